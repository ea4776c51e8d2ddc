"""Read-only probes of a robot's computer: the output of its own tools, parsed."""

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
# Prints each wireless interface after a line with its name.
_WIFI = """cat /proc/net/wireless; for i in $({
    ls -d /sys/class/net/*/wireless | cut -d/ -f5
    iw dev | sed -n 's/^\\s*Interface //p'
    sed -n 's/^ *\\([^ ]*\\):.*/\\1/p' /proc/net/wireless
} | sort -u); do
    echo "interface: $i"; iw dev $i link; iw dev $i get power_save; iw dev $i survey dump
done"""
# Prints users without a password, or with the factory password from ModalAI's documentation.
_PASSWORDS = """while IFS=: read -r user stored rest; do case $stored in
    '') echo $user ;;
    \\$[156]\\$*) salt=${stored#\\$?\\$}; kind=${stored#\\$}
        [ "$(openssl passwd -${kind%%\\$*} -salt ${salt%%\\$*} oelinux123)" != "$stored" ] ||
        echo $user ;;
esac; done < /etc/shadow"""
# Prints "yes" if an unprivileged program can filter the radio's port as edge.drivers.door does.
# Hardened kernels allow only root to attach a filter.
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
    """Wireless interfaces of the robot."""
    return wifi_of((await session.capture({"wifi": _WIFI}))["wifi"])


async def containers(session: Session) -> list[Facts] | None:
    """Docker's containers; [] without docker, None if docker does not answer."""
    return containers_of((await session.capture({"containers": _DOCKER}))["containers"])


async def units(session: Session, names: Sequence[str]) -> dict[str, Facts]:
    """Whether each unit exists, is active, and is enabled; all False if systemd is silent."""
    found = units_of((await session.capture({"units": shlex.join(_show(names))}))["units"])
    missing = {"there": False, "active": False, "enabled": False}
    return {name: found.get(name.removesuffix(".service"), missing) for name in names}


async def unit(session: Session, name: str) -> Facts:
    """As `units`, of one unit. Raises RemoteError if systemd is silent."""
    for found in units_of(await session.check_output(*_show([name]))).values():
        return found
    raise RemoteError(f"systemd reports nothing about unit {name}")


def _show(names: Sequence[str]) -> list[str]:
    services = [name if "." in name else f"{name}.service" for name in names]
    properties = "Id,LoadState,ActiveState,UnitFileState"
    return ["systemctl", "show", "--no-pager", "-p", properties, *services]


async def ping(session: Session, addresses: Mapping[str, str], count: int) -> dict[str, Facts]:
    """Ping all addresses at once; by name, the share lost and the round-trip times, ms.

    Raises RemoteError if there is no `ping`.
    """
    await session.check_output("ping", "-V")
    one = f"ping -n -q -c {count} -i 0.2 -W 1 -w {count // 5 + 2}"
    script = [
        f"{{ {one} {shlex.quote(to)} 2>&1 | sed {shlex.quote(f's/^/{name} /')}; }} &"
        for name, to in addresses.items()
    ]
    output = (await session.capture({"": "\n".join([*script, "wait"])}, each_s=20.0))[""]
    lines = [line.partition(" ") for line in output.splitlines()]
    return {
        name: ping_summary("\n".join(text for of, _, text in lines if of == name))
        for name in addresses
    }


def ping_summary(text: str) -> Facts:
    """Parse `ping -q`: loss (0 to 1) and times, ms. Without a summary, everything is lost."""
    sent = re.search(r"(\d+) packets transmitted, (\d+) (?:packets )?received", text)
    times = re.search(r"= ([\d.]+)/([\d.]+)/([\d.]+)", text)
    loss = 1.0
    if sent and int(sent[1]):
        # Duplicate answers may make it negative.
        loss = max(0.0, 1.0 - float(sent[2]) / float(sent[1]))
    answered = times if loss < 1.0 else None
    return {
        "loss": loss,
        "mean_ms": float(answered[2]) if answered else None,
        "max_ms": float(answered[3]) if answered else None,
    }


def open_ports(text: str) -> list[Facts]:
    """Parse `ss -tulnp`: protocol, number and program of the ports open to other computers."""
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
    """Parse `systemctl --version`."""
    match = re.match(r"systemd (\d+)", text)
    return int(match[1]) if match else None


def memory(text: str) -> Facts | None:
    """Parse /proc/meminfo: total and available memory, bytes."""
    values = dict(re.findall(r"^(\w+):\s+(\d+) kB", text, re.MULTILINE))
    if not {"MemTotal", "MemAvailable"} <= set(values):
        return None
    total, available = (1024.0 * int(values[key]) for key in ("MemTotal", "MemAvailable"))
    return {"total_bytes": total, "available_bytes": available}


def synchronized(text: str) -> bool | None:
    """Parse `timedatectl`: whether a time server keeps the clock, None if unknown."""
    found = group(r"(?:System clock|NTP) synchronized: (yes|no)", text)
    return None if found is None else found == "yes"


