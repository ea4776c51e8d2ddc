"""What keeps robots from flying is found and named with its fix: on real robot computers, and from
facts that those here cannot have."""

import asyncio
import contextlib
import copy
import dataclasses
import hashlib
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from edge.core.vehicle import Gps
from edge.flight.margins import ErrorBudget
from lpac.fleet.config import FleetConfig, RobotHost, SshConfig, load_fleet
from lpac.fleet.deploy import deploy
from lpac.fleet.doctor import (
    ClockOffset,
    Diagnosis,
    DoctorCheck,
    Examination,
    diagnose,
    examine,
    is_configured,
    judge,
    on,
)
from lpac.fleet.laptop import iptables_blocks, nft_blocks, rsync_version
from lpac.fleet.operations import Outcome, for_each
from lpac.fleet.release import load_common, make_release
from lpac.fleet.up import bring_up, decide, packs
from lpac.sim.hosts.host import SimulatedHost
from lpac.sim.hosts.hosts import SimulatedHosts
from tests.conftest import ROOT
from tests.host.fleet.field import SILENT, armed, lpac_fleet, name_robot, unwatched
from tests.unit.flight.test_preflight import lines

# On robot computers


@pytest.fixture(scope="module")
def enrolled(hosts: SimulatedHosts) -> SimulatedHosts:
    """With their identity; r1, r2 and r3 with new disks, and nothing else is done to them."""
    for host in hosts[:3]:
        host.reset()
    for host in hosts:
        name_robot(hosts, host)
    return hosts


@contextlib.contextmanager
def deaf(one: SimulatedHost, other: SimulatedHost) -> Iterator[None]:
    """Nothing passes from one to the other, though both have the network."""
    script = 'ip -n "$1" route "$2" blackhole "$3"/32'
    one._rack.sh(script, one.name, "add", other.address)
    try:
        yield
    finally:
        one._rack.sh(script, one.name, "delete", other.address)


def run_doctor(
    hosts: SimulatedHosts, robots: str = "r1,r2,r3", **clock: Any
) -> dict[str, dict[str, DoctorCheck]]:
    config = load_fleet(hosts.fleet_toml)
    chosen = [config.robots[name] for name in robots.split(",")]

    async def one(robot: RobotHost) -> Examination:
        others = [other for other in chosen if other is not robot]
        return await examine(config, robot, others, unwatched, **clock)

    outcomes: list[Outcome[Examination]] = asyncio.run(for_each(chosen, one))
    return {
        diagnosis.robot: {check.name: check for check in diagnosis.checks}
        for diagnosis in diagnose(config, outcomes)
    }


def test_a_stock_robot_is_told_what_it_lacks(enrolled: SimulatedHosts) -> None:
    for checks in run_doctor(enrolled).values():
        verdicts = {check.name: check.verdict for check in checks.values()}
        assert {name for name, verdict in verdicts.items() if verdict == "FAILED"} == {
            "release",
            "vision-hub",
        }
        assert 'offboard_mode is "figure_eight"' in checks["vision-hub"].found
        assert checks["vision-hub"].fix.startswith("lpac fleet enroll r")
        assert checks["release"].fix.startswith("lpac fleet deploy --robots r")
        for name in ("enrolled", "system", "clock", "mavlink", "commanders"):
            assert verdicts[name] == "ok", checks[name]


def test_each_robot_has_its_own_faults_alone(enrolled: SimulatedHosts) -> None:
    """A full disk, no radio link between two, and one that is off."""
    r1, r2, r3, r4 = enrolled
    r1.fill_disk()
    r4.cut()
    try:
        with deaf(r2, r3):
            found = run_doctor(enrolled, "r1,r2,r3,r4")
    finally:
        r1.free_disk()
        r4.heal()
    assert found["r1"]["disk"].verdict == "FAILED"
    assert found["r2"]["disk"].verdict != "FAILED"
    assert found["r1"]["radio"].verdict != "FAILED"
    assert found["r2"]["radio"].verdict == "FAILED"
    assert found["r2"]["radio"].found == "no answer from r3"
    (reach,) = found["r4"].values()
    assert (reach.name, reach.verdict, reach.found) == ("reach", "FAILED", SILENT)


