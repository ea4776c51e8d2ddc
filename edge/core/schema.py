"""Declared bounds: converts mappings (TOML, JSON) to frozen dataclasses, with one-line errors.

A field's type declares its bounds: `Annotated[float, Meta(ge=0.0, le=1.0)]` is a `Share`. msgspec
decodes files and messages by these types; `Bounded` checks values constructed in Python.
"""

import dataclasses
import functools
import operator
import re
import sys
import types
import typing
from collections.abc import Iterator, Mapping
from enum import StrEnum
from numbers import Integral, Real
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import msgspec
from msgspec import Meta

T = TypeVar("T")

# msgspec has no infinite bounds. NaN and infinity are outside of all.
MAX_FLOAT = sys.float_info.max
_LONGEST_SHOWN = 200

Finite = Annotated[float, Meta(ge=-MAX_FLOAT, le=MAX_FLOAT)]
NonNegative = Annotated[float, Meta(ge=0.0, le=MAX_FLOAT)]
Positive = Annotated[float, Meta(gt=0.0, le=MAX_FLOAT)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
AtLeastZero = Annotated[int, Meta(ge=0)]
AtLeastOne = Annotated[int, Meta(ge=1)]
PointXY = Annotated[tuple[Finite, ...], Meta(min_length=2, max_length=2, description="[x, y]")]


class ConfigError(ValueError):
    """A value in a configuration is unknown, missing or impossible; the text names it."""


def from_mapping(cls: type[T], mapping: object, where: str) -> T:
    """Convert `mapping` to the dataclass `cls`, and nested mappings to nested dataclasses.

    `where` names the file, then the path of keys, in errors. Field types may be any that msgspec
    decodes, with its constraints. Rules between fields are `Bounded.check_rules`, which raises
    ValueError.

    Raises ConfigError for an unknown or missing key, a wrong type or an impossible value.
    """
    _require_known_keys(cls, mapping, where)
    try:
        return msgspec.convert(mapping, cls)
    except msgspec.ValidationError as error:
        raise ConfigError(explain(error, cls, mapping, where)) from None


def explain(error: msgspec.ValidationError, hint: Any, value: object, where: str) -> str:
    """One line why msgspec does not convert a value: its innermost wrong part, and the cause."""
    for part in _parts(hint, value, where):
        try:
            msgspec.convert(part[1], part[0])
        except msgspec.ValidationError as of_part:
            return explain(of_part, *part)
    if error.__cause__ is not None:
        return f"{where}: {error.__cause__}"
    kind = _parse(hint).kind
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError:
        return where + _not_of(kind, value)
    return _fault(hint, value, where) or f"{where} = {_shown(value)}: {error}"


class Bounded:
    """Base of dataclasses whose values are checked on construction.

    Raises ValueError with the text of `from_mapping` for a value out of bounds.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        check_bounds(self)
        self.check_rules()

    def check_rules(self) -> None:
        """Raise ValueError for values that do not fit together; each is within its own bounds."""


def check_bounds(instance: object) -> None:
    """Raise ValueError for the first field out of bounds."""
    cls: Any = type(instance)
    if not _fits(instance, _part(cls)):
        for fault in _faults(instance, _bounded_fields(cls)).values():
            raise ValueError(fault)


def faults(instance: object, names: tuple[str, ...]) -> dict[str, str]:
    """Fields of a dataclass that are out of bounds, with the reasons."""
    cls: Any = type(instance)
    return {} if _fits(instance, _part(cls, names)) else _faults(instance, names)


def require(hint: Any, value: object, where: str) -> None:
    """Raise ValueError if a value is out of its type's bounds."""
    fault = _fault(hint, value, where)
    if fault is not None:
        raise ValueError(fault)


def bounds_of(cls: Any) -> Mapping[str, Meta]:
    """Constraint of each field that has one, or of a list's elements."""
    metas = {name: _bounds(hint) for name, hint in _hints(cls).items()}
    return {name: meta for name, meta in metas.items() if meta is not None}


def in_words(meta: Meta) -> str:
    """Text of the allowed values, to follow "must be"."""
    if meta.description is not None:
        return meta.description
    least = None if meta.ge == -MAX_FLOAT else meta.ge
    most = None if meta.le == MAX_FLOAT else meta.le
    words = []
    if least is not None and most is not None:
        words.append(f"from {_number(least)} to {_number(most)}")
        least = most = None
    shortest, longest = meta.min_length, meta.max_length
    if shortest is not None and longest is not None:
        words.append(f"{shortest} to {longest} long")
        shortest = longest = None
    parts = {
        "at least": least, "above": meta.gt, "at most": most, "below": meta.lt,
        "a multiple of": meta.multiple_of, "like": meta.pattern,
    }  # fmt: skip
    words += [f"{text} {_number(value)}" for text, value in parts.items() if value is not None]
    lengths = {"at least": shortest, "at most": longest}
    words += [f"{text} {value} long" for text, value in lengths.items() if value is not None]
    if meta.le == MAX_FLOAT:
        words.append("finite")
    return " and ".join(words)


def no_options(where: str, options: Mapping[str, object]) -> None:
    """Check for a driver without options. Raises ConfigError that names the first one."""
    for key in options:
        raise ConfigError(f"{where}: options: unknown key {key!r}; it has none")


@functools.cache
def _hints(cls: Any) -> dict[str, Any]:
    """Types of a dataclass's fields by name, cached because the look-up is slow."""
    hints = typing.get_type_hints(cls, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


def _is_table(kind: Any) -> bool:
    return dataclasses.is_dataclass(kind)


def _bounds(hint: Any) -> Meta | None:
    kind, metas, _ = _parse(hint)
    is_list = typing.get_origin(kind) is tuple
    return metas[0] if metas else _bounds(typing.get_args(kind)[0]) if is_list else None


@functools.cache
def _bounded_fields(cls: Any) -> tuple[str, ...]:
    return tuple(name for name, hint in _hints(cls).items() if _is_bounded(hint))


@functools.cache
def _part(cls: Any, names: tuple[str, ...] | None = None) -> Any:
    """A type of the named fields, by default all bounded ones, with which msgspec checks."""
    chosen = _bounded_fields(cls) if names is None else names
    return msgspec.defstruct(cls.__name__, [(name, _hints(cls)[name]) for name in chosen])


def _fits(instance: object, part: Any) -> bool:
    """Whether msgspec accepts it; it refuses numpy's numbers, even within bounds."""
    try:
        msgspec.convert(instance, part, from_attributes=True)
    except msgspec.ValidationError:
        return False
    return True


def _faults(instance: object, names: tuple[str, ...]) -> dict[str, str]:
    cls: Any = type(instance)
    hints = _hints(cls)
    found = {name: _fault(hints[name], getattr(instance, name), name) for name in names}
    return {name: fault for name, fault in found.items() if fault is not None}


def _is_bounded(hint: Any) -> bool:
    kind, metas, _ = _parse(hint)
    is_choice = typing.get_origin(kind) is Literal
    return bool(metas) or is_choice or any(map(_is_bounded, typing.get_args(kind)))


# Includes numpy's numbers.
_OF_TYPE: dict[Any, type] = {int: Integral, float: Real, str: str}


class _Parsed(NamedTuple):
    """A field's type without None and constraints, its constraints, whether None is allowed."""

    kind: Any
    metas: tuple[Meta, ...]
    optional: bool


@functools.cache
def _parse(hint: Any) -> _Parsed:
    metas: tuple[Meta, ...] = ()
    optional = False
    while True:
        origin, arguments = typing.get_origin(hint), typing.get_args(hint)
        if origin is Annotated:
            metas += tuple(each for each in hint.__metadata__ if isinstance(each, Meta))
            hint = hint.__origin__
        elif origin in (types.UnionType, typing.Union) and type(None) in arguments:
            others = (each for each in arguments if each is not type(None))
            hint, optional = functools.reduce(operator.or_, others), True
        else:
            return _Parsed(hint, metas, optional)


def _parts(hint: Any, value: object, where: str) -> Iterator[tuple[Any, Any, str]]:
    """Yield the typed parts of a table or list: type, value and path."""
    kind = _parse(hint).kind
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if isinstance(value, Mapping):
        if _is_table(kind):
            for name, of_field in _hints(kind).items():
                if name in value:
                    yield of_field, value[name], f"{where}: {name}"
        elif origin is dict:
            for key, each in value.items():
                yield arguments[0], key, f"{where}: key"
                yield arguments[1], each, f"{where}: {key}"
    elif origin is tuple and isinstance(value, list | tuple):
        repeated = arguments[1:] == (Ellipsis,)
        for i, each in enumerate(value if repeated else value[: len(arguments)]):
            yield arguments[0 if repeated else i], each, f"{where}[{i}]"


def _fault(hint: Any, value: Any, where: str) -> str | None:
    """One line why a value of the right type is out of bounds; None if it is not."""
    kind, metas, optional = _parse(hint)
    if value is None and optional:
        return None
    of_type = _OF_TYPE.get(kind)
    if of_type is not None and not isinstance(value, of_type):
        return where + _not_of(kind, value)
    for meta in metas:
        if not _holds(meta, value):
            return f"{where} = {_shown(value)}: must be {in_words(meta)}"
    if typing.get_origin(kind) is Literal and value not in typing.get_args(kind):
        return where + _not_of(kind, value)
    return next(filter(None, (_fault(*part) for part in _parts(hint, value, where))), None)


def _holds(meta: Meta, value: Any) -> bool:
    return (
        (meta.ge is None or value >= meta.ge)
        and (meta.gt is None or value > meta.gt)
        and (meta.le is None or value <= meta.le)
        and (meta.lt is None or value < meta.lt)
        and (meta.multiple_of is None or value % meta.multiple_of == 0)
        and (meta.min_length is None or len(value) >= meta.min_length)
        and (meta.max_length is None or len(value) <= meta.max_length)
        and (meta.pattern is None or re.search(meta.pattern, value) is not None)
    )


def _require_known_keys(hint: Any, value: object, where: str) -> None:
    kind = _parse(hint).kind
    if _is_table(kind) and isinstance(value, Mapping):
        known = _hints(kind)
        for key in value:
            if key not in known:
                raise ConfigError(f"{where}: unknown key {key!r}; known are {', '.join(known)}")
    for part in _parts(hint, value, where):
        _require_known_keys(*part)


def _not_of(kind: Any, value: object) -> str:
    """Text why a value does not have a type, to follow its key."""
    if _is_table(kind):
        if not isinstance(value, Mapping):
            return f": expected a table, got {_shown(value)}"
        missing = (
            field.name
            for field in dataclasses.fields(kind)
            if field.name not in value
            and field.default is dataclasses.MISSING
            and field.default_factory is dataclasses.MISSING
        )
        return f": {next(missing, 'a key')} is missing"
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        origin, arguments = Literal, tuple(map(str, kind))
    if origin is Literal:
        allowed = ", ".join(repr(each) for each in arguments)
        return f" = {_shown(value)}: allowed are {allowed}"
    if kind is float and type(value) is int:
        return ": is too large a number"
    words = {
        dict: "a table", str: "text in quotes", tuple: "a list", int: "a whole number",
        float: "a number", bool: "true or false",
    }  # fmt: skip
    expected = words.get(origin or kind, getattr(kind, "__name__", str(kind)))
    if origin is tuple and Ellipsis not in arguments:
        expected = f"a list of {len(arguments)}"
    return f" = {_shown(value)}: must be {expected}"


def _shown(value: object) -> str:
    try:
        text = repr(list(value) if isinstance(value, tuple) else value)
    except ValueError:  # Python writes no whole number of more than 4300 digits
        return "a number of too many digits"
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}..."


def _number(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
