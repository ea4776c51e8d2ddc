"""examples/camera, installed elsewhere: whole robots fly with it."""

import json
import os
import subprocess
import sys
from pathlib import Path

from tests.conftest import ROOT


def test_it_flies(tmp_path: Path) -> None:
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    options = ["--no-deps", "--no-index", "--no-build-isolation"]
    source = str(ROOT / "examples" / "camera")
    subprocess.run([*pip, "install", *options, "--target", tmp_path, source], check=True)
    paths = os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH", ""))))
    flown = subprocess.run(
        [
            sys.executable, "-m", "lpac.cli.main", "sim", "--vehicle", "simulated",
            "--sensor", "camera", "-n", "2", "--seed", "3", "--duration", "4", "--json",
        ],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert flown.returncode == 0, flown.stderr
    flight = json.loads(flown.stdout)
    assert flight["took_off"] and flight["all_landed"] and flight["problem"] is None, flight
    assert len(set(flight["cost_curve"]["normalized_cost"])) > 1
