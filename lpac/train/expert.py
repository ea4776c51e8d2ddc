"""Experts to imitate. They know the true positions of all robots.

Most also know the whole world. Their actions in unseen areas cannot be predicted, and imitation
yields the mean: to stay near the present place. "exploring-cvt" knows what all robots together have
seen, which robots that share maps learn too, and explores.
"""

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from edge.core import F32, F64, Bools
from edge.core.perception import PerceptionParameters, window_corner
from lpac.analysis.coverage import coarse, lloyd_ends
from lpac.analysis.voronoi import cvt_velocity, voronoi_cells
from lpac.sim.points import Preparation
from lpac.train.config import DataConfig

Indices = npt.NDArray[np.intp]

# Period of an expert's observations, s.
LOOK_PERIOD_S = 0.5
# The exploring expert's, in model units: pitch of its lattice; distance that lowers an unseen
# cell's weight to 1/e; distance of the goal if all unseen cells are in one direction. In eight
# training worlds of the field it ended at 0.256 of the initial cost (clairvoyant 0.263), and had
# 0.32 after 20 s (0.56 with a decay of 32). A decay of 12 left distant areas unexplored (0.39).
_PITCH = 8
_DECAY = 18.0
_STEP = 24.0


class Goals(Protocol):
    """Goals (m, 2) of `robots` (m,), indices into the working robots at `positions` (n, 2).

    In model units.
    """

    def __call__(self, positions: F64, robots: Indices) -> F64: ...

    def look(self, positions: F64) -> None:
        """Update what the robots at `positions` have seen."""


class Expert:
    """Velocities of one world's robots, with a policy's speed limit."""

    def __init__(self, goals: Goals, max_speed: float, reach: float) -> None:
        """Slow down robots nearer to their goal than `max_speed` times `reach`.

        In model units and the policy's model units/s, whatever the velocity scale.
        """
        self._goals = goals
        self._max_speed = max_speed
        self._reach = reach

    def look(self, positions: F64, alive: Bools) -> None:
        """Update what the robots at `positions` (N, 2) that are `alive` have seen."""
        self._goals.look(positions[alive])

    def velocities(
        self,
        positions: F64,
        alive: Bools,
        robots: Sequence[int] | None = None,
        moving: F64 | None = None,
    ) -> F64:
        """See `Teacher`; `moving` is not used."""
        asked = np.arange(len(positions)) if robots is None else np.array(robots, np.intp)
        velocities = np.zeros((len(asked), 2))
        flying = alive[asked]
        if flying.any():
            left = positions[alive]
            among_left = (np.cumsum(alive) - 1)[asked[flying]]
            velocities[flying] = cvt_velocity(
                left[among_left], self._goals(left, among_left), self._max_speed, self._reach
            )
        return velocities


def make_expert(config: DataConfig, world: Preparation) -> Expert:
    """Make the configured expert for a world."""
    scale, training = world.scenario.scale, world.bundle.manifest.training
    # A policy velocity of 1 in flight, in model units/s: the expert arrives within one time step.
    flown = scale.env_scale * scale.velocity_scale
    limit = training.max_speed * config.overshoot
    return Expert(_goals(config, world), limit, training.time_step * flown)


def _goals(config: DataConfig, world: Preparation) -> Goals:
    match config.expert:
        case "clairvoyant-cvt":
            return _Centroids(world.importance)
        case "best-of-lloyd":
            return _LloydEnds(world.importance, config.lloyd_runs)
        case "exploring-cvt":
            return _Exploring(world.importance, world.perception)


class _Clairvoyant:
    """Base of experts that know the whole world."""

    def look(self, positions: F64) -> None:
        """Do nothing."""


class _Centroids(_Clairvoyant):
    """ClairvoyantCVT's centroids, on a coarser raster.

    It takes a third of the time for ten robots in 512 x 512. A test bounds the mean difference from
    the fine raster's centroids by 0.2 model units, and that of the final cost by 1 %.
    """

    def __init__(self, importance: F32) -> None:
        self._importance = importance
        self._coarse: dict[int, tuple[F32, float]] = {}

    def __call__(self, positions: F64, robots: Indices) -> F64:
        left = len(positions)
        if left not in self._coarse:
            self._coarse[left] = coarse(self._importance, left)
        importance, cells = self._coarse[left]
        return voronoi_cells(importance, positions / cells).centroid[robots] * cells