def test_another_clock_another_vehicle_and_one_that_is_silent(enrolled: SimulatedHosts) -> None:
    text = enrolled.fleet_toml.read_text()
    changed = text.replace("robot_id = 1\n", "robot_id = 1\nsystem_id = 99\n")
    changed = changed.replace(
        "robot_id = 2\n", 'robot_id = 2\nmavlink_url = "udpin://127.0.0.1:14999"\n'
    )
    enrolled.fleet_toml.write_text(changed)
    try:
        # The robots' clock is this machine's: it is the laptop's that is wrong.
        found = run_doctor(enrolled, "r1,r2", unix_time_s=lambda: time.time() - 3600.0)
    finally:
        enrolled.fleet_toml.write_text(text)
    assert found["r1"]["clock"].verdict == "FAILED"
    assert "system id 1, configured is 99" in found["r1"]["mavlink"].found
    assert "no heartbeat of PX4 at UDP port 14999" in found["r2"]["mavlink"].found
    assert "14551, configured is 14999" in found["r2"]["vision-hub"].found


def test_doctor_prints_a_board_and_fails(enrolled: SimulatedHosts) -> None:
    asked = (enrolled.fleet_toml, "doctor", "--robots", "r1,r3")
    shown = lpac_fleet(*asked)
    assert shown.returncode == 1
    assert shown.stderr.splitlines()[-1] == "lpac: 4 checks failed, on r1, r3"
    assert "vision-hub FAILED FAILED" in " ".join(shown.stdout.split())
    assert "→ lpac fleet deploy --robots r1" in shown.stdout
    robots = json.loads(lpac_fleet(*asked, "--json").stdout)["robots"]
    assert list(robots) == ["r1", "r3"]
    assert not robots["r1"]["ok"]
    (hub,) = [check for check in robots["r1"]["checks"] if check["name"] == "vision-hub"]
    assert hub["verdict"] == "FAILED"
    assert hub["fix"].startswith("lpac fleet enroll r1")


def test_ping_has_every_way(enrolled: SimulatedHosts) -> None:
    shown = lpac_fleet(enrolled.fleet_toml, "ping", "--json")
    assert shown.returncode == 0, shown.stderr
    robots = json.loads(shown.stdout)["robots"]
    for name, found in robots.items():
        assert found["laptop_ms"] > 0.0
        assert set(found["others"]) == set(robots) - {name}
        assert all(way["loss"] < 1.0 for way in found["others"].values())
    with deaf(enrolled[0], enrolled[2]):
        shown = lpac_fleet(enrolled.fleet_toml, "ping")
    assert shown.returncode == 1
    assert shown.stderr.splitlines()[-1] == "lpac: no answer: r1 → r3, r3 → r1"
    assert "lost" in shown.stdout


def test_up_says_no_go_with_the_reasons(enrolled: SimulatedHosts) -> None:
    enrolled[2].cut()
    try:
        shown = lpac_fleet(enrolled.fleet_toml, "up", "--timeout", "3", "--json")
    finally:
        enrolled[2].heal()
    assert shown.returncode == 1
    assert shown.stderr.splitlines()[-1] == "lpac: NO-GO: r1, r2, r3"
    robots = json.loads(shown.stdout)["robots"]
    # The spare is not waited for.
    assert list(robots) == ["r1", "r2", "r3"]
    assert "release: there is none" in robots["r1"]["reasons"]
    assert robots["r3"]["reasons"] == [f"up: {SILENT}"]


def test_up_waits_for_a_robot_that_is_just_switched_on(enrolled: SimulatedHosts) -> None:
    config = load_fleet(enrolled.fleet_toml)
    robot = config.robots["r1"]
    waits: list[str] = []

    def report(step: str, _: float | None) -> None:
        if step.startswith("waits"):
            waits.append(step)
            enrolled[0].heal()

    enrolled[0].cut()
    arrival = asyncio.run(bring_up(config, robot, time.monotonic() + 60.0, report))
    assert waits
    assert arrival == ((), ())


