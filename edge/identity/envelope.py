"""Envelope of every message: its sender, and the sender's signature.

Little-endian, 21 bytes before the payload and 64 behind it:

| offset | type | field |
| --- | --- | --- |
| 0 | 2 bytes | magic, `LE` |
| 2 | uint8 | version of this layout, 1 |
| 3 | 8 bytes | the sender's key, by its fingerprint |
| 11 | uint48 | the start of its program: each is greater than the last |
| 17 | uint32 | sequence: each is greater than the last of that start on this topic |
| 21 | | the payload |
| -64 | 64 bytes | Ed25519 signature |

The signature is over the fleet's authority and the key expression too, so that no message passes
for one of another fleet, topic or sender.
"""

import struct
from typing import NamedTuple

from edge.identity.signature import FINGERPRINT_BYTES, SIGNATURE_BYTES, Signer, is_signed

_MAGIC = b"LE"
_VERSION = 1
_FIELDS = struct.Struct(f"<2sB{FINGERPRINT_BYTES}s6sI")
OVERHEAD_BYTES = _FIELDS.size + SIGNATURE_BYTES


class Address(NamedTuple):
    """Context of a message: the fleet, by its authority's public key, and the key expression.

    `key` is the part below `lpac/<fleet>/`, such as robot/3/status.
    """

    authority: bytes
    key: str

    def signed_text(self, sealed: bytes) -> bytes:
        """Bytes that the signature of a message covers."""
        return b"".join((b"lpac envelope 1\0", self.authority, self.key.encode(), b"\0", sealed))


class Envelope(NamedTuple):
    """A message as it came; whether its sender said so is for `is_from` to tell."""

    fingerprint: bytes
    start: int
    sequence: int
    data: bytes

    @property
    def payload(self) -> bytes:
        """The payload."""
        return self.data[_FIELDS.size : -SIGNATURE_BYTES]

    def is_from(self, public_key: bytes, address: Address) -> bool:
        """Whether the key's owner said just that there."""
        sealed, signature = self.data[:-SIGNATURE_BYTES], self.data[-SIGNATURE_BYTES:]
        return is_signed(address.signed_text(sealed), signature, public_key)


def seal(payload: bytes, *, signer: Signer, address: Address, start: int, sequence: int) -> bytes:
    """The payload in its envelope."""
    start_bytes = start.to_bytes(6, "little")
    head = _FIELDS.pack(_MAGIC, _VERSION, signer.fingerprint, start_bytes, sequence)
    sealed = head + payload
    return sealed + signer.sign(address.signed_text(sealed))


def read_envelope(data: bytes) -> Envelope | None:
    """The envelope in `data`; None if there is none of this version. Raises nothing."""
    if len(data) < OVERHEAD_BYTES:
        return None
    magic, version, fingerprint, start, sequence = _FIELDS.unpack_from(data)
    if magic != _MAGIC or version != _VERSION:
        return None
    return Envelope(fingerprint, int.from_bytes(start, "little"), sequence, data)
