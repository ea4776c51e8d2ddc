"""Checks of a robot before a flight: looked at over SSH, judged here, each fault with its fix."""

import asyncio
import hashlib
import json
import re
import shlex
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

from edge.core.counted import counted
from edge.core.schema import ConfigError
from edge.drivers.identity_folder import card_in
from edge.messages.codes import CheckCode, FailedCheck, texts
from lpac.fleet import probes
from lpac.fleet.deploy import lpac_inside
from lpac.fleet.hold import Report, lock, overview, wrong_identity
from lpac.fleet.operations import Outcome
from lpac.fleet.program import hear_heartbeat
from lpac.fleet.session import RemoteError, Session, connect
from lpac.fleet.settings import FleetConfig, RobotHost
from lpac.fleet.writer import robot_toml

Verdict = Literal["ok", "skipped", "warning", "FAILED"]
Facts = Mapping[str, Any]

# Where clocks differ by more, robots cannot tell how old each other's messages are.
MOST_CLOCK_OFFSET_S = 0.5
# What a measurement over a good radio can tell, and `up` puts right.
GOOD_CLOCK_OFFSET_S = 0.05
_EXCHANGES = 5
_PINGS = 10
# How long the program may take, after its start, until its first checks are done; and the failed
# checks that mean that it has not looked yet.
_CHECKS_WAIT_S = 8.0
_NOT_SETTLED = {CheckCode.CHECKS_RUNNING.value, CheckCode.FAILSAFE_NOT_READ.value}
# `lpac robot check` waits so long for the vehicle; the ground will be missing to its end.
_CHECK_S = 10.0
_LOST_TOO_MUCH, _SLOW_MS = 0.1, 50.0

_MB = 1e6
_LEAST_DISK_MB, _GOOD_DISK_MB = 200.0, 1000.0
_LEAST_MEMORY_MB, _GOOD_MEMORY_MB = 200.0, 400.0
# A VOXL2 throttles near 90 C.
_WARM_C, _HOT_C = 75.0, 88.0
_WEAK_DBM = -75.0
_LEAST_PYTHON, _LEAST_SYSTEMD, _LEAST_KERNEL, _LEAST_PX4 = (3, 6), 237, (4, 19), (1, 14)

# Failed checks of the robot's program that only say that no ground commands it yet.
_GROUND = (
    CheckCode.GROUND_NOT_HEARD,
    CheckCode.GROUND_SILENT,
    CheckCode.ORIGIN_NOT_SET,
    CheckCode.PLACE_NOT_KNOWN,
    CheckCode.FENCE_NOT_UPLOADED,
)
_PX4_PARTS = ("voxl-px4", "voxl-mavlink-server", "voxl-vision-hub")
# What else may command it: the bridges to DDS and ROS that ModalAI ships.
_COMMANDERS = ("voxl-microdds-agent", "voxl-mpa-to-ros", "voxl-mpa-to-ros2")
_NO_AUTOPILOT = (
    CheckCode.AUTOPILOT_NOT_CONNECTED,
    CheckCode.OTHER_AUTOPILOT,
    CheckCode.SYSTEM_ID_WRONG,
)
_UP = "lpac fleet up"
# What other checks of the doctor's say.
_SAID_ELSEWHERE = (
    *_NO_AUTOPILOT,
    CheckCode.FAILSAFE_NOT_READ,
    CheckCode.FAILSAFE_WRONG,
    CheckCode.TIME_NOT_KNOWN,
)


class DoctorCheck(NamedTuple):
    """One check: what was found, and what to do about it where something is wrong.

    "skipped": it could not be looked at, or there is nothing to look at; `found` says which.
    """

    name: str
    verdict: Verdict
    found: str
    fix: str = ""


class ClockOffset(NamedTuple):
    """The robot's wall clock minus the laptop's, s, and how far off that may be."""

    offset_s: float
    uncertainty_s: float


class Examination(NamedTuple):
    """Findings on one robot that answered.

    `vehicle` is what `lpac robot check` says, or why it was not asked; `pings` are by the other
    robots' names, or why there are none.
    """

    facts: Facts
    clock: ClockOffset
    vehicle: Facts | str
    pings: Mapping[str, Facts] | str


class Diagnosis(NamedTuple):
    """One robot's checks."""

    robot: str
    checks: tuple[DoctorCheck, ...]

    def failed(self) -> list[DoctorCheck]:
        """Those that keep it from flying."""
        return [check for check in self.checks if check.verdict == "FAILED"]


