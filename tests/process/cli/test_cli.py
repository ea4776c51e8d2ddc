"""The `lpac` command as a user types it."""

import ast
import io
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

import numpy as np
import pytest
import typer

from edge.core.world import GaussianFeature, format_world, parse_world
from edge.policy.bundle import load_bundle, make_bundle, write_bundle
from lpac.cli.main import app
from lpac.extras import install_command
from tests.conftest import ROOT, SHIPPED


def lpac(*arguments: object, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "lpac.cli.main", *map(str, arguments)],
        cwd=cwd, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200"},
    )  # fmt: skip


def error_line(result: subprocess.CompletedProcess[str]) -> str:
    """The one line that a failed command leaves."""
    assert result.returncode != 0
    *before, line = result.stderr.strip().splitlines()
    # How far it was, where it took long.
    assert all(re.match(r"[a-z ]+ \d+( of \d+)?\b|.* \d+ %", text) for text in before), before
    assert line.startswith("lpac: ")
    return line


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
    text = lpac("bundle", "info", SHIPPED)
    assert text.returncode == 0
    assert "L = 2 layers (34 -> 256 -> 256), K = 3 hops" in text.stdout
    assert "870 values: 3,480 B in float32" in text.stdout
    manifest = json.loads(lpac("bundle", "info", SHIPPED, "--json").stdout)
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
    assert "computes the golden outputs" in lpac("bundle", "verify", SHIPPED).stdout


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
    assert "p99 is" in lpac("bundle", "benchmark", SHIPPED, "--seconds", 0.2).stdout


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


def test_sim_json_is_the_same_twice() -> None:
    runs = [lpac("sim", "--seed", 7, "--duration", 5, "--json") for _ in range(2)]
    assert runs[0].returncode == 0, runs[0].stderr
    assert runs[0].stdout == runs[1].stdout
    result = json.loads(runs[0].stdout)
    assert result["seed"] == 7 and result["robots"] == 10
    assert 0.0 < result["cost"]["final_normalized"] < 1.0


def test_sim_flies_with_the_radio_of_a_field(tmp_path: Path) -> None:
    wifi = tmp_path / "wifi.toml"
    wifi.write_text("data_rate_mbit_s = 54\n")
    options = ("--duration", 1, "--robots", 30, "--transport", "router", "--wifi", wifi)
    result = lpac("sim", *options)
    assert result.returncode == 0, result.stderr
    assert "\nrouter: by the model " in result.stdout
    assert "data_rate_mbit_s = 54  # from the file\n" in result.stdout
    assert "frame_loss = 0.05  # assumed\n" in result.stdout
    link = json.loads(lpac("sim", *options, "--json").stdout)["link"]
    assert link["loss"] > 0.0 and link["by_model"]["wifi"]["data_rate_mbit_s"] == 54.0


