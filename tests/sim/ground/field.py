"""Robots and grounds on one simulated clock, for tests of what they do together.

Robots fly as they do on a drone; a test begins with a copy of a fleet that has come so far.
"""

import gc
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np

from edge.identity.members import Role
from edge.messages.mission import FlightState
from lpac.analysis.snapshot import GroundEvent
from lpac.ground.station.commands import Commands, CommandTask
from lpac.ground.station.protocol import (
    CommandReport,
    Enable,
    Request,
    SetOrigin,
    Start,
    Takeoff,
)
from lpac.ground.station.station import Station
from lpac.sim.air import Air
from lpac.sim.fleet.layout import ORIGIN
from lpac.sim.fleet.robots import SimulatedRobot
from lpac.sim.fleet.simulated import SimulatedFleet
from lpac.sim.px4.direct import DirectVehicle
from lpac.sim.px4.vehicle import Px4Vehicle
from lpac.sim.scenario import Scenario
from tests.conftest import SHIPPED
from tests.flown import PRECISE, QUICK, FlownRobot

_S = FlightState
STEP_S = 0.05
# What robots think and say to each other matters little here, and takes the most time.
SPARING = {"rates": {"perception_hz": 2.0, "policy_hz": 2.0, "control_hz": 5.0}}

# How far a fleet has come: its robots have found themselves; are ready; hover; fly the mission.
Stage = Literal["standing", "ready", "hovering", "flying"]


class FieldRobot(FlownRobot):
    """One robot, and whether its radio works."""

    def __init__(self, fleet: SimulatedFleet, robot: SimulatedRobot) -> None:
        super().__init__(robot)
        self._fleet = fleet

    @property
    def silent(self) -> bool:
        return self.robot_id in self._fleet.radio.air.silent

    @silent.setter
    def silent(self, silent: bool) -> None:
        """Whether nobody hears it."""
        air = self._fleet.radio.air
        others = air.silent - {self.robot_id}
        self._fleet.radio.air = replace(air, silent=others | ({self.robot_id} if silent else set()))

    @property
    def deaf(self) -> bool:
        return self.robot_id in self._fleet.radio.air.deaf

    @deaf.setter
    def deaf(self, deaf: bool) -> None:
        """Whether it hears nobody."""
        air = self._fleet.radio.air
        others = air.deaf - {self.robot_id}
        self._fleet.radio.air = replace(air, deaf=others | ({self.robot_id} if deaf else set()))


