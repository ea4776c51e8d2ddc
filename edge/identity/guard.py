"""Between a node and its link: what goes out is signed, what comes in is a member's or nobody's.

Who a message is from is decided here, before anything of it is decoded and whatever brought it.
"""

import math
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from threading import Lock
from typing import NamedTuple, Protocol

from edge.core.logger import log
from edge.identity.card import Card, CardError, Revocations, Role, verified
from edge.identity.envelope import (
    NO_MEMBERS,
    RELEASE,
    Address,
    Envelope,
    Head,
    enclose,
    read_envelope,
    seal,
)
from edge.identity.news import NOTHING, MessageNumber, Newest
from edge.identity.signature import Signer
from edge.messages.topics import (
    CARD,
    GROUND_CARD,
    HOLD,
    REVOKED,
    Link,
    ReceiveCallback,
    Topic,
)

_MOST_CARDS = 1000
# How often a card is shown at most when somebody new is heard; then, so that he hears it whatever
# is lost; and when all know all, which is most of a flight, and nearly for nothing.
_SHOWN_AT_MOST_EVERY_S = 0.25
_SHOWN_TO_NEW_EVERY_S, _NEW_FOR_S = 2.0, 20.0
# At first more often where nothing lost is sent again: until a lost card comes once more, whoever
# begins is deaf to who sent it.
_SHOWN_IN_HASTE_EVERY_S, _HASTE_S = 0.5, 1.5
_SHOWN_EVERY_S = {CARD: 1.0 / CARD.rate_hz, GROUND_CARD: 1.0 / GROUND_CARD.rate_hz}
# What was on its way when a member's program started again has come by then.
_LONGEST_TRANSIT_S = 5.0
# No clock is further ahead than a wrong time zone makes it; one that was lost is behind.
_MOST_AHEAD_MS = 24 * 3600e3


class Speaker(NamedTuple):
    """Sender of a message, and its program: `name` is its card's, "" where nothing is signed.

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
    REVOKED = "revoked"
    NOT_ALLOWED = "not_allowed"
    FORGED = "forged"
    REPLAYED = "replayed"
    START_AHEAD = "start_ahead"


@dataclass(slots=True)
class _Heard:
    """State of one member on one key; all times are a monotonic clock's, s."""

    newest: Newest = field(default_factory=Newest)
    newest_s: float = -math.inf
    # Its newest word every second or so, back to the longest transit ago.
    before: deque[tuple[float, MessageNumber]] = field(default_factory=deque)
    # Of its words behind the newest one: since when they come, until when, and the greatest.
    behind_since_s: float = -math.inf
    behind_s: float = -math.inf
    behind: MessageNumber = NOTHING
    # When such a word came last that was no longer on its way: a second program said it.
    twice_s: float = -math.inf

    def hear(self, number: MessageNumber, now_s: float) -> None:
        """It is news."""
        self.newest.hear(number, now_s)
        self.newest_s = now_s
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


class CardProblem(StrEnum):
    """Why others do not listen to this member, or it must not take off."""

    REVOKED = "revoked"
    REPLACED = "replaced"
    EXPIRED = "expired"


class Guard(Protocol):
    """Interface through which a node speaks and hears."""

    @property
    def role(self) -> Role | None:
        """Role that it speaks in; None where messages are not signed."""

    def subscriptions(self, hear: Mapping[Topic, Hear]) -> dict[Topic, ReceiveCallback]:
        """Callbacks to open the link with, so that the node hears these topics."""

    def over(self, link: Link) -> Link:
        """Link for the node to publish on, which passes on to this one."""

    def seal(self, topic: Topic, payload: bytes) -> bytes:
        """The payload in this sender's envelope."""

    def introduce(self) -> None:
        """Show others who this is, if it is time; for a node that may have nothing to say."""

    def card_problem(self, unix_s: float) -> CardProblem | None:
        """Describe the fault of this member's own card at that time; None: there is none."""

    def revoked_robots(self) -> frozenset[int]:
        """Robots that are listened to no more, and may still fly."""

    def robots_said_twice(self) -> frozenset[int]:
        """Robots whose key two programs have: the own one among them, if it is said elsewhere."""

    def robots_ahead(self) -> frozenset[int]:
        """Robots that number their starts further ahead of the clock than one can be wrong."""

    def hear_time(self, unix_s: float) -> None:
        """It is at least so late; robots whose start lies more than a day ahead are not heard."""

    def refused(self) -> dict[str, int]:
        """How many messages were nobody's, by why."""


