"""Golden vectors: inputs, and what the torch network makes of them, for a bundle to be held to.

Computed in float64 and rounded once, so that what a graph differs from them is its own rounding.
The inputs are such that every tensor of a graph shows in its outputs, and that the outputs of a
graph are of one magnitude. An error is measured row by row (first dimension), relative to the row's
largest golden value but at least a third of the graph's largest: the first makes small biases show,
the second keeps a row of which little is left by cancellation from being all rounding.
"""

import io
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from edge.core import F32, F64
from edge.policy.lpac.images import (
    EXPLORED,
    MAP_CHANNELS,
    NEIGHBOURS,
    OWN_CELL,
    neighbour_maps,
    own_cell,
)
from edge.policy.lpac.manifest import ACTION, CNN, gnn_graph
from export import network
from export.checkpoint import (
    POSITION_SIZE,
    ActionNetwork,
    Checkpoint,
    CheckpointError,
    Cnn,
    GnnLayer,
)
from export.graphs import action_layers

_TOLERANCE = 1e-5

_SEED = 14
_ROBOTS = 10
# In the unit square: with this seed the robots have 1 to 6 neighbours and are connected.
_RANGE = 0.4


def golden_vectors(checkpoint: Checkpoint) -> bytes:
    """An npz, all float32 but for the neighbours: the same bytes for the same checkpoint.

    `<graph>/input` and `<graph>/output` for each graph's file name; a swarm of N robots, one of
    which is alone: `swarm/neighbours` (N, N) bool, `swarm/features` (N, F_0), and
    `swarm/velocities` (K L + 1, N, 2) after 0, 1, .. K L synchronous rounds of exchange.

    Raises CheckpointError if the network's outputs are beyond float32.
    """
    arrays: dict[str, Any] = {}

    def add(graph: str, inputs: F32, function: Callable[[Tensor], Tensor]) -> None:
        arrays[f"{graph}/input"] = inputs
        arrays[f"{graph}/output"] = _rounded(graph, function(_exact(inputs)))

    if checkpoint.cnn:
        add(CNN, _images(checkpoint.cnn), partial(network.cnn_features, checkpoint.cnn))
    for number, layer in enumerate(checkpoint.gnn, 1):
        add(gnn_graph(number), _hops(layer), partial(network.gnn_features, layer))
    add(ACTION, _features(checkpoint.action), partial(network.velocities, checkpoint.action))

    neighbours = _neighbours()
    features = _swarm_features(checkpoint)
    shift = network.shift_operator(torch.from_numpy(neighbours))
    rounds = network.decentralised(checkpoint, shift, _exact(features))
    whole = network.centralised(checkpoint, shift, _exact(features))
    # Invariant: on a static graph, K L rounds make the swarm the centralised network.
    error, scale = float((rounds[-1] - whole).abs().max()), float(whole.abs().max())
    if not error <= _TOLERANCE * scale:
        raise AssertionError(f"K L rounds differ from the centralised network: {error} of {scale}")
    arrays["swarm/neighbours"] = neighbours
    arrays["swarm/features"] = features
    arrays["swarm/velocities"] = _rounded("swarm", rounds)

    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # numpy dates all entries to 1980
    return buffer.getvalue()


def _random() -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(_SEED))


def _exact(array: F32) -> Tensor:
    return torch.from_numpy(array).double()


def _rounded(graph: str, values: Tensor) -> F32:
    array: F32 = values.float().numpy()
    if not np.isfinite(array).all():
        raise CheckpointError(f"{graph}: outputs are beyond float32: are the weights this large?")
    return array


def _images(cnn: Cnn) -> F32:
    """Blank, each channel alone, all channels dense, and four as they are in flight.

    The dense ones are faint, for noise excites the network more than anything in flight.
    """
    random = _random()
    shape = (cnn.channels, cnn.image_size, cnn.image_size)
    blank = np.zeros((1, *shape))
    alone = np.zeros((cnn.channels, *shape))
    for channel in range(cnn.channels):
        alone[channel, channel] = random.uniform(-0.1, 0.1, shape[1:])
    dense = random.uniform(-0.1, 0.1, (2, *shape))
    flight = _flight_images(cnn, 4, random)
    return np.concatenate([blank, alone, dense, flight]).astype(np.float32)


