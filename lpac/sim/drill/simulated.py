"""Faults on the simulated clock: whole robots and the real ground station, in this process."""

import math
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar, assert_never, get_args

import numpy as np

from edge.core import F64
from lpac.analysis.flight import FlightRecord
from lpac.analysis.truth import TrueTrack
from lpac.ground.procedure import NoSnapshotError, Procedure, Until, carry_out
from lpac.ground.station.protocol import Request, SafetyCommand, TakeCommand
from lpac.sim.air import GROUND
from lpac.sim.drill.faults import FAULTS, Fault
from lpac.sim.drill.field import FaultyFleet, has_remote_control, settings_of
from lpac.sim.drill.flight import fly, to_mission, to_ready
from lpac.sim.drill.injections import (
    ClockSteps,
    Cut,
    DiskFills,
    Do,
    GroundClockSteps,
    GroundStops,
    Injection,
    Laptop,
    LoopHangs,
    OnVehicle,
    ProgramStops,
    RadioCut,
    RadioIs,
    RobotProgram,
    SecondLaptop,
    SecondProgram,
)
from lpac.sim.fleet.layout import WORLD
from lpac.sim.fleet.simulated import SimulatedFleet, SimulatedGround
from lpac.sim.fleet.vehicles import track_of
from lpac.sim.px4.direct import DirectVehicle
from lpac.sim.px4.vehicle import Px4Vehicle
from lpac.sim.scenario import WORLD_SENSOR, Scenario

# How far a second program's vehicle stands from the first.
_SECOND_VEHICLE_M = 3.0
# The other operator.
_SECOND = "second"
SUPPORTED: tuple[object, ...] = get_args(Injection)

T = TypeVar("T")


class SimulatedField(FaultyFleet):
    """A simulated fleet under faults."""

    def __init__(self, fleet: SimulatedFleet) -> None:
        super().__init__(fleet.layout)
        self.fleet = fleet
        self._operator = next(iter(fleet.grounds))

    def copy(self) -> "SimulatedField":
        """Independent copy of the current state."""
        copied = SimulatedField(self.fleet.copy())
        copied.orders = list(self.orders)
        return copied

    @property
    def ground(self) -> SimulatedGround:
        """The operator's ground station, which may have been restarted."""
        return self.fleet.grounds[self._operator]

    @property
    def ground_runs(self) -> bool:
        return self.ground.runs

    def now_s(self) -> float:
        """Simulated time, s."""
        return self.fleet.schedule.monotonic_s()

    def unix_now_s(self) -> float:
        """Unix time of the clocks that were not stepped."""
        return self.fleet.schedule.unix_s()

    def at(self, after_s: float, do: Do, hit: tuple[int, ...]) -> None:
        self.fleet.schedule.at(self.now_s() + after_s, partial(self.apply, do, hit))

    def all_down(self) -> bool:
        return all(
            each.vehicle.landed and not each.vehicle.armed and each.vehicle.position_m[2] >= 0.0
            for each in self.fleet.vehicles
        )

    def carry_out(self, procedure: Procedure[T]) -> T:
        """Run a procedure, which goes on after a command that times out."""

        # `self.ground` changes when the ground restarts.
        def command(request: Request) -> None:
            with suppress(NoSnapshotError):
                self.ground.command(request)

        def wait(until: Until) -> bool:
            return self.ground.wait(until)

        return carry_out(procedure, command, wait)

    @property
    def vehicles(self) -> Sequence[Px4Vehicle]:
        """All vehicles; those of second programs come last."""
        return [each.vehicle for each in self.fleet.vehicles]

    @property
    def robots_by_name(self) -> dict[str, int]:
        """Robot ids by the names in the ground station's setup."""
        return dict(self.ground.setup.robots)

    def height_m(self, robot: int) -> float:
        config = self.fleet.robots[robot % len(self.fleet.robots)].config
        return config.flight.slot_height_m

    def send(self, request: Request) -> bool:
        """Begin a command at the ground station."""
        if self.ground_runs:
            self.ground.node.begin(request)
        return self.ground_runs

    def tracks(self) -> tuple[TrueTrack, ...]:
        return tuple(track_of(vehicle.truth) for vehicle in self.vehicles)

    def inject(self, injection: Injection, robots: tuple[int, ...]) -> None:
        fleet = self.fleet
        match injection:
            case OnVehicle():
                for robot in robots:
                    injection.apply(fleet.vehicles[robot].vehicle, robot, self)
            case RadioIs(loss, duplication, corruption, delay_s):
                fleet.radio.air = replace(
                    fleet.radio.air, loss=loss, duplication=duplication, corruption=corruption,
                    delay_s=delay_s,
                )  # fmt: skip
            case RadioCut(cut):
                partition = _partition(cut, len(fleet.robots))
                fleet.radio.air = replace(fleet.radio.air, partition=partition)
            case GroundStops(for_s):
                self.ground.suspend(for_s)
            case Laptop("dies"):
                self.ground.leave()
            case Laptop("starts"):
                fleet.join(self._operator)
            case GroundClockSteps(by_s):
                self.ground.clock.ahead_s += by_s
            case SecondLaptop():
                self._inject_second_laptop(injection)
            case _:
                for robot in robots:
                    self._inject_program(injection, robot)

    def _inject_second_laptop(self, injection: SecondLaptop) -> None:
        match injection.event:
            case "joins":
                self.fleet.join(_SECOND)
            case "holds all":
                self.fleet.grounds[_SECOND].node.begin(SafetyCommand("hold"))
            case "takes command":
                self.fleet.grounds[_SECOND].node.begin(TakeCommand())
            case "dies":
                self.fleet.grounds[_SECOND].leave()

    def _inject_program(self, injection: Injection, index: int) -> None:
        robot = self.fleet.robots[index]
        match injection:
            case RobotProgram("dies"):
                robot.stop()
            case RobotProgram("ends"):
                robot.end()
            case RobotProgram("starts"):
                robot.start()
            case ProgramStops(for_s):
                robot.hang(for_s)
                self.fleet.radio.suspend(index, for_s)
            case LoopHangs(loop, for_s):
                robot.loops[loop].hang(for_s)
            case RobotProgram("loses its watchdog"):
                assert robot.watchdog is not None
                robot.watchdog.die()
            case DiskFills():
                robot.fill_disk()
            case ClockSteps(by_s):
                robot.clock.ahead_s += by_s
            case SecondProgram():
                self._start_second(index)
            case _:
                raise TypeError(f"{injection} is not done to a program")

    def _start_second(self, robot: int) -> None:
        places_m = np.array([each.vehicle.position_m[:2] for each in self.fleet.vehicles])
        start_m = _clear_place_m(places_m, robot)
        vehicle = Px4Vehicle(seed=robot, start_m=start_m, origin=WORLD)
        direct = DirectVehicle(vehicle, robot + 1, self.fleet.schedule)
        self.fleet.second_program(robot, direct).start()


