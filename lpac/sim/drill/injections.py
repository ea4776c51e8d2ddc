"""Injections: changes done to a fleet in flight. Each kind of vehicle supports some (`supports`).

Those below `VehicleInjection` are done to a simulated vehicle, whoever flies it. Those below
`PilotInjection` are what somebody with a remote control, or a ground station, does with any.
(Who is to hover over a place by one look a second must know how a simulated vehicle answers.)
"""

import math
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from edge.core import F64
from edge.core.vehicle import Vector
from lpac.sim.fleet.pilot import PilotedVehicle
from lpac.sim.px4.modes import Px4Mode
from lpac.sim.px4.vector import ZERO, minus, plus, times
from lpac.sim.px4.vehicle import Px4Vehicle, SimulatedSensor
from lpac.sim.px4.wire import MavlinkWire

_PILOT_M_S, _PILOT_GAIN_PER_S = 3.0, 0.7
_PILOT_ARRIVED_M, _PILOT_ABOVE_M = 1.0, 3.0


class Surroundings(Protocol):
    """Where a vehicle is, for what depends on that: the world's frame, north and east, m.

    Robots count on from the last to the first.
    """

    def outwards(self, robot: int) -> Vector:
        """In the plane: the way to the nearest line of the fence."""
        ...

    def inside_m(self, robot: int) -> float:
        """How far inside that line the vehicle takes itself to be."""
        ...

    def height_m(self, robot: int) -> float:
        """The height that a robot flies at."""
        ...

    def highest_m(self) -> float:
        """The height of the robot that flies highest."""
        ...

    def place_m(self, robot: int) -> F64:
        """(2,): the pad that a robot stood on at first, where it really is."""
        ...


class VehicleInjection:
    """Something that is done to a simulated vehicle."""

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        """Do it now."""
        raise NotImplementedError


class PilotInjection(VehicleInjection):
    """Something that is done by way of the vehicle's remote control, or its mode."""

    def apply(self, vehicle: PilotedVehicle, robot: int, around: Surroundings) -> None:
        """Do it now."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class LoseGps(VehicleInjection):
    """Its receiver sees no satellite, or sees them again."""

    lost: bool = True

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        vehicle.gps_lost = self.lost


@dataclass(frozen=True, slots=True)
class BatteryIs(VehicleInjection):
    """Its battery has this share left from now on."""

    remaining: float

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        vehicle.battery_remaining = self.remaining


@dataclass(frozen=True, slots=True)
class Drain(BatteryIs):
    """It falls to it in flight: PX4's own simulator drains only a battery of an armed vehicle."""


@dataclass(frozen=True, slots=True)
class SensorDies(VehicleInjection):
    """A driver says nothing any more."""

    sensor: SimulatedSensor

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        vehicle.dead_sensors.add(self.sensor)


@dataclass(frozen=True, slots=True)
class ReceiverReports(VehicleInjection):
    """The receiver says that its fix is so accurate; None: what it usually says."""

    accuracy_m: float | None

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        vehicle.gps_told_m = self.accuracy_m


@dataclass(frozen=True, slots=True)
class ReceiverJumps(VehicleInjection):
    """The receiver's fix lies that far away from where it was, outwards."""

    by_m: float

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        vehicle.gps_jump_m = times(around.outwards(robot), self.by_m)


@dataclass(frozen=True, slots=True)
class ReceiverSticks(VehicleInjection):
    """The receiver repeats its last place as a fresh fix, with a velocity of 0."""

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        vehicle.receiver.stuck = True


@dataclass(frozen=True, slots=True)
class ReceiverLies(VehicleInjection):
    """The receiver's places walk off, its velocity is biased (both outwards), or places scatter."""

    creep_m_s: float = 0.0
    velocity_bias_m_s: float = 0.0
    scatter_m: float = 0.0

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        outwards = around.outwards(robot)
        vehicle.receiver.creep_m_s = times(outwards, self.creep_m_s)
        vehicle.receiver.velocity_bias_m_s = times(outwards, self.velocity_bias_m_s)
        vehicle.receiver.scatter_m = self.scatter_m


@dataclass(frozen=True, slots=True)
class EstimateFreezes(VehicleInjection):
    """Position and velocity go on being told, and are the old ones."""

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        vehicle.estimate_frozen = True


@dataclass(frozen=True, slots=True)
class EstimateDrifts(VehicleInjection):
    """The estimate, and the receiver with it, walks away from the truth: inwards, and down.

    So the vehicle itself is led outwards, and up.
    """

    inwards_m_s: float = 0.0
    down_m_s: float = 0.0

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        north, east, _ = times(around.outwards(robot), -self.inwards_m_s)
        vehicle.gps_drift_m_s = north, east, self.down_m_s