class Unguarded:
    """Messages are not signed, and are taken for those of the keys that they come on.

    For a radio that nobody else can reach. `start` tells this start of the program from all before,
    which were smaller.
    """

    def __init__(self, start: int) -> None:
        self._start = start
        self._lock = Lock()
        self._sequences: Counter[Topic] = Counter()
        self._refused = 0

    @property
    def role(self) -> None:
        """See `Guard`."""

    def subscriptions(self, hear: Mapping[Topic, Hear]) -> dict[Topic, ReceiveCallback]:
        """See `Guard`."""
        return {topic: partial(self._receive, callback) for topic, callback in hear.items()}

    def over(self, link: Link) -> Link:
        """See `Guard`."""
        return _SealingLink(self, link)

    def seal(self, topic: Topic, payload: bytes) -> bytes:
        """See `Guard`."""
        with self._lock:
            self._sequences[topic] += 1
            sequence = self._sequences[topic]
        return enclose(payload, MessageNumber(self._start, sequence))

    def _receive(self, hear: Hear, key: str, data: bytes) -> bool:
        envelope = read_envelope(data)
        if envelope is None or envelope.head.is_signed:
            self._refused += 1
            return False
        role = Role.ROBOT if key.startswith("robot/") else Role.OPERATOR
        hear(key, envelope.payload, Speaker.of(role, "", envelope.head))
        return True

    def introduce(self) -> None:
        """See `Guard`."""

    def card_problem(self, unix_s: float) -> CardProblem | None:
        """See `Guard`."""

    def revoked_robots(self) -> frozenset[int]:
        """See `Guard`."""
        return frozenset()

    def robots_said_twice(self) -> frozenset[int]:
        """See `Guard`."""
        return frozenset()

    def robots_ahead(self) -> frozenset[int]:
        """See `Guard`."""
        return frozenset()

    def hear_time(self, unix_s: float) -> None:
        """See `Guard`."""

    def refused(self) -> dict[str, int]:
        """See `Guard`."""
        return {RefusedMessage.NO_ENVELOPE.value: self._refused} if self._refused else {}


@dataclass(frozen=True, slots=True)
class Membership:
    """One program's place in its fleet.

    `authority` is the public key of the fleet's authority, `card_data` the card as it signed it,
    `start` what tells this start of the program from all before, which were smaller.
    """

    authority: bytes
    signer: Signer
    card_data: bytes
    start: int

    @property
    def card(self) -> Card:
        """Identify a sender. Raises CardError if its card is of another key or authority."""
        card = verified(Card, self.card_data, self.authority)
        if card.public_key != self.signer.public_key:
            raise CardError(f"the card of {card.name} is for another key than the one beside it")
        return card


