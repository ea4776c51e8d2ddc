"""Doctor on facts that no robot computer here can have, and on what tools print."""

import asyncio
import copy
import dataclasses
import hashlib
import re
from pathlib import Path
from typing import Any

import pytest

from edge.core.vehicle import Gps
from edge.flight.margins import ErrorBudget
from edge.identity.members import Role
from edge.messages.codes import CheckCode, FailedCheck
from lpac.fleet import laptop
from lpac.fleet.doctor import (
    ClockOffset,
    Diagnosis,
    DoctorCheck,
    Examination,
    _check_vehicle,
    diagnose,
    is_configured,
    judge,
    measure_clock,
    on,
)
from lpac.fleet.laptop import rsync_version
from lpac.fleet.members import init, open_authority
from lpac.fleet.operations import Outcome
from lpac.fleet.settings import FleetConfig, RadioConfig, RobotHost, SshConfig, load_fleet
from lpac.fleet.up import batteries_of
from lpac.fleet.writer import robot_toml
from tests.conftest import ROOT
from tests.host.fleet.field import SILENT
from tests.unit.flight.test_preflight import lines

_C = CheckCode

PING = {"loss": 0.0, "mean_ms": 3.0, "max_ms": 9.0}


@pytest.fixture
def config(tmp_path: Path) -> FleetConfig:
    """The example's three robots and a spare."""
    text = (ROOT / "docs" / "fleet.toml").read_text()
    path = tmp_path / "fleet.toml"
    text = text.replace("# predecessors = []", 'predecessors = ["old_ros"]')
    path.write_text(text.replace('# keys = ""', 'keys = "keys"'))
    config = load_fleet(path)
    init(config, "ann")
    return config


def members_of(config: FleetConfig) -> str | None:
    """The list of members, with all robots of the file."""
    if config.keys is None:
        return None
    authority = open_authority(config)
    for name, robot in config.robots.items():
        authority.issue(Role.ROBOT, name, name.encode().ljust(32), robot.robot_id)
    return authority.members.text


def failed(code: CheckCode, text: str = "x", *, settles: bool = False) -> dict[str, Any]:
    """One failed check as the robot's program tells it, in words that say nothing."""
    return dataclasses.asdict(FailedCheck(code, text, settles))


