"""A return of several robots: they land from the lowest to the highest."""

from collections.abc import Iterable
from typing import NamedTuple

from edge.messages.mission import (
    GroundState,
    SafetyAction,
    is_over_landing_point,
    waiting_to_land,
)
from lpac.ground.station.heard import HeardRobots

# Robots of a station that has just started are known when it has listened for so long.
_GATHER_S = 3.0


class WayHome(NamedTuple):
    """Parts of a state: the robots' own safety actions, and those that wait for their turn."""

    robot_safety_actions: dict[str, SafetyAction]
    waiting: tuple[int, ...]


class Homecoming:
    """Remembers which robots have come over their landing points."""

    def __init__(self, robots: HeardRobots) -> None:
        self._robots = robots
        self._arrived: set[int] = set()

    def forget(self, robots: Iterable[int]) -> None:
        """Something else is asked of these."""
        self._arrived.difference_update(robots)

    def go_on(self, state: GroundState) -> WayHome | None:
        """Keep robots over their landing points waiting while somebody lower still flies home.

        None without a return.
        """
        asked_home = {r for r in self._robots.names if state.safety_action_for(r) == "return"}
        returning = asked_home.union(state.waiting)
        if not returning:
            return None
        statuses = {r: s for r, s in self._robots.statuses().items() if r in returning}
        self._arrived |= {r for r, status in statuses.items() if is_over_landing_point(status)}
        waiting = waiting_to_land(statuses, self._arrived)
        # A robot that is not heard, or may have one below that was not heard yet, waits on.
        gathers = self._robots.age_s < _GATHER_S
        waiting |= {r for r in state.waiting if gathers or r not in statuses}
        asked: dict[str, SafetyAction] = {
            r: c for r, c in state.robot_safety_actions.items() if int(r) not in returning
        }
        for robot in sorted(returning):
            if robot in waiting:
                asked[str(robot)] = "hold"
            elif state.safety_action != "return":
                asked[str(robot)] = "return"
        return WayHome(asked, tuple(sorted(waiting)))
