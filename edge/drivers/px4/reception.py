"""Filter and counters of a vehicle's MAVLink frames: duplicates, late, lost. No socket, no clock.

A router, or a second path, may bring frames twice, late or out of order: one that was taken before,
or is older than the newest, is not taken. MAVLink numbers the frames of a link by one byte, so what
is lost on the way can be counted; a router may merge several links of one vehicle into one path,
each with its own numbers. That byte comes round within seconds: where it alone does not tell what
is late, the vehicle's own time does, of those messages that have it.
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
# A greater gap is another stream, or a link that was silent.
_MOST_LOST = 64
_REMEMBERED_S = 3.0
# A vehicle that is silent so long may have been switched on anew, or be another one.
_SILENT_S = 1.0
# Frames of a path that is so late are not taken, even those that have no time.
_LATE_S = 0.2
# By so much the time of one vehicle does not go back.
_BACK_S = 0.03
# Shares and alarms are those of so many whole seconds, and of so many frames.
_LOSS_S, _OTHERS_S, _LEAST_FRAMES = 10, 5, 100
_LEAST_TWICE, _LEAST_OTHERS, _OTHERS_SHARE = 20, 3, 0.25


_Sort = Literal["next", "again", "late", "other"]


class Frame(Struct, frozen=True):
    """One frame: `path` is what it came by, `number` MAVLink's sequence, `content` all of it.

    `vehicle_s` is the vehicle's time when it was sent; None where the message has none.
    """

    path: Hashable
    number: int
    content: Hashable
    message_id: int
    vehicle_s: float | None = None


class _Newest(Struct, frozen=True):
    """Newest frame of a message: the vehicle's time, when it came, and by which path."""

    vehicle_s: float
    at_s: float
    path: Hashable


class _Stream:
    """The numbers of one MAVLink sequence; `is_late` by the vehicle's time of its newest."""

    def __init__(self, number: int) -> None:
        self.newest = number
        # What the first frame overtook is not a stream of its own.
        self.missing = {(number - n) % _NUMBERS for n in range(1, _MOST_OVERTAKEN + 1)}
        self.is_late = False
        self.heard_at_s = -math.inf


class _Taken(Struct, frozen=True):
    """A frame that was taken: when, by which path, and of which stream."""

    at_s: float
    path: Hashable
    stream: _Stream | None


class _Path:
    """The streams of one path, and the vehicle's time of the newest of each message."""

    def __init__(self) -> None:
        self.streams: list[_Stream] = []
        self.newest_s: dict[int, float] = {}
        # The greatest of them.
        self.latest_s = -math.inf
        self.heard_at_s = -math.inf

    def nearest(self, number: int, now_s: float) -> _Stream | None:
        """Return the stream that has the fewest numbers left before this one."""
        oldest_s = now_s - (_REMEMBERED_S if now_s - self.heard_at_s <= _SILENT_S else 0.0)
        streams = self.streams
        # Mostly there is this one alone.
        if len(streams) == 1 and streams[0].heard_at_s >= oldest_s:
            return streams[0]
        self.streams = [s for s in streams if s.heard_at_s >= oldest_s]
        return min(self.streams, key=lambda s: (number - s.newest - 1) % _NUMBERS, default=None)

    def begin_stream(self, number: int) -> _Stream:
        """Add a stream, in place of the one silent longest if there are too many."""
        if len(self.streams) == _MOST_STREAMS:
            self.streams.remove(min(self.streams, key=lambda s: s.heard_at_s))
        self.streams.append(_Stream(number))
        return self.streams[-1]


class _Second:
    """Frame counts of one second."""

    __slots__ = ("again", "lost", "others", "second", "taken", "timed")

    def __init__(self, second: int) -> None:
        self.second = second
        self.taken = self.timed = self.lost = self.again = self.others = 0


