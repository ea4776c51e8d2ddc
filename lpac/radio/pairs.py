"""Links between robots over some time, by their own statuses.

Robots count for themselves what arrives and how old it is (`edge.core.arrivals`); here two of a
robot's statuses are compared. Nobody has to be asked anything.
"""

from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

from edge.core.arrivals import Arrivals
from edge.messages.mission import RadioCounts, RobotStatus

# Messages are forgotten at this age.
LATE_S = 0.8
# Of two robots' statuses neither tells of the same moment, and some messages are on their way.
_APART_S = 1.0
# Of so many links that are all bad, what they have in common is to blame.
_LEAST_LINKS = 2

# Of a sender and a receiver, by their names.
Link = tuple[str, str]


class Window(NamedTuple):
    """The first and the last status with `radio_counts` of one start of a program in some time."""

    first: RobotStatus
    last: RobotStatus

    @property
    def counts(self) -> tuple[RadioCounts, RadioCounts]:
        """At its begin, and at its end."""
        first, last = self.first.radio_counts, self.last.radio_counts
        assert first is not None and last is not None
        return first, last

    @property
    def duration_s(self) -> float:
        """By the robot's own clock."""
        return self.last.uptime_s - self.first.uptime_s

    @property
    def sent(self) -> int:
        """How many messages its policy had for the others."""
        first, last = self.counts
        return last.sent - first.sent

    @property
    def bytes_sent(self) -> int:
        """Bytes of these together, without envelopes."""
        first, last = self.counts
        return last.sent_bytes - first.sent_bytes

    @property
    def rate_hz(self) -> float:
        """How often it had one."""
        return self.sent / self.duration_s if self.duration_s > 0.0 else 0.0

    def arrivals(self, sender: int) -> Arrivals:
        """Arrivals of a robot's messages, by its id."""
        first, last = (
            Arrivals.of_counts(counts.arrivals.get(str(sender), ())) for counts in self.counts
        )
        return last.since(first)


class Pair(NamedTuple):
    """Of `sent` messages that were for the receiver `received` came, `late` of them at 0.8 s or
    older. Ages are None if none is known; see `Arrivals.age_s`."""

    sender: str
    receiver: str
    sent: int
    received: int
    late: int
    age_p50_s: float | None
    age_p99_s: float | None

    @property
    def delivered(self) -> float:
        """The share that came, however late."""
        return self.received / self.sent

    @property
    def late_share(self) -> float:
        """Of those that came, the share that was late."""
        return self.late / self.received if self.received else 0.0

    @property
    def in_time(self) -> float:
        """The share that came before it was late."""
        return (self.received - self.late) / self.sent


def pairs(windows: Mapping[str, Window]) -> tuple[Pair, ...]:
    """Of each two robots of which one spoke; by names. The windows are of about the same time."""
    found = (
        _pair(sender, receiver, windows[sender], windows[receiver])
        for receiver in windows
        for sender in windows
        if sender != receiver
    )
    return tuple(pair for pair in found if pair is not None)


def _pair(sender: str, receiver: str, said: Window, heard: Window) -> Pair | None:
    arrivals = heard.arrivals(said.last.robot_id)
    # The receiver knows best which are missing between those that came. Of what came before or
    # after them, and of what never comes, the sender's own count tells.
    expected, apart = said.rate_hz * heard.duration_s, said.rate_hz * _APART_S + 1.0
    sent = round(min(max(arrivals.sent, expected - apart), expected + apart))
    if said.sent < 1 or sent < 1:
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
    """Where bad links have their cause.

    `receivers` hear nobody well, `senders` nobody hears well; `links` are the others.
    """

    receivers: tuple[str, ...]
    senders: tuple[str, ...]
    links: tuple[Link, ...]


def blame(is_good: Mapping[Link, bool]) -> Blame:
    """Explain bad links by few robots, among all links that there should be."""
    left = {link for link, good in is_good.items() if not good}
    found: tuple[list[str], list[str]] = [], []  # senders, receivers
    while True:
        best: tuple[int, int, str] | None = None
        for side in (1, 0):
            # Links that somebody else explains speak neither for a robot nor against it.
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
