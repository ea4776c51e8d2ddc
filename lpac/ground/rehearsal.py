"""Rehearsal: guidance for a person who carries a robot over the field before it flies there."""

import math
from typing import NamedTuple

from edge.core.fence import Fence
from edge.messages.mission import RobotStatus
from lpac.ground.rendering import nose_rad
from lpac.ground.site import turn_deg

_ARROWS = "↑↗→↘↓↙←↖"
_SECTORS = (
    "ahead", "ahead-right", "right", "behind-right", "behind", "behind-left", "left", "ahead-left",
)  # fmt: skip
# Slower than this nothing is commanded.
_STILL_M_S = 0.05


class Commanded(NamedTuple):
    """Command of the policy: `arrow` in the mission frame, y up; `words` from the nose."""

    speed_m_s: float
    arrow: str
    words: str


def commanded(velocity_m_s: tuple[float, float], nose_deg: float | None) -> Commanded:
    """Of a velocity (2,) in the mission frame, and the nose's angle, clockwise from the y axis.

    "0.8 m/s, ahead-left 35 deg" is 35 degrees to the left of the nose.
    """
    x_m_s, y_m_s = velocity_m_s
    speed_m_s = math.hypot(x_m_s, y_m_s)
    if not speed_m_s >= _STILL_M_S:
        return Commanded(speed_m_s, "·", "still")
    course_deg = math.degrees(math.atan2(x_m_s, y_m_s))
    words = f"{speed_m_s:.1f} m/s"
    if nose_deg is not None:
        turn = turn_deg(nose_deg, course_deg)
        sector = _SECTORS[_eighth(turn)]
        words += f", {sector} {abs(turn):.0f} deg"
        if sector in ("ahead", "behind"):
            words += " left" if turn < 0.0 else " right"
    return Commanded(speed_m_s, _ARROWS[_eighth(course_deg)], words)


class Carried(NamedTuple):
    """A robot that is carried, in the mission frame; None is not known.

    `nose_deg` is clockwise from the y axis. `fence_m` is how far it is inside the fence's line.
    """

    position_m: tuple[float, float] | None
    nose_deg: float | None
    fence_m: float | None
    commanded: Commanded | None


def carried(status: RobotStatus, configured: Fence) -> Carried:
    """Read a robot's status for the person who carries it."""
    position_m = None if status.position_m is None else status.position_m[:2]
    nose = nose_rad(status)
    nose_deg = None if nose is None else turn_deg(0.0, math.degrees(nose)) % 360.0
    fence = status.fence or configured
    velocity = status.policy_velocity_m_s
    return Carried(
        position_m,
        nose_deg,
        None if position_m is None else fence.distance_m(*position_m),
        None if velocity is None else commanded((velocity[0], velocity[1]), nose_deg),
    )


def _eighth(angle_deg: float) -> int:
    """Index of the nearest of eight directions, clockwise."""
    return round(angle_deg / 45.0) % 8