def well(config: FleetConfig, name: str) -> Examination:
    """A robot that may fly."""
    robot = config.robots[name]
    status = {
        "state": "idle", "autopilot": True, "system_id": robot.system_id, "peers": 2,
        "failed_checks": [
            failed(_C.GROUND_NOT_HEARD),
            failed(_C.ORIGIN_NOT_SET),
            failed(_C.PLACE_NOT_KNOWN),
            failed(_C.FENCE_NOT_UPLOADED, settles=True),
        ],
        "failed_checks_more": 0,
    }  # fmt: skip
    runs = {"there": True, "active": True, "enabled": True}
    idle = {"there": False, "active": False, "enabled": False}
    facts = {
        "identity": {"fleet": config.fleet, "robot": name, "robot_id": robot.robot_id},
        "current": "0123456789abcdef", "pending": None,
        "versions": {"image": "i1", "bundle": "b1", "world": "w1"},
        "robot_toml": hashlib.sha256(robot_toml(config, name).encode()).hexdigest(),
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
        "containers": [], "members": members_of(config), "group_keys": "00ff",
        "factory_passwords": [],
        "drops_strangers": True,
        "open_ports": [{"protocol": "tcp", "port": 22, "program": "sshd"},
                       {"protocol": "tcp", "port": 7447, "program": "python3"}],
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


def says(*checks: dict[str, Any]) -> Any:
    """Its program says that these checks failed."""
    return put("service.status.failed_checks", list(checks))


def test_a_robot_that_is_well_may_fly(config: FleetConfig) -> None:
    checks = judged(config)
    assert {check.verdict for check in checks.values()} == {"ok"}
    assert Diagnosis("r1", tuple(checks.values())).reasons() == []


def test_up_says_how_many_trials_the_packs_are_good_for(config: FleetConfig) -> None:
    def outcome(name: str, **said: object) -> Outcome[Examination]:
        examination = well(config, name)
        facts: dict[str, Any] = copy.deepcopy(dict(examination.facts))
        facts["service"]["status"] |= said
        return Outcome(config.robots[name], examination._replace(facts=facts), None)

    full, weak, unknown = batteries_of(
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
    told = [failed(_C.LANDINGS_TOO_NEAR, line)]
    checks = judged(config, put("service.status.failed_checks", told))
    assert checks["preflight"] == ("preflight", "FAILED", line, "do what each line says")
    assert Diagnosis("r1", tuple(checks.values())).reasons() == [f"preflight: {line}"]


@pytest.mark.parametrize(
    ("ahead_s", "verdict", "found"),
    [
        (3600.0, "FAILED", "1.0 h ahead of"),
        (-0.51, "warning", "510 ms behind"),
        (-0.3, "warning", "300 ms behind"),
        (0.06, "ok", "60 ms ahead of"),
    ],
)
def test_a_wrong_clock(config: FleetConfig, ahead_s: float, verdict: str, found: str) -> None:
    fleet = {name: well(config, name) for name in ("r1", "r2", "r3")}
    fleet["r1"] = fleet["r1"]._replace(clock=ClockOffset(ahead_s, 0.01))
    checks = {check.name: check for check in judge(config, config.robots["r1"], fleet)}
    assert checks["clock"].verdict == verdict
    assert checks["clock"].found == f"{found} the laptop's (± 10 ms)"
    assert checks["clock"].fix == ("" if verdict == "ok" else "lpac fleet up")


def test_with_multicast_no_robot_is_connected_to_another(config: FleetConfig) -> None:
    for radio, verdict, fix in (
        (RadioConfig("multicast"), "ok", ""),
        (RadioConfig("mesh"), "warning", "lpac fleet radio"),
    ):
        its = dataclasses.replace(config, radio=radio)
        fleet = {name: well(its, name) for name in ("r1", "r2", "r3")}
        fleet["r1"].facts["service"]["status"]["peers"] = 0
        checks = {check.name: check for check in judge(its, its.robots["r1"], fleet)}
        assert (checks["program"].verdict, checks["program"].fix) == (verdict, fix)


def test_robots_in_multicast_need_one_key(config: FleetConfig) -> None:
    assert "group key" not in judged(config)
    sending = dataclasses.replace(config, radio=RadioConfig("multicast"))
    for keys, verdict, found in (
        ("00ff", "ok", "3 of 3 robots"),
        (None, "FAILED", "it has no group key"),
        ("11ff", "FAILED", "differs from that of r2, r3"),
    ):
        check = judged(sending, put("group_keys", keys))["group key"]
        assert (check.verdict, check.fix) == (verdict, "" if verdict == "ok" else "lpac fleet up")
        assert found in check.found
    # Who has none is another matter than who has another one.
    fleet = {name: well(sending, name) for name in ("r1", "r2", "r3")}
    for name in ("r2", "r3"):
        fleet[name] = fleet[name]._replace(facts={**fleet[name].facts, "group_keys": None})
    checks = {check.name: check for check in judge(sending, sending.robots["r1"], fleet)}
    assert checks["group key"].verdict == "ok"
    assert "1 of 3 robots" in checks["group key"].found
    # Where they speak is no door.
    port = {"protocol": "udp", "port": 7450, "program": "python3"}
    assert judged(sending, put("open_ports", [port]))["doors"].verdict == "ok"
    assert judged(config, put("open_ports", [port]))["doors"].verdict == "warning"


def container(**about: object) -> list[dict[str, object]]:
    plain = {"name": "box", "image": "busybox", "running": True, "restarts": "no",
             "host_network": False, "devices": False}  # fmt: skip
    return [plain | about]


@pytest.mark.parametrize(
    ("change", "check", "verdict", "found"),
    [
        (put("identity", None), "enrolled", "FAILED", "it is not enrolled"),
        (put("identity.robot", "r2"), "enrolled", "FAILED", "answers r2 of fleet demo"),
        (put("pending", {"release": "a"}), "release", "FAILED", "interrupted"),
        *(
            (put(f"versions.{part}", "x2"), "release", "FAILED", f"its {part} x2 differs from")
            for part in ("image", "bundle", "world")
        ),
        (put("robot_toml", "0" * 64), "release", "FAILED", "is not that of fleet.toml"),
        (put("service.active", "failed"), "program", "FAILED", "it is failed"),
        (put("service.fresh", False), "program", "FAILED", "reports no status"),
        (put("service.restarts", 2), "program", "warning", "restarted 2 times"),
        (put("service.restarts", 1), "program", "warning", "restarted 1 time"),
        (put("service.enabled", False), "program", "warning", "battery swap"),
        (put("service.status.peers", 1), "program", "warning", "1 of the 2"),
        (put("systemd", 229), "system", "FAILED", "systemd 229"),
        (put("python", "3.5.2"), "system", "FAILED", "Python 3.5.2"),
        (put("kernel", "4.9.1"), "system", "warning", "4.9.1"),
        (put("rsync", False), "system", "FAILED", "rsync is missing"),
        (put("hottest_c", 80.0), "processor", "warning", "80 °C"),
        (put("hottest_c", 91.0), "processor", "FAILED", "91 °C"),
        (put("memory.available_bytes", 1e8), "memory", "FAILED", "100 of 8000 MB"),
        (
            put("disks", [
                {"path": "/opt", "free_bytes": 2e9, "total_bytes": 9e9},
                {"path": "/var", "free_bytes": 3e8, "total_bytes": 9e9},
            ]),
            "disk", "warning", "300 of 9000 MB free at /var",
        ),
        (put("disks", []), "disk", "skipped", "df prints nothing"),
        (put("service.status.system_id", 9), "mavlink", "FAILED", "system id 9, fleet.toml has 1"),
        (put("service.status.autopilot", False), "mavlink", "FAILED", "the autopilot is silent"),
        (put("wifi", []), "wifi", "skipped", "no wireless interface"),
        (put("px4", "1.12.3-0.1"), "px4", "FAILED", "older than 1.14"),
        (put("units.voxl-px4.active", False), "px4", "FAILED", "not running: voxl-px4"),
        (put("vision_hub", None), "vision-hub", "skipped", "no voxl-vision-hub"),
        (put("vision_hub", {"problem": "not JSON"}), "vision-hub", "FAILED", "not JSON"),
        (put("vision_hub.en_localhost_mavlink_udp", False), "vision-hub", "FAILED", "not true"),
        (put("vision_hub.en_localhost_mavlink_udp", None), "vision-hub", "FAILED", "not true"),
        (put("vision_hub.offboard_mode", None), "vision-hub", "FAILED", "offboard_mode is not set"),
        (put("vision_hub.localhost_udp_port_number", 1), "vision-hub", "FAILED", "UDP port 1, "),
        (
            put("units.voxl-microdds-agent.active", True),
            "commanders", "FAILED", "voxl-microdds-agent runs",
        ),
        (put("units.old_ros.enabled", True), "commanders", "FAILED", "starts at the next boot"),
        (put("drops_strangers", False), "doors", "warning", "lets only root filter"),
        (put("members", None), "member", "FAILED", "no list of the fleet's members"),
        (put("members", "{"), "member", "FAILED", "members: does not begin with"),
        (
            put("members", f"fleet demo 1 0 {64 * 'a'}"),
            "member", "FAILED", "its list of members is number 1, this computer's is ",
        ),
        (put("factory_passwords", ["root"]), "doors", "FAILED", "root: no password, or"),
        (
            put("open_ports", [{"protocol": "udp", "port": 14556, "program": "voxl-mavlink-s"}]),
            "doors", "warning", "MAVLink is open to the network: udp 14556 (voxl-mavlink-s)",
        ),
        (
            put("open_ports", [{"protocol": "udp", "port": 14550, "program": "?"}]),
            "doors", "warning", "MAVLink is open to the network: udp 14550 (?)",
        ),
        (
            put("open_ports", [{"protocol": "udp", "port": 7447, "program": "python3"}]),
            "doors", "ok", "only ssh and the radio",
        ),
        (
            put("open_ports", [{"protocol": "tcp", "port": 80, "program": "voxl-portal"}]),
            "doors", "warning", "listen to the network: tcp 80 (voxl-portal)",
        ),
        (put("containers", None), "containers", "warning", "does not answer"),
        (put("containers", container()), "containers", "ok", "1 running"),
        (put("containers", container(host_network=True)), "containers", "FAILED", "box (host"),
        (put("containers", container(devices=True)), "containers", "FAILED", "access to devices"),
        (put("containers", container(image="me/ros:1")), "containers", "FAILED", "image me/ros"),
        (
            put("containers", container(name="old_ros", running=False, restarts="always")),
            "containers", "FAILED", "(a predecessor) starts at boot",
        ),
        (
            put("containers", container(name="old_ros", running=False, restarts="unless-stopped")),
            "containers", "FAILED", "(a predecessor) starts at boot",
        ),
        (
            put("containers", container(name="old_ros", running=False)),
            "containers", "ok", "0 running",
        ),
        (says(failed(_C.FAILSAFE_WRONG, "COM_X = 0")), "failsafe", "FAILED", "COM_X = 0"),
        (says(failed(_C.FAILSAFE_NOT_READ)), "failsafe", "warning", "not been read"),
        (says(failed(_C.CHECKS_RUNNING, settles=True)), "failsafe", "warning", "not been read"),
        (says(failed(_C.CHECKS_RUNNING, settles=True)), "preflight", "warning", "x"),
        (says(failed(_C.AUTOPILOT_NOT_CONNECTED)), "failsafe", "warning", "not been read"),
        (says(failed(_C.TIME_NOT_KNOWN)), "preflight", "ok", "only the ground's commands"),
        (says(failed(_C.GPS_NO_FIX, settles=True)), "preflight", "warning", "x"),
        (says(failed(_C.BATTERY_LOW, "40 %")), "preflight", "FAILED", "40 %"),
        (says(failed(_C.NOT_ARMABLE)), "preflight", "FAILED", "x"),
        (
            says(failed(_C.NOT_ARMABLE), failed(_C.GPS_NO_FIX, settles=True)),
            "preflight", "warning", "x",
        ),
        (
            says(failed(_C.NOT_ARMABLE), failed(_C.CHECKS_RUNNING, settles=True)),
            "preflight", "FAILED", "x",
        ),
        (says({**failed(_C.OTHER), "code": "of_a_newer_program"}), "preflight", "FAILED", "x"),
        (put("service.status.failed_checks_more", 1), "failsafe", "warning", "is cut off"),
    ],
)  # fmt: skip
def test_each_fault_is_named_with_its_fix(
    config: FleetConfig, change: Any, check: str, verdict: str, found: str
) -> None:
    one = judged(config, change)[check]
    assert one.verdict == verdict
    assert found in one.found
    assert bool(one.fix) == (verdict in ("FAILED", "warning"))


def test_a_robot_is_judged_beside_the_others(config: FleetConfig) -> None:
    def check(name: str, robot: RobotHost, fleet: dict[str, Examination]) -> DoctorCheck:
        return {check.name: check for check in judge(config, robot, fleet)}[name]

    r1, fleet = config.robots["r1"], {name: well(config, name) for name in ("r1", "r2")}
    # Nobody is right where no half agrees.
    fleet["r2"].facts["versions"]["image"] = "i2"
    assert check("release", r1, fleet).found.endswith("differs from that of r2")
    # Who is off has its own fault; who answers, and is heard badly, is named.
    for about, verdict, found in (
        ({"r2": PING, "r3": {**PING, "loss": 1.0}}, "ok", "1 robot: slowest answer within 3.0 ms"),
        ({"r2": {**PING, "loss": 1.0}}, "FAILED", "no answer from r2"),
        ({"r2": {**PING, "loss": 0.2}}, "warning", "r2: 20 % lost, 3 ms"),
        ({"r2": {**PING, "mean_ms": 80.0}}, "warning", "r2: 0 % lost, 80 ms"),
    ):
        fleet["r1"] = fleet["r1"]._replace(pings=about)
        assert check("radio", r1, fleet)[1:3] == (verdict, found)
    open_authority(config).revoke("r1")
    assert check("member", r1, fleet).found == "it is not in the list of members"
    # And ssh may have another port.
    doors = [{"protocol": "tcp", "port": port, "program": "sshd"} for port in (22, 2222)]
    fleet["r1"].facts["open_ports"][:] = doors
    moved = dataclasses.replace(r1, port=2222)
    assert (
        check("doors", moved, fleet).found == "other programs listen to the network: tcp 22 (sshd)"
    )
    # Of two radios the one that is connected counts.
    link = fleet["r1"].facts["wifi"][0]
    fleet["r1"].facts["wifi"][:] = [{**link, "name": "wlan1", "connected": False}, link]
    assert check("wifi", r1, fleet).verdict == "ok"
    spare = config.robots["r11"]
    fleet["r11"] = fleet["r1"]
    assert check("program", spare, fleet)[1:3] == ("FAILED", "it is a spare, but its program runs")


def test_the_vehicle_is_asked_only_where_nothing_speaks_against_it(config: FleetConfig) -> None:
    class Silent:
        """Session that fails if it is used."""

    facts: dict[str, Any] = copy.deepcopy(dict(well(config, "r1").facts))
    facts["service"]["active"] = "inactive"
    facts["heartbeat"] = {"armed": False}
    for change, why in (
        (put("current", None), "it has no release"),
        (put("service.active", "active"), "its program runs"),
        (put("pending", {}), "a switch of releases was interrupted"),
        (put("heartbeat", None), "PX4 does not answer"),
        (put("heartbeat.armed", True), "the vehicle is armed"),
    ):
        changed = copy.deepcopy(facts)
        change(changed)
        session: Any = Silent()
        asked = _check_vehicle(config, config.robots["r1"], session, changed, lambda *_: None)
        assert asyncio.run(asked) == why


def test_the_quickest_exchange_tells_the_clock() -> None:
    """The robot is 5 s ahead; of the other exchanges one way took longer than the other."""
    times_s = iter([0.0, 5.3, 0.4, 1.0, 6.01, 1.02, 2.0, 7.1, 2.3, 3.0, 8.1, 3.3, 4.0, 9.1, 4.3])

    class Asked:
        async def check_output(self, *_: str) -> str:
            return f"{next(times_s)}\n"

    session: Any = Asked()
    assert asyncio.run(measure_clock(session, lambda: next(times_s))) == pytest.approx((5.0, 0.01))


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
        failed(_C.GROUND_NOT_HEARD),
        failed(_C.FAILSAFE_WRONG, "autopilot's EKF2_HGT_REF = 3 (vision); wanted is 1 (GPS)"),
        failed(_C.HEADING_NOT_KNOWN, "no heading", settles=True),
    ]}  # fmt: skip
    fleet["r1"] = fleet["r1"]._replace(facts=facts, vehicle=vehicle)
    checks = {check.name: check for check in judge(config, config.robots["r1"], fleet)}
    assert checks["mavlink"].verdict == "ok"
    assert checks["failsafe"].verdict == "FAILED"
    assert "EKF2_HGT_REF = 3" in checks["failsafe"].found
    assert checks["preflight"].verdict == "warning"
    assert checks["preflight"].found == "no heading"


