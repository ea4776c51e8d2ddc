"""Configuration of `lpac train`: TOML as frozen dataclasses, in model units and s."""

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
# Name of a folder and files.
FileName = Annotated[
    str,
    Meta(
        pattern=r"\A[A-Za-z0-9][A-Za-z0-9_.-]*\Z",
        description="letters, digits and _ . -; it begins with a letter or digit",
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
    """Raise ValueError unless `name` is a FileName."""
    require(FileName, name, "name")


def _require_ordered(**ranges: tuple[float, ...]) -> None:
    for name, (least, greatest) in ranges.items():
        if least > greatest:
            raise ValueError(f"{name} = {[least, greatest]}: must be [least, greatest]")


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldRanges(Bounded):
    """Worlds and swarms: each flight draws from [least, greatest] of each key.

    `weight` is the relative frequency of these worlds among all in the list.
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
    """Faults in training flights. Each flight draws from [least, greatest] of each key.

    `loss` is a message's probability of loss, `delay_s` its delay, `lag_s` the time constant of the
    velocity response, `position_bias` the standard deviation, in model units, of each robot's
    constant position error. `lost_robots` fail in flight; each returns with the probability
    `come_back`.
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
    """Flights of round 0, flown by the expert; `states` are kept of each flight.

    The expert soon reaches its goals, so short flights show most of its behaviour. `lloyd_runs` are
    those of the expert "best-of-lloyd". Imitated velocities may reach `overshoot` times max_speed,
    although no robot flies faster: where the expert's action is unpredictable, its mean is shorter
    than any single action, and overshoot keeps that mean fast.
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
    """Imitation of the expert: `epochs` over round 0, in batches of about `batch_robots`.

    `begin_with` is a checkpoint with initial weights, its path relative to the configuration;
    without it, weights are random. In each round the learning rate falls to zero along a cosine.
    `lost_messages` is the share of the graph's edges removed at random. `symmetries` mirrors and
    turns each state at random. `bf16` computes in bfloat16 on machines that support it.
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
    """Rounds in which the policy flies and the expert labels the states.

    The expert flies the share `expert_flights` of a round's `flights`. A round's initial learning
    rate is `learning_rate` times that of `fit`.
    """

    rounds: AtLeastZero = 0
    flights: AtLeastOne = 1
    duration_s: _Duration = 60.0
    epochs: AtLeastOne = 1
    expert_flights: Share = 0.0
    learning_rate: _LearningRate = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectConfig(Bounded):
    """Selection of the weights with the least mean final cost over validation worlds.

    Candidates fly over the first `worlds` of the set in each of `set_ups` (see `lpac evaluate`),
    with message loss `loss`, every `every_epochs` epochs and at the end of each round. The chosen
    policy also flies for `mission_s`, a battery's time, for the model card.
    """

    worlds: AtLeastOne = 20
    set_ups: Annotated[tuple[str, ...], Meta(min_length=1)] = ("field",)
    duration_s: _Duration = 60.0
    mission_s: _Duration = 300.0
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
    """The whole configuration; the policy family interprets `network`."""

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
    """A configuration, its network, and the file's text.

    `initial` are the weights from `fit.begin_with`; None for random ones.
    """

    config: TrainingConfig
    network: Learnable
    text: str
    initial: StateDict | None

    @property
    def digest(self) -> str:
        """Digest of the configuration without the number of rounds, which may grow later."""
        return config_digest(self.text)


def read_config(path: Path) -> ReadConfig:
    """Read a file. Raises ConfigError that names the file, the line or key, and what is allowed."""
    return config_of(read_toml_text(path), str(path), path.parent)


def config_of(text: str, where: str, folder: Path) -> ReadConfig:
    """Parse TOML with paths relative to `folder`. Raises ConfigError that begins with `where`."""
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
    """Digest that is equal for equal content, ignoring the number of DAgger rounds."""
    document = tomllib.loads(text)
    dagger = document.get("dagger")
    if isinstance(dagger, dict):
        dagger.pop("rounds", None)
    return hashlib.sha256(repr(_sorted(document)).encode()).hexdigest()


def _sorted(value: object) -> object:
    if isinstance(value, dict):
        return sorted((key, _sorted(each)) for key, each in value.items())
    return [_sorted(each) for each in value] if isinstance(value, list) else value