def diagnose(config: FleetConfig, outcomes: Sequence[Outcome[Examination]]) -> list[Diagnosis]:
    """Judge all that was found; a robot that did not answer has but one check, which failed."""
    found = {o.robot.name: o.value for o in outcomes if o.value is not None}
    return [
        Diagnosis(
            o.robot.name,
            (DoctorCheck("reach", "FAILED", o.problem or "", _reach_fix(config, o.robot)),),
        )
        if o.value is None
        else Diagnosis(o.robot.name, tuple(judge(config, o.robot, found)))
        for o in outcomes
    ]


async def examine(
    config: FleetConfig,
    robot: RobotHost,
    others: Sequence[RobotHost],
    report: Report,
    unix_time_s: Callable[[], float] = time.time,
) -> Examination:
    """Look at one robot; nothing on it is changed. Raises FleetError if it does not answer."""
    report("connect", None)
    async with connect(config, robot, lambda step: report(step, None)) as session:
        clock = await measure_clock(session, unix_time_s)
        report("looks", None)
        names = [*_PX4_PARTS, *_COMMANDERS, *config.predecessors]
        facts = await overview(session, config)
        facts |= await probes.facts(session, config.directory, names)
        facts["service"] = await _settled(session, facts["service"])
        facts["heartbeat"] = None
        if facts["service"]["active"] != "active":
            report("listens to PX4", None)
            facts["heartbeat"] = await hear_heartbeat(session, robot)
        report("pings", None)
        pings = await _ping_others(session, others)
        vehicle = await _check_vehicle(config, robot, session, facts, report)
        return Examination(facts, clock, vehicle, pings)


async def measure_clock(
    session: Session, unix_time_s: Callable[[], float] = time.time
) -> ClockOffset:
    """Compare wall clocks; the quickest of some exchanges tells. Raises FleetError."""
    best: ClockOffset | None = None
    for _ in range(_EXCHANGES):
        asked_s = unix_time_s()
        there_s = float(await session.must("date", "+%s.%N"))
        answered_s = unix_time_s()
        half_s = (answered_s - asked_s) / 2.0
        if best is None or half_s < best.uncertainty_s:
            best = ClockOffset(there_s - asked_s - half_s, half_s)
    assert best is not None
    return best


async def _settled(session: Session, state: dict[str, Any]) -> dict[str, Any]:
    """The unit's state once the program has done its first checks, if it runs."""
    until_s = time.monotonic() + _CHECKS_WAIT_S
    while state["fresh"] and time.monotonic() < until_s:
        codes = {check["code"] for check in state["status"]["failed_checks"]}
        if not codes & _NOT_SETTLED:
            break
        await asyncio.sleep(0.25)
        state = await session.call("service")
    return state


async def _ping_others(session: Session, others: Sequence[RobotHost]) -> Mapping[str, Facts] | str:
    """ICMP echo from the robot to the others, or why there is none. Raises UnreachableError."""
    if not others:
        return {}
    try:
        return await probes.ping(session, {other.name: other.address for other in others}, _PINGS)
    except RemoteError as error:
        return str(error)


async def _check_vehicle(
    config: FleetConfig, robot: RobotHost, session: Session, facts: Facts, report: Report
) -> Facts | str:
    """The release's own check of the vehicle, where nothing speaks against running it.

    With `parameters = "set"` in its configuration it sets PX4's parameters, as it would when run.
    The lock keeps everybody from starting the program meanwhile.
    """
    if config.slot_of(robot.name) is None:
        return "it is a spare: without a slot it has no configuration"
    if facts["current"] is None:
        return "it has no release"
    if facts["service"]["active"] not in ("inactive", "failed"):
        return "its program runs"
    if facts["pending"] is not None:
        return "a switch of releases was interrupted"
    if facts["heartbeat"] is None:
        return "PX4 does not answer"
    if facts["heartbeat"]["armed"]:
        return "the vehicle is armed"
    report("reads PX4's parameters", None)
    try:
        await lock(session, config, robot)
        done = await lpac_inside(
            session, f"{config.directory}/current", "robot", "check", "--config",
            "/release/robot.toml", "--json", "--wait", f"{_CHECK_S:g}",
            # Who it is in its fleet, which is for the program's user alone.
            state="" if config.keys is None else "/var/lib/private",
        )  # fmt: skip
        return dict(json.loads(done.out))
    except RemoteError as error:
        return str(error)
    except ValueError:
        return done.reason


