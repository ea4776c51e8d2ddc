"""The robot's unit under systemd: what it says, whether it is well, starting and stopping it."""

import contextlib
import json
import os
import socket
import struct
import time
from typing import Any, Dict, Optional, Tuple

from edge.drivers.px4.raw_mavlink import heartbeat
from lpac.fleet.on_robot.calls import Refused, call, must, run, say, write_whole

UNIT = "lpac-robot.service"
# Lands a vehicle whose program systemd has given up.
LAND_UNIT = "lpac-land.service"
UNIT_PATH = "/etc/systemd/system/"

# The program says how it is four times a second.
_STATUS_FRESH_S = 2.0
# By then it must be well, and for so long without a restart.
_HEALTHY_S = 40.0
_STEADY_S = 2.0
# PX4 sends heartbeats at 1 Hz.
_HEARTBEAT_WAIT_S = 2.5
_IP = 0x0800

_PROPERTIES = (
    "LoadState,ActiveState,Result,NRestarts,StatusText,InvocationID,UnitFileState,"
    "ActiveEnterTimestampMonotonic"
)


@call
def service() -> Dict[str, Any]:
    """State of the unit by systemd, and the program's own last words (`status`, None if none).

    `fresh` tells whether the program is running and said so within the last seconds.
    """
    lines = must(["systemctl", "show", UNIT, "--no-pager", "-p", _PROPERTIES]).split("\n")
    values = dict(line.split("=", 1) for line in lines if "=" in line)
    status = _parsed(values.get("StatusText", ""))
    now_s = time.monotonic()
    age_s = None if status is None else now_s - float(status["monotonic_s"])
    active = values.get("ActiveState") == "active"
    started_s = int(values.get("ActiveEnterTimestampMonotonic") or 0) / 1e6
    return {
        "active": values.get("ActiveState", "unknown"),
        "result": values.get("Result", ""),
        "restarts": int(values.get("NRestarts") or 0),
        "enabled": values.get("UnitFileState") == "enabled",
        "installed": values.get("LoadState") not in (None, "", "not-found"),
        "invocation": values.get("InvocationID", ""),
        "uptime_s": now_s - started_s if active else None,
        "status": status,
        "fresh": active and age_s is not None and -1.0 < age_s < _STATUS_FRESH_S,
    }


def refuse_in_flight(mavlink_port: int, doing: str) -> None:
    """Raises Refused if the vehicle is armed, as far as anybody on the robot can tell."""
    if armed(mavlink_port):
        raise Refused("the vehicle is armed: %s is refused until it is disarmed" % doing)


def armed(mavlink_port: int) -> bool:
    """Whether the vehicle's motors may turn, by the robot's program or else by the vehicle itself.

    A program that runs but has fallen silent may have an armed vehicle: its last word counts. If it
    had lost the vehicle by then, the vehicle's own word counts first.
    """
    state = service()
    status = {}  # type: Dict[str, Any]
    if state["active"] in ("active", "reloading", "deactivating"):
        status = state["status"] or {}
    if status.get("autopilot") and status.get("armed") is not None:
        return bool(status["armed"])
    heartbeat = hear_heartbeat(mavlink_port)
    return bool((status if heartbeat is None else heartbeat).get("armed"))


def hear_heartbeat(port: int, wait_s: float = _HEARTBEAT_WAIT_S) -> Optional[Dict[str, Any]]:
    """The first heartbeat of an autopilot that comes to the UDP port of this host, None if none.

    `sender` is the address and the port that it came from; another computer's counts only if none
    of this one's came in that time. Whoever has the port notices nothing.
    """
    from_elsewhere = None
    kind = socket.SOCK_DGRAM  # IP packets, without the frames around them
    with contextlib.closing(socket.socket(socket.AF_PACKET, kind, socket.htons(_IP))) as packets:
        until_s = time.monotonic() + wait_s
        while True:
            left_s = until_s - time.monotonic()
            if left_s <= 0.0:
                return from_elsewhere
            packets.settimeout(left_s)
            try:
                packet = packets.recv(65535)
            except socket.timeout:
                return from_elsewhere
            beat = heartbeat(_datagram(packet, port))
            if beat is None:
                continue
            found = dict(beat._asdict(), sender=_sender(packet))
            if found["sender"][0].startswith("127."):
                return found
            from_elsewhere = from_elsewhere or found


def _datagram(packet: bytes, port: int) -> bytes:
    """Payload of an IPv4 packet to a UDP port; empty if it is another packet."""
    header = 4 * (packet[0] & 0x0F) if packet else 0
    if header < 20 or len(packet) < header + 8 or packet[9] != socket.IPPROTO_UDP:
        return b""
    _, destination = struct.unpack_from("!HH", packet, header)
    return packet[header + 8 :] if destination == port else b""


def _sender(packet: bytes) -> Tuple[str, int]:
    (port,) = struct.unpack_from("!H", packet, 4 * (packet[0] & 0x0F))
    return socket.inet_ntoa(packet[12:16]), port


@call
def start(directory: str) -> Dict[str, Any]:
    """Start the unit now and at every boot, and wait until the program is well."""
    if not os.path.exists(os.path.join(directory, "current", "robot.toml")):
        raise Refused("there is no release for a slot on this robot: deploy first")
    run(["systemctl", "reset-failed", UNIT])
    must(["systemctl", "enable", UNIT])
    # A program that cannot start shows in its health, with the reason.
    run(["systemctl", "start", UNIT], timeout_s=90.0)
    problem = unhealthy()
    if problem is not None:
        raise Refused("it does not run well: %s" % problem)
    return service()


