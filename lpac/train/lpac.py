"""Training of the paper's family: CNN, aggregated graph neural network, MLP.

The state dict has the tensors and names of CoverageControl's LPAC module, which loads it if the
network has the four maps and every convolution has as many channels as the CNN has features.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Protocol, cast

import numpy as np
import torch
from msgspec import Meta
from torch import Tensor, nn
from torch.nn import functional

from edge.core import F32
from edge.core.schema import AtLeastOne, AtLeastZero, Bounded, from_mapping
from edge.policy.bundle import Bundle
from edge.policy.images import MAP_CHANNELS, require_channels
from export.checkpoint import (
    ACTION_SIZE,
    BATCH_NORM_EPS,
    LEAKY_RELU_SLOPE,
    POSITION_SIZE,
    checkpoint_tensors,
    parse_checkpoint,
    write_state_dict,
)
from export.exporter import bundle_of
from export.parameters import PolicyParameters
from lpac.train.family import Inputs, StateDict
from lpac.train.symmetry import turned_images, turned_vectors
from lpac.train.task import CoverageTask

_FIRST_CONVOLUTION = "cnn_backbone.conv0.weight"
# A counter without effect, missing in some checkpoints.
_BATCHES = "num_batches_tracked"


class ImageNetworkSizes(Protocol):
    """Keys of [network] for the CNN: see `LpacNetwork`."""

    @property
    def channels(self) -> tuple[str, ...]: ...
    @property
    def image_size(self) -> int: ...
    @property
    def cnn_channels(self) -> tuple[int, ...]: ...
    @property
    def kernel(self) -> int: ...
    @property
    def features(self) -> int: ...


def last_side(sizes: ImageNetworkSizes) -> int:
    """Side of the last convolution's output. Raises ValueError if there is none."""
    border = len(sizes.cnn_channels) * (sizes.kernel - 1)
    if sizes.image_size <= border:
        raise ValueError(
            f"image_size = {sizes.image_size}: must be above {border}, the border that the "
            "convolutions remove"
        )
    return sizes.image_size - border


@dataclass(frozen=True, slots=True, kw_only=True)
class LpacNetwork(Bounded):
    """Sizes of the network: see `Learnable`.

    `channels` are the CNN's input images, one of `MAP_CHANNELS`, `image_size` wide; `cnn_channels`
    are those of each convolution, `kernel` wide. Then follow `layers` (L) of `hops` (K), `width`
    wide, and an MLP of `mlp_layers` layers, `mlp_width` wide. With 0 hops robots use their
    neighbours' positions but not their messages: the checkpoint has one hop, of weight 0.

    Raises ValueError that names the impossible value.
    """

    channels: tuple[str, ...] = MAP_CHANNELS[4]
    image_size: AtLeastOne = 32
    cnn_channels: Annotated[tuple[AtLeastOne, ...], Meta(min_length=1)] = (32, 32, 32)
    kernel: AtLeastOne = 3
    features: AtLeastOne = 32
    layers: AtLeastOne = 2
    hops: AtLeastZero = 3
    width: AtLeastOne = 256
    mlp_width: AtLeastOne = 32
    mlp_layers: Annotated[int, Meta(ge=2)] = 2

    def check_rules(self) -> None:
        require_channels(self.channels)
        last_side(self)

    @property
    def task(self) -> CoverageTask:
        """See `Learnable`."""
        return CoverageTask()

    def module(self, actions_mean: F32, actions_std: F32) -> "LpacModule":
        """See `Learnable`."""
        return LpacModule(self, actions_mean, actions_std)

    def initial(self, checkpoint: bytes, name: str) -> StateDict:
        """See `Learnable`; images unknown to the checkpoint's CNN get weights of 0."""
        if not self.hops:
            raise ValueError(
                f"{name}: a network of hops = 0 cannot use the checkpoint's hops: remove begin_with"
            )
        zero, one = np.zeros(ACTION_SIZE, np.float32), np.ones(ACTION_SIZE, np.float32)
        state = self.module(zero, one).state_dict()
        tensors = checkpoint_tensors(checkpoint, name)
        seen = tensors[_FIRST_CONVOLUTION]
        channels = MAP_CHANNELS.get(seen.shape[1], ())
        if set(channels) <= set(self.channels):
            places = [self.channels.index(channel) for channel in channels]
            widened = seen.new_zeros(seen.shape[0], len(self.channels), *seen.shape[2:])
            widened[:, places] = seen
            tensors[_FIRST_CONVOLUTION] = widened
        for tensor, expected in state.items():
            if tensor not in tensors and tensor.endswith(_BATCHES):
                continue
            found = tuple(tensors[tensor].shape) if tensor in tensors else "nothing"
            if found != tuple(expected.shape):
                raise ValueError(f"{name}: {tensor}: found {found}, expected {(*expected.shape,)}")
        if unknown := tensors.keys() - state.keys():
            raise ValueError(f"{name}: {min(unknown)}: the network has no such tensor")
        return {**state, **tensors}

    def symmetric(self, inputs: Inputs, velocities: F32, turned: int) -> tuple[Inputs, F32]:
        """See `Learnable`; bit 0 mirrors x, bit 1 mirrors y, bit 2 swaps the two."""
        return {
            "images": turned_images(inputs["images"], self.channels, turned),
            # Features are symmetric about 1.
            "position_feature": turned_vectors(inputs["position_feature"] - 1.0, turned) + 1.0,
        }, turned_vectors(velocities, turned)

    def checkpoint(self, state: StateDict) -> bytes:
        """See `Learnable`; a file for `torch.load`."""
        return write_state_dict(state)

    def bundle(
        self,
        checkpoint: bytes,
        parameters: PolicyParameters,
        name: str,
        provenance: Mapping[str, str],
    ) -> Bundle:
        """See `Learnable`."""
        network = parse_checkpoint(checkpoint, name)
        return bundle_of(
            network, parameters, name, {"checkpoint_sha256": network.sha256, **provenance}
        )


