"""Replay window of one sender on one key: which of its numbers is news.

A number is the start of the sender's program (ms of a wall clock, or one more than its last start
where that clock is behind) and a sequence that grows within that start.
"""

from collections import deque
from typing import NamedTuple

_MOST_ENDED = 8


class MessageNumber(NamedTuple):
    """Of a sender's two messages the one with the greater number is newer."""

    start: int
    sequence: int


NOTHING = MessageNumber(-1, -1)


class Newest:
    """The newest number of a sender; one thread at a time.

    Nobody can start later than now: a start that lies ahead of the clock counts for the time at
    which it was first heard. So whoever has a stolen key cannot outnumber the next start of the
    program that it was stolen from. A start that another one has followed has ended for good.
    """

    def __init__(self) -> None:
        self.number = NOTHING
        self._since_s = 0.0
        self._ended: deque[int] = deque(maxlen=_MOST_ENDED)

    def is_older(self, number: MessageNumber, now_s: float, unix_s: float | None) -> bool:
        """Whether `number` is a replay, or was overtaken.

        `now_s` is a monotonic clock's, `unix_s` the wall clock's time at that moment, None if it is
        not known.
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
        heard_ms = 1e3 * (unix_s - (now_s - self._since_s))
        return not heard_ms <= number.start

    def hear(self, number: MessageNumber, now_s: float) -> None:
        """The sender said that, and it is the newest from now on."""
        if number.start != self.number.start:
            if self.number is not NOTHING:
                self._ended.append(self.number.start)
            self._since_s = now_s
        self.number = number
