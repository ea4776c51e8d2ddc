"""Verifies that this machine computes torch's outputs. Needs no torch: the bundle holds them."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from edge.core import F32
from edge.core.aggregation import HopBuffer
from edge.policy.family import GoldenCheck
from edge.policy.golden import Arrays, checks_of, relative_error
from edge.policy.lpac.graphs import Graphs

SWARM = "swarm"


def verify(graphs: Graphs, golden_file: bytes) -> Iterator[GoldenCheck]:
    """Run every graph on its golden inputs, then a swarm through its rounds of messages.

    Raises BundleError if the golden vectors cannot be read or do not fit the graphs.
    """

    def checks(golden: Arrays) -> Iterator[GoldenCheck]:
        for graph in graphs.lpac.graphs:
            output = graphs.run(graph, golden[f"{graph}/input"])
            yield GoldenCheck(graph, relative_error(output, golden[f"{graph}/output"]))
        velocities = swarm_velocities(
            graphs,
            golden[f"{SWARM}/neighbours"],
            golden[f"{SWARM}/features"],
            rounds=len(golden[f"{SWARM}/velocities"]) - 1,
        )
        yield GoldenCheck(SWARM, relative_error(velocities, golden[f"{SWARM}/velocities"]))

    return checks_of(golden_file, checks)


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