# Judging: pure


def judge(
    config: FleetConfig, robot: RobotHost, fleet: Mapping[str, Examination]
) -> Iterator[DoctorCheck]:
    """The checks of a robot; `fleet` has the examinations of all that answered, its own too."""
    found = fleet[robot.name]
    facts = found.facts
    yield _identity(config, robot, facts)
    yield _card(config, robot, facts["card"])
    of_all = {name: other.facts for name, other in fleet.items()}
    if config.radio.transport == "multicast" and config.keys is not None:
        yield _group(robot, of_all)
    yield _release(config, robot, of_all)
    yield _program(config, robot, fleet)
    yield _system(facts)
    yield _disk(facts)
    yield _clock(facts, found.clock)
    yield _processor(facts)
    yield _memory(facts)
    yield _wifi(robot, facts["wifi"])
    yield _radio(found.pings, set(fleet))
    yield _mavlink(robot, facts)
    yield _px4(robot, facts)
    yield _vision_hub(config, robot, facts["vision_hub"])
    yield _doors(config, robot, facts)
    yield _commanders(config, robot, facts)
    yield _containers(config, robot, facts["containers"])
    yield from _vehicle(robot, facts, found.vehicle)


def on(robot: RobotHost, *commands: str) -> str:
    """How a person runs commands on the robot as root, one after another while they succeed."""
    sudo = "" if robot.user == "root" else "sudo "
    text = " && ".join(sudo + command for command in commands)
    return f"lpac fleet exec --robots {robot.name} {shlex.quote(text)}"


def _reach_fix(config: FleetConfig, robot: RobotHost) -> str:
    ssh = ["ssh"]
    if config.ssh.config:
        ssh += ["-F", config.ssh.config]
    if robot.port is not None:
        ssh += ["-p", str(robot.port)]
    ssh.append(f"{robot.user}@{robot.host}")
    return f"switch {robot.name} on, look at its Wi-Fi, then try: {shlex.join(ssh)}"


def _enroll(robot: RobotHost) -> str:
    return f"lpac fleet enroll {robot.name} {robot.host}"


def _deploy(robot: RobotHost) -> str:
    return f"lpac fleet deploy --robots {robot.name}"


def _identity(config: FleetConfig, robot: RobotHost, facts: Facts) -> DoctorCheck:
    if facts["identity"] is None:
        return DoctorCheck("enrolled", "FAILED", "it was never enrolled", _enroll(robot))
    wrong = wrong_identity(facts["identity"], config, robot)
    if wrong is not None:
        return DoctorCheck("enrolled", "FAILED", *wrong)
    return DoctorCheck("enrolled", "ok", f"robot id {robot.robot_id} of fleet {config.fleet}")


def _card(config: FleetConfig, robot: RobotHost, card: str | None) -> DoctorCheck:
    name = "card"
    if config.keys is None:
        found = "insecure: whoever is on the network can fly it"
        return DoctorCheck(name, "warning", found, f"take insecure out of {config.path.name}")
    if card is None:
        return DoctorCheck(name, "FAILED", "it has no card of the fleet", _enroll(robot))
    try:
        own = card_in(card, config.keys)
    except (OSError, ConfigError) as error:
        return DoctorCheck(name, "FAILED", str(error), _enroll(robot))
    if own.robot_id != robot.robot_id:
        return DoctorCheck(name, "FAILED", f"its card is {own.name}'s", _enroll(robot))
    until = time.strftime("%Y-%m-%d", time.gmtime(own.expires_unix_s))
    return DoctorCheck(name, "ok", f"a member of fleet {own.fleet} until {until}")


def _group(robot: RobotHost, fleet: Mapping[str, Facts]) -> DoctorCheck:
    """Whether it has the key that the others have: by it robots hear each other in multicast."""
    name = "group key"
    has = {other: its["group_keys"] for other, its in fleet.items() if its["group_keys"]}
    if robot.name not in has:
        return DoctorCheck(name, "FAILED", "it has none: its program does not start", _UP)
    others = _others_than_most(has, robot.name)
    if others:
        found = f"it has another one than {', '.join(others)}: not all of them hear each other"
        return DoctorCheck(name, "FAILED", found, _UP)
    return DoctorCheck(
        name, "ok", f"it has one, and so have {len(has)} of {counted(len(fleet), 'robot')}"
    )


