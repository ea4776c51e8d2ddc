"""A ground station: its wishes for its fleet, and who commands it.

Pure: time is passed in, messages are handed in, and what is to be published is asked for. One
thread at a time.

Of several stations one commands: its name is the `operator` of the state that the robots obey, and
it alone changes that state. The others observe. Only hold is everybody's: others repeat a `Hold`,
which robots obey, until the commander's state has it.

What robots say of whom they obey counts if most of them say so: one alone may be cut off, or lie.
"""

import math
import re
import statistics
import zlib
from collections import Counter, deque
from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import TypeVar

from edge.identity.card import Role
from edge.identity.guard import CardProblem, Speaker
from edge.messages.codes import CheckCode, Refusal, RefusalCode
from edge.messages.mission import (
    ON_GROUND,
    ORDER_LIFETIME_S,
    Echo,
    FlightState,
    GroundState,
    Hold,
    Order,
    OrderKind,
    OrderResult,
    Place,
    RobotStatus,
    SafetyAction,
    is_over_landing_point,
    waiting_to_land,
    world_id,
)
from lpac.analysis.snapshot import EventKind, FleetSetup, FleetSnapshot, GroundEvent
from lpac.ground.station.heard import HeardRobots

# Before it says anything, a station listens: who commands, whom do the robots obey?
LISTEN_S = 0.7
# A commander that was silent for longer is gone.
COMMANDER_SILENT_S = 2.0
# ... also if robots say so, who hear what this station may not.
_ROBOTS_HEAR_NOBODY_S = 1.0
_OVERTAKEN_S = 1.0
# Who restarts knows of its robots only when it has heard them for a while.
_GATHER_S = 3.0
# Robots that heard this station's name a moment ago have heard another one of that name. They hear
# a state five times a second, and say so twice a second; one of either may be lost.
_SPOKE_S = 1.2
_NAME_TAKEN_S = 3.0
_LATELY_S = 10.0
# A robot refuses an order that expires later than the lifetime, or not after one that it obeyed.
_EXPIRY_MARGIN_S = 0.5
_LATER_S = 1e-3
_EVENTS_KEPT = 200
# Each status is echoed once or twice, but in large fleets: clocks need no more.
_ECHOED_S, _MOST_ECHOES = 0.3, 32
_RESULTS_KEPT = 1000
_AT_PLACE_M = 0.01
# A hold is repeated at least so long, if robots hold and the commander's state does not have it.
_ASKED_AT_LEAST_S = 3.0
# Beyond what most robots obey, none has heard a station.
_MOST_OBEYED_AHEAD = 10**6

_S = FlightState
T = TypeVar("T")


def is_down(status: RobotStatus) -> bool:
    """Whether it stands on the ground, disarmed as far as it knows; or lies there, killed."""
    if status.state is FlightState.FAULT:
        return status.armed is False
    return status.state in ON_GROUND and not status.armed


