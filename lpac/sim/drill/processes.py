"""Faults in real time: programs of robots and ground station, on simulated vehicles or real PX4s.

Flights are judged by the same bounds as on the simulated clock. The record has the lateness of this
machine.
"""

import heapq
import itertools
import signal
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from types import TracebackType
from typing import Self, TypeVar

from edge.robot.config import Rates, load_config
from lpac.analysis.flight import FlightRecord
from lpac.analysis.truth import TrueTrack
from lpac.ground.procedure import Ground, NoSnapshotError, Procedure, Until, carry_out
from lpac.ground.station.client import GroundError
from lpac.ground.station.protocol import Request
from lpac.sim.drill import injections
from lpac.sim.drill.faults import Fault
from lpac.sim.drill.field import FaultyFleet, Timeline, has_remote_control
from lpac.sim.drill.flight import fly, to_mission, to_ready
from lpac.sim.drill.injections import (
    BY_PILOTS,
    Do,
    FenceWithout,
    GroundStops,
    Injection,
    Laptop,
    OnVehicle,
    OperatorOrders,
    ProgramStops,
    RobotProgram,
)
from lpac.sim.fleet.ground import GroundProgram
from lpac.sim.fleet.layout import WORLD
from lpac.sim.fleet.processes import Fleet
from lpac.sim.fleet.vehicles import SimulatedVehicles, VehicleError, track_of
from lpac.sim.px4.vehicle import Px4Vehicle
from lpac.sim.scenario import Scenario
from lpac.sim.sitl.build import Px4Build
from lpac.sim.sitl.ground_station import RealVehicle, RealVehicles

# Injections into programs, and commands of the operator, on any vehicles.
_PROGRAMS = (RobotProgram, ProgramStops, Laptop, GroundStops, OperatorOrders, FenceWithout)
# Not supported: cutting this machine's network, filling its disk, stepping its clock, or hanging
# one loop of a real program.
MAVLINK: tuple[object, ...] = (OnVehicle, *_PROGRAMS)
# Injections by a ground station, or by PX4's own simulator.
_ON_REAL: dict[object, Callable[..., None]] = {
    injections.lose_gps: RealVehicle.lose_gps,
    injections.drain: RealVehicle.drain,
    injections.change_battery: RealVehicle.change_battery,
    injections.set_parameter: RealVehicle.set_parameter,
    injections.clear_fence: RealVehicle.clear_fence,
    injections.jump_origin: RealVehicle.jump_estimator_origin,
    injections.weaken_motors: RealVehicle.weaken_motors,
}
PX4: tuple[object, ...] = (*_ON_REAL, *BY_PILOTS, *_PROGRAMS)

# Timeout of a command, for each robot.
_PATIENCE_S = 60.0
# A vehicle steps every 0.02 s; without a step, look after this time.
_LOOK_S = 0.5
_KILLED_S = 10.0
# A laptop needs less than half of it; a longer start counts as lateness.
_GROUND_STARTS_WITHIN_S = 2.0
# Delay until PX4 (v1.17) reports a battery below 25 % or 15 %, after a fall to 0.5 % less.
_BATTERY_REPORTED_S = 5.5

T = TypeVar("T")


