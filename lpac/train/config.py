"""Configuration of `lpac train`: TOML, as frozen dataclasses. Units are the model's, and s."""

import hashlib
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from edge.core.file_errors import in_words
from edge.core.frames import ModelScale
from edge.core.perception import PerceptionParameters
from edge.core.schema import (
    MAX_FLOAT,
    AtLeastOne,
    AtLeastZero,
    Bounded,
    ConfigError,
    NonNegative,
    Share,
    from_mapping,
    require,
)
from edge.core.toml import parse_toml, read_toml_text
from edge.core.world import MOST_FEATURES
from edge.policy.bundle import Training
from export.parameters import PolicyParameters
from lpac.sim.description import FIELD_SCALE
from lpac.sim.scenario import MAX_ROBOTS
from lpac.sim.ticks import Clocks
from lpac.study.worlds import SET_UPS
from lpac.train.family import Learnable, StateDict, learnable

ExpertName = Literal["clairvoyant-cvt", "best-of-lloyd", "exploring-cvt"]
# Of something that has files.
FileName = Annotated[
    str,
    Meta(
        pattern=r"\A[A-Za-z0-9][A-Za-z0-9_.-]*\Z",
        description="letters, digits and _ . -, the first of the two",
    ),
]
_Duration = Annotated[float, Meta(ge=1.0, le=3600.0)]
_LearningRate = Annotated[float, Meta(gt=0.0, le=1.0)]
_AboveOne = Annotated[float, Meta(ge=1.0, le=MAX_FLOAT)]
_Robots = Annotated[int, Meta(ge=1, le=MAX_ROBOTS)]
_LostRobots = Annotated[int, Meta(ge=0, le=MAX_ROBOTS - 1)]
_WorldSize = Annotated[int, Meta(ge=64, le=8192)]
_Features = Annotated[int, Meta(ge=1, le=MOST_FEATURES)]
_PAIR = Meta(min_length=2, max_length=2, description="[least, greatest]")


def require_name(name: str) -> None:
    """Of something that has files. Raises ValueError."""
    require(FileName, name, "name")


