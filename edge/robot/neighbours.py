"""The other robots: the newest that each has said, between the link's threads and the loops.

Paper: "A Scalable Multi-Robot Framework for Decentralized and Asynchronous
Perception-Action-Communication Loops", section "Inter-Robot Communication". For the policy's
messages this is its receive buffer; the message to transmit is what a policy tick returns.
"""

import math
from collections import Counter
from dataclasses import dataclass, field
from threading import Lock
from typing import NamedTuple

from edge.core.aggregation import AggregatedMessage
from edge.core.arrivals import Arrivals
from edge.core.schema import NonNegative, require
from edge.core.wire import Rejection
from edge.messages.beacon import Beacon, ReceivedBeacon

# After a cut, TCP delivers data that is up to 2 s old; nothing is in transit longer than this.
_LONGEST_TRANSIT_S = 5.0

# What a robot said of itself holds for so long.
BEACON_LASTS_S = 3.0
MAX_MESSAGE_AGE_S = 0.8

# (start, sequence): of a sender's two messages the one with the greater number is newer.
Number = tuple[int, int]
_NO_NUMBER: Number = (-1, -1)


class ReceivedMessage(NamedTuple):
    """A policy's message, the beacon before it, and since when it may be on its way, s."""

    beacon: Beacon
    message: AggregatedMessage
    sent_at_s: float


@dataclass(slots=True)
class _Robot:
    """One robot's newest beacon, and its policy's newest message."""

    number: Number
    heard: ReceivedBeacon
    message_number: Number = _NO_NUMBER
    # Taken by the swap, and not yet.
    handed_out: ReceivedMessage | None = None
    received: ReceivedMessage | None = None
    accepted: int = 0
    # The newest number that came, whatever its age was.
    arrived: Number | None = None
    arrivals: Arrivals = field(default_factory=Arrivals)


