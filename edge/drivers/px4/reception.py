"""Filter and counters of a vehicle's MAVLink frames: duplicates, late, lost. No socket, no clock.

Routers and second paths deliver frames twice, late or out of order. A frame that was accepted
before, or is older than the newest, is dropped. Lost frames are counted by MAVLink's sequence
number, one byte for each link, which wraps within seconds. A router may merge several links of one
vehicle into one path; each is a stream here. If the sequence number is ambiguous, the vehicle's own
time decides, in those messages that have it.
"""

import math
from collections import deque
from collections.abc import Hashable
from typing import Literal

from msgspec import Struct

_NUMBERS = 256
_MOST_PATHS = 8
_MOST_STREAMS = 4
_MOST_OVERTAKEN = 16
# A larger gap is another stream, or a link that was silent.
_MOST_LOST = 64
_REMEMBERED_S = 3.0
# After this silence the vehicle may have restarted, or be another one.
_SILENT_S = 1.0
# Frames of a path that is this late are dropped, even those without the vehicle's time.
_LATE_S = 0.2
# The time of a single vehicle does not go back by this much.
_BACK_S = 0.03
# Windows of shares and alarms, whole s, and their least numbers of frames.
_LOSS_S, _ALARM_S, _LEAST_FRAMES = 10, 5, 100
_LEAST_DUPLICATES, _LEAST_FOREIGN, _FOREIGN_SHARE = 20, 3, 0.25


# "foreign": its sequence number is new, but its time is old, as from another vehicle.
_Class = Literal["next", "duplicate", "late", "foreign"]


class Frame(Struct, frozen=True):
    """One frame: `path` is how it arrived, `number` its sequence number, `content` all of it.

    `vehicle_s` is the vehicle's time of sending; None if the message has none.
    """

    path: Hashable
    number: int
    content: Hashable
    message_id: int
    vehicle_s: float | None = None


class _Newest(Struct, frozen=True):
    """Newest frame of a message: the vehicle's time, its arrival, and its path."""

    vehicle_s: float
    at_s: float
    path: Hashable


class _Stream:
    """Sequence numbers of one link; `is_late`, by the vehicle's time of its newest frame."""

    def __init__(self, number: int) -> None:
        self.newest = number
        # Frames overtaken by the first one may still arrive, and begin no other stream.
        self.missing = {(number - n) % _NUMBERS for n in range(1, _MOST_OVERTAKEN + 1)}
        self.is_late = False
        self.received_at_s = -math.inf


class _Accepted(Struct, frozen=True):
    """Arrival, path and stream of an accepted frame."""

    at_s: float
    path: Hashable
    stream: _Stream | None


class _Path:
    """Streams of one path, and the vehicle's time of the newest frame of each message."""

    def __init__(self) -> None:
        self.streams: list[_Stream] = []
        self.newest_s: dict[int, float] = {}
        # The greatest of `newest_s`.
        self.latest_s = -math.inf
        self.received_at_s = -math.inf

    def nearest(self, number: int, now_s: float) -> _Stream | None:
        """Return the stream whose newest number is closest below this one; None without any."""
        oldest_s = now_s - (_REMEMBERED_S if now_s - self.received_at_s <= _SILENT_S else 0.0)
        streams = self.streams
        # The usual case.
        if len(streams) == 1 and streams[0].received_at_s >= oldest_s:
            return streams[0]
        self.streams = [s for s in streams if s.received_at_s >= oldest_s]
        return min(self.streams, key=lambda s: (number - s.newest - 1) % _NUMBERS, default=None)

    def begin_stream(self, number: int) -> _Stream:
        """Add a stream, and drop the one silent longest if there are too many."""
        if len(self.streams) == _MOST_STREAMS:
            self.streams.remove(min(self.streams, key=lambda s: s.received_at_s))
        self.streams.append(_Stream(number))
        return self.streams[-1]


class _Second:
    """Frame counts of one second."""

    __slots__ = ("accepted", "duplicates", "foreign", "lost", "second", "timed")

    def __init__(self, second: int) -> None:
        self.second = second
        self.accepted = self.timed = self.lost = self.duplicates = self.foreign = 0


