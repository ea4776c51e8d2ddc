"""The flight state machine: which state a robot is in, and what it asks of its autopilot then.

`TRANSITIONS` is the machine, gravest first: in every tick the first row that applies is taken.
docs/safety.md shows the same table to people. Nothing here has a clock or talks to a vehicle.

Heights are above the robot's own takeoff point, which is latched when it is armed (`datum_m`): the
estimator's zero is not the pad.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from edge.core import F64
from edge.core.mailbox import Neighbour
from edge.core.mission import (
    ORDER_LIFETIME_S,
    Calm,
    FlightState,
    GroundState,
    Order,
    OrderKind,
    OrderResult,
)
from edge.core.ports import Odometry
from edge.core.safety import Closest, Fence, MotionLimits
from edge.core.vehicle import PILOTED, Action, Mode, Vector, VehicleState

_S = FlightState

# PX4 takes a setpoint stream for real only after a while, and wants one before offboard.
_STREAM_S = 0.5
_ASK_AGAIN_S = 1.0
_ARMING_TIMEOUT_S = 6.0
_OFFBOARD_TIMEOUT_S = 4.0
# After a lapse the first telemetry to come is what piled up meanwhile; PX4 tells its mode at 1 Hz.
_STALE_TELEMETRY_S = 2.0
_AT_HEIGHT_M = 0.5
_AT_SLOT_M = 1.0
_AT_LANDING_POINT_M = 0.5
_AT_REST_M_S = 0.4
_LANDED_DISARM_S = 3.0
_ANSWERS_KEPT = 8


@dataclass(frozen=True, slots=True)
class FlightParameters:
    """What one robot's flight is measured by; times in s, distances in m, speeds in m/s.

    The robot flies at `base_height_m + slot * slot_spacing_m`: the policy is planar and GPS errs by
    metres, so that each robot has a height of its own. `landing_point_m` (x, y) is in the mission
    frame. `battery_low` and `battery_critical` are remaining shares.

    Raises ValueError that names what is impossible.
    """

    slot: int
    landing_point_m: tuple[float, ...]
    base_height_m: float = 4.0
    slot_spacing_m: float = 2.0
    min_separation_m: float = 1.5
    battery_low: float = 0.25
    battery_critical: float = 0.15
    command_timeout_s: float = 0.5
    position_timeout_s: float = 1.0
    ground_timeout_s: float = 3.0
    ground_lost_land_s: float = 10.0
    takeoff_timeout_s: float = 15.0

    def __post_init__(self) -> None:
        if self.slot < 0:
            raise ValueError(f"slot = {self.slot}: must be 0 or above")
        if len(self.landing_point_m) != 2 or not all(map(math.isfinite, self.landing_point_m)):
            raise ValueError(f"landing_point_m = {list(self.landing_point_m)}: must be [x, y]")
        for name in (
            "base_height_m", "slot_spacing_m", "min_separation_m", "command_timeout_s",
            "position_timeout_s", "ground_timeout_s", "ground_lost_land_s", "takeoff_timeout_s",
        ):  # fmt: skip
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} = {getattr(self, name)}: must be above 0 and finite")
        if self.min_separation_m >= self.slot_spacing_m:
            raise ValueError(
                f"min_separation_m = {self.min_separation_m}: must be below slot_spacing_m = "
                f"{self.slot_spacing_m}, or robots at their own heights would stop each other"
            )
        if not 0.0 < self.battery_critical < self.battery_low < 1.0:
            raise ValueError(
                f"battery_critical = {self.battery_critical}, battery_low = {self.battery_low}: "
                "must be 0 < battery_critical < battery_low < 1"
            )

    @property
    def slot_height_m(self) -> float:
        """The robot's own height."""
        return self.base_height_m + self.slot * self.slot_spacing_m


