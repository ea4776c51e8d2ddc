"""What `lpac train` is told: a TOML file, as frozen dataclasses. Units are the model's, and s."""

import hashlib
import math
import re
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from edge.core.file_errors import in_words
from edge.core.frames import ModelScale
from edge.core.perception import PerceptionParameters
from edge.core.schema import ConfigError, from_mapping
from edge.core.world import MOST_FEATURES
from edge.policy.bundle import Training
from export.parameters import PolicyParameters
from lpac.evaluate.worlds import SET_UPS
from lpac.sim.description import FIELD_SCALE
from lpac.sim.scenario import MAX_ROBOTS
from lpac.sim.ticks import Clocks
from lpac.train.family import Learnable, StateDict, learnable

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")

ExpertName = Literal["clairvoyant-cvt", "best-of-lloyd", "exploring-cvt"]


def require_name(name: str) -> None:
    """Of something that has files. Raises ValueError."""
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"name = {name!r}: must be letters, digits and _ . -, the first of the two"
        )


def _at_least(least: float, **values: float) -> None:
    for name, value in values.items():
        if not least <= value < math.inf:
            raise ValueError(f"{name} = {value}: must be at least {least:g} and finite")


def _share(**values: float) -> None:
    for name, value in values.items():
        if not 0.0 <= value <= 1.0:
            raise ValueError(f"{name} = {value}: must be from 0 to 1")


def _duration(duration_s: float) -> None:
    if not 1.0 <= duration_s <= 3600.0:
        raise ValueError(f"duration_s = {duration_s}: must be from 1 to 3600")


