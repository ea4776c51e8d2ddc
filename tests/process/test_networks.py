"""docs/networks.md and examples/networks as they stand: exported, verified, trained, and flown."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from edge.policy.bundle import load_bundle
from export.module import load_class
from lpac.sim.points import fly_points
from lpac.sim.scenario import Scenario
from lpac.train.config import config_of
from lpac.train.run import TrainingRun
from tests.conftest import ROOT
from tests.training import here

PAGE = (ROOT / "docs" / "networks.md").read_text()
[MODULE] = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
[COMMANDS] = re.findall(r"^```sh\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
EXAMPLES = ROOT / "examples" / "networks"
# A training of seconds.
LESS = {
    "flights = 40\nstates = 30\nduration_s = 45.0": "flights = 2\nstates = 4\nduration_s = 4.0",
    "epochs = 10\nbatch": "epochs = 1\nbatch",
    "rounds = 2\nflights = 40\nduration_s = 60.0\nepochs = 3": "rounds = 0",
    "worlds = 10\nevery_epochs = 10": (
        'worlds = 1\nset_ups = ["n5"]\nduration_s = 4.0\nmission_s = 4.0\nevery_epochs = 10'
    ),
}


def run(folder: Path, command: str) -> subprocess.CompletedProcess[str]:
    program, *arguments = shlex.split(command)
    assert program == "lpac"
    return subprocess.run(
        [sys.executable, "-m", "lpac.cli.main", *arguments],
        cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page's module, a checkpoint of it, and the parameters of its training."""
    made = tmp_path_factory.mktemp("networks")
    (made / "lean.py").write_text(MODULE)
    torch.manual_seed(1)
    torch.save(load_class(f"{made}/lean.py:Lean")().state_dict(), made / "lean.pt")
    (made / "params.toml").write_text((EXAMPLES / "memory.toml").read_text())
    return made


def test_the_page_leads_from_a_module_to_a_flight(folder: Path) -> None:
    export, verify, points, robots = COMMANDS.splitlines()
    exported = run(folder, export)
    assert (exported.returncode, exported.stderr) == (0, ""), exported.stderr
    assert re.search(r"^family +network$", exported.stdout, re.MULTILINE)
    verified = run(folder, verify)
    assert verified.returncode == 0 and "step: action" in verified.stdout
    flown = run(folder, f"{points} -n 3 --duration 3 --json")
    assert flown.returncode == 0, flown.stderr
    flown = run(folder, f"{robots} --duration 3 --json")
    assert flown.returncode == 0, flown.stderr
    flight = json.loads(flown.stdout)
    assert flight["took_off"] and flight["all_landed"] and flight["problem"] is None


@pytest.mark.parametrize(
    ("before", "after", "problem"),
    [
        (".sum(dim=0)\n        return self.act", ".mean(dim=0)\n        return self.act",
         "step with no neighbours: gives NaN or infinity"),
        ("positions: Tensor):", "position: Tensor):", "step takes 'position': known are features"),
        ("class Lean(nn.Module)", "class Lean", "is a Lean: must be a torch.nn.Module"),
    ],
)  # fmt: skip
def test_what_cannot_be_exported_is_refused_in_one_line(
    folder: Path, before: str, after: str, problem: str
) -> None:
    assert before in MODULE
    text = MODULE.replace(before, after)
    if after == "class Lean":
        text = text.split("    def __init__")[0]
    (folder / "wrong.py").write_text(text)
    export = COMMANDS.splitlines()[0].replace("lean.py", "wrong.py")
    refused = run(folder, export)
    assert refused.returncode == 1 and problem in refused.stderr
    assert len(refused.stderr.splitlines()) == 1 and "Traceback" not in refused.stderr


@pytest.mark.parametrize("name", ["attention", "memory", "diffusion"])
def test_an_example_is_trained_and_flies(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)  # as in README.md
    text = (EXAMPLES / f"{name}.toml").read_text()
    for more, less in LESS.items():
        assert more in text
        text = text.replace(more, less)
    config = config_of(text, name, EXAMPLES)
    report = TrainingRun(config, tmp_path, lambda _: None).run(here)
    bundle = load_bundle(report["bundle"])
    assert (bundle.manifest.family, bundle.manifest.name) == ("network", name)
    flown = fly_points(Scenario(robots=5, seed=4, duration_s=4.0), bundle)
    assert flown.message_counts["accepted"] > 0
    # The same weights, from the checkpoint.
    if name != "attention":
        reference = config.config.network["module"]
        exported = run(
            ROOT,
            f"lpac export {reference} --checkpoint {tmp_path / name}.pt "
            f"--params {EXAMPLES / name}.toml -o {tmp_path / 'again'}",
        )
        assert exported.returncode == 0, exported.stderr
        again = load_bundle(tmp_path / "again")
        assert again.files["step.onnx"] == bundle.files["step.onnx"]
