"""The flight of a simulated fleet, from takeoff to landing: a script of the real ground.

Whoever has the ground carries it out: on the simulated clock (`clocked`), or over the socket of
`lpac ground`, with robots that are processes (`flight`).
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from edge.core.vehicle import PILOTED
from edge.messages.mission import FlightState
from lpac.analysis.flight import ScriptCommand
from lpac.analysis.snapshot import FleetSnapshot
from lpac.ground.procedure import Ground, NothingComesError, Procedure, Until
from lpac.ground.script import (
    MissionStep,
    OriginStep,
    Perturbation,
    PreflightStep,
    ReturnStep,
    Script,
    ScriptError,
    ScriptListener,
    ScriptRun,
    TakeoffStep,
    failures,
)
from lpac.ground.site import Sites
from lpac.ground.station.protocol import (
    CommandReport,
    Request,
    RobotCommand,
    SafetyCommand,
    Start,
    in_words,
)
from lpac.ground.station.station import is_down
from lpac.sim.fleet.layout import ORIGIN
from lpac.sim.fleet.listener import Say

_PREFLIGHT_S = 60.0
# How long robots' programs, and each one more, take to start and to be heard.
_ASSEMBLE_S, _ASSEMBLE_EACH_S = 30.0, 3.0
# A busy machine holds robots up on their way to their heights: all land, and take off again.
_MOST_TAKEOFFS = 3
_TAKE_BACK_AGAIN_S = 3.0


class CommandOutcome(NamedTuple):
    """A command, and its outcome."""

    request: Request
    report: CommandReport


class ScriptedFlight(ScriptListener):
    """One flight: `fly`, and `land` if that cannot go on, are procedures.

    `at` is the step that it is at. `began_s` tells when each began first (the ground's clock),
    `commands` is all that was commanded.
    """

    def __init__(
        self,
        ground: Ground,
        fleet_toml: Path,
        mission_s: float,
        *,
        perturb: tuple[Perturbation, ...] = (),
        on_step: Callable[[str], None] = lambda _: None,
        say: Say = lambda _: None,
    ) -> None:
        """`on_step` is told each step that begins, `say` what robots do that no script has.

        `perturb` is what a `MissionStep` has.
        """
        self.began_s: dict[str, float] = {}
        self.commands: list[CommandOutcome] = []
        self.at = ""
        self._taken_back_s = -math.inf
        self._ground = ground
        self._on_step = on_step
        self._say = say
        script = Script(
            path=fleet_toml,
            trial="flight",
            trials=1,
            robots=(),
            before=(OriginStep(ORIGIN.latitude_deg, ORIGIN.longitude_deg, ORIGIN.heading_deg),),
            steps=(
                PreflightStep(_PREFLIGHT_S), TakeoffStep(),
                MissionStep(mission_s, restart=True, perturb=perturb), ReturnStep(),
            ),
        )  # fmt: skip
        self._run = ScriptRun(script, Sites(fleet_toml), ground, self)

    def fly(self) -> Procedure[str | None]:
        """From the first status to the last disarming; what kept it from its end, if anything.

        All land then where they are.
        """
        self.step("assemble", None)
        at_most_s = _ASSEMBLE_S + _ASSEMBLE_EACH_S * len(self._ground.setup.robots)
        if not (yield Until(lambda told: not _silent(told), at_most_s)):
            return f"{', '.join(_silent(self._ground.snapshot))} were not heard"
        for takeoffs in range(1, _MOST_TAKEOFFS + 1):
            try:
                yield from self._beside(self._run.fly())
            except (ScriptError, NothingComesError) as error:
                problem = str(error)
            else:
                return None
            also = yield from self.land()
            if also is not None:
                problem = f"{problem}; {also}"
            if also is not None or "start" in self.began_s or "takeoff" not in self.began_s:
                break
            if takeoffs < _MOST_TAKEOFFS:
                self._say(f"all take off again: {problem}")
        return problem

    def land(self) -> Procedure[str | None]:
        """All land where they are; why not, if somebody does not."""
        if all(r.status is None or is_down(r.status) for r in self._ground.snapshot.robots):
            return None
        self.step("land", None)
        yield from self._take_back()
        report = yield from self._command(SafetyCommand("land", wait=True))
        return None if report.done else failures(report)

    def stop(self) -> None:
        """End the mission now: all return, and land."""
        self._run.mission_ends = True

    def told_commands(self) -> tuple[ScriptCommand, ...]:
        """`commands` as a record has them."""
        return tuple(
            ScriptCommand(
                in_words(request),
                report.done,
                report.problem.code if report.problem else None,
                {result.robot: result.code for result in report.results},
            )
            for request, report in self.commands
        )

    def _beside(self, script: Procedure[None]) -> Procedure[None]:
        """The script, whose commands are noted; beside it robots are taken back."""
        answer: CommandReport | bool | None = None
        while True:
            try:
                wanted = script.send(answer)
            except StopIteration:
                return
            yield from self._take_back()
            if isinstance(wanted, Until):
                answer = yield wanted
            else:
                answer = yield from self._command(wanted)

    def _command(self, request: Request) -> Procedure[CommandReport]:
        report: CommandReport = yield request
        self.commands.append(CommandOutcome(request, report))
        return report

    def _take_back(self) -> Procedure[None]:
        """Let a vehicle fly on that left offboard by itself, as on a busy machine.

        Whom the script gives to a pilot is left to that one.
        """
        left = tuple(
            robot.name
            for robot in self._ground.snapshot.robots
            if robot.status and robot.status.state is FlightState.PILOT
            and robot.status.mode not in PILOTED and robot.name not in self._run.given
        )  # fmt: skip
        if not left or self._ground.now_s - self._taken_back_s < _TAKE_BACK_AGAIN_S:
            return
        self._taken_back_s = self._ground.now_s
        self._say(f"{', '.join(left)} left offboard: taken back")
        yield from self._command(RobotCommand("rejoin", left))
        if self.at == "mission":
            yield from self._command(Start(left))

    def step(self, name: str, at_most_s: float | None) -> None:
        """A step begins."""
        self.began_s.setdefault(name, self._ground.now_s)
        self.at = name
        self._on_step(name)

    def line(self, text: str) -> None:
        """Something is worth a line."""
        self._say(text)

    def may(self, question: str) -> bool:
        """There is one trial."""
        return True


def _silent(snapshot: FleetSnapshot) -> list[str]:
    """The robots that are not heard."""
    return [robot.name for robot in snapshot.robots if not robot.fresh]
