"""Checks of a robot before a flight: looked at over SSH, judged here, each fault with its fix."""

import asyncio
import hashlib
import json
import re
import shlex
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from edge.core.counted import counted
from edge.drivers.identity_folder import read_members
from edge.identity.members import Role, parse_members
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


@dataclass(frozen=True, slots=True)
class _Judged:
    """A robot, what was found on it, and the facts of all that answered, its own too."""

    config: FleetConfig
    robot: RobotHost
    found: Examination
    fleet: Mapping[str, Facts]

    @property
    def facts(self) -> Facts:
        return self.found.facts

    @property
    def service(self) -> Facts:
        its: Facts = self.facts["service"]
        return its

    @property
    def enroll(self) -> str:
        return f"lpac fleet enroll {self.robot.name} {self.robot.host}"

    def command(self, name: str) -> str:
        return f"lpac fleet {name} --robots {self.robot.name}"

    def on(self, *commands: str) -> str:
        return on(self.robot, *commands)


# What a check comes to: verdict, what was found, and the fix.
Finding = tuple[Verdict, str, str]


def ok(found: str) -> Finding:
    """Finding of a check that is well."""
    return "ok", found, ""


def skipped(found: str) -> Finding:
    """Finding of a check of something that is not there, or cannot be looked at."""
    return "skipped", found, ""


def warning(found: str, fix: str) -> Finding:
    """Finding that does not keep a robot from flying."""
    return "warning", found, fix


def failed(found: str, fix: str) -> Finding:
    """Finding that keeps a robot from flying."""
    return "FAILED", found, fix


def _graded(found: str, fix: str, *, bad: bool, poor: bool) -> Finding:
    return failed(found, fix) if bad else warning(found, fix) if poor else ok(found)


def judge(
    config: FleetConfig, robot: RobotHost, fleet: Mapping[str, Examination]
) -> Iterator[DoctorCheck]:
    """The checks of a robot; `fleet` has the examinations of all that answered, its own too."""
    of_all = {name: other.facts for name, other in fleet.items()}
    judged = _Judged(config, robot, fleet[robot.name], of_all)
    for name, check in _CHECKS.items():
        finding = check(judged)
        if finding is not None:
            yield DoctorCheck(name, *finding)


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


def _identity(its: _Judged) -> Finding:
    if its.facts["identity"] is None:
        return failed("it was never enrolled", its.enroll)
    wrong = wrong_identity(its.facts["identity"], its.config, its.robot)
    if wrong is not None:
        return failed(*wrong)
    return ok(f"robot id {its.robot.robot_id} of fleet {its.config.fleet}")


def _member(its: _Judged) -> Finding:
    if its.config.keys is None:
        found = "insecure: whoever is on the network can fly it"
        return warning(found, f"take insecure out of {its.config.path.name}")
    if its.facts["members"] is None:
        return failed("it has no list of the fleet's members", its.enroll)
    try:
        here, there = read_members(its.config.keys), parse_members(its.facts["members"])
    except (OSError, ValueError) as error:
        return failed(str(error), its.enroll)
    if (Role.ROBOT, str(its.robot.robot_id)) not in {member.place for member in here.members}:
        return failed("it is not in the list of members", its.enroll)
    if there != here:
        return failed(f"its list of members is {there.number}, and here is {here.number}", _UP)
    count = counted(len(here.members), "member")
    return ok(f"a member of fleet {here.fleet}: list {here.number}, {count}")


def _group(its: _Judged) -> Finding | None:
    """Whether it has the key that the others have: by it robots hear each other in multicast."""
    if its.config.radio.transport != "multicast" or its.config.keys is None:
        return None
    has = {other: of["group_keys"] for other, of in its.fleet.items() if of["group_keys"]}
    if its.robot.name not in has:
        return failed("it has none: its program does not start", _UP)
    if others := _others_than_most(has, its.robot.name):
        found = f"it has another one than {', '.join(others)}: not all of them hear each other"
        return failed(found, _UP)
    return ok(f"it has one, and so have {len(has)} of {counted(len(its.fleet), 'robot')}")


def _others_than_most(has: Mapping[str, Any], robot: str) -> list[str]:
    """Robots that have something else than this one; none if it has what most have.

    Where no half of the fleet agrees, nobody is right.
    """
    [(most, count)] = Counter(has.values()).most_common(1)
    if has[robot] == most and 2 * count > len(has):
        return []
    return [other for other, its in has.items() if its != has[robot]]


