"""A sensor that reads a known world: for flights over a virtual importance density function."""

import numpy as np

from edge.core import F32, F64
from edge.core.perception import part_in_world, window_corner


class WorldSensor:
    """Shows the part of the world's raster that a downward camera at the position would see."""

    def __init__(self, importance: F32, sensor_size: int) -> None:
        """`importance` is (world_size, world_size), indexed [x, y]."""
        self._importance = importance
        self._size = sensor_size

    def view(self, position: F64) -> F32:
        """(sensor_size, sensor_size) around `position` (2,), model units; 0 outside the world."""
        view = np.zeros((self._size, self._size), np.float32)
        corner = window_corner(position, self._size)
        in_world, in_view = part_in_world(corner, self._size, len(self._importance))
        view[in_view] = self._importance[in_world]
        return view
