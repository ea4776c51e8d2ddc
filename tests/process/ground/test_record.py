"""The ground's log: each thing once, and from the real ground process, which may start again."""

import dataclasses
import itertools
import math
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.core.coverage import coverage_cost
from edge.core.fence import Fence
from edge.core.world import parse_world, rasterize
from edge.drivers.flight_log import FlightLogError, read, read_metadata
from edge.messages.mission import FlightState, GroundState, Origin, Place
from lpac.analysis.snapshot import Explored, FleetSetup, FleetSnapshot, GroundEvent, RobotSnapshot
from lpac.ground.record import Recording
from lpac.ground.station.client import command
from lpac.ground.station.protocol import (
    Enable,
    SafetyCommand,
    ServerMessage,
    SetOrigin,
    Start,
    Takeoff,
)
from tests.conftest import ROOT
from tests.pretend import ORIGIN, pretended
from tests.process.ground.conftest import PATIENCE_S, all_heard, wait_for_snapshot
from tests.unit.analysis.test_coverage import STATUS, model

S = FlightState
MAGIC = b"\x89MCAP0\r\n"  # at the end of a log that was closed
FENCE = Fence(((-1.0, -1.0), (33.0, -1.0), (33.0, 33.0), (-1.0, 33.0)), 0.5, 1.0, 20.0)
WORLD = model()
SETUP = FleetSetup(
    fleet="f", operator="ann", robots={"r0": 0, "r1": 1}, slots=(), fence=FENCE,
    world=WORLD.world, world_id=WORLD.world_id, bundle_id="b", world_size=WORLD.world_size,
    sensor_size=16, communication_range=64.0, env_scale=WORLD.env_scale,
    truncation=WORLD.truncation, norm=WORLD.norm,
)  # fmt: skip
STATE = GroundState(3, "ann", Origin(47.0, 8.0, 0.0), places={"0": Place(0, (1.0, 2.0))})


class Kept:
    """What a `Recording` records."""

    def __init__(self) -> None:
        self.entries: list[tuple[str, float, Mapping[str, Any]]] = []
        self.recording = Recording(lambda *entry: self.entries.append(entry))

    def of(self, topic: str) -> list[Mapping[str, Any]]:
        return [message for name, _, message in self.entries if name == topic]


def snapshot(
    now_s: float, sequence: int, x_m: float, state: S = S.MISSION, **more: Any
) -> FleetSnapshot:
    """Two robots, of which the second was heard 0.1 s ago."""
    statuses = (
        dataclasses.replace(
            STATUS, robot_id=i, sequence=sequence, state=state, armed=state is not S.LANDED,
            trial="t1", position_m=(x_m, 5.0 + 20.0 * i, 4.0),
        )
        for i in range(2)
    )  # fmt: skip
    robots = tuple(
        RobotSnapshot(f"r{i}", i, status, 0.1 * i, 0.5) for i, status in enumerate(statuses)
    )
    return FleetSnapshot(now_s, "ann", STATE, robots, **more)


def test_each_thing_is_recorded_once() -> None:
    kept = Kept()
    event = GroundEvent(99.0, "command", "", "takeoff", "ann", "t1")
    told: list[tuple[float, ServerMessage]] = [
        (100.0, SETUP), (100.0, event), (100.0, Explored("r0", "AAAA")),
        (100.2, snapshot(100.2, 1, 1.0)), (100.4, snapshot(100.4, 1, 1.0)),
        # The same again from the ground's next process, and something new.
        (105.0, event), (105.0, Explored("r0", "AAAA")), (105.0, Explored("r0", "AAAB")),
        (105.2, snapshot(105.2, 2, 2.0)),
        (166.0, snapshot(166.0, 3, 3.0)),
    ]  # fmt: skip
    for now_s, message in told:
        kept.recording.take(message, now_s)
    kept.recording.close()
    assert kept.of("event") == [dataclasses.asdict(event)]
    assert [e["cells"] for e in kept.of("explored")] == ["AAAA", "AAAB"]
    assert [s["sequence"] for s in kept.of("state")] == [3]
    said = [(s["name"], s["sequence"]) for s in kept.of("status")]
    assert said == [("r0", 1), ("r1", 1), ("r0", 2), ("r1", 2), ("r0", 3), ("r1", 3)]
    # When they were heard, by the ground's clock.
    heard = [(at_s, m["heard_at_unix_s"]) for topic, at_s, m in kept.entries if topic == "status"]
    assert heard[:2] == [(100.2, 100.2), (pytest.approx(100.1), pytest.approx(100.1))]
    assert {s["clock_offset_s"] for s in kept.of("status")} == {0.5}
    assert len(kept.of("setup")) == 2  # the second after a minute
    # No cost for the second picture, which came too soon after the first.
    assert [at_s for topic, at_s, _ in kept.entries if topic == "cost"] == [100.2, 105.2, 166.0]


