"""Robots that fly in real time in this process, for tests of the ground's processes."""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from edge.messages.codec import decode, encode
from edge.messages.mission import Order, RobotStatus
from edge.messages.topics import ORDER, STATUS, Topic
from lpac.sim.fleet.layout import ORIGIN, FleetScenario
from lpac.sim.fleet.live import LiveFleet
from lpac.sim.fleet.robots import OpenLink, SimulatedRobot
from lpac.sim.px4.direct import DirectVehicle
from lpac.sim.px4.vehicle import Px4Vehicle
from lpac.sim.radio import Subscriptions
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
    other. `says[i]` changes what others hear of robot i, `hears[i]` is asked whether an order
    reaches it.
    """

    def __init__(
        self, folder: Path, n: int, *, spares: int = 0, name: str = "", absent: int = 0
    ) -> None:
        self.says: dict[int, Callable[[RobotStatus], RobotStatus]] = {}
        self.hears: dict[int, Callable[[Order], bool]] = {}
        pads_m = tuple((2.0 + 4.0 * (i % 8), 2.0 + 4.0 * (i // 8)) for i in range(n + spares))
        scenario = FleetScenario(
            robots=n + spares, seed=3, errors=False, budget=PRECISE, pads_m=pads_m
        )
        super().__init__(
            scenario, folder, SHIPPED,
            name=name, absent=absent, spares=spares,
            settings=SPARING if n > 10 else None, vehicle_step_s=0.05 if n > 10 else 0.02,
        )  # fmt: skip
        for each in self.vehicles:
            each.vehicle.parameters |= QUICK
            each.vehicle.heading_rad = math.radians(ORIGIN.heading_deg)
        self.flown = [FlownRobot(robot) for robot in self.robots]

    def stand(self, robot_id: int, place_m: Sequence[float]) -> None:
        """Carry a robot there: (x, y) of the mission frame."""
        with self.paused():
            north_m, east_m = self.layout.to_world_m(np.array(place_m[:2]))
            self.flown[robot_id].vehicle.position_m = np.array([north_m, east_m, 0.0])

    def duplicate(self, robot_id: int) -> None:
        """A second program that says that it is this robot, beside the field."""
        with self.paused():
            place_m = self.layout.to_world_m(np.array([31.0, 31.0]))
            vehicle = Px4Vehicle(seed=99, start_m=place_m)
            second = DirectVehicle(vehicle, robot_id + 1, self.schedule)
            self.second_program(robot_id, second).start()

    def _open_link(self, robot: SimulatedRobot, subscriptions: Subscriptions) -> OpenLink:
        robot_id = robot.config.robot_id
        hear = subscriptions[ORDER]

        def hear_order(key: str, data: bytes) -> None:
            order = decode(Order, data)
            may = self.hears.get(robot_id)
            if order.robot_id != robot_id or may is None or may(order):
                hear(key, data)

        link = super()._open_link(robot, {**subscriptions, ORDER: hear_order})
        return _ChangedLink(link, robot_id, self.says)


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
