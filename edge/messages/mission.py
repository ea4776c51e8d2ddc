"""Messages between the ground and the robots.

The ground repeats a `GroundState`, so that nothing depends on one packet: it can only hold, return
or land a robot. An `Order` takes effect once: it names the robot and its boot nonce, and expires.
No repeated message can arm a vehicle.

`edge.messages.topics` has their topics, `edge.messages.codec` encodes them.
"""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache
from typing import Annotated, Literal, get_args

import numpy as np
from msgspec import Meta

from edge.core import Bools
from edge.core.fence import Fence
from edge.core.frames import Latitude, Longitude, MissionFrame
from edge.core.memory import EXPLORED_CELLS
from edge.core.position import PositionCause, PositionQuality
from edge.core.schema import Bounded, bounds_of, faults
from edge.messages.bounds import (
    MOST_ROBOTS,
    MOST_TEXTS,
    Count,
    Degrees,
    Metres,
    MetresPerSecond,
    Milliseconds,
    Name,
    Nonce,
    Precision,
    Radians,
    RobotId,
    RobotKey,
    Seconds,
    Sequence,
    Share,
    SystemId,
    TimeBase,
    UnixSeconds,
)
from edge.messages.codes import FailedCheck, Reason, ReasonCode, Refusal

ORDER_LIFETIME_S = 10.0
# Stations repeat a hold five times a second.
HOLD_LASTS_S = 1.5
Heading = Annotated[float, Meta(ge=0.0, lt=360.0)]
SlotNumber = Annotated[int, Meta(ge=0, le=1000)]
# A mission starts within this distance of the robot's own height.
AT_SLOT_M = 1.0

FailedChecks = Annotated[tuple[FailedCheck, ...], Meta(max_length=MOST_TEXTS)]
_Point = Annotated[tuple[Metres, ...], Meta(min_length=2, max_length=2, description="[x, y]")]
Vector = tuple[Metres, Metres, Metres]
# See `edge.core.arrivals`; a newer program may know more bins.
ArrivalCounts = Annotated[tuple[Count, ...], Meta(max_length=20)]
_OfRobots = Meta(max_length=MOST_ROBOTS)
_OfTexts = Meta(max_length=MOST_TEXTS)
_NO_REASON = Reason(ReasonCode.OTHER, "")


class FlightState(StrEnum):
    """State of a robot's flight; `flight.transitions` lists the transitions."""

    INIT = "init"
    IDLE = "idle"
    PREFLIGHT = "preflight"
    ARMING = "arming"
    TAKEOFF = "takeoff"
    HOLD = "hold"
    MISSION = "mission"
    RETURN = "return"
    LAND = "land"
    LANDED = "landed"
    PILOT = "pilot"
    FAULT = "fault"


# Disarmed, as far as the robot knows.
ON_GROUND = (FlightState.INIT, FlightState.IDLE, FlightState.PREFLIGHT, FlightState.LANDED)
# The robot flies its vehicle by setpoints.
STEERED = (FlightState.TAKEOFF, FlightState.HOLD, FlightState.MISSION, FlightState.RETURN)
AIRBORNE = (*STEERED, FlightState.LAND)

SafetyAction = Literal["none", "hold", "return", "land"]
_SAFETY_ACTIONS: dict[str, SafetyAction] = {action: action for action in get_args(SafetyAction)}
OrderKind = Literal["takeoff", "start", "pilot", "rejoin", "reset", "disarm", "kill"]


@dataclass(frozen=True, slots=True)
class Origin(Bounded):
    """Origin of the mission frame, set by the operator: degrees, heading in [0, 360).

    Raises ValueError if a number is out of its range.
    """

    latitude_deg: Latitude
    longitude_deg: Longitude
    heading_deg: Heading

    def frame(self) -> MissionFrame:
        """The mission frame at this origin."""
        return MissionFrame(self.latitude_deg, self.longitude_deg, math.radians(self.heading_deg))


@dataclass(frozen=True, slots=True)
class Place(Bounded):
    """A robot's place in the flight: the `slot` of its height, and its landing point (x, y), m."""

    slot: SlotNumber
    landing_point_m: _Point


@dataclass(frozen=True, slots=True)
class Echo:
    """Echo of a robot's newest status, which the ground received `held_s` before it sends this."""

    boot_nonce: Nonce
    uptime_s: Seconds
    held_s: Seconds


@dataclass(frozen=True, slots=True)
class SafetyRequest:
    """The part of a `GroundState` that robots obey even if they refuse the rest.

    An action unknown in this release counts as "none".
    """

    sequence: Sequence
    operator: Name
    safety_action: Name = field(default="none", kw_only=True)
    robot_safety_actions: Annotated[Mapping[RobotKey, Name], _OfRobots] = field(
        default_factory=dict, kw_only=True
    )

    def safety_action_for(self, robot_id: int) -> SafetyAction:
        """Safety action for one robot."""
        asked = self.robot_safety_actions.get(str(robot_id), self.safety_action)
        return _SAFETY_ACTIONS.get(asked, "none")


