"""Multicast messages: one to three datagrams each, encrypted with the fleet's group key.

The group key keeps non-members out. Each robot has it, so the sender is authenticated by the
envelope inside (`edge.identity.envelope`).

A datagram, little-endian:

| offset | type | field |
| --- | --- | --- |
| 0 | 2 bytes | magic, `LG` |
| 2 | uint8 | version of this layout, 3 |
| 3 | 4 bytes | fingerprint of the key |
| 7 | 24 bytes | nonce, random |
| 31 | 16 bytes | Poly1305 authentication tag |
| 47 | | a fragment, encrypted with XSalsa20 |

A fragment:

| offset | type | field |
| --- | --- | --- |
| 0 | uint16 | the sender's robot id |
| 2 | uint8 | index of the fragment, from 0 |
| 3 | uint8 | count of the message's fragments |
| 4 | 29 bytes | head of the message's envelope: the same in each fragment |
| 33 | | part of the remaining envelope |
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
from edge.identity.replay_window import NO_NUMBER, MessageNumber, ReplayWindow

KEY_BYTES: int = crypto_secretbox_KEYBYTES
MOST_FRAGMENTS = 3
# A frame of 1500 bytes, less the headers of IPv4 and UDP.
DATAGRAM_BYTES = 1472

_MAGIC, _VERSION = b"LG", 3
_FINGERPRINT_BYTES, _TAG_BYTES = 4, 16
_HEAD = struct.Struct(f"<2sB{_FINGERPRINT_BYTES}s{crypto_secretbox_NONCEBYTES}s")
_FRAGMENT = struct.Struct(f"<HBB{HEAD_BYTES}s")
PART_BYTES = DATAGRAM_BYTES - _HEAD.size - _TAG_BYTES - _FRAGMENT.size
MOST_BYTES = HEAD_BYTES + MOST_FRAGMENTS * PART_BYTES
# Fragments arrive one after another: with a fourth incomplete message, one has lost a fragment.
_MOST_PARTIAL = 3
# More than the robots of the largest fleet with certificates.
_MOST_SENDERS = 300


class GroupKey(NamedTuple):
    """A key that all robots of a fleet have, and its fingerprint."""

    secret: bytes
    fingerprint: bytes

    @classmethod
    def of(cls, secret: bytes) -> "GroupKey":
        """The key with this secret. Raises ValueError if it is not 32 bytes."""
        if len(secret) != KEY_BYTES:
            raise ValueError(f"a group key has {len(secret)} bytes: must be {KEY_BYTES}")
        return cls(secret, hashlib.sha256(b"lpac group\0" + secret).digest()[:_FINGERPRINT_BYTES])


def open_fleet_key(fleet: str) -> bytes:
    """Group key of a fleet without keys: not secret, it only separates fleets."""
    return hashlib.sha256(f"lpac open fleet {fleet}".encode()).digest()


class Fragment(NamedTuple):
    """A part of a message from a member; `key` is the index of its key among those known."""

    key: int
    sender: int
    part_index: int
    part_count: int
    head: bytes
    number: MessageNumber
    part: bytes


def frames(message_bytes: float) -> int:
    """Number of datagrams that a message of that size takes; more than three are not sent."""
    return max(1, math.ceil((message_bytes - HEAD_BYTES) / PART_BYTES))


def datagrams(message: bytes, *, sender: int, key: GroupKey) -> list[bytes]:
    """Datagrams of a message in its envelope. Raises ValueError if it takes more than three."""
    count = frames(len(message))
    if count > MOST_FRAGMENTS:
        raise ValueError(f"a message of {len(message)} bytes: a group takes {MOST_BYTES} at most")
    envelope_head = message[:HEAD_BYTES]
    sealed = []
    for index in range(count):
        at = HEAD_BYTES + index * PART_BYTES
        fragment = _FRAGMENT.pack(sender, index, count, envelope_head)
        nonce = randombytes(crypto_secretbox_NONCEBYTES)
        head = _HEAD.pack(_MAGIC, _VERSION, key.fingerprint, nonce)
        part = message[at : at + PART_BYTES]
        sealed.append(head + crypto_secretbox(fragment + part, nonce, key.secret))
    return sealed


def open_datagram(data: bytes, keys: Sequence[GroupKey]) -> Fragment | None:
    """The fragment in a datagram; None unless a member sent it in this version. Raises nothing."""
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
    sender, index, count, envelope_head = _FRAGMENT.unpack_from(opened)
    head = read_head(envelope_head)
    if not index < count <= MOST_FRAGMENTS or not (head or is_of_other_version(envelope_head)):
        return None
    part = opened[_FRAGMENT.size :]
    number = head.number if head else NO_NUMBER
    return Fragment(which, sender, index, count, envelope_head, number, part)


# Number, head, count and key: fragments that differ in any belong to different messages.
_MessageKey = tuple[MessageNumber, bytes, int, int]


@dataclass(slots=True)
class _Sender:
    """State of one sender; `key` is the newest that it has used."""

    window: ReplayWindow = field(default_factory=ReplayWindow)
    newest_at_s: float = -math.inf
    key: int = sys.maxsize
    partial: dict[_MessageKey, dict[int, bytes]] = field(default_factory=dict)


class Assembly:
    """Reassembles messages from fragments. One thread at a time.

    Fragments not newer than the last confirmed message are dropped as replays or duplicates. So are
    those with a former key from a sender that has used a newer one: a thief may have the former
    key. `old` counts both. A number counts only after `confirm`.

    `forget_after_s`: a sender that was silent for longer may return with a smaller number, having
    restarted with a clock that is behind. Members number their starts so that this never happens
    (math.inf).
    """

    def __init__(self, forget_after_s: float = math.inf) -> None:
        self._forget_after_s = forget_after_s
        self._senders: dict[int, _Sender] = {}
        self.old = 0

    def add(self, fragment: Fragment, now_s: float, unix_s: float | None = None) -> bytes | None:
        """The message that the fragment completes; None if it completes none.

        `now_s` is a monotonic clock's, `unix_s` the wall clock's, as for `ReplayWindow`.
        """
        sender = self._sender(fragment)
        silent = now_s - sender.newest_at_s > self._forget_after_s
        is_replay = sender.window.is_replay(fragment.number, now_s, unix_s)
        if (is_replay and not silent) or fragment.key > sender.key:
            self.old += 1
            return None
        if fragment.part_count == 1:
            return fragment.head + fragment.part
        key = fragment.number, fragment.head, fragment.part_count, fragment.key
        parts = sender.partial.setdefault(key, {})
        parts[fragment.part_index] = fragment.part
        if len(parts) == fragment.part_count:
            del sender.partial[key]
            return fragment.head + b"".join(part for _, part in sorted(parts.items()))
        if len(sender.partial) > _MOST_PARTIAL:
            # The first to begin has lost a fragment.
            del sender.partial[next(iter(sender.partial))]
        return None

    def confirm(self, fragment: Fragment, now_s: float) -> None:
        """Record the number of an authenticated message, which this fragment completed."""
        sender = self._sender(fragment)
        sender.window.accept(fragment.number, now_s)
        sender.newest_at_s = now_s
        sender.key = min(sender.key, fragment.key)
        sender.partial = {
            key: parts for key, parts in sender.partial.items() if key[0] > fragment.number
        }

    def _sender(self, fragment: Fragment) -> _Sender:
        sender_id, senders = fragment.sender, self._senders
        if sender_id not in senders:
            if len(senders) >= _MOST_SENDERS:
                # A member may claim any number of ids: forget first those without a confirmed
                # message, and then the longest silent.
                del senders[min(senders, key=lambda each: senders[each].newest_at_s)]
            senders[sender_id] = _Sender()
        return senders[sender_id]
