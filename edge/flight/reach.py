"""Limits of distance and height that no ground can extend."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from edge.core.fence import Fence
from edge.core.schema import Bounded, Positive
from edge.messages.codes import CheckCode, FailedCheck


@dataclass(frozen=True, slots=True)
class Reach(Bounded):
    """The outermost fence, around and above the place where the robot is armed, m.

    The mission origin and every corner of the fence are within `distance_m` of it, the fence's
    ceiling within `ceiling_m`. Raises ValueError if one is not finite or not above 0.
    """

    distance_m: Positive = 200.0
    ceiling_m: Positive = 120.0

    def origin_beyond(self, place_m: Sequence[float] | None) -> FailedCheck | None:
        """Fault of a mission origin for a robot at (x, y) relative to it.

        None also if the place is unknown.
        """
        if place_m is None:
            return None
        return self._beyond(
            CheckCode.ORIGIN_OUT_OF_REACH, "mission origin is", math.hypot(*place_m[:2])
        )

    def fence_beyond(self, fence: Fence, place_m: Sequence[float] | None) -> FailedCheck | None:
        """Fault of a fence for a robot at this place."""
        if place_m is None:
            return None
        farthest_m = max(math.dist(corner, place_m[:2]) for corner in fence.vertices_m)
        return self._beyond(CheckCode.FENCE_OUT_OF_REACH, "fence reaches to", farthest_m)

    def _beyond(self, code: CheckCode, what: str, away_m: float) -> FailedCheck | None:
        # NaN is an unknown place, which preflight refuses in another check.
        if not away_m > self.distance_m:
            return None
        text = (
            f"{what} {away_m:.0f} m from this robot, must be within its reach of "
            f"{self.distance_m:g} m: carry it nearer, set another one, or raise distance_m of "
            "[reach] in its robot.toml"
        )
        return FailedCheck(code, text)
