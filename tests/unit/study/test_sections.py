"""Sections about whole flights: worlds, trials, and robots that are taken away."""

import csv
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from edge.messages.mission import FlightState
from lpac.analysis.flight import FlightRecord, RobotRecord
from lpac.analysis.logs import LoggedStatus
from lpac.cli.options import DEFAULT_BUNDLE
from lpac.paper.experiments import experiment
from lpac.sim.engines import EngineName, engine_of
from lpac.sim.failure import Failure
from lpac.sim.scenario import Scenario
from lpac.study.perturbation import absences_in, absences_of, perturbed_by
from lpac.study.repeatability import not_compared, spread_of
from lpac.study.sections import Section, perturbation, repeatability, snapshots

MADE_BY = {"command": "lpac paper ..."}


def flown(
    name: str, duration_s: float, engine: EngineName = "point", **changes: object
) -> list[FlightRecord]:
    """Flights of an experiment's policy, shortened."""
    study = experiment(name, [DEFAULT_BUNDLE], engine=engine)
    scenarios = []
    for draw in study.draws:
        flight = next(study.flights_of(study.methods[0], study.conditions[0], draw))
        scenarios.append(replace(flight.scenario, duration_s=duration_s, **changes))  # type: ignore[arg-type]
    return engine_of(engine).fly(scenarios, DEFAULT_BUNDLE)


def written(name: str, section: Section, folder: Path) -> str:
    """Text of README.md."""
    section.report(name, name, "Flown.", MADE_BY).write(folder)
    return (folder / "README.md").read_text()


def test_who_is_away_does_not_count(tmp_path: Path) -> None:
    failures = (Failure(2, 2.0, 4.0),)
    [record] = flown("e3", 6.0, failures=failures)
    told = perturbed_by(record, absences_in(Scenario(failures=failures)), 16.0)
    away = (told.time_s >= 2.0) & (told.time_s < 4.0)
    np.testing.assert_array_equal(np.isnan(told.speed_m_s[:, 2]), away)
    assert not np.isnan(np.delete(told.speed_m_s, 2, axis=1)).any()
    # Robots in its range have one neighbour less.
    before, after = (int(np.searchsorted(told.time_s, at_s)) for at_s in (1.8, 2.2))
    lost = np.delete(told.neighbours[before] - told.neighbours[after], 2)
    assert lost.max() >= 1.0
    assert np.nanmax(told.speed_m_s) <= 1.25 + 0.01
    gone, back = told.phases
    assert (gone.robot, gone.away, gone.from_s, gone.until_s) == ("2", True, 2.0, 4.0)
    assert (back.away, back.from_s, back.until_s) == (False, 4.0, 6.0)
    cost = dict(zip(record.curve_time_s.tolist(), record.normalized.tolist(), strict=True))
    assert gone.cost_before == cost[1.0] and gone.cost_worst == max(cost[2.0], cost[3.0])
    assert back.cost_end == cost[5.0]

    section = perturbation(told, tmp_path)
    text = written("e3", section, tmp_path)
    assert "| robot 2 away | 2 to 4 s |" in text and "`lpac paper ...`" in text
    rows = list(csv.DictReader((tmp_path / "e3.csv").read_text().splitlines()))
    assert len(rows) == 10 * len(told.time_s)
    assert len(section.data["phases"]) == 2
    assert (tmp_path / "perturbation.png").stat().st_size > 20_000
    costs = list(csv.DictReader((tmp_path / "cost.csv").read_text().splitlines()))
    assert float(costs[-1]["cost_over_first"]) == section.data["flight"]["final"]


def test_in_a_log_robots_are_taken_while_a_pilot_has_them() -> None:
    [record] = flown("e3", 6.0, failures=())
    with pytest.raises(ValueError, match="no pilot took a robot"):
        perturbed_by(record, [], 16.0)

    def said(robot: RobotRecord, time_s: float, from_s: float) -> LoggedStatus:
        piloted = robot.robot_id == 4 and from_s <= time_s < 3.0
        state = FlightState.PILOT if piloted else FlightState.MISSION
        return cast(LoggedStatus, SimpleNamespace(state=state))

    def logged(from_s: float) -> FlightRecord:
        robots = (
            replace(robot, statuses=tuple(said(robot, t, from_s) for t in robot.time_s.tolist()))
            for robot in record.robots
        )
        return replace(record, robots=tuple(robots))

    assert absences_of(logged(3.0)) == []
    absences = absences_of(logged(2.0))
    assert [absence.robot for absence in absences] == ["4"]
    assert absences[0][1:] == pytest.approx((2.0, 3.0))
    told = perturbed_by(logged(2.0), absences, 16.0)
    assert [(phase.robot, phase.away) for phase in told.phases] == [("4", True), ("4", False)]
    away = (told.time_s >= 2.0) & (told.time_s < 3.0)
    assert away.any() and np.isnan(told.neighbours[away, 4]).all()


