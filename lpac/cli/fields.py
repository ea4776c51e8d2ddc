"""Commands whose options are the fields of dataclasses."""

import inspect
from collections.abc import Callable
from copy import copy
from dataclasses import MISSING, Field, fields, make_dataclass
from enum import StrEnum
from functools import wraps
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import typer
from typer.models import ArgumentInfo, OptionInfo

# A field's name ends in its unit; an option's help says it.
_UNITS = ("_m_s", "_s", "_m")


def options_of(*classes: type[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorate a command that takes an instance of each of these dataclasses, in their order.

    Its options are their fields, and its own keyword-only parameters, as typer has them. A field's
    type is `Annotated`, with a text for the option's help, or with a `typer.Option` or
    `typer.Argument`. An option that has no name gets the field's, without its unit.

    The command raises ValueError that names the option if a value is out of its field's bounds.
    """
    parameters = [_parameter(cls, each) for cls in classes for each in fields(cls)]
    hints = {name: hint for cls in classes for name, hint in _hints(cls).items()}
    flags = {each.name: str(each.annotation.__metadata__[0].default) for each in parameters}

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        declared = inspect.signature(command).parameters.values()
        own = [each for each in declared if each.kind is inspect.Parameter.KEYWORD_ONLY]

        @wraps(command)
        def called(**given: Any) -> None:
            from edge.core.schema import require

            further = {each.name: given.pop(each.name) for each in own if each.name in given}
            for name, value in given.items():
                require(hints[name], value, flags[name])
                if _choices(hints[name]) and value is not None:
                    several = isinstance(value, list)
                    given[name] = list(map(str, value)) if several else str(value)
            command(*(cls(**_own(cls, given)) for cls in classes), **further)

        options = [*parameters, *own]
        called.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
        called.__annotations__ = {each.name: each.annotation for each in options}
        return called

    return decorate


def chosen(cls: type[Any], *names: str, **flags: str) -> type[Any]:
    """Make a dataclass of some fields of `cls`; `flags` rename their options."""
    hints, defaults = _hints(cls), {each.name: each.default for each in fields(cls)}
    own = []
    for name in (*names, *flags):
        hint: Any = hints[name]
        if name in flags:
            [text] = [each for each in hint.__metadata__ if isinstance(each, str)]
            hint = Annotated[hint.__origin__, typer.Option(flags[name], help=text)]
        own.append((name, hint, defaults[name]))
    return make_dataclass(f"Chosen{cls.__name__}", own, frozen=True, kw_only=True)


def flag_of(name: str) -> str:
    """Default name of a field's option."""
    for unit in _UNITS:
        name = name.removesuffix(unit)
    return f"--{name.replace('_', '-')}"


def _hints(cls: type[Any]) -> dict[str, Any]:
    return get_type_hints(cls, include_extras=True)


def _own(cls: type[Any], given: dict[str, Any]) -> dict[str, Any]:
    return {each.name: given[each.name] for each in fields(cls) if each.name in given}


def _parameter(cls: type[Any], of: Field[Any]) -> inspect.Parameter:
    """A field as a parameter that typer turns into an option."""
    hint = _hints(cls)[of.name]
    metadata = hint.__metadata__ if get_origin(hint) is Annotated else ()
    [info] = [each for each in metadata if isinstance(each, OptionInfo | ArgumentInfo | str)]
    if isinstance(info, str):
        info = typer.Option(help=info)
    default = of.default if of.default_factory is MISSING else of.default_factory()
    if isinstance(info, OptionInfo) and info.default is ...:
        info, flag = copy(info), flag_of(of.name)
        # Beside a type this is what typer takes for the option's first name.
        info.default = f"{flag}/--no-{flag[2:]}" if default is True else flag
    return inspect.Parameter(
        of.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=inspect.Parameter.empty if default is MISSING else default,
        annotation=Annotated[_plain(hint, of.name), info],
    )


def _choices(hint: Any) -> tuple[str, ...]:
    """Allowed values of a Literal, also within an Optional or a list; else ()."""
    if get_origin(hint) is Annotated:
        return _choices(hint.__origin__)
    if get_origin(hint) is Literal:
        return tuple(get_args(hint))
    return tuple(choice for each in get_args(hint) for choice in _choices(each))


def _plain(hint: Any, name: str) -> Any:
    """The type as typer knows it."""
    if get_origin(hint) is Annotated:
        return _plain(hint.__origin__, name)
    arguments = get_args(hint)
    if type(None) in arguments:
        others = tuple(each for each in arguments if each is not type(None))
        return _plain(Union[others], name) | None  # noqa: UP007
    if get_origin(hint) is list:
        return list[_plain(arguments[0], name)]  # type: ignore[misc]
    choices = _choices(hint)
    return StrEnum(name, {each: each for each in choices}) if choices else hint
