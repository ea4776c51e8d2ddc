"""The flight state machine: which state a robot is in, and what it asks of its autopilot then.

`TRANSITIONS` is the machine, gravest first: in every tick the first row that applies is taken.
docs/safety.md shows the same table to people. Nothing here has a clock or talks to a vehicle.

Heights are above the robot's own takeoff point, which is latched when it is armed (`datum_m`): the
estimator's zero is not the pad.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

from edge.core import F64
from edge.core.fence import Fence
from edge.core.mailbox import Neighbour
from edge.core.ports import Odometry
from edge.core.position import PositionJudgement, PositionQuality
from edge.core.vehicle import PILOTED, Action, Mode, Vector, VehicleState
from edge.flight.energy import Energy
from edge.flight.margins import ErrorBudget
from edge.flight.safety import Closest, MotionLimits
from edge.messages.mission import (
    AIRBORNE,
    AT_SLOT_M,
    MAX_SLOT,
    ON_GROUND,
    ORDER_LIFETIME_S,
    STEERED,
    FlightState,
    GroundState,
    Order,
    OrderKind,
    OrderResult,
    Place,
    SafetyAction,
)

_S = FlightState

# PX4 wants a setpoint stream before offboard, and earlier commands are carried out meanwhile.
_STREAM_S = 0.5
_ASK_AGAIN_S = 1.0
_ARMING_TIMEOUT_S = 6.0
_OFFBOARD_TIMEOUT_S = 4.0
# One message of silence is no loss: PX4 tells twice a second.
_REMOTE_CONTROL_LOST_S = 1.0
# What was true before a lapse or a command is told no later: PX4 tells its mode at 1 Hz.
_STALE_TELEMETRY_S = 2.0
_LAPSE_SHARE = 0.9
_AT_HEIGHT_M = 0.5
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
    base_height_m: float = 5.0
    slot_spacing_m: float = 4.5
    min_separation_m: float = 1.5
    battery_low: float = 0.25
    battery_critical: float = 0.15
    command_timeout_s: float = 0.5
    ground_timeout_s: float = 3.0
    ground_lost_land_s: float = 10.0
    takeoff_timeout_s: float = 15.0
    hover_land_s: float = 60.0

    def __post_init__(self) -> None:
        if not 0 <= self.slot <= MAX_SLOT:
            raise ValueError(f"slot = {self.slot}: must be from 0 to {MAX_SLOT}")
        if len(self.landing_point_m) != 2 or not all(map(math.isfinite, self.landing_point_m)):
            raise ValueError(f"landing_point_m = {list(self.landing_point_m)}: must be [x, y]")
        for name in (
            "base_height_m", "slot_spacing_m", "min_separation_m", "command_timeout_s",
            "ground_timeout_s", "ground_lost_land_s", "takeoff_timeout_s", "hover_land_s",
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
class FlightMemory:
    """What the machine remembers from tick to tick.

    `target_m` is what TAKEOFF and HOLD keep: x and y of the mission frame, and a height.
    `reached`: since the state was entered the vehicle was seen as the state needs it: in offboard,
    in LAND landing, in FAULT disarmed. `alarming`: the operator must see `reason`.
    After a lapse of the control loop nothing is sent before `silent_until_s`, which stays set until
    the vehicle is in offboard again. `failsafe_at_s` is when the autopilot's own failsafe was last
    seen to act, `remote_control_at_s` when the remote control was last heard. `alone_since_s` is
    set while the vehicle hovers for no reason that anybody gave: since when nobody has answered.
    `armed_by` is whose takeoff order this program armed it by, `disarmed_at_s` when the vehicle was
    last known to be disarmed.
    `obeyed_expiry_s` is the last obeyed order's, `trial` the mission that was started last.
    """

    state: FlightState = FlightState.INIT
    reason: str = "program started"
    alarming: bool = False
    since_s: float = 0.0
    tick_at_s: float = -math.inf
    datum_m: float | None = None
    target_m: Vector | None = None
    reached: bool = False
    silent_until_s: float = -math.inf
    failsafe_at_s: float = -math.inf
    remote_control_at_s: float = -math.inf
    alone_since_s: float | None = None
    rejoined_at_s: float = -math.inf
    asked_at_s: float = -math.inf
    armed_asked: bool = False
    armed_by: str = ""
    disarmed_at_s: float = -math.inf
    landed_since_s: float | None = None
    land_by: Literal["ground", "return", "safety"] = "safety"
    killed: bool = False
    trial: str = ""
    obeyed_expiry_s: float = -math.inf
    answers: tuple[OrderResult, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class FlightInputs:
    """What one control tick knows.

    `position` is what the position is worth. `odometry` is in the mission frame, its z the altitude
    above sea level, less what that jumped in flight; None when the position is lost or old, or
    there is no mission origin. `policy_velocity_m_s` (2,) is None when the policy has no fresh
    answer. `closest` is the nearest neighbour. `busy_neighbours` say of themselves that they arm or
    take off. `failed_checks` are preflight's; None before the first. `not_taken` is what of the
    ground's state the robot does not fly by, in words. `order` is new in this tick. `energy` is
    None when the battery is not known.
    """

    now_s: float
    vehicle: VehicleState
    position: PositionJudgement
    odometry: Odometry | None
    policy_velocity_m_s: F64 | None
    neighbours: tuple[Neighbour, ...]
    closest: Closest | None
    busy_neighbours: tuple[int, ...]
    ground: GroundState | None
    ground_age_s: float
    failed_checks: tuple[str, ...] | None
    not_taken: tuple[str, ...]
    order: Order | None
    uptime_s: float
    energy: Energy | None


RemoteControlLost = Literal["alarm", "hold", "land"]


@dataclass(frozen=True, slots=True)
class Robot:
    """Who flies: what does not change during a flight.

    `on_remote_control_lost`: what a lost remote control does in flight; None if there is none.

    Raises ValueError if the fence leaves no way to the robot's height or to its landing point, or
    less room for errors than the budget asks for.
    """

    robot_id: int
    boot_nonce: int
    parameters: FlightParameters
    fence: Fence
    limits: MotionLimits
    on_remote_control_lost: RemoteControlLost | None = None
    errors: ErrorBudget = field(default_factory=ErrorBudget)

    def __post_init__(self) -> None:
        fence, height_m = self.fence, self.parameters.slot_height_m
        if not fence.floor_m <= height_m <= fence.ceiling_m:
            raise ValueError(
                f"slot = {self.parameters.slot} flies at {height_m:g} m: must be from floor_m = "
                f"{fence.floor_m:g} to ceiling_m = {fence.ceiling_m:g}; raise ceiling_m, or take "
                "fewer slots"
            )
        x_m, y_m = self.parameters.landing_point_m
        if not fence.distance_m(x_m, y_m) >= fence.buffer_m:
            raise ValueError(
                f"landing_point_m = {[x_m, y_m]}: must be inside the fence, at least buffer_m = "
                f"{fence.buffer_m:g} from its line"
            )
        lowest = self.errors.lowest_height
        if not lowest.holds(height_m):
            raise ValueError(f"slot = {self.parameters.slot} flies at {height_m:g} m: {lowest}")
        buffer = self.errors.fence_buffer(self.limits, self.parameters.command_timeout_s)
        if not buffer.holds(fence.buffer_m):
            raise ValueError(f"buffer_m = {fence.buffer_m:g}: {buffer}")

    @property
    def place(self) -> Place:
        """Its place in the flight."""
        return Place(self.parameters.slot, self.parameters.landing_point_m)

    def told(self, ground: GroundState) -> tuple[Fence, Place]:
        """Fence and place that the ground gives it, or else its own."""
        fence = self.fence if ground.fence is None else ground.fence
        return fence, ground.places.get(str(self.robot_id), self.place)

    def assigned(self, ground: GroundState) -> "Robot":
        """The same with those. Raises ValueError, which the operator reads, if they do not fit."""
        fence, place = self.told(ground)
        try:
            parameters = replace(
                self.parameters, slot=place.slot, landing_point_m=place.landing_point_m
            )
            return replace(self, fence=fence, parameters=parameters)
        except ValueError as error:
            raise ValueError(f"the ground's fence or place does not fit: {error}") from None


class Decision(NamedTuple):
    """A tick's outcome; `new_trial`: the explored map and the mailbox are to be forgotten.

    `taken` is the row of `TRANSITIONS` that led to the state, None if it stays.
    """

    flight: FlightMemory
    actions: tuple[Action, ...]
    alarms: tuple[str, ...]
    new_trial: bool
    taken: "Transition | None"


@dataclass(frozen=True, slots=True, eq=False)
class _Tick:
    """Memory and inputs together, as the rows of the table ask them."""

    robot: Robot
    flight: FlightMemory
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
    def silent(self) -> bool:
        return is_silent(self.flight, self.inputs.now_s)

    @property
    def safety_action(self) -> SafetyAction:
        ground = self.inputs.ground
        if ground is None or not self.ground_heard:
            return "none"
        asked = ground.safety_action_for(self.robot.robot_id)
        enabled = ground.enabled_for(self.robot.robot_id)
        return "hold" if asked == "none" and not enabled else asked

    @property
    def ground_heard(self) -> bool:
        return self.inputs.ground_age_s <= self.robot.parameters.ground_timeout_s

    @property
    def height_m(self) -> float | None:
        return height_m(self.flight, self.inputs.odometry)

    @property
    def knows_place(self) -> bool:
        """Whether the position is good to fly by."""
        return self.inputs.position.quality is PositionQuality.GOOD

    @property
    def lapse_s(self) -> float:
        """How long the control loop was silent; 0 if it was not, or has just begun."""
        silence_s = self.inputs.now_s - self.flight.tick_at_s
        return silence_s if exceeds_silence(self.robot, silence_s) else 0.0

    @property
    def acts_from_s(self) -> float:
        """From when on the state's setpoints and commands are sent."""
        return max(self.flight.since_s, self.flight.silent_until_s)

    @property
    def could_follow_s(self) -> float:
        """For how long the autopilot has been able to go to offboard."""
        return self.inputs.now_s - max(self.acts_from_s, self.flight.failsafe_at_s)

    @property
    def overdue(self) -> bool:
        """Whether the autopilot had its time to go to offboard."""
        return self.could_follow_s > _OFFBOARD_TIMEOUT_S

    @property
    def failsafe_acts(self) -> bool:
        return failsafe_acts(self.inputs.vehicle)


