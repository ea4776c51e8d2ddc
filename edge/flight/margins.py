"""Margins from errors: between robots, to the ground, inside and around the fence.

Each margin is a sum of errors that a vehicle may have at once, each at its worst and in the worst
direction. So it holds in truth, whatever the estimates are. docs/faults.md shows the sums.
"""

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

from edge.core.schema import Bounded, NonNegative, Positive
from edge.flight.safety import MotionLimits, stopping_m

# A receiver reports a radius that contains its error 68 % of the time. Twice that contains 99 % of
# normal errors.
_REPORT_FACTOR = 2.0
# A receiver without a report counts as one without corrections, whatever is configured.
_UNREPORTED_M = 3.0
_GRAVITY_M_S2 = 9.81
# Time in which all heights drift together by `height_common_m`.
_COMMON_WALK_S = 300.0
# Terminal speed of a small tumbling multicopter. Heavier ones fall faster and drift less.
_TERMINAL_M_S = 10.0
_ROUNDING_M = 1e-6


class Margin(NamedTuple):
    """The least distance, m, and the errors behind it as text."""

    least_m: float
    why: str

    def holds(self, distance_m: float) -> bool:
        """Whether a distance is enough; False for NaN."""
        return distance_m >= self.least_m - _ROUNDING_M

    def or_at_least(self, least_m: float, why: str) -> "Margin":
        """This margin, or a larger requirement."""
        return self if self.least_m >= least_m else Margin(least_m, why)

    def __str__(self) -> str:
        # Rounded up, so that the number is enough.
        return f"must be {math.ceil(100.0 * self.least_m - 1e-6) / 100.0:g} m ({self.why})"


@dataclass(frozen=True, slots=True)
class ErrorBudget(Bounded):
    """Worst errors of one vehicle, m; `[errors]` of robot.toml.

    `gps_m`: horizontal error of its estimate. `wind_m`: displacement by gusts or control,
    `wind_m_s`: speed of the strongest gust, m/s. `height_apart_m`: true difference that arises in a
    flight between equal estimated heights of two vehicles, each above its own pad.
    `height_common_m`: drift of all heights together in five minutes, `takeoffs_height_m`: the same
    from the first takeoff to the last, since each height is 0 at arming. `height_control_m`: error
    of height control. `pads_height_m`: difference of the pads' heights. `drone_m`: size with
    propellers.

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
        """Largest horizontal distance of any part of the vehicle from its commanded place."""
        return self.gps_m + self.wind_m + self.drone_m / 2.0

    def reported_position_m(self, accuracy_m: float | None) -> float:
        """The same with the accuracy reported by its receiver, None if it reports none.

        Only reports worse than `gps_m` count, so a small `gps_m` must be confirmed by a receiver
        with corrections.
        """
        estimate_m = _UNREPORTED_M if accuracy_m is None else _REPORT_FACTOR * accuracy_m
        return self.position_m + max(estimate_m - self.gps_m, 0.0)

    @property
    def takeoffs_window_s(self) -> float:
        """Longest time from the first to the last takeoff of a flight, s; inf without drift."""
        if self.height_common_m == 0.0:
            return math.inf
        return _COMMON_WALK_S * self.takeoffs_height_m / self.height_common_m

    @property
    def slot_spacing(self) -> Margin:
        """Distance between the heights of two robots."""
        estimates_m = self.height_apart_m + self.takeoffs_height_m
        return Margin(
            estimates_m + 2.0 * self.height_control_m + self.pads_height_m + self.drone_m,
            f"heights err by {estimates_m:g} m from each other, control by "
            f"{self.height_control_m:g} m each, pads by {self.pads_height_m:g} m, and a drone has "
            f"{self.drone_m:g} m",
        )

    @property
    def passing_m(self) -> float:
        """Estimated horizontal distance at which two vehicles do not touch in truth.

        Estimates include displacements by wind and control.
        """
        return 2.0 * self.gps_m + self.drone_m

    @property
    def passing_height_m(self) -> float:
        """The same in height, each above its own pad."""
        estimates_m = self.height_apart_m + self.takeoffs_height_m
        return estimates_m + self.pads_height_m + self.drone_m

    @property
    def height_m(self) -> float:
        """Largest error of one vehicle's height above its own pad relative to its command."""
        return self.height_common_m + self.height_apart_m / 2.0 + self.height_control_m

    @property
    def lowest_height(self) -> Margin:
        """Distance of a robot's height from the ground."""
        return Margin(
            self.height_m + self.drone_m / 2.0,
            f"heights err by {self.height_common_m:g} m together and {self.height_apart_m / 2.0:g} "
            f"m each, control by {self.height_control_m:g} m, and half a drone has "
            f"{self.drone_m / 2.0:g} m",
        )

    def fence_buffer(self, limits: MotionLimits, reaction_s: float) -> Margin:
        """Distance between the place where robots stop and the fence's line.

        Commanded speeds allow a stop before the buffer. The rest is the way flown without commands,
        for `reaction_s`, and the wind.
        """
        blind_m = limits.max_speed_m_s * reaction_s
        return Margin(
            blind_m + self.wind_m,
            f"a program that hangs flies on for {reaction_s:g} s at {limits.max_speed_m_s:g} m/s, "
            f"{blind_m:.2g} m, and wind carries it {self.wind_m:g} m",
        )

    def px4_fence(self, limits: MotionLimits) -> Margin:
        """Distance of PX4's own fence from the fence's line, so that it acts only after ours."""
        way_m = stopping_m(limits.max_speed_m_s, limits)
        return Margin(
            way_m + self.wind_m,
            f"it stops from {limits.max_speed_m_s:g} m/s within {way_m:.2g} m, and wind carries it "
            f"{self.wind_m:g} m",
        )

    def free_ground(self, limits: MotionLimits, px4_fence_m: float, ceiling_m: float) -> Margin:
        """Width of the ground around the fence's line that must be free of people, in whole m.

        The vehicle is beyond the line by its position error. It flies to PX4's fence `px4_fence_m`
        further out, needs its way to stop, and loses its motors there, at the ceiling plus its
        height error. It falls against the air's drag, and drifts with the greater of its maximum
        speed and the wind's.
        """
        way_m = stopping_m(limits.max_speed_m_s, limits)
        fall_m = max(limits.max_speed_m_s, self.wind_m_s) * _fall_s(ceiling_m + self.height_m)
        return Margin(
            math.ceil(self.position_m + px4_fence_m + way_m + fall_m),
            f"position {self.position_m:g} m, PX4's fence {px4_fence_m:g} m further out, "
            f"{way_m:.1f} m to stop, {fall_m:.1f} m of drift while it falls from {ceiling_m:g} m",
        )


def _fall_s(height_m: float) -> float:
    """Time of a fall from rest, with drag by the square of the speed."""
    scale_s = _TERMINAL_M_S / _GRAVITY_M_S2
    # arccosh(exp(x)) without overflow.
    x = height_m / (_TERMINAL_M_S * scale_s)
    return scale_s * (x + math.log1p(math.sqrt(-math.expm1(-2.0 * x))))


@functools.lru_cache(maxsize=64)  # used several times in each tick of the control loop
def places_apart(own_m: float, other_m: float) -> Margin:
    """Distance between two pads or landing points, from the position errors of both robots."""
    return Margin(own_m + other_m, f"positions err by {own_m:.3g} m and {other_m:.3g} m")
