"""Faults on the simulated clock: whole robots and the real ground, in this process."""

import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, assert_never

import numpy as np

from edge.core import F64
from edge.core.fence import Fence
from edge.flight.margins import ErrorBudget
from lpac.ground.procedure import NothingComesError, Procedure
from lpac.ground.station.protocol import (
    Request,
    Resume,
    RobotCommand,
    SafetyCommand,
    SetFence,
    Start,
    Takeoff,
)
from lpac.sim.description import ERRORS
from lpac.sim.drill.faults import Fault
from lpac.sim.drill.flight import Timeline, fly, to_mission, to_ready
from lpac.sim.drill.injections import (
    AutopilotSilent,
    ClockSteps,
    Cut,
    DiskFills,
    Do,
    FenceWithout,
    GroundClockSteps,
    GroundDies,
    GroundStarts,
    GroundStops,
    Injection,
    LoopHangs,
    OperatorOrders,
    OrderedKind,
    ProgramDies,
    ProgramStarts,
    ProgramStops,
    RadioCut,
    RadioIs,
    SecondProgram,
    VehicleInjection,
    WatchdogDies,
)
from lpac.sim.drill.truth import FlightTruth, GivenOrder, vehicle_truth
from lpac.sim.fleet.layout import WORLD, FleetScenario
from lpac.sim.fleet.simulated import SimulatedFleet, SimulatedGround
from lpac.sim.px4.direct import DirectVehicle
from lpac.sim.px4.vehicle import Px4Vehicle
from lpac.sim.radio import GROUND

# Receivers with corrections, and heights that hardly walk.
EXACT = ErrorBudget(
    gps_m=0.25, height_apart_m=0.2, height_common_m=0.0, takeoffs_height_m=0.0, pads_height_m=0.2
)
# Where a second program's vehicle stands, north of the first.
_BESIDE_M = 3.0
# How long an order that nobody waits for is valid.
_ORDER_S = 10.0

T = TypeVar("T")


