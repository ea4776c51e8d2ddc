"""Commands of clients: each is stepped until every robot has done it, or has not.

Pure, like the station: a command is a generator that looks at the station, changes what it wants,
and yields whenever it has to wait for what comes next.
"""

import math
from collections.abc import Callable, Collection, Generator, Iterable, Mapping
from typing import Any

from edge.messages.codes import FENCE_NOT_TAKEN, ReasonCode, Refusal, RefusalCode, texts
from edge.messages.mission import (
    FlightState,
    OrderKind,
    RobotStatus,
    is_over_landing_point,
    is_too_low,
    world_id,
)
from lpac.analysis.snapshot import COMMANDER_SILENT_S
from lpac.ground.rendering import NOT_HEARD, missing_checks, state_and_reason
from lpac.ground.station.protocol import (
    CommandProgress,
    CommandReport,
    Enable,
    NextTrial,
    Problem,
    ProblemCode,
    Request,
    ResultCode,
    Resume,
    RobotCommand,
    RobotResult,
    SafetyCommand,
    SetFence,
    SetOrigin,
    SetPlaces,
    SetWorld,
    Start,
    TakeCommand,
    Takeoff,
    command_name,
    in_words,
)
from lpac.ground.station.station import Station, is_down
from lpac.ground.station.wishes import next_trial

DEFECT = Problem(ProblemCode.DEFECT, "a defect of lpac ground ended this command")

_GATHER_S = 3.0
# Until a robot has obeyed; then, until what it was told shows.
_OBEY_S = 10.0
_TAKE_UP_S = 3.0
_ACT_S = 1.5
# A world is long, and computed with.
_WORLD_S = 30.0
# From idle, or after a landing, until all checks have been run.
_READY_S = 8.0
_CHECKS_S = 20.0
# What keeps a robot in hold from starting is often that it has not heard yet that all hold.
_START_S = 6.0
_START_AGAIN_S = 0.5
_CLIMB_S = 90.0
_LANDING_S = 120.0

_S, _C = FlightState, ResultCode

_NOT_HEARD = _C.NOT_HEARD, NOT_HEARD
_NOT_ENABLED = "not enabled: `lpac mission enable`"

Waits = Generator[None, None, None]
# What a robot does in words, once it has done what it was told; None before.
Effect = Callable[[RobotStatus], str | None]


class _ProblemError(Exception):
    """Nothing of the command is done."""

    def __init__(self, code: ProblemCode, text: str) -> None:
        super().__init__(text)
        self.problem = Problem(code, text)


