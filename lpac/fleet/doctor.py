"""Checks of the robots before a flight: facts read over SSH, findings with a fix for each fault."""

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
from lpac.fleet.program import receive_heartbeat
from lpac.fleet.session import RemoteError, Session, connect, ssh_options
from lpac.fleet.settings import FleetConfig, RobotHost
from lpac.fleet.writer import robot_toml

Verdict = Literal["ok", "skipped", "warning", "FAILED"]
Facts = Mapping[str, Any]

# Beyond this offset, robots misjudge the age of each other's messages.
MAX_CLOCK_OFFSET_S = 0.5
# Measurable over a good radio; `up` corrects beyond it.
GOOD_CLOCK_OFFSET_S = 0.05
_EXCHANGES = 5
_PINGS = 10
# Time for the program's first checks after its start, and the failed checks that show that these
# are not done yet.
_CHECKS_WAIT_S = 8.0
_NOT_SETTLED = {CheckCode.CHECKS_RUNNING.value, CheckCode.FAILSAFE_NOT_READ.value}
# Timeout of `lpac robot check`. It always runs that long, since the ground stays missing.
_CHECK_S = 10.0
_MAX_PING_LOSS, _SLOW_MS = 0.1, 50.0

_MB = 1e6
_MIN_DISK_MB, _GOOD_DISK_MB = 200.0, 1000.0
_MIN_MEMORY_MB, _GOOD_MEMORY_MB = 200.0, 400.0
# A VOXL2 throttles near 90 °C.
_WARM_C, _HOT_C = 75.0, 88.0
_WEAK_DBM = -75.0
_MIN_PYTHON, _MIN_SYSTEMD, _MIN_KERNEL, _MIN_PX4 = (3, 6), 237, (4, 19), (1, 14)

# Failed checks that only mean that no ground commands the robot yet.
_GROUND = (
    CheckCode.GROUND_NOT_HEARD,
    CheckCode.GROUND_SILENT,
    CheckCode.ORIGIN_NOT_SET,
    CheckCode.PLACE_NOT_KNOWN,
    CheckCode.FENCE_NOT_UPLOADED,
)
_PX4_PARTS = ("voxl-px4", "voxl-mavlink-server", "voxl-vision-hub")
# Other programs that may command the vehicle: ModalAI's bridges to DDS and ROS.
_COMMANDERS = ("voxl-microdds-agent", "voxl-mpa-to-ros", "voxl-mpa-to-ros2")
_NO_AUTOPILOT = (
    CheckCode.AUTOPILOT_NOT_CONNECTED,
    CheckCode.OTHER_AUTOPILOT,
    CheckCode.SYSTEM_ID_WRONG,
)
_UP = "lpac fleet up"
# Failed checks that other checks of the doctor report.
_REPORTED_ELSEWHERE = (
    *_NO_AUTOPILOT,
    CheckCode.FAILSAFE_NOT_READ,
    CheckCode.FAILSAFE_WRONG,
    CheckCode.TIME_NOT_KNOWN,
)


class DoctorCheck(NamedTuple):
    """Result of a check: what was found, and the fix if something is wrong.

    "skipped": it could not be checked, or does not apply; `found` says why.
    """

    name: str
    verdict: Verdict
    found: str
    fix: str = ""


class ClockOffset(NamedTuple):
    """The robot's wall clock minus the laptop's, s, and the error bound of that."""

    offset_s: float
    uncertainty_s: float


