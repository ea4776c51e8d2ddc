"""Verifies that this machine computes torch's outputs. Needs no torch: the bundle holds them.

Arrays are named "<graph>/<case>/<input or output>", with the cases of a graph numbered from 0.
"""

from collections.abc import Iterator

import numpy as np

from edge.policy.family import GoldenCheck
from edge.policy.golden import Arrays, checks_of, relative_error
from edge.policy.graph import Graph
from edge.policy.network.manifest import NetworkManifest


def verify(
    encode: Graph, step: Graph, network: NetworkManifest, golden_file: bytes
) -> Iterator[GoldenCheck]:
    """Run both graphs on their golden inputs, with no, one and many neighbours.

    Raises BundleError if the golden vectors cannot be read or do not fit the graphs.
    """

    def checks(golden: Arrays) -> Iterator[GoldenCheck]:
        for name, graph, inputs, outputs in (
            ("encode", encode, network.encode, network.encode_outputs),
            ("step", step, network.step, network.step_outputs),
        ):
            number = len({key.split("/")[1] for key in golden if key.startswith(f"{name}/")})
            cases = [f"{name}/{case}" for case in range(number)]
            computed = [graph.run({key: golden[f"{at}/{key}"] for key in inputs}) for at in cases]
            for output, of_output in zip(outputs, zip(*computed, strict=True), strict=True):
                expected = [golden[f"{at}/{output}"] for at in cases]
                error = relative_error(np.stack(of_output), np.stack(expected))
                yield GoldenCheck(f"{name}: {output}", error, network.tolerance)

    return checks_of(golden_file, checks)
