"""Benchmark of a robot's steps on this machine: its own code, with any number of neighbours."""

import math
import platform
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from edge.core import F32, F64
from edge.core.aggregation import AggregatedMessage
from edge.core.frames import ModelScale
from edge.core.part import PartError
from edge.core.ports import Odometry
from edge.core.shared_map import SharedMap
from edge.core.wire import encode
from edge.policy.family import Policy
from edge.robot.config import Rates
from edge.robot.pac import Pac, PacParameters

# Largest share of a step's period: the loops share the core with each other and with PX4.
MOST_OF_PERIOD = 0.5

_WARM_UP_TICKS = 5
_LEAST_TICKS = 20
_MOST_NEIGHBOURS = 1000


@dataclass(frozen=True, slots=True)
class StepTimes:
    """Times of all calls of one step, and its period in flight; ms."""

    step: str
    calls: int
    period_ms: float
    p50_ms: float
    p99_ms: float
    max_ms: float

    @property
    def share(self) -> float:
        """The 99th percentile as a share of the period."""
        return self.p99_ms / self.period_ms

    @property
    def fits(self) -> bool:
        """Whether the step leaves enough of its period to the others."""
        return self.share <= MOST_OF_PERIOD


@dataclass(frozen=True, slots=True)
class Benchmark:
    """Measured times, and the architecture: "aarch64", "x86_64"."""

    architecture: str
    neighbours: int
    steps: tuple[StepTimes, ...]


def benchmark(policy: Policy, neighbours: int, seconds: float) -> Benchmark:
    """Measure ticks of perception and inference for about `seconds`.

    All `neighbours` are in range, and each sends a message before each tick. Messages and views are
    random, of their size in flight. Raises BundleError if no robot can fly the policy, PartError if
    it fails, ValueError for an impossible number.
    """
    if not 0 <= neighbours <= _MOST_NEIGHBOURS:
        raise ValueError(f"neighbours = {neighbours}: must be from 0 to {_MOST_NEIGHBOURS}")
    if not 0.0 < seconds < math.inf:
        raise ValueError(f"seconds = {seconds:g}: must be positive and finite")
    flight = _Flight(policy, neighbours)
    for _ in range(_WARM_UP_TICKS):
        flight.tick()
    ticks_s: list[tuple[float, float]] = []
    until_s = perf_counter() + seconds
    while perf_counter() < until_s or len(ticks_s) < _LEAST_TICKS:
        ticks_s.append(flight.tick())
    rates = Rates()
    rates_hz = {"perceive": rates.perception_hz, "infer": rates.policy_hz}
    steps = tuple(
        StepTimes(step, len(times_s), 1e3 / rate_hz, *_percentiles_ms(np.array(times_s)))
        for (step, rate_hz), times_s in zip(
            rates_hz.items(), zip(*ticks_s, strict=True), strict=True
        )
    )
    return Benchmark(platform.machine(), neighbours, steps)


class _Flight:
    """One robot that circles in a random world among neighbours; mission units are model units."""

    def __init__(self, policy: Policy, neighbours: int) -> None:
        self._policy = policy
        self._rng = np.random.default_rng(0)
        self._ticks = 0
        self._pac = Pac(
            robot_id=0,
            policy=self._policy,
            sensor=self,
            odometry=self,
            parameters=PacParameters(scale=ModelScale(1.0, 1.0), max_speed_m_s=1.0),
        )
        perception = policy.manifest.perception
        assert perception is not None  # Pac has refused it otherwise.
        self._perception = perception
        self._view = self._rng.random((perception.sensor_size,) * 2, np.float32)
        angles_rad = self._rng.uniform(0.0, math.tau, neighbours)
        distances = self._rng.uniform(0.1, 0.9, neighbours) * perception.communication_range
        self._offsets = distances[:, None] * np.stack([np.cos(angles_rad), np.sin(angles_rad)], 1)
        size = policy.message_size
        self._payloads = self._rng.random((neighbours, size), np.float32)
        side = perception.shared_map_side
        codes = self._rng.integers(1, 200, (side, side), np.uint8)
        self._shared = SharedMap((0, 0), codes) if side else None

    def view(self, position: F64) -> F32:
        """See `Sensor`."""
        return self._view

    def odometry(self) -> Odometry:
        """See `OdometrySource`."""
        quarter = self._perception.world_size / 4.0
        angle_rad = 0.01 * self._ticks
        x, y = 2.0 + math.cos(angle_rad), 2.0 + math.sin(angle_rad)
        return Odometry((quarter * x, quarter * y, 4.0), (0.0, 0.0, 0.0))

    def tick(self) -> tuple[float, float]:
        """Times of `Pac.perceive` and `Pac.infer`, s."""
        self._ticks += 1
        now_s = float(self._ticks)
        self._receive(now_s)
        began_s = perf_counter()
        perceived = self._pac.perceive(now_s)
        between_s = perf_counter()
        inferred = self._pac.infer(now_s)
        ended_s = perf_counter()
        if perceived is None or inferred is None:
            raise PartError(self._pac.problem)
        assert len(inferred.senders) == len(self._offsets)
        return between_s - began_s, ended_s - between_s

    def _receive(self, now_s: float) -> None:
        self._pac.clock.update(1, now_s, echoed_at_s=now_s, held_s=0.0, now_s=now_s)
        x, y, height = self.odometry().position_m
        for number, (offset, payload) in enumerate(
            zip(self._offsets.tolist(), self._payloads, strict=True), 1
        ):
            beacon = replace(
                self._pac.beacon(now_s),
                robot_id=number,
                position_m=(x + offset[0], y + offset[1], height),
            )
            data = encode(AggregatedMessage(payload, shared=self._shared), "float16")
            self._pac.receive(beacon, (1, self._ticks), data, now_s)


def _percentiles_ms(times_s: F64) -> tuple[float, float, float]:
    p50, p99, largest = np.percentile(1e3 * times_s, (50.0, 99.0, 100.0)).tolist()
    return p50, p99, largest