@pytest.mark.slow
@pytest.mark.usefixtures("sketched")
def test_trials_and_worlds_are_reported(tmp_path: Path) -> None:
    each = flown("e2", 3.0)[:2]
    records = {f"trial {number}": record for number, record in enumerate(each, 1)}
    spread = spread_of(records)
    finals = [record.normalized[-1] for record in each]
    assert spread["final_mean"] == pytest.approx(np.mean(finals))
    assert spread["final_deviation"] == pytest.approx(np.std(finals, ddof=1))
    ends_m = [np.array([r.position_m[-1, :2] for r in record.robots]) for record in each]
    apart_m = np.linalg.norm(ends_m[0] - ends_m[1], axis=1).mean()
    assert spread["mean_scatter_of_ends_m"] == pytest.approx(apart_m / 2.0)
    section = repeatability(records, tmp_path / "e2", 40.0)
    told = section.data["trials"]["trial 2"]
    assert told["final"] == pytest.approx(finals[1])
    # Points are at their true positions, whatever their receivers measure.
    assert told["final_true"] == told["final"]
    assert set(section.data["mission_from_s"].values()) == {0.0}
    assert (tmp_path / "e2" / "repeatability.pdf").exists()

    worlds = {
        f"world {number}": {"lpac": record, "rival": record}
        for number, record in enumerate(flown("e1", 1.0))
    }
    text = written("e1", snapshots(worlds, tmp_path / "e1"), tmp_path / "e1")
    for name in ("snapshots.png", "snapshots.pdf", "costs.png", "e1.csv", "e1.json"):
        assert (tmp_path / "e1" / name).stat().st_size > 0
    assert "| world 1 | " in text and "`lpac paper ...`" in text


def test_trials_of_different_teams_are_compared_by_name() -> None:
    first, second, _ = flown("e2", 2.0)
    trials = {"trial 1": first, "trial 2": replace(second, robots=second.robots[3:])}
    spread = spread_of(trials)
    assert spread["missing"] == {"trial 2": ["0", "1", "2"]}
    assert not_compared(spread) == [
        "Not compared, because not in the air at the end of trial 2: 0, 1, 2."
    ]
    ends_m = [np.array([r.position_m[-1, :2] for r in record.robots]) for record in (first, second)]
    apart_m = np.linalg.norm(ends_m[0] - ends_m[1], axis=1)[3:].mean()
    assert spread["mean_scatter_of_ends_m"] == pytest.approx(apart_m / 2.0)
    trials["trial 1"] = replace(first, robots=first.robots[:3])
    with pytest.raises(ValueError, match="no robot was in the air at the end of all trials"):
        spread_of(trials)


@pytest.mark.slow
def test_of_whole_robots_it_is_told_where_they_truly_were(tmp_path: Path) -> None:
    study = experiment("e2", [DEFAULT_BUNDLE], engine="simulated")
    few = []
    for draw in study.draws[:2]:
        flight = next(study.flights_of(study.methods[0], study.conditions[0], draw))
        assert flight.scenario.starts_m
        starts_m = flight.scenario.starts_m[:2]
        few.append(replace(flight.scenario, robots=2, starts_m=starts_m, duration_s=3.0))
    flown_whole = engine_of("simulated").fly(few, DEFAULT_BUNDLE)
    records = {str(number): record for number, record in enumerate(flown_whole)}
    section = repeatability(records, tmp_path, 40.0)
    for name, trial in section.data["trials"].items():
        assert trial["final_true"] != trial["final"]
        assert set(trial["final_positions_m"]) == {"r0", "r1"}
        # From the takeoff command on, before which no robot moves.
        began_s = section.data["mission_from_s"][name]
        assert 2.0 < began_s < 40.0
        assert trial["time_s"][0] == 0.0
        assert trial["time_s"][-1] == pytest.approx(began_s + records[name].duration_s)
        assert trial["normalized_true_cost"][:2] == pytest.approx([1.0, 1.0], abs=1e-3)
    written("e2", section, tmp_path)
    rows = list(csv.DictReader((tmp_path / "e2.csv").read_text().splitlines()))
    assert float(rows[-1]["true_cost_over_first"]) == section.data["trials"]["1"]["final_true"]
