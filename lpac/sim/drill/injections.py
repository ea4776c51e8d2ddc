"""Injections of faults into a fleet, and their times.

An injection into a vehicle is a function of vehicle, robot and surroundings. Called without these
three it returns an `OnVehicle`, which applies it later. All other injections are data.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Any, Concatenate, Literal, ParamSpec, Protocol

import numpy as np

from edge.core import F64
from edge.core.vehicle import Vector
from lpac.sim.drill.bounds import RobotGroup
from lpac.sim.fleet.pilot import PilotedVehicle
from lpac.sim.px4.modes import Px4Mode
from lpac.sim.px4.vector import ZERO, minus, plus, times
from lpac.sim.px4.vehicle import Px4Vehicle, SimulatedSensor
from lpac.sim.px4.wire import MavlinkWire

_PILOT_M_S, _PILOT_GAIN_PER_S = 3.0, 0.7
_PILOT_ARRIVED_M, _PILOT_ABOVE_M = 1.0, 3.0
_Arguments = ParamSpec("_Arguments")


class Surroundings(Protocol):
    """Places around a vehicle: world frame, north and east, m; robot numbers wrap around."""

    def outwards(self, robot: int) -> Vector:
        """Horizontal direction to the nearest line of the fence."""
        ...

    def inside_m(self, robot: int) -> float:
        """Estimated distance inside that line, m."""
        ...

    def height_m(self, robot: int) -> float:
        """Flight height of a robot, m."""
        ...

    def highest_m(self) -> float:
        """Greatest flight height of all robots, m."""
        ...

    def place_m(self, robot: int) -> F64:
        """(2,): true position of the robot's first pad."""
        ...


@dataclass(frozen=True, slots=True)
class OnVehicle:
    """An injection into a vehicle: a function `do` of this module and its arguments.

    `kind` is the public function of this module. Those in `BY_PILOTS` take any `PilotedVehicle`,
    others a `Px4Vehicle`.
    """

    kind: Callable[..., "OnVehicle"]
    do: Callable[..., None]
    arguments: tuple[Any, ...]
    named: dict[str, Any]

    def apply(self, vehicle: PilotedVehicle, robot: int, around: Surroundings) -> None:
        """Apply the injection now."""
        self.do(vehicle, robot, around, *self.arguments, **self.named)


def _on_vehicle(
    do: Callable[Concatenate[Any, int, Surroundings, _Arguments], None],
) -> Callable[_Arguments, OnVehicle]:
    @wraps(do)
    def kind(*arguments: _Arguments.args, **named: _Arguments.kwargs) -> OnVehicle:
        return OnVehicle(kind, do, arguments, named)

    return kind


@_on_vehicle
def lose_gps(vehicle: Px4Vehicle, _: int, around: Surroundings, *, lost: bool = True) -> None:
    """Take all satellites from the receiver, or give them back."""
    vehicle.gps_lost = lost


@_on_vehicle
def change_battery(vehicle: Px4Vehicle, _: int, around: Surroundings, remaining: float) -> None:
    """Set the remaining share of the battery."""
    vehicle.battery_remaining = remaining


@_on_vehicle
def drain(vehicle: Px4Vehicle, _: int, around: Surroundings, remaining: float) -> None:
    """Drain the battery to that share in flight; PX4's own simulator cannot while disarmed."""
    vehicle.battery_remaining = remaining


@_on_vehicle
def silence(vehicle: Px4Vehicle, _: int, around: Surroundings, sensor: SimulatedSensor) -> None:
    """Silence a sensor's driver."""
    vehicle.dead_sensors.add(sensor)


@_on_vehicle
def report_accuracy(vehicle: Px4Vehicle, _: int, around: Surroundings, accuracy_m: float) -> None:
    """Make the receiver report that accuracy."""
    vehicle.gps_accuracy_override_m = accuracy_m


@_on_vehicle
def jump_fix(vehicle: Px4Vehicle, robot: int, around: Surroundings, by_m: float) -> None:
    """Displace the receiver's fix outwards."""
    vehicle.gps_jump_m = times(around.outwards(robot), by_m)


@_on_vehicle
def repeat_fix(vehicle: Px4Vehicle, _: int, around: Surroundings) -> None:
    """Make the receiver repeat its last fix as a fresh one, with velocity 0."""
    vehicle.receiver.stuck = True


@_on_vehicle
def falsify_fixes(
    vehicle: Px4Vehicle, robot: int, around: Surroundings, *,
    creep_m_s: float = 0.0, velocity_bias_m_s: float = 0.0, scatter_m: float = 0.0,
) -> None:  # fmt: skip
    """Make fixes drift or bias their velocity, both outwards, or scatter them."""
    outwards = around.outwards(robot)
    vehicle.receiver.creep_m_s = times(outwards, creep_m_s)
    vehicle.receiver.velocity_bias_m_s = times(outwards, velocity_bias_m_s)
    vehicle.receiver.scatter_m = scatter_m