@dataclass(frozen=True, slots=True)
class HeightJumps(VehicleInjection):
    """The estimate of height jumps, and no new origin explains it."""

    up_m: float

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        vehicle.gps_offset_m = minus(vehicle.gps_offset_m, (0.0, 0.0, self.up_m))


@dataclass(frozen=True, slots=True)
class EstimateJumpsOut(VehicleInjection):
    """The estimate, and the receiver with it, is all at once that far beyond the fence's line."""

    beyond_m: float

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        jump_m = times(around.outwards(robot), around.inside_m(robot) + self.beyond_m)
        vehicle.gps_offset_m = plus(vehicle.gps_offset_m, jump_m)


@dataclass(frozen=True, slots=True)
class EstimateIsRight(VehicleInjection):
    """End the estimator's error: its position jumps back."""

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        vehicle.gps_offset_m = ZERO


@dataclass(frozen=True, slots=True)
class OriginJumps(VehicleInjection):
    """The estimator starts over from another origin: north, east, down."""

    by_m: tuple[float, float, float]

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        vehicle.jump_estimator_origin(*self.by_m)


@dataclass(frozen=True, slots=True)
class CompassJumps(VehicleInjection):
    """Make the estimated heading jump."""

    by_deg: float

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        vehicle.compass_jump_rad = math.radians(self.by_deg)


@dataclass(frozen=True, slots=True)
class WindBlows(VehicleInjection):
    """Besides the fleet's own wind, a storm outwards (0: none), and gusts (standard deviation)."""

    outwards_m_s: float = 0.0
    gusts_m_s: float = 0.0

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        vehicle.wind_m_s = times(around.outwards(robot), self.outwards_m_s)
        vehicle.gust_m_s = self.gusts_m_s


@dataclass(frozen=True, slots=True)
class MotorWeakens(VehicleInjection):
    """It loses that share of its thrust."""

    loss: float

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        vehicle.motor_loss = self.loss


@dataclass(frozen=True, slots=True)
class WireIs(VehicleInjection):
    """Faults of all MAVLink messages between computer and autopilot."""

    wire: MavlinkWire

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        vehicle.wire = self.wire


@dataclass(frozen=True, slots=True)
class RemoteControl(PilotInjection):
    """Somebody's remote control is on and heard, or not."""

    on: bool

    def apply(self, vehicle: PilotedVehicle, robot: int, around: Surroundings) -> None:
        vehicle.rc_connected = self.on


@dataclass(frozen=True, slots=True)
class FenceCleared(VehicleInjection):
    """Another ground station clears PX4's fence."""

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        vehicle.fence = ()


@dataclass(frozen=True, slots=True)
class ParameterIs(VehicleInjection):
    """One of PX4's own parameters has this value, set by another ground station."""

    name: str
    value: float

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        vehicle.parameters[self.name] = self.value


@dataclass(frozen=True, slots=True)
class ModeIs(PilotInjection):
    """A ground station asks for a mode of PX4."""

    mode: Px4Mode

    def apply(self, vehicle: PilotedVehicle, robot: int, around: Surroundings) -> None:
        vehicle.set_mode(self.mode)


@dataclass(frozen=True, slots=True)
class PilotFlies(PilotInjection):
    """A pilot takes it by remote control, and flies it outwards and up at these speeds."""

    outwards_m_s: float = 0.0
    up_m_s: float = 0.0

    def apply(self, vehicle: PilotedVehicle, robot: int, around: Surroundings) -> None:
        north, east, _ = times(around.outwards(robot), self.outwards_m_s)
        vehicle.pilot(Px4Mode.POSCTL, (north, east, -self.up_m_s))


@dataclass(frozen=True, slots=True)
class PilotLands(PilotInjection):
    """The pilot who has it lands it."""

    def apply(self, vehicle: PilotedVehicle, robot: int, around: Surroundings) -> None:
        vehicle.move_sticks(())
        vehicle.set_mode(Px4Mode.LAND)


@dataclass(frozen=True, slots=True)
class CarriedToPad(VehicleInjection):
    """Somebody carries it to another robot's pad, or beside it: on the ground, motors off.

    `to_pad` is how many robots on that one is.
    """

    to_pad: int = 1
    beside_m: float = 0.0

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        if not vehicle.armed:
            north_m, east_m = around.place_m(robot + self.to_pad).tolist()
            vehicle.position_m = np.array([north_m + self.beside_m, east_m, 0.0])


