"""Swarm of robots that communicate over a medium only, in simulated time."""

import heapq
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from edge.core import F64, Bools
from edge.core.part import PartError
from edge.core.ports import OdometrySource
from edge.messages.beacon import Beacon
from edge.robot.neighbours import NeighbourTable, Number
from edge.robot.pac import Pac
from lpac.sim.failure import Failure
from lpac.sim.medium import Medium
from lpac.sim.ticks import Clocks, ticks
from lpac.sim.vehicles import PointVehicles, VehicleOdometry


class SwarmRobot(Protocol):
    """The steps of a robot, as in `Pac`."""

    largest_payload: float

    @property
    def table(self) -> NeighbourTable: ...
    @property
    def waits(self) -> bool:
        """Whether `control` needs a policy step that is not computed yet."""

    def perceive(self, now_s: float) -> object: ...
    def control(self, now_s: float) -> F64 | None: ...
    def next_message(self, now_s: float) -> Any:
        """Run the policy; returns the message to neighbours, or None."""

    def on_message(self, message: Any, now_s: float) -> None:
        """Handle another robot's message."""


AnyRobot = TypeVar("AnyRobot", bound=SwarmRobot)


class Swarm(Generic[AnyRobot]):
    """N robots, each with its own clocks; deterministic for a seed."""

    def __init__(
        self,
        *,
        boot: Callable[[int, int, OdometrySource], AnyRobot],
        vehicles: PointVehicles,
        medium: Medium,
        rng: np.random.Generator,
        clocks: Clocks,
        failures: Sequence[Failure] = (),
        bias_m: F64 | None = None,
    ) -> None:
        """`boot` makes a robot from its id, start count (from 1) and odometry, at each start.

        `rng` draws the clocks' phases; `bias_m` (N, 2) is the position error of the robots.
        """
        self._boot = boot
        self._vehicles = vehicles
        self._medium = medium
        self._bias_m = bias_m
        robots = len(vehicles.positions_m())
        self._boots = [0] * robots
        self.robots = [self._booted(robot) for robot in range(robots)]
        self._gone: list[AnyRobot] = []
        self._failed: set[int] = set()
        # Events (time, order, callback) besides the ticks; the order makes equal times
        # deterministic.
        self._events: list[tuple[float, int, Callable[[], object]]] = []
        self._scheduled = 0
        for failure in failures:
            self._schedule(failure.from_s, partial(self._fail, failure.robot))
            if failure.until_s < math.inf:
                self._schedule(failure.until_s, partial(self._come_back, failure.robot))
        self._ticks = ticks(robots, clocks, rng)
        self._next_tick = next(self._ticks)

    def run(self, times_s: Iterable[float]) -> Iterator[F64]:
        """Yields the true positions (N, 2), m, at each of `times_s`, which ascend.

        For robots that never wait.
        """
        for until_s in times_s:
            for _ in self.advance(until_s):
                raise RuntimeError("a robot waits for a policy step that is never computed")
            yield self.positions_m()

    def advance(self, until_s: float) -> Iterator[None]:
        """Advance to that time; yields while a robot waits for its policy."""
        while True:
            tick = self._next_tick
            # At equal times the tick comes first, since it may cause the event.
            if self._events and self._events[0][0] < tick.time_s:
                if self._events[0][0] > until_s:
                    break
                self._vehicles.now_s, _, do = heapq.heappop(self._events)
                do()
                continue
            if tick.time_s > until_s:
                break
            self._vehicles.now_s = tick.time_s
            if tick.robot not in self._failed:
                robot = self.robots[tick.robot]
                if tick.loop == "perception":
                    robot.perceive(tick.time_s)
                elif tick.loop == "policy":
                    self._infer(tick.robot)
                else:
                    while robot.waits:
                        yield
                    velocity_m_s = robot.control(tick.time_s)
                    self._vehicles.fly(
                        tick.robot, np.zeros(2) if velocity_m_s is None else velocity_m_s
                    )
            self._next_tick = next(self._ticks)
        self._vehicles.now_s = until_s

    def positions_m(self) -> F64:
        """The true positions (N, 2) now."""
        return self._vehicles.positions_m()

    def velocities_m_s(self) -> F64:
        """The velocities (N, 2) commanded now."""
        return self._vehicles.velocities_m_s()

    def received(self, now_s: float) -> Bools:
        """(N, N), [receiver, sender]: whether a robot holds a fresh message; none is consumed."""
        received = np.zeros((len(self.robots),) * 2, np.bool_)
        for receiver, robot in enumerate(self.robots):
            senders = [near.beacon.robot_id for near in robot.table.neighbours(now_s)]
            received[receiver, senders] = True
        return received & self.alive[:, None]

    @property
    def alive(self) -> Bools:
        """(N,): whether each robot is alive now."""
        alive = np.ones(len(self.robots), np.bool_)
        alive[list(self._failed)] = False
        return alive

    @property
    def largest_payload(self) -> float:
        """The largest absolute value in a payload that a robot used."""
        return max(robot.largest_payload for robot in (*self.robots, *self._gone))

    def message_counts(self) -> dict[str, int]:
        """Totals of broadcasts, and of their outcomes at the receivers in range."""
        counts = Counter({"broadcasts": self._medium.broadcasts, "lost": self._medium.lost})
        for robot in (*self.robots, *self._gone):
            counts.update(robot.table.counts())
        return dict(counts)

    def _booted(self, robot: int) -> AnyRobot:
        self._boots[robot] += 1
        bias_m = None if self._bias_m is None else self._bias_m[robot]
        odometry = VehicleOdometry(self._vehicles, robot, bias_m)
        return self._boot(robot, self._boots[robot], odometry)

    def _schedule(self, time_s: float, do: Callable[[], object]) -> None:
        self._scheduled += 1
        heapq.heappush(self._events, (time_s, self._scheduled, do))

    def _infer(self, robot: int) -> None:
        now_s = self._vehicles.now_s
        message = self.robots[robot].next_message(now_s)
        if message is None:
            return
        for receiver, travel_s in self._medium.broadcast(robot, self._vehicles.positions_m()):
            self._schedule(now_s + travel_s, partial(self._deliver, receiver, message))

    def _deliver(self, receiver: int, message: Any) -> None:
        if receiver not in self._failed:
            self.robots[receiver].on_message(message, self._vehicles.now_s)

    def _fail(self, robot: int) -> None:
        self._failed.add(robot)
        self._vehicles.stop(robot)

    def _come_back(self, robot: int) -> None:
        self._failed.discard(robot)
        self._gone.append(self.robots[robot])
        self.robots[robot] = self._booted(robot)


