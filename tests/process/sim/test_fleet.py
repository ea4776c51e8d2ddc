"""A fleet of real robot programs on simulated vehicles, from takeoff to landing."""

import contextlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import pytest

from edge.drivers.log_reader import read, read_metadata
from edge.messages.mission import FlightState
from edge.robot.config import load_config
from lpac.fleet.settings import load_fleet
from lpac.ground.station.config import load_ground
from lpac.sim.description import ERRORS
from lpac.sim.engines import engine_of
from lpac.sim.failure import Failure
from lpac.sim.fleet.listener import FleetListener
from lpac.sim.fleet.processes import Fleet, SimulatedFleetError
from lpac.sim.scenario import Scenario
from lpac.study.perturbation import absences_of
from tests.command import error_line, lpac
from tests.conftest import ROOT, SHIPPED
from tests.flown import PRECISE

ROBOTS = 3

OUTWARDS = (
    FlightState.PREFLIGHT, FlightState.ARMING, FlightState.TAKEOFF, FlightState.HOLD,
    FlightState.MISSION,
)  # fmt: skip


class Flight(NamedTuple):
    """As it told of itself, and its folder."""

    told: dict[str, Any]
    out: Path


@contextmanager
def launched(*arguments: object, vehicle: str = "mavlink") -> Iterator[subprocess.Popen[str]]:
    """`lpac sim --vehicle ...` in the background."""
    process = subprocess.Popen(
        [sys.executable, "-m", "lpac.cli.main", "sim", "--vehicle", vehicle, *map(str, arguments)],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "1000", "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    with process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
                process.wait(180.0)


def read_until(stream: IO[str] | None, pattern: str) -> re.Match[str]:
    assert stream is not None
    lines = []
    for line in stream:
        lines.append(line)
        match = re.search(pattern, line)
        if match:
            return match
    raise AssertionError(f"{pattern!r} is not among {lines}")


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """Flown until Ctrl-C; other fleets of this folder fly to the end of their missions."""
    out = tmp_path_factory.mktemp("fleet")
    # Other missions of this folder are flown in a mesh.
    with launched(
        "-n", ROBOTS, "--json", "--out", out, "--secure", "--transport", "multicast",
    ) as process:  # fmt: skip
        read_until(process.stderr, f" s  mission; robots: {ROBOTS} mission$")
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=180.0)
    assert output, errors
    assert process.returncode == 1
    return Flight(json.loads(output), out)


@pytest.mark.real_time
def test_all_robots_take_off_and_cover_and_ctrl_c_lands_them(flight: Flight) -> None:
    told, _ = flight
    assert told["problem"] == "stopped by Ctrl-C" and told["all_landed"], told
    for robot in told["fleet"]:
        states = [change["state"] for change in robot["timeline"]]
        positions = [states.index(state) for state in OUTWARDS if state in states]
        assert positions == sorted(positions)
        assert FlightState.LAND in states[positions[-1] :]
        assert {FlightState.TAKEOFF, FlightState.MISSION} <= {*states}
        # A machine that is too busy for a moment makes a robot hold; some 3 s later it goes on.
        assert robot["mission_share"] > 0.5 or robot["restarts"] > 2
        assert robot["messages"]["accepted"] > 0


@pytest.mark.real_time
def test_robots_never_touch_in_truth(flight: Flight) -> None:
    assert flight.told["separation"]["distance_m"] > ERRORS.drone_m


@pytest.mark.real_time
def test_the_fence_is_never_crossed_by_the_estimate(flight: Flight) -> None:
    fence = flight.told["fence"]
    assert not fence["crossed"] and fence["margin_m"] > 0.0


@pytest.mark.real_time
def test_what_a_flight_leaves_behind(flight: Flight) -> None:
    told, out = flight
    assert json.loads((out / "flight.json").read_text()) == told
    assert (out / "flight.png").stat().st_size > 0 and (out / "flight.pdf").exists()
    for robot_id, robot in enumerate(told["fleet"]):
        assert load_config(out / "robots" / str(robot_id) / "robot.toml").robot_id == robot_id
        assert robot["logs"]
        for log in robot["logs"]:
            assert read_metadata(out / log).robot_id == robot_id
        assert 0.0 < robot["cpu_share"] < 1.0 and robot["peak_memory_mb"] > 0.0
        assert set(robot["loops"]) == {"perception", "policy", "control"}
        assert all(loop["failures"] == 0 for loop in robot["loops"].values())


