"""The flight state machine as a table: transitions, their conditions and effects.

`TRANSITIONS` is sorted by severity: in each tick the first row that applies is taken. A row has all
of its effects, so no other code depends on which row it was. docs/faults.md shows the same table.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Literal

from edge.core.vehicle import PILOTED, Action, Mode
from edge.flight.alarms import (
    battery_below,
    battery_low,
    failsafe,
    ground_lost,
    off_height,
    policy_stale,
    position_doubtful,
    position_lost,
    px4_changed,
    reason_if,
    remote_control_lost,
    too_close,
)
from edge.flight.state import OFFBOARD_TIMEOUT_S, STALE_TELEMETRY_S, LandBy, Tick
from edge.messages.codes import ReasonCode
from edge.messages.mission import AIRBORNE, STEERED, FlightState, OrderKind

_S, _R = FlightState, ReasonCode

_ARMING_TIMEOUT_S = 6.0
_AT_HEIGHT_M = 0.5
_AT_LANDING_POINT_M = 0.5
_AT_REST_M_S = 0.4
# Time to get clear of near robots before descending through their heights.
_LEAVES_S = 3.0


@dataclass(frozen=True, slots=True)
class Transition:
    """One row: from any of `sources` to `target` when `why` returns a reason.

    `code` is the reason for machines, `when` describes the row for people.

    A row with `order` applies only in a tick that obeys such an order. `actions` are requested once
    from the autopilot. `alarm`: the operator must see the reason while the target lasts. `land_by`
    is the origin of a landing. `unattended`: whether the vehicle then hovers without anybody's
    command. `drops_observations`: earlier observations of the steered vehicle no longer count.
    `keeps_target`: keep the target of the state before. `rejoins`: end the pilot's mode. `kills`:
    the motors stop for good.
    """

    sources: tuple[FlightState, ...]
    target: FlightState
    code: ReasonCode
    when: str
    why: Callable[[Tick], str | None]
    _: KW_ONLY
    order: OrderKind | None = None
    actions: tuple[Action, ...] = ()
    alarm: bool = False
    land_by: LandBy = "safety"
    unattended: Literal["no", "if in hold", "yes"] = "no"
    drops_observations: bool = False
    keeps_target: bool = False
    rejoins: bool = False
    kills: bool = False


def _always(reason: str) -> Callable[[Tick], str | None]:
    return lambda _: reason


def _disarmed(t: Tick) -> str | None:
    return reason_if(t.inputs.vehicle.armed is False, "disarmed")


def _fell(t: Tick) -> str | None:
    vehicle, flight = t.inputs.vehicle, t.flight
    known = flight.killed or flight.reason.code is _R.DISARMED_IN_AIR
    return reason_if(vehicle.fell and not known, "disarmed in the air: it fell")


def _link_lost(t: Tick) -> str | None:
    lost = not t.inputs.vehicle.connected and not t.silent
    return reason_if(lost, "the autopilot does not answer")


def _disarmed_again(t: Tick) -> str | None:
    vehicle, flight = t.inputs.vehicle, t.flight
    # Only a position shows whether the autopilot was rebooted.
    received = min(vehicle.heartbeat_at_s, vehicle.position_at_s) > flight.since_s
    return _disarmed(t) if received and not vehicle.fell and not flight.killed else None


def _armed_before(t: Tick) -> str | None:
    cause = _armed_by_us(t) or "the vehicle was already armed when this program found it"
    text = f"{cause}: only observing; rejoin it, or a pilot lands it"
    return reason_if(t.inputs.vehicle.armed is True, text)


def _armed_by_others(t: Tick) -> str | None:
    if not t.inputs.vehicle.armed or t.flight.armed_asked:
        return None
    ours = t.flight.state is not _S.ARMING and _armed_by_us(t)
    if ours:
        return f"{ours}: only observing; rejoin it, or a pilot lands it"
    return "the vehicle is armed, without an order: only observing"


def _armed_by_us(t: Tick) -> str:
    operator = t.flight.armed_by
    return operator and f"armed by this program, on {operator}'s takeoff order"


def _armed_again(t: Tick) -> str | None:
    answers = t.inputs.vehicle.connected and t.heartbeat_since_entry and not t.flight.killed
    return _armed_by_others(t) if answers else None


def _pilot(t: Tick) -> str | None:
    # Right after a rejoin, the operator wants to end the pilot's mode.
    ending = not t.flight.reached and (
        t.inputs.now_s - t.flight.rejoined_at_s <= OFFBOARD_TIMEOUT_S
    )
    return reason_if(t.mode in PILOTED and not ending, f"a pilot flies it ({t.mode})")


def _left_offboard(t: Tick) -> str | None:
    left = t.flight.reached and t.mode not in (Mode.OFFBOARD, Mode.LAND)
    return reason_if(left and not t.failsafe_acts, f"the vehicle left offboard for {t.mode}")


def _left_land(t: Tick) -> str | None:
    return reason_if(
        t.flight.reached and t.mode is not Mode.LAND, f"the vehicle left land for {t.mode}"
    )


def _failsafe_takes(t: Tick) -> str | None:
    known = t.flight.reached or t.heartbeat_since_entry
    return failsafe(t) if known and t.mode is not Mode.LAND else None


def _lapse(t: Tick) -> str | None:
    return reason_if(t.lapse_s > 0.0, f"control was silent for {t.lapse_s:.1f} s")


def _autopilot_lands(t: Tick) -> str | None:
    # Otherwise it lands because of an earlier command.
    lapsed = t.flight.silent_until_s > -math.inf and not t.silent
    by_itself = t.flight.reached or t.overdue or lapsed or t.failsafe_acts
    return reason_if(t.mode is Mode.LAND and by_itself, "the autopilot lands by itself")


def _offboard_refused(t: Tick) -> str | None:
    refused = t.overdue and not t.flight.reached
    return reason_if(refused, f"offboard refused{_refusal(t, Action.OFFBOARD)}")


def _position_lost(t: Tick) -> str | None:
    return None if t.silent else position_lost(t)


def _on_ground(t: Tick) -> str | None:
    # A repeated command of the ground must not lift a vehicle off.
    return reason_if(t.in_air is False and not t.silent, "it stands on the ground")


def _long_off_height(t: Tick) -> str | None:
    return off_height(t) if t.off_height_s >= _LEAVES_S else None


def _battery_critical(t: Tick) -> str | None:
    return battery_below(t, t.robot.parameters.battery_critical, "critical")


def _ground_lands(t: Tick) -> str | None:
    return reason_if(t.safety_action == "land", "ground commands land")


def _ground_ends_takeoff(t: Tick) -> str | None:
    return reason_if(
        t.safety_action in ("land", "return"), f"ground commands {t.safety_action} during takeoff"
    )


def _ground_holds(t: Tick) -> str | None:
    return reason_if(t.safety_action == "hold", "ground commands hold")


def _ground_holds_landing(t: Tick) -> str | None:
    emergency = t.flight.land_by == "safety" or t.failsafe_acts
    return None if emergency else _ground_holds(t)


def _may_leave(t: Tick) -> bool:
    """Whether it may fly elsewhere: PX4's failsafe does not act, and it holds its height."""
    return not t.failsafe_acts and t.off_height_s < 0.0


