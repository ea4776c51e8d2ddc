"""Quality of the links between robots over some time, from their own statuses.

Robots count arrived messages and their ages (`edge.core.arrivals`). Two statuses of a robot are
compared here; no request to robots is needed.
"""

from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

from edge.core.arrivals import Arrivals
from edge.messages.mission import RadioCounts, RobotStatus

# Robots discard messages at this age.
LATE_S = 0.8
# Statuses of two robots are from different times, and some messages are in transit.
_APART_S = 1.0
# At least so many bad links must share a robot to blame it.
_LEAST_LINKS = 2

# Names of a sender and a receiver.
Link = tuple[str, str]


class Window(NamedTuple):
    """First and last status with `radio_counts` of one start of a program in some time."""

    first: RobotStatus
    last: RobotStatus

    @property
    def counts(self) -> tuple[RadioCounts, RadioCounts]:
        """First and last counts."""
        first, last = self.first.radio_counts, self.last.radio_counts
        assert first is not None and last is not None
        return first, last

    @property
    def duration_s(self) -> float:
        """Duration by the robot's own clock."""
        return self.last.uptime_s - self.first.uptime_s

    @property
    def sent(self) -> int:
        """Number of messages that its policy sent."""
        first, last = self.counts
        return last.sent - first.sent

    @property
    def bytes_sent(self) -> int:
        """Bytes of these messages, without envelopes."""
        first, last = self.counts
        return last.sent_bytes - first.sent_bytes

    @property
    def rate_hz(self) -> float:
        """Rate of its messages."""
        return self.sent / self.duration_s if self.duration_s > 0.0 else 0.0

    def arrivals(self, sender: int) -> Arrivals:
        """Arrivals of the messages of a robot, by its id."""
        first, last = (
            Arrivals.of_counts(counts.arrivals.get(str(sender), ())) for counts in self.counts
        )
        return last.since(first)


class Pair(NamedTuple):
    """Messages from `sender` to `receiver`: `sent`, `received`, and `late` of these.

    A message is late at an age of 0.8 s or more. Ages are None if unknown; see `Arrivals.age_s`.
    """

    sender: str
    receiver: str
    sent: int
    received: int
    late: int
    age_p50_s: float | None
    age_p99_s: float | None

    @property
    def delivered(self) -> float:
        """Share that arrived at any age."""
        return self.received / self.sent

    @property
    def late_share(self) -> float:
        """Share of the arrived messages that was late."""
        return self.late / self.received if self.received else 0.0

    @property
    def in_time(self) -> float:
        """Share that arrived in time."""
        return (self.received - self.late) / self.sent


def pairs(windows: Mapping[str, Window]) -> tuple[Pair, ...]:
    """Pairs whose sender sent any message; windows must be of about the same time."""
    found = (
        _pair(sender, receiver, windows[sender], windows[receiver])
        for receiver in windows
        for sender in windows
        if sender != receiver
    )
    return tuple(pair for pair in found if pair is not None)


def _pair(sender: str, receiver: str, sent_in: Window, received_in: Window) -> Pair | None:
    arrivals = received_in.arrivals(sent_in.last.robot_id)
    # The receiver knows best about losses between arrived messages. Losses before, after, and of
    # whole links follow from the sender's count.
    expected, apart = sent_in.rate_hz * received_in.duration_s, sent_in.rate_hz * _APART_S + 1.0
    sent = round(min(max(arrivals.sent, expected - apart), expected + apart))
    if sent_in.sent < 1 or sent < 1:
        return None
    received = max(0, min(arrivals.arrived, sent))
    return Pair(
        sender,
        receiver,
        sent,
        received,
        max(0, min(arrivals.older_than(LATE_S), received)),
        arrivals.age_s(0.5),
        arrivals.age_s(0.99),
    )


class Blame(NamedTuple):
    """Causes of bad links.

    `receivers` receive badly from all, `senders` are received badly by all; `links` are the others.
    """

    receivers: tuple[str, ...]
    senders: tuple[str, ...]
    links: tuple[Link, ...]


def blame(is_good: Mapping[Link, bool]) -> Blame:
    """Explain bad links by few robots, given all links that should exist."""
    left = {link for link, good in is_good.items() if not good}
    found: tuple[list[str], list[str]] = [], []  # senders, receivers
    while True:
        best: tuple[int, int, str] | None = None
        for side in (1, 0):
            # Links that are explained already count neither for nor against a robot.
            bad = Counter(link[side] for link in left)
            good = {link[side] for link, is_good_one in is_good.items() if is_good_one}
            for name in sorted(bad.keys() - good):
                if bad[name] >= _LEAST_LINKS and (best is None or bad[name] > best[0]):
                    best = bad[name], side, name
        if best is None:
            break
        _, side, name = best
        found[side].append(name)
        left = {link for link in left if link[side] != name}
    return Blame(tuple(found[1]), tuple(found[0]), tuple(sorted(left)))
