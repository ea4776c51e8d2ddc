"""What robots fly: an aggregated GNN of one layer and an MLP, in numpy.

A robot looks at where its neighbours are, and at its own place and velocity; of the neighbours'
velocities, and of who is further away, it learns by the messages.
"""

import io
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from edge.core import F32, F64
from edge.core.aggregation import Geometry, HopBuffer
from edge.policy.bundle import Bundle, BundleError
from edge.policy.family import GoldenCheck, Neighbourhood, Observation, Perceived, PolicyStep

WEIGHTS, GOLDEN = "weights.npz", "golden.npz"
# Pairs (x, y): the place in the world, the velocity, away from who is close, and to the others;
# then a 1, by whose sum over the hops a robot knows how many there are.
VECTORS = 4
FEATURES = 2 * VECTORS + 1
# Robots keep so far apart, in model units.
SPACING = 64.0


def away_from_close(position: F64, others: F64) -> F64:
    """(2,): the sum of the directions away from all that are closer than SPACING.

    Each counts from 0, at that distance, to 1.
    """
    offsets = position - others
    distance = np.maximum(np.hypot(*offsets.T), 1e-6)
    weight = np.maximum(1.0 - distance / SPACING, 0.0) / distance
    away: F64 = weight @ offsets
    return away


def place_in(position: F64, world_size: float) -> F64:
    """From (-1, -1) to (1, 1) in the world, 0 at its centre."""
    return 2.0 * position / world_size - 1.0


def features_of(observation: Observation, world_size: float, max_speed: float) -> F32:
    """(FEATURES,), each of about 1."""
    position, _, neighbours, velocity = observation
    to_others = (neighbours - position).mean(axis=0) if len(neighbours) else np.zeros(2)
    return np.concatenate(
        [
            place_in(position, world_size),
            velocity / max_speed,
            away_from_close(position, neighbours),
            4.0 * to_others / world_size,
            [1.0],
        ]
    ).astype(np.float32)


class FlockingPolicy:
    """See `edge.policy.family.Policy`."""

    def __init__(self, bundle: Bundle) -> None:
        self.manifest = bundle.manifest
        self.bundle_id = bytes.fromhex(bundle.id)
        try:
            self._golden = _arrays(bundle.files[GOLDEN])
            self._weights = _arrays(bundle.files[WEIGHTS])
            hops, width = (int(str(self.manifest.parameters[key])) for key in ("hops", "width"))
            self.geometry = Geometry(hops, (FEATURES, width))
            self.velocities(np.zeros((1, hops + 1, FEATURES), np.float32))
        except (KeyError, ValueError, OSError) as error:
            raise BundleError(
                f"bundle {self.manifest.name!r}: is not of flocking: {error}"
            ) from None

    @property
    def message_size(self) -> int:
        return self.geometry.message_size

    def agent(self) -> "FlockingAgent":
        return FlockingAgent(self)

    def velocities(self, hops: F32) -> F32:
        """(n, 2), in model units/s, of y_0 .. y_K: (n, K + 1, FEATURES)."""
        w = self._weights
        values = np.maximum(hops.reshape(len(hops), -1) @ w["gnn.weight"].T + w["gnn.bias"], 0.0)
        values = np.maximum(values @ w["mlp.weight"].T + w["mlp.bias"], 0.0)
        actions = values @ w["action.weight"].T + w["action.bias"]
        velocities: F32 = actions * w["actions_std"] + w["actions_mean"]
        return velocities

    def verify(self) -> Iterator[GoldenCheck]:
        """A swarm that says what it knows until all have heard of all: what torch made of it."""
        try:
            features, golden = self._golden["features"], self._golden["velocities"]
            told = swarm_velocities(self, self._golden["adjacency"], features)
            error = float(np.abs(told - golden).max() / np.abs(golden).max())
        except (KeyError, ValueError) as problem:
            raise BundleError(f"{GOLDEN}: cannot be read: {problem}") from None
        yield GoldenCheck("swarm", error)


class FlockingAgent:
    """See `edge.policy.family.Agent`."""

    def __init__(self, policy: FlockingPolicy) -> None:
        perception = policy.manifest.perception
        if perception is None:
            raise BundleError(f"bundle {policy.manifest.name!r} has no perception")
        self._policy = policy
        self._world_size = perception.world_size
        self._max_speed = policy.manifest.training.max_speed
        self._hops = HopBuffer(policy.geometry)

    def observe(self, observation: Observation) -> Perceived:
        return Perceived(features_of(observation, self._world_size, self._max_speed), {})

    def step(self, features: F32, neighbours: Neighbourhood) -> PolicyStep:
        return self.decide(features, neighbours.payloads, neighbours.degree)

    def decide(self, features: F32, payloads: Sequence[F32], degree: int) -> PolicyStep:
        """Step that needs no more of the neighbours than their payloads."""
        self._hops.diffuse(payloads, degree)
        [layer] = self._hops.layers
        layer[:, 0] = features
        return PolicyStep(self._policy.velocities(layer)[0], self._hops.message(degree))

    def reset(self) -> None:
        """Each step writes all that it reads."""


def swarm_velocities(
    policy: FlockingPolicy, adjacency: npt.NDArray[np.bool_], features: F32
) -> F32:
    """(N, 2): what a swarm flies after K exchanges of messages; `adjacency` is (N, N)."""
    degrees = adjacency.sum(axis=1).tolist()
    agents = [policy.agent() for _ in degrees]
    steps: list[PolicyStep] = []
    for _ in range(policy.geometry.hops + 1):
        said = [step.payload for step in steps]
        steps = [
            agent.decide(
                features[i],
                [said[j] for j in np.flatnonzero(adjacency[i])] if said else [],
                degrees[i],
            )
            for i, agent in enumerate(agents)
        ]
    return np.stack([step.velocity for step in steps])


def npz(arrays: Mapping[str, npt.NDArray[Any]]) -> bytes:
    """A file of arrays, in memory."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def _arrays(content: bytes) -> dict[str, npt.NDArray[Any]]:
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        return dict(file)
