"""What came by radio, kept for the loops: the ground's state and orders, and others' statuses.

The link's threads only put bytes in; whoever takes something out decodes it.
"""

import math
from collections import deque
from threading import Lock
from typing import NamedTuple, TypeVar

from edge.core.schema import ConfigError
from edge.flight.preflight import HeardStatus
from edge.messages.mission import GroundState, Order, RobotStatus, from_json

T = TypeVar("T")

_MOST_ORDERS = 64
_MOST_STATES = 16
_STATUS_LIFETIME_S = 3.0
# What is longer is not of this fleet, and would hold up the loop that decodes it.
_LONGEST_MESSAGE_BYTES = 65_536
_LONGEST_WORLD_BYTES = 2**20


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
        # The ground's wall clock minus this one, None while it is not known.
        self.ground_clock_offset_s: float | None = None
        # The text of the newest world file that the ground sent.
        self.world: bytes | None = None
        # Whose statuses could not be read when `peers` was asked last.
        self.not_understood: tuple[str, ...] = ()
        self.malformed = 0

    def put_ground(self, data: bytes, now_s: float, unix_now_s: float) -> None:
        """A ground's state arrived."""
        if self._is_short(data):
            self._grounds.append(_Arrived(data, now_s, unix_now_s))

    def put_world(self, data: bytes) -> None:
        """A world file arrived."""
        if self._is_short(data, _LONGEST_WORLD_BYTES):
            self.world = data

    def put_order(self, data: bytes) -> None:
        """An order arrived."""
        if self._is_short(data):
            self._orders.append(data)

    def put_status(self, key: str, data: bytes, now_s: float, unix_now_s: float) -> None:
        """Another robot's status arrived, with `key`."""
        if not self._is_short(data):
            return
        with self._lock:
            self._statuses[key] = _Arrived(data, now_s, unix_now_s)

    def ground(self, now_s: float) -> tuple[GroundState | None, float]:
        """The ground's newest state and its age, s (infinite if none came). Control thread."""
        while self._grounds:
            arrived = self._grounds.popleft()
            state = self._decode(GroundState, arrived.data)
            if state is not None and self._counts(state, arrived.at_s):
                self._ground, self._ground_at_s = state, arrived.at_s
                if state.unix_time_s is not None:
                    self.ground_clock_offset_s = state.unix_time_s - arrived.unix_s
        return self._ground, now_s - self._ground_at_s

    def _counts(self, state: GroundState, at_s: float) -> bool:
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
            order = self._decode(Order, self._orders.popleft())
            if order and order.robot_id == self._robot_id:
                return order
        return None

    def peers(self, now_s: float) -> tuple[HeardStatus, ...]:
        """The fresh statuses of the other robots. Preflight's thread."""
        with self._lock:
            self._statuses = {
                key: arrived
                for key, arrived in sorted(self._statuses.items())
                if now_s - arrived.at_s <= _STATUS_LIFETIME_S
            }
            arrivals = dict(self._statuses)
        decoded = {key: self._decode(RobotStatus, a.data) for key, a in arrivals.items()}
        self.not_understood = tuple(
            f"robot {key.split('/')[1]}" for key, status in decoded.items() if status is None
        )
        return tuple(
            HeardStatus(status, arrivals[key].at_s, arrivals[key].unix_s)
            for key, status in decoded.items()
            if status is not None
        )

    def _is_short(self, data: bytes, limit_bytes: int = _LONGEST_MESSAGE_BYTES) -> bool:
        self.malformed += len(data) > limit_bytes
        return len(data) <= limit_bytes

    def _decode(self, kind: type[T], data: bytes) -> T | None:
        try:
            return from_json(kind, data)
        except ConfigError:
            self.malformed += 1
            return None
