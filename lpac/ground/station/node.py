"""A ground station with its commands, on a clock and a link that the owner provides.

`lpac ground` runs it on the real clock and radio (`station.server`), the simulator on its own.
"""

import base64
import math
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from edge.core.memory import EXPLORED_CELLS
from edge.core.ports import Clock
from edge.identity.guard import Guard, Sender
from edge.identity.members import Role
from edge.messages.codec import MessageError, decode, encode
from edge.messages.mission import GroundState, Hold, RobotStatus
from edge.messages.topics import (
    EXPLORED,
    HOLD,
    ORDER,
    STATE,
    STATUS,
    WORLD,
    Link,
    ReceiveCallback,
    Topic,
)
from lpac.analysis.snapshot import Explored, FleetSetup, FleetSnapshot
from lpac.ground.station.commands import Commands, CommandTask
from lpac.ground.station.protocol import Request, ServerMessage
from lpac.ground.station.station import Station

_WORLD_PERIOD_S = 0.5
_FUTURE_START = (
    "is ignored: its program started more than a day from now. Either this computer's clock is "
    "slow, or the robot's was fast (`lpac fleet up`, then `lpac fleet restart`), or somebody has "
    "its key (`lpac fleet revoke`)"
)
_UNREADABLE = "flies another release, which this ground station cannot read: deploy one to all"
# Ticks are not exact.
_EARLY_S = 0.1


class GroundListener(Protocol):
    """Listener to the events at a ground."""

    def published(self, message: ServerMessage) -> None:
        """New message for clients: a setup, an event, an explored map."""

    def progressed(self) -> None:
        """A command may have progressed."""

    def state_changed(self, state: GroundState) -> None:
        """This station's state has changed. Called before it is published."""


