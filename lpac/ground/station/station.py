"""A ground station: what it knows of its fleet, and what it commands.

Pure: the owner passes in time and messages, and asks what to publish. For one thread at a time.

Only the commanding station (see `election`) changes the published state. Any station may command
hold: it repeats a `Hold`, which robots obey, until the commander's state includes it.
"""

import math
import zlib
from collections import deque
from collections.abc import Collection
from dataclasses import replace

from edge.identity.guard import Sender
from edge.messages.mission import (
    ON_GROUND,
    FlightState,
    GroundState,
    Hold,
    OrderKind,
    RobotStatus,
    SafetyAction,
    world_id,
)
from lpac.analysis.mission_tracker import MissionTracker
from lpac.analysis.snapshot import (
    COMMANDER_SILENT_S,
    EventKind,
    FleetSetup,
    FleetSnapshot,
    GroundEvent,
)
from lpac.ground.station.echoes import Echoes
from lpac.ground.station.election import Election
from lpac.ground.station.orders import Orders
from lpac.ground.station.places import with_places
from lpac.ground.station.return_queue import ReturnQueue
from lpac.ground.station.states import holds
from lpac.ground.station.statuses import RobotStatuses
from lpac.ground.station.worlds import Worlds

_RECENT_S = 10.0
_EVENTS_KEPT = 200
# Minimum time to repeat a hold that all robots obey but the commander's state does not include.
_ASKED_AT_LEAST_S = 3.0
# Limits of the age of the last state that a robot heard, with the age of the status that reports
# it. Beyond the first the robot has missed a state, beyond the second it is out of reach.
_LATE_S, _LOST_S = 1.0, 5.0


def is_down(status: RobotStatus) -> bool:
    """Whether it is on the ground and not known to be armed, or has been killed."""
    if status.state is FlightState.FAULT:
        return status.armed is False
    return status.state in ON_GROUND and not status.armed


