"""The table of `lpac watch`: one robot a line.

Every cell is as wide as its column, whatever its value is, so that nothing ever shifts.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from rich.cells import cell_len

from edge.core.fence import Fence
from edge.messages.mission import FlightState, RobotStatus
from lpac.analysis.snapshot import FleetSetup, FleetSnapshot, RobotSnapshot
from lpac.ground.alarms import (
    BATTERY_LOW,
    FEATURE_AGE_S,
    LATE_MS,
    LIMITS,
    SEVERITIES,
    Alarm,
    AlarmCode,
    Severity,
)
from lpac.ground.terminal.lines import Line, Span, TextStyle, age, fit, line, number

# Characters of an id that tell it from others.
ID = 8

_S = FlightState
_NARROWEST_NAME, _WIDEST_NAME = 4, 12
_NARROWEST_REASON = 30

MARKS: dict[Severity, str] = {"critical": "!", "warning": "*", "note": "-"}
_STATES: dict[FlightState, TextStyle] = {
    _S.INIT: "faint", _S.IDLE: "faint", _S.PREFLIGHT: "", _S.ARMING: "busy", _S.TAKEOFF: "busy",
    _S.HOLD: "calm", _S.MISSION: "good", _S.RETURN: "busy", _S.LAND: "busy", _S.LANDED: "faint",
    _S.PILOT: "foreign", _S.FAULT: "critical",
}  # fmt: skip


class Row(NamedTuple):
    """A robot, and the gravest of its alarms."""

    robot: RobotSnapshot
    alarm: Alarm | None
    setup: FleetSetup


@dataclass(frozen=True, slots=True)
class Column:
    """`top` and `unit` head it; where there is not room for all columns, low ranks stay."""

    rank: int
    top: str
    unit: str
    width: int
    cell: Callable[[Row], Span]
    left: bool = False


def columns(setup: FleetSetup, width: int) -> tuple[Column, ...]:
    """Those that there is room for; the reason takes up what is left."""
    longest = max((cell_len(name) for name in setup.robots), default=0)
    name_width = min(max(longest, _NARROWEST_NAME), _WIDEST_NAME)
    offered = (
        _COLUMNS[0],
        Column(1, "name", "", name_width, _name, left=True),
        *_COLUMNS[1:],
    )
    left, chosen = width + 1, []
    for column in sorted(offered, key=lambda column: column.rank):
        if column.width + 1 > left:
            break
        left -= column.width + 1
        chosen.append(column)
    return tuple(
        _widened(column, left) if column.cell is _reason else column
        for column in offered
        if column in chosen
    )


def _widened(column: Column, by: int) -> Column:
    return Column(column.rank, column.top, column.unit, column.width + by, column.cell, column.left)


def heading(shown: Sequence[Column]) -> tuple[Line, Line]:
    """Headings of the columns, with their units.

    A column without a name of its own shares that of the columns before it.
    """
    names, units, at = "", [], 0
    for column in shown:
        name = column.top if column.left else column.top.rjust(column.width)
        names = names.ljust(at) + name if column.top else names
        units.append(fit(column.unit, column.width, right=not column.left))
        at += column.width + 1
    return line(at - 1, Span(names, "faint")), line(at - 1, Span(" ".join(units), "faint"))


def table_row(shown: Sequence[Column], row: Row) -> Line:
    """One robot's line. What was said long ago is faint."""
    spans = []
    for column in shown:
        text, style = column.cell(row)
        if not row.robot.fresh and column.cell not in (_mark, _name, _link, _reason):
            style = "faint"
        spans += [Span(fit(text, column.width, right=not column.left), style), Span(" ")]
    return tuple(spans[:-1])


def state_word(status: RobotStatus) -> str:
    """The robot's state; "ready" is preflight with all checks passed."""
    return "ready" if status.state is _S.PREFLIGHT and status.ready else status.state.value


def state_style(status: RobotStatus) -> TextStyle:
    """In which colour."""
    return "good" if state_word(status) == "ready" else _STATES[status.state]


def _mark(row: Row) -> Span:
    return Span("") if row.alarm is None else Span(MARKS[row.alarm.severity], row.alarm.severity)


def _name(row: Row) -> Span:
    alarm = row.alarm
    grave = alarm is not None and alarm.severity != "note"
    return Span(row.robot.name, alarm.severity if alarm is not None and grave else "strong")


def _state(row: Row) -> Span:
    status = row.robot.status
    return (
        Span("not heard", "faint")
        if status is None
        else Span(state_word(status), state_style(status))
    )


def _of_status(cell: Callable[[RobotStatus], Span]) -> Callable[[Row], Span]:
    def of_row(row: Row) -> Span:
        return Span("-", "faint") if row.robot.status is None else cell(row.robot.status)

    return of_row


def _battery(row: Row) -> Span:
    status = row.robot.status
    if status is None or status.battery is None:
        return Span("-", "" if status else "faint")
    style: TextStyle = "warning" if status.battery <= BATTERY_LOW else ""
    if status.battery <= row.setup.battery_critical:
        style = "critical"
    return Span(number(100.0 * status.battery, 3, 0), style)


def _satellites(status: RobotStatus) -> Span:
    if status.satellites is None:
        return Span("-")
    few = status.satellites < LIMITS.min_satellites
    return Span(number(status.satellites, 3, 0), "warning" if few else "")


def _coordinate(axis: int, width: int) -> Callable[[RobotStatus], Span]:
    def of_status(status: RobotStatus) -> Span:
        position_m = status.position_m
        return Span(number(None if position_m is None else position_m[axis], width))

    return of_status