class SimulatedField:
    """A simulated fleet as a `Field` of the drill; `orders` are all that were given."""

    def __init__(self, fleet: SimulatedFleet) -> None:
        self.fleet = fleet
        self.orders: list[GivenOrder] = []
        self._operator = next(iter(fleet.grounds))

    def copy(self) -> "SimulatedField":
        """The same once more, as it is now."""
        copied = SimulatedField(self.fleet.copy())
        copied.orders = list(self.orders)
        return copied

    # The drill's field

    @property
    def ground(self) -> SimulatedGround:
        """The operator's, which may have started again."""
        return self.fleet.grounds[self._operator]

    @property
    def ground_runs(self) -> bool:
        """Whether it does."""
        return self.ground.runs

    def now_s(self) -> float:
        """The simulated clock."""
        return self.fleet.schedule.monotonic_s()

    def at(self, after_s: float, do: Do, hit: tuple[int, ...]) -> None:
        """Have something happen, so much later."""
        self.fleet.schedule.at(self.now_s() + after_s, partial(self._happen, do, hit))

    def all_down(self) -> bool:
        """Whether all vehicles really stand on the ground, motors off."""
        return all(
            each.vehicle.landed and not each.vehicle.armed and each.vehicle.position_m[2] >= 0.0
            for each in self.fleet.vehicles
        )

    def noted(self, request: Request) -> Callable[[], None]:
        """Note that something is commanded now; call the result when it is answered."""
        index = len(self.orders)
        self.orders.append(
            GivenOrder(_kind(request), self._robots(request), self.now_s(), math.inf)
        )

        def answered() -> None:
            self.orders[index] = self.orders[index]._replace(ended_s=self.now_s())

        return answered

    def carry_out(self, procedure: Procedure[T]) -> T:
        """Let time pass until it is through; a command that does not end is answered by None."""
        answer: Any = None
        while True:
            try:
                wanted = procedure.send(answer)
            except StopIteration as done:
                result: T = done.value
                return result
            try:
                answer = self.ground.carry_out(_one(wanted))
            except NothingComesError:
                answer = None

    def truth(self, timeline: Timeline) -> FlightTruth:
        """What the vehicles did."""
        layout = self.fleet.layout
        vehicles = tuple(
            vehicle_truth(each.vehicle.truth, layout.to_mission) for each in self.fleet.vehicles
        )
        return FlightTruth(
            vehicles, timeline.hit, timeline.fault_s, timeline.calm_s, timeline.marks,
            tuple(self.orders), layout.fence, layout.pads_m, layout.scenario.budget.drone_m,
        )  # fmt: skip

    # Where vehicles are

    def outwards(self, robot: int) -> F64:
        """(2,): the way to the nearest line of the fence, north and east."""
        layout = self.fleet.layout
        place_m = self.fleet.true_positions_m()[robot, :2]
        edges = layout.fence.edges()
        out = -edges.inward[int(np.argmin(edges.distances_m(place_m)))]
        turned: F64 = (layout.to_mission.rotation @ np.array([*out, 0.0]))[:2]
        return turned

    def inside_m(self, robot: int) -> float:
        """How far inside that line the vehicle takes itself to be."""
        layout = self.fleet.layout
        estimate_m = self.fleet.vehicles[robot].vehicle.estimated_position_m
        return layout.fence.distance_m(*layout.to_mission.local_to_mission(estimate_m)[:2])

    def height_m(self, robot: int) -> float:
        """The height that a robot flies at."""
        config = self.fleet.robots[robot % len(self.fleet.robots)].config
        return config.flight.slot_height_m

    def place_m(self, robot: int) -> F64:
        """(2,): the pad that a robot stood on at first, where it really is; north and east."""
        pads_m = self.fleet.layout.pads_m
        return np.array(self.fleet.layout.to_world_m(pads_m[robot % len(pads_m)]))

    # What happens

    def _happen(self, do: Do, hit: tuple[int, ...]) -> None:
        everybody = tuple(range(len(self.fleet.robots)))
        robots = {
            "hit": hit,
            "all": everybody,
            "others": tuple(robot for robot in everybody if robot not in hit),
            "next": tuple((robot + 1) % len(everybody) for robot in hit),
        }[do.to]
        self._inject(do.injection, robots)

    def _inject(self, injection: Injection, robots: tuple[int, ...]) -> None:
        fleet = self.fleet
        if isinstance(injection, VehicleInjection):
            for robot in robots:
                injection.apply(fleet.vehicles[robot].vehicle, robot, self)
            return
        match injection:
            case RadioIs(loss, duplication, delay_s):
                fleet.radio.air = replace(
                    fleet.radio.air, loss=loss, duplication=duplication, delay_s=delay_s
                )
            case RadioCut(cut):
                partition = _partition(cut, len(fleet.robots))
                fleet.radio.air = replace(fleet.radio.air, partition=partition)
            case GroundStops(for_s):
                self.ground.suspend(for_s)
            case GroundDies():
                self.ground.leave()
            case GroundStarts():
                fleet.join(self._operator)
            case GroundClockSteps(by_s):
                self.ground.clock.ahead_s += by_s
            case OperatorOrders(kind):
                self._order(_request(kind, tuple(f"r{robot}" for robot in robots)))
            case FenceWithout():
                self._order(
                    SetFence(_fence_without(fleet.layout.fence, self._landing_points(robots)))
                )
            case _:
                for robot in robots:
                    self._inject_program(injection, robot)

    def _inject_program(self, injection: Injection, index: int) -> None:
        robot = self.fleet.robots[index]
        match injection:
            case ProgramDies():
                robot.stop()
            case ProgramStarts():
                robot.start()
            case ProgramStops(for_s):
                robot.hang(for_s)
                self.fleet.radio.suspend(index, for_s)
            case LoopHangs(loop, for_s):
                robot.loops[loop].hang(for_s)
            case WatchdogDies():
                assert robot.watchdog is not None
                robot.watchdog.die()
            case AutopilotSilent():
                robot.vehicle.is_cut = True
            case DiskFills():
                robot.fill_disk()
            case ClockSteps(by_s):
                robot.clock.ahead_s += by_s
            case SecondProgram():
                self._start_second(index)
            case _:
                raise TypeError(f"{injection} is not done to a program")

    def _start_second(self, robot: int) -> None:
        north_m, east_m, _ = self.fleet.vehicles[robot].vehicle.position_m.tolist()
        vehicle = Px4Vehicle(seed=robot, start_m=(north_m + _BESIDE_M, east_m), origin=WORLD)
        direct = DirectVehicle(vehicle, robot + 1, self.fleet.schedule)
        self.fleet.second_program(robot, direct).start()

    def _landing_points(self, robots: tuple[int, ...]) -> list[F64]:
        return [self.fleet.layout.landing_points_m[robot] for robot in robots]

    def _order(self, request: Request) -> None:
        if self.ground_runs:
            order = GivenOrder(
                _kind(request), self._robots(request), self.now_s(), self.now_s() + _ORDER_S
            )
            self.orders.append(order)
            self.ground.node.begin(request)

    def _robots(self, request: Request) -> tuple[int, ...]:
        names: tuple[str, ...] = getattr(request, "robots", ())
        return tuple(self.ground.setup.robots[name] for name in names or self.ground.setup.robots)


