"""The robot's unit under a real systemd, the one of a VOXL2: it starts, ends, hangs and crashes."""

import dataclasses
import json
import re
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import tomlkit

from edge.messages.mission import FlightState
from lpac.fleet.release import drop_ins
from lpac.fleet.settings import FleetConfig, load_fleet
from lpac.fleet.writer import robot_toml
from lpac.ground.station.protocol import Enable, SafetyCommand, SetOrigin, Takeoff
from lpac.sim.fleet.ground import GroundProgram
from lpac.sim.fleet.layout import ORIGIN
from lpac.sim.hosts.base import NoHostsError
from lpac.sim.px4.modes import Px4Mode
from tests.conftest import ROOT, SHIPPED
from tests.host.fleet.field import name_robot
from tests.host.hosts import FrailHost, FrailHosts

UNIT = ROOT / "systemd" / "lpac-robot.service"
LAND_UNIT = ROOT / "systemd" / "lpac-land.service"
UNITS = (UNIT, LAND_UNIT)


@pytest.fixture(scope="module")
def hosts(amd64_image: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[FrailHosts]:
    """One robot's computer, with a release and the unit, which does not run."""
    with ExitStack() as stack:
        try:
            running = stack.enter_context(
                FrailHosts(1, tmp_path_factory.mktemp("hosts"), image=amd64_image, bundle=SHIPPED)
            )
        except NoHostsError as reason:
            pytest.skip(str(reason))
        config = load_fleet(running.fleet_toml)
        (host,) = running
        release = host.root / config.directory.lstrip("/") / "releases/a"
        shutil.copytree(amd64_image / "root", release / "root", symlinks=True)
        shutil.copytree(SHIPPED, release / "bundle")
        shutil.copy(config.world, release / "world.env")
        (release / "robot.toml").write_text(robot_toml(config, host.name))
        (release.parents[1] / "current").symlink_to("releases/a")
        (release.parents[1] / "sandbox").mkdir()
        name_robot(running, host)
        for unit in UNITS:
            shutil.copy(unit, host.root / "etc/systemd/system")
        host.run("systemctl daemon-reload")
        yield running


@pytest.fixture
def config(hosts: FrailHosts) -> FleetConfig:
    return load_fleet(hosts.fleet_toml)


@pytest.fixture
def host(hosts: FrailHosts) -> FrailHost:
    return hosts[0]


def shown(host: FrailHost, *properties: str) -> dict[str, str]:
    """The unit's properties."""
    output = host.run(f"systemctl show lpac-robot -p {','.join(properties)}")
    return dict(line.split("=", 1) for line in output.splitlines())


def status(host: FrailHost) -> dict[str, Any]:
    """What the robot told systemd last; empty if nothing."""
    text = shown(host, "StatusText")["StatusText"]
    told: dict[str, Any] = json.loads(text or "{}")
    return told


def wait_until(condition: Callable[[], object], timeout_s: float = 180.0) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.05)


def journal(host: FrailHost, options: str = "") -> str:
    """What is in the unit's journal so far: it is written a moment later."""
    return host.run(f"journalctl --unit lpac-robot --output cat {options}")


def is_in_journal(host: FrailHost, text: str) -> bool:
    return text in journal(host)


def events(host: FrailHost) -> list[str]:
    """What the program has logged so far."""
    lines = journal(host, "--identifier lpac-robot").splitlines()
    return [json.loads(line)["event"] for line in lines if line.startswith("{")]


def processes(host: FrailHost, pid: str) -> list[str]:
    """The command lines of a process and of those that it started."""
    return host.run(f"ps -o args= --pid {pid} --ppid {pid} || true").splitlines()


def test_a_spare_has_nothing_to_start(host: FrailHost, config: FleetConfig) -> None:
    toml = host.root / config.directory.lstrip("/") / "current/robot.toml"
    text = toml.read_text()
    toml.unlink()
    host.run("systemctl start lpac-robot")
    assert shown(host, "ActiveState", "ConditionResult") == {
        "ActiveState": "inactive",
        "ConditionResult": "no",
    }
    toml.write_text(text)


def test_it_starts_says_how_it_is_and_ends(host: FrailHost) -> None:
    # It returns once each loop has ticked.
    host.run("systemctl start lpac-robot")
    wait_until(lambda: status(host))
    first = status(host)
    assert first["robot_id"] == 1 and first["link"]
    assert set(first["loops"]) == {"control", "perception", "policy"}
    wait_until(lambda: status(host)["loops"]["policy"]["ticks"] > 3 and status(host)["autopilot"])
    later = status(host)
    assert later["boot_nonce"] == first["boot_nonce"]
    assert later["monotonic_s"] > first["monotonic_s"]
    assert all(loop["failures"] == 0 for loop in later["loops"].values())

    pid = shown(host, "MainPID")["MainPID"]
    program, watchdog = processes(host, pid)
    assert "lpac robot run" in program and "px4.watchdog" in watchdog
    look_at_the_sandbox(host, pid)
    assert any((host.root / "var/lib/lpac/logs").glob("*.mcap"))
    wait_until(lambda: "robot runs" in events(host))
    assert not re.search(r"lpac-robot\.service:\d+: ", host.run("journalctl --boot"))

    host.run("systemctl stop lpac-robot")
    assert shown(host, "ActiveState", "Result", "ExecMainStatus", "NRestarts") == {
        "ActiveState": "inactive",
        "Result": "success",
        "ExecMainStatus": "0",
        "NRestarts": "0",
    }
    assert "px4.watchdog" not in host.run("ps -eo args=")


