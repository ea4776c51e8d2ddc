"""Clients' commands; each is stepped until every robot has succeeded or failed.

Pure, like the station. A command is a generator that reads and changes the station, and yields
whenever it has to wait for messages or time.
"""

import math
from collections.abc import Callable, Collection, Generator, Iterable
from typing import Any

from edge.messages.codes import ReasonCode, Refusal, RefusalCode, texts
from edge.messages.mission import (
    AT_SLOT_M,
    FlightState,
    GroundState,
    OrderKind,
    RobotStatus,
    world_id,
)
from lpac.analysis.snapshot import COMMANDER_SILENT_S, NO_STATE
from lpac.ground.alarms import FENCE_NOT_TAKEN
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
from lpac.ground.station.return_queue import is_over_landing_point
from lpac.ground.station.states import next_trial
from lpac.ground.station.station import Station, is_down
from lpac.ground.station.statuses import TWO_PROGRAMS

DEFECT = Problem(ProblemCode.DEFECT, "a defect of lpac ground ended this command")

_GATHER_S = 3.0
# Timeouts for a robot to obey a state, and then for its effect to show in its status.
_OBEY_S = 10.0
_EFFECT_S = 3.0
_ACT_S = 1.5
# A world takes long to send and to process.
_WORLD_S = 30.0
# For all checks to run, after a landing and from idle.
_READY_S = 8.0
_CHECKS_S = 20.0
# A robot often refuses a start only because it has not heard yet that all others hold.
_START_S = 6.0
_START_AGAIN_S = 0.5
_CLIMB_S = 90.0
_LANDING_S = 120.0

_S, _C = FlightState, ResultCode

_NOT_HEARD = _C.NOT_HEARD, NOT_HEARD
_NOT_ENABLED = "not enabled: `lpac mission enable`"

Steps = Generator[None, None, None]
# Describes a robot once its status shows the wanted effect; None before.
Effect = Callable[[RobotStatus], str | None]


class _ProblemError(Exception):
    """The command is refused as a whole."""

    def __init__(self, code: ProblemCode, text: str) -> None:
        super().__init__(text)
        self.problem = Problem(code, text)