@dataclass(frozen=True, slots=True)
class GroundState(SafetyRequest):
    """The ground's requests, valid while it repeats them; `sequence` grows with every change.

    `operator` is the commander's; of two states with one sequence the greater operator's counts.
    `enabled` lets robots run their preflight checks. `safety_action` asks the fleet to hold, to
    return to the landing points, or to land; `safety_action_by` is the operator who asked, if not
    `operator`. `robot_enabled` and `robot_safety_actions` override these for one robot, by its id.
    Withdrawing a safety action sets nothing in motion.

    Robots adopt `origin`, `fence`, `places` and `world_id` on the ground only. Without a `fence` or
    a place a robot uses its configured one, without a `world_id` the one that it has. `trial` is
    the mission's name. `unix_time_s` is the ground's wall clock at the send time. `time_s` is the
    fleet's time, by the clock of the ground `time_base`; robots find messages' ages from `echoes`,
    by robot id. `waiting` are robots that hold during a return only until their way down is free.
    """

    safety_action: SafetyAction = field(default="none", kw_only=True)
    robot_safety_actions: Annotated[dict[RobotKey, SafetyAction], _OfRobots] = field(
        default_factory=dict, kw_only=True
    )
    origin: Origin | None = None
    enabled: bool = False
    robot_enabled: Annotated[dict[RobotKey, bool], _OfRobots] = field(default_factory=dict)
    safety_action_by: Name = ""
    fence: Fence | None = None
    places: Annotated[dict[RobotKey, Place], _OfRobots] = field(default_factory=dict)
    world_id: Name | None = None
    trial: Name = ""
    unix_time_s: UnixSeconds | None = None
    waiting: Annotated[tuple[RobotId, ...], _OfRobots] = ()
    time_base: TimeBase = 0
    time_s: Seconds | None = None
    echoes: Annotated[dict[RobotKey, Echo], _OfRobots] = field(default_factory=dict)

    def enabled_for(self, robot_id: int) -> bool:
        """Whether one robot may run its checks and fly."""
        return self.robot_enabled.get(str(robot_id), self.enabled)


@dataclass(frozen=True, slots=True)
class Order:
    """A request to do something once. The ground may repeat it until the robot answers.

    It is for the start of the program with this `boot_nonce`. It expires when the robot's own
    uptime reaches `expires_at_uptime_s`, `ORDER_LIFETIME_S` after the status that the ground had:
    clocks need not agree. `trial` names the mission of a start. With a new trial, robots clear the
    explored map and the neighbours' messages. A reset clears them too; the trial is then "" until
    the next start.

    `pilot` gives the holding vehicle to a human; `rejoin` takes it back. `disarm` stops the motors
    on the ground only, `kill` anywhere. All but `kill` are the commander's alone. `kind` is an
    `OrderKind`; a robot refuses any other.
    """

    order_id: Name
    robot_id: RobotId
    boot_nonce: Nonce
    kind: Name
    expires_at_uptime_s: Seconds
    operator: Name
    trial: Name = ""


@dataclass(frozen=True, slots=True)
class Hold:
    """A hold request from a station that does not command, valid while it repeats it.

    It applies to `robots`, by id, or to all if empty, and expires `HOLD_LASTS_S` after arrival.
    """

    by: Name
    robots: Annotated[tuple[RobotId, ...], _OfRobots] = ()

    def is_of(self, robot_id: int) -> bool:
        """Whether that robot must hold."""
        return not self.robots or robot_id in self.robots


@dataclass(frozen=True, slots=True)
class OrderResult:
    """A robot's answer to an order, which it obeyed unless there is a `refusal`."""

    order_id: Name
    refusal: Refusal | None = None

    @property
    def accepted(self) -> bool:
        """Whether the robot obeyed."""
        return self.refusal is None


@dataclass(frozen=True, slots=True)
class LoopStatus:
    """One loop's counts since the start, and its lateness over the last minute, ms."""

    ticks: Count
    overruns: Count
    failures: Count
    lateness_p50_ms: Milliseconds
    lateness_p99_ms: Milliseconds
    lateness_max_ms: Milliseconds


