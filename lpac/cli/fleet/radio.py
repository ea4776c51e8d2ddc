"""`lpac fleet radio`: measure before a flight whether the radio carries the fleet."""

import json
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from lpac.cli.fleet.progress import print_problems, run_for_each
from lpac.cli.ground_requests import interruptible
from lpac.cli.options import DEFAULT_FLEET, AsJson, Fleet, Robots, open_fleet
from lpac.cli.printing import BAD, FAINT, GOOD, NOTABLE, print_table, progress_of, styled

if TYPE_CHECKING:
    from rich.text import Text

    from edge.messages.mission import RobotStatus
    from lpac.analysis.snapshot import FleetSnapshot
    from lpac.fleet.operations import Outcome
    from lpac.fleet.settings import FleetConfig, RobotHost
    from lpac.fleet.wifi import BulkStream, Interface
    from lpac.ground.station.subscriber import GroundSubscriber
    from lpac.radio.checked import Checked, WifiReading
    from lpac.radio.pairs import Pair, Window
    from lpac.radio.verdict import RadioVerdict, Room

# A robot sends counts every 2 s.
_HEARD_WITHIN_S = 6.0
_LOOK_S = 0.2
_NOT_REPORTED = "not reported"


class _Result(NamedTuple):
    """Measurement, its verdict, and the outcomes of reading the robots' Wi-Fi."""

    checked: "Checked"
    pairs: "Sequence[Pair]"
    verdict: "RadioVerdict"
    stream: "BulkStream | None"
    wifi_outcomes: "Sequence[Outcome[list[Interface]]]"


