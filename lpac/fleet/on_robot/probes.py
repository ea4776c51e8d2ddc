"""Probes of the robot's computer: facts only; the laptop judges them.

Nothing here changes anything, but `set_clock` and `renumber_starts`.
"""

import contextlib
import ctypes
import glob
import hashlib
import json
import os
import re
import shutil
import socket
import struct
import subprocess
import sys
import time
from typing import Any, Dict, List, Optional

from lpac.fleet.on_robot import releases, service
from lpac.fleet.on_robot.calls import Refused, call, reason, run, say

VISION_HUB = "/etc/modalai/voxl-vision-hub.conf"
# root's, as ModalAI's documentation has it.
_FACTORY_PASSWORD = "oelinux123"

# How long the program may take, after its start, until its first checks are done.
_CHECKS_WAIT_S = 8.0
# Failed checks that mean that it has not looked yet.
_NOT_SETTLED = ("checks_running", "failsafe_not_read")
_PRIVATE = "/var/lib/private"
# As `edge.drivers.identity_folder` writes it, and `edge.identity.guard` refuses it.
_START, _MOST_AHEAD_MS = _PRIVATE + "/lpac/identity/start", 24 * 3600 * 1000
# `lpac robot check` waits so long for the vehicle; the ground will be missing to its end.
_CHECK_S = 10.0


# The clock


@call
def clock() -> Dict[str, Any]:
    """This robot's wall clock."""
    return {"unix_time_s": time.time()}


@call
def set_clock(offset_s: float, mavlink_port: int) -> Dict[str, Any]:
    """Take `offset_s` off the wall clock at once, and set the battery-backed clock if there is one.

    Refused while the vehicle is armed. On the ground the program may run meanwhile: it counts
    monotonic time. Only the flight log's times jump as the clock does.
    """
    service.refuse_in_flight(mavlink_port, "setting the clock")
    try:
        time.clock_settime(time.CLOCK_REALTIME, time.clock_gettime(time.CLOCK_REALTIME) - offset_s)
    except PermissionError:
        raise Refused(
            "its clock cannot be set: the system does not let root do that (a container?)"
        ) from None
    kept = False
    if glob.glob("/dev/rtc*") and shutil.which("hwclock"):
        kept = run(["hwclock", "-w"]).returncode == 0
    return {"unix_time_s": time.time(), "hardware_clock": kept}


@call
def renumber_starts() -> Dict[str, Any]:
    """Number the program's starts by the clock again if the last was more than a day `ahead` of it.

    Nobody listens to such a start. The clock must be right.
    """
    now_ms, ahead = int(1e3 * time.time()), False
    try:
        with open(_START, "r+") as file:
            ahead = int(file.read()) > now_ms + _MOST_AHEAD_MS
            if ahead:
                file.seek(0)
                file.truncate()
                file.write("%d\n" % now_ms)
    except (OSError, ValueError):  # None yet.
        pass
    return {"ahead": ahead}


# The computer


@call
def facts(directory: str, mavlink_port: int, names: List[str]) -> Dict[str, Any]:
    """All that can be looked at without changing anything; of the units, those with `names`."""
    say("looks")
    found = releases.overview(directory)
    found["service"] = _settled(found["service"])
    is_active = found["service"]["active"] == "active"
    if not is_active:
        say("listens to PX4")
    found.update(
        heartbeat=None if is_active else service.hear_heartbeat(mavlink_port),
        kernel=os.uname().release,
        python=sys.version.split()[0],
        rsync=shutil.which("rsync") is not None,
        systemd=systemd_version(_output(["systemctl", "--version"])),
        sdk=_read("/etc/version").strip() or None,
        px4=_output(["dpkg-query", "-W", "-f", "${Version}", "voxl-px4"]).strip() or None,
        disks=_disks([directory, "/var/lib"]),
        memory=memory(_read("/proc/meminfo")),
        cpus=os.cpu_count(),
        load=os.getloadavg()[0],
        hottest_c=_hottest_c(),
        synchronized=synchronized(_output(["timedatectl", "status", "--no-pager"])),
        wifi=_wifi(),
        vision_hub=_vision_hub(),
        units=units(known_units(names)),
        containers=known_containers(),
        card=_card(),
        group_keys=group_keys_sha256(),
        open_ports=open_ports(_output(["ss", "-H", "-t", "-u", "-l", "-n", "-p"])),
        factory_passwords=_factory_passwords(),
        drops_strangers=_drops_strangers(),
    )
    return found