def _ground_returns(t: Tick) -> str | None:
    return reason_if(t.safety_action == "return" and _may_leave(t), "ground commands return")


def _ground_returns_landing(t: Tick) -> str | None:
    return _ground_returns(t) if t.flight.land_by == "ground" else None


def _holds_without_remote_control(t: Tick) -> str | None:
    return remote_control_lost(t) if t.robot.on_remote_control_lost == "hold" else None


def _lands_without_remote_control(t: Tick) -> str | None:
    return remote_control_lost(t) if t.robot.on_remote_control_lost == "land" else None


def _ground_long_lost(t: Tick) -> str | None:
    parameters = t.robot.parameters
    # Not by the newest message's age, which does not grow if all messages are late.
    at_s, age_s = t.flight.ground_at_s, t.inputs.ground_age_s
    never = at_s == -math.inf
    lost_s = age_s - parameters.ground_timeout_s if never else t.inputs.now_s - at_s
    lost = lost_s > parameters.ground_lost_land_s and not t.silent
    return reason_if(
        lost, f"ground lost for {parameters.ground_timeout_s + parameters.ground_lost_land_s:g} s"
    )


def _free_to_return(t: Tick) -> bool:
    return t.safety_action == "none" and t.ground_heard and _may_leave(t)


def _battery_low_in_hold(t: Tick) -> str | None:
    return battery_low(t) if _free_to_return(t) else None


def _px4_stays_changed(t: Tick) -> str | None:
    stays = t.inputs.px4_change is not None and t.inputs.px4_change.stays
    return px4_changed(t) if stays and _free_to_return(t) else None


def _unattended(t: Tick) -> str | None:
    since_s, limit_s = t.flight.alone_since_s, t.robot.parameters.hover_land_s
    if since_s is None or t.silent or t.in_air is not True:
        return None
    return reason_if(t.inputs.now_s - since_s > limit_s, f"nobody answered for {limit_s:g} s")


