"""`lpac paper` on the logs of a field day, and its files."""

import csv
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

import lpac.analysis.examination
from edge.messages.mission import FlightState
from edge.policy.bundle import load_bundle
from lpac.analysis.coverage import Coverage
from lpac.analysis.examination import Examined, Wanted
from lpac.analysis.flight import FlightRecord
from lpac.analysis.logs import LoggedStatus, LoopRates
from lpac.cli.options import DEFAULT_BUNDLE, VehicleKind
from lpac.cli.paper import asynchrony, e1, e2, e3, transfer
from lpac.paper.logged import LOGS
from lpac.paper.network import network_report
from lpac.sim.points import fly_points
from lpac.sim.scenario import Scenario
from lpac.study.study import BASELINES

pytestmark = pytest.mark.usefixtures("sketched")

MADE_BY = {"command": "lpac paper ..."}


def said(time_s: float, bundle_id: str) -> LoggedStatus:
    """A pilot has the robot from the second to the third second."""
    state = FlightState.PILOT if 2.0 <= time_s < 3.0 else FlightState.MISSION
    return cast(LoggedStatus, SimpleNamespace(state=state, bundle_id=bundle_id))


@pytest.fixture
def mission() -> FlightRecord:
    """A mission of two robots, as in logs."""
    bundle = load_bundle(DEFAULT_BUNDLE)
    record = fly_points(Scenario(robots=2, duration_s=5.0), bundle)
    coverage = record.coverage
    assert coverage is not None
    robots = tuple(
        replace(r, statuses=tuple(said(t, bundle.id) for t in r.time_s.tolist()))
        for r in record.robots
    )
    read = Coverage(coverage.importance, coverage.cells_per_m, record.features)
    return replace(record, name="paper-1", robots=robots, coverage=read)


@pytest.fixture
def day(mission: FlightRecord, monkeypatch: pytest.MonkeyPatch) -> list[Wanted]:
    """Logs of two missions, the second over a missing world; returns the requested scopes."""
    asked: list[Wanted] = []

    def examine(_: Sequence[Path], wanted: Wanted) -> Examined:
        asked.append(wanted)
        other = replace(mission, name="paper-2", coverage=None)
        trials = [t for t in (mission, other) if not wanted.missions or t.name in wanted.missions]
        note = f"paper-2: world 1234 is not here; give it with {wanted.world_option}"
        without_cost = {trial.name: note for trial in trials if not len(trial.normalized)}
        return Examined(tuple(trials), (note,), without_cost)

    monkeypatch.setattr(lpac.analysis.examination, "examine", examine)
    return asked


def test_a_world_that_is_not_there_is_one_line_that_says_what_to_do(
    day: list[Wanted], tmp_path: Path
) -> None:
    for command in (e1, e2, e3):
        with pytest.raises(ValueError, match=r"^paper-2: .* with --world-file; or choose other"):
            command(logs=tmp_path, out=tmp_path / "out")
    e1(logs=tmp_path, trial=["paper-1"], world_file=Path("a.env"), out=tmp_path / "out")
    assert (day[-1].missions, day[-1].world) == (("paper-1",), Path("a.env"))


@pytest.mark.usefixtures("day")
def test_one_mission_of_a_day_is_chosen_and_its_own_policy_named(tmp_path: Path) -> None:
    e3(logs=Path("day 1"), trial=["paper-1"], out=tmp_path)
    made_by = json.loads((tmp_path / "e3.json").read_text())["made_by"]
    # Files of other experiments do not exist.
    assert made_by["command"] == "lpac paper e3 --logs 'day 1' --trial paper-1"
    assert made_by["bundle"] == load_bundle(DEFAULT_BUNDLE).id and "seeds" not in made_by
    assert {"numpy", "onnxruntime", "python", "lpac-edge"} < set(made_by)