class Examination(NamedTuple):
    """Facts about one robot that answered.

    `vehicle` is the output of `lpac robot check`, or why it was not run; `pings` are by robot name,
    or why there are none.
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
        """Checks that keep it from flying."""
        return [check for check in self.checks if check.verdict == "FAILED"]

    def reasons(self) -> list[str]:
        """Reasons against flying, in words; [] is a go."""
        return [f"{check.name}: {check.found}" for check in self.failed()]


def diagnose(config: FleetConfig, outcomes: Sequence[Outcome[Examination]]) -> list[Diagnosis]:
    """Check all robots; one that did not answer has a single failed check, "reach"."""
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
    """Read the facts of one robot. Raises FleetError if it does not answer.

    Changes nothing, unless `parameters = "set"` (see `_check_vehicle`).
    """
    report("connect", None)
    async with connect(config, robot, lambda step: report(step, None)) as session:
        clock = await measure_clock(session, unix_time_s)
        report("read facts", None)
        names = [*_PX4_PARTS, *_COMMANDERS, *config.predecessors]
        facts = await overview(session, config)
        facts |= await probes.facts(session, config.directory, names)
        facts["service"] = await _settled(session, facts["service"])
        facts["heartbeat"] = None
        if facts["service"]["active"] != "active":
            report("await PX4", None)
            facts["heartbeat"] = await receive_heartbeat(session, robot)
        report("ping", None)
        pings = await _ping_others(session, others)
        vehicle = await _check_vehicle(config, robot, session, facts, report)
        return Examination(facts, clock, vehicle, pings)


async def measure_clock(
    session: Session, unix_time_s: Callable[[], float] = time.time
) -> ClockOffset:
    """Compare the wall clocks by the quickest of several exchanges. Raises FleetError."""
    best: ClockOffset | None = None
    for _ in range(_EXCHANGES):
        sent_s = unix_time_s()
        robot_s = float(await session.check_output("date", "+%s.%N"))
        half_s = (unix_time_s() - sent_s) / 2.0
        if best is None or half_s < best.uncertainty_s:
            best = ClockOffset(robot_s - sent_s - half_s, half_s)
    assert best is not None
    return best


async def _settled(session: Session, state: dict[str, Any]) -> dict[str, Any]:
    """State of the unit, once its program, if it runs, has done its first checks."""
    until_s = time.monotonic() + _CHECKS_WAIT_S
    while state["fresh"] and time.monotonic() < until_s:
        codes = {check["code"] for check in state["status"]["failed_checks"]}
        if not codes & _NOT_SETTLED:
            break
        await asyncio.sleep(0.25)
        state = await session.call("service")
    return state


async def _ping_others(session: Session, others: Sequence[RobotHost]) -> Mapping[str, Facts] | str:
    """Ping the other robots from this one; or why that fails. Raises UnreachableError."""
    if not others:
        return {}
    try:
        return await probes.ping(session, {other.name: other.address for other in others}, _PINGS)
    except RemoteError as error:
        return str(error)


async def _check_vehicle(
    config: FleetConfig, robot: RobotHost, session: Session, facts: Facts, report: Report
) -> Facts | str:
    """Run the release's own check of the vehicle; or why it cannot be run.

    With `parameters = "set"` in robot.toml it sets PX4's parameters, as the program would. The
    robot's lock is taken, so that nobody starts the program meanwhile.
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
            # The identity, which only the program's user can read.
            state="" if config.keys is None else "/var/lib/private",
        )  # fmt: skip
        return dict(json.loads(done.out))
    except RemoteError as error:
        return str(error)
    except ValueError:
        return done.reason


@dataclass(frozen=True, slots=True)
class _Context:
    """Input of a check: the robot, its examination, and all facts by robot name."""

    config: FleetConfig
    robot: RobotHost
    found: Examination
    fleet: Mapping[str, Facts]

    @property
    def facts(self) -> Facts:
        return self.found.facts

    @property
    def service(self) -> Facts:
        service: Facts = self.facts["service"]
        return service

    @property
    def enroll(self) -> str:
        return f"lpac fleet enroll {self.robot.name} {self.robot.host}"

    def command(self, name: str) -> str:
        return f"lpac fleet {name} --robots {self.robot.name}"

    def on(self, *commands: str) -> str:
        return on(self.robot, *commands)


# Result of a check: verdict, what was found, and the fix.
Finding = tuple[Verdict, str, str]


def ok(found: str) -> Finding:
    """Passed check."""
    return "ok", found, ""


def skipped(found: str) -> Finding:
    """Check that does not apply or cannot be done."""
    return "skipped", found, ""


def warning(found: str, fix: str) -> Finding:
    """Fault that does not keep a robot from flying."""
    return "warning", found, fix


def failed(found: str, fix: str) -> Finding:
    """Fault that keeps a robot from flying."""
    return "FAILED", found, fix


def _graded(found: str, fix: str, *, bad: bool, poor: bool) -> Finding:
    return failed(found, fix) if bad else warning(found, fix) if poor else ok(found)


