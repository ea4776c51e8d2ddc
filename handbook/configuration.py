"""Generates the reference of configuration files from their dataclasses."""

import dataclasses
import inspect
import types
import typing
from collections.abc import Iterator, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from edge.core.schema import in_words
from edge.policy.bundle import Manifest
from edge.policy.lpac.manifest import LpacManifest
from edge.policy.network.manifest import NetworkManifest
from edge.robot.config import RobotConfig
from export.parameters import PolicyParameters
from handbook.markdown import cell, code, table
from lpac.ablate.config import AblationConfig
from lpac.fleet.settings import FleetTable, RobotTable
from lpac.ground.script import STEPS, STEPS_BEFORE, ScriptTable
from lpac.ground.site import SavedSite
from lpac.radio.airtime import Wifi
from lpac.sim.scenario import Scenario
from lpac.study.drills import Drill
from lpac.study.file import DRAWN, ConditionKeys, StudyFile
from lpac.train.attention import AttentionNetwork
from lpac.train.config import TrainingConfig
from lpac.train.lpac import LpacNetwork
from lpac.train.network import ModuleSource

_ROOT = Path(__file__).resolve().parent.parent
_REQUIRED = "must be given"
# Dataclasses of each page; tests check that they are complete.
ROBOT = (RobotConfig,)
FLEET = (FleetTable, RobotTable)
GROUND = (ScriptTable, *STEPS_BEFORE.values(), *STEPS.values(), SavedSite, Wifi)
TRAINING = (TrainingConfig, LpacNetwork, AttentionNetwork, ModuleSource, PolicyParameters)
ABLATION = (AblationConfig,)
STUDY = (StudyFile, ConditionKeys)
MANIFEST = (Manifest, LpacManifest, NetworkManifest)


def robot() -> str:
    """robot.toml."""
    return _page(
        "robot.toml",
        "A robot's configuration. `lpac fleet deploy` writes it from fleet.toml; write it by hand "
        "only for a robot without a fleet. `lpac robot check --config robot.toml` checks it.",
        _example("docs/robot.toml"),
        *_tables(RobotConfig, ""),
    )


def fleet() -> str:
    """fleet.toml."""
    return _page(
        "fleet.toml",
        "The fleet as configured on the workstation: its robots, their addresses and places. "
        "`[robot]` and `[robots.NAME.robot]` hold tables and keys of [robot.toml](robot-toml.md).",
        _example("docs/fleet.toml"),
        *_tables(FleetTable, ""),
        *_tables(RobotTable, "robots.NAME"),
    )


def ground() -> str:
    """Files of scripts, sites and radios."""
    steps = [
        part
        for where, kinds in (("before", STEPS_BEFORE), ("steps", STEPS))
        for name, kind in kinds.items()
        for part in _tables(kind, where, f'[[{where}]], do = "{name}"')
    ]
    return _page(
        "Scripts, sites, radios",
        "Files that ground control and the simulator read, beside fleet.toml.",
        "## A script\n\n`lpac mission run SCRIPT.toml` flies it.",
        _example("docs/script.toml"),
        *_tables(ScriptTable, ""),
        *steps,
        "## A site\n\n`lpac site save` writes it to `sites/NAME.toml`, and `lpac site use` reads "
        "it.",
        *_tables(SavedSite, "", "The file"),
        "## A radio\n\n`--wifi FILE.toml` of `lpac sim` and `lpac evaluate`.",
        *_tables(Wifi, "", "The file"),
    )


def training() -> str:
    """Files of `lpac train` and `lpac export`."""
    return _page(
        "Training",
        "Configuration of `lpac train CONFIG.toml`. Lengths are in model units, times in seconds. "
        "`examples/` has four such files; this is `examples/field.toml`.",
        _example("examples/field.toml"),
        *_tables(TrainingConfig, ""),
        *_tables(LpacNetwork, "network", '[network], family = "lpac"'),
        *_tables(AttentionNetwork, "network", '[network], family = "attention"'),
        *_tables(ModuleSource, "network", '[network], family = "network"'),
        "## Parameters of a checkpoint\n\nFile of `lpac export --params`, unless it is "
        "CoverageControl's own. `[perception]` and `[training]` are as above.",
        _example("policies/lpac_l2_k3_n10_512.toml"),
        *_tables(PolicyParameters, "", "The file", but=("perception", "training")),
    )


def ablation() -> str:
    """Files of `lpac ablate`."""
    return _page(
        "Ablation",
        "Configuration of `lpac ablate ABLATION.toml`. `train` holds keys of [a "
        "training](training.md) that are merged into the base's, `fly` those of [a study's "
        "condition](study.md).",
        _example("examples/ablation.toml"),
        *_tables(AblationConfig, ""),
    )


