"""From sensor views to what a robot remembers of the world.

All maps are indexed [x, y]; one cell is one model unit; positions are in model units.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from edge.core import F32, F64, Bools

# What a robot has explored is told in this many cells along each side of the world.
EXPLORED_CELLS = 64
TILE_SIZE = 128
MAX_WORLD_SIZE = 2**15  # whose raster takes 4 GiB


@dataclass(frozen=True, slots=True)
class PerceptionParameters:
    """The sizes that a policy was trained with, in model units (= cells).

    Raises ValueError that names the parameter for an impossible value.
    """

    world_size: int
    local_map_size: int
    sensor_size: int
    communication_range: float
    # Importance of what has not been seen yet.
    unknown_importance: float = 0.0
    # The local map is NaN there instead, for policies that tell what is unseen from what is not.
    unseen_as_nan: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.world_size <= MAX_WORLD_SIZE:
            raise ValueError(f"world_size = {self.world_size}: must be from 1 to {MAX_WORLD_SIZE}")
        for name in ("local_map_size", "sensor_size"):
            size = getattr(self, name)
            if size <= 0 or size % 2:
                raise ValueError(f"{name} = {size}: must be positive and even")
        if not 0 < self.communication_range < np.inf:
            raise ValueError(
                f"communication_range = {self.communication_range}: must be positive and finite"
            )
        if not 0 <= self.unknown_importance < np.inf:
            raise ValueError(
                f"unknown_importance = {self.unknown_importance}: must be at least 0 and finite"
            )

    @property
    def unseen(self) -> float:
        """What the local map has in the world's cells that were not seen."""
        return math.nan if self.unseen_as_nan else self.unknown_importance


def window_corner(position: F64, size: int) -> tuple[int, int]:
    """Lowest cell of the square window of `size` cells that is centred at `position`."""
    x, y = (math.floor(coordinate + 0.5) - size // 2 for coordinate in position)
    return x, y


def clamp_to_world(positions: F64, world_size: int) -> F64:
    """The points of the world that are nearest to `positions` (..., 2)."""
    inside: F64 = np.minimum(np.maximum(positions, 0.0), world_size)
    return inside


def part_in_world(
    corner: tuple[int, int], size: int, world_size: int
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """What a square window of `size` cells from `corner` on shares with the world.

    As a part of the world's raster and as a part of the window; empty, at the border, for a
    window outside the world.
    """
    low_x, high_x, low_y, high_y = (
        min(max(cell, 0), world_size) for start in corner for cell in (start, start + size)
    )
    x, y = corner
    return (
        (slice(low_x, high_x), slice(low_y, high_y)),
        (slice(low_x - x, high_x - x), slice(low_y - y, high_y - y)),
    )


class RobotMap:
    """What one robot has seen, in tiles that are made when first seen.

    So its cost is that of the area seen, however large the world is.
    """

    def __init__(self, world_size: int, unseen: float = 0.0) -> None:
        """`unseen` is the value of cells that were not seen; it may be NaN."""
        self._world_size = world_size
        self._unseen = np.float32(unseen)
        self._tiles: dict[tuple[int, int], F32] = {}

    def insert(self, view: F32, corner: tuple[int, int]) -> None:
        """Write the square `view`, whose lowest cell is `corner`; what is off the world is not."""
        size = view.shape[0]
        for key, tile_part, view_part in self._overlaps(corner, size):
            tile = self._tiles.get(key)
            if tile is None:
                tile = np.full((TILE_SIZE, TILE_SIZE), self._unseen, np.float32)
                self._tiles[key] = tile
            tile[tile_part] = view[view_part]

    def window(self, corner: tuple[int, int], out: F32) -> F32:
        """Fill the square `out` from `corner` on and return it; the outside of the world is 0."""
        size = out.shape[0]
        out[:] = 0.0
        for key, tile_part, out_part in self._overlaps(corner, size):
            tile = self._tiles.get(key)
            if tile is not None:
                out[out_part] = tile[tile_part]
            elif self._unseen:
                out[out_part] = self._unseen
        return out

    def _overlaps(
        self, corner: tuple[int, int], size: int
    ) -> Iterator[tuple[tuple[int, int], tuple[slice, slice], tuple[slice, slice]]]:
        """Tile, part of the tile and part of the window, for all tiles that share cells."""
        spans_y = list(self._spans(corner[1], size))
        for tile_x, in_tile_x, in_window_x in self._spans(corner[0], size):
            for tile_y, in_tile_y, in_window_y in spans_y:
                yield (tile_x, tile_y), (in_tile_x, in_tile_y), (in_window_x, in_window_y)

    def _spans(self, start: int, size: int) -> Iterator[tuple[int, slice, slice]]:
        """The same along one axis, from `start` on and inside the world."""
        low, end = max(start, 0), min(start + size, self._world_size)
        while low < end:
            tile = low // TILE_SIZE
            origin = tile * TILE_SIZE
            high = min(end, origin + TILE_SIZE)
            yield tile, slice(low - origin, high - origin), slice(low - start, high - start)
            low = high


def neighbours_in_range(
    position: F64, others: F64, communication_range: float
) -> npt.NDArray[np.bool_]:
    """Which of `others` (n, 2) are closer to `position` (2,) than the range: (n,) bool."""
    near: npt.NDArray[np.bool_] = np.hypot(*(others - position).T) < communication_range
    return near


class RobotMemory:
    """What one robot has seen of the world.

    Not thread-safe: it belongs to the perception thread.
    """

    def __init__(self, parameters: PerceptionParameters) -> None:
        self._world_size = parameters.world_size
        self._map = RobotMap(parameters.world_size, parameters.unseen)
        self._local = np.empty((parameters.local_map_size,) * 2, np.float32)
        # For people: which cells of the coarse raster over the world it has seen.
        self.explored: Bools = np.zeros((EXPLORED_CELLS,) * 2, np.bool_)

    def observe(self, position: F64, view: F32) -> None:
        """Write the sensor's view (sensor_size, sensor_size) around `position` into the map.

        Those cells of `explored` count as seen whose centre was.
        """
        size = view.shape[0]
        corner = window_corner(position, size)
        self._map.insert(view, corner)
        scale = EXPLORED_CELLS / self._world_size
        x, y = (
            slice(max(math.ceil(low * scale - 0.5), 0), max(math.ceil(high * scale - 0.5), 0))
            for low, high in ((start, start + size) for start in corner)
        )
        self.explored[x, y] = True

    def local_map(self, position: F64) -> F32:
        """(local_map_size, local_map_size) around `position`, valid until the next call.

        `PerceptionParameters.unseen` where nothing was seen; the outside of the world is 0.
        """
        return self._map.window(window_corner(position, self._local.shape[0]), self._local)