class CommandTask:
    """Running command for the robots `names`, until there is a `report`."""

    def __init__(
        self, station: Station, request: Request, on_accepted: Callable[["CommandTask"], None]
    ) -> None:
        """`on_accepted` is called when the command has passed its checks, before it acts."""
        self.request = request
        self.text = in_words(request)
        self.name = command_name(request)
        self.names = _addressed(station, request)
        self.report: CommandReport | None = None
        self._station = station
        self._on_accepted = on_accepted
        self._results: dict[str, RobotResult] = {}
        self._progress: list[CommandProgress] = []
        self._orders: dict[str, str] = {}
        self._steps = self._run()

    def step(self) -> None:
        """Continue as far as possible now."""
        if self.report is not None:
            return
        try:
            next(self._steps)
        except StopIteration:
            self._end()
        except _ProblemError as error:
            self.report = CommandReport(problem=error.problem)
            text = f"{self.text}: {error.problem.text}"
            self._station.notify("refusal", "", text, self._station.operator)
        except Exception:
            # End this command only; other commands and the station go on.
            self.report = CommandReport(problem=DEFECT)
            raise

    def abandon(self, why: str, *, withdraw: bool) -> None:
        """Give no more orders; with `withdraw`, also stop repeating those not yet answered."""
        if self.report is not None:
            return
        self._steps.close()
        if withdraw:
            for order_id in self._orders.values():
                self._station.orders.withdraw(order_id)
        self._fail(self._open, _C.ABANDONED, f"abandoned: {why}")
        self._end()

    def new_progress(self) -> list[CommandProgress]:
        """Progress since the last call."""
        progress, self._progress = self._progress, []
        return progress

    def _run(self) -> Steps:
        station = self._station
        robots = station.setup.robots
        for name in self.names:
            if name not in robots:
                text = f"robot {name!r} is unknown; known are {', '.join(robots)}"
                raise _ProblemError(ProblemCode.UNKNOWN_ROBOT, text)
        while not station.election.is_settled or not (self.name in _URGENT or self._all_received()):
            yield
        # Only now the robots' slots are known.
        self.names = _addressed(station, self.request)
        if not self.names:
            raise _ProblemError(ProblemCode.NO_ROBOT, "no robot is named, and none has a slot")
        do, check = _DO[type(self.request)]
        try:
            self._require_permission()
            if check is not None:
                check(self, self.request)
        except _ProblemError:
            if not self._is_missing_world():
                raise
            do = CommandTask._restore_world
        self._on_accepted(self)
        station.notify("command", "", self.text, station.operator)
        yield from do(self, self.request)

    def _all_received(self) -> bool:
        """Whether all robots are heard, or 3 s have passed since the station started."""
        station = self._station
        return station.age_s > _GATHER_S or all(self._status(name) for name in self.names)

    def _require_permission(self) -> None:
        """Raises _ProblemError if this station's operator may not give the command."""
        station = self._station
        commander = station.election.commander
        if not station.election.may_command and self.name != "hold":
            text = f"{station.operator} is an observer of this fleet: it may only command hold"
            raise _ProblemError(ProblemCode.MAY_NOT, text)
        if not station.is_member and isinstance(self.request, (Takeoff, Start)):
            text = (
                f"the key of {station.operator} is not in the list of members: make a new one "
                "(`lpac fleet rotate` or `lpac fleet operator`)"
            )
            raise _ProblemError(ProblemCode.MAY_NOT, text)
        own = station.commands or commander in ("", station.operator)
        if own or self.name in _ANY_STATION:
            return
        silent = station.election.commander_age_s > COMMANDER_SILENT_S
        raise _ProblemError(
            ProblemCode.OTHER_COMMANDS,
            f"{commander} commands the fleet{' but is silent' if silent else ''}: "
            "`lpac mission command` takes over",
        )

    @property
    def _open(self) -> list[str]:
        """Robots without a result yet."""
        return [name for name in self.names if name not in self._results]

    def _report_progress(self, robot: str, text: str) -> None:
        self._progress.append(CommandProgress(robot, text))

    def _settle(
        self,
        robot: str,
        text: str,
        code: ResultCode = ResultCode.DONE,
        refusal: RefusalCode | None = None,
    ) -> None:
        self._results[robot] = RobotResult(robot, code, text, refusal)
        self._report_progress(robot, text)
        self._station.notify(
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

    @property
    def _state(self) -> GroundState:
        return self._station.state or NO_STATE

    def _status(self, name: str) -> RobotStatus | None:
        return self._station.recent_status(name)

    def _open_statuses(self) -> dict[str, RobotStatus]:
        """Statuses of the open robots; those that are not heard fail."""
        heard = {name: status for name in self._open if (status := self._status(name))}
        self._fail([name for name in self._open if name not in heard], *_NOT_HEARD)
        return heard

    def _for_each_robot(self, check: Callable[[str, RobotStatus], None]) -> Steps:
        """Call `check` for each open robot, repeatedly, until all have results."""
        while heard := self._open_statuses():
            for name, status in heard.items():
                check(name, status)
            if self._open:
                yield

    def _obeys(self, status: RobotStatus, sequence: int = 0) -> bool:
        commander = self._station.election.commander
        return status.operator == commander and status.obeyed_sequence >= sequence

    def _disobedience(self, status: RobotStatus) -> tuple[ResultCode, str]:
        other = status.operator and status.operator != self._station.election.commander
        text = f"obeys {status.operator}" if other else "does not hear this ground station"
        return _C.NOT_OBEYING, text

    def _ids(self) -> list[int]:
        return [self._station.setup.robots[name] for name in self.names]

    @property
    def _addressed_ids(self) -> list[int] | None:
        """Ids of the named robots; None for the fleet."""
        return self._ids() if getattr(self.request, "robots", ()) else None

    def _refuse_armed(self, _: Request) -> None:
        """Refuse if any robot of the fleet is armed, even one that is not addressed."""
        robots = self._station.setup.robots
        armed = [name for name in robots if (s := self._status(name)) and not is_down(s)]
        if armed:
            verb = "is" if len(armed) == 1 else "are"
            text = f"{', '.join(armed)} {verb} armed: land and disarm first"
            raise _ProblemError(ProblemCode.ARMED, text)

    def _await_effect(self, sequence: int, effect: Effect, timeout_s: float = _EFFECT_S) -> Steps:
        """Wait until each robot obeys the state of that sequence and shows the effect."""
        assigned = isinstance(self.request, SetOrigin | SetFence | SetWorld | SetPlaces)
        began_s = self._station.now_s
        obeyed_s: dict[str, float] = {}

        def check(name: str, status: RobotStatus) -> None:
            now_s = self._station.now_s
            if not self._obeys(status, sequence):
                if now_s - began_s > _OBEY_S:
                    self._fail([name], *self._disobedience(status))
                return
            obeyed_s.setdefault(name, now_s)
            done = effect(status)
            if done is not None:
                self._settle(name, done)
            elif not assigned and status.state in _NOT_CONTROLLED:
                self._fail([name], *_explain(status))
            elif now_s - obeyed_s[name] > timeout_s:
                code, text = _explain(status)
                if assigned and status.not_taken:
                    code, text = _C.NOT_TAKEN_UP, texts(status.not_taken)
                withdraw = isinstance(self.request, SetFence) and self.request.fence is not None
                help_ = "; `lpac mission fence on` withdraws it" if withdraw else ""
                self._fail([name], code, f"{text}{help_}")

        yield from self._for_each_robot(check)

    def _origin(self, request: SetOrigin) -> Steps:
        yield from self._await_effect(
            self._station.change(origin=request.origin),
            lambda status: "accepted" if status.origin == request.origin else None,
        )

    def _fence(self, request: SetFence) -> Steps:
        fence = self._station.setup.fence if request.fence is None else request.fence
        own = "its configured one" if request.fence is None else "accepted"

        def effect(status: RobotStatus) -> str | None:
            if status.fence == fence:
                return own
            # A robot's own configuration may have another fence than the fleet's.
            accepted = not any(each.code in FENCE_NOT_TAKEN for each in status.not_taken)
            return own if request.fence is None and accepted else None

        yield from self._await_effect(self._station.change(fence=request.fence), effect)

    def _world(self, request: SetWorld) -> Steps:
        yield from self._await_world(self._station.set_world(request.text), request)

    def _await_world(self, sequence: int, request: SetWorld) -> Steps:
        wanted = world_id(request.text)
        yield from self._await_effect(
            sequence,
            lambda status: f"has world {wanted}" if status.world_id == wanted else None,
            _WORLD_S,
        )

    def _is_missing_world(self) -> bool:
        """Whether the request has the fleet's world, which this station lacks."""
        setup, request = self._station.setup, self.request
        if not isinstance(request, SetWorld) or setup.world:
            return False
        return world_id(request.text) == setup.world_id

    def _restore_world(self, request: SetWorld) -> Steps:
        """Add the fleet's world to this station; nothing changes for the robots."""
        self._station.worlds.add(request.text)
        yield from self._await_world(0, request)

    def _places(self, request: SetPlaces) -> Steps:
        setup = self._station.setup
        places = {setup.robots[name]: place for name, place in request.places.items()}

        def effect(status: RobotStatus) -> str | None:
            place = places[status.robot_id]
            height_m = setup.base_height_m + place.slot * setup.slot_spacing_m
            at_height = abs(status.slot_height_m - height_m) < 0.01
            if status.landing_point_m != place.landing_point_m or not at_height:
                return None
            return f"slot {place.slot}, {height_m:g} m high"

        taken = {place.slot for place in places.values()}
        before = self._state.places.items()
        others = {robot: place for robot, place in before if place.slot not in taken}
        given = {str(robot): place for robot, place in places.items()}
        sequence = self._station.change(places=others | given)
        yield from self._await_effect(sequence, effect)

    def _check_places(self, request: SetPlaces) -> None:
        self._refuse_armed(request)
        seated: dict[int, str] = {}
        for name, place in request.places.items():
            if seated.setdefault(place.slot, name) != name:
                text = f"{seated[place.slot]} and {name} would share slot {place.slot}"
                raise _ProblemError(ProblemCode.SLOT_SHARED, text)

    def _refuse_without_origin(self, _: Enable | Takeoff) -> None:
        if self.name != "disable" and self._state.origin is None:
            text = "no mission origin: set it with `lpac mission origin`"
            raise _ProblemError(ProblemCode.NO_ORIGIN, text)

    def _enable(self, request: Enable) -> Steps:
        station = self._station
        if self._addressed_ids is None:
            sequence = station.change(enabled=request.on, robot_enabled={})
        else:
            these = dict.fromkeys(map(str, self._addressed_ids), request.on)
            sequence = station.change(robot_enabled=self._state.robot_enabled | these)

        def on(status: RobotStatus) -> str | None:
            if status.state in (_S.INIT, _S.IDLE, *_NOT_CONTROLLED):
                return None
            if status.state is not _S.PREFLIGHT:
                return f"enabled, in {status.state}"
            return "ready" if status.ready else None

        def off(status: RobotStatus) -> str | None:
            if is_down(status):
                return None if status.state is _S.PREFLIGHT else "disabled"
            return "disabled: it holds" if status.state is _S.HOLD else None

        yield from self._await_effect(sequence, on if request.on else off, _CHECKS_S)

    def _safety_command(self, request: SafetyCommand) -> Steps:
        station = self._station
        if request.action == "hold":
            sequence = station.hold(self._addressed_ids)
        else:
            sequence = station.safety_action(request.action, self._addressed_ids)
        if not request.wait:
            yield from self._await_effect(sequence, _safety_effect(request.action), _ACT_S)
            return
        yield from self._await_obedience(sequence)
        known: dict[str, RobotStatus] = {}
        changed_s = station.now_s

        def check(name: str, status: RobotStatus) -> None:
            nonlocal changed_s
            flown = known.get(name)
            if is_down(status):
                self._settle(name, *_came_down(request.action, flown, status))
            elif status.state in _NOT_CONTROLLED:
                self._fail([name], *_explain(status))
            elif flown is None or (flown.state, flown.reason) != (status.state, status.reason):
                known[name], changed_s = status, station.now_s
                self._report_progress(name, state_and_reason(status))
            elif station.now_s - changed_s > _LANDING_S:
                self._fail([name], *_explain(status))

        yield from self._for_each_robot(check)

    def _await_obedience(self, sequence: int = 0) -> Steps:
        """Wait until each robot obeys the state of that sequence; after 10 s the others fail."""
        until_s = self._station.now_s + _OBEY_S
        while statuses := self._open_statuses():
            others = {n: s for n, s in statuses.items() if not self._obeys(s, sequence)}
            if others and self._station.now_s > until_s:
                for name, status in others.items():
                    self._fail([name], *self._disobedience(status))
                others = {}
            if not others:
                return
            yield

    def _reach_robots(self) -> Steps:
        """Take command and wait until each robot obeys it; required before orders."""
        station = self._station
        station.election.take_command()
        yield from self._await_obedience()
        duplicates = [name for name in self._open if station.is_duplicate(name)]
        self._fail(duplicates, _C.DUPLICATE_ID, TWO_PROGRAMS)

    def _order(self, kind: OrderKind, name: str, trial: str = "") -> None:
        order_id = self._station.order(kind, name, trial)
        if order_id is None:
            self._fail([name], *_NOT_HEARD)
        else:
            self._orders[name] = order_id

    def _answers(self, done: str) -> Steps:
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
        """Open robots that are commanded to hold, return or land, with the reason in words."""
        state, robots = self._state, self._station.setup.robots
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
        if not any(map(self._state.enabled_for, self._ids())):
            raise _ProblemError(ProblemCode.NOT_ENABLED, _NOT_ENABLED)
        if not self._all_down(self.names):
            self._refuse_under_safety_action(request)

    def _all_down(self, names: Collection[str]) -> bool:
        """Whether a return or landing of these robots is over: all are down, and none holds.

        An addressed or flying robot that is not heard may be in the air.
        """
        station = self._station
        robots = station.setup.robots
        expected = {*self.names, *station.flying}
        return all(
            self._state.safety_action_for(robots[name]) != "hold"
            and (name not in expected if (s := self._status(name)) is None else is_down(s))
            for name in names
        )

    def _take_off(self, request: Takeoff) -> Steps:
        station = self._station
        # A finished return or landing is withdrawn; a hold is not.
        if self._under_safety_action() and self._all_down(self.names):
            all_down = self._all_down(station.setup.robots)
            station.safety_action("none", None if all_down else self._ids())
        for name, why in self._under_safety_action().items():
            self._fail([name], _C.UNDER_SAFETY_ACTION, why)
        yield from self._reach_robots()
        self._settle_others()
        waiting = sorted(self._open, key=self._height_m)
        ordered_s: dict[str, float] = {}
        ready_by_s, next_s = station.now_s + _READY_S, station.now_s
        while self._open:
            for name in self._open:
                if name in ordered_s:
                    self._check_climb(name, ordered_s[name])
            failed = [result.robot for result in self._results.values() if not result.done]
            if failed and request.abort_on_failure:
                self._fail(waiting, _C.NOT_ORDERED, f"not ordered: {failed[0]} failed")
                waiting.clear()
            # The highest first, so that no robot climbs past another.
            if waiting and station.status(waiting[-1]) is None:
                # A silent robot may come back, and then runs its checks again.
                ready_by_s = station.now_s + _READY_S
            if waiting and station.now_s >= next_s:
                name = waiting[-1]
                self._order_takeoff(name, late=station.now_s >= ready_by_s)
                if name in self._orders:
                    ordered_s[name] = station.now_s
                    next_s = station.now_s + request.interval_s
                if name in self._orders or name not in self._open:
                    waiting.pop()
            if self._open:
                yield

    def _settle_others(self) -> None:
        for name, status in self._open_statuses().items():
            if status.state in (_S.HOLD, _S.MISSION):
                self._settle_climb(name, status, f"already in the air, in {status.state}")
            elif not self._state.enabled_for(status.robot_id):
                self._fail([name], _C.NOT_ENABLED, _NOT_ENABLED)
            elif status.state in _NOT_CONTROLLED:
                self._fail([name], *_explain(status))
            elif not status.ready:
                self._report_progress(name, _explain(status)[1])

    def _height_m(self, name: str) -> float:
        status = self._status(name)
        return 0.0 if status is None else status.slot_height_m

    def _order_takeoff(self, name: str, *, late: bool) -> None:
        """Order takeoff once the robot is ready; if it is `late`, it fails instead."""
        status = self._status(name)
        if status is None:
            self._fail([name], *_NOT_HEARD)
        elif self._station.status(name) is not None:
            if status.state is _S.PREFLIGHT and status.ready:
                self._order("takeoff", name)
                self._report_progress(name, "taking off")
            elif late:
                self._fail([name], *_explain(status))

    def _check_climb(self, name: str, ordered_s: float) -> None:
        """Record the result of a takeoff that is over."""
        status = self._status(name)
        answer = self._station.orders.results.get(self._orders[name])
        late = self._station.now_s - ordered_s > _CLIMB_S
        if answer is not None and answer.refusal is not None:
            self._refuse(name, answer.refusal)
        elif status is None:
            self._fail([name], *_NOT_HEARD)
        elif late or (answer is not None and status.state not in _CLIMBING):
            if status.state in (_S.HOLD, _S.MISSION):
                self._settle_climb(name, status, status.reason.text)
            else:
                self._fail([name], _C.WRONG_STATE, state_and_reason(status))

    def _settle_climb(self, name: str, status: RobotStatus, text: str) -> None:
        """Record the result of a robot in the air; one that stopped climbing early is too low."""
        low = status.state is _S.HOLD and is_too_low(status)
        if low:
            text += f"; below its height of {status.slot_height_m:g} m: land all, then take off"
        self._settle(name, text, _C.TOO_LOW if low else _C.DONE)

    def _start(self, _: Start) -> Steps:
        for name, why in self._under_safety_action().items():
            self._fail([name], _C.UNDER_SAFETY_ACTION, why)
        yield from self._reach_robots()
        trial = self._state.trial or next_trial("")
        self._station.change(trial=trial)
        yield from self._order_start(trial)

    def _order_start(self, trial: str) -> Steps:
        """Order start; repeat it for a while if a robot refuses for a passing reason."""
        until_s = self._station.now_s + _START_S
        again_s: dict[str, float] = {}
        refusals: dict[str, Refusal] = {}

        def check(name: str, status: RobotStatus) -> None:
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
                # A robot that has left hold since its refusal has another reason.
                if name in refusals and status.state is _S.HOLD:
                    self._refuse(name, refusals[name])
                else:
                    rule = "" if status.state is _S.HOLD else "start is from hold: "
                    code, text = _explain(status)
                    self._fail([name], code, f"{rule}{text}")
            elif self._station.status(name) is None:
                until_s = now_s + _START_S
            elif not order_id and status.state is _S.HOLD and now_s >= again_s.get(name, 0.0):
                self._order("start", name, trial)

        yield from self._for_each_robot(check)

    def _resume(self, _: Resume) -> Steps:
        station = self._station
        yield from self._reach_robots()
        yield from self._stop_returning()
        yield from self._await_obedience(station.safety_action("none", self._addressed_ids))
        trial = self._state.trial
        for name, status in self._open_statuses().items():
            if is_down(status):
                self._settle(name, "on the ground")
            elif status.state not in (_S.HOLD, _S.MISSION):
                self._fail([name], _C.WRONG_STATE, state_and_reason(status))
            elif not trial or status.trial != trial:
                self._settle(name, "holds: not in this trial yet; `lpac mission start`")
        yield from self._order_start(trial)

    def _stop_returning(self) -> Steps:
        """Let returning robots hold, since a mission starts from hold."""
        station = self._station
        homeward = {n: s for n, s in self._open_statuses().items() if s.state is _S.RETURN}
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
            # Abandoned: continue the return, unless another station has commanded hold since.
            if station.commands and not self._state.safety_action_by:
                station.safety_action("return", ids)
            raise

    def _order_each(self, request: RobotCommand) -> Steps:
        if request.kind != "kill":
            yield from self._reach_robots()
        # Kill is also sent to a silent robot, which may still receive it.
        for name in self._open:
            status = self._status(name)
            if request.kind == "disarm" and status is not None and status.armed is False:
                self._settle(name, "is not armed")
            else:
                self._order(request.kind, name)
        yield from self._answers(_ORDER_DONE[request.kind])

    def _refuse_on_mission(self, _: NextTrial) -> None:
        robots = self._station.setup.robots
        flying = [n for n in robots if (s := self._status(n)) and s.state is _S.MISSION]
        if flying:
            verb = "flies" if len(flying) == 1 else "fly"
            text = f"{', '.join(flying)} {verb} the mission: hold or land first"
            raise _ProblemError(ProblemCode.ON_MISSION, text)

    def _next_trial(self, request: NextTrial) -> Steps:
        yield from self._reach_robots()
        trial = request.trial or next_trial(self._state.trial)
        self._station.change(trial=trial)
        for name in self._open:
            self._order("reset", name, trial)
        yield from self._answers(f"trial {trial}: map and neighbours' messages are reset")

    def _take_command(self, _: TakeCommand) -> Steps:
        station = self._station
        station.election.take_command()
        for _step in self._await_effect(0, lambda _: f"obeys {station.operator}"):
            yield
            # Again: another station may change its state at the same moment.
            station.election.take_command()


# The robot's program does not control the vehicle in these.
_NOT_CONTROLLED = (_S.PILOT, _S.FAULT)
_CLIMBING = (_S.PREFLIGHT, _S.ARMING, _S.TAKEOFF)
_ORDER_DONE = {
    "pilot": "the pilot has it", "rejoin": "taken back: it holds", "disarm": "disarmed",
    "kill": "killed",
}  # fmt: skip
_SAFETY_EFFECTS = {
    "hold": {_S.HOLD: "holds"},
    "return": {_S.RETURN: "returns", _S.LAND: "lands", _S.HOLD: "waits for those below"},
    "land": {_S.LAND: "lands"},
}

_Do = Callable[[CommandTask, Any], Steps]
_Check = Callable[[CommandTask, Any], None]
# The method of each command, and a check that may refuse the command as a whole.
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
    RobotCommand: (CommandTask._order_each, None),
    NextTrial: (CommandTask._next_trial, CommandTask._refuse_on_mission),
    TakeCommand: (CommandTask._take_command, None),
}
# Commands that any station may give, and those that do not wait until all robots are heard.
_ANY_STATION = ("hold", "land", "kill", "command")
_URGENT = ("hold", "land", "kill")
# Commands that another station's hold ends, and those that end them for the same robots.
_IN_FLIGHT = ("takeoff", "start", "hold", "return", "land", "resume")
_SUPERSEDE = ("disable", "hold", "return", "land", "resume", "kill")