def _range(least: float, most: float = math.inf, **ranges: tuple[float, ...]) -> None:
    for name, values in ranges.items():
        if len(values) != 2 or not least <= values[0] <= values[1] <= most or values[1] == math.inf:
            upto = "" if most == math.inf else f" and at most {most:g}"
            raise ValueError(
                f"{name} = {list(values)}: must be [least, greatest], at least {least:g}{upto}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldRanges:
    """Worlds, and the swarms in them: each flight draws from [least, greatest] of each.

    `weight` is how often these worlds are drawn, beside others.
    """

    weight: float = 1.0
    robots: tuple[int, ...] = (10, 10)
    world_size: tuple[int, ...] = (512, 512)
    communication_range: tuple[float, ...] = (256.0, 256.0)
    features: tuple[int, ...] = (10, 10)
    sigma: tuple[float, ...] = (40.0, 60.0)

    def __post_init__(self) -> None:
        _at_least(0.0, weight=self.weight)
        _range(1, MAX_ROBOTS, robots=self.robots)
        _range(64, 8192, world_size=self.world_size)
        _range(1.0, communication_range=self.communication_range)
        _range(1, MOST_FEATURES, features=self.features)
        _range(1.0, sigma=self.sigma)


@dataclass(frozen=True, slots=True, kw_only=True)
class Disturbances:
    """What goes wrong in flights; each draws from [least, greatest].

    `loss` is the probability with which a message is lost, `delay_s` its way, `lag_s` the time
    constant with which velocities follow, `position_bias` the standard deviation of each robot's
    error in knowing its position, in model units. `lost_robots` fail in flight, each
    comes back with the probability `come_back`.
    """

    loss: tuple[float, ...] = (0.0, 0.0)
    delay_s: tuple[float, ...] = (0.0, 0.0)
    lag_s: tuple[float, ...] = (0.0, 0.0)
    position_bias: tuple[float, ...] = (0.0, 0.0)
    lost_robots: tuple[int, ...] = (0, 0)
    come_back: float = 0.0

    def __post_init__(self) -> None:
        _range(0.0, 1.0, loss=self.loss)
        _range(0.0, delay_s=self.delay_s, lag_s=self.lag_s, position_bias=self.position_bias)
        _range(0, MAX_ROBOTS - 1, lost_robots=self.lost_robots)
        _share(come_back=self.come_back)


@dataclass(frozen=True, slots=True, kw_only=True)
class DataConfig:
    """The flights of the first data, which the expert flies; of every flight `states` are kept.

    The expert soon is where it wants to be: short flights show most of it. `lloyd_runs` are those
    of the expert "best-of-lloyd". Velocities that are imitated may be `overshoot` times max_speed,
    which nobody flies faster than: so the mean of what an expert does where it cannot be foretold,
    less than each of it, is still fast.
    """

    flights: int
    states: int = 20
    duration_s: float = 20.0
    expert: ExpertName = "clairvoyant-cvt"
    lloyd_runs: int = 10
    overshoot: float = 1.0
    scale: ModelScale = FIELD_SCALE
    clocks: Clocks = field(default_factory=Clocks)
    worlds: tuple[WorldRanges, ...] = (WorldRanges(),)
    disturbances: Disturbances = field(default_factory=Disturbances)

    def __post_init__(self) -> None:
        _at_least(1, flights=self.flights, states=self.states, lloyd_runs=self.lloyd_runs)
        _at_least(1, overshoot=self.overshoot)
        _duration(self.duration_s)
        if not sum(worlds.weight for worlds in self.worlds) > 0.0:
            raise ValueError("worlds: the weights must not all be 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class FitConfig:
    """Imitation of the expert: `epochs` over the first data, in batches of about `batch_robots`.

    `begin_with` is a checkpoint that is trained on, its path from the configuration's folder; if
    there is none, weights are drawn.
    The learning rate falls to nothing along a cosine, in each round again. `lost_messages` is the
    share of the graph's edges that is left out at random; with `symmetries` each state is mirrored
    and turned at random. `bf16` computes in it where the machine does.
    """

    epochs: int
    batch_robots: int = 640
    learning_rate: float = 1e-3
    weight_decay: float = 1e-4
    lost_messages: float = 0.0
    symmetries: bool = True
    bf16: bool = True
    begin_with: str | None = None

    def __post_init__(self) -> None:
        _at_least(1, epochs=self.epochs)
        _at_least(2, batch_robots=self.batch_robots)
        _at_least(0.0, weight_decay=self.weight_decay)
        if not 0.0 < self.learning_rate <= 1.0:
            raise ValueError(f"learning_rate = {self.learning_rate}: must be above 0 and at most 1")
        _share(lost_messages=self.lost_messages)


@dataclass(frozen=True, slots=True, kw_only=True)
class DaggerConfig:
    """Rounds in which the policy flies, and the expert says what it should have done.

    Of the `flights` of a round the expert flies the share `expert_flights`. `learning_rate` is the
    share of fit's with which a round begins.
    """

    rounds: int = 0
    flights: int = 1
    duration_s: float = 60.0
    epochs: int = 1
    expert_flights: float = 0.0
    learning_rate: float = 0.5

    def __post_init__(self) -> None:
        _at_least(0, rounds=self.rounds)
        _at_least(1, flights=self.flights, epochs=self.epochs)
        _duration(self.duration_s)
        _share(expert_flights=self.expert_flights)
        if not 0.0 < self.learning_rate <= 1.0:
            raise ValueError(f"learning_rate = {self.learning_rate}: must be above 0 and at most 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectConfig:
    """Which weights are best: those that end with the least mean cost over validation worlds.

    They are flown over the first `worlds` of that set in each of `set_ups` (`lpac evaluate` has
    them), with messages lost, after every so many epochs and at the end of each round.
    """

    worlds: int = 20
    set_ups: tuple[str, ...] = ("field",)
    duration_s: float = 60.0
    loss: float = 0.0
    every_epochs: int = 5

    def __post_init__(self) -> None:
        _at_least(1, worlds=self.worlds, every_epochs=self.every_epochs)
        _duration(self.duration_s)
        _share(loss=self.loss)
        if not self.set_ups:
            raise ValueError("set_ups = []: must be one or more")
        for name in self.set_ups:
            if name not in SET_UPS:
                raise ValueError(f"set_ups = {name!r}: allowed are {', '.join(SET_UPS)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportConfig:
    """What the policy is called, and under what licence it is."""

    name: str
    licence: str = "MIT"

    def __post_init__(self) -> None:
        require_name(self.name)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingConfig:
    """All of it; `network` is what the policy family understands."""

    perception: PerceptionParameters
    training: Training
    data: DataConfig
    network: dict[str, object]
    fit: FitConfig
    export: ExportConfig
    dagger: DaggerConfig = field(default_factory=DaggerConfig)
    select: SelectConfig = field(default_factory=SelectConfig)
    seed: int = 0

    def __post_init__(self) -> None:
        _at_least(0, seed=self.seed)

    @property
    def parameters(self) -> PolicyParameters:
        """What the bundle says that the policy was trained with."""
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


def read_toml(path: Path) -> str:
    """The text of a file that is TOML. Raises ConfigError that names the file, and the line."""
    try:
        text = path.read_text("utf-8-sig")
        tomllib.loads(text)
    except OSError as error:
        raise ConfigError(f"{path}: {in_words(error)}") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is not UTF-8 text, expected TOML") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: is not TOML: {error}") from None
    return text


def read_config(path: Path) -> ReadConfig:
    """Raises ConfigError that names the file, the line or key, the value and what is allowed."""
    return config_of(read_toml(path), str(path), path.parent)


def config_of(text: str, where: str, folder: Path) -> ReadConfig:
    """Of TOML, whose paths are from that folder. Raises ConfigError that begins with `where`."""
    config = from_mapping(TrainingConfig, tomllib.loads(text), where)
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
