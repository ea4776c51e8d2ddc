"""Sign what a node publishes, and authenticate what it receives.

A message's sender is decided here, before anything is decoded and whichever link delivered it.
"""

import math
from abc import ABC, abstractmethod
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from threading import Lock

from msgspec import Struct

from edge.core.logger import log
from edge.identity.envelope import (
    NO_MEMBERS,
    RELEASE,
    Address,
    Envelope,
    Head,
    enclose,
    is_of_other_version,
    read_envelope,
    seal,
)
from edge.identity.members import Member, Members, Role, number_of
from edge.identity.replay_window import NO_NUMBER, MessageNumber, ReplayWindow
from edge.identity.signature import Signer
from edge.messages.topics import HOLD, Link, ReceiveCallback, Topic, robot_id_in

# After a cut, TCP delivers data that is up to 2 s old; nothing is in transit longer than this.
LONGEST_TRANSIT_S = 5.0
_MOST_NAMED = 4
# A wrong time zone sets a clock ahead by less than this; a clock that lost its time is behind.
_MOST_AHEAD_MS = 24 * 3600e3


class Sender(Struct, frozen=True):
    """Sender of a message: `name` is from the list of members, "" in a fleet without keys.

    `number` is the message's, `release` the sender's, `members` the digest of the sender's list.
    """

    role: Role
    name: str
    number: MessageNumber = NO_NUMBER
    release: bytes = RELEASE
    members: bytes = NO_MEMBERS

    @classmethod
    def of(cls, role: Role, name: str, head: Head) -> "Sender":
        """The sender of a message with that head."""
        return cls(role, name, head.number, head.release, head.members)


# Takes the key below `lpac/<fleet>/`, the payload and the sender; called from any thread.
MessageHandler = Callable[[str, bytes, Sender], None]


class RefusedMessage(StrEnum):
    """Reason to refuse a message."""

    NO_ENVELOPE = "no_envelope"
    UNKNOWN_KEY = "unknown_key"
    NOT_ALLOWED = "not_allowed"
    FORGED = "forged"
    REPLAYED = "replayed"
    START_AHEAD = "start_ahead"
    COMPRESSION = "compression"


@dataclass(slots=True)
class _Stream:
    """State of one member's messages on one key; all times are a monotonic clock's, s."""

    window: ReplayWindow = field(default_factory=ReplayWindow)
    newest_s: float = -math.inf
    # Digest of the member's list in its newest message.
    members: bytes = NO_MEMBERS
    # About one newest number a second, back to the longest transit ago.
    history: deque[tuple[float, MessageNumber]] = field(default_factory=deque)
    # Messages older than the newest: when they began, the last one's time, the greatest number.
    late_since_s: float = -math.inf
    late_s: float = -math.inf
    late: MessageNumber = NO_NUMBER
    # Time of the last message too late to have been in transit: a second program sent it.
    duplicate_s: float = -math.inf

    def accept(self, head: Head, now_s: float) -> None:
        """Record the newest message."""
        number = head.number
        self.window.accept(number, now_s)
        self.newest_s, self.members = now_s, head.members
        if not self.history or now_s - self.history[-1][0] >= 1.0:
            self.history.append((now_s, number))
        while len(self.history) > 1 and now_s - self.history[1][0] > LONGEST_TRANSIT_S:
            self.history.popleft()

    def record_late(self, number: MessageNumber, now_s: float) -> None:
        """Record a message older than the newest, to detect two programs with one key.

        Only the program that started last is accepted.
        """
        if now_s - self.late_s > LONGEST_TRANSIT_S:
            self.late_since_s, self.late = now_s, NO_NUMBER
        if number <= self.late:
            return
        self.late_s, self.late = now_s, number
        accepted = [*self.history, (self.newest_s, self.window.number)]
        settled = [n for at_s, n in accepted if now_s - at_s > LONGEST_TRANSIT_S]
        persists = now_s - self.late_since_s > LONGEST_TRANSIT_S
        if persists and settled and number <= settled[-1]:
            self.duplicate_s = now_s


