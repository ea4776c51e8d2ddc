"""Replay window of one sender on one key: accepts only numbers newer than the last.

A number is the start of the sender's program and a sequence that grows within that start. A start
is a wall clock's ms, or one more than the last start where that clock is behind.
"""

from collections import deque
from typing import NamedTuple

_MOST_ENDED = 8


class MessageNumber(NamedTuple):
    """Number of a message: of two from one sender, the greater is newer."""

    start: int
    sequence: int


NO_NUMBER = MessageNumber(-1, -1)


class ReplayWindow:
    """The newest number of a sender; one thread at a time.

    A start ahead of the clock counts as the time of its first message, so that a thief of the key
    cannot outnumber the program's next start. Once another start has followed, a start is refused
    for good.
    """

    def __init__(self) -> None:
        self.number = NO_NUMBER
        self._since_s = 0.0
        self._ended: deque[int] = deque(maxlen=_MOST_ENDED)

    def is_replay(self, number: MessageNumber, now_s: float, unix_s: float | None) -> bool:
        """Whether `number` is a replay, or a newer message arrived before it.

        `now_s` is a monotonic clock's time, `unix_s` the wall clock's, None if not known.
        """
        newest = self.number
        if number.start == newest.start:
            return number <= newest
        if number.start in self._ended:
            return True
        if number.start > newest.start:
            return False
        if unix_s is None:
            return True
        received_ms = 1e3 * (unix_s - (now_s - self._since_s))
        return not received_ms <= number.start

    def accept(self, number: MessageNumber, now_s: float) -> None:
        """Set the newest number, of an authenticated message."""
        if number.start != self.number.start:
            if self.number is not NO_NUMBER:
                self._ended.append(self.number.start)
            self._since_s = now_s
        self.number = number
