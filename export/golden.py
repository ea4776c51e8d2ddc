"""Golden vectors: inputs, and the torch network's outputs, against which a bundle is verified.

Outputs are computed in float64 and rounded once, so that a graph's difference is its own rounding.
Inputs are chosen so that every tensor of a graph affects its outputs, and that all outputs of a
graph have a similar magnitude. `edge.policy.lpac.verify` defines the error.
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
from edge.policy.images import (
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
# In the unit square. With this seed, robots have 1 to 6 neighbours and are connected.
_RANGE = 0.4


def golden_vectors(checkpoint: Checkpoint) -> bytes:
    """The npz file, deterministic, all arrays float32 except the adjacency.

    For each graph, `<file name>/input` and `/output`. For a swarm of N robots, one of them without
    neighbours: `swarm/neighbours` (N, N) bool, `swarm/features` (N, F_0), `swarm/velocities`
    (K L + 1, N, 2) after 0, 1, .. K L synchronous rounds of exchange.

    Raises CheckpointError if the network's outputs are beyond float32.
    """
    arrays: dict[str, Any] = {}

    def add(graph: str, inputs: F32, function: Callable[[Tensor], Tensor]) -> None:
        arrays[f"{graph}/input"] = inputs
        arrays[f"{graph}/output"] = _float32(graph, function(_float64(inputs)))

    if checkpoint.cnn:
        add(CNN, _images(checkpoint.cnn), partial(network.cnn_features, checkpoint.cnn))
    for number, layer in enumerate(checkpoint.gnn, 1):
        add(gnn_graph(number), _hops(layer), partial(network.gnn_features, layer))
    add(ACTION, _features(checkpoint.action), partial(network.velocities, checkpoint.action))

    neighbours = _neighbours()
    features = _swarm_features(checkpoint)
    shift = network.shift_operator(torch.from_numpy(neighbours))
    rounds = network.decentralised(checkpoint, shift, _float64(features))
    whole = network.centralised(checkpoint, shift, _float64(features))
    # Invariant: on a static graph, the swarm equals the centralised network after K L rounds.
    error, scale = float((rounds[-1] - whole).abs().max()), float(whole.abs().max())
    if not error <= _TOLERANCE * scale:
        raise AssertionError(f"K L rounds differ from the centralised network: {error} of {scale}")
    arrays["swarm/neighbours"] = neighbours
    arrays["swarm/features"] = features
    arrays["swarm/velocities"] = _float32("swarm", rounds)

    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # numpy dates all entries to 1980
    return buffer.getvalue()


def _random() -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(_SEED))


def _float64(array: F32) -> Tensor:
    return torch.from_numpy(array).double()


def _float32(graph: str, values: Tensor) -> F32:
    array: F32 = values.float().numpy()
    if not np.isfinite(array).all():
        raise CheckpointError(f"{graph}: outputs overflow float32: check the size of the weights")
    return array


def _images(cnn: Cnn) -> F32:
    """Blank, each channel alone, all channels dense, and four as in flight.

    The dense ones are faint: noise excites the network more than any image in flight.
    """
    random = _random()
    shape = (cnn.channels, cnn.image_size, cnn.image_size)
    blank = np.zeros((1, *shape))
    alone = np.zeros((cnn.channels, *shape))
    for channel in range(cnn.channels):
        alone[channel, channel] = random.uniform(-0.1, 0.1, shape[1:])
    dense = random.uniform(-0.1, 0.1, (2, *shape))
    flight = flight_images(cnn.channels, cnn.image_size, 4, random)
    return np.concatenate([blank, alone, dense, flight]).astype(np.float32)


def flight_images(channels: int, size: int, count: int, random: np.random.Generator) -> F64:
    """Images (count, channels, size, size) as in flight, for one of `MAP_CHANNELS`.

    Important places in the seen area, some neighbours, the world's corner on one side.
    """
    cells = (np.arange(size) + 0.5) / size
    x, y = np.meshgrid(cells, cells, indexing="ij")
    images = np.zeros((count, channels, size, size))
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
        image[:] = [maps[channel] for channel in MAP_CHANNELS[channels]]
    return images


def _hops(layer: GnnLayer) -> F32:
    """Zeros, then each hop alone and all hops together, with both signs."""
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
    """Zeros, then random features with both signs."""
    weight, bias = action_layers(action)[0]
    return _balanced(_random().standard_normal((8, weight.shape[1])), weight, bias)


def _balanced(rows: F64, weight: F64, bias: F32 | F64) -> F32:
    """A row of zeros, then each of `rows` (n, in) and its negative: (2 n + 1, in).

    Rows are scaled so that their products with `weight` (out, in) are as large as `bias` (out,),
    and neither hides the other.
    """
    reach = np.abs(rows @ weight.T).max(axis=1, keepdims=True)
    target = 2 * max(np.abs(bias).max(), 1e-3)
    scaled = rows * (target / np.maximum(reach, 1e-30 * target))
    return np.concatenate([np.zeros((1, rows.shape[1])), scaled, -scaled]).astype(np.float32)


def _neighbours() -> npt.NDArray[np.bool_]:
    """Adjacency (N, N) of a random geometric graph; the last robot has no neighbours."""
    positions = _random().uniform(0, 1, (_ROBOTS, 2))
    near: npt.NDArray[np.bool_] = np.hypot(*(positions[:, None] - positions[None]).T) < _RANGE
    np.fill_diagonal(near, False)
    near[-1] = near[:, -1] = False
    return near


def _swarm_features(checkpoint: Checkpoint) -> F32:
    """x_0 (N, F_0): the CNN's features of images as in flight, or random ones, and positions."""
    random = _random()
    if checkpoint.cnn:
        cnn = checkpoint.cnn
        images = flight_images(cnn.channels, cnn.image_size, _ROBOTS, random)
        features = network.cnn_features(cnn, torch.from_numpy(images)).numpy()
    else:
        inputs = checkpoint.geometry.feature_sizes[0] - POSITION_SIZE
        features = random.standard_normal((_ROBOTS, inputs))
    positions = random.uniform(0.5, 1.5, (_ROBOTS, POSITION_SIZE))
    return np.concatenate([features, positions], axis=1).astype(np.float32)