def judge(
    config: FleetConfig, robot: RobotHost, fleet: Mapping[str, Examination]
) -> Iterator[DoctorCheck]:
    """Check a robot; `fleet` has the examinations of all robots that answered, by name."""
    facts = {name: other.facts for name, other in fleet.items()}
    context = _Context(config, robot, fleet[robot.name], facts)
    for name, check in _CHECKS.items():
        finding = check(context)
        if finding is not None:
            yield DoctorCheck(name, *finding)


def on(robot: RobotHost, *commands: str) -> str:
    """`lpac fleet exec` command line that runs `commands` on the robot as root, joined by &&."""
    sudo = "" if robot.user == "root" else "sudo "
    text = " && ".join(sudo + command for command in commands)
    return f"lpac fleet exec --robots {robot.name} {shlex.quote(text)}"


def _reach_fix(config: FleetConfig, robot: RobotHost) -> str:
    ssh = shlex.join(["ssh", *ssh_options(config, robot), f"{robot.user}@{robot.host}"])
    return f"switch {robot.name} on, check its Wi-Fi, then try: {ssh}"


def _identity(ctx: _Context) -> Finding:
    if ctx.facts["identity"] is None:
        return failed("it is not enrolled", ctx.enroll)
    wrong = wrong_identity(ctx.facts["identity"], ctx.config, ctx.robot)
    if wrong is not None:
        return failed(*wrong)
    return ok(f"robot id {ctx.robot.robot_id} of fleet {ctx.config.fleet}")


def _member(ctx: _Context) -> Finding:
    if ctx.config.keys is None:
        found = "insecure: anyone on the network can fly it"
        return warning(found, f"remove insecure from {ctx.config.path.name}")
    if ctx.facts["members"] is None:
        return failed("it has no list of the fleet's members", ctx.enroll)
    try:
        here, there = read_members(ctx.config.keys), parse_members(ctx.facts["members"])
    except (OSError, ValueError) as error:
        return failed(str(error), ctx.enroll)
    if (Role.ROBOT, str(ctx.robot.robot_id)) not in {member.place for member in here.members}:
        return failed("it is not in the list of members", ctx.enroll)
    if there != here:
        found = f"its list of members is number {there.number}, this computer's is {here.number}"
        return failed(found, _UP)
    count = counted(len(here.members), "member")
    return ok(f"a member of fleet {here.fleet}: list {here.number}, {count}")


def _group(ctx: _Context) -> Finding | None:
    """Multicast: whether it has the others' group key, without which they cannot communicate."""
    if ctx.config.radio.transport != "multicast" or ctx.config.keys is None:
        return None
    has = {other: of["group_keys"] for other, of in ctx.fleet.items() if of["group_keys"]}
    if ctx.robot.name not in has:
        return failed("it has no group key: its program does not start", _UP)
    if others := _disagreeing(has, ctx.robot.name):
        found = f"its group key differs from that of {', '.join(others)}: they cannot communicate"
        return failed(found, _UP)
    return ok(f"the same on {len(has)} of {counted(len(ctx.fleet), 'robot')}")


def _disagreeing(has: Mapping[str, Any], robot: str) -> list[str]:
    """Robots whose value differs from this one's; [] if this one agrees with a majority."""
    [(most, count)] = Counter(has.values()).most_common(1)
    if has[robot] == most and 2 * count > len(has):
        return []
    return [other for other, value in has.items() if value != has[robot]]


def _release(ctx: _Context) -> Finding:
    if ctx.facts["pending"] is not None:
        return failed("a switch of releases was interrupted", _UP)
    if ctx.facts["current"] is None or ctx.facts["versions"] is None:
        return failed("it has no release", ctx.command("deploy"))
    versions = {other: of["versions"] for other, of in ctx.fleet.items() if of["versions"]}
    for part in ("image", "bundle", "world"):
        has = {other: str(of.get(part)) for other, of in versions.items()}
        if others := _disagreeing(has, ctx.robot.name):
            found = f"its {part} {has[ctx.robot.name][:12]} differs from that of "
            return failed(found + ", ".join(others), "lpac fleet deploy")
    if not is_configured(ctx.config, ctx.robot, ctx.facts):
        found = f"its configuration is not that of {ctx.config.path.name}"
        return failed(found, ctx.command("deploy"))
    return ok(ctx.facts["current"])


