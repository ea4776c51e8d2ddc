"""`lpac fleet`: deploy, start and stop programs, land, and read journals."""

import json
import shlex
import signal
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TypeVar

import typer

from lpac.cli.fields import options_of
from lpac.cli.fleet.progress import print_json, print_results, require_all, run_all, run_for_each
from lpac.cli.fleet.status import SHORT, flight, program
from lpac.cli.options import DEFAULT_FLEET, AsJson, Fleet, FleetOptions, Robots, open_fleet
from lpac.cli.printing import GOOD, styled, working

if TYPE_CHECKING:
    from rich.text import Text

    from lpac.fleet.deploy import Deployed
    from lpac.fleet.hold import Report
    from lpac.fleet.operations import Outcome
    from lpac.fleet.session import Session
    from lpac.fleet.settings import FleetConfig, RobotHost

T = TypeVar("T")

InFlight = Annotated[
    bool, typer.Option("--in-flight", help="Even if the vehicle is armed: it holds or lands.")
]
_COLOURS = ("cyan", "magenta", "yellow", "green", "blue", "bright_cyan", "bright_magenta")


class _Deployed(NamedTuple):
    """Result of a deployment, and how long it took."""

    deployed: "Deployed"
    duration_s: float


def deploy(fleet: Fleet = DEFAULT_FLEET, robots: Robots = None, as_json: AsJson = False) -> None:
    """Copy image, policy and configuration to the robots, verify them there, and run them.

    If anything fails on a robot, it keeps its release. A robot in flight refuses.
    """
    from lpac.fleet.deploy import deploy as deploy_to
    from lpac.fleet.release import load_common, make_release

    config, chosen = open_fleet(fleet, robots)
    with tempfile.TemporaryDirectory(prefix="lpac-deploy-") as folder:
        releases = {}
        with working("reading image, policy and world"):
            common = load_common(config)
            for robot in chosen:
                place = Path(folder, robot.name)
                place.mkdir()
                releases[robot.name] = make_release(config, robot, common, place)

        async def one(robot: "RobotHost", report: "Report") -> _Deployed:
            began_s = time.monotonic()
            deployed = await deploy_to(config, robot, releases[robot.name], report)
            return _Deployed(deployed, time.monotonic() - began_s)

        outcomes = run_for_each(chosen, one)
    print_results(
        config, outcomes, "deployed on", as_json=as_json, cells=_deployed_cells,
        numbers=("MB sent", "perceive ms", "infer ms", "s"), headings=("release",),
        describe=lambda v: {**v.deployed._asdict(), "duration_s": v.duration_s},
    )  # fmt: skip


def _deployed_cells(value: _Deployed) -> tuple["str | Text", ...]:
    deployed = value.deployed
    return (
        deployed.release,
        f"{deployed.sent_bytes / 1e6:.1f}",
        _decimal(deployed.perceive_p99_ms),
        _decimal(deployed.infer_p99_ms),
        f"{value.duration_s:.0f}",
        styled(deployed.summary, GOOD),
    )


def rollback(fleet: Fleet = DEFAULT_FLEET, robots: Robots = None, as_json: AsJson = False) -> None:
    """Return to the previous release. A robot in flight refuses."""
    from lpac.fleet.deploy import rollback as roll_back

    config, chosen = open_fleet(fleet, robots)
    chosen = _without_spares(config, chosen, "rolled back")

    print_results(
        config, run_for_each(chosen, partial(roll_back, config)), "rolled back on", as_json=as_json,
        headings=("release",), cells=lambda release: (release, styled("rolled back", GOOD)),
        describe=lambda release: {"release": release},
    )  # fmt: skip


class _Controlled(NamedTuple):
    """A robot's release, its systemd unit, and the interrupted switch of releases ended first."""

    release: str | None
    service: dict[str, Any]
    recovered: str | None


def start(fleet: Fleet = DEFAULT_FLEET, robots: Robots = None, as_json: AsJson = False) -> None:
    """Start the robots' programs, now and at every boot. No robot takes off."""
    from lpac.fleet import program

    config, chosen = open_fleet(fleet, robots)
    chosen = _without_spares(config, chosen, "started")
    _control(config, chosen, "start", lambda at, _: program.start(at, config), as_json)


