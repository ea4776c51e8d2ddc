"""Evaluates a fleet's positions: the paper's coverage cost, Lloyd's algorithm, Voronoi cells."""

import math
from typing import Protocol

import numpy as np
import numpy.typing as npt

from edge.core import F32, F64
from edge.core.world import Feature, parse_world, rasterize
from edge.messages.mission import STEERED, FlightState, RobotStatus
from lpac.analysis.mission_tracker import MissionStatus
from lpac.analysis.snapshot import FleetSnapshot
from lpac.analysis.voronoi import cell_corners, coverage_cost, voronoi_cells

# Ten with the given positions.
_RANDOM_STARTS = 9
_SEED = 0
# Side of the raster for Lloyd's algorithm, in cells: 16 times as fast as the policy's 512, with the
# same cost within 1e-3. Large fleets need more.
_COARSE_CELLS = 128
_CELLS_PER_ROBOT = 16**2
# Stop when a step improves the cost by less than this share.
_LEAST_GAIN = 1e-5
# Beyond any flight. Squares of much larger numbers would overflow.
_FURTHEST_M = 1e6


class World(Protocol):
    """Description of a world; see `lpac.analysis.snapshot.FleetSetup` for the values."""

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

    `importance` (world_size, world_size) is indexed [x, y], and rasterised from `features` if these
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
        """Parse a world file. Raises ValueError if the text is invalid."""
        features = parse_world(world.world, f"world {world.world_id}")
        importance = rasterize(features, world.world_size, world.truncation, world.norm)
        return cls(importance, world.env_scale, features)

    @classmethod
    def known(cls, world: World) -> "Coverage | None":
        """Like `of`; None if the text is unknown or invalid."""
        try:
            return cls.of(world) if world.world else None
        except ValueError:
            return None

    def cost(self, positions_m: F64) -> float:
        """The paper's coverage cost J in model units (see `coverage_cost`); N >= 1."""
        return coverage_cost(self.importance, positions_m * self.cells_per_m)

    def lloyd(self, positions_m: F64) -> float:
        """The least J of ten runs of Lloyd's algorithm with knowledge of the world.

        Runs start from `positions_m` and from nine random sets of positions, always the same; N >=
        1. Each ends in a local minimum, so other starts may give less. Takes 0.5 s for 10 robots, 2
        s for 30.
        """
        positions = positions_m * self.cells_per_m
        ends = lloyd_ends(self.importance, positions, 1 + _RANDOM_STARTS)
        return min(self.cost(each / self.cells_per_m) for each in (positions, *ends))

    def cells_m(self, positions_m: F64) -> list[list[tuple[float, float]]]:
        """Corners of each robot's Voronoi cell within the world, in order, m.

        A robot outside the world may have none; robots at one point share a cell.
        """
        size = (self.size_m, self.size_m)
        corners_m = (cell_corners(size, positions_m, robot) for robot in range(len(positions_m)))
        return [[(x, y) for x, y in cell.tolist()] for cell in corners_m]

    def density(self, size: int) -> npt.NDArray[np.uint8]:
        """Importance (size, size), indexed [x, y], scaled to 0 to 255."""
        shrunk, _ = _shrink(self.importance, size)
        highest = max(float(shrunk.max()), 1e-9)
        return np.asarray(np.rint(shrunk * (255.0 / highest)), np.uint8)


def coarse(importance: F32, robots: int) -> tuple[F32, float]:
    """The importance in fewer cells, as needed for `robots`, and their side in old cells."""
    sides = math.ceil(math.sqrt(_CELLS_PER_ROBOT * robots))
    return _shrink(importance, max(_COARSE_CELLS, sides))


def lloyd_ends(importance: F32, positions: F64, runs: int) -> list[F64]:
    """Final positions, each (N, 2), of `runs` of Lloyd's algorithm, in model units.

    The first run starts from `positions` (N, 2), the others at random positions, the same each
    time. Without any importance there is only the first.
    """
    shrunk, cells = coarse(importance, len(positions))
    starts = (positions / cells, *_random_starts(shrunk, len(positions), runs - 1))
    return [_lloyd(shrunk, start) * cells for start in starts]


class LastPositions:
    """Selects the positions that count for J; remembers last known positions."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[float, float]] = {}

    def counted(self, snapshot: FleetSnapshot) -> dict[str, tuple[float, float]]:
        """Positions that count for J, by robot's name: (x, y) in the mission frame, m.

        Call with snapshots in order. Robots in the air count; if none is, all count. A robot in the
        air without a position counts at its last one. Stale robots never count.
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
    """Whether the robot reports that it flies."""
    if status.state in (FlightState.PILOT, FlightState.LAND):
        return bool(status.armed)
    return status.state in STEERED


def _position_m(status: RobotStatus) -> tuple[float, float] | None:
    if status.position_m is None or not all(abs(c) < _FURTHEST_M for c in status.position_m):
        return None
    x_m, y_m, _ = status.position_m
    return x_m, y_m


def _shrink(importance: F32, most: int) -> tuple[F32, float]:
    """Importance in larger cells (most, most), and their side in old cells."""
    count = importance.shape[0]
    edges = np.linspace(0.0, count, most + 1)[:, None]
    cells = np.arange(count)
    shares = np.clip(np.minimum(edges[1:], cells + 1) - np.maximum(edges[:-1], cells), 0.0, None)
    return np.asarray(shares @ importance @ shares.T, np.float32), count / most


def _random_starts(importance: F32, robots: int, count: int) -> list[F64]:
    """Draw `count` sets of positions (robots, 2), in cells, with the importance as density."""
    weights = importance.ravel().astype(np.float64)
    if weights.sum() == 0.0:
        return []
    rng = np.random.default_rng(_SEED)
    drawn = rng.choice(len(weights), (count, robots), p=weights / weights.sum())
    cells = np.stack(np.unravel_index(drawn, importance.shape), axis=-1)
    # Spread within the cell: only one of several robots at one point would own an area.
    return list(cells + rng.random(cells.shape))


def _lloyd(importance: F32, positions: F64) -> F64:
    """Local minimum (N, 2) of Lloyd's algorithm."""
    last = math.inf
    while True:
        cells = voronoi_cells(importance, positions)
        cost = float(cells.cost.sum())
        if not cost < last * (1.0 - _LEAST_GAIN):
            return positions
        last, positions = cost, cells.centroid