def height_m(flight: FlightMemory, odometry: Odometry | None) -> float | None:
    """Height above the robot's own takeoff point, m; None when unknown."""
    if odometry is None or flight.datum_m is None:
        return None
    return odometry.position_m[2] - flight.datum_m


def flown_s(flight: FlightMemory, vehicle: VehicleState, now_s: float) -> float | None:
    """How long ago the vehicle was armed, s; None if it is not, or was so before this program."""
    since_s = now_s - flight.disarmed_at_s
    return since_s if vehicle.armed and math.isfinite(since_s) else None


def failsafe_acts(vehicle: VehicleState) -> bool:
    """Whether the autopilot's own failsafe has the vehicle: who asks for another mode ends it.

    PX4 v1.14 calls a warning a failsafe, too: then it still does what it is told in offboard.
    """
    return vehicle.failsafe is True and vehicle.mode not in (Mode.OFFBOARD, *PILOTED)


@dataclass(frozen=True, slots=True)
class Transition:
    """One row: from any of `sources` to `target` when `why` gives a reason; `when` is for people.

    `alarm`: the operator must see the reason for as long as the target lasts.
    """

    sources: tuple[FlightState, ...]
    target: FlightState
    when: str
    why: Callable[[_Tick], str | None]
    actions: tuple[Action, ...] = ()
    land_by: Literal["ground", "return", "safety"] = "safety"
    alarm: bool = False


