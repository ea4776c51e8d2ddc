"""Texts, numbers and severities of a robot, from its status and alarms, for all views.

Pure. The terminal, the map's page, Foxglove and the simulator's table draw what is made here, so
that all use the same words. A text is at most as wide as its column.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

from edge.core.counted import counted
from edge.core.fence import Fence
from edge.messages.codes import texts
from edge.messages.mission import ON_GROUND, FlightState, RobotStatus
from lpac.analysis.snapshot import FleetSetup, FleetSnapshot, RobotSnapshot
from lpac.ground.alarms import (
    BATTERY_LOW,
    FEATURE_AGE_S,
    ID,
    LATE_MS,
    LIMITS,
    SEVERITIES,
    Alarm,
    AlarmCode,
    Severity,
)

TextStyle = Literal[
    "", "strong", "faint", "good", "calm", "busy", "foreign", "critical", "warning", "note", "bar",
    "banner",
]  # fmt: skip
NOT_HEARD = "not heard"

_S = FlightState


class Span(NamedTuple):
    """A piece of text."""

    text: str
    style: TextStyle = ""


class Row(NamedTuple):
    """A robot and its gravest alarm. Without a setup, limits and fence are unknown."""

    robot: RobotSnapshot
    alarm: Alarm | None = None
    setup: FleetSetup | None = None

    @property
    def status(self) -> RobotStatus:
        """Its newest status; only for a robot that was heard at some time."""
        assert self.robot.status is not None
        return self.robot.status


def in_order(
    setup: FleetSetup,
    snapshot: FleetSnapshot,
    alarms: Sequence[Alarm],
    lasting: Mapping[str, Severity] | None = None,
) -> list[Row]:
    """The fleet's robots: those with critical alarms first, then those with warnings.

    `lasting` are severities that still count although the alarm is over, so that rows do not jump.
    """
    severities = {r: alarm.severity for r, alarm in gravest(alarms).items()} | dict(lasting or {})
    return sorted(
        rows(setup, snapshot, alarms),
        key=lambda row: SEVERITIES.index(severities.get(row.robot.name, "note")),
    )


def rows(setup: FleetSetup, snapshot: FleetSnapshot, alarms: Iterable[Alarm]) -> list[Row]:
    """The fleet's robots, in its order."""
    worst = gravest(alarms)
    return [Row(robot, worst.get(robot.name), setup) for robot in snapshot.robots]


def gravest(alarms: Iterable[Alarm]) -> dict[str, Alarm]:
    """Each robot's gravest alarm, from alarms in order of severity."""
    worst: dict[str, Alarm] = {}
    for alarm in alarms:
        worst.setdefault(alarm.robot, alarm)
    return worst


def number(value: float | None, width: int, decimals: int = 1) -> str:
    """Format with as many decimals as fit; "-" if unknown, ">99" if it does not fit at all."""
    if value is None or not math.isfinite(value):
        return "-".rjust(width)
    for places in range(decimals, -1, -1):
        # Adding 0 turns -0.0 into 0.0.
        text = f"{round(value, places) + 0.0:.{places}f}"
        if len(text) <= width:
            return text.rjust(width)
    return ">" + "9" * (width - 1) if value > 0.0 else "<-" + "9" * (width - 2)


def direction(heading_deg: float, decimals: int = 0) -> str:
    """Format a heading in [0°, 360°), also after rounding."""
    return f"{round(heading_deg, decimals) % 360.0:.{decimals}f}°"


def age(value_s: float | None) -> str:
    """Format in three characters: seconds, or minutes or hours with a unit."""
    if value_s is None or not math.isfinite(value_s):
        return "  -"
    if value_s < 9.95:
        return f"{max(value_s, 0.0):.1f}"
    if value_s < 999.5:
        return f"{value_s:3.0f}"
    minutes = value_s / 60.0
    return f"{minutes:2.0f}m" if minutes < 99.5 else f"{min(minutes / 60.0, 99.0):2.0f}h"