def lpac_network(network: Mapping[str, object], where: str) -> LpacNetwork:
    """See `LearnableFamily`."""
    return from_mapping(LpacNetwork, network, where)


class LpacModule(nn.Module):
    """See `TrainableModule`; computes `export.network.centralised`, for training."""

    actions_mean: Tensor
    actions_std: Tensor

    def __init__(self, network: LpacNetwork, actions_mean: F32, actions_std: F32) -> None:
        super().__init__()
        self.register_buffer("actions_mean", torch.from_numpy(actions_mean.copy()))
        self.register_buffer("actions_std", torch.from_numpy(actions_std.copy()))
        self.cnn_backbone = ImageNetwork(network)
        self.gnn_backbone = _Gnn(network)
        self.gnn_mlp = _Mlp(network)
        self.output_linear = nn.Linear(network.mlp_width, ACTION_SIZE)

    def forward(self, inputs: Mapping[str, Tensor], shift: Tensor, present: Tensor) -> Tensor:
        """See `TrainableModule`."""
        features = torch.cat(
            [self.cnn_backbone(inputs["images"]), inputs["position_feature"]], dim=1
        )
        swarms = features.new_zeros(*present.shape, features.shape[1])
        swarms[present] = features
        values = self.gnn_backbone(swarms, shift)[present]
        actions: Tensor = self.output_linear(self.gnn_mlp(values)).float()
        return actions * self.actions_std + self.actions_mean


class ImageNetwork(nn.Module):
    """The paper's CNN: features (R, features) of images (R, channels, size, size)."""

    def __init__(self, network: ImageNetworkSizes) -> None:
        super().__init__()
        self._convolutions = len(network.cnn_channels)
        inputs = len(network.channels)
        for i, outputs in enumerate(network.cnn_channels):
            self.add_module(f"conv{i}", nn.Conv2d(inputs, outputs, network.kernel))
            self.add_module(f"batch_norm{i}", nn.BatchNorm2d(outputs, eps=BATCH_NORM_EPS))
            inputs = outputs
        self.linear_1 = nn.Linear(inputs * last_side(network) ** 2, network.features)

    def forward(self, images: Tensor) -> Tensor:
        # A fifth faster on a CPU.
        values = images.contiguous(memory_format=torch.channels_last)
        for i in range(self._convolutions):
            values = self.get_submodule(f"conv{i}")(values)
            values = self.get_submodule(f"batch_norm{i}")(values)
            values = functional.leaky_relu(values, LEAKY_RELU_SLOPE)
        return functional.leaky_relu(self.linear_1(values.flatten(1)), LEAKY_RELU_SLOPE)


class _Gnn(nn.Module):
    def __init__(self, network: LpacNetwork) -> None:
        super().__init__()
        inputs = network.features + POSITION_SIZE
        self._layers = network.layers
        for i in range(network.layers):
            self.add_module(f"graph_conv_{i}", _GraphLayer(network.hops, inputs, network.width))
            inputs = network.width

    def forward(self, swarms: Tensor, shift: Tensor) -> Tensor:
        for i in range(self._layers):
            swarms = self.get_submodule(f"graph_conv_{i}")(swarms, shift)
        return swarms


class _GraphLayer(nn.Module):
    """z_l of K hops, and ReLU."""

    def __init__(self, hops: int, inputs: int, outputs: int) -> None:
        super().__init__()
        self.lins = nn.ModuleList(
            nn.Linear(inputs, outputs, bias=False) for _ in range(max(hops, 1) + 1)
        )
        if not hops:  # bundles have at least one hop
            for unused in self.lins[1].parameters():
                nn.init.zeros_(unused.requires_grad_(False))
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, swarms: Tensor, shift: Tensor) -> Tensor:
        hop, values = swarms, self.bias
        for k, tap in enumerate(self.lins):
            if k:
                hop = shift @ hop
            values = values + tap(hop)
        return values.relu()


class _Norm(nn.Module):
    """Adds the level `module` to the names in the state dict."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.module = nn.BatchNorm1d(size, eps=BATCH_NORM_EPS)

    def forward(self, values: Tensor) -> Tensor:
        return cast(Tensor, self.module(values))


class _Mlp(nn.Module):
    """Linear layers, with batch norm and ReLU between them."""

    def __init__(self, network: LpacNetwork) -> None:
        super().__init__()
        sizes = [network.width, *[network.mlp_width] * network.mlp_layers]
        self.lins = nn.ModuleList(nn.Linear(*pair) for pair in pairwise(sizes))
        self.norms = nn.ModuleList(_Norm(network.mlp_width) for _ in range(network.mlp_layers - 1))

    def forward(self, values: Tensor) -> Tensor:
        for linear, norm in zip(self.lins, self.norms, strict=False):
            values = norm(linear(values)).relu()
        return cast(Tensor, self.lins[-1](values))