def _release(its: _Judged) -> Finding:
    if its.facts["pending"] is not None:
        return failed("a switch of releases was interrupted", _UP)
    if its.facts["current"] is None or its.facts["versions"] is None:
        return failed("there is none", its.command("deploy"))
    versions = {other: of["versions"] for other, of in its.fleet.items() if of["versions"]}
    for part in ("image", "bundle", "world"):
        has = {other: str(of.get(part)) for other, of in versions.items()}
        if others := _others_than_most(has, its.robot.name):
            found = f"its {part} is {has[its.robot.name][:12]}, another one than that of "
            return failed(found + ", ".join(others), "lpac fleet deploy")
    if not is_configured(its.config, its.robot, its.facts):
        found = f"its configuration is not the one of {its.config.path.name}"
        return failed(found, its.command("deploy"))
    return ok(its.facts["current"])


def is_configured(config: FleetConfig, robot: RobotHost, overview: Facts) -> bool:
    """Whether the robot's release has the robot.toml that fleet.toml gives now.

    Whatever a spare has does not count: its program does not run.
    """
    if config.slot_of(robot.name) is None:
        return True
    text = robot_toml(config, robot.name)
    return bool(overview["robot_toml"] == hashlib.sha256(text.encode()).hexdigest())


def _program(its: _Judged) -> Finding:
    service = its.service
    if its.facts["current"] is None:
        return skipped("it has no release")
    if its.config.slot_of(its.robot.name) is None:
        if service["active"] == "active":
            return failed("it is a spare, and its program runs", its.command("deploy"))
        return ok("spare: not started")
    start, logs = its.command("start"), its.command("logs")
    if service["active"] != "active":
        return failed(f"it is {service['active']} ({service['result']})", start)
    if not service["fresh"]:
        return failed("it runs, and says nothing", logs)
    if not service["enabled"]:
        return warning("it does not start after a battery swap", start)
    if service["restarts"]:
        return warning(f"it was restarted {service['restarts']} times", logs)
    state, peers = service["status"]["state"], service["status"]["peers"]
    if its.config.radio.transport == "multicast":  # Grounds alone connect: there may be none now.
        return ok(f"runs: {state}")
    wanted = sum(bool(of["service"]["fresh"]) for of in its.fleet.values()) - 1
    if peers < wanted:
        found = f"it is connected to {peers} of the {wanted} other programs"
        return warning(found, "lpac fleet radio")
    return ok(f"runs: {state}, {peers} peers")


def _system(its: _Judged) -> Finding:
    facts, systemd = its.facts, its.facts["systemd"]
    found = f"Linux {facts['kernel']}, systemd {systemd}, Python {facts['python']}"
    found += f", SDK {facts['sdk']}" if facts["sdk"] else ""
    if _numbers(facts["python"]) < _LEAST_PYTHON or systemd is None or systemd < _LEAST_SYSTEMD:
        fix = "the robot needs Python 3.6 and systemd 237 or newer: update its system"
        return failed(found, fix)
    if not facts["rsync"]:
        return failed("rsync is missing", "install rsync on the robot")
    if _numbers(facts["kernel"]) < _LEAST_KERNEL:
        return warning(f"{found}: older than what is known to work", "update it")
    return ok(found)


def _disk(its: _Judged) -> Finding:
    if not its.facts["disks"]:
        return skipped("df says nothing")
    least = min(its.facts["disks"], key=lambda disk: float(disk["free_bytes"]))
    free_mb, total_mb = least["free_bytes"] / _MB, least["total_bytes"] / _MB
    fix = (
        "lpac fleet pull, then remove old logs on the robot (/var/lib/lpac/logs, /data/px4/log), "
        "but not the newest, from which their numbers go on"
    )
    return _graded(
        f"{free_mb:.0f} of {total_mb:.0f} MB free at {least['path']}", fix,
        bad=free_mb < _LEAST_DISK_MB, poor=free_mb < _GOOD_DISK_MB,
    )  # fmt: skip


def _clock(its: _Judged) -> Finding:
    offset_s, uncertainty_s = its.found.clock
    way = "ahead of" if offset_s > 0.0 else "behind"
    found = f"{_duration(abs(offset_s))} {way} the laptop's (± {1000.0 * uncertainty_s:.0f} ms)"
    found += ", kept by a time server" if its.facts["synchronized"] else ""
    surely_s = abs(offset_s) - uncertainty_s
    return _graded(
        found, _UP, bad=surely_s > MOST_CLOCK_OFFSET_S, poor=surely_s > GOOD_CLOCK_OFFSET_S
    )