def test_a_clock_that_cannot_be_set_is_no_go(enrolled: SimulatedHosts) -> None:
    """A container may not set the clock of the machine that it runs on."""
    config = load_fleet(enrolled.fleet_toml)
    arrival = asyncio.run(
        bring_up(
            config, config.robots["r1"], time.monotonic(), unwatched, lambda: time.time() + 100.0
        )
    )
    assert len(arrival.problems) == 1
    assert arrival.problems[0].startswith("its clock cannot be set")


def test_up_starts_what_was_switched_off_and_says_go(
    enrolled: SimulatedHosts, tmp_path: Path
) -> None:
    host = enrolled[0]
    config = load_fleet(enrolled.fleet_toml)
    robot = config.robots[host.name]
    release = make_release(config, robot, load_common(config), tmp_path)
    asyncio.run(deploy(config, robot, release, unwatched))
    hub = host.root / "etc/modalai/voxl-vision-hub.conf"
    hub.write_text(hub.read_text().replace("figure_eight", "off"))

    # The program is stopped, but meant to run: as after a start that failed.
    host.run("systemctl stop lpac-robot")
    checks = run_doctor(enrolled, host.name)[host.name]
    assert checks["program"].found == "it is inactive (success)"
    # Its release has looked at PX4's parameters, and set them.
    assert checks["failsafe"].verdict == checks["preflight"].verdict == "ok"

    shown = lpac_fleet(enrolled.fleet_toml, "up", "--robots", host.name, "--json")
    found = json.loads(shown.stdout)["robots"][host.name]
    assert shown.returncode == 0, found["reasons"]
    assert found["go"]
    assert found["checks"][0]["found"] == "its program was started"

    # What is changed and not deployed is seen.
    text = enrolled.fleet_toml.read_text()
    for fleet_toml, as_deployed in ((re.sub("ceiling_m = .*", "ceiling_m = 20", text), False),
                                    (text, True)):  # fmt: skip
        enrolled.fleet_toml.write_text(fleet_toml)
        shown = lpac_fleet(enrolled.fleet_toml, "status", "--robots", host.name, "--json")
        assert json.loads(shown.stdout)["robots"][host.name]["is_configured"] is as_deployed
        checks = run_doctor(enrolled, host.name)[host.name]
        assert (checks["release"].verdict == "ok") is as_deployed

    # One that was stopped on purpose stays so.
    host.run("systemctl disable --now lpac-robot")
    assert asyncio.run(bring_up(config, robot, time.monotonic(), unwatched)) == ((), ())
    assert host.run("systemctl is-active lpac-robot || true") == "inactive\n"


def test_no_clock_is_set_under_an_armed_vehicle(enrolled: SimulatedHosts) -> None:
    config = load_fleet(enrolled.fleet_toml)
    with armed(enrolled[1]):
        arrival = asyncio.run(
            bring_up(
                config, config.robots["r2"], time.monotonic(), unwatched,
                lambda: time.time() + 100.0,
            )
        )  # fmt: skip
    assert arrival.problems == (
        "the vehicle is armed: setting the clock is refused until it is disarmed",
    )


# From facts


@pytest.fixture
def config(tmp_path: Path) -> FleetConfig:
    """The example's three robots and a spare."""
    text = (ROOT / "docs" / "fleet.toml").read_text()
    path = tmp_path / "fleet.toml"
    path.write_text(text.replace("# predecessors = []", 'predecessors = ["old_ros"]'))
    return load_fleet(path)


PING = {"loss": 0.0, "mean_ms": 3.0, "max_ms": 9.0}


