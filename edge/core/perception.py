"""From sensor views to the policy's input images.

LPAC paper (arXiv 2401.04855), section "Perception Module": the robot remembers what it has seen,
and the policy gets four square images around the robot: importance, the neighbours' relative x
and y, and obstacles (the outside of the world). All maps are indexed [x, y]; one cell is one
model unit; positions are in model units.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from edge.core import F32, F64, Bools

# The images by number of channels, in the order in which CoverageControl stacks them.
MAP_CHANNELS = {
    2: ("importance", "obstacles"),
    4: ("importance", "neighbours_x", "neighbours_y", "obstacles"),
}

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

    def __init__(self, world_size: int, unknown_importance: float = 0.0) -> None:
        self._world_size = world_size
        self._unknown = np.float32(unknown_importance)
        self._tiles: dict[tuple[int, int], F32] = {}

    def insert(self, view: F32, corner: tuple[int, int]) -> None:
        """Write the square `view`, whose lowest cell is `corner`; what is off the world is not."""
        size = view.shape[0]
        for key, tile_part, view_part in self._overlaps(corner, size):
            tile = self._tiles.get(key)
            if tile is None:
                tile = np.full((TILE_SIZE, TILE_SIZE), self._unknown, np.float32)
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
            elif self._unknown:
                out[out_part] = self._unknown
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


class Resize:
    """Bilinear, antialiased resize from `size` to `new_size` cells: A @ x @ A.T for an image x.

    Each row of A (new_size, size) is a triangle as wide as two new cells, cut at the border and
    summing to one; as torch and torchvision resize.
    """

    # Rows of A that are multiplied together, without the columns that are zero in all of them.
    _BAND = 8

    def __init__(self, size: int, new_size: int) -> None:
        scale = size / new_size
        centres = (np.arange(new_size) + 0.5) * scale
        distances = np.abs(np.arange(size) + 0.5 - centres[:, None]) / max(scale, 1.0)
        weights = np.clip(1.0 - distances, 0.0, None)
        weights /= weights.sum(axis=1, keepdims=True)
        self._cumulated = np.concatenate([np.zeros((1, new_size)), weights.T.cumsum(axis=0)])
        matrix = weights.astype(np.float32)
        self._transposed = np.ascontiguousarray(matrix.T)
        self._bands = []
        for start in range(0, new_size, self._BAND):
            rows = slice(start, start + self._BAND)
            used = np.flatnonzero(matrix[rows].any(axis=0))
            columns = slice(used[0], used[-1] + 1)
            self._bands.append((rows, columns, matrix[rows, columns].copy()))
        self._half = np.empty((new_size, size), np.float32)

    def image(self, image: F32, out: F32) -> None:
        """Resize `image` (size, size) into `out` (new_size, new_size)."""
        for rows, columns, band in self._bands:
            np.matmul(band, image[columns], out=self._half[rows])
        np.matmul(self._half, self._transposed, out=out)

    def interval(self, part: slice) -> F64:
        """Resize the line (size,) that is 1 in `part` and 0 elsewhere to (new_size,)."""
        resized: F64 = self._cumulated[part.stop] - self._cumulated[part.start]
        return resized


def neighbour_maps(offsets: F64, communication_range: float, image_size: int) -> F32:
    """The neighbours' relative x and relative y as two images, (2, image_size, image_size).

    `offsets` (n, 2) are the neighbours' positions relative to the robot, in model units. An image
    spans twice the range; values are in units of the range and add up within a cell.
    """
    scaled = offsets * (image_size / (2.0 * communication_range)) + (image_size / 2.0 - 0.5)
    cells = np.clip(np.rint(scaled), 0, image_size - 1).astype(np.intp)
    maps = np.zeros((2, image_size, image_size), np.float32)
    for axis in range(2):
        np.add.at(maps[axis], (cells[:, 0], cells[:, 1]), offsets[:, axis] / communication_range)
    return maps


def neighbours_in_range(
    position: F64, others: F64, communication_range: float
) -> npt.NDArray[np.bool_]:
    """Which of `others` (n, 2) are closer to `position` (2,) than the range: (n,) bool."""
    near: npt.NDArray[np.bool_] = np.hypot(*(others - position).T) < communication_range
    return near


class Perception:
    """One robot's memory of the world, and the images of it that the policy takes.

    Positions outside the world are taken to the nearest point of it, where training kept the
    robots: the policy never sees an input that it could not have been trained on.

    Not thread-safe: it belongs to the perception thread.
    """

    def __init__(self, parameters: PerceptionParameters, channels: int, image_size: int) -> None:
        self._parameters = parameters
        self._map = RobotMap(parameters.world_size, parameters.unknown_importance)
        self._local = np.empty((parameters.local_map_size,) * 2, np.float32)
        self._resize = Resize(parameters.local_map_size, image_size)
        self._images = np.empty((1, channels, image_size, image_size), np.float32)
        # For people: which cells of the coarse raster over the world it has seen.
        self.explored: Bools = np.zeros((EXPLORED_CELLS,) * 2, np.bool_)

    def observe(self, position: F64, view: F32) -> None:
        """Write the sensor's view (sensor_size, sensor_size) around `position` into the map.

        Those cells of `explored` count as seen whose centre was.
        """
        size = view.shape[0]
        corner = window_corner(position, size)
        self._map.insert(view, corner)
        scale = EXPLORED_CELLS / self._parameters.world_size
        x, y = (
            slice(max(math.ceil(low * scale - 0.5), 0), max(math.ceil(high * scale - 0.5), 0))
            for low, high in ((start, start + size) for start in corner)
        )
        self.explored[x, y] = True

    def images(self, position: F64, neighbours: F64) -> F32:
        """The policy's images, (1, channels, image_size, image_size), valid until the next call.

        `neighbours` (n, 2) are the positions of the robots in range, in model units.
        """
        parameters = self._parameters
        own = clamp_to_world(position, parameters.world_size)
        corner = window_corner(own, parameters.local_map_size)
        self._map.window(corner, self._local)
        self._resize.image(self._local, out=self._images[0, 0])
        _, inside = part_in_world(corner, parameters.local_map_size, parameters.world_size)
        self._images[0, -1] = 1.0 - np.outer(*map(self._resize.interval, inside))
        if self._images.shape[1] == len(MAP_CHANNELS[4]):
            others = clamp_to_world(neighbours, parameters.world_size)
            self._images[0, 1:3] = neighbour_maps(
                others - own, parameters.communication_range, self._images.shape[-1]
            )
        return self._images
