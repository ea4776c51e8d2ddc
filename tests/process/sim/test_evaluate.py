"""`lpac evaluate` as a user types it: over cores, killed and gone on with, on a cluster."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from lpac.analysis.statistics import VERDICT_RULE
from lpac.cli.options import DEFAULT_BUNDLE
from lpac.radio.records import RadioRecord, write_records
from lpac.sim.ticks import Clocks
from lpac.study.flights import curves_of
from lpac.study.study import Condition, Draw, Method, Study
from lpac.study.summary import LEGEND, tables_of
from lpac.study.worlds import SET_UPS
from tests.command import called, error_line, lpac

PLAIN = ("-k", 2, "--duration", 2, "--baseline", "decentralized-cvt-prior")


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The shipped policy over two worlds, under five conditions."""
    out = tmp_path_factory.mktemp("evaluated")
    result = lpac(
        "evaluate", *PLAIN, "--loss", 0.3, "--lost", "2@1", "--payload", "int8", "--out", out,
        "--json"
    )  # fmt: skip
    assert result.returncode == 0, (result.stdout, result.stderr)
    return out, json.loads(result.stdout)


def test_it_tells_what_it_flew(evaluated: tuple[Path, dict[str, Any]]) -> None:
    out, told = evaluated
    assert json.loads((out / "evaluation.json").read_text()) == told
    assert told["world_set"] == "validation" and told["test_set_opened"] is None
    plain, lossy, lost, int8, int8_lossy = told["conditions"]
    assert (lossy["scenario"]["loss"], lost["lost_robots"], lost["lost_at_s"]) == (0.3, 2, 1.0)
    for condition in told["conditions"]:
        names = [result["name"] for result in condition["results"]]
        assert names == [DEFAULT_BUNDLE.name, "decentralized-cvt-prior", "clairvoyant-cvt"]
    policy, prior, clairvoyant = plain["results"]
    assert 0.0 < clairvoyant["final"]["mean"][0] < policy["final"]["mean"][0] < 1.0
    assert clairvoyant["over_clairvoyant"]["ratio_of_means"] == [1.0, 1.0, 1.0]
    assert all(ratio > 1.0 for [ratio] in zip(*policy["by_world"]["over_best_of_ten"], strict=True))
    told_of = [condition["scenario"] for condition in (int8, int8_lossy)]
    payloads = [(scenario["payload"], scenario["loss"]) for scenario in told_of]
    assert payloads == [("int8", 0.0), ("int8", 0.3)]
    coarse = int8["results"][0]["final"]["mean"][0]
    assert 0.0 < abs(coarse - policy["final"]["mean"][0]) < 0.05 and int8["results"][1] == prior
    # A baseline says nothing that could be lost.
    assert lossy["results"][1] == prior and lossy["results"][0] != policy
    assert lost["results"][0]["final"]["mean"][0] > policy["final"]["mean"][0]


def test_it_says_what_its_columns_are_and_how_many_worlds_would_tell(
    evaluated: tuple[Path, dict[str, Any]],
) -> None:
    out, told = evaluated
    readme = (out / "README.md").read_text()
    for column in ("J / J(0)", "p90", "worst", "area", "vs clairvoyant", "vs best Lloyd"):
        assert f"{column}: " in LEGEND
    assert VERDICT_RULE in LEGEND and all(line in readme for line in LEGEND.splitlines())
    assert "not distinguishable" in readme and "undecided" not in readme
    plain = {**told, "conditions": told["conditions"][:1]}
    policy, prior, _ = plain["conditions"][0]["results"]
    plain["conditions"] = [{**plain["conditions"][0], "compared": policy["against"][prior["name"]]}]
    [compared, _] = tables_of(plain)
    assert "2 worlds are too few: at least 6" in compared.note


def test_it_draws_what_it_flew(evaluated: tuple[Path, dict[str, Any]]) -> None:
    out, _ = evaluated
    folders = ("field", "field-30-percent-of-messages-lost", "field-2-of-10-robots-lost-at-1-s")
    names = ("curves", "distributions", "pairs")
    figures = [out / folder / name for folder in folders for name in names]
    for figure in (*figures, out / "conditions"):
        assert figure.with_suffix(".png").stat().st_size > 10_000
    assert len(list((out / "worst" / DEFAULT_BUNDLE.name).glob("*.png"))) == 2


@pytest.mark.usefixtures("sketched")
def test_with_the_radio_that_a_field_had(tmp_path: Path) -> None:
    records = tmp_path / "field.jsonl"
    said = RadioRecord(
        sender="r1", receiver="r2", transport="multicast", robots=3, message_bytes=1300.0,
        message_hz=2.5, sent=1000, received=800, loaded=False, ground_wired=True,
        rate_mbit_s=100.0,
    )  # fmt: skip
    write_records(records, [said])
    options = ("-k", 1, "--duration", 1, "--baseline", "clairvoyant-cvt", "--transport",
        "multicast", "--wifi", records, "--out", tmp_path)  # fmt: skip
    result = called("evaluate", *options)
    assert result.returncode == 0, result.stderr
    assert "field, multicast by the model: 1 world of the validation set" in result.stdout
    assert "data_rate_mbit_s = 100  # from the radios' rates, 1 record\n" in result.stdout
    told = json.loads((tmp_path / "evaluation.json").read_text())
    ideal, modelled = told["conditions"]
    assert ideal["scenario"]["radio"] is None
    assert modelled["scenario"]["link"]["loss"] > 0.2
    assert modelled["results"][0] != ideal["results"][0]
    assert modelled["results"][1] == ideal["results"][1]
    assert told["wifi_from"]["frame_loss"] == {"kind": "delivered", "records": 1}


