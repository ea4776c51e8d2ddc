"""The policy in torch and torch_geometric, as a robot without this project would run it.

The network is LPAC's (arXiv 2401.04855) with the modules and names of its state dict. A robot has
no graph, only its neighbours' aggregated messages: for k = 1..K each layer takes y_k from their
values for hop k instead of the hop before.
"""

import math
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch_geometric.nn import MLP, TAGConv  # type: ignore[import-untyped]

from edge.core import F32, F64
from edge.core.perception import PerceptionParameters, part_in_world, window_corner
from edge.policy.images import neighbour_maps

_LEAKY_RELU_SLOPE = 0.01

Layer = Callable[[int, int, int], nn.Module]


class PygLayer(TAGConv):  # type: ignore[misc]
    """torch_geometric's TAGConv on the star of a robot, node 0, and its neighbours, 1..n.

    Like TAGConv, it propagates hop by hop and applies the taps at every node. Normalisation by
    degree is left out, since messages and `scale` contain it.
    """

    def __init__(self, inputs: int, outputs: int, hops: int) -> None:
        super().__init__(inputs, outputs, hops, normalize=False)

    def forward(self, own: Tensor, held: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        """x_l (1, F_l) and y_kl (K, F_{l-1}), k = 0..K-1.

        From x_{l-1} `own` (1, F_{l-1}) and the n neighbours' messages `held` (n, K, F_{l-1});
        `scale` () is 1/sqrt(n).
        """
        neighbours = len(held)
        edge_index = torch.stack(
            [torch.arange(1, neighbours + 1), torch.zeros(neighbours, dtype=torch.long)]
        )
        edge_weight = scale.expand(neighbours)
        nodes = torch.cat([own.new_zeros(1, *held.shape[1:]), held])
        out = self.lins[0](torch.cat([own, held[:, 0]]))
        hops = [own]
        for k, tap in enumerate(self.lins[1:]):
            y = self.propagate(edge_index, x=nodes[:, k], edge_weight=edge_weight)
            out = out + tap(y)
            hops.append(y[:1])
        return (out[:1] + self.bias).relu(), torch.cat(hops[:-1])


class TapLayer(nn.Module):
    """The layer as a sum over the neighbours and one linear layer per tap."""

    def __init__(self, inputs: int, outputs: int, hops: int) -> None:
        super().__init__()
        self.lins = nn.ModuleList(nn.Linear(inputs, outputs, bias=False) for _ in range(hops + 1))
        self.bias = nn.Parameter(torch.empty(outputs))

    def forward(self, own: Tensor, held: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        """See `PygLayer.forward`."""
        hops = torch.cat([own, held.sum(0) * scale])
        out = self.bias
        for k, tap in enumerate(self.lins):
            out = out + tap(hops[k : k + 1])
        return out.relu(), hops[:-1]


class Network(nn.Module):
    """The whole network of one robot, weights and sizes from an LPAC state dict."""

    def __init__(self, state: Mapping[str, Tensor], layer: Layer) -> None:
        super().__init__()
        self.cnn_backbone = _cnn(state)
        hops = _count(state, "gnn_backbone.graph_conv_0.lins.{}.weight") - 1
        shapes = [
            state[f"gnn_backbone.graph_conv_{i}.lins.0.weight"].shape
            for i in range(_count(state, "gnn_backbone.graph_conv_{}.bias"))
        ]
        self.gnn_backbone = nn.ModuleDict(
            {
                f"graph_conv_{i}": layer(inputs, outputs, hops)
                for i, (outputs, inputs) in enumerate(shapes)
            }
        )
        self.held_shapes = [(hops, inputs) for _, inputs in shapes]
        mlp_layers = _count(state, "gnn_mlp.lins.{}.bias")
        mlp_sizes = [len(state[f"gnn_mlp.lins.{i}.bias"]) for i in range(mlp_layers)]
        self.gnn_mlp = MLP([shapes[-1][0], *mlp_sizes])
        self.output_linear = nn.Linear(mlp_sizes[-1], 2)
        self.register_buffer("actions_mean", torch.empty(2))
        self.register_buffer("actions_std", torch.empty(2))
        self.load_state_dict(state)
        self.eval()

    def forward(
        self, maps: Tensor, neighbours: Tensor, position: Tensor, payloads: Tensor, scale: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Velocity (2,) and the robot's own payload (message_size,).

        `maps` (2, size, size) are the local importance and obstacle maps, `neighbours`
        (2, image, image), `position` (2,) is the position feature, `payloads` (n, message_size).
        """
        size = neighbours.shape[-2:]
        resized = functional.interpolate(maps[None], size, mode="bilinear", antialias=True)
        images = torch.cat([resized[:, :1], neighbours[None], resized[:, 1:]], 1)
        features = torch.cat([self.cnn_backbone(images), position[None]], 1)
        features, message = self.exchange(features, payloads, scale)
        return self.velocity(features), message

    def velocity(self, features: Tensor) -> Tensor:
        """Velocity (2,) of x_L (1, F_L)."""
        actions = self.output_linear(self.gnn_mlp(features))
        velocity: Tensor = (actions * self.actions_std + self.actions_mean)[0]
        return velocity

    def exchange(self, features: Tensor, payloads: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        """The graph neural network: x_L (1, F_L) from x_0 (1, F_0), and the own payload."""
        sizes = [hops * inputs for hops, inputs in self.held_shapes]
        parts = torch.split(payloads, sizes, 1)
        own = []
        for layer, held, shape in zip(
            self.gnn_backbone.values(), parts, self.held_shapes, strict=True
        ):
            features, hops = layer(features, held.reshape(-1, *shape), scale)
            own.append(hops.flatten())
        return features, torch.cat(own) * scale


class NetworkForm(nn.Module):
    """The network with the contract of the family `network`."""

    def __init__(self, network: Network, channels: tuple[str, ...], image_size: int) -> None:
        super().__init__()
        self.channels, self.image_size = channels, image_size
        self.message_size = sum(hops * inputs for hops, inputs in network.held_shapes)
        self.network = network

    def encode(self, maps: Tensor, position: Tensor) -> Tensor:
        """x_0 (F_0,)."""
        return torch.cat([self.network.cnn_backbone(maps[None])[0], position + 0.5])

    def step(self, features: Tensor, messages: Tensor, degree: Tensor) -> tuple[Tensor, Tensor]:
        """Velocity (2,) and the own payload."""
        scale = (degree > 0.0).to(degree.dtype) * degree.clamp(min=1.0).rsqrt()
        last, message = self.network.exchange(features[None], messages, scale)
        return self.network.velocity(last), message


class TorchRobot:
    """One robot's tick with a `Network`, or a traced one."""

    def __init__(
        self, network: Callable[..., tuple[Tensor, Tensor]], perception: PerceptionParameters,
        image_size: int, robot_map: F32,
    ) -> None:  # fmt: skip
        """`robot_map` (world_size, world_size) is the robot's memory."""
        self._network = network
        self._perception = perception
        self._image_size = image_size
        self._robot_map = robot_map

    def tick(self, position: F64, neighbours: F64, payloads: Sequence[F32]) -> tuple[F32, F32]:
        """Velocity (2,) and payload (message_size,) from the n >= 1 neighbours' messages."""
        with torch.inference_mode():
            inputs = self.inputs(position, neighbours, payloads)
            velocity, message = self._network(*inputs)
            return velocity.numpy(), message.numpy()

    def inputs(self, position: F64, neighbours: F64, payloads: Sequence[F32]) -> tuple[Tensor, ...]:
        """Inputs of the network."""
        perception = self._perception
        size, world_size = perception.local_map_size, perception.world_size
        in_world, in_map = part_in_world(window_corner(position, size), size, world_size)
        maps = np.zeros((2, size, size), np.float32)
        maps[0][in_map] = self._robot_map[in_world]
        maps[1] = 1.0
        maps[1][in_map] = 0.0
        near = neighbour_maps(
            neighbours - position, perception.communication_range, self._image_size
        )
        own = ((position + world_size / 2.0) / world_size).astype(np.float32)
        return (
            torch.from_numpy(maps),
            torch.from_numpy(near),
            torch.from_numpy(own),
            *exchange_inputs(payloads),
        )


def exchange_inputs(payloads: Sequence[F32]) -> tuple[Tensor, Tensor]:
    """The neighbours' payloads as one (n, message_size) tensor, and 1/sqrt(n)."""
    return torch.from_numpy(np.stack(payloads)).float(), torch.tensor(1 / math.sqrt(len(payloads)))


def load_network(checkpoint: Path, layer: Layer) -> Network:
    """Load the network of an LPAC state dict, on one thread."""
    torch.set_num_threads(1)
    return Network(torch.load(checkpoint, weights_only=True), layer)


def _cnn(state: Mapping[str, Tensor]) -> nn.Sequential:
    modules: OrderedDict[str, nn.Module] = OrderedDict()
    for i in range(_count(state, "cnn_backbone.conv{}.weight")):
        outputs, inputs, kernel, _ = state[f"cnn_backbone.conv{i}.weight"].shape
        modules[f"conv{i}"] = nn.Conv2d(inputs, outputs, kernel)
        modules[f"batch_norm{i}"] = nn.BatchNorm2d(outputs)
        modules[f"activation{i}"] = nn.LeakyReLU(_LEAKY_RELU_SLOPE)
    outputs, inputs = state["cnn_backbone.linear_1.weight"].shape
    modules["flatten"] = nn.Flatten()
    modules["linear_1"] = nn.Linear(inputs, outputs)
    modules["activation"] = nn.LeakyReLU(_LEAKY_RELU_SLOPE)
    return nn.Sequential(modules)


def _count(state: Mapping[str, Tensor], name: str) -> int:
    """Number of tensors named `name` with 0, 1, .. in it."""
    count = 0
    while name.format(count) in state:
        count += 1
    return count