def test_sim_writes_a_flight_over_a_world_file(tmp_path: Path) -> None:
    world = tmp_path / "world.env"
    world.write_text("CircularBND 300 200 40 6\nUniform 3 0.001\n10 10\n100 10\n10 90\n")
    out = tmp_path / "flight"
    result = lpac(
        "sim", "--world", world, "--duration", 2, "--robots", 3, "--loss", 0.1, "--delay", 0.1,
        "--out", out,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert "of the initial cost" in result.stdout
    assert {path.name for path in out.iterdir()} == {
        "flight.json", "flight.npz", "flight.png", "flight.pdf", "world.env",
    }  # fmt: skip
    assert json.loads((out / "flight.json").read_text())["robots"] == 3
    assert parse_world((out / "world.env").read_text()) == parse_world(world.read_text())


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["sim", "--robots", "0"], "--robots 0: must be from 1 to 65536"),
        (["sim", "--seed", "-1"], "--seed -1: must be at least 0"),
        (["sim", "--world", "docs/demo.png"], "docs/demo.png: is not a text file"),
        (["sim", "--out", "README.md"], "README.md"),
        (["sim", "--loss", "2"], "--loss 2.0: must be from 0 to 1"),
        (["sim", "--transport", "mesh", "--loss", "0.1"], "--loss and --transport: the model"),
        (["sim", "--transport", "mesh", "--delay", "1"], "--delay and --transport: the model"),
        (["sim", "--transport", "mesh", "--wifi", "absent.toml"], "absent.toml"),
        (["sim", "--wifi", "README.md"], "--wifi does nothing without --transport"),
        (["sim", "--world", "absent.env"], "absent.env: there is no such file"),
        (["sim", "--world", "tests"], "tests: is a folder; a file is needed"),
        (["sim", "--features", "0"], "--features 0: the world would have nothing in it to cover"),
        (["sim", "--world", "/dev/null"], "/dev/null: the world would have nothing in it"),
        (["sim", "--starts", "Makefile"], "Makefile: line 1: must be 'x y', in m"),
        (["sim", "--starts", "/dev/null"], "/dev/null: has 0 starts, and there are 10 robots"),
        (["sim", "--policy-hz", "0"], "--policy-hz 0: must be from 0.1 to 100"),
        (["sim", "--position-error", "-1"], "--position-error -1: must be at least 0"),
        (["sim", "--lost", "10@5"], "lost robots 10@5: must be fewer than the team's 10"),
        (["sim", "--lost", "2@60"], "robot 8 is gone from 60 s on: must be within the flight"),
        (["sim", "--range", "0"], "--range 0.0: must be positive and finite"),
        (["sim", "--secure"], "--secure does nothing with --vehicle point"),
        (["sim", "--no-script"], "--no-script does nothing with --vehicle point"),
        (["sim", "--world", "a.env", "--features", "3"], "--features does nothing with --world"),
        (
            ["sim", "--controller", "shared-cvt", "--loss", "0.5"],
            "--loss does nothing with --controller shared-cvt",
        ),
        (
            ["sim", "--vehicle", "simulated", "--control-hz", "1"],
            "lpac: fleet.toml: robots.r0, in slots[0]: rates: --control-hz 1.0: PX4 needs",
        ),
        (
            ["drill", "--sensor", "foo", "--fault", "none"],
            "sensor: type = 'foo': is not installed here",
        ),
        (["paper", "all", "--namespaces", "a,b"], "2 given, and 10 robots need one each"),
        (["sim", "--away", "3@20-10"], "failure of robot 3: from_s = 20.0, until_s = 10.0: must"),
        (
            ["sim", "--lag", "1", "--vehicle", "mavlink"],
            "--lag does nothing with --vehicle mavlink",
        ),
        (["sim", "--bundle", f"{SHIPPED}.pt"], "is a torch checkpoint; `lpac export"),
        (["sim", "--bundle", "absent"], "absent: there is no such file or folder"),
        (["bundle", "verify", "README.md"], "neither a bundle directory nor its archive"),
        (["bundle", "info", "tests"], "manifest.json is missing"),
        (["bundle", "benchmark", str(SHIPPED), "--neighbours", "-1"], "must be from 0 to 1000"),
        (["export", "absent.pt", "--params", f"{SHIPPED}.toml", "-o", "x"], "absent.pt"),
        (["export", "README.md", "--params", f"{SHIPPED}.toml", "-o", "x"], "README.md"),
        (["export", f"{SHIPPED}.pt", "--params", "absent.toml", "-o", "x"], "absent.toml"),
    ],
)
def test_a_mistake_is_one_line(arguments: list[str], text: str) -> None:
    assert text in error_line(lpac(*arguments))


def test_a_start_outside_of_the_world_is_one(tmp_path: Path) -> None:
    starts = tmp_path / "starts.txt"
    starts.write_text("1 32\n1 33\n")
    told = error_line(lpac("sim", "-n", "2", "--starts", starts))
    assert "line 2: 1 33: is outside of the world: must be from 0 to 32 m" in told


