"""Flight state machine of one robot: parameters, memory, and a tick's inputs.

`Tick` combines them, with derived values; transitions, orders and alarms use nothing else. No clock
or vehicle is used.

Heights are above the robot's own takeoff point, latched at arming (`datum_m`): the estimator's zero
is not the pad.
"""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Literal, NamedTuple

from msgspec import Meta, Struct

from edge.core import F64
from edge.core.fence import Fence
from edge.core.ports import Odometry
from edge.core.position import PositionJudgement, PositionQuality
from edge.core.schema import Bounded, PointXY, Positive
from edge.core.vehicle import PILOTED, Mode, Vector, VehicleState
from edge.flight.energy import Energy
from edge.flight.failsafe import CommandTimeout
from edge.flight.lift import Lift
from edge.flight.margins import ErrorBudget, places_apart
from edge.flight.reach import Reach
from edge.flight.safety import Closest, MotionLimits, SeparationLimits, stopping_m
from edge.flight.silence import SilenceLimits
from edge.messages.beacon import Neighbour
from edge.messages.codes import FailedCheck, Reason, ReasonCode
from edge.messages.mission import (
    FlightState,
    GroundState,
    Order,
    OrderResult,
    Place,
    SafetyAction,
    SlotNumber,
)

# Time for the autopilot to enter offboard.
OFFBOARD_TIMEOUT_S = 4.0
# Telemetry from before a lapse or a command arrives no later: PX4 sends its mode at 1 Hz.
STALE_TELEMETRY_S = 2.0
_LAPSE_SHARE = 0.9
# Longest time from the decision to land to the landing's begin.
_LANDS_WITHIN_S = 6.0
_STARTED = Reason(ReasonCode.PROGRAM_STARTED, "program started")

# Origin of a landing: the ground, the end of a return, or an emergency.
LandBy = Literal["ground", "return", "safety"]
RemoteControlLost = Literal["alarm", "hold", "land"]
_BatteryShare = Annotated[float, Meta(gt=0.0, lt=1.0)]


class Px4Change(NamedTuple):
    """A change in flight, by somebody else, of parameters or fence that preflight had accepted.

    `stays`: it could not be set back.
    """

    text: str
    stays: bool


@dataclass(frozen=True, slots=True)
class FlightParameters(Bounded):
    """Parameters of one robot's flight; times in s, distances in m, speeds in m/s.

    The robot flies at `base_height_m + slot * slot_spacing_m`: the policy is planar and GPS errs by
    metres, so each robot has its own height. `landing_point_m` (x, y) is in the mission frame.
    `battery_low` and `battery_critical` are remaining shares.

    Raises ValueError that names the impossible value.
    """

    slot: SlotNumber
    landing_point_m: PointXY
    base_height_m: Positive = 5.0
    slot_spacing_m: Positive = 4.5
    min_separation_m: Positive = 1.5
    battery_low: _BatteryShare = 0.25
    battery_critical: _BatteryShare = 0.15
    command_timeout_s: CommandTimeout = 0.5
    ground_timeout_s: Positive = 3.0
    ground_lost_land_s: Positive = 10.0
    takeoff_timeout_s: Positive = 15.0
    hover_land_s: Positive = 60.0

    def check_rules(self) -> None:
        if self.min_separation_m >= self.slot_spacing_m:
            raise ValueError(
                f"min_separation_m = {self.min_separation_m}: must be below slot_spacing_m = "
                f"{self.slot_spacing_m}, or robots at their own heights would stop each other"
            )
        if not self.battery_critical < self.battery_low:
            raise ValueError(
                f"battery_critical = {self.battery_critical}: must be below battery_low = "
                f"{self.battery_low}"
            )

    @property
    def slot_height_m(self) -> float:
        """The robot's own height."""
        return self.base_height_m + self.slot * self.slot_spacing_m


class FlightMemory(Struct, frozen=True):
    """Memory of the state machine from tick to tick.

    `target_m` is the target of TAKEOFF and HOLD: x and y of the mission frame, and a height.
    `reached`: since the state began, the vehicle has reported what the state requires: offboard, in
    LAND landing, in FAULT disarmed. `alarming`: the operator must see `reason`. After a lapse of
    the control loop nothing is sent before `silent_until_s`, which stays set until the vehicle is
    in offboard again. `failsafe_at_s` is when the autopilot's failsafe last acted,
    `remote_control_at_s` when the remote control was last heard, `ground_at_s` when the ground was
    last not lost. `alone_since_s` is set while the vehicle hovers without anybody's command: since
    when nobody has answered. `gps_ignored`: this program made the estimator ignore the receiver,
    and must set that back. `armed_by` is the operator of the takeoff order by which this program
    armed it, `disarmed_at_s` when the vehicle was last known to be disarmed. `obeyed_expiry_s` is
    the last obeyed order's, `trial` the last started mission. `lift` is the detector of a lost
    height and of the ground.
    """

    state: FlightState = FlightState.INIT
    reason: Reason = _STARTED
    alarming: bool = False
    since_s: float = 0.0
    tick_at_s: float = -math.inf
    datum_m: float | None = None
    target_m: Vector | None = None
    reached: bool = False
    silent_until_s: float = -math.inf
    failsafe_at_s: float = -math.inf
    gps_ignored: bool = False
    remote_control_at_s: float = -math.inf
    ground_at_s: float = -math.inf
    alone_since_s: float | None = None
    rejoined_at_s: float = -math.inf
    asked_at_s: float = -math.inf
    armed_asked: bool = False
    armed_by: str = ""
    disarmed_at_s: float = -math.inf
    landed_since_s: float | None = None
    land_by: LandBy = "safety"
    killed: bool = False
    trial: str = ""
    obeyed_expiry_s: float = -math.inf
    answers: tuple[OrderResult, ...] = ()
    lift: Lift = Lift()