@pytest.mark.real_time
def test_its_logs_say_the_same(flight: Flight) -> None:
    """`lpac replay` decides what was decided, and `lpac report` has the flight's figures."""
    told, out = flight
    replayed = lpac("replay", out / "robots", "--json")
    assert replayed.returncode == 0, replayed.stderr
    flights = json.loads(replayed.stdout)["flights"]
    assert len(flights) >= ROBOTS
    assert all(each["ticks"] and not each["differing"] for each in flights)
    (trial,) = json.loads(lpac("report", out, "--json").stdout)["trials"]
    for reported, flown in ((trial["cost"], "cost"), (trial["truth"]["cost"], "true_cost")):
        assert [reported[key] for key in ("initial", "final", "normalized")] == [
            told[flown][key] for key in ("initial", "final", "final_normalized")
        ]
    assert trial["fence_margin_m"] == told["fence"]["margin_m"] is not None
    assert trial["truth"]["separation"]["distance_m"] == told["separation"]["distance_m"]


@pytest.mark.real_time
def test_a_killed_robot_program_falls_silent_and_can_be_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lpac.sim.fleet.processes.STOP_WITHIN_S", 60.0)
    with Fleet(Scenario(robots=2), tmp_path, SHIPPED) as fleet:
        assert fleet.listener.wait_for(lambda statuses: len(statuses) == 2, 60.0)
        before = fleet.listener.statuses()[1].boot_nonce
        fleet.robots[1].send_signal(signal.SIGKILL)
        assert fleet.robots[1].wait(60.0) == -signal.SIGKILL
        assert fleet.listener.wait_for(lambda statuses: set(statuses) == {0}, 60.0)
        with pytest.raises(SimulatedFleetError, match="the program of r1 has ended"):
            fleet.require_running()
        fleet.robots[1].start()
        assert fleet.listener.wait_for(
            lambda statuses: 1 in statuses and statuses[1].boot_nonce != before, 60.0
        )
        # A stopped process is woken up to end.
        fleet.robots[0].send_signal(signal.SIGSTOP)
    assert [robot.wait(0.0) for robot in fleet.robots] == [0, 0]


@pytest.mark.real_time
def test_a_fleet_in_multicast_is_heard_by_each_ground_and_by_itself(tmp_path: Path) -> None:
    scenario = Scenario(robots=2, secure=True, transport="multicast")
    with Fleet(scenario, tmp_path, SHIPPED) as fleet:
        config = load_ground(fleet.fleet_toml, None)
        assert config.connect == fleet.endpoints
        for robot, endpoint in zip(fleet.robots, fleet.endpoints, strict=True):
            link = load_config(robot.folder / "robot.toml").link
            assert (link.listen, link.connect, link.interface) == ((endpoint,), (), "127.0.0.1")
        assert fleet.listener.wait_for(lambda statuses: set(statuses) == {0, 1}, 60.0)
        keys = load_fleet(fleet.fleet_toml).keys
        with FleetListener(fleet=fleet.name, connect=config.connect, identity=keys) as second:
            assert second.wait_for(lambda statuses: set(statuses) == {0, 1}, 60.0)
        fleet.listener.__exit__(None, None, None)
        gone_unix_s = time.time()
        assert fleet.listener.wait_for(lambda statuses: not statuses, 60.0)
    for robot in fleet.robots:
        (log,) = robot.logs()
        assert any(at_s > gone_unix_s for _, at_s, _ in read(log, "received"))


@pytest.mark.real_time
def test_a_pilot_takes_a_robot_out_of_the_fence_and_back(tmp_path: Path) -> None:
    """As tests/sim/sim/test_pilot.py has it on the simulated clock."""
    taken = Failure(robot=0, from_s=1.0, until_s=19.0)
    scenario = Scenario(
        robots=2, seed=3, duration_s=22.0, secure=True, transport="multicast", budget=PRECISE,
        failures=(taken,),
    )  # fmt: skip
    [record] = engine_of("mavlink").fly([scenario], SHIPPED, tmp_path)
    [absence] = absences_of(record)
    assert absence.robot == "r0"
    assert np.allclose((absence.from_s, absence.until_s), (taken.from_s, taken.until_s), atol=3.0)
    truth, fence = record.truth["r0"], record.fence
    assert fence is not None
    away = (truth.time_s > absence.from_s) & (truth.time_s < absence.until_s)
    inside_m = [fence.distance_m(x, y) for x, y, _ in truth.position_m[away][::25].tolist()]
    assert min(inside_m) < -1.0 and inside_m[-1] > 0.0


