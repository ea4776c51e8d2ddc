"""A swarm of robots that share nothing but the medium, in simulated time."""

import heapq
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from edge.core import F32, F64
from edge.drivers.world_sensor import WorldSensor
from edge.policy.bundle import BundleError
from edge.policy.family import Policy
from edge.robot.pac import Pac, PacParameters
from lpac.sim.medium import Medium
from lpac.sim.vehicles import PointVehicles, VehicleOdometry


@dataclass(frozen=True, slots=True)
class Clocks:
    """Periods of a robot's three loops, s; a tick is early or late by up to `jitter` periods."""

    perception_s: float = 0.2
    policy_s: float = 0.4
    control_s: float = 0.1
    jitter: float = 0.05


class Swarm:
    """N robots, each with its own perception, mailbox and clocks; deterministic for a seed."""

    def __init__(
        self,
        *,
        policy: Policy,
        importance: F32,
        positions_m: F64,
        parameters: PacParameters,
        medium: Medium,
        rng: np.random.Generator,
        clocks: Clocks | None = None,
    ) -> None:
        """`positions_m` (N, 2) are the starting positions; `rng` draws the clocks' phases.

        Raises BundleError if the policy has no perception.
        """
        perception = policy.manifest.perception
        if perception is None:
            raise BundleError(f"bundle {policy.manifest.name!r} has no perception to simulate")
        sensor = WorldSensor(importance, perception.sensor_size)
        self._vehicles = PointVehicles(
            positions_m, perception.world_size / parameters.scale.env_scale
        )
        self.robots = tuple(
            Pac(
                robot_id=robot,
                boot_epoch=1,
                policy=policy,
                sensor=sensor,
                odometry=VehicleOdometry(self._vehicles, robot),
                parameters=parameters,
            )
            for robot in range(len(positions_m))
        )
        self.largest_payload = 0.0
        self._medium = medium
        self._rng = rng
        # Events (time, order, what to do); the order makes equal times deterministic.
        self._events: list[tuple[float, int, Callable[[], object]]] = []
        self._scheduled = 0
        self._start_clocks(clocks or Clocks())

    def run(self, times_s: Iterable[float]) -> Iterator[F64]:
        """Yields the true positions (N, 2), m, at each of `times_s`, which ascend."""
        for until_s in times_s:
            while self._events[0][0] <= until_s:
                self._vehicles.now_s, _, do = heapq.heappop(self._events)
                do()
            self._vehicles.now_s = until_s
            yield self._vehicles.positions_m()

    def message_counts(self) -> dict[str, int]:
        """Broadcasts, and what became of them at each receiver in range, in all."""
        counts = Counter({"broadcasts": self._medium.broadcasts, "lost": self._medium.lost})
        for robot in self.robots:
            counts.update(robot.mailbox.counts())
        return dict(counts)

    def _start_clocks(self, clocks: Clocks) -> None:
        for robot in range(len(self.robots)):
            for period_s, step in (
                (clocks.perception_s, self._perceive),
                (clocks.policy_s, self._infer),
                (clocks.control_s, self._control),
            ):
                phase_s = period_s * self._rng.random()
                self._tick(robot, step, phase_s, period_s, clocks.jitter)

    def _tick(
        self,
        robot: int,
        step: Callable[[int], None],
        due_s: float,
        period_s: float,
        jitter: float,
    ) -> None:
        """Run `step` at about `due_s`, and then every period, on absolute deadlines."""

        def tick() -> None:
            step(robot)
            self._tick(robot, step, due_s + period_s, period_s, jitter)

        lateness_s = jitter * period_s * self._rng.uniform(-1.0, 1.0)
        self._schedule(max(due_s + lateness_s, self._vehicles.now_s), tick)

    def _schedule(self, time_s: float, do: Callable[[], object]) -> None:
        self._scheduled += 1
        heapq.heappush(self._events, (time_s, self._scheduled, do))

    def _perceive(self, robot: int) -> None:
        self.robots[robot].perceive(self._vehicles.now_s)

    def _control(self, robot: int) -> None:
        velocity_m_s = self.robots[robot].control(self._vehicles.now_s)
        self._vehicles.fly(robot, np.zeros(2) if velocity_m_s is None else velocity_m_s)

    def _infer(self, robot: int) -> None:
        now_s = self._vehicles.now_s
        self._tell_time(robot)
        tick = self.robots[robot].infer(now_s)
        if tick is None:
            return
        for payload in tick.payloads:
            self.largest_payload = max(self.largest_payload, float(np.abs(payload).max()))
        for receiver, travel_s in self._medium.broadcast(robot, self._vehicles.positions_m()):
            self._schedule(now_s + travel_s, partial(self._deliver, receiver, tick.message))

    def _deliver(self, receiver: int, message: bytes) -> None:
        self._tell_time(receiver)
        self.robots[receiver].receive(message, self._vehicles.now_s)

    def _tell_time(self, robot: int) -> None:
        """All have one clock."""
        now_s = self._vehicles.now_s
        self.robots[robot].clock.hear(1, now_s, echoed_at_s=now_s, held_s=0.0, now_s=now_s)
