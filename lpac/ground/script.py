"""Scripts of trials, such as the paper's experiment: the file format, and the procedure.

docs/script.toml has every key. A script is an ordinary client of the ground: it gives commands and
reads snapshots. It ends when another operator commands the fleet to hold, return or land.
"""

import math
import re
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

from msgspec import Meta

from edge.core.file_errors import in_words
from edge.core.frames import Latitude, Longitude
from edge.core.schema import Bounded, ConfigError, NonNegative, from_mapping
from edge.core.toml import read_toml
from edge.core.world import has_importance, parse_world
from edge.messages.mission import FlightState, GroundState, Heading, Origin, RobotStatus
from lpac.analysis.snapshot import FleetSetup, FleetSnapshot
from lpac.ground.procedure import Ground, Procedure, Until, collect_statuses, fresh_snapshot
from lpac.ground.rendering import NOT_HEARD, missing_checks, state_and_reason
from lpac.ground.site import SavedSite, Sites, origin_at, places_at, standing
from lpac.ground.station.protocol import (
    CommandReport,
    Enable,
    NextTrial,
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
    Takeoff,
)
from lpac.ground.station.station import is_down
from lpac.ground.station.subscriber import addressed

_S = FlightState

# States in which checks may still be running or settling.
_BEFORE_READY = (_S.INIT, _S.IDLE, _S.PREFLIGHT)
_RESTART_PERIOD_S = 3.0
# Longest duration of a start, in which no other step may be due.
_MAX_START_S = 7.0
_REJOIN_TIMEOUT_S = 15.0
_PERIOD_S = 0.2
# A shorter wait, from rounding, would not advance a simulated clock.
_MIN_WAIT_S = 0.01
_Duration = Annotated[float, Meta(gt=0.0, le=36000.0)]


@dataclass(frozen=True, slots=True)
class OriginStep(Bounded):
    """Set the mission's origin: as given, or measured as by `lpac mission origin --from`."""

    latitude_deg: Latitude | None = None
    longitude_deg: Longitude | None = None
    heading_deg: Heading | None = None
    from_robot: str = ""
    toward_robot: str = ""
    average_s: Annotated[float, Meta(gt=0.0, le=600.0)] = 5.0

    def check_rules(self) -> None:
        given = (self.latitude_deg, self.longitude_deg, self.heading_deg)
        if self.from_robot and given != (None, None, None):
            raise ValueError(
                "from_robot: measures the origin: latitude_deg, longitude_deg and heading_deg must "
                "be left out"
            )
        if not self.from_robot and (None in given or self.toward_robot):
            raise ValueError(
                "latitude_deg, longitude_deg and heading_deg must be given, or from_robot"
            )

    def given(self) -> Origin | None:
        """The given origin; None if it is to be measured."""
        if self.latitude_deg is None or self.longitude_deg is None or self.heading_deg is None:
            return None
        return Origin(self.latitude_deg, self.longitude_deg, self.heading_deg)


@dataclass(frozen=True, slots=True)
class SiteStep:
    """Use a saved site: its origin, fence and landing points."""

    name: str


@dataclass(frozen=True, slots=True)
class WorldStep:
    """Send a world file to the robots; its path is relative to the script's folder."""

    file: str


@dataclass(frozen=True, slots=True)
class PreflightStep(Bounded):
    """Enable the robots and wait until all are ready."""

    at_most_s: _Duration = 60.0


@dataclass(frozen=True, slots=True)
class TakeoffStep(Bounded):
    """Take off, one after another."""

    interval_s: Annotated[float, Meta(ge=0.0, le=60.0)] = 2.0
    abort_on_failure: bool = True


@dataclass(frozen=True, slots=True)
class Perturbation(Bounded):
    """Hand a robot to a pilot at a time of the mission, or take it back into the mission."""

    at_s: NonNegative
    robot: str
    do: Literal["pilot", "rejoin"]