def look_at_the_sandbox(host: FrailHost, pid: str) -> None:
    """Not root, no capability, nothing to write to but its state and its own /tmp."""
    lines = (line.split(None, 1) for line in host.run(f"cat /proc/{pid}/status").splitlines())
    facts = {line[0]: line[1] for line in lines if len(line) == 2}
    assert "0" not in facts["Uid:"].split()
    assert set(facts["CapBnd:"]) == {"0"}
    assert facts["NoNewPrivs:"] == "1" and facts["Seccomp:"] == "2"
    writable = set()
    for line in host.run(f"cat /proc/{pid}/mountinfo").splitlines():
        mount, options = line.split()[4:6]
        if "ro" not in options.split(",") and not mount.startswith(("/proc", "/dev", "/sys")):
            writable.add(mount)
    assert "/var/lib/lpac" in writable
    # Newer systemd gives it an empty /run, of which nothing is its user's.
    assert writable <= {"/tmp", "/var/tmp", "/var/lib/lpac", "/var/lib/private/lpac", "/run"}


def test_a_program_that_hangs_in_flight_is_restarted_and_leaves_the_vehicle_in_hold(
    hosts: FrailHosts, host: FrailHost, config: FleetConfig
) -> None:
    with host.stepped:
        host.vehicle.parameters |= {"COM_SPOOLUP_TIME": 0.0, "MPC_TKO_RAMP_T": 0.0}
    host.run("systemctl start lpac-robot")
    with GroundProgram(hosts.fleet_toml, config.fleet) as ground:
        take_off(ground)
        hung = shown(host, "MainPID")["MainPID"]
        host.run(f"kill -STOP {hung}")
        with host.stepped:
            assert host.stepped.wait_for(lambda: host.vehicle.mode is Px4Mode.HOLD, 60.0)
        wait_until(lambda: shown(host, "NRestarts")["NRestarts"] == "1")
        wait_until(lambda: status(host).get("state") == "pilot")
        assert status(host)["armed"]
        with host.stepped:
            assert host.vehicle.armed and host.vehicle.mode is Px4Mode.HOLD
    wait_until(partial(is_in_journal, host, "Failed with result 'watchdog'"))
    host.run("systemctl stop lpac-robot")
    with host.stepped:
        assert host.vehicle.armed and host.vehicle.mode is Px4Mode.HOLD


def test_a_program_that_cannot_start_is_given_up_and_its_vehicle_landed(
    host: FrailHost, config: FleetConfig
) -> None:
    """In the air, in hold, as the test before left it."""
    toml = host.root / config.directory.lstrip("/") / "current/robot.toml"
    text = toml.read_text()
    with host.stepped:
        assert host.vehicle.armed and host.vehicle.mode is Px4Mode.HOLD
    changed = tomlkit.parse(text)
    changed["flight"]["hover_land_s"] = 1.0
    changed["fleet"] = 3
    toml.write_text(tomlkit.dumps(changed))
    # An old systemd has started it for the hang before, with the former configuration.
    host.run("systemctl stop lpac-land; systemctl reset-failed lpac-robot || true")
    host.run("systemctl start lpac-robot || true")
    wait_until(lambda: shown(host, "ActiveState")["ActiveState"] == "failed")
    with host.stepped:
        assert host.stepped.wait_for(lambda: not host.vehicle.armed, 120.0)
        modes = [truth.mode for truth in host.vehicle.truth]
    assert Px4Mode.LAND in modes
    said = "journalctl --unit lpac-land --output cat"
    wait_until(lambda: "nobody has taken the vehicle: land" in host.run(said))
    for line in ("Start request repeated too quickly", "lpac: /release/robot.toml: fleet = 3"):
        wait_until(partial(is_in_journal, host, line))
    traceback = journal(host).partition("Traceback")[2]
    assert not traceback, traceback
    toml.write_text(text)
    host.run("systemctl reset-failed lpac-robot")


def take_off(ground: GroundProgram) -> None:
    """When it is ready; also for another time if it was held up."""
    for request in (SetOrigin(ORIGIN), Enable()):
        assert ground.subscriber.wait_for(lambda told: told.robots[0].fresh, 180.0)
        assert ground.command(request).problem is None
    until_s = time.monotonic() + 180.0
    while not (report := ground.command(Takeoff())).done:
        assert report.problem is None and time.monotonic() < until_s, report
        status = ground.subscriber.snapshot.robots[0].status
        if status is not None and status.state is FlightState.HOLD:
            ground.command(SafetyCommand("land", wait=True))


def test_it_lives_where_the_drop_in_says(host: FrailHost, config: FleetConfig) -> None:
    elsewhere = dataclasses.replace(config, directory="/data/lpac")
    for name, text in drop_ins(elsewhere, config.robots[host.name]).items():
        path = host.root / f"etc/systemd/system/{Path(name).stem}.service.d" / name
        path.parent.mkdir()
        path.write_text(text)
    host.run(f"mv {config.directory} {elsewhere.directory} && systemctl daemon-reload")
    host.run("systemctl start lpac-robot")
    wait_until(lambda: status(host).get("robot_id") == 1)
    logs = host.root / "var/lib/lpac/logs"
    count = len(list(logs.glob("*.mcap")))
    host.run("systemctl restart lpac-robot")
    assert len(list(logs.glob("*.mcap"))) == count + 1
    host.run("systemctl stop lpac-robot")


def test_nothing_was_added_to_the_release(host: FrailHost, amd64_image: Path) -> None:
    def names(tree: Path) -> set[Path]:
        return {path.relative_to(tree) for path in tree.rglob("*")}

    release = host.root / "data/lpac/releases/a"  # where the test before has moved it
    assert names(release / "root") == names(amd64_image / "root")
