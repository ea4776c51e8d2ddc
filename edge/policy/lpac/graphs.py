"""Runs a policy's ONNX graphs."""

from edge.core import F32
from edge.core.aggregation import HopBuffer
from edge.policy.bundle import Bundle, BundleError
from edge.policy.graph import Graph
from edge.policy.lpac.manifest import ACTION, CNN, LpacManifest, gnn_graph

_BATCH = "batch"


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
            self._cnn = _BatchGraph(bundle, CNN, "images", shape, "features", (images.features,))
        self._layers = tuple(
            _BatchGraph(
                bundle, gnn_graph(layer), "hops", (hops + 1, sizes[layer - 1]),
                "features", (sizes[layer],),
            )
            for layer in range(1, geometry.layers + 1)
        )  # fmt: skip
        self._action = _BatchGraph(bundle, ACTION, "features", (sizes[-1],), "velocity", (2,))

    def run(self, graph: str, batch: F32) -> F32:
        """The output of a graph, given by file name, for a batch of inputs."""
        by_name = {g.name: g for g in (self._cnn, *self._layers, self._action) if g}
        return by_name[graph].of(batch)

    def image_features(self, images: F32) -> F32:
        """The CNN's features (n, F_0 - 2) of n robots' images (n, channels, size, size).

        Raises BundleError if the bundle was exported without perception.
        """
        if self._cnn is None:
            raise BundleError(f"bundle {self.manifest.name!r} has no perception (no {CNN})")
        return self._cnn.of(images)

    def velocity(self, features: F32, hops: HopBuffer) -> F32:
        """Actions (n, 2), in model units/s, of n robots with inputs x_i = `features` (n, F_0).

        `hops` holds y_kl for k = 1..K; y_0l is filled in here, layer by layer (paper, section
        "Decentralized Graph Neural Networks": z_l = sum over k of y_kl H_lk, x_l = ReLU(z_l)).
        """
        for graph, layer in zip(self._layers, hops.layers, strict=True):
            layer[:, 0] = features
            features = graph.of(layer)
        return self._action.of(features)


class _BatchGraph(Graph):
    """A graph with one input and one output, each with a free first dimension."""

    def __init__(
        self,
        bundle: Bundle,
        name: str,
        input_name: str,
        input_shape: tuple[int, ...],
        output_name: str,
        output_shape: tuple[int, ...],
    ) -> None:
        super().__init__(
            bundle,
            name,
            {input_name: (_BATCH, *input_shape)},
            {output_name: (_BATCH, *output_shape)},
        )
        self._input = input_name

    def of(self, batch: F32) -> F32:
        """The output for a batch of inputs."""
        [output] = self.run({self._input: batch})
        return output