class CommandTask:
    """One command that runs: `text` in words, for the robots `names`, until there is a `report`."""

    def __init__(
        self, station: Station, request: Request, on_taken: Callable[["CommandTask"], None]
    ) -> None:
        """`on_taken` is called once the command is known to be possible, before it does a thing."""
        self.request = request
        self.text = in_words(request)
        self.name = command_name(request)
        self.names = _addressed(station, request)
        self.report: CommandReport | None = None
        self._station = station
        self._on_taken = on_taken
        self._results: dict[str, RobotResult] = {}
        self._news: list[CommandProgress] = []
        self._orders: dict[str, str] = {}
        self._steps = self._run()

    def step(self) -> None:
        """Go on as far as is possible now."""
        if self.report is not None:
            return
        try:
            next(self._steps)
        except StopIteration:
            self._end()
        except _ProblemError as error:
            self.report = CommandReport(problem=error.problem)
            text = f"{self.text}: {error.problem.text}"
            self._station.tell("refusal", "", text, self._station.operator)
        except Exception:
            # It goes no further; the others, and the station, do.
            self.report = CommandReport(problem=DEFECT)
            raise

    def abandon(self, why: str, *, withdraw: bool) -> None:
        """Order nothing more; `withdraw` what was ordered and is not answered."""
        if self.report is not None:
            return
        self._steps.close()
        if withdraw:
            for order_id in self._orders.values():
                self._station.orders.withdraw(order_id)
        self._fail(self._open, _C.ABANDONED, f"abandoned: {why}")
        self._end()

    def news(self) -> list[CommandProgress]:
        """Progress since the last call."""
        news, self._news = self._news, []
        return news

    def _run(self) -> Waits:
        station = self._station
        robots = station.setup.robots
        for name in self.names:
            if name not in robots:
                text = f"robot {name!r} is unknown; known are {', '.join(robots)}"
                raise _ProblemError(ProblemCode.UNKNOWN_ROBOT, text)
        while not station.election.listened or not (self.name in _URGENT or self._are_gathered()):
            yield
        # Who sits in a slot is known only now.
        self.names = _addressed(station, self.request)
        if not self.names:
            raise _ProblemError(ProblemCode.NO_ROBOT, "no robot is named, or sits in a slot")
        do, check = _DO[type(self.request)]
        try:
            self._refuse_who_may_not()
            if check is not None:
                check(self, self.request)
        except _ProblemError:
            if not self._is_missing_world():
                raise
            do = CommandTask._learn_world
        self._on_taken(self)
        station.tell("command", "", self.text, station.operator)
        yield from do(self, self.request)

    def _are_gathered(self) -> bool:
        """Whether all are heard, as far as they will be: the station may just have started."""
        station = self._station
        return station.age_s > _GATHER_S or all(self._status(name) for name in self.names)

    def _refuse_who_may_not(self) -> None:
        """Raises _ProblemError if this station's operator may not ask for it."""
        station = self._station
        commander = station.election.commander
        if not station.election.may_command and self.name != "hold":
            text = f"{station.operator} is an observer of this fleet: it may ask for hold alone"
            raise _ProblemError(ProblemCode.MAY_NOT, text)
        if not station.is_member and isinstance(self.request, (Takeoff, Start)):
            text = (
                f"the key of {station.operator} is not in the list of members: it needs a new one "
                "(`lpac fleet rotate`, or `lpac fleet operator`)"
            )
            raise _ProblemError(ProblemCode.MAY_NOT, text)
        own = station.commands or commander in ("", station.operator)
        if own or self.name in _EVERYBODYS:
            return
        silent = station.election.commander_age_s > COMMANDER_SILENT_S
        raise _ProblemError(
            ProblemCode.OTHER_COMMANDS,
            f"{commander} commands the fleet{', and is silent' if silent else ''}: "
            "`lpac mission command` takes over",
        )

    # Results

    @property
    def _open(self) -> list[str]:
        """Robots whose result is not known yet."""
        return [name for name in self.names if name not in self._results]

    def _say(self, robot: str, text: str) -> None:
        self._news.append(CommandProgress(robot, text))

    def _settle(
        self,
        robot: str,
        text: str,
        code: ResultCode = ResultCode.DONE,
        refusal: RefusalCode | None = None,
    ) -> None:
        self._results[robot] = RobotResult(robot, code, text, refusal)
        self._say(robot, text)
        self._station.tell(
            "result" if code is _C.DONE else "refusal",
            robot,
            f"{self.text}: {text}",
            self._station.operator,
        )

    def _fail(self, robots: Iterable[str], code: ResultCode, text: str) -> None:
        for robot in robots:
            self._settle(robot, text, code)

    def _refuse(self, robot: str, refusal: Refusal) -> None:
        self._settle(robot, refusal.text, _C.REFUSED, refusal.code)

    def _end(self) -> None:
        self.report = CommandReport(tuple(self._results[name] for name in self.names))

    # What is known of the robots

    def _status(self, name: str) -> RobotStatus | None:
        return self._station.lately(name)

    def _heard(self) -> dict[str, RobotStatus]:
        """The open ones that are heard; the others have failed."""
        heard = {name: status for name in self._open if (status := self._status(name))}
        self._fail([name for name in self._open if name not in heard], *_NOT_HEARD)
        return heard

    def _each(self, look: Callable[[str, RobotStatus], None]) -> Waits:
        """Look at each open robot that is heard, again and again until all are settled."""
        while heard := self._heard():
            for name, status in heard.items():
                look(name, status)
            if self._open:
                yield

    def _obeys(self, status: RobotStatus, sequence: int = 0) -> bool:
        commander = self._station.election.commander
        return status.operator == commander and status.obeyed_sequence >= sequence

    def _not_obeying(self, status: RobotStatus) -> tuple[ResultCode, str]:
        other = status.operator and status.operator != self._station.election.commander
        text = f"obeys {status.operator}" if other else "does not hear this station"
        return _C.NOT_OBEYING, text

    def _ids(self) -> list[int]:
        return [self._station.setup.robots[name] for name in self.names]

    @property
    def _those(self) -> list[int] | None:
        """The robots by id; None for the fleet."""
        return self._ids() if getattr(self.request, "robots", ()) else None

    # Desired state

    def _refuse_armed(self, _: Request) -> None:
        """Whoever is addressed: the mission frame, fence, world and places are the fleet's."""
        robots = self._station.setup.robots
        armed = [name for name in robots if (s := self._status(name)) and not is_down(s)]
        if armed:
            verb = "is" if len(armed) == 1 else "are"
            text = f"{', '.join(armed)} {verb} armed: land and disarm first"
            raise _ProblemError(ProblemCode.ARMED, text)

    def _take_up(self, sequence: int, effect: Effect, patience_s: float = _TAKE_UP_S) -> Waits:
        """Wait until each robot has obeyed that state, and has taken up what it says."""
        assigned = isinstance(self.request, SetOrigin | SetFence | SetWorld | SetPlaces)
        began_s = self._station.now_s
        obeyed_s: dict[str, float] = {}

        def look(name: str, status: RobotStatus) -> None:
            now_s = self._station.now_s
            if not self._obeys(status, sequence):
                if now_s - began_s > _OBEY_S:
                    self._fail([name], *self._not_obeying(status))
                return
            obeyed_s.setdefault(name, now_s)
            how = effect(status)
            if how is not None:
                self._settle(name, how)
            elif not assigned and status.state in _NOT_STEERED:
                self._fail([name], *_why(status))
            elif now_s - obeyed_s[name] > patience_s:
                code, text = _why(status)
                if assigned and status.not_taken:
                    code, text = _C.NOT_TAKEN_UP, texts(status.not_taken)
                withdraw = isinstance(self.request, SetFence) and self.request.fence is not None
                help_ = "; `lpac mission fence on` withdraws it" if withdraw else ""
                self._fail([name], code, f"{text}{help_}")

        yield from self._each(look)

    def _origin(self, request: SetOrigin) -> Waits:
        yield from self._take_up(
            self._station.change(origin=request.origin),
            lambda status: "taken up" if status.origin == request.origin else None,
        )

    def _fence(self, request: SetFence) -> Waits:
        fence = self._station.setup.fence if request.fence is None else request.fence
        own = "its configured one" if request.fence is None else "taken up"

        def effect(status: RobotStatus) -> str | None:
            if status.fence == fence:
                return own
            # A robot's own file may say otherwise than the fleet's.
            others = not any(each.code in FENCE_NOT_TAKEN for each in status.not_taken)
            return own if request.fence is None and others else None

        yield from self._take_up(self._station.change(fence=request.fence), effect)

    def _world(self, request: SetWorld) -> Waits:
        yield from self._have_world(self._station.set_world(request.text), request)

    def _have_world(self, sequence: int, request: SetWorld) -> Waits:
        wanted = world_id(request.text)
        yield from self._take_up(
            sequence,
            lambda status: f"has world {wanted}" if status.world_id == wanted else None,
            _WORLD_S,
        )

    def _is_missing_world(self) -> bool:
        """Whether it is the world that the fleet has, and this station lacks."""
        setup, request = self._station.setup, self.request
        if not isinstance(request, SetWorld) or setup.world:
            return False
        return world_id(request.text) == setup.world_id

    def _learn_world(self, request: SetWorld) -> Waits:
        """Of the fleet nothing changes."""
        self._station.worlds.remember(request.text)
        yield from self._have_world(0, request)

    def _places(self, request: SetPlaces) -> Waits:
        setup = self._station.setup
        places = {setup.robots[name]: place for name, place in request.places.items()}

        def effect(status: RobotStatus) -> str | None:
            place = places[status.robot_id]
            height_m = setup.base_height_m + place.slot * setup.slot_spacing_m
            there = abs(status.slot_height_m - height_m) < 0.01
            if status.landing_point_m != place.landing_point_m or not there:
                return None
            return f"slot {place.slot}, {height_m:g} m high"

        before = {} if self._station.state is None else self._station.state.places
        taken = {place.slot for place in places.values()}
        others = {robot: place for robot, place in before.items() if place.slot not in taken}
        given = {str(robot): place for robot, place in places.items()}
        sequence = self._station.change(places=others | given)
        yield from self._take_up(sequence, effect)

    def _check_places(self, request: SetPlaces) -> None:
        self._refuse_armed(request)
        seated: dict[int, str] = {}
        for name, place in request.places.items():
            if seated.setdefault(place.slot, name) != name:
                text = f"{seated[place.slot]} and {name} would share slot {place.slot}"
                raise _ProblemError(ProblemCode.SLOT_SHARED, text)

    def _refuse_without_origin(self, _: Enable | Takeoff) -> None:
        state = self._station.state
        if self.name != "disable" and (state is None or state.origin is None):
            text = "no mission origin: set it with `lpac mission origin`"
            raise _ProblemError(ProblemCode.NO_ORIGIN, text)

    def _enable(self, request: Enable) -> Waits:
        station = self._station
        if self._those is None:
            sequence = station.change(enabled=request.on, robot_enabled={})
        else:
            before = {} if station.state is None else station.state.robot_enabled
            these = dict.fromkeys(map(str, self._those), request.on)
            sequence = station.change(robot_enabled=before | these)

        def on(status: RobotStatus) -> str | None:
            if status.state in (_S.INIT, _S.IDLE, *_NOT_STEERED):
                return None
            if status.state is not _S.PREFLIGHT:
                return f"enabled, in {status.state}"
            return "ready" if status.ready else None

        def off(status: RobotStatus) -> str | None:
            if is_down(status):
                return None if status.state is _S.PREFLIGHT else "disabled"
            return "disabled: it holds" if status.state is _S.HOLD else None

        yield from self._take_up(sequence, on if request.on else off, _CHECKS_S)

    def _safety_command(self, request: SafetyCommand) -> Waits:
        station = self._station
        if request.action == "hold":
            sequence = station.hold(self._those)
        else:
            sequence = station.safety_action(request.action, self._those)
        if not request.wait:
            yield from self._take_up(sequence, _obeying_words(request.action), _ACT_S)
            return
        yield from self._obeyed(sequence)
        known: dict[str, RobotStatus] = {}
        changed_s = station.now_s

        def look(name: str, status: RobotStatus) -> None:
            nonlocal changed_s
            flown = known.get(name)
            if is_down(status):
                self._settle(name, *_came_down(request.action, flown, status))
            elif status.state in _NOT_STEERED:
                self._fail([name], *_why(status))
            elif flown is None or (flown.state, flown.reason) != (status.state, status.reason):
                known[name], changed_s = status, station.now_s
                self._say(name, state_and_reason(status))
            elif station.now_s - changed_s > _LANDING_S:
                self._fail([name], *_why(status))

        yield from self._each(look)

    def _obeyed(self, sequence: int = 0) -> Waits:
        """Each robot obeys that state, or has failed: what it said before counts no more."""
        until_s = self._station.now_s + _OBEY_S
        while heard := self._heard():
            deaf = {n: s for n, s in heard.items() if not self._obeys(s, sequence)}
            if deaf and self._station.now_s > until_s:
                for name, status in deaf.items():
                    self._fail([name], *self._not_obeying(status))
                deaf = {}
            if not deaf:
                return
            yield

    # Orders

    def _reach(self) -> Waits:
        """Before orders: each robot obeys this station, or has failed."""
        station = self._station
        station.election.take_command()
        yield from self._obeyed()
        twice = [name for name in self._open if station.is_duplicate(name)]
        self._fail(twice, _C.DUPLICATE_ID, "two programs say that they are this robot")

    def _order(self, kind: OrderKind, name: str, trial: str = "") -> None:
        order_id = self._station.order(kind, name, trial)
        if order_id is None:
            self._fail([name], *_NOT_HEARD)
        else:
            self._orders[name] = order_id

    def _answers(self, done: str) -> Waits:
        """Wait for the robots' answers to their orders."""
        while self._open:
            for name in self._open:
                answer = self._station.orders.results.get(self._orders[name])
                if answer is not None:
                    if answer.refusal is None:
                        self._settle(name, done)
                    else:
                        self._refuse(name, answer.refusal)
            if self._open:
                yield

    def _under_safety_action(self) -> dict[str, str]:
        """Why the open ones that are asked to hold, return or land are not to be set in motion."""
        state, robots = self._station.state, self._station.setup.robots
        if state is None:
            return {}
        by = f" by {state.safety_action_by}" if state.safety_action_by else ""
        return {
            name: f"{safety_action} is commanded{by}: `lpac mission resume` withdraws it"
            for name in self._open
            if (safety_action := state.safety_action_for(robots[name])) != "none"
        }

    def _refuse_under_safety_action(self, _: Request) -> None:
        commanded = self._under_safety_action()
        if len(commanded) == len(self.names):
            raise _ProblemError(ProblemCode.UNDER_SAFETY_ACTION, commanded[self.names[0]])

    def _check_takeoff(self, request: Takeoff) -> None:
        self._refuse_without_origin(request)
        state = self._station.state
        if state is not None and not any(map(state.enabled_for, self._ids())):
            raise _ProblemError(ProblemCode.NOT_ENABLED, _NOT_ENABLED)
        if not self._brought_down(self.names):
            self._refuse_under_safety_action(request)

    def _brought_down(self, names: Collection[str]) -> bool:
        """Whether all are down who are asked to return or to land, and nobody is asked to hold.

        Who is not heard, and should be, may be in the air.
        """
        station = self._station
        state, robots = station.state, station.setup.robots
        awaited = {*self.names, *station.flying}
        return state is not None and all(
            state.safety_action_for(robots[name]) != "hold"
            and (name not in awaited if (s := self._status(name)) is None else is_down(s))
            for name in names
        )

    def _take_off(self, request: Takeoff) -> Waits:
        station = self._station
        # What brought the robots down before does not keep them there; somebody's hold does.
        if self._under_safety_action() and self._brought_down(self.names):
            whole = self._brought_down(station.setup.robots)
            station.safety_action("none", None if whole else self._ids())
        for name, why in self._under_safety_action().items():
            self._fail([name], _C.UNDER_SAFETY_ACTION, why)
        yield from self._reach()
        self._settle_who_does_not_take_off()
        waiting = sorted(self._open, key=self._height_m)
        ordered_s: dict[str, float] = {}
        ready_by_s, next_s = station.now_s + _READY_S, station.now_s
        while self._open:
            self._look_at_climbs(ordered_s)
            failed = [result.robot for result in self._results.values() if not result.done]
            if failed and request.abort_on_failure:
                self._fail(waiting, _C.NOT_ORDERED, f"not ordered: {failed[0]} failed")
                waiting.clear()
            # The highest first: it climbs past nobody.
            if waiting and station.status(waiting[-1]) is None:
                # Who falls silent may come back, and then runs its checks again.
                ready_by_s = station.now_s + _READY_S
            if waiting and station.now_s >= next_s:
                decided = self._order_takeoff(waiting[-1], late=station.now_s >= ready_by_s)
                if decided is not None:
                    name = waiting.pop()
                    if decided:
                        ordered_s[name] = station.now_s
                        next_s = station.now_s + request.interval_s
            if self._open:
                yield

    def _settle_who_does_not_take_off(self) -> None:
        for name, status in self._heard().items():
            if status.state in (_S.HOLD, _S.MISSION):
                self._settle_up(name, status, f"already in the air, in {status.state}")
            elif not self._is_enabled(name):
                self._fail([name], _C.NOT_ENABLED, _NOT_ENABLED)
            elif status.state in _NOT_STEERED:
                self._fail([name], *_why(status))
            elif not status.ready:
                self._say(name, _why(status)[1])

    def _is_enabled(self, name: str) -> bool:
        state = self._station.state
        return state is not None and state.enabled_for(self._station.setup.robots[name])

    def _height_m(self, name: str) -> float:
        status = self._status(name)
        return 0.0 if status is None else status.slot_height_m

    def _order_takeoff(self, name: str, *, late: bool) -> bool | None:
        """Whether it was ordered, as the robot is ready; None if that is to be waited for."""
        status = self._status(name)
        if status is None:
            self._fail([name], *_NOT_HEARD)
        elif self._station.status(name) is None:
            return None
        elif status.state is _S.PREFLIGHT and status.ready:
            self._order("takeoff", name)
            self._say(name, "takes off")
            return True
        elif late:
            self._fail([name], *_why(status))
        else:
            return None
        return False

    def _look_at_climbs(self, ordered_s: Mapping[str, float]) -> None:
        for name, at_s in ordered_s.items():
            if name in self._open:
                self._look_at_climb(name, at_s)

    def _look_at_climb(self, name: str, ordered_s: float) -> None:
        """Settle a takeoff that is over."""
        status = self._status(name)
        answer = self._station.orders.results.get(self._orders[name])
        late = self._station.now_s - ordered_s > _CLIMB_S
        if answer is not None and answer.refusal is not None:
            self._refuse(name, answer.refusal)
        elif status is None:
            self._fail([name], *_NOT_HEARD)
        elif late or (answer is not None and status.state not in _CLIMBING):
            if status.state in (_S.HOLD, _S.MISSION):
                self._settle_up(name, status, status.reason.text)
            else:
                self._fail([name], _C.WRONG_STATE, state_and_reason(status))

    def _settle_up(self, name: str, status: RobotStatus, text: str) -> None:
        """Settle who has taken off; who was held up on its way is too low for a mission."""
        low = status.state is _S.HOLD and is_too_low(status)
        if low:
            text += f"; below its height of {status.slot_height_m:g} m: land all, then take off"
        self._settle(name, text, _C.TOO_LOW if low else _C.DONE)

    def _start(self, _: Start) -> Waits:
        for name, why in self._under_safety_action().items():
            self._fail([name], _C.UNDER_SAFETY_ACTION, why)
        yield from self._reach()
        state = self._station.state
        trial = state.trial if state is not None and state.trial else next_trial("")
        self._station.change(trial=trial)
        yield from self._order_start(trial)

    def _order_start(self, trial: str) -> Waits:
        """Order it; again, for a while, if a robot refuses because of the moment."""
        until_s = self._station.now_s + _START_S
        again_s: dict[str, float] = {}
        refusals: dict[str, Refusal] = {}

        def look(name: str, status: RobotStatus) -> None:
            nonlocal until_s
            now_s = self._station.now_s
            order_id = self._orders.get(name, "")
            answer = self._station.orders.results.get(order_id)
            if answer is not None and answer.refusal is not None:
                refusals[name] = answer.refusal
                again_s[name] = now_s + _START_AGAIN_S
                order_id = ""
                del self._orders[name]
            if status.state is _S.MISSION and status.trial == trial:
                self._settle(name, f"flies the mission, trial {trial}")
            elif now_s > until_s or status.state not in (_S.HOLD, _S.TAKEOFF):
                # Who has left hold since then is where it is for another reason.
                if name in refusals and status.state is _S.HOLD:
                    self._refuse(name, refusals[name])
                else:
                    rule = "" if status.state is _S.HOLD else "start is from hold: "
                    code, text = _why(status)
                    self._fail([name], code, f"{rule}{text}")
            elif self._station.status(name) is None:
                until_s = now_s + _START_S
            elif not order_id and status.state is _S.HOLD and now_s >= again_s.get(name, 0.0):
                self._order("start", name, trial)

        yield from self._each(look)

    def _resume(self, _: Resume) -> Waits:
        station = self._station
        yield from self._reach()
        yield from self._stop_homeward()
        yield from self._obeyed(station.safety_action("none", self._those))
        assert station.state is not None
        trial = station.state.trial
        for name, status in self._heard().items():
            if is_down(status):
                self._settle(name, "on the ground")
            elif status.state not in (_S.HOLD, _S.MISSION):
                self._fail([name], _C.WRONG_STATE, state_and_reason(status))
            elif not trial or status.trial != trial:
                self._settle(name, "holds: it has not begun this trial; `lpac mission start`")
        yield from self._order_start(trial)

    def _stop_homeward(self) -> Waits:
        """From return the way to the mission leads through hold."""
        station = self._station
        homeward = {n: s for n, s in self._heard().items() if s.state is _S.RETURN}
        if not homeward:
            return
        ids = [status.robot_id for status in homeward.values()]
        until_s = station.now_s + _OBEY_S
        station.safety_action("hold", ids)
        try:
            while station.now_s < until_s and any(
                (s := self._status(name)) and s.state is _S.RETURN for name in homeward
            ):
                yield
        except GeneratorExit:
            # Abandoned: nobody wants them to stay, unless somebody else asked for it since.
            if (
                station.commands
                and station.state is not None
                and not station.state.safety_action_by
            ):
                station.safety_action("return", ids)
            raise

    def _give(self, request: RobotCommand) -> Waits:
        if request.kind != "kill":
            yield from self._reach()
        # Who is silent is killed, too, if it still hears.
        for name in self._open:
            status = self._status(name)
            if request.kind == "disarm" and status is not None and status.armed is False:
                self._settle(name, "is not armed")
            else:
                self._order(request.kind, name)
        yield from self._answers(_GIVEN[request.kind])

    def _refuse_on_mission(self, _: NextTrial) -> None:
        robots = self._station.setup.robots
        flying = [n for n in robots if (s := self._status(n)) and s.state is _S.MISSION]
        if flying:
            verb = "flies" if len(flying) == 1 else "fly"
            text = f"{', '.join(flying)} {verb} the mission: hold or land first"
            raise _ProblemError(ProblemCode.ON_MISSION, text)

    def _again(self, request: NextTrial) -> Waits:
        yield from self._reach()
        state = self._station.state
        trial = request.trial or next_trial("" if state is None else state.trial)
        self._station.change(trial=trial)
        for name in self._open:
            self._order("reset", name, trial)
        yield from self._answers(f"trial {trial}: map and neighbours' messages are reset")

    def _command(self, _: TakeCommand) -> Waits:
        station = self._station
        until_s = station.now_s + _OBEY_S
        station.election.take_command()

        def look(name: str, status: RobotStatus) -> None:
            # Somebody else may change something at the same moment.
            station.election.take_command()
            if self._obeys(status):
                self._settle(name, f"obeys {station.operator}")
            elif station.now_s > until_s:
                self._fail([name], *self._not_obeying(status))

        yield from self._each(look)