class Field:
    """A fleet, its grounds, and the time that passes."""

    def __init__(self, fleet: SimulatedFleet) -> None:
        self.fleet = fleet
        self.robots = [FieldRobot(fleet, robot) for robot in fleet.robots]

    @property
    def now_s(self) -> float:
        return self.fleet.schedule.monotonic_s()

    @property
    def stations(self) -> Mapping[str, Station]:
        """Of the grounds that run."""
        grounds = self.fleet.grounds
        return {n: g.node.station for n, g in grounds.items() if g.runs}

    @property
    def commands(self) -> Mapping[str, Commands]:
        return {name: self.fleet.grounds[name].node.commands for name in self.stations}

    @property
    def events(self) -> list[GroundEvent]:
        """What the first ground told."""
        return self.fleet.ground.events

    @property
    def air(self) -> Air:
        return self.fleet.radio.air

    @air.setter
    def air(self, air: Air) -> None:
        self.fleet.radio.air = air

    def cut(self, some: Sequence[str], others: Sequence[str]) -> None:
        """These grounds and robots, and those, hear nothing of each other."""
        groups = tuple(frozenset(map(self._station, group)) for group in (some, others))
        self.air = replace(self.air, partition=groups)

    def mend(self) -> None:
        """Nobody is cut off."""
        self.air = replace(self.air, partition=())

    def _station(self, name: str) -> int:
        grounds = self.fleet.grounds
        return grounds[name].station_id if name in grounds else int(name.removeprefix("r"))

    def join(self, name: str, role: Role = Role.OPERATOR) -> Station:
        """Start a ground, or start it again: as on another computer, it remembers nothing."""
        return self.fleet.join(name, role, remembers=False).node.station

    def restart(self, name: str, away_s: float = 0.5) -> Station:
        """As on the same laptop, where the last process' memory is."""
        self.leave(name)
        self.run(away_s)
        return self.fleet.join(name).node.station

    def leave(self, name: str) -> None:
        self.fleet.grounds[name].leave()

    def second_program(self, robot_id: int) -> FieldRobot:
        """Another computer that says it is this robot, with a vehicle beside the field."""
        vehicle = Px4Vehicle(seed=99, start_m=self.fleet.layout.to_world_m(np.array([31.0, 31.0])))
        clock = self.fleet.schedule
        robot = self.fleet.second_program(robot_id, DirectVehicle(vehicle, robot_id + 1, clock))
        robot.start()
        return FieldRobot(self.fleet, robot)

    def copy(self) -> "Field":
        """The same once more, to which other things happen."""
        for robot in self.robots:
            robot.vehicle.truth.clear()
        return Field(self.fleet.copy())

    def step(self) -> None:
        self.run(STEP_S)

    def run(self, duration_s: float) -> None:
        self.fleet.schedule.run_until(self.now_s + duration_s)

    def until(self, condition: Callable[[], object], timeout_s: float = 60.0) -> None:
        end_s = self.now_s + timeout_s
        while not condition():
            assert self.now_s < end_s, [(r.state, r.said.reason) for r in self.robots]
            self.step()

    def begin(self, request: Request, by: str = "alice") -> CommandTask:
        task = self.fleet.grounds[by].node.begin(request)
        assert task is not None
        return task

    def do(self, request: Request, by: str = "alice") -> CommandReport:
        running = self.begin(request, by)
        self.until(lambda: running.report, 300.0)
        assert running.report is not None
        return running.report

    def done(self, request: Request, by: str = "alice") -> CommandReport:
        report = self.do(request, by)
        assert report.done, report
        return report

    def states(self) -> set[FlightState]:
        return {robot.state for robot in self.robots}

    def each_state(self) -> list[FlightState]:
        return [robot.state for robot in self.robots]

    def operators(self) -> set[str]:
        """Operators that the robots obey."""
        return {robot.said.operator for robot in self.robots}

    def land(self) -> None:
        """What flies is on its way down; the grounds know it when it is."""
        self.until(lambda: self.states() <= {_S.LANDED, _S.PREFLIGHT, _S.IDLE}, 120.0)
        self.run(0.5)


@cache
def _flown(n: int, spares: int, stage: Stage, secure: bool) -> Field:
    """The fleet that others are copies of."""
    if stage == "standing":
        with tempfile.TemporaryDirectory() as folder:
            scenario = Scenario(
                robots=n + spares, seed=3, errors=False, budget=PRECISE, secure=secure
            )
            fleet = SimulatedFleet(
                scenario, Path(folder), SHIPPED,
                operator="alice", settings=SPARING, spares=spares, vehicle_step_s=0.1,
            )  # fmt: skip
        for each in fleet.vehicles:
            each.vehicle.parameters |= QUICK
        field = Field(fleet)
        field.until(lambda: all(r.program.status for r in field.robots))
        field.until(lambda: field.states() == {_S.IDLE})
        return _come_so_far(field)
    before: dict[Stage, Stage] = {
        "ready": "standing", "hovering": "ready", "flying": "hovering",
    }  # fmt: skip
    field = a_field(n, before[stage], spares=spares, secure=secure)
    requests: dict[Stage, tuple[Request, ...]] = {
        "ready": (SetOrigin(ORIGIN), Enable()),
        "hovering": (Takeoff(interval_s=0.0),),
        "flying": (Start(),),
    }
    for request in requests[stage]:
        field.done(request)
    return _come_so_far(field)


def _come_so_far(field: Field) -> Field:
    """Ready to be copied often."""
    field.run(1.0)
    for robot in field.robots:
        robot.vehicle.truth.clear()
    # It stays: a collection need not look through it.
    gc.freeze()
    return field


def a_field(
    n: int = 3, stage: Stage = "standing", *, spares: int = 0, seed: int = 0, secure: bool = False
) -> Field:
    """N robots that alice commands, and spares that fly nowhere; `seed` is the radio's luck.

    With `secure` all of them sign what they say.
    """
    field = Field(_flown(n, spares, stage, secure).fleet.copy())
    if seed:
        field.fleet.radio.rng = np.random.default_rng(seed)
    return field
