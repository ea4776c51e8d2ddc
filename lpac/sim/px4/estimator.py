"""Model of PX4's estimator: when it trusts its position, and the errors of its estimate.

Times are those of a real PX4 v1.17, by its own clock.
"""

import math
from collections.abc import Sequence

from edge.core.vehicle import Vector
from lpac.sim.px4.vector import ZERO, level, minus, plus, times, total

NOISE_M = (0.15, 0.15, 0.1)
NOISE_TIME_S = 10.0
# Times after the start at which the origin is set and the attitude aligned; times before the
# position is valid from which on the attitude is trusted, and GPS is used.
ORIGIN_AFTER_S = 0.64
ALIGNED_AFTER_S = 2.0
ATTITUDE_BEFORE_READY_S = 2.0
FUSION_BEFORE_READY_S = 1.05
# How long a position without GPS counts as valid, and how long GPS counts as used. A GPS that comes
# back later is used again after `GPS_REGAIN_S`.
DEAD_RECKONING_S = 5.0
GPS_FUSION_S = 7.0
GPS_REGAIN_S = 1.2
DEAD_RECKONING_DRIFT_M = 0.5  # per square root of a second
# A fix beyond PX4's gates is rejected for this time; any other is followed smoothly. Correction
# gains, as measured with a real PX4 v1.17 and a stuck receiver: of position, velocity and tilt (as
# an acceleration) by the position error, of velocity by the velocity error.
GPS_GATE_M, GPS_GATE_M_S, GPS_REJECTED_S = 5.0, 4.0, 7.0
GPS_BY_PLACE, GPS_VELOCITY_BY_VELOCITY = (0.96, 0.33, 0.12), 0.25


class Estimator:
    """Estimate of a vehicle's position over time."""

    def __init__(self, ready_after_s: float, noise_m: Vector) -> None:
        """`ready_after_s` is when the position becomes valid; `noise_m` is the initial error."""
        self._ready_after_s = ready_after_s
        self._time_s = 0.0
        self._noise_m = noise_m
        self._drift_m = ZERO
        # Noise, drift of dead reckoning, and followed errors of fixes: north, east, down.
        self.error_m = noise_m
        # There was no GPS yet.
        self._gps_lost_since_s = -math.inf
        self._gps_back_at_s = -math.inf
        self._followed_m = self.velocity_error_m_s = self._tilt_error_m_s2 = ZERO
        self._followed_once = False
        self._rejects_since_s = math.inf

    @property
    def has_origin(self) -> bool:
        """Whether the origin is set, by the first GPS fix."""
        return self._time_s >= min(ORIGIN_AFTER_S, self._ready_after_s)

    @property
    def is_aligned(self) -> bool:
        """Whether the attitude is aligned; it is trusted a little later."""
        return self._time_s >= min(ALIGNED_AFTER_S, self._ready_after_s)

    @property
    def has_attitude(self) -> bool:
        """Whether the attitude is trusted."""
        return self._time_s >= self._ready_after_s - ATTITUDE_BEFORE_READY_S

    @property
    def is_ready(self) -> bool:
        """Whether the time after the start suffices for a position."""
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
        """Whether GPS holds the position, or did a moment ago."""
        return self._is_held(DEAD_RECKONING_S)

    @property
    def accuracy_m(self) -> tuple[float, float]:
        """Its estimate of its own accuracy, horizontal and vertical, m."""
        if not self.is_aligned:
            return 14.1, 1.8
        if not self.has_used_gps:
            return 0.02, 0.08
        without_gps_s = max(0.0, self._time_s - self._gps_lost_since_s)
        return 0.29 + 0.06 * without_gps_s**2, 0.04

    @property
    def doubts_gps(self) -> bool:
        """Whether GPS is back but not used yet, or its fixes are rejected."""
        is_new = self._time_s < self._gps_back_at_s
        return self.has_gps and (is_new or self._rejects_since_s < math.inf)

    @property
    def uses_gps(self) -> bool:
        """Whether GPS is used, or waited for."""
        return self.has_used_gps and self._is_held(GPS_FUSION_S)

    @property
    def position_valid(self) -> bool:
        """Whether the estimated position is valid."""
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
        """Advance by one step; the fix has the errors `off_m` and `off_m_s`.

        `draws` (6,) are standard normal.
        """
        self._time_s = time_s
        if has_gps:
            # Skip the costly part until a fix is wrong for the first time.
            self._followed_once = self._followed_once or off_m != ZERO or off_m_s != ZERO
            if self._followed_once:
                self._follow(off_m, off_m_s, dt_s)
            if self._gps_lost_since_s < math.inf:
                if self._gps_lost_since_s > -math.inf and not self.position_valid:
                    self._gps_back_at_s = time_s + GPS_REGAIN_S
                self._gps_lost_since_s = math.inf
            self._drift_m = ZERO
        else:
            # Without GPS, gravity corrects the tilt.
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
        """Follow a wrong fix; reject one beyond the gates for a while, then reset to it."""
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