def well(config: FleetConfig, name: str) -> Examination:
    """A robot that may fly."""
    robot = config.robots[name]
    status = {
        "state": "idle", "autopilot": True, "system_id": robot.system_id, "peers": 2,
        "failed_checks": [
            "ground was not heard: start `lpac ground`, check the radio and the fleet's name",
            "mission origin is not set: set it on the ground",
            "place in the fence is not known: it needs the position and the mission origin",
            "autopilot does not have the fence: wait for the upload, or check the link",
        ],
    }  # fmt: skip
    runs = {"there": True, "active": True, "enabled": True}
    idle = {"there": False, "active": False, "enabled": False}
    facts = {
        "identity": {"fleet": config.fleet, "robot": name, "robot_id": robot.robot_id},
        "current": "0123456789abcdef", "pending": None,
        "versions": {"image": "i1", "bundle": "b1", "world": "w1"},
        "robot_toml": hashlib.sha256(config.robot_toml(name).encode()).hexdigest(),
        "service": {
            "active": "active", "result": "success", "fresh": True, "enabled": True,
            "restarts": 0, "status": status,
        },
        "heartbeat": None, "kernel": "4.19.125", "systemd": 237, "python": "3.6.9",
        "rsync": True, "sdk": "1.4.1", "px4": "1.14.0-2.0.94",
        "disks": [{"path": "/opt", "free_bytes": 20e9, "total_bytes": 60e9}],
        "memory": {"total_bytes": 8e9, "available_bytes": 6e9},
        "cpus": 8, "load": 1.5, "hottest_c": 61.0, "synchronized": False,
        "wifi": [{
            "name": "wlan0", "connected": True, "network": "field", "signal_dbm": -52.0,
            "rate_mbit_s": 200.0, "frequency_mhz": 5180.0, "power_save": False,
        }],
        "vision_hub": {
            "en_localhost_mavlink_udp": True, "localhost_udp_port_number": None,
            "offboard_mode": "off",
        },
        "units": {
            "voxl-px4": {**runs}, "voxl-mavlink-server": {**runs}, "voxl-vision-hub": {**runs},
            "voxl-microdds-agent": {**idle}, "old_ros": {**idle},
        },
        "containers": [],
    }  # fmt: skip
    pings = {other: PING for other in ("r1", "r2", "r3") if other != name}
    return Examination(facts, ClockOffset(0.001, 0.01), "its program says so itself", pings)


def judged(config: FleetConfig, change: Any = lambda _: None) -> dict[str, DoctorCheck]:
    """The checks of r1, with its facts changed."""
    fleet = {name: well(config, name) for name in ("r1", "r2", "r3")}
    facts: dict[str, Any] = copy.deepcopy(dict(fleet["r1"].facts))
    change(facts)
    fleet["r1"] = fleet["r1"]._replace(facts=facts)
    return {check.name: check for check in judge(config, config.robots["r1"], fleet)}


def put(path: str, value: object) -> Any:
    def change(facts: dict[str, Any]) -> None:
        *parents, last = path.split(".")
        for parent in parents:
            facts = facts[parent]
        facts[last] = value

    return change


def test_a_robot_that_is_well_may_fly(config: FleetConfig) -> None:
    checks = judged(config)
    assert {check.verdict for check in checks.values()} == {"ok"}
    assert decide(Diagnosis("r1", tuple(checks.values()))) == ("r1", True, ())


def test_up_says_how_many_trials_the_packs_are_good_for(config: FleetConfig) -> None:
    def outcome(name: str, **said: object) -> Outcome[Examination]:
        examination = well(config, name)
        facts: dict[str, Any] = copy.deepcopy(dict(examination.facts))
        facts["service"]["status"] |= said
        return Outcome(config.robots[name], examination._replace(facts=facts), None)

    full, weak, unknown = packs(
        config,
        [
            outcome("r1", battery=0.95, endurance_s=1000.0),
            outcome("r2", battery=0.95, endurance_s=400.0),
            outcome("r3", battery=None, endurance_s=900.0),
            Outcome(config.robots["r1"], None, "it does not answer"),
        ],
        trial_s=60.0,
    )
    assert (full.robot, full.share) == ("r1", 0.95)
    assert full.trials is not None and weak.trials is not None
    assert 0 < weak.trials < full.trials < 0.7 * 1000.0 / 60.0
    assert unknown == ("r3", None, 900.0, None)


