"""Rehearsal: guidance for a person who carries a robot over the field before the flight."""

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
# Below this speed the policy commands no motion.
_STILL_M_S = 0.05


class VelocityCommand(NamedTuple):
    """The policy's velocity: `arrow` in the mission frame, y up; `words` relative to the nose."""

    speed_m_s: float
    arrow: str
    words: str


def describe_velocity(velocity_m_s: tuple[float, float], nose_deg: float | None) -> VelocityCommand:
    """Describe a velocity (2,), mission frame, for a nose at an angle clockwise from the y axis.

    "0.8 m/s, ahead-left 35 deg" is 35 degrees to the left of the nose.
    """
    x_m_s, y_m_s = velocity_m_s
    speed_m_s = math.hypot(x_m_s, y_m_s)
    if not speed_m_s >= _STILL_M_S:
        return VelocityCommand(speed_m_s, "·", "still")
    course_deg = math.degrees(math.atan2(x_m_s, y_m_s))
    words = f"{speed_m_s:.1f} m/s"
    if nose_deg is not None:
        turn = turn_deg(nose_deg, course_deg)
        sector = _SECTORS[_eighth(turn)]
        words += f", {sector} {abs(turn):.0f} deg"
        if sector in ("ahead", "behind"):
            words += " left" if turn < 0.0 else " right"
    return VelocityCommand(speed_m_s, _ARROWS[_eighth(course_deg)], words)


class CarriedRobot(NamedTuple):
    """A robot that is carried, mission frame; None if unknown.

    `nose_deg` is clockwise from the y axis, `fence_m` the distance inside the fence's line.
    """

    position_m: tuple[float, float] | None
    nose_deg: float | None
    fence_m: float | None
    commanded: VelocityCommand | None


def carried_robot(status: RobotStatus, configured: Fence) -> CarriedRobot:
    """Guidance from a robot's status; `configured` is the fence of a robot that reports none."""
    position_m = None if status.position_m is None else status.position_m[:2]
    nose = nose_rad(status)
    nose_deg = None if nose is None else turn_deg(0.0, math.degrees(nose)) % 360.0
    fence = status.fence or configured
    velocity = status.policy_velocity_m_s
    return CarriedRobot(
        position_m,
        nose_deg,
        None if position_m is None else fence.distance_m(*position_m),
        None if velocity is None else describe_velocity((velocity[0], velocity[1]), nose_deg),
    )


def _eighth(angle_deg: float) -> int:
    """Nearest of eight directions, clockwise from 0."""
    return round(angle_deg / 45.0) % 8
