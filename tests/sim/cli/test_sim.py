"""`lpac sim` in this process, on simulated time."""

import io
import json
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.core.world import GaussianFeature, parse_world
from edge.policy.bundle import load_bundle, make_bundle, write_bundle
from lpac.analysis.worlds import format_world
from tests.command import called, error_line
from tests.conftest import SHIPPED


def test_sim_json_is_the_same_twice() -> None:
    runs = [called("sim", "--seed", 7, "--duration", 5, "--json") for _ in range(2)]
    assert runs[0].returncode == 0, runs[0].stderr
    assert runs[0].stdout == runs[1].stdout
    result = json.loads(runs[0].stdout)
    assert result["seed"] == 7 and result["robots"] == 10
    assert 0.0 < result["cost"]["final_normalized"] < 1.0


def test_sim_flies_with_the_radio_of_a_field(tmp_path: Path) -> None:
    wifi = tmp_path / "wifi.toml"
    wifi.write_text("data_rate_mbit_s = 54\n")
    options = ("--duration", 1, "--robots", 30, "--transport", "multicast", "--wifi", wifi)
    result = called("sim", *options)
    assert result.returncode == 0, result.stderr
    assert "\nmulticast: by the model " in result.stdout
    assert "data_rate_mbit_s = 54  # from the file\n" in result.stdout
    assert "frame_loss = 0.05  # assumed\n" in result.stdout
    link = json.loads(called("sim", *options, "--json").stdout)["link"]
    assert link["loss"] > 0.0 and link["by_model"]["wifi"]["data_rate_mbit_s"] == 54.0


def test_sim_writes_a_flight_over_a_world_file(tmp_path: Path) -> None:
    world = tmp_path / "world.env"
    world.write_text("CircularBND 300 200 40 6\nUniform 3 0.001\n10 10\n100 10\n10 90\n")
    out = tmp_path / "flight"
    result = called(
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


def test_a_start_outside_of_the_world_is_one(tmp_path: Path) -> None:
    starts = tmp_path / "starts.txt"
    starts.write_text("1 32\n1 33\n")
    told = error_line(called("sim", "-n", "2", "--starts", starts))
    assert "line 2: 1 33: is outside of the world: must be from 0 to 32 m" in told


def test_features_that_a_smaller_world_leaves_out_are_counted(tmp_path: Path) -> None:
    world = tmp_path / "world.env"
    inside, outside = (
        GaussianFeature((50.0, 50.0), (9.0, 9.0)),
        GaussianFeature((300.0, 50.0), (9.0, 9.0)),
    )
    world.write_text(format_world((inside, outside)))
    told = called("sim", "-n", 1, "--duration", 1, "--world", world, "--world-size", 128)
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
    told = called("sim", "-n", 1, "--duration", 1, "--bundle", tmp_path / "wrong")
    assert told.returncode == 0
    assert "wrong: swarm did not reproduce the bundle's golden outputs here" in told.stderr


@pytest.mark.slow
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
        name: json.loads(called("sim", "--duration", 5, "--json", *its).stdout)
        for name, its in options.items()
    }
    ends = {name: json.dumps(flight["final_positions_m"]) for name, flight in flights.items()}
    assert len(set(ends.values())) == len(options)
    moved = np.array(flights["starts"]["final_positions_m"]) - [[3 * i, 2 * i] for i in range(10)]
    assert np.linalg.norm(moved, axis=1).max() <= 5 * 1.25 + 0.1


def test_whole_robots_have_knobs_too(tmp_path: Path) -> None:
    """One flight has them all, and says who came nearest to whom by their names."""
    starts, out = tmp_path / "starts.txt", tmp_path / "flight"
    starts.write_text("4 4\n20 4\n")
    told = called(
        "sim", "--vehicle", "simulated", "-n", 2, "--duration", 3, "--policy-hz", 1,
        "--max-message-age", 0.01, "--loss", 1, "--range", 100, "--world-size", 700,
        "--starts", starts, "--no-errors", "--out", out,
    )  # fmt: skip
    assert re.search(r"least true separation in the air: [\d.]+ m, r0 and r1 at ", told.stdout)
    flight = json.loads((out / "flight.json").read_text())
    began_m = np.array(flight["start_positions_m"])[:, :2]
    np.testing.assert_allclose(began_m, [[4, 4], [20, 4]], atol=1.0)
    # From the mission's start on nothing is heard any more.
    assert flight["steps_s"]["mission"] > 0.0 and "r0: not heard; r1: not heard" in told.stdout
    flown = load_bundle(out / "bundle").manifest
    assert flown.perception is not None
    assert (flown.perception.world_size, flown.perception.communication_range) == (700, 100.0)
    for robot in range(2):
        has = tomllib.loads((out / "robots" / str(robot) / "robot.toml").read_text())
        assert (has["rates"]["policy_hz"], has["policy"]["max_message_age_s"]) == (1.0, 0.01)