class _Bases(NamedTuple):
    """Fleets that are ready, and that fly their mission: flights are copies of them."""

    ready: SimulatedField
    mission: SimulatedField


class SimulatedDrill:
    """Flies faults on the simulated clock, one by one; flights of one seed share their begin.

    A flight follows from fault, seed, number of robots and bundle, whatever was flown before.
    """

    def __init__(self, robots: int, bundle: Path) -> None:
        self._robots = robots
        self._bundle = bundle
        self._key: object = None
        self._bases: _Bases | None = None

    def fly(self, fault: Fault, seed: int, logs: Path | None = None) -> FlightTruth:
        """One flight. With `logs` the robots write theirs in that folder."""
        if logs is not None:
            field = self._ready(fault, seed, logs, logged=True)
            if fault.phase in ("mission", "return"):
                field.carry_out(to_mission(field))
        else:
            bases = self._of(fault, seed)
            field = (bases.ready if fault.phase in ("ready", "takeoff") else bases.mission).copy()
        timeline = field.carry_out(fly(field, fault, seed, self._robots))
        field.fleet.close()
        return field.truth(timeline)

    def _of(self, fault: Fault, seed: int) -> _Bases:
        key = (seed, fault.exact, fault.settings)
        if self._bases is None or key != self._key:
            with tempfile.TemporaryDirectory() as folder:
                ready = self._ready(fault, seed, Path(folder))
            mission = ready.copy()
            mission.carry_out(to_mission(mission))
            self._key, self._bases = key, _Bases(ready, mission)
        return self._bases

    def _ready(
        self, fault: Fault, seed: int, folder: Path, *, logged: bool = False
    ) -> SimulatedField:
        settings: dict[str, dict[str, object]] = {}
        for table, key, value in fault.settings:
            settings.setdefault(table, {})[key] = value
        scenario = FleetScenario(
            robots=self._robots, seed=seed, secure=True, errors=not fault.exact,
            budget=EXACT if fault.exact else ERRORS,
        )  # fmt: skip
        fleet = SimulatedFleet(scenario, folder, self._bundle, settings=settings, logs=logged)
        if settings.get("failsafe", {}).get("rc") == "pilot":
            for each in fleet.vehicles:
                each.vehicle.rc_connected = True
        field = SimulatedField(fleet)
        field.carry_out(to_ready(field))
        return field


def _one(wanted: Any) -> Procedure[Any]:
    answer = yield wanted
    return answer


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


def _kind(request: Request) -> str:
    """What an order is called in a flight's truth."""
    if isinstance(request, RobotCommand):
        return request.kind
    return request.action if isinstance(request, SafetyCommand) else type(request).__name__.lower()


def _request(kind: OrderedKind, robots: tuple[str, ...]) -> Request:
    match kind:
        case "takeoff":
            return Takeoff(robots)
        case "start":
            return Start(robots)
        case "resume":
            return Resume(robots)
        case "hold" | "return" | "land":
            return SafetyCommand(kind, robots)
        case "pilot" | "rejoin" | "kill" | "disarm":
            return RobotCommand(kind, robots)


def _fence_without(fence: Fence, places_m: list[F64]) -> Fence:
    """As much of a square fence as leaves these places outside, by half a metre."""
    corners = np.array(fence.vertices_m)
    low_m, high_m = corners.min(axis=0), corners.max(axis=0)
    x_m = min(place_m[0] for place_m in places_m)
    # What is left on the side with more room.
    if x_m - low_m[0] > high_m[0] - max(place_m[0] for place_m in places_m):
        high_m[0] = x_m - 0.5
    else:
        low_m[0] = max(place_m[0] for place_m in places_m) + 0.5
    (x0, y0), (x1, y1) = low_m.tolist(), high_m.tolist()
    return replace(fence, vertices_m=((x0, y0), (x1, y0), (x1, y1), (x0, y1)))
