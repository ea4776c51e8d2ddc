"""Configuration of `lpac ablate`, TOML as frozen dataclasses, and its trainings.

Compute is equal: each variant has as many flights, states, epochs, rounds and candidates as the
base. A variant without DAgger keeps the rounds, but the expert flies in them:
`dagger.expert_flights` = 1.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

import tomlkit

from edge.core.schema import ConfigError, from_mapping
from edge.core.toml import read_toml
from lpac.study.file import condition_of, merged
from lpac.study.study import BASELINES, Condition
from lpac.train.config import ReadConfig, TrainingConfig, config_of, require_name

BASE = "base"
# Keys of a training that variants must not change: amount of compute, and task.
_FIXED_KEYS = (
    "data.flights", "data.states", "data.duration_s", "fit.epochs", "dagger.rounds",
    "dagger.flights", "dagger.duration_s", "dagger.epochs", "select.worlds", "select.set_ups",
    "select.duration_s", "select.every_epochs", "perception.sensor_size",
    "training.max_speed", "training.idf_truncation", "training.idf_norm",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """A variant's difference from the base. `why` is a sentence for the report.

    `train` is merged into the base's configuration, `fly` into its condition. A variant without
    `train` flies the base's policies.
    """

    name: str
    why: str
    train: dict[str, object] = field(default_factory=dict)
    fly: dict[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_name(self.name)
        if self.name in (BASE, *BASELINES):
            raise ValueError(f"name = {self.name!r}: is reserved for the base and the baselines")
        if not self.why.strip() or "\n" in self.why.strip():
            raise ValueError(f"why = {self.why!r}: must be a sentence on one line")
        if not self.train and not self.fly:
            raise ValueError("train and fly are empty: set a key of at least one")


@dataclass(frozen=True, slots=True, kw_only=True)
class AblationConfig:
    """The file. `base` is the path of a training's configuration, relative to the file.

    `train` is merged into that configuration. `fly` has keys of a study's condition. Base and
    variants are trained with each of `seeds`, and flown over `worlds` worlds in `set_up`.
    """

    base: str
    variants: tuple[Variant, ...]
    seeds: tuple[int, ...] = (0, 1, 2)
    worlds: int = 40
    world_set: Literal["validation", "test"] = "validation"
    set_up: str = "field"
    duration_s: float = 60.0
    train: dict[str, object] = field(default_factory=dict)
    fly: dict[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = [variant.name for variant in self.variants]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"variants: name = {name!r}: is used twice")
        if not self.variants:
            raise ValueError("variants = []: must be one or more")
        if not self.seeds or len(set(self.seeds)) < len(self.seeds) or min(self.seeds) < 0:
            raise ValueError(
                f"seeds = {list(self.seeds)}: must be one or more, at least 0, each once"
            )
        if self.worlds < 1:
            raise ValueError(f"worlds = {self.worlds}: must be at least 1")
        if not 1.0 <= self.duration_s <= 3600.0:
            raise ValueError(f"duration_s = {self.duration_s}: must be from 1 to 3600")


@dataclass(frozen=True, slots=True, eq=False)
class PlannedTraining:
    """A training of the base or a variant; `name` is that of its folder and of its policy."""

    name: str
    seed: int
    read: ReadConfig


@dataclass(frozen=True, slots=True, eq=False)
class PlannedVariant:
    """The base or a variant; `trained` is False for variants that fly the base's policies."""

    name: str
    why: str
    trainings: tuple[PlannedTraining, ...]
    condition: Condition
    trained: bool


@dataclass(frozen=True, slots=True, eq=False)
class Ablation:
    """An ablation; the base is the first of `variants`."""

    config: AblationConfig
    variants: tuple[PlannedVariant, ...]

    @property
    def trainings(self) -> list[PlannedTraining]:
        """All trainings, each once."""
        return [each for variant in self.variants if variant.trained for each in variant.trainings]

    @property
    def worlds(self) -> range:
        """Numbers of the worlds, without those used to select weights."""
        select = self.variants[0].trainings[0].read.config.select
        first = select.worlds if self.config.world_set == "validation" else 0
        return range(first, first + self.config.worlds)


def read_ablation(path: Path) -> Ablation:
    """Read a file. Raises ConfigError that names the file, the line or key, and what is allowed."""
    config = from_mapping(AblationConfig, read_toml(path), str(path))
    _require_no_names(config.train, str(path))
    base_path = path.parent / config.base
    document = merged(read_toml(base_path), config.train)
    where = f"{path}: {BASE}"
    base = PlannedVariant(
        BASE,
        f"All parts: {base_path.name}.",
        _trainings(BASE, config.seeds, document, where, base_path.parent),
        _condition(config, BASE, {}, where, path.parent),
        trained=True,
    )
    variants = [base]
    for variant in config.variants:
        name, where, trainings = variant.name, f"{path}: {variant.name}", base.trainings
        if variant.train:
            _require_no_names(variant.train, where)
            changed = merged(document, variant.train)
            trainings = _trainings(name, config.seeds, changed, where, base_path.parent)
            _require_equal_compute(trainings[0].read.config, base.trainings[0].read.config, where)
        condition = _condition(config, name, variant.fly, where, path.parent)
        variants.append(
            PlannedVariant(name, variant.why, trainings, condition, trained=bool(variant.train))
        )
    return Ablation(config, tuple(variants))


def _condition(
    config: AblationConfig, name: str, fly: Mapping[str, object], where: str, folder: Path
) -> Condition:
    """Condition under which a variant flies."""
    keys = {"set_up": config.set_up, "duration_s": config.duration_s, "title": name}
    return condition_of({**keys, **merged(config.fly, fly)}, f"{where}: fly", folder)


def _trainings(
    variant: str, seeds: Sequence[int], document: Mapping[str, Any], where: str, folder: Path
) -> tuple[PlannedTraining, ...]:
    trainings = []
    for seed in seeds:
        name = f"{variant}-{seed}"
        own = merged(document, {"seed": seed, "export": {"name": name}})
        trainings.append(PlannedTraining(name, seed, config_of(tomlkit.dumps(own), where, folder)))
    return tuple(trainings)


def _require_no_names(train: Mapping[str, object], where: str) -> None:
    for key in ("seed", "export"):
        if key in train:
            raise ConfigError(f"{where}: train.{key}: must not be set: it follows from `seeds`")


def _require_equal_compute(config: TrainingConfig, base: TrainingConfig, where: str) -> None:
    for key in _FIXED_KEYS:
        value, allowed = attrgetter(key)(config), attrgetter(key)(base)
        if value != allowed:
            hint = "; dagger.expert_flights = 1 switches DAgger off" if "dagger" in key else ""
            raise ConfigError(
                f"{where}: train.{key} = {value}: must be the base's, {allowed}, for equal "
                f"compute{hint}"
            )
