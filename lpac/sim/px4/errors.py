"""Errors of a vehicle's sensors and battery, and wind, from its own seed and its fleet's.

All are functions of time, drawn once, without state. A vehicle's estimates are its true state plus
these errors.
"""

import math
from typing import NamedTuple

import numpy as np

from edge.core.vehicle import Vector
from lpac.sim.px4.vector import plus, times

# Range of a receiver's total horizontal error.
LEAST_BIAS_M, GREATEST_BIAS_M = 1.0, 5.0
# Accuracy that it reports, horizontally: it includes noise, but hardly any slow bias.
GPS_ACCURACIES_M, GPS_VERTICAL = (0.8, 1.4), 2.0
SATELLITES = (8, 16)
# Errors of a fix, which the estimator smooths: noise, and now and then multipath.
_FIX_WAVES, _FIX_WAVE_M, _FIX_PERIODS_S = 4, 0.2, (2.0, 60.0)
_ECHOES_M, _ECHO_EVERY_S, _ECHO_FOR_S = (1.0, 3.5), (120.0, 400.0), (3.0, 15.0)
# Drift of the bias: amplitude along it and across it, and periods.
_WALK_M, _WALK_PERIODS_S = 0.4, (200.0, 700.0)

# Error of the estimated horizontal velocity along each axis: 0.25 m/s rms, 0.6 m/s at most. In
# PX4's own simulation that of a real PX4 was 0.03 to 0.46 m/s rms, correlated over some 3 s.
_VELOCITY_WAVES, _VELOCITY_WAVE_M_S, _VELOCITY_PERIODS_S = 3, 0.2, (10.0, 30.0)

# All heights of a fleet drift together, by this much within a quarter of the period.
COMMON_HEIGHT_M, COMMON_HEIGHT_PERIOD_S = 3.0, 1200.0
# Amplitude of each vehicle's barometer and GPS height: the drift since any moment is at most four
# times that, between two vehicles eight times.
OWN_HEIGHT_M, _OWN_HEIGHT_PERIODS_S = 0.25, (150.0, 600.0)

COMPASS_RAD = math.radians(20.0)
_YAW_RESET_SHARE, _YAW_RESETS_S = 0.3, (20.0, 180.0)

# Wind and gusts together.
GREATEST_WIND_M_S = 8.0
_MEAN_WINDS_M_S, _GUST_PERIODS_S = (1.0, 4.0), (20.0, 45.0)

_RESISTANCES_OHM = (0.02, 0.03)
_DRAINS = (1.0, 1.25)
_WEAK_MOTOR_SHARE, _THRUST_LOSSES = 0.15, (0.05, 0.2)
# The remote control's receiver repeatedly loses the signal for a while.
_STALE_EVERY_S, _STALE_FOR_S = (90.0, 240.0), (0.3, 3.0)


def draw_bias_m(share: float, bearing_rad: float) -> tuple[float, float]:
    """North and east of a receiver's error at the start; `share` is uniform in 0 to 1."""
    length_m = LEAST_BIAS_M + (GREATEST_BIAS_M - LEAST_BIAS_M) * share
    return length_m * math.cos(bearing_rad), length_m * math.sin(bearing_rad)


class Wave(NamedTuple):
    """Sine wave, 0 at time 0; `began` is the sine of its phase."""

    amplitude: float
    rate_rad_s: float
    phase_rad: float
    began: float

    def at(self, time_s: float) -> float:
        """Change since time 0."""
        amplitude, rate_rad_s, phase_rad, began = self
        return amplitude * (math.sin(rate_rad_s * time_s + phase_rad) - began)

    def about(self, time_s: float) -> float:
        """Offset from the mean."""
        return self.amplitude * math.sin(self.rate_rad_s * time_s + self.phase_rad)