class VehicleFrames:
    """Frames of one vehicle over all paths.

    `path` is the path for answers: most accepted frames arrive by it.
    """

    def __init__(self) -> None:
        self.path: Hashable = None
        self._path_at_s = -math.inf
        self._paths: dict[Hashable, _Path] = {}
        # By id, for messages that have the vehicle's time.
        self._newest: dict[int, _Newest] = {}
        self._latest_s = -math.inf
        # By content, for at least the last `_REMEMBERED_S`.
        self._accepted: dict[Hashable, _Accepted] = {}
        self._seconds: deque[_Second] = deque(maxlen=_LOSS_S + 1)
        self._lost_at_s = self._duplicate_at_s = -math.inf

    def accept(self, frame: Frame, now_s: float) -> bool:
        """Add a frame; returns whether it is new: neither late nor accepted before."""
        newest = None if frame.vehicle_s is None else self._newest.get(frame.message_id)
        if newest is not None and self._restarted(frame, newest, now_s):
            self._newest.clear()
            self._latest_s = -math.inf
            self._paths.clear()
            newest = None
        if len(self._paths) > _MOST_PATHS:
            self._drop_silent_paths(now_s)
        path = self._paths.get(frame.path)
        if path is None:
            path = self._paths[frame.path] = _Path()
        kind, stream = self._classify(frame, path, now_s)
        path.received_at_s = now_s
        second = self._second(now_s)
        if kind == "duplicate":
            second.duplicates += 1
            self._duplicate_at_s = now_s
        if frame.vehicle_s is None:
            is_old = self._is_late(path) or (stream is not None and stream.is_late)
        else:
            back_s = 0.0 if newest is None else newest.vehicle_s - frame.vehicle_s
            is_old = back_s > 0.0
            same_time = newest is not None and back_s == 0.0 and newest.path != frame.path
            # A single vehicle sends such a frame only as a duplicate.
            if (back_s > _BACK_S or same_time) and kind in ("next", "foreign"):
                second.foreign += 1
        if is_old or kind != "next":
            return False
        second.accepted += 1
        self._accepted[frame.content] = _Accepted(now_s, frame.path, stream)
        if frame.vehicle_s is not None:
            second.timed += 1
            self._newest[frame.message_id] = _Newest(frame.vehicle_s, now_s, frame.path)
            self._latest_s = max(self._latest_s, frame.vehicle_s)
        if frame.path != self.path and now_s - self._path_at_s > _SILENT_S:
            self.path = frame.path
        if frame.path == self.path:
            self._path_at_s = now_s
        return True

    def lost(self, now_s: float) -> float:
        """Share of frames lost in the last ten seconds, in steps of 5 %."""
        if now_s - self._lost_at_s > _LOSS_S + 1:
            return 0.0
        seconds = self._last(_LOSS_S, now_s)
        accepted, lost = sum([s.accepted for s in seconds]), sum([s.lost for s in seconds])
        sent = accepted + lost
        return round(20.0 * lost / sent) / 20.0 if sent >= _LEAST_FRAMES else 0.0

    def has_duplicates(self, now_s: float) -> bool:
        """Whether accepted frames arrive again."""
        if now_s - self._duplicate_at_s > _ALARM_S + 1:
            return False
        return sum([s.duplicates for s in self._last(_ALARM_S, now_s)]) >= _LEAST_DUPLICATES

    def has_twin(self, now_s: float) -> bool:
        """Whether two vehicles seem to use one system id.

        Time then goes back again and again, or two paths deliver different frames of the same time.
        """
        seconds = self._last(_ALARM_S, now_s)
        foreign = sum(s.foreign for s in seconds)
        least = max(_LEAST_FOREIGN, _FOREIGN_SHARE * sum(s.timed for s in seconds))
        return foreign >= least and foreign > sum(s.duplicates for s in seconds)

    def _recently_accepted(self, frame: Frame, now_s: float) -> _Accepted | None:
        accepted = self._accepted.get(frame.content)
        return None if accepted is None or now_s - accepted.at_s > _REMEMBERED_S else accepted

    def _drop_silent_paths(self, now_s: float) -> None:
        self._paths = {
            key: path
            for key, path in self._paths.items()
            if now_s - path.received_at_s <= _SILENT_S
        }

    def _restarted(self, frame: Frame, newest: _Newest, now_s: float) -> bool:
        """Whether the vehicle has restarted or been replaced."""
        if frame.vehicle_s is None or frame.vehicle_s >= newest.vehicle_s:
            return False
        if self._recently_accepted(frame, now_s) is not None:
            return False
        silent_s = now_s - newest.at_s
        # A frame from before the silence is only late.
        may_have_started = silent_s > _SILENT_S and frame.vehicle_s < silent_s + _SILENT_S
        return may_have_started or silent_s > 2.0 * _REMEMBERED_S

    def _is_late(self, path: _Path) -> bool:
        """Whether frames of this path are older than those of another."""
        return path.latest_s < self._latest_s - _LATE_S

    def _classify(self, frame: Frame, path: _Path, now_s: float) -> tuple[_Class, _Stream | None]:
        """Class and stream of a frame, by its path's and by the accepted frames."""
        accepted = self._recently_accepted(frame, now_s)
        by_other_path = accepted is not None and accepted.path != frame.path
        stream = path.nearest(frame.number, now_s)
        ahead = 0 if stream is None else (frame.number - stream.newest) % _NUMBERS
        # After a wrap, a stream may send the same content with the same number.
        wrapped = stream is None or (
            ahead == 1 and accepted is not None and accepted.stream is stream
        )
        if accepted is not None and not by_other_path and not wrapped:
            return "duplicate", stream
        follows = 0 < ahead <= _MOST_LOST
        was_missing = not follows and any(frame.number in s.missing for s in path.streams)
        comes_next, is_late = not was_missing, False
        if frame.vehicle_s is not None:
            # The time is more reliable than the number.
            newest_s = path.newest_s.get(frame.message_id, -math.inf)
            comes_next = frame.vehicle_s >= newest_s
            is_late = frame.vehicle_s < newest_s - _BACK_S
            path.newest_s[frame.message_id] = max(newest_s, frame.vehicle_s)
            path.latest_s = max(path.latest_s, frame.vehicle_s)
            if stream is not None and follows:
                # A path's only stream cannot be late: there is nothing newer to accept instead.
                stream.is_late = is_late and len(path.streams) > 1
        if not was_missing and not is_late:
            if stream is None or not follows:
                stream, ahead = path.begin_stream(frame.number), 1
            self._count_missing(stream, frame, ahead, now_s)
        if comes_next:
            return "duplicate" if by_other_path else "next", stream
        if by_other_path:
            return "duplicate", stream
        return "late" if was_missing else "foreign", stream

    def _count_missing(self, stream: _Stream, frame: Frame, ahead: int, now_s: float) -> None:
        stream.newest, stream.received_at_s = frame.number, now_s
        if stream.missing:
            # Keep all numbers that do not seem to follow: a late frame begins no stream.
            recent = range(1, _NUMBERS - _MOST_LOST)
            stream.missing = {n for n in stream.missing if (frame.number - n) % _NUMBERS in recent}
        if ahead > 1:
            stream.missing |= {(frame.number - n) % _NUMBERS for n in range(1, ahead)}
            if self.path in (None, frame.path) and not stream.is_late:
                self._second(now_s).lost += ahead - 1
                self._lost_at_s = now_s

    def _second(self, now_s: float) -> _Second:
        second = math.floor(now_s)
        if not self._seconds or self._seconds[-1].second != second:
            self._seconds.append(_Second(second))
            self._accepted = {
                content: accepted
                for content, accepted in self._accepted.items()
                if now_s - accepted.at_s <= _REMEMBERED_S
            }
        return self._seconds[-1]

    def _last(self, seconds: int, now_s: float) -> list[_Second]:
        oldest = math.floor(now_s) - seconds
        return [each for each in self._seconds if each.second >= oldest]
