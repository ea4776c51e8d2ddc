"""`lpac paper` as a user types it."""

import json
from pathlib import Path

import pytest

from edge.policy.bundle import load_bundle
from lpac.cli.options import DEFAULT_BUNDLE
from tests.command import called, error_line, lpac
from tests.conftest import ROOT

STUDIES = ROOT / "lpac" / "paper" / "studies"


def test_rates_and_asynchrony_are_flown_and_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In this process, over its cores; for as long as it takes to cover."""
    for name in ("async", "async-quick"):
        text = (STUDIES / f"{name}.toml").read_text()
        (tmp_path / f"{name}.toml").write_text(f"{text}\n[scenario]\nduration_s = 20.0\n")
    monkeypatch.setattr("lpac.paper.experiments._STUDIES", tmp_path)
    out = tmp_path / "out"
    command = ("paper", "async", "--quick", "-k", 1, "--out", out, "--json")
    result = called(*command)
    assert result.returncode == 0, (result.stdout, result.stderr)
    told = json.loads(result.stdout)
    assert told["made_by"]["bundle"] == load_bundle(DEFAULT_BUNDLE).id and told["worlds"] == 1
    field, *others = told["timings"]
    assert (field["perception_hz"], field["policy_hz"], field["synchronous"]) == (5.0, 2.5, False)
    assert field["over_field"] == [[1.0, 1.0, 1.0]] * 3 and told["times_s"] == [5.0, 10.0, 20.0]
    # It covers, and what is another timing is another flight.
    [[_, _, end]] = field["by_world"]
    assert 0.0 < end < 0.5
    ends = {tuple(timing["by_world"][0]) for timing in told["timings"]}
    assert len(ends) == 1 + len(others) == 13
    assert (out / "rates.png").exists() and (out / "README.md").exists()
    # What was flown is kept: a world more is all that is flown then.
    flown = (out / "flights.jsonl").read_bytes()
    assert called(*command).stdout == result.stdout
    assert (out / "flights.jsonl").read_bytes() == flown


def test_trials_are_flown_over_cores(tmp_path: Path) -> None:
    result = lpac("paper", "e2", "--trials", 2, "--out", tmp_path, "--json")
    assert result.returncode == 0, (result.stdout, result.stderr)
    told = json.loads(result.stdout)
    assert told == json.loads((tmp_path / "e2.json").read_text())
    finals = [trial["final"] for trial in told["trials"].values()]
    assert len(finals) == 2 and finals[0] != finals[1] and max(finals) < 0.8
    made_by = told["made_by"]
    assert made_by["bundle"] == load_bundle(DEFAULT_BUNDLE).id
    # Nothing in it is of this machine alone.
    assert made_by["command"] == "lpac paper e2 --trials 2"
    assert made_by["worlds"].startswith("0 to 0 of the validation") and "numpy" in made_by
    assert (tmp_path / "repeatability.png").exists() and (tmp_path / "README.md").exists()


def test_mistakes_are_one_line(tmp_path: Path) -> None:
    no_worlds = called("paper", "async", "-k", 0, "--out", tmp_path)
    assert error_line(no_worlds) == "lpac: worlds = 0: must be from 1 to 10000"
    assert "absent" in error_line(called("paper", "async", "--bundle", "absent"))
    assert error_line(called("paper", "e2", "--trials", 1)).startswith("lpac: --trials 1: must be")
    assert (
        error_line(called("paper", "e3", "--world", -1))
        == "lpac: first_world = -1: must be from 0 to 1000000"
    )
    no_build = called("paper", "e3", "--vehicle", "px4", "--out", tmp_path)
    assert error_line(no_build) == "lpac: --vehicle px4 needs --px4 with PX4's build folder"
    no_px4 = called("paper", "e1", "--px4", tmp_path, "--out", tmp_path / "new")
    assert error_line(no_px4) == "lpac: --px4 does nothing with --vehicle point"
    assert not (tmp_path / "new").exists()