def test_an_accuracy_that_is_too_bad_for_the_landing_points_is_no_go(config: FleetConfig) -> None:
    """That may pass, or not; nobody is told that he may fly meanwhile."""
    bad = Gps(3, 14, 0.8, accuracy_m=2.0)
    (line,) = lines(bad, 0.9, 16.0, ErrorBudget())
    checks = judged(config, put("service.status.failed_checks", [line]))
    assert checks["preflight"] == ("preflight", "FAILED", line, "mend what each line says")
    assert not decide(Diagnosis("r1", tuple(checks.values()))).go


@pytest.mark.parametrize(
    ("ahead_s", "verdict"), [(3600.0, "FAILED"), (-0.3, "warning"), (0.0, "ok")]
)
def test_a_wrong_clock(config: FleetConfig, ahead_s: float, verdict: str) -> None:
    fleet = {name: well(config, name) for name in ("r1", "r2", "r3")}
    fleet["r1"] = fleet["r1"]._replace(clock=ClockOffset(ahead_s, 0.01))
    checks = {check.name: check for check in judge(config, config.robots["r1"], fleet)}
    assert checks["clock"].verdict == verdict
    assert checks["clock"].fix == ("" if verdict == "ok" else "lpac fleet up")


def container(**about: object) -> list[dict[str, object]]:
    plain = {"name": "box", "image": "busybox", "running": True, "restarts": "no",
             "host_network": False, "devices": False}  # fmt: skip
    return [plain | about]


@pytest.mark.parametrize(
    ("change", "check", "verdict", "found"),
    [
        (put("identity", None), "enrolled", "FAILED", "never enrolled"),
        (put("identity.robot", "r2"), "enrolled", "FAILED", "answers r2 of fleet demo"),
        (put("pending", {"release": "a"}), "release", "FAILED", "interrupted"),
        (put("versions.bundle", "b2"), "release", "FAILED", "that of r2, r3"),
        (put("robot_toml", "0" * 64), "release", "FAILED", "is not the one of fleet.toml"),
        (put("service.active", "failed"), "program", "FAILED", "it is failed"),
        (put("service.fresh", False), "program", "FAILED", "says nothing"),
        (put("service.restarts", 2), "program", "warning", "restarted 2 times"),
        (put("service.enabled", False), "program", "warning", "battery swap"),
        (put("service.status.peers", 1), "program", "warning", "1 of the 2"),
        (put("systemd", 229), "system", "FAILED", "systemd 229"),
        (put("python", "3.5.2"), "system", "FAILED", "Python 3.5.2"),
        (put("kernel", "4.9.1"), "system", "warning", "4.9.1"),
        (put("rsync", False), "system", "FAILED", "rsync is missing"),
        (put("hottest_c", 80.0), "processor", "warning", "80 °C"),
        (put("hottest_c", 91.0), "processor", "FAILED", "91 °C"),
        (put("memory.available_bytes", 1e8), "memory", "FAILED", "100 of 8000 MB"),
        (put("wifi", []), "wifi", "skipped", "no wireless interface"),
        (put("px4", "1.12.3-0.1"), "px4", "FAILED", "older than 1.14"),
        (put("units.voxl-px4.active", False), "px4", "FAILED", "voxl-px4 does not run"),
        (put("vision_hub", None), "vision-hub", "skipped", "no voxl-vision-hub"),
        (put("vision_hub", {"problem": "it is no JSON"}), "vision-hub", "FAILED", "no JSON"),
        (put("vision_hub.en_localhost_mavlink_udp", False), "vision-hub", "FAILED", "not true"),
        (
            put("units.voxl-microdds-agent.active", True),
            "commanders", "FAILED", "voxl-microdds-agent runs",
        ),
        (put("units.old_ros.enabled", True), "commanders", "FAILED", "starts at the next boot"),
        (put("containers", None), "containers", "warning", "does not answer"),
        (put("containers", container()), "containers", "ok", "1 run"),
        (put("containers", container(host_network=True)), "containers", "FAILED", "box (host"),
        (put("containers", container(devices=True)), "containers", "FAILED", "access to devices"),
        (put("containers", container(image="me/ros:1")), "containers", "FAILED", "image me/ros"),
        (
            put("containers", container(name="old_ros", running=False, restarts="always")),
            "containers", "FAILED", "(a predecessor) comes back by itself",
        ),
        (
            put("containers", container(name="old_ros", running=False)),
            "containers", "ok", "0 run",
        ),
        (
            put("service.status.failed_checks", ["autopilot's COM_OBL_RC_ACT = 0; wanted is 4"]),
            "failsafe", "FAILED", "COM_OBL_RC_ACT = 0",
        ),
        (
            put("service.status.failed_checks", ["checks are still running"]),
            "failsafe", "warning", "not read",
        ),
        (
            put("service.status.failed_checks", ["GPS has no 3-D fix: wait, or move to open sky"]),
            "preflight", "warning", "3-D fix",
        ),
        (
            put("service.status.failed_checks", ["battery has 40 %, must have 50 %: charge it"]),
            "preflight", "FAILED", "battery has 40 %",
        ),
        (
            put("service.status.failed_checks", ["GPS is poor: wait"] * 8),
            "failsafe", "warning", "there may be more",
        ),
    ],
)  # fmt: skip
def test_each_fault_is_named_with_its_fix(
    config: FleetConfig, change: Any, check: str, verdict: str, found: str
) -> None:
    one = judged(config, change)[check]
    assert one.verdict == verdict
    assert found in one.found
    assert bool(one.fix) == (verdict in ("FAILED", "warning"))


