"""Messages <-> JSON. What is out of its bounds, or cannot be understood, is refused whole.

Of another release's messages, what is not known here is ignored. A missing key has its default, but
in a ground's state each must be there.
"""

import dataclasses
from contextlib import suppress
from typing import Any, TypeVar

import msgspec

from edge.core.schema import explain
from edge.messages.mission import GroundState

T = TypeVar("T")

# A state that lacks something says nothing that can be relied on.
_KEYS_OF_STATE = frozenset(field.name for field in dataclasses.fields(GroundState))

_encoder = msgspec.json.Encoder()
_keys = msgspec.json.Decoder(dict[str, msgspec.Raw])
_decoders: dict[type, "msgspec.json.Decoder[Any]"] = {}


class MessageError(ValueError):
    """A message that is not understood; one line says why."""


def encode(message: object) -> bytes:
    """The message as one JSON object, UTF-8."""
    return _encoder.encode(message)


def decode(kind: type[T], data: bytes | msgspec.Raw) -> T:
    """The message of that kind in `data`. Raises MessageError."""
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
    """Why something is no message of that kind: where it can be told, key, value and bounds."""
    if isinstance(error, msgspec.ValidationError):
        with suppress(msgspec.MsgspecError, RecursionError):
            return explain(error, kind, msgspec.json.decode(data), kind.__name__)
    return f"{kind.__name__}: {error}"
