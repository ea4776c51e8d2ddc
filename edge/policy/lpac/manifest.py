"""Keys of a bundle's manifest that belong to this family."""

from dataclasses import asdict, dataclass
from typing import Literal

from edge.core.aggregation import Geometry
from edge.core.schema import AtLeastOne, Bounded, ConfigError, from_mapping
from edge.policy.bundle import LPAC, BundleError, Manifest
from edge.policy.golden import GOLDEN
from edge.policy.images import EXPLORED, require_channels

CNN = "cnn.onnx"
ACTION = "action.onnx"


def gnn_graph(layer: int) -> str:
    """File name of GNN layer `layer` = 1..L."""
    return f"gnn_{layer}.onnx"


@dataclass(frozen=True, slots=True)
class Images(Bounded):
    """Inputs and outputs of the CNN."""

    channels: tuple[str, ...]
    size: AtLeastOne
    features: AtLeastOne
    activation: Literal["leaky_relu_0.01"] = "leaky_relu_0.01"
    padding: Literal["none"] = "none"

    def check_rules(self) -> None:
        require_channels(self.channels)


@dataclass(frozen=True, slots=True)
class LpacManifest:
    """Description of the network. `images` is None in a bundle without perception."""

    opset: int
    geometry: Geometry
    images: Images | None

    def __post_init__(self) -> None:
        if self.images and self.geometry.feature_sizes[0] != self.images.features + 2:
            raise ValueError(
                f"geometry.feature_sizes[0] = {self.geometry.feature_sizes[0]}: must be "
                f"images.features + 2 = {self.images.features + 2}"
            )

    @classmethod
    def of(cls, manifest: Manifest) -> "LpacManifest":
        """Read the family's keys of the manifest. Raises BundleError if they are invalid."""
        where = f"bundle {manifest.name!r}"
        if manifest.family != LPAC:
            raise BundleError(f"{where}: its family is {manifest.family!r}, not {LPAC!r}")
        try:
            lpac = from_mapping(cls, manifest.parameters, where)
        except ConfigError as error:
            raise BundleError(str(error)) from None
        if (lpac.images is None) != (manifest.perception is None):
            raise BundleError(f"{where}: images and perception must be given together")
        if lpac.images and manifest.perception:
            explores = EXPLORED in lpac.images.channels
            if manifest.perception.unseen_as_nan != explores:
                raise BundleError(
                    f"{where}: perception.unseen_as_nan = {manifest.perception.unseen_as_nan}: "
                    f"must be {explores}, by images.channels"
                )
        expected = {*lpac.graphs, GOLDEN}
        if set(manifest.files) != expected:
            raise BundleError(
                f"{where}: files = {', '.join(sorted(manifest.files))}: must be "
                f"{', '.join(sorted(expected))}"
            )
        return lpac

    @property
    def parameters(self) -> dict[str, object]:
        """Value of `Manifest.parameters`."""
        return asdict(self)

    @property
    def graphs(self) -> tuple[str, ...]:
        """The graphs' file names, in the order of computation."""
        layers = (gnn_graph(layer) for layer in range(1, self.geometry.layers + 1))
        return (*((CNN,) if self.images else ()), *layers, ACTION)
