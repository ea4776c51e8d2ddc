"""The camera's geometry: which ground a pixel shows, and which pixels show a cell.

All lengths are model units (cells). The camera looks straight down; its image's columns run along
the mission frame's x axis, its rows against the y axis: the top of the image is +y.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from edge.core import F32, F64, Bools
from edge.core.perception import window_corner
from edge.core.schema import Bounded

Pixels = Annotated[int, Meta(ge=8, le=4096)]
FieldOfView = Annotated[float, Meta(ge=1.0, le=170.0)]


@dataclass(frozen=True, slots=True)
class Pinhole(Bounded):
    """A camera without distortion, its pixels square.

    Raises ValueError that names the number for an impossible one.
    """

    columns: Pixels = 120
    rows: Pixels = 90
    field_of_view_deg: FieldOfView = 40.0  # across the columns

    def pixel(self, height: float) -> float:
        """How long a pixel is on the ground, seen from `height` above it."""
        return 2.0 * height * math.tan(math.radians(self.field_of_view_deg) / 2.0) / self.columns

    def edges(self, centre: F64, height: float, margin: int = 0) -> tuple[F64, F64]:
        """(columns + 1,) x and (rows + 1,) y, both ascending: the pixels' edges on the ground.

        From `height` above `centre` (2,); without `margin` pixels at each side.
        """
        x, y = (
            place + (np.arange(margin, count - margin + 1) - count / 2.0) * self.pixel(height)
            for place, count in zip(centre, (self.columns, self.rows), strict=True)
        )
        return x, y


def shares(edges: F64, cells: F64) -> F32:
    """(n, m): the share of each of the n intervals of `edges` (n + 1,) in the m of `cells`."""
    low = np.maximum(edges[:-1, None], cells[:-1])
    high = np.minimum(edges[1:, None], cells[1:])
    return np.asarray(np.clip(high - low, 0.0, None) / np.diff(edges)[:, None], np.float32)


def onto_cells(image: F32, x: F64, y: F64, position: F64, size: int) -> tuple[F32, Bools]:
    """What pixels say of the cells around a robot: (size, size), indexed [x, y], and where.

    `image` (rows, columns), top first, has the pixels' edges `x` and `y`; a cell has the mean of
    its pixels, by area. Only those cells are seen that lie wholly in the image.
    """
    corner = window_corner(position, size)
    in_x, in_y = (start + np.arange(size + 1, dtype=np.float64) for start in corner)
    cells = shares(in_x, x) @ image[::-1].T @ shares(in_y, y).T
    return np.asarray(cells, np.float32), np.outer(_within(in_x, x), _within(in_y, y))


def smoothed(cells: F32, seen: Bools, width: int) -> F32:
    """Of each cell the mean of what is seen in the square of `width` cells around it; else 0."""
    offsets = np.abs(np.subtract.outer(*(np.arange(len(cells)),) * 2))
    band = (2 * offsets <= width).astype(np.float32)
    known = band @ seen.astype(np.float32) @ band
    total = band @ np.where(seen, cells, np.float32(0.0)) @ band
    means: F32 = np.divide(total, known, out=np.zeros_like(cells), where=known > 0.5)
    return means


def _within(cells: F64, edges: F64) -> npt.NDArray[np.bool_]:
    tolerance = 1e-9 * max(1.0, abs(float(edges[-1])))
    inside: npt.NDArray[np.bool_] = (cells[:-1] >= edges[0] - tolerance) & (
        cells[1:] <= edges[-1] + tolerance
    )
    return inside
