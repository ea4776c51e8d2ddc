"""The fleet's time: the ground's clock as estimated by each robot.

No wall clock is used. The ground's states echo the time at which the robot sent the last message
that the ground received. The time since then is a round trip, plus the time that the ground held
the message. The ground's clock is thus known to half a round trip, whatever the delays.
"""

import math

from msgspec import Struct

# Drift of both clocks' crystals, s per s.
_DRIFT = 1e-4
# Resolution of echoed times.
_ROUNDED_S = 1e-3
# Grounds whose clocks are kept: a fleet changes its ground within about a second.
_MOST_GROUNDS = 4


class FleetTime(Struct, frozen=True):
    """An instant by the clock of the ground `base`, within `uncertainty_s` of `time_s`."""

    base: int
    time_s: float
    uncertainty_s: float


class Age(Struct, frozen=True):
    """Bounds of an age, s."""

    least_s: float
    most_s: float


class _Known(Struct, frozen=True):
    """A ground's clock minus the robot's, measured at `at_s` of the robot's clock."""

    offset_s: float
    uncertainty_s: float
    at_s: float

    def uncertainty_at(self, now_s: float) -> float:
        return self.uncertainty_s + _DRIFT * abs(now_s - self.at_s)


class FleetClock:
    """Grounds' clocks relative to one robot's monotonic clock, whose time is `now_s`.

    One thread calls `update`; the other methods are thread-safe.
    """

    def __init__(self) -> None:
        # Replaced as a whole; the newest ground is the last entry.
        self._known: dict[int, _Known] = {}

    def update(
        self, base: int, time_s: float, *, echoed_at_s: float, held_s: float, now_s: float
    ) -> None:
        """Update from a state that the ground `base` sent at `time_s` of its clock.

        The ground had received this robot's message, sent at `echoed_at_s`, `held_s` earlier.
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
        """`now_s` by the newest ground's clock; None if no ground has answered yet."""
        known = self._known
        if not known:
            return None
        base = next(reversed(known))
        newest = known[base]
        return FleetTime(base, now_s + newest.offset_s, newest.uncertainty_at(now_s))

    def age_s(self, instant: FleetTime, now_s: float) -> Age | None:
        """Age of an instant; None if its ground's clock is unknown."""
        known = self._known.get(instant.base)
        if known is None:
            return None
        elapsed_s = now_s + known.offset_s - instant.time_s
        error_s = known.uncertainty_at(now_s) + instant.uncertainty_s
        return Age(max(elapsed_s - error_s, 0.0), max(elapsed_s + error_s, 0.0))
