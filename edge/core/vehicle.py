"""State and commands of a vehicle, as its autopilot has them; nothing of MAVLink.

Local frame (see `frames`): x north, y east, z down, m, from the estimator's origin. Times are the
robot's monotonic clock, s.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from msgspec import Struct

Vector = tuple[float, float, float]


# PX4's parameter of which of a receiver's measurements its estimator uses: bit 0 place, 1 height,
# 2 velocity; 0: it goes without the receiver.
GPS_CONTROL = "EKF2_GPS_CTRL"


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
    IGNORE_GPS = "ignore_gps"
    USE_GPS = "use_gps"


class ActionResult(NamedTuple):
    """Outcome of a command; `text` says why it was refused, "" if it was accepted."""

    action: Action
    accepted: bool
    text: str
    at_s: float


class AutopilotReason(NamedTuple):
    """Why the autopilot refuses or does something: `code` is its own name for it, `text` in words.

    `arguments` are the numbers in it, such as which sensor.
    """

    code: str
    arguments: tuple[float, ...]
    text: str


@dataclass(frozen=True, slots=True)
class Gps:
    """The receiver's own view: `fix` is MAVLink's GPS_FIX_TYPE (3 is 3-D), `hdop` without unit.

    `accuracy_m` is the horizontal accuracy that it claims for itself, None if it claims none.
    `offset_m` and `velocity_offset_m_s` are how far in the plane its fix is from the estimator's
    position and velocity, None if one of them is not known. `slip_m` is how far in the plane its
    place has moved lately in another way than its velocity says, jumps apart; None if it tells no
    velocity.
    `at_s` is when its last new measurement was received, and `repeats` how many have told the same
    place since another one.
    """

    fix: int
    satellites: int
    hdop: float
    accuracy_m: float | None = None
    offset_m: float | None = None
    velocity_offset_m_s: float | None = None
    slip_m: float | None = None
    at_s: float = float("-inf")
    repeats: int = 0


class EstimatorStatus(NamedTuple):
    """The autopilot's estimate of its own errors.

    `horizontal` is whether it vouches for a position and a velocity in the plane, `glitch` whether
    it rejects the GPS; heard at `at_s`.
    """

    horizontal: bool
    glitch: bool
    at_s: float


class GlobalOrigin(NamedTuple):
    """Where the estimator's local frame starts: WGS84 degrees, and m above mean sea level."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float


class VehicleState(Struct, frozen=True):
    """Everything that was heard of the vehicle, the newest of each; None is not heard yet.

    `position_local_m` and `velocity_local_m_s` were received together, at `position_at_s`; their
    values last changed at `position_changed_at_s`, and jumped, in another way than `origin`
    explains, at `jumped_at_s`. `height_jumped_m` is how far they have jumped up so in all, m,
    since the vehicle was armed; the vehicle did not move when they did. Whether to trust them is
    for `position.judge` to say.
    `mode`, `armed` and `failsafe` (the autopilot acts on a failure by itself) come with its
    heartbeat, once a second, last at `heartbeat_at_s`. `fell` is whether it was disarmed, or
    switched on anew, while it was in the air by its own word; until it is armed again.
    `origin` is the estimator's. `height_above_home_m` is above where the vehicle was armed, up
    positive. `battery` is the remaining share, 0 to 1, `voltage_v` the pack's. Both, `armable` and
    `remote_control` are None again once they were not heard for 2.5 s, and so is `thrust`, the
    share of the greatest thrust, 0 to 1, that the autopilot asks of its motors. `problems` are the
    autopilot's reasons why it would not arm, `warnings` what it finds wrong while it is armed, and
    why it takes over; the gravest come first. `remote_control` tells whether it hears one.
    `link_lost` is the share of the autopilot's messages that were lost on the way in the last ten
    seconds, in steps of 5 %, and `link_twice` whether they arrive more than once.
    `ignores_gps`: its estimator was told to go without the receiver.
    `version` is its firmware's, such as "1.17.0".
    `result` is the outcome of the last command that ended.
    """

    connected: bool = False
    system_id: int | None = None
    other_system_ids: tuple[int, ...] = ()
    position_local_m: Vector | None = None
    velocity_local_m_s: Vector | None = None
    position_at_s: float = float("-inf")
    position_changed_at_s: float = float("-inf")
    jumped_at_s: float = float("-inf")
    height_jumped_m: float = 0.0
    heading_rad: float | None = None
    origin: GlobalOrigin | None = None
    height_above_home_m: float | None = None
    thrust: float | None = None
    mode: Mode | None = None
    armed: bool | None = None
    in_air: bool | None = None
    failsafe: bool | None = None
    fell: bool = False
    heartbeat_at_s: float = float("-inf")
    battery: float | None = None
    voltage_v: float | None = None
    gps: Gps | None = None
    ignores_gps: bool | None = None
    estimator: EstimatorStatus | None = None
    armable: bool | None = None
    problems: tuple[AutopilotReason, ...] = ()
    warnings: tuple[AutopilotReason, ...] = ()
    remote_control: bool | None = None
    link_lost: float = 0.0
    link_twice: bool = False
    version: str | None = None
    result: ActionResult | None = None


class Velocity(NamedTuple):
    """Fly with this velocity: north, east, down, m/s."""

    velocity_local_m_s: Vector


class Position(NamedTuple):
    """Fly to this position: north, east, down, m."""

    position_local_m: Vector


Setpoint = Velocity | Position
