"""Starts, seeds and errors of a study's flights, as in the paper's experiments."""

import math
from itertools import combinations, pairwise

import numpy as np
import pytest

from lpac.cli.options import DEFAULT_BUNDLE
from lpac.paper.experiments import experiment
from lpac.sim.description import FIELD_SCALE
from lpac.sim.engines import EngineName
from lpac.sim.fleet.layout import MAX_ROBOTS, Layout
from lpac.sim.scenario import Scenario
from lpac.study.study import BASELINES, Study


def studied(name: str, engine: EngineName = "point", *, quick: bool = False) -> Study:
    return experiment(name, [DEFAULT_BUNDLE], engine=engine, quick=quick)


def scenarios_of(study: Study, method: int = 0, condition: int = 0) -> list[Scenario]:
    """One scenario for each draw."""
    return [
        next(
            study.flights_of(study.all_methods[method], study.conditions[condition], draw)
        ).scenario
        for draw in study.draws
    ]


def test_worlds_differ_and_starts_do_not() -> None:
    study = studied("e1")
    assert [method.name for method in study.methods] == ["lpac", *BASELINES]
    each = [scenarios_of(study, method) for method in range(1 + len(BASELINES))]
    assert len({scenario.starts_m for its in each for scenario in its}) == 1
    for of_world in zip(*each, strict=True):
        assert len({scenario.features for scenario in of_world}) == 1
    assert len({scenario.features for scenario in each[0]}) == 3 == len(study.draws)


def test_trials_differ_by_placing_and_gps_alone() -> None:
    study = studied("e2")
    trials = scenarios_of(study)
    assert trials == scenarios_of(study) and len(trials) == 3
    assert len({trial.features for trial in trials}) == 1
    assert {trial.duration_s for trial in trials} == {40.0}
    truth = scenarios_of(studied("e1"))[0].starts_m
    errors_m = []
    for trial in trials:
        assert truth and trial.starts_m and trial.position_bias
        placed_m = np.linalg.norm(np.subtract(trial.starts_m, truth), axis=1)
        assert 0.0 < placed_m.max() <= 0.1
        errors_m.append(np.array(trial.position_bias) / FIELD_SCALE.env_scale)
        far_m = np.linalg.norm(errors_m[-1], axis=1)
        assert 1.0 <= far_m.min() < far_m.max() <= 5.0
    assert all(not np.array_equal(one, other) for one, other in pairwise(errors_m))


def test_three_robots_are_taken_one_after_another() -> None:
    [scenario] = scenarios_of(studied("e3"))
    assert [failure.robot for failure in scenario.failures] == [0, 3, 7]
    for failure, later in pairwise(scenario.failures):
        assert failure.until_s == failure.from_s + 20.0 == later.from_s - 40.0
    assert scenario.failures[-1].until_s < scenario.duration_s


@pytest.mark.slow
def test_whole_robots_stand_on_pads_with_room_between_them() -> None:
    """In E1 and E3 with one fleet's receivers, in E2 with others in each trial."""
    worlds, points = scenarios_of(studied("e1", "simulated")), scenarios_of(studied("e1"))
    assert [one.features for one in worlds] == [one.features for one in points]
    assert len({one.seed for one in worlds}) == 1
    trials = scenarios_of(studied("e2", "simulated"))
    assert len({trial.seed for trial in trials}) == len({trial.starts_m for trial in trials}) == 3
    for one, other in pairwise(trials):
        assert one.starts_m and other.starts_m
        offsets_m = np.array(one.starts_m) - np.array(other.starts_m)
        assert np.linalg.norm(offsets_m, axis=1).max() <= 2.0 * 0.1
    elsewhere = scenarios_of(studied("e3", "simulated"))
    for scenario in (*worlds, *trials, *elsewhere):
        # Closer pads would be refused by the ground.
        layout = Layout(scenario, DEFAULT_BUNDLE)
        for places_m in (layout.pads_m, layout.landing_points_m):
            apart_m = [math.dist(a, b) for a, b in combinations(places_m.tolist(), 2)]
            assert min(apart_m) >= layout.apart_m
    # Points start at the same places.
    [beside, *_] = scenarios_of(studied("e1", "simulated"), condition=1)
    assert beside.starts_m and beside.position_bias
    np.testing.assert_array_equal(beside.starts_m, Layout(worlds[0], DEFAULT_BUNDLE).pads_m)


def test_rates_are_flown_once_and_nothing_is_forgotten_before_two_periods() -> None:
    study = studied("async")
    scenarios = [condition.scenario for condition in study.conditions]
    assert len(scenarios) == 4 * 5 * 2 + 4
    for scenario in scenarios:
        clocks = scenario.clocks
        assert scenario.input_age_s >= 2.0 * max(clocks.policy_s, clocks.perception_s)
        late_s = 1.5 * scenario.delay_s
        assert scenario.max_message_age_s + 1e-9 >= max(0.8, 2.0 * clocks.policy_s) + late_s
    usual = scenarios[0]
    assert (usual.clocks, usual.max_message_age_s, usual.input_age_s) == (Scenario().clocks, 0.8, 1)


def test_whole_robots_fly_what_they_can() -> None:
    """Never synchronised; in real time, delays are the radio's only."""
    points, whole = studied("async"), studied("async", "simulated")
    kept = [c.scenario for c in points.conditions if not c.scenario.clocks.synchronous]
    assert [condition.scenario for condition in whole.conditions] == kept
    assert {condition.engine for condition in whole.conditions} == {"simulated"}
    assert (points.worlds, whole.worlds) == (50, 10)
    real = experiment("async", [DEFAULT_BUNDLE], engine="mavlink")
    assert [c.scenario for c in real.conditions] == [each for each in kept if not each.delay_s]
    assert real.worlds == 1
    teams = studied("transfer", "simulated").conditions
    assert max(condition.scenario.robots for condition in teams) <= MAX_ROBOTS
    assert {condition.from_pads for condition in teams} == {False, True}


def test_each_quick_study_is_a_smaller_one() -> None:
    for name in ("async", "transfer"):
        full, quick = studied(name), studied(name, quick=True)
        assert quick.worlds < full.worlds and quick.text == full.text
        of_full = [condition.scenario for condition in full.conditions]
        assert all(condition.scenario in of_full for condition in quick.conditions)
