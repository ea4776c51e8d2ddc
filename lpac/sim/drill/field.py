"""Common part of all fleets of the drill: targets of a fault, orders, true positions."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np

from edge.core import F64
from edge.core.fence import Fence
from edge.core.vehicle import Vector
from edge.flight.margins import ErrorBudget
from lpac.analysis.flight import FaultRecord, FlightRecord, GivenOrder
from lpac.analysis.logs import simulated_name
from lpac.analysis.truth import TrueTrack
from lpac.ground.procedure import Ground
from lpac.ground.station.protocol import (
    Request,
    RobotCommand,
    SetFence,
    command_name,
    of_robots,
)
from lpac.sim.description import ERRORS
from lpac.sim.drill.bounds import robots_of
from lpac.sim.drill.faults import Fault
from lpac.sim.drill.injections import Do, FenceWithout, Injection, OperatorOrders
from lpac.sim.fleet.layout import Layout
from lpac.sim.px4.vector import level
from lpac.sim.scenario import WORLD_SENSOR, Scenario

# Receivers with corrections, whose estimates still wander by 0.15 m along each axis, and heights
# that hardly walk.
EXACT = ErrorBudget(
    gps_m=0.6, height_apart_m=0.2, height_common_m=0.0, takeoffs_height_m=0.0, pads_height_m=0.2
)
# How long an order that nobody waits for is valid.
_ORDER_S = 10.0


class Timeline(NamedTuple):
    """Robots that were hit, and times of the fault and its marks, s of the vehicles' clock."""

    hit: tuple[int, ...]
    fault_s: float
    marks: Mapping[str, float]


class FaultyVehicle(Protocol):
    """True and estimated position of a vehicle: the world's frame, (3,), m."""

    position_m: F64
    rc_connected: bool

    @property
    def estimated_position_m(self) -> F64: ...


