"""Studies as TOML files; see `Study` for what the keys mean."""

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
    """A study as its file has it; paths count from the file's folder.

    The shipped policy flies if no other and no baseline is named. `scenario` and each of
    `conditions` have keys of `ConditionKeys` and of `Scenario`. In a condition, a list of values
    where there should be one means a condition for each of them, and several such lists one for
    each combination.
    """

    title: Annotated[str, "Of the report; else the file's name."] = ""
    text: Annotated[str, "What a reader of the report should know."] = ""
    policies: Annotated[
        dict[str, tuple[str, ...]],
        "By name the paths of its bundles, one per training; [] is the shipped one.",
    ] = field(default_factory=dict)
    baselines: Annotated[
        tuple[BaselineName, ...], "Beside clairvoyant-cvt, which always flies."
    ] = ()
    world_set: Annotated[WorldSet, "Look at test only once."] = "validation"
    first_world: Annotated[WorldNumber, "Number of the first world of the set."] = 0
    worlds: Annotated[Worlds, "How many, from the first on."] = 20
    starts: Annotated[
        Literal["own", "first"],
        "Where robots start: in each world where its number says, or where the first one's do.",
    ] = "own"
    trials: Annotated[Trials, "How often each world is flown."] = 1
    placed_within_m: Annotated[
        Misplaced, "How far from the same starts robots are placed in each trial, m."
    ] = 0.0
    receiver_error_m: Annotated[
        tuple[Misplaced, Misplaced] | None,
        "[least, greatest]: how wrong the positions of points are throughout a trial, m.",
    ] = None
    scenario: Annotated[dict[str, object], "What all flights have alike: see below."] = field(
        default_factory=dict
    )
    conditions: Annotated[
        tuple[dict[str, object], ...], Meta(min_length=1), "What is otherwise: see below."
    ] = ({},)
    figures: Annotated[tuple[Figure, ...], "Which are drawn."] = USUAL_FIGURES


@dataclass(frozen=True, slots=True, kw_only=True)
class ConditionKeys(Bounded):
    """Keys of a condition that are none of its scenario's."""

    title: Annotated[str, "Its name in figures and tables; else what is otherwise."] = ""
    engine: Annotated[
        EngineName,
        "What flies the policies: points; whole robots on one simulated clock; a program for each "
        "robot in real time, on simulated vehicles or on real PX4s (--px4).",
    ] = "point"
    from_pads: Annotated[
        bool, "Points begin on the pads of whole robots, as wrong about their places as these."
    ] = False
    lost: Annotated[str, "Points lost in flight, ROBOTS@SECONDS, such as 2@20."] = ""
    methods: Annotated[
        Annotated[tuple[str, ...], Meta(min_length=1)] | None,
        "Names of those that fly it; else all.",
    ] = None
    set_up: Annotated[
        str, "Team and world, from which other keys differ: field, n32, paper, ..."
    ] = "field"
    world: Annotated[str, "Path of a world file; else worlds are drawn."] = ""


# Keys of a scenario that the study says.
DRAWN = ("controller", "seed", "features", "scale")


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
    for keys in _combinations(file.scenario, f"{where}: scenario"):
        condition_of(keys, f"{where}: scenario", path.parent)
    # A condition given in two ways is flown once.
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
    """A condition by its keys and those of its scenario. Raises ConfigError."""
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
    """The given one, and what is otherwise; nothing if neither is."""
    given = keys.get("title", "")
    told = _otherwise(keys, whole, {} if given else changes)
    return ", ".join(filter(None, [given, _said({**told, "title": ""})]))


def _otherwise(
    keys: Mapping[str, Any], whole: Mapping[str, Any], changes: Mapping[str, Any]
) -> dict[str, Any]:
    """Of one combination of `whole` those keys that are one of several values, or changes."""
    told = {}
    for key, value in keys.items():
        if isinstance(value, Mapping):
            told[key] = _otherwise(value, whole[key], changes.get(key, {}))
        elif key in changes or value != whole[key]:
            told[key] = value
    return told


def _said(keys: Mapping[str, Any]) -> str:
    """Keys and their values, for people."""
    parts = []
    for key, value in keys.items():
        said = f"{value:g}" if isinstance(value, float) else f"{value}"
        said = _said(value) if isinstance(value, Mapping) else said
        if said:
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


def _combinations(
    keys: Mapping[str, Any], where: str, cls: type = Scenario
) -> Iterator[dict[str, Any]]:
    """One for each combination of the values in lists that stand where one value should.

    Raises ConfigError for a list of none.
    """
    hints = {**get_type_hints(ConditionKeys), **get_type_hints(cls)}
    choices: list[list[tuple[str, Any]]] = []
    for key, value in keys.items():
        hint = hints.get(key)
        if value == [] and not _is_of_lists(hint):
            raise ConfigError(f"{where}: {key} = []: must have a value at least")
        if isinstance(value, list) and not _is_of_lists(hint):
            choices.append([(key, each) for each in value])
        elif isinstance(value, Mapping) and is_dataclass(hint):
            its = _combinations(value, f"{where}: {key}", cast(type, hint))
            choices.append([(key, each) for each in its])
        else:
            choices.append([(key, value)])
    return map(dict, itertools.product(*choices))


def _is_of_lists(hint: Any) -> bool:
    """Whether a field's type has a list for its value."""
    return any(get_origin(each) is tuple for each in (hint, *get_args(hint)))
