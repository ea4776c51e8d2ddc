"""What the ground and the robots say to each other, and its JSON.

Two kinds of message go to the robots. `GroundState` is published again and again, so that nothing
depends on one packet; what it says can only hold, return or land a robot. An `Order` happens once:
it names the robot and its boot nonce, and expires. Nothing that repeats can arm a vehicle.

Keys, below `lpac/<fleet>/`: `ground/state`, `ground/order`, `ground/world` (a CoverageControl world
file's text), `robot/<id>/status`, and `robot/<id>/explored` (see `explored_to_bytes`).
"""

import dataclasses
import hashlib
import json
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal, TypeVar

import numpy as np

from edge.core import Bools
from edge.core.fence import Fence
from edge.core.frames import MissionFrame
from edge.core.perception import EXPLORED_CELLS
from edge.core.position import PositionCause, PositionQuality
from edge.core.schema import ConfigError, from_mapping
from edge.core.vehicle import Vector

ORDER_LIFETIME_S = 10.0
MAX_SLOT = 1000
# A mission starts within this distance of the robot's own height.
AT_SLOT_M = 1.0
_OVER_LANDING_POINT_M = 1.5

T = TypeVar("T")


class FlightState(StrEnum):
    """Where a robot is in its flight; `flight.transitions` tells what leads where."""

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
OrderKind = Literal["takeoff", "start", "pilot", "rejoin", "reset", "disarm", "kill"]


@dataclass(frozen=True, slots=True)
class Origin:
    """Where the mission frame lies, as the operator sets it: degrees, heading in [0, 360).

    Raises ValueError if a number is out of its range.
    """

    latitude_deg: float
    longitude_deg: float
    heading_deg: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.heading_deg < 360.0:
            raise ValueError(f"heading_deg = {self.heading_deg}: must be in [0, 360)")
        self.frame()

    def frame(self) -> MissionFrame:
        """The mission frame itself."""
        return MissionFrame(self.latitude_deg, self.longitude_deg, math.radians(self.heading_deg))


@dataclass(frozen=True, slots=True)
class Place:
    """A robot's place in the flight: its height's `slot`, and where it lands, (x, y), m."""

    slot: int
    landing_point_m: tuple[float, ...]

    def __post_init__(self) -> None:
        if not 0 <= self.slot <= MAX_SLOT:
            raise ValueError(f"slot = {self.slot}: must be from 0 to {MAX_SLOT}")
        if len(self.landing_point_m) != 2 or not all(map(math.isfinite, self.landing_point_m)):
            raise ValueError(f"landing_point_m = {list(self.landing_point_m)}: must be [x, y]")


@dataclass(frozen=True, slots=True)
class GroundState:
    """What the ground wants for as long as it says so; `sequence` grows with every change.

    `operator` is who commands; of two states with one sequence the greater operator's counts.
    `enabled` lets robots run their preflight checks. `safety_action` asks the fleet to hold, to
    return to the landing points, or to land; `safety_action_by` is who asked, if it was not
    `operator`. `robot_enabled` and `robot_safety_actions` (robot id as text) override them for one
    robot. Withdrawing it sets nothing in motion. `origin`, `fence` (None: the robot's
    configured one), `places` (by robot id; who is not in it keeps its configured one) and
    `world_id` (None: whatever the robot has) are taken up on the ground only. `trial` is the
    mission's name. `unix_time_s` is the ground's clock when it said so. `waiting` are those that
    hold in a return only until their way down is free: nobody asked them to.
    """

    sequence: int
    operator: str
    origin: Origin | None = None
    enabled: bool = False
    robot_enabled: dict[str, bool] = field(default_factory=dict)
    safety_action: SafetyAction = "none"
    safety_action_by: str = ""
    robot_safety_actions: dict[str, SafetyAction] = field(default_factory=dict)
    fence: Fence | None = None
    places: dict[str, Place] = field(default_factory=dict)
    world_id: str | None = None
    trial: str = ""
    unix_time_s: float | None = None
    waiting: tuple[int, ...] = ()

    def enabled_for(self, robot_id: int) -> bool:
        """Whether one robot may run its checks and fly."""
        return self.robot_enabled.get(str(robot_id), self.enabled)

    def safety_action_for(self, robot_id: int) -> SafetyAction:
        """What is asked of one robot."""
        return self.robot_safety_actions.get(str(robot_id), self.safety_action)


