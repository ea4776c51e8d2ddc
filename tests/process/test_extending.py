"""docs/extending.md as it stands: the package that it shows is installed elsewhere, and flies."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

GUIDE = (ROOT / "docs" / "extending.md").read_text()
# `name`: and, after an empty line, the file in a fence.
FILES = dict(re.findall(r"^`([\w./]+)`:\n\n```\w+\n(.*?)^```$", GUIDE, re.MULTILINE | re.DOTALL))
[COMMANDS] = re.findall(r"^```sh\n(.*?)^```$", GUIDE, re.MULTILINE | re.DOTALL)

# Both simulators of points, in worlds that differ.
BATCH = """
import json
from pathlib import Path
from edge.policy.bundle import load_bundle
from lpac.sim.batch import fly_batch
from lpac.sim.points import fly_points
from lpac.sim.scenario import Scenario
from lpac.sim.failure import Failure

bundle = load_bundle(Path("lloyd"))
scenarios = [
    Scenario(robots=4, duration_s=6.0, loss=0.3),
    Scenario(robots=3, duration_s=8.0, failures=(Failure(0, 2.0, until_s=3.0),), lag_s=1.0),
    Scenario(robots=2, duration_s=4.0, world_size=300, communication_range=200.0),
]
flights = zip(fly_batch(scenarios, bundle), scenarios)
same = [a.positions_m == fly_points(b, bundle).positions_m for a, b in flights]
print(json.dumps([each.all().item() for each in same]))
"""

# Another policy, with the golden outputs of this one.
OTHER = """
from dataclasses import replace
from pathlib import Path
from edge.policy.bundle import load_bundle, make_bundle, write_bundle

bundle = load_bundle(Path("lloyd"))
files = {name: bundle.files[name] for name in bundle.manifest.files}
manifest = replace(bundle.manifest, parameters={"gain": 0.5001})
write_bundle(make_bundle(manifest, files), Path("other"))
"""

# `lpac` with an agent that cannot perceive.
BROKEN = """
import lpac_lloyd.policy as policy
from lpac.cli.main import main

def observe(self, observation):
    return observation.position[2]

policy.LloydAgent.observe = observe
if __name__ == "__main__":
    main()
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package's source, and in `site` the package, installed."""
    folder = tmp_path_factory.mktemp("extending")
    for name, text in FILES.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    options = ["--no-deps", "--no-index", "--no-build-isolation"]
    site = folder / "site"
    subprocess.run([*pip, "install", *options, "--target", site, "."], check=True, cwd=folder)
    return folder


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    paths = (str(folder / "site"), os.environ.get("PYTHONPATH", ""))
    return subprocess.run(
        [str(Path(sys.executable).with_name(arguments[0])), *arguments[1:]],
        cwd=folder / "site",
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture(scope="module")
def bundle(installed: Path) -> None:
    install, make, *_ = COMMANDS.splitlines()
    assert install == "pip install ."
    made = run(installed, *shlex.split(make))
    assert (made.returncode, made.stderr) == (0, "")


@pytest.mark.usefixtures("bundle")
def test_the_bundle_says_what_it_is(installed: Path) -> None:
    info, verify = "lpac bundle info lloyd", "lpac bundle verify lloyd"
    assert f"{info}\n{verify}\n" in COMMANDS
    told = run(installed, *shlex.split(info))
    assert (told.returncode, told.stderr) == (0, "")
    for line in ("family       lloyd", "gain         0.5", "made by      lpac-lloyd 1.0"):
        assert line in told.stdout.splitlines()
    verified = run(installed, *shlex.split(verify))
    assert (verified.returncode, verified.stderr) == (0, "")
    assert verified.stdout.startswith("steps        relative error 0.0e+00  ok\n")
    times = run(installed, *shlex.split("lpac bundle benchmark lloyd --seconds 0.1 --json"))
    assert set(json.loads(times.stdout)["steps"]) == {"perceive", "infer"}


@pytest.mark.usefixtures("bundle")
def test_what_computes_something_else_is_not_verified(installed: Path) -> None:
    assert run(installed, "python", "-c", OTHER).returncode == 0
    verified = run(installed, "lpac", "bundle", "verify", "other")
    assert verified.returncode == 1
    assert "FAILED" in verified.stdout
    assert verified.stderr.startswith("lpac: other: steps: not within 1e-05 of ")


@pytest.mark.usefixtures("bundle")
@pytest.mark.parametrize(
    "vehicle", ["simulated", pytest.param("mavlink", marks=pytest.mark.real_time)]
)
def test_it_flies(installed: Path, vehicle: str) -> None:
    [command] = [line for line in COMMANDS.splitlines() if f"--vehicle {vehicle}" in line]
    flown = run(installed, *shlex.split(command), "--json")
    assert flown.returncode == 0, flown.stderr
    flight = json.loads(flown.stdout)
    curve = flight["cost_curve"]["normalized_cost"]
    assert max(curve) - min(curve) > 0.02, curve  # the policy took them somewhere
    assert all(robot["messages"]["accepted"] > 0 for robot in flight["fleet"])


@pytest.mark.usefixtures("bundle")
def test_it_flies_in_batches_as_it_does_alone(installed: Path) -> None:
    flown = run(installed, "python", "-c", BATCH)
    assert (flown.returncode, flown.stderr) == (0, "")
    assert json.loads(flown.stdout) == [True, True, True]


@pytest.mark.usefixtures("bundle")
def test_the_fog_hides_what_is_far(installed: Path) -> None:
    """The same flight under the built-in sensor is another one."""
    [command] = [line for line in COMMANDS.splitlines() if "--vehicle simulated" in line]
    short = ["--duration", "5", "--json"]
    flights = [
        json.loads(run(installed, *shlex.split(text), *short).stdout)
        for text in (command, command.replace("--sensor fog", ""))
    ]
    assert flights[0] != flights[1]


@pytest.mark.usefixtures("bundle")
@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (
            "--bundle lloyd --sensor haze",
            "sensor: type = 'haze': is not installed here (entry points 'lpac_edge.sensors'): "
            "install the package that has it; known are 'fog', 'world'",
        ),
    ],
)
def test_what_is_not_installed_is_named(installed: Path, arguments: str, text: str) -> None:
    refused = run(installed, "lpac", "sim", "--vehicle", "simulated", *shlex.split(arguments))
    assert refused.returncode == 1
    assert text in refused.stderr and "Traceback" not in refused.stderr


@pytest.mark.usefixtures("bundle")
@pytest.mark.parametrize(
    "arguments",
    [
        "sim --bundle lloyd -n 2 --duration 5",
        "sim --bundle lloyd -n 2 --duration 5 --vehicle simulated",
        "evaluate lloyd --worlds 1 --set-up n3 --duration 5",
        "bundle benchmark lloyd --seconds 0.1",
        "drill --bundle lloyd -n 2 --fault none --seed 0",
    ],
)
def test_what_an_agent_raises_is_one_line(installed: Path, arguments: str) -> None:
    (installed / "site" / "broken.py").write_text(BROKEN)
    refused = run(installed, "python", "broken.py", *shlex.split(arguments))
    assert refused.returncode == 1
    text = "policy: IndexError: index 2 is out of bounds for axis 0 with size 2 (site/broken.py, "
    assert text in refused.stderr + refused.stdout and "Traceback" not in refused.stderr
    if arguments.startswith("sim"):
        assert refused.stderr.splitlines()[-1].startswith("lpac: robot ")
