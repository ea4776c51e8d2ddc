"""Keys of a bundle's manifest that belong to this family: the contract of the two graphs."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Literal

from msgspec import Meta

from edge.core.schema import AtLeastOne, Bounded, ConfigError, Positive, from_mapping
from edge.policy.bundle import BundleError, Manifest
from edge.policy.golden import GOLDEN
from edge.policy.graph import Shape
from edge.policy.images import EXPLORED, require_channels

NETWORK = "network"
ENCODE, STEP = "encode.onnx", "step.onnx"
# Name of the dimension of n neighbours, which may be 0.
NEIGHBOURS = "neighbours"

# Relative error that float32 rounding may reach.
MAX_TOLERANCE = 1e-3

_Size = Annotated[int, Meta(ge=0, le=2**20)]


@dataclass(frozen=True, slots=True)
class Array(Bounded):
    """Shape and unit of a graph's input or output, all float32.

    A dimension is a size, or "neighbours" for the number n of neighbours.
    """

    shape: Shape
    unit: str


@dataclass(frozen=True, slots=True)
class Maps(Bounded):
    """Images of `edge.policy.images`, for an `encode` with the input `maps`."""

    channels: tuple[str, ...]
    size: AtLeastOne

    def check_rules(self) -> None:
        require_channels(self.channels)


@dataclass(frozen=True, slots=True)
class TrainingRates(Bounded):
    """Rates at which the network was trained, Hz: of `encode` and of `step`."""

    encode_hz: Positive = 5.0
    step_hz: Positive = 2.5


@dataclass(frozen=True, slots=True)
class NetworkManifest(Bounded):
    """Description of a network: inputs and outputs of both graphs by name.

    A graph takes any of the inputs that `encode_inputs` and `step_inputs` list. Memory begins with
    zeros. `order` says whether a permutation of the neighbours, which come by robot id, changes the
    result. `tolerance` is the relative error allowed to the golden outputs: float32 rounding.
    """

    opset: int
    encode: dict[str, Array]
    step: dict[str, Array]
    features: Annotated[tuple[AtLeastOne, ...], Meta(min_length=1)]
    message_size: _Size
    memory_size: _Size
    tolerance: Annotated[float, Meta(gt=0.0, le=MAX_TOLERANCE)]
    maps: Maps | None = None
    rates: TrainingRates = TrainingRates()
    order: Literal["any", "by robot id"] = "any"
    action: Array = Array((2,), "model units/s")

    def check_rules(self) -> None:
        for key, given, known in (
            ("encode", self.encode, encode_inputs(self.maps)),
            ("step", self.step, step_inputs(self.features, self.message_size, self.memory_size)),
        ):
            for name, array in given.items():
                if known.get(name) != array:
                    raise ValueError(f"{key}.{name} = {array}: {_expected(name, known)}")
        if ("maps" in self.encode) != (self.maps is not None):
            raise ValueError("maps: must be given with the input maps of encode, and only then")
        if self.action != _ACTION:
            raise ValueError(f"action = {self.action}: must be {_ACTION}")

    @classmethod
    def of(cls, manifest: Manifest) -> "NetworkManifest":
        """Read the family's keys of the manifest. Raises BundleError if they are invalid."""
        where = f"bundle {manifest.name!r}"
        try:
            network = from_mapping(cls, manifest.parameters, where)
        except ConfigError as error:
            raise BundleError(str(error)) from None
        if manifest.perception is None:
            raise BundleError(f"{where}: perception is missing")
        explores = network.maps is not None and EXPLORED in network.maps.channels
        if manifest.perception.unseen_as_nan != explores:
            raise BundleError(
                f"{where}: perception.unseen_as_nan = {manifest.perception.unseen_as_nan}: "
                f"must be {explores}, by maps.channels"
            )
        expected = {ENCODE, STEP, GOLDEN}
        if set(manifest.files) != expected:
            raise BundleError(
                f"{where}: files = {', '.join(sorted(manifest.files))}: must be "
                f"{', '.join(sorted(expected))}"
            )
        return network

    @property
    def encode_outputs(self) -> dict[str, Shape]:
        """Shapes of the outputs of `encode`."""
        return {"features": self.features}

    @property
    def step_outputs(self) -> dict[str, Shape]:
        """Shapes of the outputs of `step`."""
        return step_outputs(self.message_size, self.memory_size)

    @property
    def parameters(self) -> dict[str, object]:
        """Value of `Manifest.parameters`."""
        return asdict(self)


_ACTION = Array((2,), "model units/s")


def encode_inputs(maps: Maps | None) -> dict[str, Array]:
    """Inputs that `encode` may take.

    `position` is the robot's in the world, each coordinate in [0, 1]; `velocity` is its own;
    `neighbours` are the positions, relative to the robot's, of the robots in range.
    """
    inputs = {
        "position": Array((2,), "world sizes"),
        "velocity": Array((2,), "model units/s"),
        "neighbours": Array((NEIGHBOURS, 2), "model units"),
    }
    if maps:
        shape = (len(maps.channels), maps.size, maps.size)
        inputs["maps"] = Array(shape, "importance; communication ranges; share of a cell")
    return inputs


def step_inputs(features: Shape, message_size: int, memory_size: int) -> dict[str, Array]:
    """Inputs that `step` may take.

    Row i of `messages`, `positions`, `velocities` and `ages` is of one neighbour: its message, its
    position when it sent that, relative to the robot's present one, its velocity then, and the
    greatest possible age of the message. `degree` also counts neighbours in range without a message
    this time. `memory` is the former step's.
    """
    return {
        "features": Array(features, "encode"),
        "messages": Array((NEIGHBOURS, message_size), "step"),
        "positions": Array((NEIGHBOURS, 2), "model units"),
        "velocities": Array((NEIGHBOURS, 2), "model units/s"),
        "ages": Array((NEIGHBOURS,), "s"),
        "degree": Array((), "robots"),
        "memory": Array((memory_size,), "step"),
    }


def step_outputs(message_size: int, memory_size: int) -> dict[str, Shape]:
    """Shapes of the outputs of `step`; a network without memory has no output for it."""
    outputs: dict[str, Shape] = {"action": _ACTION.shape, "message": (message_size,)}
    return outputs | ({"new_memory": (memory_size,)} if memory_size else {})


def _expected(name: str, known: Mapping[str, Array]) -> str:
    return f"must be {known[name]}" if name in known else f"known are {', '.join(known)}"
