"""Cards and revocations, which the fleet's authority signs: members, and keys no longer good.

A signed document is 64 bytes of Ed25519 signature and behind them JSON. The signature is over the
document's kind, so that none passes for another, and the JSON.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, TypeVar

import msgspec
from msgspec import Meta

from edge.identity.signature import (
    PUBLIC_KEY_BYTES,
    SIGNATURE_BYTES,
    Signer,
    fingerprint,
    is_signed,
)
from edge.messages.bounds import Count, Name, RobotId, UnixSeconds

MOST_REVOKED = 1000

PublicKey = Annotated[bytes, Meta(min_length=PUBLIC_KEY_BYTES, max_length=PUBLIC_KEY_BYTES)]
Fingerprint = Annotated[str, Meta(pattern="^[0-9a-f]{16}$")]


class CardError(ValueError):
    """It is no document of this fleet's authority; one line says why."""


class Role(StrEnum):
    """A robot speaks for itself, an operator for the ground; an observer asks for a hold only."""

    ROBOT = "robot"
    OPERATOR = "operator"
    OBSERVER = "observer"


@dataclass(frozen=True, slots=True)
class Card:
    """A member of a fleet and its public key.

    Of two cards for the same member the one with the greater `serial` counts. Once it has expired
    nobody takes off with it; whoever flies goes on.
    """

    fleet: Name
    role: Role
    name: Name
    public_key: PublicKey
    serial: Count
    expires_unix_s: UnixSeconds
    robot_id: RobotId | None = None

    def __post_init__(self) -> None:
        if (self.role is Role.ROBOT) != (self.robot_id is not None):
            raise ValueError(f"robot_id = {self.robot_id}: a robot has one, and nobody else")

    @property
    def fingerprint(self) -> bytes:
        """Its key's."""
        return fingerprint(self.public_key)

    @property
    def member(self) -> tuple[Role, str]:
        """Member that the card stands for."""
        return self.role, self.name if self.robot_id is None else str(self.robot_id)


@dataclass(frozen=True, slots=True)
class Revocations:
    """The fingerprints of keys that nobody listens to any more; of two lists the later counts."""

    count: Count
    fingerprints: Annotated[tuple[Fingerprint, ...], Meta(max_length=MOST_REVOKED)] = ()


T = TypeVar("T", Card, Revocations)
_encoder = msgspec.json.Encoder()


def signed(document: Card | Revocations, authority: Signer) -> bytes:
    """The document, signed."""
    text = _encoder.encode(document)
    return authority.sign(_context(type(document)) + text) + text


def verified(kind: type[T], data: bytes, authority: bytes) -> T:
    """The document of that kind in `data`, if the holder of the public key signed it.

    Raises CardError.
    """
    signature, text = data[:SIGNATURE_BYTES], data[SIGNATURE_BYTES:]
    if not is_signed(_context(kind) + text, signature, authority):
        raise CardError(f"{kind.__name__}: this fleet's authority has not signed it")
    try:
        return msgspec.json.decode(text, type=kind)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise CardError(f"{kind.__name__}: {error}") from None


def _context(kind: type[Card | Revocations]) -> bytes:
    return f"lpac {kind.__name__} 1\0".encode()
