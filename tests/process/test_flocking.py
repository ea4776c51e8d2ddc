"""examples/flocking, installed elsewhere: it is trained, verified, and flown."""

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch

from edge.core.schema import ConfigError
from edge.policy.bundle import load_bundle
from edge.policy.family import Observation
from lpac.sim.points import fly_points
from lpac.sim.scenario import Scenario
from lpac.train.config import config_of
from lpac.train.run import TrainingRun
from tests.conftest import ROOT
from tests.training import here

SOURCE = ROOT / "examples" / "flocking"
QUICK = (SOURCE / "quick.toml").read_text()
# A training of seconds.
LESS = {
    "flights = 24\nstates = 40\nduration_s = 30.0": "flights = 6\nstates = 20\nduration_s = 15.0",
    "robots = [4, 14]": "robots = [4, 6]",
    "epochs = 30\nbatch": "epochs = 40\nbatch",
    "rounds = 2\nflights = 16\nduration_s = 40.0\nepochs = 20": (
        "rounds = 1\nflights = 5\nduration_s = 15.0\nepochs = 30"
    ),
    "worlds = 5\nduration_s = 40.0\nevery_epochs = 30": (
        'worlds = 1\nset_ups = ["n5"]\nduration_s = 10.0\nmission_s = 10.0\nevery_epochs = 40'
    ),
}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the package is installed, and which is searched."""
    folder = tmp_path_factory.mktemp("flocking")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    options = ["--no-deps", "--no-index", "--no-build-isolation"]
    subprocess.run([*pip, "install", *options, "--target", folder, SOURCE], check=True)
    return folder


@pytest.fixture(scope="module")
def bundle(site: Path) -> Path:
    text = QUICK
    for more, less in LESS.items():
        assert more in text
        text = text.replace(more, less)
    threads = torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(site))
        torch.set_num_threads(1)  # as in README.md
        told = TrainingRun(config_of(text, "tiny", SOURCE), site / "run", lambda _: None).run(here)
    torch.set_num_threads(threads)
    assert told["baselines"] == {}
    assert "a flock's" in (site / "run" / "README.md").read_text()
    return Path(told["bundle"])


@pytest.fixture
def installed(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(site))


def lpac(site: Path, *arguments: str) -> str:
    paths = os.pathsep.join(filter(None, (str(site), os.environ.get("PYTHONPATH", ""))))
    told = subprocess.run(
        [sys.executable, "-m", "lpac.cli.main", *arguments],
        cwd=site, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert told.returncode == 0, told.stderr
    return told.stdout


def test_the_command_says_that_it_computes_what_torch_did(site: Path, bundle: Path) -> None:
    assert "swarm" in lpac(site, "bundle", "verify", str(bundle))


@pytest.mark.usefixtures("installed")
def test_robots_that_hear_each_other_come_to_fly_alike(bundle: Path) -> None:
    from lpac_flocking.task import disagreement_m_s, speed_m_s  # noqa: PLC0415

    flown = fly_points(Scenario(robots=6, seed=4, duration_s=25.0), load_bundle(bundle))
    apart = disagreement_m_s(flown.time_s, flown.positions_m)
    assert apart[-25:].mean() < 0.5 * apart[5:30].mean(), apart[::10]
    assert speed_m_s(flown.time_s, flown.positions_m)[-25:].mean() > 0.2


def test_whole_robots_fly_it(site: Path, bundle: Path) -> None:
    told = lpac(
        site, "sim", "--vehicle", "simulated", "--bundle", str(bundle), "-n", "2",
        "--duration", "4", "--json",
    )  # fmt: skip
    flight = json.loads(told)
    assert flight["took_off"] and flight["all_landed"] and flight["problem"] is None, flight
    assert all(robot["messages"]["accepted"] > 0 for robot in flight["fleet"])


def test_the_drill_promises_the_same_of_it(site: Path, bundle: Path) -> None:
    told = lpac(
        site, "drill", "--bundle", str(bundle), "--fault", "none", "-n", "2", "--json",
        "--out", str(site / "drill"),
    )  # fmt: skip
    [fault] = json.loads(told)["faults"]
    assert (fault["flights"], fault["broken"]) == (1, 0)


@pytest.mark.usefixtures("installed")
def test_a_robot_alone_and_one_upon_another_have_finite_features() -> None:
    from lpac_flocking.policy import FEATURES, features_of  # noqa: PLC0415

    place, local_map = np.array([10.0, 20.0]), np.zeros((2, 2), np.float32)
    for others in (np.zeros((0, 2)), place[None]):
        features = features_of(Observation(place, local_map, others, np.zeros(2)), 512, 5.0)
        assert features.shape == (FEATURES,) and np.isfinite(features).all()


@pytest.mark.usefixtures("installed")
def test_an_impossible_size_is_named() -> None:
    text = QUICK.replace("hops = 3", "hops = 0")
    tomllib.loads(text)
    with pytest.raises(ConfigError, match="hops = 0: must be at least 1"):
        config_of(text, "quick.toml", SOURCE)
