"""`lpac ablate` as a user types it. What comes of one is in tests/unit/ablate."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lpac.ablate.config import read_ablation
from lpac.ablate.run import AblationRun
from tests.command import called, error_line
from tests.training import here
from tests.unit.ablate.test_config import written


def test_it_says_what_it_came_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything was trained and flown before: it does nothing again."""
    monkeypatch.setattr("lpac.train.run.write_card", lambda *_: None)
    path, out = written(tmp_path), tmp_path / "run"
    AblationRun(read_ablation(path), out, lambda now: None).run(here)
    before = {each: each.read_bytes() for each in out.rglob("*") if each.is_file()}
    result = called("ablate", path, "--out", out)
    assert result.returncode == 0, (result.stdout, result.stderr)
    told = json.loads((out / "ablation.json").read_text())
    assert "6 worlds of the validation set from 2 on, n3, 1 s; cost at the end" in result.stdout
    for variant in told["variants"]:
        [row] = [line for line in result.stdout.splitlines() if line.startswith(variant["name"])]
        assert f" {variant['mean'][0]:.3f} " in row
        assert variant["verdict"] is None or row.rstrip().endswith(variant["verdict"])
    assert "2 training seeds: the results hold for these policies" in result.stdout
    assert before.items() <= {each: each.read_bytes() for each in before}.items()
    again = called("ablate", path, "--out", out, "--json")
    assert json.loads(again.stdout) == told


def test_what_ends_it_is_one_line(tmp_path: Path) -> None:
    # Seeds enough that it surely has work left.
    path, out = written(tmp_path, ("[0, 4]", "[0, 1, 2, 3, 4, 5]")), tmp_path / "run"
    command = [sys.executable, "-m", "lpac.cli.main", "ablate", str(path), "--out", str(out)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, process_group=0, text=True) as process:
        while not list(out.glob("base-0/data/*-*.npz")):
            assert process.poll() is None
            time.sleep(0.02)
        second = error_line(called("ablate", path, "--out", out))
        assert f"is in use by process {process.pid} on this machine" in second
        os.killpg(process.pid, signal.SIGINT)
        _, told = process.communicate()
    assert process.returncode == 130 and told.strip().endswith(
        "lpac: interrupted: the same command continues"
    )


def test_what_cannot_be_is_one_line(tmp_path: Path) -> None:
    """Others are in tests/unit/ablate."""
    path = written(tmp_path, ("train.network.hops = 0", "train.dagger.rounds = 0"))
    told = error_line(called("ablate", path, "--out", tmp_path / "run"))
    assert "parts.toml: no-features: train.dagger.rounds = 0: must be the base's, 1" in told