def is_configured(config: FleetConfig, robot: RobotHost, overview: Facts) -> bool:
    """Whether the robot's release has the present fleet.toml's robot.toml; True for a spare."""
    if config.slot_of(robot.name) is None:
        return True
    text = robot_toml(config, robot.name)
    return bool(overview["robot_toml"] == hashlib.sha256(text.encode()).hexdigest())


def _program(ctx: _Context) -> Finding:
    service = ctx.service
    if ctx.facts["current"] is None:
        return skipped("it has no release")
    if ctx.config.slot_of(ctx.robot.name) is None:
        if service["active"] == "active":
            return failed("it is a spare, but its program runs", ctx.command("deploy"))
        return ok("spare: not started")
    start, logs = ctx.command("start"), ctx.command("logs")
    if service["active"] != "active":
        return failed(f"it is {service['active']} ({service['result']})", start)
    if not service["fresh"]:
        return failed("it runs but reports no status", logs)
    if not service["enabled"]:
        return warning("it is not enabled: it does not start after a battery swap", start)
    if service["restarts"]:
        return warning(f"it restarted {counted(service['restarts'], 'time')}", logs)
    state, peers = service["status"]["state"], service["status"]["peers"]
    if ctx.config.radio.transport == "multicast":  # Only grounds connect.
        return ok(f"runs: {state}")
    wanted = sum(bool(of["service"]["fresh"]) for of in ctx.fleet.values()) - 1
    if peers < wanted:
        found = f"it is connected to {peers} of the {wanted} other programs"
        return warning(found, "lpac fleet radio")
    return ok(f"runs: {state}, {counted(peers, 'peer')}")


def _system(ctx: _Context) -> Finding:
    facts, systemd = ctx.facts, ctx.facts["systemd"]
    found = f"Linux {facts['kernel']}, systemd {systemd}, Python {facts['python']}"
    found += f", SDK {facts['sdk']}" if facts["sdk"] else ""
    if _version(facts["python"]) < _MIN_PYTHON or systemd is None or systemd < _MIN_SYSTEMD:
        return failed(found, "update its system: it needs Python 3.6 and systemd 237 or newer")
    if not facts["rsync"]:
        return failed("rsync is missing", "install rsync on the robot")
    if _version(facts["kernel"]) < _MIN_KERNEL:
        return warning(f"{found}: kernels before 4.19 are untested", "update it")
    return ok(found)


def _disk(ctx: _Context) -> Finding:
    if not ctx.facts["disks"]:
        return skipped("not known: df prints nothing")
    least = min(ctx.facts["disks"], key=lambda disk: float(disk["free_bytes"]))
    free_mb, total_mb = least["free_bytes"] / _MB, least["total_bytes"] / _MB
    fix = (
        "lpac fleet pull, then remove old logs on the robot (/var/lib/lpac/logs, /data/px4/log); "
        "keep the newest, from which numbering continues"
    )
    return _graded(
        f"{free_mb:.0f} of {total_mb:.0f} MB free at {least['path']}", fix,
        bad=free_mb < _MIN_DISK_MB, poor=free_mb < _GOOD_DISK_MB,
    )  # fmt: skip


def _clock(ctx: _Context) -> Finding:
    offset_s, uncertainty_s = ctx.found.clock
    way = "ahead of" if offset_s > 0.0 else "behind"
    found = f"{_duration(abs(offset_s))} {way} the laptop's (± {1000.0 * uncertainty_s:.0f} ms)"
    found += ", kept by a time server" if ctx.facts["synchronized"] else ""
    least_s = abs(offset_s) - uncertainty_s
    return _graded(found, _UP, bad=least_s > MAX_CLOCK_OFFSET_S, poor=least_s > GOOD_CLOCK_OFFSET_S)


def _processor(ctx: _Context) -> Finding:
    cores = f"{ctx.facts['cpus']} cores, load {ctx.facts['load']:.1f}"
    hottest_c = ctx.facts["hottest_c"]
    if hottest_c is None:
        return ok(f"{cores}, temperature not known")
    throttles = ": it throttles near 90 °C" if hottest_c >= _WARM_C else ""
    fix = "cool it with moving air; switch it on later"
    found = f"{cores}, {hottest_c:.0f} °C{throttles}"
    return _graded(found, fix, bad=hottest_c >= _HOT_C, poor=hottest_c >= _WARM_C)