class Guard(ABC):
    """Interface through which a node publishes and receives. Call its methods from any thread.

    The defaults are those of a fleet without keys, which has no list of members.
    """

    def __init__(self, release: bytes) -> None:
        self.release = release
        self._lock = Lock()
        self._sequences: Counter[str] = Counter()
        self._refused: Counter[RefusedMessage] = Counter()
        self._unreadable_robots: set[int] = set()

    @property
    def role(self) -> Role | None:
        """This program's role; None where messages are not signed."""
        return None

    def subscriptions(
        self, handlers: Mapping[Topic, MessageHandler]
    ) -> dict[Topic, ReceiveCallback]:
        """Callbacks for the link: they pass authenticated messages to the handlers."""
        return {topic: partial(self._receive, topic, each) for topic, each in handlers.items()}

    def wrap(self, link: Link) -> Link:
        """A link that seals messages and publishes them on this one."""
        return _SealingLink(self, link)

    @abstractmethod
    def seal(self, topic: Topic, payload: bytes) -> bytes:
        """The payload in this sender's envelope."""

    def is_member(self) -> bool:
        """Whether the list of members has this program's key; else all members refuse it."""
        return True

    def members_differ(self) -> str:
        """Describe which recent senders have another list of members; "" if none has."""
        return ""

    def revoked_robots(self) -> frozenset[int]:
        """Robots of an earlier list of members: they are refused, and may still fly."""
        return frozenset()

    def duplicate_robots(self) -> frozenset[int]:
        """Robots whose key two programs use, this robot included."""
        return frozenset()

    def robots_with_future_start(self) -> frozenset[int]:
        """Robots whose start number is more than a day ahead of the clock: refused."""
        return frozenset()

    def receive_time(self, unix_s: float) -> None:  # noqa: B027  (no use in an open fleet)
        """Take a lower bound of the wall-clock time; starts a day beyond it are refused."""

    def pop_unreadable_robots(self) -> set[int]:
        """Robots that sent envelopes of another version since the last call."""
        with self._lock:
            robots, self._unreadable_robots = self._unreadable_robots, set()
        return robots

    def refused(self) -> dict[str, int]:
        """Counts of refused messages, by `RefusedMessage`."""
        with self._lock:
            return {reason.value: count for reason, count in self._refused.items()}

    @abstractmethod
    def _authenticate(
        self, topic: Topic, key: str, envelope: Envelope
    ) -> tuple[bytes, Sender] | RefusedMessage:
        """Payload and sender of a message received on that key."""

    def _receive(self, topic: Topic, handler: MessageHandler, key: str, data: bytes) -> bool:
        robot_id = robot_id_in(key)
        if topic.sender == "robot" and robot_id is None:
            self._refuse(RefusedMessage.NOT_ALLOWED, key)
            return False
        envelope = read_envelope(data)
        found: tuple[bytes, Sender] | RefusedMessage = RefusedMessage.NO_ENVELOPE
        if envelope is not None:
            found = self._authenticate(topic, key, envelope)
        elif robot_id is not None and is_of_other_version(data):
            # Its signature cannot be verified here: the robot may not have sent it.
            with self._lock:
                self._unreadable_robots.add(robot_id)
        if isinstance(found, RefusedMessage):
            self._refuse(found, key)
            return False
        payload = topic.unpacked(found[0])
        if payload is None:
            self._refuse(RefusedMessage.COMPRESSION, key)
            return False
        handler(key, payload, found[1])
        return True

    def _refuse(self, reason: RefusedMessage, key: str) -> None:
        with self._lock:
            self._refused[reason] += 1
            first = self._refused[reason] == 1
        if first:
            log.warning("message refused", why=reason.value, key=key)

    def _next_sequence(self, key: str) -> int:
        with self._lock:
            self._sequences[key] += 1
            return self._sequences[key]


class Unguarded(Guard):
    """Guard of a fleet without keys: a message's sender is the one that its key names.

    For a radio that nobody else can reach. `start` is greater than at each earlier start of the
    program.
    """

    def __init__(self, start: int, release: bytes = RELEASE) -> None:
        super().__init__(release)
        self._start = start

    def seal(self, topic: Topic, payload: bytes) -> bytes:
        """See `Guard`."""
        number = MessageNumber(self._start, self._next_sequence(topic.pattern))
        return enclose(topic.packed(payload), number, release=self.release)

    def _authenticate(
        self, topic: Topic, key: str, envelope: Envelope
    ) -> tuple[bytes, Sender] | RefusedMessage:
        if envelope.head.is_signed:
            return RefusedMessage.NO_ENVELOPE
        role = Role.ROBOT if key.startswith("robot/") else Role.OPERATOR
        return envelope.payload, Sender.of(role, "", envelope.head)


