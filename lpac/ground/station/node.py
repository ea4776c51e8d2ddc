"""One ground: its station and its commands, on a clock and a link that somebody else has.

`lpac ground` runs it on the real clock and the radio (`station.server`), the simulator on its own.
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
_AHEAD = (
    "is not listened to: its program started more than a day from now. Either this computer's "
    "clock is behind, or the robot's was wrong (`lpac fleet up`, then `lpac fleet restart`), or "
    "somebody has its key (`lpac fleet revoke`)"
)
_STRANGER = "flies another release, which this ground station cannot read: deploy one to all"
# Ticks are not exact.
_EARLY_S = 0.1


class GroundListener(Protocol):
    """Listener to the events at a ground."""

    def told(self, message: ServerMessage) -> None:
        """Something new that clients want to hear: a setup, an event, what was explored."""

    def stepped(self) -> None:
        """Commands went on."""

    def commanded(self, state: GroundState) -> None:
        """The fleet is told something else, by this station; before robots hear of it."""


class GroundNode:
    """One ground, which one thread calls, and which speaks and hears by its guard.

    What raises in it is told as an event: robots that fly need it more than they need what it could
    not do.
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
        self._told_setup = setup
        self._kept: GroundState | None = None
        self._published: tuple[int | None, Hold | None, int] = None, None, 0
        self._state_at_s = -math.inf
        self._world_at_s = 0.0
        self._complained: set[str] = set()

    @property
    def subscriptions(self) -> Mapping[Topic, ReceiveCallback]:
        """Subscriptions: topic -> callback with the key and the data, in the node's thread."""
        topics = (STATUS, EXPLORED, STATE, HOLD, WORLD)
        return self._guard.subscriptions(dict.fromkeys(topics, self._hear))

    def attach(self, link: Link) -> None:
        """Set the link to publish on from now on."""
        self._link = self._guard.wrap(link)

    def detach(self) -> None:
        """Publish nothing from now on."""
        self._link = None

    @property
    def explored(self) -> tuple[Explored, ...]:
        """Explored map of each robot, as far as it was heard."""
        return tuple(_explored(name, cells) for name, cells in self._explored.items())

    @property
    def snapshot(self) -> FleetSnapshot:
        """The fleet now."""
        return self.station.snapshot(self.commands.texts)

    def _hear(self, key: str, data: bytes, sender: Sender) -> None:
        self._set_time()
        with self.surviving(key):
            self._receive(key, data, sender)

    def tick(self) -> None:
        """Time has passed; some five times a second."""
        self._set_time()
        self.station.hear_twice(self._guard.duplicate_robots())
        self.station.members_problem = (
            self._guard.members_differ()
            if self.station.is_member
            else "this station's key is not in the list of members: no robot hears it"
        )
        for robot_id in self._guard.robots_with_future_start():
            name = self._names.get(f"robot/{robot_id}", "")
            self._complain(f"ahead {robot_id}", name, _AHEAD)
        for robot_id in self._guard.pop_unreadable_robots():
            name = self._names.get(f"robot/{robot_id}", "")
            self._complain(f"stranger {robot_id}", name, _STRANGER)
        with self.surviving("tick"):
            self.station.tick()
            self._step()
        with self.surviving("publish"):
            self._publish()

    def begin(self, request: Request) -> CommandTask | None:
        """Begin a command; None if a defect kept it from beginning."""
        self._set_time()
        with self.surviving("command"):
            task = self.commands.begin(request)
            self._step()
            return task
        return None

    def abandon(self, task: CommandTask, why: str) -> None:
        """Whoever wanted it does not any more."""
        self._set_time()
        task.abandon(why, withdraw=False)
        self._step()

    def _set_time(self) -> None:
        unix_s = self._clock.unix_s()
        self.station.set_time(self._clock.monotonic_s(), unix_s)
        self.station.is_member = self._guard.is_member()
        self._guard.receive_time(unix_s)

    def _receive(self, key: str, data: bytes, sender: Sender) -> None:
        source, _, topic = key.rpartition("/")
        name = self._names.get(source)
        if topic == EXPLORED.name:
            sane = len(data) == EXPLORED_CELLS**2 // 8
            if name is not None and sane and self._explored.get(name) != data:
                self._explored[name] = data
                self._listener.told(_explored(name, data))
            return
        try:
            if topic == STATE.name:
                self.station.election.hear_state(decode(GroundState, data), sender)
            elif topic == HOLD.name:
                self.station.hear_hold(decode(Hold, data), sender)
            elif topic == WORLD.name:
                self.station.hear_world(data.decode(errors="replace"))
            else:
                status = decode(RobotStatus, data)
                if source != f"robot/{status.robot_id}":
                    said = self._names.get(f"robot/{status.robot_id}", f"robot {status.robot_id}")
                    raise MessageError(f"it says that it is {said}")
                is_own = sender.release == self._guard.release
                self.station.hear_status(status, "" if is_own else sender.release.hex())
        except MessageError as error:
            # Another version of the program, say.
            self._complain(key, name or "", f"{topic} is not understood: {error}")
            return
        if name is None and topic == STATUS.name:
            self._complain(key, "", f"{source.replace('/', ' ')} is heard, and not in fleet.toml")
        self._step()

    def _step(self) -> None:
        """Let commands go on, and tell what is new."""
        self.commands.step()
        self._listener.stepped()
        setup = self.station.setup
        if setup != self._told_setup:
            self._told_setup = setup
            self._listener.told(setup)
        for event in self.station.new_events():
            self._listener.told(event)
        if self._published != self._to_publish():
            # What is new does not wait for its turn.
            self._publish()

    def _to_publish(self) -> tuple[int | None, Hold | None, int]:
        station = self.station
        sequence = station.state.sequence if station.commands and station.state else None
        return sequence, station.published_hold, len(station.orders.pending)

    def _publish(self) -> None:
        station = self.station
        if station.commands and station.state is not None and station.state != self._kept:
            self._kept = station.state
            self._listener.commanded(station.state)
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
    def surviving(self, what: str) -> Iterator[None]:
        """Tell of a defect, and go on."""
        try:
            yield
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{Path(where.filename).name}, line {where.lineno}"
            text = f"a defect of lpac ground ({what}): {error!r} in {place}"
            self._complain(f"defect {what}", "", text)

    def _complain(self, key: str, robot: str, text: str) -> None:
        """Once for each key is enough."""
        if key not in self._complained:
            self._complained.add(key)
            self.station.tell("presence", robot, text)


def _explored(name: str, cells: bytes) -> Explored:
    return Explored(name, base64.b64encode(cells).decode())
