"""Subscriber to the statuses of a fleet's robots."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Self

from edge.drivers.identity_folder import load_identity
from edge.drivers.zenoh_link import ZenohLink
from edge.identity.guard import Guard, Sender, Unguarded
from edge.messages.codec import MessageError, decode
from edge.messages.mission import RobotStatus
from edge.messages.topics import STATUS
from lpac.analysis.snapshot import FRESH_S

_LOOK_AGAIN_S = 0.2

Statuses = Mapping[int, RobotStatus]
Report = Callable[[str], None]


class ReceivedStatus(NamedTuple):
    """A status, and the `time.monotonic()` of its arrival."""

    at_s: float
    status: RobotStatus


class FleetListener:
    """Receive-only subscriber that keeps every status of every robot; a context.

    All methods are thread-safe.
    """

    def __init__(
        self,
        *,
        fleet: str,
        connect: Sequence[str],
        identity: Path | None = None,
        report: Report = lambda _: None,
    ) -> None:
        """`connect` are the robots' endpoints; `identity` is the folder with its own keys, in a
        secure fleet; `report` gets malformed messages, from another thread.
        """
        self._fleet = fleet
        self._identity = identity
        self._connect = tuple(connect)
        self._report = report
        self._changed = threading.Condition()
        self._statuses: dict[int, list[ReceivedStatus]] = {}
        self._link: ZenohLink | None = None

    def __enter__(self) -> Self:
        """Subscribe. Raises LinkError."""
        guard: Guard = Unguarded(0)
        tls, scheme = None, "tcp"
        if self._identity is not None:
            identity = load_identity(self._identity, fleet=self._fleet, unix_s=time.time())
            guard, tls, scheme = identity.guard(time.monotonic), identity.tls, "tls"
        self._link = ZenohLink(
            fleet=self._fleet,
            listen=(f"{scheme}/127.0.0.1:0",),
            connect=self._connect,
            subscriptions=guard.subscriptions({STATUS: self._receive}),
            tls=tls,
        )
        return self

    def __exit__(self, *_: object) -> None:
        assert self._link is not None
        self._link.close()

    def statuses(self) -> dict[int, RobotStatus]:
        """The newest status of each robot with a fresh one, by robot id."""
        earliest_s = time.monotonic() - FRESH_S
        with self._changed:
            newest = {robot: received[-1] for robot, received in self._statuses.items()}
        return {robot: last.status for robot, last in newest.items() if last.at_s >= earliest_s}

    def history(self, robot: int) -> tuple[ReceivedStatus, ...]:
        """All statuses of a robot, in order."""
        with self._changed:
            return tuple(self._statuses.get(robot, ()))

    def forget(self) -> None:
        """Keep only the last status of each robot."""
        with self._changed:
            for received in self._statuses.values():
                del received[:-1]

    def wait_for(self, condition: Callable[[Statuses], bool], timeout_s: float) -> bool:
        """Wait until `condition` holds; False on timeout."""
        deadline_s = time.monotonic() + timeout_s
        while not condition(self.statuses()):
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:
                return False
            with self._changed:
                # A robot that falls silent sends no notification, so look again.
                self._changed.wait(min(left_s, _LOOK_AGAIN_S))
        return True

    def _receive(self, _: str, data: bytes, __: Sender) -> None:
        at_s = time.monotonic()
        try:
            status = decode(RobotStatus, data)
        except MessageError as error:
            self._report(f"a status is malformed: {error}")
            return
        with self._changed:
            self._statuses.setdefault(status.robot_id, []).append(ReceivedStatus(at_s, status))
            self._changed.notify_all()