@dataclass(frozen=True, slots=True)
class MissionStep(Bounded):
    """Fly the mission; with `restart`, robots that hold on their own are started again."""

    duration_s: _Duration
    restart: bool = False
    perturb: tuple[Perturbation, ...] = ()

    def check_rules(self) -> None:
        for perturbation in self.perturb:
            if not perturbation.at_s < self.duration_s:
                raise ValueError(
                    f"perturb: at_s = {perturbation.at_s}: must be below duration_s = "
                    f"{self.duration_s}"
                )
        piloted: set[str] = set()
        for perturbation in self.in_time():
            at = f"perturb: at_s = {perturbation.at_s}: {perturbation.robot}"
            if perturbation.do == "pilot" and perturbation.robot in piloted:
                raise ValueError(f"{at} has a pilot already: must rejoin first")
            if perturbation.do == "rejoin" and perturbation.robot not in piloted:
                raise ValueError(f"{at} has no pilot: must be handed to one before it rejoins")
            piloted ^= {perturbation.robot}

    def in_time(self) -> list[Perturbation]:
        """Perturbations in order of time."""
        return sorted(self.perturb, key=lambda perturbation: perturbation.at_s)


@dataclass(frozen=True, slots=True)
class ReturnStep:
    """Fly to the landing points and land; done when all have landed."""


@dataclass(frozen=True, slots=True)
class LandStep:
    """Land in place; done when all have landed."""


Step = (
    OriginStep | SiteStep | WorldStep | PreflightStep | TakeoffStep | MissionStep | ReturnStep
    | LandStep
)  # fmt: skip

STEPS_BEFORE: dict[str, type[Step]] = {"origin": OriginStep, "site": SiteStep, "world": WorldStep}
STEPS: dict[str, type[Step]] = {
    "preflight": PreflightStep, "takeoff": TakeoffStep, "mission": MissionStep,
    "return": ReturnStep, "land": LandStep,
}  # fmt: skip
_NAMES = {kind: name for name, kind in (STEPS_BEFORE | STEPS).items()}


@dataclass(frozen=True, slots=True)
class ScriptTable(Bounded):
    """The whole file."""

    trial: Annotated[
        str,
        Meta(
            pattern=r"\A[A-Za-z0-9_-]{0,24}\Z",
            description="at most 24 letters, digits, '-' and '_'",
        ),
    ] = ""
    trials: Annotated[int, Meta(ge=1, le=1000)] = 1
    robots: tuple[str, ...] = ()
    before: tuple[dict, ...] = ()  # type: ignore[type-arg]
    steps: Annotated[
        tuple[dict, ...],  # type: ignore[type-arg]
        Meta(min_length=1, description="one or more [[steps]] tables"),
    ] = ()


@dataclass(frozen=True, slots=True)
class Script:
    """A checked script. `before` runs once, `steps` in each of `trials`.

    `robots` is empty for all robots with a slot.
    """

    path: Path
    trial: str
    trials: int
    robots: tuple[str, ...]
    before: tuple[Step, ...]
    steps: tuple[Step, ...]


def load_script(path: Path, sites: Sites) -> Script:
    """Load a script, checking its worlds and sites too.

    Raises ValueError: one line that names the file, the step, the key and what is allowed.
    """
    table = from_mapping(ScriptTable, read_toml(path), str(path))
    before = _steps(table.before, STEPS_BEFORE, f"{path}: before")
    for step in before:
        if isinstance(step, WorldStep):
            _set_world(path, step)
        elif isinstance(step, SiteStep):
            sites.load(step.name)
    steps = _steps(table.steps, STEPS, f"{path}: steps")
    _check_order(steps, f"{path}: steps")
    return Script(path, table.trial, table.trials, table.robots, before, steps)


def read_world(path: Path) -> str:
    """Read and check a world file. Raises ConfigError that names the file and the error."""
    try:
        text = path.read_text("utf-8-sig")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {in_words(error)}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not text: {error}") from None
    if not has_importance(parse_world(text, str(path))):
        raise ConfigError(f"{path}: has no features of any importance")
    return text


def _set_world(script: Path, step: WorldStep, robots: tuple[str, ...] = ()) -> SetWorld:
    file = script.parent / step.file
    return SetWorld(read_world(file), file.name, robots)