def _memory(ctx: _Context) -> Finding:
    memory = ctx.facts["memory"]
    if memory is None:
        return skipped("not known")
    free_mb, total_mb = memory["available_bytes"] / _MB, memory["total_bytes"] / _MB
    fix = "stop what uses it (`top` on the robot), or switch the robot off and on"
    found = f"{free_mb:.0f} of {total_mb:.0f} MB available"
    return _graded(found, fix, bad=free_mb < _MIN_MEMORY_MB, poor=free_mb < _GOOD_MEMORY_MB)


def _wifi(ctx: _Context) -> Finding:
    links = ctx.facts["wifi"]
    if not links:
        return skipped("no wireless interface, or its driver does not report it")
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
        fix = ctx.on(f"iw dev {name} set power_save off")
        return warning(f"{found}: it delays messages", f"{fix} (at every boot)")
    if signal_dbm is not None and signal_dbm < _WEAK_DBM:
        return warning(f"{found}: weak", "move the access point nearer or higher")
    return ok(found)


def _radio(ctx: _Context) -> Finding:
    pings = ctx.found.pings
    if isinstance(pings, str):
        return skipped(pings)
    # A robot that the laptop cannot reach either has its own failed check.
    reachable = {other: ping for other, ping in pings.items() if other in ctx.fleet}
    if not reachable:
        return skipped("no other robot answers")
    fix = (
        "lpac fleet radio; all must be in one network, and the access point must let its clients "
        "reach each other"
    )
    if silent := [other for other, ping in reachable.items() if ping["loss"] >= 1.0]:
        return failed(f"no answer from {', '.join(silent)}", fix)
    bad = [
        f"{other}: {100.0 * ping['loss']:.0f} % lost, {ping['mean_ms']:.0f} ms"
        for other, ping in reachable.items()
        if ping["loss"] > _MAX_PING_LOSS or ping["mean_ms"] > _SLOW_MS
    ]
    if bad:
        return warning("; ".join(bad), fix)
    slowest_ms = max(ping["mean_ms"] for ping in reachable.values())
    return ok(f"{counted(len(reachable), 'robot')}: slowest answer within {slowest_ms:.1f} ms")


def _mavlink(ctx: _Context) -> Finding:
    robot, status, beat = ctx.robot, ctx.service["status"], ctx.facts["heartbeat"]
    runs, port = ctx.service["fresh"], robot.mavlink_port
    fix = ctx.on("systemctl status voxl-px4 voxl-mavlink-server voxl-vision-hub")
    if runs and not status["autopilot"]:
        why = [c.text for c in _parse_checks(status["failed_checks"]) if c.code in _NO_AUTOPILOT]
        return failed(why[0] if why else "the autopilot is silent", fix)
    if ctx.service["active"] == "active" and not runs:
        return skipped("the robot's program uses the port but reports no status")
    if not runs and beat is None:
        return failed(f"no heartbeat of PX4 at UDP port {port}", fix)
    system_id = status["system_id"] if runs else beat["system_id"]
    if system_id != robot.system_id:
        found = f"PX4 has system id {system_id}, fleet.toml has {robot.system_id}"
        return failed(found, f"{ctx.enroll} (it sets MAV_SYS_ID)")
    return ok(f"PX4 answers at port {port}, system id {system_id}")


def _px4(ctx: _Context) -> Finding:
    units = {name: unit for name, unit in ctx.facts["units"].items() if name in _PX4_PARTS}
    version = ctx.facts["px4"]
    if not any(unit["there"] for unit in units.values()) and version is None:
        return skipped("not a VOXL2: no voxl-px4")
    if idle := [name for name, unit in units.items() if not unit["active"]]:
        fix = ctx.on(f"systemctl enable --now {' '.join(idle)}")
        return failed(f"not running: {', '.join(idle)}", fix)
    if version is None:
        return skipped("its services run; dpkg does not know its version")
    if _version(version) < _MIN_PX4:
        return failed(f"PX4 {version} is older than 1.14", "update the VOXL SDK")
    return ok(f"PX4 {version}")


