"""Messages to all robots at once: one datagram, or up to three, sealed with the fleet's group key.

Who is not a member reads none of it, and nothing of his is listened to. Who said it is for the
envelope inside to tell (`edge.identity.envelope`): any member has the key.

A datagram, little-endian:

| offset | type | field |
| --- | --- | --- |
| 0 | 2 bytes | magic, `LG` |
| 2 | uint8 | version of this layout, 3 |
| 3 | 4 bytes | the key, by its fingerprint |
| 7 | 24 bytes | nonce, random |
| 31 | 16 bytes | Poly1305 authentication tag |
| 47 | | a fragment, encrypted by XSalsa20 |

A fragment:

| offset | type | field |
| --- | --- | --- |
| 0 | uint16 | the sender's robot id |
| 2 | uint8 | which fragment of the message, from 0 |
| 3 | uint8 | how many it has |
| 4 | 29 bytes | head of the message's envelope: the same in each of its fragments |
| 33 | | its part of what is behind that |
"""

import hashlib
import math
import struct
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from nacl.bindings import (
    crypto_secretbox,
    crypto_secretbox_KEYBYTES,
    crypto_secretbox_NONCEBYTES,
    crypto_secretbox_open,
    randombytes,
)
from nacl.exceptions import CryptoError

from edge.identity.envelope import HEAD_BYTES, is_of_other_version, read_head
from edge.identity.news import NOTHING, MessageNumber, Newest

KEY_BYTES: int = crypto_secretbox_KEYBYTES
MOST_FRAGMENTS = 3
# What fits into one frame of 1500 bytes, behind the headers of IPv4 and UDP.
DATAGRAM_BYTES = 1472

_MAGIC, _VERSION = b"LG", 3
_FINGERPRINT_BYTES, _TAG_BYTES = 4, 16
_HEAD = struct.Struct(f"<2sB{_FINGERPRINT_BYTES}s{crypto_secretbox_NONCEBYTES}s")
_FRAGMENT = struct.Struct(f"<HBB{HEAD_BYTES}s")
PART_BYTES = DATAGRAM_BYTES - _HEAD.size - _TAG_BYTES - _FRAGMENT.size
MOST_BYTES = HEAD_BYTES + MOST_FRAGMENTS * PART_BYTES
# A sender's fragments come one after another; a fourth message in pieces means that one is lost.
_MOST_PARTIAL = 3
# Each robot of the largest fleet with certificates, and some.
_MOST_SENDERS = 300


class GroupKey(NamedTuple):
    """A key that all robots of a fleet have, and what it is called."""

    secret: bytes
    fingerprint: bytes

    @classmethod
    def of(cls, secret: bytes) -> "GroupKey":
        """Raises ValueError if it is not 32 bytes."""
        if len(secret) != KEY_BYTES:
            raise ValueError(f"a group key has {len(secret)} bytes: must be {KEY_BYTES}")
        return cls(secret, hashlib.sha256(b"lpac group\0" + secret).digest()[:_FINGERPRINT_BYTES])


def key_of_open_fleet(fleet: str) -> bytes:
    """Group key of a fleet without keys: it keeps fleets apart, and nothing secret."""
    return hashlib.sha256(f"lpac open fleet {fleet}".encode()).digest()


class Fragment(NamedTuple):
    """A part of a message, as a member sent it; `key` is the place of its key among those known."""

    key: int
    sender: int
    place: int
    of: int
    head: bytes
    number: MessageNumber
    part: bytes


def frames(message_bytes: float) -> int:
    """How many datagrams a message of so many bytes takes; more than three are not sent."""
    return max(1, math.ceil((message_bytes - HEAD_BYTES) / PART_BYTES))


def datagrams(message: bytes, *, sender: int, key: GroupKey) -> list[bytes]:
    """The message, which has an envelope, in datagrams.

    Raises ValueError for one that takes more than three.
    """
    count = frames(len(message))
    if count > MOST_FRAGMENTS:
        raise ValueError(f"a message of {len(message)} bytes: a group takes {MOST_BYTES} at most")
    envelope_head = message[:HEAD_BYTES]
    sealed = []
    for place in range(count):
        at = HEAD_BYTES + place * PART_BYTES
        fragment = _FRAGMENT.pack(sender, place, count, envelope_head)
        nonce = randombytes(crypto_secretbox_NONCEBYTES)
        head = _HEAD.pack(_MAGIC, _VERSION, key.fingerprint, nonce)
        part = message[at : at + PART_BYTES]
        sealed.append(head + crypto_secretbox(fragment + part, nonce, key.secret))
    return sealed


