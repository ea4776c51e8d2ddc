"""ONNX graphs of a bundle. The only module that imports onnxruntime."""

import os
from collections.abc import Mapping

import numpy as np

from edge.core import F32
from edge.policy.bundle import Bundle, BundleError

# Set before the import, or onnxruntime writes a telemetry database into the home directory.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"
import onnxruntime as ort

# A size, or the name of a free dimension.
Shape = tuple[int | str, ...]


class Graph:
    """A graph of float32 tensors, without state: safe to call from several threads."""

    def __init__(
        self, bundle: Bundle, name: str, inputs: Mapping[str, Shape], outputs: Mapping[str, Shape]
    ) -> None:
        """Load the file `name`. Raises BundleError unless it has these inputs and outputs."""
        self.name = name
        options = ort.SessionOptions()
        # The board also runs the autopilot: no thread pool, no spinning.
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        # Errors are raised; printed as well, they would hide the one line for people.
        options.log_severity_level = 4
        # The arena would keep the memory of the largest batch, that of verification: 4.5 MB.
        options.enable_cpu_mem_arena = False
        try:
            self._session = ort.InferenceSession(
                bundle.files[name], options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime's exceptions share no base class
            raise BundleError(f"{name}: onnxruntime cannot load it: {error}") from None
        # onnxruntime keeps the file's bytes in case of another device: 4 MB for a policy.
        self._session._model_bytes = None
        for kind, found, expected in (
            ("input", self._session.get_inputs(), inputs),
            ("output", self._session.get_outputs(), outputs),
        ):
            shapes = {value.name: tuple(value.shape) for value in found}
            if shapes != dict(expected):
                raise BundleError(
                    f"{name}: the {kind} is {shapes}; the manifest needs {dict(expected)}"
                )
        self._outputs = list(outputs)

    def run(self, inputs: Mapping[str, F32]) -> list[F32]:
        """The outputs, in the order given to the constructor, in new arrays."""
        # `ascontiguousarray` would give a number a dimension.
        contiguous = {name: np.asarray(values, order="C") for name, values in inputs.items()}
        outputs: list[F32] = self._session.run(self._outputs, contiguous)
        return outputs
