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
    assert not any(figure.broken for figure in judge(fault.judged_by, record))
    assert list(tmp_path.rglob("*.mcap"))


@pytest.mark.parametrize(
    ("engine", "fault", "said"),
    [
        ("point", "landed", "fault = landed: must be '' for points"),
        ("simulated", "nothing-such", "fault = nothing-such: there is none; `lpac drill --list`"),
        ("mavlink", "radio-dies", "fault = radio-dies: is not flown with mavlink"),
    ],
)
def test_an_engine_says_what_fault_it_does_not_fly(
    engine: EngineName, fault: str, said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        fly(Scenario(fault=fault), SHIPPED, engine=engine)