def test_what_was_changed_and_not_deployed_is_no_go(config: FleetConfig) -> None:
    """A lower ceiling; two robots that were given each other's names. A spare needs none."""
    text = config.path.read_text()
    fleet = {name: well(config, name) for name in ("r1", "r2", "r3")}
    exchanged = re.sub(r"robots\.r([12])", lambda found: f"robots.r{3 - int(found[1])}", text)
    for changed in (text.replace("ceiling_m = 30.0", "ceiling_m = 29.0"), exchanged):
        config.path.write_text(changed)
        now = load_fleet(config.path)
        checks = {check.name: check for check in judge(now, now.robots["r1"], fleet)}
        assert checks["release"].verdict == "FAILED"
        assert checks["release"].fix == "lpac fleet deploy --robots r1"
    assert is_configured(config, config.robots["r11"], {"robot_toml": None})


def test_fixes_are_roots_and_reach_the_robot_as_the_fleet_does(config: FleetConfig) -> None:
    user = dataclasses.replace(config.robots["r1"], user="voxl", port=2222)
    assert on(user, "a b", "c") == "lpac fleet exec --robots r1 'sudo a b && sudo c'"
    ssh = dataclasses.replace(config, ssh=SshConfig("/lab/ssh_config"))
    silent: list[Outcome[Examination]] = [Outcome(user, None, SILENT)]
    ((check,),) = (diagnosis.checks for diagnosis in diagnose(ssh, silent))
    assert check.fix.endswith("try: ssh -F /lab/ssh_config -p 2222 voxl@192.168.8.11")


@pytest.mark.parametrize(
    ("about", "found"),
    [({"power_save": True}, "power save on"), ({"signal_dbm": -80.0}, "-80 dBm, 200 Mbit/s: weak"),
     ({"connected": False}, "wlan0 is not connected")],
)  # fmt: skip
def test_a_poor_radio(config: FleetConfig, about: dict[str, object], found: str) -> None:
    wifi = [well(config, "r1").facts["wifi"][0] | about]
    check = judged(config, put("wifi", wifi))["wifi"]
    assert check.verdict == "warning"
    assert found in check.found


def test_what_a_stopped_robots_release_says_counts(config: FleetConfig) -> None:
    fleet = {name: well(config, name) for name in ("r1", "r2", "r3")}
    facts: dict[str, Any] = copy.deepcopy(dict(fleet["r1"].facts))
    facts["service"] |= {"active": "inactive", "fresh": False, "status": None}
    facts["heartbeat"] = {"system_id": 1, "autopilot": 12, "armed": False}
    vehicle = {"explanations": [], "changes": [], "failed": [
        "ground was not heard: start it",
        "autopilot's EKF2_HGT_REF = 3 (vision); wanted is 1 (GPS)",
        "heading is not known: check the compass",
    ]}  # fmt: skip
    fleet["r1"] = fleet["r1"]._replace(facts=facts, vehicle=vehicle)
    checks = {check.name: check for check in judge(config, config.robots["r1"], fleet)}
    assert checks["mavlink"].verdict == "ok"
    assert checks["failsafe"].verdict == "FAILED"
    assert "EKF2_HGT_REF = 3" in checks["failsafe"].found
    assert checks["preflight"].verdict == "warning"
    assert checks["preflight"].found == "heading is not known: check the compass"