@dataclass(frozen=True, slots=True)
class Flight:
    """What the machine remembers from tick to tick.

    `target_m` is what TAKEOFF and HOLD keep: x and y of the mission frame, and a height.
    `mode_seen`: since the state was entered the autopilot was seen in the mode that it needs.
    `lapsed`: the control loop was silent for too long, and no mode was seen since; then nothing is
    sent before `silent_until_s`. `trial` is the mission that was started last.
    """

    state: FlightState = FlightState.INIT
    reason: str = "program started"
    since_s: float = 0.0
    tick_at_s: float = -math.inf
    datum_m: float | None = None
    target_m: Vector | None = None
    mode_seen: bool = False
    lapsed: bool = False
    silent_until_s: float = -math.inf
    asked_at_s: float = -math.inf
    armed_asked: bool = False
    landed_since_s: float | None = None
    position_ok_at_s: float = math.inf
    land_by: Literal["ground", "return", "safety"] = "safety"
    killed: bool = False
    trial: str = ""
    answers: tuple[OrderResult, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class FlightInputs:
    """What one control tick knows.

    `odometry` is in the mission frame, its z up from the estimator's origin; None when the
    autopilot's position is old, or there is no mission origin. `policy_velocity_m_s` (2,) is None
    when the policy has no fresh answer. `closest` is the nearest neighbour. `busy_neighbours` say
    of themselves that they arm or take off. `failed_checks` are preflight's; None before the first.
    `order` is new in this tick.
    """

    now_s: float
    vehicle: VehicleState
    odometry: Odometry | None
    policy_velocity_m_s: F64 | None
    neighbours: tuple[Neighbour, ...]
    closest: Closest | None
    busy_neighbours: tuple[int, ...]
    ground: GroundState | None
    ground_age_s: float
    failed_checks: tuple[str, ...] | None
    order: Order | None
    uptime_s: float


@dataclass(frozen=True, slots=True)
class Robot:
    """Who flies: what does not change during a flight."""

    robot_id: int
    boot_nonce: int
    parameters: FlightParameters
    fence: Fence
    limits: MotionLimits


class Decision(NamedTuple):
    """A tick's outcome; `new_trial`: the explored map and the mailbox are to be forgotten."""

    flight: Flight
    actions: tuple[Action, ...]
    alarms: tuple[str, ...]
    new_trial: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Tick:
    """Memory and inputs together, as the rows of the table ask them."""

    robot: Robot
    flight: Flight
    inputs: FlightInputs
    accepted: OrderKind | None

    @property
    def age_s(self) -> float:
        return self.inputs.now_s - self.flight.since_s

    @property
    def mode(self) -> Mode | None:
        return self.inputs.vehicle.mode

    @property
    def heard_since_entry(self) -> bool:
        return self.inputs.vehicle.heartbeat_at_s > self.flight.since_s

    @property
    def calm(self) -> Calm:
        ground = self.inputs.ground
        if ground is None:
            return "none"
        asked = ground.calm_for(self.robot.robot_id)
        return "hold" if asked == "none" and not ground.enabled else asked

    @property
    def ground_heard(self) -> bool:
        return self.inputs.ground_age_s <= self.robot.parameters.ground_timeout_s

    @property
    def height_m(self) -> float | None:
        return height_m(self.flight, self.inputs.odometry)

    @property
    def mode_counts(self) -> bool:
        """Whether the reported mode tells that the autopilot left ours, and is no old news."""
        flight = self.flight
        return flight.mode_seen or (flight.lapsed and self.inputs.now_s >= flight.silent_until_s)

    @property
    def lapse_s(self) -> float:
        return self.inputs.now_s - self.flight.tick_at_s

    @property
    def offboard_since_s(self) -> float:
        return max(self.flight.since_s, self.flight.silent_until_s)


def height_m(flight: Flight, odometry: Odometry | None) -> float | None:
    """Height above the robot's own takeoff point, m; None when unknown."""
    if odometry is None or flight.datum_m is None:
        return None
    return odometry.position_m[2] - flight.datum_m


@dataclass(frozen=True, slots=True)
class Transition:
    """One row: from any of `sources` to `target` when `why` gives a reason; `when` is for people."""

    sources: tuple[FlightState, ...]
    target: FlightState
    when: str
    why: Callable[[_Tick], str | None]
    actions: tuple[Action, ...] = ()
    land_by: Literal["ground", "return", "safety"] = "safety"


_STEERED = (_S.TAKEOFF, _S.HOLD, _S.MISSION, _S.RETURN)
_AIRBORNE = (*_STEERED, _S.LAND)
_ON_GROUND = (_S.INIT, _S.IDLE, _S.PREFLIGHT, _S.LANDED)


def _if(condition: bool, reason: str) -> str | None:
    return reason if condition else None


def _killed(t: _Tick) -> str | None:
    return _if(t.accepted == "kill", "killed by the operator")


def _disarmed(t: _Tick) -> str | None:
    return _if(t.inputs.vehicle.armed is False, "disarmed")


def _link_lost(t: _Tick) -> str | None:
    return _if(not t.inputs.vehicle.connected, "the autopilot does not answer")


def _armed_by_others(t: _Tick) -> str | None:
    if not t.inputs.vehicle.armed:
        return None
    first = t.flight.state is _S.INIT
    return f"vehicle {'was already' if first else 'is'} armed, not by this program: only observing"


def _pilot(t: _Tick) -> str | None:
    return _if(t.mode_counts and t.mode in PILOTED, f"a pilot flies it ({t.mode})")


def _left_offboard(t: _Tick) -> str | None:
    left = t.flight.mode_seen and t.mode not in (Mode.OFFBOARD, Mode.LAND, None)
    return _if(left, f"vehicle left offboard for {t.mode}")


def _left_land(t: _Tick) -> str | None:
    return _if(t.flight.mode_seen and t.mode is not Mode.LAND, f"vehicle left land for {t.mode}")


def _lapse(t: _Tick) -> str | None:
    silent = t.lapse_s > t.robot.parameters.command_timeout_s and t.flight.tick_at_s > -math.inf
    return _if(silent, f"control was silent for {t.lapse_s:.1f} s")


def _autopilot_lands(t: _Tick) -> str | None:
    return _if(t.mode_counts and t.mode is Mode.LAND, "the autopilot lands by itself")


def _offboard_refused(t: _Tick) -> str | None:
    waited_s = t.inputs.now_s - t.offboard_since_s
    refused = not t.flight.mode_seen and waited_s > _OFFBOARD_TIMEOUT_S
    return _if(refused, f"offboard refused{_refusal(t, Action.OFFBOARD)}")


def _position_lost(t: _Tick) -> str | None:
    lost_s = t.inputs.now_s - max(t.flight.position_ok_at_s, t.flight.silent_until_s)
    timeout_s = t.robot.parameters.position_timeout_s
    return _if(t.inputs.odometry is None and lost_s >= timeout_s, "position lost")


def _battery_critical(t: _Tick) -> str | None:
    return _battery_below(t, t.robot.parameters.battery_critical, "critical")


def _battery_low(t: _Tick) -> str | None:
    return _battery_below(t, t.robot.parameters.battery_low, "low")


def _battery_below(t: _Tick, share: float, word: str) -> str | None:
    battery = t.inputs.vehicle.battery
    return None if battery is None or battery > share else f"battery {word}: {battery:.0%}"


def _ground_lands(t: _Tick) -> str | None:
    return _if(t.calm == "land", "ground commands land")


def _ground_ends_takeoff(t: _Tick) -> str | None:
    return _if(t.calm in ("land", "return"), f"ground commands {t.calm} during takeoff")


def _ground_holds(t: _Tick) -> str | None:
    return _if(t.calm == "hold", "ground commands hold")


def _ground_holds_landing(t: _Tick) -> str | None:
    return _if(t.calm == "hold" and t.flight.land_by != "safety", "ground commands hold")


def _ground_returns(t: _Tick) -> str | None:
    return _if(t.calm == "return", "ground commands return")


def _ground_returns_landing(t: _Tick) -> str | None:
    return _if(t.calm == "return" and t.flight.land_by == "ground", "ground commands return")


def _too_close(t: _Tick) -> str | None:
    closest, limit_m = t.inputs.closest, t.robot.parameters.min_separation_m
    if closest is None or closest.distance_m >= limit_m:
        return None
    return f"only {closest.distance_m:.1f} m to robot {closest.robot_id}"


def _ground_lost(t: _Tick) -> str | None:
    return _if(not t.ground_heard, "ground lost")


def _ground_long_lost(t: _Tick) -> str | None:
    parameters = t.robot.parameters
    limit_s = parameters.ground_timeout_s + parameters.ground_lost_land_s
    return _if(t.inputs.ground_age_s > limit_s, "ground lost for too long")


def _policy_stale(t: _Tick) -> str | None:
    return _if(t.inputs.policy_velocity_m_s is None, "the policy has no fresh answer")


def _found(t: _Tick) -> str | None:
    vehicle = t.inputs.vehicle
    found = vehicle.connected and vehicle.armed is False and vehicle.position_ok
    return _if(found and vehicle.origin_deg is not None, "autopilot and position found")


def _enabled(t: _Tick) -> str | None:
    ground = t.inputs.ground
    enabled = ground is not None and ground.enabled and ground.origin is not None
    return _if(enabled and t.ground_heard, "enabled")


def _not_enabled(t: _Tick) -> str | None:
    return _if(_enabled(t) is None, "not enabled" if t.ground_heard else "ground lost")


def _may_fly_again(t: _Tick) -> str | None:
    return _if(t.calm == "none" and _enabled(t) is not None, "enabled")


def _rest(t: _Tick) -> str | None:
    return _if(_enabled(t) is None and t.age_s > _ASK_AGAIN_S, "disarmed")


def _takeoff(t: _Tick) -> str | None:
    return _if(t.accepted == "takeoff", "takeoff ordered")


def _arming_called_off(t: _Tick) -> str | None:
    if not t.ground_heard:
        return "ground lost"
    return _if(t.calm != "none", f"ground commands {t.calm}")


def _arming_failed(t: _Tick) -> str | None:
    for action in (Action.OFFBOARD, Action.ARM):
        refusal = _refusal(t, action)
        if refusal:
            return f"{action} refused{refusal}"
    return _if(t.age_s > _ARMING_TIMEOUT_S, "the autopilot does not arm")


def _armed(t: _Tick) -> str | None:
    armed = t.flight.armed_asked and t.inputs.vehicle.armed and t.heard_since_entry
    return _if(bool(armed) and t.inputs.odometry is not None, "armed")


def _lift_off_failed(t: _Tick) -> str | None:
    height, parameters = t.height_m, t.robot.parameters
    climb_s = 2.0 * parameters.slot_height_m / t.robot.limits.max_climb_m_s
    lifted = t.inputs.vehicle.in_air and height is not None and height > _AT_HEIGHT_M
    limit_s = parameters.takeoff_timeout_s + (climb_s if lifted else 0.0)
    return _if(t.age_s > limit_s, "takeoff failed: not climbing")


def _at_slot(t: _Tick) -> str | None:
    height = t.height_m
    wanted_m = t.robot.parameters.slot_height_m
    there = t.inputs.vehicle.in_air and height is not None and height > wanted_m - _AT_HEIGHT_M
    return _if(bool(there), f"at its height, {wanted_m:g} m")


def _start(t: _Tick) -> str | None:
    return _if(t.accepted == "start", "mission started")


def _rejoin(t: _Tick) -> str | None:
    return _if(t.accepted == "rejoin", "taken back by the operator")


def _at_landing_point(t: _Tick) -> str | None:
    odometry = t.inputs.odometry
    if odometry is None:
        return None
    away_m = math.dist(odometry.position_m[:2], t.robot.parameters.landing_point_m)
    speed_m_s = math.hypot(*odometry.velocity_m_s[:2])
    return _if(away_m < _AT_LANDING_POINT_M and speed_m_s < _AT_REST_M_S, "at the landing point")


def _refusal(t: _Tick, action: Action) -> str:
    """ ": reason" of the last command, if it was this one, of this state, and refused."""
    result = t.inputs.vehicle.result
    if result is None or result.action is not action or result.accepted:
        return ""
    return f": {result.text}" if result.at_s >= t.flight.since_s else ""


TRANSITIONS: tuple[Transition, ...] = (
    Transition(tuple(_S), _S.FAULT, "the operator orders kill", _killed, (Action.KILL,)),
    # What the vehicle does, whoever made it.
    Transition((*_AIRBORNE, _S.PILOT), _S.LANDED, "the vehicle is disarmed", _disarmed),
    Transition((_S.FAULT,), _S.INIT, "the vehicle is disarmed, and not killed",
               lambda t: None if t.flight.killed or not t.heard_since_entry else _disarmed(t)),
    Transition((_S.ARMING, *_AIRBORNE, _S.PILOT), _S.FAULT, "the autopilot does not answer",
               _link_lost),
    Transition((_S.IDLE, _S.PREFLIGHT, _S.LANDED), _S.INIT, "the autopilot does not answer",
               _link_lost),
    Transition(_ON_GROUND, _S.PILOT, "the vehicle is armed, not by this program", _armed_by_others),
    Transition((_S.FAULT,), _S.PILOT, "the autopilot answers again, armed",
               lambda t: None if t.flight.killed or not t.inputs.vehicle.connected
               or not t.heard_since_entry else _armed_by_others(t)),
    # A pilot, and the autopilot's own failsafe.
    Transition(_AIRBORNE, _S.PILOT, "the sticks fly the vehicle", _pilot),
    Transition((_S.ARMING,), _S.IDLE, "the control loop was silent", _lapse, (Action.DISARM,)),
    Transition(_STEERED, _S.HOLD, "the control loop was silent", _lapse),
    Transition(_STEERED, _S.PILOT, "the vehicle left offboard", _left_offboard),
    Transition((_S.LAND,), _S.PILOT, "the vehicle left land", _left_land),
    Transition(_STEERED, _S.LAND, "the autopilot lands by itself", _autopilot_lands),
    Transition((_S.TAKEOFF,), _S.LAND, "offboard is refused", _offboard_refused),
    Transition((_S.HOLD, _S.RETURN), _S.PILOT, "offboard is refused", _offboard_refused),
    # What cannot wait for anybody.
    Transition(_STEERED, _S.LAND, "the position is lost", _position_lost),
    Transition(_STEERED, _S.LAND, "the battery is critical", _battery_critical),
    # The ground calms.
    Transition((_S.TAKEOFF,), _S.LAND, "the ground commands land or return",
               _ground_ends_takeoff, land_by="ground"),
    Transition((_S.HOLD, _S.MISSION, _S.RETURN), _S.LAND, "the ground commands land",
               _ground_lands, land_by="ground"),
    Transition((_S.TAKEOFF, _S.MISSION, _S.RETURN), _S.HOLD, "the ground commands hold",
               _ground_holds),
    Transition((_S.LAND,), _S.HOLD, "the ground commands hold, and landing was no emergency",
               _ground_holds_landing),
    Transition((_S.HOLD, _S.MISSION), _S.RETURN, "the ground commands return", _ground_returns),
    Transition((_S.LAND,), _S.RETURN, "the ground commands return, and had commanded land",
               _ground_returns_landing),
    Transition((_S.ARMING,), _S.IDLE, "the ground commands hold, land or return, or is lost",
               _arming_called_off, (Action.DISARM,)),
    # What the robot notices by itself.
    Transition((_S.MISSION, _S.RETURN), _S.HOLD, "a neighbour is too close", _too_close),
    Transition((_S.MISSION, _S.RETURN), _S.HOLD, "the ground is lost", _ground_lost),
    Transition((_S.HOLD,), _S.LAND, "the ground stays lost", _ground_long_lost),
    Transition((_S.MISSION,), _S.RETURN, "the battery is low", _battery_low),
    Transition((_S.HOLD,), _S.RETURN, "the battery is low, and the ground commands nothing",
               lambda t: _battery_low(t) if t.calm == "none" and t.ground_heard else None),
    Transition((_S.MISSION,), _S.HOLD, "the policy has no fresh answer", _policy_stale),
    # The way of a flight.
    Transition((_S.INIT,), _S.IDLE, "autopilot, position and estimator origin are known", _found),
    Transition((_S.IDLE,), _S.PREFLIGHT, "the ground enables, and has set an origin", _enabled),
    Transition((_S.PREFLIGHT,), _S.IDLE, "the ground does not enable, or is lost", _not_enabled),
    Transition((_S.PREFLIGHT,), _S.ARMING, "the operator orders takeoff, and the robot is ready",
               _takeoff),
    Transition((_S.ARMING,), _S.TAKEOFF, "the vehicle is armed", _armed),
    Transition((_S.ARMING,), _S.IDLE, "offboard or arming is refused, or takes too long",
               _arming_failed, (Action.DISARM,)),
    Transition((_S.TAKEOFF,), _S.HOLD, "at its height, and the autopilot says in the air",
               _at_slot),
    Transition((_S.TAKEOFF,), _S.LAND, "it does not climb", _lift_off_failed),
    Transition((_S.HOLD,), _S.MISSION, "the operator orders start", _start),
    Transition((_S.RETURN,), _S.LAND, "at its landing point", _at_landing_point,
               land_by="return"),
    Transition((_S.PILOT,), _S.HOLD, "the operator orders rejoin", _rejoin),
    Transition((_S.LANDED,), _S.PREFLIGHT, "enabled, and the ground commands nothing",
               _may_fly_again),
    Transition((_S.LANDED,), _S.IDLE, "the ground does not enable, or is lost", _rest),
)  # fmt: skip


def step(robot: Robot, flight: Flight, inputs: FlightInputs) -> Decision:
    """One control tick: at most one transition, and what to ask of the autopilot now."""
    if inputs.odometry is not None:
        flight = replace(flight, position_ok_at_s=inputs.now_s)
    expected = Mode.LAND if flight.state is _S.LAND else Mode.OFFBOARD
    if (
        flight.state in _AIRBORNE
        and inputs.vehicle.mode is expected
        and not _silent(flight, inputs)
    ):
        flight = replace(flight, mode_seen=True, lapsed=False)
    if flight.state is _S.PILOT and flight.datum_m is None:
        flight = replace(flight, datum_m=_home_m(inputs))
    accepted, flight = _answer(robot, flight, inputs)
    tick = _Tick(robot, flight, inputs, accepted)
    new_trial = False
    actions: tuple[Action, ...] = ()
    row, reason = _first_row(tick)
    if row is not None:
        if row.target is _S.MISSION and inputs.order is not None:
            new_trial = inputs.order.trial != flight.trial
            flight = replace(flight, trial=inputs.order.trial)
        flight = _enter(row, reason, replace(tick, flight=flight))
        actions = row.actions
        tick = _Tick(robot, flight, inputs, None)
    asked = _ask(tick)
    if Action.ARM in asked:
        flight = replace(flight, armed_asked=True)
    if asked:
        flight = replace(flight, asked_at_s=inputs.now_s)
    flight = replace(flight, tick_at_s=inputs.now_s, landed_since_s=_landed_since_s(tick))
    return Decision(flight, actions + asked, _alarms(tick), new_trial)


def is_silent(flight: Flight, now_s: float) -> bool:
    """Whether no setpoint may be sent yet, after a lapse."""
    return now_s < flight.silent_until_s


def _silent(flight: Flight, inputs: FlightInputs) -> bool:
    return is_silent(flight, inputs.now_s)


def _first_row(tick: _Tick) -> tuple[Transition | None, str]:
    for row in TRANSITIONS:
        if tick.flight.state in row.sources:
            reason = row.why(tick)
            if reason is not None:
                return row, reason
    return None, ""


def _enter(row: Transition, reason: str, t: _Tick) -> Flight:
    """The memory with which the row's target begins."""
    flight, now_s = t.flight, t.inputs.now_s
    lapsed = row.why is _lapse
    stays_offboard = flight.state in _STEERED and row.target in _STEERED and not lapsed
    return replace(
        flight,
        state=row.target,
        reason=reason,
        since_s=now_s,
        datum_m=_datum_m(row.target, t),
        target_m=_target_m(row.target, t),
        mode_seen=stays_offboard and flight.mode_seen,
        lapsed=lapsed or (stays_offboard and flight.lapsed),
        silent_until_s=now_s + _STALE_TELEMETRY_S if lapsed else flight.silent_until_s,
        asked_at_s=-math.inf,
        armed_asked=False,
        landed_since_s=None,
        land_by=row.land_by,
        killed=flight.killed or row.why is _killed,
    )


def _datum_m(target: FlightState, t: _Tick) -> float | None:
    odometry = t.inputs.odometry
    if target is _S.TAKEOFF and odometry is not None:
        return odometry.position_m[2]
    if target in (_S.LANDED, _S.INIT):
        return None
    return t.flight.datum_m


def _home_m(inputs: FlightInputs) -> float | None:
    """For a program that starts in flight, the takeoff point is where the vehicle was armed."""
    odometry, above_home_m = inputs.odometry, inputs.vehicle.height_above_home_m
    if odometry is None or above_home_m is None:
        return None
    return odometry.position_m[2] - above_home_m


def _target_m(target: FlightState, t: _Tick) -> Vector | None:
    odometry = t.inputs.odometry
    if odometry is None or target not in (_S.TAKEOFF, _S.HOLD):
        return None
    x_m, y_m, z_m = odometry.position_m
    if target is _S.TAKEOFF:
        return x_m, y_m, t.robot.parameters.slot_height_m
    datum_m = t.flight.datum_m
    return None if datum_m is None else (x_m, y_m, z_m - datum_m)


def _ask(t: _Tick) -> tuple[Action, ...]:
    """What the state needs from the autopilot, asked again until it is so; ARM is asked once."""
    flight, vehicle, now_s = t.flight, t.inputs.vehicle, t.inputs.now_s
    if flight.killed and vehicle.armed is not False:
        return _again(t, Action.KILL)
    if flight.state is _S.ARMING:
        return _ask_to_arm(t)
    if flight.state is _S.LAND:
        if t.mode is not Mode.LAND:
            return _again(t, Action.LAND)
        on_ground_s = now_s - (flight.landed_since_s or now_s)
        return _again(t, Action.DISARM) if on_ground_s > _LANDED_DISARM_S else ()
    if flight.state in _STEERED and not flight.mode_seen:
        streamed = now_s - t.offboard_since_s >= _STREAM_S
        return _again(t, Action.OFFBOARD) if streamed else ()
    return ()


def _ask_to_arm(t: _Tick) -> tuple[Action, ...]:
    if t.flight.armed_asked or t.age_s < _STREAM_S:
        return ()
    result = t.inputs.vehicle.result
    ready = t.mode is Mode.OFFBOARD and t.heard_since_entry
    if result is not None and result.action is Action.OFFBOARD and result.accepted:
        ready = ready or result.at_s >= t.flight.since_s
    return (Action.ARM,) if ready else _again(t, Action.OFFBOARD)


def _again(t: _Tick, action: Action) -> tuple[Action, ...]:
    return (action,) if t.inputs.now_s - t.flight.asked_at_s >= _ASK_AGAIN_S else ()


def _landed_since_s(t: _Tick) -> float | None:
    if t.flight.state is not _S.LAND or t.inputs.vehicle.in_air is not False:
        return None
    return t.flight.landed_since_s or t.inputs.now_s


def _answer(robot: Robot, flight: Flight, inputs: FlightInputs) -> tuple[OrderKind | None, Flight]:
    """Accept or refuse the order, once: one that was answered is not looked at again."""
    order = inputs.order
    if order is None or order.robot_id != robot.robot_id:
        return None, flight
    if any(answer.order_id == order.order_id for answer in flight.answers):
        return None, flight
    problem = _order_problem(_Tick(robot, flight, inputs, None), order)
    answer = OrderResult(order.order_id, problem is None, problem or "")
    flight = replace(flight, answers=(*flight.answers, answer)[-_ANSWERS_KEPT:])
    return (order.kind if problem is None else None), flight


def _order_problem(t: _Tick, order: Order) -> str | None:
    """Why the order is refused; None if it is taken."""
    if order.boot_nonce != t.robot.boot_nonce:
        return "meant for another start of this robot's program"
    left_s = order.expires_at_uptime_s - t.inputs.uptime_s
    if not 0.0 <= left_s <= ORDER_LIFETIME_S:
        return "expired" if left_s < 0.0 else f"would be valid for {left_s:.0f} s: too long"
    state = t.flight.state
    if order.kind == "kill":
        return None
    source = {"takeoff": _S.PREFLIGHT, "start": _S.HOLD, "rejoin": _S.PILOT}[order.kind]
    if state is not source:
        return f"{order.kind} is taken in {source} only, the robot is in {state}: {t.flight.reason}"
    if not t.ground_heard:
        return "the ground's state is not heard"
    if t.calm != "none":
        return f"the ground commands {t.calm}"
    if order.kind == "takeoff":
        return _not_ready(t)
    return _not_in_place(t) or (_cannot_start(t) if order.kind == "start" else None)


def _not_ready(t: _Tick) -> str | None:
    failed = t.inputs.failed_checks
    if failed is None:
        return "not ready: the checks are still running"
    return f"not ready: {'; '.join(failed)}" if failed else None


def _not_in_place(t: _Tick) -> str | None:
    """Why the mission cannot be flown from here."""
    odometry, height = t.inputs.odometry, t.height_m
    vehicle = t.inputs.vehicle
    if odometry is None or height is None:
        return "position or height is not known"
    if not (vehicle.armed and vehicle.in_air):
        return "the vehicle is not in the air"
    slot_height_m = t.robot.parameters.slot_height_m
    if abs(height - slot_height_m) > _AT_SLOT_M:
        return f"at {height:.1f} m; its height is {slot_height_m:g} m (within {_AT_SLOT_M:g} m)"
    x_m, y_m, _ = odometry.position_m
    if t.robot.fence.distance_m(x_m, y_m) <= 0.0:
        return f"outside the fence, at ({x_m:.1f}, {y_m:.1f}) m"
    return None


def _cannot_start(t: _Tick) -> str | None:
    if not t.flight.mode_seen:
        return "the autopilot is not in offboard yet"
    if t.inputs.policy_velocity_m_s is None:
        return "the policy has no fresh answer"
    if t.inputs.busy_neighbours:
        busy = ", ".join(map(str, t.inputs.busy_neighbours))
        return f"robots still taking off: {busy}"
    return _too_close(t)


def _alarms(t: _Tick) -> tuple[str, ...]:
    """What the operator must see, the gravest first."""
    state = t.flight.state
    alarms = []
    if state in (_S.FAULT, _S.PILOT):
        alarms.append(t.flight.reason)
    if state in _AIRBORNE:
        checks = (_position_lost, _too_close, _battery_low, _ground_lost)
        alarms += [text for check in checks if (text := check(t)) is not None]
        if state in (_S.HOLD, _S.LAND) and not t.flight.reason.startswith(
            ("ground commands", "at ")
        ):
            alarms.append(t.flight.reason)
    return tuple(dict.fromkeys(alarms))