@dataclass(frozen=True, slots=True)
class Order:
    """Something to do once. The ground may repeat the same order until it is answered.

    It is for the start of the program whose `boot_nonce` it names, and expires at
    `expires_at_uptime_s` of the robot's own uptime, `ORDER_LIFETIME_S` after the status that the
    ground saw: clocks need not agree. `trial` names the mission of a start: another one than the
    last has the explored map and the mailbox forgotten. A reset does, too; the robot's own trial is
    then "" until it starts again.

    `pilot` gives the vehicle, which holds, to a human; `rejoin` takes it back. `disarm` stops the
    motors on the ground only, `kill` anywhere. All but `kill` are the commander's alone.
    """

    order_id: str
    robot_id: int
    boot_nonce: int
    kind: OrderKind
    expires_at_uptime_s: float
    operator: str
    trial: str = ""


@dataclass(frozen=True, slots=True)
class OrderResult:
    """A robot's answer to an order; `reason` says why it was refused."""

    order_id: str
    accepted: bool
    reason: str = ""


@dataclass(frozen=True, slots=True)
class LoopStatus:
    """One loop's counts since the start, and its lateness, ms, over the last minute."""

    ticks: int
    overruns: int
    failures: int
    lateness_p50_ms: float
    lateness_p99_ms: float
    lateness_max_ms: float


