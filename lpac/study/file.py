"""Studies as TOML files; see `Study` for what the keys mean."""

import itertools
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast, get_args, get_origin, get_type_hints

from edge.core.schema import ConfigError, from_mapping
from edge.core.world import parse_world
from lpac.shipped import SHIPPED_BUNDLE
from lpac.sim.baselines import BaselineName
from lpac.sim.engines import EngineName
from lpac.sim.failure import NONE_LOST, LostRobots
from lpac.sim.scenario import Scenario
from lpac.study.study import USUAL_FIGURES, Condition, Figure, Method, Study
from lpac.study.worlds import SET_UPS, WorldSet


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyFile:
    """A study as its file has it; paths count from the file's folder.

    `policies` are lists of bundles by name, one bundle for each training; the shipped policy flies
    if there are none. `scenario` has keys of `Scenario` and of `Condition`, and `set_up`, a name
    from `SET_UPS`, or `world`, the path of a world file. Each of `conditions` says what is
    otherwise: a list of values where there should be one means a condition for each of them, and
    several such lists one for each combination.
    """

    title: str = ""
    text: str = ""
    policies: dict[str, tuple[str, ...]] = field(default_factory=dict)
    baselines: tuple[BaselineName, ...] = ()
    world_set: WorldSet = "validation"
    first_world: int = 0
    worlds: int = 20
    scenario: dict[str, object] = field(default_factory=dict)
    conditions: tuple[dict[str, object], ...] = ({},)
    starts: Literal["own", "first"] = "own"
    trials: int = 1
    placed_within_m: float = 0.0
    receiver_error_m: tuple[float, float] | None = None
    figures: tuple[Figure, ...] = USUAL_FIGURES


@dataclass(frozen=True, slots=True, kw_only=True)
class ConditionKeys:
    """Keys of a condition that are none of its scenario's."""

    title: str = ""
    engine: EngineName = "point"
    from_pads: bool = False
    lost: str = ""
    methods: tuple[str, ...] = ()
    set_up: str = "field"
    world: str = ""


# Keys of a scenario that the study says.
_DRAWN = ("controller", "seed", "features", "scale")


def read_toml(path: Path) -> dict[str, Any]:
    """What a file holds. Raises ConfigError that names it."""
    try:
        return tomllib.loads(path.read_text("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: {error}") from None


def read_study(
    path: Path, px4_build: Path | None = None, bundle: Path | str = SHIPPED_BUNDLE
) -> Study:
    """The study in a file; `bundle` flies where a policy has no bundles of its own.

    Raises ConfigError that names file, key, value and what is allowed.
    """
    file, where = from_mapping(StudyFile, read_toml(path), str(path)), str(path)
    bundles = file.policies or ({} if file.baselines else {"field": ()})
    try:
        methods = [
            *(
                Method.of(name, *([path.parent / one for one in its] or [Path(bundle)]))
                for name, its in bundles.items()
            ),
            *map(Method.of, file.baselines),
        ]
    except ValueError as error:
        raise ConfigError(f"{where}: policies: {error}") from None
    for keys in _combinations(file.scenario):
        condition_of(keys, f"{where}: scenario", path.parent)
    conditions = [
        condition_of(
            {"title": _title(change), **keys}, f"{where}: conditions[{number}]", path.parent
        )
        for number, changes in enumerate(file.conditions)
        for change in _combinations(changes)
        for keys in _combinations(merged(file.scenario, change))
    ]
    try:
        return Study(
            methods=tuple(methods),
            conditions=tuple(dict.fromkeys(conditions)),
            world_set=file.world_set,
            first_world=file.first_world,
            worlds=file.worlds,
            title=file.title or path.stem,
            text=file.text,
            starts=file.starts,
            trials=file.trials,
            placed_within_m=file.placed_within_m,
            receiver_error_m=file.receiver_error_m,
            figures=file.figures,
            sizes_from=str(bundle),
            px4_build="" if px4_build is None else str(px4_build.resolve()),
        )
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None


def condition_of(keys: Mapping[str, object], where: str, folder: Path = Path()) -> Condition:
    """A condition by its keys and those of its scenario. Raises ConfigError."""
    own_names = [each.name for each in fields(ConditionKeys)]
    own = from_mapping(ConditionKeys, {k: v for k, v in keys.items() if k in own_names}, where)
    if own.set_up not in SET_UPS:
        raise ConfigError(f"{where}: set_up = {own.set_up!r}: allowed are {', '.join(SET_UPS)}")
    known = (*own_names, *(each.name for each in fields(Scenario) if each.name not in _DRAWN))
    for key in keys:
        if key not in known:
            raise ConfigError(f"{where}: unknown key {key!r}; known are {', '.join(known)}")
    set_up = SET_UPS[own.set_up]
    sizes = {
        "robots": set_up.robots,
        "world_size": set_up.world_size,
        "communication_range": float(set_up.communication_range),
        "random_feature_count": set_up.features,
        "random_feature_sigma": list(set_up.sigma),
    }
    others = {key: value for key, value in keys.items() if key not in own_names}
    scenario = from_mapping(Scenario, {**sizes, **others}, where)
    try:
        if own.world:
            path = folder / own.world
            features = parse_world(path.read_text("utf-8-sig"), str(path))
            scenario = replace(scenario, features=features)
        return Condition(
            scenario=scenario,
            engine=own.engine,
            from_pads=own.from_pads,
            lost=LostRobots.parse(own.lost) if own.lost else NONE_LOST,
            methods=own.methods,
            title=own.title,
        )
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None


def _title(change: Mapping[str, Any]) -> str:
    """What is otherwise, for people; nothing if nothing is."""
    parts = []
    for key, value in change.items():
        said = f"{value:g}" if isinstance(value, float) else f"{value}"
        said = _title(value) if isinstance(value, Mapping) else said
        parts.append(said if key == "set_up" else f"{key} {said}")
    return ", ".join(parts)


def merged(keys: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Tables key by key; all else replaces what was."""
    told = dict(keys)
    for key, value in changes.items():
        old = told.get(key)
        both_tables = isinstance(old, Mapping) and isinstance(value, Mapping)
        told[key] = merged(told[key], value) if both_tables else value
    return told


def _combinations(keys: Mapping[str, Any], cls: type = Scenario) -> Iterator[dict[str, Any]]:
    """One for each combination of the values in lists that stand where one value should."""
    hints = {**get_type_hints(ConditionKeys), **get_type_hints(cls)}
    choices: list[list[tuple[str, Any]]] = []
    for key, value in keys.items():
        hint = hints.get(key)
        if isinstance(value, list) and not _is_of_lists(hint):
            choices.append([(key, each) for each in value])
        elif isinstance(value, Mapping) and is_dataclass(hint):
            choices.append([(key, each) for each in _combinations(value, cast(type, hint))])
        else:
            choices.append([(key, value)])
    return map(dict, itertools.product(*choices))


def _is_of_lists(hint: Any) -> bool:
    """Whether a field's type has a list for its value."""
    return any(get_origin(each) is tuple for each in (hint, *get_args(hint)))
