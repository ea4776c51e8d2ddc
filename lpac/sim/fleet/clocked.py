"""One flight of a fleet on the simulated clock, by a script of the real ground."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from edge.messages.mission import RobotStatus
from lpac.ground.procedure import NothingComesError
from lpac.ground.station.protocol import SNAPSHOT_PERIOD_S
from lpac.sim.fleet.flight import FleetFlight, RobotRecord, flight_of
from lpac.sim.fleet.layout import FleetScenario
from lpac.sim.fleet.listener import Heard, Say
from lpac.sim.fleet.scripted import ScriptedFlight
from lpac.sim.fleet.simulated import SimulatedFleet
from lpac.sim.fleet.vehicles import TrueTrack


def fly_simulated(
    scenario: FleetScenario,
    folder: Path,
    bundle: Path,
    say: Say = lambda _: None,
    *,
    logs: bool = False,
    recorded: Path | None = None,
) -> FleetFlight:
    """Prepare a fleet in `folder`, fly a mission of `scenario.duration_s`, and land.

    With `logs` the robots write theirs in `folder`; `recorded` is the folder of such a flight,
    whose policies' steps are taken again. Raises what `SimulatedFleet` does, and RecordingError.
    """
    earlier = set(folder.rglob("*.mcap"))
    fleet = SimulatedFleet(scenario, folder, bundle, logs=logs, recorded=recorded)
    ground = fleet.ground
    flight = ScriptedFlight(
        ground, folder / "fleet.toml", scenario.duration_s, on_step=say, say=say
    )
    notes = _Notes(fleet)
    try:
        problem = ground.carry_out(flight.fly())
    except NothingComesError as error:
        problem = str(error)
    fleet.close()
    return notes.flight(flight, problem, sorted(set(folder.rglob("*.mcap")) - earlier))


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

    def flight(
        self, flown: ScriptedFlight, problem: str | None, logs: Sequence[Path]
    ) -> FleetFlight:
        self._look()
        began_s = flown.began_s | {"end": self._fleet.ground.now_s}
        last_s = began_s.get("return", began_s["end"])
        return flight_of(
            self._fleet.layout,
            "simulated",
            [
                RobotRecord(
                    tuple(history),
                    track,
                    _last(history, last_s),
                    logs=tuple(
                        str(path.relative_to(self._fleet.folder))
                        for path in logs
                        if path.is_relative_to(robot.config.log.folder)
                    ),
                )
                for history, track, robot in zip(
                    self._heard, self._tracks(), self._fleet.robots, strict=True
                )
            ],
            0.0,
            began_s,
            problem=problem,
            commands=tuple(flown.commands),
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
