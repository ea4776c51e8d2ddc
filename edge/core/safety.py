"""Limits on what the vehicle is told to do."""

import numpy as np

from edge.core import F64


def limit_speed(velocity: F64, max_speed: float) -> F64:
    """`velocity` (2,), shortened to `max_speed` if it is longer; the direction stays.

    A velocity that is not finite becomes 0.
    """
    speed = float(np.hypot(*velocity))
    if not np.isfinite(speed):
        return np.zeros(2)
    return velocity if speed <= max_speed else velocity * (max_speed / speed)
