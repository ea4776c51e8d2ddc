"""Messages of the ground, kept for the loops: its state, holds, orders and world.

The link's threads only put bytes in; whoever takes something out decodes it.
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
# The ground names whom it hears; in a large fleet it takes so long until all had their turn.
_GROUND_NAMES_WITHIN_S = 20.0
# Whom the ground has heard for so long a robot hears, too, unless their radios do not reach.
_HEARD_WITHIN_S = 5.0


class _Arrived(NamedTuple):
    data: bytes
    sender: Sender
    at_s: float


class _HeardByGround(NamedTuple):
    """Since when the ground names a robot among those that it hears, and when it did last."""

    since_s: float
    at_s: float


class Inbox:
    """`put_*` may be called from any thread, each other method from one thread."""

    def __init__(self, robot_id: int, ground_timeout_s: float, release: bytes = RELEASE) -> None:
        """Of several grounds' states the one with the greatest (sequence, operator) counts.

        A smaller one does once no other came for the timeout. A hold of another station, or of an
        observer, counts while it is repeated and the commander asks for nothing.
        """
        self._robot_id = robot_id
        self._ground_timeout_s = ground_timeout_s
        self._release = release
        # Of the ground whose state counts; "" if it is this robot's own.
        self.other_release = ""
        self._lock = Lock()
        self._grounds: deque[_Arrived] = deque(maxlen=_MOST_STATES)
        self._orders: deque[_Arrived] = deque(maxlen=_MOST_ORDERS)
        # When robots, by what they are called, said what is no beacon of this version.
        self._strangers: dict[str, float] = {}
        self._ground: GroundState | None = None
        self._ground_at_s = -math.inf
        self._holds: deque[_Arrived] = deque(maxlen=_MOST_STATES)
        self._held_by = ""
        self._held_at_s = -math.inf
        self._refused_asks: SafetyAction = "none"
        self._refused_at_s = -math.inf
        # Why the newest state of a ground was not understood; "" if it was.
        self.ground_refusal = ""
        # The text of the newest world file that the ground sent.
        self.world: bytes | None = None
        self.not_understood_count = 0
        self._heard_by_ground: dict[int, _HeardByGround] = {}

    def put_ground(self, data: bytes, sender: Sender, now_s: float) -> None:
        """A ground's state arrived."""
        self._grounds.append(_Arrived(data, sender, now_s))

    def put_hold(self, data: bytes, sender: Sender, now_s: float) -> None:
        """A station's hold arrived."""
        self._holds.append(_Arrived(data, sender, now_s))

    def put_world(self, data: bytes) -> None:
        """A world file arrived."""
        self.world = data

    def put_order(self, data: bytes, sender: Sender, now_s: float) -> None:
        """An order arrived."""
        self._orders.append(_Arrived(data, sender, now_s))

    def put_stranger(self, name: str, now_s: float) -> None:
        """A robot's message arrived that could not be read."""
        with self._lock:
            self.not_understood_count += 1
            self._strangers[name] = now_s

    def ground(self, now_s: float) -> tuple[GroundState | None, float]:
        """The ground's newest state and its age, s (infinite if none came). Control thread."""
        while self._grounds:
            arrived = self._grounds.popleft()
            try:
                state = _ground_state(arrived.data)
            except MessageError as error:
                self.not_understood_count += 1
                self.ground_refusal = str(error)
                self._take_safety_request(arrived)
                continue
            if _is_own(state.operator, arrived.sender) and self._counts(state, arrived.at_s):
                self._ground, self._ground_at_s = state, arrived.at_s
                self._put_echoes(state, arrived.at_s)
                self._refused_asks, self.ground_refusal = "none", ""
                self._note_release(arrived.sender)
        return self._with_asked_hold(now_s), now_s - self._ground_at_s

    def _put_echoes(self, state: GroundState, at_s: float) -> None:
        with self._lock:
            for robot_id in map(int, state.echoes):
                before = self._heard_by_ground.get(robot_id)
                is_new = before is None or at_s - before.at_s > _GROUND_NAMES_WITHIN_S
                since_s = at_s if before is None or is_new else before.since_s
                self._heard_by_ground[robot_id] = _HeardByGround(since_s, at_s)

    def _with_asked_hold(self, now_s: float) -> GroundState | None:
        while self._holds:
            arrived = self._holds.popleft()
            try:
                hold = decode(Hold, arrived.data)
            except MessageError:
                self.not_understood_count += 1
                continue
            if hold.is_of(self._robot_id) and arrived.sender.name in ("", hold.by):
                self._held_by, self._held_at_s = hold.by, arrived.at_s
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
        """Request of a ground whose states are refused: hold, land, or none. Control thread.

        The last state that was understood stays, and its age grows.
        """
        fresh = now_s - self._refused_at_s <= self._ground_timeout_s
        return self._refused_asks if fresh else "none"

    def _take_safety_request(self, arrived: _Arrived) -> None:
        try:
            request = decode(SafetyRequest, arrived.data)
        except MessageError:
            return
        if _is_own(request.operator, arrived.sender) and self._counts(request, arrived.at_s):
            asked = request.safety_action_for(self._robot_id)
            self._refused_asks = asked if asked in ("hold", "land") else "none"
            self._refused_at_s = arrived.at_s
            self._note_release(arrived.sender)

    def _note_release(self, sender: Sender) -> None:
        self.other_release = "" if sender.release == self._release else sender.release.hex()

    def _counts(self, state: SafetyRequest, at_s: float) -> bool:
        newest = self._ground
        if newest is None or at_s - self._ground_at_s > self._ground_timeout_s:
            return True
        return (state.sequence, state.operator) >= (newest.sequence, newest.operator)

    def ground_age_s(self, now_s: float) -> float:
        """The age of the ground's newest state, s; infinite if none came. From any thread."""
        return now_s - self._ground_at_s

    def ground_unix_s(self, now_s: float) -> float | None:
        """The ground's wall clock, None if it is not known. From any thread."""
        ground, at_s = self._ground, self._ground_at_s
        if ground is None or ground.unix_time_s is None:
            return None
        return ground.unix_time_s + now_s - at_s

    def order(self, now_s: float) -> Order | None:
        """The next order for this robot, if one has come by then. Control thread.

        What came since was made by a later uptime than the tick's, and would seem valid too long.
        """
        while self._orders and self._orders[0].at_s <= now_s:
            data, sender, _ = self._orders.popleft()
            try:
                order = decode(Order, data)
            except MessageError:
                self.not_understood_count += 1
                continue
            if order.robot_id == self._robot_id and _is_own(order.operator, sender):
                return order
        return None

    def strangers(self, now_s: float) -> tuple[str, ...]:
        """Robots that said lately what could not be read."""
        with self._lock:
            self._strangers = {
                name: at_s
                for name, at_s in sorted(self._strangers.items())
                if now_s - at_s <= BEACON_LASTS_S
            }
            return tuple(self._strangers)

    def unheard(self, now_s: float, table: NeighbourTable) -> tuple[int, ...]:
        """Robots that the ground hears and this one does not."""
        with self._lock:
            return tuple(
                robot_id
                for robot_id, (since_s, at_s) in sorted(self._heard_by_ground.items())
                if robot_id != self._robot_id
                and f"robot {robot_id}" not in self._strangers
                and now_s - at_s <= _GROUND_NAMES_WITHIN_S
                # The ground heard it, and this robot did not.
                and at_s - max(since_s, table.last_heard_s(robot_id)) >= _HEARD_WITHIN_S
            )


@functools.lru_cache(maxsize=4)
def _ground_state(data: bytes) -> GroundState:
    """The robots of one process, as in a simulator, hear the same bytes. Raises MessageError."""
    return decode(GroundState, data)


def _is_own(operator: str, sender: Sender) -> bool:
    """Whether who says it is the operator that it names, as far as that is known."""
    return sender.role is Role.OPERATOR and sender.name in ("", operator)
