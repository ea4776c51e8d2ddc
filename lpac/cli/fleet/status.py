"""`lpac fleet status`: the state of each robot."""

import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from lpac.cli.fleet.progress import print_json, require_all, run_for_each
from lpac.cli.options import DEFAULT_FLEET, AsJson, Fleet, Robots, open_fleet
from lpac.cli.printing import BAD, FAINT, GOOD, NOTABLE, print_notes, print_table, styled

if TYPE_CHECKING:
    from rich.text import Text

    from lpac.fleet.hold import Report
    from lpac.fleet.operations import Outcome
    from lpac.fleet.settings import FleetConfig, RobotHost

# Characters of a shortened id.
SHORT = 8
# A greater clock offset is noted, since logs of several robots could not be put in order.
_CLOCK_WITHIN_S = 0.5

_HEADINGS = (
    "robot", "slot", "release", "program", "flight", "armed", "battery", "sats", "peers",
    "failed\nchecks", "clock\ns",
)  # fmt: skip
_NUMBERS = ("slot", "battery", "sats", "peers", "failed\nchecks", "clock\ns")


class State(NamedTuple):
    """A robot's `overview`, and by how much its clock is ahead of this computer's, s.

    `slot` is its slot's index, None for a spare. `last_words` is the last output of a failed
    program, else None. `is_configured`: its configuration is fleet.toml's; None without a release.
    """

    overview: dict[str, Any]
    slot: int | None
    clock_offset_s: float
    last_words: str | None
    is_configured: bool | None = None


def status(fleet: Fleet = DEFAULT_FLEET, robots: Robots = None, as_json: AsJson = False) -> None:
    """Show each robot's release and state."""
    config, chosen = open_fleet(fleet, robots)

    async def one(robot: "RobotHost", _: "Report") -> "State":
        return await read_state(config, robot)

    outcomes = run_for_each(chosen, one)
    if as_json:
        print_json(config, outcomes, describe)
    else:
        print_status(config, outcomes)
    require_all(outcomes, "reached")


async def read_state(config: "FleetConfig", robot: "RobotHost") -> State:
    """Read a robot's state, without locking or changing anything. Raises FleetError."""
    from lpac.fleet.doctor import is_configured
    from lpac.fleet.hold import visit

    async with visit(config, robot) as (session, overview):
        clock_offset_s = overview["unix_time_s"] - time.time()
        words = None
        if _failed(overview["service"]):
            words = (await session.call("last_words"))["text"]
    configured = None if overview["current"] is None else is_configured(config, robot, overview)
    return State(overview, _slot(config, robot.name), clock_offset_s, words, configured)


def describe(state: State) -> dict[str, object]:
    """Describe a state for JSON: the overview's keys, and the others."""
    return {
        **state.overview,
        "slot": state.slot,
        "clock_offset_s": round(state.clock_offset_s, 3),
        "last_words": state.last_words,
        "is_configured": state.is_configured,
    }


def print_status(config: "FleetConfig", outcomes: Sequence["Outcome[State]"]) -> None:
    """Print the table of the fleet, and notes on problems."""
    states = {o.robot.name: o.value for o in outcomes if o.value is not None}
    parts = {name: _parts(state.overview["versions"]) for name, state in states.items()}
    newest = max(states, key=lambda name: _release_number(states[name]), default="")
    behind = {name: text for name, text in parts.items() if text not in (None, parts[newest])}
    silent = ["", styled("see below", BAD), *[""] * (len(_HEADINGS) - 4)]
    rows = []
    for robot, state, *_ in outcomes:
        slot = _slot(config, robot.name)
        place = styled("spare", FAINT) if slot is None else str(slot)
        cells = silent if state is None else _cells(state, robot.name in behind)
        rows.append([robot.name, place, *cells])
    print_table(_HEADINGS, rows, _NUMBERS)
    notes: list[tuple[str, str | Text]] = []
    for outcome in outcomes:
        if outcome.problem is not None:
            notes.append((outcome.robot.name, styled(outcome.problem, BAD)))
        if outcome.value is not None:
            notes += [(outcome.robot.name, note) for note in _notes(outcome.value)]
        if outcome.robot.name in behind and outcome.value is not None:
            has = f"{_date(outcome.value)}: {behind[outcome.robot.name]}"
            notes.append((outcome.robot.name, styled(f"* behind {newest}: {has}", NOTABLE)))
        if outcome.value is not None and outcome.value.is_configured is False:
            note = (
                f"* its configuration is not that of {config.path.name}: lpac fleet deploy "
                f"--robots {outcome.robot.name}"
            )
            notes.append((outcome.robot.name, styled(note, NOTABLE)))
    if parts.get(newest):
        label = "newest" if behind else "all"
        notes.append((label, f"{_date(states[newest])}: {parts[newest]}"))
    print_notes(notes)


