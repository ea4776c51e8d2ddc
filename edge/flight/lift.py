"""Detects a vehicle that does not hold its height, or stands on the ground.

The autopilot reports neither if the motors lift too little: commanded to climb, it pushes against
the ground and reports to be in the air. Height, climb rate and thrust reveal it. No clock is used.
"""

import math
from typing import NamedTuple

from msgspec import Struct
from msgspec.structs import replace

# No control error lasts this long at this distance from its height, where others fly.
OFF_HEIGHT_M, _OFF_S = 1.5, 2.0
# No flying vehicle keeps its height this long with a thrust this far from the hover thrust.
_STANDS_S = 2.0
_STILL_M_S = 0.3
_FALLS_SHARE, _CLIMBS_SHARE, _FULL_THRUST = 0.5, 1.2, 0.95
# The hover thrust is learned near the robot's height.
_AT_HEIGHT_M, _LEARNED_WITHIN_S = 0.5, 10.0
# After a longer pause the motion is unknown.
_LONGEST_TICK_S = 0.5


class Motion(NamedTuple):
    """A vehicle's motion in one tick; heights above the takeoff point; None if unknown.

    `wanted_m` is the commanded height, None while landing; `approach_m_s` the least rate of
    approach to it, 0 if the vehicle may pause. `ground_below_m` is the highest estimate possible on
    the ground.
    """

    height_m: float | None
    climb_m_s: float | None
    wanted_m: float | None
    approach_m_s: float
    thrust: float | None
    in_air: bool | None
    ground_below_m: float


class Lift(Struct, frozen=True):
    """State kept from tick to tick.

    `slack_m` is the permitted distance from the height on the way to it. The vehicle has exceeded
    it since `off_since_s`, and behaves like a standing one since `stands_since_s`; None if it does
    not. `hover_thrust` is None before the vehicle was at its height.
    """

    slack_m: float = math.inf
    off_since_s: float | None = None
    stands_since_s: float | None = None
    hover_thrust: float | None = None

    def off_s(self, now_s: float) -> float:
        """Time for which the height has been lost, s; below 0 if it is not."""
        return -math.inf if self.off_since_s is None else now_s - self.off_since_s - _OFF_S

    def stands(self, now_s: float) -> bool:
        """Whether the vehicle stands on the ground, whatever the autopilot reports."""
        since_s = self.stands_since_s
        return since_s is not None and now_s - since_s >= _STANDS_S

    def entered(self, *, steered: bool) -> "Lift":
        """State after a transition; a lost height is forgotten unless the robot still steers."""
        return replace(self, slack_m=math.inf, off_since_s=self.off_since_s if steered else None)


def update(lift: Lift, motion: Motion, now_s: float, dt_s: float) -> Lift:
    """State after a tick, `dt_s` after the last one."""
    dt_s = min(max(dt_s, 0.0), _LONGEST_TICK_S)
    off_m = math.nan
    if motion.height_m is not None and motion.wanted_m is not None:
        off_m = abs(motion.height_m - motion.wanted_m)
    slack_m = lift.slack_m
    if math.isfinite(off_m):
        slack_m = min(max(slack_m - motion.approach_m_s * dt_s, 0.0), off_m)
    off_since_s, is_lost = lift.off_since_s, lift.off_s(now_s) >= 0.0
    if not is_lost:
        off_since_s = _since(off_since_s, off_m > slack_m + OFF_HEIGHT_M, now_s)
    hover_thrust = lift.hover_thrust
    if off_m < _AT_HEIGHT_M and not is_lost and motion.in_air and motion.thrust is not None:
        before = motion.thrust if hover_thrust is None else hover_thrust
        hover_thrust = before + (motion.thrust - before) * dt_s / _LEARNED_WITHIN_S
    seems_to_stand = _seems_to_stand(motion, hover_thrust, is_lost=is_lost)
    stands_since_s = _since(lift.stands_since_s, seems_to_stand, now_s)
    return Lift(slack_m, off_since_s, stands_since_s, hover_thrust)


def _since(before_s: float | None, holds: bool, now_s: float) -> float | None:
    if not holds:
        return None
    return now_s if before_s is None else before_s


def _seems_to_stand(motion: Motion, hover_thrust: float | None, *, is_lost: bool) -> bool:
    height_m, climb_m_s, thrust = motion.height_m, motion.climb_m_s, motion.thrust
    if height_m is None or climb_m_s is None or thrust is None or hover_thrust is None:
        return False
    if abs(climb_m_s) > _STILL_M_S or height_m > motion.ground_below_m:
        return False
    if thrust < _FALLS_SHARE * hover_thrust:
        return True
    if motion.wanted_m is None:
        return False
    # Commanded to climb, or at rest after sinking, it pushes and does not rise.
    climbs = is_lost or height_m < motion.wanted_m - OFF_HEIGHT_M
    return climbs and thrust > min(_CLIMBS_SHARE * hover_thrust, _FULL_THRUST)