def _if(condition: bool, reason: str) -> str | None:
    return reason if condition else None


def _killed(t: _Tick) -> str | None:
    return _if(t.accepted == "kill", "killed by the operator")


def _disarmed(t: _Tick) -> str | None:
    return _if(t.inputs.vehicle.armed is False, "disarmed")


def _link_lost(t: _Tick) -> str | None:
    lost = not t.inputs.vehicle.connected and not t.silent
    return _if(lost, "the autopilot does not answer")


def _disarmed_again(t: _Tick) -> str | None:
    return _disarmed(t) if t.heard_since_entry and not t.flight.killed else None


def _armed_by_others(t: _Tick) -> str | None:
    if not t.inputs.vehicle.armed or t.flight.armed_asked:
        return None
    if t.flight.armed_by and t.flight.state is not _S.ARMING:
        whose = f"armed by this program, on {t.flight.armed_by}'s takeoff order"
    elif t.flight.state is _S.INIT:
        whose = "the vehicle was already armed when this program found it"
    else:
        return "the vehicle is armed, without an order: only observing"
    return f"{whose}: only observing; rejoin it, or a pilot lands it"


def _armed_again(t: _Tick) -> str | None:
    answers = t.inputs.vehicle.connected and t.heard_since_entry and not t.flight.killed
    return _armed_by_others(t) if answers else None


def _pilot(t: _Tick) -> str | None:
    # Right after a rejoin, the pilot's mode is the one that the operator wants to end.
    ending = not t.flight.reached and (
        t.inputs.now_s - t.flight.rejoined_at_s <= _OFFBOARD_TIMEOUT_S
    )
    return _if(t.mode in PILOTED and not ending, f"a pilot flies it ({t.mode})")


def _left_offboard(t: _Tick) -> str | None:
    left = t.flight.reached and t.mode not in (Mode.OFFBOARD, Mode.LAND)
    return _if(left and not t.failsafe_acts, f"the vehicle left offboard for {t.mode}")


def _left_land(t: _Tick) -> str | None:
    return _if(t.flight.reached and t.mode is not Mode.LAND, f"the vehicle left land for {t.mode}")


def _failsafe(t: _Tick) -> str | None:
    return _if(t.failsafe_acts, f"the autopilot's own failsafe acts: {t.mode}")


def _failsafe_takes(t: _Tick) -> str | None:
    known = t.flight.reached or t.heard_since_entry
    return _failsafe(t) if known and t.mode is not Mode.LAND else None


def _lapse(t: _Tick) -> str | None:
    return _if(t.lapse_s > 0.0, f"control was silent for {t.lapse_s:.1f} s")


def _autopilot_lands(t: _Tick) -> str | None:
    # Else it lands because it was told to, before this state.
    lapsed = t.flight.silent_until_s > -math.inf and not t.silent
    by_itself = t.flight.reached or t.overdue or lapsed or t.failsafe_acts
    return _if(t.mode is Mode.LAND and by_itself, "the autopilot lands by itself")


def _offboard_refused(t: _Tick) -> str | None:
    refused = t.overdue and not t.flight.reached
    return _if(refused, f"offboard refused{_refusal(t, Action.OFFBOARD)}")


def _position_lost(t: _Tick) -> str | None:
    position = t.inputs.position
    lost = position.quality is PositionQuality.LOST and not t.silent
    return _if(lost, f"position lost: {position.text}")


def _position_not_good(t: _Tick) -> str | None:
    position = t.inputs.position
    return _if(not t.knows_place, f"position {position.quality}: {position.text}")


def _on_ground(t: _Tick) -> str | None:
    # Nothing that the ground repeats may lift a vehicle off.
    return _if(t.inputs.vehicle.in_air is False and not t.silent, "it stands on the ground")


def _battery_critical(t: _Tick) -> str | None:
    return _battery_below(t, t.robot.parameters.battery_critical, "critical")


def _battery_low(t: _Tick) -> str | None:
    energy = t.inputs.energy
    below = _battery_below(t, t.robot.parameters.battery_low, "low")
    return below or (None if energy is None else energy.shortage())


def _battery_below(t: _Tick, share: float, word: str) -> str | None:
    battery = t.inputs.vehicle.battery
    return None if battery is None or battery > share else f"battery {word}: {battery:.0%}"


def _battery_not_known(t: _Tick) -> str | None:
    unknown = t.inputs.vehicle.battery is None and not t.silent
    return _if(unknown, "battery is not known")


def _ground_lands(t: _Tick) -> str | None:
    return _if(t.safety_action == "land", "ground commands land")


def _ground_ends_takeoff(t: _Tick) -> str | None:
    return _if(
        t.safety_action in ("land", "return"), f"ground commands {t.safety_action} during takeoff"
    )


def _ground_holds(t: _Tick) -> str | None:
    return _if(t.safety_action == "hold", "ground commands hold")


def _ground_holds_landing(t: _Tick) -> str | None:
    emergency = t.flight.land_by == "safety" or t.failsafe_acts
    return None if emergency else _ground_holds(t)


def _ground_returns(t: _Tick) -> str | None:
    return _if(t.safety_action == "return" and not t.failsafe_acts, "ground commands return")


