"""A robot's map of the world, from its sensor and from others' shared maps.

All maps are indexed [x, y]; one cell is one model unit; positions are in model units.
"""

import math
from collections.abc import Iterator

import numpy as np

from edge.core import F32, F64, Bools
from edge.core.perception import PerceptionParameters, window_corner
from edge.core.shared_map import SharedCells, SharedMap

# Cells along each side of the world in the coarse raster of explored areas.
EXPLORED_CELLS = 64
TILE_SIZE = 128


class RobotMap:
    """Map of the cells that one robot has seen, in tiles that are allocated when first seen.

    Memory and time depend on the seen area, not on the world's size.
    """

    def __init__(self, world_size: int, unseen: float = 0.0) -> None:
        """`unseen` is the value of unseen cells, possibly NaN."""
        self._world_size = world_size
        self._unseen = np.float32(unseen)
        self._tiles: dict[tuple[int, int], F32] = {}

    def insert(self, view: F32, corner: tuple[int, int], seen: Bools | None = None) -> None:
        """Write the square `view`, whose lowest cell is `corner`, clipped to the world.

        `seen`, of the view's shape, limits this to cells where it is True.
        """
        size = view.shape[0]
        for key, tile_part, view_part in self._overlaps(corner, size):
            tile = self._tiles.get(key)
            if tile is None:
                tile = np.full((TILE_SIZE, TILE_SIZE), self._unseen, np.float32)
                self._tiles[key] = tile
            if seen is None:
                tile[tile_part] = view[view_part]
            else:
                np.copyto(tile[tile_part], view[view_part], where=seen[view_part])

    def window(self, corner: tuple[int, int], out: F32) -> F32:
        """Fill the square `out` from `corner` on and return it; 0 outside the world."""
        size = out.shape[0]
        if min(corner) < 0 or max(corner) + size > self._world_size:
            out[:] = 0.0
        for key, tile_part, out_part in self._overlaps(corner, size):
            tile = self._tiles.get(key)
            out[out_part] = self._unseen if tile is None else tile[tile_part]
        return out

    def _overlaps(
        self, corner: tuple[int, int], size: int
    ) -> Iterator[tuple[tuple[int, int], tuple[slice, slice], tuple[slice, slice]]]:
        """Yield each tile that overlaps the window, and the overlap as slices of both."""
        spans_y = list(self._spans(corner[1], size))
        for tile_x, in_tile_x, in_window_x in self._spans(corner[0], size):
            for tile_y, in_tile_y, in_window_y in spans_y:
                yield (tile_x, tile_y), (in_tile_x, in_tile_y), (in_window_x, in_window_y)

    def _spans(self, start: int, size: int) -> Iterator[tuple[int, slice, slice]]:
        """Yield the overlaps along one axis, clipped to the world."""
        low, end = max(start, 0), min(start + size, self._world_size)
        while low < end:
            tile = low // TILE_SIZE
            origin = tile * TILE_SIZE
            high = min(end, origin + TILE_SIZE)
            yield tile, slice(low - origin, high - origin), slice(low - start, high - start)
            low = high


class RobotMemory:
    """One robot's memory of the world.

    Not thread-safe: it belongs to the perception thread.
    """

    def __init__(self, parameters: PerceptionParameters) -> None:
        self._world_size = parameters.world_size
        self._unseen = parameters.unseen
        self._cells = SharedCells(parameters) if parameters.shared_map_cell else None
        # NaN marks the gaps, which others' maps fill.
        self._map = RobotMap(parameters.world_size, math.nan if self._cells else self._unseen)
        self._local = np.empty((parameters.local_map_size,) * 2, np.float32)
        # For display: seen cells of a coarse raster over the world.
        self.explored: Bools = np.zeros((EXPLORED_CELLS,) * 2, np.bool_)

    def observe(self, position: F64, view: F32, seen: Bools | None = None) -> None:
        """Write the sensor's view (sensor_size, sensor_size) around `position` into the map.

        `seen`, of the same shape, limits this to cells where it is True. A cell of `explored` is
        set if its centre was seen.
        """
        size = view.shape[0]
        corner = window_corner(position, size)
        self._map.insert(view, corner, seen)
        if self._cells:
            self._cells.see(view, corner, seen)
        scale = EXPLORED_CELLS / self._world_size
        x, y = (
            slice(max(math.ceil(low * scale - 0.5), 0), max(math.ceil(high * scale - 0.5), 0))
            for low, high in ((start, start + size) for start in corner)
        )
        if seen is None:
            self.explored[x, y] = True
        else:
            in_x, in_y = (
                ((np.arange(EXPLORED_CELLS)[cells] + 0.5) / scale).astype(int) - start
                for cells, start in zip((x, y), corner, strict=True)
            )
            self.explored[x, y] |= seen[np.ix_(in_x, in_y)]

    def merge(self, received: SharedMap) -> None:
        """Merge another robot's shared map, if maps are shared."""
        if self._cells:
            self._cells.merge(received)

    def shared_map(self, position: F64) -> SharedMap | None:
        """Shared map of the surroundings of `position`; None if maps are not shared."""
        return self._cells.around(position) if self._cells else None

    def local_map(self, position: F64) -> F32:
        """Map (local_map_size, local_map_size) around `position`, valid until the next call.

        Unknown cells are `PerceptionParameters.unseen`; cells outside the world are 0.
        """
        corner = window_corner(position, self._local.shape[0])
        self._map.window(corner, self._local)
        if self._cells:
            shared = self._cells.importance(corner, self._local.shape[0])
            np.copyto(self._local, shared, where=np.isnan(self._local))
            if not math.isnan(self._unseen):
                np.copyto(self._local, self._unseen, where=np.isnan(self._local))
        return self._local
