"""A ground to look at: yellow flowers, the more the more important a place is, on a meadow.

Neither the meadow nor the stones on it mean anything, and stones are as bright as flowers. What a
camera sees of it is computed pixel by pixel, as the mean over the ground that the pixel shows.
"""

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from edge.core import F32, F64
from edge.core.world import parse_world, rasterize
from lpac_camera.pinhole import Pinhole, shares

TEXELS = 4  # a side of a cell: 1.6 cm in the field
# A flower is so many texels wide, 4.7 cm in the field, and grows in this share of the cells where
# importance is 1.
_FLOWER = 3
_FLOWERS_AT_ONE = 0.6
COVER_AT_ONE = _FLOWERS_AT_ONE * (_FLOWER / TEXELS) ** 2
_STONES = 0.02  # of the cells
_YELLOW, _STONE = (0.92, 0.80, 0.12), (0.80, 0.79, 0.77)
_MEADOW, _SOIL = (0.27, 0.38, 0.16), (0.42, 0.34, 0.24)
_LIGHT = 0.12  # how much lighter or darker it is in places: clouds, the sun
_NOISE = 0.02  # of the camera's pixels, standard deviation


class Ground:
    """The ground of a world; the same each time that it is made of the same world.

    `importance` is the world's. `colors` (3, TEXELS * world, TEXELS * world), uint8, is indexed
    [channel, x, y], and `flowers` [x, y].
    """

    def __init__(self, importance: F32, seed: int = 0) -> None:
        """`importance` is (world, world), from 0 to 1, indexed [x, y]."""
        rng = np.random.default_rng(seed)
        self.importance = importance
        side = TEXELS * len(importance)
        soil = np.clip(0.5 + 0.35 * _patches(rng, side, (8, 40, 160)), 0.0, 1.0)[:, :, None]
        meadow, brown = (np.array(color, np.float32) for color in (_MEADOW, _SOIL))
        colors = (1.0 - soil) * meadow + soil * brown
        colors *= 1.0 + 0.25 * rng.standard_normal((side, side, 1), np.float32)
        stones = _placed(rng, np.full_like(importance, _STONES))
        self.flowers = _placed(rng, _FLOWERS_AT_ONE * importance) & ~stones
        colors[stones], colors[self.flowers] = _STONE, _YELLOW
        colors *= 1.0 + _LIGHT * _patches(rng, side, (3,))[:, :, None]
        colors *= 1.0 + 0.06 * rng.standard_normal((side, side, 1), np.float32)
        levels = np.rint(255.0 * np.clip(colors, 0.0, 1.0)).astype(np.uint8)
        self.colors = np.ascontiguousarray(np.moveaxis(levels, -1, 0))

    def photograph(
        self, camera: Pinhole, position: F64, height: float, rng: np.random.Generator
    ) -> npt.NDArray[np.uint8]:
        """(rows, columns, 3): what the camera sees from there; nothing grows beyond the world."""
        image = np.moveaxis(_seen(self.colors, TEXELS, camera, position, height), 0, -1)
        image = image / np.float32(255.0)
        world = np.array([0.0, len(self.importance)])
        in_x, in_y = (shares(axis, world)[:, 0] for axis in camera.edges(position, height))
        beyond = 1.0 - np.outer(in_y[::-1], in_x)[:, :, None]
        image += beyond * np.mean([_MEADOW, _SOIL], axis=0, dtype=np.float32)
        image += _NOISE * rng.standard_normal(image.shape, np.float32)
        return np.asarray(np.rint(255.0 * np.clip(image, 0.0, 1.0)), np.uint8)

    def cover(self, camera: Pinhole, position: F64, height: float) -> F32:
        """(rows, columns): which share of each pixel flowers fill."""
        cover: F32 = _seen(self.flowers[None], TEXELS, camera, position, height)[0]
        return cover

    def shown_importance(self, camera: Pinhole, position: F64, height: float) -> F32:
        """(rows, columns): the true mean importance of what each pixel shows."""
        shown: F32 = _seen(self.importance[None], 1, camera, position, height)[0]
        return shown


@lru_cache(maxsize=2)
def ground_of(text: str, source: str, world_size: int, truncation: float, norm: float) -> Ground:
    """The ground of a world file's text; robots of one program share it. Raises ValueError."""
    importance = rasterize(parse_world(text, source), world_size, truncation, norm)
    return Ground(np.clip(importance, 0.0, 1.0))


def _seen(
    texels: npt.NDArray[np.uint8] | npt.NDArray[np.bool_] | F32,
    scale: int,
    camera: Pinhole,
    position: F64,
    height: float,
) -> F32:
    """(n, rows, columns), top first: of each pixel the mean of the texels that it shows, by area.

    `texels` (n, x, y) are n channels, `scale` of them to a side of a cell.
    """
    edges = [scale * axis for axis in camera.edges(position, height)]
    x, y = (
        slice(*np.clip([np.floor(axis[0]), np.ceil(axis[-1])], 0, texels.shape[-1]).astype(int))
        for axis in edges
    )
    in_x, in_y = (
        shares(axis, np.arange(part.start, part.stop + 1, dtype=np.float64))
        for axis, part in zip(edges, (x, y), strict=True)
    )
    image: F32 = (in_x @ texels[:, x, y].astype(np.float32) @ in_y.T).swapaxes(1, 2)[:, ::-1]
    return image


def _placed(rng: np.random.Generator, probability: F32) -> npt.NDArray[np.bool_]:
    """One thing, `_FLOWER` texels wide, somewhere in each cell that has one; by texels."""
    size = len(probability)
    there = rng.random((size, size), np.float32) < probability
    shift = rng.integers(0, TEXELS - _FLOWER + 1, (2, size, size))
    texels = np.zeros((size, TEXELS, size, TEXELS), np.bool_)
    for i in range(TEXELS):
        for j in range(TEXELS):
            in_x = (shift[0] <= i) & (i < shift[0] + _FLOWER)
            in_y = (shift[1] <= j) & (j < shift[1] + _FLOWER)
            texels[:, i, :, j] = there & in_x & in_y
    return texels.reshape(TEXELS * size, TEXELS * size)


def _patches(rng: np.random.Generator, side: int, counts: tuple[int, ...]) -> F32:
    """(side, side), about -1 to 1: smooth, with so many patches along a side."""
    at = np.arange(side, dtype=np.float64)
    total = np.zeros((side, side), np.float32)
    for count in counts:
        knots = rng.uniform(-1.0, 1.0, (count + 1, count + 1))
        place = at * count / side
        low = place.astype(int)
        part = place - low
        weights = np.zeros((side, count + 1))
        weights[np.arange(side), low] = 1.0 - part
        weights[np.arange(side), low + 1] += part
        total += (weights @ knots @ weights.T).astype(np.float32)
    return total / np.float32(np.sqrt(len(counts)))
