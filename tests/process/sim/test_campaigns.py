"""Flights over cores and over a Ray cluster, and campaigns that are killed and gone on with."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from ray.cluster_utils import Cluster

from edge.policy.bundle import load_bundle
from lpac.analysis.logs import read_logs
from lpac.analysis.truth import TRUTH, load_truth
from lpac.sim.cluster import over_ray
from lpac.sim.cores import over_cores
from lpac.sim.drill.outcome import FlightOutcome
from lpac.study.drills import Drill, fly_drill
from lpac.study.flights import CostCurve, KeptFlights, PlannedFlight, curves_of
from lpac.study.study import Condition, Method, Study
from lpac.study.worlds import FIELD
from lpac.train.rollout import ShardTask, fly_shard, plan_round
from tests.command import called, error_line
from tests.conftest import SHIPPED
from tests.training import here, read

# They soon come down.
DRILL = Drill(faults=("landed", "ground-dies"), first_seed=1, robots=2)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """A Ray cluster of two nodes on this machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        # Its workers would wait for all other tests' processes.
        patch.setenv("RAY_worker_niceness", "0")
        nodes: Any = Cluster(
            initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
        )
        nodes.add_node(num_cpus=1)
        yield nodes
        nodes.shutdown()


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> dict[PlannedFlight, FlightOutcome]:
    """Two faults, over all cores."""
    return fly_drill(DRILL.flights(), tmp_path_factory.mktemp("cores"), over_cores)


def test_flights_over_cores_hold_what_is_promised(
    flown: dict[PlannedFlight, FlightOutcome],
) -> None:
    asked = [(flight.scenario.fault, flight.scenario.seed) for flight in flown]
    assert asked == [("ground-dies", 1), ("landed", 1)]
    assert all(outcome.held for outcome in flown.values())


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_cluster_of_two_nodes_flies_the_same(
    tmp_path: Path, cluster: Cluster, flown: dict[PlannedFlight, FlightOutcome]
) -> None:
    assert fly_drill(DRILL.flights(), tmp_path, over_ray(cluster.address)) == flown


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_study_over_a_cluster_flies_the_same(cluster: Cluster, tmp_path: Path) -> None:
    condition = Condition(scenario=FIELD.scenario(duration_s=1.0))
    study = Study(methods=(Method.of("field", SHIPPED),), conditions=(condition,), worlds=1)
    flown = dict(
        KeptFlights(tmp_path, CostCurve).fly(curves_of, study.flights(), over_ray(cluster.address))
    )
    assert flown == dict(pair for flight in study.flights() for pair in curves_of((flight,)))


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_training_over_a_cluster_flies_the_same(cluster: Cluster, tmp_path: Path) -> None:
    config = read(tmp_path, ("[2, 3]", "[30, 31]")).config
    bundle = load_bundle(SHIPPED)
    tasks = [ShardTask(shard, bundle) for shard in plan_round(config.data, config.dagger, 0, 0)]
    there, own = (
        {shard.name: shard.states for shard in pool(fly_shard, tasks)}
        for pool in (over_ray(cluster.address), here)
    )
    assert there.keys() == own.keys() and len(own) == 2
    for name, states in own.items():
        assert (there[name].velocities == states.velocities).all()
        assert (there[name].inputs["images"] == states.inputs["images"]).all()


def test_a_campaign_that_was_killed_goes_on(tmp_path: Path) -> None:
    out = tmp_path / "drill"
    options = ("--fault", "landed", "--fault", "ground-dies", "-n", "2", "--seeds", "2")
    command = [sys.executable, "-m", "lpac.cli.main", "drill", *options, "--out", str(out)]
    kept = out / "flights.jsonl"
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, process_group=0) as killed:
        while len(_lines(kept)) < 2:
            assert killed.poll() is None
            time.sleep(0.05)
        killed.send_signal(signal.SIGKILL)
    # As if it was killed in the middle of a line.
    before = _lines(kept)[:2]
    kept.write_text("\n".join([*before, '{"fault": "lan']))
    result = called("drill", *options, "--out", out, "--json")
    assert result.returncode == 0, (result.stdout, result.stderr)
    assert _lines(kept)[:2] == before
    told = json.loads(result.stdout)
    assert [(each["fault"], each["flights"], each["broken"]) for each in told["faults"]] == [
        ("ground-dies", 2, 0), ("landed", 2, 0),
    ]  # fmt: skip
    suite = ElementTree.parse(out / "drill.xml").getroot()
    assert (suite.get("tests"), suite.get("failures")) == ("4", "0")
    # What another version of the code has flown does not count.
    first, *others = _lines(kept)
    kept.write_text("\n".join([first.replace('"code": "', '"code": "x'), *others]) + "\n")
    assert called("drill", *options[:4], "-n", "2", "--out", out).returncode == 0
    assert len(_lines(kept)) == 1 + 2


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.exists() else []


def test_a_flight_again_is_that_flight_with_logs_and_figure(
    tmp_path: Path, flown: dict[PlannedFlight, FlightOutcome]
) -> None:
    result = called("drill", "--fault", "landed", "--seed", 1, "-n", 2, "--out", tmp_path, "--json")
    assert result.returncode == 0, (result.stdout, result.stderr)
    [told] = json.loads(result.stdout)["faults"]
    first = next(its for flight, its in flown.items() if flight.scenario.fault == "landed")
    worst = {figure["name"]: figure["value"] for figure in told["worst"]}
    assert worst == {figure.name: figure.value for figure in first.figures}
    folder = tmp_path / "landed-1"
    assert (folder / "drill.png").exists() and (folder / "drill.xml").exists()
    # On the clock of the robots' logs.
    truth, logs = load_truth(folder / TRUTH), read_logs([folder])
    assert len(truth) == DRILL.robots
    for robot, track in truth.items():
        said_s = [status.time_s for status in logs.statuses[robot]]
        assert track.time_s[0] <= said_s[0] + 1.0 and said_s[-1] <= track.time_s[-1] + 1.0
    assert len(list(folder.glob("robots/*/logs/*.mcap"))) == DRILL.robots


def test_a_file_of_faults_is_flown_as_a_study(
    tmp_path: Path, flown: dict[PlannedFlight, FlightOutcome]
) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('faults = ["landed"]\nfirst_seed = 1\nrobots = 2\n')
    result = called("study", file, "--out", tmp_path / "out", "--json")
    assert result.returncode == 0, (result.stdout, result.stderr)
    [told] = json.loads(result.stdout)["faults"]
    outcome = next(
        outcome for flight, outcome in flown.items() if flight.scenario.fault == "landed"
    )
    worst = {figure["name"]: figure["value"] for figure in told["worst"]}
    assert worst == {figure.name: figure.value for figure in outcome.figures}
    assert (tmp_path / "out" / "README.md").exists() and (tmp_path / "out" / "drill.xml").exists()


def test_what_cannot_be_is_one_line(tmp_path: Path) -> None:
    for arguments, text in (
        (("--fault", "nothing"), "--fault nothing: no such fault; `lpac drill --list` shows all"),
        (("--seeds", 0), "--seeds = 0: must be at least 1"),
        (("--seed", -1), "--seed = -1: must be at least 0"),
        (("--seeds", 2, "--seed", 1), "--seeds and --seed: give one of them"),
        (("-n", 1), "--robots = 1: must be from 2 to 10"),
        (("--ray", "127.0.0.1:1"), "127.0.0.1:1"),
    ):
        assert text in error_line(called("drill", *arguments, "--out", tmp_path))
