"""Messages <-> JSON. What is out of its bounds, or cannot be understood, is refused whole.

Programs one release apart talk to each other. Keys that a receiver does not know it ignores,
unless the sender lists them in `must_understand`. In what a robot says of itself, missing keys have
defaults; in what the ground says, whatever keeps a robot safe must be there.
"""

import dataclasses
from contextlib import suppress
from typing import Any, TypeVar

import msgspec

from edge.core.schema import explain
from edge.messages.mission import GroundState, Order

T = TypeVar("T")

# Everything that decides about a flight; a state that lacks one says nothing that can be relied on.
_MUST_BE_THERE: dict[type, frozenset[str]] = {
    GroundState: frozenset(
        {
            "sequence", "operator", "origin", "enabled", "robot_enabled", "safety_action",
            "robot_safety_actions", "fence", "places", "world_id", "trial", "waiting", "version",
        }
    ),
    Order: frozenset(
        {
            "order_id", "robot_id", "boot_nonce", "kind", "expires_at_uptime_s", "operator",
            "trial", "version",
        }
    ),
}  # fmt: skip

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
        required = _MUST_BE_THERE.get(kind)
        if required is not None:
            missing = required - _keys.decode(data).keys()
            if missing:
                raise MessageError(f"{kind.__name__}: {', '.join(sorted(missing))} is missing")
        message = _decoder(kind).decode(data)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise MessageError(_why(error, kind, data)) from None
    asked = set(getattr(message, "must_understand", ()))
    if asked and (unknown := asked - {field.name for field in dataclasses.fields(kind)}):  # type: ignore[arg-type]
        names = ", ".join(sorted(unknown))
        raise MessageError(f"{kind.__name__}: {names}: this program is too old to know")
    return message


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
