"""The expert, which knows the whole flock, and what a good flight is: a `lpac.train.task.Task`."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edge.core import F64, Bools
from edge.core.frames import ModelScale
from lpac.analysis.flight import FlightRecord
from lpac.sim.baselines import BaselineName
from lpac.sim.points import Preparation
from lpac.study.flights import CostCurve, FlightGroup, PlannedFlight, records_of
from lpac.train.config import DataConfig
from lpac_flocking.policy import away_from_close, place_in

# In model units/s: how fast the flock flies, how hard robots part, and how hard they gather.
_CRUISE, _PART, _GATHER = 2.5, 3.0, 2.5
# How the flock is turned: it circles around the world's centre, and keeps off the border.
_TURN = 0.5


class FlockExpert:
    """Global consensus of velocities, and a potential's gradient (as Tolstaya et al., CoRL 2019).

    All fly as the flock does on average, at the same speed, and are turned by where its centre is;
    beside that each keeps off who is close, and comes closer to the centre.
    """

    def __init__(self, world_size: float, max_speed: float) -> None:
        self._world_size = world_size
        self._max_speed = max_speed

    def look(self, positions: F64, alive: Bools) -> None:
        """There is nothing to remember."""

    def velocities(
        self,
        positions: F64,
        alive: Bools,
        robots: Sequence[int] | None = None,
        moving: F64 | None = None,
    ) -> F64:
        """See `lpac.train.task.Teacher`."""
        asked = range(len(positions)) if robots is None else robots
        velocities = np.zeros((len(asked), 2))
        left = np.flatnonzero(alive)
        if not len(left):
            return velocities
        centre = positions[left].mean(axis=0)
        common = np.zeros(2) if moving is None else moving[left].mean(axis=0)
        common = self._common(common, place_in(centre, self._world_size))
        for row, robot in enumerate(asked):
            if alive[robot]:
                away = away_from_close(positions[robot], positions[left[left != robot]])
                gather = 4.0 * (centre - positions[robot]) / self._world_size
                gather /= max(1.0, float(np.hypot(*gather)))
                velocities[row] = common + _PART * away + _GATHER * gather
        speeds = np.hypot(*velocities.T)[:, None]
        velocities *= np.minimum(1.0, self._max_speed / np.maximum(speeds, 1e-9))
        return velocities

    def _common(self, velocity: F64, place: F64) -> F64:
        """(2,): the flock's next velocity."""
        around = np.array([-place[1], place[0]])
        wanted: F64 = velocity + _TURN * _CRUISE * (around - place * np.hypot(*place) ** 2)
        wanted *= _CRUISE / max(float(np.hypot(*wanted)), 0.5 * _CRUISE)
        return wanted


class FlockingTask(NamedTuple):
    """See `lpac.train.task.Task`."""

    @property
    def baselines(self) -> Sequence[BaselineName]:
        """Those that there are cover."""
        return ()

    def expert_name(self, data: DataConfig) -> str:
        """See `lpac.train.task.Task`."""
        return "a flock's, which knows all positions and velocities"

    def teacher(self, data: DataConfig, world: Preparation) -> FlockExpert:
        """See `lpac.train.task.Task`."""
        return FlockExpert(world.perception.world_size, world.bundle.manifest.training.max_speed)

    def costs(self, flights: FlightGroup) -> list[tuple[PlannedFlight, CostCurve]]:
        """Disagreement in the last half of the flight, over that of robots each on its own way.

        Those fly at the flock's speed in directions that have nothing to do with each other. A
        flock that stands, or is scattered, is no flock: by what its speed is short, and its
        radius is more than half the world's, the cost is higher.
        """
        return [
            (
                flight,
                CostCurve((0.0, record.duration_s), (1.0, cost_of(record, flight.scenario.scale))),
            )
            for flight, record in records_of(flights)
        ]


def cost_of(record: FlightRecord, scale: ModelScale) -> float:
    """See `FlockingTask.costs`."""
    time_s = record.robots[0].time_s
    positions_m = np.stack([robot.position_m[:, :2] for robot in record.robots], axis=1)
    half = len(time_s) // 2
    cruise_m_s = _CRUISE * scale.velocity_scale
    apart = disagreement_m_s(time_s, positions_m)[half:].mean() / cruise_m_s
    speed = speed_m_s(time_s, positions_m)[half:].mean() / cruise_m_s
    offsets_m = positions_m - positions_m.mean(axis=1, keepdims=True)
    radius = np.sqrt((offsets_m[half:] ** 2).sum(axis=2).mean())
    assert record.coverage is not None
    world_m = record.coverage.size_m
    return float(apart + max(0.0, 0.8 - speed) + max(0.0, 4.0 * radius / world_m - 1.0))


def disagreement_m_s(time_s: F64, positions_m: F64) -> F64:
    """(T - 1,): root of the mean square by which robots' velocities differ from their mean."""
    velocities = _velocities(time_s, positions_m)
    apart = velocities - velocities.mean(axis=1, keepdims=True)
    disagreement: F64 = np.sqrt((apart**2).sum(axis=2).mean(axis=1))
    return disagreement


def speed_m_s(time_s: F64, positions_m: F64) -> F64:
    """(T - 1,): how fast the flock's centre moves."""
    speed: F64 = np.hypot(*_velocities(time_s, positions_m).mean(axis=1).T)
    return speed


def _velocities(time_s: F64, positions_m: F64) -> F64:
    """(T - 1, N, 2)."""
    velocities: F64 = np.diff(positions_m, axis=0) / np.diff(time_s)[:, None, None]
    return velocities
