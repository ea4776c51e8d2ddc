"""How many robots a machine carries, and what becomes of a flight on one that does not keep up."""

from pathlib import Path

import pytest

from lpac.cli.sim import _as_many_as_carried, _say_if_carried
from lpac.sim.fleet import load
from lpac.sim.fleet.flight import fly, summary_lines
from lpac.sim.fleet.load import robots_carried
from lpac.sim.fleet.processes import OVERLOADED_S, Backlog, Fleet, FleetScenario, OverloadError
from tests.conftest import SHIPPED

# Units of work a second, measured: two cores of a small cloud machine, which flew ten robots with
# 0.9 cores; and half of that, on which ten fell 88 s behind and five flew well.
TEN_FLEW, FIVE_FLEW = 62.0, 31.0


def test_what_a_machine_carries_is_found_out_by_work() -> None:
    assert robots_carried(SHIPPED, "mavlink") > robots_carried(SHIPPED, "px4") / 2.0 > 0.0


@pytest.mark.parametrize(("units_per_s", "robots"), [(TEN_FLEW, 10), (FIVE_FLEW, 5), (1.0, 1)])
def test_as_many_robots_fly_as_the_machine_carries(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    units_per_s: float,
    robots: int,
) -> None:
    monkeypatch.setattr(load, "_units_per_s", lambda _: units_per_s)
    assert _as_many_as_carried(SHIPPED, "mavlink") == robots
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith(f": flying {robots}")


def test_who_asks_for_more_is_warned(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(load, "_units_per_s", lambda _: FIVE_FLEW)
    assert _say_if_carried(5, SHIPPED, "mavlink") == 5
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("carries about 5 of these robots and vehicles")
    assert _say_if_carried(6, SHIPPED, "mavlink") == 5
    (line,) = capsys.readouterr().err.splitlines()
    assert (
        "carries about 5 of these robots" in line
        and "not 6" in line
        and line.endswith("fewer: -n 5")
    )


@pytest.mark.parametrize(
    ("robots", "carried", "advice"), [(10, None, 5), (10, 7, 7), (10, 12, 9), (3, 0, 1)]
)
def test_who_falls_behind_is_told_what_was_found_out(
    robots: int, carried: int | None, advice: int
) -> None:
    error = OverloadError(Backlog(9.0, 0.0), robots, carried)
    assert str(error).endswith(f"fly fewer: -n {advice}")


@pytest.mark.parametrize("in_the_air", [False, True])
def test_a_flight_that_falls_behind_ends_early_and_says_so_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_the_air: bool
) -> None:
    said: list[str] = []
    fleet = Fleet(FleetScenario(robots=2), tmp_path, SHIPPED, say=said.append)
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
    flight = fly(fleet, said.append)
    # What robots refuse follows from it, and is not said.
    fleet.say_unless_behind("robot 0 refuses takeoff")
    assert flight.problem is not None and flight.overloaded
    lines = summary_lines(flight)
    assert lines[1:] == [f"PROBLEM: {flight.problem}"]
    assert "the vehicles fell 6.0 s behind real time" in lines[1] and lines[1].endswith("-n 1")
    steps = ["assemble", "preflight"]
    if in_the_air:
        assert said == [*steps, "takeoff", "landing all robots where they are"]
        assert flight.all_landed and "no mission; all landed and disarmed" in lines[0]
    else:
        assert said == steps
        assert not flight.all_landed and lines[0].endswith("nobody took off")
