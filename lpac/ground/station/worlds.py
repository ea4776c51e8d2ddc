"""World files of the virtual sensors: the texts a ground station knows, and the robots' ids."""

from edge.messages.codes import CheckCode
from edge.messages.mission import ON_GROUND, RobotStatus, world_id
from lpac.analysis.commonest import commonest
from lpac.analysis.snapshot import FleetSetup
from lpac.ground.station.statuses import RobotStatuses


class Worlds:
    """World texts by id, and the id of each robot's world."""

    def __init__(self, setup: FleetSetup, robots: RobotStatuses) -> None:
        self._configured = setup.world_id
        self._texts = {setup.world_id: setup.world}
        # The last text from another station that no robot has yet: a state with its id may follow.
        self._candidate = ""
        self._robots = robots
        # By robot id: the world of its newest status.
        self._ids: dict[int, str] = {}

    def receive_status(self, status: RobotStatus) -> None:
        """Note the robot's world."""
        self._ids[status.robot_id] = status.world_id

    def fleet_id(self, commanded: str | None) -> str:
        """Id of the fleet's world: the commanded one, or else the one that most robots have."""
        return commanded or commonest(self._ids.values()) or self._configured

    def add(self, text: str) -> None:
        """Keep a text, by its id."""
        self._texts[world_id(text)] = text

    def receive(self, text: str, fleet_id: str) -> None:
        """Keep a text from another station; one that nobody uses is replaced by the next."""
        if world_id(text) in (fleet_id, *self._ids.values()):
            self.add(text)
        else:
            self._candidate = text

    def text(self, world: str) -> str:
        """Text of a world, "" if unknown."""
        if self._candidate and world_id(self._candidate) == world:
            self.add(self._candidate)
        return self._texts.get(world, "")

    def to_publish(self, wanted: str | None) -> str | None:
        """Text of the wanted world, while a robot on the ground lacks it and can use it."""
        text = "" if wanted is None else self.text(wanted)
        lacking = any(
            s.world_id != wanted
            and s.state in ON_GROUND
            and all(each.code is not CheckCode.WORLD_UNUSABLE for each in s.not_taken)
            for s in self._robots.statuses().values()
        )
        return text if text and lacking else None