def _ground_returns_landing(t: _Tick) -> str | None:
    return _ground_returns(t) if t.flight.land_by == "ground" else None


def _too_close(t: _Tick) -> str | None:
    closest, limit_m = t.inputs.closest, t.robot.parameters.min_separation_m
    if closest is None or closest.distance_m >= limit_m:
        return None
    return f"only {closest.distance_m:.1f} m to robot {closest.robot_id}"


def _outside(t: _Tick) -> str | None:
    odometry = t.inputs.odometry
    outside = odometry and t.robot.fence.distance_m(*odometry.position_m[:2]) < 0.0
    return _if(bool(outside), "outside the fence")


def _remote_control_lost(t: _Tick) -> str | None:
    if t.robot.on_remote_control_lost is None or t.inputs.vehicle.remote_control or t.silent:
        return None
    # A program that was started in flight has not heard it yet.
    heard_at_s = t.flight.remote_control_at_s
    lost_s = t.inputs.now_s - (heard_at_s if heard_at_s > -math.inf else t.flight.since_s)
    return _if(lost_s > _REMOTE_CONTROL_LOST_S, "remote control lost")


def _holds_without_remote_control(t: _Tick) -> str | None:
    return _remote_control_lost(t) if t.robot.on_remote_control_lost == "hold" else None


def _lands_without_remote_control(t: _Tick) -> str | None:
    return _remote_control_lost(t) if t.robot.on_remote_control_lost == "land" else None


def _ground_lost(t: _Tick) -> str | None:
    return _if(not t.ground_heard, "ground lost")


def _ground_long_lost(t: _Tick) -> str | None:
    parameters = t.robot.parameters
    limit_s = parameters.ground_timeout_s + parameters.ground_lost_land_s
    lost = t.inputs.ground_age_s > limit_s and not t.silent
    return _if(lost, f"ground lost for {limit_s:g} s")


def _battery_low_in_hold(t: _Tick) -> str | None:
    free = t.safety_action == "none" and t.ground_heard and not t.failsafe_acts
    return _battery_low(t) if free else None


def _left_alone(t: _Tick) -> str | None:
    since_s, limit_s = t.flight.alone_since_s, t.robot.parameters.hover_land_s
    if since_s is None or t.silent or t.inputs.vehicle.in_air is not True:
        return None
    return _if(t.inputs.now_s - since_s > limit_s, f"nobody answered for {limit_s:g} s")


def _hovers_alone(t: _Tick) -> str | None:
    limit_s = t.robot.parameters.hover_land_s
    text = f"hovers, and lands {limit_s:g} s after it began to, if nobody orders or holds it"
    return _if(t.flight.alone_since_s is not None, text)


def _policy_stale(t: _Tick) -> str | None:
    return _if(t.inputs.policy_velocity_m_s is None, "the policy has no fresh answer")


def _found(t: _Tick) -> str | None:
    vehicle = t.inputs.vehicle
    found = vehicle.connected and vehicle.armed is False and t.knows_place
    return _if(found, "autopilot and position found")


def _enabled(t: _Tick) -> str | None:
    ground = t.inputs.ground
    if ground is None or ground.origin is None or not t.ground_heard:
        return None
    return _if(ground.enabled_for(t.robot.robot_id), "enabled")


def _enabled_at_rest(t: _Tick) -> str | None:
    # Until then the operator sees why arming failed, and telemetry that the vehicle is disarmed.
    return _enabled(t) if t.age_s > _STALE_TELEMETRY_S else None


def _not_enabled(t: _Tick) -> str | None:
    return _if(_enabled(t) is None, "not enabled" if t.ground_heard else "ground lost")


def _may_fly_again(t: _Tick) -> str | None:
    return _enabled(t) if t.safety_action == "none" else None


def _takeoff(t: _Tick) -> str | None:
    return _if(t.accepted == "takeoff", "takeoff ordered")


def _arming_called_off(t: _Tick) -> str | None:
    if not t.ground_heard:
        return "ground lost while arming"
    if t.safety_action != "none":
        return f"ground commands {t.safety_action} while arming"
    if not t.knows_place and not t.silent:
        return f"{_position_not_good(t)}, while arming"
    left = t.flight.reached and t.mode is not Mode.OFFBOARD
    return _lapse(t) or _if(left, f"the vehicle left offboard for {t.mode} while arming")


def _arming_failed(t: _Tick) -> str | None:
    for action in (Action.OFFBOARD, Action.ARM):
        refusal = _refusal(t, action)
        if refusal:
            return f"{action} refused{refusal}"
    return _if(t.age_s > _ARMING_TIMEOUT_S, "the autopilot does not arm")


def _armed(t: _Tick) -> str | None:
    armed = t.flight.armed_asked and t.inputs.vehicle.armed is True
    return _if(armed and t.inputs.odometry is not None, "armed")


def _lift_off_failed(t: _Tick) -> str | None:
    height, parameters = t.height_m, t.robot.parameters
    climb_s = 2.0 * parameters.slot_height_m / t.robot.limits.max_climb_m_s
    lifted = t.inputs.vehicle.in_air and height is not None and height > _AT_HEIGHT_M
    limit_s = parameters.takeoff_timeout_s + (climb_s if lifted else 0.0)
    return _if(t.age_s > limit_s, "takeoff failed: not climbing")


def _at_slot(t: _Tick) -> str | None:
    height = t.height_m
    wanted_m = t.robot.parameters.slot_height_m
    there = height is not None and height > wanted_m - _AT_HEIGHT_M
    return _if(there and t.inputs.vehicle.in_air is True, f"at its height, {wanted_m:g} m")


def _start(t: _Tick) -> str | None:
    return _if(t.accepted == "start", "mission started")


