"""How well a vehicle knows where it is: when the estimator trusts its position, and how it errs.

Times are those of a real PX4 v1.17, by its own clock.
"""

import math
from collections.abc import Sequence

from edge.core.vehicle import Vector
from lpac.sim.px4.vector import ZERO, level, minus, plus, times, total

NOISE_M = (0.15, 0.15, 0.1)
NOISE_TIME_S = 10.0
# After the start: when the origin is chosen and the attitude found; how long before the position is
# good the attitude is trusted, and GPS is used.
ORIGIN_AFTER_S = 0.64
ALIGNED_AFTER_S = 2.0
ATTITUDE_BEFORE_READY_S = 2.0
FUSION_BEFORE_READY_S = 1.05
# For so long the estimator vouches for a position that no GPS holds, and for so long it goes on
# waiting for the GPS. One that comes back after that is used again `GPS_REGAIN_S` later.
DEAD_RECKONING_S = 5.0
GPS_FUSION_S = 7.0
GPS_REGAIN_S = 1.2
DEAD_RECKONING_DRIFT_M = 0.5  # per square root of a second
# A fix further off than PX4's gates is rejected, for so long; any other is followed smoothly. Rates
# of the correction, as a real PX4 v1.17 was seen to follow a receiver that repeats itself: of the
# position, the velocity and the tilt (as an acceleration) by the place, of the velocity by its own.
GPS_GATE_M, GPS_GATE_M_S, GPS_REJECTED_S = 5.0, 4.0, 7.0
GPS_BY_PLACE, GPS_VELOCITY_BY_VELOCITY = (0.96, 0.33, 0.12), 0.25


