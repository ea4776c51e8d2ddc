"""Probes of the robot's computer: what its own tools print, parsed here; nothing is changed."""

import json
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgspec

from lpac.fleet.session import RemoteError, Session

Facts = dict[str, Any]

VISION_HUB = "/etc/modalai/voxl-vision-hub.conf"
_IDENTITY = "/var/lib/private/lpac/identity"
# Of wireless interfaces, each after a line with its name.
_WIFI = """cat /proc/net/wireless; for i in $({
    ls -d /sys/class/net/*/wireless | cut -d/ -f5
    iw dev | sed -n 's/^\\s*Interface //p'
    sed -n 's/^ *\\([^ ]*\\):.*/\\1/p' /proc/net/wireless
} | sort -u); do
    echo "interface: $i"; iw dev $i link; iw dev $i get power_save; iw dev $i survey dump
done"""
# Users without a password, or with the one that every VOXL comes with: root's, as ModalAI's
# documentation has it.
_PASSWORDS = """while IFS=: read -r user stored rest; do case $stored in
    '') echo $user ;;
    \\$[156]\\$*) salt=${stored#\\$?\\$}; kind=${stored#\\$}
        [ "$(openssl passwd -${kind%%\\$*} -salt ${salt%%\\$*} oelinux123)" != "$stored" ] ||
        echo $user ;;
esac; done < /etc/shadow"""
# Whether a program without privileges can keep strangers from the radio's port, as
# edge.drivers.door does: hardened kernels let root alone attach a filter.
_FILTER = """import ctypes, os, socket, struct
os.setgroups([]); os.setresuid(65534, 65534, 65534)
passes_all = ctypes.create_string_buffer(struct.pack("HBBI", 0x06, 0, 0, 0xFFFFFFFF))
one = socket.socket()
one.setsockopt(socket.SOL_SOCKET, 26, struct.pack("HL", 1, ctypes.addressof(passes_all)))
one.getsockopt(socket.SOL_SOCKET, 55, 36)
print("yes")"""
_DOCKER = """command -v docker > /dev/null || { echo '[]'; exit; }
all=$(docker ps --all --quiet) || exit
if [ "$all" ]; then docker inspect $all; else echo '[]'; fi"""


async def wifi(session: Session) -> list[Facts]:
    """The wireless interfaces; empty where there is none."""
    return wifi_of((await session.look({"wifi": _WIFI}))["wifi"])


async def containers(session: Session) -> list[Facts] | None:
    """The containers of a container engine, empty where there is none; None if it is silent."""
    return containers_of((await session.look({"containers": _DOCKER}))["containers"])


async def units(session: Session, names: Sequence[str]) -> dict[str, Facts]:
    """Whether each unit is there, runs, and starts at boot; none does where systemd is silent."""
    told = units_of((await session.look({"units": shlex.join(_show(names))}))["units"])
    nowhere = {"there": False, "active": False, "enabled": False}
    return {name: told.get(name.removesuffix(".service"), nowhere) for name in names}


async def unit(session: Session, name: str) -> Facts:
    """The same of one unit. Raises RemoteError where systemd is silent."""
    for told in units_of(await session.must(*_show([name]))).values():
        return told
    raise RemoteError(f"systemd says nothing of unit {name}")


def _show(names: Sequence[str]) -> list[str]:
    services = [name if "." in name else f"{name}.service" for name in names]
    properties = "Id,LoadState,ActiveState,UnitFileState"
    return ["systemctl", "show", "--no-pager", "-p", properties, *services]


async def ping(session: Session, addresses: Mapping[str, str], count: int) -> dict[str, Facts]:
    """ICMP echo to all of them at once: by name share lost, and time there and back, ms.

    Raises RemoteError if there is no `ping`.
    """
    await session.must("ping", "-V")
    one = f"ping -n -q -c {count} -i 0.2 -W 1 -w {count // 5 + 2}"
    script = [
        f"{{ {one} {shlex.quote(to)} 2>&1 | sed {shlex.quote(f's/^/{name} /')}; }} &"
        for name, to in addresses.items()
    ]
    said = (await session.look({"": "\n".join([*script, "wait"])}, each_s=20.0))[""]
    lines = [line.partition(" ") for line in said.splitlines()]
    return {
        name: ping_summary("\n".join(text for of, _, text in lines if of == name))
        for name in addresses
    }


# Parsing


def ping_summary(text: str) -> Facts:
    """Loss (0 to 1) and times, ms, of what `ping -q` prints; all is lost if it says nothing."""
    sent = re.search(r"(\d+) packets transmitted, (\d+) (?:packets )?received", text)
    times = re.search(r"= ([\d.]+)/([\d.]+)/([\d.]+)", text)
    loss = 1.0
    if sent and int(sent[1]):
        # Answers that came twice count once.
        loss = max(0.0, 1.0 - float(sent[2]) / float(sent[1]))
    heard = times if loss < 1.0 else None
    return {
        "loss": loss,
        "mean_ms": float(heard[2]) if heard else None,
        "max_ms": float(heard[3]) if heard else None,
    }