class SignedGuard:
    """The guard of a member. From any thread.

    Nobody needs a list of members: each shows its card, which the authority has signed, now and
    then and when somebody new is heard; more often in the beginning over a link that
    sends nothing again. It comes in its owner's envelope, by which others know a program that just
    began, and may need their cards, also if it says nothing else, as a ground that does not
    command. `revocations` is the newest signed list that is known.
    """

    def __init__(
        self,
        membership: Membership,
        clock_s: Callable[[], float],
        revocations: bytes = b"",
    ) -> None:
        """Raises CardError for a card or a list that is not this fleet's."""
        self.card = membership.card
        self._membership = membership
        self._clock_s = clock_s
        self._lock = Lock()
        self._members: dict[tuple[Role, str], Card] = {self.card.member: self.card}
        self._cards: dict[bytes, Card] = {self.card.fingerprint: self.card}
        self._revocations = Revocations(0)
        self._revoked: frozenset[bytes] = frozenset()
        self.revocations = b""
        self._heard: defaultdict[tuple[bytes, str], _Heard] = defaultdict(_Heard)
        # When a key's start lay ahead of the clock; when the own key was said by a later start.
        self._ahead_s: dict[bytes, float] = {}
        self._own_said_s = -math.inf
        # The wall clock minus the monotonic one, once it is known.
        self._unix_offset_s: float | None = None
        self._refused: Counter[RefusedMessage] = Counter()
        self._sequences: Counter[str] = Counter()
        self._shown_at_s = self._new_until_s = -math.inf
        # A program that begins is new to all.
        self._show_soon = True
        self._link: Link | None = None
        if revocations and not self.hear_revocations(revocations):
            raise CardError("Revocations: this fleet's authority has not signed it")

    @property
    def role(self) -> Role:
        """See `Guard`."""
        return self.card.role

    @property
    def _authority(self) -> bytes:
        return self._membership.authority

    @property
    def _start(self) -> int:
        return self._membership.start

    def subscriptions(self, hear: Mapping[Topic, Hear]) -> dict[Topic, ReceiveCallback]:
        """See `Guard`."""
        return {
            **{topic: partial(self._receive, topic, callback) for topic, callback in hear.items()},
            CARD: partial(self._receive_card, CARD),
            GROUND_CARD: partial(self._receive_card, GROUND_CARD),
            REVOKED: self._receive_revocations,
        }

    def over(self, link: Link) -> Link:
        """See `Guard`."""
        self._link = link
        return _SealingLink(self, link)

    def introduce(self) -> None:
        """See `Guard`."""
        if self._link is not None:
            for topic, shown in self._to_show(again=self._link.sends_again):
                self._link.publish(topic, shown)

    def card_problem(self, unix_s: float) -> CardProblem | None:
        """See `Guard`."""
        if self.card.fingerprint in self._revoked:
            return CardProblem.REVOKED
        if self._members[self.card.member] is not self.card:
            return CardProblem.REPLACED
        return CardProblem.EXPIRED if unix_s > self.card.expires_unix_s else None

    def revoked_robots(self) -> frozenset[int]:
        """See `Guard`."""
        with self._lock:
            revoked = [c for c in self._members.values() if c.fingerprint in self._revoked]
        return frozenset(card.robot_id for card in revoked if card.robot_id is not None)

    def robots_said_twice(self) -> frozenset[int]:
        """See `Guard`."""
        since_s = self._clock_s() - _LONGEST_TRANSIT_S
        with self._lock:
            heard = {key for (key, _), said in self._heard.items() if said.newest_s >= since_s}
            twice = {key for (key, _), said in self._heard.items() if said.twice_s >= since_s}
            ahead = {key for key, at_s in self._ahead_s.items() if at_s >= since_s}
        own = {self.card.fingerprint} if self._own_said_s >= since_s else set()
        return self._robots(twice | (ahead & heard) | own)

    def robots_ahead(self) -> frozenset[int]:
        """See `Guard`."""
        since_s = self._clock_s() - _LONGEST_TRANSIT_S
        with self._lock:
            return self._robots({key for key, at_s in self._ahead_s.items() if at_s >= since_s})

    def _robots(self, fingerprints: Iterable[bytes]) -> frozenset[int]:
        cards = (self._cards.get(fingerprint) for fingerprint in fingerprints)
        return frozenset(card.robot_id for card in cards if card and card.robot_id is not None)

    def hear_time(self, unix_s: float) -> None:
        """See `Guard`."""
        offset_s = unix_s - self._clock_s()
        # A clock that is set back in flight makes nobody's start too great who was heard before.
        if self._unix_offset_s is None or offset_s > self._unix_offset_s:
            self._unix_offset_s = offset_s

    def refused(self) -> dict[str, int]:
        """See `Guard`."""
        with self._lock:
            return {reason.value: count for reason, count in self._refused.items()}

    # At the port, before there is a connection: see `edge.drivers.door`

    def knock(self, place: str) -> bytes:
        """See `edge.messages.topics.Knocking`: the own card, in an envelope for this alone."""
        return self._seal(_knock_key(self.card, place), self._membership.card_data)

    def is_knock(self, data: bytes, place: str) -> bool:
        """See `edge.messages.topics.Knocking`. A robot's own knock, said again, is none."""
        envelope = read_envelope(data)
        if envelope is None or envelope.head.fingerprint in self._revoked:
            return False
        try:
            card = verified(Card, envelope.payload, self._authority)
        except CardError:
            return False
        key = _knock_key(card, place)
        is_theirs = card.fingerprint == envelope.head.fingerprint and envelope.is_from(
            card.public_key, Address(self._authority, key)
        )
        return is_theirs and self._overtaken(key, card, envelope) is None

    # What goes out

    def seal(self, topic: Topic, payload: bytes) -> bytes:
        """See `Guard`."""
        return self._seal(self._own_key(topic), payload)

    def _seal(self, key: str, payload: bytes) -> bytes:
        with self._lock:
            self._sequences[key] += 1
            sequence = self._sequences[key]
        return seal(
            payload,
            signer=self._membership.signer,
            address=Address(self._authority, key),
            number=MessageNumber(self._start, sequence),
        )

    def _own_key(self, topic: Topic) -> str:
        if self.card.role is Role.ROBOT:
            return f"robot/{self.card.robot_id}/{topic.name}"
        return f"ground/{topic.name}"

    def _to_show(self, *, again: bool) -> tuple[tuple[Topic, bytes], ...]:
        """The own card, and from an operator the revocations, if it is time.

        `again`: what is lost is sent again.
        """
        now_s = self._clock_s()
        card = CARD if self.card.role is Role.ROBOT else GROUND_CARD
        with self._lock:
            if self._show_soon:
                wait_s = _SHOWN_AT_MOST_EVERY_S
            elif not again and now_s < self._new_until_s - _NEW_FOR_S + _HASTE_S:
                wait_s = _SHOWN_IN_HASTE_EVERY_S
            elif now_s < self._new_until_s:
                wait_s = _SHOWN_TO_NEW_EVERY_S
            else:
                wait_s = _SHOWN_EVERY_S[card]
            if now_s - self._shown_at_s < wait_s:
                return ()
            if self._show_soon:
                self._new_until_s = now_s + _NEW_FOR_S
            self._shown_at_s, self._show_soon = now_s, False
        shown = [(card, self.seal(card, self._membership.card_data))]
        if self.card.role is Role.OPERATOR and self.revocations:
            shown.append((REVOKED, self.revocations))
        return tuple(shown)

    # What comes in

    def _receive(self, topic: Topic, hear: Hear, key: str, data: bytes) -> bool:
        found = self._opened(topic, key, data)
        if isinstance(found, RefusedMessage):
            self._refuse(found, key)
            return False
        hear(key, found[0], found[1])
        return True

    def _opened(
        self, topic: Topic, key: str, data: bytes
    ) -> tuple[bytes, Speaker] | RefusedMessage:
        envelope = read_envelope(data)
        if envelope is None:
            return RefusedMessage.NO_ENVELOPE
        card = self._cards.get(envelope.head.fingerprint)
        if envelope.head.fingerprint in self._revoked:
            return RefusedMessage.REVOKED
        if card is None:
            self._show_soon = True  # It may know as little of this one.
            return RefusedMessage.UNKNOWN_KEY
        if not _may_say(card, topic, key):
            return RefusedMessage.NOT_ALLOWED
        if not envelope.is_from(card.public_key, Address(self._authority, key)):
            return RefusedMessage.FORGED
        refused = self._overtaken(key, card, envelope)
        if refused is not None:
            return refused
        return envelope.payload, Speaker.of(card.role, card.name, envelope.head)

    def _overtaken(self, key: str, card: Card, envelope: Envelope) -> RefusedMessage | None:
        """Why the member's word does not count, if its number is the reason; else it is heard."""
        number = envelope.head.number
        now_s, offset_s = self._clock_s(), self._unix_offset_s
        unix_s = None if offset_s is None else now_s + offset_s
        # A ground whose computer's clock was wrong once would be out of reach in flight.
        is_robot = card.role is Role.ROBOT
        is_own = card.fingerprint == self.card.fingerprint and is_robot
        with self._lock:
            if is_own and number.start <= self._start:
                # A robot's own word, said again. Another program with this key, if there is one
                # and it began earlier, hears this one.
                return RefusedMessage.REPLAYED
            if is_own:
                self._own_said_s = now_s
            if is_robot and unix_s is not None and number.start > 1e3 * unix_s + _MOST_AHEAD_MS:
                self._ahead_s[card.fingerprint] = now_s
                return RefusedMessage.START_AHEAD
            heard = self._heard[card.fingerprint, key]
            if heard.newest.is_older(number, now_s, unix_s):
                heard.hear_behind(number, now_s)
                return RefusedMessage.REPLAYED
            if number.start != heard.newest.number.start:
                self._show_soon = True  # A program that just began knows nobody's card.
            heard.hear(number, now_s)
        return None

    def _receive_card(self, topic: Topic, key: str, data: bytes) -> bool:
        envelope = read_envelope(data)
        reason = (
            RefusedMessage.NO_ENVELOPE if envelope is None else self._shown(topic, key, envelope)
        )
        # Shown again and again, it is no less the member's, but it may be of an earlier start.
        if reason not in (None, RefusedMessage.REPLAYED):
            self._refuse(reason, key)
        return reason is None

    def _shown(self, topic: Topic, key: str, envelope: Envelope) -> RefusedMessage | None:
        """A card in its owner's envelope: why it is not looked at, if it is not."""
        try:
            card = verified(Card, envelope.payload, self._authority)
        except CardError:
            return RefusedMessage.FORGED
        if not _is_of(card, topic, key):
            return RefusedMessage.NOT_ALLOWED
        address = Address(self._authority, key)
        if card.fingerprint != envelope.head.fingerprint or not envelope.is_from(
            card.public_key, address
        ):
            return RefusedMessage.FORGED
        with self._lock:
            known = self._members.get(card.member)
            if known is None and len(self._members) >= _MOST_CARDS:
                return RefusedMessage.UNKNOWN_KEY
            if known is None or known.serial < card.serial:
                if known is not None:
                    del self._cards[known.fingerprint]
                self._members[card.member] = self._cards[card.fingerprint] = card
                self._show_soon = True
        if card.fingerprint in self._revoked:
            return RefusedMessage.REVOKED
        if card.fingerprint not in self._cards:
            return RefusedMessage.NOT_ALLOWED  # Somebody has a newer card in its place.
        return self._overtaken(key, card, envelope)

    def _receive_revocations(self, key: str, data: bytes) -> None:
        if data != self.revocations and not self.hear_revocations(data):
            self._refuse(RefusedMessage.FORGED, key)

    def hear_revocations(self, data: bytes) -> bool:
        """Take a signed list if it is a newer one; whether the authority has signed it at all."""
        try:
            revocations = verified(Revocations, data, self._authority)
        except CardError:
            return False
        with self._lock:
            if revocations.count > self._revocations.count:
                self._revocations, self.revocations = revocations, data
                self._revoked = frozenset(map(bytes.fromhex, revocations.fingerprints))
        return True

    def _refuse(self, reason: RefusedMessage, key: str) -> None:
        with self._lock:
            self._refused[reason] += 1
            first = self._refused[reason] == 1
        # Of whoever comes the card is not known at first.
        if first and reason is not RefusedMessage.UNKNOWN_KEY:
            log.warning("a message is not listened to", why=reason.value, key=key)


class _SealingLink:
    """A link on which everything is in an envelope."""

    def __init__(self, guard: Guard, link: Link) -> None:
        self._guard = guard
        self._link = link

    def publish(self, topic: Topic, data: bytes) -> None:
        """Send to whoever listens; it may be lost."""
        self._guard.introduce()
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

    @property
    def sends_again(self) -> bool:
        """Whether what is lost on its way is said once more."""
        return self._link.sends_again


def _knock_key(card: Card, place: str) -> str:
    """Return the key that a knock is signed for: it names the destination, against replay."""
    return f"{'ground' if card.robot_id is None else f'robot/{card.robot_id}'}/knock/{place}"


def _is_of(card: Card, topic: Topic, key: str) -> bool:
    """Whether that is the member's own key."""
    if card.role is Role.ROBOT:
        return key == f"robot/{card.robot_id}/{topic.name}"
    return key == f"ground/{topic.name}"


def _may_say(card: Card, topic: Topic, key: str) -> bool:
    """An observer may ask for a hold, and nothing else."""
    return _is_of(card, topic, key) and (card.role is not Role.OBSERVER or topic == HOLD)