class ProcessField(FaultyFleet):
    """A fleet of processes under faults; a context, within those of its parts.

    A thread of its own runs the injections, on the vehicles' clock.
    """

    def __init__(self, fleet: Fleet, ground: GroundProgram, stepped: threading.Condition) -> None:
        """Hold `stepped` to change vehicles; it is notified after each step."""
        super().__init__(fleet.layout)
        self.fleet = fleet
        self.stepped = stepped
        self._ground = ground
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._count = itertools.count()
        self._over = False
        self._failed: Exception | None = None
        self._heights_m = [
            load_config(robot.folder / "robot.toml").flight.slot_height_m for robot in fleet.robots
        ]
        self._stopped: set[int] = set()
        self._late_s = self._ground_late_s = 0.0
        self._thread = threading.Thread(target=self._run, name="faults", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        with self.stepped:
            self._over = True
            self.stepped.notify_all()
        self._thread.join()

    @property
    def ground(self) -> Ground:
        """The operator's ground station, as last reported."""
        return self._ground.subscriber

    @property
    def ground_runs(self) -> bool:
        return self._ground.running

    def at(self, after_s: float, do: Do, hit: tuple[int, ...]) -> None:
        self._at(self.now_s() + after_s, partial(self.apply, do, hit))

    def carry_out(self, procedure: Procedure[T]) -> T:
        """Run a procedure, which goes on after a command that times out.

        Raises the error of a failed injection, OverloadError or VehicleError.
        """
        return carry_out(procedure, self._command, self._wait)

    @property
    def robots_by_name(self) -> dict[str, int]:
        """Robot ids by the names of the programs."""
        return {robot.name: robot.robot_id for robot in self.fleet.robots}

    def height_m(self, robot: int) -> float:
        """Flight height by the robot's robot.toml, m."""
        return self._heights_m[robot % len(self._heights_m)]

    def send(self, request: Request) -> bool:
        """Send a command; a thread awaits the answer."""

        def command() -> None:
            # The ground station may end before it answers.
            with suppress(GroundError):
                self._ground.command(request)

        if self.ground_runs:
            threading.Thread(target=command, name="operator", daemon=True).start()
        return self.ground_runs

    def inject(self, injection: Injection, robots: tuple[int, ...]) -> None:
        match injection:
            case OnVehicle():
                with self.stepped:
                    for robot in robots:
                        self.inject_vehicle(injection, robot)
            case Laptop("dies"):
                self._ground.kill()
            case Laptop("starts"):
                began_s = time.monotonic()
                self._ground.start()
                took_s = time.monotonic() - began_s
                self._ground_late_s = max(0.0, took_s - _GROUND_STARTS_WITHIN_S)
            case GroundStops(for_s):
                self._ground.suspend()
                self._at(self.now_s() + for_s, self._ground.wake)
            case _:
                for robot in robots:
                    self._inject_program(injection, robot)

    def unix_now_s(self) -> float:
        """This machine's Unix time."""
        return time.time()

    def late_s(self) -> float:
        """Lateness measured in `fly`, s."""
        return self._late_s

    def fly(self, fault: Fault, scenario: Scenario) -> Timeline:
        """Fly from the programs' start to the end. Raises the same as `carry_out`."""
        self.carry_out(to_ready(self))
        self.fleet.begin()
        began_s = time.monotonic()
        if fault.phase in ("mission", "return"):
            self.carry_out(to_mission(self))
        timeline = self.carry_out(fly(self, fault, scenario))
        self._late_s = self._late_since_s(began_s)
        return timeline

    def _late_since_s(self, began_s: float) -> float:
        """Greatest lateness, s: of the vehicles, of a robot's control, or of a ground's restart.

        Programs that an injection stopped do not count.
        """
        late_s = [self.vehicles_late_s(began_s), self._ground_late_s]
        for robot in self.robots_by_name.values():
            overruns = [
                received.status.loops["control"].overruns
                for received in self.fleet.listener.history(robot)
                if received.at_s >= began_s and "control" in received.status.loops
            ]
            if overruns and robot not in self._stopped:
                late_s.append((overruns[-1] - overruns[0]) / Rates().control_hz)
        return max(late_s)

    @abstractmethod
    def inject_vehicle(self, injection: OnVehicle, robot: int) -> None:
        """Inject now; the caller holds `stepped`."""

    @abstractmethod
    def vehicles_late_s(self, began_s: float) -> float:
        """Lateness of the vehicles since `began_s` (`time.monotonic()`), s."""

    def _inject_program(self, injection: Injection, index: int) -> None:
        robot = self.fleet.robots[index]
        self._stopped.add(index)
        match injection:
            case RobotProgram("dies"):
                robot.send_signal(signal.SIGKILL)
            case RobotProgram("ends"):
                robot.send_signal(signal.SIGTERM)
            case RobotProgram("starts"):
                # systemd too kills a hanging program before the restart.
                robot.send_signal(signal.SIGKILL)
                robot.wait(_KILLED_S)
                robot.start()
            case ProgramStops(for_s):
                robot.send_signal(signal.SIGSTOP)
                self._at(self.now_s() + for_s, partial(robot.send_signal, signal.SIGCONT))
            case RobotProgram("loses its watchdog"):
                robot.kill_watchdog()
            case _:
                raise TypeError(f"{injection} is not done to a program")

    def _at(self, at_s: float, inject: Callable[[], None]) -> None:
        with self.stepped:
            heapq.heappush(self._due, (at_s, next(self._count), inject))

    def _run(self) -> None:
        def is_due() -> bool:
            return self._over or bool(self._due and self._due[0][0] <= self.now_s())

        while True:
            with self.stepped:
                self.stepped.wait_for(is_due)
                if self._over:
                    return
                _, _, inject = heapq.heappop(self._due)
            try:
                inject()
            except Exception as error:
                self._failed = error
                return

    def _wait(self, until: Until) -> bool:
        end_s = self.now_s() + until.at_most_s
        while True:
            self._look()
            with self.stepped:
                if until.condition(self.ground.snapshot):
                    return True
                if self.now_s() >= end_s:
                    return False
                self.stepped.wait(_LOOK_S)

    def _command(self, request: Request) -> None:
        end_s = time.monotonic() + _PATIENCE_S * len(self.fleet.robots)

        def look() -> None:
            self._look()
            if time.monotonic() > end_s:
                raise NoSnapshotError

        with suppress(GroundError, NoSnapshotError):
            self._ground.command(request, look)

    def _look(self) -> None:
        if self._failed is not None:
            raise self._failed
        self.fleet.vehicles.require_running()
        self.fleet.require_keeping_up()


class MavlinkField(ProcessField):
    """Field with simulated vehicles, which a thread of this process flies."""

    def __init__(self, fleet: Fleet, ground: GroundProgram, simulated: SimulatedVehicles) -> None:
        super().__init__(fleet, ground, simulated.stepped)
        self._simulated = simulated

    def now_s(self) -> float:
        """Time of the vehicles, which share one clock, s."""
        with self.stepped:
            return self.vehicles[0].time_s

    @property
    def vehicles(self) -> Sequence[Px4Vehicle]:
        """The simulated vehicles."""
        return self._simulated.vehicles

    def all_down(self) -> bool:
        with self.stepped:
            return all(
                vehicle.landed and not vehicle.armed and vehicle.position_m[2] >= 0.0
                for vehicle in self.vehicles
            )

    def vehicles_late_s(self, began_s: float) -> float:
        """Total lateness of the vehicles, s."""
        return self.fleet.lateness().vehicles_s

    def inject_vehicle(self, injection: OnVehicle, robot: int) -> None:
        """Inject into the simulated vehicle."""
        injection.apply(self.vehicles[robot], robot, self)

    def tracks(self) -> tuple[TrueTrack, ...]:
        with self.stepped:
            truths = [tuple(vehicle.truth) for vehicle in self.vehicles]
        return tuple(map(track_of, truths))


class Px4Field(ProcessField):
    """Field with real PX4s and PX4's own vehicle model; its clock starts at its creation."""

    def __init__(self, fleet: Fleet, ground: GroundProgram, px4s: RealVehicles) -> None:
        super().__init__(fleet, ground, px4s.stepped)
        self._px4s = px4s
        self._made_s = time.monotonic()

    def lead_s(self, injection: Injection) -> float:
        """PX4's filter delays its report of a sudden drop of the battery."""
        is_drain = isinstance(injection, OnVehicle) and injection.kind is injections.drain
        return _BATTERY_REPORTED_S if is_drain else 0.0

    def now_s(self) -> float:
        """Time since the creation, s."""
        return time.monotonic() - self._made_s

    @property
    def vehicles(self) -> Sequence[RealVehicle]:
        """The vehicles as a ground station receives them."""
        return self._px4s.vehicles

    def all_down(self) -> bool:
        with self.stepped:
            return all(vehicle.landed and not vehicle.armed for vehicle in self.vehicles)

    def vehicles_late_s(self, began_s: float) -> float:
        """The longest standstill of a PX4's clock, s.

        On a busy machine the clock and its timers run some per cent slow, which is allowed.
        """
        assert isinstance(self.fleet.vehicles, Px4Build)
        return self.fleet.vehicles.stood_still_s(began_s)

    def inject_vehicle(self, injection: OnVehicle, robot: int) -> None:
        """Inject over the ground station's link, or by the pilot's remote control."""
        vehicle = self.vehicles[robot]
        if injection.kind in BY_PILOTS:
            injection.apply(vehicle, robot, self)
        else:
            _ON_REAL[injection.kind](vehicle, *injection.arguments, **injection.named)

    def tracks(self) -> tuple[TrueTrack, ...]:
        """True tracks by PX4's own logs, which are complete once it has ended.

        Raises VehicleError without a log, or if a PX4 did not confirm an injected parameter.
        """
        tracks = self.fleet.vehicles.tracks()
        for robot, track in enumerate(tracks):
            vehicle = self.vehicles[robot]
            if vehicle.unconfirmed:
                names = ", ".join(vehicle.unconfirmed)
                raise VehicleError(
                    f"could not be flown: the PX4 of r{robot} did not confirm {names}"
                )
            if not len(track.mode):
                raise VehicleError(f"the PX4 of r{robot} has left no log of its flight")
        return tuple(track.shifted(-self._made_s) for track in tracks)


def fly_fault(fleet: Fleet, fault: Fault) -> FlightRecord:
    """Fly the fault once; the fleet was made with its settings."""
    with (
        fleet,
        GroundProgram(fleet.fleet_toml, fleet.name) as ground,
        process_field(fleet, ground) as field,
    ):
        if has_remote_control(fault):
            with field.stepped:
                for vehicle in field.vehicles:
                    vehicle.rc_connected = True
        timeline = field.fly(fault, fleet.layout.scenario)
    return field.record(timeline)


@contextmanager
def process_field(fleet: Fleet, ground: GroundProgram) -> Iterator[ProcessField]:
    """The field for the fleet's kind of vehicles; it ends before the programs."""
    with ExitStack() as stack:
        field: ProcessField
        if fleet.simulated is not None:
            field = MavlinkField(fleet, ground, fleet.simulated)
        else:
            assert isinstance(fleet.vehicles, Px4Build)
            px4s = stack.enter_context(RealVehicles(fleet.vehicles, WORLD))
            field = Px4Field(fleet, ground, px4s)
        yield stack.enter_context(field)
