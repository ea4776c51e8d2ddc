"""Commands whose options are the fields of dataclasses."""

import inspect
from collections.abc import Callable
from copy import copy
from dataclasses import MISSING, Field, fields
from functools import wraps
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer
from typer.models import ArgumentInfo, OptionInfo

# A field's name ends in its unit; an option's help says it.
_UNITS = ("_m_s", "_s", "_m")


def options_of(*classes: type[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorate a command that takes an instance of each of these dataclasses, in their order.

    Its options are their fields. A field's type is `Annotated`, with a text for the option's help,
    or with a `typer.Option` or `typer.Argument`. An option that has no name gets the field's,
    without its unit.

    The command raises ValueError that names the option if a value is out of its field's bounds.
    """
    parameters = [_parameter(cls, each) for cls in classes for each in fields(cls)]
    hints = {name: hint for cls in classes for name, hint in _hints(cls).items()}
    flags = {each.name: str(each.annotation.__metadata__[0].default) for each in parameters}

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @wraps(command)
        def called(**given: Any) -> None:
            from edge.core.schema import require

            for name, value in given.items():
                require(hints[name], value, flags[name])
            command(*(cls(**_own(cls, given)) for cls in classes))

        called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        called.__annotations__ = {each.name: each.annotation for each in parameters}
        return called

    return decorate


def _hints(cls: type[Any]) -> dict[str, Any]:
    return get_type_hints(cls, include_extras=True)


def _own(cls: type[Any], given: dict[str, Any]) -> dict[str, Any]:
    return {each.name: given[each.name] for each in fields(cls) if each.name in given}


def _parameter(cls: type[Any], of: Field[Any]) -> inspect.Parameter:
    """A field as a parameter that typer makes an option of."""
    hint = _hints(cls)[of.name]
    metadata = hint.__metadata__ if get_origin(hint) is Annotated else ()
    [info] = [each for each in metadata if isinstance(each, OptionInfo | ArgumentInfo | str)]
    if isinstance(info, str):
        info = typer.Option(help=info)
    if isinstance(info, OptionInfo) and info.default is ...:
        info = copy(info)
        # Beside a type this is what typer takes for the option's first name.
        info.default = _flag(of.name)
    default = of.default if of.default_factory is MISSING else of.default_factory()
    return inspect.Parameter(
        of.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=inspect.Parameter.empty if default is MISSING else default,
        annotation=Annotated[_without_bounds(hint), info],
    )


def _flag(name: str) -> str:
    for unit in _UNITS:
        name = name.removesuffix(unit)
    return f"--{name.replace('_', '-')}"


def _without_bounds(hint: Any) -> Any:
    """The type that typer knows."""
    if get_origin(hint) is Annotated:
        return _without_bounds(hint.__origin__)
    arguments = get_args(hint)
    if any(get_origin(each) is Annotated for each in arguments):
        plain = [_without_bounds(each) for each in arguments]
        return plain[0] | plain[1] if len(plain) > 1 else hint
    return hint