def radio(
    fleet: Fleet = DEFAULT_FLEET,
    robots: Robots = None,
    seconds: Annotated[
        float, typer.Option(min=10.0, max=3600.0, help="How long to listen, s.")
    ] = 20.0,
    load: Annotated[
        bool, typer.Option("--load", help="Also send a bulk stream from the first robot.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", help="A folder for the heat map: radio.png and .pdf.")
    ] = None,
    record: Annotated[
        Path | None, typer.Option("--record", help="Write a JSON line for each pair to this file.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure how well robots on the ground receive each other: does the radio carry the fleet?

    Needs `lpac ground`, and robots with a mission origin; commands nothing. Spares are left out.
    With --robots only these are judged; all robots share the channel.
    """
    config, chosen = open_fleet(fleet, robots)
    result = _measure(config, chosen, seconds, load=load)
    checked, verdict = result.checked, result.verdict
    if record is not None:
        _write(record, result)
    if out is not None:
        from lpac.radio.heat_map import draw

        draw(checked.robots, result.pairs, f"{config.fleet}: {verdict.sentence}", out / "radio")
    if as_json:
        typer.echo(json.dumps({"fleet": config.fleet, **_described(result)}, indent=2))
    else:
        _print_pairs(checked, result.pairs)
        _print_wifi(checked, result.wifi_outcomes)
        _print_verdict(result)
    if verdict.problems:
        raise ValueError(f"radio: {verdict.sentence}")


def _write(record: Path, result: _Result) -> None:
    from lpac.radio.records import write_records

    write_records(record, result.checked.records(result.pairs))
    if not result.wifi_outcomes:
        note = "the robots are simulated on this computer: no radio was measured"
        typer.echo(f"note: {note}", err=True)


def _measure(
    config: "FleetConfig", robots: Sequence["RobotHost"], seconds: float, *, load: bool
) -> _Result:
    """Measure the robots that have a slot. Raises ValueError."""
    from edge.policy.bundle import load_bundle
    from lpac.ground.station.subscriber import GroundSubscriber
    from lpac.radio.airtime import MESSAGE_BYTES
    from lpac.radio.verdict import verdict

    chosen = [robot for robot in robots if config.slot_of(robot.name) is not None]
    if len(chosen) < 2:
        raise ValueError("radio: needs two or more robots with a slot")
    computers = [robot for robot in chosen if robot.has_computer]
    if load and not computers:
        raise ValueError("--load: no robot has a computer that could send a bulk stream")
    judged = load_bundle(config.bundle).manifest.payload_types
    payload = config.robot_config(chosen[0].name).policy.payload_of(judged)
    with interruptible("radio", "nothing was changed"), GroundSubscriber(config.fleet) as ground:
        _require_speaking(ground, [robot.name for robot in chosen], load=load)
        before = _read_wifi(config, computers)
        windows, stream = _listen(ground, config, seconds, computers[0] if load else None)
        after = _read_wifi(config, computers)
    checked = _checked(config, chosen, windows, before, after, MESSAGE_BYTES[payload], loaded=load)
    pairs = checked.pairs()
    return _Result(checked, pairs, verdict(checked, pairs), stream, after)


def _require_speaking(ground: "GroundSubscriber", names: Sequence[str], *, load: bool) -> None:
    """Raise ValueError, with the remedy, unless the robots send counts."""
    from lpac.radio.verdict import WHAT_RUNS, obstacles

    statuses: dict[str, RobotStatus] = {}

    def all_reported(snapshot: "FleetSnapshot") -> bool:
        for name, status in _fresh_statuses(snapshot, names).items():
            # Only some statuses have counts.
            if status.radio_counts is not None or statuses.get(name) is None:
                statuses[name] = status
        return len(statuses) == len(names) and all(s.radio_counts for s in statuses.values())

    # The verdict lists robots that are not heard.
    ground.wait_for(all_reported, _HEARD_WITHIN_S)
    if not statuses:
        raise ValueError(f"radio: no robot is heard: {WHAT_RUNS}")
    hindrances = obstacles(statuses)
    if hindrances:
        raise ValueError(f"radio: {'; '.join(hindrances)}")
    armed = [name for name, status in statuses.items() if status.armed]
    if load and armed:
        raise ValueError(f"--load: {', '.join(armed)}: armed: disturb no radio in flight")


def _fresh_statuses(snapshot: "FleetSnapshot", names: Sequence[str]) -> dict[str, "RobotStatus"]:
    """Statuses of the named robots that are heard now."""
    return {
        robot.name: robot.status
        for robot in snapshot.robots
        if robot.fresh and robot.status is not None and robot.name in names
    }


def _listen(
    ground: "GroundSubscriber",
    config: "FleetConfig",
    seconds: float,
    bulk_from: "RobotHost | None",
) -> tuple[dict[str, "Window"], "BulkStream | None"]:
    """Count messages of all robots with a slot: the others take airtime from those judged."""
    from lpac.fleet.wifi import bulk_stream
    from lpac.radio.pairs import Window

    names = [slot.robot for slot in config.slots if slot.robot is not None]
    windows: dict[str, Window] = {}

    def take(snapshot: "FleetSnapshot") -> bool:
        for name, status in _fresh_statuses(snapshot, names).items():
            known = windows.get(name)
            if status.radio_counts is None:
                continue
            # A restarted program counts from zero.
            restarted = known is None or known.first.boot_nonce != status.boot_nonce
            windows[name] = Window(status if known is None or restarted else known.first, status)
        return False

    stream = nullcontext() if bulk_from is None else bulk_stream(config, bulk_from)
    with progress_of("listening") as progress, stream as streaming:
        task = progress.add_task("s", total=round(seconds))
        began_s = time.monotonic()
        while (passed_s := time.monotonic() - began_s) < seconds:
            progress.update(task, completed=int(passed_s))
            # Take each snapshot, since only some statuses have counts. Raises if the ground ends.
            ground.wait_for(take, min(_LOOK_S, seconds - passed_s))
    return {name: w for name, w in windows.items() if w.duration_s > 0.0}, streaming


def _read_wifi(
    config: "FleetConfig", robots: Sequence["RobotHost"]
) -> "list[Outcome[list[Interface]]]":
    from lpac.fleet.wifi import read_wifi

    outcomes = run_for_each(robots, partial(read_wifi, config)) if robots else []
    if any(outcome.interrupted for outcome in outcomes):
        raise KeyboardInterrupt
    return outcomes


def _checked(
    config: "FleetConfig",
    chosen: Sequence["RobotHost"],
    windows: Mapping[str, "Window"],
    before: "Sequence[Outcome[list[Interface]]]",
    after: "Sequence[Outcome[list[Interface]]]",
    flight_bytes: float,
    *,
    loaded: bool,
) -> "Checked":
    from edge.identity.envelope import HEAD_BYTES, OVERHEAD_BYTES
    from lpac.fleet.wifi import in_the_wifi, reading
    from lpac.radio.checked import Checked

    then = {outcome.robot.name: outcome.value or [] for outcome in before}
    return Checked(
        robots=tuple(robot.name for robot in chosen),
        windows=windows,
        wifi={
            o.robot.name: reading(then[o.robot.name], o.value) for o in after if o.value is not None
        },
        transport=config.radio.transport,
        overhead_bytes=HEAD_BYTES if config.keys is None else OVERHEAD_BYTES,
        flight_bytes=flight_bytes,
        loaded=loaded,
        ground_wired=not in_the_wifi(chosen[0].address),
    )


def _print_pairs(checked: "Checked", found: Sequence["Pair"]) -> None:
    """Print a table per measure: rows of receivers, columns of senders."""
    from lpac.radio.pairs import LATE_S

    names = checked.robots
    by_link = {(pair.receiver, pair.sender): pair for pair in found}
    for heading, cell in (
        ("arrived, %", partial(_delivered, expected_loss=checked.expected_loss)),
        ("age p99, s", _age), (f"{LATE_S:g} s old or older, %", _late),
    ):  # fmt: skip
        typer.echo(f"{heading}: a row receives, a column sends")
        rows: list[list[str | Text]] = [
            [receiver, *(
                cell(pair) if (pair := by_link.get((receiver, sender)))
                else styled("" if receiver == sender else "-", FAINT)
                for sender in names
            )]
            for receiver in names
        ]  # fmt: skip
        print_table(("", *names), rows, names)
        typer.echo()


def _print_wifi(checked: "Checked", outcomes: "Sequence[Outcome[list[Interface]]]") -> None:
    if outcomes:
        numbers = ("signal dBm", "rate Mbit/s", "channel busy %")
        rows: list[list[str | Text]] = [
            [name, *_wifi_cells(checked.wifi.get(name))] for name in checked.robots
        ]
        print_table(("robot", *numbers), rows, numbers)
        print_problems(outcomes)
        typer.echo()


def _print_verdict(result: _Result) -> None:
    verdict, stream, room = result.verdict, result.stream, result.verdict.room
    if stream is not None:
        typer.echo(f"bulk stream from {stream.robot}: {stream.rate_mbit_s:.1f} Mbit/s")
    for problem in verdict.problems:
        typer.secho(problem, fg=BAD)
    if not verdict.problems:
        typer.secho(verdict.sentence, fg=GOOD)
    # A failure needs no model, unless it is the model that finds the channel too small.
    if room is not None and (not verdict.problems or room.carries < room.robots):
        typer.secho(_basis(result.checked, room), dim=True)


def _basis(checked: "Checked", room: "Room") -> str:
    """Describe the assumptions behind the room for more."""
    text = (
        f"room by the model of docs/network.md: {checked.transport} at {_rates(checked, room)}; "
        f"{room.ground_bytes:.0f} bytes {room.message_hz:.1f} times a second take "
        f"{100.0 * room.ground_share:.0f} % of the channel, {room.flight_bytes:.0f} bytes in "
        f"flight {100.0 * room.flight_share:.0f} %; up to {room.carries} robots stay below 60 %"
    )
    if room.busy_share is not None:
        text += (
            f"; scaled, since the channel was busy {100.0 * room.busy_share:.0f} % of the time and "
            f"the model predicts {100.0 * room.model_busy_share:.0f} %"
        )
        if room.others_share > 0.0:
            text += f"; others are assumed to take {100.0 * room.others_share:.0f} %"
    if not checked.ground_wired:
        text += (
            "; this computer is on the Wi-Fi, so all that it sends or forwards crosses the air "
            "twice"
        )
    return text


def _rates(checked: "Checked", room: "Room") -> str:
    rate, to_all = f"{room.rate_mbit_s:.0f} Mbit/s", f"{room.multicast_rate_mbit_s:g} Mbit/s to all"
    if checked.transport != "multicast":
        return rate if room.rate_told else f"{rate} (assumed)"
    if room.rate_told:
        return f"{rate}, and an assumed {to_all}"
    return f"{rate}, and {to_all} (both assumed)"


def _delivered(pair: "Pair", *, expected_loss: float) -> "Text":
    from lpac.radio.verdict import LEAST_DELIVERED, is_good

    good = is_good(pair, expected_loss)
    style = GOOD if pair.delivered >= LEAST_DELIVERED else NOTABLE if good else BAD
    return styled(f"{100.0 * pair.delivered:.0f}", style)


def _age(pair: "Pair") -> "Text":
    from lpac.radio.pairs import LATE_S

    age_s = pair.age_p99_s
    if age_s is None:
        return styled("-", FAINT)
    return styled(
        f"{age_s:.2f}", BAD if age_s >= LATE_S else NOTABLE if age_s >= LATE_S / 2 else GOOD
    )


def _late(pair: "Pair") -> "Text":
    from lpac.radio.verdict import MOST_LATE

    if not pair.received:
        return styled("-", FAINT)
    share = pair.late_share
    style = GOOD if not share else NOTABLE if share <= MOST_LATE else BAD
    return styled(f"{100.0 * share:.0f}", style)


def _wifi_cells(wifi: "WifiReading | None") -> list["Text"]:
    if wifi is None:
        return [styled("see below", FAINT)]
    values = (
        wifi.signal_dbm, wifi.rate_mbit_s,
        None if wifi.busy_share is None else 100.0 * wifi.busy_share,
    )  # fmt: skip
    return [styled(_NOT_REPORTED, FAINT) if v is None else styled(f"{v:.0f}", "") for v in values]


def _described(result: _Result) -> dict[str, Any]:
    checked, verdict, stream = result.checked, result.verdict, result.stream
    problems = {outcome.robot.name: outcome.problem for outcome in result.wifi_outcomes}
    return {
        "ok": not verdict.problems,
        "sentence": verdict.sentence,
        "problems": verdict.problems,
        "transport": checked.transport,
        "room": verdict.room and verdict.room._asdict(),
        "bulk_stream": stream and {"robot": stream.robot, "rate_mbit_s": stream.rate_mbit_s},
        "robots": {
            name: {
                "heard": name in checked.windows,
                "wifi": (wifi := checked.wifi.get(name)) and wifi._asdict(),
                "wifi_problem": problems.get(name),
            }
            for name in checked.robots
        },
        "pairs": [
            {**pair._asdict(), "delivered": pair.delivered, "late_share": pair.late_share}
            for pair in result.pairs
        ],
    }