def _processor(its: _Judged) -> Finding:
    cores = f"{its.facts['cpus']} cores, load {its.facts['load']:.1f}"
    hottest_c = its.facts["hottest_c"]
    if hottest_c is None:
        return ok(f"{cores}, temperature not known")
    slows = ": it slows down near 90 °C" if hottest_c >= _WARM_C else ""
    fix = "let it cool, with wind on it; switch it on later"
    found = f"{cores}, {hottest_c:.0f} °C{slows}"
    return _graded(found, fix, bad=hottest_c >= _HOT_C, poor=hottest_c >= _WARM_C)


def _memory(its: _Judged) -> Finding:
    memory = its.facts["memory"]
    if memory is None:
        return skipped("not known")
    free_mb, total_mb = memory["available_bytes"] / _MB, memory["total_bytes"] / _MB
    fix = "stop what takes it (`top` on the robot), or switch the robot off and on"
    found = f"{free_mb:.0f} of {total_mb:.0f} MB available"
    return _graded(found, fix, bad=free_mb < _LEAST_MEMORY_MB, poor=free_mb < _GOOD_MEMORY_MB)


def _wifi(its: _Judged) -> Finding:
    links = its.facts["wifi"]
    if not links:
        return skipped("no wireless interface: wired, or its driver does not say")
    link = max(links, key=lambda each: (each["connected"] is True, each["signal_dbm"] is not None))
    name, signal_dbm, rate_mbit_s = link["name"], link["signal_dbm"], link["rate_mbit_s"]
    words = [str(link["network"] or name)]
    words += [f"{signal_dbm:.0f} dBm"] if signal_dbm is not None else []
    words += [f"{rate_mbit_s:g} Mbit/s"] if rate_mbit_s is not None else []
    words += ["power save on"] if link["power_save"] else []
    found = ", ".join(words)
    if link["connected"] is False:
        return warning(f"{name} is not connected", "join the fleet's Wi-Fi")
    if link["power_save"]:
        fix = its.on(f"iw dev {name} set power_save off")
        return warning(f"{found}: messages are late", f"{fix} (at every boot)")
    if signal_dbm is not None and signal_dbm < _WEAK_DBM:
        return warning(f"{found}: weak", "bring the access point nearer, or higher")
    return ok(found)


def _radio(its: _Judged) -> Finding:
    pings = its.found.pings
    if isinstance(pings, str):
        return skipped(pings)
    # A robot that is off is its own fault, not that of all others.
    heard = {other: ping for other, ping in pings.items() if other in its.fleet}
    if not heard:
        return skipped("no other robot answers")
    fix = (
        "lpac fleet radio; all must be in one network, and the access point must let its clients "
        "reach each other"
    )
    if deaf := [other for other, ping in heard.items() if ping["loss"] >= 1.0]:
        return failed(f"no answer from {', '.join(deaf)}", fix)
    bad = [
        f"{other}: {100.0 * ping['loss']:.0f} % lost, {ping['mean_ms']:.0f} ms"
        for other, ping in heard.items()
        if ping["loss"] > _LOST_TOO_MUCH or ping["mean_ms"] > _SLOW_MS
    ]
    if bad:
        return warning("; ".join(bad), fix)
    slowest_ms = max(ping["mean_ms"] for ping in heard.values())
    return ok(f"{counted(len(heard), 'robot')}: slowest answer within {slowest_ms:.1f} ms")


def _mavlink(its: _Judged) -> Finding:
    robot, status, beat = its.robot, its.service["status"], its.facts["heartbeat"]
    runs, port = its.service["fresh"], robot.mavlink_port
    fix = its.on("systemctl status voxl-px4 voxl-mavlink-server voxl-vision-hub")
    if runs and not status["autopilot"]:
        about = [c.text for c in _told(status["failed_checks"]) if c.code in _NO_AUTOPILOT]
        return failed(about[0] if about else "the autopilot is silent", fix)
    if its.service["active"] == "active" and not runs:
        return skipped("the robot's program has the port, and says nothing")
    if not runs and beat is None:
        return failed(f"no heartbeat of PX4 at UDP port {port}", fix)
    system_id = status["system_id"] if runs else beat["system_id"]
    if system_id != robot.system_id:
        found = f"PX4 has system id {system_id}, configured is {robot.system_id}"
        return failed(found, f"{its.enroll} (it sets MAV_SYS_ID)")
    return ok(f"PX4 answers at port {port}, system id {system_id}")


