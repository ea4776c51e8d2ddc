"""Shared maps: a coarse map of the sender's surroundings.

Cells are squares of `PerceptionParameters.shared_map_cell` model units from the world's corner on.
A robot knows a cell once its sensor has seen all of it at once, or another robot sent it. Robots
forward received cells, so knowledge spreads as far as the communication graph reaches at any time,
with messages of constant size. A cell is one byte: 0 if unknown, else one more than the exponent
and the first three fraction bits of a float16, so forwarding changes nothing.

All maps are indexed [x, y].
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from edge.core import F32, F64, Bools
from edge.core.perception import PerceptionParameters, overlap, window_corner

Codes = npt.NDArray[np.uint8]

_SHIFT = 7
_MOST_CODE = 0xF8
# Value of each byte, (256,): NaN for 0 and unused bytes.
_IMPORTANCE = np.full(256, np.nan, np.float32)
_IMPORTANCE[1 : _MOST_CODE + 1] = (np.arange(_MOST_CODE, dtype=np.uint16) << _SHIFT).view(
    np.float16
)
_LARGEST = _IMPORTANCE[_MOST_CODE]


class SharedMap(NamedTuple):
    """A robot's known surroundings: read-only `codes` (n, n) from cell `corner` on."""

    corner: tuple[int, int]
    codes: Codes


def codes_of(importance: F32) -> Codes:
    """Nearest bytes for finite importance of any shape, from 0 to 61440."""
    bounded: F32 = np.minimum(np.maximum(importance, 0.0), _LARGEST)
    bits = bounded.astype(np.float16).view(np.uint16)
    codes: Codes = (((bits + (1 << (_SHIFT - 1))) >> _SHIFT) + 1).astype(np.uint8)
    return codes


def importance_of(codes: Codes) -> F32:
    """Importance of bytes; NaN where unknown."""
    return _IMPORTANCE[codes]


def cell_means(view: F32, cell: int) -> F32:
    """Means (m, n) of the squares of `cell` x `cell` values of `view` (m cell, n cell)."""
    m, n = (size // cell for size in view.shape)
    # Contiguous cells are summed in the same order for every view.
    cells = np.ascontiguousarray(view.reshape(m, cell, n, cell).swapaxes(1, 2))
    means: F32 = cells.reshape(m, n, cell * cell).mean(axis=2)
    return means


class SharedCells:
    """A robot's knowledge for shared maps: a byte for each cell of the world.

    Not thread-safe: it belongs to the perception thread.
    """

    def __init__(self, parameters: PerceptionParameters) -> None:
        """`parameters` must have a `shared_map_cell`."""
        self._cell = parameters.shared_map_cell
        self._shared_side = parameters.shared_map_side
        self._side = -(-parameters.world_size // self._cell)
        self._codes: Codes = np.zeros((self._side, self._side), np.uint8)

    def see(self, view: F32, corner: tuple[int, int], seen: Bools | None = None) -> None:
        """Update all cells that are wholly in the square `view` with the lowest value at `corner`.

        With `seen`, of the view's shape, only cells that were seen completely.
        """
        (x, stop_x), (y, stop_y) = self._wholly_in(corner, len(view))
        in_x, in_y = (
            slice(low * self._cell - start, high * self._cell - start)
            for low, high, start in ((x, stop_x, corner[0]), (y, stop_y, corner[1]))
        )
        codes = codes_of(cell_means(view[in_x, in_y], self._cell))
        here, there = self._overlap((x, y), codes.shape)
        if seen is None:
            self._codes[here] = codes[there]
        else:
            whole = cell_means(seen[in_x, in_y].astype(np.float32), self._cell) == 1.0
            np.copyto(self._codes[here], codes[there], where=whole[there])

    def see_world(self, codes: Codes, corner: tuple[int, int], size: int) -> None:
        """Like `see`, for a view of `size` x `size` of a world with the given `codes`."""
        (x, stop_x), (y, stop_y) = self._wholly_in(corner, size)
        here, _ = self._overlap((x, y), (stop_x - x, stop_y - y))
        self._codes[here] = codes[here]

    def merge(self, received: SharedMap) -> None:
        """Fill unknown cells from another robot's map."""
        here, there = self._overlap(received.corner, received.codes.shape)
        known = self._codes[here]
        np.copyto(known, received.codes[there], where=known == 0)

    def around(self, position: F64) -> SharedMap:
        """Known surroundings of `position` (2,), model units, of the local map's size."""
        x, y = corner = window_corner(position / self._cell, self._shared_side)
        codes = np.zeros((self._shared_side, self._shared_side), np.uint8)
        here, there = self._overlap(corner, codes.shape)
        codes[there] = self._codes[here]
        return SharedMap((x, y), codes)

    def importance(self, corner: tuple[int, int], size: int) -> F32:
        """Importance (size, size) from model unit `corner` on; NaN if unknown or off the world."""
        first = corner[0] // self._cell, corner[1] // self._cell
        codes = np.zeros((-(-size // self._cell) + 1,) * 2, np.uint8)
        here, there = self._overlap(first, codes.shape)
        codes[there] = self._codes[here]
        # This order copies whole rows last, which takes half the time.
        fine = importance_of(codes).repeat(self._cell, axis=1).repeat(self._cell, axis=0)
        x, y = corner[0] % self._cell, corner[1] % self._cell
        return fine[x : x + size, y : y + size]

    def _wholly_in(self, corner: tuple[int, int], size: int) -> tuple[tuple[int, int], ...]:
        """First cell and end, along x and y, of the cells wholly in a view; equal if none."""
        firsts = [-(-start // self._cell) for start in corner]
        stops = [(start + size) // self._cell for start in corner]
        return tuple((first, max(first, stop)) for first, stop in zip(firsts, stops, strict=True))

    def _overlap(
        self, corner: tuple[int, int], shape: tuple[int, ...]
    ) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Overlap of the world with cells from `corner` on, as parts of both, world first."""
        (in_world_x, in_x), (in_world_y, in_y) = (
            overlap(start, size, self._side) for start, size in zip(corner, shape, strict=True)
        )
        return (in_world_x, in_world_y), (in_x, in_y)
