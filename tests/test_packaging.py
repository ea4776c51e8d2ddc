"""What a robot installs: the runtime and the command, nothing of the workstation's parts."""

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

from tests.conftest import ROOT


def test_the_wheel_holds_the_robots_parts_only(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*command, "-w", tmp_path, ROOT], check=True, cwd=tmp_path)
    (wheel,) = tmp_path.glob("lpac_edge-*.whl")
    folders = {Path(name).parts[0] for name in zipfile.ZipFile(wheel).namelist()}
    assert {folder for folder in folders if not folder.endswith(".dist-info")} == {"edge", "cli"}


def test_a_robot_installs_nothing_that_it_does_not_need() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    names = {re.match(r"[\w-]+", requirement)[0] for requirement in project["dependencies"]}  # type: ignore[index]
    assert names == {
        "eclipse-zenoh", "geographiclib", "mavsdk", "mcap", "numpy", "onnxruntime",
        "structlog", "typer",
    }  # fmt: skip