class Errors:
    """Errors of one vehicle. A fleet's vehicles share `fleet_seed` and `mean_wind_m_s`.

    The mean wind is drawn if it is None. `thrust_loss` is the share of thrust lost by a weak motor,
    0 for most. `drain` is the battery's rate of discharge relative to a new one, `resistance_ohm`
    its internal resistance.
    """

    def __init__(self, seed: int, fleet_seed: int, mean_wind_m_s: float | None = None) -> None:
        own, common = np.random.default_rng([seed, 1]), np.random.default_rng([fleet_seed, 2])
        self._walk = [_draw_wave(own, _WALK_M, _WALK_PERIODS_S) for _ in range(2)]
        self._height = [_draw_wave(own, OWN_HEIGHT_M, _OWN_HEIGHT_PERIODS_S) for _ in range(2)]
        sign = 1.0 if common.uniform() < 0.5 else -1.0
        self._height.append(
            Wave(sign * COMMON_HEIGHT_M, math.tau / COMMON_HEIGHT_PERIOD_S, 0.0, 0.0)
        )

        self._heading_rad = float(own.uniform(-COMPASS_RAD, COMPASS_RAD))
        self._heading_after_rad = self._heading_rad * float(own.uniform(0.0, 0.5))
        resets = own.uniform() < _YAW_RESET_SHARE
        self._yaw_reset_s = float(own.uniform(*_YAW_RESETS_S)) if resets else math.inf

        direction_rad = float(common.uniform(0.0, math.tau))
        self._wind_direction = math.cos(direction_rad), math.sin(direction_rad), 0.0
        drawn_m_s = float(common.uniform(*_MEAN_WINDS_M_S))
        self._mean_wind_m_s = drawn_m_s if mean_wind_m_s is None else mean_wind_m_s
        self._gust_rad_s = math.tau / float(common.uniform(*_GUST_PERIODS_S))

        self.resistance_ohm = float(own.uniform(*_RESISTANCES_OHM))
        self.drain = float(own.uniform(*_DRAINS))
        is_weak = own.uniform() < _WEAK_MOTOR_SHARE
        self.thrust_loss = float(own.uniform(*_THRUST_LOSSES)) if is_weak else 0.0
        self._stale_every_s = float(own.uniform(*_STALE_EVERY_S))
        self._stale_for_s = float(own.uniform(*_STALE_FOR_S))

        self._fix = [
            [_draw_wave(own, _FIX_WAVE_M, _FIX_PERIODS_S) for _ in range(_FIX_WAVES)]
            for _ in range(3)
        ]
        bearing_rad = float(own.uniform(0.0, math.tau))
        self._echo_m = times(
            (math.cos(bearing_rad), math.sin(bearing_rad), 0.0), float(own.uniform(*_ECHOES_M))
        )
        self._echo_every_s = float(own.uniform(*_ECHO_EVERY_S))
        self._echo_for_s = float(own.uniform(*_ECHO_FOR_S))
        self._sky = _draw_wave(own, 1.0, _WALK_PERIODS_S)
        self._velocity = [
            [
                _draw_wave(own, _VELOCITY_WAVE_M_S, _VELOCITY_PERIODS_S)
                for _ in range(_VELOCITY_WAVES)
            ]
            for _ in range(2)
        ]

    def position_m(self, time_s: float, bias_m: Vector) -> Vector:
        """Error of the estimate, north, east, down, for a receiver with this initial bias.

        Without any horizontal bias the receiver does not drift.
        """
        north_m, east_m, down_m = bias_m
        if began_m := math.hypot(north_m, east_m):
            length_m = min(max(began_m + self._walk[0].at(time_s), LEAST_BIAS_M), GREATEST_BIAS_M)
            turn_rad = self._walk[1].at(time_s) / began_m
            factor = length_m / began_m
            cos, sin = factor * math.cos(turn_rad), factor * math.sin(turn_rad)
            north_m, east_m = cos * north_m - sin * east_m, sin * north_m + cos * east_m
        return north_m, east_m, down_m + self.height_m(time_s)

    def fix_m(self, time_s: float) -> Vector:
        """Error of a receiver's fix relative to the estimate, north, east, down.

        It has noise of a few decimetres, and multipath of up to 3.5 m for some seconds.
        """
        noise_m = [_sum_about(waves, time_s) for waves in self._fix]
        since_s = time_s % self._echo_every_s - (self._echo_every_s - self._echo_for_s)
        echo = math.sin(math.pi * since_s / self._echo_for_s) if since_s > 0.0 else 0.0
        return plus(noise_m, times(self._echo_m, echo))

    def velocity_m_s(self, time_s: float) -> Vector:
        """Error of the estimated velocity, north, east, down; 0 down."""
        north, east = self._velocity
        return _sum_about(north, time_s), _sum_about(east, time_s), 0.0

    def gps_accuracy_m(self, time_s: float) -> tuple[float, float]:
        """The receiver's own accuracy of its fix, horizontally and vertically."""
        least_m, greatest_m = GPS_ACCURACIES_M
        accuracy_m = least_m + (greatest_m - least_m) * (1.0 - self._share_of_sky(time_s))
        return accuracy_m, GPS_VERTICAL * accuracy_m

    def satellites(self, time_s: float) -> int:
        """Number of satellites that the receiver sees."""
        least, greatest = SATELLITES
        return least + round((greatest - least) * self._share_of_sky(time_s))

    def _share_of_sky(self, time_s: float) -> float:
        """Quality of the satellites' geometry now, 0 to 1."""
        return 0.5 + 0.5 * self._sky.about(time_s)

    def height_m(self, time_s: float) -> float:
        """Error of the estimated height since the start, positive down."""
        return math.fsum(
            [
                a * (math.sin(rate * time_s + phase) - began)
                for a, rate, phase, began in self._height
            ]
        )

    def heading_rad(self, time_s: float) -> float:
        """Error of the compass; the estimator may correct it once in flight."""
        return self._heading_rad if time_s < self._yaw_reset_s else self._heading_after_rad

    def wind_m_s(self, time_s: float) -> Vector:
        """Wind velocity with gusts, the same for the whole fleet."""
        gust = max(0.0, math.sin(self._gust_rad_s * time_s)) ** 3
        gusts_m_s = max(0.0, GREATEST_WIND_M_S - self._mean_wind_m_s)
        speed_m_s = self._mean_wind_m_s + gusts_m_s * gust
        return times(self._wind_direction, speed_m_s)

    def is_remote_control_stale(self, time_s: float) -> bool:
        """Whether the remote control's receiver has no signal now."""
        return time_s % self._stale_every_s > self._stale_every_s - self._stale_for_s


def _sum_about(waves: list[Wave], time_s: float) -> float:
    """Sum of the waves, as offset from the mean."""
    return math.fsum([a * math.sin(rate * time_s + phase) for a, rate, phase, _ in waves])


def _draw_wave(rng: np.random.Generator, amplitude: float, periods_s: tuple[float, float]) -> Wave:
    rate_rad_s = math.tau / float(rng.uniform(*periods_s))
    phase_rad = float(rng.uniform(0.0, math.tau))
    return Wave(amplitude, rate_rad_s, phase_rad, math.sin(phase_rad))
