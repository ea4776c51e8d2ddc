"""What this machine carries, and what becomes of a flight on one that does not keep up."""

from pathlib import Path

import pytest

from lpac.sim.fleet import load
from lpac.sim.fleet.flight import fly_programs
from lpac.sim.fleet.load import robots_carried
from lpac.sim.fleet.processes import OVERLOADED_S, Fleet
from lpac.sim.flight_summary import summary_lines
from lpac.sim.scenario import Scenario
from tests.conftest import SHIPPED

STEPS = (
    "assemble", "preflight", "takeoff", "start", "mission", "return",
    "landing all robots where they are",
)  # fmt: skip


def test_what_a_machine_carries_is_found_out_by_work() -> None:
    assert robots_carried(SHIPPED, "mavlink") > robots_carried(SHIPPED, "px4") / 2.0 > 0.0


def test_two_cores_carry_three_px4s(monkeypatch: pytest.MonkeyPatch) -> None:
    # As two cores were measured on which three flew, and five when nothing else ran.
    monkeypatch.setattr(load, "_units_per_s", lambda _: 53.0)
    assert 3 <= robots_carried(SHIPPED, "px4") < 5


@pytest.mark.real_time
@pytest.mark.parametrize("in_the_air", [False, True])
def test_a_flight_that_falls_behind_ends_early_and_says_so_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_the_air: bool
) -> None:
    said: list[str] = []
    scenario = Scenario(robots=2)
    fleet = Fleet(scenario, tmp_path, SHIPPED, report=said.append)
    assert fleet.simulated is not None
    vehicles = fleet.simulated.vehicles

    # Some of it before the flight, which does not count.
    behind_s = 3.0

    def lost_s() -> float:
        nonlocal behind_s
        up = not in_the_air or any(not vehicle.landed for vehicle in vehicles)
        if up and "preflight" in said:
            behind_s = 3.0 + OVERLOADED_S + 1.0
        return behind_s

    monkeypatch.setattr(fleet.simulated, "lost_s", lost_s)
    flight = fly_programs(fleet, said.append)
    # What robots refuse follows from it, and is not said.
    fleet.report_unless_behind("robot 0 refuses takeoff")
    problem = flight.script.problem
    assert problem is not None and flight.script.overloaded
    lines = summary_lines(scenario, flight)
    assert lines[1:] == [f"PROBLEM: {problem}"]
    assert "the vehicles fell 6.0 s behind real time" in lines[1] and lines[1].endswith("-n 1")
    assert not any("refuses" in line for line in said)
    steps = [line for line in said if line in STEPS]
    if in_the_air:
        assert steps == ["assemble", "preflight", "takeoff", "landing all robots where they are"]
        assert flight.all_landed and "no mission; all landed and disarmed" in lines[0]
    else:
        assert steps == ["assemble", "preflight"]
        assert not flight.all_landed and lines[0].endswith("nobody took off")
