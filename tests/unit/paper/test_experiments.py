"""The paper's experiments in the air: what is flown, and what is made of it."""

import csv
import json
import math
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from edge.messages.mission import FlightState
from edge.policy.bundle import Bundle
from lpac.analysis.flight import FlightRecord, RobotRecord
from lpac.analysis.logs import LoggedStatus
from lpac.cli.options import DEFAULT_BUNDLE
from lpac.evaluate.flights import BASELINES
from lpac.paper.experiments import (
    AWAY_S,
    E2_DURATION_S,
    PLACED_WITHIN_M,
    TAKEN,
    TAKEN_AT_S,
    absences_of,
    pads_of,
    perturbation,
    perturbed,
    perturbed_by,
    repeatability,
    spread_of,
    transferability,
    who_is_missing,
    whole_perturbation,
    whole_repeatability,
    whole_transferability,
)
from lpac.paper.flown import fly_whole
from lpac.paper.report import (
    POINTS,
    write_perturbation,
    write_repeatability,
    write_transferability,
)
from lpac.sim.cores import in_this_process
from lpac.sim.description import FIELD_SCALE
from lpac.sim.experiment import fly
from lpac.sim.failure import Failure
from lpac.sim.fleet.layout import Layout

MADE_BY = {"command": "lpac paper ..."}


def test_worlds_differ_and_starts_do_not() -> None:
    plan = transferability(3)
    assert list(plan) == ["world 0", "world 1", "world 2"]
    scenarios = [scenario for of_world in plan.values() for scenario in of_world.values()]
    assert len({scenario.starts_m for scenario in scenarios}) == 1
    for of_world in plan.values():
        assert list(of_world) == ["lpac", *BASELINES]
        assert len({scenario.features for scenario in of_world.values()}) == 1
        assert all(name == scenario.controller for name, scenario in of_world.items())
    assert len({scenario.features for scenario in scenarios}) == 3


def test_trials_differ_by_placing_and_gps_alone() -> None:
    trials = list(repeatability(5).values())
    assert repeatability(5) == repeatability(5)
    assert len({trial.features for trial in trials}) == 1
    assert {trial.duration_s for trial in trials} == {E2_DURATION_S}
    [truth] = {scenario.starts_m for scenario in transferability(1)["world 0"].values()}
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
    scenario = perturbation()
    assert [failure.robot for failure in scenario.failures] == list(TAKEN)
    assert scenario.failures[0].from_s == TAKEN_AT_S
    for failure, later in pairwise(scenario.failures):
        assert failure.until_s == failure.from_s + AWAY_S < later.from_s
    assert scenario.failures[-1].until_s < scenario.duration_s


def test_who_is_away_does_not_count(shipped_bundle: Bundle, tmp_path: Path) -> None:
    scenario = replace(perturbation(), duration_s=6.0, failures=(Failure(2, 2.0, 4.0),))
    flight = fly(scenario, shipped_bundle)
    told = perturbed(flight)
    away = (told.time_s >= 2.0) & (told.time_s < 4.0)
    np.testing.assert_array_equal(np.isnan(told.speed_m_s[:, 2]), away)
    assert not np.isnan(np.delete(told.speed_m_s, 2, axis=1)).any()
    # Who was in its range has one neighbour less.
    before, after = (int(np.searchsorted(told.time_s, at_s)) for at_s in (1.8, 2.2))
    lost = np.delete(told.neighbours[before] - told.neighbours[after], 2)
    assert lost.max() >= 1.0
    assert np.nanmax(told.speed_m_s) <= 1.25 + 0.01
    gone, back = told.phases
    assert (gone.robot, gone.away, gone.from_s, gone.until_s) == ("2", True, 2.0, 4.0)
    assert (back.away, back.from_s, back.until_s) == (False, 4.0, 6.0)
    cost = dict(zip(flight.cost_time_s.tolist(), flight.normalized_cost.tolist(), strict=True))
    assert gone.cost_before == cost[1.0] and gone.cost_worst == max(cost[2.0], cost[3.0])
    assert back.cost_end == cost[5.0]

    write_perturbation(told, tmp_path, MADE_BY)
    rows = list(csv.DictReader((tmp_path / "e3.csv").read_text().splitlines()))
    assert len(rows) == 10 * len(told.time_s)
    document = json.loads((tmp_path / "e3.json").read_text())
    assert document["made_by"] == MADE_BY and len(document["phases"]) == 2
    assert (tmp_path / "perturbation.png").stat().st_size > 20_000
    costs = list(csv.DictReader((tmp_path / "e3-cost.csv").read_text().splitlines()))
    assert float(costs[-1]["cost_over_first"]) == document["flight"]["final"]
    assert "| robot 2 away | 2 to 4 s |" in (tmp_path / "README.md").read_text()


