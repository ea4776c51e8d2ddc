"""Reads studies from TOML files; `Study` defines the keys."""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, cast, get_args, get_origin, get_type_hints

from msgspec import Meta

from edge.core.schema import Bounded, ConfigError, from_mapping
from edge.core.toml import read_toml
from edge.core.world import parse_world
from lpac.shipped import SHIPPED_BUNDLE
from lpac.sim.baselines import BaselineName
from lpac.sim.engines import EngineName
from lpac.sim.failure import NONE_LOST, LostRobots
from lpac.sim.scenario import Scenario
from lpac.study.study import (
    USUAL_FIGURES,
    Condition,
    ConditionError,
    Figure,
    Method,
    Misplaced,
    Study,
    Trials,
    WorldNumber,
    Worlds,
)
from lpac.study.worlds import SET_UPS, WorldSet


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyFile(Bounded):
    """A study as in its file; paths are relative to the file's folder.

    Without policies and baselines, the shipped policy flies. `scenario` and each of `conditions`
    have keys of `ConditionKeys` and of `Scenario`. In a condition, a list in place of a single
    value gives one condition per value; several lists give all combinations.
    """

    title: Annotated[str, "Title of the report; by default the file's name."] = ""
    text: Annotated[str, "Introduction of the report."] = ""
    policies: Annotated[
        dict[str, tuple[str, ...]],
        "Paths of bundles by name, one per training; [] is the shipped one.",
    ] = field(default_factory=dict)
    baselines: Annotated[
        tuple[BaselineName, ...], "In addition to clairvoyant-cvt, which always flies."
    ] = ()
    world_set: Annotated[WorldSet, "Use test only once."] = "validation"
    first_world: Annotated[WorldNumber, "Number of the first world of the set."] = 0
    worlds: Annotated[Worlds, "Number of worlds."] = 20
    starts: Annotated[
        Literal["own", "first"],
        "Each world has its own starts, or all have those of the first world.",
    ] = "own"
    trials: Annotated[Trials, "Flights over each world."] = 1
    placed_within_m: Annotated[
        Misplaced, "Maximum distance of each trial's starts from the world's, m."
    ] = 0.0
    receiver_error_m: Annotated[
        tuple[Misplaced, Misplaced] | None,
        "[least, greatest]: constant error of points' positions in a trial, m.",
    ] = None
    scenario: Annotated[dict[str, object], "Common to all flights: see below."] = field(
        default_factory=dict
    )
    conditions: Annotated[
        tuple[dict[str, object], ...], Meta(min_length=1), "Differences: see below."
    ] = ({},)
    figures: Annotated[tuple[Figure, ...], "Figures to draw."] = USUAL_FIGURES


@dataclass(frozen=True, slots=True, kw_only=True)
class ConditionKeys(Bounded):
    """Keys of a condition in addition to its scenario's."""

    title: Annotated[str, "Name in figures and tables; by default its differences."] = ""
    engine: Annotated[
        EngineName,
        "What flies the policies: points; whole robots on one simulated clock; a program for each "
        "robot in real time, on simulated vehicles or on real PX4s (--px4).",
    ] = "point"
    from_pads: Annotated[
        bool, "Points start on whole robots' pads, with the same position errors."
    ] = False
    lost: Annotated[str, "Points lost in flight, ROBOTS@SECONDS, such as 2@20."] = ""
    methods: Annotated[
        Annotated[tuple[str, ...], Meta(min_length=1)] | None,
        "Names of the methods that fly it; by default all.",
    ] = None
    set_up: Annotated[str, "Team and world that other keys modify: field, n32, paper, ..."] = (
        "field"
    )
    world: Annotated[str, "Path of a world file; by default worlds are drawn."] = ""


# Keys of a scenario that the study sets.
DRAWN = ("controller", "seed", "features", "scale")