@options_of(FleetOptions)
def stop(options: FleetOptions, *, in_flight: InFlight = False) -> None:
    """Stop the robots' programs, now and at every boot. A robot in flight refuses."""
    from lpac.fleet import program

    config, chosen = open_fleet(options.fleet, options.robots)
    _control(
        config, chosen, "stop",
        lambda at, robot: program.stop(at, robot, in_flight=in_flight, disable=True),
        options.as_json,
    )  # fmt: skip


@options_of(FleetOptions)
def restart(options: FleetOptions, *, in_flight: InFlight = False) -> None:
    """Stop the robots' programs and start them again. A robot in flight refuses."""
    from lpac.fleet import program

    config, chosen = open_fleet(options.fleet, options.robots)
    chosen = _without_spares(config, chosen, "restarted")

    _control(
        config, chosen, "restart",
        lambda at, robot: program.restart(at, config, robot, in_flight=in_flight), options.as_json,
    )  # fmt: skip


def land(fleet: Fleet = DEFAULT_FLEET, robots: Robots = None, as_json: AsJson = False) -> None:
    """Land vehicles whose programs have ended, where they are, through SSH and PX4.

    Refused while the program runs (use `lpac mission land`) and while a pilot flies.
    """
    from lpac.fleet import program
    from lpac.fleet.hold import visit

    config, chosen = open_fleet(fleet, robots)

    async def one(robot: "RobotHost", report: "Report") -> dict[str, Any]:
        async with visit(config, robot, report) as (session, _):
            return await program.land(session, robot, report)

    print_results(
        config, run_for_each(chosen, one), "landing:", as_json=as_json,
        describe=lambda v: {"mode": v["mode"], "armed": v["armed"]},
        cells=lambda v: (styled("it lands" if v["armed"] else "it has landed", GOOD),),
    )  # fmt: skip


_DONE = {"start": "started on", "stop": "stopped on", "restart": "restarted on"}


def _control(
    config: "FleetConfig",
    robots: Sequence["RobotHost"],
    step: str,
    change: Callable[["Session", "RobotHost"], Awaitable[None]],
    as_json: bool,
) -> None:
    """Lock each robot, change its systemd unit, and print the results."""
    from lpac.fleet.hold import hold

    async def one(robot: "RobotHost", report: "Report") -> _Controlled:
        async with hold(config, robot, report) as (session, found, recovered):
            report(step, None)
            await change(session, robot)
            return _Controlled(found["current"], await session.call("service"), recovered)

    outcomes = run_for_each(robots, one)
    for outcome in outcomes:
        if outcome.value and outcome.value.recovered and not as_json:
            typer.echo(f"{outcome.robot.name}: {outcome.value.recovered}")
    print_results(
        config, outcomes, _DONE[step], as_json=as_json, describe=_Controlled._asdict,
        headings=("release", "flight"),
        cells=lambda v: ((v.release or "")[:SHORT], flight(v.service), program(v.service)),
    )  # fmt: skip


def _without_spares(
    config: "FleetConfig", robots: list["RobotHost"], done: str
) -> list["RobotHost"]:
    spares = [robot.name for robot in robots if config.slot_of(robot.name) is None]
    if len(spares) == len(robots):
        raise ValueError(f"a spare is not {done}, it has no slot: {', '.join(spares)}")
    if spares:
        typer.echo(f"left out, since a spare is not {done}: {', '.join(spares)}", err=True)
    return [robot for robot in robots if robot.name not in spares]


@contextmanager
def _end_on_closed_pipe() -> Iterator[None]:
    """End of SIGPIPE, once all sessions have, if `head` or `grep -m1` closed stdout."""
    try:
        yield
    except* BrokenPipeError:
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
        signal.raise_signal(signal.SIGPIPE)


