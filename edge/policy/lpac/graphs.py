"""Runs a policy's ONNX graphs. The only module that imports onnxruntime."""

import os

import numpy as np

from edge.core import F32
from edge.core.aggregation import HopBuffer
from edge.policy.bundle import Bundle, BundleError
from edge.policy.lpac.manifest import ACTION, CNN, LpacManifest, gnn_graph

# Set before the import, or onnxruntime writes a telemetry database into the home directory.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"
import onnxruntime as ort


class Graphs:
    """A bundle's graphs, without state: safe to call from several threads."""

    def __init__(self, bundle: Bundle) -> None:
        """Load the graphs. Raises BundleError for a graph that does not fit the manifest."""
        self.manifest = bundle.manifest
        self.bundle_id = bytes.fromhex(bundle.id)
        self.lpac = LpacManifest.of(bundle.manifest)
        self.geometry, images = self.lpac.geometry, self.lpac.images
        geometry = self.geometry
        sizes, hops = geometry.feature_sizes, geometry.hops
        self._cnn = None
        if images:
            shape = (len(images.channels), images.size, images.size)
            self._cnn = _Graph(bundle, CNN, "images", shape, "features", (images.features,))
        self._layers = tuple(
            _Graph(
                bundle, gnn_graph(layer), "hops", (hops + 1, sizes[layer - 1]),
                "features", (sizes[layer],),
            )
            for layer in range(1, geometry.layers + 1)
        )  # fmt: skip
        self._action = _Graph(bundle, ACTION, "features", (sizes[-1],), "velocity", (2,))

    def run(self, graph: str, batch: F32) -> F32:
        """The output of a graph, given by file name, for a batch of inputs."""
        by_name = {g.name: g for g in (self._cnn, *self._layers, self._action) if g}
        return by_name[graph].run(batch)

    def image_features(self, images: F32) -> F32:
        """The CNN's features (n, F_0 - 2) of n robots' images (n, channels, size, size).

        Raises BundleError if the bundle was exported without perception.
        """
        if self._cnn is None:
            raise BundleError(f"bundle {self.manifest.name!r} has no perception (no {CNN})")
        return self._cnn.run(images)

    def velocity(self, features: F32, hops: HopBuffer) -> F32:
        """Actions (n, 2), in model units/s, of n robots with inputs x_i = `features` (n, F_0).

        `hops` holds y_kl for k = 1..K; y_0l is filled in here, layer by layer (paper, section
        "Decentralized Graph Neural Networks": z_l = sum over k of y_kl H_lk, x_l = ReLU(z_l)).
        """
        for graph, layer in zip(self._layers, hops.layers, strict=True):
            layer[:, 0] = features
            features = graph.run(layer)
        return self._action.run(features)


class _Graph:
    def __init__(
        self,
        bundle: Bundle,
        name: str,
        input_name: str,
        input_shape: tuple[int, ...],
        output_name: str,
        output_shape: tuple[int, ...],
    ) -> None:
        self.name = name
        options = ort.SessionOptions()
        # The board also runs the autopilot: no thread pool, no spinning.
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
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
        found = {
            kind: {value.name: tuple(value.shape[1:]) for value in values}
            for kind, values in (
                ("input", self._session.get_inputs()),
                ("output", self._session.get_outputs()),
            )
        }
        expected = {"input": {input_name: input_shape}, "output": {output_name: output_shape}}
        for kind, shapes in expected.items():
            if found[kind] != shapes:
                raise BundleError(
                    f"{name}: the {kind} is {found[kind]}; the manifest's geometry needs {shapes}"
                )
        self._input, self._outputs = input_name, [output_name]

    def run(self, batch: F32) -> F32:
        output: F32 = self._session.run(self._outputs, {self._input: np.ascontiguousarray(batch)})[
            0
        ]
        return output
