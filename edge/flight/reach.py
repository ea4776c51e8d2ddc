"""Limits that no ground can widen: how far and how high a robot may be sent at most."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from edge.core.fence import Fence
from edge.core.schema import Bounded, Positive
from edge.messages.codes import CheckCode, FailedCheck


@dataclass(frozen=True, slots=True)
class Reach(Bounded):
    """The outermost fence: around where the robot stands when it is armed, and above it, m.

    The mission origin and every corner of the fence lie within `distance_m` of there, the fence's
    ceiling within `ceiling_m`. Raises ValueError if one is not finite or not above 0.
    """

    distance_m: Positive = 200.0
    ceiling_m: Positive = 120.0

    def origin_beyond(self, place_m: Sequence[float] | None) -> FailedCheck | None:
        """Describe the fault of a mission origin for a robot at this place (x, y) of it.

        Nothing, as far as is known, if the place is not.
        """
        if place_m is None:
            return None
        return self._beyond(
            CheckCode.ORIGIN_OUT_OF_REACH, "mission origin is", math.hypot(*place_m[:2])
        )

    def fence_beyond(self, fence: Fence, place_m: Sequence[float] | None) -> FailedCheck | None:
        """The same of a fence."""
        if place_m is None:
            return None
        farthest_m = max(math.dist(corner, place_m[:2]) for corner in fence.vertices_m)
        return self._beyond(CheckCode.FENCE_OUT_OF_REACH, "fence reaches to", farthest_m)

    def _beyond(self, code: CheckCode, what: str, away_m: float) -> FailedCheck | None:
        # NaN is a place that is not known, which preflight refuses by itself.
        if not away_m > self.distance_m:
            return None
        text = (
            f"{what} {away_m:.0f} m from this robot, must be within its reach of "
            f"{self.distance_m:g} m: carry it nearer, set another one, or raise distance_m of "
            "[reach] in its robot.toml"
        )
        return FailedCheck(code, text)
