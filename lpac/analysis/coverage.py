"""Value of a fleet's positions: the paper's coverage cost, Lloyd's, and Voronoi cells."""

import math
from typing import Protocol

import numpy as np
import numpy.typing as npt

from edge.core import F32, F64
from edge.core.coverage import cell_corners, coverage_cost, voronoi_cells
from edge.core.world import Feature, parse_world, rasterize
from edge.messages.mission import STEERED, FlightState, RobotStatus
from lpac.analysis.mission_tracker import MissionStatus
from lpac.analysis.snapshot import FleetSnapshot

# With the positions that are given, ten.
_RANDOM_STARTS = 9
_SEED = 0
# Lloyd's algorithm runs on a raster of this many cells a side: 16 times as fast as on the policy's
# 512, and the cost that it comes to is the same within 1e-3. Very many robots need more.
_COARSE_CELLS = 128
_CELLS_PER_ROBOT = 16**2
# It ends when a step gains less than this share of the cost.
_LEAST_GAIN = 1e-5
# Nobody flies there, and squares of more are not finite.
_FURTHEST_M = 1e6


class World(Protocol):
    """Description of a world; `lpac.analysis.snapshot.FleetSetup` says what each value is."""

    @property
    def world(self) -> str: ...
    @property
    def world_id(self) -> str: ...
    @property
    def world_size(self) -> int: ...
    @property
    def env_scale(self) -> float: ...
    @property
    def truncation(self) -> float: ...
    @property
    def norm(self) -> float: ...


class Coverage:
    """Coverage of one world. Positions are (N, 2) in the mission frame, m, also outside the world.

    `importance` is (world_size, world_size), indexed [x, y], and what `features` come to, if these
    are known; `size_m` is the world's side.
    """

    def __init__(
        self, importance: F32, cells_per_m: float, features: tuple[Feature, ...] = ()
    ) -> None:
        self.importance = importance
        self.features = features
        self.size_m = len(importance) / cells_per_m
        self.cells_per_m = cells_per_m

    @classmethod
    def of(cls, world: World) -> "Coverage":
        """Raises ValueError if the world's text is no world file."""
        features = parse_world(world.world, f"world {world.world_id}")
        importance = rasterize(features, world.world_size, world.truncation, world.norm)
        return cls(importance, world.env_scale, features)

    def cost(self, positions_m: F64) -> float:
        """The coverage cost J of the paper in model units (see `coverage_cost`); N >= 1."""
        return coverage_cost(self.importance, positions_m * self.cells_per_m)

    def lloyd(self, positions_m: F64) -> float:
        """The least J of ten runs of Lloyd's algorithm, which knows the world.

        From `positions_m`, and from nine random starts that are the same each time; N >= 1. Each
        ends in a local minimum: other starts may come to less. It takes 0.5 s for 10 robots, 2 s
        for 30.
        """
        positions = positions_m * self.cells_per_m
        ends = lloyd_ends(self.importance, positions, 1 + _RANDOM_STARTS)
        return min(self.cost(each / self.cells_per_m) for each in (positions, *ends))

    def cells_m(self, positions_m: F64) -> list[list[tuple[float, float]]]:
        """Each robot's Voronoi cell within the world: its corners in order, m.

        A robot outside the world may have none; robots at one point share theirs.
        """
        size = (self.size_m, self.size_m)
        corners_m = (cell_corners(size, positions_m, robot) for robot in range(len(positions_m)))
        return [[(x, y) for x, y in cell.tolist()] for cell in corners_m]

    def density(self, size: int) -> npt.NDArray[np.uint8]:
        """(size, size), indexed [x, y]: the importance from 0 to 255, its highest."""
        shrunk, _ = _shrink(self.importance, size)
        highest = max(float(shrunk.max()), 1e-9)
        return np.asarray(np.rint(shrunk * (255.0 / highest)), np.uint8)


def coarse(importance: F32, robots: int) -> tuple[F32, float]:
    """The importance in fewer cells, enough for so many robots; and how many old ones each has."""
    sides = math.ceil(math.sqrt(_CELLS_PER_ROBOT * robots))
    return _shrink(importance, max(_COARSE_CELLS, sides))


def lloyd_ends(importance: F32, positions: F64, runs: int) -> list[F64]:
    """Where `runs` of Lloyd's algorithm end, each (N, 2), in model units.

    It knows the world. The first starts from `positions` (N, 2), the others at random, at the same
    places each time; without any importance there is only the first.
    """
    shrunk, cells = coarse(importance, len(positions))
    starts = (positions / cells, *_random_starts(shrunk, len(positions), runs - 1))
    return [_lloyd(shrunk, start) * cells for start in starts]


class Whereabouts:
    """Tells which robots' positions count for J; it remembers where they were."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[float, float]] = {}

    def counted(self, snapshot: FleetSnapshot) -> dict[str, tuple[float, float]]:
        """The robots that count, by name: (x, y) in the mission frame, m. Pictures come in order.

        Those in the air; while nobody is, all. Who does not know where it is counts in the air
        with where it was last, else not; who was not heard for a while never counts.
        """
        flying, known = {}, {}
        for robot in snapshot.robots:
            status = robot.status
            if status is None or not robot.fresh:
                continue
            place_m = _position_m(status)
            if place_m is not None:
                self._last[robot.name] = place_m
            elif in_air(status):
                place_m = self._last.get(robot.name)
            if place_m is not None:
                known[robot.name] = place_m
                if in_air(status):
                    flying[robot.name] = place_m
        return flying or known


def in_air(status: MissionStatus) -> bool:
    """Whether the robot flies, as far as it says."""
    if status.state in (FlightState.PILOT, FlightState.LAND):
        return bool(status.armed)
    return status.state in STEERED


def _position_m(status: RobotStatus) -> tuple[float, float] | None:
    if status.position_m is None or not all(abs(c) < _FURTHEST_M for c in status.position_m):
        return None
    x_m, y_m, _ = status.position_m
    return x_m, y_m


def _shrink(importance: F32, most: int) -> tuple[F32, float]:
    """(most, most): the importance in larger cells; and how many old ones a new one is long."""
    count = importance.shape[0]
    edges = np.linspace(0.0, count, most + 1)[:, None]
    cells = np.arange(count)
    shares = np.clip(np.minimum(edges[1:], cells + 1) - np.maximum(edges[:-1], cells), 0.0, None)
    return np.asarray(shares @ importance @ shares.T, np.float32), count / most


def _random_starts(importance: F32, robots: int, count: int) -> list[F64]:
    """So many of positions (robots, 2), in cells, drawn from the importance."""
    weights = importance.ravel().astype(np.float64)
    if weights.sum() == 0.0:
        return []
    rng = np.random.default_rng(_SEED)
    drawn = rng.choice(len(weights), (count, robots), p=weights / weights.sum())
    cells = np.stack(np.unravel_index(drawn, importance.shape), axis=-1)
    # Within the cell, since of robots at one point only one would own anything.
    return list(cells + rng.random(cells.shape))


def _lloyd(importance: F32, positions: F64) -> F64:
    """Positions (N, 2) that a step of Lloyd's algorithm improves no more."""
    last = math.inf
    while True:
        cells = voronoi_cells(importance, positions)
        cost = float(cells.cost.sum())
        if not cost < last * (1.0 - _LEAST_GAIN):
            return positions
        last, positions = cost, cells.centroid