def _steps(
    tables: Sequence[dict[str, Any]], kinds: Mapping[str, type[Step]], where: str
) -> tuple[Step, ...]:
    steps = []
    for i, table in enumerate(tables):
        kind = str(table.get("do", ""))
        if kind not in kinds:
            allowed = ", ".join(map(repr, kinds))
            raise ConfigError(f"{where}[{i}]: do = {kind!r}: allowed are {allowed}")
        keys = {key: value for key, value in table.items() if key != "do"}
        steps.append(from_mapping(kinds[kind], keys, f"{where}[{i}] ({kind})"))
    return tuple(steps)


def _check_order(steps: Sequence[Step], where: str) -> None:
    """Require that a trial begins and ends on the ground, with one mission per flight."""
    in_air = flown = False
    for i, step in enumerate(steps):
        at = f"{where}[{i}] ({_NAMES[type(step)]})"
        match step:
            case PreflightStep() | TakeoffStep() if in_air:
                raise ConfigError(f"{at}: robots are in the air: must come after return or land")
            case MissionStep() | ReturnStep() | LandStep() if not in_air:
                raise ConfigError(f"{at}: robots are on the ground: must come after takeoff")
            case MissionStep() if flown:
                raise ConfigError(f"{at}: return or land must come between two missions")
            case TakeoffStep():
                in_air, flown = True, False
            case MissionStep():
                flown = True
            case ReturnStep() | LandStep():
                in_air = False
    if not isinstance(steps[-1], ReturnStep | LandStep):
        last = _NAMES[type(steps[-1])]
        raise ConfigError(f"{where}: the last step is {last!r}: must be 'return' or 'land'")


class ScriptListener(Protocol):
    """Listener to the progress of a script."""

    def step(self, name: str, at_most_s: float | None) -> None:
        """Begin a step that takes at most `at_most_s`; None if that is not limited."""

    def line(self, text: str) -> None:
        """Show a line about an event."""

    def confirm(self, question: str) -> bool:
        """Ask a person whether to go on."""
        ...


class ScriptError(RuntimeError):
    """A failed step; the message says which and why.

    `hold`: robots in flight should be held. False if another operator commands the fleet to hold,
    return or land, or robots are landing.
    """

    def __init__(self, text: str, *, hold: bool = True) -> None:
        super().__init__(text)
        self.hold = hold


