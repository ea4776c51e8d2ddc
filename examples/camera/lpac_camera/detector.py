"""The detector: an image in, importance per pixel out, by an ONNX graph.

`detector.onnx` is one 3 x 3 convolution, fitted by `python -m lpac_camera.fit`. Its input `image`
is (1, 3, rows, columns), red, green, blue from 0 to 1; its output `importance` is (1, 1, rows - 2,
columns - 2): the outermost pixels have no neighbours to look at. A pixel's value is noise around
the truth, below 0 too; only the mean of many means anything.
"""

import os
from pathlib import Path

import numpy as np
import numpy.typing as npt

from edge.core import F32

# onnxruntime writes a telemetry database into the home directory unless told so before its import.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"
import onnxruntime as ort

GRAPH = Path(__file__).with_name("detector.onnx")
# Pixels that the output lacks at each side.
MARGIN = 1


class Detector:
    """Runs a detector's graph on one thread."""

    def __init__(self, graph: Path = GRAPH) -> None:
        """Raises ValueError for a file that is no such graph, OSError if there is none."""
        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        data = graph.read_bytes()
        try:
            self._session = ort.InferenceSession(data, options, ["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors have no common base below Exception
            raise ValueError(
                f"{graph}: is not a graph that onnxruntime can load: {error}"
            ) from None

    def importance(self, image: npt.NDArray[np.uint8]) -> F32:
        """(rows - 2, columns - 2) of an image (rows, columns, 3)."""
        channels = np.moveaxis(image, -1, 0)[None].astype(np.float32) / np.float32(255.0)
        (found,) = self._session.run(["importance"], {"image": channels})
        importance: F32 = found[0, 0]
        return importance