def _others_than_most(has: Mapping[str, Any], robot: str) -> list[str]:
    """Robots that have something else than this one; none if it has what most have.

    Where no half of the fleet agrees, nobody is right.
    """
    [(most, count)] = Counter(has.values()).most_common(1)
    if has[robot] == most and 2 * count > len(has):
        return []
    return [other for other, its in has.items() if its != has[robot]]


def _doors(config: FleetConfig, robot: RobotHost, facts: Facts) -> DoctorCheck:
    """Ways to the vehicle past the fleet's keys."""
    name = "doors"
    users = facts["factory_passwords"]
    if users:
        found = f"{', '.join(users)}: no password, or the one that every VOXL comes with"
        return DoctorCheck(name, "FAILED", found, on(robot, *(f"passwd {user}" for user in users)))
    # Members knock at the UDP port of the radio's number.
    radio = {(protocol, robot.zenoh_port) for protocol in ("tcp", "udp")}
    expected = {("tcp", robot.port or 22), *radio}
    if config.radio.transport == "multicast":
        expected.add(("udp", int(config.radio.group.rpartition(":")[2])))
    others = [
        each for each in facts["open_ports"] if (each["protocol"], each["port"]) not in expected
    ]
    mavlink = [each for each in others if _may_be_mavlink(each)]
    if mavlink:
        found = f"others on the network may reach PX4's MAVLink: {_ports(mavlink)}"
        rules = [
            f"iptables -I INPUT ! -i lo -p udp --dport {each['port']} -j DROP" for each in mavlink
        ]
        return DoctorCheck(name, "warning", found, on(robot, *rules) + " (at every boot)")
    if others:
        found = f"other programs listen to the network: {_ports(others)}"
        return DoctorCheck(name, "warning", found, "stop what the fleet does not need")
    found = "ssh and the radio alone listen to the network"
    if config.keys is None:
        return DoctorCheck(name, "ok", found)
    if not facts["drops_strangers"]:
        found += "; whoever floods the radio's port closes it: the kernel lets root alone filter"
        allow = "keep strangers out of the Wi-Fi, or let the program filter: docs/security.md"
        return DoctorCheck(name, "warning", found, allow)
    return DoctorCheck(name, "ok", f"{found}; the kernel drops strangers who flood it")


def _may_be_mavlink(port: Facts) -> bool:
    """By its number, as PX4 and ground stations have them, or by who has it."""
    its = port["program"].startswith(("px4", "voxl-mavlink", "voxl-vision", "mavlink"))
    return bool(port["protocol"] == "udp" and (its or 14_540 <= port["port"] <= 14_599))


def _ports(ports: Sequence[Facts]) -> str:
    return ", ".join(f"{each['protocol']} {each['port']} ({each['program']})" for each in ports)


def _release(config: FleetConfig, robot: RobotHost, fleet: Mapping[str, Facts]) -> DoctorCheck:
    facts = fleet[robot.name]
    name = "release"
    if facts["pending"] is not None:
        return DoctorCheck(name, "FAILED", "a switch of releases was interrupted", _UP)
    versions = facts["versions"]
    if facts["current"] is None or versions is None:
        return DoctorCheck(name, "FAILED", "there is none", _deploy(robot))
    for part in ("image", "bundle", "world"):
        has = {
            other: str(its["versions"].get(part))
            for other, its in fleet.items()
            if its["versions"] is not None
        }
        others = _others_than_most(has, robot.name)
        if others:
            found = f"its {part} is {has[robot.name][:12]}, another one than that of "
            return DoctorCheck(name, "FAILED", found + ", ".join(others), "lpac fleet deploy")
    if not is_configured(config, robot, facts):
        found = f"its configuration is not the one of {config.path.name}"
        return DoctorCheck(name, "FAILED", found, _deploy(robot))
    return DoctorCheck(name, "ok", f"{facts['current']}")


def is_configured(config: FleetConfig, robot: RobotHost, overview: Facts) -> bool:
    """Whether the robot's release has the robot.toml that fleet.toml gives now.

    Whatever a spare has does not count: its program does not run.
    """
    if config.slot_of(robot.name) is None:
        return True
    text = robot_toml(config, robot.name)
    return bool(overview["robot_toml"] == hashlib.sha256(text.encode()).hexdigest())


