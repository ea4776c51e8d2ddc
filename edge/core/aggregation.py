"""The graph neural network's aggregated messages.

Paper: "A Scalable Multi-Robot Framework for Decentralized and Asynchronous
Perception-Action-Communication Loops", section "Decentralized Graph Neural Networks".
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from edge.core import F32
from edge.core.schema import AtLeastOne, Bounded
from edge.core.shared_map import SharedMap


@dataclass(frozen=True, slots=True)
class Geometry(Bounded):
    """Sizes of the graph neural network: L layers of K hops, F_0 .. F_L features.

    Raises ValueError that names an impossible size.
    """

    hops: AtLeastOne
    feature_sizes: Annotated[tuple[AtLeastOne, ...], Meta(min_length=2)]

    @property
    def layers(self) -> int:
        """L, the number of layers."""
        return len(self.feature_sizes) - 1

    @property
    def message_size(self) -> int:
        """Number of floats in a message: (y)_kl for k = 0..K-1 and l = 1..L."""
        return self.hops * sum(self.feature_sizes[:-1])


@dataclass(frozen=True, slots=True, eq=False)
class AggregatedMessage:
    """Message of a robot's policy to its neighbours: Y_j.

    `payload` (message_size,) is float32 or float16: (y_j)_kl in the order [l][k][feature], times
    1/sqrt(d_j), where d_j is the sender's number of neighbours. `shared` is the sender's map of its
    surroundings, if robots share maps, and `trial` the mission of that map: maps of other missions
    are discarded.
    """

    payload: F32
    trial: int = 0
    shared: SharedMap | None = None


class HopBuffer:
    """Robots' y_kl for k = 0..K and l = 1..L, updated in place once per policy tick.

    `robots` exceeds 1 only in batched simulation. Not thread-safe: it belongs to the policy thread.
    """

    def __init__(self, geometry: Geometry, robots: int = 1) -> None:
        self._hops = geometry.hops
        inputs = geometry.feature_sizes[:-1]
        # One block per layer, (robots, K + 1, F_{l-1}), the input batch of the layer's graph.
        self.layers: tuple[F32, ...] = tuple(
            np.zeros((robots, geometry.hops + 1, size), np.float32) for size in inputs
        )
        self._sum = np.zeros(geometry.message_size, np.float32)
        ends = np.cumsum([geometry.hops * size for size in inputs])
        # Each layer's slice of the sum. Not views: a deep copy would separate them from the sum.
        self._parts = tuple(
            slice(end - geometry.hops * size, end)
            for end, size in zip(ends.tolist(), inputs, strict=True)
        )

    def diffuse(self, payloads: Sequence[F32], degree: int, robot: int = 0) -> None:
        """y_kl = sum over neighbours j of S_ij (y_j)_{k-1,l}, for k = 1..K and all layers at once.

        `payloads` are the neighbours' messages, (message_size,) each. `degree` is d_i, larger than
        their number if some messages were not received. S_ij = 1/sqrt(d_i d_j); the sender has
        applied 1/sqrt(d_j).
        """
        if payloads:
            received = np.concatenate(payloads, dtype=np.float32).reshape(len(payloads), -1)
            np.add.reduce(received, axis=0, out=self._sum)
            self._sum *= np.float32(1.0 / math.sqrt(degree))
        else:
            self._sum[:] = 0.0
        for layer, part in zip(self.layers, self._parts, strict=True):
            layer[robot, 1:] = self._sum[part].reshape(self._hops, -1)

    def message(self, degree: int, robot: int = 0) -> F32:
        """A new payload (message_size,): y_kl for k = 0..K-1, times 1/sqrt(degree), or 0."""
        scale = np.float32(1.0 / math.sqrt(degree) if degree else 0.0)
        return np.concatenate([layer[robot, : self._hops].ravel() for layer in self.layers]) * scale