class Station:
    """One ground station. Without `may_command` it can only ask for holds."""

    def __init__(
        self, setup: FleetSetup, now_s: float, unix_now_s: float, *, may_command: bool = True
    ) -> None:
        # Whether this station's key is in the list of members, and what is wrong with the list.
        self.is_member = True
        self.members_problem = ""
        self._setup = setup
        self._robots = RobotStatuses(setup.robots, now_s, unix_now_s, self.notify)
        self.orders = Orders(setup.operator, self._robots)
        self.worlds = Worlds(setup, self._robots)
        self.election = Election(
            setup, self._robots, self.orders, self.notify, may_command=may_command
        )
        self._echoes = Echoes(self._robots)
        self._return_queue = ReturnQueue(self._robots)
        self._time_base = zlib.crc32(self.orders.prefix.encode()) or 1
        # The hold that this station asks for while another commands.
        self._asked: Hold | None = None
        self._asked_at_s = -math.inf
        self._missions = MissionTracker()
        # The last mission's trial and Unix start time, None if it began before its robot was heard.
        self._mission: tuple[str, float | None] = "", None
        self._events: deque[GroundEvent] = deque(maxlen=_EVENTS_KEPT)
        self._new_events: list[GroundEvent] = []

    @property
    def state(self) -> GroundState | None:
        """The commander's state; None if there is none yet."""
        return self.election.state

    @property
    def commands(self) -> bool:
        """Whether this station commands."""
        return self.election.commands

    @property
    def now_s(self) -> float:
        """Present time on the monotonic clock, s."""
        return self._robots.now_s

    @property
    def age_s(self) -> float:
        """Time since this station started, s."""
        return self._robots.age_s

    @property
    def operator(self) -> str:
        """This station's name."""
        return self._setup.operator

    @property
    def setup(self) -> FleetSetup:
        """The fleet's setup with the present world and places."""
        setup, state = self._setup, self.state
        world = self.worlds.fleet_id(None if state is None else state.world_id)
        if world != setup.world_id:
            # Better no text than that of another world.
            setup = replace(setup, world=self.worlds.text(world), world_id=world)
        return with_places(setup, {} if state is None else state.places, self._robots.names)

    @property
    def flying(self) -> tuple[str, ...]:
        """Robots with a slot, in the order of the slots."""
        return tuple(slot.robot for slot in self.setup.slots if slot.robot)

    def status(self, name: str) -> RobotStatus | None:
        """The robot's newest status, if it is not older than `FRESH_S`."""
        return self._robots.status(self._setup.robots[name])

    def recent_status(self, name: str) -> RobotStatus | None:
        """The robot's newest status, if it is not older than 10 s: links may be bad."""
        last = self._robots.last(self._setup.robots[name])
        return last[0] if last is not None and last[1] <= _RECENT_S else None

    def is_duplicate(self, name: str) -> bool:
        """Whether two programs have this robot's id."""
        return self._robots.is_duplicate(self._setup.robots[name])

    def snapshot(self, running: tuple[str, ...] = ()) -> FleetSnapshot:
        """Snapshot for the clients; `running` are the commands that run."""
        return FleetSnapshot(
            unix_time_s=self._robots.unix_now_s,
            commander=self.election.commander,
            ground=self.state,
            robots=self._robots.snapshots(),
            running=running,
            commander_age_s=self.election.commander_age_s,
            shares_name=self.election.shares_name,
            members_problem=self.members_problem,
            mission_s=self._mission_s,
        )

    @property
    def _mission_s(self) -> float | None:
        (trial, began_s), state = self._mission, self.state
        flown = self._missions.robots and state is not None and state.trial == trial
        return self._robots.unix_now_s - began_s if flown and began_s is not None else None

    def notify(self, kind: EventKind, robot: str, text: str, operator: str = "") -> None:
        """Add an event for the clients."""
        trial = "" if self.state is None else self.state.trial
        unix_now_s = self._robots.unix_now_s
        event = GroundEvent(unix_now_s, kind, robot, text, operator, trial)
        self._events.append(event)
        self._new_events.append(event)

    @property
    def last_events(self) -> tuple[GroundEvent, ...]:
        """The last 200 events, in order."""
        return tuple(self._events)

    def new_events(self) -> list[GroundEvent]:
        """Events since the last call."""
        events, self._new_events = self._new_events, []
        return events

    def set_time(self, now_s: float, unix_now_s: float) -> None:
        """Set the time. Call before anything else."""
        self._robots.now_s, self._robots.unix_now_s = now_s, unix_now_s

    def set_duplicates(self, robots: frozenset[int]) -> None:
        """Set the ids of robots whose key signs for two programs."""
        self._robots.duplicate_keys = robots

    def receive_status(self, status: RobotStatus, other_release: str = "") -> None:
        """Take a robot's status; robots of other fleets are ignored."""
        known = status.robot_id in self._robots.statuses()
        if self._robots.receive(status, other_release):
            if self._missions.begins(status.robot_id, status, self.now_s):
                self._mission = status.trial, self._robots.unix_now_s if known else None
            self.worlds.receive_status(status)
            self.orders.receive(status)
            self.election.receive_status(status)

    def receive_world(self, text: str) -> None:
        """Take a world file from another station."""
        self.worlds.receive(text, self.setup.world_id)

    def receive_hold(self, hold: Hold, sender: Sender) -> None:
        """Take a hold from another station; the commander puts it into its state."""
        before = self.state
        if not self.commands or before is None or sender.name not in ("", hold.by):
            return
        if hold.by == self.operator or holds(before, hold):
            return
        self.safety_action("hold", hold.robots or None, hold.by)
        assert self.state is not None
        self.election.notify_changes(before, self.state, hold.by)
        self.election.interruption = f"{hold.by} commands hold"

    def tick(self) -> None:
        """Do what time makes due. Call a few times a second."""
        self._robots.update()
        self.orders.expire()
        self.election.elect()
        if self.commands:
            self._asked = None
            queued = self._return_queue.update(self.election.take_command())
            if queued is not None:
                self.change(**queued._asdict())
        elif self._asked is not None:
            self._end_asking(self._asked)

    def change(self, **changes: object) -> int:
        """Change fields of the state, taking command; return its sequence."""
        election = self.election
        before = election.take_command()
        after = replace(before, **changes)  # type: ignore[arg-type]
        if after != before:
            election.state = after = replace(after, sequence=before.sequence + 1)
        return after.sequence

    def safety_action(
        self, safety_action: SafetyAction, robots: Collection[int] | None = None, by: str = ""
    ) -> int:
        """Command the fleet, or these robots, to hold, return or land; "none" withdraws it.

        `by` names another station that asked for it. Returns the state's sequence.
        """
        state = self.election.take_command()
        these = frozenset(self._robots.names if robots is None else robots)
        self._return_queue.forget(these)
        if robots is None:
            return self.change(
                safety_action=safety_action, safety_action_by=by, robot_safety_actions={},
                waiting=(),
            )  # fmt: skip
        actions = state.robot_safety_actions | dict.fromkeys(
            map(str, sorted(robots)), safety_action
        )
        return self.change(
            safety_action_by=by,
            robot_safety_actions={r: a for r, a in actions.items() if a != state.safety_action},
            waiting=tuple(r for r in state.waiting if r not in these),
        )

    def hold(self, robots: Collection[int] | None = None) -> int:
        """Command hold, whoever commands; return the least sequence that robots must obey."""
        election = self.election
        lost = election.commander_age_s > COMMANDER_SILENT_S
        if election.may_command and (self.commands or not election.commander or lost):
            return self._hold_as_commander(robots)
        before = self._asked
        of_all = robots is None or (before is not None and not before.robots)
        these = {*(robots or ()), *(before.robots if before is not None else ())}
        self._asked = Hold(self.operator, () if of_all else tuple(sorted(these)))
        self._asked_at_s = self.now_s
        return 0

    def _hold_as_commander(self, robots: Collection[int] | None) -> int:
        self.safety_action("hold", robots)
        state, statuses = self.election.take_command(), self._robots.statuses().values()
        # Robots may obey a station that took over and is not received here.
        others = (s.obeyed_sequence for s in statuses if s.operator != self.operator)
        beyond = min(max(others, default=0), self.election.greatest_obeyed) + 1
        self.election.state = replace(state, sequence=max(state.sequence, beyond))
        return self.election.state.sequence

    def _end_asking(self, asked: Hold) -> None:
        """Stop asking once the commander or all robots hold; take over from a silent commander."""
        if self.election.may_command and self.election.commander_age_s > COMMANDER_SILENT_S:
            self._hold_as_commander(asked.robots or None)
            self._asked = None
            return
        taken_up = self.state is not None and holds(self.state, asked)
        all_hold = all(
            status.state is FlightState.HOLD or is_down(status)
            for robot, status in self._robots.statuses().items()
            if asked.is_of(robot)
        )
        if taken_up or (all_hold and self.now_s - self._asked_at_s > _ASKED_AT_LEAST_S):
            self._asked = None

    def set_world(self, text: str) -> int:
        """Set the robots' world; return the state's sequence."""
        self.worlds.add(text)
        return self.change(world_id=world_id(text))

    def order(self, kind: OrderKind, name: str, trial: str = "") -> str | None:
        """Give an order; return its id, or None if the robot was never heard."""
        return self.orders.give(kind, self._setup.robots[name], trial)

    @property
    def published_hold(self) -> Hold | None:
        """Hold to publish, if any."""
        return None if self.commands else self._asked

    def published_state(self) -> GroundState | None:
        """State to publish, if any, with the next echoes."""
        if not self.commands or self.state is None:
            return None
        return replace(
            self.state,
            unix_time_s=self._robots.unix_now_s,
            time_base=self._time_base,
            time_s=self.now_s,
            echoes=self._echoes.take(),
        )

    def is_heard_late(self) -> bool:
        """Whether a robot seems to miss states, which then go out at each tick."""
        ages_s = map(self._robots.ground_age_s, self._robots.statuses())
        return any(_LATE_S < age_s < _LOST_S for age_s in ages_s)

    def published_world(self) -> str | None:
        """World file to publish, while a robot needs it."""
        return self.worlds.to_publish(self.state.world_id if self.commands and self.state else None)
