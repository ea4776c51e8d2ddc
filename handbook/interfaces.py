"""Generates the Python reference: the API, and interfaces for other packages."""

import ast
import dataclasses
import inspect
import textwrap
import types
from collections.abc import Iterator, Mapping
from contextlib import suppress
from enum import Enum
from importlib import import_module
from pathlib import Path
from typing import Any

from msgspec import Struct

from handbook.markdown import code
from lpac import api

_LINE = 88
_ROOT = Path(__file__).resolve().parent.parent
# Names for other packages, by purpose and module.
_INTERFACES = {
    "A sensor": {
        "edge.core.ports": "SensorDriver SensorSetting SensorOver Sensor Camera Look",
        "edge.core.perception": "PerceptionParameters window_corner part_in_world",
        "edge.core.world": "Feature",
        "lpac.analysis.worlds": "format_world",
        "edge.drivers.world_sensor": "world_sensor",
    },
    "A policy": {
        "edge.policy.family": (
            "PolicyFamily Policy Agent Observation Perceived PolicyStep GoldenCheck TOLERANCE "
            "VerifiedPolicy verified"
        ),
        "edge.policy.bundle": (
            "Bundle Manifest Training SCHEMA_VERSION make_bundle write_bundle BundleError"
        ),
        "edge.core.wire": "PayloadType FLOAT_PAYLOADS",
        "edge.core.aggregation": "Geometry HopBuffer",
    },
    "A network that `lpac train` trains": {
        "lpac.train.family": (
            "LearnableFamily Learnable TrainableModule Inputs StateDict shift_operator"
        ),
        "export.parameters": "PolicyParameters PolicyMessages",
    },
    "What it is trained for": {
        "lpac.train.task": "Task Teacher",
        "lpac.train.config": "DataConfig",
        "lpac.sim.points": "prepare Preparation",
        "lpac.sim.baselines": "BaselineName",
        "lpac.study.flights": "records_of FlightGroup PlannedFlight CostCurve",
    },
    "A vehicle": {
        "edge.core.ports": (
            "VehicleDriver VehicleSetting OpenVehicle Vehicle VehicleSetup Watchdog"
        ),
        "edge.core.vehicle": (
            "VehicleState Setpoint Velocity Position Action ActionResult Mode Gps EstimatorStatus "
            "GlobalOrigin"
        ),
    },
    "A radio": {
        "edge.messages.topics": "LinkDriver LinkSetting Link Topic ReceiveCallback TlsFiles Group",
        "edge.messages.admission": "Admission",
        "edge.drivers.link": "zenoh_link",
    },
    "What all of them use": {
        "edge.core": "F32 F64 Bools",
        "edge.core.schema": (
            "from_mapping ConfigError Bounded Positive NonNegative AtLeastOne Share"
        ),
    },
    "A figure": {"lpac.analysis": "style"},
}


def names() -> set[tuple[str, str]]:
    """Module and name of everything on the page of interfaces."""
    return {
        (module, name)
        for taken in _INTERFACES.values()
        for module, several in taken.items()
        for name in several.split()
    }


def python_api() -> str:
    """Reference of `lpac.api`."""
    return "\n\n".join(
        [
            "# Python: reference",
            "All of `lpac.api`; [the tour](../api.md) shows how to use it.",
            inspect.getdoc(api) or "",
            *(_described(getattr(api, name), name, "##") for name in api.__all__),
        ]
    )


def page() -> str:
    """Reference of interfaces of drivers and policy families."""
    return "\n\n".join(
        [
            "# Interfaces",
            "Interfaces for a package of yours: what it implements, its arguments, and other "
            "imports. [Extending](../extending.md) builds one from beginning to end; bundles, "
            "flights and worlds are in [Python: reference](api.md).",
            "Like those, the names here change only with a new minor version, and "
            "[the changelog](../../CHANGELOG.md) says how.",
            *(
                part
                for title, taken in _INTERFACES.items()
                for part in (f"## {title}", *_each(taken))
            ),
        ]
    )


def _each(taken: Mapping[str, str]) -> Iterator[str]:
    for module, several in taken.items():
        for name in several.split():
            parent = import_module(module)
            if not hasattr(parent, name):  # a module of that package
                import_module(f"{module}.{name}")
            yield _described(getattr(parent, name), name, "###", module)


def _described(thing: object, name: str, heading: str, imported: str = "") -> str:
    """Describe a name, `imported` from a module: signature or fields, and docstring."""
    parts = [f"{heading} {name}"]
    if imported:
        parts.append(f"`from {imported} import {name}`")
    if inspect.isclass(thing):
        parts += [_class(thing), inspect.getdoc(thing) or ""]
        for method, member in _methods(thing):
            text, shown = inspect.getdoc(member) or "", method.replace("__", "\\_\\_")
            parts.append(f"{heading}# {name}.{shown}\n\n{_member(member)}\n\n{text}")
    elif inspect.isfunction(thing):
        parts += [_function(thing), inspect.getdoc(thing) or ""]
    elif inspect.ismodule(thing):
        parts += [inspect.getdoc(thing) or "", _constants(thing)]
        for function, member in inspect.getmembers(thing, inspect.isfunction):
            if member.__module__ == thing.__name__ and not function.startswith("_"):
                parts.append(_described(member, f"{name}.{function}", f"{heading}#"))
    elif imported:
        parts += _assignment(import_module(imported), name)
    else:
        # Make paths in the repository relative.
        parts.append(code(repr(thing).replace(f"{_ROOT}/", "")))
    return "\n\n".join(part for part in parts if part)