class Commands:
    """Running commands of a station. A safety command may begin at any time, and ends others."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self._running: list[CommandTask] = []

    def begin(self, request: Request) -> CommandTask:
        """Begin a command."""
        # So that an earlier interruption does not end this one.
        self.step()
        running = CommandTask(self._station, request, self._end_others)
        running.step()
        self._running.append(running)
        return running

    def step(self) -> None:
        """Continue all commands. Call after each message and periodically."""
        why, self._station.election.interruption = self._station.election.interruption, ""
        for running in self._running:
            if why and self._is_interrupted(running):
                running.abandon(why, withdraw=True)
            running.step()
        self._running = [running for running in self._running if running.report is None]

    def _is_interrupted(self, running: CommandTask) -> bool:
        """Another station's hold ends flight commands; a new commander ends nearly all."""
        if self._station.commands:
            return running.name in _IN_FLIGHT
        return running.name not in ("command", "kill")

    @property
    def texts(self) -> tuple[str, ...]:
        """Running commands, in words."""
        return tuple(running.text for running in self._running)

    def _end_others(self, new: CommandTask) -> None:
        """End the flight commands that `new` supersedes for the same robots."""
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


def _safety_effect(safety_action: str) -> Effect:
    def effect(status: RobotStatus) -> str | None:
        if is_down(status):
            return "on the ground"
        return _SAFETY_EFFECTS[safety_action].get(status.state)

    return effect