class ScriptRun:
    """One run of a script, for `robots`; those that it has handed to a pilot are in `piloted`.

    Set `mission_ends` to end the mission early and go on with the next step, without further
    takeoffs. `fly` and `hold` are procedures (see `lpac.ground.procedure`).
    """

    def __init__(
        self, script: Script, sites: Sites, ground: Ground, listener: ScriptListener
    ) -> None:
        """Raises ValueError if the script names a robot that the fleet does not have."""
        try:
            self.robots = addressed(ground.setup, script.robots)
            for step in (*script.before, *script.steps):
                for name in _names(step):
                    addressed(ground.setup, [name])
                    if isinstance(step, MissionStep) and name not in self.robots:
                        raise ValueError(
                            f"perturb: robot {name!r} is not among the script's robots"
                        )
        except ValueError as error:
            raise ConfigError(f"{script.path}: {error}") from None
        self._script = script
        self._sites = sites
        self._ground = ground
        self._listener = listener
        self.piloted: set[str] = set()
        self.mission_ends = False
        self._reported: set[Hashable] = set()
        self._last_start_s: dict[str, float] = {}

    def fly(self) -> Procedure[None]:
        """Run all steps of all trials. Raises ScriptError.

        After an error, robots in flight fly on: call `hold`, also after a KeyboardInterrupt.
        """
        script = self._script
        for i, step in enumerate(script.before):
            yield from self._run_step(step, f"before[{i}]", "")
        first = self._first_number()
        for trial in range(1, script.trials + 1):
            count = f"trial {trial} of {script.trials}: " if script.trials > 1 else ""
            self._reported.clear()
            self.piloted.clear()
            if trial > 1 and not self._listener.confirm(f"{count}let the robots take off again?"):
                raise ScriptError(f"{count}declined", hold=False)
            yield from self._begin_trial(first + trial - 1, count)
            for i, step in enumerate(script.steps):
                yield from self._run_step(step, f"steps[{i}]", count)

    def hold(self) -> Procedure[str]:
        """Hold robots in flight; return the result and what to do next, in words."""
        # With old statuses too: a robot that is silent now may be in the air.
        last = [r.status for r in self._ground.snapshot.robots if r.name in self.robots]
        if all(status is None or is_down(status) for status in last):
            return "no robot is in the air"
        report = yield SafetyCommand("hold", self._script.robots)
        done = "hold is commanded"
        if not report.done:
            done += f", but {failures(report)}"
        return f"{done}: next `lpac mission land`, `lpac mission return` or `lpac mission resume`"

    def _run_step(self, step: Step, where: str, count: str) -> Procedure[None]:
        name = f"{count}{_NAMES[type(step)]}"
        try:
            if self.mission_ends and isinstance(step, TakeoffStep):
                raise ScriptError("stopped", hold=False)
            if isinstance(step, MissionStep):
                # The mission's time counts from when all robots fly it.
                self._listener.step(f"{count}start", None)
                yield from self._require_of_flying(Start(self._script.robots))
            self._listener.step(name, _duration_s(step))
            yield from self._execute(step)
        except ScriptError as error:
            raise ScriptError(f"{name} ({where}): {error}", hold=error.hold) from None
        except ValueError as error:
            raise ScriptError(f"{name} ({where}): {error}") from None

    def _execute(self, step: Step) -> Procedure[None]:
        robots = self._script.robots
        match step:
            case OriginStep():
                yield from self._set_origin(step)
            case SiteStep():
                site = self._sites.load(step.name)
                _require((yield from take_site(site, self._ground.setup, self.robots)))
                self._sites.use(step.name)
            case WorldStep():
                yield from self._require(_set_world(self._script.path, step, robots))
            case PreflightStep():
                yield from self._prepare(step)
            case TakeoffStep():
                yield from self._require_of_flying(
                    Takeoff(robots, step.interval_s, step.abort_on_failure)
                )
            case MissionStep():
                yield from self._fly_mission(step)
            case ReturnStep():
                # Not followed by a hold, which would keep landing robots in the air.
                yield from self._require(SafetyCommand("return", robots, wait=True), hold=False)
            case LandStep():
                yield from self._require(SafetyCommand("land", robots, wait=True), hold=False)

    def _first_number(self) -> int:
        """Number of the first trial: a repeated script continues the numbering."""
        name = re.escape(self._script.trial)
        match = re.fullmatch(rf"{name}-(\d{{1,6}})", self._ground.snapshot.state.trial)
        return 1 if match is None else int(match[1]) + 1

    def _begin_trial(self, number: int, count: str) -> Procedure[None]:
        trial = f"{self._script.trial}-{number}" if self._script.trial else ""
        name = f"{count}reset maps"
        self._listener.step(name, None)
        try:
            yield from self._require(NextTrial(trial, self._script.robots))
        except ScriptError as error:
            raise ScriptError(f"{name}: {error}") from None

    def _set_origin(self, step: OriginStep) -> Procedure[None]:
        origin = step.given()
        if origin is None:
            found = yield from collect_statuses(self._ground, _names(step), step.average_s)
            stands = [standing(name, statuses) for name, statuses in found.items()]
            origin = origin_at(stands[0], stands[1] if len(stands) > 1 else None)
        self._listener.line(
            f"origin {origin.latitude_deg:.7f} {origin.longitude_deg:.7f}, heading "
            f"{origin.heading_deg:.1f} deg"
        )
        yield from self._require(SetOrigin(origin, self._script.robots))

    def _prepare(self, step: PreflightStep) -> Procedure[None]:
        state, ids = self._ground.snapshot.state, self._ground.setup.robots
        if any(state.safety_action_for(ids[r]) in ("return", "land") for r in self.robots):
            # Withdraw the end of the last trial, which keeps robots on the ground.
            yield from self._require(Resume(self._script.robots))
        began_s = self._ground.now_s
        report = yield Enable(True, self._script.robots)
        snapshot = yield from fresh_snapshot(self._ground)
        statuses = self._statuses(snapshot)
        not_yet = {r.robot for r in report.results if not r.done}
        if report.problem or not all(
            n in statuses and statuses[n].state in _BEFORE_READY for n in not_yet
        ):
            raise ScriptError(failures(report))

        def ready(snapshot: FleetSnapshot) -> bool:
            missing = self._not_ready(snapshot)
            # At first all checks fail.
            if self._ground.now_s - began_s > min(5.0, step.at_most_s / 2.0):
                for what, text in missing.items():
                    self._report_once(what, text)
            return not missing

        left_s = began_s + step.at_most_s - self._ground.now_s
        if not (yield Until(ready, max(0.0, left_s))):
            missing = self._not_ready(self._ground.snapshot)
            raise ScriptError(
                f"not ready after {step.at_most_s:g} s: {'; '.join(missing.values())}"
            )

    def _not_ready(self, snapshot: FleetSnapshot) -> dict[Hashable, str]:
        """Why robots are not ready, in words; the key identifies each reason."""
        missing: dict[Hashable, str] = {}
        statuses = self._statuses(snapshot)
        for name in self.robots:
            status = statuses.get(name)
            action = snapshot.state.safety_action_for(status.robot_id) if status else "none"
            if status is None:
                missing[name, NOT_HEARD] = f"{name} is {NOT_HEARD}"
            elif action != "none":
                text = f"{name} is commanded to {action}: `lpac mission resume` withdraws it"
                missing[name, action] = text
            elif status.state is not _S.PREFLIGHT:
                text = f"{name} is in {state_and_reason(status)}"
                missing[name, status.state, status.reason.code] = text
            elif not status.ready:
                codes = (check.code for check in status.failed_checks)
                missing[name, *codes] = f"{name}: {missing_checks(status)}"
        return missing

    def _fly_mission(self, step: MissionStep) -> Procedure[None]:
        # An older snapshot may show robots before their start.
        yield from fresh_snapshot(self._ground)
        began_s = self._ground.now_s
        due = step.in_time()
        before = dict.fromkeys(self.robots, _S.MISSION)
        to_restart: set[str] = set()
        while (left_s := began_s + step.duration_s - self._ground.now_s) > 0.0:
            if self.mission_ends:
                return
            while due and self._ground.now_s - began_s >= due[0].at_s:
                yield from self._perturb(due.pop(0))
            free_s = min([left_s, *(began_s + p.at_s - self._ground.now_s for p in due)])
            snapshot = self._ground.snapshot
            self._check_other_commander(snapshot)
            statuses = self._statuses(snapshot)
            for name in self.robots:
                status = statuses.get(name)
                if status is None:
                    self._report_once((name, NOT_HEARD), f"{name} is {NOT_HEARD}")
                    continue
                action = _action_for(snapshot.ground, status.robot_id)
                commanded = name in self.piloted or action != "none"
                if status.state is not _S.HOLD or commanded:
                    to_restart.discard(name)
                if before[name] is _S.MISSION and status.state is not _S.MISSION and not commanded:
                    text = f"{name} left the mission: {state_and_reason(status)}"
                    self._report_once((name, status.state, status.reason.code), text)
                    if status.state is _S.HOLD:
                        to_restart.add(name)
                before[name] = status.state
                if step.restart and name in to_restart and free_s > _MAX_START_S:
                    yield from self._restart(name)
            if len(statuses) == len(self.robots) and all(map(is_down, statuses.values())):
                raise ScriptError("no robot is in the air any more")
            yield Until(lambda _: False, max(_MIN_WAIT_S, min(free_s, _PERIOD_S)))

    def _restart(self, name: str) -> Procedure[None]:
        if self._ground.now_s - self._last_start_s.get(name, -math.inf) < _RESTART_PERIOD_S:
            return
        self._last_start_s[name] = self._ground.now_s
        report = yield Start((name,))
        if not report.done:
            text = f"{name} is not restarted: {failures(report)}"
            codes = (report.problem and report.problem.code, *map(_codes, report.results))
            self._report_once((name, "not started", codes), text)

    def _perturb(self, perturbation: Perturbation) -> Procedure[None]:
        name = perturbation.robot
        yield from self._require_of_flying(RobotCommand(perturbation.do, (name,)))
        if perturbation.do == "pilot":
            self.piloted.add(name)
            self._listener.line(f"{name} is handed to a pilot")
            return

        def holds(snapshot: FleetSnapshot) -> bool:
            status = self._statuses(snapshot).get(name)
            return status is not None and status.state is _S.HOLD

        if not (yield Until(holds, _REJOIN_TIMEOUT_S)):
            self._check_other_commander(self._ground.snapshot)
            raise ScriptError(f"{name} does not hold")
        yield from self._require_of_flying(Start((name,)))
        self.piloted.discard(name)
        self._listener.line(f"{name} is back in the mission")

    def _check_other_commander(self, snapshot: FleetSnapshot) -> None:
        """Raise ScriptError if all robots have a safety command, since the script gives none."""
        ground = snapshot.ground
        actions = [_action_for(ground, self._ground.setup.robots[name]) for name in self.robots]
        if ground is not None and "none" not in actions:
            by = ground.safety_action_by or ground.operator
            raise ScriptError(f"{by} commands {actions[0]}: the script ends", hold=False)

    def _statuses(self, snapshot: FleetSnapshot) -> dict[str, RobotStatus]:
        """Fresh statuses of the script's robots."""
        return {
            robot.name: robot.status
            for robot in snapshot.robots
            if robot.name in self.robots and robot.status is not None and robot.fresh
        }

    def _require(self, request: Request, *, hold: bool = True) -> Procedure[None]:
        _require((yield request), hold=hold)

    def _require_of_flying(self, request: Takeoff | Start | RobotCommand) -> Procedure[None]:
        """Give a command in flight. If it fails, another operator's command is reported first."""
        report = yield request
        if not report.done:
            snapshot = yield from fresh_snapshot(self._ground)
            # On the ground, the last landing's command may still be in force.
            if not all(map(is_down, self._statuses(snapshot).values())):
                self._check_other_commander(snapshot)
            raise ScriptError(failures(report))

    def _report_once(self, what: Hashable, text: str) -> None:
        """Show a text, unless one with the same key was shown, such as with other numbers."""
        if what not in self._reported:
            self._reported.add(what)
            self._listener.line(text)


