"""The wheel: what is in it, and its use in an environment of its own, from another folder."""

import os
import signal
import subprocess
import sys
import sysconfig
import time
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from threading import Timer

import pytest

from lpac.cli.options import DEFAULT_BUNDLE
from tests.conftest import ROOT, SHIPPED

PATIENCE_S = 60.0
LOADED_FROM_HERE = "raise SystemExit('a folder of the working directory was imported')"


PIP = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    options = ["--no-deps", "--no-build-isolation"]
    subprocess.run([*PIP, "wheel", *options, "-w", folder, ROOT], check=True, cwd=folder)
    (built,) = folder.glob("lpac_edge-*.whl")
    return built


@pytest.fixture(scope="module")
def lpac(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`lpac` of the wheel; it shares this environment's packages, not its editable install."""
    environment = tmp_path_factory.mktemp("installed") / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    python = environment / "bin" / "python"
    subprocess.run(
        [*PIP, "--python", python, "install", "--no-deps", "--no-index", wheel], check=True
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
    return subprocess.run(
        [lpac, *arguments], cwd=folder, env=environment(folder), capture_output=True, text=True,
        check=False,
    )  # fmt: skip


def environment(folder: Path) -> dict[str, str]:
    """Without this repository; the ground's socket is in the folder."""
    kept = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    return kept | {"XDG_RUNTIME_DIR": str(folder)}


def test_the_wheel_holds_everything_below_three_names(wheel: Path) -> None:
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert {name.split("/")[0] for name in names} == {"edge", "export", "lpac"}
    made = {path for part in ("edge", "export", "lpac") for path in (ROOT / part).rglob("*")}
    for path in made:
        if path.is_file() and "__pycache__" not in path.parts:
            assert str(path.relative_to(ROOT)) in names
    shipped = {name.removeprefix("lpac/_shipped/") for name in names if "/_shipped/" in name}
    assert shipped == {
        *(str(path.relative_to(ROOT)) for path in DEFAULT_BUNDLE.iterdir()),
        *(f"systemd/{path.name}" for path in (ROOT / "systemd").iterdir()),
    }


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
    assert "1 flight log\n" in flown.stdout, flown.stderr
    log = (folder / "flight" / "robots" / "0" / "robot.log").read_text()
    assert "working directory was imported" not in log
    told = run(lpac, folder, "report", "flight/robots")
    assert told.returncode == 0, told.stderr
    assert (folder / "flight" / "robots" / "report" / "report.html").exists()


def test_a_fleet_is_commanded_seen_and_recorded(lpac: Path, folder: Path) -> None:
    with ExitStack() as stack:
        started = stack.enter_context
        started(program(lpac, folder, "  lpac ground", "sim", "--vehicle", "mavlink", "-n", "1",
                        "--no-script", "--out", "fleet"))  # fmt: skip
        fleet = ("--fleet", "fleet/fleet.toml")
        started(program(lpac, folder, "ground station ann", "ground", "--name", "ann", *fleet))
        started(program(lpac, folder, "connected to the ground", "record", "--out", "logs", *fleet))
        started(program(lpac, folder, "only observes", "map", "--port", "0", *fleet))
        until_s = time.monotonic() + PATIENCE_S
        seen = ""
        while '"state": "idle"' not in seen:
            assert time.monotonic() < until_s, seen
            seen = run(lpac, folder, "watch", "--json", *fleet).stdout
        told = run(lpac, folder, "mission", "enable", *fleet)
        assert told.returncode == 1 and "mission origin" in told.stdout + told.stderr, told
    assert list((folder / "logs").glob("ground-*.mcap"))


@contextmanager
def program(lpac: Path, folder: Path, says: str, *arguments: str) -> Iterator[None]:
    """It runs, and has said so; Ctrl-C ends it."""
    with subprocess.Popen(
        [lpac, *arguments], cwd=folder, env=environment(folder), text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    ) as running:  # fmt: skip
        try:
            assert running.stdout is not None
            silent = Timer(PATIENCE_S, running.kill)
            silent.start()
            has_said = any(says in line for line in running.stdout)
            silent.cancel()
            assert has_said, says
            yield
        finally:
            running.send_signal(signal.SIGINT)
            running.communicate(timeout=PATIENCE_S)
    assert running.returncode == 0


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["robot", "check"], "robot.toml: cannot be read"),
        (["ground"], "fleet.toml: cannot be read"),
        (["report", "logs"], "logs"),
        (["bundle", "verify", "absent"], "absent: there is no such file"),
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
