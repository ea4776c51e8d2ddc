"""Maps that robots share: a coarse map of the surroundings of the robot that tells it.

Its cells are squares of `PerceptionParameters.shared_map_cell` model units, from the world's corner
on. A robot knows a cell once its sensor has shown all of it at once, or once it was told. What it
was told it passes on: so news travels as far as the communication graph reaches, now or later, and
a message is as large in any swarm. A cell is a byte: 0 if it is unknown, else one more than the
exponent and the first three bits of the fraction of a float16, so that who passes it on tells the
same.

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
# Of each byte, (256,): NaN of 0, and of those that stand for nothing.
_IMPORTANCE = np.full(256, np.nan, np.float32)
_IMPORTANCE[1 : _MOST_CODE + 1] = (np.arange(_MOST_CODE, dtype=np.uint16) << _SHIFT).view(
    np.float16
)
_LARGEST = _IMPORTANCE[_MOST_CODE]


class SharedMap(NamedTuple):
    """A robot's known surroundings: `codes` (n, n), which nobody changes, from cell `corner` on."""

    corner: tuple[int, int]
    codes: Codes


def codes_of(importance: F32) -> Codes:
    """The bytes for importance of any shape, which is finite: to the nearest, from 0 to 61440."""
    bounded: F32 = np.minimum(np.maximum(importance, 0.0), _LARGEST)
    bits = bounded.astype(np.float16).view(np.uint16)
    codes: Codes = (((bits + (1 << (_SHIFT - 1))) >> _SHIFT) + 1).astype(np.uint8)
    return codes


def importance_of(codes: Codes) -> F32:
    """The importance that bytes stand for, NaN where it is unknown."""
    return _IMPORTANCE[codes]


def cell_means(view: F32, cell: int) -> F32:
    """(m, n): the mean of each square of `cell` x `cell` values of `view` (m cell, n cell)."""
    m, n = (size // cell for size in view.shape)
    # Each cell's values side by side: so they are added in one order, whatever view they are of.
    cells = np.ascontiguousarray(view.reshape(m, cell, n, cell).swapaxes(1, 2))
    means: F32 = cells.reshape(m, n, cell * cell).mean(axis=2)
    return means


class SharedCells:
    """The part of a robot's knowledge that it tells others: a byte for each cell of the world.

    Not thread-safe: it belongs to the perception thread.
    """

    def __init__(self, parameters: PerceptionParameters) -> None:
        """For `parameters` that have a `shared_map_cell`."""
        self._cell = parameters.shared_map_cell
        self._told = parameters.shared_map_side
        self._side = -(-parameters.world_size // self._cell)
        self._codes: Codes = np.zeros((self._side, self._side), np.uint8)

    def see(self, view: F32, corner: tuple[int, int], seen: Bools | None = None) -> None:
        """Know all cells that are wholly in the square `view`, whose lowest value is `corner`'s.

        With `seen`, of the view's shape, those all of which it says was seen.
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
        """As `see`, of a view of `size` x `size` of a world whose cells are all `codes`."""
        (x, stop_x), (y, stop_y) = self._wholly_in(corner, size)
        here, _ = self._overlap((x, y), (stop_x - x, stop_y - y))
        self._codes[here] = codes[here]

    def hear(self, told: SharedMap) -> None:
        """Know what another robot knows, where nothing was known."""
        here, there = self._overlap(told.corner, told.codes.shape)
        known = self._codes[here]
        np.copyto(known, told.codes[there], where=known == 0)

    def tell(self, position: F64) -> SharedMap:
        """Known surroundings of `position` (2,), model units: as large as the local map."""
        x, y = corner = window_corner(position / self._cell, self._told)
        codes = np.zeros((self._told, self._told), np.uint8)
        here, there = self._overlap(corner, codes.shape)
        codes[there] = self._codes[here]
        return SharedMap((x, y), codes)

    def importance(self, corner: tuple[int, int], size: int) -> F32:
        """(size, size) from model unit `corner` on, NaN where it is unknown or off the world."""
        first = corner[0] // self._cell, corner[1] // self._cell
        codes = np.zeros((-(-size // self._cell) + 1,) * 2, np.uint8)
        here, there = self._overlap(first, codes.shape)
        codes[there] = self._codes[here]
        # In this order whole rows are copied last, which takes half as long.
        fine = importance_of(codes).repeat(self._cell, axis=1).repeat(self._cell, axis=0)
        x, y = corner[0] % self._cell, corner[1] % self._cell
        return fine[x : x + size, y : y + size]

    def _wholly_in(self, corner: tuple[int, int], size: int) -> tuple[tuple[int, int], ...]:
        """First cell, and the one after the last, along x and y; the same if there is none."""
        firsts = [-(-start // self._cell) for start in corner]
        stops = [(start + size) // self._cell for start in corner]
        return tuple((first, max(first, stop)) for first, stop in zip(firsts, stops, strict=True))

    def _overlap(
        self, corner: tuple[int, int], shape: tuple[int, ...]
    ) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Overlap of the world with cells of that shape from `corner` on: there, and here."""
        (in_world_x, in_x), (in_world_y, in_y) = (
            overlap(start, size, self._side) for start, size in zip(corner, shape, strict=True)
        )
        return (in_world_x, in_world_y), (in_x, in_y)