class GroundNode:
    """One ground station. For one thread; all messages pass its guard.

    An exception in it becomes an event, and the node goes on, since flying robots need it.
    """

    def __init__(
        self, setup: FleetSetup, clock: Clock, listener: GroundListener, guard: Guard
    ) -> None:
        may_command = guard.role is not Role.OBSERVER
        self.station = Station(setup, clock.monotonic_s(), clock.unix_s(), may_command=may_command)
        self.commands = Commands(self.station)
        self._guard = guard
        self._link: Link | None = None
        self._clock = clock
        self._listener = listener
        self._names = {f"robot/{robot}": name for name, robot in setup.robots.items()}
        self._explored: dict[str, bytes] = {}
        self._published_setup = setup
        self._last_state: GroundState | None = None
        self._published: tuple[int | None, Hold | None, int] = None, None, 0
        self._state_at_s = -math.inf
        self._world_at_s = 0.0
        self._notified: set[str] = set()

    @property
    def subscriptions(self) -> Mapping[Topic, ReceiveCallback]:
        """Topic -> callback with key and data, to be called in the node's thread."""
        topics = (STATUS, EXPLORED, STATE, HOLD, WORLD)
        return self._guard.subscriptions(dict.fromkeys(topics, self._receive))

    def attach(self, link: Link) -> None:
        """Publish on this link from now on."""
        self._link = self._guard.wrap(link)

    def detach(self) -> None:
        """Stop publishing."""
        self._link = None

    @property
    def explored(self) -> tuple[Explored, ...]:
        """Explored maps received from the robots."""
        return tuple(_explored(name, cells) for name, cells in self._explored.items())

    @property
    def snapshot(self) -> FleetSnapshot:
        """Present snapshot of the fleet."""
        return self.station.snapshot(self.commands.texts)

    def _receive(self, key: str, data: bytes, sender: Sender) -> None:
        self._set_time()
        with self.reporting_defects(key):
            self._dispatch(key, data, sender)

    def tick(self) -> None:
        """Do what time makes due. Call at about 5 Hz."""
        self._set_time()
        self.station.set_duplicates(self._guard.duplicate_robots())
        self.station.members_problem = (
            self._guard.members_differ()
            if self.station.is_member
            else "this station's key is not in the list of members: no robot hears it"
        )
        for robots, text in (
            (self._guard.robots_with_future_start(), _FUTURE_START),
            (self._guard.pop_unreadable_robots(), _UNREADABLE),
        ):
            for robot_id in robots:
                name = self._names.get(f"robot/{robot_id}", "")
                self._notify_once(f"{robot_id} {text}", name, text)
        with self.reporting_defects("tick"):
            self.station.tick()
            self._step()
        with self.reporting_defects("publish"):
            self._publish()

    def begin(self, request: Request) -> CommandTask | None:
        """Begin a command; None if a defect prevented it."""
        self._set_time()
        with self.reporting_defects("command"):
            task = self.commands.begin(request)
            self._step()
            return task
        return None

    def abandon(self, task: CommandTask, why: str) -> None:
        """Abandon a command, but not what it has ordered."""
        self._set_time()
        task.abandon(why, withdraw=False)
        self._step()

    def _set_time(self) -> None:
        unix_s = self._clock.unix_s()
        self.station.set_time(self._clock.monotonic_s(), unix_s)
        self.station.is_member = self._guard.is_member()
        self._guard.receive_time(unix_s)

    def _dispatch(self, key: str, data: bytes, sender: Sender) -> None:
        source, _, topic = key.rpartition("/")
        name = self._names.get(source)
        if topic == EXPLORED.name:
            valid = len(data) == EXPLORED_CELLS**2 // 8
            if name is not None and valid and self._explored.get(name) != data:
                self._explored[name] = data
                self._listener.published(_explored(name, data))
            return
        try:
            if topic == STATE.name:
                self.station.election.receive_state(decode(GroundState, data), sender)
            elif topic == HOLD.name:
                self.station.receive_hold(decode(Hold, data), sender)
            elif topic == WORLD.name:
                self.station.receive_world(data.decode(errors="replace"))
            else:
                status = decode(RobotStatus, data)
                if source != f"robot/{status.robot_id}":
                    other = self._names.get(f"robot/{status.robot_id}", f"robot {status.robot_id}")
                    raise MessageError(f"it has the id of {other}")
                is_own = sender.release == self._guard.release
                self.station.receive_status(status, "" if is_own else sender.release.hex())
        except MessageError as error:
            # Perhaps of another release.
            self._notify_once(key, name or "", f"{topic} is not understood: {error}")
            return
        if name is None and topic == STATUS.name:
            self._notify_once(key, "", f"{source.replace('/', ' ')} is heard but not in fleet.toml")
        self._step()

    def _step(self) -> None:
        """Continue commands, and publish what is new."""
        self.commands.step()
        self._listener.progressed()
        setup = self.station.setup
        if setup != self._published_setup:
            self._published_setup = setup
            self._listener.published(setup)
        for event in self.station.new_events():
            self._listener.published(event)
        if self._published != self._to_publish():
            self._publish()  # at once, not with the next tick

    def _to_publish(self) -> tuple[int | None, Hold | None, int]:
        station = self.station
        sequence = station.state.sequence if station.commands and station.state else None
        return sequence, station.published_hold, len(station.orders.pending)

    def _publish(self) -> None:
        station = self.station
        if station.commands and station.state is not None and station.state != self._last_state:
            self._last_state = station.state
            self._listener.state_changed(station.state)
        now_s, before = self._clock.monotonic_s(), self._published
        self._published = self._to_publish()
        if self._link is None:
            return
        due = now_s - self._state_at_s > 1.0 / STATE.rate_hz - _EARLY_S
        if due or self._published != before or station.is_heard_late():
            state = station.published_state()
            if state is not None:
                self._link.publish(STATE, encode(state))
                self._state_at_s = now_s
        if station.published_hold is not None:
            self._link.publish(HOLD, encode(station.published_hold))
        for order in station.orders.pending:
            self._link.publish(ORDER, encode(order))
        world = station.published_world()
        if world is not None and now_s - self._world_at_s >= _WORLD_PERIOD_S:
            self._world_at_s = now_s
            self._link.publish(WORLD, world.encode())

    @contextmanager
    def reporting_defects(self, what: str) -> Iterator[None]:
        """Turn an exception into an event, and go on."""
        try:
            yield
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{Path(where.filename).name}, line {where.lineno}"
            text = f"a defect of lpac ground ({what}): {error!r} in {place}"
            self._notify_once(f"defect {what}", "", text)

    def _notify_once(self, key: str, robot: str, text: str) -> None:
        if key not in self._notified:
            self._notified.add(key)
            self.station.notify("presence", robot, text)


def _explored(name: str, cells: bytes) -> Explored:
    return Explored(name, base64.b64encode(cells).decode())