def _program(
    config: FleetConfig, robot: RobotHost, fleet: Mapping[str, Examination]
) -> DoctorCheck:
    facts = fleet[robot.name].facts
    service = facts["service"]
    name = "program"
    if facts["current"] is None:
        return DoctorCheck(name, "skipped", "it has no release")
    if config.slot_of(robot.name) is None:
        if service["active"] == "active":
            return DoctorCheck(
                name, "FAILED", "it is a spare, and its program runs", _deploy(robot)
            )
        return DoctorCheck(name, "ok", "spare: not started")
    start = f"lpac fleet start --robots {robot.name}"
    logs = f"lpac fleet logs --robots {robot.name}"
    if service["active"] != "active":
        return DoctorCheck(
            name, "FAILED", f"it is {service['active']} ({service['result']})", start
        )
    if not service["fresh"]:
        return DoctorCheck(name, "FAILED", "it runs, and says nothing", logs)
    if not service["enabled"]:
        return DoctorCheck(name, "warning", "it does not start after a battery swap", start)
    if service["restarts"]:
        return DoctorCheck(name, "warning", f"it was restarted {service['restarts']} times", logs)
    running = [other for other, its in fleet.items() if its.facts["service"]["fresh"]]
    if config.radio.transport == "multicast":  # Grounds alone connect, and there may be none now.
        return DoctorCheck(name, "ok", f"runs: {service['status']['state']}")
    peers, wanted = service["status"]["peers"], len(running) - 1
    if peers < wanted:
        found = f"it is connected to {peers} of the {wanted} other programs"
        return DoctorCheck(name, "warning", found, "lpac fleet radio")
    return DoctorCheck(name, "ok", f"runs: {service['status']['state']}, {peers} peers")


def _system(facts: Facts) -> DoctorCheck:
    name = "system"
    systemd = facts["systemd"]
    found = f"Linux {facts['kernel']}, systemd {systemd}, Python {facts['python']}"
    found += f", SDK {facts['sdk']}" if facts["sdk"] else ""
    if _numbers(facts["python"]) < _LEAST_PYTHON or systemd is None or systemd < _LEAST_SYSTEMD:
        fix = "the robot needs Python 3.6 and systemd 237 or newer: update its system"
        return DoctorCheck(name, "FAILED", found, fix)
    if not facts["rsync"]:
        return DoctorCheck(name, "FAILED", "rsync is missing", "install rsync on the robot")
    if _numbers(facts["kernel"]) < _LEAST_KERNEL:
        return DoctorCheck(
            name, "warning", f"{found}: older than what is known to work", "update it"
        )
    return DoctorCheck(name, "ok", found)


def _disk(facts: Facts) -> DoctorCheck:
    least = min(facts["disks"], key=lambda disk: float(disk["free_bytes"]))
    free_mb, total_mb = least["free_bytes"] / _MB, least["total_bytes"] / _MB
    found = f"{free_mb:.0f} of {total_mb:.0f} MB free at {least['path']}"
    fix = (
        "lpac fleet pull, then remove old logs on the robot (/var/lib/lpac/logs, /data/px4/log), "
        "but not the newest, from which their numbers go on"
    )
    if free_mb < _LEAST_DISK_MB:
        return DoctorCheck("disk", "FAILED", found, fix)
    if free_mb < _GOOD_DISK_MB:
        return DoctorCheck("disk", "warning", found, fix)
    return DoctorCheck("disk", "ok", found)


def _clock(facts: Facts, clock: ClockOffset) -> DoctorCheck:
    offset_s, uncertainty_s = clock
    way = "ahead of" if offset_s > 0.0 else "behind"
    found = f"{_duration(abs(offset_s))} {way} the laptop's (± {1000.0 * uncertainty_s:.0f} ms)"
    found += ", kept by a time server" if facts["synchronized"] else ""
    if abs(offset_s) > MOST_CLOCK_OFFSET_S + uncertainty_s:
        return DoctorCheck("clock", "FAILED", found, _UP)
    if abs(offset_s) > GOOD_CLOCK_OFFSET_S + uncertainty_s:
        return DoctorCheck("clock", "warning", found, _UP)
    return DoctorCheck("clock", "ok", found)