def study() -> str:
    """Files of `lpac study`."""
    return _page(
        "A study",
        "Configuration of `lpac study STUDY.toml`; `lpac/paper/studies` has the paper's "
        "experiments in this form.",
        _example("examples/study.toml"),
        *_tables(StudyFile, ""),
        "## Keys of `[scenario]` and of each of `[[conditions]]`",
        *_tables(ConditionKeys, "", "Of the condition"),
        *_tables(Scenario, "", "Of its flights", hidden=DRAWN),
        "## Keys of a drill",
        "A file with `faults` is a [drill](../drill.md): it flies faults instead of worlds.",
        _example("examples/drill.toml"),
        *_tables(Drill, ""),
    )


def manifest() -> str:
    """manifest.json of a bundle."""
    return _page(
        "Manifest of a bundle",
        "`manifest.json`, as `lpac bundle info --json` prints it. The bundle's id is the sha256 of "
        "this file.",
        *_tables(Manifest, "", "Every family"),
        *_tables(LpacManifest, "", 'family = "lpac"'),
        *_tables(NetworkManifest, "", 'family = "network"'),
    )


def keys(cls: type[Any]) -> Iterator[str]:
    """All keys of a dataclass, and of dataclasses in its fields."""
    for name, hint in _hints(cls).items():
        yield name
        within = _within(hint)
        if within is not None:
            yield from keys(within)


def _page(title: str, *parts: str) -> str:
    return "\n\n".join([f"# {title}", *parts])


def _example(path: str) -> str:
    text = (_ROOT / path).read_text()
    return f'```toml title="{path}"\n{text}```'


def _tables(
    cls: type[Any], path: str, title: str | None = None, but: tuple[str, ...] = (),
    hidden: tuple[str, ...] = (),
) -> Iterator[str]:  # fmt: skip
    """Yield a section for the dataclass at `path` of the file, and one for each below it.

    Fields in `but` get no section; `hidden` ones are not keys of the file.
    """
    yield f"### {title or (f'[{path}]' if path else 'The top of the file')}"
    yield _about(cls)
    rows, below = [], []
    for field in dataclasses.fields(cls):
        if field.name in hidden:
            continue
        hint = _hints(cls)[field.name]
        within = _within(hint)
        if within is not None and field.name not in but:
            place = f"{path}.{field.name}" if path else field.name
            several = "list of tables" in _kind(hint)
            below.append((within, place, f"[[{place}]]" if several else f"[{place}]"))
        about = [each for each in getattr(hint, "__metadata__", ()) if isinstance(each, str)]
        rows.append((f"`{field.name}`", cell("; ".join([_kind(hint), *about])), _default(field)))
    if rows:
        yield table(("key", "value", "default"), rows)
    for within, place, heading in below:
        yield from _tables(within, place, heading)


def _about(cls: type[Any]) -> str:
    """A dataclass's docstring without its exceptions, which do not concern users."""
    paragraphs = (inspect.getdoc(cls) or "").split("\n\n")
    return "\n\n".join(each for each in paragraphs if not each.startswith("Raises "))


def _hints(cls: type[Any]) -> dict[str, Any]:
    hints = typing.get_type_hints(cls, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


def _within(hint: Any) -> type[Any] | None:
    """The dataclass of a key's table or list of tables."""
    if dataclasses.is_dataclass(hint):
        return typing.cast(type[Any], hint)
    if typing.get_origin(hint) in (Annotated, tuple, types.UnionType, typing.Union):
        found = filter(None, map(_within, typing.get_args(hint)))
        return next(found, None)
    return None


def _kind(hint: Any) -> str:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        bounds = " and ".join(
            in_words(each) for each in hint.__metadata__ if isinstance(each, Meta)
        )
        kind = _kind(hint.__origin__)
        return f"{kind} ({bounds})" if bounds else kind
    if dataclasses.is_dataclass(hint):
        return "table"
    if origin is Literal:
        return " or ".join(f"`{_toml(each)}`" for each in arguments)
    if origin in (types.UnionType, typing.Union):
        return " or ".join(_kind(each) for each in arguments if each is not type(None))
    if origin is tuple:
        each = _kind(arguments[0])
        return "list of tables" if each == "table" else f"list, each {each}"
    if isinstance(hint, type) and issubclass(hint, StrEnum):
        return " or ".join(f"`{_toml(str(each))}`" for each in hint)
    names = {float: "number", int: "whole number", str: "text", bool: "`true` or `false`"}
    return names.get(hint, "table")


def _default(field: "dataclasses.Field[Any]") -> str:
    if field.default is not dataclasses.MISSING:
        value = field.default
    elif field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    else:
        return _REQUIRED
    if value is None or value == {}:
        return "nothing"
    within = value[0] if isinstance(value, tuple) and value else value
    if dataclasses.is_dataclass(within):
        return "its table's values"
    return code(_toml(value))


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, Mapping):
        return "{}"
    return str(value)
