"""The newest message of each neighbour, between the link's threads and the robot's loops.

Paper: "A Scalable Multi-Robot Framework for Decentralized and Asynchronous
Perception-Action-Communication Loops", section "Inter-Robot Communication". Of its two buffers this
is the receive buffer; the message to transmit is what a policy tick returns.
"""

import math
from collections import Counter
from threading import Lock
from typing import NamedTuple

from edge.core.aggregation import AggregatedMessage
from edge.core.arrivals import Arrivals
from edge.core.schema import NonNegative, require
from edge.core.shared_map import SharedMap
from edge.core.wire import Rejection

# After a cut, TCP delivers data that is up to 2 s old; nothing is in transit longer than this.
_LONGEST_TRANSIT_S = 5.0


class Neighbour(NamedTuple):
    """Another robot: its position and velocity in the mission frame, as they were `age_s` ago.

    And what it told of its surroundings in the mission `trial`, if robots share maps. `is_piloted`:
    somebody else than its program flies it, or it does not hold its height, so that nobody knows
    where it flies next.
    """

    robot_id: int
    position_m: tuple[float, float, float]
    velocity_m_s: tuple[float, float, float]
    age_s: float
    trial: int = 0
    shared: SharedMap | None = None
    is_piloted: bool = False


class _Received(NamedTuple):
    message: AggregatedMessage
    born_s: float


class _LastHeard(NamedTuple):
    boot_epoch: int
    sequence: int
    at_s: float


class _Arrived(NamedTuple):
    """All that came of a robot, and the newest of it, whatever its age was."""

    boot_epoch: int
    sequence: int
    arrivals: Arrivals


class Mailbox:
    """One robot's receive buffer. Every method may be called from any thread.

    `now_s` is the robot's own monotonic clock, s. How old a message was when it came is for the
    caller to say: its greatest possible age. One of which that is not known is not kept.

    `swap` and `neighbours` leave out what is not younger than `max_message_age_s`, and take nothing
    away. With 0 age plays no part, and the paper's rule holds: `swap` hands each message out once,
    and a neighbour is in `neighbours` until a `swap` that finds nothing new from it.

    Raises ValueError if `max_message_age_s` is not finite or below 0.
    """

    def __init__(self, robot_id: int, max_message_age_s: float = 0.8) -> None:
        require(NonNegative, max_message_age_s, "max_message_age_s")
        self._robot_id = robot_id
        self._max_message_age_s = max_message_age_s
        # By the paper's rule, at any age.
        self._kept_s = max_message_age_s or math.inf
        # A robot without a battery-backed clock may come back with a smaller boot epoch. Once it
        # was silent for longer than a message can be in transit, nothing of an earlier start can
        # still arrive, so whatever does is of a new one.
        self._restart_silence_s = max(max_message_age_s, _LONGEST_TRANSIT_S)
        self._lock = Lock()
        self._received: dict[int, _Received] = {}
        self._handed_out: dict[int, _Received] = {}  # the paper's rule only
        # Outlives the messages: a late duplicate must not pass for news.
        self._heard: dict[int, _LastHeard] = {}
        self._accepted: Counter[int] = Counter()
        self._arrived: dict[int, _Arrived] = {}
        self._counts: Counter[str] = Counter(
            dict.fromkeys(["accepted", *(reason.value for reason in Rejection)], 0)
        )

    def receive(
        self, message: AggregatedMessage, now_s: float, age_s: float | None
    ) -> Rejection | None:
        """Keep `message`, which is at most so old, if it is its sender's newest.

        Else say why not: OWN, OUTDATED, AGE_UNKNOWN or STALE. Nobody may change the message or its
        payload afterwards.
        """
        with self._lock:
            rejection = self._rejection(message, now_s, age_s)
            self._count_arrival(message, age_s, rejection)
            if rejection is None:
                sender = message.robot_id
                self._heard[sender] = _LastHeard(message.boot_epoch, message.sequence, now_s)
                self._received[sender] = _Received(message, now_s - (age_s or 0.0))
                self._accepted[sender] += 1
            self._counts[rejection or "accepted"] += 1
        return rejection

    def swap(self, now_s: float) -> tuple[AggregatedMessage, ...]:
        """The messages for one policy tick, by robot id: their order of arrival is no matter."""
        with self._lock:
            handed_out = self._received
            if self._max_message_age_s == 0.0:
                self._handed_out, self._received = self._received, {}
            received = sorted(handed_out.items())
        return tuple(entry.message for _, entry in received if now_s - entry.born_s < self._kept_s)

    def neighbours(self, now_s: float) -> tuple[Neighbour, ...]:
        """Neighbours and their positions, by robot id; takes nothing away."""
        with self._lock:
            newest = self._handed_out | self._received if self._handed_out else self._received
            received = sorted(newest.items())
        kept_s = self._kept_s
        neighbours = [
            Neighbour(
                robot_id,
                message.position_m,
                message.velocity_m_s,
                age_s if age_s > 0.0 else 0.0,
                message.trial,
                message.shared,
            )
            for robot_id, (message, born_s) in received
            if (age_s := now_s - born_s) < kept_s
        ]
        return tuple(neighbours)

    def reject(self, reason: Rejection) -> None:
        """Count a message that did not come this far."""
        with self._lock:
            self._counts[reason] += 1

    def counts(self) -> dict[str, int]:
        """How many messages were accepted, and how many rejected for each reason, so far."""
        with self._lock:
            return dict(self._counts)

    def accepted(self) -> dict[int, int]:
        """How many messages of each neighbour were accepted so far, by robot id."""
        with self._lock:
            return dict(self._accepted)

    def arrivals(self) -> dict[int, Arrivals]:
        """Counts of messages of each neighbour so far, also late or overtaken ones, by robot id."""
        with self._lock:
            return {sender: known.arrivals for sender, known in self._arrived.items()}

    def clear(self) -> None:
        """Forget the messages, for a new mission; not the counts, nor what was the newest."""
        with self._lock:
            self._received = {}
            self._handed_out = {}

    def _count_arrival(
        self, message: AggregatedMessage, age_s: float | None, rejection: Rejection | None
    ) -> None:
        sender, epoch, sequence = message.robot_id, message.boot_epoch, message.sequence
        if rejection is Rejection.OWN:
            return
        known = self._arrived.get(sender)
        if known is None:
            known = _Arrived(epoch, sequence - 1, Arrivals())
        elif epoch != known.boot_epoch:
            if rejection is Rejection.OUTDATED:
                return  # of an earlier start
            known = known._replace(boot_epoch=epoch, sequence=sequence - 1)
        elif sequence == known.sequence:
            return  # it came twice
        arrivals = known.arrivals.plus(max(0, sequence - known.sequence), age_s)
        self._arrived[sender] = _Arrived(epoch, max(sequence, known.sequence), arrivals)

    def _silent(self, heard: _LastHeard, now_s: float) -> bool:
        return now_s - heard.at_s > self._restart_silence_s

    def _rejection(
        self, message: AggregatedMessage, now_s: float, age_s: float | None
    ) -> Rejection | None:
        if message.robot_id == self._robot_id:
            return Rejection.OWN
        heard = self._heard.get(message.robot_id)
        if (
            heard is not None
            and (message.boot_epoch, message.sequence) <= heard[:2]
            and (message.boot_epoch == heard.boot_epoch or not self._silent(heard, now_s))
        ):
            return Rejection.OUTDATED
        if self._max_message_age_s == 0.0:
            return None
        if age_s is None:
            return Rejection.AGE_UNKNOWN
        return None if age_s < self._max_message_age_s else Rejection.STALE
