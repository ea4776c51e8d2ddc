"""Margins that follow from errors: how far apart, how high, how far inside, how far around.

Each margin is a sum of errors that a vehicle may have at once, each at its worst and the wrong way
round, so that truth holds whatever the estimates say. docs/safety.md shows the same sums.
"""

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

from edge.core.schema import Bounded, NonNegative, Positive
from edge.flight.safety import MotionLimits, stopping_m

# A receiver reports a radius that holds its error 68 % of the time. If errors are normal, twice
# that holds 99 % of them.
_REPORT_FACTOR = 2.0
# Without a report a receiver counts as one without corrections, whatever is configured.
_UNREPORTED_M = 3.0
_GRAVITY_M_S2 = 9.81
# In which time all heights walk together by `height_common_m`.
_COMMON_WALK_S = 300.0
# Of a small multicopter that tumbles. Heavier ones fall faster, and wind carries them less far.
_TERMINAL_M_S = 10.0
_ROUNDING_M = 1e-6


class Margin(NamedTuple):
    """The least distance, m, and the errors that ask for it, in words."""

    least_m: float
    why: str

    def holds(self, distance_m: float) -> bool:
        """Whether a distance is enough; NaN is not."""
        return distance_m >= self.least_m - _ROUNDING_M

    def or_at_least(self, least_m: float, why: str) -> "Margin":
        """This one, unless something else asks for more."""
        return self if self.least_m >= least_m else Margin(least_m, why)

    def __str__(self) -> str:
        # Never a number that would not do.
        return f"must be {math.ceil(100.0 * self.least_m - 1e-6) / 100.0:g} m ({self.why})"