def _px4(its: _Judged) -> Finding:
    parts = {part: of for part, of in its.facts["units"].items() if part in _PX4_PARTS}
    version = its.facts["px4"]
    if not any(of["there"] for of in parts.values()) and version is None:
        return skipped("not a VOXL2: there is no voxl-px4")
    if idle := [part for part, of in parts.items() if not of["active"]]:
        fix = its.on(f"systemctl enable --now {' '.join(idle)}")
        return failed(f"{', '.join(idle)} does not run", fix)
    if version is None:
        return skipped("its services run; its version is not known to dpkg")
    if _numbers(version) < _LEAST_PX4:
        return failed(f"PX4 {version} is older than 1.14", "update the VOXL SDK")
    return ok(f"PX4 {version}")


def _vision_hub(its: _Judged) -> Finding:
    found = its.facts["vision_hub"]
    if found is None:
        return skipped("there is no voxl-vision-hub")
    fix = f"{its.enroll} (it writes /etc/modalai/voxl-vision-hub.conf)"
    if "problem" in found:
        return failed(str(found["problem"]), fix)
    faults = []
    mode, port = found["offboard_mode"], found["localhost_udp_port_number"]
    if mode != "off":
        stands = "not set" if mode is None else f'"{mode}"'
        faults.append(f"offboard_mode is {stands}: it flies by itself in offboard mode")
    if found["en_localhost_mavlink_udp"] is not True:
        faults.append("en_localhost_mavlink_udp is not true: PX4 cannot be reached")
    if port not in (None, its.robot.mavlink_port):
        faults.append(f"PX4 comes to UDP port {port}, configured is {its.robot.mavlink_port}")
    if faults:
        return failed("; ".join(faults), fix)
    return ok("offboard_mode is off, MAVLink comes to this host")


def _doors(its: _Judged) -> Finding:
    """Ways to the vehicle past the fleet's keys."""
    robot, radio = its.robot, its.config.radio
    if users := its.facts["factory_passwords"]:
        found = f"{', '.join(users)}: no password, or the one that every VOXL comes with"
        return failed(found, its.on(*(f"passwd {user}" for user in users)))
    # Members knock at the UDP port of the radio's number.
    expected = {("tcp", robot.port or 22), ("tcp", robot.zenoh_port), ("udp", robot.zenoh_port)}
    if radio.transport == "multicast":
        expected.add(("udp", int(radio.group.rpartition(":")[2])))
    ports = its.facts["open_ports"]
    others = [each for each in ports if (each["protocol"], each["port"]) not in expected]
    if mavlink := [each for each in others if _may_be_mavlink(each)]:
        found = f"others on the network may reach PX4's MAVLink: {_ports(mavlink)}"
        drop = "iptables -I INPUT ! -i lo -p udp --dport {} -j DROP"
        fix = its.on(*(drop.format(each["port"]) for each in mavlink))
        return warning(found, f"{fix} (at every boot)")
    if others:
        found = f"other programs listen to the network: {_ports(others)}"
        return warning(found, "stop what the fleet does not need")
    found = "ssh and the radio alone listen to the network"
    if its.config.keys is None:
        return ok(found)
    if not its.facts["drops_strangers"]:
        found += "; whoever floods the radio's port closes it: the kernel lets root alone filter"
        allow = "keep strangers out of the Wi-Fi, or let the program filter: docs/security.md"
        return warning(found, allow)
    return ok(f"{found}; the kernel drops strangers who flood it")


def _may_be_mavlink(port: Facts) -> bool:
    """By its number, as PX4 and ground stations have them, or by who has it."""
    its = port["program"].startswith(("px4", "voxl-mavlink", "voxl-vision", "mavlink"))
    return bool(port["protocol"] == "udp" and (its or 14_540 <= port["port"] <= 14_599))


def _ports(ports: Sequence[Facts]) -> str:
    return ", ".join(f"{each['protocol']} {each['port']} ({each['program']})" for each in ports)


def _commanders(its: _Judged) -> Finding:
    """Units of others that may send setpoints."""
    units = its.facts["units"]
    suspects = [*_COMMANDERS, *(name.removesuffix(".service") for name in its.config.predecessors)]
    for state, option, found in (
        ("active", " --now", "runs: it may command PX4 too"),
        ("enabled", "", "starts at the next boot"),
    ):
        if bad := [name for name in suspects if units.get(name, {}).get(state)]:
            fix = its.on(f"systemctl disable{option} {' '.join(bad)}")
            return failed(f"{', '.join(bad)} {found}", fix)
    return ok("no other program that is known to command PX4 runs")