def _require_ordered(**ranges: tuple[float, ...]) -> None:
    for name, (least, greatest) in ranges.items():
        if least > greatest:
            raise ValueError(f"{name} = {[least, greatest]}: must be [least, greatest]")


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldRanges(Bounded):
    """Worlds, and the swarms in them: each flight draws from [least, greatest] of each.

    `weight` is how often these worlds are drawn, beside others.
    """

    weight: NonNegative = 1.0
    robots: Annotated[tuple[_Robots, ...], _PAIR] = (10, 10)
    world_size: Annotated[tuple[_WorldSize, ...], _PAIR] = (512, 512)
    communication_range: Annotated[tuple[_AboveOne, ...], _PAIR] = (256.0, 256.0)
    features: Annotated[tuple[_Features, ...], _PAIR] = (10, 10)
    sigma: Annotated[tuple[_AboveOne, ...], _PAIR] = (40.0, 60.0)

    def check_rules(self) -> None:
        _require_ordered(
            robots=self.robots,
            world_size=self.world_size,
            communication_range=self.communication_range,
            features=self.features,
            sigma=self.sigma,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Disturbances(Bounded):
    """Faults in training flights; each draws from [least, greatest].

    `loss` is the probability with which a message is lost, `delay_s` its way, `lag_s` the time
    constant with which velocities follow, `position_bias` the standard deviation of each robot's
    error in knowing its position, in model units. `lost_robots` fail in flight, each
    comes back with the probability `come_back`.
    """

    loss: Annotated[tuple[Share, ...], _PAIR] = (0.0, 0.0)
    delay_s: Annotated[tuple[NonNegative, ...], _PAIR] = (0.0, 0.0)
    lag_s: Annotated[tuple[NonNegative, ...], _PAIR] = (0.0, 0.0)
    position_bias: Annotated[tuple[NonNegative, ...], _PAIR] = (0.0, 0.0)
    lost_robots: Annotated[tuple[_LostRobots, ...], _PAIR] = (0, 0)
    come_back: Share = 0.0

    def check_rules(self) -> None:
        _require_ordered(
            loss=self.loss,
            delay_s=self.delay_s,
            lag_s=self.lag_s,
            position_bias=self.position_bias,
            lost_robots=self.lost_robots,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class DataConfig(Bounded):
    """The flights of the first data, which the expert flies; of every flight `states` are kept.

    The expert soon is where it wants to be: short flights show most of it. `lloyd_runs` are those
    of the expert "best-of-lloyd". Velocities that are imitated may be `overshoot` times max_speed,
    which nobody flies faster than: so the mean of what an expert does where it cannot be foretold,
    less than each of it, is still fast.
    """

    flights: AtLeastOne
    states: AtLeastOne = 20
    duration_s: _Duration = 20.0
    expert: ExpertName = "clairvoyant-cvt"
    lloyd_runs: AtLeastOne = 10
    overshoot: _AboveOne = 1.0
    scale: ModelScale = FIELD_SCALE
    clocks: Clocks = field(default_factory=Clocks)
    worlds: tuple[WorldRanges, ...] = (WorldRanges(),)
    disturbances: Disturbances = field(default_factory=Disturbances)

    def check_rules(self) -> None:
        if not sum(worlds.weight for worlds in self.worlds) > 0.0:
            raise ValueError("worlds: the weights must not all be 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class FitConfig(Bounded):
    """Imitation of the expert: `epochs` over the first data, in batches of about `batch_robots`.

    `begin_with` is a checkpoint that is trained on, its path from the configuration's folder; if
    there is none, weights are drawn.
    The learning rate falls to nothing along a cosine, in each round again. `lost_messages` is the
    share of the graph's edges that is left out at random; with `symmetries` each state is mirrored
    and turned at random. `bf16` computes in it where the machine does.
    """

    epochs: AtLeastOne
    batch_robots: Annotated[int, Meta(ge=2)] = 640
    learning_rate: _LearningRate = 1e-3
    weight_decay: NonNegative = 1e-4
    lost_messages: Share = 0.0
    symmetries: bool = True
    bf16: bool = True
    begin_with: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DaggerConfig(Bounded):
    """Rounds in which the policy flies, and the expert says what it should have done.

    Of the `flights` of a round the expert flies the share `expert_flights`. `learning_rate` is the
    share of fit's with which a round begins.
    """

    rounds: AtLeastZero = 0
    flights: AtLeastOne = 1
    duration_s: _Duration = 60.0
    epochs: AtLeastOne = 1
    expert_flights: Share = 0.0
    learning_rate: _LearningRate = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectConfig(Bounded):
    """Which weights are best: those that end with the least mean cost over validation worlds.

    They are flown over the first `worlds` of that set in each of `set_ups` (`lpac evaluate` has
    them), with messages lost, after every so many epochs and at the end of each round.
    """

    worlds: AtLeastOne = 20
    set_ups: Annotated[tuple[str, ...], Meta(min_length=1)] = ("field",)
    duration_s: _Duration = 60.0
    loss: Share = 0.0
    every_epochs: AtLeastOne = 5

    def check_rules(self) -> None:
        for name in self.set_ups:
            if name not in SET_UPS:
                raise ValueError(f"set_ups = {name!r}: allowed are {', '.join(SET_UPS)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportConfig(Bounded):
    """The policy's name and licence."""

    name: FileName
    licence: str = "MIT"


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingConfig(Bounded):
    """All of it; `network` is what the policy family understands."""

    perception: PerceptionParameters
    training: Training
    data: DataConfig
    network: dict[str, object]
    fit: FitConfig
    export: ExportConfig
    dagger: DaggerConfig = field(default_factory=DaggerConfig)
    select: SelectConfig = field(default_factory=SelectConfig)
    seed: AtLeastZero = 0

    @property
    def parameters(self) -> PolicyParameters:
        """Training parameters for the bundle."""
        return PolicyParameters(self.perception, self.training)


@dataclass(frozen=True, slots=True, eq=False)
class ReadConfig:
    """A configuration, the network that it describes, and the file's text.

    `initial` are the weights that training begins with, None for such as are drawn.
    """

    config: TrainingConfig
    network: Learnable
    text: str
    initial: StateDict | None

    @property
    def digest(self) -> str:
        """Of all that the configuration says but the number of rounds: more may follow."""
        return config_digest(self.text)


def read_config(path: Path) -> ReadConfig:
    """Raises ConfigError that names the file, the line or key, the value and what is allowed."""
    return config_of(read_toml_text(path), str(path), path.parent)


def config_of(text: str, where: str, folder: Path) -> ReadConfig:
    """Of TOML, whose paths are from that folder. Raises ConfigError that begins with `where`."""
    config = from_mapping(TrainingConfig, parse_toml(text, where), where)
    network = learnable(config.network, f"{where}: network")
    return ReadConfig(config, network, text, _initial(config, network, where, folder))


def _initial(
    config: TrainingConfig, network: Learnable, where: str, folder: Path
) -> StateDict | None:
    if config.fit.begin_with is None:
        return None
    checkpoint, where = folder / config.fit.begin_with, f"{where}: fit.begin_with"
    try:
        return network.initial(checkpoint.read_bytes(), str(checkpoint))
    except OSError as error:
        raise ConfigError(f"{where} = {str(checkpoint)!r}: {in_words(error)}") from None
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None


def config_digest(text: str) -> str:
    """Equal for texts that say the same, but for the number of DAgger rounds."""
    document = tomllib.loads(text)
    dagger = document.get("dagger")
    if isinstance(dagger, dict):
        dagger.pop("rounds", None)
    return hashlib.sha256(repr(_sorted(document)).encode()).hexdigest()


def _sorted(value: object) -> object:
    if isinstance(value, dict):
        return sorted((key, _sorted(each)) for key, each in value.items())
    return [_sorted(each) for each in value] if isinstance(value, list) else value
