"""What a ground station wants of its fleet, and who commands it.

Pure: time is passed in, messages are handed in, and what is to be published is asked for. One
thread at a time.

Of several stations one commands: its name is the `operator` of the state that the robots obey, and
it alone changes that state. The others observe. Only hold is everybody's: an observer publishes
the commander's own state with hold in it and the next sequence, until the commander says so itself.
"""

import math
import re
from collections import Counter, deque
from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import Literal, TypeVar

from edge.core.mission import (
    ON_GROUND,
    ORDER_LIFETIME_S,
    Calm,
    FlightState,
    GroundState,
    Order,
    OrderKind,
    OrderResult,
    Place,
    RobotStatus,
    is_over_landing_point,
    waiting_to_land,
    world_id,
)
from ground.heard import FRESH_S, HeardRobots
from ground.protocol import Event, Picture, Setup

# Before it says anything, a station listens: who commands, whom do the robots obey?
LISTEN_S = 0.7
# A commander that was silent for longer is gone.
COMMANDER_SILENT_S = 2.0
# ... also if robots say so, who hear what this station may not.
_ROBOTS_HEAR_NOBODY_S = 1.0
_OVERTAKEN_S = 1.0
_LATELY_S = 10.0
_EVENTS_KEPT = 200
_AT_PLACE_M = 0.01

EventKind = Literal["command", "result", "refusal", "state", "commander", "presence"]

_S = FlightState
T = TypeVar("T")


class NameTakenError(ValueError):
    """Another station has this one's name; the text says what to do."""


def is_down(status: RobotStatus) -> bool:
    """Whether it stands on the ground, disarmed as far as it knows."""
    return status.state in ON_GROUND and not status.armed


