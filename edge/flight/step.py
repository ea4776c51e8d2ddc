"""One control tick of the flight state machine: memory and inputs -> memory and requests.

Pure: the caller has the clock, and commands the autopilot.
"""

import math
from typing import Any, NamedTuple

from msgspec.structs import replace

from edge.core.vehicle import Action, Mode, Vector, VehicleState
from edge.flight.alarms import alarms
from edge.flight.lift import Lift, Motion, update
from edge.flight.orders import ORDERS, answered, new_order, obeyed, refusal
from edge.flight.state import (
    STALE_TELEMETRY_S,
    FlightInputs,
    FlightMemory,
    Robot,
    Tick,
    failsafe_acts,
    in_air,
    is_silent,
)
from edge.flight.transitions import TRANSITIONS, Transition, by_state
from edge.messages.codes import Reason, Refusal, RefusalCode
from edge.messages.mission import AIRBORNE, ON_GROUND, STEERED, FlightState

_S = FlightState
ROWS = by_state(TRANSITIONS)

# PX4 needs a setpoint stream before offboard, and executes earlier commands meanwhile.
_STREAM_S = 0.5
_ASK_AGAIN_S = 1.0
_LANDED_DISARM_S = 3.0
# A return climbs with at least this share of the commanded speed.
_CLIMBS_SHARE = 0.5


class Decision(NamedTuple):
    """Outcome of a tick.

    With `new_trial`, the explored map and the neighbours' messages must be cleared. `taken` is the
    applied row of `TRANSITIONS`, None if the state stays.
    """

    flight: FlightMemory
    actions: tuple[Action, ...]
    alarms: tuple[Reason, ...]
    new_trial: bool
    taken: Transition | None


def step(robot: Robot, flight: FlightMemory, inputs: FlightInputs) -> Decision:
    """One control tick: at most one transition, and requests to the autopilot."""
    flight = _observed(Tick(robot, flight, inputs))
    order = new_order(robot, flight, inputs)
    tick = Tick(robot, flight, inputs)
    refused = None if order is None else refusal(tick, order)
    taken = order if refused is None else None
    row, reason = _first_row(tick, None if taken is None else taken.kind)
    overruled = row is not None and row.order is None
    if taken is not None and overruled and not ORDERS[taken.kind].moves_nothing:
        # A more severe transition came first.
        taken, refused = None, Refusal(RefusalCode.OVERRULED, reason)
    actions: tuple[Action, ...] = ()
    if row is not None:
        flight, actions = enter(row, reason, tick), row.actions
    if order is not None:
        flight = answered(flight, order, refused)
    new_trial = False
    if taken is not None:
        flight, new_trial = obeyed(flight, taken)
    tick = Tick(robot, flight, inputs)
    asked, of_gps = _requests(tick), _gps_requests(tick)
    flight = replace(
        flight,
        tick_at_s=inputs.now_s,
        target_m=_target_m(tick),
        asked_at_s=inputs.now_s if asked else flight.asked_at_s,
        armed_asked=flight.armed_asked or Action.ARM in asked,
        gps_ignored=Action.IGNORE_GPS in of_gps
        or (flight.gps_ignored and inputs.vehicle.ignores_gps is not False),
    )
    return Decision(flight, actions + asked + of_gps, alarms(tick), new_trial, row)


def _observed(t: Tick) -> FlightMemory:
    """Update the memory from this tick's inputs, before any transition."""
    flight, inputs, now_s = t.flight, t.inputs, t.inputs.now_s
    vehicle = inputs.vehicle
    if t.lapse_s > 0.0:
        flight = replace(flight, silent_until_s=now_s + STALE_TELEMETRY_S)
    if vehicle.heartbeat_at_s > t.acts_from_s + _STREAM_S and not is_silent(flight, now_s):
        flight = _updated(flight, reached=flight.reached or _is_reached(flight.state, vehicle))
    if not is_silent(flight, now_s) and (flight.reached or flight.state not in STEERED):
        flight = _updated(flight, silent_until_s=-math.inf)
    disarmed = vehicle.connected and vehicle.armed is False
    flight = _updated(
        flight,
        lift=_lift(t),
        ground_at_s=now_s if t.ground_heard else flight.ground_at_s,
        remote_control_at_s=now_s if vehicle.remote_control else flight.remote_control_at_s,
        disarmed_at_s=now_s if disarmed else flight.disarmed_at_s,
    )
    landed_since_s = now_s if flight.landed_since_s is None else flight.landed_since_s
    down = flight.state is _S.LAND and in_air(flight, vehicle, now_s) is False
    flight = _updated(flight, landed_since_s=landed_since_s if down else None)
    if failsafe_acts(vehicle):
        flight = replace(flight, failsafe_at_s=now_s)
        if flight.state is _S.LAND and flight.reached and vehicle.mode is not Mode.LAND:
            # PX4 continues to land; if it does not, it is requested again.
            flight = replace(flight, reached=False, asked_at_s=now_s)
    # Telemetry from before arming was called off has arrived by then.
    reported = vehicle.heartbeat_at_s > flight.since_s + STALE_TELEMETRY_S
    if disarmed and flight.state in ON_GROUND and reported:
        flight = _updated(flight, armed_by="")
    flight = _updated(flight, alone_since_s=_unattended_since_s(t))
    if flight.state is _S.PILOT and flight.datum_m is None and t.age_s > STALE_TELEMETRY_S:
        flight = replace(flight, datum_m=_home_m(inputs))
    return flight