def _processor(facts: Facts) -> DoctorCheck:
    cores = f"{facts['cpus']} cores, load {facts['load']:.1f}"
    hottest_c = facts["hottest_c"]
    fix = "let it cool, with wind on it; switch it on later"
    if hottest_c is None:
        return DoctorCheck("processor", "ok", f"{cores}, temperature not known")
    found = f"{cores}, {hottest_c:.0f} °C"
    if hottest_c >= _HOT_C:
        return DoctorCheck("processor", "FAILED", f"{found}: it slows down near 90 °C", fix)
    if hottest_c >= _WARM_C:
        return DoctorCheck("processor", "warning", f"{found}: it slows down near 90 °C", fix)
    return DoctorCheck("processor", "ok", found)


def _memory(facts: Facts) -> DoctorCheck:
    memory = facts["memory"]
    if memory is None:
        return DoctorCheck("memory", "skipped", "not known")
    free_mb, total_mb = memory["available_bytes"] / _MB, memory["total_bytes"] / _MB
    found = f"{free_mb:.0f} of {total_mb:.0f} MB available"
    fix = "stop what takes it (`top` on the robot), or switch the robot off and on"
    if free_mb < _LEAST_MEMORY_MB:
        return DoctorCheck("memory", "FAILED", found, fix)
    return DoctorCheck("memory", "warning" if free_mb < _GOOD_MEMORY_MB else "ok", found, fix)


def _wifi(robot: RobotHost, links: Sequence[Facts]) -> DoctorCheck:
    name = "wifi"
    if not links:
        return DoctorCheck(
            name, "skipped", "no wireless interface: wired, or its driver does not say"
        )
    link = max(links, key=lambda each: (each["connected"] is True, each["signal_dbm"] is not None))
    words = [str(link["network"] or link["name"])]
    words += [f"{link['signal_dbm']:.0f} dBm"] if link["signal_dbm"] is not None else []
    words += [f"{link['rate_mbit_s']:g} Mbit/s"] if link["rate_mbit_s"] is not None else []
    words += ["power save on"] if link["power_save"] else []
    found = ", ".join(words)
    if link["connected"] is False:
        return DoctorCheck(
            name, "warning", f"{link['name']} is not connected", "join the fleet's Wi-Fi"
        )
    if link["power_save"]:
        fix = on(robot, f"iw dev {link['name']} set power_save off")
        return DoctorCheck(name, "warning", f"{found}: messages are late", f"{fix} (at every boot)")
    if link["signal_dbm"] is not None and link["signal_dbm"] < _WEAK_DBM:
        return DoctorCheck(
            name, "warning", f"{found}: weak", "bring the access point nearer, or higher"
        )
    return DoctorCheck(name, "ok", found)


def _radio(pings: Mapping[str, Facts] | str, answering: set[str]) -> DoctorCheck:
    name = "radio"
    if isinstance(pings, str):
        return DoctorCheck(name, "skipped", pings)
    # A robot that is off is its own fault, not that of all others.
    heard = {other: ping for other, ping in pings.items() if other in answering}
    if not heard:
        return DoctorCheck(name, "skipped", "no other robot answers")
    fix = (
        "lpac fleet radio; all must be in one network, and the access point must let its clients "
        "reach each other"
    )
    deaf = [other for other, ping in heard.items() if ping["loss"] >= 1.0]
    if deaf:
        return DoctorCheck(name, "FAILED", f"no answer from {', '.join(deaf)}", fix)
    bad = [
        f"{other}: {100.0 * ping['loss']:.0f} % lost, {ping['mean_ms']:.0f} ms"
        for other, ping in heard.items()
        if ping["loss"] > _LOST_TOO_MUCH or ping["mean_ms"] > _SLOW_MS
    ]
    if bad:
        return DoctorCheck(name, "warning", "; ".join(bad), fix)
    slowest_ms = max(ping["mean_ms"] for ping in heard.values())
    return DoctorCheck(
        name,
        "ok",
        f"{counted(len(heard), 'robot')}: slowest answer within {slowest_ms:.1f} ms",
    )