@dataclass(frozen=True, slots=True)
class Membership:
    """One program's membership in its fleet.

    `own` is its own member, `members` the list at the start, `start` a number greater than at each
    earlier start of the program.
    """

    own: Member
    signer: Signer
    members: Members
    start: int


class SignedGuard(Guard):
    """The guard of a member: it refuses senders that are not in `members`, the present list."""

    def __init__(
        self, membership: Membership, clock_s: Callable[[], float], release: bytes = RELEASE
    ) -> None:
        super().__init__(release)
        self.members = membership.members
        self._own = membership.own
        self._signer = membership.signer
        self._start = membership.start
        self._clock_s = clock_s
        self._revoked: frozenset[int] = frozenset()
        self._streams: defaultdict[tuple[bytes, str], _Stream] = defaultdict(_Stream)
        # Time of each key's last start ahead of the clock, and of a later start of the own key.
        self._future_start_s: dict[bytes, float] = {}
        self._own_key_s = -math.inf
        # The wall clock minus the monotonic one; None until known.
        self._unix_offset_s: float | None = None

    def update_members(self, members: Members) -> None:
        """Replace the list of members by a newer one. Raises MembersError if it is none."""
        with self._lock:
            self.members.require_newer(members)
            if members != self.members:
                former = self._revoked | self.members.robot_ids
                self._revoked, self.members = former - members.robot_ids, members

    @property
    def role(self) -> Role:
        """See `Guard`."""
        return self._own.role

    def is_member(self) -> bool:
        """See `Guard`."""
        listed = self.members.by_key.get(self._own.fingerprint)
        return listed is not None and listed.place == self._own.place

    def members_differ(self) -> str:
        """See `Guard`."""
        since_s, members = self._clock_s() - LONGEST_TRANSIT_S, self.members
        newest: dict[bytes, _Stream] = {}
        with self._lock:
            for (key, _), stream in self._streams.items():
                if stream.newest_s >= max(since_s, newest.get(key, stream).newest_s):
                    newest[key] = stream
        others = [
            f"{sender.name} has {_compared(number_of(newest[key].members), members.number)}"
            for key, sender in members.by_key.items()
            if key in newest and newest[key].members != members.digest
        ]
        if not others:
            return ""
        more = [f"and {len(others) - _MOST_NAMED} more"] if len(others) > _MOST_NAMED else []
        differ = ", ".join(others[:_MOST_NAMED] + more)
        return f"the list of members here is {members.number}, and {differ}: run `lpac fleet up`"

    def revoked_robots(self) -> frozenset[int]:
        """See `Guard`."""
        return self._revoked

    def duplicate_robots(self) -> frozenset[int]:
        """See `Guard`."""
        since_s = self._clock_s() - LONGEST_TRANSIT_S
        with self._lock:
            streams = self._streams.items()
            recent = {key for (key, _), stream in streams if stream.newest_s >= since_s}
            duplicate = {key for (key, _), stream in streams if stream.duplicate_s >= since_s}
            future = {key for key, at_s in self._future_start_s.items() if at_s >= since_s}
        own = {self._own.fingerprint} if self._own_key_s >= since_s else set()
        return self._robots(duplicate | (future & recent) | own)

    def robots_with_future_start(self) -> frozenset[int]:
        """See `Guard`."""
        since_s = self._clock_s() - LONGEST_TRANSIT_S
        with self._lock:
            return self._robots(
                {key for key, at_s in self._future_start_s.items() if at_s >= since_s}
            )

    def _robots(self, fingerprints: Iterable[bytes]) -> frozenset[int]:
        found = (self.members.by_key.get(fingerprint) for fingerprint in fingerprints)
        return frozenset(m.robot_id for m in found if m and m.robot_id is not None)

    def receive_time(self, unix_s: float) -> None:
        """See `Guard`."""
        offset_s = unix_s - self._clock_s()
        # A clock set back in flight must not make known starts lie in the future.
        if self._unix_offset_s is None or offset_s > self._unix_offset_s:
            self._unix_offset_s = offset_s

    def knock(self, place: str) -> bytes:
        """See `edge.messages.topics.Knocking`."""
        return self._seal(_knock_key(self._own, place), b"")

    def is_knock(self, data: bytes, place: str) -> bool:
        """See `edge.messages.topics.Knocking`. A replay of a robot's own knock is none."""
        envelope = read_envelope(data)
        sender = None if envelope is None else self.members.by_key.get(envelope.head.fingerprint)
        if envelope is None or sender is None:
            return False
        key = _knock_key(sender, place)
        return self._verify(key, sender, envelope) is None

    def seal(self, topic: Topic, payload: bytes) -> bytes:
        """See `Guard`."""
        return self._seal(_key(self._own, topic), topic.packed(payload))

    def _seal(self, key: str, payload: bytes) -> bytes:
        return seal(
            payload,
            signer=self._signer,
            address=Address(self.members.authority, key),
            number=MessageNumber(self._start, self._next_sequence(key)),
            members=self.members.digest,
            release=self.release,
        )

    def _authenticate(
        self, topic: Topic, key: str, envelope: Envelope
    ) -> tuple[bytes, Sender] | RefusedMessage:
        sender = self.members.by_key.get(envelope.head.fingerprint)
        if sender is None:
            return RefusedMessage.UNKNOWN_KEY
        if not _may_publish(sender, topic, key):
            return RefusedMessage.NOT_ALLOWED
        refused = self._verify(key, sender, envelope)
        if refused is not None:
            return refused
        return envelope.payload, Sender.of(sender.role, sender.name, envelope.head)

    def _verify(self, key: str, sender: Member, envelope: Envelope) -> RefusedMessage | None:
        """Record that member's newest message on that key, or return why it is refused."""
        if not envelope.is_from(sender.public_key, Address(self.members.authority, key)):
            return RefusedMessage.FORGED
        return self._check_number(key, sender, envelope.head)

    def _check_number(self, key: str, sender: Member, head: Head) -> RefusedMessage | None:
        number, fingerprint = head.number, head.fingerprint
        now_s, offset_s = self._clock_s(), self._unix_offset_s
        unix_s = None if offset_s is None else now_s + offset_s
        # For robots only: a ground whose clock was wrong once could not command in flight.
        is_robot = sender.role is Role.ROBOT
        is_own = fingerprint == self._own.fingerprint and is_robot
        with self._lock:
            if is_own and number.start <= self._start:
                # A replay, or another program with this key that started earlier: that program
                # receives this one, and reports the duplicate.
                return RefusedMessage.REPLAYED
            if is_own:
                self._own_key_s = now_s
            if is_robot and unix_s is not None and number.start > 1e3 * unix_s + _MOST_AHEAD_MS:
                self._future_start_s[fingerprint] = now_s
                return RefusedMessage.START_AHEAD
            stream = self._streams[fingerprint, key]
            if stream.window.is_replay(number, now_s, unix_s):
                stream.record_late(number, now_s)
                return RefusedMessage.REPLAYED
            stream.accept(head, now_s)
        return None


