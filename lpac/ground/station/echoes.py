"""Echoes of the robots' statuses, from which robots measure the round-trip time."""

import math

from edge.messages.mission import Echo
from lpac.ground.station.statuses import RobotStatuses

# Enough for the robots' clocks; in large fleets robots take turns.
_MAX_AGE_S, _MAX_ECHOES = 0.5, 32


class Echoes:
    """Selects the statuses to echo."""

    def __init__(self, robots: RobotStatuses) -> None:
        self._robots = robots
        self._echoed_at_s: dict[int, float] = {}

    def take(self) -> dict[str, Echo]:
        """Echoes of fresh statuses; if there are too many, of the robots that waited longest."""
        lasts = ((robot, self._robots.last(robot)) for robot in self._robots.names)
        fresh = {r: last for r, last in lasts if last is not None and last[1] <= _MAX_AGE_S}
        turns = sorted(fresh, key=lambda robot: self._echoed_at_s.get(robot, -math.inf))
        echoes = {}
        for robot in turns[:_MAX_ECHOES]:
            status, held_s = fresh[robot]
            self._echoed_at_s[robot] = self._robots.now_s
            echoes[str(robot)] = Echo(
                status.boot_nonce, round(status.uptime_s, 4), round(held_s, 4)
            )
        return echoes