@dataclass(frozen=True, slots=True)
class RadioCounts:
    """Counts of messages between a robot and its neighbours since its program's start.

    It sent them `sent` messages of `sent_bytes` in all, without envelopes. `arrivals` has each
    robot's `Arrivals.counts`, late messages included.
    """

    sent: Count
    sent_bytes: Count
    arrivals: Annotated[dict[RobotKey, ArrivalCounts], _OfRobots] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class RobotStatus:
    """A robot's report of itself, a few times a second.

    `ready` means that it would accept a takeoff order; else `failed_checks` says why not. Positions
    are in the mission frame, heights above its own takeoff point, m. `obeyed_sequence` is the last
    ground state's that it obeyed. `alarms` are for the operator, the gravest first. `not_taken`
    lists parts of the ground's state that it does not adopt now, and why. `global_deg` is latitude
    and longitude.

    `policy_velocity_m_s` (2,) is the policy's present request, also on the ground; `feature_age_s`
    is the age of its features. `message_counts` counts all messages since the start: "accepted", or
    by the reason to refuse them. `neighbour_messages` counts the accepted ones of each neighbour.
    `radio_counts` are None in most statuses. `ground_age_s` is the age of the ground state that it
    obeys, None before the first.

    `position_quality` rates its position, and `position_cause` says what lowers it;
    `gps_accuracy_m` is the GPS's own figure. `remote_control` is whether the pilot's is received,
    None without one. `battery_lasts_s` is the flight time until the battery is critical, `home_s`
    the time to land with the reserve left, `endurance_s` a full battery's flight time. `flown_s` is
    the time since arming, None if disarmed, or armed before the program's start.

    Optional values that are not finite become None, whatever a sensor reports. Raises ValueError
    for a required one.
    """

    robot_id: RobotId
    boot_nonce: Nonce
    sequence: Sequence
    uptime_s: Seconds
    unix_time_s: UnixSeconds
    state: FlightState
    slot_height_m: Metres
    landing_point_m: tuple[Metres, ...]
    reason: Reason = _NO_REASON
    ready: bool = False
    failed_checks: FailedChecks = ()
    alarms: Annotated[tuple[Reason, ...], Meta(max_length=MOST_TEXTS)] = ()
    obeyed_sequence: Sequence = -1
    operator: Name = ""
    orders: Annotated[tuple[OrderResult, ...], Meta(max_length=MOST_TEXTS)] = ()
    bundle_id: Name = ""
    world_id: Name = ""
    trial: Name = ""
    origin: Origin | None = None
    system_id: SystemId | None = None
    position_m: Vector | None = None
    velocity_m_s: tuple[MetresPerSecond, MetresPerSecond, MetresPerSecond] | None = None
    heading_rad: Radians | None = None
    mode: Name | None = None
    armed: bool | None = None
    battery: Share | None = None
    satellites: Count | None = None
    message_counts: Annotated[dict[Name, Count], _OfTexts] = field(default_factory=dict)
    neighbour_ages_s: Annotated[dict[RobotKey, Seconds], _OfRobots] = field(default_factory=dict)
    loops: Annotated[dict[Name, LoopStatus], _OfTexts] = field(default_factory=dict)
    fence: Fence | None = None
    not_taken: FailedChecks = ()
    in_air: bool | None = None
    global_deg: tuple[Degrees, Degrees] | None = None
    hdop: Precision | None = None
    policy_velocity_m_s: tuple[MetresPerSecond, MetresPerSecond] | None = None
    feature_age_s: Seconds | None = None
    neighbour_messages: Annotated[dict[RobotKey, Count], _OfRobots] = field(default_factory=dict)
    ground_age_s: Seconds | None = None
    position_quality: PositionQuality | None = None
    position_cause: PositionCause | None = None
    gps_accuracy_m: Precision | None = None
    remote_control: bool | None = None
    battery_lasts_s: Seconds | None = None
    home_s: Seconds | None = None
    endurance_s: Seconds | None = None
    flown_s: Seconds | None = None
    radio_counts: RadioCounts | None = None

    def __post_init__(self) -> None:
        for name, fault in faults(self, _numbers_of_status()).items():
            if name in _NEVER_NONE:
                raise ValueError(fault)
            object.__setattr__(self, name, None)
        if len(self.landing_point_m) != 2:
            raise ValueError(f"landing_point_m = {list(self.landing_point_m)}: must be 2 numbers")
        ages_s = self.neighbour_ages_s
        if not all(map(math.isfinite, ages_s.values())):
            finite = {robot: age_s for robot, age_s in ages_s.items() if math.isfinite(age_s)}
            object.__setattr__(self, "neighbour_ages_s", finite)


_NEVER_NONE = (
    "robot_id", "boot_nonce", "sequence", "uptime_s", "unix_time_s", "obeyed_sequence",
    "slot_height_m", "landing_point_m",
)  # fmt: skip


@cache
def _numbers_of_status() -> tuple[str, ...]:
    return tuple(name for name, meta in bounds_of(RobotStatus).items() if meta.ge is not None)


def world_id(text: str) -> str:
    """Id of a world file: the first 12 hexadecimal digits of its SHA-256."""
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def explored_to_bytes(explored: Bools) -> bytes:
    """Pack an explored map (64, 64) over the policy's world, [x, y]: True where it was seen."""
    if explored.shape != (EXPLORED_CELLS, EXPLORED_CELLS):
        raise ValueError(f"explored has shape {explored.shape}")
    return np.packbits(explored).tobytes()


def explored_from_bytes(data: bytes) -> Bools:
    """Unpack `explored_to_bytes`. Raises ValueError if the size is wrong."""
    if len(data) != EXPLORED_CELLS**2 // 8:
        raise ValueError(f"explored has {len(data)} bytes: must be {EXPLORED_CELLS**2 // 8}")
    bits = np.unpackbits(np.frombuffer(data, np.uint8)).astype(np.bool_)
    return bits.reshape(EXPLORED_CELLS, EXPLORED_CELLS)