def disks_of(text: str) -> list[Facts]:
    """Parse `df -P -B1`: free and total bytes of each file system."""
    found = re.findall(r"^.*?\s(\d+)\s+\d+\s+(\d+)\s+\d+%\s+(/.*)$", text, re.MULTILINE)
    return [
        {"path": path, "free_bytes": int(free), "total_bytes": int(total)}
        for total, free, path in dict.fromkeys(found)
    ]


def hottest_c(text: str) -> float | None:
    """Highest temperature of the CPU, GPU and package zones; other zones may not be in °C."""
    zones = re.findall(r"^.*(?:cpu|gpu|pkg).* (-?\d+)$", text, re.MULTILINE)
    return max((max(int(value) / 1000.0, -273.0) for value in zones), default=None)


def wifi_of(text: str) -> list[Facts]:
    """Parse the output of `_WIFI`: /proc/net/wireless, then `iw`'s output for each interface."""
    table, *blocks = re.split(r"^interface: ", text, flags=re.MULTILINE)
    levels = wireless(table)
    found = {}
    for block in blocks:
        name, _, output = block.partition("\n")
        link = iw_link(output) | iw_survey(output) | {"name": name}
        if link["signal_dbm"] is None:
            link["signal_dbm"] = levels.get(name)
        save = group(r"Power save: (on|off)", output)
        link["power_save"] = None if save is None else save == "on"
        found[name] = link
    return [found[name] for name in sorted(found)]


def wireless(text: str) -> dict[str, float | None]:
    """Parse /proc/net/wireless: signal level by interface, dBm; None if it is in another unit."""
    found = re.findall(r"^\s*(\S+):\s+[0-9a-f]+\s+\S+\s+(-?\d+)", text, re.MULTILINE)
    return {name: float(level) if float(level) < 0.0 else None for name, level in found}


def iw_link(text: str) -> Facts:
    """Parse `iw dev NAME link`; `connected` is None if unknown."""
    joined = group(r"^(Connected to|Joined IBSS|Not connected)", text)
    return {
        "connected": None if joined is None else joined != "Not connected",
        "network": group(r"^\s*SSID: (.+)$", text),
        "signal_dbm": number(group(r"signal: (-?[\d.]+) dBm", text)),
        "rate_mbit_s": number(group(r"tx bitrate: ([\d.]+) MBit/s", text)),
        "frequency_mhz": number(group(r"freq: ([\d.]+)", text)),
    }


def iw_survey(text: str) -> Facts:
    """Parse `iw dev NAME survey dump`: active and busy time of the channel in use, ms.

    None if the driver does not count them.
    """
    blocks = re.split(r"^Survey data from .*$", text, flags=re.MULTILINE)
    used = next((block for block in blocks if re.search(r"frequency:.*\[in use\]", block)), "")
    return {
        "active_ms": number(group(r"channel active time:\s+(\d+) ms", used)),
        "busy_ms": number(group(r"channel busy time:\s+(\d+) ms", used)),
    }


def vision_hub(text: str) -> Facts | None:
    """Parse voxl-vision-hub's configuration: the keys that matter here; None without a file."""
    if not text:
        return None
    try:
        values = json.loads(without_comments(text))
    except ValueError as error:
        return {"problem": f"not JSON: {error}"}
    if not isinstance(values, dict):
        return {"problem": "not a JSON object"}
    keys = ("en_localhost_mavlink_udp", "localhost_udp_port_number", "offboard_mode")
    return {key: values.get(key) for key in keys}


def without_comments(text: str) -> str:
    """Strip C comments, which ModalAI's JSON files may have, outside of strings."""
    pattern = r'("(?:\\.|[^"\\])*")|/\*.*?\*/|//[^\n]*'
    return re.sub(pattern, lambda match: match[1] or " ", text, flags=re.DOTALL)


def units_of(text: str) -> dict[str, Facts]:
    """Parse `systemctl show`, by unit name without ".service"."""
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
    """Parse `docker inspect`; None if it is not its output."""
    try:
        containers = msgspec.json.decode(text, type=list[dict[str, Any]])
    except msgspec.MsgspecError:
        return None
    found = []
    for one in containers:
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
    """First group of the first match, or None."""
    match = re.search(pattern, text, re.MULTILINE)
    return match[1] if match else None


def number(text: str | None) -> float | None:
    """Parse a decimal number; None if it is not one."""
    try:
        return None if text is None else float(text)
    except ValueError:
        return None


def _or_none(text: str) -> str | None:
    return text or None


async def facts(session: Session, directory: str, names: Sequence[str]) -> Facts:
    """Run all probes; `names` are the units to include."""
    there = f"d={directory}; while [ ! -d ${{d:=/}} ]; do d=${{d%/*}}; done"
    disks = f"{there}; df -P -B1 $d /var/lib"
    commands = {"disks": disks} | {name: command for name, (command, _) in _FACTS.items()}
    output = await session.capture(commands)
    found: Facts = {name: parse(output[name]) for name, (_, parse) in _FACTS.items()}
    return found | {"disks": disks_of(output["disks"]), "units": await units(session, names)}


# Fact -> command, and parser of its output.
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