class FlightInputs(Struct, frozen=True, eq=False):
    """Inputs of one control tick.

    `position` is the judged quality. `odometry` is in the mission frame, with z the altitude above
    sea level without its jumps in flight; None when the position is lost or old, or without a
    mission origin. `policy_velocity_m_s` (2,) is None without a fresh answer of the policy;
    `policy_problem` is the known cause, or "". `neighbours` are those heard, `closest` the nearest
    of them. `busy_neighbours` report that they arm or take off. `safety_request` is the request of
    a ground whose states are refused; `other_release` is the ground's release, "" if it is this
    robot's. `failed_checks` are preflight's; None before the first. `not_taken` are parts of the
    ground's state that the robot does not use. `order` is new in this tick. `energy` is None if the
    battery is unknown. `lands_beside_m` (2,) is the place of landing if another robot stands at the
    landing point. `fell_silent` are robots that fell silent in flight and may still be in the air,
    as of their last message. `px4_change` is None while PX4 is as preflight found it.
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
    safety_request: SafetyAction
    failed_checks: tuple[FailedCheck, ...] | None
    not_taken: tuple[FailedCheck, ...]
    order: Order | None
    uptime_s: float
    energy: Energy | None
    lands_beside_m: tuple[float, float] | None = None
    fell_silent: tuple[Neighbour, ...] = ()
    policy_problem: str = ""
    px4_change: Px4Change | None = None
    other_release: str = ""


@dataclass(frozen=True)
class Robot:
    """The robot in flight: everything that is constant during a flight.

    `on_remote_control_lost` is the action on a lost remote control in flight; None without one.

    Raises ValueError if the fence excludes the robot's height or landing point, has less room for
    errors than the budget requires, or is higher than the robot's reach.
    """

    robot_id: int
    boot_nonce: int
    parameters: FlightParameters
    fence: Fence
    limits: MotionLimits
    on_remote_control_lost: RemoteControlLost | None = None
    errors: ErrorBudget = field(default_factory=ErrorBudget)
    reach: Reach = field(default_factory=Reach)

    def __post_init__(self) -> None:
        if self.fence.ceiling_m > self.reach.ceiling_m:
            raise ValueError(
                f"ceiling_m = {self.fence.ceiling_m:g}: must be within the robot's reach, of "
                f"ceiling_m = {self.reach.ceiling_m:g}"
            )
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

    @cached_property
    def place(self) -> Place:
        """Its place in the flight."""
        return Place(self.parameters.slot, self.parameters.landing_point_m)

    @cached_property
    def separation(self) -> SeparationLimits:
        """Distances from others, which have the same errors and parameters."""
        p, errors = self.parameters, self.errors
        passing_m = max(errors.passing_m, p.min_separation_m)
        return SeparationLimits(
            level_m=p.min_separation_m,
            passing_m=passing_m,
            passing_height_m=errors.passing_height_m,
            # A pilot's next movement is unknown.
            piloted_m=passing_m + errors.wind_m,
            # As from a robot on the ground: both may be off their places.
            landed_m=max(
                places_apart(errors.position_m, errors.position_m).least_m, p.min_separation_m
            ),
            silence=self.silence,
        )

    @cached_property
    def silence(self) -> SilenceLimits:
        """Limits of another robot that fell silent."""
        p, limits = self.parameters, self.limits
        # Way until it stops from its greatest speed, once it is to hold.
        stops_s = stopping_m(limits.max_speed_m_s, limits) / limits.max_speed_m_s
        lands_after_s = max(p.hover_land_s, p.ground_timeout_s + p.ground_lost_land_s)
        return SilenceLimits(
            max_speed_m_s=limits.max_speed_m_s,
            ceiling_m=self.fence.ceiling_m + self.errors.height_m,
            flies_on_s=p.ground_timeout_s + stops_s,
            hovers_s=lands_after_s + _LANDS_WITHIN_S,
        )

    def fence_and_place(self, ground: GroundState) -> tuple[Fence, Place]:
        """Fence and place from the ground's state, by default its own."""
        fence = self.fence if ground.fence is None else ground.fence
        place = ground.places.get(str(self.robot_id))
        return fence, self.place if place is None else place

    def assigned(self, ground: GroundState) -> "Robot":
        """The robot with these. Raises ValueError, for the operator, if they do not fit."""
        fence, place = self.fence_and_place(ground)
        try:
            parameters = replace(
                self.parameters, slot=place.slot, landing_point_m=place.landing_point_m
            )
            return replace(self, fence=fence, parameters=parameters)
        except ValueError as error:
            raise ValueError(f"the ground's fence or place does not fit: {error}") from None