def program(service: Mapping[str, Any]) -> "Text":
    """State of the systemd unit, in a word or two."""
    if not service["installed"]:
        return styled("none", FAINT)
    if _failed(service):
        return styled("failed", BAD)
    if service["active"] != "active":
        return styled({"inactive": "stopped"}.get(service["active"], service["active"]), NOTABLE)
    if not service["fresh"]:
        return styled("silent", BAD)
    return styled(f"up {_duration(service['uptime_s'])}", GOOD)


def flight(service: Mapping[str, Any]) -> str:
    """Flight state of the program's last status; "" if it does not run."""
    return str(service["status"].get("state", "")) if service["fresh"] else ""


def _cells(state: State, behind: bool) -> list["str | Text"]:
    overview, service = state.overview, state.overview["service"]
    reported = service["status"] if service["fresh"] else {}
    marks = ("*" if behind or state.is_configured is False else "") + (
        "?" if overview["pending"] else ""
    )
    armed = reported.get("armed")
    failed_checks = len(reported.get("failed_checks", ()))
    clock_well = abs(state.clock_offset_s) <= _CLOCK_WITHIN_S
    return [
        (overview["current"] or "none")[:SHORT] + marks,
        program(service),
        flight(service),
        "" if armed is None else styled("yes", NOTABLE) if armed else "no",
        "" if reported.get("battery") is None else f"{100.0 * reported['battery']:.0f} %",
        _number(reported.get("satellites")),
        _number(reported.get("peers")),
        "" if not reported else styled(str(failed_checks), NOTABLE if failed_checks else ""),
        styled(f"{round(state.clock_offset_s, 1) + 0.0:+.1f}", "" if clock_well else NOTABLE),
    ]


def _notes(state: State) -> list["str | Text"]:
    from edge.core.counted import counted

    notes: list[str | Text] = []
    service, pending = state.overview["service"], state.overview["pending"]
    if pending:
        note = f"? switch to {pending[:SHORT]} not confirmed: if nobody is deploying, deploy again"
        notes.append(styled(note, NOTABLE))
    if state.last_words is not None:
        notes.append(styled(state.last_words, BAD))
    if service["restarts"]:
        notes.append(f"systemd restarted its program {counted(service['restarts'], 'time')}")
    return notes


def _slot(config: "FleetConfig", robot: str) -> int | None:
    robots = [slot.robot for slot in config.slots]
    return robots.index(robot) if robot in robots else None


def _failed(service: Mapping[str, Any]) -> bool:
    """Whether the program has failed, or is being restarted after it did."""
    died = service["result"] not in ("", "success") or service["restarts"] > 0
    return service["active"] == "failed" or (service["active"] == "activating" and died)


def _parts(versions: Mapping[str, Any] | None) -> str | None:
    """Versions that all robots of a fleet should have in common; None without a release."""
    if versions is None:
        return None
    names = ("image", "bundle", "world")
    return ", ".join(f"{name} {str(versions.get(name))[:SHORT]}" for name in names)


def _release_number(state: State) -> int:
    """Number of the robot's release: the Unix time when it was made, s."""
    return int(state.overview["number"] or 0)


def _date(state: State) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(_release_number(state)))


def _duration(seconds: float) -> str:
    for unit_s, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2.0 * unit_s:
            return f"{seconds / unit_s:.0f} {unit}"
    return f"{seconds:.0f} s"


def _number(value: int | None) -> str:
    return "" if value is None else str(value)
