"""All that `lpac watch` knows of one robot."""

import math
from collections.abc import Sequence
from itertools import zip_longest

from rich.cells import cell_len

from edge.core.counted import counted
from edge.messages.mission import ON_GROUND, RobotStatus
from lpac.analysis.snapshot import FleetSnapshot, RobotSnapshot
from lpac.ground.alarms import LATE_MS, Alarm
from lpac.ground.terminal.lines import (
    Line,
    Span,
    TextStyle,
    age,
    direction,
    duration,
    fit,
    line,
    number,
    wrapped,
)
from lpac.ground.terminal.table import (
    ID,
    Row,
    fence_margin_m,
    fence_size,
    speed_m_s,
    state_style,
    state_word,
)


def detail(row: Row, snapshot: FleetSnapshot, alarms: Sequence[Alarm], width: int) -> list[Line]:
    """All that is known of a robot."""
    robot, status = row.robot, row.robot.status
    lines = [_detail_title(robot, width)]
    for alarm in alarms:
        if alarm.robot == robot.name:
            lines += _fact("alarm", alarm.text, width, alarm.severity)
    if status is None:
        return [*lines, *_fact("", "it was never heard", width, "faint")]
    for each in status.not_taken:
        lines += _fact("not taken", each.text, width, "warning")
    if status.state in ON_GROUND:
        for check in status.failed_checks:
            lines += _fact("not ready", check.text, width)
    for name, text in _facts(row, status, snapshot).items():
        if text:
            lines += _fact(name, text, width)
    return [
        *lines,
        line(width),
        *_beside(_neighbour_table(row, status), _loop_table(status), width),
    ]


def in_short(row: Row, width: int) -> tuple[Line, Line]:
    """Of a robot what the table may have no room for: why it is in its state, fence, release."""
    status = row.robot.status
    name = Span(f" {row.robot.name}  ", "strong")
    if status is None:
        return line(width, name, Span("was never heard", "faint")), line(width)
    margin_m = fence_margin_m(status, row.setup.fence)
    fence = "-" if margin_m is None else f"{margin_m:.1f} m"
    return (
        line(width, name, Span(status.reason.text)),
        line(
            width,
            Span(" fence margin ", "faint"),
            Span(fence, "critical" if margin_m is not None and margin_m < 0.0 else ""),
            Span("   bundle ", "faint"),
            Span(status.bundle_id[:ID] or "-"),
            Span("   world ", "faint"),
            Span(status.world_id[:ID] or "-"),
            Span("   trial ", "faint"),
            Span(status.trial or "-"),
        ),
    )


def _detail_title(robot: RobotSnapshot, width: int) -> Line:
    status = robot.status
    name = Span(f"{robot.name} ", "strong")
    if status is None:
        return line(width, name, Span(f"(id {robot.robot_id})", "faint"))
    heard = f"heard {age(robot.age_s).strip()} s ago"
    left = (
        name,
        Span(f"(id {robot.robot_id})  ", "faint"),
        Span(state_word(status), state_style(status)),
        Span(f": {status.reason.text}"),
    )
    return (
        *line(width - len(heard) - 1, *left),
        Span(f" {heard}", "" if robot.fresh else "critical"),
    )


def _facts(row: Row, status: RobotStatus, snapshot: FleetSnapshot) -> dict[str, str]:
    return {
        "vehicle": _vehicle(status),
        "GPS": _gps(status),
        "position": _position(status),
        "landing": _landing(row, status),
        "policy": _policy(status),
        "obeys": _obeys(status, snapshot),
        "orders": "; ".join(
            "accepted" if order.refusal is None else f"refused: {order.refusal.text}"
            for order in reversed(status.orders)
        ),
        "release": _release(status),
        "origin": _origin(status),
        "program": _program(row, status),
    }


def _vehicle(status: RobotStatus) -> str:
    armed = {True: "armed", False: "disarmed", None: "armed or not: unknown"}
    air = {True: "in the air", False: "on the ground", None: ""}
    return _listed(
        status.mode or "mode unknown",
        armed[status.armed],
        air[status.in_air],
        "" if status.battery is None else f"battery {status.battery:.0%}",
        _lasts(status),
        "" if status.system_id is None else f"system id {status.system_id}",
    )


def _lasts(status: RobotStatus) -> str:
    if status.battery_lasts_s is None:
        return ""
    home = "" if status.home_s is None else f" of which home takes {status.home_s:.0f}"
    return f"for {status.battery_lasts_s:.0f} s{home}"


def _gps(status: RobotStatus) -> str:
    return _listed(
        "" if status.satellites is None else counted(status.satellites, "satellite"),
        "" if status.hdop is None else f"HDOP {status.hdop:.1f}",
        "" if status.gps_accuracy_m is None else f"accurate to {status.gps_accuracy_m:.1f} m",
        "" if status.global_deg is None else "at {:.6f} {:.6f}".format(*status.global_deg),
    )