def _drops_strangers() -> bool:
    """Whether a program without privileges can keep strangers from the radio's port.

    A child that runs as nobody attaches a filter, as `edge.drivers.door` does: hardened kernels
    allow that to root alone.
    """
    child = os.fork()
    if child == 0:
        try:
            os.setgroups([])
            os.setresuid(65534, 65534, 65534)
            passes_all = ctypes.create_string_buffer(struct.pack("HBBI", 0x06, 0, 0, 0xFFFFFFFF))
            program = struct.pack("HL", 1, ctypes.addressof(passes_all))
            with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_STREAM)) as one:
                one.setsockopt(socket.SOL_SOCKET, 26, program)
                one.getsockopt(socket.SOL_SOCKET, 55, 36)
            os._exit(0)
        finally:
            os._exit(1)
    return os.waitpid(child, 0)[1] == 0


def _card() -> Optional[str]:
    """The file with who this robot is in its fleet; None if it has no card."""
    return _read(os.path.join(_PRIVATE, "lpac/identity/identity.json")) or None


def group_keys_sha256() -> Optional[str]:
    """Of the file with the multicast group's keys, in hexadecimal digits; None without keys."""
    try:
        with open(os.path.join(_PRIVATE, "lpac/identity/group-keys"), "rb") as file:
            return hashlib.sha256(file.read()).hexdigest()
    except FileNotFoundError:
        return None


def open_ports(text: str) -> List[Dict[str, Any]]:
    """The ports that other computers reach, of `ss -tulnp`: protocol, number and program."""
    found = {}  # type: Dict[Any, str]
    for line in text.split("\n"):
        match = re.match(r"(udp|tcp)\s+\S+\s+\d+\s+\d+\s+(\S+):(\d+)\s", line)
        if match is None or re.match(r"127\.|\[::1\]|\[?::ffff:127\.", match.group(2)):
            continue
        program = _group(r'users:\(\("([^"]+)"', line) or "?"
        found[match.group(1), int(match.group(3))] = program
    return [
        {"protocol": protocol, "port": port, "program": program}
        for (protocol, port), program in sorted(found.items())
    ]


def _factory_passwords() -> List[str]:
    """Users that can log in with no password, or with the one that every VOXL comes with."""
    found = []
    for line in _read("/etc/shadow").split("\n"):
        user, _, rest = line.partition(":")
        stored = rest.partition(":")[0]
        if user and (not stored or _is_password(_FACTORY_PASSWORD, stored)):
            found.append(user)
    return found


def _is_password(password: str, stored: str) -> bool:
    match = re.match(r"\$([156])\$([^$]+)\$", stored)
    if match is None or not shutil.which("openssl"):
        return False
    method, salt = match.groups()
    return _output(["openssl", "passwd", "-" + method, "-salt", salt, password]).strip() == stored


def _settled(state: Dict[str, Any]) -> Dict[str, Any]:
    """The unit's state once the program has done its first checks, if it runs."""
    until_s = time.monotonic() + _CHECKS_WAIT_S
    while state["fresh"] and time.monotonic() < until_s:
        codes = {check["code"] for check in state["status"]["failed_checks"]}
        if not codes.intersection(_NOT_SETTLED):
            break
        time.sleep(0.25)
        state = service.service()
    return state


@call
def vehicle_check(directory: str) -> Dict[str, Any]:
    """Check of the vehicle by the release itself, while it does not run: `lpac robot check`.

    With `parameters = "set"` in its configuration it sets PX4's parameters, as it would when run.
    Needs the lock, so that nobody starts the program meanwhile.
    """
    releases.require_lock()
    say("reads PX4's parameters")
    if service.service()["active"] not in ("inactive", "failed"):
        raise Refused("its program runs")
    done = releases.run_inside(
        os.path.realpath(os.path.join(directory, "current")),
        ["/usr/bin/lpac", "robot", "check", "--config", "/release/robot.toml", "--json", "--wait",
         "%g" % _CHECK_S],
        # Who it is in its fleet, which is for the program's user alone.
        state=_PRIVATE if os.path.isdir(os.path.join(_PRIVATE, "lpac/identity")) else "",
    )  # fmt: skip
    try:
        report = json.loads(done.stdout)
    except ValueError:
        raise Refused(reason(done)) from None
    return dict(report)


def systemd_version(text: str) -> Optional[int]:
    """The version in what `systemctl --version` prints."""
    match = re.match(r"systemd (\d+)", text)
    return int(match.group(1)) if match else None


def memory(text: str) -> Optional[Dict[str, float]]:
    """Total and available memory, bytes, of /proc/meminfo."""
    values = dict(re.findall(r"^(\w+):\s+(\d+) kB", text, re.MULTILINE))
    if not {"MemTotal", "MemAvailable"} <= set(values):
        return None
    return {
        "total_bytes": 1024.0 * int(values["MemTotal"]),
        "available_bytes": 1024.0 * int(values["MemAvailable"]),
    }


