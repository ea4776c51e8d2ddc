"""Exact differences between frozen dataclasses or structs, for logs without repetition.

Values are equal if their bits are: 0.0 and -0.0 differ, and NaN equals itself.
"""

import dataclasses
import typing
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np

T = TypeVar("T")


def _listed(value: object) -> object:
    """Encode arrays, which msgspec does not support, as lists of numbers."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise NotImplementedError(f"a {type(value).__name__}")


_encode = msgspec.msgpack.Encoder(enc_hook=_listed).encode


def same(one: object, other: object) -> bool:
    """Whether two values are equal bit by bit, including dataclasses, named tuples and arrays."""
    return one is other or _encode(one) == _encode(other)


def plain(value: object) -> Any:
    """Convert to JSON's types; numbers that are not finite stay numbers."""
    return msgspec.to_builtins(value, enc_hook=_listed)


def fields_of(value: object) -> dict[str, Any]:
    """Fields of a dataclass or struct by name, unconverted."""
    names, values, _, _ = _kind(type(value))
    return dict(zip(names, values(value), strict=True))


def changes(before: object, after: object) -> dict[str, Any]:
    """Fields of the dataclass or struct `after` that differ from `before`; name -> plain value.

    All fields if `before` is of another type. Nested dataclasses are compared in the same way.
    """
    names, values, _, choices = _kind(type(after))
    if type(before) is not type(after):
        return {
            name: _chosen(now) if name in choices else _whole(now)
            for name, now in zip(names, values(after), strict=True)
        }
    differences: dict[str, Any] = {}
    for name, was, now in zip(names, values(before), values(after), strict=True):
        if now is was:
            # The usual case: replaced dataclasses keep other fields.
            continue
        kind = type(now)
        if kind is float:
            # The next most frequent case. Zeros are included, since their signs may differ.
            if now != was or not now:
                differences[name] = now
        elif name in choices:
            if kind is not type(was) or _encode(was) != _encode(now):
                differences[name] = _chosen(now)
        elif type(was) is kind and _has_fields(kind):
            if inner := changes(was, now):
                differences[name] = inner
        elif _encode(was) != _encode(now):
            differences[name] = _whole(now)
    return differences


def _whole(value: object) -> Any:
    return changes(None, value) if _has_fields(type(value)) else plain(value)


def _has_fields(kind: type) -> bool:
    return hasattr(kind, "__dataclass_fields__") or hasattr(kind, "__struct_fields__")


def changed(kind: type[T], before: T | None, differences: Mapping[str, Any]) -> T:
    """Apply `changes` to `before`; if that is None, `differences` has all fields.

    Numbers that are not finite may be text. Raises ValueError or TypeError if they do not fit.
    """
    names, values_of, hints, choices = _kind(kind)
    values: dict[str, Any] = {}
    if before is not None:
        values.update(zip(names, values_of(before), strict=True))
    for name, value in differences.items():
        if name not in hints:
            raise ValueError(f"{kind.__name__} has no {name}")
        was = values.get(name)
        if name in choices:
            values[name] = None
            if value is not None:
                ((chosen, of_it),) = value.items()
                values[name] = _typed(of_it, choices[name][chosen])
        elif was is not None and _has_fields(type(was)) and isinstance(value, Mapping):
            values[name] = changed(type(was), was, value)
        elif _has_fields(hints[name]):
            values[name] = changed(hints[name], None, value)
        else:
            values[name] = _typed(value, hints[name])
    return kind(**values)


def _typed(value: object, hint: Any) -> Any:
    return msgspec.convert(value, hint, strict=False, dec_hook=_array)


def _array(_: type, value: object) -> object:
    return np.array(value, np.float64)


class _Kind(NamedTuple):
    """A dataclass or struct: names of its fields, getter of their values, and their types.

    `choices` are fields that may be one of several dataclasses, by name: their changes are whole,
    `{name: fields}`.
    """

    names: tuple[str, ...]
    values: Callable[[object], tuple[Any, ...]]
    hints: dict[str, Any]
    choices: dict[str, dict[str, type]]


_kinds: dict[type, _Kind] = {}


def _kind(kind: type) -> _Kind:
    if kind not in _kinds:
        names = getattr(kind, "__struct_fields__", None) or tuple(
            field.name for field in dataclasses.fields(kind)
        )
        # attrgetter of a single name returns no tuple.
        values = attrgetter(*names) if len(names) > 1 else lambda o: (getattr(o, names[0]),)
        hints = typing.get_type_hints(kind, include_extras=True)
        choices: dict[str, dict[str, type]] = {}
        for name, hint in hints.items():
            several = [each for each in typing.get_args(hint) if dataclasses.is_dataclass(each)]
            if len(several) > 1:
                choices[name] = {each.__name__: each for each in several if isinstance(each, type)}
        _kinds[kind] = _Kind(names, values, hints, choices)
    return _kinds[kind]


def _chosen(value: object) -> Any:
    return None if value is None else {type(value).__name__: plain(value)}
