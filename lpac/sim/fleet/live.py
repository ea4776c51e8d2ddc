"""Whole robots in one process, as fast as real time, on a real radio: for a real ground process.

They cost a small part of what a process for each robot and a server for their vehicles would.
"""

import secrets
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

from edge.drivers.zenoh_link import ZenohLink
from edge.messages.topics import ReceiveCallback
from lpac.sim.fleet.layout import Settings
from lpac.sim.fleet.robots import (
    VEHICLE_STEP_S,
    OpenLink,
    SimulatedRobot,
    SimulatedRobots,
)
from lpac.sim.ports import free_ports
from lpac.sim.radio import Subscriptions
from lpac.sim.scenario import Scenario

# How often the clock is looked at; and how long the robots have been on when they are first heard.
_LOOK_S = 0.01
_WARM_S = 12.0


class _Arrived(NamedTuple):
    at_s: float
    receive: ReceiveCallback
    key: str
    data: bytes


class LiveFleet(SimulatedRobots):
    """Robots on zenoh, as a context; from other threads they are touched while it is `paused`.

    A thread lets their time pass. If the machine is too slow for a moment they are late, and make
    up for it; what comes by radio reaches them when it came by their clock, too.
    """

    def __init__(
        self,
        scenario: Scenario,
        folder: Path,
        bundle: Path,
        *,
        name: str = "",
        settings: Settings | None = None,
        spares: int = 0,
        vehicle_step_s: float = VEHICLE_STEP_S,
    ) -> None:
        """See `SimulatedRobots`. Raises what `Layout` does."""
        self.name = name or f"live-{secrets.token_hex(3)}"
        self.ports = free_ports(scenario.robots)
        super().__init__(
            scenario,
            folder,
            bundle,
            fleet=self.name,
            ports=self.ports,
            epoch_s=time.time(),
            settings=settings,
            spares=spares,
            vehicle_step_s=vehicle_step_s,
        )
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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
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
        return ZenohLink(
            fleet=self.name,
            robot_id=config.robot_id,
            # The port of a second program of a robot is another one.
            listen=config.link.listen if first else ("tcp/127.0.0.1:0",),
            connect=config.link.connect if first else everybody,
            subscriptions={topic: self._later(hear) for topic, hear in subscriptions.items()},
        )