def _came_down(
    safety_action: str, flown: RobotStatus | None, status: RobotStatus
) -> tuple[str, ResultCode]:
    """Result of a robot that is down; `flown` is the last status of its flight, if any."""
    if flown is not None and status.state is _S.FAULT:
        code, text = _explain(status)
        return text, code
    if flown is None or safety_action != "return" or _is_home(flown, status):
        return "on the ground", _C.DONE
    where = "at an unknown place"
    if status.position_m is not None:
        away_m = math.dist(status.position_m[:2], status.landing_point_m)
        where = f"{away_m:.0f} m from its landing point"
    return f"landed {where}; last seen in flight in {state_and_reason(flown)}", _C.LANDED_ELSEWHERE


def is_too_low(status: RobotStatus) -> bool:
    """Whether the robot is too far below its own height to start a mission."""
    if status.position_m is None:
        return False
    return status.slot_height_m - status.position_m[2] > AT_SLOT_M


def _is_home(flown: RobotStatus, status: RobotStatus) -> bool:
    """Whether it landed at its landing point, or beside it on purpose."""
    if is_over_landing_point(status):
        return True
    beside = any(alarm.code is ReasonCode.LANDS_BESIDE for alarm in flown.alarms)
    chosen = beside or status.position_m is None
    return chosen and flown.reason.code is ReasonCode.AT_LANDING_POINT


def _explain(status: RobotStatus) -> tuple[ResultCode, str]:
    """Why a robot does not do what was commanded, and the remedy."""
    text = state_and_reason(status)
    if status.state is _S.PILOT:
        return _C.WRONG_STATE, f"{text}; `lpac mission rejoin` takes it back"
    if status.state is _S.FAULT and status.armed is False:
        return _C.WRONG_STATE, f"{text}; inspect it, then `lpac fleet restart`"
    if status.state is _S.PREFLIGHT and not status.ready:
        return _C.NOT_READY, f"not ready: {missing_checks(status)}"
    return _C.WRONG_STATE, text
