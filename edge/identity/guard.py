"""Between a node and its link: what goes out is signed, what comes in is a member's or nobody's.

Who a message is from is decided here, before anything of it is decoded and whatever brought it.
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
from edge.core.wire import deflate, inflate
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
from edge.identity.news import NOTHING, MessageNumber, Newest
from edge.identity.signature import Signer
from edge.messages.topics import HOLD, Link, ReceiveCallback, Topic, robot_id_in

# What was on its way when a member's program started again has come by then.
_LONGEST_TRANSIT_S = 5.0
_MOST_NAMED = 4
# No clock is further ahead than a wrong time zone makes it; one that was lost is behind.
_MOST_AHEAD_MS = 24 * 3600e3


class Speaker(Struct, frozen=True):
    """Sender of a message, and its program: `name` is the list's, "" where nothing is signed.

    `number` is the message's; `release` and `members` are what the sender flies and knows.
    """

    role: Role
    name: str
    number: MessageNumber = NOTHING
    release: bytes = RELEASE
    members: bytes = NO_MEMBERS

    @classmethod
    def of(cls, role: Role, name: str, head: Head) -> "Speaker":
        """The sender of a message with that head."""
        return cls(role, name, head.number, head.release, head.members)


# Of the key below `lpac/<fleet>/`, the payload and who said it; from any thread.
Hear = Callable[[str, bytes, Speaker], None]


class RefusedMessage(StrEnum):
    """Why a message is nobody's."""

    NO_ENVELOPE = "no_envelope"
    UNKNOWN_KEY = "unknown_key"
    NOT_ALLOWED = "not_allowed"
    FORGED = "forged"
    REPLAYED = "replayed"
    START_AHEAD = "start_ahead"
    COMPRESSION = "compression"


@dataclass(slots=True)
class _Heard:
    """State of one member on one key; all times are a monotonic clock's, s."""

    newest: Newest = field(default_factory=Newest)
    newest_s: float = -math.inf
    # Digest of the list of members that it had then.
    members: bytes = NO_MEMBERS
    # Its newest word every second or so, back to the longest transit ago.
    before: deque[tuple[float, MessageNumber]] = field(default_factory=deque)
    # Of its words behind the newest one: since when they come, until when, and the greatest.
    behind_since_s: float = -math.inf
    behind_s: float = -math.inf
    behind: MessageNumber = NOTHING
    # When such a word came last that was no longer on its way: a second program said it.
    twice_s: float = -math.inf

    def hear(self, head: Head, now_s: float) -> None:
        """It is news."""
        number = head.number
        self.newest.hear(number, now_s)
        self.newest_s, self.members = now_s, head.members
        if not self.before or now_s - self.before[-1][0] >= 1.0:
            self.before.append((now_s, number))
        while len(self.before) > 1 and now_s - self.before[1][0] > _LONGEST_TRANSIT_S:
            self.before.popleft()

    def hear_behind(self, number: MessageNumber, now_s: float) -> None:
        """It is none: of two programs with one key the one that started last is heard."""
        if now_s - self.behind_s > _LONGEST_TRANSIT_S:
            self.behind_since_s, self.behind = now_s, NOTHING
        if number <= self.behind:
            return
        self.behind_s, self.behind = now_s, number
        said = [*self.before, (self.newest_s, self.newest.number)]
        settled = [n for at_s, n in said if now_s - at_s > _LONGEST_TRANSIT_S]
        goes_on = now_s - self.behind_since_s > _LONGEST_TRANSIT_S
        if goes_on and settled and number <= settled[-1]:
            self.twice_s = now_s