def _flight_images(cnn: Cnn, count: int, random: np.random.Generator) -> F64:
    """Important places in what has been seen, some neighbours, the world's corner on one side."""
    size = cnn.image_size
    cells = (np.arange(size) + 0.5) / size
    x, y = np.meshgrid(cells, cells, indexing="ij")
    images = np.zeros((count, cnn.channels, size, size))
    for image in images:
        peaks = random.uniform(0.1, 0.9, (4, 2))
        importance = sum(np.exp(-((x - px) ** 2 + (y - py) ** 2) / 0.02) for px, py in peaks)
        seen = np.hypot(x - 0.5, y - 0.5) < random.uniform(0.3, 0.6)
        maps = {
            "importance": np.clip(importance, 0, 1) * seen,
            EXPLORED: seen.astype(np.float64),
            "obstacles": np.maximum(x > random.uniform(0.6, 1), y < random.uniform(0, 0.4)),
        }
        offsets = random.uniform(-0.9, 0.9, (random.integers(1, 6), 2))
        maps |= zip(NEIGHBOURS, neighbour_maps(offsets, 1.0, size), strict=True)
        maps[OWN_CELL] = own_cell(offsets, 1.0, size)
        image[:] = [maps[channel] for channel in MAP_CHANNELS[cnn.channels]]
    return images


def _hops(layer: GnnLayer) -> F32:
    """Nothing, then each hop alone and all hops together, with both signs."""
    random = _random()
    taps, inputs, outputs = layer.taps.shape
    alone = np.zeros((taps, taps, inputs))
    for k in range(taps):
        alone[k, k] = random.standard_normal(inputs)
    rows = np.concatenate([alone, random.standard_normal((2, taps, inputs))])
    weight = layer.taps.reshape(taps * inputs, outputs).T.astype(np.float64)
    balanced = _balanced(rows.reshape(len(rows), -1), weight, layer.bias)
    return balanced.reshape(-1, taps, inputs)


def _features(action: ActionNetwork) -> F32:
    """Nothing, then random features with both signs."""
    weight, bias = action_layers(action)[0]
    return _balanced(_random().standard_normal((8, weight.shape[1])), weight, bias)


def _balanced(rows: F64, weight: F64, bias: F32 | F64) -> F32:
    """A row of zeros, then each of `rows` (n, in) and its negative: (2 n + 1, in).

    Scaled so that what `weight` (out, in) makes of a row is as large as `bias` (out,): then
    neither hides the other, however small one of them is.
    """
    reach = np.abs(rows @ weight.T).max(axis=1, keepdims=True)
    target = 2 * max(np.abs(bias).max(), 1e-3)
    scaled = rows * (target / np.maximum(reach, 1e-30 * target))
    return np.concatenate([np.zeros((1, rows.shape[1])), scaled, -scaled]).astype(np.float32)


def _neighbours() -> npt.NDArray[np.bool_]:
    """Adjacency, (N, N): a random geometric graph, from which the last robot is cut off."""
    positions = _random().uniform(0, 1, (_ROBOTS, 2))
    near: npt.NDArray[np.bool_] = np.hypot(*(positions[:, None] - positions[None]).T) < _RANGE
    np.fill_diagonal(near, False)
    near[-1] = near[:, -1] = False
    return near


def _swarm_features(checkpoint: Checkpoint) -> F32:
    """x_0 (N, F_0): the CNN's features of images as in flight, if there is one, and positions."""
    random = _random()
    if checkpoint.cnn:
        images = _flight_images(checkpoint.cnn, _ROBOTS, random)
        features = network.cnn_features(checkpoint.cnn, torch.from_numpy(images)).numpy()
    else:
        inputs = checkpoint.geometry.feature_sizes[0] - POSITION_SIZE
        features = random.standard_normal((_ROBOTS, inputs))
    positions = random.uniform(0.5, 1.5, (_ROBOTS, POSITION_SIZE))
    return np.concatenate([features, positions], axis=1).astype(np.float32)
