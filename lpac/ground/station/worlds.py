"""Worlds of the virtual sensors: the texts that a ground station knows, and which robots have."""

from edge.messages.codes import CheckCode
from edge.messages.mission import ON_GROUND, RobotStatus, world_id
from lpac.analysis.commonest import commonest
from lpac.analysis.snapshot import FleetSetup
from lpac.ground.station.heard import HeardRobots


class Worlds:
    """Texts by their ids, and the fleet's id."""

    def __init__(self, setup: FleetSetup, robots: HeardRobots) -> None:
        self._configured = setup.world_id
        self._texts = {setup.world_id: setup.world}
        # Another station sent it last, and nobody was known to fly over it: a state may follow.
        self._stray = ""
        self._robots = robots
        # By robot id: the world of its newest status.
        self._ids: dict[int, str] = {}

    def hear_status(self, status: RobotStatus) -> None:
        """Note which one a robot has."""
        self._ids[status.robot_id] = status.world_id

    def fleets(self, told: str | None) -> str:
        """The fleet's: what it is told, or else what most robots have."""
        return told or commonest(self._ids.values()) or self._configured

    def remember(self, text: str) -> None:
        """It may be the one that the robots have."""
        self._texts[world_id(text)] = text

    def hear(self, text: str, fleets: str) -> None:
        """Another station sends it to the robots; what nobody flies over is soon forgotten."""
        if world_id(text) in (fleets, *self._ids.values()):
            self.remember(text)
        else:
            self._stray = text

    def text(self, world: str) -> str:
        """The text of a world, "" if it is not known."""
        if self._stray and world_id(self._stray) == world:
            self.remember(self._stray)
        return self._texts.get(world, "")

    def to_publish(self, wanted: str | None) -> str | None:
        """The wanted one's text, while a robot on the ground lacks it, and may have use for it."""
        text = "" if wanted is None else self.text(wanted)
        lacking = any(
            s.world_id != wanted
            and s.state in ON_GROUND
            and all(each.code is not CheckCode.WORLD_UNUSABLE for each in s.not_taken)
            for s in self._robots.statuses().values()
        )
        return text if text and lacking else None