def _mavlink(robot: RobotHost, facts: Facts) -> DoctorCheck:
    name = "mavlink"
    status, heartbeat = facts["service"]["status"], facts["heartbeat"]
    runs = facts["service"]["fresh"]
    if runs and not status["autopilot"]:
        about = [c.text for c in _checks(status["failed_checks"]) if c.code in _NO_AUTOPILOT]
        return DoctorCheck(
            name, "FAILED", about[0] if about else "the autopilot is silent", _px4_fix(robot)
        )
    if facts["service"]["active"] == "active" and not runs:
        return DoctorCheck(name, "skipped", "the robot's program has the port, and says nothing")
    if not runs and heartbeat is None:
        found = f"no heartbeat of PX4 at UDP port {robot.mavlink_port}"
        return DoctorCheck(name, "FAILED", found, _px4_fix(robot))
    system_id = status["system_id"] if runs else heartbeat["system_id"]
    if system_id != robot.system_id:
        found = f"PX4 has system id {system_id}, configured is {robot.system_id}"
        return DoctorCheck(name, "FAILED", found, f"{_enroll(robot)} (it sets MAV_SYS_ID)")
    return DoctorCheck(
        name, "ok", f"PX4 answers at port {robot.mavlink_port}, system id {system_id}"
    )


def _px4_fix(robot: RobotHost) -> str:
    return on(robot, "systemctl status voxl-px4 voxl-mavlink-server voxl-vision-hub")


def _px4(robot: RobotHost, facts: Facts) -> DoctorCheck:
    name = "px4"
    parts = {part: its for part, its in facts["units"].items() if part in _PX4_PARTS}
    if not any(its["there"] for its in parts.values()) and facts["px4"] is None:
        return DoctorCheck(name, "skipped", "not a VOXL2: there is no voxl-px4")
    idle = [part for part, its in parts.items() if not its["active"]]
    if idle:
        return DoctorCheck(
            name, "FAILED", f"{', '.join(idle)} does not run",
            on(robot, f"systemctl enable --now {' '.join(idle)}"),
        )  # fmt: skip
    if facts["px4"] is None:
        return DoctorCheck(name, "skipped", "its services run; its version is not known to dpkg")
    if _numbers(facts["px4"]) < _LEAST_PX4:
        return DoctorCheck(
            name, "FAILED", f"PX4 {facts['px4']} is older than 1.14", "update the VOXL SDK"
        )
    return DoctorCheck(name, "ok", f"PX4 {facts['px4']}")


def _vision_hub(config: FleetConfig, robot: RobotHost, found: Facts | None) -> DoctorCheck:
    name = "vision-hub"
    if found is None:
        return DoctorCheck(name, "skipped", "there is no voxl-vision-hub")
    fix = f"{_enroll(robot)} (it writes /etc/modalai/voxl-vision-hub.conf)"
    if "problem" in found:
        return DoctorCheck(name, "FAILED", str(found["problem"]), fix)
    faults = []
    mode, port = found["offboard_mode"], found["localhost_udp_port_number"]
    if mode != "off":
        stands = "not set" if mode is None else f'"{mode}"'
        faults.append(f"offboard_mode is {stands}: it flies by itself in offboard mode")
    if found["en_localhost_mavlink_udp"] is not True:
        faults.append("en_localhost_mavlink_udp is not true: PX4 cannot be reached")
    if port not in (None, robot.mavlink_port):
        faults.append(f"PX4 comes to UDP port {port}, configured is {robot.mavlink_port}")
    if faults:
        return DoctorCheck(name, "FAILED", "; ".join(faults), fix)
    return DoctorCheck(name, "ok", "offboard_mode is off, MAVLink comes to this host")


def _commanders(config: FleetConfig, robot: RobotHost, facts: Facts) -> DoctorCheck:
    """Units of others that may send setpoints."""
    units = facts["units"]
    suspects = [*_COMMANDERS, *(name.removesuffix(".service") for name in config.predecessors)]
    runs = [name for name in suspects if units.get(name, {}).get("active")]
    if runs:
        return DoctorCheck(
            "commanders", "FAILED", f"{', '.join(runs)} runs: it may command PX4 too",
            on(robot, f"systemctl disable --now {' '.join(runs)}"),
        )  # fmt: skip
    waits = [name for name in suspects if units.get(name, {}).get("enabled")]
    if waits:
        return DoctorCheck(
            "commanders", "FAILED", f"{', '.join(waits)} starts at the next boot",
            on(robot, f"systemctl disable {' '.join(waits)}"),
        )  # fmt: skip
    return DoctorCheck("commanders", "ok", "no other program that is known to command PX4 runs")


