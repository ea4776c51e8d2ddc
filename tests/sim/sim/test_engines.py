"""One way to fly a scenario, whatever flies it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge.policy.bundle import Bundle
from lpac.sim.drill.bounds import judge
from lpac.sim.drill.faults import FAULTS
from lpac.sim.drill.field import scenario_of
from lpac.sim.engines import EngineName, fly
from lpac.sim.fleet.flight import FleetMoment
from lpac.sim.points import FlightMoment
from lpac.sim.scenario import Scenario
from tests.conftest import SHIPPED
from tests.flown import PRECISE


@pytest.mark.parametrize(("engine", "kind"), [("point", FlightMoment), ("simulated", FleetMoment)])
def test_a_scenario_is_flown_on_an_engine_by_its_name(
    shipped_bundle: Bundle, engine: EngineName, kind: type
) -> None:
    """Watching changes nothing, and the bundle may be in memory or on the disk."""
    moments: list[FlightMoment | FleetMoment] = []
    scenario = Scenario(robots=2, seed=3, duration_s=3.0)
    if engine == "simulated":
        scenario = replace(scenario, errors=False, budget=PRECISE)
    of_memory = fly(scenario, shipped_bundle, moments.append, engine=engine)
    of_disk = fly(scenario, SHIPPED, engine=engine)
    assert of_memory.cost.tolist() == of_disk.cost.tolist() and len(of_disk.cost) >= 4
    assert of_memory.bundle_id == of_disk.bundle_id == shipped_bundle.id
    assert {type(moment) for moment in moments} == {kind}
    assert "mission" in {moment.step for moment in moments}
    assert (np.diff([moment.time_s for moment in moments]) > 0.0).all()


def test_a_fault_is_a_part_of_a_scenario(tmp_path: Path) -> None:
    """Its flight has a record like any other, and the fault's bounds are functions of that."""
    fault = FAULTS["landed"]
    record = fly(scenario_of(fault, 0, 2), SHIPPED, engine="simulated", folder=tmp_path)
    assert list(record.truth) == ["r0", "r1"]
    least = record.true_separation
    assert least is not None and least.distance_m > record.fault.drone_m
    assert record.fault.hit and record.fault.begin_s > 0.0
    assert record.took_off and record.all_landed
    with pytest.raises(ValueError, match="has no points"):
        assert record.positions_m is None
    assert not any(figure.broken for figure in judge(fault.judged_by, record))
    assert list(tmp_path.rglob("*.mcap"))


def test_a_fleet_is_stopped_before_it_takes_off() -> None:
    scenario = Scenario(robots=2, seed=3, duration_s=3.0, errors=False, budget=PRECISE)
    flown = fly(scenario, SHIPPED, lambda moment: moment.stop(), engine="simulated")
    assert not (flown.took_off or flown.flew_mission)
    assert flown.script.problem is not None and flown.script.problem.endswith("stopped")
    with pytest.raises(ValueError, match="fault = landed: cannot be watched"):
        fly(scenario_of(FAULTS["landed"], 0, 2), SHIPPED, print, engine="simulated")


def test_logs_are_found_in_a_folder_named_from_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    scenario = Scenario(robots=1, seed=3, duration_s=1.0, errors=False, budget=PRECISE)
    flown = fly(scenario, SHIPPED, engine="simulated", folder=Path("out/here"))
    [program] = flown.script.programs
    assert [Path("out/here", log).exists() for log in program.logs] == [True]