@dataclass(frozen=True, slots=True)
class RobotStatus:
    """What a robot says of itself, a few times a second.

    `ready` means that a takeoff order would be taken; else `failed_checks` says why not. Positions
    are in the mission frame, heights above the robot's own takeoff point, m. `obeyed_sequence` is
    the last ground state's that it obeyed. `alarms` are for the operator, the gravest first;
    `not_taken` says what of the ground's state the robot does not take up now, and why.
    `global_deg` is its latitude and longitude. `policy_velocity_m_s` (2,) is what the policy asks
    for now, also on the ground; `feature_age_s` is the age of the features that it asks from.
    `neighbour_messages` counts each neighbour's messages since the start. `ground_age_s` is how
    long ago the state that it obeys was heard, None if never. `position_quality` is what its
    position is worth, `position_cause` what speaks against it; `gps_accuracy_m` is the receiver's
    own figure. `remote_control` tells whether its pilot's is heard, None where there is none.
    `battery_lasts_s` is how long it flies until its battery is critical, `home_s` what it needs to
    be landed with the reserve left, and `endurance_s` what a full battery would last. `flown_s` is
    how long ago it was armed, None if it is not, or was so before its program started.

    What is not finite, of what may be None, is None: whatever a sensor says, nobody else has to
    look. Raises ValueError for what must be there and is not finite.
    """

    robot_id: int
    boot_nonce: int
    sequence: int
    uptime_s: float
    unix_time_s: float
    state: FlightState
    reason: str
    ready: bool
    failed_checks: tuple[str, ...]
    alarms: tuple[str, ...]
    obeyed_sequence: int
    operator: str
    orders: tuple[OrderResult, ...]
    bundle_id: str
    world_id: str
    trial: str
    origin: Origin | None
    system_id: int | None
    slot_height_m: float
    landing_point_m: tuple[float, ...]
    position_m: Vector | None
    velocity_m_s: Vector | None
    heading_rad: float | None
    mode: str | None
    armed: bool | None
    battery: float | None
    satellites: int | None
    message_counts: dict[str, int]
    neighbour_ages_s: dict[str, float]
    loops: dict[str, LoopStatus]
    fence: Fence | None = None
    not_taken: tuple[str, ...] = ()
    in_air: bool | None = None
    global_deg: tuple[float, ...] | None = None
    hdop: float | None = None
    policy_velocity_m_s: tuple[float, ...] | None = None
    feature_age_s: float | None = None
    neighbour_messages: dict[str, int] = field(default_factory=dict)
    ground_age_s: float | None = None
    position_quality: PositionQuality | None = None
    position_cause: PositionCause | None = None
    gps_accuracy_m: float | None = None
    remote_control: bool | None = None
    battery_lasts_s: float | None = None
    home_s: float | None = None
    endurance_s: float | None = None
    flown_s: float | None = None

    def __post_init__(self) -> None:
        for name, size in (
            ("position_m", 3), ("velocity_m_s", 3), ("landing_point_m", 2), ("global_deg", 2),
            ("policy_velocity_m_s", 2),
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and len(value) != size:
                raise ValueError(f"{name} = {list(value)}: must be {size} numbers")
            if value is not None and not all(map(math.isfinite, value)):
                self._forget(name)
        for name in (
            "uptime_s", "unix_time_s", "slot_height_m", "heading_rad", "battery", "hdop",
            "feature_age_s", "ground_age_s", "gps_accuracy_m",
            "battery_lasts_s", "home_s", "endurance_s", "flown_s",
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                self._forget(name)
        ages_s = self.neighbour_ages_s
        if not all(map(math.isfinite, ages_s.values())):
            heard = {robot: age_s for robot, age_s in ages_s.items() if math.isfinite(age_s)}
            object.__setattr__(self, "neighbour_ages_s", heard)

    def _forget(self, name: str) -> None:
        if name in ("uptime_s", "unix_time_s", "slot_height_m", "landing_point_m"):
            raise ValueError(f"{name} = {getattr(self, name)}: must be finite")
        object.__setattr__(self, name, None)


def is_over_landing_point(status: RobotStatus) -> bool:
    """Whether the robot has come home, as far as it knows."""
    if status.position_m is None:
        return False
    return math.dist(status.position_m[:2], status.landing_point_m) < _OVER_LANDING_POINT_M


def is_too_low(status: RobotStatus) -> bool:
    """Whether the robot is so far below its own height that it cannot start a mission there."""
    if status.position_m is None:
        return False
    return status.slot_height_m - status.position_m[2] > AT_SLOT_M


def waiting_to_land(statuses: Mapping[int, RobotStatus], arrived: Collection[int]) -> set[int]:
    """Who of those that `arrived` over their landing points must not land yet; robot ids.

    Landing leads through the heights of all lower robots: somebody still flies home there.
    """
    lowest_m = min(
        (s.slot_height_m for r, s in statuses.items() if s.state in STEERED and r not in arrived),
        default=math.inf,
    )
    return {
        robot
        for robot, status in statuses.items()
        if robot in arrived and status.state in STEERED and status.slot_height_m > lowest_m
    }


def world_id(text: str) -> str:
    """What a world file is called: the first 12 hexadecimal digits of its sha256."""
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def explored_to_bytes(explored: Bools) -> bytes:
    """(64, 64) over the policy's world, indexed [x, y]: True where the robot has seen the cell."""
    if explored.shape != (EXPLORED_CELLS, EXPLORED_CELLS):
        raise ValueError(f"explored has shape {explored.shape}")
    return np.packbits(explored).tobytes()


def explored_from_bytes(data: bytes) -> Bools:
    """The inverse of `explored_to_bytes`. Raises ValueError if the size is wrong."""
    if len(data) != EXPLORED_CELLS**2 // 8:
        raise ValueError(f"explored has {len(data)} bytes: must be {EXPLORED_CELLS**2 // 8}")
    bits = np.unpackbits(np.frombuffer(data, np.uint8)).astype(np.bool_)
    return bits.reshape(EXPLORED_CELLS, EXPLORED_CELLS)


def to_json(message: GroundState | Order | RobotStatus) -> bytes:
    """The message as one JSON object, UTF-8."""
    return json.dumps(dataclasses.asdict(message), separators=(",", ":")).encode()


def from_json(kind: type[T], data: bytes) -> T:
    """The message of that kind in `data`. Raises ConfigError that says what is wrong with it."""
    try:
        mapping = json.loads(data)
    except (ValueError, RecursionError):
        raise ConfigError(f"{kind.__name__}: not JSON") from None
    return from_mapping(kind, mapping, kind.__name__)
