"""Robots that fly in real time in this process, for tests of the ground's processes."""

import math
import time
from collections.abc import Callable
from pathlib import Path

from edge.messages.codec import decode, encode
from edge.messages.mission import RobotStatus
from edge.messages.topics import STATUS, Topic
from lpac.sim.fleet.layout import ORIGIN
from lpac.sim.fleet.live import LiveFleet
from lpac.sim.fleet.robots import OpenLink, SimulatedRobot
from lpac.sim.radio import Subscriptions
from lpac.sim.scenario import Scenario
from tests.conftest import SHIPPED
from tests.flown import PRECISE, QUICK, FlownRobot

__all__ = ["ORIGIN", "FlownFleet", "until"]

# Of thirty robots, for one computer that does other things besides.
SPARING = {
    "rates": {"perception_hz": 1.0, "policy_hz": 1.0, "control_hz": 5.0},
    "policy": {"max_input_age_s": 3.0, "max_message_age_s": 2.5},
}


class FlownFleet(LiveFleet):
    """N robots with slots, and spares; a context.

    They stand along the lower edge of the field, 4 m from each other, and then in further rows,
    with their noses along the y axis; nearer, those that take off at once would wait for each
    other. `says[i]` changes what others hear of robot i.
    """

    def __init__(self, folder: Path, n: int, *, spares: int = 0, name: str = "") -> None:
        self.says: dict[int, Callable[[RobotStatus], RobotStatus]] = {}
        pads_m = tuple((2.0 + 4.0 * (i % 8), 2.0 + 4.0 * (i // 8)) for i in range(n + spares))
        scenario = Scenario(
            robots=n + spares, seed=3, errors=False, budget=PRECISE, starts_m=pads_m
        )
        super().__init__(
            scenario, folder, SHIPPED,
            name=name, spares=spares,
            settings=SPARING if n > 10 else None, vehicle_step_s=0.05 if n > 10 else 0.02,
        )  # fmt: skip
        for each in self.vehicles:
            each.vehicle.parameters |= QUICK
            each.vehicle.heading_rad = math.radians(ORIGIN.heading_deg)
        self.flown = [FlownRobot(robot) for robot in self.robots]

    def _open_link(self, robot: SimulatedRobot, subscriptions: Subscriptions) -> OpenLink:
        link = super()._open_link(robot, subscriptions)
        return _ChangedLink(link, robot.config.robot_id, self.says)


class _ChangedLink:
    """A link on which others hear what a test wants."""

    def __init__(
        self,
        link: OpenLink,
        robot_id: int,
        says: dict[int, Callable[[RobotStatus], RobotStatus]],
    ) -> None:
        self._link = link
        self._robot_id = robot_id
        self._says = says
        self.is_claimed = link.is_claimed
        self.peers = link.peers
        self.refused = link.refused
        self.sends_again = link.sends_again
        self.close = link.close

    def publish(self, topic: Topic, data: bytes) -> None:
        change = self._says.get(self._robot_id)
        if topic is STATUS and change is not None:
            data = encode(change(decode(RobotStatus, data)))
        self._link.publish(topic, data)


def until(condition: Callable[[], object], patience_s: float = 60.0) -> None:
    """Wait for what robots do."""
    deadline_s = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.02)
