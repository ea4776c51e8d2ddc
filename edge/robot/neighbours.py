"""The other robots' newest messages: written by the link's threads, read by the loops.

Paper: "A Scalable Multi-Robot Framework for Decentralized and Asynchronous
Perception-Action-Communication Loops", section "Inter-Robot Communication": for the policy's
messages this is the receive buffer. A policy tick returns the message to transmit.
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
from edge.identity.guard import LONGEST_TRANSIT_S
from edge.messages.beacon import Beacon, ReceivedBeacon

# Validity of a beacon, from its arrival.
BEACON_LASTS_S = 3.0
MAX_MESSAGE_AGE_S = 0.8

# (start, sequence): of a sender's two messages the one with the greater number is newer.
Number = tuple[int, int]
_NO_NUMBER: Number = (-1, -1)


class ReceivedMessage(NamedTuple):
    """A policy's message, the beacon before it, and its earliest send time, s."""

    beacon: Beacon
    message: AggregatedMessage
    sent_at_s: float


@dataclass(slots=True)
class _Robot:
    """One robot's newest beacon, and its policy's newest message."""

    number: Number
    beacon: ReceivedBeacon
    message_number: Number = _NO_NUMBER
    # Handed out by the last swap, and received since.
    handed_out: ReceivedMessage | None = None
    received: ReceivedMessage | None = None
    accepted: int = 0
    # The newest number, whatever its age was.
    arrived: Number | None = None
    arrivals: Arrivals = field(default_factory=Arrivals)


