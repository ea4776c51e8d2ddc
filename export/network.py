"""The network in plain torch, layer by layer as trained: the reference for the exported graphs.

Nothing is folded or shared with the ONNX graphs. All functions compute in the inputs' precision.
"""

import torch
from torch import Tensor
from torch.nn import functional

from edge.core import F32
from export.checkpoint import (
    BATCH_NORM_EPS,
    LEAKY_RELU_SLOPE,
    ActionNetwork,
    BatchNorm,
    Checkpoint,
    Cnn,
    GnnLayer,
    Linear,
)


def cnn_features(cnn: Cnn, images: Tensor) -> Tensor:
    """Features (batch, F_0 - 2) of images (batch, channels, size, size)."""
    values = images
    for layer in cnn.convolutions:
        values = functional.conv2d(
            values, _tensor_like(images, layer.weight), _tensor_like(images, layer.bias)
        )
        values = functional.leaky_relu(_batch_norm(layer.norm, values), LEAKY_RELU_SLOPE)
    return functional.leaky_relu(_linear(cnn.linear, values.flatten(1)), LEAKY_RELU_SLOPE)


def gnn_features(layer: GnnLayer, hops: Tensor) -> Tensor:
    """x_l (batch, F_l) of y_kl, k = 0..K, stacked as hops (batch, K + 1, F_{l-1})."""
    values = _tensor_like(hops, layer.bias)
    for k, tap in enumerate(layer.taps):
        values = values + hops[:, k] @ _tensor_like(hops, tap)
    return values.relu()


def velocities(action: ActionNetwork, features: Tensor) -> Tensor:
    """Velocities (batch, 2) in model units/s of x_L (batch, F_L)."""
    values = features
    for linear, norm in action.hidden:
        values = _batch_norm(norm, _linear(linear, values)).relu()
    values = _linear(action.output, _linear(action.last, values))
    return values * _tensor_like(features, action.std) + _tensor_like(features, action.mean)


def shift_operator(neighbours: Tensor) -> Tensor:
    """S_ij = 1/sqrt(d_i d_j) for neighbours i, j, else 0, of a symmetric (N, N) bool matrix."""
    adjacency = neighbours.double()
    degrees = adjacency.sum(1)
    scale = torch.where(degrees > 0, degrees, torch.inf).rsqrt()
    return scale[:, None] * adjacency * scale


def centralised(checkpoint: Checkpoint, shift: Tensor, features: Tensor) -> Tensor:
    """Velocities (N, 2) of the whole swarm, from x_0 (N, F_0)."""
    values = features
    for layer in checkpoint.gnn:
        hops = [values]
        for _ in range(checkpoint.geometry.hops):
            hops.append(shift @ hops[-1])
        values = gnn_features(layer, torch.stack(hops, 1))
    return velocities(checkpoint.action, values)


def decentralised(checkpoint: Checkpoint, shift: Tensor, features: Tensor) -> Tensor:
    """Velocities (K L + 1, N, 2) after 0, 1, .. K L synchronous rounds of exchange.

    In each round a robot computes y_kl = sum_j S_ij (y_j)_{k-1,l} from its neighbours' values after
    the round before (paper, section "Decentralized Graph Neural Networks").
    """
    geometry = checkpoint.geometry
    shape = (len(features), geometry.hops + 1)
    held = [features.new_zeros(*shape, size) for size in geometry.feature_sizes[:-1]]
    rounds = []
    for _ in range(geometry.hops * geometry.layers + 1):
        values = features
        for layer, hops in zip(checkpoint.gnn, held, strict=True):
            hops[:, 1:] = torch.einsum("ij,jkf->ikf", shift, hops[:, :-1].clone())
            hops[:, 0] = values
            values = gnn_features(layer, hops)
        rounds.append(velocities(checkpoint.action, values))
    return torch.stack(rounds)


def _tensor_like(values: Tensor, array: F32) -> Tensor:
    return torch.from_numpy(array).to(values.dtype)


def _linear(linear: Linear, values: Tensor) -> Tensor:
    return functional.linear(
        values, _tensor_like(values, linear.weight), _tensor_like(values, linear.bias)
    )


def _batch_norm(norm: BatchNorm, values: Tensor) -> Tensor:
    mean, variance, weight, bias = (
        _tensor_like(values, array) for array in (norm.mean, norm.variance, norm.weight, norm.bias)
    )
    return functional.batch_norm(values, mean, variance, weight, bias, eps=BATCH_NORM_EPS)