class Station:
    """One ground station. `state` is what the fleet is told, by whoever commands it.

    It is None as long as nobody was heard to say anything.
    """

    def __init__(self, setup: Setup, now_s: float, unix_now_s: float) -> None:
        self.state: GroundState | None = None
        self.commands = False
        # What became of orders, by their id.
        self.results: dict[str, OrderResult] = {}
        # What another station did that ends this one's running commands; "" if nothing.
        self.interruption = ""
        self._now_s, self._unix_now_s = now_s, unix_now_s
        self._setup = setup
        self._worlds = {setup.world_id: setup.world}
        self._robots = HeardRobots(
            setup.robots,
            lambda robot, text: self.tell("presence", robot, text),
            lambda robot, text: self.tell("state", robot, text),
        )
        self._began_s = now_s
        self._heard_s = now_s  # when the commander was
        self._obeyed_since_s: float | None = None
        self._decided = False
        self._ahead_since_s: dict[int, float] = {}
        # The hold that this station asks for while another commands.
        self._asked: GroundState | None = None
        self._orders: dict[str, tuple[Order, float]] = {}
        self._orders_made = 0
        self._orders_prefix = f"{setup.operator}-{int(unix_now_s * 1e3)}"
        self._returning: frozenset[int] = frozenset()
        self._arrived: set[int] = set()
        self._events: deque[Event] = deque(maxlen=_EVENTS_KEPT)
        self._new_events: list[Event] = []

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
        """Who commands, or did last; "" if nobody does yet."""
        if self.state is not None:
            return self.state.operator
        statuses = self.statuses().values()
        newest = max(statuses, key=lambda status: status.obeyed_sequence, default=None)
        return "" if newest is None else newest.operator

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
        if self._asked is not None and self.state is not None:
            # The robots hear this station, in the commander's name.
            return own_s
        told_s = [
            status.ground_age_s
            for status in self.statuses().values()
            if status.operator == commander and status.ground_age_s is not None
        ]
        return min(told_s if told_s and self.state is None else [own_s, *told_s])

    @property
    def setup(self) -> Setup:
        """As it is now: the world, and who sits where, change."""
        places = {} if self.state is None else self.state.places
        if not places:
            return self._setup
        names = self._robots.names
        seated = {place.slot: (names.get(int(r), ""), place) for r, place in places.items()}
        slots = []
        for slot in self._setup.slots:
            robot, place = slot.robot, slot.place
            if slot.place.slot in seated:
                robot, place = seated[slot.place.slot]
            elif robot and str(self._setup.robots[robot]) in places:
                robot = ""  # It was given another place.
            slots.append(replace(slot, place=place, robot=robot))
        return replace(self._setup, slots=tuple(slots))

    @property
    def flying(self) -> tuple[str, ...]:
        """The robots that sit in a slot, in the order of the slots."""
        return tuple(slot.robot for slot in self.setup.slots if slot.robot)

    def statuses(self) -> dict[int, RobotStatus]:
        """The newest of each robot that was heard within 2 s, by robot id."""
        return self._robots.statuses(self._now_s)

    def status(self, name: str) -> RobotStatus | None:
        """The robot's newest, if it was heard within 2 s."""
        return self._robots.status(self._setup.robots[name], self._now_s)

    def lately(self, name: str) -> RobotStatus | None:
        """The robot's newest, if it was heard within 10 s: a bad link is silent for seconds."""
        last = self._robots.last(self._setup.robots[name], self._now_s)
        return last[0] if last is not None and last[1] <= _LATELY_S else None

    def is_duplicate(self, name: str) -> bool:
        """Whether two programs say that they are this robot."""
        return self._robots.is_duplicate(self._setup.robots[name])

    def picture(self, running: tuple[str, ...] = ()) -> Picture:
        """All of it, for the clients; `running` are the commands that run."""
        return Picture(
            unix_time_s=self._unix_now_s,
            commander=self.commander,
            ground=self.state,
            robots=self._robots.pictures(self._now_s),
            running=running,
            commander_age_s=self.commander_age_s,
        )

    # Events

    def tell(self, kind: EventKind, robot: str, text: str, operator: str = "") -> None:
        """Keep an event for the clients."""
        trial = "" if self.state is None else self.state.trial
        event = Event(self._unix_now_s, kind, robot, text, operator, trial)
        self._events.append(event)
        self._new_events.append(event)

    @property
    def last_events(self) -> tuple[Event, ...]:
        """The last of them, in order."""
        return tuple(self._events)

    def new_events(self) -> list[Event]:
        """Those since the last call."""
        events, self._new_events = self._new_events, []
        return events

    # What it hears

    def set_time(self, now_s: float, unix_now_s: float) -> None:
        """It is now so late; everything else follows."""
        self._now_s, self._unix_now_s = now_s, unix_now_s

    def hear_status(self, status: RobotStatus) -> None:
        """A robot's status came. One that is not of this fleet is nobody's."""
        if self._robots.hear(status, self._now_s, self._unix_now_s):
            self._settle_orders(status)
            self._look_who_is_obeyed(status)

    def _settle_orders(self, status: RobotStatus) -> None:
        answers = {answer.order_id: answer for answer in status.orders}
        for order_id, (order, _) in list(self._orders.items()):
            if order.robot_id != status.robot_id:
                continue
            if status.boot_nonce != order.boot_nonce:
                self._settle(OrderResult(order_id, False, "its program has started again"))
            elif order_id in answers:
                self._settle(answers[order_id])
            elif status.uptime_s > order.expires_at_uptime_s:
                self._settle(OrderResult(order_id, False, "it did not answer"))

    def _settle(self, result: OrderResult) -> None:
        del self._orders[result.order_id]
        self.results[result.order_id] = result

    def _look_who_is_obeyed(self, status: RobotStatus) -> None:
        """A robot may have obeyed this station's former life, which said more than is known."""
        state = self.state
        if (
            not self.commands
            or state is None
            or status.operator != state.operator
            or status.obeyed_sequence <= state.sequence
        ):
            self._ahead_since_s.pop(status.robot_id, None)
            return
        # It may also obey an observer's hold, which comes here too.
        since_s = self._ahead_since_s.setdefault(status.robot_id, self._now_s)
        if self._now_s - since_s > _OVERTAKEN_S:
            self.state = replace(state, sequence=status.obeyed_sequence + 1)

    def hear_state(self, state: GroundState) -> None:
        """Another station's state came. Raises NameTakenError if it has this one's name."""
        if state.operator == self.operator:
            self._hear_own_name(state)
            return
        before = self.state
        silent = not self.commands and self.commander_age_s > COMMANDER_SILENT_S
        if before is not None and _rank(state) < _rank(before) and not silent:
            return
        if before is None or before.operator != state.operator:
            if self.commands:
                self.interruption = f"{state.operator} commands the fleet"
                for order, _ in tuple(self._orders.values()):
                    if order.kind != "kill":
                        self._settle(OrderResult(order.order_id, False, self.interruption))
            self._tell_commander(state.operator)
        elif before.sequence != state.sequence:
            by = state.calm_by if _is_calmed(before, state) else ""
            self._tell_changes(before, state, by or state.operator)
        self.state, self.commands, self._heard_s = state, False, self._now_s
        self._keep_world_of(state)
        if self._asked is not None and state.sequence >= self._asked.sequence:
            held = _holds_as(state, self._asked)
            asked = replace(_with_hold_of(state, self._asked), sequence=state.sequence + 1)
            self._asked = None if held else asked

    def _hear_own_name(self, state: GroundState) -> None:
        """It is an observer's hold, or somebody else has this name."""
        own = self.state
        by_observer = state.calm_by not in ("", self.operator)
        if not self.commands or own is None:
            # An observer that goes on with the state of this station's former life soon ends.
            if not by_observer:
                raise self._name_taken()
            return
        if state.sequence < own.sequence or (state.sequence == own.sequence and not by_observer):
            return
        if not by_observer:
            raise self._name_taken()
        after = replace(_with_hold_of(own, state), sequence=state.sequence + 1)
        self._tell_changes(own, after, state.calm_by)
        self.interruption = f"{state.calm_by} commands hold"
        self.state = after
        self._returning = self._returning_by(after)

    def _name_taken(self) -> NameTakenError:
        return NameTakenError(
            f"another ground station commands this fleet as {self.operator}: give this one "
            "another name with --name"
        )

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
                self._settle(OrderResult(order_id, False, "it did not answer"))
        self._listen()
        if self._asked is not None:
            self._end_asking(self._asked)
        if self.commands:
            self._bring_home()

    def _listen(self) -> None:
        """Find out who commands robots that obey somebody; take those that were left alone."""
        obeyed = {s.operator for s in self.statuses().values() if s.operator}
        if self.state is not None or self._decided or not obeyed:
            self._obeyed_since_s = None
            return
        if self._obeyed_since_s is None:
            self._obeyed_since_s = self._now_s
        if self._now_s - self._obeyed_since_s < LISTEN_S:
            return
        self._decided = True
        # The robots' ages tell of a commander that this station does not hear, but they do.
        if obeyed == {self.operator} or self.commander_age_s > _ROBOTS_HEAR_NOBODY_S:
            self.take_command()

    # Who commands

    def take_command(self) -> None:
        """Command from now on, with what the fleet is told already."""
        if self.commands:
            return
        before = self.state or self._state_of_robots()
        obeyed = max((s.obeyed_sequence for s in self.statuses().values()), default=0)
        by = before.calm_by or before.operator
        self.state = replace(
            before,
            sequence=max(before.sequence, obeyed) + 1,
            operator=self.operator,
            calm_by="" if by == self.operator or before.calm == "none" else by,
        )
        self.commands = True
        self._asked = None
        self._returning = self._returning_by(self.state)
        self._keep_world_of(self.state)
        self._tell_commander(self.operator)

    def _state_of_robots(self) -> GroundState:
        """What the robots were told by a station that is not heard, as far as they show it."""
        statuses = [s for s in self.statuses().values() if s.operator]
        enabled = any(s.state not in (_S.INIT, _S.IDLE) for s in statuses)
        idle = {str(s.robot_id): False for s in statuses if s.state is _S.IDLE}
        fence = _agreed(s.fence for s in statuses)
        return GroundState(
            sequence=0,
            operator=self.commander or self.operator,
            origin=_agreed(s.origin for s in statuses),
            enabled=enabled,
            robot_enabled=idle if enabled else {},
            fence=None if fence == self._setup.fence else fence,
            places=self._places_of(statuses),
            world_id=_commonest(s.world_id for s in statuses),
            trial=_commonest(s.trial for s in statuses if s.trial) or "",
        )

    def _places_of(self, statuses: Iterable[RobotStatus]) -> dict[str, Place]:
        """The places of those that do not have their configured one."""
        setup = self._setup
        configured = {setup.robots[s.robot]: s.place for s in setup.slots if s.robot}
        places = {}
        for status in statuses:
            above_m = status.slot_height_m - setup.base_height_m
            place = Place(max(0, round(above_m / setup.slot_spacing_m)), status.landing_point_m)
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

    def calm(self, calm: Calm, robots: Collection[int] | None = None) -> int:
        """Ask calm of the fleet, or of these robots alone; "none" withdraws it. The sequence."""
        self.take_command()
        assert self.state is not None
        these = frozenset(self._robots.names if robots is None else robots)
        self._arrived -= these
        self._returning = self._returning | these if calm == "return" else self._returning - these
        if robots is None:
            return self.change(calm=calm, calm_by="", robot_calm={})
        asked: dict[str, Calm] = dict.fromkeys(map(str, sorted(robots)), calm)
        asked = {r: c for r, c in (self.state.robot_calm | asked).items() if c != self.state.calm}
        return self.change(calm_by="", robot_calm=asked)

    def hold(self, robots: Collection[int] | None = None) -> int:
        """Hold, whoever commands; the sequence that says so."""
        lost = self.commander_age_s > COMMANDER_SILENT_S
        if self.commands or not self.commander or lost:
            return self.calm("hold", robots)
        state = self._asked or self.state or self._state_of_robots()
        obeyed = max((s.obeyed_sequence for s in self.statuses().values()), default=0)
        asked = replace(state, calm_by=self.operator, sequence=max(state.sequence, obeyed) + 1)
        held: dict[str, Calm] = {str(robot): "hold" for robot in robots or ()}
        if robots is None:
            asked = replace(asked, calm="hold", robot_calm={})
        else:
            asked = replace(asked, robot_calm=state.robot_calm | held)
        self._asked = asked
        return asked.sequence

    def _end_asking(self, asked: GroundState) -> None:
        """The commander takes the hold up, or is gone, or is out of reach of this station."""
        if self.commander_age_s > COMMANDER_SILENT_S:
            self.take_command()
            self.change(calm=asked.calm, calm_by="", robot_calm=asked.robot_calm)
            self._returning = frozenset()
        elif self.state is None and all(
            s.obeyed_sequence >= asked.sequence for s in self.statuses().values() if s.operator
        ):
            self._asked = None

    def _returning_by(self, state: GroundState) -> frozenset[int]:
        """Who returns according to the state; who waits for that above its landing point, too."""
        robots = self._robots.names
        asked = {robot for robot in robots if state.calm_for(robot) == "return"}
        waiting = {
            robot
            for robot, status in self.statuses().items()
            if state.robot_calm.get(str(robot)) == "hold" and is_over_landing_point(status)
        }
        return frozenset(asked | waiting) if asked else frozenset()

    def _bring_home(self) -> None:
        """Who returns and is over its landing point waits while somebody lower still flies home."""
        if not self._returning or self.state is None:
            return
        statuses = {r: s for r, s in self.statuses().items() if r in self._returning}
        self._arrived |= {r for r, status in statuses.items() if is_over_landing_point(status)}
        waiting = waiting_to_land(statuses, self._arrived)
        asked: dict[str, Calm] = {
            r: c for r, c in self.state.robot_calm.items() if int(r) not in self._returning
        }
        for robot in sorted(self._returning):
            if robot in waiting:
                asked[str(robot)] = "hold"
            elif self.state.calm != "return":
                asked[str(robot)] = "return"
        self.change(robot_calm=asked)

    def set_world(self, text: str) -> int:
        """Want that world of the robots; the sequence."""
        self.remember_world(text)
        self._setup = replace(self._setup, world=text, world_id=world_id(text))
        return self.change(world_id=world_id(text))

    def _keep_world_of(self, state: GroundState) -> None:
        """The robots' world is what clients see, if its text is known here."""
        text = None if state.world_id is None else self._worlds.get(state.world_id)
        if text is not None and state.world_id is not None:
            self._setup = replace(self._setup, world=text, world_id=state.world_id)

    def remember_world(self, text: str) -> None:
        """It may be the one that the robots have."""
        self._worlds[world_id(text)] = text

    # Orders

    def order(self, kind: OrderKind, name: str, trial: str = "") -> str | None:
        """Order something once; the order's id, for `results`. None if the robot was never heard.

        One that was silent since counts its uptime on.
        """
        last = self._robots.last(self._setup.robots[name], self._now_s)
        if last is None:
            return None
        status, age_s = last
        uptime_s = status.uptime_s + (0.0 if age_s <= FRESH_S else age_s - FRESH_S)
        self._orders_made += 1
        order = Order(
            order_id=f"{self._orders_prefix}-{self._orders_made}",
            robot_id=status.robot_id,
            boot_nonce=status.boot_nonce,
            kind=kind,
            expires_at_uptime_s=uptime_s + ORDER_LIFETIME_S,
            operator=self.operator,
            trial=trial,
        )
        self._orders[order.order_id] = order, self._now_s
        return order.order_id

    def withdraw(self, order_id: str) -> None:
        """Say an order no more, if it is open."""
        self._orders.pop(order_id, None)

    # What is to be published, a few times a second

    def published_state(self) -> GroundState | None:
        """None: nothing is."""
        state = self.state if self.commands else self._asked
        return None if state is None else replace(state, unix_time_s=self._unix_now_s)

    def published_orders(self) -> tuple[Order, ...]:
        """Those that are not answered."""
        return tuple(order for order, _ in self._orders.values())

    def published_world(self) -> str | None:
        """The world's text, while a robot on the ground lacks it."""
        wanted = self.state.world_id if self.commands and self.state else None
        if wanted is None or wanted != self._setup.world_id:
            return None
        lacking = any(
            s.world_id != wanted and s.state in ON_GROUND for s in self.statuses().values()
        )
        return self._setup.world if lacking else None