class Guard(ABC):
    """Interface through which a node speaks and hears. From any thread.

    What is known of members here is what is known in a fleet without keys: nothing.
    """

    def __init__(self, release: bytes) -> None:
        self.release = release
        self._lock = Lock()
        self._sequences: Counter[str] = Counter()
        self._refused: Counter[RefusedMessage] = Counter()
        self._strangers: set[int] = set()

    @property
    def role(self) -> Role | None:
        """Role that it speaks in; None where messages are not signed."""
        return None

    def subscriptions(self, hear: Mapping[Topic, Hear]) -> dict[Topic, ReceiveCallback]:
        """Callbacks to open the link with, so that the node hears these topics."""
        return {topic: partial(self._receive, topic, callback) for topic, callback in hear.items()}

    def over(self, link: Link) -> Link:
        """Link for the node to publish on, which passes on to this one."""
        return _SealingLink(self, link)

    @abstractmethod
    def seal(self, topic: Topic, payload: bytes) -> bytes:
        """The payload in this sender's envelope."""

    def is_listed(self) -> bool:
        """Whether the list of members has this program's key: else nobody listens to it."""
        return True

    def members_differ(self) -> str:
        """Describe who of those heard lately has another list of members; "" if nobody has."""
        return ""

    def revoked_robots(self) -> frozenset[int]:
        """Robots that are listened to no more, and may still fly."""
        return frozenset()

    def robots_said_twice(self) -> frozenset[int]:
        """Robots whose key two programs have: the own one among them, if it is said elsewhere."""
        return frozenset()

    def robots_ahead(self) -> frozenset[int]:
        """Robots that number their starts further ahead of the clock than one can be wrong."""
        return frozenset()

    def hear_time(self, unix_s: float) -> None:  # noqa: B027  (an open fleet has no use for it)
        """It is at least so late; robots whose start lies more than a day ahead are not heard."""

    def take_strangers(self) -> set[int]:
        """Robots that sent envelopes of another version since this was called last."""
        with self._lock:
            robots, self._strangers = self._strangers, set()
        return robots

    def refused(self) -> dict[str, int]:
        """How many messages were nobody's, by why."""
        with self._lock:
            return {reason.value: count for reason, count in self._refused.items()}

    @abstractmethod
    def _opened(
        self, topic: Topic, key: str, envelope: Envelope
    ) -> tuple[bytes, Speaker] | RefusedMessage:
        """Payload and sender of a message that came on that key."""

    def _receive(self, topic: Topic, hear: Hear, key: str, data: bytes) -> bool:
        robot_id = robot_id_in(key)
        if topic.sender == "robot" and robot_id is None:
            self._refuse(RefusedMessage.NOT_ALLOWED, key)
            return False
        envelope = read_envelope(data)
        found: tuple[bytes, Speaker] | RefusedMessage = RefusedMessage.NO_ENVELOPE
        if envelope is not None:
            found = self._opened(topic, key, envelope)
        elif robot_id is not None and is_of_other_version(data):
            # Nobody knows whether that robot sent it.
            with self._lock:
                self._strangers.add(robot_id)
        if not isinstance(found, RefusedMessage) and topic.deflated:
            payload = inflate(found[0], topic.limit_bytes)
            found = (
                RefusedMessage.COMPRESSION
                if payload is None or len(payload) > topic.limit_bytes
                else (bytes(payload), found[1])
            )
        if isinstance(found, RefusedMessage):
            self._refuse(found, key)
            return False
        hear(key, found[0], found[1])
        return True

    def _refuse(self, reason: RefusedMessage, key: str) -> None:
        with self._lock:
            self._refused[reason] += 1
            first = self._refused[reason] == 1
        if first:
            log.warning("a message is not listened to", why=reason.value, key=key)

    def _next_sequence(self, key: str) -> int:
        with self._lock:
            self._sequences[key] += 1
            return self._sequences[key]


class Unguarded(Guard):
    """Messages are not signed, and are taken for those of the keys that they come on.

    For a radio that nobody else can reach. `start` tells this start of the program from all before,
    which were smaller.
    """

    def __init__(self, start: int, release: bytes = RELEASE) -> None:
        super().__init__(release)
        self._start = start

    def seal(self, topic: Topic, payload: bytes) -> bytes:
        """See `Guard`."""
        number = MessageNumber(self._start, self._next_sequence(topic.pattern))
        return enclose(_packed(topic, payload), number, release=self.release)

    def _opened(
        self, topic: Topic, key: str, envelope: Envelope
    ) -> tuple[bytes, Speaker] | RefusedMessage:
        if envelope.head.is_signed:
            return RefusedMessage.NO_ENVELOPE
        role = Role.ROBOT if key.startswith("robot/") else Role.OPERATOR
        return envelope.payload, Speaker.of(role, "", envelope.head)


@dataclass(frozen=True, slots=True)
class Membership:
    """One program's place in its fleet.

    `own` is the member that it is, if the list says so, `members` the list as it begins, `start`
    what tells this start of the program from all before, which were smaller.
    """

    own: Member
    signer: Signer
    members: Members
    start: int


