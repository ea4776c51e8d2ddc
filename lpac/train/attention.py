"""Family `attention`: graph attention over the neighbours, trained on coverage.

Its layers are those of a graph attention network (Velickovic et al., ICLR 2018) with scaled
dot products (Vaswani et al., NeurIPS 2017). A robot attends to itself and its neighbours; keys and
values depend on a neighbour's message and on its relative position. A message holds each layer's
part, so that on a static graph the robots' actions are those of the whole network after as many
exchanges as there are layers.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import torch
from msgspec import Meta
from torch import Tensor, nn

from edge.core.schema import AtLeastOne, Bounded, Positive, from_mapping
from edge.policy.images import MAP_CHANNELS, require_channels
from lpac.train.lpac import ImageNetwork, last_side
from lpac.train.network import ModuleNetwork

_POSITION = 2
# A relative position, and its length.
_PLACE = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class AttentionNetwork(Bounded):
    """Sizes of the network, and the training's world.

    The CNN's keys are those of `LpacNetwork`. Then follow `layers` of attention with `heads`, each
    `width` wide in all, and an MLP with one hidden layer. `world_size` is the side of the
    training's worlds, and `reach` the length in which relative positions are given, in model units.
    """

    channels: tuple[str, ...] = MAP_CHANNELS[4]
    image_size: AtLeastOne = 32
    cnn_channels: Annotated[tuple[AtLeastOne, ...], Meta(min_length=1)] = (32, 32, 32)
    kernel: AtLeastOne = 3
    features: AtLeastOne = 32
    layers: AtLeastOne = 2
    heads: AtLeastOne = 2
    width: AtLeastOne = 64
    world_size: Positive = 512.0
    reach: Positive = 256.0

    def check_rules(self) -> None:
        if self.width % self.heads:
            raise ValueError(f"width = {self.width}: must be a multiple of heads = {self.heads}")
        require_channels(self.channels)
        last_side(self)


def attention_network(network: Mapping[str, object], where: str) -> ModuleNetwork:
    """See `LearnableFamily`."""
    sizes = from_mapping(AttentionNetwork, network, where)
    return ModuleNetwork(lambda: AttentionModule(sizes))


class AttentionModule(nn.Module):
    """See `TrainableModule`, and `export.module.network_bundle`."""

    actions_mean: Tensor
    actions_std: Tensor

    def __init__(self, sizes: AttentionNetwork) -> None:
        super().__init__()
        self.register_buffer("actions_mean", torch.zeros(2))
        self.register_buffer("actions_std", torch.ones(2))
        self.channels, self.image_size = sizes.channels, sizes.image_size
        self.message_size = sizes.layers * sizes.width
        self._sizes = sizes
        self.cnn = ImageNetwork(sizes)
        inputs = [sizes.features + _POSITION, *[sizes.width] * (sizes.layers - 1)]
        self._layers = [_AttentionLayer(size, sizes) for size in inputs]
        self.layers = nn.ModuleList(self._layers)
        self.mlp = nn.Sequential(
            nn.Linear(sizes.width, sizes.width), nn.ReLU(), nn.Linear(sizes.width, 2)
        )

    def encode(self, maps: Tensor, position: Tensor) -> Tensor:
        """The CNN's features, and the position about the world's centre."""
        return torch.cat([self.cnn(maps[None])[0], position - 0.5])

    def step(self, features: Tensor, messages: Tensor, positions: Tensor) -> tuple[Tensor, Tensor]:
        """The action, and a message with the robot's part of each layer."""
        own_place = positions.new_zeros(1, _PLACE)
        places = torch.cat([own_place, self._places(positions)])
        sent = []
        for layer, received in zip(
            self._layers, torch.split(messages, self._sizes.width, dim=1), strict=True
        ):
            own = layer.message(features)
            everybody = torch.cat([own[None], received])
            features = layer(features, everybody, places, None)
            sent.append(own)
        return self._action(features), torch.cat(sent)

    def forward(self, inputs: Mapping[str, Tensor], shift: Tensor, present: Tensor) -> Tensor:
        """Velocities (R, 2), as the robots' after as many exchanges as there are layers."""
        seen = torch.cat([self.cnn(inputs["maps"]), inputs["position"] - 0.5], dim=1)
        features = seen.new_zeros(*present.shape, seen.shape[1])
        features[present] = seen
        at = inputs["position"].new_zeros(*present.shape, _POSITION)
        at[present] = inputs["position"] * self._sizes.world_size
        places = self._places(at[:, None, :, :] - at[:, :, None, :])
        itself = torch.eye(present.shape[1], dtype=torch.bool, device=present.device)
        attended = (shift > 0.0) | itself
        for layer in self._layers:
            features = layer(features, layer.message(features)[:, None], places, attended)
        return self._action(features[present])

    def _places(self, positions: Tensor) -> Tensor:
        """(..., 3) of relative positions (..., 2) in model units."""
        scaled = positions / self._sizes.reach
        return torch.cat([scaled, scaled.square().sum(dim=-1, keepdim=True).sqrt()], dim=-1)

    def _action(self, features: Tensor) -> Tensor:
        action: Tensor = self.mlp(features).to(self.actions_std.dtype)
        return action * self.actions_std + self.actions_mean


class _AttentionLayer(nn.Module):
    def __init__(self, inputs: int, sizes: AttentionNetwork) -> None:
        super().__init__()
        self._heads, self._width = sizes.heads, sizes.width
        self.message = nn.Linear(inputs, sizes.width)
        self.query = nn.Linear(inputs, sizes.width)
        self.key = nn.Linear(sizes.width, sizes.width)
        self.value = nn.Linear(sizes.width, sizes.width)
        self.place = nn.Linear(_PLACE, 2 * sizes.width)
        self.update = nn.Linear(inputs + sizes.width, sizes.width)

    def forward(
        self, features: Tensor, messages: Tensor, places: Tensor, attended: Tensor | None
    ) -> Tensor:
        """New features (..., width).

        Of `features` (..., inputs), the `messages` (..., n, width) of all n robots, their `places`
        (..., n, 3), and which of them are `attended` (..., n); None: all.
        """
        key_place, value_place = self.place(places).split(self._width, dim=-1)
        keys = self._by_head(self.key(messages) + key_place)
        values = self._by_head((self.value(messages) + value_place).relu())
        query = self._by_head(self.query(features)[..., None, :])
        scores = (query * keys).sum(dim=-1) / math.sqrt(self._width / self._heads)
        if attended is not None:
            scores = scores.masked_fill(~attended[..., None], -torch.inf)
        weights = scores.softmax(dim=-2)
        received = (weights[..., None] * values).sum(dim=-3).flatten(-2)
        updated: Tensor = self.update(torch.cat([features, received], dim=-1))
        return updated.relu()

    def _by_head(self, rows: Tensor) -> Tensor:
        """(..., n, heads, width / heads) of (..., n, width)."""
        return torch.unflatten(rows, -1, (self._heads, self._width // self._heads))