def _position(status: RobotStatus) -> str:
    where = f"height {status.slot_height_m:g} m when it flies"
    if status.position_m is not None:
        x_m, y_m, height_m = status.position_m
        where = f"x {x_m:.1f}, y {y_m:.1f}, height {height_m:.1f} of {status.slot_height_m:g} m"
    heading_rad = status.heading_rad
    return _listed(
        where,
        "" if status.position_quality is None else f"position {status.position_quality}",
        "" if status.velocity_m_s is None else f"{speed_m_s(status):.1f} m/s",
        "" if heading_rad is None else f"heading {direction(math.degrees(heading_rad))}",
    )


def _listed(*parts: str) -> str:
    return ", ".join(part for part in parts if part)


def _policy(status: RobotStatus) -> str:
    velocity_m_s, age_s = status.policy_velocity_m_s, status.feature_age_s
    return _listed(
        "no answer" if velocity_m_s is None else "asks for {:.2f} {:.2f} m/s".format(*velocity_m_s),
        "no features" if age_s is None else f"features {age_s:.1f} s old",
        f"trial {status.trial}" if status.trial else "",
    )


def _landing(row: Row, status: RobotStatus) -> str:
    x_m, y_m = status.landing_point_m
    text = f"at x {x_m:.1f} m, y {y_m:.1f} m"
    if status.position_m is not None:
        away_m = math.dist(status.position_m[:2], status.landing_point_m)
        text += f", {away_m:.1f} m away"
    margin_m = fence_margin_m(status, row.setup.fence)
    return text if margin_m is None else f"{text}; fence margin {margin_m:.1f} m"


def _obeys(status: RobotStatus, snapshot: FleetSnapshot) -> str:
    if not status.operator:
        return "nobody yet"
    ground = snapshot.ground
    said = "" if ground is None else f" of {ground.sequence}"
    safety_action = "" if ground is None else ground.safety_action_for(status.robot_id)
    asked = f", asked to {safety_action}" if safety_action not in ("", "none") else ""
    return f"{status.operator}, state {status.obeyed_sequence}{said}{asked}"


def _release(status: RobotStatus) -> str:
    return _listed(
        f"bundle {status.bundle_id[:ID]}",
        f"world {status.world_id[:ID]}",
        "" if status.fence is None else f"fence {fence_size(status.fence)}",
    )


def _origin(status: RobotStatus) -> str:
    origin = status.origin
    if origin is None:
        return ""
    where = f"{origin.latitude_deg:.7f} {origin.longitude_deg:.7f}"
    return f"{where} {direction(origin.heading_deg, 1)}"


def _program(row: Row, status: RobotStatus) -> str:
    offset_s = row.robot.clock_offset_s
    clock = "" if offset_s is None else f", clock {offset_s:+.2f} s"
    return f"up {duration(status.uptime_s)}, start {status.boot_nonce:x}{clock}"


def _fact(name: str, text: str, width: int, style: TextStyle = "") -> list[Line]:
    return wrapped(width, (Span(f"{name:<10} ", "faint"),), Span(text, style))


def _neighbour_table(row: Row, status: RobotStatus) -> list[Line]:
    """Senders that it hears, at which rate, and how old their last messages are."""
    names = {str(robot_id): name for name, robot_id in row.setup.robots.items()}
    known = {*status.neighbour_messages, *status.neighbour_ages_s}
    lines: list[Line] = [(Span("neighbour messages   Hz   s", "faint"),)]
    for robot in sorted(known, key=lambda robot: (len(robot), robot)):
        name = fit(names.get(robot, f"robot {robot}"), 9)
        count = number(status.neighbour_messages.get(robot), 8, 0)
        rate, old = (
            number(row.robot.rates_hz.get(robot), 4),
            age(status.neighbour_ages_s.get(robot)),
        )
        heard = robot in status.neighbour_ages_s
        lines.append((Span(f"{name} {count} {rate} {old}", "" if heard else "faint"),))
    rejected = {k: n for k, n in status.message_counts.items() if k != "accepted" and n}
    lines += [(Span(f"{fit(why, 9)} {number(n, 8, 0)}", "faint"),) for why, n in rejected.items()]
    return lines


def _loop_table(status: RobotStatus) -> list[Line]:
    """How often each loop ran and missed ticks, and its lateness over the last minute."""
    lines: list[Line] = [(Span("loop         ticks missed failed  p50  p99  max", "faint"),)]
    for name, loop in status.loops.items():
        counts = (
            number(loop.ticks, 7, 0),
            number(loop.overruns, 6, 0),
            number(loop.failures, 6, 0),
        )
        late = (loop.lateness_p50_ms, loop.lateness_p99_ms, loop.lateness_max_ms)
        text = " ".join((fit(name, 10), *counts, *(number(ms, 4) for ms in late)))
        lines.append((Span(text, "warning" if loop.lateness_p99_ms > LATE_MS else ""),))
    return lines


def _beside(left: Sequence[Line], right: Sequence[Line], width: int) -> list[Line]:
    """Two blocks side by side, or where that is too wide, one below the other."""
    widest = max(sum(cell_len(span.text) for span in row) for row in left)
    needed = widest + 3 + max(sum(cell_len(span.text) for span in row) for row in right)
    if needed > width:
        return [line(width, *row) for row in (*right, (), *left)]
    lines = []
    for a, b in zip_longest(left, right, fillvalue=()):
        lines.append(line(width, *line(widest + 3, *a), *b))
    return lines
