"""One scenario flown twice, on the simulated clock and as programs: its operator sees the same.

What is compared is what a client of the ground is told: snapshots, and what came of commands.
"""

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import combinations, groupby, pairwise
from pathlib import Path

import numpy as np
import pytest

from edge.core import F64
from edge.core.world import rasterize
from edge.messages.codes import ReasonCode
from edge.messages.mission import FlightState, RobotStatus
from lpac.analysis.snapshot import FleetSetup, FleetSnapshot
from lpac.analysis.voronoi import coverage_cost
from lpac.ground.alarms import SnapshotHistory, alarms
from lpac.ground.procedure import fresh_snapshot
from lpac.ground.station.client import subscribe
from lpac.ground.station.protocol import SNAPSHOT_PERIOD_S, in_words
from lpac.sim.cores import over_cores
from lpac.sim.description import FIELD_SCALE
from lpac.sim.fleet.ground import GroundProgram
from lpac.sim.fleet.layout import Layout
from lpac.sim.fleet.processes import Fleet
from lpac.sim.fleet.scripted import CommandOutcome, ScriptedFlight
from lpac.sim.fleet.simulated import SimulatedFleet
from lpac.sim.scenario import Scenario
from tests.conftest import SHIPPED

# It measures how alike they are: beside another flight, programs are late.
pytestmark = pytest.mark.alone

SCENARIO = Scenario(robots=3, seed=1, duration_s=20.0)
# A machine that holds up a program is not what is compared.
MOST_FLIGHTS = 3
STARTING_S = 2.0
# Snapshots at the end of the mission, of which the cost is taken.
LAST = int(3.0 / SNAPSHOT_PERIOD_S)
# The phases of the robots' clocks are chance in programs, and the swarm's end hangs on them: on the
# simulated clock, which draws them, costs at the end were 0.46 to 0.52 of the first one, places up
# to 1.5 m apart. A flight of programs must be one of these, within a metre of that robot on which
# the cost hangs most: 4 % of it.
# With fewer a flight now and then is like none of them.
DRAWS = 12
COST_TOLERANCE = 0.03
START_TOLERANCE_M, END_TOLERANCE_M = 0.5, 1.2
# Where a robot takes its pad to be, and what its landing leaves.
LANDING_TOLERANCE_M = 1.0

_S = FlightState