def _lift(t: Tick) -> Lift:
    flight, inputs, odometry = t.flight, t.inputs, t.inputs.odometry
    if flight.state not in AIRBORNE:
        return Lift()
    # A takeoff waits below a robot that hovers above it.
    climbs_m_s = 0.0 if flight.state is _S.TAKEOFF else _CLIMBS_SHARE * t.robot.limits.max_climb_m_s
    motion = Motion(
        height_m=t.height_m,
        climb_m_s=None if odometry is None else odometry.velocity_m_s[2],
        wanted_m=t.wanted_height_m,
        approach_m_s=climbs_m_s,
        thrust=inputs.vehicle.thrust,
        in_air=inputs.vehicle.in_air,
        ground_below_m=t.robot.errors.height_m,
    )
    return update(flight.lift, motion, inputs.now_s, inputs.now_s - flight.tick_at_s)


def _updated(flight: FlightMemory, **changes: Any) -> FlightMemory:
    """Replace fields; returns the same memory if nothing changes, the usual case."""
    for name, value in changes.items():
        if getattr(flight, name) != value:
            return replace(flight, **changes)
    return flight


def _unattended_since_s(t: Tick) -> float | None:
    flight, now_s, order = t.flight, t.inputs.now_s, t.inputs.order
    ordered = order is not None and order.robot_id == t.robot.robot_id
    taken = flight.state is _S.PILOT and t.mode is not Mode.HOLD
    if ordered or t.safety_action == "hold" or taken:
        return None
    begins = flight.state is _S.HOLD and t.failsafe_acts
    return now_s if begins and flight.alone_since_s is None else flight.alone_since_s


def _is_reached(state: FlightState, vehicle: VehicleState) -> bool:
    if state is _S.FAULT:
        return vehicle.armed is False
    return vehicle.mode is (Mode.LAND if state is _S.LAND else Mode.OFFBOARD)


def _first_row(tick: Tick, ordered: str | None) -> tuple[Transition | None, str]:
    for row in ROWS[tick.flight.state]:
        if row.order is None or row.order == ordered:
            reason = row.why(tick)
            if reason is not None:
                return row, reason
    return None, ""


def enter(row: Transition, reason: str, t: Tick) -> FlightMemory:
    """Memory on entering the row's target state; `reason` is the text of its reason."""
    flight, now_s = t.flight, t.inputs.now_s
    from_offboard = flight.state in (_S.ARMING, *STEERED)
    stays_offboard = from_offboard and row.target in STEERED and not row.drops_observations
    in_hold = t.mode is Mode.HOLD
    alone = row.unattended == "yes" or (row.unattended == "if in hold" and in_hold)
    alone_since_s = now_s if flight.alone_since_s is None else flight.alone_since_s
    return replace(
        flight,
        state=row.target,
        reason=Reason(row.code, reason),
        alarming=row.alarm,
        since_s=now_s,
        datum_m=_datum_m(row.target, t),
        target_m=flight.target_m if row.keeps_target else None,
        reached=stays_offboard and flight.reached,
        rejoined_at_s=now_s if row.rejoins else flight.rejoined_at_s,
        asked_at_s=-math.inf,
        armed_asked=False,
        armed_by=_armed_by(row.target, flight),
        alone_since_s=alone_since_s if alone else None,
        landed_since_s=None,
        land_by=row.land_by,
        killed=flight.killed or row.kills,
        lift=flight.lift.entered(steered=row.target in STEERED),
    )


def _armed_by(target: FlightState, flight: FlightMemory) -> str:
    called_off = flight.state is _S.ARMING and not flight.armed_asked
    return "" if called_off or target in (_S.PREFLIGHT, _S.LANDED) else flight.armed_by