def _found(t: Tick) -> str | None:
    vehicle = t.inputs.vehicle
    found = vehicle.connected and vehicle.armed is False and t.knows_place
    return reason_if(found, "autopilot and position found")


def _enabled(t: Tick) -> str | None:
    ground = t.inputs.ground
    if ground is None or ground.origin is None or not t.ground_heard:
        return None
    return reason_if(ground.enabled_for(t.robot.robot_id), "enabled")


def _enabled_at_rest(t: Tick) -> str | None:
    # Until then the operator sees why arming failed, and telemetry shows the vehicle disarmed.
    return _enabled(t) if t.age_s > STALE_TELEMETRY_S else None


def _not_enabled(t: Tick) -> str | None:
    return reason_if(_enabled(t) is None, "not enabled" if t.ground_heard else "ground lost")


def _may_fly_again(t: Tick) -> str | None:
    return _enabled(t) if t.safety_action == "none" else None


def _arming_called_off(t: Tick) -> str | None:
    if not t.ground_heard:
        return "ground lost while arming"
    if t.safety_action != "none":
        return f"ground commands {t.safety_action} while arming"
    doubtful = position_lost(t) or position_doubtful(t)
    if doubtful and not t.silent:
        return f"{doubtful}, while arming"
    left = t.flight.reached and t.mode is not Mode.OFFBOARD
    return _lapse(t) or reason_if(left, f"the vehicle left offboard for {t.mode} while arming")


def _arming_failed(t: Tick) -> str | None:
    for action in (Action.OFFBOARD, Action.ARM):
        refusal = _refusal(t, action)
        if refusal:
            return f"{action} refused{refusal}"
    return reason_if(t.age_s > _ARMING_TIMEOUT_S, "the autopilot does not arm")


def _armed(t: Tick) -> str | None:
    armed = t.flight.armed_asked and t.inputs.vehicle.armed is True
    return reason_if(armed and t.inputs.odometry is not None, "armed")


def _lift_off_failed(t: Tick) -> str | None:
    height, parameters = t.height_m, t.robot.parameters
    climb_s = 2.0 * parameters.slot_height_m / t.robot.limits.max_climb_m_s
    lifted = t.inputs.vehicle.in_air and height is not None and height > _AT_HEIGHT_M
    limit_s = parameters.takeoff_timeout_s + (climb_s if lifted else 0.0)
    return reason_if(t.age_s > limit_s, "takeoff failed: not climbing")


def _at_slot(t: Tick) -> str | None:
    height = t.height_m
    wanted_m = t.robot.parameters.slot_height_m
    there = height is not None and height > wanted_m - _AT_HEIGHT_M
    return reason_if(there and t.inputs.vehicle.in_air is True, f"at its height, {wanted_m:g} m")


def _nothing_to_decide_by(t: Tick) -> str | None:
    unknown = t.inputs.odometry is None and policy_stale(t) is not None
    return reason_if(unknown, "no position comes from the autopilot")


def _at_landing_point(t: Tick) -> str | None:
    odometry = t.inputs.odometry
    if odometry is None:
        return None
    away_m = math.dist(odometry.position_m[:2], t.landing_place_m)
    speed_m_s = math.hypot(*odometry.velocity_m_s[:2])
    return reason_if(
        away_m < _AT_LANDING_POINT_M and speed_m_s < _AT_REST_M_S, "at the landing point"
    )


def _refusal(t: Tick, action: Action) -> str:
    """Text ": reason" if the last command was this one, in this state, and was refused; else ""."""
    result = t.inputs.vehicle.result
    if result is None or result.action is not action or result.accepted:
        return ""
    return f": {result.text}" if result.at_s >= t.flight.since_s else ""