@_on_vehicle
def freeze_estimate(vehicle: Px4Vehicle, _: int, around: Surroundings) -> None:
    """Freeze the estimated position and velocity that PX4 sends."""
    vehicle.estimate_frozen = True


@_on_vehicle
def drift_estimate(
    vehicle: Px4Vehicle, robot: int, around: Surroundings, *,
    inwards_m_s: float = 0.0, down_m_s: float = 0.0,
) -> None:  # fmt: skip
    """Make estimate and receiver drift from the truth, inwards and down.

    The vehicle is thereby led outwards and up.
    """
    north, east, _ = times(around.outwards(robot), -inwards_m_s)
    vehicle.gps_drift_m_s = north, east, down_m_s


@_on_vehicle
def jump_height(vehicle: Px4Vehicle, _: int, around: Surroundings, up_m: float) -> None:
    """Make the estimated height jump, without a new origin."""
    vehicle.gps_offset_m = minus(vehicle.gps_offset_m, (0.0, 0.0, up_m))


@_on_vehicle
def jump_outside(vehicle: Px4Vehicle, robot: int, around: Surroundings, beyond_m: float) -> None:
    """Make estimate and receiver jump to that distance beyond the fence."""
    jump_m = times(around.outwards(robot), around.inside_m(robot) + beyond_m)
    vehicle.gps_offset_m = plus(vehicle.gps_offset_m, jump_m)


@_on_vehicle
def correct_estimate(vehicle: Px4Vehicle, _: int, around: Surroundings) -> None:
    """End the error of the estimate: the position jumps back."""
    vehicle.gps_offset_m = ZERO


@_on_vehicle
def jump_origin(
    vehicle: Px4Vehicle, _: int, around: Surroundings, north_m: float, east_m: float, down_m: float
) -> None:
    """Restart the estimator from another origin."""
    vehicle.jump_estimator_origin(north_m, east_m, down_m)


@_on_vehicle
def jump_heading(vehicle: Px4Vehicle, _: int, around: Surroundings, by_deg: float) -> None:
    """Make the estimated heading jump."""
    vehicle.compass_jump_rad = math.radians(by_deg)


@_on_vehicle
def blow(
    vehicle: Px4Vehicle, robot: int, around: Surroundings, outwards_m_s: float = 0.0,
    gusts_m_s: float = 0.0,
) -> None:  # fmt: skip
    """Add a storm outwards and gusts (standard deviation) to the fleet's own wind."""
    vehicle.wind_m_s = times(around.outwards(robot), outwards_m_s)
    vehicle.gust_m_s = gusts_m_s


@_on_vehicle
def weaken_motors(vehicle: Px4Vehicle, _: int, around: Surroundings, loss: float) -> None:
    """Reduce the greatest thrust by that share."""
    vehicle.motor_loss = loss


@_on_vehicle
def disturb_wire(vehicle: Px4Vehicle, _: int, around: Surroundings, wire: MavlinkWire) -> None:
    """Set the faults of MAVLink messages between computer and autopilot."""
    vehicle.wire = wire


@_on_vehicle
def clear_fence(vehicle: Px4Vehicle, _: int, around: Surroundings) -> None:
    """Clear PX4's fence, as another ground station would."""
    vehicle.fence = ()


@_on_vehicle
def set_parameter(
    vehicle: Px4Vehicle, _: int, around: Surroundings, name: str, value: float
) -> None:
    """Set a parameter of PX4, as another ground station would."""
    vehicle.parameters[name] = value


@_on_vehicle
def carry_to_pad(
    vehicle: Px4Vehicle, robot: int, around: Surroundings, to_pad: int = 1, offset_m: float = 0.0
) -> None:
    """Carry a disarmed vehicle to the pad of robot + `to_pad`, or `offset_m` north of it."""
    if not vehicle.armed:
        north_m, east_m = around.place_m(robot + to_pad).tolist()
        vehicle.position_m = np.array([north_m + offset_m, east_m, 0.0])


@_on_vehicle
def pilot_flies_over(vehicle: Px4Vehicle, robot: int, around: Surroundings, pad: int = 1) -> None:
    """Fly it by pilot over the pad of robot + `pad`, at that robot's height, for a second."""
    pad_m, height_m = around.place_m(robot + pad), around.height_m(robot + pad)
    # Above all robots on the way there.
    if math.dist(vehicle.position_m[:2], pad_m) > _PILOT_ARRIVED_M:
        height_m = around.highest_m() + _PILOT_ABOVE_M
    target_m = np.array([*pad_m, -height_m])
    wanted_m_s = _PILOT_GAIN_PER_S * (target_m - vehicle.position_m)
    fastest = max(1.0, float(np.linalg.norm(wanted_m_s)) / _PILOT_M_S)
    if vehicle.mode is not Px4Mode.POSCTL:
        vehicle.pilot(Px4Mode.POSCTL)
    vehicle.move_sticks((wanted_m_s / fastest).tolist())