def _vision_hub(ctx: _Context) -> Finding:
    found = ctx.facts["vision_hub"]
    if found is None:
        return skipped("no voxl-vision-hub")
    fix = f"{ctx.enroll} (it writes /etc/modalai/voxl-vision-hub.conf)"
    if "problem" in found:
        return failed(f"its configuration is {found['problem']}", fix)
    faults = []
    mode, port = found["offboard_mode"], found["localhost_udp_port_number"]
    if mode != "off":
        value = "not set" if mode is None else f'"{mode}"'
        faults.append(f"offboard_mode is {value}: it sends setpoints of its own")
    if found["en_localhost_mavlink_udp"] is not True:
        faults.append("en_localhost_mavlink_udp is not true: PX4 cannot be reached")
    if port not in (None, ctx.robot.mavlink_port):
        faults.append(f"it sends to UDP port {port}, fleet.toml has {ctx.robot.mavlink_port}")
    if faults:
        return failed("; ".join(faults), fix)
    return ok("offboard_mode is off, MAVLink is sent to this host")


def _open_doors(ctx: _Context) -> Finding:
    """Ways to command the vehicle without the fleet's keys."""
    robot, radio = ctx.robot, ctx.config.radio
    if users := ctx.facts["factory_passwords"]:
        found = f"{', '.join(users)}: no password, or the factory password of every VOXL"
        return failed(found, ctx.on(*(f"passwd {user}" for user in users)))
    # UDP at the radio's port is for port knocking (edge.drivers.door).
    expected = {("tcp", robot.port or 22), ("tcp", robot.zenoh_port), ("udp", robot.zenoh_port)}
    if radio.transport == "multicast":
        expected.add(("udp", int(radio.group.rpartition(":")[2])))
    ports = ctx.facts["open_ports"]
    others = [each for each in ports if (each["protocol"], each["port"]) not in expected]
    if mavlink := [each for each in others if _may_be_mavlink(each)]:
        found = f"PX4's MAVLink is open to the network: {_ports(mavlink)}"
        drop = "iptables -I INPUT ! -i lo -p udp --dport {} -j DROP"
        fix = ctx.on(*(drop.format(each["port"]) for each in mavlink))
        return warning(found, f"{fix} (at every boot)")
    if others:
        found = f"other programs listen to the network: {_ports(others)}"
        return warning(found, "stop the programs that the fleet does not need")
    found = "only ssh and the radio listen to the network"
    if ctx.config.keys is None:
        return ok(found)
    if not ctx.facts["drops_strangers"]:
        found += "; a flood can block the radio's port: the kernel lets only root filter it"
        fix = "keep strangers out of the Wi-Fi, or allow the program to filter: docs/security.md"
        return warning(found, fix)
    return ok(f"{found}; the kernel filters floods from strangers")


def _may_be_mavlink(port: Facts) -> bool:
    """Whether its number or program is one of PX4's or a ground station's."""
    known = port["program"].startswith(("px4", "voxl-mavlink", "voxl-vision", "mavlink"))
    return bool(port["protocol"] == "udp" and (known or 14_540 <= port["port"] <= 14_599))


def _ports(ports: Sequence[Facts]) -> str:
    return ", ".join(f"{each['protocol']} {each['port']} ({each['program']})" for each in ports)


def _commanders(ctx: _Context) -> Finding:
    """Other units that may send setpoints."""
    units = ctx.facts["units"]
    suspects = [*_COMMANDERS, *(name.removesuffix(".service") for name in ctx.config.predecessors)]
    for state, option, found in (
        ("active", " --now", "runs and may command PX4"),
        ("enabled", "", "starts at the next boot"),
    ):
        if bad := [name for name in suspects if units.get(name, {}).get(state)]:
            fix = ctx.on(f"systemctl disable{option} {' '.join(bad)}")
            return failed(f"{', '.join(bad)} {found}", fix)
    return ok("no other program known to command PX4 runs")