def open_ports(text: str) -> list[Facts]:
    """The ports that other computers reach, of `ss -tulnp`: protocol, number and program."""
    found: dict[tuple[str, int], str] = {}
    for line in text.splitlines():
        match = re.match(r"(udp|tcp)\s+\S+\s+\d+\s+\d+\s+(\S+):(\d+)\s", line)
        if match and not re.match(r"127\.|\[::1\]|\[?::ffff:127\.", match[2]):
            found[match[1], int(match[3])] = group(r'users:\(\("([^"]+)"', line) or "?"
    return [
        {"protocol": protocol, "port": port, "program": program}
        for (protocol, port), program in sorted(found.items())
    ]


def systemd_version(text: str) -> int | None:
    """The version in what `systemctl --version` prints."""
    match = re.match(r"systemd (\d+)", text)
    return int(match[1]) if match else None


def memory(text: str) -> Facts | None:
    """Total and available memory, bytes, of /proc/meminfo."""
    values = dict(re.findall(r"^(\w+):\s+(\d+) kB", text, re.MULTILINE))
    if not {"MemTotal", "MemAvailable"} <= set(values):
        return None
    total, available = (1024.0 * int(values[key]) for key in ("MemTotal", "MemAvailable"))
    return {"total_bytes": total, "available_bytes": available}


def synchronized(text: str) -> bool | None:
    """Whether a time server keeps the clock, of what `timedatectl` prints; None if unknown."""
    said = group(r"(?:System clock|NTP) synchronized: (yes|no)", text)
    return None if said is None else said == "yes"


def disks_of(text: str) -> list[Facts]:
    """Free and total bytes of the file systems in what `df -P -B1` prints, each once."""
    found = re.findall(r"^.*?\s(\d+)\s+\d+\s+(\d+)\s+\d+%\s+(/.*)$", text, re.MULTILINE)
    return [
        {"path": path, "free_bytes": int(free), "total_bytes": int(total)}
        for total, free, path in dict.fromkeys(found)
    ]


def hottest_c(text: str) -> float | None:
    """The hottest of what measures processors; other zones may be no temperatures at all."""
    zones = re.findall(r"^.*(?:cpu|gpu|pkg).* (-?\d+)$", text, re.MULTILINE)
    return max((max(int(value) / 1000.0, -273.0) for value in zones), default=None)


def wifi_of(text: str) -> list[Facts]:
    """The wireless interfaces, of the kernel's table and what `iw` prints of each."""
    table, *blocks = re.split(r"^interface: ", text, flags=re.MULTILINE)
    levels = wireless(table)
    found = {}
    for block in blocks:
        name, _, said = block.partition("\n")
        link = iw_link(said) | iw_survey(said) | {"name": name}
        if link["signal_dbm"] is None:
            link["signal_dbm"] = levels.get(name)
        save = group(r"Power save: (on|off)", said)
        link["power_save"] = None if save is None else save == "on"
        found[name] = link
    return [found[name] for name in sorted(found)]


def wireless(text: str) -> dict[str, float | None]:
    """Signal level, dBm, by interface, of /proc/net/wireless; None where it is not in dBm."""
    found = re.findall(r"^\s*(\S+):\s+[0-9a-f]+\s+\S+\s+(-?\d+)", text, re.MULTILINE)
    return {name: float(level) if float(level) < 0.0 else None for name, level in found}


def iw_link(text: str) -> Facts:
    """Parse `iw dev NAME link`; `connected` is None if it tells nothing."""
    joined = group(r"^(Connected to|Joined IBSS|Not connected)", text)
    return {
        "connected": None if joined is None else joined != "Not connected",
        "network": group(r"^\s*SSID: (.+)$", text),
        "signal_dbm": number(group(r"signal: (-?[\d.]+) dBm", text)),
        "rate_mbit_s": number(group(r"tx bitrate: ([\d.]+) MBit/s", text)),
        "frequency_mhz": number(group(r"freq: ([\d.]+)", text)),
    }


def iw_survey(text: str) -> Facts:
    """How long its radio has listened to the channel in use, and found it busy, ms.

    Of `iw dev NAME survey dump`; None where the driver does not count.
    """
    blocks = re.split(r"^Survey data from .*$", text, flags=re.MULTILINE)
    used = next((block for block in blocks if re.search(r"frequency:.*\[in use\]", block)), "")
    return {
        "active_ms": number(group(r"channel active time:\s+(\d+) ms", used)),
        "busy_ms": number(group(r"channel busy time:\s+(\d+) ms", used)),
    }


