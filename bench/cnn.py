"""How much of what the core can do the CNN gets out of it."""

import json
import math
import tempfile
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
from onnx import TensorProto, helper, shape_inference

from bench.result import Table
from bench.timing import interleaved, quartiles, with_quartiles
from edge.core import F32
from edge.policy.bundle import Bundle
from edge.policy.lpac.manifest import CNN
from edge.policy.lpac.policy import LpacPolicy

# Large enough for the peak, small enough for the second-level cache of a small core.
_GEMM_SIZE = 512
_PROFILED_RUNS = 200


def measure(bundle: Bundle, images: F32, rounds: int, round_s: float) -> dict[str, Any]:
    """Speed of the CNN, the peak (the faster of two matrix products), and where the time goes."""
    policy = LpacPolicy(bundle)
    flops = _flops(bundle.files[CNN])
    gemm_flop = 2 * _GEMM_SIZE**3
    times = interleaved({"CNN": lambda: policy.image_features(images), **_gemms()}, rounds, round_s)
    cnn_gflops = sum(flops) / times.pop("CNN") / 1e9
    gemm_gflops = {name: gemm_flop / t / 1e9 for name, t in times.items()}
    peak = max(gemm_gflops, key=lambda name: float(np.median(gemm_gflops[name])))
    return {
        "flop": sum(flops),
        "gflops": quartiles(cnn_gflops),
        "peak_gflops": {name: quartiles(speed) for name, speed in gemm_gflops.items()},
        "share_of_peak": quartiles(cnn_gflops / gemm_gflops[peak]),
        "operators": _profile(bundle.files[CNN], images, flops),
    }


def table(figures: dict[str, Any]) -> Table:
    """Speeds, and the operators of the CNN."""
    total_us = sum(operator["us"] for operator in figures["operators"])
    rows = [
        ("CNN", f"{figures['flop'] / 1e6:.2f}", "", "", with_quartiles(figures["gflops"], 1)),
        *(
            (name, f"{2 * _GEMM_SIZE**3 / 1e6:.0f}", "", "", with_quartiles(speed, 1))
            for name, speed in figures["peak_gflops"].items()
        ),
    ]
    for operator in figures["operators"]:
        us, mflop = operator["us"], operator["flop"] / 1e6
        speed = f"{mflop / us * 1e3:.1f}" if mflop else ""
        share = f"{100 * us / total_us:.0f} %"
        rows.append((f"  {operator['name']}", f"{mflop:.2f}", f"{us:.0f}", share, speed))
    return Table(
        f"CNN, {100 * figures['share_of_peak']['median']:.0f} % of the peak",
        ("", "MFLOP", "us (profiled)", "share", "GFLOP/s"),
        rows,
    )


def _flops(model: bytes) -> list[int]:
    """Two per multiplication and addition, for the convolutions and matrix products in order."""
    graph = shape_inference.infer_shapes(onnx.load_from_string(model)).graph
    weights = {tensor.name: math.prod(tensor.dims[1:]) for tensor in graph.initializer}
    outputs = {
        value.name: math.prod(size.dim_value for size in value.type.tensor_type.shape.dim[1:])
        for value in (*graph.value_info, *graph.output)
    }
    return [
        2 * outputs[node.output[0]] * weights[node.input[1]]
        for node in graph.node
        if node.op_type in ("Conv", "Gemm")
    ]


def _gemms() -> dict[str, Callable[[], object]]:
    """One large matrix product each by numpy's BLAS and by onnxruntime."""
    size = _GEMM_SIZE
    matrix = np.random.default_rng(1).random((size, size), np.float32)
    out = np.empty_like(matrix)
    weight = helper.make_tensor("b", TensorProto.FLOAT, (size, size), matrix.tobytes(), raw=True)
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, (size, size)) for name in "ac"]
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["a", "b"], ["c"])], "gemm", values[:1], values[1:], [weight]
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    session = ort.InferenceSession(model.SerializeToString(), _one_thread())
    return {
        f"matrix product {size}, numpy": lambda: np.matmul(matrix, matrix, out=out),
        f"matrix product {size}, onnxruntime": lambda: session.run(None, {"a": matrix}),
    }


def _profile(model: bytes, images: F32, flops: list[int]) -> list[dict[str, Any]]:
    """Median time of each operator that onnxruntime makes of the graph."""
    with tempfile.TemporaryDirectory() as folder:
        options = _one_thread()
        options.enable_profiling = True
        options.profile_file_prefix = str(Path(folder) / "cnn")
        session = ort.InferenceSession(model, options)
        for _ in range(_PROFILED_RUNS):
            session.run(None, {session.get_inputs()[0].name: images})
        events = json.loads(Path(session.end_profiling()).read_text())
    times_us: dict[tuple[str, str], list[float]] = defaultdict(list)
    for event in events:
        if event["cat"] == "Node" and event["name"].endswith("_kernel_time"):
            times_us[event["name"], event["args"]["op_name"]].append(event["dur"])
    counted = iter(flops)
    return [
        {
            "name": operator,
            "us": float(np.median(durations)),
            "flop": next(counted) if operator.endswith(("Conv", "Gemm")) else 0,
        }
        for (_, operator), durations in times_us.items()
    ]


def _one_thread() -> ort.SessionOptions:
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    return options