def _given_away(t: _Tick) -> str | None:
    return _if(t.accepted == "pilot", "given to a pilot")


def _disarm(t: _Tick) -> str | None:
    return _if(t.accepted == "disarm", "disarm ordered")


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
    Transition(tuple(_S), _S.FAULT, "the operator orders kill", _killed, alarm=True),
    Transition((_S.ARMING, *AIRBORNE, _S.PILOT), _S.PILOT,
               "the operator orders disarm, on the ground", _disarm, (Action.DISARM,)),
    # What the vehicle does, whoever made it.
    Transition((*AIRBORNE, _S.PILOT), _S.LANDED, "the vehicle is disarmed", _disarmed),
    Transition((_S.FAULT,), _S.INIT, "the vehicle is disarmed, and was not killed",
               _disarmed_again),
    Transition((*AIRBORNE, _S.PILOT), _S.FAULT, "the autopilot does not answer", _link_lost,
               alarm=True),
    Transition((_S.IDLE, _S.PREFLIGHT, _S.LANDED), _S.INIT, "the autopilot does not answer",
               _link_lost),
    Transition((_S.ARMING,), _S.INIT, "the autopilot does not answer", _link_lost,
               (Action.DISARM,)),
    Transition((*ON_GROUND, _S.ARMING), _S.PILOT, "the vehicle is armed, not by this program",
               _armed_by_others, alarm=True),
    Transition((_S.FAULT,), _S.PILOT, "the autopilot answers again, armed, and was not killed",
               _armed_again, alarm=True),
    # A pilot, and the autopilot's own failsafe.
    Transition(AIRBORNE, _S.PILOT, "a pilot's mode is on", _pilot, alarm=True),
    Transition(STEERED, _S.HOLD, "the control loop was silent", _lapse, alarm=True),
    Transition((_S.TAKEOFF, _S.MISSION, _S.RETURN), _S.HOLD,
               "the autopilot's own failsafe holds or moves the vehicle", _failsafe_takes,
               alarm=True),
    Transition(STEERED, _S.PILOT, "the vehicle left offboard", _left_offboard, alarm=True),
    Transition((_S.LAND,), _S.PILOT, "the vehicle left land", _left_land, alarm=True),
    Transition(STEERED, _S.LAND, "the autopilot lands by itself", _autopilot_lands, alarm=True),
    Transition((_S.HOLD, _S.RETURN), _S.PILOT, "offboard is refused", _offboard_refused,
               alarm=True),
    # What cannot wait for anybody.
    Transition(STEERED, _S.LAND, "the position is lost", _position_lost, alarm=True),
    Transition(STEERED, _S.LAND, "the battery is critical", _battery_critical, alarm=True),
    Transition((_S.HOLD, _S.MISSION, _S.RETURN), _S.LAND, "it stands on the ground", _on_ground,
               alarm=True),
    # The operator gives it away.
    Transition((_S.HOLD, _S.MISSION, _S.RETURN), _S.PILOT, "the operator orders pilot",
               _given_away, (Action.HOLD,), alarm=True),
    # The ground holds, returns or lands it.
    Transition((_S.ARMING,), _S.IDLE, "the ground commands hold, land or return, or is lost; the "
               "control loop was silent; the vehicle left offboard",
               _arming_called_off, (Action.DISARM,), alarm=True),
    Transition((_S.TAKEOFF,), _S.LAND, "the ground commands land or return",
               _ground_ends_takeoff, land_by="return"),
    Transition((_S.HOLD, _S.MISSION, _S.RETURN), _S.LAND, "the ground commands land",
               _ground_lands, land_by="ground"),
    Transition((_S.TAKEOFF, _S.MISSION, _S.RETURN), _S.HOLD, "the ground commands hold",
               _ground_holds),
    Transition((_S.LAND,), _S.HOLD, "the ground commands hold, and landing was no emergency",
               _ground_holds_landing),
    Transition((_S.HOLD, _S.MISSION), _S.RETURN, "the ground commands return", _ground_returns),
    Transition((_S.LAND,), _S.RETURN, "the ground commands return, and had commanded land",
               _ground_returns_landing),
    # What the robot notices by itself.
    Transition((_S.MISSION,), _S.HOLD, "a neighbour is too close", _too_close, alarm=True),
    Transition((_S.TAKEOFF, _S.MISSION), _S.HOLD,
               "the remote control is lost, and rc_lost = hold", _holds_without_remote_control,
               alarm=True),
    Transition((_S.TAKEOFF, _S.HOLD, _S.MISSION), _S.LAND,
               "the remote control is lost, and rc_lost = land", _lands_without_remote_control,
               alarm=True),
    Transition((_S.MISSION, _S.RETURN), _S.HOLD, "the ground is lost", _ground_lost, alarm=True),
    Transition((_S.TAKEOFF, _S.HOLD), _S.LAND, "the ground stays lost", _ground_long_lost,
               alarm=True),
    Transition((_S.HOLD, _S.PILOT), _S.LAND,
               "it hovers for no reason that anybody gave, and nobody answers", _left_alone,
               alarm=True),
    Transition((_S.MISSION,), _S.RETURN, "the battery is low, or just lasts for the way home",
               _battery_low, alarm=True),
    Transition((_S.HOLD,), _S.RETURN,
               "the same, and the ground commands nothing",
               _battery_low_in_hold, alarm=True),
    Transition((_S.MISSION,), _S.HOLD, "the policy has no fresh answer", _policy_stale,
               alarm=True),
    # The way of a flight.
    Transition((_S.INIT,), _S.IDLE, "autopilot, position and estimator origin are known", _found),
    Transition((_S.IDLE,), _S.PREFLIGHT, "the ground enables and has set an origin, after 2 s",
               _enabled_at_rest),
    Transition((_S.PREFLIGHT,), _S.IDLE, "the ground does not enable, or is lost", _not_enabled),
    Transition((_S.PREFLIGHT,), _S.ARMING, "the operator orders takeoff, and the robot is ready",
               _takeoff),
    Transition((_S.ARMING,), _S.TAKEOFF, "the vehicle is armed", _armed),
    Transition((_S.ARMING,), _S.IDLE, "offboard or arming is refused, or takes too long",
               _arming_failed, (Action.DISARM,), alarm=True),
    Transition((_S.TAKEOFF,), _S.HOLD, "at its height, and the autopilot says in the air",
               _at_slot),
    Transition((_S.TAKEOFF,), _S.LAND, "it does not climb", _lift_off_failed, alarm=True),
    Transition((_S.HOLD,), _S.MISSION, "the operator orders start", _start),
    Transition((_S.RETURN,), _S.LAND, "at its landing point", _at_landing_point,
               land_by="return"),
    Transition((_S.PILOT,), _S.HOLD, "the operator orders rejoin", _rejoin),
    Transition((_S.LANDED,), _S.PREFLIGHT, "enabled, and the ground commands nothing",
               _may_fly_again),
)  # fmt: skip