def _assignment(module: types.ModuleType, name: str) -> list[str]:
    """Source of an assignment, and the comment above it."""
    source = inspect.getsource(module)
    [found] = (
        line
        for line in ast.parse(source).body
        if (isinstance(line, ast.Assign) and ast.unparse(line.targets[0]) == name)
        or (isinstance(line, ast.AnnAssign) and ast.unparse(line.target) == name)
    )
    comment = " ".join(line.removeprefix("# ") for line in _comment(found, source))
    return [f"```python\n{ast.get_source_segment(source, found)}\n```", comment]


def _constants(module: types.ModuleType) -> str:
    """Source of a module's constants."""
    source = inspect.getsource(module)
    found = []
    for line in ast.parse(source).body:
        if isinstance(line, ast.Assign) and not ast.unparse(line.targets[0]).startswith("_"):
            with suppress(ValueError):  # not a literal
                ast.literal_eval(line.value)
                found.append(ast.get_source_segment(source, line) or "")
    return "\n".join(["```python", *found, "```"]) if found else ""


def _comment(line: ast.stmt, source: str) -> list[str]:
    """Lines of the comment above a line of the source."""
    lines = [each.strip() for each in source.splitlines()[: line.lineno - 1]]
    first = len(lines)
    while first and lines[first - 1].startswith("# "):
        first -= 1
    return lines[first:]


def _methods(cls: type) -> list[tuple[str, Any]]:
    """Documented members that a class defines itself, including `__call__`."""
    return [
        (name, member)
        for name, member in vars(cls).items()
        if (not name.startswith("_") or name == "__call__")
        and (inspect.isfunction(member) or isinstance(member, property | classmethod))
        and inspect.getdoc(member)
    ]


def _class(cls: type) -> str:
    """Fields, values, or constructor of a class; "" for a protocol."""
    if issubclass(cls, Enum):
        return "```python\n" + "\n".join(f"{it.name} = {it.value!r}" for it in cls) + "\n```"
    definition = _definition(cls)
    assert isinstance(definition, ast.ClassDef)
    fields = [
        text
        for line in definition.body
        if isinstance(line, ast.AnnAssign)
        for text in (*_comment(line, _source(cls)), ast.unparse(line))
    ]
    made = next((f for f in definition.body if getattr(f, "name", "") == "__init__"), None)
    if fields and (dataclasses.is_dataclass(cls) or issubclass(cls, tuple | Struct)):
        return "```python\n" + "\n".join(fields) + "\n```"
    return _call(made, cls.__name__, bound=True) if isinstance(made, ast.FunctionDef) else ""


def _member(member: Any) -> str:
    if isinstance(member, property):
        definition = _definition(member.fget)
        assert isinstance(definition, ast.FunctionDef)
        returns = f": {ast.unparse(definition.returns)}" if definition.returns else ""
        return f"```python\n{definition.name}{returns}\n```"
    return _function(getattr(member, "__func__", member), bound=True)


def _function(function: Any, *, bound: bool = False) -> str:
    definition = _definition(function)
    assert isinstance(definition, ast.FunctionDef | ast.AsyncFunctionDef)
    call = _call(definition, definition.name, bound=bound)
    is_context = any(ast.unparse(each) == "contextmanager" for each in definition.decorator_list)
    return call.replace("\n", "\n@contextmanager\n", 1) if is_context else call


def _call(
    definition: ast.FunctionDef | ast.AsyncFunctionDef, name: str, *, bound: bool = False
) -> str:
    """Signature as in the source, with one argument per line if it is long.

    `bound` drops the first argument.
    """
    arguments = _arguments(definition.args)[1 if bound else 0 :]
    returns = f" -> {ast.unparse(definition.returns)}" if definition.returns else ""
    text = f"{name}({', '.join(arguments)}){returns}"
    if len(text) > _LINE:
        text = "".join([f"{name}(\n", *(f"    {each},\n" for each in arguments), f"){returns}"])
    return f"```python\n{text}\n```"


def _arguments(arguments: ast.arguments) -> list[str]:
    own = [*arguments.posonlyargs, *arguments.args]
    defaults = [*[None] * (len(own) - len(arguments.defaults)), *arguments.defaults]
    shown = [_argument(*each) for each in zip(own, defaults, strict=True)]
    if arguments.vararg:
        shown.append(f"*{ast.unparse(arguments.vararg)}")
    elif arguments.kwonlyargs:
        shown.append("*")
    shown += map(_argument, arguments.kwonlyargs, arguments.kw_defaults)
    return shown + ([f"**{ast.unparse(arguments.kwarg)}"] if arguments.kwarg else [])


def _argument(argument: ast.arg, default: ast.expr | None) -> str:
    return ast.unparse(argument) + ("" if default is None else f" = {ast.unparse(default)}")


def _definition(thing: Any) -> ast.stmt:
    return ast.parse(_source(thing)).body[0]


def _source(thing: Any) -> str:
    return textwrap.dedent(inspect.getsource(thing))
