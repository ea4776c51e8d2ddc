"""Trace of the training maps in a trained CNN, and whether a parameter file agrees with it.

A batch norm keeps the mean of what it was given in training. Behind the first convolution that is,
but for the borders, the mean of each image times the sum of its weights: with more filters than
images, the images' means follow from the tensors alone. The mean of "obstacles" is the share of
the local maps that lay outside the world, which tells of the world's size.
"""

import numpy as np

from edge.core.perception import PerceptionParameters
from edge.policy.lpac.images import MAP_CHANNELS
from export.checkpoint import Cnn

# Of the filters' means, what the images' means may leave unexplained. Trained CNNs leave 0.5 %, and
# one whose batch norm was not trained all of it.
_UNEXPLAINED = 0.05
# Robots that cover a world keep away from its border: of what they would see beyond it at places
# drawn at random they saw 0.56 to 0.77 in training.
_LEAST, _MOST = 0.4, 1.1


def outside_share(cnn: Cnn) -> float | None:
    """The share of training's local maps that lay outside the world; None if nothing tells it."""
    first = cnn.convolutions[0]
    sums = first.weight.sum((2, 3), dtype=np.float64)
    means = np.asarray(first.norm.mean, np.float64) - first.bias
    if np.linalg.matrix_rank(sums) < cnn.channels:
        return None
    images, *_ = np.linalg.lstsq(sums, means, rcond=None)
    unexplained = np.linalg.norm(sums @ images - means)
    if not unexplained < _UNEXPLAINED * np.linalg.norm(means):
        return None
    return float(images[MAP_CHANNELS[cnn.channels].index("obstacles")])


def contradiction(cnn: Cnn, perception: PerceptionParameters) -> str | None:
    """Why the CNN was hardly trained with these sizes, as a sentence's part; None if it may be."""
    share = outside_share(cnn)
    if share is None:
        return None
    local, world = perception.local_map_size, perception.world_size
    # The mean over places in the world, drawn at random, of a window that is no larger than it.
    at_random = 1.0 - (1.0 - local / world / 4.0) ** 2
    if _LEAST * at_random < share < _MOST * at_random:
        return None
    return (
        f"with local_map_size = {local} and world_size = {world}, {_LEAST * at_random:.0%} to "
        f"{_MOST * at_random:.0%} of the local maps lie outside the world; where this network was "
        f"trained it was {share:.0%}"
    )
