"""Experts to imitate, which know where all robots truly are.

Most know the whole world, too. What such a one does where a robot has seen nothing cannot be
learned, only its mean: to stay about where one is. "exploring-cvt" knows what all robots together
have seen, which is what robots that share maps come to know: it goes and looks.
"""

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from edge.core import F32, F64, Bools
from edge.core.coverage import cvt_velocity, voronoi_cells
from edge.core.perception import PerceptionParameters, window_corner
from lpac.analysis.coverage import coarse, lloyd_ends
from lpac.sim.points import Preparation
from lpac.train.config import DataConfig

Indices = npt.NDArray[np.intp]

# How often an expert looks around, s.
LOOK_PERIOD_S = 0.5
# Of the expert that explores, in model units: its lattice; how much further what is unseen may be
# to count e times less; how far its goal is where all that is unseen is in one direction. In eight
# training worlds of the field it ended at 0.256 of the first cost (clairvoyant 0.263), and was at
# 0.32 after 20 s; with a decay of 32 at 0.56. With 12 it left what is far unseen: 0.39.
_PITCH = 8
_DECAY = 18.0
_STEP = 24.0


class Goals(Protocol):
    """Where `robots` (m,) of those at `positions` (n, 2), all that are left, should go: (m, 2).

    In model units.
    """

    def __call__(self, positions: F64, robots: Indices) -> F64: ...

    def look(self, positions: F64) -> None:
        """Take notice of what the robots there see."""


class Expert:
    """The velocities of one world's robots, limited as a policy's are."""

    def __init__(self, goals: Goals, max_speed: float, reach: float) -> None:
        """A robot closer to its goal than `max_speed` times `reach` slows down.

        In model units, and model units/s as the policy has them, however fast they are flown.
        """
        self._goals = goals
        self._max_speed = max_speed
        self._reach = reach

    def look(self, positions: F64, alive: Bools) -> None:
        """Take notice of what the robots at `positions` (N, 2) see that are left."""
        self._goals.look(positions[alive])

    def velocities(
        self,
        positions: F64,
        alive: Bools,
        robots: Sequence[int] | None = None,
        moving: F64 | None = None,
    ) -> F64:
        """See `Teacher`; it does not matter how they move."""
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
    """The configured one, for that world."""
    scale, training = world.scenario.scale, world.bundle.manifest.training
    # What a velocity of 1 comes to in flight, in model units/s: so it arrives within a time step.
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
    """Has seen everything."""

    def look(self, positions: F64) -> None:
        """There is nothing new."""


class _Centroids(_Clairvoyant):
    """ClairvoyantCVT's, on a coarser raster.

    Of ten robots in 512 x 512 it takes a third of the time; a test holds the centroids to the fine
    raster's within 0.2 model units on average, and the cost at the end to 1 %.
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
    """The best ends of several runs of Lloyd's algorithm, shared out among the robots."""

    def __init__(self, importance: F32, runs: int) -> None:
        self._importance = importance
        self._runs = runs
        # By the number of robots that are left.
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
    """Explores its own Voronoi cell of its local map and covers it, the more the less is unseen.

    What `lpac.sim.baselines.FrontierCvt` does, but without its jumps from one goal to another: the
    mean of what is done on both sides of a jump is to stay, and that is what would be learned.
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
            # Further than a step where it explores: there it cannot be too fast.
            goals[row] += (1.0 + exploring) * to_goal
        return goals


def assignment(cost: F64) -> Indices:
    """(n,): the column of each row of `cost` (n, n), each once, so that their sum is least.

    Shortest augmenting paths with potentials: Jonker and Volgenant, Computing 38 (1987).
    """
    n = len(cost)
    row_of = np.full(n + 1, -1)  # of each column; the last is where a search begins
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