# A robot flies itself down in none of these, and does not stop there.
_NOT_STEERED = (_S.PILOT, _S.FAULT)
_CLIMBING = (_S.PREFLIGHT, _S.ARMING, _S.TAKEOFF)
_GIVEN = {
    "pilot": "the pilot has it", "rejoin": "taken back: it holds", "disarm": "disarmed",
    "kill": "killed",
}  # fmt: skip
_OBEYING_WORDS = {
    "hold": {_S.HOLD: "holds"},
    "return": {_S.RETURN: "returns", _S.LAND: "lands", _S.HOLD: "waits for those below"},
    "land": {_S.LAND: "lands"},
}

_Do = Callable[[CommandTask, Any], Waits]
_Check = Callable[[CommandTask, Any], None]
# What each command does, and the check that refuses it as a whole before.
_DO: dict[type[Request], tuple[_Do, _Check | None]] = {
    SetOrigin: (CommandTask._origin, CommandTask._refuse_armed),
    SetFence: (CommandTask._fence, CommandTask._refuse_armed),
    SetWorld: (CommandTask._world, CommandTask._refuse_armed),
    SetPlaces: (CommandTask._places, CommandTask._check_places),
    Enable: (CommandTask._enable, CommandTask._refuse_without_origin),
    Takeoff: (CommandTask._take_off, CommandTask._check_takeoff),
    Start: (CommandTask._start, CommandTask._refuse_under_safety_action),
    SafetyCommand: (CommandTask._safety_command, None),
    Resume: (CommandTask._resume, None),
    RobotCommand: (CommandTask._give, None),
    NextTrial: (CommandTask._again, CommandTask._refuse_on_mission),
    TakeCommand: (CommandTask._command, None),
}
# By their names. Everybody's need no command of the fleet, or take it on the way; urgent ones do
# not wait until all are heard.
_EVERYBODYS = ("hold", "land", "kill", "command")
_URGENT = ("hold", "land", "kill")
# These set robots in motion, or stop them. They end with another station's hold, and when one that
# supersedes them begins for the same robots.
_IN_FLIGHT = ("takeoff", "start", "hold", "return", "land", "resume")
_SUPERSEDE = ("disable", "hold", "return", "land", "resume", "kill")