def test_in_a_log_robots_are_taken_while_a_pilot_has_them(shipped_bundle: Bundle) -> None:
    record = fly(replace(perturbation(), duration_s=6.0, failures=()), shipped_bundle).record
    with pytest.raises(ValueError, match="no pilot took a robot"):
        perturbed_by(record, [], 16.0)

    def said(robot: RobotRecord, time_s: float, from_s: float) -> LoggedStatus:
        piloted = robot.robot_id == 4 and from_s <= time_s < 3.0
        state = FlightState.PILOT if piloted else FlightState.MISSION
        return cast(LoggedStatus, SimpleNamespace(state=state))

    def logged(from_s: float) -> FlightRecord:
        robots = (
            replace(robot, said=tuple(said(robot, t, from_s) for t in robot.time_s.tolist()))
            for robot in record.robots
        )
        return replace(record, robots=tuple(robots))

    assert absences_of(logged(3.0)) == []
    record = logged(2.0)
    absences = absences_of(record)
    assert [absence.robot for absence in absences] == ["4"]
    assert absences[0][1:] == pytest.approx((2.0, 3.0))
    told = perturbed_by(record, absences, 16.0)
    assert [(phase.robot, phase.away) for phase in told.phases] == [("4", True), ("4", False)]
    away = (told.time_s >= 2.0) & (told.time_s < 3.0)
    assert away.any() and np.isnan(told.neighbours[away, 4]).all()


@pytest.mark.slow
@pytest.mark.usefixtures("sketched")
def test_trials_and_worlds_are_reported(shipped_bundle: Bundle, tmp_path: Path) -> None:
    trials = {
        name: fly(replace(scenario, duration_s=3.0), shipped_bundle)
        for name, scenario in repeatability(2).items()
    }
    records = {name: flight.record for name, flight in trials.items()}
    spread = spread_of(records)
    finals = [flight.normalized_cost[-1] for flight in trials.values()]
    assert spread["final_mean"] == pytest.approx(np.mean(finals))
    assert spread["final_deviation"] == pytest.approx(np.std(finals, ddof=1))
    ends_m = [flight.positions_m[-1] for flight in trials.values()]
    apart_m = np.linalg.norm(ends_m[0] - ends_m[1], axis=1).mean()
    assert spread["mean_scatter_of_ends_m"] == pytest.approx(apart_m / 2.0)
    told = write_repeatability(records, tmp_path / "e2", MADE_BY)
    assert told["trials"]["trial 2"]["final"] == pytest.approx(finals[1])
    # Points are where they are, whatever their receivers say.
    assert told["trials"]["trial 2"]["final_true"] == told["trials"]["trial 2"]["final"]
    assert told["flown"] == POINTS and set(told["mission_from_s"].values()) == {0.0}
    assert (tmp_path / "e2" / "repeatability.pdf").exists()

    plan = transferability(2)
    worlds = {
        world: {
            name: fly(replace(of_world[name], duration_s=1.0), shipped_bundle).record
            for name in ("lpac", "decentralized-cvt-prior")
        }
        for world, of_world in plan.items()
    }
    write_transferability(worlds, tmp_path / "e1", MADE_BY)
    for name in ("snapshots.png", "snapshots.pdf", "costs.png", "e1.csv", "e1.json"):
        assert (tmp_path / "e1" / name).stat().st_size > 0
    text = (tmp_path / "e1" / "README.md").read_text()
    assert "| world 1 | " in text and "`lpac paper ...`" in text


