"""Coverage of a raster by a swarm: cost, Voronoi cells, and steps towards their centroids.

A raster is (rows, columns) float32, indexed [x, y]; its cell (i, j) covers [i, i+1) x [j, j+1) in
model units and counts as one weight at its centre (i + 0.5, j + 0.5). Positions are in model units
from the raster's corner. All functions are exact with float64 sums, and allow robots at one point,
on the border and outside the raster.

They are parts of the baselines, Lloyd's algorithm on centroidal Voronoi tessellations (CVT):
ClairvoyantCVT uses `voronoi_cells` on the true density, CentralizedCVT on the part seen by the
swarm, and DecentralizedCVT uses `local_centroid` on the part seen by each robot.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from edge.core import F32, F64

# Voronoi cells of less mass count as empty; the reference library's threshold.
_EMPTY_MASS = 1e-10
# Corners closer to a bisector lie on it: four robots on a circle share one corner.
_ON_BISECTOR = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class VoronoiCells:
    """One Voronoi cell per robot: each raster cell belongs to the nearest robot.

    `mass` (N,) is the importance in the cell, `centroid` (N, 2) the robot's goal in Lloyd's
    algorithm, `cost` (N,) the sum of importance times squared distance from the robot. Masses sum
    to the raster's, costs to `coverage_cost`.
    """

    mass: F64
    centroid: F64
    cost: F64


def coverage_cost(importance: F32, positions: F64) -> float:
    """J, the sum over raster cells of importance times squared distance to the nearest robot.

    `importance` (rows, columns), `positions` (N, 2), N >= 1. Source: the coverage cost of
    arXiv 2401.04855 ("LPAC"), on a raster.
    """
    cost = 0.0
    for block in _blocks(importance, positions):
        nearest = np.add.outer(block.dx2[0], block.dy2[0])
        for dx2, dy2 in zip(block.dx2[1:], block.dy2[1:], strict=True):
            np.minimum(nearest, np.add.outer(dx2, dy2), out=nearest)
        cost += float((block.importance * nearest).sum())
    return cost


def voronoi_cells(importance: F32, positions: F64) -> VoronoiCells:
    """Voronoi cells of robots at `positions` (N, 2), N >= 1, on `importance` (rows, columns).

    The first of equally near robots owns a raster cell, so the first of several robots at one point
    owns all of their cells. (The reference library counts these cells, and their cost, once per
    robot.)

    The centroid of an empty cell is the mean of its corners, as in the reference library; for a
    robot outside the raster without a cell on it, the raster's nearest point.
    """
    moments = _moments(importance, positions)
    centroid = [_centroid(m, importance.shape, positions, i) for i, m in enumerate(moments)]
    return VoronoiCells(mass=moments[:, 0], centroid=np.array(centroid), cost=moments[:, 3])


def local_centroid(
    window: F32, origin_cell: tuple[int, int], position: F64, neighbours: F64
) -> F64:
    """Centroid (2,) of one robot's Voronoi cell among its neighbours', within its own window.

    `window` (rows, columns) is a part of the robot's map, clipped to the world, and `origin_cell`
    the index of its first cell in the world's raster. `position` (2,) and `neighbours` (n, 2), n >=
    0, are in the world's model units; neighbours may be outside the window. Empty cells are treated
    as in `voronoi_cells`.
    """
    origin = np.array(origin_cell, np.float64)
    positions = np.vstack([position, neighbours]) - origin
    own_moments = _moments(window, positions)[0]
    return _centroid(own_moments, window.shape, positions, 0) + origin


def cvt_velocity(positions: F64, goals: F64, max_speed: float, time_step: float) -> F64:
    """Velocities (N, 2) towards `goals` (N, 2) at `max_speed`, or slower to arrive in `time_step`.

    Units are those of the arguments: model units, model units per second, seconds.
    """
    offset = goals - positions
    distance = np.linalg.norm(offset, axis=1, keepdims=True)
    velocity: F64 = offset / np.maximum(distance / max_speed, time_step)
    return velocity


class _Block(NamedTuple):
    """A part of the raster and, in ascending order, the robots that may be nearest to its cells.

    `x` (rows,) and `y` (columns,) are the cells' centres, `dx2` (robots, rows) and `dy2`
    (robots, columns) the parts of the squared distances from the robots to them.
    """

    importance: F32
    robots: npt.NDArray[np.intp]
    x: F64
    y: F64
    dx2: F64
    dy2: F64


def _blocks(importance: F32, positions: F64) -> Iterator[_Block]:
    """Cut the raster into blocks with few robots each, without blocks of no importance."""
    x, y = (np.arange(cells, dtype=np.float64) + 0.5 for cells in importance.shape)
    # Only the first of several robots at one point owns cells; drop the others.
    first_at_point = np.sort(np.unique(positions, axis=0, return_index=True)[1])
    todo = [(0, len(x), 0, len(y), first_at_point)]
    while todo:
        x0, x1, y0, y1, robots = todo.pop()
        part = importance[x0:x1, y0:y1]
        if not part.any():
            continue
        px, py = positions[robots].T[:, :, None]
        robots = robots[_may_own((x[[x0, x1 - 1]] - px) ** 2, (y[[y0, y1 - 1]] - py) ** 2)]
        # Splitting costs time per block, robots in a block time per cell; the optimum is flat.
        if max(x1 - x0, y1 - y0) > max(32, 512 // len(robots)):
            xm, ym = (x0 + x1) // 2, (y0 + y1) // 2
            todo += [(x0, xm, y0, ym, robots), (x0, xm, ym, y1, robots)]
            todo += [(xm, x1, y0, ym, robots), (xm, x1, ym, y1, robots)]
            continue
        px, py = positions[robots].T[:, :, None]
        dx2, dy2 = (x[x0:x1] - px) ** 2, (y[y0:y1] - py) ** 2
        yield _Block(part, robots, x[x0:x1], y[y0:y1], dx2, dy2)


def _may_own(dx2: F64, dy2: F64) -> npt.NDArray[np.bool_]:
    """Mask of the k robots that can be nearest to some point of a rectangle, (k,).

    `dx2` and `dy2`, (k, 2) each, are the parts of the squared distances to its sides. The
    difference of two robots' squared distances is linear in the point, so a robot that is farther
    than another at all four corners is farther everywhere in between.
    """
    d2 = (dx2[:, :, None] + dy2[:, None, :]).reshape(-1, 4)
    central = d2[d2.max(axis=1).argmin()]
    may_own: npt.NDArray[np.bool_] = (d2 <= central).any(axis=1)
    return may_own


def _moments(importance: F32, positions: F64) -> F64:
    """Each Voronoi cell's mass, first moments in x and y, second moment about the robot, (N, 4)."""
    moments = np.zeros((len(positions), 4))
    for block in _blocks(importance, positions):
        nearest = np.add.outer(block.dx2[0], block.dy2[0])
        owner = np.zeros(nearest.shape, np.intp)
        for i in range(1, len(block.robots)):
            d2 = np.add.outer(block.dx2[i], block.dy2[i])
            np.putmask(owner, d2 < nearest, i)
            np.minimum(nearest, d2, out=nearest)
        weight = block.importance.astype(np.float64)
        for i, robot in enumerate(block.robots):
            own = weight * (owner == i)
            # Each moment is a sum of a term in x and one in y: row and column sums suffice.
            rows, columns = own.sum(axis=1), own.sum(axis=0)
            second = rows @ block.dx2[i] + columns @ block.dy2[i]
            moments[robot] += rows.sum(), rows @ block.x, columns @ block.y, second
    return moments