@dataclass(slots=True)
class SeenFlight:
    """What an operator saw of one flight, and what its vehicles fell behind real time, s."""

    layout: Layout
    setup: FleetSetup
    behind_s: float = 0.0
    snapshots: list[FleetSnapshot] = field(default_factory=list)
    commands: list[CommandOutcome] = field(default_factory=list)

    def statuses(self, robot: int) -> list[tuple[float, RobotStatus]]:
        """Of one robot, with the ground's wall clock, s; each as often as it was told."""
        told = ((snapshot.unix_time_s, snapshot.robots[robot]) for snapshot in self.snapshots)
        return [(at_s, each.status) for at_s, each in told if each.status is not None]

    def states(self, robot: int) -> list[FlightState]:
        """One after another, from the checks on: before, a program starts.

        On their way back the ground has robots wait for each other. How long, and how much of the
        way is left to them then, hangs on the clocks' phases, and may be too short to be seen.
        """
        states = [status.state for _, status in self.statuses(robot)]
        if _S.RETURN in states:
            back = states.index(_S.RETURN)
            states[back:] = [_S.RETURN if each is _S.HOLD else each for each in states[back:]]
        states = [state for state, _ in groupby(states)]
        return states[states.index(_S.PREFLIGHT) :]

    def mission(self) -> list[FleetSnapshot]:
        """While all fly their mission."""
        return [
            snapshot
            for snapshot in self.snapshots
            if all(r.status and r.status.state is _S.MISSION for r in snapshot.robots)
        ]

    def held_up(self) -> bool:
        """Whether a machine was too busy for a robot, or for the vehicles."""
        return self.behind_s > 0.0 or any(
            status.reason.code is ReasonCode.CONTROL_SILENT
            or any(loop.overruns for loop in status.loops.values())
            for robot in range(SCENARIO.robots)
            for _, status in self.statuses(robot)
        )

    def results(self) -> list[tuple[str, dict[str, str]]]:
        """Each command, and what came of it for each robot."""
        return [
            (in_words(request), {r.robot: r.code.value for r in report.results})
            for request, report in self.commands
        ]

    def costs(self) -> tuple[float, float]:
        """Coverage cost where the robots take themselves to be: as the mission begins, and ends.

        Of the end the mean of some seconds, since robots keep moving about their places.
        """
        manifest = self.layout.bundle.manifest
        assert manifest.perception is not None and self.layout.features is not None
        importance = rasterize(
            self.layout.features, manifest.perception.world_size,
            manifest.training.idf_truncation, manifest.training.idf_norm,
        )  # fmt: skip
        mission = self.mission()
        costs = [
            coverage_cost(importance, FIELD_SCALE.position_to_model(places_m(snapshot)[:, :2]))
            for snapshot in (mission[0], *mission[-LAST:])
        ]
        return costs[0], float(np.mean(costs[1:]))

    def alarms(self) -> set[tuple[str, str]]:
        """What an operator's table warned of, but for the first moments of the mission.

        A robot tells of its start at once, and of the features and neighbours that it starts with
        half a second later.
        """
        history, found = SnapshotHistory(), set()
        started_s = -math.inf
        for earlier, snapshot in pairwise(self.snapshots):
            two_s_ago = history.add(snapshot, snapshot.unix_time_s)
            if missions(snapshot) != missions(earlier):
                started_s = snapshot.unix_time_s
            if snapshot.unix_time_s - started_s > STARTING_S:
                told = alarms(self.setup, snapshot, two_s_ago)
                found |= {(a.robot, a.text) for a in told if a.severity != "note"}
        return found


def missions(snapshot: FleetSnapshot) -> list[str]:
    """Robots that fly the mission."""
    return [r.name for r in snapshot.robots if r.status and r.status.state is _S.MISSION]


def places_m(snapshot: FleetSnapshot) -> F64:
    """Where robots take themselves to be: the mission frame, (N, 3), m."""
    return np.array([r.status.position_m for r in snapshot.robots if r.status])


def on_the_simulated_clock(folder: Path, draw: int) -> SeenFlight:
    """Each start of a robot's program draws the phases of its clocks."""
    folder = folder / f"simulated-{draw}"
    fleet = SimulatedFleet(SCENARIO, folder, SHIPPED)
    for robot in fleet.robots * draw:
        robot.stop()
        robot.start()
    seen = SeenFlight(fleet.layout, fleet.ground.setup)
    fleet.schedule.every(SNAPSHOT_PERIOD_S, lambda: seen.snapshots.append(fleet.ground.snapshot))
    flight = ScriptedFlight(fleet.ground, folder / "fleet.toml", SCENARIO.duration_s)
    assert fleet.ground.carry_out(flight.fly()) is None
    fleet.ground.carry_out(fresh_snapshot(fleet.ground))
    seen.commands = flight.commands
    return seen


def as_programs(folder: Path) -> SeenFlight:
    fleet = Fleet(SCENARIO, folder, SHIPPED)
    with fleet, GroundProgram(fleet.fleet_toml, fleet.name) as ground:
        seen = SeenFlight(fleet.layout, ground.subscriber.setup)
        with watching(fleet.name, seen.snapshots.append):
            flight = ScriptedFlight(
                ground.subscriber, fleet.fleet_toml, SCENARIO.duration_s,
                on_step=lambda step: fleet.begin() if step == "preflight" else None,
            )  # fmt: skip
            assert ground.subscriber.carry_out(flight.fly()) is None
            ground.subscriber.carry_out(fresh_snapshot(ground.subscriber))
        seen.behind_s = fleet.lateness().vehicles_s
    seen.commands = flight.commands
    return seen


