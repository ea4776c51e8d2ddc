"""The `lpac` command as a user types it."""

import ast
import json
import os
import platform
import re
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import typer

from lpac.cli.main import app
from lpac.extras import install_command
from tests.command import called, error_line, lpac
from tests.conftest import ROOT, SHIPPED


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["robot", "--help"]])
def test_only_the_command_that_runs_is_loaded(arguments: list[str]) -> None:
    code = f"""
import sys
from lpac.cli.main import app
sys.argv = ["lpac", *{arguments}]
app(standalone_mode=False)
print(sorted(n for n in sys.modules if n.startswith("lpac.cli.")), "rich" in sys.modules)
"""
    told = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    loaded = [
        "lpac.cli.apps",
        "lpac.cli.main",
        *(["lpac.cli.robot"] if "robot" in arguments else []),
    ]
    assert told.stdout.splitlines()[-1] == f"{loaded} False"


def test_the_version_is_the_installed_one() -> None:
    assert lpac("--version").stdout == f"lpac {version('lpac-edge')}\n"


@pytest.mark.parametrize(
    ("typed", "completed"),
    [("lpac mi", "mission"), ("lpac mission ta", "takeoff"), ("lpac sim --veh", "--vehicle")],
)
def test_a_shell_completes_commands_and_options(typed: str, completed: str) -> None:
    asked = os.environ | {
        "_LPAC_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": str(typed.count(" ")),
    }  # fmt: skip
    code = "import sys; sys.argv = ['lpac']; from lpac.cli.main import main; main()"
    told = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=asked, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert told.stdout.split() == [completed]


def test_every_command_that_people_are_pointed_to_exists() -> None:
    """In the documents, and in what programs say."""
    listed: Any = typer.main.get_command(app)
    commands = {name: listed.get_command(None, name) for name in listed.list_commands(None)}
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.*")]
    parts = ("edge", "lpac")
    programs = [path for part in parts for path in (ROOT / part).rglob("*.py")]
    for path in [*(page for page in pages if page.suffix in (".md", ".toml")), *programs]:
        for name, sub in re.findall(r"`lpac ([a-z]+)(?: ([a-z0-9]+))?", path.read_text()):
            assert name in commands, (path, name)
            below = getattr(commands[name], "commands", {})
            assert not below or not sub or sub in below, (path, name, sub)


def test_bundle_info_for_people_and_for_scripts() -> None:
    text = called("bundle", "info", SHIPPED)
    assert text.returncode == 0
    assert "L = 2 layers (34 -> 256 -> 256), K = 3 hops" in text.stdout
    assert "870 values: 3,480 B in float32" in text.stdout
    manifest = json.loads(called("bundle", "info", SHIPPED, "--json").stdout)
    assert manifest["geometry"] == {"hops": 3, "feature_sizes": [34, 256, 256]}
    assert manifest["id"] == (SHIPPED / "bundle.id").read_text().strip()


def test_bundle_verify_reports_the_error_of_each_graph() -> None:
    result = lpac("bundle", "verify", SHIPPED, "--json")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert set(report["errors"]) == {
        "cnn.onnx", "gnn_1.onnx", "gnn_2.onnx", "action.onnx", "swarm",
    }  # fmt: skip
    assert max(report["errors"].values()) <= report["tolerance"] and report["failed"] == []
    assert "computes the golden outputs" in called("bundle", "verify", SHIPPED).stdout