class Estimator:
    """A vehicle's knowledge of its position, as time passes."""

    def __init__(self, ready_after_s: float, noise_m: Vector) -> None:
        """The position is good `ready_after_s` after the start; `noise_m` errs first."""
        self._ready_after_s = ready_after_s
        self._time_s = 0.0
        self._noise_m = noise_m
        self._drift_m = ZERO
        # Noise, what dead reckoning has gathered, jumps it believes: north, east, down.
        self.error_m = noise_m
        # It has never been there.
        self._gps_lost_since_s = -math.inf
        self._gps_back_at_s = -math.inf
        self._followed_m = self.velocity_error_m_s = self._tilt_error_m_s2 = ZERO
        self._followed_once = False
        self._rejects_since_s = math.inf

    @property
    def has_origin(self) -> bool:
        """Whether the origin is chosen: by the first GPS fix."""
        return self._time_s >= min(ORIGIN_AFTER_S, self._ready_after_s)

    @property
    def is_aligned(self) -> bool:
        """Whether it has found its attitude; it is trusted a little later."""
        return self._time_s >= min(ALIGNED_AFTER_S, self._ready_after_s)

    @property
    def has_attitude(self) -> bool:
        """Whether the attitude is known."""
        return self._time_s >= self._ready_after_s - ATTITUDE_BEFORE_READY_S

    @property
    def is_ready(self) -> bool:
        """Whether it has ever been long enough for a position."""
        return self._time_s >= self._ready_after_s

    @property
    def has_gps(self) -> bool:
        """Whether the receiver has a fix."""
        return self._gps_lost_since_s == math.inf

    @property
    def has_used_gps(self) -> bool:
        """Whether GPS was ever used."""
        return self._time_s >= self._ready_after_s - FUSION_BEFORE_READY_S

    @property
    def is_held(self) -> bool:
        """Whether GPS holds the position, or did so a moment ago."""
        return self._is_held(DEAD_RECKONING_S)

    @property
    def accuracy_m(self) -> tuple[float, float]:
        """Its own accuracy, as it takes it, horizontally and vertically."""
        if not self.is_aligned:
            return 14.1, 1.8
        if not self.has_used_gps:
            return 0.02, 0.08
        without_gps_s = max(0.0, self._time_s - self._gps_lost_since_s)
        return 0.29 + 0.06 * without_gps_s**2, 0.04

    @property
    def doubts_gps(self) -> bool:
        """Whether GPS is back, but not believed yet; or it jumped."""
        is_new = self._time_s < self._gps_back_at_s
        return self.has_gps and (is_new or self._rejects_since_s < math.inf)

    @property
    def uses_gps(self) -> bool:
        """Whether GPS is used, or waited for."""
        return self.has_used_gps and self._is_held(GPS_FUSION_S)

    @property
    def position_valid(self) -> bool:
        """Whether the estimator vouches for its position."""
        return self._time_s >= self._ready_after_s and self._is_held(DEAD_RECKONING_S)

    def _is_held(self, without_gps_s: float) -> bool:
        is_back = self._time_s >= self._gps_back_at_s
        return is_back and self._time_s - self._gps_lost_since_s < without_gps_s

    def step(
        self,
        time_s: float,
        dt_s: float,
        has_gps: bool,
        off_m: Vector,
        off_m_s: Vector,
        draws: Sequence[float],
    ) -> None:
        """One step of time: the fix's place and velocity err by `off_m` and `off_m_s`.

        `draws` (6,) are normal.
        """
        self._time_s = time_s
        if has_gps:
            # Mostly there is nothing to follow, and never was.
            self._followed_once = self._followed_once or off_m != ZERO or off_m_s != ZERO
            if self._followed_once:
                self._follow(off_m, off_m_s, dt_s)
            if self._gps_lost_since_s < math.inf:
                if self._gps_lost_since_s > -math.inf and not self.position_valid:
                    self._gps_back_at_s = time_s + GPS_REGAIN_S
                self._gps_lost_since_s = math.inf
            self._drift_m = ZERO
        else:
            # Without it, gravity tells the tilt.
            self._tilt_error_m_s2 = ZERO
            self._followed_m = plus(self._followed_m, times(self.velocity_error_m_s, dt_s))
            self._gps_lost_since_s = min(self._gps_lost_since_s, time_s)
            step_m = DEAD_RECKONING_DRIFT_M * math.sqrt(dt_s)
            self._drift_m = plus(self._drift_m, level(times(draws[3:6], step_m)))
        decay = dt_s / NOISE_TIME_S
        kept, grows = 1.0 - decay, math.sqrt(2.0 * decay)
        north_m, east_m, down_m = self._noise_m
        self._noise_m = (
            north_m * kept + NOISE_M[0] * draws[0] * grows,
            east_m * kept + NOISE_M[1] * draws[1] * grows,
            down_m * kept + NOISE_M[2] * draws[2] * grows,
        )
        self.error_m = total(self._noise_m, self._drift_m, self._followed_m)

    def _follow(self, off_m: Vector, off_m_s: Vector, dt_s: float) -> None:
        """Go after a fix that lies; where it is too far off to be true, wait, then start over."""
        place_m = minus(off_m, self._followed_m)
        speed_m_s = minus(off_m_s, self.velocity_error_m_s)
        far = math.hypot(*place_m) > GPS_GATE_M or math.hypot(*speed_m_s) > GPS_GATE_M_S
        self._rejects_since_s = min(self._rejects_since_s, self._time_s) if far else math.inf
        if self._time_s - self._rejects_since_s >= GPS_REJECTED_S:
            self._followed_m, self.velocity_error_m_s = off_m, off_m_s
            return
        rates = self.velocity_error_m_s, self._tilt_error_m_s2, ZERO
        if not far:
            by_position, by_velocity, by_tilt = (times(place_m, gain) for gain in GPS_BY_PLACE)
            by_velocity = plus(by_velocity, times(speed_m_s, GPS_VELOCITY_BY_VELOCITY))
            rates = plus(rates[0], by_position), plus(rates[1], by_velocity), by_tilt
        self._followed_m = plus(self._followed_m, times(rates[0], dt_s))
        self.velocity_error_m_s = plus(self.velocity_error_m_s, times(rates[1], dt_s))
        self._tilt_error_m_s2 = plus(self._tilt_error_m_s2, times(rates[2], dt_s))
