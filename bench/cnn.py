"""Efficiency of the CNN relative to the core's peak."""

from collections.abc import Callable
from typing import Any

import numpy as np
import onnxruntime as ort
import torch
from onnx import TensorProto, helper
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from bench.result import Table
from bench.timing import interleaved, quartiles, with_quartiles
from edge.core import F32

# Large enough for peak speed, small enough for a small core's second-level cache.
_GEMM_SIZE = 512


def measure(
    cnn: Callable[[F32], F32], same: nn.Module, images: F32, rounds: int, round_s: float
) -> dict[str, Any]:
    """Speed of the CNN, and the peak: the faster of two matrix products.

    `same` is the CNN in torch, for counting operations.
    """
    with FlopCounterMode(display=False) as counted:
        same(torch.from_numpy(images))
    flop = counted.get_total_flops()
    times = interleaved({"CNN": lambda: cnn(images), **_gemms()}, rounds, round_s)
    cnn_gflops = flop / times.pop("CNN") / 1e9
    gemm_gflops = {name: 2 * _GEMM_SIZE**3 / t / 1e9 for name, t in times.items()}
    peak = max(gemm_gflops, key=lambda name: float(np.median(gemm_gflops[name])))
    return {
        "flop": flop,
        "gflops": quartiles(cnn_gflops),
        "peak_gflops": {name: quartiles(speed) for name, speed in gemm_gflops.items()},
        "share_of_peak": quartiles(cnn_gflops / gemm_gflops[peak]),
    }


def table(figures: dict[str, Any]) -> Table:
    """Speed of the CNN and of matrix products."""
    speeds = {"CNN": figures["gflops"], **figures["peak_gflops"]}
    return Table(
        f"CNN, {100 * figures['share_of_peak']['median']:.0f} % of the peak",
        ("", "GFLOP/s"),
        [(name, with_quartiles(speed, 1)) for name, speed in speeds.items()],
    )


def _gemms() -> dict[str, Callable[[], object]]:
    """A large matrix product with numpy's BLAS and one with onnxruntime."""
    size = _GEMM_SIZE
    matrix = np.random.default_rng(1).random((size, size), np.float32)
    out = np.empty_like(matrix)
    weight = helper.make_tensor("b", TensorProto.FLOAT, (size, size), matrix.tobytes(), raw=True)
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, (size, size)) for name in "ac"]
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["a", "b"], ["c"])], "gemm", values[:1], values[1:], [weight]
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    one_thread = ort.SessionOptions()
    one_thread.intra_op_num_threads = 1
    session = ort.InferenceSession(model.SerializeToString(), one_thread)
    return {
        f"matrix product {size}, numpy": lambda: np.matmul(matrix, matrix, out=out),
        f"matrix product {size}, onnxruntime": lambda: session.run(None, {"a": matrix}),
    }