class Commands:
    """All commands that run on a station. A safety command is taken at any time,
    and ends the others."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self._running: list[CommandTask] = []

    def begin(self, request: Request) -> CommandTask:
        """Begin a command."""
        # What another station did before does not end this one.
        self.step()
        running = CommandTask(self._station, request, self._end_others)
        running.step()
        self._running.append(running)
        return running

    def step(self) -> None:
        """Time has passed, or something was heard."""
        why, self._station.election.interruption = self._station.election.interruption, ""
        for running in self._running:
            if why and self._is_interrupted(running):
                running.abandon(why, withdraw=True)
            running.step()
        self._running = [running for running in self._running if running.report is None]

    def _is_interrupted(self, running: CommandTask) -> bool:
        """Another's hold ends what sets robots in motion; a new commander all that was wanted."""
        if self._station.commands:
            return running.name in _IN_FLIGHT
        return running.name not in ("command", "kill")

    @property
    def texts(self) -> tuple[str, ...]:
        """Those that run, in words."""
        return tuple(running.text for running in self._running)

    def _end_others(self, new: CommandTask) -> None:
        """Whatever else is wanted of the same robots' flight is so no more."""
        if new.name not in _SUPERSEDE:
            return
        for running in self._running:
            shared = set(running.names) & set(new.names)
            same = running.name == new.name and isinstance(new.request, SafetyCommand)
            if running is not new and shared and not same and running.name in _IN_FLIGHT:
                running.abandon(new.text, withdraw=True)


