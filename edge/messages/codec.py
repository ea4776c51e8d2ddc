"""Messages <-> JSON. A message with a malformed or out-of-bounds value is refused whole.

Unknown keys, from another release, are ignored. A missing key has its default; a `GroundState` must
have all keys.
"""

import dataclasses
from contextlib import suppress
from typing import Any, TypeVar

import msgspec

from edge.core.schema import explain
from edge.messages.mission import GroundState

T = TypeVar("T")

# A default in place of the ground's request could be unsafe.
_KEYS_OF_STATE = frozenset(field.name for field in dataclasses.fields(GroundState))

_encoder = msgspec.json.Encoder()
_keys = msgspec.json.Decoder(dict[str, msgspec.Raw])
_decoders: dict[type, "msgspec.json.Decoder[Any]"] = {}


class MessageError(ValueError):
    """A message that cannot be decoded; one line says why."""


def encode(message: object) -> bytes:
    """The message as one JSON object, UTF-8."""
    return _encoder.encode(message)


def decode(kind: type[T], data: bytes | msgspec.Raw) -> T:
    """The message of type `kind` in `data`. Raises MessageError."""
    try:
        if kind is GroundState and (missing := _KEYS_OF_STATE - _keys.decode(data).keys()):
            raise MessageError(f"{kind.__name__}: {', '.join(sorted(missing))} is missing")
        return _decoder(kind).decode(data)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise MessageError(_why(error, kind, data)) from None


def _decoder(kind: type[T]) -> "msgspec.json.Decoder[T]":
    if kind not in _decoders:
        _decoders[kind] = msgspec.json.Decoder(kind)
    return _decoders[kind]


def _why(error: Exception, kind: type[Any], data: bytes | msgspec.Raw) -> str:
    """Why `data` is no message of that kind: key, value and bounds, where known."""
    if isinstance(error, msgspec.ValidationError):
        with suppress(msgspec.MsgspecError, RecursionError):
            return explain(error, kind, msgspec.json.decode(data), kind.__name__)
    return f"{kind.__name__}: {error}"
