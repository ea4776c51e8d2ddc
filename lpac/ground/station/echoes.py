"""Echoes of the robots' statuses, by which they find out how long messages travel."""

import math

from edge.messages.mission import Echo
from lpac.ground.station.heard import HeardRobots

# Each status is echoed once or twice, less often in large fleets: clocks need no more.
_ECHOED_S, _MOST_ECHOES = 0.5, 32


class Echoes:
    """Gives each robot its turn."""

    def __init__(self, robots: HeardRobots) -> None:
        self._robots = robots
        self._echoed_at_s: dict[int, float] = {}

    def take(self) -> dict[str, Echo]:
        """Echoes of those that were heard just now; if there are many, of those due longest."""
        lasts = ((robot, self._robots.last(robot)) for robot in self._robots.names)
        fresh = {r: last for r, last in lasts if last is not None and last[1] <= _ECHOED_S}
        turns = sorted(fresh, key=lambda robot: self._echoed_at_s.get(robot, -math.inf))
        echoes = {}
        for robot in turns[:_MOST_ECHOES]:
            status, held_s = fresh[robot]
            self._echoed_at_s[robot] = self._robots.now_s
            echoes[str(robot)] = Echo(
                status.boot_nonce, round(status.uptime_s, 4), round(held_s, 4)
            )
        return echoes
