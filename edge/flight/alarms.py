"""Alarms of a robot in flight for its operator, most severe first.

Each condition gives the text of its alarm, or None. The table of transitions and the orders use
some of them, too.
"""

import math
from collections.abc import Callable, Mapping

from edge.core.position import PositionQuality
from edge.core.vehicle import Action
from edge.flight.state import Tick
from edge.messages.codes import Reason, ReasonCode
from edge.messages.mission import AIRBORNE, FlightState

# PX4 reports five times a second; a few missing messages are no loss.
_REMOTE_CONTROL_LOST_S = 1.0


def reason_if(condition: bool, reason: str) -> str | None:
    """The reason, if the condition holds."""
    return reason if condition else None


def failsafe(t: Tick) -> str | None:
    return f"the autopilot's own failsafe acts: {t.mode}" if t.failsafe_acts else None


def hovers_alone(t: Tick) -> str | None:
    if t.flight.alone_since_s is None:
        return None
    limit_s = t.robot.parameters.hover_land_s
    return f"hovers unattended: lands {limit_s:g} s after it began, unless ordered or held"


def remote_control_lost(t: Tick) -> str | None:
    if t.robot.on_remote_control_lost is None or t.inputs.vehicle.remote_control or t.silent:
        return None
    # A program started in flight has not received it yet.
    received_at_s = t.flight.remote_control_at_s
    lost_s = t.inputs.now_s - (received_at_s if received_at_s > -math.inf else t.flight.since_s)
    return reason_if(lost_s > _REMOTE_CONTROL_LOST_S, "remote control lost")


def position_lost(t: Tick) -> str | None:
    position = t.inputs.position
    return f"position lost: {position.text}" if position.quality is PositionQuality.LOST else None


def position_doubtful(t: Tick) -> str | None:
    position, doubtful = t.inputs.position, PositionQuality.DOUBTFUL
    return f"position doubtful: {position.text}" if position.quality is doubtful else None


def off_height(t: Tick) -> str | None:
    return reason_if(t.off_height_s >= 0.0, "it does not hold its height")


def disarm_refused(t: Tick) -> str | None:
    result = t.inputs.vehicle.result
    if t.flight.landed_since_s is None or result is None or result.at_s < t.flight.since_s:
        return None
    refused = result.action is Action.DISARM and not result.accepted
    text = f"on the ground, and PX4 does not disarm ({result.text}): keep away; kill stops it"
    return reason_if(refused, text)


def too_close(t: Tick) -> str | None:
    closest, limit_m = t.inputs.closest, t.robot.parameters.min_separation_m
    if closest is None or closest.distance_m >= limit_m:
        return None
    return f"only {closest.distance_m:.1f} m to robot {closest.robot_id}"


def outside(t: Tick) -> str | None:
    odometry = t.inputs.odometry
    outside = odometry and t.robot.fence.distance_m(*odometry.position_m[:2]) < 0.0
    return reason_if(bool(outside), "outside the fence")


def lands_beside(t: Tick) -> str | None:
    beside_m, flight = t.inputs.lands_beside_m, t.flight
    where_it_is = flight.state is FlightState.LAND and (
        flight.reason.code is not ReasonCode.AT_LANDING_POINT
    )
    if beside_m is None or where_it_is or flight.state is FlightState.PILOT:
        return None
    away_m = math.dist(beside_m, t.robot.parameters.landing_point_m)
    return (
        f"another robot stands or fell silent at its landing point: lands {away_m:.0f} m beside it"
    )


def battery_low(t: Tick) -> str | None:
    energy = t.inputs.energy
    below = battery_below(t, t.robot.parameters.battery_low, "low")
    return below or (None if energy is None else energy.shortage())


def battery_below(t: Tick, share: float, word: str) -> str | None:
    battery = t.inputs.vehicle.battery
    return None if battery is None or battery > share else f"battery {word}: {battery:.0%}"


def battery_not_known(t: Tick) -> str | None:
    unknown = t.inputs.vehicle.battery is None and not t.silent
    return reason_if(unknown, "battery is not known")


def px4_changed(t: Tick) -> str | None:
    return None if t.inputs.px4_change is None else t.inputs.px4_change.text


def link_loses(t: Tick) -> str | None:
    share = t.inputs.vehicle.link_lost
    return f"{share:.0%} of the autopilot's messages are lost on the way" if share > 0.0 else None


def link_twice(t: Tick) -> str | None:
    text = "MAVLink arrives twice: a second path leads from the autopilot to this program"
    return reason_if(t.inputs.vehicle.link_twice, text)


def ground_lost(t: Tick) -> str | None:
    return reason_if(not t.ground_heard, "ground lost")


def policy_stale(t: Tick) -> str | None:
    if t.inputs.policy_velocity_m_s is not None:
        return None
    why = t.inputs.policy_problem
    return "the policy has no fresh answer" + (f": {why}" if why else "")


ALARMS: Mapping[ReasonCode, Callable[[Tick], str | None]] = {
    ReasonCode.FAILSAFE: failsafe,
    ReasonCode.HOVERS_ALONE: hovers_alone,
    ReasonCode.REMOTE_CONTROL_LOST: remote_control_lost,
    ReasonCode.POSITION_LOST: position_lost,
    ReasonCode.POSITION_DOUBTFUL: position_doubtful,
    ReasonCode.OFF_HEIGHT: off_height,
    ReasonCode.DISARM_REFUSED: disarm_refused,
    ReasonCode.TOO_CLOSE: too_close,
    ReasonCode.OUTSIDE_FENCE: outside,
    ReasonCode.PX4_CHANGED: px4_changed,
    ReasonCode.LANDS_BESIDE: lands_beside,
    ReasonCode.BATTERY_LOW: battery_low,
    ReasonCode.BATTERY_NOT_KNOWN: battery_not_known,
    ReasonCode.GROUND_LOST: ground_lost,
}


# Also before takeoff.
_LINK_ALARMS: Mapping[ReasonCode, Callable[[Tick], str | None]] = {
    ReasonCode.LINK_LOSES: link_loses,
    ReasonCode.LINK_TWICE: link_twice,
}
_IN_FLIGHT = {**ALARMS, **_LINK_ALARMS}


def alarms(t: Tick) -> tuple[Reason, ...]:
    """Present alarms, most severe first, without repetition."""
    found = [t.flight.reason] if t.flight.alarming else []
    in_flight = t.flight.state in (*AIRBORNE, FlightState.PILOT)
    conditions = _IN_FLIGHT if in_flight else _LINK_ALARMS
    found += [
        Reason(code, text) for code, condition in conditions.items() if (text := condition(t))
    ]
    if in_flight:
        warnings = t.inputs.vehicle.warnings
        found += [Reason(ReasonCode.PX4, f"PX4: {warning.text}") for warning in warnings]
    return tuple(dict.fromkeys(found))
