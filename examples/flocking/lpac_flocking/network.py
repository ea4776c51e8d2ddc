"""The family as one that is trained, with torch: see `lpac.train.family.Learnable`."""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from edge.core import F32
from edge.core.schema import AtLeastOne, Bounded, from_mapping
from edge.policy.bundle import SCHEMA_VERSION, Bundle, Manifest, make_bundle
from edge.policy.family import verified
from export.parameters import PolicyParameters
from lpac.train.family import Inputs, StateDict, shift_operator
from lpac_flocking.policy import FEATURES, GOLDEN, VECTORS, WEIGHTS, FlockingPolicy, npz
from lpac_flocking.task import FlockingTask

_GOLDEN_ROBOTS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class FlockingNetwork(Bounded):
    """Sizes: K = `hops` of neighbours' features, `width` of the layer and of the MLP."""

    hops: AtLeastOne = 3
    width: AtLeastOne = 64

    @property
    def task(self) -> FlockingTask:
        return FlockingTask()

    def module(self, actions_mean: F32, actions_std: F32) -> "FlockingModule":
        return FlockingModule(self, actions_mean, actions_std)

    def initial(self, checkpoint: bytes, name: str) -> StateDict:
        state = self._untrained().state_dict()
        try:
            found: StateDict = torch.load(io.BytesIO(checkpoint), "cpu", weights_only=True)
            sizes = {key: tuple(tensor.shape) for key, tensor in found.items()}
        except Exception as error:  # torch raises many kinds on what it cannot read
            raise ValueError(f"{name}: cannot be read: {error}") from None
        if sizes != {key: tuple(tensor.shape) for key, tensor in state.items()}:
            raise ValueError(f"{name}: is of another network than hops, width = {self}")
        return found

    def symmetric(self, inputs: Inputs, velocities: F32, turned: int) -> tuple[Inputs, F32]:
        """By quarter turns; the flock circles in one direction, so that a mirror shows another."""
        features = inputs["features"].copy()
        vectors = features[:, : 2 * VECTORS].reshape(-1, VECTORS, 2)
        for _ in range(turned % 4):
            vectors = np.stack([-vectors[..., 1], vectors[..., 0]], axis=-1)
            velocities = np.stack([-velocities[:, 1], velocities[:, 0]], axis=1)
        features[:, : 2 * VECTORS] = vectors.reshape(-1, 2 * VECTORS)
        return {"features": features}, velocities

    def checkpoint(self, state: StateDict) -> bytes:
        buffer = io.BytesIO()
        torch.save({name: tensor.detach().cpu() for name, tensor in state.items()}, buffer)
        return buffer.getvalue()

    def bundle(
        self,
        checkpoint: bytes,
        parameters: PolicyParameters,
        name: str,
        provenance: Mapping[str, str],
    ) -> Bundle:
        """With what torch makes of a swarm, which robots compute again before they fly."""
        state = self.initial(checkpoint, name)
        messages = parameters.messages
        manifest = Manifest(
            schema=SCHEMA_VERSION,
            name=name,
            family="flocking",
            perception=parameters.perception,
            training=parameters.training,
            provenance=dict(provenance),
            files={},
            payload_limit=messages.payload_limit,
            payload_types=messages.payload_types,
            parameters={"hops": self.hops, "width": self.width},
        )
        weights = {key: tensor.numpy() for key, tensor in state.items()}
        bundle = make_bundle(manifest, {WEIGHTS: npz(weights), GOLDEN: npz(self._golden(state))})
        if problem := verified(FlockingPolicy(bundle)).problem:
            raise ValueError(f"{name}: {problem}")
        return bundle

    def _untrained(self) -> "FlockingModule":
        return self.module(np.zeros(2, np.float32), np.ones(2, np.float32))

    def _golden(self, state: StateDict) -> dict[str, npt.NDArray[Any]]:
        rng = np.random.default_rng(0)
        features = rng.normal(size=(_GOLDEN_ROBOTS, FEATURES)).astype(np.float32)
        adjacency = np.triu(rng.random((_GOLDEN_ROBOTS,) * 2) < 0.5, 1)
        adjacency |= adjacency.T
        module = self._untrained().eval()
        module.load_state_dict(state)
        shift = shift_operator(adjacency[None], np.ones_like(adjacency[None]))
        with torch.no_grad():
            velocities = module(
                {"features": torch.from_numpy(features)},
                torch.from_numpy(shift),
                torch.ones(1, _GOLDEN_ROBOTS, dtype=torch.bool),
            )
        return {"features": features, "adjacency": adjacency, "velocities": velocities.numpy()}


def flocking_network(network: Mapping[str, object], where: str) -> FlockingNetwork:
    """See `lpac.train.family.LearnableFamily`."""
    return from_mapping(FlockingNetwork, network, where)


class FlockingModule(nn.Module):
    """See `lpac.train.family.TrainableModule`; what `FlockingPolicy.velocities` computes."""

    actions_mean: Tensor
    actions_std: Tensor

    def __init__(self, network: FlockingNetwork, actions_mean: F32, actions_std: F32) -> None:
        super().__init__()
        self.register_buffer("actions_mean", torch.from_numpy(actions_mean.copy()))
        self.register_buffer("actions_std", torch.from_numpy(actions_std.copy()))
        self._hops = network.hops
        self.gnn = nn.Linear((network.hops + 1) * FEATURES, network.width)
        self.mlp = nn.Linear(network.width, network.width)
        self.action = nn.Linear(network.width, 2)

    def forward(self, inputs: Mapping[str, Tensor], shift: Tensor, present: Tensor) -> Tensor:
        features = inputs["features"]
        swarms = features.new_zeros(*present.shape, FEATURES)
        swarms[present] = features
        hops = [swarms]
        for _ in range(self._hops):
            hops.append(shift @ hops[-1])
        values = self.gnn(torch.cat(hops, dim=-1)[present]).relu()
        actions: Tensor = self.action(self.mlp(values).relu()).float()
        return actions * self.actions_std + self.actions_mean
