"""Sizes of a robot's perception, and places of windows in the world.

All maps are indexed [x, y]; one cell is one model unit; positions are in model units.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from edge.core import F64, Bools
from edge.core.schema import Bounded, NonNegative, Positive

MAX_WORLD_SIZE = 2**15  # a raster of 4 GiB
_EvenSize = Annotated[int, Meta(ge=2, multiple_of=2, description="positive and even")]


@dataclass(frozen=True, slots=True)
class PerceptionParameters(Bounded):
    """Sizes with which a policy was trained, in model units (= cells).

    Raises ValueError that names an impossible parameter.
    """

    world_size: Annotated[int, Meta(ge=1, le=MAX_WORLD_SIZE)]
    local_map_size: _EvenSize
    sensor_size: _EvenSize
    communication_range: Positive
    # Importance of unseen cells.
    unknown_importance: NonNegative = 0.0
    # The local map is NaN in unseen cells, for policies that treat them differently.
    unseen_as_nan: bool = False
    # Robots share maps with cells of this size; 0: they do not.
    shared_map_cell: int = 0

    def check_rules(self) -> None:
        cell = self.shared_map_cell
        if cell < 0 or (cell and self.local_map_size % cell):
            raise ValueError(
                f"shared_map_cell = {cell}: must be 0, or divide "
                f"local_map_size = {self.local_map_size}"
            )

    @property
    def shared_map_side(self) -> int:
        """Number of cells along each side of a shared map; 0 if maps are not shared."""
        return self.local_map_size // self.shared_map_cell if self.shared_map_cell else 0

    @property
    def unseen(self) -> float:
        """Value of unseen cells of the world in the local map."""
        return math.nan if self.unseen_as_nan else self.unknown_importance


def window_corner(position: F64, size: int) -> tuple[int, int]:
    """Lowest cell of the square window of `size` cells centred at `position`."""
    x, y = (math.floor(coordinate + 0.5) - size // 2 for coordinate in position)
    return x, y


def clamp_to_world(positions: F64, world_size: int) -> F64:
    """Points of the world nearest to `positions` (..., 2)."""
    inside: F64 = np.minimum(np.maximum(positions, 0.0), world_size)
    return inside


def part_in_world(
    corner: tuple[int, int], size: int, world_size: int
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Overlap of the world with a square window of `size` cells from `corner` on.

    Returned as a part of the world's raster and as a part of the window; empty, at the border, for
    a window outside the world.
    """
    (in_world_x, in_window_x), (in_world_y, in_window_y) = (
        overlap(start, size, world_size) for start in corner
    )
    return (in_world_x, in_world_y), (in_window_x, in_window_y)


def overlap(start: int, size: int, world_size: int) -> tuple[slice, slice]:
    """Overlap of `size` cells from `start` on with 0 .. world_size, as parts of both, world first.

    Empty, at the border, if they do not overlap.
    """
    low, high = min(max(start, 0), world_size), min(max(start + size, 0), world_size)
    return slice(low, high), slice(low - start, high - start)


def neighbours_in_range(position: F64, others: F64, communication_range: float) -> Bools:
    """Mask (n,) of the `others` (n, 2) closer to `position` (2,) than the range."""
    near: Bools = np.hypot(*(others - position).T) < communication_range
    return near