def _addressed(station: Station, request: Request) -> tuple[str, ...]:
    if isinstance(request, SetPlaces):
        return tuple(request.places)
    named = tuple(dict.fromkeys(getattr(request, "robots", ())))
    return named if named or isinstance(request, RobotCommand) else station.flying


def _obeying_words(safety_action: str) -> Effect:
    def effect(status: RobotStatus) -> str | None:
        if is_down(status):
            return "on the ground"
        return _OBEYING_WORDS[safety_action].get(status.state)

    return effect


def _came_down(
    safety_action: str, flown: RobotStatus | None, status: RobotStatus
) -> tuple[str, ResultCode]:
    """Say how a robot came down; `flown` is the last status of its flight, if any."""
    if flown is not None and status.state is _S.FAULT:
        code, text = _why(status)
        return text, code
    if flown is None or safety_action != "return" or _is_home(flown, status):
        return "on the ground", _C.DONE
    where = "at an unknown place"
    if status.position_m is not None:
        away_m = math.dist(status.position_m[:2], status.landing_point_m)
        where = f"{away_m:.0f} m from its landing point"
    return f"landed {where}; last seen in flight in {state_and_reason(flown)}", _C.LANDED_ELSEWHERE


def _is_home(flown: RobotStatus, status: RobotStatus) -> bool:
    """Whether it came down where return leads: at its landing point, or beside it."""
    if is_over_landing_point(status):
        return True
    beside = any(alarm.code is ReasonCode.LANDS_BESIDE for alarm in flown.alarms)
    chosen = beside or status.position_m is None
    return chosen and flown.reason.code is ReasonCode.AT_LANDING_POINT


def _why(status: RobotStatus) -> tuple[ResultCode, str]:
    """Explain why a robot does not do what it was told, and what helps."""
    text = state_and_reason(status)
    if status.state is _S.PILOT:
        return _C.WRONG_STATE, f"{text}; `lpac mission rejoin` takes it back"
    if status.state is _S.FAULT and status.armed is False:
        return _C.WRONG_STATE, f"{text}; look at it, then `lpac fleet restart`"
    if status.state is _S.PREFLIGHT and not status.ready:
        return _C.NOT_READY, f"not ready: {missing_checks(status)}"
    return _C.WRONG_STATE, text
