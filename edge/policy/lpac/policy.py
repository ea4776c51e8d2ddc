"""A bundle of this family as a policy for robots."""

from collections.abc import Iterator, Mapping

import numpy as np

from edge.core import F32, F64
from edge.core.aggregation import HopBuffer
from edge.core.part import array_problem
from edge.policy.bundle import Bundle, BundleError
from edge.policy.family import GoldenCheck, Neighbourhood, Observation, Perceived, PolicyStep
from edge.policy.golden import GOLDEN
from edge.policy.images import PolicyImages
from edge.policy.lpac.graphs import Graphs
from edge.policy.lpac.manifest import CNN
from edge.policy.lpac.verify import verify


class LpacPolicy(Graphs):
    """See `edge.policy.family.Policy`."""

    def __init__(self, bundle: Bundle) -> None:
        super().__init__(bundle)
        self._golden = bundle.files[GOLDEN]

    @property
    def message_size(self) -> int:
        """Number of floats in an aggregated message."""
        return self.geometry.message_size

    def agent(self) -> "LpacAgent":
        """Make a robot's agent. Raises BundleError if the bundle has no perception."""
        return LpacAgent(self)

    def verify(self) -> Iterator[GoldenCheck]:
        """Verify each graph, then a whole swarm. Raises BundleError."""
        return verify(self, self._golden)

    def logged_features(self, inputs: Mapping[str, F32]) -> F32:
        """See `edge.policy.family.Replayable`."""
        images = self.lpac.images
        if images is None:
            raise BundleError(f"bundle {self.manifest.name!r} has no perception (no {CNN})")
        shape = (1, len(images.channels), images.size, images.size)
        for name, expected in (("images", shape), ("position_feature", (2,))):
            if problem := array_problem(name, inputs[name], expected):
                raise ValueError(problem)
        features = self.image_features(inputs["images"])[0]
        return np.concatenate([features, inputs["position_feature"]])

    def logged_step(
        self, features: F32, neighbours: Neighbourhood, inputs: Mapping[str, F32]
    ) -> PolicyStep:
        """See `edge.policy.family.Replayable`."""
        return self.step(features, neighbours, HopBuffer(self.geometry))

    def step(self, features: F32, neighbours: Neighbourhood, hops: HopBuffer) -> PolicyStep:
        """The action from x_i and the neighbours' Y_j, and the robot's own Y_i."""
        hops.diffuse(neighbours.payloads, neighbours.degree)
        [velocity] = self.velocity(features[None], hops)
        return PolicyStep(velocity, hops.message(neighbours.degree))


class LpacAgent:
    """See `edge.policy.family.Agent`; paper, section "Decentralized Graph Neural Networks"."""

    def __init__(self, policy: LpacPolicy) -> None:
        manifest, images = policy.manifest, policy.lpac.images
        if images is None or manifest.perception is None:
            raise BundleError(
                f"bundle {manifest.name!r} has no perception: it cannot drive a robot"
            )
        self._policy = policy
        self._world_size = manifest.perception.world_size
        self._images = PolicyImages(manifest.perception, images.channels, images.size)
        self._hops = HopBuffer(policy.geometry)

    def observe(self, observation: Observation) -> Perceived:
        """x_i: the CNN's features of the images, and the 2 of the position."""
        images = self._images.images(*observation[:3])
        position = position_feature(observation.position, self._world_size)
        features = np.concatenate([self._policy.image_features(images)[0], position])
        return Perceived(features, {"images": images.copy(), "position_feature": position})

    def step(self, features: F32, neighbours: Neighbourhood) -> PolicyStep:
        """See `LpacPolicy.step`."""
        return self._policy.step(features, neighbours, self._hops)

    def reset(self) -> None:
        """Do nothing: no state is kept between steps."""


def position_feature(position: F64, world_size: int) -> F32:
    """(p + W/2) / W, in [0.5, 1.5] for p in the world, as in training."""
    return ((position + world_size / 2.0) / world_size).astype(np.float32)