class _Bases(NamedTuple):
    """Fleets in the ready state and in the mission, copied for each flight."""

    ready: SimulatedField
    mission: SimulatedField


class SimulatedDrill:
    """Fly faults on the simulated clock, one by one; those of one scenario share their start.

    A flight depends on fault, scenario and bundle alone. Sensors other than the built-in one may
    have a device or a state, so their flights share nothing.
    """

    def __init__(self, bundle: Path) -> None:
        self._bundle = bundle
        self._key: object = None
        self._bases: _Bases | None = None

    def fly(self, scenario: Scenario, logs: Path | None = None) -> FlightRecord:
        """Fly the scenario's fault. The robots write their logs in the folder `logs`, if given."""
        fault = FAULTS[scenario.fault]
        on_ground = fault.phase in ("ready", "takeoff")
        if logs is None and scenario.sensor == WORLD_SENSOR:
            bases = self._of(fault, scenario)
            field = (bases.ready if on_ground else bases.mission).copy()
        else:
            with tempfile.TemporaryDirectory() as nowhere:
                folder = Path(nowhere) if logs is None else logs
                field = self._ready(fault, scenario, folder, logged=logs is not None)
            if not on_ground:
                field.carry_out(to_mission(field))
        timeline = field.carry_out(fly(field, fault, scenario))
        field.fleet.close()
        return field.record(timeline)

    def _of(self, fault: Fault, scenario: Scenario) -> _Bases:
        key = (replace(scenario, fault=""), fault.settings)
        if self._bases is None or key != self._key:
            with tempfile.TemporaryDirectory() as folder:
                ready = self._ready(fault, scenario, Path(folder))
            mission = ready.copy()
            mission.carry_out(to_mission(mission))
            self._key, self._bases = key, _Bases(ready, mission)
        return self._bases

    def _ready(
        self, fault: Fault, scenario: Scenario, folder: Path, *, logged: bool = False
    ) -> SimulatedField:
        settings = settings_of(fault)
        fleet = SimulatedFleet(scenario, folder, self._bundle, settings=settings, logs=logged)
        if has_remote_control(fault):
            for each in fleet.vehicles:
                each.vehicle.rc_connected = True
        field = SimulatedField(fleet)
        field.carry_out(to_ready(field))
        return field


def _clear_place_m(places_m: F64, robot: int) -> tuple[float, float]:
    """A place near the robot's, clear of the others at `places_m` (N, 2)."""
    angles_rad = np.arange(8) * (math.pi / 4.0)
    around_m = places_m[robot] + _SECOND_VEHICLE_M * np.column_stack(
        [np.cos(angles_rad), np.sin(angles_rad)]
    )
    to_others_m = np.linalg.norm(around_m[:, None] - np.delete(places_m, robot, axis=0), axis=2)
    north_m, east_m = around_m[to_others_m.min(axis=1, initial=math.inf).argmax()].tolist()
    return north_m, east_m


def _partition(cut: Cut, robots: int) -> tuple[frozenset[int], ...]:
    ground, each = frozenset({GROUND}), tuple(frozenset({robot}) for robot in range(robots))
    if cut == "none":
        return ()
    if cut == "from the ground":
        return ground, frozenset(range(robots))
    if cut == "from each other":
        return each
    if cut == "all":
        return ground, *each
    if cut == "in halves":
        half = (robots + 1) // 2
        return ground | frozenset(range(half)), frozenset(range(half, robots))
    assert_never(cut)