@pytest.mark.usefixtures("sketched")
def test_killed_and_with_a_full_disk_it_loses_nothing_and_goes_on(
    evaluated: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    kept = tmp_path / "flights.jsonl"
    options = [*map(str, PLAIN), "--out", str(tmp_path)]
    command = [sys.executable, "-m", "lpac.cli.main", "evaluate", *options]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, process_group=0) as killed:
        while not kept.exists() or len(kept.read_text().splitlines()) < 2:
            assert killed.poll() is None
            time.sleep(0.02)
        killed.send_signal(signal.SIGKILL)
    # A flight of somebody else's study; and as if it was killed in the middle of a line.
    other = {"flight": "other", "outcome": [[0.0] * 20_000, [], None]}
    before = [*kept.read_text().splitlines()[:1], json.dumps(other)]
    kept.write_text("\n".join([*before, '{"flight": "lpa']))

    def limit() -> None:
        """Files may not grow past some flights of these; the tasks have room."""
        most = kept.stat().st_size + 1000
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))

    full = subprocess.run(command, capture_output=True, text=True, check=False, preexec_fn=limit)
    assert error_line(full) == "lpac: [Errno 27] File too large"
    before = [*before, *kept.read_text().splitlines()[2:-1]]
    assert len(before) > 2
    result = called("evaluate", *PLAIN, "--out", tmp_path, "--json")
    assert result.returncode == 0, (result.stdout, result.stderr)
    assert kept.read_text().splitlines()[: len(before)] == before
    assert json.loads(result.stdout)["conditions"] == evaluated[1]["conditions"][:1]


def test_interrupted_it_is_one_line(tmp_path: Path) -> None:
    kept = tmp_path / "flights.jsonl"
    command = [sys.executable, "-m", "lpac.cli.main", "evaluate", "-k", "50"]
    with subprocess.Popen(
        [*command, "--out", str(tmp_path)], stderr=subprocess.PIPE, process_group=0, text=True
    ) as interrupted:
        while not kept.exists():
            assert interrupted.poll() is None
            time.sleep(0.02)
        # As a terminal does: its workers have it too.
        os.killpg(interrupted.pid, signal.SIGINT)
        _, said = interrupted.communicate()
    assert interrupted.returncode == 130 and said.strip().endswith(
        "lpac: interrupted: the same command continues"
    )


@pytest.mark.usefixtures("sketched")
def test_whether_one_is_better(tmp_path: Path) -> None:
    """Clairvoyant against what stays where it sees something, over few seconds."""
    result = called(
        "evaluate", "--compare", "clairvoyant-cvt", "decentralized-cvt", "-k", 6, "--duration", 4,
        "--baseline", "clairvoyant-cvt", "--out", tmp_path, "--set", "test",
    )  # fmt: skip
    assert result.returncode == 0, (result.stdout, result.stderr)
    assert "clairvoyant-cvt is better than decentralized-cvt: cost at the end 0." in result.stdout
    assert "the test set was used, 6 worlds" in result.stdout
    told = json.loads((tmp_path / "evaluation.json").read_text())
    assert told["test_set_opened"].keys() == {"date", "bundle_ids", "worlds"}
    assert told["conditions"][0]["compared"]["better"] == "a"


def test_what_cannot_be_is_one_line(tmp_path: Path) -> None:
    """Others are in tests/unit/cli."""
    for arguments, text in (
        (("--payload", "int4"), "--payload int4: must be one of float32, float16, int8"),
        (("--set", "tests"), "--set tests: must be one of training, validation, test"),
        (("--ray", "127.0.0.1:1"), "no Ray cluster at 127.0.0.1:1"),
    ):
        assert text in error_line(called("evaluate", *arguments, "--out", tmp_path))


@pytest.mark.real_time
def test_a_program_for_each_robot_flies_what_whole_robots_do() -> None:
    """Over the same world from the same pad, with its timing's rates."""
    scenario = SET_UPS["n1"].scenario(duration_s=4.0, clocks=Clocks(perception_s=0.4))
    conditions = (
        Condition(scenario=scenario, engine="simulated"),
        Condition(scenario=scenario, engine="mavlink"),
    )
    study = Study(methods=(Method.of("field", DEFAULT_BUNDLE),), conditions=conditions, worlds=1)
    of_both = [
        pair
        for condition in conditions
        for flight in study.flights_of(study.methods[0], condition, Draw(0))
        for pair in curves_of((flight,))
    ]
    (_, on_a_clock), (_, in_real_time) = of_both
    assert on_a_clock.time_s == in_real_time.time_s == (0.0, 1.0, 2.0, 3.0, 4.0)
    # Receivers err alike in both; who has taken off has drifted by some metres.
    assert in_real_time.cost[0] == pytest.approx(on_a_clock.cost[0], rel=0.1)