class _Message(NamedTuple):
    beacon: Beacon
    number: Number
    data: bytes


class ClockedPac(Pac):
    """Robot of a fleet with one shared clock."""

    waits = False
    largest_payload = 0.0

    def __init__(self, *, start: int, **pac: Any) -> None:
        """`start` identifies this start of the program; the rest is passed to `Pac`."""
        super().__init__(**pac)
        self._start = start
        self._sent = 0

    def next_message(self, now_s: float) -> _Message | None:
        """See `SwarmRobot`. Raises PartError if the policy or the sensor fails."""
        self._set_clock(now_s)
        tick = self.infer(now_s)
        if self.problem:
            raise PartError(f"robot {self._robot_id}: {self.problem}")
        if tick is None:
            return None
        for payload in tick.payloads:
            self.largest_payload = max(
                self.largest_payload, float(np.abs(payload).max(initial=0.0))
            )
        self._sent += 1
        return _Message(self.beacon(now_s), (self._start, self._sent), tick.message)

    def on_message(self, message: _Message, now_s: float) -> None:
        """See `SwarmRobot`."""
        self._set_clock(now_s)
        self.receive(*message, now_s)

    def _set_clock(self, now_s: float) -> None:
        self.clock.update(1, now_s, echoed_at_s=now_s, held_s=0.0, now_s=now_s)
