"""Scripted flight of a simulated fleet, from takeoff to landing, by the real ground station.

It is carried out on the simulated clock (`clocked`), or over the socket of `lpac ground` with
robots as processes (`flight`).
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from edge.core.vehicle import PILOTED
from edge.messages.mission import FlightState
from lpac.analysis.flight import ScriptCommand
from lpac.analysis.snapshot import FleetSnapshot
from lpac.ground.procedure import Ground, NoSnapshotError, Procedure, Until
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
from lpac.sim.fleet.listener import Report

_PREFLIGHT_S = 60.0
# Time for the programs to start and connect: base, and for each robot.
_ASSEMBLE_S, _ASSEMBLE_EACH_S = 30.0, 3.0
# On a busy machine robots may be late to reach their heights: all land, and take off again.
_MOST_TAKEOFFS = 3
_REJOIN_AGAIN_S = 3.0


class CommandOutcome(NamedTuple):
    """A command and its report."""

    request: Request
    report: CommandReport


class ScriptedFlight(ScriptListener):
    """One flight by the procedures `fly`, and `land` if that cannot go on.

    `at` is the current step. `began_s` has the first start of each step on the ground station's
    clock, `commands` all commands.
    """

    def __init__(
        self,
        ground: Ground,
        fleet_toml: Path,
        mission_s: float,
        *,
        perturb: tuple[Perturbation, ...] = (),
        on_step: Callable[[str], None] = lambda _: None,
        report: Report = lambda _: None,
    ) -> None:
        """`on_step` gets each step as it begins, `report` events that are not in the script.

        `perturb` is passed to `MissionStep`.
        """
        self.began_s: dict[str, float] = {}
        self.commands: list[CommandOutcome] = []
        self.at = ""
        self._rejoined_s = -math.inf
        self._ground = ground
        self._on_step = on_step
        self._report = report
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
        """Fly from the first status to the last disarming; returns the problem, if any.

        After a problem all land where they are.
        """
        self.step("assemble", None)
        at_most_s = _ASSEMBLE_S + _ASSEMBLE_EACH_S * len(self._ground.setup.robots)
        if not (yield Until(lambda snapshot: not _silent(snapshot), at_most_s)):
            return f"no status came from {', '.join(_silent(self._ground.snapshot))}"
        for takeoffs in range(1, _MOST_TAKEOFFS + 1):
            try:
                yield from self._supervised(self._run.fly())
            except (ScriptError, NoSnapshotError) as error:
                problem = str(error)
            else:
                return None
            also = yield from self.land()
            if also is not None:
                problem = f"{problem}; {also}"
            if also is not None or "start" in self.began_s or "takeoff" not in self.began_s:
                break
            if takeoffs < _MOST_TAKEOFFS:
                self._report(f"all take off again: {problem}")
        return problem

    def land(self) -> Procedure[str | None]:
        """Land all where they are; returns the problem, if any."""
        if all(r.status is None or is_down(r.status) for r in self._ground.snapshot.robots):
            return None
        self.step("land", None)
        yield from self._rejoin()
        report = yield from self._command(SafetyCommand("land", wait=True))
        return None if report.done else failures(report)

    def stop(self) -> None:
        """End the mission now: all return and land."""
        self._run.mission_ends = True

    def recorded_commands(self) -> tuple[ScriptCommand, ...]:
        """`commands` for the flight record."""
        return tuple(
            ScriptCommand(
                in_words(request),
                report.done,
                report.problem.code if report.problem else None,
                {result.robot: result.code for result in report.results},
            )
            for request, report in self.commands
        )

    def _supervised(self, script: Procedure[None]) -> Procedure[None]:
        """Run the script, record its commands, and rejoin robots that left offboard."""
        answer: CommandReport | bool | None = None
        while True:
            try:
                wanted = script.send(answer)
            except StopIteration:
                return
            yield from self._rejoin()
            if isinstance(wanted, Until):
                answer = yield wanted
            else:
                answer = yield from self._command(wanted)

    def _command(self, request: Request) -> Procedure[CommandReport]:
        report: CommandReport = yield request
        self.commands.append(CommandOutcome(request, report))
        return report

    def _rejoin(self) -> Procedure[None]:
        """Rejoin vehicles that left offboard on their own, as on a busy machine.

        Vehicles that the script gave to a pilot are left alone.
        """
        left = tuple(
            robot.name
            for robot in self._ground.snapshot.robots
            if robot.status and robot.status.state is FlightState.PILOT
            and robot.status.mode not in PILOTED and robot.name not in self._run.piloted
        )  # fmt: skip
        if not left or self._ground.now_s - self._rejoined_s < _REJOIN_AGAIN_S:
            return
        self._rejoined_s = self._ground.now_s
        self._report(f"{', '.join(left)} left offboard: sent rejoin")
        yield from self._command(RobotCommand("rejoin", left))
        if self.at == "mission":
            yield from self._command(Start(left))

    def step(self, name: str, at_most_s: float | None) -> None:
        """Record the start of a step."""
        self.began_s.setdefault(name, self._ground.now_s)
        self.at = name
        self._on_step(name)

    def line(self, text: str) -> None:
        """Report a line of text."""
        self._report(text)

    def confirm(self, question: str) -> bool:
        """Continue without asking: there is one trial."""
        return True


def _silent(snapshot: FleetSnapshot) -> list[str]:
    """Names of the robots without a fresh status."""
    return [robot.name for robot in snapshot.robots if not robot.fresh]