def _centroid(moments: F64, size: tuple[int, ...], positions: F64, robot: int) -> F64:
    """Centroid (2,) of the robot's cell, or its substitute for an empty cell."""
    centroid: F64
    if moments[0] >= _EMPTY_MASS:
        centroid = moments[1:3] / moments[0]
    elif len(corners := cell_corners(size, positions, robot)):
        centroid = corners.mean(axis=0)
    else:
        centroid = np.clip(positions[robot], 0.0, size)
    return centroid


def cell_corners(size: tuple[float, ...], positions: F64, robot: int) -> F64:
    """Corners (n, 2) of the robot's Voronoi cell in [0, size[0]] x [0, size[1]]; n may be 0.

    `positions` is (N, 2), `robot` an index. Robots at one point share their cell.
    """
    position = positions[robot]
    corners = np.array([(0.0, 0.0), (size[0], 0.0), size, (0.0, size[1])])
    offsets = positions - position
    distances = np.linalg.norm(offsets, axis=1)
    for j in np.argsort(distances):
        if distances[j] == 0.0:
            continue
        reach = np.linalg.norm(corners - position, axis=1).max(initial=0.0)
        if distances[j] > 2.0 * reach:
            break  # this and all following bisectors pass outside the cell
        # Cut off what lies beyond the bisector between the two robots.
        beyond = (corners - position) @ offsets[j] / distances[j] - distances[j] / 2.0
        beyond[np.abs(beyond) < _ON_BISECTOR] = 0.0
        kept = []
        for k in range(len(corners)):
            if beyond[k - 1] * beyond[k] < 0.0:
                share = beyond[k - 1] / (beyond[k - 1] - beyond[k])
                kept.append(corners[k - 1] + share * (corners[k] - corners[k - 1]))
            if beyond[k] <= 0.0:
                kept.append(corners[k])
        corners = np.array(kept).reshape(-1, 2)
    return corners