def test_trials_of_different_teams_are_compared_by_name(shipped_bundle: Bundle) -> None:
    plan = {n: replace(one, duration_s=2.0) for n, one in repeatability(2).items()}
    trials = {n: fly(one, shipped_bundle).record for n, one in plan.items()}
    first, second = trials.values()
    trials["trial 2"] = replace(second, robots=second.robots[3:])
    spread = spread_of(trials)
    assert spread["missing"] == {"trial 2": ["0", "1", "2"]}
    assert who_is_missing(spread) == [
        "At the end of trial 2 not in the air, and so not compared: 0, 1, 2."
    ]
    ends_m = [np.array([r.position_m[-1, :2] for r in record.robots]) for record in (first, second)]
    apart_m = np.linalg.norm(ends_m[0] - ends_m[1], axis=1)[3:].mean()
    assert spread["mean_scatter_of_ends_m"] == pytest.approx(apart_m / 2.0)
    trials["trial 1"] = replace(first, robots=first.robots[:3])
    with pytest.raises(ValueError, match="no robot was in the air at the end of all trials"):
        spread_of(trials)


@pytest.mark.slow
def test_whole_robots_fly_the_same_worlds(tmp_path: Path) -> None:
    """From pads with room between them; what is drawn has where they truly were."""
    plan, points = whole_transferability(DEFAULT_BUNDLE, 2), transferability(2)
    pads_m = pads_of(DEFAULT_BUNDLE)
    for world, scenario in plan.items():
        assert scenario.features == points[world]["lpac"].features
        np.testing.assert_array_equal(scenario.starts_m, pads_m)
    trials = list(whole_repeatability(DEFAULT_BUNDLE, 3).values())
    assert len({trial.seed for trial in trials}) == len({trial.starts_m for trial in trials}) == 3
    for one, other in pairwise(trials):
        offsets_m = np.array(one.starts_m) - np.array(other.starts_m)
        assert np.linalg.norm(offsets_m, axis=1).max() <= 2.0 * PLACED_WITHIN_M
    perturbed_elsewhere = whole_perturbation(DEFAULT_BUNDLE, 1)
    for scenario in (*plan.values(), *trials, perturbed_elsewhere):
        # Or the ground refuses the fleet.
        layout = Layout(scenario, DEFAULT_BUNDLE)
        for places_m in (layout.pads_m, layout.landing_points_m):
            apart_m = [math.dist(a, b) for a, b in combinations(places_m.tolist(), 2)]
            assert min(apart_m) >= layout.apart_m

    few = [
        replace(trial, robots=2, starts_m=trial.starts_m[:2], duration_s=3.0)
        for trial in trials[:2]
        if trial.starts_m
    ]

    records = {str(n): record for n, record in fly_whole(few, DEFAULT_BUNDLE, in_this_process)}
    told = write_repeatability(records, tmp_path, MADE_BY, "Whole robots.")
    for name, trial in told["trials"].items():
        assert trial["final_true"] != trial["final"] and set(trial["final_positions_m"]) == {
            "r0",
            "r1",
        }
        # From the takeoff command on, before which nobody moves.
        began_s = told["mission_from_s"][name]
        assert 2.0 < began_s < 40.0
        assert trial["time_s"][0] == 0.0
        assert trial["time_s"][-1] == pytest.approx(began_s + records[name].duration_s)
        assert trial["normalized_true_cost"][:2] == pytest.approx([1.0, 1.0], abs=1e-3)
    rows = list(csv.DictReader((tmp_path / "e2.csv").read_text().splitlines()))
    assert float(rows[-1]["true_cost_over_first"]) == told["trials"]["1"]["final_true"]
    assert "Whole robots." in (tmp_path / "README.md").read_text()