def read_study(
    path: Path, px4_build: Path | None = None, bundle: Path | str = SHIPPED_BUNDLE
) -> Study:
    """Read a study; `bundle` flies for policies without bundles.

    Raises ConfigError that names file, key, value and what is allowed.
    """
    file, where = from_mapping(StudyFile, read_toml(path), str(path)), str(path)
    bundles = file.policies or ({} if file.baselines else {"field": ()})
    try:
        methods = [
            *(
                Method.of(name, *([path.parent / one for one in paths] or [Path(bundle)]))
                for name, paths in bundles.items()
            ),
            *map(Method.of, file.baselines),
        ]
    except ValueError as error:
        raise ConfigError(f"{where}: policies: {error}") from None
    for keys in _combinations(file.scenario, f"{where}: scenario"):
        condition_of(keys, f"{where}: scenario", path.parent)
    # Equal conditions are flown once.
    places: dict[Condition, str] = {}
    for number, changes in enumerate(file.conditions):
        place, whole = f"{where}: conditions[{number}]", merged(file.scenario, changes)
        place = place if file.conditions != ({},) else f"{where}: scenario"
        for keys in _combinations(whole, place):
            titled = {**keys, "title": _title(keys, whole, changes)}
            places.setdefault(condition_of(titled, place, path.parent), place)
    try:
        return Study(
            methods=tuple(methods),
            conditions=tuple(places),
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
    except ConditionError as error:
        raise ConfigError(f"{places[error.condition]}: {error}") from None
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None


def condition_of(keys: Mapping[str, object], where: str, folder: Path = Path()) -> Condition:
    """Make a condition from its own keys and those of its scenario. Raises ConfigError."""
    own_names = [each.name for each in fields(ConditionKeys)]
    own = from_mapping(ConditionKeys, {k: v for k, v in keys.items() if k in own_names}, where)
    if own.set_up not in SET_UPS:
        raise ConfigError(f"{where}: set_up = {own.set_up!r}: allowed are {', '.join(SET_UPS)}")
    known = (*own_names, *(each.name for each in fields(Scenario) if each.name not in DRAWN))
    for key in keys:
        if key not in known:
            raise ConfigError(f"{where}: unknown key {key!r}; known are {', '.join(known)}")
    others = {key: value for key, value in keys.items() if key not in own_names}
    scenario = from_mapping(Scenario, {**SET_UPS[own.set_up].sizes, **others}, where)
    try:
        if own.world:
            path = folder / own.world
            features = parse_world(path.read_text("utf-8-sig"), str(path))
            scenario = replace(scenario, features=features)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{where}: world = {own.world!r}: {error}") from None
    try:
        return Condition(
            scenario=scenario,
            engine=own.engine,
            from_pads=own.from_pads,
            lost=LostRobots.parse(own.lost) if own.lost else NONE_LOST,
            methods=own.methods or (),
            title=own.title,
        )
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None


def _title(keys: Mapping[str, Any], whole: Mapping[str, Any], changes: Mapping[str, Any]) -> str:
    """The given title and the condition's differences; "" without either."""
    given = keys.get("title", "")
    changed = _differences(keys, whole, {} if given else changes)
    return ", ".join(filter(None, [given, _text_of({**changed, "title": ""})]))


def _differences(
    keys: Mapping[str, Any], whole: Mapping[str, Any], changes: Mapping[str, Any]
) -> dict[str, Any]:
    """Keys of one combination of `whole` that are in lists or `changes`."""
    differing = {}
    for key, value in keys.items():
        if isinstance(value, Mapping):
            differing[key] = _differences(value, whole[key], changes.get(key, {}))
        elif key in changes or value != whole[key]:
            differing[key] = value
    return differing


def _text_of(keys: Mapping[str, Any]) -> str:
    """Text of keys and values."""
    parts = []
    for key, value in keys.items():
        text = f"{value:g}" if isinstance(value, float) else f"{value}"
        text = _text_of(value) if isinstance(value, Mapping) else text
        if text:
            parts.append(text if key == "set_up" else f"{key} {text}")
    return ", ".join(parts)


def merged(keys: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Merge tables key by key; other values are replaced."""
    result = dict(keys)
    for key, value in changes.items():
        old = result.get(key)
        both_tables = isinstance(old, Mapping) and isinstance(value, Mapping)
        result[key] = merged(result[key], value) if both_tables else value
    return result


def _combinations(
    keys: Mapping[str, Any], where: str, cls: type = Scenario
) -> Iterator[dict[str, Any]]:
    """Yield each combination of the values in lists that replace single values.

    Raises ConfigError for an empty list.
    """
    hints = {**get_type_hints(ConditionKeys), **get_type_hints(cls)}
    choices: list[list[tuple[str, Any]]] = []
    for key, value in keys.items():
        hint = hints.get(key)
        if value == [] and not _is_of_lists(hint):
            raise ConfigError(f"{where}: {key} = []: must have at least one value")
        if isinstance(value, list) and not _is_of_lists(hint):
            choices.append([(key, each) for each in value])
        elif isinstance(value, Mapping) and is_dataclass(hint):
            nested = _combinations(value, f"{where}: {key}", cast(type, hint))
            choices.append([(key, each) for each in nested])
        else:
            choices.append([(key, value)])
    return map(dict, itertools.product(*choices))


def _is_of_lists(hint: Any) -> bool:
    """Whether a field's type is a list."""
    return any(get_origin(each) is tuple for each in (hint, *get_args(hint)))