def vision_hub(text: str) -> Facts | None:
    """voxl-vision-hub's configuration as far as it matters; None where there is none."""
    if not text:
        return None
    try:
        values = json.loads(without_comments(text))
    except ValueError as error:
        return {"problem": f"it is no JSON: {error}"}
    if not isinstance(values, dict):
        return {"problem": "it is no JSON object"}
    keys = ("en_localhost_mavlink_udp", "localhost_udp_port_number", "offboard_mode")
    return {key: values.get(key) for key in keys}


def without_comments(text: str) -> str:
    """JSON without the comments that ModalAI's files may have: as in C, outside of strings."""
    pattern = r'("(?:\\.|[^"\\])*")|/\*.*?\*/|//[^\n]*'
    return re.sub(pattern, lambda match: match[1] or " ", text, flags=re.DOTALL)


def units_of(text: str) -> dict[str, Facts]:
    """Parse `systemctl show` of units, by name without ".service"."""
    found = {}
    for block in re.split(r"\n\s*\n", text.strip()):
        values = dict(line.split("=", 1) for line in block.split("\n") if "=" in line)
        if name := values.get("Id", ""):
            found[name.removesuffix(".service")] = {
                "there": values.get("LoadState") not in ("not-found", None),
                "active": values.get("ActiveState") in ("active", "activating", "reloading"),
                "enabled": values.get("UnitFileState") == "enabled",
            }
    return found


def containers_of(text: str) -> list[Facts] | None:
    """Parse `docker inspect` of containers, as far as it matters here; None if it is none."""
    try:
        told = msgspec.json.decode(text, type=list[dict[str, Any]])
    except msgspec.MsgspecError:
        return None
    found = []
    for one in told:
        host = one.get("HostConfig") or {}
        mounts = [str(bind).split(":")[0] for bind in host.get("Binds") or []]
        has_device = any(mount == "/dev" or mount.startswith("/dev/") for mount in mounts)
        found.append({
            "name": str(one.get("Name", "")).lstrip("/"),
            "image": str((one.get("Config") or {}).get("Image", "")),
            "running": bool((one.get("State") or {}).get("Running")),
            "restarts": str((host.get("RestartPolicy") or {}).get("Name") or "no"),
            "host_network": host.get("NetworkMode") == "host",
            "devices": bool(host.get("Privileged") or host.get("Devices") or has_device),
        })  # fmt: skip
    return found


def group(pattern: str, text: str) -> str | None:
    """The first group of the first match."""
    match = re.search(pattern, text, re.MULTILINE)
    return match[1] if match else None


def number(text: str | None) -> float | None:
    """A decimal number, None if it is none."""
    try:
        return None if text is None else float(text)
    except ValueError:
        return None


def _or_none(text: str) -> str | None:
    return text or None


async def facts(session: Session, directory: str, names: Sequence[str]) -> Facts:
    """All that can be looked at; of the units, those with `names`."""
    there = f"d={directory}; while [ ! -d ${{d:=/}} ]; do d=${{d%/*}}; done"
    disks = f"{there}; df -P -B1 $d /var/lib"
    said = await session.look({"disks": disks} | {name: its[0] for name, its in _FACTS.items()})
    found: Facts = {name: its[1](said[name]) for name, its in _FACTS.items()}
    return found | {"disks": disks_of(said["disks"]), "units": await units(session, names)}


# What is printed, and how it is parsed.
_FACTS: dict[str, tuple[str, Callable[[str], Any]]] = {
    "kernel": ("uname -r", str),
    "python": ("python3 -V", lambda text: group(r"([\d.]+)", text) or "0"),
    "rsync": ("command -v rsync", bool),
    "systemd": ("systemctl --version", systemd_version),
    "sdk": ("cat /etc/version", _or_none),
    "px4": ("dpkg-query -W -f '${Version}' voxl-px4", _or_none),
    "memory": ("cat /proc/meminfo", memory),
    "cpus": ("nproc", str),
    "load": ("cat /proc/loadavg", lambda text: number(text.partition(" ")[0]) or 0.0),
    "hottest_c": (
        "for z in /sys/class/thermal/thermal_zone*; do echo $(cat $z/type $z/temp); done",
        hottest_c,
    ),
    "synchronized": ("timedatectl status --no-pager", synchronized),
    "wifi": (_WIFI, wifi_of),
    "vision_hub": (f"cat {VISION_HUB}", vision_hub),
    "containers": (_DOCKER, containers_of),
    "members": (f"cat {_IDENTITY}/members", _or_none),
    "group_keys": (f"sha256sum {_IDENTITY}/group-keys", lambda text: _or_none(text.split(" ")[0])),
    "open_ports": ("ss -H -t -u -l -n -p", open_ports),
    "factory_passwords": (_PASSWORDS, str.split),
    "drops_strangers": (f"python3 -c {shlex.quote(_FILTER)}", bool),
}