class NeighbourTable:
    """One robot's knowledge of the others. Thread-safe.

    `now_s` is the robot's own monotonic clock, s. `age_s` is a message's greatest possible age at
    its arrival; a policy's message of unknown age is not kept.

    `swap` and `neighbours` leave out messages of age `max_message_age_s` or more, and remove
    nothing. With 0, age does not matter and the paper's rule holds: `swap` returns each message
    once, and a neighbour is in `neighbours` until a `swap` without a new message from it.

    Raises ValueError if `max_message_age_s` is not finite or below 0.
    """

    def __init__(self, robot_id: int, max_message_age_s: float = MAX_MESSAGE_AGE_S) -> None:
        require(NonNegative, max_message_age_s, "max_message_age_s")
        self._robot_id = robot_id
        self._max_message_age_s = max_message_age_s
        # By the paper's rule, at any age.
        self._kept_s = max_message_age_s or math.inf
        self._extrapolated_s = max_message_age_s or MAX_MESSAGE_AGE_S
        # Arrival of the last message with this robot's own id.
        self._own_received_at_s = -math.inf
        # A robot without a battery-backed clock may restart with a smaller start, and a stranger
        # may have sent a greater number in its name. After a silence longer than any transit, each
        # beacon is accepted again, and each policy's message of another start.
        self._restart_silence_s = max(max_message_age_s, LONGEST_TRANSIT_S)
        self._lock = Lock()
        # By robot id, ascending. Never removed: a late duplicate must not pass for a new message.
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
        """Keep a beacon, and the policy's message after it, if they are the newest.

        `message` is a Rejection if it cannot be used, None if the policy is silent. Returns why
        the message, or the beacon, is not kept: OWN, OUTDATED, AGE_UNKNOWN, STALE, or `message`.
        The message and its payload must not change afterwards.
        """
        rejection: Rejection | None
        with self._lock:
            if beacon.robot_id == self._robot_id:
                self._own_received_at_s = now_s
                rejection = Rejection.OWN
            elif (robot := self._keep_beacon(beacon, number, now_s, age_s)) is None:
                rejection = Rejection.OUTDATED
            elif isinstance(message, AggregatedMessage):
                received = ReceivedMessage(beacon, message, now_s - (age_s or 0.0))
                rejection = self._keep_message(robot, received, number, age_s)
            else:
                rejection = message
            if message is not None:
                self._counts[rejection or "accepted"] += 1
        return rejection

    def _keep_beacon(
        self, beacon: Beacon, number: Number, now_s: float, age_s: float | None
    ) -> _Robot | None:
        """The beacon's robot; None if the beacon is outdated."""
        # The position of an older beacon counts as of its arrival, and is not extrapolated.
        known_s = age_s if age_s is not None and age_s < self._extrapolated_s else 0.0
        received = ReceivedBeacon(beacon, now_s, now_s - known_s)
        robot = self._robots.get(beacon.robot_id)
        if robot is None:
            robot = _Robot(number, received)
            self._robots = dict(sorted([*self._robots.items(), (beacon.robot_id, robot)]))
        silent = now_s - robot.beacon.received_at_s > self._restart_silence_s
        if silent and number[0] != robot.message_number[0]:
            robot.message_number = _NO_NUMBER
        if number > robot.number or silent:
            robot.number, robot.beacon = number, received
        elif robot.beacon is not received:
            _count(robot, number, age_s, is_outdated=True)
            return None
        _count(robot, number, age_s)
        return robot

    def _keep_message(
        self, robot: _Robot, received: ReceivedMessage, number: Number, age_s: float | None
    ) -> Rejection | None:
        if not number > robot.message_number:
            return Rejection.OUTDATED
        robot.message_number = number
        if self._max_message_age_s > 0.0:
            if age_s is None:
                return Rejection.AGE_UNKNOWN
            if not age_s < self._max_message_age_s:
                return Rejection.STALE
        robot.received = received
        robot.accepted += 1
        return None

    def swap(self, now_s: float) -> tuple[ReceivedMessage, ...]:
        """The messages for one policy tick, by robot id, whatever their order of arrival."""
        with self._lock:
            received = [robot.received for robot in self._robots.values()]
            if self._max_message_age_s == 0.0:
                for robot in self._robots.values():
                    robot.handed_out, robot.received = robot.received, None
        return self._fresh(received, now_s)

    def neighbours(self, now_s: float) -> tuple[ReceivedMessage, ...]:
        """The policies' fresh messages, by robot id; removes nothing."""
        with self._lock:
            received = [r.received or r.handed_out for r in self._robots.values()]
        return self._fresh(received, now_s)

    def _fresh(
        self, received: list[ReceivedMessage | None], now_s: float
    ) -> tuple[ReceivedMessage, ...]:
        kept_s = self._kept_s
        return tuple(each for each in received if each and now_s - each.sent_at_s < kept_s)

    def beacons(self, now_s: float, max_age_s: float) -> tuple[ReceivedBeacon, ...]:
        """Beacons of the last `max_age_s`, of any mission frame, by robot id."""
        with self._lock:
            beacons = [robot.beacon for robot in self._robots.values()]
        return tuple(each for each in beacons if now_s - each.received_at_s <= max_age_s)

    def is_own_id_received(self, now_s: float) -> bool:
        """Whether another program sent a message with this robot's id in the last seconds."""
        return now_s - self._own_received_at_s <= BEACON_LASTS_S

    def last_received_s(self, robot_id: int) -> float:
        """Arrival of the robot's last beacon; -inf if there was none."""
        robot = self._robots.get(robot_id)
        return -math.inf if robot is None else robot.beacon.received_at_s

    def counts(self) -> dict[str, int]:
        """Counts of policies' messages: accepted, and rejected for each reason."""
        with self._lock:
            return dict(self._counts)

    def accepted(self) -> dict[int, int]:
        """Counts of accepted policies' messages, by robot id."""
        with self._lock:
            return {r: robot.accepted for r, robot in self._robots.items() if robot.accepted}

    def arrivals(self) -> dict[int, Arrivals]:
        """Arrivals of each robot's messages, late and overtaken ones included, by robot id."""
        with self._lock:
            return {robot_id: robot.arrivals for robot_id, robot in self._robots.items()}

    def clear(self) -> None:
        """Forget the messages, for a new mission; keep the counts and the newest numbers."""
        with self._lock:
            for robot in self._robots.values():
                robot.received = robot.handed_out = None


def _count(
    robot: _Robot, number: Number, age_s: float | None, *, is_outdated: bool = False
) -> None:
    (start, sequence), arrived = number, robot.arrived
    if arrived is None or start != arrived[0]:
        if is_outdated:
            return  # From an earlier start.
        arrived = start, sequence - 1
    elif sequence == arrived[1]:
        return  # A duplicate.
    robot.arrivals = robot.arrivals.plus(max(0, sequence - arrived[1]), age_s)
    robot.arrived = start, max(sequence, arrived[1])
