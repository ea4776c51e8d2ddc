"""Messages from the ground, queued for the control loop: its state, holds, orders and world.

The link's threads only store bytes; the reading thread decodes them.
"""

import functools
import math
from collections import deque
from dataclasses import replace
from threading import Lock
from typing import NamedTuple

from edge.identity.envelope import RELEASE
from edge.identity.guard import Sender
from edge.identity.members import Role
from edge.messages.codec import MessageError, decode
from edge.messages.mission import (
    HOLD_LASTS_S,
    GroundState,
    Hold,
    Order,
    SafetyAction,
    SafetyRequest,
)
from edge.robot.neighbours import BEACON_LASTS_S, NeighbourTable

_MOST_ORDERS = 64
_MOST_STATES = 16
# Each state names a part of the fleet; a large fleet needs this long to name all robots.
_CONTACT_TIMEOUT_S = 20.0
# Robots that the ground has received for longer should be in this robot's range, too.
_CONTACT_SETTLES_S = 5.0


class _Received(NamedTuple):
    data: bytes
    sender: Sender
    at_s: float


class _GroundContact(NamedTuple):
    """Period in which the ground names a robot in its echoes."""

    since_s: float
    at_s: float


class Inbox:
    """Received messages. Call `receive_*` from any thread, each other method from one thread.

    `other_release` is the release of the ground whose state counts, "" if it is this robot's own.
    `ground_refusal` says why the newest state could not be decoded, "" if it could. `world` is the
    newest world file, set whole by the link's threads.
    """

    def __init__(self, robot_id: int, ground_timeout_s: float, release: bytes = RELEASE) -> None:
        """Of several grounds' states the one with the greatest (sequence, operator) counts.

        After the timeout without a state, a smaller one counts too. A hold of another station, or
        of an observer, counts while it is repeated and the commander requests no safety action.
        """
        self._robot_id = robot_id
        self._ground_timeout_s = ground_timeout_s
        self._release = release
        self.other_release = ""
        self._lock = Lock()
        self._grounds: deque[_Received] = deque(maxlen=_MOST_STATES)
        self._orders: deque[_Received] = deque(maxlen=_MOST_ORDERS)
        # By robot id, the time of its last message in another version.
        self._unreadable: dict[int, float] = {}
        self._ground: GroundState | None = None
        self._ground_at_s = -math.inf
        self._holds: deque[_Received] = deque(maxlen=_MOST_STATES)
        self._held_by = ""
        self._held_at_s = -math.inf
        # The safety action of a state that could not be decoded whole.
        self._refused_action: SafetyAction = "none"
        self._refused_at_s = -math.inf
        self.ground_refusal = ""
        self.world: bytes | None = None
        self.not_understood_count = 0
        self._contacts: dict[int, _GroundContact] = {}

    def receive_ground(self, data: bytes, sender: Sender, now_s: float) -> None:
        """Queue a ground's state."""
        self._grounds.append(_Received(data, sender, now_s))

    def receive_hold(self, data: bytes, sender: Sender, now_s: float) -> None:
        """Queue a station's hold."""
        self._holds.append(_Received(data, sender, now_s))

    def receive_order(self, data: bytes, sender: Sender, now_s: float) -> None:
        """Queue an order."""
        self._orders.append(_Received(data, sender, now_s))

    def receive_unreadable(self, robot_id: int, now_s: float) -> None:
        """Record a robot's message of another version."""
        with self._lock:
            self.not_understood_count += 1
            self._unreadable[robot_id] = now_s

    def ground(self, now_s: float) -> tuple[GroundState | None, float]:
        """The ground's newest state and its age, s; infinite before the first. Control thread."""
        while self._grounds:
            received = self._grounds.popleft()
            try:
                state = _ground_state(received.data)
            except MessageError as error:
                self.not_understood_count += 1
                self.ground_refusal = str(error)
                self._read_safety_request(received)
                continue
            if _is_from(state.operator, received.sender) and self._counts(state, received.at_s):
                self._ground, self._ground_at_s = state, received.at_s
                self._update_contacts(state, received.at_s)
                self._refused_action, self.ground_refusal = "none", ""
                self._set_release(received.sender)
        return self._with_hold(now_s), now_s - self._ground_at_s

    def _update_contacts(self, state: GroundState, at_s: float) -> None:
        with self._lock:
            for robot_id in map(int, state.echoes):
                before = self._contacts.get(robot_id)
                is_new = before is None or at_s - before.at_s > _CONTACT_TIMEOUT_S
                since_s = at_s if before is None or is_new else before.since_s
                self._contacts[robot_id] = _GroundContact(since_s, at_s)

    def _with_hold(self, now_s: float) -> GroundState | None:
        while self._holds:
            received = self._holds.popleft()
            try:
                hold = decode(Hold, received.data)
            except MessageError:
                self.not_understood_count += 1
                continue
            if hold.is_of(self._robot_id) and received.sender.name in ("", hold.by):
                self._held_by, self._held_at_s = hold.by, received.at_s
        ground = self._ground
        if (
            ground is None
            or now_s - self._held_at_s > HOLD_LASTS_S
            or ground.safety_action_for(self._robot_id) != "none"
        ):
            return ground
        return replace(
            ground,
            robot_safety_actions=ground.robot_safety_actions | {str(self._robot_id): "hold"},
            safety_action_by=self._held_by,
        )

    def safety_request(self, now_s: float) -> SafetyAction:
        """Safety action of a ground whose states are refused: hold, land, or none. Control thread.

        The last state that was decoded stays, and its age grows.
        """
        fresh = now_s - self._refused_at_s <= self._ground_timeout_s
        return self._refused_action if fresh else "none"

    def _read_safety_request(self, received: _Received) -> None:
        try:
            request = decode(SafetyRequest, received.data)
        except MessageError:
            return
        if _is_from(request.operator, received.sender) and self._counts(request, received.at_s):
            action = request.safety_action_for(self._robot_id)
            self._refused_action = action if action in ("hold", "land") else "none"
            self._refused_at_s = received.at_s
            self._set_release(received.sender)

    def _set_release(self, sender: Sender) -> None:
        self.other_release = "" if sender.release == self._release else sender.release.hex()

    def _counts(self, state: SafetyRequest, at_s: float) -> bool:
        newest = self._ground
        if newest is None or at_s - self._ground_at_s > self._ground_timeout_s:
            return True
        return (state.sequence, state.operator) >= (newest.sequence, newest.operator)

    def ground_age_s(self, now_s: float) -> float:
        """Age of the ground's newest state, s; infinite before the first. From any thread."""
        return now_s - self._ground_at_s

    def ground_unix_s(self, now_s: float) -> float | None:
        """The ground's wall clock, None if not known. From any thread."""
        ground, at_s = self._ground, self._ground_at_s
        if ground is None or ground.unix_time_s is None:
            return None
        return ground.unix_time_s + now_s - at_s

    def order(self, now_s: float) -> Order | None:
        """The next order for this robot that arrived by `now_s`. Control thread.

        A later one was made with a later uptime than the tick's, and would seem valid too long.
        """
        while self._orders and self._orders[0].at_s <= now_s:
            data, sender, _ = self._orders.popleft()
            try:
                order = decode(Order, data)
            except MessageError:
                self.not_understood_count += 1
                continue
            if order.robot_id == self._robot_id and _is_from(order.operator, sender):
                return order
        return None

    def unreadable_robots(self, now_s: float) -> tuple[int, ...]:
        """Ids of robots with a recent message of another version."""
        with self._lock:
            self._unreadable = {
                robot_id: at_s
                for robot_id, at_s in sorted(self._unreadable.items())
                if now_s - at_s <= BEACON_LASTS_S
            }
            return tuple(self._unreadable)

    def missing_robots(self, now_s: float, table: NeighbourTable) -> tuple[int, ...]:
        """Ids of robots that the ground receives and this robot does not."""
        with self._lock:
            return tuple(
                robot_id
                for robot_id, (since_s, at_s) in sorted(self._contacts.items())
                if robot_id != self._robot_id
                and robot_id not in self._unreadable
                and now_s - at_s <= _CONTACT_TIMEOUT_S
                and at_s - max(since_s, table.last_received_s(robot_id)) >= _CONTACT_SETTLES_S
            )


# In a simulator, the robots of one process decode the same bytes in turn.
@functools.lru_cache(maxsize=4)
def _ground_state(data: bytes) -> GroundState:
    return decode(GroundState, data)


def _is_from(operator: str, sender: Sender) -> bool:
    """Whether the sender is the operator that its message names, as far as known."""
    return sender.role is Role.OPERATOR and sender.name in ("", operator)