def step(robot: Robot, flight: FlightMemory, inputs: FlightInputs) -> Decision:
    """One control tick: at most one transition, and what to ask of the autopilot now."""
    flight = _look(_Tick(robot, flight, inputs, None))
    order = _new_order(robot, flight, inputs)
    tick = _Tick(robot, flight, inputs, None)
    refusal = None if order is None else _order_problem(tick, order)
    obeyed = order if refusal is None else None
    row, reason = _first_row(replace(tick, accepted=None if obeyed is None else obeyed.kind))
    overruled = row is not None and row.why not in _BY_ORDER
    if obeyed is not None and obeyed.kind != "reset" and overruled:
        # Something graver came first.
        obeyed, refusal = None, reason
    actions: tuple[Action, ...] = ()
    if row is not None:
        flight, actions = _enter(row, reason, tick), row.actions
    if order is not None:
        flight = _answer(flight, order, refusal)
    if obeyed is not None and obeyed.kind == "takeoff":
        flight = replace(flight, armed_by=obeyed.operator)
    new_trial = False
    if obeyed is not None and obeyed.kind in ("start", "reset"):
        new_trial = obeyed.kind == "reset" or obeyed.trial != flight.trial
        flight = replace(flight, trial="" if obeyed.kind == "reset" else obeyed.trial)
    tick = _Tick(robot, flight, inputs, None)
    asked = _ask(tick)
    flight = replace(
        flight,
        tick_at_s=inputs.now_s,
        target_m=_target_m(tick),
        asked_at_s=inputs.now_s if asked else flight.asked_at_s,
        armed_asked=flight.armed_asked or Action.ARM in asked,
    )
    return Decision(flight, actions + asked, _alarms(tick), new_trial, row)


def exceeds_silence(robot: Robot, silence_s: float) -> bool:
    """Whether the control loop was silent for too long; not if it has just begun, with inf.

    A little before the watchdog counts, so that what it does is never taken for a pilot's.
    """
    return _LAPSE_SHARE * robot.parameters.command_timeout_s < silence_s < math.inf


def is_silent(flight: FlightMemory, now_s: float) -> bool:
    """Whether no setpoint may be sent yet, after a lapse."""
    return now_s < flight.silent_until_s


def _look(t: _Tick) -> FlightMemory:
    """The memory, with what this tick's inputs add to it, before any transition."""
    flight, inputs, now_s = t.flight, t.inputs, t.inputs.now_s
    vehicle = inputs.vehicle
    if t.lapse_s > 0.0:
        flight = replace(flight, silent_until_s=now_s + _STALE_TELEMETRY_S)
    if vehicle.heartbeat_at_s > t.acts_from_s + _STREAM_S and not is_silent(flight, now_s):
        flight = replace(flight, reached=flight.reached or _as_needed(flight.state, vehicle))
    if not is_silent(flight, now_s) and (flight.reached or flight.state not in STEERED):
        flight = replace(flight, silent_until_s=-math.inf)
    landed_since_s = now_s if flight.landed_since_s is None else flight.landed_since_s
    down = flight.state is _S.LAND and vehicle.in_air is False
    flight = replace(flight, landed_since_s=landed_since_s if down else None)
    if failsafe_acts(vehicle):
        flight = replace(flight, failsafe_at_s=now_s)
        if flight.state is _S.LAND and flight.reached and vehicle.mode is not Mode.LAND:
            # PX4 goes on landing by itself; if it does not, it is asked again.
            flight = replace(flight, reached=False, asked_at_s=now_s)
    if vehicle.connected and vehicle.armed is False:
        flight = replace(flight, disarmed_at_s=now_s)
        # What was on its way when arming was called off has arrived by then.
        looked = vehicle.heartbeat_at_s > flight.since_s + _STALE_TELEMETRY_S
        if flight.state in ON_GROUND and looked:
            flight = replace(flight, armed_by="")
    if vehicle.remote_control:
        flight = replace(flight, remote_control_at_s=now_s)
    flight = replace(flight, alone_since_s=_alone_since_s(t))
    if flight.state is _S.PILOT and flight.datum_m is None and t.age_s > _STALE_TELEMETRY_S:
        flight = replace(flight, datum_m=_home_m(inputs))
    return flight