def changes_in_words(before: GroundState, after: GroundState) -> list[str]:
    """What the ground wants that it did not want before, for people."""
    words: list[str] = []
    if (before.calm, before.robot_calm) != (after.calm, after.robot_calm):
        if _is_calmed(before, after):
            words.append(next(c for c in (after.calm, *after.robot_calm.values()) if c != "none"))
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


def _agreed(values: Iterable[T | None]) -> T | None:
    """What all say that say anything; None if they differ."""
    said = [value for value in values if value]
    return said[0] if said and all(value == said[0] for value in said) else None


def _commonest(values: Iterable[str]) -> str | None:
    return next((value for value, _ in Counter(values).most_common(1)), None)


def _is_at(status: RobotStatus, place: Place) -> bool:
    return math.dist(status.landing_point_m, place.landing_point_m) < _AT_PLACE_M


def _with_hold_of(state: GroundState, asked: GroundState) -> GroundState:
    """The state with the hold that another station asks for, and nothing else of it."""
    if asked.calm == "hold":
        return replace(state, calm="hold", robot_calm={}, calm_by=asked.calm_by)
    held: dict[str, Calm] = {r: c for r, c in asked.robot_calm.items() if c == "hold"}
    return replace(state, robot_calm=state.robot_calm | held, calm_by=asked.calm_by)


def _holds_as(state: GroundState, asked: GroundState) -> bool:
    """Whether the state has the hold that is asked for."""
    if asked.calm == "hold":
        return state.calm == "hold" and set(state.robot_calm.values()) <= {"hold"}
    return all(state.calm_for(int(r)) == c for r, c in asked.robot_calm.items() if c == "hold")


def _is_calmed(before: GroundState, after: GroundState) -> bool:
    """Whether more is asked to hold, to return or to land than before."""
    if after.calm not in ("none", before.calm):
        return True
    return any(c != "none" and before.calm_for(int(r)) != c for r, c in after.robot_calm.items())
