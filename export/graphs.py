"""Builds the network's ONNX graphs node by node, byte-identical on any machine.

Batch norms are folded into the layers before them. The last two linear layers and the
de-normalisation become one. Float64 without library sums gives the same float32 weights everywhere.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper

from edge.core import F32, F64
from edge.policy.lpac.manifest import ACTION, CNN, gnn_graph
from export.checkpoint import (
    BATCH_NORM_EPS,
    LEAKY_RELU_SLOPE,
    ActionNetwork,
    BatchNorm,
    Checkpoint,
    Cnn,
    GnnLayer,
)

OPSET = 20
_IR_VERSION = 10
_PRODUCER = "lpac-edge"
_BATCH = "batch"


def build_graphs(checkpoint: Checkpoint) -> dict[str, bytes]:
    """All graphs of the bundle by file name. The first dimension is the free `batch`.

    cnn.onnx: images (batch, channels, size, size) -> features (batch, F_0 - 2).
    gnn_<l>.onnx: hops (batch, K + 1, F_{l-1}) -> features (batch, F_l).
    action.onnx: features (batch, F_L) -> velocity (batch, 2) in model units/s.
    """
    graphs = {CNN: _cnn(checkpoint.cnn)} if checkpoint.cnn else {}
    for number, layer in enumerate(checkpoint.gnn, 1):
        graphs[gnn_graph(number)] = _gnn(f"gnn_{number}", layer)
    graphs[ACTION] = _action(checkpoint.action)
    return graphs


def action_layers(action: ActionNetwork) -> list[tuple[F64, F64]]:
    """The action network as weight (out, in) and bias (out,), with ReLU between the layers."""
    layers = [_fold(linear.weight, linear.bias, norm) for linear, norm in action.hidden]
    output = action.output.weight.astype(np.float64)
    weight = [[math.fsum(row * column) for column in action.last.weight.T] for row in output]
    bias = [
        math.fsum([*(row * action.last.bias), offset])
        for row, offset in zip(output, action.output.bias, strict=True)
    ]
    std = action.std.astype(np.float64)
    layers.append((np.array(weight) * std[:, None], np.array(bias) * std + action.mean))
    return layers


def _fold(weight: F32, bias: F32, norm: BatchNorm) -> tuple[F64, F64]:
    """Fold a batch norm into the layer before it: weight (out, ...) and bias (out,)."""
    scale = norm.weight / np.sqrt(norm.variance.astype(np.float64) + BATCH_NORM_EPS)
    folded: F64 = weight * scale.reshape(-1, *[1] * (weight.ndim - 1))
    return folded, (bias.astype(np.float64) - norm.mean) * scale + norm.bias


class _Node(NamedTuple):
    """One operator of a chain; `weights` are the inputs after the chain's value."""

    operator: str
    weights: Mapping[str, npt.NDArray[np.floating]] = {}
    attributes: Mapping[str, Any] = {}


_LEAKY_RELU = _Node("LeakyRelu", attributes={"alpha": LEAKY_RELU_SLOPE})


def _cnn(cnn: Cnn) -> bytes:
    nodes = []
    for i, convolution in enumerate(cnn.convolutions):
        weight, bias = _fold(convolution.weight, convolution.bias, convolution.norm)
        nodes += [_Node("Conv", {f"weight_{i}": weight, f"bias_{i}": bias}), _LEAKY_RELU]
    linear = {"linear_weight": cnn.linear.weight, "linear_bias": cnn.linear.bias}
    nodes += [_Node("Flatten"), _Node("Gemm", linear, {"transB": 1}), _LEAKY_RELU]
    images = (cnn.channels, cnn.image_size, cnn.image_size)
    return _model("cnn", ("images", images), ("features", len(cnn.linear.bias)), nodes)


def _gnn(name: str, layer: GnnLayer) -> bytes:
    taps, inputs, outputs = layer.taps.shape
    weights = {"taps": layer.taps.reshape(taps * inputs, outputs), "bias": layer.bias}
    nodes = [_Node("Flatten"), _Node("Gemm", weights), _Node("Relu")]
    return _model(name, ("hops", (taps, inputs)), ("features", outputs), nodes)


def _action(action: ActionNetwork) -> bytes:
    layers = action_layers(action)
    nodes = []
    for i, (weight, bias) in enumerate(layers):
        weights = {f"weight_{i}": weight, f"bias_{i}": bias}
        nodes += [_Node("Gemm", weights, {"transB": 1}), _Node("Relu")]
    inputs, outputs = layers[0][0].shape[1], layers[-1][0].shape[0]
    return _model("action", ("features", (inputs,)), ("velocity", outputs), nodes[:-1])


def _model(
    name: str,
    inputs: tuple[str, tuple[int, ...]],
    outputs: tuple[str, int],
    chain: Sequence[_Node],
) -> bytes:
    """Build the graph in which each node takes the output of the one before it."""
    nodes, initialisers, value = [], [], inputs[0]
    for number, node in enumerate(chain, 1):
        result = outputs[0] if number == len(chain) else f"{node.operator.lower()}_{number}"
        nodes.append(
            helper.make_node(
                node.operator,
                [value, *node.weights],
                [result],
                f"{node.operator}_{number}",
                **node.attributes,
            )
        )
        initialisers += [
            helper.make_tensor(
                key, TensorProto.FLOAT, array.shape, array.astype("<f4").tobytes(), raw=True
            )
            for key, array in node.weights.items()
        ]
        value = result
    graph = helper.make_graph(
        nodes,
        name,
        [helper.make_tensor_value_info(inputs[0], TensorProto.FLOAT, [_BATCH, *inputs[1]])],
        [helper.make_tensor_value_info(outputs[0], TensorProto.FLOAT, [_BATCH, outputs[1]])],
        initialisers,
    )
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=_IR_VERSION,
        producer_name=_PRODUCER,
    )
    onnx.checker.check_model(model, full_check=True)
    content: bytes = model.SerializeToString(deterministic=True)
    return content
