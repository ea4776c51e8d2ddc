"""A ground station: its knowledge of its fleet, and its wishes for it.

Pure: time is passed in, messages are handed in, and what is to be published is asked for. One
thread at a time.

The state that the fleet is told is changed by the station that commands alone (`election`). Only
hold is everybody's: others repeat a `Hold`, which robots obey, until the commander's state has it.
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
from lpac.ground.station.heard import HeardRobots
from lpac.ground.station.homecoming import Homecoming
from lpac.ground.station.orders import Orders
from lpac.ground.station.places import with_places
from lpac.ground.station.wishes import holds
from lpac.ground.station.worlds import Worlds

_LATELY_S = 10.0
_EVENTS_KEPT = 200
# A hold is repeated at least so long, if robots hold and the commander's state does not have it.
_ASKED_AT_LEAST_S = 3.0
# Age of the last state that a robot heard, its status's included: beyond the first it has missed
# one, beyond the second it is out of reach.
_LATE_S, _LOST_S = 1.0, 5.0


def is_down(status: RobotStatus) -> bool:
    """Whether it stands on the ground, disarmed as far as it knows; or lies there, killed."""
    if status.state is FlightState.FAULT:
        return status.armed is False
    return status.state in ON_GROUND and not status.armed


class Station:
    """One ground station.

    One that may not command asks for holds alone: robots take nothing else of it.
    """

    def __init__(
        self, setup: FleetSetup, now_s: float, unix_now_s: float, *, may_command: bool = True
    ) -> None:
        # Whether the list of members has this station's key, and what is wrong with the list.
        self.is_member = True
        self.members_problem = ""
        self._setup = setup
        self._robots = HeardRobots(setup.robots, now_s, unix_now_s, self.tell)
        self.orders = Orders(setup.operator, self._robots)
        self.worlds = Worlds(setup, self._robots)
        self.election = Election(
            setup, self._robots, self.orders, self.tell, may_command=may_command
        )
        self._echoes = Echoes(self._robots)
        self._homecoming = Homecoming(self._robots)
        self._time_base = zlib.crc32(self.orders.prefix.encode()) or 1
        # The hold that this station asks for while another commands.
        self._asked: Hold | None = None
        self._asked_at_s = -math.inf
        self._missions = MissionTracker()
        # Of the mission that began last: its trial, and when, Unix time; None: before it was heard.
        self._mission: tuple[str, float | None] = "", None
        self._events: deque[GroundEvent] = deque(maxlen=_EVENTS_KEPT)
        self._new_events: list[GroundEvent] = []

    # What it knows

    @property
    def state(self) -> GroundState | None:
        """State that the commander publishes; None: nothing yet."""
        return self.election.state

    @property
    def commands(self) -> bool:
        """Whether this station commands."""
        return self.election.commands

    @property
    def now_s(self) -> float:
        """The time of what happened last."""
        return self._robots.now_s

    @property
    def age_s(self) -> float:
        """How long it has been there, s."""
        return self._robots.age_s

    @property
    def operator(self) -> str:
        """This station's name."""
        return self._setup.operator

    @property
    def setup(self) -> FleetSetup:
        """As it is now: the world, and who sits where, change."""
        setup, state = self._setup, self.state
        world = self.worlds.fleets(None if state is None else state.world_id)
        if world != setup.world_id:
            # A wrong text would be shown as if it were the robots'.
            setup = replace(setup, world=self.worlds.text(world), world_id=world)
        return with_places(setup, {} if state is None else state.places, self._robots.names)

    @property
    def flying(self) -> tuple[str, ...]:
        """The robots that sit in a slot, in the order of the slots."""
        return tuple(slot.robot for slot in self.setup.slots if slot.robot)

    def status(self, name: str) -> RobotStatus | None:
        """The robot's newest, if it was heard within `FRESH_S`."""
        return self._robots.status(self._setup.robots[name])

    def lately(self, name: str) -> RobotStatus | None:
        """The robot's newest, if it was heard within 10 s: a bad link is silent for seconds."""
        last = self._robots.last(self._setup.robots[name])
        return last[0] if last is not None and last[1] <= _LATELY_S else None

    def is_duplicate(self, name: str) -> bool:
        """Whether two programs say that they are this robot."""
        return self._robots.is_duplicate(self._setup.robots[name])

    def snapshot(self, running: tuple[str, ...] = ()) -> FleetSnapshot:
        """All of it, for the clients; `running` are the commands that run."""
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

    # Events

    def tell(self, kind: EventKind, robot: str, text: str, operator: str = "") -> None:
        """Keep an event for the clients."""
        trial = "" if self.state is None else self.state.trial
        unix_now_s = self._robots.unix_now_s
        event = GroundEvent(unix_now_s, kind, robot, text, operator, trial)
        self._events.append(event)
        self._new_events.append(event)

    @property
    def last_events(self) -> tuple[GroundEvent, ...]:
        """The last of them, in order."""
        return tuple(self._events)

    def new_events(self) -> list[GroundEvent]:
        """Those since the last call."""
        events, self._new_events = self._new_events, []
        return events

    # What it hears

    def set_time(self, now_s: float, unix_now_s: float) -> None:
        """It is now so late; everything else follows."""
        self._robots.now_s, self._robots.unix_now_s = now_s, unix_now_s

    def hear_twice(self, robots: frozenset[int]) -> None:
        """These robots' keys speak twice now, by robot id."""
        self._robots.said_twice = robots

    def hear_status(self, status: RobotStatus, other_release: str = "") -> None:
        """A robot's status came. One that is not of this fleet is nobody's."""
        known = status.robot_id in self._robots.statuses()
        if self._robots.hear(status, other_release):
            if self._missions.begins(status.robot_id, status, self.now_s):
                self._mission = status.trial, self._robots.unix_now_s if known else None
            self.worlds.hear_status(status)
            self.orders.hear(status)
            self.election.hear_status(status)

    def hear_world(self, text: str) -> None:
        """Another station sends a world to the robots."""
        self.worlds.hear(text, self.setup.world_id)

    def hear_hold(self, hold: Hold, sender: Sender) -> None:
        """Another station asks for a hold: the commander takes it up."""
        before = self.state
        if not self.commands or before is None or sender.name not in ("", hold.by):
            return
        if hold.by == self.operator or holds(before, hold):
            return
        self.safety_action("hold", hold.robots or None, hold.by)
        assert self.state is not None
        self.election.tell_changes(before, self.state, hold.by)
        self.election.interruption = f"{hold.by} commands hold"

    def tick(self) -> None:
        """Time has passed: see who fell silent, and what is to be done by itself."""
        self._robots.look()
        self.orders.expire()
        self.election.listen()
        if self.commands:
            self._asked = None
            way_home = self._homecoming.go_on(self.election.take_command())
            if way_home is not None:
                self.change(**way_home._asdict())
        elif self._asked is not None:
            self._end_asking(self._asked)

    # What it wants

    def change(self, **changes: object) -> int:
        """Want something else of the fleet; the state's sequence. Takes the command."""
        election = self.election
        before = election.take_command()
        after = replace(before, **changes)  # type: ignore[arg-type]
        if after != before:
            election.state = after = replace(after, sequence=before.sequence + 1)
        return after.sequence

    def safety_action(
        self, safety_action: SafetyAction, robots: Collection[int] | None = None, by: str = ""
    ) -> int:
        """Ask the fleet, or these robots alone, to hold, return or land; "none" withdraws it.

        `by` is another station that wants it. Returns the sequence.
        """
        state = self.election.take_command()
        these = frozenset(self._robots.names if robots is None else robots)
        self._homecoming.forget(these)
        if robots is None:
            return self.change(
                safety_action=safety_action, safety_action_by=by, robot_safety_actions={},
                waiting=(),
            )  # fmt: skip
        asked = state.robot_safety_actions | dict.fromkeys(map(str, sorted(robots)), safety_action)
        return self.change(
            safety_action_by=by,
            robot_safety_actions={r: c for r, c in asked.items() if c != state.safety_action},
            waiting=tuple(r for r in state.waiting if r not in these),
        )

    def hold(self, robots: Collection[int] | None = None) -> int:
        """Hold, whoever commands; the least sequence that robots obey then."""
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
        # Robots may obey somebody who took over without being heard here.
        others = (s.obeyed_sequence for s in statuses if s.operator != self.operator)
        beyond = min(max(others, default=0), self.election.greatest_obeyed) + 1
        self.election.state = replace(state, sequence=max(state.sequence, beyond))
        return self.election.state.sequence

    def _end_asking(self, asked: Hold) -> None:
        """The commander takes the hold up, or is gone, or is out of reach of this station."""
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
        """Want that world of the robots; the sequence."""
        self.worlds.remember(text)
        return self.change(world_id=world_id(text))

    def order(self, kind: OrderKind, name: str, trial: str = "") -> str | None:
        """Order something once; the order's id. None if the robot was never heard."""
        return self.orders.give(kind, self._setup.robots[name], trial)

    # What is to be published, a few times a second

    @property
    def published_hold(self) -> Hold | None:
        """The hold to ask for; None: none is."""
        return None if self.commands else self._asked

    def published_state(self) -> GroundState | None:
        """None: nothing is. In large fleets robots are echoed in turns, from call to call."""
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
        lasts = filter(None, map(self._robots.last, self._robots.statuses()))
        return any(
            status.ground_age_s is not None and _LATE_S < status.ground_age_s + age_s < _LOST_S
            for status, age_s in lasts
        )

    def published_world(self) -> str | None:
        """The world's text, while a robot lacks it that may have use for it."""
        return self.worlds.to_publish(self.state.world_id if self.commands and self.state else None)
