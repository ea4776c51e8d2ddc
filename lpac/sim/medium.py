"""Broadcast medium between point robots: receivers of a message, and its delays."""

from collections.abc import Iterator

import numpy as np

from edge.core import F64
from edge.core.schema import NonNegative, Share, require


class Medium:
    """Broadcast with range, loss and delay; it counts lost messages."""

    def __init__(
        self, *, range_m: float, loss: float, delay_s: float, rng: np.random.Generator
    ) -> None:
        """`loss` is the probability that one receiver misses one message.

        A message travels `delay_s` on average, anything from half to one and a half of it.
        Raises ValueError that names the invalid value.
        """
        if not range_m > 0.0:
            raise ValueError(f"range_m = {range_m}: must be positive")
        require(Share, loss, "loss")
        require(NonNegative, delay_s, "delay_s")
        self._range_m = range_m
        self._loss = loss
        self._delay_s = delay_s
        self._rng = rng
        self.broadcasts = 0
        self.lost = 0

    def broadcast(self, sender: int, positions_m: F64) -> Iterator[tuple[int, float]]:
        """Receivers of a message sent now, each with its travel time, s."""
        self.broadcasts += 1
        distances = np.hypot(*(positions_m - positions_m[sender]).T)
        distances[sender] = np.inf
        receivers = np.flatnonzero(distances < self._range_m)
        # Both numbers are drawn for every receiver, so that changing loss or delay leaves later
        # draws alone.
        drawn = self._rng.random((len(receivers), 2))
        for receiver, (chance, travel) in zip(receivers.tolist(), drawn.tolist(), strict=True):
            if chance < self._loss:
                self.lost += 1
            else:
                yield receiver, self._delay_s * (0.5 + travel)