class Station:
    """One ground station. `state` is what the fleet is told, by whoever commands it.

    It is None as long as nobody was heard to say anything. One that may not command asks for holds
    alone: robots take nothing else of it.
    """

    def __init__(
        self, setup: FleetSetup, now_s: float, unix_now_s: float, *, may_command: bool = True
    ) -> None:
        self.may_command = may_command
        # What is wrong with this station's own card; None: nothing.
        self.card_problem: CardProblem | None = None
        self.state: GroundState | None = None
        self.commands = False
        # What became of orders, by their id.
        self.results: dict[str, OrderResult] = {}
        # What another station did that ends this one's running commands; "" if nothing.
        self.interruption = ""
        self._now_s, self._unix_now_s = now_s, unix_now_s
        self._setup = setup
        self._worlds = {setup.world_id: setup.world}
        # What somebody sent last that nobody was known to fly over: a state may come behind it.
        self._stray_world = ""
        # By robot id: what each said last.
        self._worlds_of_robots: dict[int, str] = {}
        self._robots = HeardRobots(
            setup.robots,
            self._tell_presence,
            self._tell_state,
        )
        self._echoed_at_s: dict[int, float] = {}
        self._began_s = now_s
        self._heard_s = now_s  # when the commander was
        self._obeyed_since_s: float | None = None
        self._decided = False
        self._name_shared_at_s = -math.inf
        self._ahead_since_s: dict[int, float] = {}
        # The hold that this station asks for while another commands.
        self._asked: Hold | None = None
        self._asked_at_s = -math.inf
        self._orders: dict[str, tuple[Order, float]] = {}
        self._orders_made = 0
        self._expiries_s: dict[tuple[int, int], float] = {}
        # Kills of second programs of one robot: nobody waits for their answers.
        self._more_kills: list[tuple[Order, float]] = []
        self._orders_prefix = f"{setup.operator}-{int(unix_now_s * 1e3)}"
        self._time_base = zlib.crc32(self._orders_prefix.encode()) or 1
        self._arrived: set[int] = set()
        self._remembered: GroundState | None = None
        self._events: deque[GroundEvent] = deque(maxlen=_EVENTS_KEPT)
        self._new_events: list[GroundEvent] = []

    # What it knows

    @property
    def now_s(self) -> float:
        """The time of what happened last."""
        return self._now_s

    @property
    def age_s(self) -> float:
        """How long it has been there, s."""
        return self._now_s - self._began_s

    @property
    def listened(self) -> bool:
        """Whether it has listened long enough to know who commands."""
        if self.state is not None or self._decided:
            return True
        return self.age_s >= LISTEN_S and self._obeyed_since_s is None

    @property
    def operator(self) -> str:
        """This station's name."""
        return self._setup.operator

    @property
    def commander(self) -> str:
        """Station that commands, or did last; "" if none does yet."""
        if self.state is not None:
            return self.state.operator
        named: dict[str, list[int]] = {}
        for status in self.statuses().values():
            if status.operator:
                named.setdefault(status.operator, []).append(status.obeyed_sequence)
        return max(named, key=lambda o: (len(named[o]), max(named[o])), default="")

    @property
    def commander_age_s(self) -> float:
        """How long ago the commander was heard, by this station or by a robot, s.

        0 if that is this station, or nobody.
        """
        commander = self.commander
        if self.commands or not commander:
            return 0.0
        heard_s = self._began_s if self.state is None else self._heard_s
        own_s = self._now_s - heard_s
        told_s = [
            status.ground_age_s
            for status in self.statuses().values()
            if status.operator == commander and status.ground_age_s is not None
        ]
        return min(told_s if told_s and self.state is None else [own_s, *told_s])

    @property
    def shares_name(self) -> bool:
        """Whether another station spoke in this one's name lately."""
        return self._now_s - self._name_shared_at_s <= _LATELY_S

    @property
    def world_id(self) -> str:
        """The fleet's world: what it is told, or else what most robots have."""
        told = None if self.state is None else self.state.world_id
        return told or _commonest(self._worlds_of_robots.values()) or self._setup.world_id

    @property
    def setup(self) -> FleetSetup:
        """As it is now: the world, and who sits where, change."""
        setup, world = self._setup, self.world_id
        if world != setup.world_id:
            # A wrong text would be shown as if it were the robots'.
            setup = replace(setup, world=self._text_of(world), world_id=world)
        places = {} if self.state is None else self.state.places
        if not places:
            return setup
        names = self._robots.names
        seated = {place.slot: (names.get(int(r), ""), place) for r, place in places.items()}
        slots = []
        for slot in setup.slots:
            robot, place = slot.robot, slot.place
            if slot.place.slot in seated:
                robot, place = seated[slot.place.slot]
            elif robot and str(setup.robots[robot]) in places:
                robot = ""  # It was given another place.
            slots.append(replace(slot, place=place, robot=robot))
        return replace(setup, slots=tuple(slots))

    @property
    def flying(self) -> tuple[str, ...]:
        """The robots that sit in a slot, in the order of the slots."""
        return tuple(slot.robot for slot in self.setup.slots if slot.robot)

    def statuses(self) -> dict[int, RobotStatus]:
        """The newest of each robot that was heard within `FRESH_S`, by robot id."""
        return self._robots.statuses(self._now_s)

    def status(self, name: str) -> RobotStatus | None:
        """The robot's newest, if it was heard within `FRESH_S`."""
        return self._robots.status(self._setup.robots[name], self._now_s)

    def lately(self, name: str) -> RobotStatus | None:
        """The robot's newest, if it was heard within 10 s: a bad link is silent for seconds."""
        last = self._robots.last(self._setup.robots[name], self._now_s)
        return last[0] if last is not None and last[1] <= _LATELY_S else None

    def is_duplicate(self, name: str) -> bool:
        """Whether two programs say that they are this robot."""
        return self._robots.is_duplicate(self._setup.robots[name])

    def snapshot(self, running: tuple[str, ...] = ()) -> FleetSnapshot:
        """All of it, for the clients; `running` are the commands that run."""
        return FleetSnapshot(
            unix_time_s=self._unix_now_s,
            commander=self.commander,
            ground=self.state,
            robots=self._robots.snapshots(self._now_s),
            running=running,
            commander_age_s=self.commander_age_s,
            shares_name=self.shares_name,
        )

    # Events

    def tell(
        self,
        kind: EventKind,
        robot: str,
        text: str,
        operator: str = "",
        state: FlightState | None = None,
    ) -> None:
        """Keep an event for the clients."""
        trial = "" if self.state is None else self.state.trial
        event = GroundEvent(self._unix_now_s, kind, robot, text, operator, trial, state)
        self._events.append(event)
        self._new_events.append(event)

    def _tell_presence(self, robot: str, text: str) -> None:
        self.tell("presence", robot, text)

    def _tell_state(self, robot: str, state: FlightState, text: str) -> None:
        self.tell("state", robot, text, state=state)

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
        self._now_s, self._unix_now_s = now_s, unix_now_s

    def hear_twice(self, robots: frozenset[int]) -> None:
        """These robots' keys speak twice now, by robot id."""
        self._robots.said_twice = robots

    def hear_status(self, status: RobotStatus) -> None:
        """A robot's status came. One that is not of this fleet is nobody's."""
        if self._robots.hear(status, self._now_s, self._unix_now_s):
            self._worlds_of_robots[status.robot_id] = status.world_id
            self._settle_orders(status)
            self._look_who_is_obeyed(status)

    def _settle_orders(self, status: RobotStatus) -> None:
        answers = {answer.order_id: answer for answer in status.orders}
        for order_id, (order, _) in list(self._orders.items()):
            if order.robot_id != status.robot_id:
                continue
            if status.boot_nonce != order.boot_nonce:
                self._refuse(order_id, RefusalCode.STARTED_AGAIN, "its program has started again")
            elif order_id in answers:
                self._settle(answers[order_id])
            elif status.uptime_s > order.expires_at_uptime_s:
                self._refuse(order_id, RefusalCode.NOT_ANSWERED, "it did not answer")

    def _refuse(self, order_id: str, code: RefusalCode, text: str) -> None:
        self._settle(OrderResult(order_id, Refusal(code, text)))

    def _settle(self, result: OrderResult) -> None:
        del self._orders[result.order_id]
        self.results[result.order_id] = result
        while len(self.results) > _RESULTS_KEPT:
            del self.results[next(iter(self.results))]

    def _look_who_is_obeyed(self, status: RobotStatus) -> None:
        """A robot may obey what this station does not know of: its former life, or another one."""
        state = self.state
        obeyed = status.obeyed_sequence, status.operator
        own = status.operator == self.operator
        # Who obeys a station that is gone does so no longer than it takes to hear this one.
        heard = own or _hears_ground(status)
        if not self.commands or state is None or obeyed <= _rank(state) or not heard:
            self._ahead_since_s.pop(status.robot_id, None)
            return
        # Another commander mostly comes here too.
        self._ahead_since_s.setdefault(status.robot_id, self._now_s)
        ahead = self._ahead_of(state)
        if 2 * len(ahead) <= len(self.statuses()):
            return
        operator = _commonest(told.operator for told in ahead)
        if operator in (None, self.operator):
            self.state = replace(state, sequence=self._greatest_obeyed() + 1)
            return
        self._step_down(operator)
        self._tell_commander(operator)
        # What the other one wants is not known.
        self.state, self._decided = None, True

    def _ahead_of(self, state: GroundState) -> list[RobotStatus]:
        """Robots that have obeyed something beyond that state for a while."""
        return [
            status
            for robot, status in self.statuses().items()
            if self._now_s - self._ahead_since_s.get(robot, self._now_s) > _OVERTAKEN_S
            and (status.obeyed_sequence, status.operator) > _rank(state)
        ]

    def _step_down(self, operator: str) -> None:
        """Another station commands from now on."""
        self.commands = False
        self._ahead_since_s.clear()
        self.interruption = f"{operator} commands the fleet"
        for order, _ in tuple(self._orders.values()):
            if order.kind != "kill":
                self._refuse(order.order_id, RefusalCode.INTERRUPTED, self.interruption)

    def hear_state(self, state: GroundState, speaker: Speaker) -> None:
        """Another station's state came. It counts if its operator's key signed it."""
        if speaker.name not in ("", state.operator) or speaker.role is not Role.OPERATOR:
            return
        if state.operator == self.operator:
            own = self.state
            if self.commands and own is not None and state.sequence <= own.sequence:
                return  # Of this station's former life.
            self._tell_shared_name()
        before = self.state
        silent = not self.commands and self.commander_age_s > COMMANDER_SILENT_S
        if before is not None and _rank(state) < _rank(before) and not silent:
            return
        if self.commands:
            self._step_down(state.operator)
        if before is None or before.operator != state.operator:
            self._tell_commander(state.operator)
        elif before.sequence != state.sequence:
            by = state.safety_action_by if _is_safer(before, state) else ""
            self._tell_changes(before, state, by or state.operator)
        self.state, self.commands, self._heard_s = state, False, self._now_s

    def hear_hold(self, hold: Hold, speaker: Speaker) -> None:
        """Another station asks for a hold: the commander takes it up."""
        own = self.state
        if not self.commands or own is None or speaker.name not in ("", hold.by):
            return
        if hold.by == self.operator or _holds(own, hold):
            return
        held = _held(own, hold)
        self._tell_changes(own, held, hold.by)
        self.interruption = f"{hold.by} commands hold"
        self.state = replace(held, sequence=own.sequence + 1)

    def _tell_shared_name(self) -> None:
        if not self.shares_name:
            text = "another ground station has this one's name: give one another with --name"
            self.tell("commander", "", text, self.operator)
        self._name_shared_at_s = self._now_s

    def _tell_commander(self, operator: str) -> None:
        self.tell("commander", "", f"{operator} commands the fleet", operator)

    def _tell_changes(self, before: GroundState, after: GroundState, by: str) -> None:
        for text in changes_in_words(before, after):
            self.tell("command", "", text, by)

    def tick(self) -> None:
        """Time has passed: see who fell silent, and what is to be done by itself."""
        self._robots.look(self._now_s)
        for order_id, (_, made_s) in list(self._orders.items()):
            if self._now_s - made_s > ORDER_LIFETIME_S + 1.0:
                self._refuse(order_id, RefusalCode.NOT_ANSWERED, "it did not answer")
        self._more_kills = [
            (order, made_s)
            for order, made_s in self._more_kills
            if self._now_s - made_s <= ORDER_LIFETIME_S
        ]
        self._listen()
        if self._asked is not None:
            self._end_asking(self._asked)
        if self.commands:
            self._bring_home()

    def _listen(self) -> None:
        """Find out who commands robots that obey somebody; take those that were left alone."""
        if self.state is not None or self._decided or not self.commander:
            self._obeyed_since_s = None
            return
        if self._obeyed_since_s is None:
            self._obeyed_since_s = self._now_s
        listened_s = self._now_s - self._obeyed_since_s
        if listened_s < LISTEN_S:
            return
        if self._own_name_age_s() < _SPOKE_S:
            if listened_s > _NAME_TAKEN_S:
                self._tell_shared_name()
                self._decided = True
            return
        self._decided = True
        if not self.may_command:
            return
        # The robots' ages tell of a commander that this station does not hear, but they do.
        if self.commander == self.operator or self.commander_age_s > _ROBOTS_HEAR_NOBODY_S:
            self.take_command()

    def _own_name_age_s(self) -> float:
        """How long ago most robots had heard a station of this name; infinite if not, s."""
        lasts = (self._robots.last(robot, self._now_s) for robot in self.statuses())
        ages_s = [
            status.ground_age_s + age_s
            if status.operator == self.operator and status.ground_age_s is not None
            else math.inf
            for status, age_s in filter(None, lasts)
        ]
        return statistics.median_high(ages_s) if ages_s else math.inf

    # Who commands

    def take_command(self) -> None:
        """Command from now on, with what the fleet is told already."""
        if self.commands:
            return
        before = self._known_state()
        obeyed = self._greatest_obeyed()
        by = before.safety_action_by or before.operator
        self.state = replace(
            before,
            sequence=max(before.sequence, obeyed) + 1,
            operator=self.operator,
            safety_action_by="" if by == self.operator or before.safety_action == "none" else by,
        )
        self.commands = True
        self._asked = None
        self._tell_commander(self.operator)

    def _greatest_obeyed(self) -> int:
        """As far as that can be: no robot alone makes it so great that no state goes beyond."""
        return min(
            max((s.obeyed_sequence for s in self.statuses().values()), default=0),
            self._obeyed_by_most() + _MOST_OBEYED_AHEAD,
        )

    def _obeyed_by_most(self) -> int:
        obeyed = [s.obeyed_sequence for s in self.statuses().values()]
        return max(statistics.median_low(obeyed), 0) if obeyed else 0

    def _known_state(self) -> GroundState:
        """State of the fleet: as last heard, remembered, or seen in the robots."""
        if self.state is not None:
            return self.state
        obeyed = [(s.obeyed_sequence, s.operator) for s in self.statuses().values() if s.operator]
        remembered = self._remembered
        if remembered is not None and _rank(remembered) == max(obeyed, default=None):
            return remembered
        return self._state_of_robots()

    def remember(self, state: GroundState) -> None:
        """Take the last process's state: it counts if robots still obey just that."""
        self._remembered = state

    def _state_of_robots(self) -> GroundState:
        """State by a station that is not heard, as far as the robots show it."""
        statuses = [s for s in self.statuses().values() if s.operator]
        idle = {str(s.robot_id): False for s in statuses if s.state is _S.IDLE}
        # Who is not heard yet may be in the air.
        enabled = bool(statuses) and len(idle) < len(self._setup.robots)
        # Of two fences that as many have, the configured one is not what the ground asked for.
        fences = sorted((s.fence for s in statuses), key=lambda fence: fence == self._setup.fence)
        fence = _commonest(fences)
        return GroundState(
            sequence=0,
            operator=self.commander or self.operator,
            origin=_commonest(s.origin for s in statuses),
            enabled=enabled,
            robot_enabled=idle if enabled else {},
            fence=None if fence == self._setup.fence else fence,
            places=self._places_of(statuses),
            world_id=_commonest(s.world_id for s in statuses),
            trial=_commonest(s.trial for s in statuses) or "",
        )

    def _places_of(self, statuses: Iterable[RobotStatus]) -> dict[str, Place]:
        """The places of those that do not have their configured one."""
        setup = self._setup
        configured = {setup.robots[s.robot]: s.place for s in setup.slots if s.robot}
        places = {}
        for status in statuses:
            above_m = status.slot_height_m - setup.base_height_m
            try:
                place = Place(max(0, round(above_m / setup.slot_spacing_m)), status.landing_point_m)
            except ValueError:  # It says what no place is.
                continue
            known = configured.get(status.robot_id)
            if known is None or known.slot != place.slot or not _is_at(status, known):
                places[str(status.robot_id)] = place
        return places

    # What it wants

    def change(self, **changes: object) -> int:
        """Want something else of the fleet; the state's sequence. Takes the command."""
        self.take_command()
        assert self.state is not None
        after = replace(self.state, **changes)  # type: ignore[arg-type]
        if after != self.state:
            self.state = replace(after, sequence=self.state.sequence + 1)
        return self.state.sequence

    def safety_action(
        self, safety_action: SafetyAction, robots: Collection[int] | None = None
    ) -> int:
        """Ask the fleet, or these robots alone, to hold,
        return or land; "none" withdraws it. The sequence."""
        self.take_command()
        assert self.state is not None
        these = frozenset(self._robots.names if robots is None else robots)
        self._arrived -= these
        if robots is None:
            return self.change(
                safety_action=safety_action,
                safety_action_by="",
                robot_safety_actions={},
                waiting=(),
            )
        asked: dict[str, SafetyAction] = dict.fromkeys(map(str, sorted(robots)), safety_action)
        asked = {
            r: c
            for r, c in (self.state.robot_safety_actions | asked).items()
            if c != self.state.safety_action
        }
        waiting = tuple(r for r in self.state.waiting if r not in these)
        return self.change(safety_action_by="", robot_safety_actions=asked, waiting=waiting)

    def hold(self, robots: Collection[int] | None = None) -> int:
        """Hold, whoever commands; the least sequence that robots obey then."""
        lost = self.commander_age_s > COMMANDER_SILENT_S
        if self.may_command and (self.commands or not self.commander or lost):
            return self._hold_as_commander(robots)
        before = self._asked
        of_all = robots is None or (before is not None and not before.robots)
        these = {*(robots or ()), *(before.robots if before is not None else ())}
        self._asked = Hold(self.operator, () if of_all else tuple(sorted(these)))
        self._asked_at_s = self._now_s
        return 0

    def _hold_as_commander(self, robots: Collection[int] | None) -> int:
        self.safety_action("hold", robots)
        assert self.state is not None
        # Robots may obey somebody who took over without being heard here.
        others = (s for s in self.statuses().values() if s.operator != self.operator)
        beyond = max((s.obeyed_sequence for s in others), default=0)
        beyond = min(beyond, self._greatest_obeyed()) + 1
        self.state = replace(self.state, sequence=max(self.state.sequence, beyond))
        return self.state.sequence

    def _end_asking(self, asked: Hold) -> None:
        """The commander takes the hold up, or is gone, or is out of reach of this station."""
        if self.may_command and self.commander_age_s > COMMANDER_SILENT_S:
            self.take_command()
            assert self.state is not None
            self.state = replace(
                _held(self.state, asked), sequence=self.state.sequence + 1, safety_action_by=""
            )
            return
        taken_up = self.state is not None and _holds(self.state, asked)
        all_hold = all(
            status.state is _S.HOLD or is_down(status)
            for robot, status in self.statuses().items()
            if asked.is_of(robot)
        )
        if taken_up or (all_hold and self._now_s - self._asked_at_s > _ASKED_AT_LEAST_S):
            self._asked = None

    def _bring_home(self) -> None:
        """Keep robots over their landing points waiting while somebody lower still flies home."""
        state = self.state
        assert state is not None
        asked_home = {r for r in self._robots.names if state.safety_action_for(r) == "return"}
        returning = asked_home.union(state.waiting)
        if not returning:
            return
        statuses = {r: s for r, s in self.statuses().items() if r in returning}
        self._arrived |= {r for r, status in statuses.items() if is_over_landing_point(status)}
        waiting = waiting_to_land(statuses, self._arrived)
        # Who is not heard, or may have somebody below who was not heard yet, waits on.
        waiting |= {r for r in state.waiting if self.age_s < _GATHER_S or r not in statuses}
        asked: dict[str, SafetyAction] = {
            r: c for r, c in state.robot_safety_actions.items() if int(r) not in returning
        }
        for robot in sorted(returning):
            if robot in waiting:
                asked[str(robot)] = "hold"
            elif state.safety_action != "return":
                asked[str(robot)] = "return"
        self.change(robot_safety_actions=asked, waiting=tuple(sorted(waiting)))

    def set_world(self, text: str) -> int:
        """Want that world of the robots; the sequence."""
        self.remember_world(text)
        return self.change(world_id=world_id(text))

    def hear_world(self, text: str) -> None:
        """Another station sends it to the robots; what nobody flies over is soon forgotten."""
        if world_id(text) in (self.world_id, *self._worlds_of_robots.values()):
            self.remember_world(text)
        else:
            self._stray_world = text

    def remember_world(self, text: str) -> None:
        """It may be the one that the robots have."""
        self._worlds[world_id(text)] = text

    def _text_of(self, world: str) -> str:
        """The text of a world, "" if it is not known."""
        if self._stray_world and world_id(self._stray_world) == world:
            self.remember_world(self._stray_world)
        return self._worlds.get(world, "")

    # Orders

    def order(self, kind: OrderKind, name: str, trial: str = "") -> str | None:
        """Order something once; the order's id, for `results`. None if the robot was never heard.

        One that was silent since counts its uptime on.
        """
        last = self._robots.last(self._setup.robots[name], self._now_s)
        if last is None:
            return None
        order = self._new_order(kind, *last, trial)
        self._orders[order.order_id] = order, self._now_s
        if kind == "kill":
            others = self._robots.others(order.robot_id, self._now_s)
            self._more_kills += [(self._new_order(kind, *o, trial), self._now_s) for o in others]
        return order.order_id

    def _new_order(self, kind: OrderKind, status: RobotStatus, age_s: float, trial: str) -> Order:
        """For the program that said the status so long ago."""
        self._orders_made += 1
        program = status.robot_id, status.boot_nonce
        expiry_s = max(
            status.uptime_s + age_s + ORDER_LIFETIME_S - _EXPIRY_MARGIN_S,
            self._expiries_s.get(program, -math.inf) + _LATER_S,
        )
        self._expiries_s[program] = expiry_s
        return Order(
            order_id=f"{self._orders_prefix}-{self._orders_made}",
            robot_id=status.robot_id,
            boot_nonce=status.boot_nonce,
            kind=kind,
            expires_at_uptime_s=expiry_s,
            operator=self.operator,
            trial=trial,
        )

    def withdraw(self, order_id: str) -> None:
        """Say an order no more, if it is open."""
        self._orders.pop(order_id, None)

    # What is to be published, a few times a second

    @property
    def published_hold(self) -> Hold | None:
        """The hold to ask for; None: none is."""
        return self._asked

    def published_state(self) -> GroundState | None:
        """None: nothing is. In large fleets robots are echoed in turns, from call to call."""
        if not self.commands or self.state is None:
            return None
        return replace(
            self.state,
            unix_time_s=self._unix_now_s,
            time_base=self._time_base,
            time_s=self._now_s,
            echoes=self._echoes(),
        )

    def _echoes(self) -> dict[str, Echo]:
        fresh = {}
        for robot in self._robots.names:
            last = self._robots.last(robot, self._now_s)
            if last is not None and last[1] <= _ECHOED_S:
                fresh[robot] = last
        # Whose turn was longest ago.
        turns = sorted(fresh, key=lambda robot: self._echoed_at_s.get(robot, -math.inf))
        echoes = {}
        for robot in turns[:_MOST_ECHOES]:
            status, held_s = fresh[robot]
            self._echoed_at_s[robot] = self._now_s
            echoes[str(robot)] = Echo(
                status.boot_nonce, round(status.uptime_s, 4), round(held_s, 4)
            )
        return echoes

    def published_orders(self) -> tuple[Order, ...]:
        """Those that are not answered."""
        return tuple(order for order, _ in (*self._orders.values(), *self._more_kills))

    def published_world(self) -> str | None:
        """The world's text, while a robot on the ground lacks it, and may have use for it."""
        wanted = self.state.world_id if self.commands and self.state else None
        text = "" if wanted is None else self._text_of(wanted)
        if not text:
            return None
        lacking = any(
            s.world_id != wanted
            and s.state in ON_GROUND
            and all(each.code is not CheckCode.WORLD_UNUSABLE for each in s.not_taken)
            for s in self.statuses().values()
        )
        return text if lacking else None


