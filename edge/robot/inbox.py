"""What came by radio, kept for the loops: the ground's state and orders, and others' statuses.

The link's threads only put bytes in; whoever takes something out decodes it.
"""

import math
from collections import deque
from threading import Lock
from typing import NamedTuple

from edge.flight.preflight import HeardStatus
from edge.messages.codec import MessageError, decode
from edge.messages.mission import (
    GroundState,
    KillForm,
    Order,
    RobotStatus,
    SafetyAction,
    SafetyForm,
)

_MOST_ORDERS = 64
_MOST_STATES = 16
_STATUS_LIFETIME_S = 3.0


class _Arrived(NamedTuple):
    data: bytes
    at_s: float
    unix_s: float


class Inbox:
    """`put_*` may be called from any thread, each other method from one thread."""

    def __init__(self, robot_id: int, ground_timeout_s: float) -> None:
        """Of several grounds' states the one with the greatest (sequence, operator) counts.

        A smaller one does once no other came for the timeout.
        """
        self._robot_id = robot_id
        self._ground_timeout_s = ground_timeout_s
        self._lock = Lock()
        self._grounds: deque[_Arrived] = deque(maxlen=_MOST_STATES)
        self._orders: deque[bytes] = deque(maxlen=_MOST_ORDERS)
        self._statuses: dict[str, _Arrived] = {}
        self._ground: GroundState | None = None
        self._ground_at_s = -math.inf
        self._safety_form: SafetyAction = "none"
        self._safety_form_at_s = -math.inf
        # Why the newest state of a ground was not understood; "" if it was.
        self.ground_refusal = ""
        # The ground's wall clock minus this one, None while it is not known.
        self.ground_clock_offset_s: float | None = None
        # The text of the newest world file that the ground sent.
        self.world: bytes | None = None
        # Whose statuses could not be read when `peers` was asked last.
        self.not_understood: tuple[str, ...] = ()
        self.malformed = 0

    def put_ground(self, data: bytes, now_s: float, unix_now_s: float) -> None:
        """A ground's state arrived."""
        self._grounds.append(_Arrived(data, now_s, unix_now_s))

    def put_world(self, data: bytes) -> None:
        """A world file arrived."""
        self.world = data

    def put_order(self, data: bytes) -> None:
        """An order arrived."""
        self._orders.append(data)

    def put_status(self, key: str, data: bytes, now_s: float, unix_now_s: float) -> None:
        """Another robot's status arrived, with `key`."""
        with self._lock:
            self._statuses[key] = _Arrived(data, now_s, unix_now_s)

    def ground(self, now_s: float) -> tuple[GroundState | None, float]:
        """The ground's newest state and its age, s (infinite if none came). Control thread."""
        while self._grounds:
            arrived = self._grounds.popleft()
            try:
                state = decode(GroundState, arrived.data)
            except MessageError as error:
                self.malformed += 1
                self.ground_refusal = str(error)
                self._take_safety_form(arrived)
                continue
            if self._counts(state, arrived.at_s):
                self._ground, self._ground_at_s = state, arrived.at_s
                self._safety_form, self.ground_refusal = "none", ""
                if state.unix_time_s is not None:
                    self.ground_clock_offset_s = state.unix_time_s - arrived.unix_s
        return self._ground, now_s - self._ground_at_s

    def safety_form(self, now_s: float) -> SafetyAction:
        """What a ground asks whose states are not understood: hold, land, or none. Control thread.

        The last state that was understood stays, and its age grows.
        """
        fresh = now_s - self._safety_form_at_s <= self._ground_timeout_s
        return self._safety_form if fresh else "none"

    def _take_safety_form(self, arrived: _Arrived) -> None:
        try:
            form = decode(SafetyForm, arrived.data)
        except MessageError:
            return
        if not self._counts(form, arrived.at_s):
            return
        asked = form.robot_safety_actions.get(str(self._robot_id), form.safety_action)
        known: dict[str, SafetyAction] = {"hold": "hold", "land": "land"}
        self._safety_form = known.get(asked, "none")
        self._safety_form_at_s = arrived.at_s

    def _counts(self, state: GroundState | SafetyForm, at_s: float) -> bool:
        newest = self._ground
        if newest is None or at_s - self._ground_at_s > self._ground_timeout_s:
            return True
        return (state.sequence, state.operator) >= (newest.sequence, newest.operator)

    def ground_age_s(self, now_s: float) -> float:
        """The age of the ground's newest state, s; infinite if none came. From any thread."""
        return now_s - self._ground_at_s

    def order(self) -> Order | None:
        """The next order for this robot, if one has come. Control thread."""
        while self._orders:
            order = self._order(self._orders.popleft())
            if order and order.robot_id == self._robot_id:
                return order
        return None

    def _order(self, data: bytes) -> Order | None:
        """An order; of one that is not understood, the form to kill that every version obeys."""
        try:
            return decode(Order, data)
        except MessageError:
            self.malformed += 1
        try:
            form = decode(KillForm, data)
        except MessageError:
            return None
        return Order(
            form.order_id, form.robot_id, form.boot_nonce, form.kind,
            form.expires_at_uptime_s, form.operator,
        )  # fmt: skip

    def peers(self, now_s: float) -> tuple[HeardStatus, ...]:
        """The fresh statuses of the other robots. Preflight's thread."""
        with self._lock:
            self._statuses = {
                key: arrived
                for key, arrived in sorted(self._statuses.items())
                if now_s - arrived.at_s <= _STATUS_LIFETIME_S
            }
            arrivals = dict(self._statuses)
        decoded = {key: self._status(a.data) for key, a in arrivals.items()}
        self.not_understood = tuple(
            f"robot {key.split('/')[1]}" for key, status in decoded.items() if status is None
        )
        return tuple(
            HeardStatus(status, arrivals[key].at_s, arrivals[key].unix_s)
            for key, status in decoded.items()
            if status is not None
        )

    def _status(self, data: bytes) -> RobotStatus | None:
        try:
            return decode(RobotStatus, data)
        except MessageError:
            self.malformed += 1
            return None
