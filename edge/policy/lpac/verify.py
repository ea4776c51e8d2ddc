"""Verifies that this machine computes torch's outputs. Needs no torch: the bundle holds them."""

import io
import zipfile
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from edge.core import F32
from edge.core.aggregation import HopBuffer
from edge.policy.bundle import BundleError
from edge.policy.family import GoldenCheck
from edge.policy.lpac.graphs import Graphs
from edge.policy.lpac.manifest import GOLDEN

SWARM = "swarm"
# The shipped policy's unpack to 0.3 MB.
_MAX_GOLDEN_BYTES = 2**24


def verify(graphs: Graphs, golden_file: bytes) -> Iterator[GoldenCheck]:
    """Run every graph on its golden inputs, then a swarm through its rounds of messages.

    Raises BundleError if the golden vectors cannot be read or do not fit the graphs.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(golden_file)) as archive:
            size = sum(info.file_size for info in archive.infolist())
        if size > _MAX_GOLDEN_BYTES:
            raise BundleError(
                f"{GOLDEN}: unpacks to {size} bytes; at most {_MAX_GOLDEN_BYTES} are allowed"
            )
        golden = dict(np.load(io.BytesIO(golden_file), allow_pickle=False))
        for graph in graphs.lpac.graphs:
            output = graphs.run(graph, golden[f"{graph}/input"])
            yield GoldenCheck(graph, _relative_error(output, golden[f"{graph}/output"]))
        velocities = swarm_velocities(
            graphs,
            golden[f"{SWARM}/neighbours"],
            golden[f"{SWARM}/features"],
            rounds=len(golden[f"{SWARM}/velocities"]) - 1,
        )
        yield GoldenCheck(SWARM, _relative_error(velocities, golden[f"{SWARM}/velocities"]))
    except KeyError as error:
        raise BundleError(f"{GOLDEN}: {error} is missing") from None
    except Exception as error:
        if isinstance(error, BundleError):
            raise
        raise BundleError(f"{GOLDEN}: does not fit the graphs: {error}") from None


def swarm_velocities(
    graphs: Graphs, neighbours: npt.NDArray[np.bool_], features: F32, rounds: int
) -> F32:
    """Velocities (rounds + 1, N, 2) of a swarm after 0, 1, .. synchronous exchanges of messages.

    `neighbours` (N, N) is the static graph, known to the robots from the start; `features` is
    (N, F_0). After K L rounds they equal those of the centralised network.
    """
    robots = range(len(features))
    buffers = [HopBuffer(graphs.geometry) for _ in robots]
    payloads: list[F32] | None = None
    velocities = np.empty((rounds + 1, len(features), 2), np.float32)
    for exchanged in range(rounds + 1):
        for i in robots:
            if payloads:
                received = [payloads[j] for j in np.flatnonzero(neighbours[i])]
                buffers[i].diffuse(received, degree=len(received))
            velocities[exchanged, i] = graphs.velocity(features[i : i + 1], buffers[i])[0]
        payloads = [buffers[i].message(int(neighbours[i].sum())) for i in robots]
    return velocities


def _relative_error(output: F32, golden: F32) -> float:
    """The largest error of a row over the row's largest value or a third of the overall largest.

    The row's value shows a weight that affects few rows. The third of the overall value keeps out
    rows that are mostly rounding because their parts cancel.
    """
    errors, sizes = (
        np.abs(values).reshape(len(golden), -1).max(axis=1)
        for values in (output.astype(np.float64) - golden, golden)
    )
    scales = np.maximum(sizes, sizes.max() / 3.0)
    with np.errstate(divide="ignore"):  # outputs of zero: any error is infinite
        ratios = np.divide(errors, scales, out=np.zeros_like(errors), where=errors != 0.0)
    return float(ratios.max())