def duration(value_s: float) -> str:
    """Such as 02:05, or 1:02:05."""
    minutes, seconds = divmod(int(max(value_s, 0.0)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes:02}:{seconds:02}"


def _fence_margin_m(row: Row) -> float | None:
    """Distance inside the fence's line, m, negative outside; by the robot's own fence if known."""
    position_m, fence = row.status.position_m, row.status.fence or (row.setup and row.setup.fence)
    if not fence or position_m is None or not all(map(math.isfinite, position_m)):
        return None
    return fence.distance_m(*position_m[:2])


def fence_size(fence: Fence) -> str:
    """Describe the fence's extent and heights, m."""
    across, along = zip(*fence.vertices_m, strict=True)
    sides = f"{max(across) - min(across):.0f}x{max(along) - min(along):.0f}"
    return f"{sides} m, {fence.floor_m:g}-{fence.ceiling_m:g} m high"


def nose_rad(status: RobotStatus, heading_deg: float | None = None) -> float | None:
    """Direction of its nose, clockwise from the mission frame's y axis; None if unknown.

    `heading_deg` is that axis's compass heading, for a robot that has no origin yet.
    """
    own_deg = heading_deg if status.origin is None else status.origin.heading_deg
    if status.heading_rad is None or own_deg is None:
        return None
    return status.heading_rad - math.radians(own_deg)


class StateStyle(NamedTuple):
    """Letter and style of a state."""

    letter: str
    style: TextStyle


_STATE_STYLES = {
    _S.INIT: StateStyle("I", "faint"), _S.IDLE: StateStyle("-", "faint"),
    _S.PREFLIGHT: StateStyle("C", ""), _S.ARMING: StateStyle("A", "busy"),
    _S.TAKEOFF: StateStyle("T", "busy"), _S.HOLD: StateStyle("H", "calm"),
    _S.MISSION: StateStyle("M", "good"), _S.RETURN: StateStyle("R", "busy"),
    _S.LAND: StateStyle("L", "busy"), _S.LANDED: StateStyle("D", "faint"),
    _S.PILOT: StateStyle("P", "foreign"), _S.FAULT: StateStyle("F", "critical"),
}  # fmt: skip
_READY = StateStyle("✓", "good")


def is_ready(status: RobotStatus) -> bool:
    """Whether it would take off now."""
    return status.state is _S.PREFLIGHT and status.ready


def state_word(status: RobotStatus) -> str:
    """The robot's state; "ready" is preflight with all checks passed."""
    return "ready" if is_ready(status) else status.state.value


def state_style(status: RobotStatus) -> StateStyle:
    """Letter and style of its state."""
    return _READY if is_ready(status) else _STATE_STYLES[status.state]


def state_and_reason(status: RobotStatus) -> str:
    """Such as "hold: ground commands hold"."""
    return f"{status.state}: {status.reason.text}"


def missing_checks(status: RobotStatus) -> str:
    """Failed checks of a robot in preflight, with their remedies."""
    return texts(status.failed_checks) or "the checks are still running"


def problem(row: Row) -> Span:
    """Text of its gravest alarm; without one, failed checks, or the reason of its state."""
    status, alarm = row.robot.status, row.alarm
    if status is None:
        return Span("")
    if alarm is None:
        failed = status.failed_checks if status.state in ON_GROUND and not status.ready else ()
        return Span(texts(status.alarms or failed) or status.reason.text)
    # The state column already says that it is not ready.
    short = alarm.code is AlarmCode.NOT_READY
    return Span(status.failed_checks[0].text if short else alarm.text, alarm.severity)


def not_ready(row: Row) -> str:
    """Why it would not take off now; "" if it would."""
    status = row.robot.status
    if status is None or not row.robot.fresh:
        return NOT_HEARD
    if is_ready(status):
        return ""
    return missing_checks(status) if status.state is _S.PREFLIGHT else status.state.value


MARKS: dict[Severity, str] = {"critical": "!", "warning": "*", "note": "-"}


def _mark(row: Row) -> Span:
    return Span("") if row.alarm is None else Span(MARKS[row.alarm.severity], row.alarm.severity)


def _name(row: Row) -> Span:
    grave = row.alarm is not None and row.alarm.severity != "note"
    return Span(row.robot.name, row.alarm.severity if row.alarm and grave else "strong")


def _link(row: Row) -> Span:
    if row.robot.status is None:
        return Span("-", "faint")
    return Span(age(row.robot.age_s), "" if row.robot.fresh else "critical")


def _state(row: Row) -> Span:
    return Span(state_word(row.status), state_style(row.status).style)


def _battery(row: Row) -> Span:
    battery = row.status.battery
    if battery is None:
        return Span("-")
    style: TextStyle = "warning" if battery <= BATTERY_LOW else ""
    if row.setup is not None and battery <= row.setup.battery_critical:
        style = "critical"
    return Span(number(100.0 * battery, 3, 0), style)


def _satellites(row: Row) -> Span:
    satellites = row.status.satellites
    few = satellites is not None and satellites < LIMITS.min_satellites
    return Span(number(satellites, 3, 0), "warning" if few else "")


def _coordinate(axis: int, width: int) -> Callable[[Row], Span]:
    return lambda row: Span(number(row.status.position_m and row.status.position_m[axis], width))


def speed_m_s(status: RobotStatus) -> float | None:
    """How fast it is; None if that is not known."""
    return None if status.velocity_m_s is None else math.hypot(*status.velocity_m_s)


def _features(row: Row) -> Span:
    age_s = row.status.feature_age_s
    old = age_s is not None and age_s > FEATURE_AGE_S and row.status.state in (_S.HOLD, _S.MISSION)
    return Span(age(age_s), "warning" if old else "")


def _rate(row: Row) -> Span:
    heard = row.status.neighbour_ages_s
    rates_hz = [rate for robot, rate in row.robot.rates_hz.items() if robot in heard]
    return Span(number(sum(rates_hz) / len(rates_hz) if rates_hz else None, 3))


def _oldest(row: Row) -> Span:
    return Span(age(max(row.status.neighbour_ages_s.values(), default=None)))


def _lag(row: Row) -> Span:
    lag_ms = max((loop.lateness_p99_ms for loop in row.status.loops.values()), default=None)
    late = lag_ms is not None and lag_ms > LATE_MS
    # From a second on, in seconds with the unit.
    if lag_ms is not None and lag_ms >= 999.5:
        return Span(number(lag_ms / 1000.0, 2, 0) + "s", "warning")
    return Span(number(lag_ms, 3), "warning" if late else "")


def _margin(row: Row) -> Span:
    margin_m = _fence_margin_m(row)
    return Span(number(margin_m, 5), "critical" if margin_m is not None and margin_m < 0 else "")


class Column(NamedTuple):
    """Column headed by `top` and `unit`. Where not all fit, those of low rank are shown."""

    key: str
    rank: int
    top: str
    unit: str
    width: int
    of: Callable[[Row], Span]
    left: bool = False


# Left to right. On 80 characters, one of them the scroll bar, ranks up to 8 fit; positions are on
# the map.
COLUMNS = (
    Column("mark", 0, "", "", 1, _mark, left=True),
    Column("name", 1, "name", "", 4, _name, left=True),
    Column("state", 2, "state", "", 9, _state, left=True),
    Column("battery", 5, "bat", "%", 3, _battery),
    Column("satellites", 8, "GPS", "sat", 3, _satellites),
    Column("mode", 6, "mode", "", 8, lambda row: Span(row.status.mode or "-"), left=True),
    Column("x", 9, "x", "m", 5, _coordinate(0, 5)),
    Column("y", 10, "y", "m", 5, _coordinate(1, 5)),
    Column("height", 7, "h", "m", 4, _coordinate(2, 4)),
    Column("speed", 16, "v", "m/s", 3, lambda row: Span(number(speed_m_s(row.status), 3))),
    Column("features", 11, "feat", "s", 4, _features),
    Column("neighbours", 12, "neigh", "n", 5, lambda r: Span(str(len(r.status.neighbour_ages_s)))),
    Column("rate", 14, "", "Hz", 3, _rate),
    Column("oldest", 13, "", "s", 3, _oldest),
    Column("lag", 15, "lag", "ms", 3, _lag),
    Column("link", 3, "link", "s", 4, _link),
    Column("margin", 17, "fence", "m", 5, _margin),
    Column("bundle", 18, "bundle", "", ID, lambda row: Span(row.status.bundle_id[:ID]), left=True),
    Column("world", 19, "world", "", ID, lambda row: Span(row.status.world_id[:ID]), left=True),
    Column("problem", 4, "reason", "", 30, problem, left=True),
)
COLUMN = {column.key: column for column in COLUMNS}
# Columns of a robot that was never heard, too.
_ALWAYS = ("mark", "name", "link", "problem")


def cell(row: Row, column: str) -> Span:
    """Cell of a row. Values of an old status are faint."""
    text, style = _cell(row, column)
    old = column not in _ALWAYS and not row.robot.fresh
    return Span(text, "faint" if old else style)


def quantity(row: Row, column: str) -> Span:
    """Cell with its unit, for use without a heading, not faint. Counts have no unit."""
    text, style = _cell(row, column)
    text, unit = text.strip(), COLUMN[column].unit
    counts = unit in ("", "n", "sat")
    return Span(text if counts or not text[-1:].isdigit() else f"{text} {unit}", style)


def _cell(row: Row, column: str) -> Span:
    if row.robot.status is None and column not in _ALWAYS:
        return Span(NOT_HEARD if column == "state" else "-", "faint")
    return COLUMN[column].of(row)


class Fact(NamedTuple):
    """Something known of a robot. Several facts may share a name."""

    name: str
    text: str
    style: TextStyle = ""


def facts(row: Row, snapshot: FleetSnapshot, alarms: Iterable[Alarm]) -> list[Fact]:
    """All that is known of a robot except the `tables`; problems first."""
    robot, status = row.robot, row.robot.status
    known = [Fact("alarm", a.text, a.severity) for a in alarms if a.robot == robot.name]
    if status is None:
        return [*known, Fact("", "never heard", "faint")]
    known += [Fact("not taken", each.text, "warning") for each in status.not_taken]
    if status.state in ON_GROUND:
        known += [Fact("not ready", check.text) for check in status.failed_checks]
    more = _flight(status) | _program(row, status, snapshot)
    return known + [Fact(name, text) for name, text in more.items() if text]


def _flight(status: RobotStatus) -> dict[str, str]:
    armed = {True: "armed", False: "disarmed", None: "armed or not: unknown"}
    air = {True: "in the air", False: "on the ground", None: ""}
    where = f"height {status.slot_height_m:g} m when it flies"
    if status.position_m is not None:
        x_m, y_m, height_m = status.position_m
        where = f"x {x_m:.1f}, y {y_m:.1f}, height {height_m:.1f} of {status.slot_height_m:g} m"
    lasts = _format("for {:.0f} s", status.battery_lasts_s)
    heading_rad = status.heading_rad
    return {
        "vehicle": _joined(
            status.mode or "mode unknown",
            armed[status.armed],
            air[status.in_air],
            _format("battery {:.0%}", status.battery),
            lasts and lasts + _format(" of which home takes {:.0f}", status.home_s),
            _format("system id {}", status.system_id),
        ),
        "GPS": _joined(
            "" if status.satellites is None else counted(status.satellites, "satellite"),
            _format("HDOP {:.1f}", status.hdop),
            _format("accurate to {:.1f} m", status.gps_accuracy_m),
            _format("at {0[0]:.6f} {0[1]:.6f}", status.global_deg),
        ),
        "position": _joined(
            where,
            _format("position {}", status.position_quality),
            _format("{:.1f} m/s", speed_m_s(status)),
            "" if heading_rad is None else f"heading {direction(math.degrees(heading_rad))}",
        ),
    }


def _program(row: Row, status: RobotStatus, snapshot: FleetSnapshot) -> dict[str, str]:
    x_m, y_m = landing_m = status.landing_point_m
    position_m, origin = status.position_m, status.origin
    away_m = None if position_m is None else math.dist(position_m[:2], landing_m)
    safety_action = snapshot.state.safety_action_for(status.robot_id)
    return {
        "landing": f"at x {x_m:.1f} m, y {y_m:.1f} m"
        + _format(", {:.1f} m away", away_m)
        + _format("; fence margin {:.1f} m", _fence_margin_m(row)),
        "policy": _joined(
            _format("asks for {0[0]:.2f} {0[1]:.2f} m/s", status.policy_velocity_m_s)
            or "no answer",
            _format("features {:.1f} s old", status.feature_age_s) or "no features",
            status.trial and f"trial {status.trial}",
        ),
        "obeys": f"{status.operator}, state {status.obeyed_sequence}"
        + _format(" of {.sequence}", snapshot.ground)
        + ("" if safety_action == "none" else f", asked to {safety_action}")
        if status.operator
        else "nobody yet",
        "orders": "; ".join(
            "accepted" if order.refusal is None else f"refused: {order.refusal.text}"
            for order in reversed(status.orders)
        ),
        "release": _joined(
            f"bundle {status.bundle_id[:ID]}",
            f"world {status.world_id[:ID]}",
            _format("fence {}", status.fence and fence_size(status.fence)),
        ),
        "origin": ""
        if origin is None
        else f"{origin.latitude_deg:.7f} {origin.longitude_deg:.7f} "
        f"{direction(origin.heading_deg, 1)}",
        "program": f"up {duration(status.uptime_s)}, start {status.boot_nonce:x}"
        + _format(", clock {:+.2f} s", row.robot.clock_offset_s),
    }


def _format(text: str, value: object) -> str:
    """Format the value; "" if it is None."""
    return "" if value is None else text.format(value)


def _joined(*parts: str | None) -> str:
    return ", ".join(part for part in parts if part)


class StatusTable(NamedTuple):
    """Table of a robot's status: headings, column widths, and rows of one style each."""

    headings: tuple[str, ...]
    widths: tuple[int, ...]
    rows: list[tuple[tuple[str, ...], TextStyle]]


def tables(row: Row) -> tuple[StatusTable, ...]:
    """Tables of neighbours (count, rate, Hz, and age, s, of messages) and loops (lateness, ms).

    Below the neighbours are the counts of rejected messages. Lateness is of the last minute.
    """
    status = row.robot.status
    if status is None:
        return ()
    names = {} if row.setup is None else {str(i): name for name, i in row.setup.robots.items()}
    known = {*status.neighbour_messages, *status.neighbour_ages_s}
    neighbours: list[tuple[tuple[str, ...], TextStyle]] = []
    for robot in sorted(known, key=lambda robot: (len(robot), robot)):
        count = number(status.neighbour_messages.get(robot), 8, 0)
        rate = number(row.robot.rates_hz.get(robot), 4)
        cells = names.get(robot, f"robot {robot}"), count, rate
        age_s = status.neighbour_ages_s.get(robot)
        neighbours.append(((*cells, age(age_s)), "" if age_s is not None else "faint"))
    for why, messages in status.message_counts.items():
        if why != "accepted" and messages:
            neighbours.append(((why, number(messages, 8, 0)), "faint"))
    loops: list[tuple[tuple[str, ...], TextStyle]] = []
    for name, loop in status.loops.items():
        late_ms = loop.lateness_p50_ms, loop.lateness_p99_ms, loop.lateness_max_ms
        counts = number(loop.ticks, 7, 0), number(loop.overruns, 6, 0), number(loop.failures, 6, 0)
        late: TextStyle = "warning" if loop.lateness_p99_ms > LATE_MS else ""
        loops.append(((name, *counts, *(number(ms, 4) for ms in late_ms)), late))
    return (
        StatusTable(("neighbour", "messages", "Hz", "s"), (9, 8, 4, 3), neighbours),
        StatusTable(
            ("loop", "ticks", "missed", "failed", "p50", "p99", "max"),
            (10, 7, 6, 6, 4, 4, 4), loops,
        ),
    )  # fmt: skip
