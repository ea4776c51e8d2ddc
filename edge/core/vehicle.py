"""What the autopilot tells about the vehicle, and what it can be told; nothing of MAVLink.

Local frame (see `frames`): x north, y east, z down, m, from the estimator's origin. Times are the
robot's monotonic clock, s.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

Vector = tuple[float, float, float]


class Mode(StrEnum):
    """The autopilot's flight modes, as far as the robot must tell them apart."""

    OFFBOARD = "offboard"
    HOLD = "hold"
    TAKEOFF = "takeoff"
    MISSION = "mission"
    RETURN = "return"
    LAND = "land"
    POSITION = "position"
    ALTITUDE = "altitude"
    STABILIZED = "stabilized"
    MANUAL = "manual"
    OTHER = "other"


# A human's sticks move the vehicle.
PILOTED = frozenset({Mode.POSITION, Mode.ALTITUDE, Mode.STABILIZED, Mode.MANUAL})


class Action(StrEnum):
    """Commands to the autopilot, besides setpoints."""

    ARM = "arm"
    OFFBOARD = "offboard"
    HOLD = "hold"
    LAND = "land"
    DISARM = "disarm"
    KILL = "kill"


class ActionResult(NamedTuple):
    """What became of a command; `text` says why it was refused, "" if it was accepted."""

    action: Action
    accepted: bool
    text: str
    at_s: float


@dataclass(frozen=True, slots=True)
class Gps:
    """The receiver's own view: `fix` is MAVLink's GPS_FIX_TYPE (3 is 3-D), `hdop` without unit."""

    fix: int
    satellites: int
    hdop: float


@dataclass(frozen=True, slots=True)
class VehicleState:
    """Everything that was heard of the vehicle, the newest of each; None is not heard yet.

    `position_local_m` and `velocity_local_m_s` were received together, at `position_at_s`;
    `mode`, `armed` come with the autopilot's heartbeat, 1 to 5 times a second, last at
    `heartbeat_at_s`.
    `origin_deg` is the estimator's origin: latitude and longitude. `height_above_home_m` is above
    where the vehicle was armed, up positive. `battery` is the remaining share, 0 to 1. `problems`
    are the autopilot's reasons why it would not arm, in its own words. `remote_control` tells
    whether it hears one.
    `result` is the outcome of the last command that ended.
    """

    connected: bool = False
    system_id: int | None = None
    other_system_ids: tuple[int, ...] = ()
    position_local_m: Vector | None = None
    velocity_local_m_s: Vector | None = None
    position_at_s: float = float("-inf")
    position_ok: bool = False
    heading_rad: float | None = None
    origin_deg: tuple[float, float] | None = None
    height_above_home_m: float | None = None
    mode: Mode | None = None
    armed: bool | None = None
    in_air: bool | None = None
    heartbeat_at_s: float = float("-inf")
    battery: float | None = None
    gps: Gps | None = None
    armable: bool | None = None
    problems: tuple[str, ...] = ()
    remote_control: bool | None = None
    result: ActionResult | None = None


class Velocity(NamedTuple):
    """Fly with this velocity: north, east, down, m/s."""

    velocity_local_m_s: Vector


class Position(NamedTuple):
    """Fly to this position: north, east, down, m."""

    position_local_m: Vector


Setpoint = Velocity | Position
