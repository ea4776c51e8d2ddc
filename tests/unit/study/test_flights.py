"""Flights of a study: their worlds, groups, and stored outcomes."""

import json
from collections.abc import Generator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.policy.bundle import load_bundle
from lpac.radio.airtime import Wifi
from lpac.radio.modelled import ModelledRadio
from lpac.sim.cores import Outcome, in_this_process
from lpac.sim.failure import LostRobots
from lpac.sim.fleet.layout import Layout
from lpac.sim.ticks import Clocks
from lpac.study.flights import (
    CostCurve,
    KeptFlights,
    PlannedFlight,
    curves_of,
    groups_of,
    records_of,
)
from lpac.study.study import BASELINES, Condition, Draw, Method, Study
from lpac.study.worlds import FIELD, SET_UPS, SetUp, draw_world
from tests.conftest import SHIPPED

OURS, CLAIRVOYANT = Method.of("ours", SHIPPED), Method.of("clairvoyant-cvt")


def flight_of(
    method: Method = OURS, world: int = 3, set_up: SetUp = FIELD, *, engine: Any = "point",
    from_pads: bool = False, lost: LostRobots | None = None, **changes: Any,
) -> PlannedFlight:  # fmt: skip
    scenario = set_up.scenario(**{"duration_s": 1.0, **changes})
    condition = Condition(scenario=scenario, engine=engine, from_pads=from_pads)
    if lost is not None:
        condition = replace(condition, lost=lost)
    study = Study(methods=(OURS,), conditions=(condition,), world_set="training")
    [flight] = study.flights_of(method, condition, Draw(world))
    return flight


def each_with(*changes: dict[str, Any]) -> tuple[dict[str, Any], ...]:
    return changes


def test_all_fly_over_the_sets_world() -> None:
    world = draw_world("training", 3, FIELD)
    for method in (OURS, CLAIRVOYANT):
        flight = flight_of(method)
        [(_, record)] = records_of((flight,))
        assert flight.scenario.features == world.features and flight.scenario.seed == world.seed
        places_m = np.array([robot.position_m[0, :2] for robot in record.robots])
        np.testing.assert_allclose(places_m * 16.0, world.starts)
        assert flight.scenario.communication_range == FIELD.communication_range


def test_a_batch_tells_what_its_flights_tell() -> None:
    changes: list[dict[str, Any]] = [
        {}, {"loss": 0.5}, {"world": 4}, {"delay_s": 0.3}, {"max_message_age_s": 0.1},
        {"payload": "float32"}, {"clocks": Clocks(perception_s=0.1, policy_s=0.2)},
        {"lag_s": 0.6}, {"position_error_m": 1.5},
        {"radio": ModelledRadio("multicast", Wifi(frame_loss=0.3))},
    ]  # fmt: skip
    group = tuple(flight_of(**change) for change in changes)
    assert len({one.key for one in group}) == len({curve for _, curve in curves_of(group)}) == 10
    assert curves_of(group) == [pair for one in group for pair in curves_of((one,))]


def test_lost_robots_do_not_count_and_baselines_never_had_them() -> None:
    lost = LostRobots(2, 0.5)
    [(_, whole), (_, of_lost)] = curves_of((flight_of(), flight_of(lost=lost)))
    never = flight_of(CLAIRVOYANT, lost=lost)
    [(_, of_eight)] = curves_of((never,))
    assert of_lost.cost[0] == whole.cost[0] < of_eight.cost[0]
    assert of_lost.cost[-1] > whole.cost[-1]
    assert never.scenario.robots == 8 and not never.scenario.failures


def test_baselines_lose_no_messages_and_have_all_vehicles_errors() -> None:
    radio = ModelledRadio("mesh")
    for changes in each_with({"loss": 0.3, "delay_s": 0.1}, {"radio": radio}, {"payload": "int8"}):
        assert flight_of(CLAIRVOYANT, **changes) == flight_of(CLAIRVOYANT)
        assert flight_of(**changes) != flight_of()
    for harder in each_with({"lag_s": 0.5}, {"position_error_m": 1.0}):
        assert flight_of(CLAIRVOYANT, **harder) != flight_of(CLAIRVOYANT)


@pytest.mark.slow
def test_whole_robots_begin_where_points_from_pads_do() -> None:
    small: dict[str, Any] = {"set_up": SET_UPS["n3"], "world": 4}
    [(_, of_point)] = curves_of((flight_of(from_pads=True, **small),))
    [(_, of_whole)] = curves_of((flight_of(engine="simulated", **small),))
    assert of_whole.time_s == of_point.time_s == (0.0, 1.0)
    # They hold above their pads, in wind.
    assert of_whole.cost[0] == pytest.approx(of_point.cost[0], rel=0.05)
    assert of_whole.cost != of_point.cost
    baseline = flight_of(CLAIRVOYANT, engine="simulated", **small)
    assert baseline == flight_of(CLAIRVOYANT, from_pads=True, **small)
    assert baseline.engine == "point" and baseline.scenario.position_bias is not None


