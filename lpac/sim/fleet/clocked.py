"""One flight of a fleet on the simulated clock, by a script of the real ground."""

from pathlib import Path

import numpy as np

from edge.messages.mission import RobotStatus
from lpac.ground.procedure import NothingComesError
from lpac.ground.script import (
    LandStep,
    MissionStep,
    OriginStep,
    PreflightStep,
    ReturnStep,
    Script,
    ScriptError,
    ScriptListener,
    ScriptRun,
    TakeoffStep,
)
from lpac.ground.site import Sites
from lpac.ground.station.protocol import SNAPSHOT_PERIOD_S
from lpac.sim.fleet.flight import FleetFlight, RobotRecord, flight_of
from lpac.sim.fleet.layout import ORIGIN, FleetScenario
from lpac.sim.fleet.simulated import SimulatedFleet
from lpac.sim.fleet.vehicles import TrueTrack
from lpac.sim.operator import Heard, Say

_PREFLIGHT_S = 60.0


def fly_simulated(
    scenario: FleetScenario, folder: Path, bundle: Path, say: Say = lambda _: None
) -> FleetFlight:
    """Prepare a fleet in `folder`, fly a mission of `scenario.duration_s`, and land.

    A script that fails lands the robots where they are. Raises what `SimulatedFleet` does.
    """
    fleet = SimulatedFleet(scenario, folder, bundle)
    ground, listener = fleet.ground, _Listener(fleet, say)
    script = Script(
        path=folder / "fleet.toml",
        trial="flight",
        trials=1,
        robots=(),
        before=(OriginStep(ORIGIN.latitude_deg, ORIGIN.longitude_deg, ORIGIN.heading_deg),),
        steps=(
            PreflightStep(_PREFLIGHT_S), TakeoffStep(), MissionStep(scenario.duration_s),
            ReturnStep(),
        ),
    )  # fmt: skip
    notes = _Notes(fleet)
    sites = Sites(folder / "fleet.toml")
    problem = None
    try:
        ground.carry_out(ScriptRun(script, sites, ground, listener).fly())
    except (ScriptError, NothingComesError) as error:
        problem = str(error)
        listener.step("land", None)
        down = Script(script.path, "", 1, (), (), (LandStep(),))
        try:
            ground.carry_out(ScriptRun(down, sites, ground, listener).fly())
        except (ScriptError, NothingComesError) as also:
            problem = f"{problem}; {also}"
    return notes.flight(listener.began_s | {"end": ground.now_s}, problem)


class _Listener(ScriptListener):
    """Notes when each step of the script began."""

    def __init__(self, fleet: SimulatedFleet, say: Say) -> None:
        self.began_s: dict[str, float] = {}
        self._fleet = fleet
        self._say = say

    def step(self, name: str, at_most_s: float | None) -> None:
        """A step begins."""
        self.began_s.setdefault(name, self._fleet.ground.now_s)
        self._say(name)

    def line(self, text: str) -> None:
        """Something is worth a line."""
        self._say(text)

    def may(self, question: str) -> bool:
        """There is one trial."""
        return True


class _Notes:
    """What the ground heard of each robot, as it came."""

    def __init__(self, fleet: SimulatedFleet) -> None:
        self._fleet = fleet
        self._heard: list[list[Heard]] = [[] for _ in fleet.robots]
        fleet.schedule.every(SNAPSHOT_PERIOD_S, self._look)

    def _look(self) -> None:
        for robot, history in zip(
            self._fleet.ground.node.snapshot.robots, self._heard, strict=True
        ):
            if robot.status is None or robot.age_s is None:
                continue
            if not history or history[-1].status.sequence != robot.status.sequence:
                history.append(Heard(self._fleet.ground.now_s - robot.age_s, robot.status))

    def flight(self, began_s: dict[str, float], problem: str | None) -> FleetFlight:
        self._look()
        last_s = began_s.get("return", began_s["end"])
        return flight_of(
            self._fleet.layout,
            "simulated",
            [
                RobotRecord(tuple(history), track, _last(history, last_s))
                for history, track in zip(self._heard, self._tracks(), strict=True)
            ],
            0.0,
            began_s,
            problem=problem,
        )

    def _tracks(self) -> list[TrueTrack]:
        truths = [each.vehicle.truth for each in self._fleet.vehicles]
        return [
            TrueTrack(
                time_s=np.array([entry.time_s for entry in truth]),
                position_m=np.array([entry.position_m for entry in truth]).reshape(-1, 3),
                airborne=np.array([not entry.landed for entry in truth], np.bool_),
            )
            for truth in truths
        ]


def _last(history: list[Heard], until_s: float) -> RobotStatus | None:
    past = [heard.status for heard in history if heard.at_s <= until_s]
    return past[-1] if past else None
