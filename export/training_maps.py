"""Estimates from a trained CNN how much of its training maps lay outside the world.

A batch norm keeps the mean of its training inputs. After the first convolution this is, except at
the borders, each image's mean times the sum of its weights. With more filters than images, the
images' means follow. The mean of "obstacles" is the share of local maps outside the world, which
depends on the world's size.
"""

import numpy as np

from edge.core.perception import PerceptionParameters
from edge.policy.images import MAP_CHANNELS
from export.checkpoint import Cnn

# Largest residual of the filters' means. Trained CNNs leave 0.5 %; an untrained batch norm 100 %.
_MAX_RESIDUAL = 0.05
# Robots that cover a world keep away from its border: known trainings saw 0.56 to 0.77 of the
# outside that robots at random places would see.
_MIN_RATIO, _MAX_RATIO = 0.4, 1.1


def outside_share(cnn: Cnn) -> float | None:
    """Share of the training's local maps that lay outside the world; None if unknown."""
    first = cnn.convolutions[0]
    sums = first.weight.sum((2, 3), dtype=np.float64)
    means = np.asarray(first.norm.mean, np.float64) - first.bias
    if np.linalg.matrix_rank(sums) < cnn.channels:
        return None
    images, *_ = np.linalg.lstsq(sums, means, rcond=None)
    unexplained = np.linalg.norm(sums @ images - means)
    if not unexplained < _MAX_RESIDUAL * np.linalg.norm(means):
        return None
    return float(images[MAP_CHANNELS[cnn.channels].index("obstacles")])


def map_mismatch(cnn: Cnn, perception: PerceptionParameters) -> str | None:
    """The reason why the CNN was not trained with these sizes, if there is one."""
    share = outside_share(cnn)
    if share is None:
        return None
    local, world = perception.local_map_size, perception.world_size
    # Mean over uniform positions in the world, for a window no larger than the world.
    at_random = 1.0 - (1.0 - local / world / 4.0) ** 2
    if _MIN_RATIO * at_random < share < _MAX_RATIO * at_random:
        return None
    return (
        f"with local_map_size = {local} and world_size = {world}, {_MIN_RATIO * at_random:.0%} to "
        f"{_MAX_RATIO * at_random:.0%} of the local maps lie outside the world; in training it was "
        f"{share:.0%}"
    )
