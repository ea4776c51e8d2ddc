"""What is broken in the program shows in the drill: each mutation breaks a promise of its fault."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any

import pytest
from msgspec import structs

import edge.flight.guidance
import edge.flight.orders
import edge.flight.step
from edge.core import F64
from edge.core.logger import errors_only
from edge.flight.orders import ORDERS
from edge.flight.state import Robot
from edge.flight.transitions import TRANSITIONS, Transition, by_state
from edge.identity.replay_window import NO_NUMBER, MessageNumber, ReplayWindow
from edge.messages.codes import ReasonCode
from edge.messages.mission import FlightState
from lpac.ground.station.station import Station
from lpac.sim.drill.bounds import judge
from lpac.sim.drill.faults import FAULTS
from lpac.sim.drill.field import scenario_of
from lpac.sim.drill.simulated import SimulatedDrill
from lpac.sim.fleet.layout import Layout
from lpac.sim.fleet.robots import SimulatedWatchdog
from lpac.sim.fleet.simulated import SimulatedFleet
from lpac.sim.scenario import Scenario
from tests.conftest import SHIPPED

# Each flies as many robots as it shows with.
PAIR = 2
Mutation = Callable[[pytest.MonkeyPatch], None]


@pytest.fixture(scope="module", autouse=True)
def soon() -> Iterator[None]:
    """Coarser physics; and what a mutation keeps in the air is not waited for as long as else."""
    with pytest.MonkeyPatch.context() as patch:
        coarse = partial(SimulatedFleet, vehicle_step_s=0.05)
        patch.setattr("lpac.sim.drill.simulated.SimulatedFleet", coarse)
        patch.setattr("lpac.sim.drill.flight._ALL_DOWN_S", 20.0)
        patch.setattr("lpac.ground.station.commands._LANDING_S", 40.0)
        yield


def swapped(first: ReasonCode, second: ReasonCode) -> Mutation:
    """The first rows of these reasons from MISSION or HOLD take each other's places."""

    def mutate(monkeypatch: pytest.MonkeyPatch) -> None:
        rows = list(TRANSITIONS)
        i, j = (rows.index(_row(code)) for code in (first, second))
        rows[i], rows[j] = rows[j], rows[i]
        monkeypatch.setattr(edge.flight.step, "ROWS", by_state(rows))

    return mutate


def _row(code: ReasonCode) -> Transition:
    return next(
        row for row in TRANSITIONS if row.code is code and FlightState.MISSION in row.sources
    )


def without_brake(monkeypatch: pytest.MonkeyPatch) -> None:
    def as_wanted(position_m: F64, velocity_m_s: F64, wanted_m_s: F64, *_: Any) -> F64:
        return wanted_m_s

    monkeypatch.setattr(edge.flight.guidance, "brake", as_wanted)


def start_ignores_the_fence(monkeypatch: pytest.MonkeyPatch) -> None:
    start = ORDERS["start"]
    checks = tuple(check for check in start.checks if check.__name__ != "_not_in_place")
    assert checks != start.checks
    rules = {**ORDERS, "start": replace(start, checks=checks)}
    monkeypatch.setattr(edge.flight.orders, "ORDERS", rules)


def sends_at_once_after_a_lapse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(edge.flight.guidance, "is_silent", lambda *_: False)


def watchdog_waits_5_s(monkeypatch: pytest.MonkeyPatch) -> None:
    feed = SimulatedWatchdog.feed

    def fed(self: SimulatedWatchdog, *, flying: bool) -> None:
        feed(self, flying=flying)
        self._timeout_s = 5.0

    monkeypatch.setattr(SimulatedWatchdog, "feed", fed)


def landing_points_swapped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the ground and the robots, once they fly."""
    homewards = edge.flight.guidance._return_velocity

    def to_another(robot: Robot, inputs: Any, position_m: F64) -> F64:
        others = {0: 1, 1: 0}
        points_m = _landing_points_m()
        return homewards(
            robot,
            structs.replace(inputs, lands_beside_m=points_m[others[robot.robot_id]]),
            position_m,
        )

    monkeypatch.setattr(edge.flight.guidance, "_return_velocity", to_another)


@cache
def _landing_points_m() -> list[tuple[float, float]]:
    layout = Layout(Scenario(robots=PAIR, seed=0), SHIPPED)
    return [(float(x), float(y)) for x, y in layout.landing_points_m]


def ground_tells_nothing_of_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The station tells robots nothing of a hold."""
    publish = Station.published_state

    def without(self: Station) -> Any:
        state = publish(self)
        return state and replace(state, safety_action="none", robot_safety_actions={})

    monkeypatch.setattr(Station, "published_state", without)


def a_program_that_starts_again_is_not_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    is_replay = ReplayWindow.is_replay

    def of_another_start(
        self: ReplayWindow, number: MessageNumber, now_s: float, unix_s: float | None
    ) -> bool:
        started_again = self.number is not NO_NUMBER and number.start != self.number.start
        return started_again or is_replay(self, number, now_s, unix_s)

    monkeypatch.setattr(ReplayWindow, "is_replay", of_another_start)


@pytest.mark.parametrize(
    ("mutate", "fault", "robots"),
    [
        (swapped(ReasonCode.CONTROL_SILENT, ReasonCode.LEFT_OFFBOARD), "program-goes-on", PAIR),
        (start_ignores_the_fence, "start-outside", PAIR),
        (sends_at_once_after_a_lapse, "program-goes-on", PAIR),
        (watchdog_waits_5_s, "program-hangs", PAIR),
        (landing_points_swapped, "none", PAIR),
        (ground_tells_nothing_of_holds, "held", PAIR),
        (without_brake, "somebody-over-the-pad", PAIR),
        (a_program_that_starts_again_is_not_heard, "ground-restarts", PAIR),
    ],
    ids=lambda each: getattr(each, "__name__", str(each)),
)
def test_a_mutation_breaks_its_promise(
    monkeypatch: pytest.MonkeyPatch, mutate: Mutation, fault: str, robots: int
) -> None:
    assert not _broken_without(fault, robots)
    mutate(monkeypatch)
    assert _broken(fault, robots)


@cache
def _drill(_robots: int) -> SimulatedDrill:
    return SimulatedDrill(SHIPPED)


@cache
def _broken_without(fault: str, robots: int) -> list[str]:
    """Before any mutation."""
    return _broken(fault, robots)


def _broken(name: str, robots: int) -> list[str]:
    fault = FAULTS[name]
    with errors_only():
        truth = _drill(robots).fly(scenario_of(fault, 0, robots))
    figures = judge(fault.judged_by, truth)
    return [figure.name for figure in figures if figure.broken]