def _alone_since_s(t: _Tick) -> float | None:
    flight, now_s, order = t.flight, t.inputs.now_s, t.inputs.order
    ordered = order is not None and order.robot_id == t.robot.robot_id
    taken = flight.state is _S.PILOT and t.mode is not Mode.HOLD
    if ordered or t.safety_action == "hold" or taken:
        return None
    begins = flight.state is _S.HOLD and t.failsafe_acts
    return now_s if begins and flight.alone_since_s is None else flight.alone_since_s


def _as_needed(state: FlightState, vehicle: VehicleState) -> bool:
    if state is _S.FAULT:
        return vehicle.armed is False
    return vehicle.mode is (Mode.LAND if state is _S.LAND else Mode.OFFBOARD)


def _first_row(tick: _Tick) -> tuple[Transition | None, str]:
    for row in TRANSITIONS:
        if tick.flight.state in row.sources:
            reason = row.why(tick)
            if reason is not None:
                return row, reason
    return None, ""


def _enter(row: Transition, reason: str, t: _Tick) -> FlightMemory:
    """The memory with which the row's target begins."""
    flight, now_s = t.flight, t.inputs.now_s
    from_offboard = flight.state in (_S.ARMING, *STEERED)
    stays_offboard = from_offboard and row.target in STEERED and row.why is not _lapse
    # Found in hold, or left there: nobody who has it is known.
    found = row.target is _S.PILOT and flight.state in (_S.INIT, _S.FAULT)
    left = (found or row.why is _offboard_refused) and t.mode is Mode.HOLD
    alone = left or row.why in (_lapse, _failsafe_takes)
    alone_since_s = now_s if flight.alone_since_s is None else flight.alone_since_s
    return replace(
        flight,
        state=row.target,
        reason=reason,
        alarming=row.alarm,
        since_s=now_s,
        datum_m=_datum_m(row.target, t),
        target_m=flight.target_m if row.why is _at_slot else None,
        reached=stays_offboard and flight.reached,
        rejoined_at_s=now_s if row.why is _rejoin else flight.rejoined_at_s,
        asked_at_s=-math.inf,
        armed_asked=False,
        armed_by=_armed_by(row.target, flight),
        alone_since_s=alone_since_s if alone else None,
        landed_since_s=None,
        land_by=row.land_by,
        killed=flight.killed or row.why is _killed,
    )


def _armed_by(target: FlightState, flight: FlightMemory) -> str:
    called_off = flight.state is _S.ARMING and not flight.armed_asked
    return "" if called_off or target in (_S.PREFLIGHT, _S.LANDED) else flight.armed_by


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


def _target_m(t: _Tick) -> Vector | None:
    """Above the takeoff point, or where the vehicle was when it could be told to stay there."""
    odometry, height, state = t.inputs.odometry, t.height_m, t.flight.state
    if state not in (_S.TAKEOFF, _S.HOLD):
        return None
    target_m = t.flight.target_m
    if odometry is None or height is None:
        return target_m
    # Nobody, or PX4's own failsafe, steered it meanwhile.
    led_away = t.silent or t.failsafe_acts
    if target_m is not None and t.knows_place and not led_away:
        return target_m
    fence = t.robot.fence
    # While the position is in doubt, numbers that were good before may be another place now.
    x_m, y_m = fence.moved_inside_m(*odometry.position_m[:2], fence.buffer_m / 2.0)
    if state is _S.TAKEOFF:
        return x_m, y_m, t.robot.parameters.slot_height_m
    return x_m, y_m, height if target_m is None or led_away else target_m[2]


def _ask(t: _Tick) -> tuple[Action, ...]:
    """What the state needs from the autopilot, asked again until it is so; ARM is asked once."""
    flight, now_s = t.flight, t.inputs.now_s
    streamed = t.could_follow_s >= _STREAM_S
    if flight.state is _S.LAND:
        since_s = flight.landed_since_s
        if since_s is not None and now_s - since_s > _LANDED_DISARM_S:
            return _again(t, Action.DISARM)
        asked_lately = now_s - flight.asked_at_s < t.robot.parameters.hover_land_s
        if flight.reached or (t.failsafe_acts and (t.mode is Mode.LAND or asked_lately)):
            return ()
        return _again(t, Action.LAND)
    if flight.state is _S.FAULT:
        return _again(t, Action.KILL) if flight.killed and not flight.reached else ()
    if flight.state is _S.ARMING and flight.reached:
        return () if flight.armed_asked else (Action.ARM,)
    if flight.state in ON_GROUND and t.inputs.vehicle.armed is False:
        # Where a flight leaves PX4, it would not arm again.
        stuck = t.heard_since_entry and t.mode in (Mode.OFFBOARD, Mode.LAND, Mode.RETURN)
        return _again(t, Action.HOLD) if stuck else ()
    if t.silent and flight.state in STEERED:
        # Without setpoints it would land. Before a look, a pilot may have it.
        flies_on = t.mode is Mode.OFFBOARD and t.heard_since_entry
        return _again(t, Action.HOLD) if flies_on else ()
    if flight.state in (_S.ARMING, *STEERED) and streamed and not flight.reached:
        return _again(t, Action.OFFBOARD)
    return ()


def _again(t: _Tick, action: Action) -> tuple[Action, ...]:
    asked_at_s = t.flight.asked_at_s
    if t.inputs.now_s - asked_at_s < _ASK_AGAIN_S:
        return ()
    # A mode is asked for again only after a look: a pilot may have taken the vehicle in between.
    looked = t.inputs.vehicle.heartbeat_at_s > asked_at_s + _STREAM_S
    return (action,) if looked or action in (Action.DISARM, Action.KILL) else ()


