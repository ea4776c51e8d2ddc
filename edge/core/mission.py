"""What the ground and the robots say to each other, and its JSON.

Two kinds of message go to the robots. `GroundState` is published again and again, so that nothing
depends on one packet; what it says can only stop or calm a robot. An `Order` happens once: it names
the robot and its boot nonce, and expires. Nothing that repeats can arm a vehicle.

Keys, below `lpac/<fleet>/`: `ground/state`, `ground/order`, `robot/<id>/status`.
"""

import dataclasses
import json
import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal, TypeVar

from edge.core.frames import MissionFrame
from edge.core.schema import ConfigError, from_mapping
from edge.core.vehicle import Vector

ORDER_LIFETIME_S = 10.0

T = TypeVar("T")


class FlightState(StrEnum):
    """Where a robot is in its flight; `flight.TRANSITIONS` tells what leads where."""

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

Calm = Literal["none", "hold", "return", "land"]
OrderKind = Literal["takeoff", "start", "rejoin", "kill"]


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
class GroundState:
    """What the ground wants for as long as it says so; `sequence` grows with every change.

    `enabled` lets robots run their preflight checks. `calm` asks the fleet to hold, to return to
    the landing points, or to land; `robot_calm` (robot id as text) overrides it for one robot.
    Withdrawing it sets nothing in motion. `origin` is taken up on the ground only. `unix_time_s` is
    the ground's clock when it said so.
    """

    sequence: int
    operator: str
    origin: Origin | None = None
    enabled: bool = False
    calm: Calm = "none"
    robot_calm: dict[str, Calm] = field(default_factory=dict)
    unix_time_s: float | None = None

    def calm_for(self, robot_id: int) -> Calm:
        """What is asked of one robot."""
        return self.robot_calm.get(str(robot_id), self.calm)


@dataclass(frozen=True, slots=True)
class Order:
    """Something to do once. The ground may repeat the same order until it is answered.

    It is for the start of the program whose `boot_nonce` it names, and expires at
    `expires_at_uptime_s` of the robot's own uptime, `ORDER_LIFETIME_S` after the status that the
    ground saw: clocks need not agree. `trial` names the mission of a start: a name that the robot
    has not flown last resets its explored map and its mailbox.
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
    the last ground state's that it obeyed. `alarms` are for the operator, the gravest first.
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

    def __post_init__(self) -> None:
        for name, size in (("position_m", 3), ("velocity_m_s", 3), ("landing_point_m", 2)):
            value = getattr(self, name)
            if value is not None and len(value) != size:
                raise ValueError(f"{name} = {list(value)}: must be {size} numbers")


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