class _SealingLink:
    """A link that publishes every message in an envelope."""

    def __init__(self, guard: Guard, link: Link) -> None:
        self._guard = guard
        self._link = link

    def publish(self, topic: Topic, data: bytes) -> None:
        """See `Link`."""
        self._link.publish(topic, self._guard.seal(topic, data))

    def is_claimed(self, robot_id: int) -> bool:
        """See `Link`."""
        return self._link.is_claimed(robot_id)

    def peers(self) -> int:
        """See `Link`."""
        return self._link.peers()

    def refused(self) -> int:
        """See `Link`."""
        return self._link.refused()


def _knock_key(sender: Member, place: str) -> str:
    """Return the key that a knock is signed for: it names the destination, against replay."""
    return f"{_prefix(sender)}/knock/{place}"


def _key(sender: Member, topic: Topic) -> str:
    return f"{_prefix(sender)}/{topic.name}"


def _prefix(sender: Member) -> str:
    return "ground" if sender.robot_id is None else f"robot/{sender.robot_id}"


def _may_publish(sender: Member, topic: Topic, key: str) -> bool:
    """An observer may ask for a hold, and nothing else."""
    return key == _key(sender, topic) and (sender.role is not Role.OBSERVER or topic == HOLD)


def _compared(theirs: int, own: int) -> str:
    if theirs == own:
        return f"another {theirs}"
    return f"{theirs}, which is {'newer' if theirs > own else 'older'}"
