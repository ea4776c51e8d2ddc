"""Order of landing in a return: from the lowest robot to the highest."""

import math
from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

from edge.messages.mission import STEERED, GroundState, RobotStatus, SafetyAction
from lpac.ground.station.statuses import RobotStatuses

# A station that has just started knows all robots after this time.
_GATHER_S = 3.0
_OVER_LANDING_POINT_M = 1.5


class QueuedReturn(NamedTuple):
    """Fields of a `GroundState`: safety actions of single robots, and robots that wait."""

    robot_safety_actions: dict[str, SafetyAction]
    waiting: tuple[int, ...]


class ReturnQueue:
    """Landing queue; keeps which robots have arrived over their landing points."""

    def __init__(self, robots: RobotStatuses) -> None:
        self._robots = robots
        self._arrived: set[int] = set()

    def forget(self, robots: Iterable[int]) -> None:
        """Drop robots that got another safety action."""
        self._arrived.difference_update(robots)

    def update(self, state: GroundState) -> QueuedReturn | None:
        """Let robots hold over their landing points until all lower ones have landed.

        Returns None without a return.
        """
        asked = {r for r in self._robots.names if state.safety_action_for(r) == "return"}
        returning = asked.union(state.waiting)
        if not returning:
            return None
        statuses = {r: s for r, s in self._robots.statuses().items() if r in returning}
        self._arrived |= {r for r, status in statuses.items() if is_over_landing_point(status)}
        waiting = _waiting_to_land(statuses, self._arrived)
        # A silent robot stays waiting; so do all while robots below may not be known yet.
        gathers = self._robots.age_s < _GATHER_S
        waiting |= {r for r in state.waiting if gathers or r not in statuses}
        actions: dict[str, SafetyAction] = {
            r: action for r, action in state.robot_safety_actions.items() if int(r) not in returning
        }
        for robot in sorted(returning):
            if robot in waiting:
                actions[str(robot)] = "hold"
            elif state.safety_action != "return":
                actions[str(robot)] = "return"
        return QueuedReturn(actions, tuple(sorted(waiting)))


def is_over_landing_point(status: RobotStatus) -> bool:
    """Whether the robot reports a position over its landing point."""
    if status.position_m is None:
        return False
    return math.dist(status.position_m[:2], status.landing_point_m) < _OVER_LANDING_POINT_M


def _waiting_to_land(statuses: Mapping[int, RobotStatus], arrived: Collection[int]) -> set[int]:
    """Ids of robots in `arrived`, over their landing points, that must not land yet.

    They would descend through the heights of lower robots that still fly home.
    """
    lowest_m = min(
        (s.slot_height_m for r, s in statuses.items() if s.state in STEERED and r not in arrived),
        default=math.inf,
    )
    return {
        robot
        for robot, status in statuses.items()
        if robot in arrived and status.state in STEERED and status.slot_height_m > lowest_m
    }