def test_bundle_verify_after_one_flipped_byte(tmp_path: Path) -> None:
    copy = tmp_path / "bundle"
    shutil.copytree(SHIPPED, copy)
    content = bytearray((copy / "gnn_2.onnx").read_bytes())
    content[len(content) // 2] ^= 0xFF
    (copy / "gnn_2.onnx").write_bytes(content)
    line = error_line(lpac("bundle", "verify", copy))
    assert line.endswith("gnn_2.onnx does not have the hash that manifest.json states")


def test_bundle_benchmark_times_the_steps_of_a_flight() -> None:
    result = lpac("bundle", "benchmark", SHIPPED, "--seconds", 0.2, "--neighbours", 3, "--json")
    # A busy machine may be too slow, which it says.
    assert result.returncode == 0 or "too slow on this machine" in error_line(result)
    report = json.loads(result.stdout)
    assert report["id"] == (SHIPPED / "bundle.id").read_text().strip()
    assert report["architecture"] == platform.machine() and report["neighbours"] == 3
    periods_ms = {name: step["period_ms"] for name, step in report["steps"].items()}
    assert periods_ms == {"perceive": 200.0, "infer": 400.0}
    for step in report["steps"].values():
        assert 0.0 < step["p50_ms"] <= step["p99_ms"] <= step["max_ms"]
    assert "p99 is" in called("bundle", "benchmark", SHIPPED, "--seconds", 0.2).stdout


def test_a_machine_that_is_too_slow_is_told_in_one_line() -> None:
    code = (
        "import sys, edge.robot.benchmark as b; b.MOST_OF_PERIOD = 0.0; sys.argv = ['lpac', "
        f"'bundle', 'benchmark', '{SHIPPED}', '--seconds', '0.1']; "
        "import lpac.cli.main as m; m.main()"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert "too slow on this machine: perceive " in error_line(result)


def test_what_is_not_installed_is_said_in_one_line() -> None:
    code = (
        "import sys; sys.modules['torch'] = None; sys.argv = ['lpac', 'export', "
        f"'{SHIPPED}.pt', '--params', '{SHIPPED}.toml', '-o', 'x']; "
        "import lpac.cli.main as m; m.main()"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert error_line(result) == (
        f"lpac: torch is not installed here: `{install_command('export')}`"
    )


def test_ctrl_c_while_a_program_starts_is_one_line(tmp_path: Path) -> None:
    # A module, and in a string: there Python has an end of its own for it.
    (tmp_path / "started.py").write_text("""
import sys
import lpac.cli.main, lpac.fleet.settings
def stopped(_):
    exec("raise KeyboardInterrupt")
lpac.fleet.settings.load_fleet = stopped
sys.argv = ["lpac", "watch"]
lpac.cli.main.main()
""")
    result = subprocess.run(
        [sys.executable, "-m", "started"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (result.returncode, result.stdout) == (130, "")
    assert error_line(result) == "lpac: interrupted"


def test_a_bad_world_file_is_named(tmp_path: Path) -> None:
    world = tmp_path / "world.env"
    world.write_text("CircularBND 300 200 forty 6\n")
    assert "forty" in error_line(lpac("sim", "--world", world))


def test_export_then_verify(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="export needs torch")
    for output in ("bundle", "bundle.zip"):
        result = called(
            "export", f"{SHIPPED}.pt", "--params", f"{SHIPPED}.toml", "-o", tmp_path / output
        )
        assert result.returncode == 0, result.stderr
        assert called("bundle", "verify", tmp_path / output).returncode == 0


def test_verify_imports_no_torch() -> None:
    result = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "lpac.cli.main", "bundle", "verify",
        str(SHIPPED)],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "onnxruntime" in result.stderr
    assert "torch" not in result.stderr + result.stdout


def test_nothing_is_written_into_the_home_folder(tmp_path: Path) -> None:
    """onnxruntime would leave a telemetry database there."""
    subprocess.run(
        [sys.executable, "-m", "lpac.cli.main", "bundle", "verify", str(SHIPPED)],
        cwd=ROOT, check=True, capture_output=True,
        env={**os.environ, "HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)},
    )  # fmt: skip
    assert list(tmp_path.iterdir()) == []


def test_robot_process_loads_no_workstation_package() -> None:
    """Run the policy's whole path, then look at what was imported."""
    code = """
import sys
sys.argv = ["lpac", "bundle", "verify", "policies/lpac_l2_k3_n10_512"]
import lpac.cli.main, edge.robot.process, edge.drivers.px4.driver, edge.drivers.zenoh_link
try:
    lpac.cli.main.main()
except SystemExit as stop:
    assert not stop.code, stop.code
print(sorted({name if name.startswith("lpac.") else name.split(".")[0] for name in sys.modules}))
"""
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    loaded = set(ast.literal_eval(result.stdout.splitlines()[-1]))
    assert {"onnxruntime", "structlog"} <= loaded
    workstation = {"torch", "torch_geometric", "onnx", "matplotlib", "export", "rich"}
    assert loaded.isdisjoint(workstation | {"lpac.sim", "lpac.ground"})