@dataclass(frozen=True, slots=True)
class PilotFliesOver(VehicleInjection):
    """A pilot flies it over a robot's pad, at that robot's height; for one second.

    `pad` is how many robots on that one is.
    """

    pad: int = 1

    def apply(self, vehicle: Px4Vehicle, robot: int, around: Surroundings) -> None:
        pad_m, height_m = around.place_m(robot + self.pad), around.height_m(robot + self.pad)
        # Over everybody's heads on the way there.
        if math.dist(vehicle.position_m[:2], pad_m) > _PILOT_ARRIVED_M:
            height_m = around.highest_m() + _PILOT_ABOVE_M
        target_m = np.array([*pad_m, -height_m])
        wanted_m_s = _PILOT_GAIN_PER_S * (target_m - vehicle.position_m)
        fastest = max(1.0, float(np.linalg.norm(wanted_m_s)) / _PILOT_M_S)
        if vehicle.mode is not Px4Mode.POSCTL:
            vehicle.pilot(Px4Mode.POSCTL)
        vehicle.move_sticks((wanted_m_s / fastest).tolist())


# What is done to programs, to the radio and to the ground


@dataclass(frozen=True, slots=True)
class ProgramDies:
    """Like kill -9, or a computer that loses its power."""


@dataclass(frozen=True, slots=True)
class ProgramEnds:
    """It is told to end (SIGTERM), as `systemctl stop` does."""


@dataclass(frozen=True, slots=True)
class ProgramStarts:
    """It starts again."""


@dataclass(frozen=True, slots=True)
class ProgramStops:
    """All of it stands still for so long, as by SIGSTOP and SIGCONT."""

    for_s: float


@dataclass(frozen=True, slots=True)
class LoopHangs:
    """One of its loops stands still for so long: control, perception, policy, preflight, status."""

    loop: Literal["control", "perception", "policy", "preflight", "status"]
    for_s: float


@dataclass(frozen=True, slots=True)
class WatchdogDies:
    """The process that watches the program is gone."""


@dataclass(frozen=True, slots=True)
class DiskFills:
    """Nothing more can be written."""


@dataclass(frozen=True, slots=True)
class ClockSteps:
    """The wall clock of its computer steps."""

    by_s: float


@dataclass(frozen=True, slots=True)
class GroundClockSteps:
    """The wall clock of the operator's laptop steps."""

    by_s: float


@dataclass(frozen=True, slots=True)
class SecondProgram:
    """Another computer says that it is this robot, with a vehicle of its own."""


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
class GroundStops:
    """The ground's program stands still for so long, as a laptop that sleeps."""

    for_s: float


@dataclass(frozen=True, slots=True)
class GroundDies:
    """Like a laptop whose battery is empty."""


@dataclass(frozen=True, slots=True)
class GroundStarts:
    """It starts again on the same laptop."""


@dataclass(frozen=True, slots=True)
class SecondGroundJoins:
    """Another operator's laptop is on the radio from now on, and commands nothing."""


@dataclass(frozen=True, slots=True)
class SecondGroundHolds:
    """That other operator holds all robots."""


@dataclass(frozen=True, slots=True)
class SecondGroundTakesCommand:
    """That other operator commands the fleet from now on."""


@dataclass(frozen=True, slots=True)
class SecondGroundDies:
    """That other operator's laptop is gone."""


OrderedKind = Literal[
    "takeoff", "start", "pilot", "rejoin", "kill", "disarm", "hold", "return", "land", "resume"
]


@dataclass(frozen=True, slots=True)
class OperatorOrders:
    """The operator commands something of the robots meant, and does not wait for the answer."""

    kind: OrderedKind


@dataclass(frozen=True, slots=True)
class FenceWithout:
    """The operator sets a fence that the landing point of a robot lies outside of."""


Injection = (
    VehicleInjection | ProgramDies | ProgramEnds | ProgramStarts | ProgramStops | LoopHangs
    | WatchdogDies | DiskFills | ClockSteps | GroundClockSteps | SecondProgram
    | RadioIs | RadioCut | GroundStops | GroundDies | GroundStarts | SecondGroundJoins
    | SecondGroundHolds | SecondGroundTakesCommand | SecondGroundDies | OperatorOrders
    | FenceWithout
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Do:
    """Something happens `at_s` after the fault's begin, to those that it hits, to all, or others.

    A `mark` names the time, for bounds that count from it. What is done to ground or radio is done
    once.
    """

    at_s: float
    injection: Injection
    to: Literal["hit", "all", "others", "next"] = "hit"
    mark: str = ""
