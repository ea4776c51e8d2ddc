"""State and commands of a vehicle, independent of MAVLink.

Local frame (see `frames`): x north, y east, z down, m, from the estimator's origin. Times are by
the robot's monotonic clock, s.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from msgspec import Struct

Vector = tuple[float, float, float]


# PX4's parameter for the estimator's use of the receiver: bit 0 position, 1 height, 2 velocity; 0
# for none.
GPS_CONTROL = "EKF2_GPS_CTRL"


class Mode(StrEnum):
    """Flight modes of the autopilot that the robot distinguishes."""

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


# Modes in which a human's sticks move the vehicle.
PILOTED = frozenset({Mode.POSITION, Mode.ALTITUDE, Mode.STABILIZED, Mode.MANUAL})


class Action(StrEnum):
    """Commands to the autopilot, in addition to setpoints."""

    ARM = "arm"
    OFFBOARD = "offboard"
    HOLD = "hold"
    LAND = "land"
    DISARM = "disarm"
    KILL = "kill"
    IGNORE_GPS = "ignore_gps"
    USE_GPS = "use_gps"


class ActionResult(NamedTuple):
    """Outcome of a command; `text` is the reason of a refusal, "" if it was accepted."""

    action: Action
    accepted: bool
    text: str
    at_s: float


class AutopilotReason(NamedTuple):
    """A reason from the autopilot: `code` is its own name, `text` is for people.

    `arguments` are its numbers, such as a sensor's index.
    """

    code: str
    arguments: tuple[float, ...]
    text: str


@dataclass(frozen=True, slots=True)
class Gps:
    """The receiver's state: `fix` is MAVLink's GPS_FIX_TYPE (3 is 3-D), `hdop` has no unit.

    `accuracy_m` is the horizontal accuracy reported by the receiver, None without one. `offset_m`
    and `velocity_offset_m_s` are horizontal differences between its fix and the estimator's
    position and velocity, None if unknown. `slip_m` is the recent horizontal difference between its
    movement and its velocity, without jumps; None if it has no velocity. `at_s` is when its last
    new measurement was received, `repeats` the number of repetitions of the same place.
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
    """The autopilot's estimate of its own errors, received at `at_s`.

    `horizontal`: it considers its horizontal position and velocity valid. `glitch`: it rejects the
    GPS.
    """

    horizontal: bool
    glitch: bool
    at_s: float


class GlobalOrigin(NamedTuple):
    """Origin of the estimator's local frame: WGS84 degrees, and m above mean sea level."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float


class VehicleState(Struct, frozen=True):
    """The newest known state of the vehicle; None if not received yet.

    `position_local_m` and `velocity_local_m_s` were received together, at `position_at_s`; their
    values last changed at `position_changed_at_s`, and last jumped, other than with `origin`, at
    `jumped_at_s`. `height_jumped_m` is the sum of upward jumps since arming, m, during which the
    vehicle did not move. `position.judge` decides whether to trust them.

    `mode`, `armed` and `failsafe` (the autopilot acts on a failure) come with its heartbeat, once a
    second, last at `heartbeat_at_s`. `fell`: it was disarmed or rebooted while it reported to be in
    the air; reset by arming.

    `origin` is the estimator's. `height_above_home_m` is above the place of arming, positive up.
    `battery` is the remaining share, 0 to 1, `voltage_v` the pack's voltage. Both, `armable`,
    `remote_control` and `thrust`, the requested share of the maximum thrust, 0 to 1, become None
    again 2.5 s after the last message. `problems` are the autopilot's reasons not to arm,
    `warnings` its faults while armed and reasons to take over, both with the most severe first.
    `remote_control`: whether it receives a remote control.

    `link_lost` is the share of the autopilot's messages lost in the last ten seconds, in steps of
    0.05, `link_twice` whether they arrive more than once. `ignores_gps`: whether its estimator is
    set to ignore the receiver. `version` is the firmware's, such as "1.17.0". `result` is the
    outcome of the last completed command.
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
    """Setpoint of a velocity: north, east, down, m/s."""

    velocity_local_m_s: Vector


class Position(NamedTuple):
    """Setpoint of a position: north, east, down, m."""

    position_local_m: Vector


Setpoint = Velocity | Position