@_on_vehicle
def lose_remote_control(vehicle: PilotedVehicle, _: int, around: Surroundings) -> None:
    """Switch the remote control off."""
    vehicle.rc_connected = False


@_on_vehicle
def set_mode(vehicle: PilotedVehicle, _: int, around: Surroundings, mode: Px4Mode) -> None:
    """Command a mode of PX4, as a ground station would."""
    vehicle.set_mode(mode)


@_on_vehicle
def pilot_flies(
    vehicle: PilotedVehicle, robot: int, around: Surroundings, outwards_m_s: float = 0.0,
    up_m_s: float = 0.0,
) -> None:  # fmt: skip
    """Take over by remote control, and fly outwards and up at these speeds."""
    north, east, _ = times(around.outwards(robot), outwards_m_s)
    vehicle.pilot(Px4Mode.POSCTL, (north, east, -up_m_s))


@_on_vehicle
def pilot_lands(vehicle: PilotedVehicle, _: int, around: Surroundings) -> None:
    """Land by remote control."""
    vehicle.move_sticks(())
    vehicle.set_mode(Px4Mode.LAND)


BY_PILOTS = (lose_remote_control, set_mode, pilot_flies, pilot_lands)


@dataclass(frozen=True, slots=True)
class RobotProgram:
    """A robot's program dies (kill -9, no power), ends (SIGTERM), starts or loses its watchdog."""

    event: Literal["dies", "ends", "starts", "loses its watchdog"]


@dataclass(frozen=True, slots=True)
class ProgramStops:
    """The whole program stops for a while, as by SIGSTOP and SIGCONT."""

    for_s: float


@dataclass(frozen=True, slots=True)
class LoopHangs:
    """One loop of a program hangs for a while."""

    loop: Literal["control", "perception", "policy", "preflight", "status"]
    for_s: float


@dataclass(frozen=True, slots=True)
class DiskFills:
    """The robot's disk is full."""


@dataclass(frozen=True, slots=True)
class ClockSteps:
    """The wall clock of the robot's computer steps."""

    by_s: float


@dataclass(frozen=True, slots=True)
class SecondProgram:
    """Another computer claims to be this robot, with a vehicle of its own."""


@dataclass(frozen=True, slots=True)
class RadioIs:
    """Loss and delay of all messages; see `lpac.sim.air.Air`."""

    loss: float = 0.0
    duplication: float = 0.0
    corruption: float = 0.0
    delay_s: float = 0.01


Cut = Literal["none", "from the ground", "from each other", "all", "in halves"]


@dataclass(frozen=True, slots=True)
class RadioCut:
    """A cut of the radio: between robots and ground, among robots, or everywhere.

    In halves, the ground is with the first half.
    """

    cut: Cut


@dataclass(frozen=True, slots=True)
class Laptop:
    """The operator's laptop dies or starts again."""

    event: Literal["dies", "starts"]


@dataclass(frozen=True, slots=True)
class GroundStops:
    """The ground station's program stops for a while, as on a sleeping laptop."""

    for_s: float


@dataclass(frozen=True, slots=True)
class GroundClockSteps:
    """The wall clock of the operator's laptop steps."""

    by_s: float


@dataclass(frozen=True, slots=True)
class SecondLaptop:
    """A second operator's laptop joins without command, holds all, takes command, or dies."""

    event: Literal["joins", "holds all", "takes command", "dies"]


@dataclass(frozen=True, slots=True)
class OperatorOrders:
    """The operator sends a command without awaiting the answer."""

    kind: Literal["start", "rejoin", "kill", "hold", "return", "land", "resume"]


@dataclass(frozen=True, slots=True)
class FenceWithout:
    """The operator sets a fence that leaves the landing points of robots outside."""


Injection = (
    OnVehicle | RobotProgram | ProgramStops | LoopHangs | DiskFills | ClockSteps | SecondProgram
    | RadioIs | RadioCut | Laptop | GroundStops | GroundClockSteps | SecondLaptop
    | OperatorOrders | FenceWithout
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Do:
    """An injection `at_s` after the start of the fault, into a group of robots.

    `mark` names its time for bounds. An injection into ground station or radio happens once.
    """

    injection: Injection
    at_s: float = 0.0
    to: RobotGroup = "hit"
    mark: str = ""
