"""Fit the detector to rendered images, and write its graph: `python -m lpac_camera.fit`.

Of each pixel the share that flowers fill is known, since the ground was made. What is fitted, by
least squares, is a linear function of the colours of the pixel and its eight neighbours: it is
linear so that a pixel which shows flowers and meadow gets what it has of each, from any height.
Then it is scaled so that its means are those of the importance.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

from edge.core import F32, F64
from edge.core.world import rasterize
from lpac.analysis.worlds import random_features
from lpac_camera.detector import GRAPH, MARGIN
from lpac_camera.ground import COVER_AT_ONE, Ground
from lpac_camera.pinhole import Pinhole

_WORLDS, _IMAGES = 4, 15
_WORLD_SIZE = 256
# From landing to the field's higher robots, model units.
_HEIGHTS = (32.0, 250.0)
_PIECE = 22
# Not those that anybody tests with.
_SEED = 1_000_000
OPSET = 17


class Example(NamedTuple):
    """An image, and what is true of its inner pixels: (rows - 2, columns - 2)."""

    image: npt.NDArray[np.uint8]
    flowers: F32
    importance: F32


def examples() -> Iterator[Example]:
    """Images of worlds that nobody flies in."""
    rng = np.random.default_rng(_SEED)
    camera = Pinhole()
    inner = slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN)
    for world in range(_WORLDS):
        features = random_features(rng, 3, _WORLD_SIZE, (20.0, 30.0))
        ground = Ground(rasterize(features, _WORLD_SIZE), _SEED + world)
        for _ in range(_IMAGES):
            height = rng.uniform(*_HEIGHTS)
            # All of the image shows the world.
            margin = camera.pixel(height) * camera.columns / 2.0
            position = rng.uniform(margin, _WORLD_SIZE - margin, 2)
            yield Example(
                ground.photograph(camera, position, height, rng),
                ground.cover(camera, position, height)[inner] / np.float32(COVER_AT_ONE),
                ground.shown_importance(camera, position, height)[inner],
            )


def fitted(shown: Sequence[Example]) -> F64:
    """(28,): weights of a 3 x 3 neighbourhood's channels, [channel, row, column], and a bias."""
    normal, wanted = np.zeros((28, 28)), np.zeros(28)
    for image, flowers, _ in shown:
        rows = _rows(image)
        normal += rows.T @ rows
        wanted += rows.T @ flowers.ravel()
    # Neighbouring pixels are alike; a little ridge keeps their weights small.
    weights = np.linalg.solve(normal + 1e-4 * np.trace(normal) / 28 * np.eye(28), wanted)
    # Least squares lean towards the mean where colours tell little: undone, over larger pieces.
    said, true = (
        np.concatenate([_pieces(values) for values in each])
        for each in (
            [(_rows(e.image) @ weights).reshape(e.importance.shape) for e in shown],
            [e.importance for e in shown],
        )
    )
    slope, offset = np.polyfit(true, said, 1)
    weights[-1] -= offset
    result: F64 = weights / slope
    return result


def _rows(image: npt.NDArray[np.uint8]) -> F64:
    """(pixels, 28): what the convolution sees of each inner pixel, and 1."""
    around = np.lib.stride_tricks.sliding_window_view(image / 255.0, (3, 3), axis=(0, 1))
    return np.concatenate([around.reshape(-1, 27), np.ones((around[..., 0, 0, 0].size, 1))], 1)


def _pieces(values: F32 | F64) -> F64:
    """The means of pieces of `_PIECE` x `_PIECE` pixels."""
    rows, columns = (size // _PIECE for size in values.shape)
    whole = values[: rows * _PIECE, : columns * _PIECE]
    means: F64 = whole.reshape(rows, _PIECE, columns, _PIECE).mean(axis=(1, 3)).ravel()
    return means


def graph(weights: F64) -> onnx.ModelProto:
    """The convolution as an ONNX model."""
    kernel: F32 = weights[:27].reshape(1, 3, 3, 3).astype(np.float32)
    bias: F32 = weights[27:].astype(np.float32)
    node = helper.make_node("Conv", ["image", "kernel", "bias"], ["importance"])
    model = helper.make_model(
        helper.make_graph(
            [node],
            "flowers",
            [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, "rows", "columns"])],
            [helper.make_tensor_value_info("importance", TensorProto.FLOAT, [1, 1, None, None])],
            [numpy_helper.from_array(kernel, "kernel"), numpy_helper.from_array(bias, "bias")],
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=8,
        producer_name="lpac-camera",
    )
    onnx.checker.check_model(model, full_check=True)
    return model


def main() -> None:
    """Fit, and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=GRAPH, help="the file to write")
    out: Path = parser.parse_args().out
    out.write_bytes(graph(fitted(list(examples()))).SerializeToString())
    print(f"{out}: {out.stat().st_size} bytes")


if __name__ == "__main__":
    main()
