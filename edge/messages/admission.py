"""How much of what comes by radio is looked at, before anything of it is decoded.

A robot must fly on whatever anybody sends: how many messages, of how many senders, how large.
"""

import math

from edge.messages.topics import Topic

# Three topics of each robot, of more robots than a fleet has.
_MOST_KEYS = 1000
_LONGEST_KEY = 40
# A cut link delivers what was said meanwhile at once.
_BURST_S = 2.0
_FORGOTTEN_AFTER_S = 10.0
_SWEPT_EVERY_S = 1.0


class _Heard:
    """Budget of a key: the messages that it may still send, and when that was."""

    __slots__ = ("at_s", "left")

    def __init__(self, left: float, at_s: float) -> None:
        self.left, self.at_s = left, at_s


class Admission:
    """Bounds what comes: each key to its topic's `most_hz`, and the number of keys.

    Whoever speaks keeps its place: new keys come in once there is room. `refused` counts what was
    not looked at. One thread at a time.
    """

    def __init__(self, most_keys: int = _MOST_KEYS) -> None:
        self._most_keys = most_keys
        self._heard: dict[str, _Heard] = {}
        self._swept_at_s = -math.inf
        self.refused = 0

    def admits(self, topic: Topic, key: str, size: int, now_s: float) -> bool:
        """Whether a message of so many bytes, which came now by the monotonic clock, is looked at.

        `key` is the sender's and the topic's, such as robot/3/status.
        """
        fits = len(key) <= _LONGEST_KEY and size <= topic.limit_bytes
        admitted = fits and self._has_left(topic, key, now_s)
        if not admitted:
            self.refused += 1
        return admitted

    def _has_left(self, topic: Topic, key: str, now_s: float) -> bool:
        most = topic.most_hz * _BURST_S
        heard = self._heard.get(key)
        if heard is None:
            if len(self._heard) >= self._most_keys:
                self._forget_the_silent(now_s)
                if len(self._heard) >= self._most_keys:
                    return False
            heard = self._heard[key] = _Heard(most, now_s)
        heard.left = min(most, heard.left + (now_s - heard.at_s) * topic.most_hz)
        heard.at_s = now_s
        if heard.left < 1.0:
            return False
        heard.left -= 1.0
        return True

    def _forget_the_silent(self, now_s: float) -> None:
        if now_s - self._swept_at_s < _SWEPT_EVERY_S:
            return
        self._swept_at_s = now_s
        self._heard = {
            key: heard
            for key, heard in self._heard.items()
            if now_s - heard.at_s <= _FORGOTTEN_AFTER_S
        }
