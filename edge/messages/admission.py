"""Limits on received messages, applied before anything is decoded.

A robot must fly on whatever anybody sends: however many messages, senders or bytes.
"""

import math

from edge.messages.topics import Topic

# Three topics of each robot, of more robots than a fleet has.
_MOST_KEYS = 1000
_LONGEST_KEY = 40
# A link that recovers delivers at once what was sent during the cut.
_BURST_S = 2.0
_IDLE_AFTER_S = 10.0
_SWEEP_PERIOD_S = 1.0


class _Budget:
    """Messages that a key may still send, as of `at_s`."""

    __slots__ = ("at_s", "left")

    def __init__(self, left: float, at_s: float) -> None:
        self.left, self.at_s = left, at_s


class Admission:
    """Limits each key to its topic's `most_hz`, and the number of keys.

    Active keys keep their place; new ones are admitted once idle ones make room. `refused` counts
    the messages refused. One thread at a time.
    """

    def __init__(self, most_keys: int = _MOST_KEYS) -> None:
        self._most_keys = most_keys
        self._budgets: dict[str, _Budget] = {}
        self._swept_at_s = -math.inf
        self.refused = 0

    def admits(self, topic: Topic, key: str, size: int, now_s: float) -> bool:
        """Whether to decode a message of `size` bytes, received at monotonic time `now_s`.

        `key` names sender and topic, such as robot/3/status.
        """
        fits = len(key) <= _LONGEST_KEY and size <= topic.limit_bytes
        admitted = fits and self._spend(topic, key, now_s)
        if not admitted:
            self.refused += 1
        return admitted

    def _spend(self, topic: Topic, key: str, now_s: float) -> bool:
        most = topic.most_hz * _BURST_S
        budget = self._budgets.get(key)
        if budget is None:
            if len(self._budgets) >= self._most_keys:
                self._drop_idle(now_s)
                if len(self._budgets) >= self._most_keys:
                    return False
            budget = self._budgets[key] = _Budget(most, now_s)
        budget.left = min(most, budget.left + (now_s - budget.at_s) * topic.most_hz)
        budget.at_s = now_s
        if budget.left < 1.0:
            return False
        budget.left -= 1.0
        return True

    def _drop_idle(self, now_s: float) -> None:
        if now_s - self._swept_at_s < _SWEEP_PERIOD_S:
            return
        self._swept_at_s = now_s
        self._budgets = {
            key: budget
            for key, budget in self._budgets.items()
            if now_s - budget.at_s <= _IDLE_AFTER_S
        }