@call
def stop(mavlink_port: int, in_flight: bool, disable: bool) -> Dict[str, Any]:
    """Stop the unit; a vehicle in flight holds or lands then, as its `on_stop` says.

    Refused while the vehicle is armed unless `in_flight` insists. With `disable` it does not start
    at the next boot either.
    """
    if not in_flight:
        refuse_in_flight(mavlink_port, "stopping")
    if service()["installed"]:
        must(["systemctl", "stop", UNIT])
        if disable:
            must(["systemctl", "disable", UNIT])
    return service()


@call
def restart(directory: str, mavlink_port: int, in_flight: bool) -> Dict[str, Any]:
    """Stop and start the unit."""
    stop(mavlink_port, in_flight, disable=False)
    return start(directory)


@call
def last_words() -> Dict[str, Any]:
    """`text`: what the program last said of why it does not run."""
    return {"text": _reason()}


def unhealthy() -> Optional[str]:
    """Why the program does not run well 40 s from now, None once it has for a few seconds.

    Well means: systemd has it active without a restart, all its loops tick without new failures,
    and it has joined the radio link. Vehicle, GPS and battery are preflight's matter.
    """
    until_s = time.monotonic() + _HEALTHY_S
    first = None  # type: Optional[Dict[str, Any]]
    first_s = 0.0
    restarts = service()["restarts"]
    while True:
        now = service()
        problem = _problem(now)
        if problem is None and (first is None or _restarted(first, now)):
            first, first_s = now, time.monotonic()
        if problem is None and first is not None:
            problem = _loop_problem(first["status"]["loops"], now["status"]["loops"])
            if problem is None and time.monotonic() - first_s >= _STEADY_S:
                return None
        hopeless = now["active"] == "failed" or now["restarts"] >= restarts + 2
        if hopeless or time.monotonic() > until_s:
            return "%s; %s" % (problem or "it runs for too short a time", _reason())
        time.sleep(0.25)


def _problem(now: Dict[str, Any]) -> Optional[str]:
    if now["active"] != "active":
        return "the unit is %s (%s)" % (now["active"], now["result"])
    if not now["fresh"]:
        return "the program says nothing"
    if not now["status"]["link"]:
        return "the radio link is not open"
    return None


def _restarted(first: Dict[str, Any], now: Dict[str, Any]) -> bool:
    return bool(now["status"]["boot_nonce"] != first["status"]["boot_nonce"])


def _loop_problem(before: Dict[str, Any], now: Dict[str, Any]) -> Optional[str]:
    for name in sorted(now):
        if now[name]["failures"] > before[name]["failures"]:
            return "its %s loop fails" % name
        if now[name]["ticks"] <= before[name]["ticks"]:
            return "its %s loop does not tick" % name
    return None


def _reason() -> str:
    """The program's last line that says why it does not run, from the journal."""
    shown = run(["journalctl", "-u", UNIT, "-n", "20", "-o", "cat", "--no-pager"])
    for line in reversed(shown.stdout.split("\n")):
        if line.startswith("lpac: "):
            return "it says: %s" % line
        if line.startswith("{"):
            try:
                event = json.loads(line)
            except ValueError:
                continue
            if event.get("level") in ("error", "critical"):
                return "it says: %s" % event.get("event")
    return "see `lpac fleet logs`"


def install_unit(directory: str, release: str) -> None:
    """Make the release's unit files, and their drop-ins if it has any, systemd's."""
    # The unit mounts the image over it.
    os.makedirs(os.path.join(directory, "sandbox"), mode=0o755, exist_ok=True)
    changed = False
    for unit in (UNIT, LAND_UNIT):
        conf = unit.replace(".service", ".conf")
        for name, target in ((unit, unit), (conf, os.path.join(unit + ".d", conf))):
            changed = _install(os.path.join(release, name), UNIT_PATH + target) or changed
    if changed:
        must(["systemctl", "daemon-reload"])


def run_now() -> Optional[str]:
    """Restart the unit, also at every boot; why the program does not run well then."""
    say("restart")
    run(["systemctl", "reset-failed", UNIT])
    must(["systemctl", "enable", UNIT])
    former = service()["invocation"]
    # A program that cannot start shows in its health, with the reason.
    run(["systemctl", "restart", UNIT], timeout_s=90.0)
    if former and service()["invocation"] == former:
        return "it was not restarted: see `systemctl status lpac-robot` on the robot"
    say("health")
    return unhealthy()


def halt() -> None:
    """Stop the unit, now and at boot, if it is there."""
    run(["systemctl", "disable", "--now", UNIT])


def _install(source: str, target: str) -> bool:
    """Copy the file, or remove what an earlier release had of it; whether that changed anything."""
    if not os.path.exists(source):
        if not os.path.exists(target):
            return False
        os.unlink(target)
        return True
    os.makedirs(os.path.dirname(target), exist_ok=True)
    with open(source, "rb") as file:
        data = file.read()
    if os.path.exists(target):
        with open(target, "rb") as file:
            if file.read() == data:
                return False
    write_whole(target, data)
    return True


def _parsed(text: str) -> Optional[Dict[str, Any]]:
    try:
        status = json.loads(text)
    except ValueError:
        return None
    return status if isinstance(status, dict) and "monotonic_s" in status else None