class NeighbourTable:
    """One robot's knowledge of the others. Every method may be called from any thread.

    `now_s` is the robot's own monotonic clock, s. How old a message was when it came is for the
    caller to say: its greatest possible age. A policy's message of which that is not known is not
    kept.

    `swap` and `neighbours` leave out what is not younger than `max_message_age_s`, and take nothing
    away. With 0 age plays no part, and the paper's rule holds: `swap` hands each message out once,
    and a neighbour is in `neighbours` until a `swap` that finds nothing new from it.

    Raises ValueError if `max_message_age_s` is not finite or below 0.
    """

    def __init__(self, robot_id: int, max_message_age_s: float = MAX_MESSAGE_AGE_S) -> None:
        require(NonNegative, max_message_age_s, "max_message_age_s")
        self._robot_id = robot_id
        self._max_message_age_s = max_message_age_s
        # By the paper's rule, at any age.
        self._kept_s = max_message_age_s or math.inf
        self._extrapolated_s = max_message_age_s or MAX_MESSAGE_AGE_S
        # Arrival of the newest message in this robot's own name.
        self._own_heard_at_s = -math.inf
        # A robot without a battery-backed clock may come back with a smaller start, and a stranger
        # may have sent a greater number in its name. After a silence that is longer than a message
        # can be in transit, any beacon counts again, and any policy's message of another start.
        self._restart_silence_s = max(max_message_age_s, _LONGEST_TRANSIT_S)
        self._lock = Lock()
        # Outlive the messages: a late duplicate must not pass for news.
        # In the order of robot ids.
        self._robots: dict[int, _Robot] = {}
        self._counts: Counter[str] = Counter(
            dict.fromkeys(["accepted", *(reason.value for reason in Rejection)], 0)
        )

    def receive(
        self,
        beacon: Beacon,
        number: Number,
        message: AggregatedMessage | Rejection | None,
        now_s: float,
        age_s: float | None,
    ) -> Rejection | None:
        """Keep a beacon, and the policy's message behind it, which are at most so old, if newest.

        `message` may be why it cannot be used; None if the policy is silent. Returns why it is not
        kept, or the beacon is not: OWN, OUTDATED, AGE_UNKNOWN, STALE, or what `message` is. Nobody
        may change the message or its payload afterwards.
        """
        with self._lock:
            rejection = self._receive(beacon, number, message, now_s, age_s)
            if message is not None:
                self._counts[rejection or "accepted"] += 1
        return rejection

    def _receive(
        self,
        beacon: Beacon,
        number: Number,
        message: AggregatedMessage | Rejection | None,
        now_s: float,
        age_s: float | None,
    ) -> Rejection | None:
        if beacon.robot_id == self._robot_id:
            self._own_heard_at_s = now_s
            return Rejection.OWN
        # The position of an older message is taken as of its arrival, not extrapolated.
        known_s = age_s if age_s is not None and age_s < self._extrapolated_s else 0.0
        heard = ReceivedBeacon(beacon, now_s, now_s - known_s)
        robot = self._robots.get(beacon.robot_id)
        if robot is None:
            robot = _Robot(number, heard)
            self._robots = dict(sorted([*self._robots.items(), (beacon.robot_id, robot)]))
        silent = now_s - robot.heard.received_at_s > self._restart_silence_s
        if silent and number[0] != robot.message_number[0]:
            robot.message_number = _NO_NUMBER
        if number > robot.number or silent:
            robot.number, robot.heard = number, heard
        elif robot.heard is not heard:
            _count(robot, number, age_s, is_outdated=True)
            return Rejection.OUTDATED
        _count(robot, number, age_s)
        if message is None or isinstance(message, Rejection):
            return message
        if not number > robot.message_number:
            return Rejection.OUTDATED
        robot.message_number = number
        if self._max_message_age_s > 0.0:
            if age_s is None:
                return Rejection.AGE_UNKNOWN
            if not age_s < self._max_message_age_s:
                return Rejection.STALE
        robot.received = ReceivedMessage(beacon, message, now_s - (age_s or 0.0))
        robot.accepted += 1
        return None

    # For the policy

    def swap(self, now_s: float) -> tuple[ReceivedMessage, ...]:
        """The messages for one policy tick, by robot id: their order of arrival is no matter."""
        with self._lock:
            received = [robot.received for robot in self._robots.values()]
            if self._max_message_age_s == 0.0:
                for robot in self._robots.values():
                    robot.handed_out, robot.received = robot.received, None
        return self._fresh(received, now_s)

    def neighbours(self, now_s: float) -> tuple[ReceivedMessage, ...]:
        """Robots whose policies are heard, by robot id; takes nothing away."""
        with self._lock:
            received = [r.received or r.handed_out for r in self._robots.values()]
        return self._fresh(received, now_s)

    def _fresh(
        self, received: list[ReceivedMessage | None], now_s: float
    ) -> tuple[ReceivedMessage, ...]:
        kept_s = self._kept_s
        return tuple(each for each in received if each and now_s - each.sent_at_s < kept_s)

    # For everybody else

    def heard(self, now_s: float, max_age_s: float) -> tuple[ReceivedBeacon, ...]:
        """Beacons that came in the last `max_age_s`, of any mission frame, by robot id."""
        with self._lock:
            heard = [robot.heard for robot in self._robots.values()]
        return tuple(each for each in heard if now_s - each.received_at_s <= max_age_s)

    def is_own_id_heard(self, now_s: float) -> bool:
        """Whether another program sent a message with this robot's id in the last seconds."""
        return now_s - self._own_heard_at_s <= BEACON_LASTS_S

    def last_heard_s(self, robot_id: int) -> float:
        """When the robot was heard last; -inf if never."""
        robot = self._robots.get(robot_id)
        return -math.inf if robot is None else robot.heard.received_at_s

    def counts(self) -> dict[str, int]:
        """How many policies' messages were accepted, and rejected for each reason, so far."""
        with self._lock:
            return dict(self._counts)

    def accepted(self) -> dict[int, int]:
        """How many messages of each neighbour's policy were accepted so far, by robot id."""
        with self._lock:
            return {r: robot.accepted for r, robot in self._robots.items() if robot.accepted}

    def arrivals(self) -> dict[int, Arrivals]:
        """Counts of messages of each neighbour so far, also late or overtaken ones, by robot id."""
        with self._lock:
            return {robot_id: robot.arrivals for robot_id, robot in self._robots.items()}

    def clear(self) -> None:
        """Forget the messages, for a new mission; not the counts, nor what was the newest."""
        with self._lock:
            for robot in self._robots.values():
                robot.received = robot.handed_out = None


def _count(
    robot: _Robot, number: Number, age_s: float | None, *, is_outdated: bool = False
) -> None:
    (start, sequence), arrived = number, robot.arrived
    if arrived is None or start != arrived[0]:
        if is_outdated:
            return  # Of an earlier start.
        arrived = start, sequence - 1
    elif sequence == arrived[1]:
        return  # It came twice.
    robot.arrivals = robot.arrivals.plus(max(0, sequence - arrived[1]), age_s)
    robot.arrived = start, max(sequence, arrived[1])