class FaultyFleet(ABC):
    """A fleet that faults are done to, under its ground, on some kind of vehicles.

    `orders` are all that were given, `layout` is what it is.

    It is a `Surroundings` of its vehicles.
    """

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.orders: list[GivenOrder] = []

    # What differs between kinds of vehicles

    @property
    @abstractmethod
    def ground(self) -> Ground:
        """The ground that commands now."""

    @property
    @abstractmethod
    def ground_runs(self) -> bool:
        """Whether it does."""

    @abstractmethod
    def at(self, after_s: float, do: Do, hit: tuple[int, ...]) -> None:
        """Have something happen, so much later."""

    @abstractmethod
    def all_down(self) -> bool:
        """Whether all vehicles really stand on the ground, motors off."""

    @abstractmethod
    def now_s(self) -> float:
        """The vehicles' clock."""

    @abstractmethod
    def unix_now_s(self) -> float:
        """Unix time, as whoever writes the robots' logs has it."""

    @property
    @abstractmethod
    def vehicles(self) -> Sequence[FaultyVehicle]:
        """One for each robot, at least."""

    @property
    @abstractmethod
    def robots_by_name(self) -> dict[str, int]:
        """Robot ids by the operator's names."""

    @abstractmethod
    def height_m(self, robot: int) -> float:
        """The height that a robot flies at."""

    @abstractmethod
    def send(self, request: Request) -> bool:
        """The operator commands that, and does not wait; False if there is no ground."""

    @abstractmethod
    def inject(self, injection: Injection, robots: tuple[int, ...]) -> None:
        """Do to these robots what is neither an order nor a fence."""

    @abstractmethod
    def tracks(self) -> tuple[TrueTrack, ...]:
        """True tracks of the vehicles so far, in the world's frame."""

    def highest_m(self) -> float:
        """The height of the robot that flies highest."""
        return max(map(self.height_m, range(len(self.robots_by_name))))

    def lead_s(self, injection: Injection) -> float:
        """How much earlier it has to happen to be felt in time."""
        return 0.0

    def late_s(self) -> float:
        """How far the machine that flies them was behind real time."""
        return 0.0

    # What happens

    def happen(self, do: Do, hit: tuple[int, ...]) -> None:
        """Do it to those who are meant."""
        robots = robots_of(do.to, hit, self.layout.scenario.robots)
        match do.injection:
            case OperatorOrders(kind):
                names = tuple(f"r{robot}" for robot in robots)
                # Every other kind needs nothing but its robots.
                kill = RobotCommand("kill", names)
                self._order(kill if kind == "kill" else of_robots(kind, names))
            case FenceWithout():
                places_m = [self.layout.landing_points_m[robot] for robot in robots]
                self._order(SetFence(_fence_without(self.layout.fence, places_m)))
            case injection:
                self.inject(injection, robots)

    def noted(self, request: Request) -> Callable[[], None]:
        """Note that something is commanded now; call the result when it is answered."""
        index = len(self.orders)
        self.orders.append(
            GivenOrder(command_name(request), self._addressed(request), self.now_s(), math.inf)
        )

        def answered() -> None:
            self.orders[index] = self.orders[index]._replace(ended_s=self.now_s())

        return answered

    def record(self, timeline: Timeline) -> FlightRecord:
        """The whole flight, on the vehicles' clock."""
        layout = self.layout
        tracks = [layout.mission_track(track) for track in self.tracks()]
        perception = layout.bundle.manifest.perception
        assert perception is not None
        return FlightRecord(
            name="drill",
            begin_s=self.unix_now_s() - self.now_s(),
            duration_s=0.0,
            from_s=0.0,
            to_s=self.now_s(),
            robots=(),
            truth={simulated_name(robot): track for robot, track in enumerate(tracks)},
            coverage=None,
            sensor_size=perception.sensor_size,
            cost_time_s=np.zeros(0),
            fence=layout.fence,
            fault=FaultRecord(
                hit=timeline.hit,
                begin_s=timeline.fault_s,
                marks=timeline.marks,
                orders=tuple(self.orders),
                pads_m=layout.pads_m,
                drone_m=layout.scenario.budget.drone_m,
                late_s=self.late_s(),
            ),
        )

    # Where vehicles are

    def outwards(self, robot: int) -> Vector:
        """In the plane: the way to what it takes to be the fence's nearest line."""
        return level(self.layout.way_out(self.vehicles[robot].estimated_position_m)[0].tolist())

    def inside_m(self, robot: int) -> float:
        """How far inside that line the vehicle takes itself to be."""
        return self.layout.way_out(self.vehicles[robot].estimated_position_m)[1]

    def place_m(self, robot: int) -> F64:
        """(2,): the pad that a robot stood on at first, where it really is; north and east."""
        pads_m = self.layout.pads_m
        return np.array(self.layout.to_world_m(pads_m[robot % len(pads_m)]))

    def _order(self, request: Request) -> None:
        began_s = self.now_s()
        if self.send(request):
            robots = self._addressed(request)
            self.orders.append(
                GivenOrder(command_name(request), robots, began_s, began_s + _ORDER_S)
            )

    def _addressed(self, request: Request) -> tuple[int, ...]:
        names: tuple[str, ...] = getattr(request, "robots", ())
        numbers = self.robots_by_name
        return tuple(numbers[name] for name in names or numbers)


def scenario_of(fault: Fault, seed: int, robots: int, sensor: str = WORLD_SENSOR) -> Scenario:
    """The fleet that flies it: members with keys, on vehicles that err, unless they are exact."""
    return Scenario(
        robots=robots, seed=seed, secure=True, errors=not fault.exact,
        budget=EXACT if fault.exact else ERRORS, sensor=sensor, fault=fault.name,
    )  # fmt: skip


def settings_of(fault: Fault) -> dict[str, dict[str, object]]:
    """Its further keys of robot.toml, by table."""
    settings: dict[str, dict[str, object]] = {}
    for table, key, value in fault.settings:
        settings.setdefault(table, {})[key] = value
    return settings


def has_remote_control(fault: Fault) -> bool:
    """Whether its robots are set up for a pilot's remote control, which is on then."""
    return settings_of(fault).get("failsafe", {}).get("rc") == "pilot"


def supports(kinds: Collection[object], fault: Fault) -> bool:
    """Whether vehicles that take injections of these kinds fly a fault."""
    return all(
        type(do.injection) in kinds or getattr(do.injection, "kind", None) in kinds
        for do in fault.does
    )


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