def speed_m_s(status: RobotStatus) -> float | None:
    """How fast it is; None if that is not known."""
    return None if status.velocity_m_s is None else math.hypot(*status.velocity_m_s)


def _features(status: RobotStatus) -> Span:
    age_s = status.feature_age_s
    old = age_s is not None and age_s > FEATURE_AGE_S and status.state in (_S.HOLD, _S.MISSION)
    return Span(age(age_s), "warning" if old else "")


def _neighbours(status: RobotStatus) -> Span:
    return Span(str(len(status.neighbour_ages_s)))


def _rate(row: Row) -> Span:
    status = row.robot.status
    heard = () if status is None else status.neighbour_ages_s
    rates_hz = [rate for robot, rate in row.robot.rates_hz.items() if robot in heard]
    return Span(number(sum(rates_hz) / len(rates_hz) if rates_hz else None, 3))


def _oldest(status: RobotStatus) -> Span:
    return Span(age(max(status.neighbour_ages_s.values(), default=None)))


def _lag(status: RobotStatus) -> Span:
    lag_ms = max((loop.lateness_p99_ms for loop in status.loops.values()), default=None)
    late = lag_ms is not None and lag_ms > LATE_MS
    # Beyond a second with the unit, as an age has one beyond minutes.
    if lag_ms is not None and lag_ms >= 999.5:
        return Span(number(lag_ms / 1000.0, 2, 0) + "s", "warning")
    return Span(number(lag_ms, 3), "warning" if late else "")


def _link(row: Row) -> Span:
    if row.robot.status is None:
        return Span("-", "faint")
    return Span(age(row.robot.age_s), "" if row.robot.fresh else "critical")


def fence_margin_m(status: RobotStatus, fence: Fence) -> float | None:
    """How far inside the fence's line, negative outside; of its own fence, if it tells it."""
    if status.position_m is None or not all(map(math.isfinite, status.position_m)):
        return None
    return (status.fence or fence).distance_m(*status.position_m[:2])


def fence_size(fence: Fence) -> str:
    """Its extent and its heights, m."""
    across, along = zip(*fence.vertices_m, strict=True)
    sides = f"{max(across) - min(across):.0f}x{max(along) - min(along):.0f}"
    return f"{sides} m, {fence.floor_m:g}-{fence.ceiling_m:g} m high"


def _margin(row: Row) -> Span:
    status = row.robot.status
    margin_m = None if status is None else fence_margin_m(status, row.setup.fence)
    return Span(number(margin_m, 5), "critical" if margin_m is not None and margin_m < 0 else "")


def _reason(row: Row) -> Span:
    """Why it has its mark, before why it is in its state."""
    status, alarm = row.robot.status, row.alarm
    if status is None:
        return Span("")
    if alarm is None:
        return Span(status.reason.text)
    # Its state says that it is not ready.
    short = alarm.code is AlarmCode.NOT_READY
    return Span(status.failed_checks[0].text if short else alarm.text, alarm.severity)


# Left to right. At 80 columns, one of them for the scroll bar, ranks up to 8 have room: who reads
# why a robot is as it is sees where it is on the map.
_COLUMNS = (
    Column(0, "", "", 1, _mark, left=True),
    Column(2, "state", "", 9, _state, left=True),
    Column(5, "bat", "%", 3, _battery),
    Column(8, "GPS", "sat", 3, _of_status(_satellites)),
    Column(6, "mode", "", 8, _of_status(lambda s: Span(s.mode or "-")), left=True),
    Column(9, "x", "m", 5, _of_status(_coordinate(0, 5))),
    Column(10, "y", "m", 5, _of_status(_coordinate(1, 5))),
    Column(7, "h", "m", 4, _of_status(_coordinate(2, 4))),
    Column(16, "v", "m/s", 3, _of_status(lambda s: Span(number(speed_m_s(s), 3)))),
    Column(11, "feat", "s", 4, _of_status(_features)),
    Column(12, "neigh", "n", 5, _of_status(_neighbours)),
    Column(14, "", "Hz", 3, _rate),
    Column(13, "", "s", 3, _of_status(_oldest)),
    Column(15, "lag", "ms", 3, _of_status(_lag)),
    Column(3, "link", "s", 4, _link),
    Column(17, "fence", "m", 5, _margin),
    Column(18, "bundle", "", ID, _of_status(lambda s: Span(s.bundle_id[:ID])), left=True),
    Column(19, "world", "", ID, _of_status(lambda s: Span(s.world_id[:ID])), left=True),
    Column(4, "reason", "", _NARROWEST_REASON, _reason, left=True),
)


def in_order(
    setup: FleetSetup,
    snapshot: FleetSnapshot,
    alarms: Sequence[Alarm],
    lasting: Mapping[str, Severity] | None = None,
) -> list[Row]:
    """The fleet's robots, those with critical alarms first, then those with warnings.

    `lasting` are robots that are kept up for a while, so that nothing jumps to and fro.
    """
    worst = gravest(alarms)
    places = {name: alarm.severity for name, alarm in worst.items()} | dict(lasting or {})

    def place(row: Row) -> int:
        severity = places.get(row.robot.name, "note")
        return SEVERITIES.index(severity)

    rows = [Row(robot, worst.get(robot.name), setup) for robot in snapshot.robots]
    return sorted(rows, key=place)


def gravest(alarms: Iterable[Alarm]) -> dict[str, Alarm]:
    """Each robot's gravest alarm; they come in order."""
    worst: dict[str, Alarm] = {}
    for alarm in alarms:
        worst.setdefault(alarm.robot, alarm)
    return worst