@dataclass(frozen=True, slots=True)
class ErrorBudget(Bounded):
    """How wrong one vehicle may be at worst, m; `[errors]` of robot.toml.

    `gps_m`: its estimate's horizontal error. `wind_m`: how far a gust, or control, carries it from
    where it wants to be, `wind_m_s` the greatest speed of a gust, m/s. `height_apart_m`: by how
    much two vehicles' estimated heights come to differ in truth in one flight, each above its own
    pad; `height_common_m`: how far all heights walk together in five minutes, `takeoffs_height_m`
    how far they do from the first takeoff to the last, since each is 0 when its robot is armed.
    `height_control_m`: how far from its height it is held. `pads_height_m`: how much higher one pad
    may lie than another. `drone_m`: its size, propellers and all.

    Raises ValueError if one is not finite or below 0 (`drone_m`: not above 0).
    """

    gps_m: NonNegative = _UNREPORTED_M
    wind_m: NonNegative = 0.75
    wind_m_s: NonNegative = 8.0
    height_apart_m: NonNegative = 2.0
    height_common_m: NonNegative = 3.0
    takeoffs_height_m: NonNegative = 0.5
    height_control_m: NonNegative = 0.5
    pads_height_m: NonNegative = 0.5
    drone_m: Positive = 0.5

    @property
    def position_m(self) -> float:
        """How far any part of the vehicle may be from the place that it is told, horizontally."""
        return self.gps_m + self.wind_m + self.drone_m / 2.0

    def reported_position_m(self, accuracy_m: float | None) -> float:
        """The same, with the accuracy that its receiver reports; None if it reports none.

        A report that is worse than `gps_m` counts; a better one never does. So a `gps_m` of a
        receiver with corrections has to be confirmed by the receiver.
        """
        estimate_m = _UNREPORTED_M if accuracy_m is None else _REPORT_FACTOR * accuracy_m
        return self.position_m + max(estimate_m - self.gps_m, 0.0)

    @property
    def takeoffs_window_s(self) -> float:
        """From the first takeoff to the last of those who fly together, s; inf if nothing walks."""
        if self.height_common_m == 0.0:
            return math.inf
        return _COMMON_WALK_S * self.takeoffs_height_m / self.height_common_m

    @property
    def slot_spacing(self) -> Margin:
        """From one robot's height to another's."""
        estimates_m = self.height_apart_m + self.takeoffs_height_m
        return Margin(
            estimates_m + 2.0 * self.height_control_m + self.pads_height_m + self.drone_m,
            f"heights err by {estimates_m:g} m from each other, control by "
            f"{self.height_control_m:g} m each, pads by {self.pads_height_m:g} m, and a drone has "
            f"{self.drone_m:g} m",
        )

    @property
    def passing_m(self) -> float:
        """In the plane between two vehicles as estimated, so that in truth they do not touch.

        Estimates tell where wind and control carry them, but for their own errors.
        """
        return 2.0 * self.gps_m + self.drone_m

    @property
    def passing_height_m(self) -> float:
        """The same in height, each above its own pad."""
        estimates_m = self.height_apart_m + self.takeoffs_height_m
        return estimates_m + self.pads_height_m + self.drone_m

    @property
    def height_m(self) -> float:
        """How far one vehicle's height above its own pad may be from what it is told."""
        return self.height_common_m + self.height_apart_m / 2.0 + self.height_control_m

    @property
    def lowest_height(self) -> Margin:
        """From the ground to a robot's height."""
        return Margin(
            self.height_m + self.drone_m / 2.0,
            f"heights err by {self.height_common_m:g} m together and {self.height_apart_m / 2.0:g} "
            f"m each, control by {self.height_control_m:g} m, and half a drone has "
            f"{self.drone_m / 2.0:g} m",
        )

    def fence_buffer(self, limits: MotionLimits, reaction_s: float) -> Margin:
        """From where robots stop to the fence's line.

        They are told no speed that they could not stop from before the buffer. What remains is what
        they fly on when nobody tells them anything, for `reaction_s`, and the wind.
        """
        blind_m = limits.max_speed_m_s * reaction_s
        return Margin(
            blind_m + self.wind_m,
            f"a program that hangs flies on for {reaction_s:g} s at {limits.max_speed_m_s:g} m/s, "
            f"{blind_m:.2g} m, and wind carries it {self.wind_m:g} m",
        )

    def px4_fence(self, limits: MotionLimits) -> Margin:
        """From the fence's line to PX4's own fence, which must not act while ours still can."""
        way_m = stopping_m(limits.max_speed_m_s, limits)
        return Margin(
            way_m + self.wind_m,
            f"it stops from {limits.max_speed_m_s:g} m/s within {way_m:.2g} m, and wind carries it "
            f"{self.wind_m:g} m",
        )

    def free_ground(self, limits: MotionLimits, px4_fence_m: float, ceiling_m: float) -> Margin:
        """Around the fence's line: where nobody may be, whatever fails, in whole m.

        The vehicle is beyond the line by its position error, runs up to PX4's fence `px4_fence_m`
        further out, needs its way to stop, and loses its motors just there, at the ceiling and its
        height error above it. It falls against the air's drag, and is carried all the time at its
        own greatest speed or the wind's, whichever is greater.
        """
        way_m = stopping_m(limits.max_speed_m_s, limits)
        fall_m = max(limits.max_speed_m_s, self.wind_m_s) * _fall_s(ceiling_m + self.height_m)
        return Margin(
            math.ceil(self.position_m + px4_fence_m + way_m + fall_m),
            f"position {self.position_m:g} m, PX4's fence {px4_fence_m:g} m further out, "
            f"{way_m:.1f} m to stop, {fall_m:.1f} m of drift while it falls from {ceiling_m:g} m",
        )


def _fall_s(height_m: float) -> float:
    """How long a fall from rest takes, with drag by the square of the speed."""
    scale_s = _TERMINAL_M_S / _GRAVITY_M_S2
    # arccosh(exp(x)), which does not overflow.
    x = height_m / (_TERMINAL_M_S * scale_s)
    return scale_s * (x + math.log1p(math.sqrt(-math.expm1(-2.0 * x))))


@functools.lru_cache(maxsize=64)  # asked for several times in each tick of the control loop
def places_apart(own_m: float, other_m: float) -> Margin:
    """From one robot's pad or landing point to another's, by the position errors of both."""
    return Margin(own_m + other_m, f"positions err by {own_m:.3g} m and {other_m:.3g} m")