def changes_in_words(before: GroundState, after: GroundState) -> list[str]:
    """Describe what the ground newly wants, for people."""
    words: list[str] = []
    if (before.safety_action, before.robot_safety_actions) != (
        after.safety_action,
        after.robot_safety_actions,
    ):
        if _is_safer(before, after):
            words.append(
                next(
                    c
                    for c in (after.safety_action, *after.robot_safety_actions.values())
                    if c != "none"
                )
            )
        else:
            words.append("resume")
    if (before.enabled, before.robot_enabled) != (after.enabled, after.robot_enabled):
        words.append("enable" if after.enabled or any(after.robot_enabled.values()) else "disable")
    words += [
        name
        for name in ("origin", "fence", "places")
        if getattr(before, name) != getattr(after, name)
    ]
    if before.world_id != after.world_id:
        words.append(f"world {after.world_id}")
    if before.trial != after.trial:
        words.append(f"trial {after.trial}")
    return words


def next_trial(trial: str) -> str:
    """The name after this one: "t1", "t2", ..."""
    match = re.fullmatch(r"(.*?)(\d+)", trial)
    if match is None:
        return f"{trial}2" if trial else "t1"
    return f"{match[1]}{int(match[2]) + 1}"


def _rank(state: GroundState) -> tuple[int, str]:
    """Of two states, robots obey that of the greater rank."""
    return state.sequence, state.operator