def _containers(
    config: FleetConfig, robot: RobotHost, containers: Sequence[Facts] | None
) -> DoctorCheck:
    name = "containers"
    if containers is None:
        fix = on(robot, "docker ps --all")
        return DoctorCheck(name, "warning", "there is docker, and it does not answer", fix)
    bad = []
    for container in containers:
        why = _why_suspect(container, config.predecessors)
        returns = container["restarts"] in ("always", "unless-stopped")
        if why and (container["running"] or returns):
            state = "runs" if container["running"] else "comes back by itself"
            bad.append((container["name"], f"{container['name']} ({why}) {state}"))
    if bad:
        names = " ".join(each for each, _ in bad)
        found = "; ".join(text for _, text in bad) + ": it could command the vehicle"
        return DoctorCheck(
            name,
            "FAILED",
            found,
            on(robot, f"docker update --restart=no {names}", f"docker stop {names}"),
        )
    running = sum(bool(container["running"]) for container in containers)
    return DoctorCheck(name, "ok", f"{running} run, none that could command the vehicle")


def _why_suspect(container: Facts, predecessors: Sequence[str]) -> str:
    if container["name"] in predecessors:
        return "a predecessor"
    if re.search(r"ros|lpac|px4|mav", container["image"], re.IGNORECASE):
        return f"image {container['image']}"
    if container["host_network"]:
        return "host networking"
    return "access to devices" if container["devices"] else ""


def _vehicle(robot: RobotHost, facts: Facts, vehicle: Facts | str) -> Iterator[DoctorCheck]:
    """PX4's failsafe parameters, and what else keeps the vehicle from taking off."""
    service = facts["service"]
    if service["fresh"]:
        checks = _checks(service["status"]["failed_checks"])
        cut = service["status"]["failed_checks_more"] > 0
    elif isinstance(vehicle, str):
        yield DoctorCheck("failsafe", "skipped", vehicle)
        yield DoctorCheck("preflight", "skipped", vehicle)
        return
    else:
        checks, cut = _checks(vehicle["failed"]), False
    yield _failsafe(robot, checks, cut)
    yield _preflight([c for c in checks if c.code not in (*_GROUND, *_SAID_ELSEWHERE)], cut)


def _checks(told: Sequence[Facts]) -> list[FailedCheck]:
    """As the robot's program tells them; what this one has no name for is some other check."""
    return [
        FailedCheck(CheckCode(each["code"]), each["text"], bool(each["settles_by_itself"]))
        for each in told
    ]


def _failsafe(robot: RobotHost, checks: Sequence[FailedCheck], cut: bool) -> DoctorCheck:
    name = "failsafe"
    not_read = (*_NO_AUTOPILOT, CheckCode.CHECKS_RUNNING, CheckCode.FAILSAFE_NOT_READ)
    if any(check.code in not_read for check in checks):
        return DoctorCheck(name, "warning", "PX4's parameters were not read", "try again")
    wrong = [check for check in checks if check.code is CheckCode.FAILSAFE_WRONG]
    if wrong:
        fix = f"{_enroll(robot)} (it sets them, and restarts PX4 if need be)"
        return DoctorCheck(name, "FAILED", texts(wrong), fix)
    if cut:
        found = "not among the first failed checks: there may be more"
        return DoctorCheck(name, "warning", found, "mend what `preflight` names, then try again")
    return DoctorCheck(name, "ok", "PX4's parameters are as they must be")


def _preflight(checks: Sequence[FailedCheck], cut: bool) -> DoctorCheck:
    name = "preflight"
    if not checks:
        return DoctorCheck(name, "ok", "nothing but the ground's commands is missing")
    # Before the vehicle stands under open sky, this is how it is; PX4 does not arm then.
    settling = {check.code for check in checks if check.settles_by_itself}
    may_arm_then = bool(settling - {CheckCode.CHECKS_RUNNING})
    waits = all(
        check.code in settling or (may_arm_then and check.code is CheckCode.NOT_ARMABLE)
        for check in checks
    )
    found = texts(checks) + ("; perhaps more" if cut else "")
    if waits:
        return DoctorCheck(name, "warning", found, "wait under open sky, then try again")
    return DoctorCheck(name, "FAILED", found, "mend what each line says")


def _numbers(version: str) -> tuple[int, int]:
    match = re.search(r"(\d+)\.(\d+)", version)
    return (int(match[1]), int(match[2])) if match else (0, 0)


def _duration(seconds: float) -> str:
    """In the unit that a person would take."""
    if seconds < 1.0:
        return f"{1000.0 * seconds:.0f} ms"
    if seconds < 120.0:
        return f"{seconds:.1f} s"
    if seconds < 172800.0:
        return f"{seconds / 3600.0:.1f} h"
    return f"{seconds / 86400.0:.0f} days"