def open_datagram(data: bytes, keys: Sequence[GroupKey]) -> Fragment | None:
    """The fragment in a datagram; None if no member sent it, or in another way. Raises nothing."""
    if not _HEAD.size + _TAG_BYTES + _FRAGMENT.size <= len(data) <= DATAGRAM_BYTES:
        return None
    magic, version, fingerprint, nonce = _HEAD.unpack_from(data)
    which = next((i for i, key in enumerate(keys) if key.fingerprint == fingerprint), None)
    if magic != _MAGIC or version != _VERSION or which is None:
        return None
    try:
        opened: bytes = crypto_secretbox_open(data[_HEAD.size :], nonce, keys[which].secret)
    except CryptoError:
        return None
    sender, place, of, envelope_head = _FRAGMENT.unpack_from(opened)
    head = read_head(envelope_head)
    if not place < of <= MOST_FRAGMENTS or not (head or is_of_other_version(envelope_head)):
        return None
    part = opened[_FRAGMENT.size :]
    number = head.number if head else NOTHING
    return Fragment(which, sender, place, of, envelope_head, number, part)


# Pieces that say otherwise of their message are of another one: its number and the head that it is
# from, of how many pieces it is, and the key.
_Pieces = tuple[MessageNumber, bytes, int, int]


@dataclass(slots=True)
class _Sender:
    """Parts of one sender's messages; `key` is the newest that it spoke with."""

    newest: Newest = field(default_factory=Newest)
    newest_at_s: float = -math.inf
    key: int = sys.maxsize
    partial: dict[_Pieces, dict[int, bytes]] = field(default_factory=dict)


class Assembly:
    """Makes messages of fragments: all of them, or nothing. One thread at a time.

    What is not newer than what `heard` was told of is old, and dropped unseen: whatever a stranger
    recorded and says again, and what came twice. So is what comes with a former key from a sender
    who has the new one: it is who stole the former. A number counts once the message is known to be
    its sender's.

    `forget_after_s`: who was silent for longer may have started again with a clock that is behind.
    Members' starts are numbered so that they never are (math.inf).
    """

    def __init__(self, forget_after_s: float = math.inf) -> None:
        self._forget_after_s = forget_after_s
        self._senders: dict[int, _Sender] = {}
        self.old = 0

    def add(self, fragment: Fragment, now_s: float, unix_s: float | None = None) -> bytes | None:
        """The message that the fragment completes, if it does.

        `now_s` is a monotonic clock's, `unix_s` the wall clock's, as `Newest` takes them.
        """
        sender = self._sender(fragment)
        silent = now_s - sender.newest_at_s > self._forget_after_s
        is_older = sender.newest.is_older(fragment.number, now_s, unix_s)
        if (is_older and not silent) or fragment.key > sender.key:
            self.old += 1
            return None
        if fragment.of == 1:
            return fragment.head + fragment.part
        which = fragment.number, fragment.head, fragment.of, fragment.key
        parts = sender.partial.setdefault(which, {})
        parts[fragment.place] = fragment.part
        if len(parts) == fragment.of:
            del sender.partial[which]
            return fragment.head + b"".join(part for _, part in sorted(parts.items()))
        if len(sender.partial) > _MOST_PARTIAL:
            # The one that began first: its rest is lost.
            del sender.partial[next(iter(sender.partial))]
        return None

    def heard(self, fragment: Fragment, now_s: float) -> None:
        """The message that this fragment completed was its sender's, and so is its number."""
        sender = self._sender(fragment)
        sender.newest.hear(fragment.number, now_s)
        sender.newest_at_s = now_s
        sender.key = min(sender.key, fragment.key)
        sender.partial = {
            which: parts for which, parts in sender.partial.items() if which[0] > fragment.number
        }

    def _sender(self, fragment: Fragment) -> _Sender:
        who, senders = fragment.sender, self._senders
        if who not in senders:
            if len(senders) >= _MOST_SENDERS:
                # A member may claim any number of ids: those go first of which nothing was heard,
                # and then who was silent for longest.
                del senders[min(senders, key=lambda each: senders[each].newest_at_s)]
            senders[who] = _Sender()
        return senders[who]