def test_the_cost_is_normalised_by_each_trials_begin() -> None:
    kept = Kept()
    kept.recording.take(SETUP, 0.0)
    kept.recording.take(snapshot(1.0, 1, 1.0, S.HOLD), 1.0)
    kept.recording.take(snapshot(2.0, 2, 5.0), 2.0)
    kept.recording.take(snapshot(3.0, 3, 9.0), 3.0)
    kept.recording.close()
    raster = rasterize(parse_world(WORLD.world), WORLD.world_size, 2.0, 1.0)
    expected = [
        coverage_cost(raster, np.array([(x_m, 5.0), (x_m, 25.0)]) * WORLD.env_scale)
        for x_m in (1.0, 5.0, 9.0)
    ]
    costs = kept.of("cost")
    assert [cost["cost"] for cost in costs] == expected
    assert [cost["initial"] for cost in costs] == [None, expected[1], expected[1]]
    assert costs[2]["normalized"] == expected[2] / expected[1]
    assert [cost["flying_mission"] for cost in costs] == [False, True, True]
    assert {(cost["trial"], cost["robots"]) for cost in costs} == {("t1", ("r0", "r1"))}


def test_a_name_that_is_flown_again_begins_anew() -> None:
    kept = Kept()
    kept.recording.take(SETUP, 0.0)
    flown = ((S.MISSION, 1.0), (S.HOLD, 5.0), (S.MISSION, 6.0), (S.LANDED, 7.0), (S.HOLD, 7.0))
    for second, (state, x_m) in enumerate((*flown, (S.MISSION, 9.0)), 1):
        kept.recording.take(snapshot(float(second), second, x_m, state), float(second))
    kept.recording.close()
    costs = kept.of("cost")
    first = costs[0]["cost"]
    # A pause is no new mission; after landing there is a new one.
    assert [cost["initial"] for cost in costs] == [*[first] * 5, costs[5]["cost"]]
    assert costs[5]["normalized"] == 1.0 != costs[4]["normalized"]


@pytest.mark.parametrize("world", ["", "Circle 1 2"])
def test_without_a_world_all_else_is_recorded(world: str) -> None:
    kept = Kept()
    kept.recording.take(dataclasses.replace(SETUP, world=world), 0.0)
    kept.recording.take(snapshot(1.0, 1, 1.0), 1.0)
    kept.recording.close()
    assert [topic for topic, _, _ in kept.entries] == ["setup", "state", "status", "status"]


class Recorder:
    """`lpac record` as a process, and the lines that it prints."""

    def __init__(self, fleet_toml: Path) -> None:
        # As from a terminal, also if these tests have none to lose.
        before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "lpac.cli.main", "record", "--fleet", str(fleet_toml)],
            cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )  # fmt: skip
        signal.signal(signal.SIGHUP, before)
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
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    processes: list[subprocess.Popen[Any]] = []
    with pretended(tmp_path, 2) as fleet:
        recorder = Recorder(fleet.fleet_toml)
        try:
            recorder.wait_for("waiting for it")
            processes.append(ground_process(fleet.fleet_toml))
            recorder.wait_for("hears the ground station")
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
            recorder.wait_for("hears the ground station")
            wait_for_snapshot(fleet.name, lambda told: told.commander == "ann" and all_heard(told))
            # They sink for as long as the test has a use for it.
            for robot in fleet.robots:
                robot.takeoff_s = math.inf
            assert command(fleet.name, SafetyCommand("land")).done
            wait_until_all_are_told(fleet.name, S.LAND)
            # Its terminal is closed: it goes on until all have landed.
            recorder.process.send_signal(signal.SIGHUP)
            for robot in fleet.robots:
                robot.takeoff_s = 1.0
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
    with pretended(tmp_path, 1) as fleet:
        recorder = Recorder(fleet.fleet_toml)
        with recorder.process:
            recorder.wait_for("waiting for it")
            recorder.process.send_signal(number)
            assert recorder.end() == 0
    (path,) = (tmp_path / "logs").iterdir()
    assert path.read_bytes().endswith(MAGIC)


@pytest.mark.parametrize(("below", "why"), [("", "File exists"), ("more/logs", "Not a directory")])
def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path, below: str, why: str) -> None:
    file = tmp_path / "file"
    file.write_text("")
    with pretended(tmp_path, 1) as fleet:
        done = subprocess.run(
            [
                sys.executable, "-m", "lpac.cli.main", "record", "--fleet", str(fleet.fleet_toml),
                "--out", str(file / below),
            ],
            cwd=ROOT, capture_output=True, text=True, check=False,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )  # fmt: skip
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == f"lpac: {file / below}: cannot be made: {why}\n"
