"""One clock for a fleet: its ground's, as far as each robot knows it.

Nobody's wall clock is asked: a ground echoes to each robot when, by the robot's own clock, the
robot said what was heard of it last. What lies between is a round trip, of which the way here took
some part; so the ground's clock is known to half a round trip, whatever the delays were.
"""

import math
from typing import NamedTuple

# Both clocks' quartzes, s per s.
_DRIFT = 1e-4
# What is echoed is rounded.
_ROUNDED_S = 1e-3
# Robots change from one ground's clock to another's within a second or so.
_MOST_GROUNDS = 4


class FleetTime(NamedTuple):
    """An instant by the clock of the ground `base`: at most `uncertainty_s` from `time_s`."""

    base: int
    time_s: float
    uncertainty_s: float


class Age(NamedTuple):
    """How old something is at least, and at most, s."""

    least_s: float
    most_s: float


class _Known(NamedTuple):
    """The ground's clock minus the own one, as it was at `at_s` of the own one."""

    offset_s: float
    uncertainty_s: float
    at_s: float

    def uncertainty_at(self, now_s: float) -> float:
        return self.uncertainty_s + _DRIFT * abs(now_s - self.at_s)


class FleetClock:
    """The grounds' clocks by one robot's monotonic clock, which `now_s` is throughout.

    One thread calls `hear`, any number the rest.
    """

    def __init__(self) -> None:
        # Replaced whole; the newest ground is the last.
        self._known: dict[int, _Known] = {}

    def hear(
        self, base: int, time_s: float, *, echoed_at_s: float, held_s: float, now_s: float
    ) -> None:
        """A state came that the ground `base` said at `time_s` of its clock.

        `held_s` before that the ground had heard what this robot said at `echoed_at_s`.
        """
        round_trip_s = now_s - echoed_at_s - held_s
        if not (round_trip_s >= -_ROUNDED_S and held_s >= 0.0 and math.isfinite(time_s)):
            return
        half_s = 0.5 * max(round_trip_s, 0.0)
        new = _Known(time_s + half_s - now_s, half_s + _ROUNDED_S, now_s)
        before = self._known.get(base)
        if before is not None and before.uncertainty_at(now_s) < new.uncertainty_s:
            new = before
        others = [(b, known) for b, known in self._known.items() if b != base]
        self._known = dict([*others[1 - _MOST_GROUNDS :], (base, new)])

    def at(self, now_s: float) -> FleetTime | None:
        """That instant by the newest ground's clock; None if no ground has answered yet."""
        known = self._known
        if not known:
            return None
        base = next(reversed(known))
        newest = known[base]
        return FleetTime(base, now_s + newest.offset_s, newest.uncertainty_at(now_s))

    def age_s(self, instant: FleetTime, now_s: float) -> Age | None:
        """How long ago the instant was; None if its ground's clock is not known here."""
        known = self._known.get(instant.base)
        if known is None:
            return None
        elapsed_s = now_s + known.offset_s - instant.time_s
        error_s = known.uncertainty_at(now_s) + instant.uncertainty_s
        return Age(max(elapsed_s - error_s, 0.0), max(elapsed_s + error_s, 0.0))