class _LloydEnds(_Clairvoyant):
    """The best result of several runs of Lloyd's algorithm, assigned to the robots."""

    def __init__(self, importance: F32, runs: int) -> None:
        self._importance = importance
        self._runs = runs
        # By the number of working robots.
        self._best: dict[int, F64] = {}

    def __call__(self, positions: F64, robots: Indices) -> F64:
        left = len(positions)
        if left not in self._best:
            raster, cells = coarse(self._importance, left)
            ends = lloyd_ends(self._importance, positions, self._runs)
            costs = [voronoi_cells(raster, each / cells).cost.sum() for each in ends]
            self._best[left] = ends[int(np.argmin(costs))]
        goals = self._best[left]
        squares = ((positions[:, None] - goals) ** 2).sum(axis=2)
        return goals[assignment(squares)[robots]]


class _Exploring:
    """Explores a robot's Voronoi cell within its local map, and covers it as it becomes known.

    Like `lpac.sim.baselines.FrontierCvt`, but continuous: where goals jump, imitation would learn
    the mean of both sides, which is to stay.
    """

    def __init__(self, importance: F32, perception: PerceptionParameters) -> None:
        half, world_size = _PITCH // 2, perception.world_size
        self._sensor_size = perception.sensor_size
        self._half_window = perception.local_map_size / 2.0
        lattice = np.arange(half, world_size, _PITCH)
        self._importance = importance[np.ix_(lattice, lattice)].astype(np.float64)
        self._centres = lattice + 0.5
        self._seen = np.zeros((len(lattice),) * 2, np.bool_)

    def look(self, positions: F64) -> None:
        for position in positions:
            corner = window_corner(position, self._sensor_size)
            x, y = (
                slice(
                    max(math.ceil((low - _PITCH // 2) / _PITCH), 0),
                    max(math.ceil((low + self._sensor_size - _PITCH // 2) / _PITCH), 0),
                )
                for low in corner
            )
            self._seen[x, y] = True

    def __call__(self, positions: F64, robots: Indices) -> F64:
        self.look(positions)
        goals = positions[robots]
        for row, robot in enumerate(robots):
            position = positions[robot]
            x, y = (np.abs(self._centres - at) < self._half_window for at in position)
            grid = np.meshgrid(self._centres[x], self._centres[y], indexing="ij")
            points = np.stack(grid, axis=-1).reshape(-1, 2)
            squares = ((points[:, None] - positions) ** 2).sum(axis=2)
            own = squares.argmin(axis=1) == robot
            seen, importance = (
                values[np.ix_(x, y)].ravel()[own] for values in (self._seen, self._importance)
            )
            offsets = points[own] - position
            unseen, known, weights = offsets[~seen], offsets[seen], importance[seen]
            distance = np.linalg.norm(unseen, axis=1)
            pull = np.exp(-distance / _DECAY)
            away = pull / np.maximum(distance, 1.0)
            to_explore = _STEP * (away @ unseen) / max(pull.sum(), 1e-12)
            to_cover = weights @ known / max(weights.sum(), 1e-12)
            to_cover *= min(1.0, _STEP / max(float(np.linalg.norm(to_cover)), 1e-12))
            exploring = pull.sum() / (pull.sum() + 1.0)
            to_goal = exploring * to_explore + (1.0 - exploring) * to_cover
            # Move the goal further away while exploring, so that the robot does not slow down.
            goals[row] += (1.0 + exploring) * to_goal
        return goals


def assignment(cost: F64) -> Indices:
    """Column of each row (n,) in the assignment of least total `cost` (n, n).

    Shortest augmenting paths with potentials: Jonker and Volgenant, Computing 38 (1987).
    """
    n = len(cost)
    row_of = np.full(n + 1, -1)  # of each column; the last one is the start of a search
    of_rows, of_columns = np.zeros(n), np.zeros(n + 1)
    for row in range(n):
        column, row_of[n] = n, row
        shortest, before = np.full(n, np.inf), np.full(n, n)
        done = np.zeros(n + 1, np.bool_)
        while row_of[column] >= 0:
            done[column] = True
            here = row_of[column]
            reduced = cost[here] - of_rows[here] - of_columns[:n]
            closer = ~done[:n] & (reduced < shortest)
            shortest[closer], before[closer] = reduced[closer], column
            open_ = np.where(done[:n], np.inf, shortest)
            nearest = int(open_.argmin())
            step = open_[nearest]
            of_rows[row_of[done]] += step
            of_columns[done] -= step
            shortest[~done[:n]] -= step
            column = nearest
        while column != n:
            previous = before[column]
            row_of[column] = row_of[previous]
            column = previous
    columns = np.empty(n, np.intp)
    columns[row_of[:n]] = np.arange(n)
    return columns
