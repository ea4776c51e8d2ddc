"""`lpac fleet doctor` and `up`: check the fleet in the field, and decide go or no-go."""

import json
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lpac.cli.fields import options_of
from lpac.cli.fleet.progress import run_for_each
from lpac.cli.options import DEFAULT_FLEET, AsJson, Fleet, FleetOptions, Robots, open_fleet
from lpac.cli.printing import BAD, FAINT, GOOD, NOTABLE, print_notes, print_table, styled

if TYPE_CHECKING:
    from rich.text import Text

    from lpac.fleet.doctor import Diagnosis, Examination
    from lpac.fleet.hold import Report
    from lpac.fleet.operations import Outcome
    from lpac.fleet.settings import FleetConfig, RobotHost
    from lpac.fleet.up import BatteryReport, UpResult

_STYLES = {"ok": GOOD, "skipped": FAINT, "warning": NOTABLE, "FAILED": BAD}


def doctor(
    fleet: Fleet = DEFAULT_FLEET,
    robots: Robots = None,
    laptop: Annotated[
        bool, typer.Option("--laptop", help="Check this machine, not the robots.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Find what would keep the robots from flying, and print how to fix it.

    Changes nothing, with one exception: PX4 parameters of a robot whose program does not run are
    set if its configuration says so.
    """
    from lpac.fleet.doctor import Diagnosis, diagnose
    from lpac.fleet.laptop import examine_laptop

    config, chosen = open_fleet(fleet, robots)
    if laptop:
        diagnoses = [Diagnosis("laptop", examine_laptop(config))]
    else:
        diagnoses = diagnose(config, _examine(config, chosen))
    if as_json:
        _echo(config, _described(diagnoses))
    else:
        _print_found(config, diagnoses)
    _require_none_failed(diagnoses)


def _examine(config: "FleetConfig", robots: Sequence["RobotHost"]) -> "list[Outcome[Examination]]":
    from lpac.fleet.doctor import examine

    async def one(robot: "RobotHost", report: "Report") -> "Examination":
        others = [other for other in robots if other is not robot]
        return await examine(config, robot, others, report)

    return run_for_each(robots, one)


def _print_found(config: "FleetConfig", diagnoses: "Sequence[Diagnosis]") -> None:
    _print_board(diagnoses)
    _print_findings(diagnoses)
    margin = config.free_ground()
    if margin is not None:
        typer.echo(f"\nkeep free: the fence and {margin.least_m:g} m around it ({margin.why})")


def _print_board(diagnoses: "Sequence[Diagnosis]") -> None:
    """A row for each check, a column for each robot."""
    names = list(dict.fromkeys(check.name for each in diagnoses for check in each.checks))
    verdicts = [{check.name: check.verdict for check in each.checks} for each in diagnoses]
    rows: list[list[str | Text]] = [
        [name, *(_verdict(of_robot.get(name)) for of_robot in verdicts)] for name in names
    ]
    print_table(("", *(each.robot for each in diagnoses)), rows)


def _verdict(verdict: str | None) -> "Text":
    if verdict is None:
        return styled("", FAINT)
    # Ten robots must fit into a terminal.
    short = {"skipped": "-", "warning": "warn"}.get(verdict, verdict)
    return styled(short, _STYLES[verdict])


def _print_findings(diagnoses: "Sequence[Diagnosis]") -> None:
    """Print checks that are not ok, the worst first; one line for robots with the same finding."""
    notes: list[tuple[str, str | Text]] = []
    for verdict in ("FAILED", "warning", "skipped"):
        found: dict[tuple[str, str], dict[str, str]] = {}
        for diagnosis in diagnoses:
            for check in diagnosis.checks:
                if check.verdict == verdict:
                    found.setdefault((check.name, check.found), {})[diagnosis.robot] = check.fix
        for (name, text), fixes in found.items():
            notes.append((", ".join(fixes), styled(f"{name}: {text}", _STYLES[verdict])))
            first, *others = dict.fromkeys(fixes.values())
            if first:
                also = f"   (likewise on {', '.join([*fixes][1:])})" if others else ""
                notes.append(("", f"  → {first}{also}"))
    print_notes(notes)


def _print_multicast(config: "FleetConfig") -> None:
    """Print the costs of multicast."""
    from lpac.fleet.up import group_costs

    for cost in group_costs(config):
        (least, most), (seldom, often) = cost.datagrams, cost.lost
        several = most > 1
        numbers = f"{least} to {most}" if least < most else str(most)
        lost = f"{seldom:.0%} to {often:.0%}" if least < most else f"{often:.0%}"
        typer.echo(
            f"multicast: a message in {cost.payload} takes {numbers} "
            f"datagram{'s' if several else ''}{', all or nothing' if several else ''}: if 1 in 20 "
            f"is lost, so are {lost} of messages"
        )


def _described(diagnoses: "Sequence[Diagnosis]") -> dict[str, Any]:
    return {
        each.robot: {
            "ok": not each.failed(),
            "checks": [check._asdict() for check in each.checks],
        }
        for each in diagnoses
    }


def _require_none_failed(diagnoses: "Sequence[Diagnosis]") -> None:
    from edge.core.counted import counted

    failed = [each.robot for each in diagnoses if each.failed()]
    if failed:
        count = sum(len(each.failed()) for each in diagnoses)
        raise ValueError(f"{counted(count, 'check')} failed, on {', '.join(failed)}")


@options_of(FleetOptions)
def up(
    options: FleetOptions,
    *,
    timeout: Annotated[float, typer.Option(help="How long to wait for the robots, s.")] = 40.0,
    trial: Annotated[
        float, typer.Option(min=1.0, help="A trial's duration, s, to count what each pack lasts.")
    ] = 60.0,
) -> None:
    """Wait for the robots, set their clocks, start their programs, check all: go or no-go.

    All robots that have a slot, unless --robots is given. No robot takes off.
    """
    from lpac.fleet.up import batteries_of, combine_checks

    config, chosen = open_fleet(options.fleet, options.robots)
    until_s = time.monotonic() + timeout
    if options.robots is None:
        chosen = _in_slots(config, chosen)
    results = _bring_up(config, chosen, until_s)
    came = [outcome.robot for outcome in results if outcome.value is not None]
    examinations = _examine(config, came)
    diagnoses = combine_checks(config, results, examinations)
    batteries = {pack.robot: pack for pack in batteries_of(config, examinations, trial)}
    if options.as_json:
        described = _described(diagnoses)
        for diagnosis in diagnoses:
            reasons = diagnosis.reasons()
            described[diagnosis.robot] |= {"go": not reasons, "reasons": reasons}
        for pack in batteries.values():
            described[pack.robot]["pack"] = pack._asdict()
        _echo(config, described)
    else:
        _print_found(config, diagnoses)
        _print_multicast(config)
        _print_decisions(diagnoses, batteries)
        _print_remarks(config, trial)
    no_go = [diagnosis.robot for diagnosis in diagnoses if diagnosis.failed()]
    if no_go:
        raise ValueError(f"NO-GO: {', '.join(no_go)}")


def _in_slots(config: "FleetConfig", robots: Sequence["RobotHost"]) -> list["RobotHost"]:
    """Select the robots that have a slot. Raises ValueError if there are none."""
    chosen = [robot for robot in robots if config.slot_of(robot.name) is not None]
    if not chosen:
        raise ValueError(f"{config.path}: slots: no robot has one")
    return chosen


def _print_remarks(config: "FleetConfig", trial_s: float) -> None:
    if config.insecure:
        typer.secho("insecure: anyone on the network can fly this fleet", fg="yellow")
    typer.echo(f"trials: number of {trial_s:g} s that each pack lasts; --trial SECONDS for others")


def _bring_up(
    config: "FleetConfig", robots: Sequence["RobotHost"], until_s: float
) -> "list[Outcome[UpResult]]":
    from lpac.fleet.up import bring_up

    async def bring_one_up(robot: "RobotHost", report: "Report") -> "UpResult":
        return await bring_up(config, robot, until_s, report)

    return run_for_each(robots, bring_one_up)


def _print_decisions(
    diagnoses: "Sequence[Diagnosis]", batteries: "Mapping[str, BatteryReport]"
) -> None:
    rows: list[tuple[str | Text, ...]] = []
    for diagnosis in diagnoses:
        first, *others = diagnosis.reasons() or [""]
        word = styled("NO-GO", BAD) if first else styled("GO", GOOD)
        pack = batteries.get(diagnosis.robot)
        battery = "" if pack is None or pack.share is None else f"{pack.share:.0%}"
        count = "" if pack is None or pack.trials is None else str(pack.trials)
        rows.append((diagnosis.robot, word, battery, count, first))
        rows += [("", "", "", "", reason) for reason in others]
    no_go = any(diagnosis.failed() for diagnosis in diagnoses)
    known = [p.trials for p in batteries.values() if p.trials is not None]
    least = str(min(known)) if known else ""
    go = styled("NO-GO", BAD) if no_go else styled("GO", GOOD)
    rows.append(("fleet", go, "", least, ""))
    typer.echo()
    print_table(("robot", "", "battery", "trials", "why"), rows, ("battery", "trials"))


def _echo(config: "FleetConfig", robots: dict[str, Any]) -> None:
    margin = config.free_ground()
    described = {
        "fleet": config.fleet,
        "ok": all(described["ok"] for described in robots.values()),
        "free_ground_m": None if margin is None else margin.least_m,
        "robots": robots,
    }
    typer.echo(json.dumps(described, indent=2))
