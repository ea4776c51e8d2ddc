"""Envelope of every message: the sender, and in a fleet with keys the sender's signature.

Little-endian: 29 bytes before the payload, and the signature after it.

| offset | type | field |
| --- | --- | --- |
| 0 | 2 bytes | magic, `LE` |
| 2 | uint8 | version of this layout and the beacon's, 2 |
| 3 | 4 bytes | the sender's release |
| 7 | 4 bytes | digest of the sender's list of members; zeros in a fleet without keys |
| 11 | 8 bytes | fingerprint of the sender's key; zeros in a fleet without keys |
| 19 | uint48 | start of the sender's program: each is greater than the last |
| 25 | uint32 | sequence: one more than the last of that start on this topic |
| 29 | | the payload |
| -64 | 64 bytes | Ed25519 signature; absent in a fleet without keys |

The signature also covers the fleet's authority and the key expression, so that no message passes
for one of another fleet, topic or sender.
"""

import hashlib
import struct
from importlib.metadata import version
from typing import NamedTuple

from msgspec import Struct

from edge.identity.replay_window import MessageNumber
from edge.identity.signature import FINGERPRINT_BYTES, SIGNATURE_BYTES, Signer, is_signed

DIGEST_BYTES = 4
# The release of this program.
RELEASE = hashlib.sha256(version("lpac-edge").encode()).digest()[:DIGEST_BYTES]
NO_MEMBERS = bytes(DIGEST_BYTES)

_MAGIC = b"LE"
_VERSION = 2
_FIELDS = struct.Struct(f"<2sB{DIGEST_BYTES}s{DIGEST_BYTES}s{FINGERPRINT_BYTES}s6sI")
_NO_KEY = bytes(FINGERPRINT_BYTES)
HEAD_BYTES = _FIELDS.size
OVERHEAD_BYTES = HEAD_BYTES + SIGNATURE_BYTES


class Address(NamedTuple):
    """Context of a message: the fleet, by its authority's public key, and the key expression.

    `key` is the part below `lpac/<fleet>/`, such as robot/3/status.
    """

    authority: bytes
    key: str

    def signed_text(self, sealed: bytes) -> bytes:
        """Bytes that the signature of a message covers."""
        return b"".join((b"lpac envelope 2\0", self.authority, self.key.encode(), b"\0", sealed))


class Head(Struct, frozen=True):
    """The fields before a message's payload."""

    release: bytes
    members: bytes
    fingerprint: bytes
    number: MessageNumber

    @property
    def is_signed(self) -> bool:
        """Whether the sender has a key."""
        return self.fingerprint != _NO_KEY


class Envelope(Struct, frozen=True):
    """A message as received: `is_from` verifies its sender."""

    head: Head
    data: bytes

    @property
    def payload(self) -> bytes:
        """The payload."""
        return self.data[HEAD_BYTES : -SIGNATURE_BYTES if self.head.is_signed else None]

    def is_from(self, public_key: bytes, address: Address) -> bool:
        """Whether the key's owner signed this message for that address."""
        sealed, signature = self.data[:-SIGNATURE_BYTES], self.data[-SIGNATURE_BYTES:]
        return is_signed(address.signed_text(sealed), signature, public_key)


def seal(
    payload: bytes,
    *,
    signer: Signer,
    address: Address,
    number: MessageNumber,
    members: bytes = NO_MEMBERS,
    release: bytes = RELEASE,
) -> bytes:
    """The payload in a signed envelope."""
    sealed = _head(release, members, signer.fingerprint, number) + payload
    return sealed + signer.sign(address.signed_text(sealed))


def enclose(payload: bytes, number: MessageNumber, *, release: bytes = RELEASE) -> bytes:
    """The payload in the unsigned envelope of a fleet without keys."""
    return _head(release, NO_MEMBERS, _NO_KEY, number) + payload


def _head(release: bytes, members: bytes, fingerprint: bytes, number: MessageNumber) -> bytes:
    start = number.start.to_bytes(6, "little")
    return _FIELDS.pack(_MAGIC, _VERSION, release, members, fingerprint, start, number.sequence)


def read_head(data: bytes) -> Head | None:
    """The head at the start of `data`; None if there is none of this version. Raises nothing."""
    if len(data) < HEAD_BYTES:
        return None
    magic, layout, release, members, fingerprint, start, sequence = _FIELDS.unpack_from(data)
    if magic != _MAGIC or layout != _VERSION:
        return None
    number = MessageNumber(int.from_bytes(start, "little"), sequence)
    return Head(release, members, fingerprint, number)


def is_of_other_version(data: bytes) -> bool:
    """Whether `data` is an envelope of another version of this layout."""
    return data.startswith(_MAGIC) and data[len(_MAGIC) : len(_MAGIC) + 1] != bytes((_VERSION,))


def read_envelope(data: bytes) -> Envelope | None:
    """The envelope in `data`; None if there is none of this version. Raises nothing."""
    head = read_head(data)
    if head is None or (head.is_signed and len(data) < OVERHEAD_BYTES):
        return None
    return Envelope(head, data)