def take_site(
    site: SavedSite, setup: FleetSetup, robots: Collection[str]
) -> Procedure[CommandReport]:
    """Give robots a site's origin, fence and places; each robot keeps its height.

    A place may be impossible in a robot's present fence, or the other way round, so failed requests
    are repeated once after the others. Raises ValueError.
    """
    robots = addressed(setup, robots)
    requests: tuple[Request, ...] = (
        SetOrigin(site.origin, robots),
        SetFence(site.fence, robots),
        SetPlaces(places_at(site, setup, robots)),
    )
    reports: dict[int, CommandReport] = {}
    for i in (0, 1, 2, 0, 1, 2):
        if i not in reports or not reports[i].done:
            reports[i] = yield requests[i]
            if reports[i].problem:
                return reports[i]
    results = []
    for name in robots:
        failed = (
            result
            for report in reports.values()
            for result in report.results
            if result.robot == name and not result.done
        )
        done = RobotResult(name, ResultCode.DONE, "has origin, fence and place")
        results.append(next(failed, done))
    return CommandReport(tuple(results))


def _require(report: CommandReport, *, hold: bool = True) -> None:
    if not report.done:
        raise ScriptError(failures(report), hold=hold)


def _codes(result: RobotResult) -> tuple[str | None, ...]:
    return result.code, result.refusal


def failures(report: CommandReport) -> str:
    """Describe why a command was not done."""
    if report.problem is not None:
        return report.problem.text
    return "; ".join(f"{r.robot}: {r.text}" for r in report.results if not r.done)


def _action_for(ground: GroundState | None, robot_id: int) -> str:
    """Safety action commanded to a robot; hold if it is not enabled."""
    if ground is None:
        return "none"
    safety_action = ground.safety_action_for(robot_id)
    return "hold" if safety_action == "none" and not ground.enabled_for(robot_id) else safety_action


def _duration_s(step: Step) -> float | None:
    match step:
        case PreflightStep():
            return step.at_most_s
        case MissionStep():
            return step.duration_s
        case OriginStep() if step.from_robot:
            return step.average_s
    return None


def _names(step: Step) -> list[str]:
    match step:
        case OriginStep():
            return [name for name in (step.from_robot, step.toward_robot) if name]
        case MissionStep():
            return [perturbation.robot for perturbation in step.perturb]
    return []