_BY_ORDER = (_killed, _disarm, _given_away, _takeoff, _start, _rejoin)
# Where each order is taken; PILOT among pilot's, since there it is so already.
_TAKEN_IN: dict[OrderKind, tuple[FlightState, ...]] = {
    "takeoff": (_S.PREFLIGHT,),
    "start": (_S.HOLD,),
    "pilot": (_S.HOLD, _S.MISSION, _S.RETURN, _S.PILOT),
    "rejoin": (_S.PILOT,),
    "reset": tuple(s for s in _S if s not in (_S.ARMING, _S.TAKEOFF, _S.MISSION)),
    "disarm": (_S.ARMING, *AIRBORNE, _S.PILOT),
}


def _new_order(robot: Robot, flight: FlightMemory, inputs: FlightInputs) -> Order | None:
    """The order, unless it is another robot's, or was answered before."""
    order = inputs.order
    if order is None or order.robot_id != robot.robot_id:
        return None
    return None if any(a.order_id == order.order_id for a in flight.answers) else order


def _answer(flight: FlightMemory, order: Order, refusal: str | None) -> FlightMemory:
    answer = OrderResult(order.order_id, refusal is None, refusal or "")
    expiry_s = flight.obeyed_expiry_s
    if refusal is None:
        expiry_s = max(expiry_s, order.expires_at_uptime_s)
    answers = (*flight.answers, answer)[-_ANSWERS_KEPT:]
    return replace(flight, answers=answers, obeyed_expiry_s=expiry_s)


def _order_problem(t: _Tick, order: Order) -> str | None:
    """Why the order is refused; None if it is taken."""
    if order.boot_nonce != t.robot.boot_nonce:
        return "meant for another start of this robot's program"
    left_s = order.expires_at_uptime_s - t.inputs.uptime_s
    if not 0.0 <= left_s <= ORDER_LIFETIME_S:
        return "expired" if left_s < 0.0 else f"would be valid for {left_s:.0f} s: too long"
    if order.kind == "kill":
        return None
    ground = t.inputs.ground
    if ground is not None and order.operator != ground.operator:
        return f"{ground.operator} commands, not {order.operator}"
    if order.kind == "disarm" and (problem := _cannot_disarm(t)):
        return problem
    state, sources = t.flight.state, _TAKEN_IN[order.kind]
    if state not in sources:
        alone = f"taken in {sources[0]} only, the robot is" if len(sources) == 1 else "not taken"
        return f"{order.kind} is {alone} in {state}: {t.flight.reason}"
    if order.expires_at_uptime_s <= t.flight.obeyed_expiry_s:
        return "older than an order that was obeyed"
    if t.silent:
        return "the control loop was silent just before"
    if not t.ground_heard:
        return "the ground's state is not heard"
    if order.kind in ("pilot", "reset", "disarm"):
        return None
    if t.safety_action != "none":
        return f"the ground commands {t.safety_action}"
    if order.kind == "takeoff":
        return _not_ready(t)
    return _not_in_place(t) or (_cannot_start(t) if order.kind == "start" else None)


def _cannot_disarm(t: _Tick) -> str | None:
    vehicle = t.inputs.vehicle
    arming = t.flight.state is _S.ARMING  # It may be armed before that is heard.
    if vehicle.armed is False and not arming:
        return "is not armed"
    if vehicle.in_air:
        return "in the air: land it first"
    known = arming or (vehicle.armed and vehicle.in_air is False)
    return None if known else "not known to be armed, and on the ground"


def _not_ready(t: _Tick) -> str | None:
    failed = t.inputs.failed_checks
    if failed is None:
        return "not ready: the checks are still running"
    return f"not ready: {'; '.join(failed)}" if failed else None


def _not_in_place(t: _Tick) -> str | None:
    """Why the mission cannot be flown from here."""
    odometry, height = t.inputs.odometry, t.height_m
    vehicle = t.inputs.vehicle
    if not t.knows_place:
        return _position_not_good(t)
    if odometry is None or height is None:
        return "position or height is not known"
    if not (vehicle.armed and vehicle.in_air):
        return "the vehicle is not in the air"
    if t.failsafe_acts:
        return _failsafe(t)
    slot_height_m = t.robot.parameters.slot_height_m
    if abs(height - slot_height_m) > AT_SLOT_M:
        return f"at {height:.1f} m; its height is {slot_height_m:g} m (within {AT_SLOT_M:g} m)"
    x_m, y_m, _ = odometry.position_m
    if t.robot.fence.distance_m(x_m, y_m) <= 0.0:
        return f"outside the fence, at ({x_m:.1f}, {y_m:.1f}) m"
    return None


def _cannot_start(t: _Tick) -> str | None:
    if not t.flight.reached:
        return "the autopilot is not in offboard yet"
    if t.inputs.policy_velocity_m_s is None:
        return "the policy has no fresh answer"
    if t.inputs.not_taken:
        return "; ".join(t.inputs.not_taken)
    if t.robot.on_remote_control_lost in ("hold", "land") and (lost := _remote_control_lost(t)):
        return lost
    if t.inputs.busy_neighbours:
        busy = ", ".join(map(str, t.inputs.busy_neighbours))
        return f"robots still taking off: {busy}"
    return _too_close(t)


def _alarms(t: _Tick) -> tuple[str, ...]:
    """What the operator must see, the gravest first."""
    alarms = [t.flight.reason] if t.flight.alarming else []
    if t.flight.state in (*AIRBORNE, _S.PILOT):
        checks = (
            _failsafe, _hovers_alone, _remote_control_lost, _position_not_good, _too_close,
            _outside, _battery_low, _battery_not_known, _ground_lost,
        )  # fmt: skip
        alarms += [text for check in checks if (text := check(t)) is not None]
        alarms += [f"PX4: {warning.text}" for warning in t.inputs.vehicle.warnings]
    return tuple(dict.fromkeys(alarms))