def test_whole_robots_fly_a_bundle_of_their_set_ups_world_and_range(tmp_path: Path) -> None:
    for set_up, own in (("field", False), ("n3", True)):
        flight = flight_of(set_up=SET_UPS[set_up], engine="simulated")
        layout = Layout(flight.scenario, SHIPPED)
        robots: dict[str, dict[str, object]] = {
            f"r{i}": {
                "system_id": i + 1,
                "mavlink_url": f"udpin://127.0.0.1:{14551 + i}",
                "zenoh_port": 7447 + i,
            }
            for i in range(SET_UPS[set_up].robots)
        }
        layout.write(tmp_path, "fleet", robots)
        assert (layout.bundle_path == SHIPPED) is not own
        perception = load_bundle(layout.bundle_path).manifest.perception
        assert perception is not None
        assert perception.world_size == SET_UPS[set_up].world_size
    assert SET_UPS["n3"].world_size < FIELD.world_size


def test_the_best_of_ten_runs_of_lloyds_is_no_more_than_the_clairvoyant() -> None:
    [(_, flown)] = curves_of((flight_of(CLAIRVOYANT),))
    assert flown.lloyd is not None and flown.lloyd < flown.cost[-1]
    [(_, others)] = curves_of((flight_of(),))
    assert others.lloyd is None


def test_another_bundle_is_not_taken_for_it() -> None:
    with pytest.raises(ValueError, match="differs from the planned bundle"):
        curves_of((replace(flight_of(), flown_by="0" * 64),))


def test_a_flight_is_the_same_wherever_its_bundle_and_px4_lie() -> None:
    flight = flight_of()
    assert replace(flight, bundle="elsewhere", px4_build="there").key == flight.key
    others = (replace(flight, flown_by="another"), replace(flight, engine="px4"))
    assert len({flight.key, *(other.key for other in others)}) == 3


def test_another_build_of_px4_flies_otherwise(tmp_path: Path) -> None:
    builds = {"first": b"one", "copy": b"one", "second": b"two"}
    keys = {}
    for name, program in builds.items():
        (tmp_path / name / "bin").mkdir(parents=True)
        (tmp_path / name / "bin" / "px4").write_bytes(program)
        keys[name] = replace(flight_of(), engine="px4", px4_build=str(tmp_path / name)).key
    assert keys["first"] == keys["copy"] != keys["second"]


def test_policies_fly_together_and_nothing_gets_lost() -> None:
    conditions = (Condition(), Condition(scenario=FIELD.scenario(loss=0.3)))
    methods = (OURS, *map(Method.of, BASELINES))
    study = Study(methods=methods, conditions=conditions, worlds=9)
    flights = study.flights()
    assert len({flight.key for flight in flights}) == len(flights) == 9 * (2 + len(BASELINES))
    groups = groups_of(flights)
    assert sorted(f.key for group in groups for f in group) == sorted(f.key for f in flights)
    for group in groups:
        assert len(group) == 1 or {f.scenario.controller for f in group} == {"lpac"}
    assert max(map(len, groups)) == 8


def test_what_was_flown_is_kept(tmp_path: Path) -> None:
    flight = flight_of()
    first = dict(KeptFlights(tmp_path, CostCurve).fly(curves_of, [flight], in_this_process))

    def refuse(do: object, tasks: Sequence[object]) -> Generator[Outcome, None, None]:
        raise AssertionError(f"{tasks} were flown")
        yield

    assert dict(KeptFlights(tmp_path, CostCurve).fly(curves_of, [flight], refuse)) == first
    # Outcomes of another version of the code are ignored.
    path = tmp_path / "flights.jsonl"
    came_of, *lines = path.read_text().splitlines()
    other = json.dumps({**json.loads(came_of), "code": "x"})
    path.write_text("\n".join([other, *lines]) + "\n")
    with pytest.raises(AssertionError, match="were flown"):
        dict(KeptFlights(tmp_path, CostCurve).fly(curves_of, [flight], refuse))
    assert first[flight] == CostCurve(*first[flight]) and len(first[flight].cost) == 2


def test_in_real_time_flights_go_one_after_another_in_this_process() -> None:
    """With any pool; in real time messages are late only by the radio."""
    condition = Condition(engine="mavlink")
    study = Study(methods=(OURS,), conditions=(condition,), worlds=2)
    flights = [f for f in study.flights() if f.scenario.controller == "lpac"]
    assert [len(group) for group in groups_of(flights)] == [1, 1]
    late = Condition(scenario=FIELD.scenario(delay_s=0.4), engine="mavlink")
    with pytest.raises(ValueError, match=r"delay_s = 0.4: must be 0.0 for programs in real time"):
        Study(methods=(OURS,), conditions=(late,))
