"""The Python reference: what notebooks use, and what packages of others implement."""

import ast
import dataclasses
import inspect
import textwrap
from enum import Enum
from pathlib import Path
from typing import Any

from edge.core import ports, vehicle
from edge.core.perception import PerceptionParameters, window_corner
from edge.messages import topics
from edge.policy import bundle, family
from handbook.markdown import code
from lpac import api
from lpac.train import family as learnable

_LINE = 88
_ROOT = Path(__file__).resolve().parent.parent
# What docs/extending.md speaks of, by the kind of package that needs it.
_INTERFACES = {
    "A sensor": (
        ports.SensorDriver, ports.SensorSetting, ports.Sensor, ports.Camera, ports.Look,
        PerceptionParameters, window_corner,
    ),
    "A policy": (
        family.PolicyFamily, family.Policy, family.Agent, family.Observation, family.Perceived,
        family.PolicyStep, family.GoldenCheck, bundle.Manifest, bundle.Training,
        bundle.BundleError, bundle.make_bundle, bundle.write_bundle,
    ),
    "A network that `lpac train` trains": (
        learnable.LearnableFamily, learnable.Learnable, learnable.TrainableModule,
    ),
    "A vehicle": (
        ports.VehicleDriver, ports.VehicleSetting, ports.OpenVehicle, ports.Vehicle,
        ports.VehicleSetup, ports.Watchdog, vehicle.VehicleState, vehicle.Velocity,
        vehicle.Position, vehicle.Action, vehicle.ActionResult, vehicle.Mode, vehicle.Gps,
        vehicle.EstimatorStatus, vehicle.GlobalOrigin,
    ),
    "A radio": (topics.LinkDriver, topics.LinkSetting, topics.Link, topics.Topic),
}  # fmt: skip


def python_api() -> str:
    """`lpac.api`, all of it."""
    return "\n\n".join(
        [
            "# Python API",
            "[The Python API](../api.md) shows how to use it; this is all of `lpac.api`.",
            inspect.getdoc(api) or "",
            *(_described(getattr(api, name), name, "##") for name in api.__all__),
        ]
    )


def page() -> str:
    """What drivers and policy families are to the rest."""
    return "\n\n".join(
        [
            "# Interfaces",
            "What a package of yours implements, and what it is given. "
            "[Extending](../extending.md) builds one from beginning to end.",
            *(
                "\n\n".join(
                    [f"## {title}", *(_described(it, it.__name__, "###", it) for it in things)]
                )
                for title, things in _INTERFACES.items()
            ),
        ]
    )


def _described(thing: object, name: str, heading: str, imported: object = None) -> str:
    parts = [f"{heading} {name}"]
    if imported is not None:
        parts.append(f"`from {getattr(imported, '__module__', '')} import {name}`")
    if inspect.isclass(thing):
        parts += [_class(thing), inspect.getdoc(thing) or ""]
        for method, its in _methods(thing):
            text = inspect.getdoc(its) or ""
            parts.append(f"{heading}# {name}.{method}\n\n{_member(its)}\n\n{text}")
    elif inspect.isfunction(thing):
        parts += [_function(thing), inspect.getdoc(thing) or ""]
    else:
        # A path of the repository is told without the folder that it lies in.
        parts.append(code(repr(thing).replace(f"{_ROOT}/", "")))
    return "\n\n".join(part for part in parts if part)


def _methods(cls: type) -> list[tuple[str, Any]]:
    """What a class says itself and has words for; of a driver its call, too."""
    return [
        (name, member)
        for name, member in vars(cls).items()
        if (not name.startswith("_") or name == "__call__")
        and (inspect.isfunction(member) or isinstance(member, property | classmethod))
        and inspect.getdoc(member)
    ]


def _class(cls: type) -> str:
    """Its fields or values, or how it is made; nothing for a protocol."""
    if issubclass(cls, Enum):
        return "```python\n" + "\n".join(f"{it.name} = {it.value!r}" for it in cls) + "\n```"
    definition = _definition(cls)
    assert isinstance(definition, ast.ClassDef)
    fields = [ast.unparse(line) for line in definition.body if isinstance(line, ast.AnnAssign)]
    made = next((f for f in definition.body if getattr(f, "name", "") == "__init__"), None)
    if fields and (dataclasses.is_dataclass(cls) or issubclass(cls, tuple)):
        return "```python\n" + "\n".join(fields) + "\n```"
    return _call(made, cls.__name__) if isinstance(made, ast.FunctionDef) else ""


def _member(member: Any) -> str:
    if isinstance(member, property):
        definition = _definition(member.fget)
        assert isinstance(definition, ast.FunctionDef)
        returns = f": {ast.unparse(definition.returns)}" if definition.returns else ""
        return f"```python\n{definition.name}{returns}\n```"
    return _function(getattr(member, "__func__", member))


def _function(function: Any) -> str:
    definition = _definition(function)
    assert isinstance(definition, ast.FunctionDef | ast.AsyncFunctionDef)
    return _call(definition, definition.name)


def _call(definition: ast.FunctionDef | ast.AsyncFunctionDef, name: str) -> str:
    """The call as the source has it; one argument on a line where it is long."""
    arguments = _arguments(definition.args)
    returns = f" -> {ast.unparse(definition.returns)}" if definition.returns else ""
    text = f"{name}({', '.join(arguments)}){returns}"
    if len(text) > _LINE:
        text = "".join([f"{name}(\n", *(f"    {each},\n" for each in arguments), f"){returns}"])
    return f"```python\n{text}\n```"


def _arguments(arguments: ast.arguments) -> list[str]:
    own = [*arguments.posonlyargs, *arguments.args]
    defaults = [*[None] * (len(own) - len(arguments.defaults)), *arguments.defaults]
    said = [_argument(*each) for each in zip(own, defaults, strict=True)]
    if own and own[0].arg in ("self", "cls"):
        del said[0]
    if arguments.vararg:
        said.append(f"*{ast.unparse(arguments.vararg)}")
    elif arguments.kwonlyargs:
        said.append("*")
    said += map(_argument, arguments.kwonlyargs, arguments.kw_defaults)
    return said + ([f"**{ast.unparse(arguments.kwarg)}"] if arguments.kwarg else [])


def _argument(argument: ast.arg, default: ast.expr | None) -> str:
    return ast.unparse(argument) + ("" if default is None else f" = {ast.unparse(default)}")


def _definition(thing: Any) -> ast.stmt:
    return ast.parse(textwrap.dedent(inspect.getsource(thing))).body[0]