def _containers(ctx: _Context) -> Finding:
    containers = ctx.facts["containers"]
    if containers is None:
        return warning("docker does not answer", ctx.on("docker ps --all"))
    bad = {}
    for container in containers:
        why = _why_suspect(container, ctx.config.predecessors)
        returns = container["restarts"] in ("always", "unless-stopped")
        if why and (container["running"] or returns):
            state = "runs" if container["running"] else "starts at boot"
            bad[container["name"]] = f"{container['name']} ({why}) {state}"
    if bad:
        names = " ".join(bad)
        fix = ctx.on(f"docker update --restart=no {names}", f"docker stop {names}")
        return failed("; ".join(bad.values()) + ": may command the vehicle", fix)
    running = sum(bool(container["running"]) for container in containers)
    return ok(f"{running} running, none that may command the vehicle")


def _why_suspect(container: Facts, predecessors: Sequence[str]) -> str:
    if container["name"] in predecessors:
        return "a predecessor"
    if re.search(r"ros|lpac|px4|mav", container["image"], re.IGNORECASE):
        return f"image {container['image']}"
    if container["host_network"]:
        return "host networking"
    return "access to devices" if container["devices"] else ""


def _failed_checks(ctx: _Context) -> tuple[list[FailedCheck], bool] | str:
    """Failed checks of the vehicle, and whether they are complete; or why they are unknown."""
    if ctx.service["fresh"]:
        status = ctx.service["status"]
        return _parse_checks(status["failed_checks"]), status["failed_checks_more"] == 0
    vehicle = ctx.found.vehicle
    return vehicle if isinstance(vehicle, str) else (_parse_checks(vehicle["failed"]), True)


def _parse_checks(checks: Sequence[Facts]) -> list[FailedCheck]:
    """Parse failed checks; an unknown code becomes `CheckCode.OTHER`."""
    return [
        FailedCheck(CheckCode(each["code"]), each["text"], bool(each["settles_by_itself"]))
        for each in checks
    ]


def _failsafe(ctx: _Context) -> Finding:
    """PX4's failsafe parameters."""
    known = _failed_checks(ctx)
    if isinstance(known, str):
        return skipped(known)
    checks, is_all = known
    not_read = (*_NO_AUTOPILOT, CheckCode.CHECKS_RUNNING, CheckCode.FAILSAFE_NOT_READ)
    if any(check.code in not_read for check in checks):
        return warning("PX4's parameters have not been read", "try again")
    if wrong := [check for check in checks if check.code is CheckCode.FAILSAFE_WRONG]:
        return failed(texts(wrong), f"{ctx.enroll} (it sets them, and restarts PX4 if need be)")
    if not is_all:
        found = "unknown: the list of failed checks is cut off"
        return warning(found, "correct what `preflight` names, then try again")
    return ok("PX4's failsafe parameters are correct")


def _preflight(ctx: _Context) -> Finding:
    """Other failed checks of the vehicle."""
    known = _failed_checks(ctx)
    if isinstance(known, str):
        return skipped(known)
    checks = [check for check in known[0] if check.code not in (*_GROUND, *_REPORTED_ELSEWHERE)]
    if not checks:
        return ok("only the ground's commands are missing")
    # Without open sky these checks fail, and PX4 does not arm.
    settling = {check.code for check in checks if check.settles_by_itself}
    may_arm_then = bool(settling - {CheckCode.CHECKS_RUNNING})
    waits = all(
        check.code in settling or (may_arm_then and check.code is CheckCode.NOT_ARMABLE)
        for check in checks
    )
    found = texts(checks) + ("" if known[1] else "; there may be more")
    if waits:
        return warning(found, "wait under open sky, then try again")
    return failed(found, "do what each line says")


_CHECKS: dict[str, Callable[[_Context], Finding | None]] = {
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
    "doors": _open_doors,
    "commanders": _commanders,
    "containers": _containers,
    "failsafe": _failsafe,
    "preflight": _preflight,
}


def _version(version: str) -> tuple[int, int]:
    match = re.search(r"(\d+)\.(\d+)", version)
    return (int(match[1]), int(match[2])) if match else (0, 0)


def _duration(seconds: float) -> str:
    for limit_s, unit_s, text in ((1.0, 1e-3, "{:.0f} ms"), (120.0, 1.0, "{:.1f} s"),
                                  (172800.0, 3600.0, "{:.1f} h")):  # fmt: skip
        if seconds < limit_s:
            return text.format(seconds / unit_s)
    return f"{seconds / 86400.0:.0f} days"
