"""What of a frozen dataclass is not as it was, exactly: so that a log need not repeat the rest.

Two values are the same if they are so bit by bit: 0.0 and -0.0 are not, and NaN is itself.
"""

import dataclasses
import typing
from collections.abc import Mapping
from functools import cache
from typing import Any, TypeVar

import msgspec
import numpy as np

T = TypeVar("T")


def _listed(value: object) -> object:
    """What msgspec does not know: arrays, whose numbers are all that counts."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise NotImplementedError(f"a {type(value).__name__}")


_encode = msgspec.msgpack.Encoder(enc_hook=_listed).encode


def same(one: object, other: object) -> bool:
    """Whether they are so bit by bit; dataclasses, named tuples, arrays, and what is in them."""
    return one is other or _encode(one) == _encode(other)


def plain(value: object) -> Any:
    """The value in JSON's types; numbers that are not finite stay numbers."""
    return msgspec.to_builtins(value, enc_hook=_listed)


def changes(before: object, after: object) -> dict[str, Any]:
    """The fields of `after`, a dataclass, that are not as in `before`; name -> plain value.

    All of them if `before` is none of its kind. Of dataclasses in it, again the changes.
    """
    kind = type(after)
    known = type(before) is kind
    changed: dict[str, Any] = {}
    for name in _names(kind):
        now = getattr(after, name)
        was = getattr(before, name) if known else None
        if known and now is was:
            # Mostly: whoever replaces some fields keeps the others.
            continue
        if known and type(was) is type(now) and dataclasses.is_dataclass(now):
            if inner := changes(was, now):
                changed[name] = inner
        elif not (known and same(was, now)):
            changed[name] = plain(now)
    return changed


def changed(kind: type[T], before: T | None, told: Mapping[str, Any]) -> T:
    """What `before` has become by these `changes`; None: `told` is all of it.

    Numbers that are not finite may be text. Raises ValueError or TypeError if `told` does not fit.
    """
    hints = _hints(kind)
    values = {} if before is None else {name: getattr(before, name) for name in _names(kind)}
    for name, value in told.items():
        if name not in hints:
            raise ValueError(f"{kind.__name__} has no {name}")
        was = values.get(name)
        if was is not None and dataclasses.is_dataclass(was) and isinstance(value, Mapping):
            values[name] = changed(type(was), was, value)
        else:
            values[name] = _typed(value, hints[name])
    return kind(**values)


def _typed(value: object, hint: Any) -> Any:
    return msgspec.convert(value, hint, strict=False, dec_hook=_array)


def _array(_: type, value: object) -> object:
    return np.array(value, np.float64)


@cache
def _names(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(kind))


@cache
def _hints(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind, include_extras=True)
