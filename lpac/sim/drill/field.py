"""Common base of the drill's fleets: targets of a fault, commands, true positions."""

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

# Receivers with corrections, whose estimates still drift by 0.15 m along each axis, and heights
# that hardly drift.
EXACT = ErrorBudget(
    gps_m=0.6, height_apart_m=0.2, height_common_m=0.0, takeoffs_height_m=0.0, pads_height_m=0.2
)
# Validity of a command whose answer is not awaited.
_ORDER_S = 10.0


class Timeline(NamedTuple):
    """Robots hit, and times of the fault and its marks, s on the vehicles' clock."""

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
    """A fleet under its ground station, on some kind of vehicles, into which faults are injected.

    `orders` are all commands given. It is the `Surroundings` of its vehicles.
    """

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.orders: list[GivenOrder] = []

    @property
    @abstractmethod
    def ground(self) -> Ground:
        """The ground station in command."""

    @property
    @abstractmethod
    def ground_runs(self) -> bool:
        """Whether the ground station runs."""

    @abstractmethod
    def at(self, after_s: float, do: Do, hit: tuple[int, ...]) -> None:
        """Schedule an injection `after_s` from now."""

    @abstractmethod
    def all_down(self) -> bool:
        """Whether all vehicles really stand on the ground, motors off."""

    @abstractmethod
    def now_s(self) -> float:
        """Time on the vehicles' clock, s."""

    @abstractmethod
    def unix_now_s(self) -> float:
        """Unix time, as in the robots' logs."""

    @property
    @abstractmethod
    def vehicles(self) -> Sequence[FaultyVehicle]:
        """The vehicles, at least one for each robot."""

    @property
    @abstractmethod
    def robots_by_name(self) -> dict[str, int]:
        """Robot ids by the operator's names."""

    @abstractmethod
    def height_m(self, robot: int) -> float:
        """The height that a robot flies at."""

    @abstractmethod
    def send(self, request: Request) -> bool:
        """Send a command without awaiting its answer; False without a ground station."""

    @abstractmethod
    def inject(self, injection: Injection, robots: tuple[int, ...]) -> None:
        """Apply an injection that is neither a command nor a fence."""

    @abstractmethod
    def tracks(self) -> tuple[TrueTrack, ...]:
        """True tracks of the vehicles until now, in the world's frame."""

    def highest_m(self) -> float:
        """The height of the robot that flies highest."""
        return max(map(self.height_m, range(len(self.robots_by_name))))

    def lead_s(self, injection: Injection) -> float:
        """Delay from the injection to its effect, by which it is injected earlier, s."""
        return 0.0

    def late_s(self) -> float:
        """Lateness of this machine behind real time, s."""
        return 0.0

    def apply(self, do: Do, hit: tuple[int, ...]) -> None:
        """Apply an injection to its group of robots."""
        robots = robots_of(do.to, hit, self.layout.scenario.robots)
        match do.injection:
            case OperatorOrders(kind):
                names = tuple(f"r{robot}" for robot in robots)
                kill = RobotCommand("kill", names)
                self._order(kill if kind == "kill" else of_robots(kind, names))
            case FenceWithout():
                places_m = [self.layout.landing_points_m[robot] for robot in robots]
                self._order(SetFence(_fence_without(self.layout.fence, places_m)))
            case injection:
                self.inject(injection, robots)

    def record_order(self, request: Request) -> Callable[[], None]:
        """Record a command given now; returns a callback for its answer."""
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

    def outwards(self, robot: int) -> Vector:
        """Horizontal direction to the fence's nearest line, by the vehicle's estimate."""
        return level(self.layout.way_out(self.vehicles[robot].estimated_position_m)[0].tolist())

    def inside_m(self, robot: int) -> float:
        """Estimated distance inside that line, m."""
        return self.layout.way_out(self.vehicles[robot].estimated_position_m)[1]

    def place_m(self, robot: int) -> F64:
        """(2,): true position of the robot's first pad, north and east, m."""
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
    """Scenario of a fault: a fleet with keys, and vehicles with errors unless it is exact."""
    return Scenario(
        robots=robots, seed=seed, secure=True, errors=not fault.exact,
        budget=EXACT if fault.exact else ERRORS, sensor=sensor, fault=fault.name,
    )  # fmt: skip


def settings_of(fault: Fault) -> dict[str, dict[str, object]]:
    """The fault's further keys of robot.toml, by table."""
    settings: dict[str, dict[str, object]] = {}
    for table, key, value in fault.settings:
        settings.setdefault(table, {})[key] = value
    return settings


def has_remote_control(fault: Fault) -> bool:
    """Whether the fault's robots are set up for a pilot's remote control, which is then on."""
    return settings_of(fault).get("failsafe", {}).get("rc") == "pilot"


def supports(kinds: Collection[object], fault: Fault) -> bool:
    """Whether these kinds of injections include all of a fault's."""
    return all(
        type(do.injection) in kinds or getattr(do.injection, "kind", None) in kinds
        for do in fault.does
    )


def _fence_without(fence: Fence, places_m: list[F64]) -> Fence:
    """The part of a square fence that leaves these places outside, by half a metre."""
    corners = np.array(fence.vertices_m)
    low_m, high_m = corners.min(axis=0), corners.max(axis=0)
    x_m = min(place_m[0] for place_m in places_m)
    # Keep the side with more room.
    if x_m - low_m[0] > high_m[0] - max(place_m[0] for place_m in places_m):
        high_m[0] = x_m - 0.5
    else:
        low_m[0] = max(place_m[0] for place_m in places_m) + 0.5
    (x0, y0), (x1, y1) = low_m.tolist(), high_m.tolist()
    return replace(fence, vertices_m=((x0, y0), (x1, y0), (x1, y1), (x0, y1)))