def test_features_that_a_smaller_world_leaves_out_are_counted(tmp_path: Path) -> None:
    world = tmp_path / "world.env"
    inside, outside = (
        GaussianFeature((50.0, 50.0), (9.0, 9.0)),
        GaussianFeature((300.0, 50.0), (9.0, 9.0)),
    )
    world.write_text(format_world((inside, outside)))
    told = lpac("sim", "-n", 1, "--duration", 1, "--world", world, "--world-size", 128)
    assert "1 of 2 features lie outside of the world, whose side is 128" in told.stderr


def test_a_bundle_that_is_not_verified_flies_as_a_point_with_a_warning(tmp_path: Path) -> None:
    bundle = load_bundle(SHIPPED)
    golden = dict(np.load(io.BytesIO(bundle.files["golden.npz"])))
    golden["swarm/velocities"] = golden["swarm/velocities"] * np.float32(1.001)
    changed = io.BytesIO()
    np.savez(changed, **golden)
    files = {name: bundle.files[name] for name in bundle.manifest.files}
    wrong = make_bundle(bundle.manifest, {**files, "golden.npz": changed.getvalue()})
    write_bundle(wrong, tmp_path / "wrong")
    told = lpac("sim", "-n", 1, "--duration", 1, "--bundle", tmp_path / "wrong")
    assert told.returncode == 0
    assert "wrong: swarm of the bundle do not compute its golden outputs here" in told.stderr


def test_whole_robots_have_knobs_too(tmp_path: Path) -> None:
    starts = tmp_path / "starts.txt"
    starts.write_text("4 4\n20 4\n4 20\n")
    options: dict[str, list[Any]] = {
        "as it is": [],
        "rates": ["--policy-hz", 1],
        "ages": ["--max-message-age", 0.01],
        "loss": ["--loss", 1],
        "range": ["--range", 100],
        "world": ["--world-size", 700],
        "starts": ["--starts", starts, "--no-errors"],
    }
    whole = ("sim", "--vehicle", "simulated", "-n", 3, "--duration", 12, "--json")
    flights = {name: json.loads(lpac(*whole, *its).stdout) for name, its in options.items()}
    costs = {name: json.dumps(flight["cost_curve"]) for name, flight in flights.items()}
    assert len(set(costs.values())) == len(options), costs
    began_m = np.array(flights["starts"]["start_positions_m"])[:, :2]
    np.testing.assert_allclose(began_m, [[4, 4], [20, 4], [4, 20]], atol=1.0)


def test_sim_calls_robots_by_their_names() -> None:
    told = lpac("sim", "--vehicle", "simulated", "-n", 2, "--duration", 4).stdout
    assert re.search(r"least true separation in the air: [\d.]+ m, r0 and r1 at ", told), told


def test_sim_has_the_knobs_of_an_experiment(tmp_path: Path) -> None:
    """Each of them changes the flight, and starts are where the file says."""
    starts = tmp_path / "starts.txt"
    starts.write_text("".join(f"{3 * i}, {2 * i}\n" for i in range(10)))
    options: dict[str, list[Any]] = {
        "as it is": [],
        "starts": ["--starts", starts],
        "rates": ["--perception-hz", 1, "--policy-hz", 5, "--control-hz", 20],
        "range": ["--range", 64],
        "world": ["--world-size", 300],
        "lag": ["--lag", 1.3],
        "errors": ["--position-error", 1],
        "lost": ["--lost", "2@2"],
        "together": ["--synchronous"],
        "payload": ["--payload", "int8"],
    }
    flights = {
        name: json.loads(lpac("sim", "--duration", 5, "--json", *its).stdout)
        for name, its in options.items()
    }
    ends = {name: json.dumps(flight["final_positions_m"]) for name, flight in flights.items()}
    assert len(set(ends.values())) == len(options)
    moved = np.array(flights["starts"]["final_positions_m"]) - [[3 * i, 2 * i] for i in range(10)]
    assert np.linalg.norm(moved, axis=1).max() <= 5 * 1.25 + 0.1


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
        result = lpac(
            "export", f"{SHIPPED}.pt", "--params", f"{SHIPPED}.toml", "-o", tmp_path / output
        )
        assert result.returncode == 0, result.stderr
        assert lpac("bundle", "verify", tmp_path / output).returncode == 0


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
