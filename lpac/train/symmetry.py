"""A policy's inputs in a mirrored or turned world.

`turned` is 0 (unchanged) to 7: bit 0 mirrors x, bit 1 mirrors y, bit 2 then swaps x and y.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from edge.policy.images import NEIGHBOURS

_Array = npt.NDArray[Any]


def turned_vectors(vectors: _Array, turned: int) -> _Array:
    """Mirror or turn vectors (R, 2) about the origin."""
    signs = np.array([-1.0 if turned & 1 << axis else 1.0 for axis in range(2)], vectors.dtype)
    mirrored = vectors * signs
    return np.ascontiguousarray(mirrored[:, ::-1] if turned & 4 else mirrored)


def turned_images(images: _Array, channels: Sequence[str], turned: int) -> _Array:
    """Mirror or turn images (R, channels, size, size) of `edge.policy.images`."""
    # Neighbours' channels are vectors' x and y: these also change sign or order.
    plane = [channels.index(name) for name in NEIGHBOURS if name in channels]
    for axis in range(2):
        if turned & 1 << axis:
            images = np.flip(images, 2 + axis).copy()
            if plane:
                images[:, plane[axis]] *= -1.0
    if turned & 4:
        images = images.swapaxes(2, 3)
        order = list(range(len(channels)))
        if plane:
            order[plane[0]], order[plane[1]] = order[plane[1]], order[plane[0]]
        images = images[:, order]
    return np.ascontiguousarray(images)