@pytest.mark.usefixtures("day")
def test_a_logged_flight_is_held_against_baselines_from_where_it_began(
    mission: FlightRecord, tmp_path: Path
) -> None:
    e1(logs=tmp_path, trial=["paper-1"], out=tmp_path)
    told = json.loads((tmp_path / "e1.json").read_text())
    [of_world] = told["flights"].values()
    assert list(of_world) == ["flight", *BASELINES]
    flown = of_world["flight"]
    assert flown["final"] == pytest.approx(mission.normalized[-1])
    for its in of_world.values():
        assert its["time_s"] == flown["time_s"] and its["normalized_cost"][0] == 1.0
    assert of_world["clairvoyant-cvt"]["final"] < min(1.0, flown["final"])
    assert "points from the robots' positions" in told["flown"]


def of_another_policy(mission: FlightRecord) -> FlightRecord:
    robots = tuple(
        replace(r, statuses=tuple(said(t, "0123456789abcdef01") for t in r.time_s.tolist()))
        for r in mission.robots
    )
    return replace(mission, name="paper-0", robots=robots)


def read_from_logs(monkeypatch: pytest.MonkeyPatch, *missions: FlightRecord) -> None:
    examined = Examined(missions, ())
    monkeypatch.setattr(lpac.analysis.examination, "examine", lambda *_: examined)


