"""A bundle of this family as a policy for robots."""

from collections.abc import Iterator, Mapping

import numpy as np

from edge.core import F32
from edge.core.part import array_problem
from edge.policy.bundle import Bundle
from edge.policy.family import GoldenCheck, Neighbourhood, Observation, Perceived, PolicyStep
from edge.policy.golden import GOLDEN
from edge.policy.graph import Graph, Shape
from edge.policy.images import PolicyImages
from edge.policy.network.golden import verify
from edge.policy.network.manifest import ENCODE, STEP, Array, NetworkManifest

_MEMORY = "memory"


class NetworkPolicy:
    """See `edge.policy.family.Policy`."""

    def __init__(self, bundle: Bundle) -> None:
        """Raise BundleError for a graph that does not fit the manifest."""
        self.manifest = bundle.manifest
        self.bundle_id = bytes.fromhex(bundle.id)
        self.network = network = NetworkManifest.of(bundle.manifest)
        self.encode_graph = Graph(bundle, ENCODE, _shapes(network.encode), network.encode_outputs)
        self.step_graph = Graph(bundle, STEP, _shapes(network.step), network.step_outputs)
        self._golden = bundle.files[GOLDEN]

    @property
    def message_size(self) -> int:
        """Number of floats in a message."""
        return self.network.message_size

    def agent(self) -> "NetworkAgent":
        """Make a robot's agent."""
        return NetworkAgent(self)

    def verify(self) -> Iterator[GoldenCheck]:
        """Run both graphs on the golden inputs. Raises BundleError."""
        return verify(self.encode_graph, self.step_graph, self.network, self._golden)

    def logged_features(self, inputs: Mapping[str, F32]) -> F32:
        """See `edge.policy.family.Replayable`."""
        for name, array in self.network.encode.items():
            shape = tuple(
                actual if isinstance(size, str) else size
                for size, actual in zip(array.shape, inputs[name].shape, strict=True)
            )
            if problem := array_problem(name, inputs[name], shape):
                raise ValueError(problem)
        return self.encode({name: inputs[name] for name in self.network.encode})

    def encode(self, inputs: Mapping[str, F32]) -> F32:
        """Features of the inputs that the manifest names."""
        [features] = self.encode_graph.run(inputs)
        return features

    def logged_step(
        self, features: F32, neighbours: Neighbourhood, inputs: Mapping[str, F32]
    ) -> PolicyStep:
        """See `edge.policy.family.Replayable`."""
        return self.step(features, neighbours, inputs[_MEMORY])[0]

    def step(self, features: F32, neighbours: Neighbourhood, memory: F32) -> tuple[PolicyStep, F32]:
        """The step, and the new memory (memory_size,)."""
        shape = (len(neighbours.payloads), self.message_size)
        messages = np.zeros(shape, np.float32)
        if messages.size:
            messages = np.concatenate(neighbours.payloads, dtype=np.float32).reshape(shape)
        inputs = {
            "features": features,
            "messages": messages,
            "positions": neighbours.positions,
            "velocities": neighbours.velocities,
            "ages": neighbours.ages_s,
            "degree": np.array(neighbours.degree, np.float32),
            _MEMORY: memory,
        }
        velocity, message, *new = self.step_graph.run(
            {name: inputs[name] for name in self.network.step}
        )
        step = PolicyStep(velocity, message, {_MEMORY: memory})
        return step, new[0] if new else memory


class NetworkAgent:
    """See `edge.policy.family.Agent`."""

    def __init__(self, policy: NetworkPolicy) -> None:
        perception, maps = policy.manifest.perception, policy.network.maps
        assert perception is not None  # checked by NetworkManifest
        self._policy = policy
        self._world_size = perception.world_size
        self._images = PolicyImages(perception, maps.channels, maps.size) if maps else None
        self._memory: F32
        self.reset()

    def observe(self, observation: Observation) -> Perceived:
        """Features of the inputs that the manifest names."""
        position, local_map, neighbours, velocity = observation
        inputs: dict[str, F32] = {}
        for name in self._policy.network.encode:
            if name == "maps":
                assert self._images is not None
                [images] = self._images.images(position, local_map, neighbours)
                inputs[name] = images.copy()
            elif name == "position":
                inputs[name] = (position / self._world_size).astype(np.float32)
            elif name == "velocity":
                inputs[name] = velocity.astype(np.float32)
            else:
                inputs[name] = (neighbours - position).astype(np.float32)
        return Perceived(self._policy.encode(inputs), inputs)

    def step(self, features: F32, neighbours: Neighbourhood) -> PolicyStep:
        """The next step. Raises ValueError, and keeps its memory, if the new one is not finite."""
        step, memory = self._policy.step(features, neighbours, self._memory)
        if problem := array_problem(_MEMORY, memory, self._memory.shape):
            raise ValueError(problem)
        self._memory = memory
        return step

    def reset(self) -> None:
        """Clear the memory."""
        self._memory = np.zeros(self._policy.network.memory_size, np.float32)


def _shapes(arrays: Mapping[str, Array]) -> dict[str, Shape]:
    return {name: array.shape for name, array in arrays.items()}