def synchronized(text: str) -> Optional[bool]:
    """Whether a time server keeps the clock, of what `timedatectl` prints; None if unknown."""
    match = re.search(r"(?:System clock|NTP) synchronized: (yes|no)", text)
    return match.group(1) == "yes" if match else None


def _disks(paths: List[str]) -> List[Dict[str, Any]]:
    """Free and total bytes of the file systems, each once."""
    disks = {}  # type: Dict[int, Dict[str, Any]]
    for wanted in paths:
        path = wanted
        while not os.path.isdir(path):
            path = os.path.dirname(path)
        usage = shutil.disk_usage(path)
        disks.setdefault(
            os.stat(path).st_dev,
            {"path": path, "free_bytes": usage.free, "total_bytes": usage.total},
        )
    return list(disks.values())


def _hottest_c() -> Optional[float]:
    """The hottest of what measures processors; other zones may be no temperatures at all."""
    hottest = None
    for zone in glob.glob("/sys/class/thermal/thermal_zone*"):
        kind, value = _read(zone + "/type"), _read(zone + "/temp").strip()
        if re.search("cpu|gpu|pkg", kind) and re.match(r"-?\d+$", value):
            hottest = max(int(value) / 1000.0, -273.0 if hottest is None else hottest)
    return hottest


# The radio


@call
def wifi() -> Dict[str, Any]:
    """State of the wireless interfaces, and of their channels."""
    return {"interfaces": _wifi()}


def _wifi() -> List[Dict[str, Any]]:
    """The wireless interfaces; empty where there is none."""
    found = []
    levels = wireless(_read("/proc/net/wireless"))
    names = {os.path.basename(os.path.dirname(p)) for p in glob.glob("/sys/class/net/*/wireless")}
    names.update(re.findall(r"^\s*Interface (\S+)", _output(["iw", "dev"]), re.MULTILINE))
    for name in sorted(names | set(levels)):
        link = iw_link(_output(["iw", "dev", name, "link"]))
        link["name"] = name
        if link["signal_dbm"] is None:
            link["signal_dbm"] = levels.get(name)
        save = re.search(r"Power save: (on|off)", _output(["iw", "dev", name, "get", "power_save"]))
        link["power_save"] = save.group(1) == "on" if save else None
        link.update(iw_survey(_output(["iw", "dev", name, "survey", "dump"])))
        found.append(link)
    return found


def wireless(text: str) -> Dict[str, Optional[float]]:
    """Signal level, dBm, by interface, of /proc/net/wireless; None where it is not in dBm."""
    levels = {}  # type: Dict[str, Optional[float]]
    for line in text.split("\n")[2:]:
        match = re.match(r"\s*(\S+):\s+[0-9a-f]+\s+(\S+)\s+(-?\d+)", line)
        if match:
            level = float(match.group(3))
            levels[match.group(1)] = level if level < 0.0 else None
    return levels


def iw_link(text: str) -> Dict[str, Any]:
    """Parse `iw dev NAME link`; `connected` is None if it tells nothing."""
    connected = None  # type: Optional[bool]
    if re.search(r"^(Connected to|Joined IBSS)", text, re.MULTILINE):
        connected = True
    elif text.startswith("Not connected"):
        connected = False
    return {
        "connected": connected,
        "network": _group(r"^\s*SSID: (.+)$", text),
        "signal_dbm": _number(_group(r"signal: (-?[\d.]+) dBm", text)),
        "rate_mbit_s": _number(_group(r"tx bitrate: ([\d.]+) MBit/s", text)),
        "frequency_mhz": _number(_group(r"freq: ([\d.]+)", text)),
    }


def iw_survey(text: str) -> Dict[str, Optional[float]]:
    """How long its radio has listened to the channel in use, and found it busy, ms.

    Of `iw dev NAME survey dump`; None where the driver does not count.
    """
    blocks = re.split(r"^Survey data from .*$", text, flags=re.MULTILINE)
    used = next((block for block in blocks if re.search(r"frequency:.*\[in use\]", block)), "")
    return {
        "active_ms": _number(_group(r"channel active time:\s+(\d+) ms", used)),
        "busy_ms": _number(_group(r"channel busy time:\s+(\d+) ms", used)),
    }


