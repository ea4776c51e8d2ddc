"""Input images of the policy.

LPAC paper (arXiv 2401.04855), section "Perception Module": four square images around the robot:
importance, the neighbours' relative x and y, and obstacles (the outside of the world). Two more,
which the paper's policies do not use: "explored" is 1 in cells of the world that the robot or its
neighbours have seen, 0 elsewhere, and separates unseen from unimportant; "own_cell" is 1 in the
robot's Voronoi cell among the neighbours, 0 elsewhere. All are indexed [x, y]. One cell of a map is
one model unit; positions are in model units.
"""

from collections.abc import Sequence

import numpy as np

from edge.core import F32, F64, Bools
from edge.core.perception import (
    PerceptionParameters,
    clamp_to_world,
    part_in_world,
    window_corner,
)

NEIGHBOURS = ("neighbours_x", "neighbours_y")
EXPLORED = "explored"
OWN_CELL = "own_cell"
# The images by number of channels. Two and four are in CoverageControl's order.
MAP_CHANNELS: dict[int, tuple[str, ...]] = {
    2: ("importance", "obstacles"),
    4: ("importance", *NEIGHBOURS, "obstacles"),
    5: ("importance", *NEIGHBOURS, EXPLORED, "obstacles"),
    6: ("importance", *NEIGHBOURS, EXPLORED, OWN_CELL, "obstacles"),
}


def require_channels(channels: tuple[str, ...]) -> None:
    """Raise ValueError unless `channels` are of `MAP_CHANNELS`."""
    if channels not in MAP_CHANNELS.values():
        allowed = " or ".join(", ".join(names) for names in MAP_CHANNELS.values())
        raise ValueError(f"channels = {', '.join(channels)}: allowed are {allowed}")


class Resize:
    """Bilinear, antialiased resize from `size` to `new_size` cells: A @ x @ A.T for an image x.

    Each row of A (new_size, size) is a triangle two new cells wide, cut at the border and summing
    to one, as in torch and torchvision.
    """

    # Number of rows of A multiplied together, without the columns that are zero in all of them.
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
        """Resize the line (size,) that is 1 in `part` and 0 elsewhere, to (new_size,)."""
        resized: F64 = self._cumulated[part.stop] - self._cumulated[part.start]
        return resized


def neighbour_maps(offsets: F64, communication_range: float, image_size: int) -> F32:
    """The neighbours' relative x and relative y as two images, (2, image_size, image_size).

    `offsets` (n, 2) are the neighbours' positions relative to the robot, in model units. An image
    spans twice the range. Values are in units of the range, summed within a cell.
    """
    scaled = offsets * (image_size / (2.0 * communication_range)) + (image_size / 2.0 - 0.5)
    cells = np.clip(np.rint(scaled), 0, image_size - 1).astype(np.intp)
    maps = np.zeros((2, image_size, image_size), np.float32)
    for axis in range(2):
        np.add.at(maps[axis], (cells[:, 0], cells[:, 1]), offsets[:, axis] / communication_range)
    return maps


def own_cell(offsets: F64, local_map_size: float, image_size: int) -> Bools:
    """Mask (image_size, image_size) of the places nearer to the robot than to any neighbour.

    `offsets` (n, 2) are the neighbours' positions relative to the robot, in model units; the image
    spans `local_map_size` around it.
    """
    places = (np.arange(image_size) + 0.5 - image_size / 2.0) * (local_map_size / image_size)
    along_x, along_y = (
        offsets[:, 0, None, None] * places[:, None],
        offsets[:, 1, None, None] * places,
    )
    half_squares = (offsets**2).sum(axis=1)[:, None, None] / 2.0
    own: Bools = (along_x + along_y <= half_squares).all(axis=0)
    return own


class PolicyImages:
    """Computes one robot's images. Not thread-safe: it belongs to the perception thread."""

    def __init__(
        self, parameters: PerceptionParameters, channels: Sequence[str], image_size: int
    ) -> None:
        """`channels` are of `MAP_CHANNELS`; EXPLORED needs `parameters.unseen_as_nan`."""
        self._parameters = parameters
        self._resize = Resize(parameters.local_map_size, image_size)
        self._images = np.empty((1, len(channels), image_size, image_size), np.float32)
        self._channels = tuple(channels)
        if EXPLORED in channels:
            # Input of the resize: the mask of seen cells, then the map with unseen cells filled in.
            self._part = np.empty((parameters.local_map_size,) * 2, np.float32)

    def images(self, position: F64, local_map: F32, neighbours: F64) -> F32:
        """The policy's images, (1, channels, image_size, image_size), valid until the next call.

        `position` (2,) is in the world, `local_map` (local_map_size, local_map_size) around it, and
        `neighbours` (n, 2) are the positions of the robots in range. Those outside the world are
        moved to the nearest point inside: in training all robots were inside.
        """
        parameters = self._parameters
        # Views for this call only: a deep copy of the robot would separate kept views from images.
        image = dict(zip(self._channels, self._images[0], strict=True))
        corner = window_corner(position, parameters.local_map_size)
        _, inside = part_in_world(corner, parameters.local_map_size, parameters.world_size)
        if EXPLORED in image:
            unseen = np.isnan(local_map)
            self._part[:] = 0.0
            self._part[inside] = ~unseen[inside]
            self._resize.image(self._part, out=image[EXPLORED])
            self._part[:] = local_map
            np.copyto(self._part, parameters.unknown_importance, where=unseen)
            local_map = self._part
        self._resize.image(local_map, out=image["importance"])
        image["obstacles"][:] = 1.0 - np.outer(*map(self._resize.interval, inside))
        size = self._images.shape[-1]
        offsets = clamp_to_world(neighbours, parameters.world_size) - position
        if NEIGHBOURS[0] in image:
            maps = neighbour_maps(offsets, parameters.communication_range, size)
            for name, values in zip(NEIGHBOURS, maps, strict=True):
                image[name][:] = values
        if OWN_CELL in image:
            image[OWN_CELL][:] = own_cell(offsets, parameters.local_map_size, size)
        return self._images