# The laptop


def test_the_laptop_is_looked_at_and_what_it_lacks_is_named(
    config: FleetConfig, tmp_path: Path
) -> None:
    def look(**environment: str) -> dict[str, dict[str, str]]:
        asked = (config.path, "doctor", "--laptop", "--json")
        shown = lpac_fleet(*asked, environment=environment)
        return {c["name"]: c for c in json.loads(shown.stdout)["robots"]["laptop"]["checks"]}

    checks = look()
    assert list(checks) == ["tools", "keys", "sleep", "clock", "firewall"]
    assert checks["tools"]["verdict"] == "ok"
    tools = look(PATH=str(tmp_path))["tools"]
    assert (tools["verdict"], tools["found"]) == ("FAILED", "ssh, ssh-keygen, rsync is missing")


def test_rsync_version() -> None:
    assert rsync_version("rsync  version 3.1.2  protocol version 31\n") == (3, 1)
    assert rsync_version("rsync  version v3.4.1  protocol version 32\n") == (3, 4)
    assert rsync_version("openrsync: protocol version 29\n") is None


UFW = """-P INPUT DROP
-P FORWARD DROP
-P OUTPUT ACCEPT
-N ufw-user-input
-A INPUT -i lo -j ACCEPT
-A INPUT -m conntrack --ctstate RELATED,ESTABLISHED -j ACCEPT
-A INPUT -j ufw-user-input
-A ufw-user-input -p tcp -m tcp --dport 22 -j ACCEPT
"""


def test_iptables_rules() -> None:
    assert iptables_blocks(UFW, [7447]) == ["input"]
    opened = UFW + "-A ufw-user-input -p tcp -m multiport --dports 80,7000:7999 -j ACCEPT\n"
    assert iptables_blocks(opened, [7447]) == []
    assert iptables_blocks("-P INPUT ACCEPT\n-P OUTPUT ACCEPT\n", [7447]) == []
    assert iptables_blocks(
        "-P OUTPUT ACCEPT\n-A OUTPUT -p tcp --dport 7447 -j REJECT\n", [7447]
    ) == ["output"]


def test_nft_rules() -> None:
    place = {"family": "inet", "table": "filter"}
    base = place | {"name": "input", "hook": "input", "policy": "drop"}

    def rule(*expressions: dict[str, Any]) -> dict[str, Any]:
        return {"rule": place | {"chain": "input", "expr": list(expressions)}}

    def to_port(right: Any) -> dict[str, Any]:
        left = {"payload": {"protocol": "tcp", "field": "dport"}}
        return {"match": {"op": "==", "left": left, "right": right}}

    established = {"match": {"op": "in", "left": {"ct": {"key": "state"}}, "right": "established"}}
    accept = {"accept": None}
    closed = [{"chain": base}, rule(established, accept), rule(to_port(22), accept)]
    assert nft_blocks({"nftables": closed}, [7447]) == ["input"]
    for right in (7447, {"set": [22, 7447]}, {"set": [{"range": [7000, 8000]}]}):
        opened = [*closed, rule(to_port(right), accept)]
        assert nft_blocks({"nftables": opened}, [7447]) == []
    named = {"set": place | {"name": "open", "elem": [22, {"range": [7440, 7450]}]}}
    opened = [named, *closed, rule(to_port("@open"), accept)]
    assert nft_blocks({"nftables": opened}, [7447]) == []
    assert nft_blocks({"nftables": opened}, [7451]) == ["input"]
    assert nft_blocks({"nftables": []}, [7447]) == []
