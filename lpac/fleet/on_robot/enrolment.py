"""Enrolment of a computer as a robot of a fleet; each step may be repeated."""

import base64
import binascii
import json
import os
import shutil
import time
from typing import Any, Dict, List, Optional

from lpac.fleet.on_robot import probes, releases, service, signatures
from lpac.fleet.on_robot.calls import Refused, call, must, reason, say, write_whole

_IDENTITY = "/etc/lpac/robot.json"
# As `edge.drivers.identity_folder` reads it; the program sees it below /var/lib/lpac.
_MEMBERSHIP = "/var/lib/private/lpac/identity"
_KEY, _NEXT_KEY, _CARD = "key.pem", "next-key.pem", "identity.json"
_AUTHORITY, _GROUP_KEYS = "authority.pem", "group-keys"
# Bridges PX4 to DDS: through it a predecessor's program commands the vehicle.
_DDS_AGENT = "voxl-microdds-agent"
# What else of ModalAI's may send setpoints.
_BRIDGES = ("voxl-mpa-to-ros", "voxl-mpa-to-ros2")
_VISION_HUB = "voxl-vision-hub"
_PX4 = "voxl-px4"
# PX4 writes changed parameters to its file up to two seconds later.
_PARAMETERS_SAVED_S = 3.0
# Until PX4, its MAVLink server and voxl-vision-hub are there again.
_PX4_STARTS_S = 40.0


@call
def set_identity(fleet: str, robot: str, robot_id: int, rename: bool) -> Dict[str, Any]:
    """Write who this robot is. Raises Refused if it is another one, unless `rename` insists."""
    wanted = {"fleet": fleet, "robot": robot, "robot_id": robot_id}
    found = releases.identity()
    if found == wanted:
        return {"changed": False, "former": None}
    former = None
    if found is not None:
        former = "%s of fleet %s (id %s)" % tuple(map(found.get, ("robot", "fleet", "robot_id")))
        if not rename:
            raise Refused("it is enrolled as %s: if it is to be %s, add --yes" % (former, robot))
    os.makedirs(os.path.dirname(_IDENTITY), mode=0o755, exist_ok=True)
    write_whole(_IDENTITY, (json.dumps(wanted) + "\n").encode())
    return {"changed": True, "former": former}


@call
def identity_key(fresh: bool) -> Dict[str, Any]:
    """The public key of this robot, whose secret key is made here and never leaves.

    With `fresh` it is another one than before, which counts once `set_card` brings its card.
    Returns the `public_key` in hexadecimal digits, the text of the `card` that is there, None
    unless the robot knows by whom releases are signed, too, and the SHA-256 of the `group_keys`
    that are, in hexadecimal digits.
    """
    _make_identity()
    key = os.path.join(_MEMBERSHIP, _NEXT_KEY if fresh else _KEY)
    if fresh or not os.path.exists(key):
        made = must(["openssl", "genpkey", "-algorithm", "ed25519"])
        write_whole(key, made.encode(), 0o600)
        _own_identity()
    pem = must(["openssl", "pkey", "-in", key, "-pubout"])
    der = base64.b64decode("".join(pem.strip().split("\n")[1:-1]))
    card = None
    paths = (os.path.join(_MEMBERSHIP, _CARD), signatures.AUTHORITY)
    if all(map(os.path.exists, paths)):
        with open(os.path.join(_MEMBERSHIP, _CARD)) as file:
            card = file.read()
    # An Ed25519 key is the last 32 bytes of its DER (RFC 8410).
    public_key = binascii.hexlify(der[-32:]).decode()
    return {"public_key": public_key, "card": card, "group_keys": probes.group_keys_sha256()}