def test_a_logged_flight_of_another_policy_has_no_baselines(
    mission: FlightRecord,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    read_from_logs(monkeypatch, of_another_policy(mission))
    e1(logs=tmp_path, out=tmp_path)
    told = json.loads((tmp_path / "e1.json").read_text())
    assert [list(of_world) for of_world in told["flights"].values()] == [["flight"]]
    assert told["flown"] == LOGS
    assert "give that bundle with --bundle" in capsys.readouterr().err


def test_of_a_day_with_two_policies_each_mission_is_looked_at_by_itself(
    mission: FlightRecord,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    read_from_logs(monkeypatch, of_another_policy(mission), mission)
    e1(logs=tmp_path, out=tmp_path)
    told = json.loads((tmp_path / "e1.json").read_text())
    assert [len(of_world) for of_world in told["flights"].values()] == [1, 1 + len(BASELINES)]
    assert "no baselines for paper-0" in capsys.readouterr().err
    # Methods that did not fly have an empty cell.
    assert "|  |  |" in (tmp_path / "README.md").read_text()


@pytest.mark.parametrize(
    ("command", "options"),
    [
        (e1, {"worlds": 3}), (e1, {"ray": "auto"}), (e2, {"trials": 3}), (e2, {"world": 0}),
        (e3, {"world": 0}), (e3, {"ray": "auto"}), (asynchrony, {"worlds": 3}),
        (asynchrony, {"quick": True}), (transfer, {"worlds": 3}), (transfer, {"quick": True}),
    ],
)  # fmt: skip
def test_what_chooses_flights_is_a_mistake_with_logs(
    command: Callable[..., None], options: dict[str, Any], tmp_path: Path
) -> None:
    [name] = options
    with pytest.raises(ValueError, match=f"^--{name} does nothing with --logs$"):
        command(**options, logs=tmp_path, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_missions_are_put_together_by_their_rates(
    mission: FlightRecord,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    """Of a minute each; one without rates in its logs is left out."""
    minute_s = mission.cost_time_s * 12.0
    robots = tuple(replace(robot, time_s=robot.time_s * 12.0) for robot in mission.robots)
    record = replace(mission, duration_s=60.0, to_s=60.0, cost_time_s=minute_s, robots=robots)
    rates = {"paper-1": LoopRates(5.0, 2.5), "paper-2": LoopRates(5.0, 1.0), "paper-3": None}
    missions = [replace(record, name=name, rates=its) for name, its in rates.items()]
    read_from_logs(monkeypatch, *missions)
    asynchrony(logs=Path("day 1"), out=tmp_path)
    assert "paper-3 is left out: its robots' rates differ" in capsys.readouterr().err
    told = json.loads((tmp_path / "async.json").read_text())
    assert [(of["policy_hz"], of["over"]) for of in told["timings"]] == [
        (2.5, ["paper-1"]), (1.0, ["paper-2"]),
    ]  # fmt: skip
    assert told["timings"][1]["over_field"][-1] == [1.0, 1.0, 1.0]
    assert told["made_by"]["command"] == "lpac paper async --logs 'day 1'"


@pytest.mark.usefixtures("day")
def test_missions_are_put_together_by_their_teams(mission: FlightRecord, tmp_path: Path) -> None:
    transfer(logs=Path("day 1"), trial=["paper-1"], out=tmp_path)
    told = json.loads((tmp_path / "transfer.json").read_text())
    [condition] = told["conditions"]
    assert condition["name"] == "2 robots, 10 features"
    assert condition["scenario"]["duration_s"] == 5.0
    policy, clairvoyant = condition["results"]
    assert policy["final"]["mean"][0] == pytest.approx(mission.normalized[-1])
    assert clairvoyant["over_clairvoyant"]["ratio_of_means"][0] == 1.0
    over = policy["over_clairvoyant"]["ratio_of_means"][0]
    assert over == pytest.approx(policy["final"]["mean"][0] / clairvoyant["final"]["mean"][0])
    assert told["made_by"]["command"] == "lpac paper transfer --logs 'day 1' --trial paper-1"
    assert "all missions of such a team" in (tmp_path / "README.md").read_text()
    assert (tmp_path / "2-robots-10-features" / "curves.png").exists()
    with pytest.raises(ValueError, match="give --bundle once"):
        transfer(logs=tmp_path, bundles=[DEFAULT_BUNDLE, DEFAULT_BUNDLE], out=tmp_path / "out")


def test_neighbours_are_those_in_range_of_the_policy_that_flew(
    mission: FlightRecord, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    read_from_logs(monkeypatch, of_another_policy(mission))
    with pytest.raises(ValueError, match="another bundle flew, 0123456789abcdef: give it with --b"):
        e3(logs=tmp_path, out=tmp_path)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"px4": Path("build")}, "--px4 does nothing with --vehicle point"),
        ({"px4": Path("build"), "logs": Path()}, "--px4 does nothing with --logs"),
        ({"vehicle": VehicleKind.SIMULATED, "px4": Path("build")}, "--px4 does nothing with"),
        ({"vehicle": VehicleKind.SIMULATED, "logs": Path()}, "--vehicle does nothing with --logs"),
        ({"vehicle": VehicleKind.PX4}, "--vehicle px4 needs --px4"),
        ({"trial": ["a"]}, "--trial does nothing without --logs"),
        ({"world_file": Path("a.env")}, "--world-file does nothing without --logs"),
        ({"bundles": [Path("absent")]}, "absent"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_no_folder(
    options: dict[str, Any], problem: str, tmp_path: Path
) -> None:
    for command in (e1, e2, e3, asynchrony, transfer):
        with pytest.raises((ValueError, OSError), match=problem):
            command(**options, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_measured_network_gets_its_table_and_what_made_it(tmp_path: Path) -> None:
    run = {"experiment": "robots", "middleware": "zenoh", "robots": 2, "met": False}
    spread = {"mean": 75.04, "deviation": 0.5, "runs": 3}
    told = {
        "measured_on": {
            "where": "namespaces", "namespaces": ["drone0", "drone1"], "cores": 2, "kernel": "6.1",
            "versions": {"zenoh": "1.10"},
        },
        "summaries": [
            {"experiment": "robots", "middleware": "zenoh", "robots": 2,
             "throughput_mbit_s": spread}
        ],
        "runs": [run],
    }  # fmt: skip
    document = network_report(told, MADE_BY).write(tmp_path)
    assert "between network namespaces (drone0, drone1)" in document["flown"]
    [row] = csv.DictReader((tmp_path / "network.csv").read_text().splitlines())
    assert row == {
        "experiment": "robots", "middleware": "zenoh", "robots": "2", "met": "False",
    }  # fmt: skip
    text = (tmp_path / "README.md").read_text()
    assert "| robots | zenoh | 2 | 75.0 ± 0.5 |  |  |" in text and "(robots.png)" in text
    assert "1 run left out: not all robots had met." in text