def _datum_m(target: FlightState, t: Tick) -> float | None:
    odometry = t.inputs.odometry
    if target is _S.TAKEOFF and odometry is not None:
        return odometry.position_m[2]
    if target in (_S.LANDED, _S.INIT):
        return None
    return t.flight.datum_m


def _home_m(inputs: FlightInputs) -> float | None:
    """Takeoff point of a program that starts in flight: the place of arming."""
    odometry, above_home_m = inputs.odometry, inputs.vehicle.height_above_home_m
    if odometry is None or above_home_m is None:
        return None
    return odometry.position_m[2] - above_home_m


def _target_m(t: Tick) -> Vector | None:
    """Target above the takeoff point, or at the place where the vehicle could first hold."""
    odometry, height, state = t.inputs.odometry, t.height_m, t.flight.state
    if state not in (_S.TAKEOFF, _S.HOLD):
        return None
    target_m = t.flight.target_m
    if odometry is None or height is None:
        return target_m
    # PX4's failsafe, or nothing, steered it in between.
    led_away = t.silent or t.failsafe_acts
    if target_m is not None and t.knows_place and not led_away:
        return target_m
    fence = t.robot.fence
    # While the position is in doubt, the old numbers may be another place.
    x_m, y_m = fence.moved_inside_m(*odometry.position_m[:2], fence.buffer_m / 2.0)
    if state is _S.TAKEOFF:
        return x_m, y_m, t.robot.parameters.slot_height_m
    return x_m, y_m, height if target_m is None or led_away else target_m[2]


def _requests(t: Tick) -> tuple[Action, ...]:
    """Commands that the state requires, repeated until done; ARM is requested once."""
    flight, now_s = t.flight, t.inputs.now_s
    streamed = t.could_follow_s >= _STREAM_S
    if flight.state is _S.LAND:
        since_s = flight.landed_since_s
        if since_s is not None and now_s - since_s > _LANDED_DISARM_S:
            return _repeated(t, Action.DISARM)
        asked_lately = now_s - flight.asked_at_s < t.robot.parameters.hover_land_s
        if flight.reached or (t.failsafe_acts and (t.mode is Mode.LAND or asked_lately)):
            return ()
        return _repeated(t, Action.LAND)
    if flight.state is _S.FAULT:
        return _repeated(t, Action.KILL) if flight.killed and not flight.reached else ()
    if flight.state is _S.ARMING and flight.reached:
        return () if flight.armed_asked else (Action.ARM,)
    if flight.state in ON_GROUND and t.inputs.vehicle.armed is False:
        # PX4 would not arm again in the mode at the end of a flight.
        stuck = t.heartbeat_since_entry and t.mode in (Mode.OFFBOARD, Mode.LAND, Mode.RETURN)
        return _repeated(t, Action.HOLD) if stuck else ()
    if t.silent and flight.state in STEERED:
        # Without setpoints it would land. Before telemetry, a pilot may have it.
        flies_on = t.mode is Mode.OFFBOARD and t.heartbeat_since_entry
        return _repeated(t, Action.HOLD) if flies_on else ()
    if flight.state in (_S.ARMING, *STEERED) and streamed and not flight.reached:
        return _repeated(t, Action.OFFBOARD)
    return ()


def _gps_requests(t: Tick) -> tuple[Action, ...]:
    """Make the estimator ignore a receiver while that contradicts itself.

    PX4 then keeps its place by its other sensors for seconds, and its height after that. Only this
    program's own setting is set back: others may ignore the receiver on purpose.
    """
    vehicle = t.inputs.vehicle
    if t.silent or not vehicle.connected:
        return ()
    if t.inputs.position.distrusts_gps and vehicle.armed is not False:
        flies = t.flight.state in AIRBORNE
        return (Action.IGNORE_GPS,) if flies and not vehicle.ignores_gps else ()
    return (Action.USE_GPS,) if t.flight.gps_ignored and vehicle.ignores_gps else ()


def _repeated(t: Tick, action: Action) -> tuple[Action, ...]:
    asked_at_s = t.flight.asked_at_s
    if t.inputs.now_s - asked_at_s < _ASK_AGAIN_S:
        return ()
    # Modes are requested again only after telemetry: a pilot may have taken the vehicle.
    reported = t.inputs.vehicle.heartbeat_at_s > asked_at_s + _STREAM_S
    return (action,) if reported or action in (Action.DISARM, Action.KILL) else ()
