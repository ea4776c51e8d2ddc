"""Whole robots in this process, as fast as real time and on zenoh: for tests of ground processes.

They cost a small part of what a process for each robot and a server for their vehicles would.
"""

import math
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple, Self

from edge.drivers.zenoh_link import ZenohLink
from edge.identity.envelope import enclose, read_envelope
from edge.messages.codec import decode, encode
from edge.messages.mission import RobotStatus
from edge.messages.topics import STATUS, ReceiveCallback, Topic
from lpac.sim.air import Subscriptions
from lpac.sim.fleet.layout import ORIGIN
from lpac.sim.fleet.robots import OpenLink, SimulatedRobot, SimulatedRobots
from lpac.sim.ports import free_ports
from lpac.sim.scenario import Scenario
from tests.conftest import SHIPPED
from tests.flown import PRECISE, QUICK, FlownRobot

__all__ = ["ORIGIN", "FlownFleet", "until"]

# Of thirty robots, for one computer that does other things besides.
SPARING = {
    "rates": {"perception_hz": 1.0, "policy_hz": 1.0, "control_hz": 5.0},
    "policy": {"max_input_age_s": 3.0, "max_message_age_s": 2.5},
}
# How often the clock is looked at; and how long the robots have been on when they are first heard.
_LOOK_S = 0.01
_WARM_S = 12.0


class _Arrived(NamedTuple):
    at_s: float
    receive: ReceiveCallback
    key: str
    data: bytes


class FlownFleet(SimulatedRobots):
    """N robots with slots, and spares; a context. Other threads touch them while it is `paused`.

    They stand along the lower edge of the field, 4 m from each other, and then in further rows,
    with their noses along the y axis; nearer, those that take off at once would wait for each
    other. `says[i]` changes what others hear of robot i.

    A thread lets their time pass. If the machine is too slow for a moment they are late, and make
    up for it; what comes by radio reaches them when it came by their clock, too.
    """

    def __init__(self, folder: Path, n: int, *, spares: int = 0, name: str = "") -> None:
        self.says: dict[int, Callable[[RobotStatus], RobotStatus]] = {}
        self.name = name or f"live-{secrets.token_hex(3)}"
        self.ports = free_ports(n + spares)
        pads_m = tuple((2.0 + 4.0 * (i % 8), 2.0 + 4.0 * (i // 8)) for i in range(n + spares))
        super().__init__(
            Scenario(robots=n + spares, seed=3, errors=False, budget=PRECISE, starts_m=pads_m),
            folder, SHIPPED,
            fleet=self.name, ports=self.ports, epoch_s=time.time(), spares=spares,
            settings=SPARING if n > 10 else None, vehicle_step_s=0.05 if n > 10 else 0.02,
        )  # fmt: skip
        for each in self.vehicles:
            each.vehicle.parameters |= QUICK
            each.vehicle.heading_rad = math.radians(ORIGIN.heading_deg)
        self.flown = [FlownRobot(robot) for robot in self.robots]
        self._began_s = 0.0
        self._arrived: deque[_Arrived] = deque()
        self._lock = threading.RLock()
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, name="live fleet", daemon=True)

    def __enter__(self) -> Self:
        for robot in self.robots:
            robot.start()
        self.schedule.run_until(_WARM_S)
        self._began_s = time.monotonic() - _WARM_S
        self.schedule.epoch_s = time.time() - _WARM_S
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ends.set()
        self._thread.join()
        for robot in self.all_programs:
            robot.stop()
        self.close()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """No time passes meanwhile."""
        with self._lock:
            yield

    def _run(self) -> None:
        while not self._ends.wait(_LOOK_S):
            with self._lock:
                while self._arrived:
                    came = self._arrived.popleft()
                    due_s = came.at_s - self._began_s
                    self.schedule.at(due_s, partial(came.receive, came.key, came.data))
                self.schedule.run_until(time.monotonic() - self._began_s)

    def _later(self, receive: ReceiveCallback) -> ReceiveCallback:
        """Robots that are late would take what came for something that came before it was said."""

        def arrive(key: str, data: bytes) -> None:
            self._arrived.append(_Arrived(time.monotonic(), receive, key, data))

        return arrive

    def _open_link(self, robot: SimulatedRobot, subscriptions: Subscriptions) -> OpenLink:
        config = robot.config
        first = robot in self.robots
        everybody = tuple(f"tcp/127.0.0.1:{port}" for port in self.ports)
        link = ZenohLink(
            fleet=self.name,
            robot_id=config.robot_id,
            # The port of a second program of a robot is another one.
            listen=config.link.listen if first else ("tcp/127.0.0.1:0",),
            connect=config.link.connect if first else everybody,
            subscriptions={topic: self._later(hear) for topic, hear in subscriptions.items()},
        )
        return _ChangedLink(link, config.robot_id, self.says)


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
        self.close = link.close

    def publish(self, topic: Topic, data: bytes) -> None:
        change = self._says.get(self._robot_id)
        if topic is STATUS and change is not None:
            envelope = read_envelope(data)
            assert envelope is not None
            payload = topic.unpacked(envelope.payload)
            assert payload is not None
            status = change(decode(RobotStatus, payload))
            data = enclose(topic.packed(encode(status)), envelope.head.number)
        self._link.publish(topic, data)


def until(condition: Callable[[], object], patience_s: float = 60.0) -> None:
    """Wait for what robots do."""
    deadline_s = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.02)