class SignedGuard(Guard):
    """The guard of a member.

    `members` is the list that counts now: whoever is not in it is not heard.
    """

    def __init__(
        self, membership: Membership, clock_s: Callable[[], float], release: bytes = RELEASE
    ) -> None:
        super().__init__(release)
        self.members = membership.members
        self._own = membership.own
        self._signer = membership.signer
        self._start = membership.start
        self._clock_s = clock_s
        # Robots of an earlier list that are in the list no more.
        self._left: frozenset[int] = frozenset()
        self._heard: defaultdict[tuple[bytes, str], _Heard] = defaultdict(_Heard)
        # When a key's start lay ahead of the clock; when the own key was said by a later start.
        self._ahead_s: dict[bytes, float] = {}
        self._own_said_s = -math.inf
        # The wall clock minus the monotonic one, once it is known.
        self._unix_offset_s: float | None = None

    def take(self, members: Members) -> None:
        """Take a newer list, from now on. Raises MembersError if it is none."""
        with self._lock:
            self.members.require_newer(members)
            if members != self.members:
                former = self._left | self.members.robot_ids
                self._left, self.members = former - members.robot_ids, members

    @property
    def role(self) -> Role:
        """See `Guard`."""
        return self._own.role

    def is_listed(self) -> bool:
        """See `Guard`."""
        listed = self.members.by_key.get(self._own.fingerprint)
        return listed is not None and listed.place == self._own.place

    def members_differ(self) -> str:
        """See `Guard`."""
        since_s, members = self._clock_s() - _LONGEST_TRANSIT_S, self.members
        newest: dict[bytes, _Heard] = {}
        with self._lock:
            for (key, _), heard in self._heard.items():
                if heard.newest_s >= max(since_s, newest.get(key, heard).newest_s):
                    newest[key] = heard
        others = [
            f"{sender.name} has {_compared(number_of(newest[key].members), members.number)}"
            for key, sender in members.by_key.items()
            if key in newest and newest[key].members != members.digest
        ]
        if not others:
            return ""
        more = [f"and {len(others) - _MOST_NAMED} more"] if len(others) > _MOST_NAMED else []
        said = ", ".join(others[:_MOST_NAMED] + more)
        return f"the list of members here is {members.number}, and {said}: run `lpac fleet up`"

    def revoked_robots(self) -> frozenset[int]:
        """See `Guard`."""
        return self._left

    def robots_said_twice(self) -> frozenset[int]:
        """See `Guard`."""
        since_s = self._clock_s() - _LONGEST_TRANSIT_S
        with self._lock:
            heard = {key for (key, _), said in self._heard.items() if said.newest_s >= since_s}
            twice = {key for (key, _), said in self._heard.items() if said.twice_s >= since_s}
            ahead = {key for key, at_s in self._ahead_s.items() if at_s >= since_s}
        own = {self._own.fingerprint} if self._own_said_s >= since_s else set()
        return self._robots(twice | (ahead & heard) | own)

    def robots_ahead(self) -> frozenset[int]:
        """See `Guard`."""
        since_s = self._clock_s() - _LONGEST_TRANSIT_S
        with self._lock:
            return self._robots({key for key, at_s in self._ahead_s.items() if at_s >= since_s})

    def _robots(self, fingerprints: Iterable[bytes]) -> frozenset[int]:
        found = (self.members.by_key.get(fingerprint) for fingerprint in fingerprints)
        return frozenset(m.robot_id for m in found if m and m.robot_id is not None)

    def hear_time(self, unix_s: float) -> None:
        """See `Guard`."""
        offset_s = unix_s - self._clock_s()
        # A clock that is set back in flight makes nobody's start too great who was heard before.
        if self._unix_offset_s is None or offset_s > self._unix_offset_s:
            self._unix_offset_s = offset_s

    # At the port, before there is a connection: see `edge.drivers.door`

    def knock(self, place: str) -> bytes:
        """See `edge.messages.topics.Knocking`."""
        return self._seal(_knock_key(self._own, place), b"")

    def is_knock(self, data: bytes, place: str) -> bool:
        """See `edge.messages.topics.Knocking`. A robot's own knock, said again, is none."""
        envelope = read_envelope(data)
        sender = None if envelope is None else self.members.by_key.get(envelope.head.fingerprint)
        if envelope is None or sender is None:
            return False
        key = _knock_key(sender, place)
        return self._problem(key, sender, envelope) is None

    # What goes out

    def seal(self, topic: Topic, payload: bytes) -> bytes:
        """See `Guard`."""
        return self._seal(_key(self._own, topic), _packed(topic, payload))

    def _seal(self, key: str, payload: bytes) -> bytes:
        return seal(
            payload,
            signer=self._signer,
            address=Address(self.members.authority, key),
            number=MessageNumber(self._start, self._next_sequence(key)),
            members=self.members.digest,
            release=self.release,
        )

    # What comes in

    def _opened(
        self, topic: Topic, key: str, envelope: Envelope
    ) -> tuple[bytes, Speaker] | RefusedMessage:
        sender = self.members.by_key.get(envelope.head.fingerprint)
        if sender is None:
            return RefusedMessage.UNKNOWN_KEY
        if not _may_say(sender, topic, key):
            return RefusedMessage.NOT_ALLOWED
        problem = self._problem(key, sender, envelope)
        if problem is not None:
            return problem
        return envelope.payload, Speaker.of(sender.role, sender.name, envelope.head)

    def _problem(self, key: str, sender: Member, envelope: Envelope) -> RefusedMessage | None:
        """Why it is not that member's newest word there; else it is heard."""
        if not envelope.is_from(sender.public_key, Address(self.members.authority, key)):
            return RefusedMessage.FORGED
        return self._overtaken(key, sender, envelope)

    def _overtaken(self, key: str, sender: Member, envelope: Envelope) -> RefusedMessage | None:
        """Why the member's word does not count, if its number is the reason; else it is heard."""
        number = envelope.head.number
        now_s, offset_s = self._clock_s(), self._unix_offset_s
        unix_s = None if offset_s is None else now_s + offset_s
        # A ground whose computer's clock was wrong once would be out of reach in flight.
        is_robot = sender.role is Role.ROBOT
        fingerprint = envelope.head.fingerprint
        is_own = fingerprint == self._own.fingerprint and is_robot
        with self._lock:
            if is_own and number.start <= self._start:
                # A robot's own word, said again. Another program with this key, if there is one
                # and it began earlier, hears this one.
                return RefusedMessage.REPLAYED
            if is_own:
                self._own_said_s = now_s
            if is_robot and unix_s is not None and number.start > 1e3 * unix_s + _MOST_AHEAD_MS:
                self._ahead_s[fingerprint] = now_s
                return RefusedMessage.START_AHEAD
            heard = self._heard[fingerprint, key]
            if heard.newest.is_older(number, now_s, unix_s):
                heard.hear_behind(number, now_s)
                return RefusedMessage.REPLAYED
            heard.hear(envelope.head, now_s)
        return None