class Tick(Struct, frozen=True, eq=False):
    """Memory and inputs together, with derived values."""

    robot: Robot
    flight: FlightMemory
    inputs: FlightInputs

    @property
    def landing_place_m(self) -> tuple[float, ...]:
        """Destination of RETURN, (2,): the landing point, or beside it."""
        return self.inputs.lands_beside_m or self.robot.parameters.landing_point_m

    @property
    def age_s(self) -> float:
        return self.inputs.now_s - self.flight.since_s

    @property
    def mode(self) -> Mode | None:
        return self.inputs.vehicle.mode

    @property
    def heartbeat_since_entry(self) -> bool:
        return self.inputs.vehicle.heartbeat_at_s > self.flight.since_s

    @property
    def silent(self) -> bool:
        return is_silent(self.flight, self.inputs.now_s)

    @property
    def safety_action(self) -> SafetyAction:
        ground, request = self.inputs.ground, self.inputs.safety_request
        if request != "none" or ground is None or not self.ground_heard:
            return request
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
    def wanted_height_m(self) -> float | None:
        """The commanded height; None if there is none."""
        if self.flight.state in (FlightState.MISSION, FlightState.RETURN):
            return self.robot.parameters.slot_height_m
        return None if self.flight.target_m is None else self.flight.target_m[2]

    @property
    def off_height_s(self) -> float:
        """Time for which the height has been lost, s; below 0 if it is not."""
        return self.flight.lift.off_s(self.inputs.now_s)

    @property
    def in_air(self) -> bool | None:
        return in_air(self.flight, self.inputs.vehicle, self.inputs.now_s)

    @property
    def knows_place(self) -> bool:
        """Whether the position is good to fly by."""
        return self.inputs.position.quality is PositionQuality.GOOD

    @property
    def lapse_s(self) -> float:
        """Duration of the control loop's last silence; 0 without one, or in the first tick."""
        silence_s = self.inputs.now_s - self.flight.tick_at_s
        return silence_s if exceeds_silence(self.robot, silence_s) else 0.0

    @property
    def acts_from_s(self) -> float:
        """Time from which the state's setpoints and commands are sent."""
        return max(self.flight.since_s, self.flight.silent_until_s)

    @property
    def could_follow_s(self) -> float:
        """Time for which the autopilot could have entered offboard."""
        return self.inputs.now_s - max(self.acts_from_s, self.flight.failsafe_at_s)

    @property
    def overdue(self) -> bool:
        """Whether the autopilot has had enough time to enter offboard."""
        return self.could_follow_s > OFFBOARD_TIMEOUT_S

    @property
    def failsafe_acts(self) -> bool:
        return failsafe_acts(self.inputs.vehicle)


def height_m(flight: FlightMemory, odometry: Odometry | None) -> float | None:
    """Height above the robot's own takeoff point, m; None when unknown."""
    if odometry is None or flight.datum_m is None:
        return None
    return odometry.position_m[2] - flight.datum_m


def in_air(flight: FlightMemory, vehicle: VehicleState, now_s: float) -> bool | None:
    """Whether the vehicle is in the air; None if unknown. Standing overrides PX4's report."""
    return False if flight.lift.stands(now_s) else vehicle.in_air


def flown_s(flight: FlightMemory, vehicle: VehicleState, now_s: float) -> float | None:
    """Time since arming, s; None if disarmed, or armed before this program started."""
    since_s = now_s - flight.disarmed_at_s
    return since_s if vehicle.armed and math.isfinite(since_s) else None


def failsafe_acts(vehicle: VehicleState) -> bool:
    """Whether the autopilot's failsafe has control; a request for another mode would end that.

    PX4 v1.14 also reports warnings as failsafe, while it still follows commands in offboard.
    """
    return vehicle.failsafe is True and vehicle.mode not in (Mode.OFFBOARD, *PILOTED)


def exceeds_silence(robot: Robot, silence_s: float) -> bool:
    """Whether the control loop was silent for too long; not for inf, in the first tick.

    This is slightly before the watchdog acts, so that its action is never mistaken for a pilot's.
    """
    return _LAPSE_SHARE * robot.parameters.command_timeout_s < silence_s < math.inf


def is_silent(flight: FlightMemory, now_s: float) -> bool:
    """Whether no setpoint may be sent yet, after a lapse."""
    return now_s < flight.silent_until_s