@pytest.mark.real_time
def test_without_the_script_it_waits_for_a_ground(tmp_path: Path) -> None:
    """What it says to type next is right; it outlives a robot's program, and ends by Ctrl-C."""
    out = tmp_path / "a fleet"
    with launched("-n", 2, "--no-script", "--out", out) as process:
        (setting,) = read_until(process.stdout, r"^  export (\S.*)$").groups()
        read_until(process.stdout, "^  lpac ground$")
        (setting,) = shlex.split(setting)
        assert setting == f"LPAC_FLEET={out / 'fleet.toml'}"
        config = load_fleet(out / "fleet.toml")
        endpoints = [f"tcp/{r.address}:{r.zenoh_port}" for r in config.robots.values()]
        with FleetListener(fleet=config.fleet, connect=endpoints) as heard:
            assert heard.wait_for(lambda statuses: set(statuses) == {0, 1}, 60.0)
            # It only listens: nobody commands.
            assert {heard.history(robot)[-1].status.operator for robot in (0, 1)} == {""}
            assert len(list((out / "robots" / "1" / "logs").glob("*.mcap"))) == 1
            os.kill(pid_of(str(out / "robots" / "1" / "robot.toml")), signal.SIGKILL)
            read_until(process.stderr, r"the program of r1 has ended, by SIGKILL$")
            assert heard.wait_for(lambda statuses: set(statuses) == {0}, 60.0)
            process.send_signal(signal.SIGINT)
            assert process.wait(60.0) == 0
            assert heard.wait_for(lambda statuses: not statuses, 60.0)


def pid_of(arguments: str) -> int:
    """The process that has these arguments, with a NUL between each two."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):  # It may end meanwhile.
            found += [int(path.parent.name)] if arguments.encode() in path.read_bytes() else []
    (pid,) = found
    return pid


@pytest.mark.parametrize("robots", [1, 16])
def test_the_fleet_is_described_as_its_robots_are(tmp_path: Path, robots: int) -> None:
    """The ground reads fleet.toml, the robots their robot.toml."""
    fleet = Fleet(Scenario(robots=robots, seed=robots), tmp_path, SHIPPED)
    config = load_fleet(fleet.fleet_toml)
    assert config.bundle == SHIPPED and config.world == tmp_path / "world.env"
    assert list(config.robots) == [f"r{i}" for i in range(robots)]
    assert len({robot.host for robot in config.robots.values()}) == robots
    for i, (name, slot) in enumerate(zip(config.robots, config.slots, strict=True)):
        folder = fleet.robots[i].folder
        robot = load_config(folder / "robot.toml")
        its = config.robot_config(name)
        # Where a robot keeps its files is its own matter, and which of its addresses are open.
        assert (robot.policy.bundle, Path(robot.policy.world).resolve()) == (
            str(SHIPPED), tmp_path / "world.env",
        )  # fmt: skip
        assert (robot.log.folder, robot.link.listen) == (
            str(folder / "logs"), (fleet.endpoints[i],),
        )  # fmt: skip
        assert robot.link.connect == its.link.connect == fleet.endpoints[:i]
        policy = replace(robot.policy, bundle=its.policy.bundle, world=its.policy.world)
        assert its == replace(robot, policy=policy, log=its.log, link=its.link)
        assert slot.robot == name and slot.height == i
        np.testing.assert_allclose(slot.pad_m, fleet.layout.landing_points_m[i], atol=1e-3)
        assert slot.landing_point_m == slot.pad_m


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["-n", "0"], "--robots 0: must be at least 1"),
        (["-n", "31"], "robots = 31: must be from 1 to 30"),
        (["--duration", "0"], "--duration = 0.0: must be above 0 and at most 86400"),
        (["--loss", "0.1"], "--loss does nothing with --vehicle mavlink"),
        (["--wifi", "wifi.toml"], "--wifi does nothing without --transport"),
        (["--controller", "shared-cvt"], "--controller does nothing with --vehicle mavlink"),
        (["--px4", "docs"], "--px4 does nothing with --vehicle mavlink"),
        (["--bundle", "absent"], "absent: there is no such file or folder"),
    ],
)
def test_a_mistake_is_one_line(arguments: list[str], text: str) -> None:
    assert text in error_line(lpac("sim", "--vehicle", "mavlink", *arguments))