def _containers(its: _Judged) -> Finding:
    containers = its.facts["containers"]
    if containers is None:
        return warning("there is docker, and it does not answer", its.on("docker ps --all"))
    bad = {}
    for container in containers:
        why = _why_suspect(container, its.config.predecessors)
        returns = container["restarts"] in ("always", "unless-stopped")
        if why and (container["running"] or returns):
            state = "runs" if container["running"] else "comes back by itself"
            bad[container["name"]] = f"{container['name']} ({why}) {state}"
    if bad:
        names = " ".join(bad)
        fix = its.on(f"docker update --restart=no {names}", f"docker stop {names}")
        return failed("; ".join(bad.values()) + ": it could command the vehicle", fix)
    running = sum(bool(container["running"]) for container in containers)
    return ok(f"{running} run, none that could command the vehicle")


def _why_suspect(container: Facts, predecessors: Sequence[str]) -> str:
    if container["name"] in predecessors:
        return "a predecessor"
    if re.search(r"ros|lpac|px4|mav", container["image"], re.IGNORECASE):
        return f"image {container['image']}"
    if container["host_network"]:
        return "host networking"
    return "access to devices" if container["devices"] else ""


def _failed_checks(its: _Judged) -> tuple[list[FailedCheck], bool] | str:
    """Failed checks of the vehicle, and whether these are all; or why they are not known."""
    if its.service["fresh"]:
        status = its.service["status"]
        return _told(status["failed_checks"]), status["failed_checks_more"] == 0
    vehicle = its.found.vehicle
    return vehicle if isinstance(vehicle, str) else (_told(vehicle["failed"]), True)


def _told(told: Sequence[Facts]) -> list[FailedCheck]:
    """As the robot's program tells them; what this one has no name for is some other check."""
    return [
        FailedCheck(CheckCode(each["code"]), each["text"], bool(each["settles_by_itself"]))
        for each in told
    ]


def _failsafe(its: _Judged) -> Finding:
    """PX4's failsafe parameters."""
    known = _failed_checks(its)
    if isinstance(known, str):
        return skipped(known)
    checks, is_all = known
    not_read = (*_NO_AUTOPILOT, CheckCode.CHECKS_RUNNING, CheckCode.FAILSAFE_NOT_READ)
    if any(check.code in not_read for check in checks):
        return warning("PX4's parameters were not read", "try again")
    if wrong := [check for check in checks if check.code is CheckCode.FAILSAFE_WRONG]:
        return failed(texts(wrong), f"{its.enroll} (it sets them, and restarts PX4 if need be)")
    if not is_all:
        found = "not among the first failed checks: there may be more"
        return warning(found, "mend what `preflight` names, then try again")
    return ok("PX4's parameters are as they must be")


def _preflight(its: _Judged) -> Finding:
    """Other reasons that keep the vehicle from taking off."""
    known = _failed_checks(its)
    if isinstance(known, str):
        return skipped(known)
    checks = [check for check in known[0] if check.code not in (*_GROUND, *_SAID_ELSEWHERE)]
    if not checks:
        return ok("nothing but the ground's commands is missing")
    # Before the vehicle stands under open sky, this is how it is; PX4 does not arm then.
    settling = {check.code for check in checks if check.settles_by_itself}
    may_arm_then = bool(settling - {CheckCode.CHECKS_RUNNING})
    waits = all(
        check.code in settling or (may_arm_then and check.code is CheckCode.NOT_ARMABLE)
        for check in checks
    )
    found = texts(checks) + ("" if known[1] else "; perhaps more")
    if waits:
        return warning(found, "wait under open sky, then try again")
    return failed(found, "mend what each line says")


_CHECKS: dict[str, Callable[[_Judged], Finding | None]] = {
    "enrolled": _identity,
    "member": _member,
    "group key": _group,
    "release": _release,
    "program": _program,
    "system": _system,
    "disk": _disk,
    "clock": _clock,
    "processor": _processor,
    "memory": _memory,
    "wifi": _wifi,
    "radio": _radio,
    "mavlink": _mavlink,
    "px4": _px4,
    "vision-hub": _vision_hub,
    "doors": _doors,
    "commanders": _commanders,
    "containers": _containers,
    "failsafe": _failsafe,
    "preflight": _preflight,
}


def _numbers(version: str) -> tuple[int, int]:
    match = re.search(r"(\d+)\.(\d+)", version)
    return (int(match[1]), int(match[2])) if match else (0, 0)


def _duration(seconds: float) -> str:
    """In the unit that a person would take."""
    for limit_s, unit_s, text in ((1.0, 1e-3, "{:.0f} ms"), (120.0, 1.0, "{:.1f} s"),
                                  (172800.0, 3600.0, "{:.1f} h")):  # fmt: skip
        if seconds < limit_s:
            return text.format(seconds / unit_s)
    return f"{seconds / 86400.0:.0f} days"
