"""Nested mappings (TOML, JSON) into frozen dataclasses; each mistake is a line naming the key."""

import dataclasses
import functools
import types
import typing
from collections.abc import Mapping
from enum import StrEnum
from typing import Any, Literal, TypeVar

T = TypeVar("T")


class ConfigError(ValueError):
    """A value that a person wrote is unknown, missing or impossible; the text says which."""


def from_mapping(cls: type[T], mapping: object, where: str) -> T:
    """Build the dataclass `cls` from `mapping`; nested dataclasses from nested mappings.

    `where` names the file, and then the path of keys, in errors. Field types may be bool, int,
    float, str, Literal, StrEnum, tuple[X, ...], dict[str, X], dataclasses, unions of one of these
    with None, and object for anything. The dataclass checks its own values in `__post_init__`, with
    a ValueError.

    Raises ConfigError for an unknown or missing key, a wrong type or an impossible value.
    """
    if not isinstance(mapping, Mapping):
        raise ConfigError(f"{where}: expected a table, got {mapping!r}")
    hints = _hints(cls)  # type: ignore[arg-type]
    fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for key in mapping:
        if key not in fields:
            raise ConfigError(f"{where}: unknown key {key!r}; known are {', '.join(fields)}")
    values = {}
    for name, field in fields.items():
        if name in mapping:
            values[name] = _value(hints[name], mapping[name], f"{where}: {name}")
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise ConfigError(f"{where}: {name} is missing")
    try:
        return cls(**values)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None


def no_options(where: str, options: Mapping[str, object]) -> None:
    """Of a driver that has none. Raises ConfigError that names the first one."""
    for key in options:
        raise ConfigError(f"{where}: options: unknown key {key!r}; it has none")


@functools.cache
def _hints(cls: type[Any]) -> dict[str, Any]:
    """They are slow to look up, and statuses are decoded a hundred times a second."""
    return typing.get_type_hints(cls)


def _value(hint: Any, value: object, where: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        if value is None and type(None) in arguments:
            return None
        (hint,) = (argument for argument in arguments if argument is not type(None))
        return _value(hint, value, where)
    if hint is object:  # whoever takes it looks what it is
        return value
    if dataclasses.is_dataclass(hint):
        return from_mapping(typing.cast(type[Any], hint), value, where)
    if origin is Literal:
        if value not in arguments:
            allowed = ", ".join(repr(argument) for argument in arguments)
            raise ConfigError(f"{where} = {value!r}: allowed are {allowed}")
        return value
    if isinstance(hint, type) and issubclass(hint, StrEnum):
        return hint(_value(Literal[tuple(str(member) for member in hint)], value, where))
    if origin is tuple and isinstance(value, list):
        return tuple(_value(arguments[0], v, f"{where}[{i}]") for i, v in enumerate(value))
    if origin is dict and isinstance(value, Mapping):
        return {key: _value(arguments[1], v, f"{where}: {key}") for key, v in value.items()}
    if hint is float and type(value) is int:
        try:
            return float(value)
        except OverflowError:
            raise ConfigError(f"{where}: is too large a number") from None
    if type(value) is hint:
        return value
    in_words = {tuple: "a list", dict: "a table", str: "text in quotes"}
    expected = in_words.get(origin or hint, getattr(hint, "__name__", ""))
    raise ConfigError(f"{where} = {value!r}: expected {expected}")