@contextmanager
def watching(fleet: str, see: Callable[[FleetSnapshot], None]) -> Iterator[None]:
    """Meanwhile a client of the ground sees all that it shows, to the end."""
    over_at_unix_s: list[float] = []

    def watch() -> None:
        with subscribe(fleet) as told:
            for message in told:
                if isinstance(message, FleetSnapshot):
                    see(message)
                    # It may be behind the one that flies.
                    if over_at_unix_s and message.unix_time_s >= over_at_unix_s[0]:
                        return

    watcher = threading.Thread(target=watch)
    watcher.start()
    yield
    over_at_unix_s.append(time.time())
    watcher.join()


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> "Flights":
    folder = tmp_path_factory.mktemp("same")
    simulated = list(over_cores(partial(on_the_simulated_clock, folder), range(DRAWS)))
    for attempt in range(MOST_FLIGHTS):
        programs = as_programs(folder / f"programs-{attempt}")
        if not programs.held_up():
            return simulated, programs
    raise AssertionError("this machine is too busy for three robots")


Flights = tuple[list[SeenFlight], SeenFlight]


def test_each_robot_is_seen_in_the_same_states(flights: Flights) -> None:
    simulated, programs = flights
    for robot in range(SCENARIO.robots):
        for each in simulated:
            assert programs.states(robot) == each.states(robot), robot
        assert programs.states(robot)[-1] is _S.LANDED


def test_each_command_has_the_same_results(flights: Flights) -> None:
    simulated, programs = flights
    assert all(programs.results() == each.results() for each in simulated)
    assert {name for name, _ in programs.results()} >= {"takeoff", "start", "return"}
    assert {code for _, its in programs.results() for code in its.values()} == {"done"}


def test_nothing_alarms(flights: Flights) -> None:
    simulated, programs = flights
    for seen in (*simulated, programs):
        assert seen.alarms() == set()


def test_they_cover_alike(flights: Flights) -> None:
    simulated, programs = flights
    firsts, lasts = zip(*(seen.costs() for seen in simulated), strict=True)
    first, last = programs.costs()
    # They stand on the same pads, and hold there, but for gusts and their receivers' noise.
    assert firsts == pytest.approx([first] * DRAWS, rel=0.02)
    tolerance = COST_TOLERANCE * first
    assert min(lasts) - tolerance < last < max(lasts) + tolerance
    assert max(last, *lasts) < 0.6 * first


def test_they_fly_alike(flights: Flights) -> None:
    simulated, programs = [seen.mission() for seen in flights[0]], flights[1].mission()
    lasted_s = [told[-1].unix_time_s - told[0].unix_time_s for told in (*simulated, programs)]
    assert lasted_s == pytest.approx([lasted_s[-1]] * (DRAWS + 1), abs=1.0)
    for i, tolerance_m in ((0, START_TOLERANCE_M), (-1, END_TOLERANCE_M)):
        here_m = places_m(programs[i])
        off_m = [np.linalg.norm(places_m(each[i]) - here_m, axis=1).max() for each in simulated]
        assert min(off_m) < tolerance_m, off_m


def test_they_come_as_near_to_each_other_and_land_on_their_pads(flights: Flights) -> None:
    simulated, programs = flights
    nearest_m = [nearest(seen) for seen in simulated]
    assert min(nearest_m) - 0.5 < nearest(programs) < max(nearest_m) + 0.5
    for seen in (*simulated, programs):
        for robot, pad_m in enumerate(seen.layout.landing_points_m):
            _, status = seen.statuses(robot)[-1]
            assert status.position_m is not None
            assert math.dist(status.position_m[:2], pad_m) < LANDING_TOLERANCE_M, robot


def nearest(seen: SeenFlight) -> float:
    """The least distance of two robots in the mission, m."""
    return min(
        math.dist(a_m, b_m)
        for snapshot in seen.mission()
        for a_m, b_m in combinations(places_m(snapshot).tolist(), 2)
    )
