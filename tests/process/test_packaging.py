"""What is installed: everything, below three import names; and what a robot needs for it."""

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

from lpac.cli.options import DEFAULT_BUNDLE
from tests.conftest import ROOT


def test_the_wheel_holds_everything_below_three_names(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*command, "-w", tmp_path, ROOT], check=True, cwd=tmp_path)
    (wheel,) = tmp_path.glob("lpac_edge-*.whl")
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


def test_a_robot_installs_nothing_that_it_does_not_need() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    names = {re.match(r"[\w-]+", requirement)[0] for requirement in project["dependencies"]}  # type: ignore[index]
    assert names == {
        "eclipse-zenoh", "geographiclib", "mavsdk", "mcap", "msgspec", "numpy", "onnxruntime",
        "pynacl", "structlog", "typer", "zstandard",
    }  # fmt: skip