@call
def set_card(files: Dict[str, str], fresh: bool, mavlink_port: int) -> Dict[str, Any]:
    """Write what the fleet's authority gave for the key, `fresh` or not; by name, in base64.

    The robot's program reads it when it starts.
    """
    releases.require_lock()
    service.refuse_in_flight(mavlink_port, "a new card")
    _make_identity()
    if fresh:
        os.replace(os.path.join(_MEMBERSHIP, _NEXT_KEY), os.path.join(_MEMBERSHIP, _KEY))
    for name, text in sorted(files.items()):
        if os.path.basename(name) != name:
            raise Refused("%r is no file's name" % name)
        write_whole(os.path.join(_MEMBERSHIP, name), base64.b64decode(text), 0o600)
    _own_identity()
    signatures.trust_authority(base64.b64decode(files[_AUTHORITY]))
    return {}


@call
def set_group_keys(text: str, mavlink_port: int) -> Dict[str, Any]:
    """Write the fleet's keys of its multicast group, in base64, which the program starts with."""
    releases.require_lock()
    service.refuse_in_flight(mavlink_port, "a new key of the group")
    _make_identity()
    write_whole(os.path.join(_MEMBERSHIP, _GROUP_KEYS), base64.b64decode(text), 0o600)
    _own_identity()
    return {}


def _make_identity() -> None:
    # As systemd makes it for a DynamicUser=.
    os.makedirs("/var/lib/private", mode=0o700, exist_ok=True)
    os.makedirs(_MEMBERSHIP, mode=0o700, exist_ok=True)


def _own_identity() -> None:
    """For the program's user, who owns the folder around, or will when it starts first."""
    owner = os.stat(os.path.dirname(_MEMBERSHIP))
    for path in [_MEMBERSHIP, *(os.path.join(_MEMBERSHIP, n) for n in os.listdir(_MEMBERSHIP))]:
        os.chown(path, owner.st_uid, owner.st_gid, follow_symlinks=False)


@call
def set_vision_hub(mavlink_port: int) -> Dict[str, Any]:
    """Let voxl-vision-hub forward MAVLink to this host, and send no setpoints of its own.

    Returns whether it is `there` at all, what was `changed`, and whether it was `restarted`.
    """
    path = probes.VISION_HUB
    if not os.path.exists(path):
        return {"there": False, "changed": [], "restarted": False}
    with open(path) as file:
        text = file.read()
    try:
        values = json.loads(probes.without_comments(text))
    except ValueError as error:
        raise Refused(
            "%s is no JSON (%s): mend it, or remove it and reinstall" % (path, error)
        ) from None
    if not isinstance(values, dict):
        raise Refused("%s is no JSON object: mend it, or remove it and reinstall" % path)
    changes = []
    wanted = [("en_localhost_mavlink_udp", True), ("offboard_mode", "off")]
    if "localhost_udp_port_number" in values:
        wanted.append(("localhost_udp_port_number", mavlink_port))
    for key, value in wanted:
        if values.get(key) != value:
            changes.append("%s from %s to %s" % (key, *map(json.dumps, (values.get(key), value))))
            values[key] = value
    is_active = _unit(_VISION_HUB)["active"]
    if changes:
        service.refuse_in_flight(mavlink_port, "changing voxl-vision-hub")
        if not os.path.exists(path + ".before-lpac"):
            shutil.copy2(path, path + ".before-lpac")
        write_whole(path, (json.dumps(values, indent=4) + "\n").encode())
        if is_active:
            must(["systemctl", "restart", _VISION_HUB])
    return {"there": True, "changed": changes, "restarted": bool(changes) and is_active}