class _SealingLink:
    """A link on which everything is in an envelope."""

    def __init__(self, guard: Guard, link: Link) -> None:
        self._guard = guard
        self._link = link

    def publish(self, topic: Topic, data: bytes) -> None:
        """Send to whoever listens; it may be lost."""
        self._link.publish(topic, self._guard.seal(topic, data))

    def is_claimed(self, robot_id: int) -> bool:
        """Whether another program than this one says that it is that robot."""
        return self._link.is_claimed(robot_id)

    def peers(self) -> int:
        """How many others it reaches now."""
        return self._link.peers()

    def refused(self) -> int:
        """How many messages it did not look at."""
        return self._link.refused()


def _packed(topic: Topic, payload: bytes) -> bytes:
    return deflate(payload) if topic.deflated else payload


def _knock_key(sender: Member, place: str) -> str:
    """Return the key that a knock is signed for: it names the destination, against replay."""
    return f"{_prefix(sender)}/knock/{place}"


def _key(sender: Member, topic: Topic) -> str:
    return f"{_prefix(sender)}/{topic.name}"


def _prefix(sender: Member) -> str:
    return "ground" if sender.robot_id is None else f"robot/{sender.robot_id}"


def _may_say(sender: Member, topic: Topic, key: str) -> bool:
    """An observer may ask for a hold, and nothing else."""
    return key == _key(sender, topic) and (sender.role is not Role.OBSERVER or topic == HOLD)


def _compared(theirs: int, own: int) -> str:
    if theirs == own:
        return f"another {theirs}"
    return f"{theirs}, which is {'newer' if theirs > own else 'older'}"