@_end_on_closed_pipe()
def logs(
    fleet: Fleet = DEFAULT_FLEET,
    robots: Robots = None,
    follow: Annotated[
        bool, typer.Option("--follow", "-f", help="Also show new lines, until Ctrl-C.")
    ] = False,
    lines: Annotated[
        int, typer.Option("--lines", "-n", min=0, help="Number of last lines of each robot.")
    ] = 50,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object per line.")
    ] = False,
) -> None:
    """Show the logs of the robots' programs, with systemd's messages, in order of time."""
    from lpac.fleet.logs import Entry, read_journal, readable

    config, chosen = open_fleet(fleet, robots)
    label = _labels(chosen)
    entries: list[tuple[Entry, str]] = []

    def show(entry: Entry, name: str) -> None:
        if as_json:
            typer.echo(json.dumps({"robot": name, **entry._asdict()}))
        else:
            for line in readable(entry).split("\n"):
                typer.echo(label[name] + line)

    def keep(entry: Entry, name: str) -> None:
        entries.append((entry, name))

    async def one(robot: "RobotHost") -> None:
        await read_journal(config, robot, lines, show if follow else keep, follow=follow)

    outcomes = _run_plainly(chosen, one, label)
    for entry, name in sorted(entries):
        show(entry, name)
    if follow:  # Ctrl-C is how that ends.
        outcomes = [o._replace(problem=None) if o.interrupted else o for o in outcomes]
    require_all(outcomes, "read the journal of")


@_end_on_closed_pipe()
def execute_on_all(
    command: Annotated[
        list[str],
        typer.Argument(help="Program and arguments, or one string for the robot's shell."),
    ],
    fleet: Fleet = DEFAULT_FLEET,
    robots: Robots = None,
    as_json: AsJson = False,
) -> None:
    """Run a command on the robots, such as `lpac fleet exec --robots r1,r3 -- df -h /`."""
    from lpac.fleet.execute import execute

    config, chosen = open_fleet(fleet, robots)
    label = _labels(chosen)
    text = command[0] if len(command) == 1 else shlex.join(command)

    async def one(robot: "RobotHost") -> dict[str, Any]:
        written: dict[str, list[str]] = {"stdout": [], "stderr": []}

        def on_line(line: str, stream: str) -> None:
            if as_json:
                written[stream].append(line)
            else:
                typer.echo(label[robot.name] + line, err=stream == "stderr")

        exit_code = await execute(
            config, robot, text, lambda line: on_line(line, "stdout"),
            lambda line: on_line(line, "stderr"),
        )  # fmt: skip
        if exit_code != 0 and not as_json:
            typer.echo(f"{label[robot.name]}exit code {exit_code}", err=True)
        return {"exit_code": exit_code, **written}

    outcomes = [_by_exit_code(outcome) for outcome in _run_plainly(chosen, one, label)]
    if as_json:
        print_json(config, outcomes, lambda value: value)
    require_all(outcomes, "succeeded on")


def _by_exit_code(outcome: "Outcome[dict[str, Any]]") -> "Outcome[dict[str, Any]]":
    code = 0 if outcome.value is None else outcome.value["exit_code"]
    return outcome._replace(problem=f"exit code {code}") if code else outcome


def _run_plainly(
    robots: Sequence["RobotHost"],
    task: Callable[["RobotHost"], Awaitable[T]],
    label: dict[str, str],
) -> list["Outcome[T]"]:
    """Run without a table, since the output counts; print problems on stderr as they come."""

    def on_outcome(outcome: "Outcome[T]") -> None:
        if outcome.problem is not None and not outcome.interrupted:
            typer.echo(label[outcome.robot.name] + outcome.problem, err=True)

    return run_all(robots, task, on_outcome)


def _labels(robots: Sequence["RobotHost"]) -> dict[str, str]:
    """Prefix of each robot's lines."""
    width = max(len(robot.name) for robot in robots)
    return {
        robot.name: typer.style(robot.name.ljust(width), fg=_COLOURS[n % len(_COLOURS)]) + "  "
        for n, robot in enumerate(robots)
    }


def _decimal(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"