@call
def ping(addresses: Dict[str, str], count: int) -> Dict[str, Any]:
    """ICMP echo to all of them at once: by name share lost, and time there and back, ms.

    Raises Refused if there is no `ping`.
    """
    say("pings")
    program = shutil.which("ping")
    if program is None:
        raise Refused("the program ping is missing on the robot: apt install iputils-ping")
    asked = {}
    for name, address in addresses.items():
        command = [program, "-n", "-q", "-c", str(count), "-i", "0.2", "-W", "1",
                   "-w", str(count // 5 + 2), address]  # fmt: skip
        asked[name] = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            errors="replace",
            env=dict(os.environ, LC_ALL="C"),
        )
    return {name: ping_summary(process.communicate()[0]) for name, process in asked.items()}


def ping_summary(text: str) -> Dict[str, Any]:
    """Loss (0 to 1) and times, ms, of what `ping -q` prints; all is lost if it says nothing."""
    sent = re.search(r"(\d+) packets transmitted, (\d+) (?:packets )?received", text)
    times = re.search(r"= ([\d.]+)/([\d.]+)/([\d.]+)", text)
    loss = 1.0
    if sent and int(sent.group(1)):
        # Answers that came twice count once.
        loss = max(0.0, 1.0 - float(sent.group(2)) / float(sent.group(1)))
    heard = loss < 1.0 and times is not None
    return {
        "loss": loss,
        "mean_ms": float(times.group(2)) if heard and times else None,
        "max_ms": float(times.group(3)) if heard and times else None,
    }


# Who else commands PX4


def _vision_hub() -> Optional[Dict[str, Any]]:
    """voxl-vision-hub's configuration as far as it matters; None where there is none."""
    if not os.path.exists(VISION_HUB):
        return None
    try:
        values = json.loads(without_comments(_read(VISION_HUB)))
    except ValueError as error:
        return {"problem": "it is no JSON: %s" % error}
    if not isinstance(values, dict):
        return {"problem": "it is no JSON object"}
    keys = ("en_localhost_mavlink_udp", "localhost_udp_port_number", "offboard_mode")
    return {key: values.get(key) for key in keys}


def without_comments(text: str) -> str:
    """JSON without the comments that ModalAI's files may have: as in C, outside of strings."""
    pattern = r'("(?:\\.|[^"\\])*")|/\*.*?\*/|//[^\n]*'
    return re.sub(pattern, lambda match: match.group(1) or " ", text, flags=re.DOTALL)


def known_units(names: List[str]) -> str:
    properties = "Id,LoadState,ActiveState,UnitFileState"
    services = [name if "." in name else name + ".service" for name in names]
    return _output(["systemctl", "show", "--no-pager", "-p", properties, *services])


def units(text: str) -> Dict[str, Dict[str, Any]]:
    """By name, without ".service", whether a unit is there, runs, and starts at boot."""
    found = {}
    for block in re.split(r"\n\s*\n", text.strip()):
        values = dict(line.split("=", 1) for line in block.split("\n") if "=" in line)
        name = values.get("Id", "")
        if name:
            found[re.sub(r"\.service$", "", name)] = {
                "there": values.get("LoadState") not in ("not-found", None),
                "active": values.get("ActiveState") in ("active", "activating", "reloading"),
                "enabled": values.get("UnitFileState") == "enabled",
            }
    return found


def known_containers() -> Optional[List[Dict[str, Any]]]:
    """The containers of a container engine, empty where there is none; None if it is silent."""
    if shutil.which("docker") is None:
        return []
    try:
        listed = run(["docker", "ps", "--all", "--quiet"])
        if listed.returncode != 0:
            return None
        names = listed.stdout.split()
        return containers(run(["docker", "inspect", *names]).stdout) if names else []
    except (Refused, ValueError):
        return None


def containers(text: str) -> List[Dict[str, Any]]:
    """Parse `docker inspect` of containers, as far as it matters here. Raises ValueError."""
    found = []
    for one in json.loads(text):
        host = one.get("HostConfig") or {}
        mounts = [str(bind).split(":")[0] for bind in host.get("Binds") or []]
        found.append(
            {
                "name": str(one.get("Name", "")).lstrip("/"),
                "image": str((one.get("Config") or {}).get("Image", "")),
                "running": bool((one.get("State") or {}).get("Running")),
                "restarts": str((host.get("RestartPolicy") or {}).get("Name") or "no"),
                "host_network": host.get("NetworkMode") == "host",
                "devices": bool(
                    host.get("Privileged")
                    or host.get("Devices")
                    or any(mount == "/dev" or mount.startswith("/dev/") for mount in mounts)
                ),
            }
        )
    return found


# Reading


def _output(command: List[str]) -> str:
    """Output of a program; empty if it is not there, or does not end."""
    try:
        return run(command, timeout_s=5.0).stdout
    except (Refused, OSError):
        return ""


def _read(path: str) -> str:
    """A file's text; nothing if it cannot be read."""
    try:
        with open(path, encoding="utf-8", errors="replace") as file:
            return file.read()
    except OSError:
        return ""


def _group(pattern: str, text: str) -> Optional[str]:
    match = re.search(pattern, text, re.MULTILINE)
    return match.group(1) if match else None


def _number(text: Optional[str]) -> Optional[float]:
    try:
        return None if text is None else float(text)
    except ValueError:
        return None