TRANSITIONS: tuple[Transition, ...] = (
    Transition(tuple(_S), _S.FAULT, _R.KILLED, "kill ordered",
               _always("killed by the operator"), order="kill", alarm=True, kills=True),
    Transition((_S.ARMING, *AIRBORNE, _S.PILOT), _S.PILOT, _R.DISARM_ORDERED,
               "disarm ordered, on the ground", _always("disarm ordered"),
               order="disarm", actions=(Action.DISARM,)),
    Transition((*AIRBORNE, _S.PILOT, _S.FAULT), _S.FAULT, _R.DISARMED_IN_AIR,
               "the vehicle is disarmed in the air, or its autopilot reboots there", _fell,
               alarm=True),
    Transition((*AIRBORNE, _S.PILOT), _S.LANDED, _R.DISARMED, "the vehicle is disarmed", _disarmed),
    Transition((_S.FAULT,), _S.INIT, _R.DISARMED,
               "the vehicle is disarmed, was not killed, and did not fall", _disarmed_again),
    Transition((*AIRBORNE, _S.PILOT), _S.FAULT, _R.AUTOPILOT_SILENT,
               "the autopilot does not answer", _link_lost, alarm=True),
    Transition((_S.IDLE, _S.PREFLIGHT, _S.LANDED), _S.INIT, _R.AUTOPILOT_SILENT,
               "the autopilot does not answer", _link_lost),
    Transition((_S.ARMING,), _S.INIT, _R.AUTOPILOT_SILENT, "the autopilot does not answer",
               _link_lost, actions=(Action.DISARM,)),
    Transition((_S.INIT,), _S.PILOT, _R.ARMED_BEFORE,
               "the vehicle is armed when the program finds it", _armed_before, alarm=True,
               unattended="if in hold"),
    Transition((_S.IDLE, _S.PREFLIGHT, _S.LANDED, _S.ARMING), _S.PILOT, _R.ARMED_BY_OTHERS,
               "the vehicle is armed, not by this program", _armed_by_others, alarm=True),
    Transition((_S.FAULT,), _S.PILOT, _R.ARMED_BEFORE,
               "the autopilot answers again, armed, and was not killed", _armed_again, alarm=True,
               unattended="if in hold"),
    Transition(AIRBORNE, _S.PILOT, _R.PILOT, "a pilot's mode is on", _pilot, alarm=True),
    Transition(STEERED, _S.HOLD, _R.CONTROL_SILENT, "the control loop was silent", _lapse,
               alarm=True, unattended="yes", drops_observations=True),
    Transition((_S.TAKEOFF, _S.MISSION, _S.RETURN), _S.HOLD, _R.FAILSAFE,
               "the autopilot's own failsafe holds or moves the vehicle", _failsafe_takes,
               alarm=True, unattended="yes"),
    Transition(STEERED, _S.PILOT, _R.LEFT_OFFBOARD, "the vehicle left offboard", _left_offboard,
               alarm=True),
    Transition((_S.LAND,), _S.PILOT, _R.LEFT_LAND, "the vehicle left land", _left_land, alarm=True),
    Transition(STEERED, _S.LAND, _R.AUTOPILOT_LANDS, "the autopilot lands by itself",
               _autopilot_lands, alarm=True),
    Transition((_S.HOLD, _S.RETURN), _S.PILOT, _R.OFFBOARD_REFUSED, "offboard is refused",
               _offboard_refused, alarm=True, unattended="if in hold"),
    Transition(STEERED, _S.LAND, _R.POSITION_LOST, "the position is lost", _position_lost,
               alarm=True),
    Transition(STEERED, _S.LAND, _R.BATTERY_CRITICAL, "the battery is critical", _battery_critical,
               alarm=True),
    Transition((_S.HOLD, _S.MISSION, _S.RETURN), _S.LAND, _R.ON_GROUND, "it stands on the ground",
               _on_ground, alarm=True),
    Transition((_S.TAKEOFF, _S.MISSION, _S.RETURN), _S.HOLD, _R.OFF_HEIGHT,
               "it does not hold its height", off_height, alarm=True),
    Transition((_S.HOLD,), _S.LAND, _R.OFF_HEIGHT, "the same, 3 s later", _long_off_height,
               alarm=True),
    Transition((_S.HOLD, _S.MISSION, _S.RETURN), _S.PILOT, _R.GIVEN_TO_PILOT,
               "pilot ordered", _always("given to a pilot"), order="pilot",
               actions=(Action.HOLD,), alarm=True),
    Transition((_S.ARMING,), _S.IDLE, _R.ARMING_CALLED_OFF,
               "the ground commands hold, land or return, or is lost; the control loop was silent; "
               "the vehicle left offboard", _arming_called_off, actions=(Action.DISARM,),
               alarm=True),
    Transition((_S.TAKEOFF,), _S.LAND, _R.GROUND_ENDS_TAKEOFF, "the ground commands land or return",
               _ground_ends_takeoff, land_by="return"),
    Transition((_S.HOLD, _S.MISSION, _S.RETURN), _S.LAND, _R.GROUND_LANDS,
               "the ground commands land", _ground_lands, land_by="ground"),
    Transition((_S.TAKEOFF, _S.MISSION, _S.RETURN), _S.HOLD, _R.GROUND_HOLDS,
               "the ground commands hold", _ground_holds),
    Transition((_S.LAND,), _S.HOLD, _R.GROUND_HOLDS,
               "the ground commands hold, and landing was no emergency", _ground_holds_landing),
    Transition((_S.HOLD, _S.MISSION), _S.RETURN, _R.GROUND_RETURNS, "the ground commands return",
               _ground_returns),
    Transition((_S.LAND,), _S.RETURN, _R.GROUND_RETURNS,
               "the ground commands return, and had commanded land", _ground_returns_landing),
    Transition((_S.MISSION,), _S.HOLD, _R.TOO_CLOSE, "a neighbour is too close", too_close,
               alarm=True),
    Transition((_S.TAKEOFF, _S.MISSION), _S.HOLD, _R.REMOTE_CONTROL_LOST,
               "the remote control is lost, and rc_lost = hold", _holds_without_remote_control,
               alarm=True),
    Transition((_S.TAKEOFF, _S.HOLD, _S.MISSION), _S.LAND, _R.REMOTE_CONTROL_LOST,
               "the remote control is lost, and rc_lost = land", _lands_without_remote_control,
               alarm=True),
    Transition((_S.MISSION, _S.RETURN), _S.HOLD, _R.GROUND_LOST, "the ground is lost", ground_lost,
               alarm=True),
    Transition((_S.TAKEOFF, _S.HOLD), _S.LAND, _R.GROUND_LOST, "the ground stays lost",
               _ground_long_lost, alarm=True),
    Transition((_S.HOLD, _S.PILOT), _S.LAND, _R.NOBODY_ANSWERED,
               "it hovers without anybody's command, and nobody answers", _unattended,
               alarm=True),
    Transition((_S.HOLD, _S.MISSION), _S.RETURN, _R.PX4_CHANGED,
               "PX4's parameters or fence were changed and not set back, and the ground commands "
               "nothing", _px4_stays_changed, alarm=True),
    Transition((_S.MISSION,), _S.RETURN, _R.BATTERY_LOW,
               "the battery is low, or just lasts for the way home", battery_low, alarm=True),
    Transition((_S.HOLD,), _S.RETURN, _R.BATTERY_LOW, "the same, and the ground commands nothing",
               _battery_low_in_hold, alarm=True),
    Transition((_S.MISSION,), _S.HOLD, _R.AUTOPILOT_SILENT,
               "the policy has no fresh answer since no position comes", _nothing_to_decide_by,
               alarm=True),
    Transition((_S.MISSION,), _S.HOLD, _R.POLICY_STALE, "the policy has no fresh answer",
               policy_stale, alarm=True),
    Transition((_S.INIT,), _S.IDLE, _R.FOUND, "autopilot, position and estimator origin are known",
               _found),
    Transition((_S.IDLE,), _S.PREFLIGHT, _R.ENABLED,
               "the ground enables and has set an origin, after 2 s", _enabled_at_rest),
    Transition((_S.PREFLIGHT,), _S.IDLE, _R.NOT_ENABLED, "the ground does not enable, or is lost",
               _not_enabled),
    Transition((_S.PREFLIGHT,), _S.ARMING, _R.TAKEOFF_ORDERED,
               "takeoff ordered, and the robot is ready", _always("takeoff ordered"),
               order="takeoff"),
    Transition((_S.ARMING,), _S.TAKEOFF, _R.ARMED, "the vehicle is armed", _armed),
    Transition((_S.ARMING,), _S.IDLE, _R.ARMING_FAILED,
               "offboard or arming is refused, or takes too long", _arming_failed,
               actions=(Action.DISARM,), alarm=True),
    Transition((_S.TAKEOFF,), _S.HOLD, _R.AT_HEIGHT,
               "at its height, and the autopilot reports in the air", _at_slot, keeps_target=True),
    Transition((_S.TAKEOFF,), _S.LAND, _R.NOT_CLIMBING, "it does not climb", _lift_off_failed,
               alarm=True),
    Transition((_S.HOLD,), _S.MISSION, _R.MISSION_STARTED, "start ordered",
               _always("mission started"), order="start"),
    Transition((_S.RETURN,), _S.LAND, _R.AT_LANDING_POINT, "at its landing point",
               _at_landing_point, land_by="return"),
    Transition((_S.PILOT,), _S.HOLD, _R.TAKEN_BACK, "rejoin ordered",
               _always("taken back by the operator"), order="rejoin", rejoins=True),
    Transition((_S.LANDED,), _S.PREFLIGHT, _R.ENABLED, "enabled, and the ground commands nothing",
               _may_fly_again),
)  # fmt: skip


Rows = Mapping[FlightState, Sequence[Transition]]


def by_state(rows: Sequence[Transition]) -> Rows:
    """The rows that apply in each state, in order."""
    return {state: [row for row in rows if state in row.sources] for state in FlightState}