class VehicleFrames:
    """The frames of one vehicle, over whatever paths they come.

    `path` is the one to answer by: of the frames that are taken, most come by it.
    """

    def __init__(self) -> None:
        self.path: Hashable = None
        self._path_at_s = -math.inf
        self._paths: dict[Hashable, _Path] = {}
        # Of each message that has the vehicle's time.
        self._newest: dict[int, _Newest] = {}
        self._latest_s = -math.inf
        # Of each content that was taken in the last seconds, or a little longer ago.
        self._taken: dict[Hashable, _Taken] = {}
        self._seconds: deque[_Second] = deque(maxlen=_LOSS_S + 1)
        # When a frame was last found to be lost, and last came again.
        self._lost_at_s = self._again_at_s = -math.inf

    def take(self, frame: Frame, now_s: float) -> bool:
        """Whether it is to be taken: it is neither old nor was taken before."""
        newest = None if frame.vehicle_s is None else self._newest.get(frame.message_id)
        if newest is not None and self._began_anew(frame, newest, now_s):
            self._newest.clear()
            self._latest_s = -math.inf
            self._paths.clear()
            newest = None
        if len(self._paths) > _MOST_PATHS:
            self._forget_paths(now_s)
        path = self._paths.get(frame.path)
        if path is None:
            path = self._paths[frame.path] = _Path()
        sort, stream = self._sort(frame, path, now_s)
        path.heard_at_s = now_s
        second = self._this(now_s)
        if sort == "again":
            second.again += 1
            self._again_at_s = now_s
        if frame.vehicle_s is None:
            is_old = self._is_late(path) or (stream is not None and stream.is_late)
        else:
            # By how much the vehicle's time goes back with this frame.
            back_s = 0.0 if newest is None else newest.vehicle_s - frame.vehicle_s
            is_old = back_s > 0.0
            same_time = newest is not None and back_s == 0.0 and newest.path != frame.path
            # One vehicle would not say it so, if it does not say it again.
            if (back_s > _BACK_S or same_time) and sort in ("next", "other"):
                second.others += 1
        if is_old or sort != "next":
            return False
        second.taken += 1
        self._taken[frame.content] = _Taken(now_s, frame.path, stream)
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
        """The share of the frames that were lost in the last ten seconds, in steps of 5 %."""
        if now_s - self._lost_at_s > _LOSS_S + 1:
            return 0.0
        seconds = self._within(_LOSS_S, now_s)
        taken, lost = sum([s.taken for s in seconds]), sum([s.lost for s in seconds])
        return round(20.0 * lost / (taken + lost)) / 20.0 if taken + lost >= _LEAST_FRAMES else 0.0

    def arrives_twice(self, now_s: float) -> bool:
        """Whether frames come again that were taken before."""
        if now_s - self._again_at_s > _OTHERS_S + 1:
            return False
        return sum([s.again for s in self._within(_OTHERS_S, now_s)]) >= _LEAST_TWICE

    def has_others(self, now_s: float) -> bool:
        """Whether two vehicles seem to speak with one system id.

        Time goes back again and again then, or things are said of one time by two paths that are
        not the same.
        """
        seconds = self._within(_OTHERS_S, now_s)
        others = sum(s.others for s in seconds)
        least = max(_LEAST_OTHERS, _OTHERS_SHARE * sum(s.timed for s in seconds))
        return others >= least and others > sum(s.again for s in seconds)

    def _taken_lately(self, frame: Frame, now_s: float) -> _Taken | None:
        taken = self._taken.get(frame.content)
        return None if taken is None or now_s - taken.at_s > _REMEMBERED_S else taken

    def _forget_paths(self, now_s: float) -> None:
        """Anybody can make one more."""
        self._paths = {
            key: path for key, path in self._paths.items() if now_s - path.heard_at_s <= _SILENT_S
        }

    def _began_anew(self, frame: Frame, newest: _Newest, now_s: float) -> bool:
        """Whether the vehicle was switched on anew, or another one is there instead."""
        if frame.vehicle_s is None or frame.vehicle_s >= newest.vehicle_s:
            return False
        if self._taken_lately(frame, now_s) is not None:
            return False
        silent_s = now_s - newest.at_s
        # What was sent before the silence is only late.
        may_have_started = silent_s > _SILENT_S and frame.vehicle_s < silent_s + _SILENT_S
        return may_have_started or silent_s > 2.0 * _REMEMBERED_S

    def _is_late(self, path: _Path) -> bool:
        """Whether what comes by this path is older than what came by another."""
        return path.latest_s < self._latest_s - _LATE_S

    def _sort(self, frame: Frame, path: _Path, now_s: float) -> tuple[_Sort, _Stream | None]:
        """Classify a frame against its path's and those that were taken, and find its stream."""
        taken = self._taken_lately(frame, now_s)
        by_other = taken is not None and taken.path != frame.path
        stream = path.nearest(frame.number, now_s)
        ahead = 0 if stream is None else (frame.number - stream.newest) % _NUMBERS
        # Once its numbers have come round, a stream may say the same with the same number.
        came_round = stream is None or (ahead == 1 and taken is not None and taken.stream is stream)
        if taken is not None and not by_other and not came_round:
            return "again", stream
        follows = 0 < ahead <= _MOST_LOST
        was_missing = not follows and any(frame.number in s.missing for s in path.streams)
        comes_next, is_late = not was_missing, False
        if frame.vehicle_s is not None:
            # Time tells more than a number does.
            newest_s = path.newest_s.get(frame.message_id, -math.inf)
            comes_next = frame.vehicle_s >= newest_s
            is_late = frame.vehicle_s < newest_s - _BACK_S
            path.newest_s[frame.message_id] = max(newest_s, frame.vehicle_s)
            path.latest_s = max(path.latest_s, frame.vehicle_s)
            if stream is not None and follows:
                # With no other stream there is nothing newer to take instead.
                stream.is_late = is_late and len(path.streams) > 1
        if not was_missing and not is_late:
            if stream is None or not follows:
                stream, ahead = path.begin_stream(frame.number), 1
            self._count_missing(stream, frame, ahead, now_s)
        if comes_next:
            return "again" if by_other else "next", stream
        if by_other:
            return "again", stream
        return "late" if was_missing else "other", stream

    def _count_missing(self, stream: _Stream, frame: Frame, ahead: int, now_s: float) -> None:
        stream.newest, stream.heard_at_s = frame.number, now_s
        if stream.missing:
            # All that do not seem to follow: what is late begins no stream.
            recent = range(1, _NUMBERS - _MOST_LOST)
            stream.missing = {n for n in stream.missing if (frame.number - n) % _NUMBERS in recent}
        if ahead > 1:
            stream.missing |= {(frame.number - n) % _NUMBERS for n in range(1, ahead)}
            if self.path in (None, frame.path) and not stream.is_late:
                self._this(now_s).lost += ahead - 1
                self._lost_at_s = now_s

    def _this(self, now_s: float) -> _Second:
        second = math.floor(now_s)
        if not self._seconds or self._seconds[-1].second != second:
            self._seconds.append(_Second(second))
            self._taken = {
                content: taken
                for content, taken in self._taken.items()
                if now_s - taken.at_s <= _REMEMBERED_S
            }
        return self._seconds[-1]

    def _within(self, seconds: int, now_s: float) -> list[_Second]:
        oldest = math.floor(now_s) - seconds
        return [each for each in self._seconds if each.second >= oldest]
