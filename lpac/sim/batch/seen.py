"""Map of a robot in a known world: only which cells it has seen."""

import numpy as np

from edge.core import F32, F64, Bools
from edge.core.perception import PerceptionParameters, part_in_world, window_corner
from edge.core.shared_map import Codes, SharedCells, SharedMap, cell_means, codes_of

# Margin by which the box grows beyond need, in cells, so that it seldom grows.
_MARGIN = 64


class ShownWorld:
    """The true world, with its shared-map codes if robots share maps."""

    def __init__(self, importance: F32, parameters: PerceptionParameters) -> None:
        """`importance` (world_size, world_size) is not copied."""
        self.importance = importance
        self.parameters = parameters
        cell = parameters.shared_map_cell
        # Codes of all shared-map cells.
        self.codes: Codes = np.zeros((0, 0), np.uint8)
        if cell:
            beyond = -parameters.world_size % cell
            self.codes = codes_of(cell_means(np.pad(importance, (0, beyond)), cell))


class SeenMap:
    """Map of one robot, from its sensor and from shared maps.

    Equivalent to `edge.core.memory.RobotMemory`: the world's importance in seen cells, and the
    value for unseen ones elsewhere. All robots share the world; each one stores one byte for each
    cell of a box around the seen cells, and one for each shared cell.
    """

    def __init__(self, world: ShownWorld) -> None:
        self._world = world
        self._parameters = parameters = world.parameters
        self._cells = SharedCells(parameters) if parameters.shared_map_cell else None
        # The box's least and greatest cells, and its cells that were seen.
        self._low = (0, 0)
        self._high = (0, 0)
        self._seen: Bools = np.zeros((0, 0), np.bool_)

    def observe(self, position: F64) -> None:
        """See what the sensor shows around `position` (2,)."""
        size, world_size = self._parameters.sensor_size, self._parameters.world_size
        corner = window_corner(position, size)
        if self._cells:
            self._cells.see_world(self._world.codes, corner, size)
        (x, y), _ = part_in_world(corner, size, world_size)
        if x.start == x.stop or y.start == y.stop:
            return
        (x0, y0), (x1, y1) = self._low, self._high
        if not (x0 <= x.start and x.stop <= x1 and y0 <= y.start and y.stop <= y1):
            self._grow(x, y)
            x0, y0 = self._low
        self._seen[x.start - x0 : x.stop - x0, y.start - y0 : y.stop - y0] = True

    def merge(self, received: SharedMap) -> None:
        """Merge another robot's shared map; do nothing if maps are not shared."""
        if self._cells:
            self._cells.merge(received)

    def shared_map(self, position: F64) -> SharedMap | None:
        """Shared map of the surroundings of `position`; None if maps are not shared."""
        return self._cells.around(position) if self._cells else None

    def local_map(self, position: F64, out: F32) -> F32:
        """Fill `out` (local_map_size, local_map_size) around `position` (2,) and return it.

        Cells neither seen nor shared are `PerceptionParameters.unseen`; those outside the world
        are 0.
        """
        parameters = self._parameters
        size = parameters.local_map_size
        out[:] = 0.0
        corner_x, corner_y = corner = window_corner(position, size)
        (x, y), in_window = part_in_world(corner, size, parameters.world_size)
        if self._cells:
            known = self._cells.importance(corner, size)
            np.copyto(known, parameters.unseen, where=np.isnan(known))
            out[in_window] = known[in_window]
        elif parameters.unseen:
            out[in_window] = parameters.unseen
        (x0, y0), (x1, y1) = self._low, self._high
        x0, x1 = max(x0, x.start), min(x1, x.stop)
        y0, y1 = max(y0, y.start), min(y1, y.stop)
        if x0 >= x1 or y0 >= y1:
            return out
        low_x, low_y = self._low
        np.copyto(
            out[x0 - corner_x : x1 - corner_x, y0 - corner_y : y1 - corner_y],
            self._world.importance[x0:x1, y0:y1],
            where=self._seen[x0 - low_x : x1 - low_x, y0 - low_y : y1 - low_y],
        )
        return out

    def _grow(self, x: slice, y: slice) -> None:
        """Extend the box to include the cells of `x` and `y`."""
        (x0, y0), (x1, y1) = self._low, self._high
        seen = self._seen
        if not seen.size:
            x0, y0, x1, y1 = x.start, y.start, x.start, y.start
        world_size = self._parameters.world_size
        low_x, low_y = (
            old if old <= part.start else max(part.start - _MARGIN, 0)
            for old, part in ((x0, x), (y0, y))
        )
        high_x, high_y = (
            old if old >= part.stop else min(part.stop + _MARGIN, world_size)
            for old, part in ((x1, x), (y1, y))
        )
        self._seen = np.zeros((high_x - low_x, high_y - low_y), np.bool_)
        if seen.size:
            self._seen[x0 - low_x : x1 - low_x, y0 - low_y : y1 - low_y] = seen
        self._low, self._high = (low_x, low_y), (high_x, high_y)
