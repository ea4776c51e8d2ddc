"""The wheel in an environment of its own, used from a folder that is not this repository."""

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from tests.conftest import ROOT, SHIPPED

LOADED_FROM_HERE = "raise SystemExit('a folder of the working directory was imported')"


@pytest.fixture(scope="module")
def lpac(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`lpac` of the wheel; it shares this environment's packages, not its editable install."""
    folder = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    options = ["--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "wheel", *options, "-w", folder, ROOT], check=True, cwd=folder)
    (wheel,) = folder.glob("lpac_edge-*.whl")
    environment = folder / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    python = environment / "bin" / "python"
    subprocess.run(
        [*pip, "--python", python, "install", "--no-deps", "--no-index", wheel], check=True
    )
    (site,) = environment.glob("lib/python*/site-packages")
    # A folder that a .pth file names has its own .pth files, the editable install's, left unread.
    (site / "shared.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return environment / "bin" / "lpac"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A person's folder, with packages in it that are called as ours."""
    for name in ("cli", "edge", "export", "lpac"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(LOADED_FROM_HERE)
    return tmp_path


def run(lpac: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    return subprocess.run(
        [lpac, *arguments], cwd=folder, env=environment, capture_output=True, text=True,
        check=False,
    )  # fmt: skip


def test_the_policy_is_found(lpac: Path, folder: Path) -> None:
    told = run(lpac, folder, "demo", "--help")
    assert (told.returncode, told.stderr) == (0, "")
    assert "out/demo" in told.stdout
    flown = run(lpac, folder, "sim", "--robots", "2", "--duration", "1", "--out", "flight")
    assert (flown.returncode, flown.stderr) == (0, "")
    assert (folder / "flight" / "flight.png").exists()


def test_the_programs_that_it_starts_are_its_own(lpac: Path, folder: Path) -> None:
    """Those that measure this machine, and a robot's."""
    flown = run(
        lpac, folder, "sim", "--vehicle", "mavlink", "-n", "1", "--duration", "1", "--out", "flight"
    )
    assert "of these robots and vehicles" in flown.stderr
    assert "1 flight logs" in flown.stdout, flown.stderr
    log = (folder / "flight" / "robots" / "0" / "robot.log").read_text()
    assert "working directory was imported" not in log


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["robot", "check"], "robot.toml: cannot be read"),
        (["ground"], "fleet.toml: cannot be read"),
        (["report", "logs"], "logs"),
        (["bundle", "verify", "absent"], "absent: No such file"),
    ],
)
def test_a_mistake_is_one_line_here_too(
    lpac: Path, folder: Path, arguments: list[str], text: str
) -> None:
    told = run(lpac, folder, *arguments)
    assert told.returncode == 1
    (line,) = told.stderr.splitlines()
    assert line.startswith("lpac: ") and text in line


def test_a_bundle_is_verified(lpac: Path, folder: Path) -> None:
    told = run(lpac, folder, "bundle", "verify", str(SHIPPED))
    assert (told.returncode, told.stderr) == (0, "")