def _hears_ground(status: RobotStatus) -> bool:
    """Whether somebody still says what the robot obeys."""
    return status.ground_age_s is not None and status.ground_age_s <= _ROBOTS_HEAR_NOBODY_S


def _commonest(values: Iterable[T | None]) -> T | None:
    """Value of most of those that have one; of equals the first."""
    said = Counter(value for value in values if value)
    return max(said, key=said.__getitem__, default=None)


def _is_at(status: RobotStatus, place: Place) -> bool:
    return math.dist(status.landing_point_m, place.landing_point_m) < _AT_PLACE_M


def _held(state: GroundState, hold: Hold) -> GroundState:
    """The state with that hold, and nothing else of it."""
    if not hold.robots:
        return replace(
            state,
            safety_action="hold",
            robot_safety_actions={},
            safety_action_by=hold.by,
            waiting=(),
        )
    held: dict[str, SafetyAction] = dict.fromkeys(map(str, hold.robots), "hold")
    waiting = tuple(robot for robot in state.waiting if robot not in hold.robots)
    return replace(
        state,
        robot_safety_actions=state.robot_safety_actions | held,
        safety_action_by=hold.by,
        waiting=waiting,
    )


def _holds(state: GroundState, hold: Hold) -> bool:
    """Whether the state has that hold."""
    if not hold.robots:
        actions = {state.safety_action, *state.robot_safety_actions.values()}
        return actions == {"hold"} and not state.waiting
    return all(
        state.safety_action_for(robot) == "hold" and robot not in state.waiting
        for robot in hold.robots
    )


def _is_safer(before: GroundState, after: GroundState) -> bool:
    """Whether more is asked to hold, to return or to land than before."""
    if after.safety_action not in ("none", before.safety_action):
        return True
    return any(
        c != "none" and before.safety_action_for(int(r)) != c
        for r, c in after.robot_safety_actions.items()
    )