LAPTOP = {
    "rsync --version": "rsync  version 3.1.2  protocol version 31",
    "ssh -V": "OpenSSH_9.2p1, of a laptop",
    "-F /lab/ssh_config -G 192.168.8.11": "identityfile KEY",
    "sleep.target": "LoadState=masked",
    "suspend.target": "LoadState=masked",
    "timedatectl": "yes",
    "nft": '{"nftables": []}',
    "iptables": "-P INPUT ACCEPT",
}


NFT = '{"nftables": [{"table": {}}, {"chain": {"hook": "output", "policy": "drop"}}]}'


@pytest.mark.parametrize(
    ("said", "name", "verdict", "found"),
    [
        ({}, "tools", "ok", "OpenSSH_9.2p1, rsync 3.1"),
        ({"rsync --version": "rsync  version 3.0.9"}, "tools", "FAILED", "older than 3.1"),
        ({}, "keys", "ok", "KEY, no agent"),
        ({"ssh-keygen -y": ""}, "keys", "FAILED", "KEY has a passphrase"),
        ({}, "sleep", "ok", "sleep.target and suspend.target are masked"),
        ({"suspend.target": "LoadState=loaded"}, "sleep", "warning", "may sleep when idle"),
        ({}, "clock", "ok", "set by a time server"),
        ({"timedatectl": "no"}, "clock", "warning", "not set by a time server since boot"),
        ({}, "firewall", "ok", "outgoing connections are allowed"),
        # As ufw has it: nobody connects to the laptop.
        ({"iptables": "-P INPUT DROP"}, "firewall", "ok", "outgoing connections are allowed"),
        ({"iptables": "-P OUTPUT DROP"}, "firewall", "warning", "are dropped by default"),
        ({"nft": NFT}, "firewall", "warning", "are dropped by default"),
        ({"iptables": "", "nft": ""}, "firewall", "skipped", "neither nft nor iptables"),
    ],
)
def test_a_laptop(
    config: FleetConfig, monkeypatch: pytest.MonkeyPatch,
    said: dict[str, str], name: str, verdict: str, found: str,
) -> None:  # fmt: skip
    """Judge a laptop by stubbed tools; one with empty output exits with an error."""
    key = config.path.with_name("KEY")
    key.touch()

    def run(*command: str) -> tuple[int, str]:
        asked = " ".join(command)
        text = next((text for part, text in (LAPTOP | said).items() if part in asked), "\n")
        return (0 if text else 1), text.replace("KEY", str(key))

    monkeypatch.setattr(laptop, "_run", run)
    monkeypatch.setattr("shutil.which", lambda program: program)
    monkeypatch.setattr("platform.system", lambda: "Linux")
    monkeypatch.setattr("os.geteuid", lambda: 0)
    monkeypatch.delenv("SSH_AUTH_SOCK", raising=False)
    checked = laptop.examine_laptop(dataclasses.replace(config, ssh=SshConfig("/lab/ssh_config")))
    (check,) = (check for check in checked if check.name == name)
    assert check.verdict == verdict and found in check.found
    assert bool(check.fix) == (verdict in ("FAILED", "warning"))


def test_rsync_version() -> None:
    assert rsync_version("rsync  version 3.1.2  protocol version 31\n") == (3, 1)
    assert rsync_version("rsync  version v3.4.1  protocol version 32\n") == (3, 4)
    assert rsync_version("openrsync: protocol version 29\n") is None
