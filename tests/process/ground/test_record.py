"""`lpac record` beside a ground process, which may start again."""

import itertools
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.core.world import parse_world, rasterize
from edge.drivers.log_reader import FlightLogError, read, read_metadata
from edge.messages.mission import FlightState
from lpac.analysis.voronoi import coverage_cost
from lpac.ground.station.client import command
from lpac.ground.station.protocol import (
    Enable,
    SafetyCommand,
    SetOrigin,
    Start,
    Takeoff,
)
from tests.command import called
from tests.conftest import ROOT
from tests.live import ORIGIN, FlownFleet
from tests.process.ground.conftest import PATIENCE_S, all_heard, wait_for_snapshot

S = FlightState
MAGIC = b"\x89MCAP0\r\n"  # at the end of a log that was closed


class Recorder:
    """`lpac record` as a process, and the lines that it prints."""

    def __init__(self, fleet_toml: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "lpac.cli.main", "record", "--fleet", str(fleet_toml)],
            cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )  # fmt: skip
        assert self.process.stdout is not None
        self._output = self.process.stdout

    def wait_for(self, text: str) -> None:
        watchdog = threading.Timer(PATIENCE_S, self.process.kill)
        watchdog.start()
        for line in self._output:
            if text in line:
                watchdog.cancel()
                return
        raise AssertionError(f"it ended, and never said {text!r}")

    def end(self) -> int:
        self.wait_for("recorded to")
        return self.process.wait(PATIENCE_S)


def ground_process(fleet_toml: Path) -> "subprocess.Popen[bytes]":
    return subprocess.Popen(
        [sys.executable, "-m", "lpac.cli.main", "ground", "--name", "ann", "--fleet",
        str(fleet_toml)],
        cwd=ROOT, stdout=subprocess.DEVNULL, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip


def wait_until_all_are_told(fleet: str, state: S) -> None:
    """Until all clients are told that every robot is so: a first picture is for one alone."""
    shown = itertools.count()
    wait_for_snapshot(
        fleet,
        lambda told: all(r.status and r.status.state is state for r in told.robots) and next(shown),
    )


def test_a_flight_is_recorded_also_when_the_ground_starts_again(
    tmp_path: Path, short_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(short_path))
    processes: list[subprocess.Popen[Any]] = []
    with FlownFleet(tmp_path, 2) as fleet:
        recorder = Recorder(fleet.fleet_toml)
        try:
            recorder.wait_for("waiting for it")
            processes.append(ground_process(fleet.fleet_toml))
            recorder.wait_for("connected to the ground station")
            wait_for_snapshot(fleet.name)
            for request, state in (
                (SetOrigin(ORIGIN), S.IDLE), (Enable(), S.PREFLIGHT),
                (Takeoff(interval_s=0.1), S.HOLD), (Start(), S.MISSION),
            ):  # fmt: skip
                assert command(fleet.name, request).done
                wait_until_all_are_told(fleet.name, state)
            recorder.wait_for("trial t1 begins with 2 robots")
            processes[0].kill()
            recorder.wait_for("has ended")
            processes.append(ground_process(fleet.fleet_toml))
            recorder.wait_for("connected to the ground station")
            wait_for_snapshot(fleet.name, lambda told: told.commander == "ann" and all_heard(told))
            # They sink for as long as the test has a use for it.
            for robot in fleet.flown:
                robot.sink_slowly()
            assert command(fleet.name, SafetyCommand("land")).done
            wait_until_all_are_told(fleet.name, S.LAND)
            # Its terminal is closed: it goes on until all have landed.
            recorder.process.send_signal(signal.SIGHUP)
            for robot in fleet.flown:
                robot.hurry()
            assert command(fleet.name, SafetyCommand("land", wait=True)).done
            assert recorder.end() == 0
        finally:
            processes += [recorder.process]
            for process in processes:
                with process:
                    process.kill()
    (path,) = (tmp_path / "logs").iterdir()
    assert path.name == "ground-0001.mcap"
    assert path.read_bytes().endswith(MAGIC)
    entries = list(read(path))
    by_topic: dict[str, list[dict[str, Any]]] = {}
    for topic, _, message in entries:
        by_topic.setdefault(topic, []).append(message)
    assert by_topic["setup"][0]["fleet"] == fleet.name and by_topic["setup"][0]["world"]
    said = [(s["name"], s["boot_nonce"], s["sequence"]) for s in by_topic["status"]]
    assert len(set(said)) == len(said)
    flown = {(s["name"], s["state"]) for s in by_topic["status"]}
    assert {
        (name, state) for name in ("r0", "r1") for state in ("hold", "mission", "land")
    } <= flown
    assert all(abs(s["clock_offset_s"]) < PATIENCE_S for s in by_topic["status"])
    commands = [e for e in by_topic["event"] if e["kind"] == "command"]
    assert {e["operator"] for e in commands} == {"ann"} and len(commands) >= 4
    assert any(s["safety_action"] == "land" for s in by_topic["state"])
    assert_costs_are_of_the_last_statuses(entries)
    with pytest.raises(FlightLogError, match="was not written by a robot"):
        read_metadata(path)


def assert_costs_are_of_the_last_statuses(entries: list[tuple[str, float, dict[str, Any]]]) -> None:
    setup = next(message for topic, _, message in entries if topic == "setup")
    raster = rasterize(
        parse_world(setup["world"]), setup["world_size"], setup["truncation"], setup["norm"]
    )
    last: dict[str, dict[str, Any]] = {}
    compared = 0
    for topic, _, message in entries:
        if topic == "status":
            last[message["name"]] = message
        elif topic == "cost":
            positions_m = np.array([last[name]["position_m"][:2] for name in message["robots"]])
            expected = coverage_cost(raster, positions_m * setup["env_scale"])
            assert message["cost"] == pytest.approx(expected)
            compared += message["flying_mission"]
    assert compared > 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_it_ends_in_order(tmp_path: Path, number: signal.Signals) -> None:
    recorder = Recorder(FlownFleet(tmp_path, 1).fleet_toml)  # which does not run
    with recorder.process:
        recorder.wait_for("waiting for it")
        recorder.process.send_signal(number)
        assert recorder.end() == 0
    (path,) = (tmp_path / "logs").iterdir()
    assert path.read_bytes().endswith(MAGIC)


@pytest.mark.parametrize(
    ("below", "why"),
    [
        ("", "already exists and is not a folder"),
        ("more/logs", "a part of this path is a file; a folder is needed"),
    ],
)
def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path, below: str, why: str) -> None:
    file = tmp_path / "file"
    file.write_text("")
    done = called("record", "--fleet", FlownFleet(tmp_path, 1).fleet_toml, "--out", file / below)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == f"lpac: {file / below}: cannot be created: {why}\n"
