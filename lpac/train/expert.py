"""Who is imitated: experts that know where all robots truly are.

Most know the whole world, too. What such a one does where a robot has seen nothing cannot be
learned, only its mean: to stay about where one is. "frontier-cvt" knows what all robots together
have seen, which is what robots that share maps come to know: it goes and looks.
"""

from dataclasses import replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from edge.core import F32, F64, Bools
from edge.core.coverage import cvt_velocity, voronoi_cells
from lpac.analysis.coverage import coarse, lloyd_ends
from lpac.sim.baselines import FrontierCvt
from lpac.sim.experiment import Preparation
from lpac.train.config import DataConfig


class Goals(Protocol):
    """Where robots at `positions` (n, 2), all that are left, should go: (n, 2), model units."""

    def __call__(self, positions: F64) -> F64: ...


class Expert:
    """The velocities of one world's robots, limited as a policy's are."""

    def __init__(self, goals: Goals, max_speed: float, reach: float) -> None:
        """A robot closer to its goal than `max_speed` times `reach` slows down.

        In model units, and model units/s as the policy has them, however fast they are flown.
        """
        self._goals = goals
        self._max_speed = max_speed
        self._reach = reach

    def velocities(self, positions: F64, alive: Bools) -> F64:
        """(N, 2) at true positions (N, 2); 0 of those who are not left."""
        velocities = np.zeros_like(positions)
        left = positions[alive]
        if len(left):
            goals = self._goals(left)
            velocities[alive] = cvt_velocity(left, goals, self._max_speed, self._reach)
        return velocities


def make_expert(config: DataConfig, world: Preparation) -> Expert:
    """The configured one, for that world."""
    scale, training = world.scenario.scale, world.bundle.manifest.training
    # What a velocity of 1 comes to in flight, in model units/s: so it arrives within a time step.
    flown = scale.env_scale * scale.velocity_scale
    return Expert(_goals(config, world), training.max_speed, training.time_step * flown)


def _goals(config: DataConfig, world: Preparation) -> Goals:
    match config.expert:
        case "clairvoyant-cvt":
            return _Centroids(world.importance)
        case "best-of-lloyd":
            return _LloydEnds(world.importance, config.lloyd_runs)
        case "frontier-cvt":
            all_hear_all = replace(
                world.perception, communication_range=2.0 * world.perception.world_size
            )
            return FrontierCvt(world.importance, all_hear_all, world.scenario.robots).goals


class _Centroids:
    """ClairvoyantCVT's, on a coarser raster.

    Of ten robots in 512 x 512 it takes a third of the time; a test holds the centroids to the fine
    raster's within 0.2 model units on average, and the cost at the end to 1 %.
    """

    def __init__(self, importance: F32) -> None:
        self._importance = importance
        self._coarse: dict[int, tuple[F32, float]] = {}

    def __call__(self, positions: F64) -> F64:
        robots = len(positions)
        if robots not in self._coarse:
            self._coarse[robots] = coarse(self._importance, robots)
        importance, cells = self._coarse[robots]
        return voronoi_cells(importance, positions / cells).centroid * cells


class _LloydEnds:
    """The best ends of several runs of Lloyd's algorithm, shared out among the robots."""

    def __init__(self, importance: F32, runs: int) -> None:
        self._importance = importance
        self._runs = runs
        # By the number of robots that are left.
        self._best: dict[int, F64] = {}

    def __call__(self, positions: F64) -> F64:
        robots = len(positions)
        if robots not in self._best:
            raster, cells = coarse(self._importance, robots)
            ends = lloyd_ends(self._importance, positions, self._runs)
            costs = [voronoi_cells(raster, each / cells).cost.sum() for each in ends]
            self._best[robots] = ends[int(np.argmin(costs))]
        goals = self._best[robots]
        squares = ((positions[:, None] - goals) ** 2).sum(axis=2)
        return goals[assignment(squares)]


def assignment(cost: F64) -> npt.NDArray[np.intp]:
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
