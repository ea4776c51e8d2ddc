"""Loss, delay and repeats of MAVLink between vehicle and computer."""

import heapq
import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class MavlinkWire:
    """`loss` is the share of lost messages, in either direction; 1 is a cut wire.

    Of the vehicle's messages the share `late` is delayed, and the share `twice` arrives both at
    once and delayed, by a time drawn from `late_s`.
    """

    loss: float = 0.0
    twice: float = 0.0
    late: float = 0.0
    late_s: tuple[float, float] = (0.06, 0.11)


class OnTheWire:
    """Messages in transit. Deterministic for a seed and the messages sent."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._late: list[tuple[float, int, Any]] = []
        self._count = 0

    def is_lost(self, wire: MavlinkWire) -> bool:
        """Draw whether the next message is lost."""
        return wire.loss > 0.0 and self._random.random() < wire.loss

    def pass_on(self, messages: Sequence[Any], wire: MavlinkWire, now_s: float) -> list[Any]:
        """Return the messages that arrive now, late ones included."""
        arrived = []
        for message in messages:
            if self.is_lost(wire):
                continue
            is_late = self._random.random() < wire.late
            if is_late or self._random.random() < wire.twice:
                self._count += 1
                at_s = now_s + self._random.uniform(*wire.late_s)
                heapq.heappush(self._late, (at_s, self._count, message))
            if not is_late:
                arrived.append(message)
        while self._late and self._late[0][0] <= now_s:
            arrived.append(heapq.heappop(self._late)[2])
        return arrived