@call
def retire(predecessors: List[str], mavlink_port: int) -> Dict[str, Any]:
    """Stop containers and units that must not command the vehicle any more, also at boot.

    Nothing is deleted. Returns what was `stopped`, what runs that may send setpoints too
    (`suspects`), with what to do, and whether the containers were looked at (`saw_containers`).
    """
    known = probes.known_containers()
    containers = known or []
    by_name = {container["name"]: container for container in containers}
    stopped = []
    for name in [*predecessors, _DDS_AGENT]:
        container, unit = by_name.get(name), _unit(name)
        if container and (container["running"] or container["restarts"] != "no"):
            service.refuse_in_flight(mavlink_port, "stopping %s" % name)
            say("stops %s" % name)
            must(["docker", "update", "--restart=no", name])
            must(["docker", "stop", name])
            stopped.append("container %s" % name)
        if unit["active"] or unit["enabled"]:
            service.refuse_in_flight(mavlink_port, "stopping %s" % name)
            say("stops %s" % name)
            must(["systemctl", "disable", "--now", name])
            stopped.append("unit %s" % name)
    suspects = [
        "container %s (%s) runs in this host's network: if it commands the vehicle, add it to "
        "predecessors" % (container["name"], container["image"])
        for container in containers
        if container["running"] and container["host_network"]
        if container["name"] not in predecessors
    ]
    suspects += [
        "unit %s runs: if it sends setpoints, add it to predecessors" % name
        for name in _BRIDGES
        if name not in predecessors and _unit(name)["active"]
    ]
    return {"stopped": stopped, "suspects": suspects, "saw_containers": known is not None}


@call
def set_up_px4(
    directory: str,
    url: str,
    mavlink_port: int,
    system_id: int,
    rc: str,
    ceiling_m: float,
    command_timeout_s: float,
) -> Dict[str, Any]:
    """Set the vehicle's system id and failsafe parameters by the current release's own program.

    The robot's program stands still meanwhile. PX4 is restarted where that is needed and systemd
    runs it: `restarted`. `needs_reboot` says that somebody has to do it by hand.
    """
    releases.require_lock()
    service.refuse_in_flight(mavlink_port, "setting up PX4")
    program_runs = service.service()["active"] in ("active", "activating", "reloading")
    if program_runs:
        say("stops the program")
        service.stop(mavlink_port, in_flight=False, disable=False)
    try:
        say("sets PX4's parameters")
        report = _setup(directory, url, system_id, rc, ceiling_m, command_timeout_s)
        report["restarted"] = False
        if report["needs_reboot"] and _unit(_PX4)["active"]:
            say("restarts PX4")
            time.sleep(_PARAMETERS_SAVED_S)
            service.refuse_in_flight(mavlink_port, "restarting PX4")
            must(["systemctl", "restart", _PX4])
            report["system_id"] = _await_px4(mavlink_port, system_id)
            report["restarted"] = True
            report["needs_reboot"] = report["system_id"] != system_id
    finally:
        if program_runs:
            service.start(directory)
    return report


def _setup(
    directory: str,
    url: str,
    system_id: int,
    rc: str,
    ceiling_m: float,
    command_timeout_s: float,
) -> Dict[str, Any]:
    release = os.path.join(directory, "releases", str(releases.linked(directory, "current")))
    command = [
        "/usr/bin/lpac", "robot", "setup", "--json", "--url", url, "--system-id", str(system_id),
        "--rc", rc, "--ceiling", repr(ceiling_m), "--command-timeout", repr(command_timeout_s),
    ]  # fmt: skip
    done = releases.run_inside(release, command)
    try:
        return dict(json.loads(done.stdout))
    except ValueError:
        raise Refused(reason(done).replace("lpac: ", "", 1)) from None


def _await_px4(mavlink_port: int, system_id: int) -> Optional[int]:
    """As which system PX4 answers after its restart; None if it is silent."""
    heard = None  # type: Optional[int]
    until_s = time.monotonic() + _PX4_STARTS_S
    while time.monotonic() < until_s and heard != system_id:
        heartbeat = service.hear_heartbeat(mavlink_port)
        heard = heartbeat["system_id"] if heartbeat else heard
    return heard


def _unit(name: str) -> Dict[str, Any]:
    """Whether a unit is there, runs, and starts at boot."""
    for unit in probes.units(probes.known_units([name])).values():
        return unit
    return {"there": False, "active": False, "enabled": False}
