"""Run a graph with onnxruntime and compare its outputs."""

import numpy as np
import onnxruntime

from edge.core import F32


def run_graph(content: bytes, inputs: F32) -> F32:
    """The output of a graph with one input and one output."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    output: F32
    (output,) = session.run(None, {session.get_inputs()[0].name: inputs})
    return output


def relative_error(output: F32, truth: F32) -> float:
    """The largest error of a row over the row's largest value or a third of the overall largest."""
    errors, sizes = (
        np.abs(values).reshape(len(truth), -1).max(axis=1) for values in (output - truth, truth)
    )
    return float((errors / np.maximum(sizes, sizes.max() / 3)).max())
