"""The robot's end of a session, sent over SSH: Python 3.6 or newer, the standard library alone.

Calls come in as JSON lines; progress and results go out. A call that has begun is carried out
though the laptop has gone: what it does to the robot is then whole. A session ends when its input
ends, or is silent: then the lock that it held is free again.

Here is but what must not depend on the laptop: whether the vehicle is armed, who holds the robot,
and the switch of releases. A release is a folder `releases/NUMBER`, with the hash of every file in
its `manifest.json`; `current` is a symlink to the one that runs, replaced in one step. `pending`
says that a switch is not confirmed yet: whoever takes the lock next confirms it or takes it back.
"""

import base64
import contextlib
import fcntl
import hashlib
import json
import os
import select
import signal
import socket
import stat
import struct
import subprocess
import time
import traceback
from typing import Any, Callable, Dict, List, Optional, Tuple

from edge.drivers.px4.raw_mavlink import heartbeat

UNIT, LAND_UNIT = "lpac-robot.service", "lpac-land.service"
_UNIT_PATH = "/etc/systemd/system/"
_PROPERTIES = (
    "LoadState,ActiveState,Result,NRestarts,StatusText,InvocationID,UnitFileState,"
    "ActiveEnterTimestampMonotonic"
)
# The robot's, whatever folder its releases are in; it can be taken when no disk can be written.
_LOCK = "/run/lpac-fleet.lock"
# The laptop says something every few seconds.
_SILENCE_S = 12.0
# The program says how it is four times a second.
_STATUS_FRESH_S = 2.0
# By then it must be well, and for so long without a restart.
_HEALTHY_S, _STEADY_S = 40.0, 2.0
# PX4 sends heartbeats at 1 Hz.
_HEARTBEAT_WAIT_S = 2.5
_IP = 0x0800
_ARMED = "the vehicle is armed by now: nothing is restarted in flight, and the switch is pending"

Result = Dict[str, Any]
_CALLS = {}  # type: Dict[str, Callable[..., Result]]
_lock = []  # type: List[int]


class Refused(Exception):
    """A request that cannot or must not be carried out; one line says why, and what to do."""


def call(function: Callable[..., Result]) -> Callable[..., Result]:
    """Let the laptop call this function, with arguments and a result that JSON can hold."""
    _CALLS[function.__name__] = function
    return function


def serve() -> None:
    """Answer calls from standard input until it ends or is silent."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    buffer = b""
    while select.select([0], [], [], _SILENCE_S)[0]:
        data = os.read(0, 1 << 16)
        if not data:
            return
        *lines, buffer = (buffer + data).split(b"\n")
        for line in filter(None, lines):
            request = json.loads(line.decode())
            try:
                _send({"result": _CALLS[request["call"]](**request["arguments"])})
            except (Refused, OSError) as error:
                _send({"error": " ".join(str(error).split())})
            except Exception as error:
                # A mistake of ours: the one who reads it needs the place.
                place = traceback.extract_tb(error.__traceback__)[-1]
                _send({"error": "%s: %s (line %s)" % (type(error).__name__, error, place[1])})


def _send(message: Result) -> None:
    data = (json.dumps(message) + "\n").encode()
    try:
        while data:
            data = data[os.write(1, data) :]
    except OSError:
        pass  # Nobody is there any more; the call goes on.


@call
def run(command: List[str], timeout_s: float = 10.0) -> Result:
    """Run a program: its exit `code`, `out`, `err`. Raises Refused if it is missing, or hangs."""
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            encoding="utf-8", errors="replace", timeout=timeout_s, check=False,
        )  # fmt: skip
    except FileNotFoundError:
        raise Refused("the program %s is missing on the robot" % command[0]) from None
    except subprocess.TimeoutExpired:
        raise Refused("%s did not end within %g s" % (" ".join(command[:3]), timeout_s)) from None
    return {"code": done.returncode, "out": done.stdout, "err": done.stderr}


def must(*command: str) -> str:
    """Output of a program. Raises Refused unless it returns 0."""
    done = run(list(command), 60.0)
    if done["code"] != 0:
        raise Refused("%s: %s" % (" ".join(command), " ".join(done["err"].split()) or "fails"))
    return str(done["out"])


@call
def write(files: Dict[str, str], mode: int) -> Result:
    """Write files, their contents in base64, and folders around them."""
    for path, content in files.items():
        os.makedirs(os.path.dirname(path), mode=0o755, exist_ok=True)
        write_whole(path, base64.b64decode(content), mode)
    return {}


def write_whole(path: str, data: bytes, mode: int = 0o644) -> None:
    """Write a file that is the old one or the new one whenever the power goes.

    It is its folder's owner's, who may have put a link there for root to follow.
    """
    part, owner = path + ".part", os.stat(os.path.dirname(path))
    if os.path.lexists(part):
        os.unlink(part)
    with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        os.fchown(file.fileno(), owner.st_uid, owner.st_gid)
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)


@call
def service() -> Result:
    """State of the unit by systemd, and the program's own last words (`status`, None if none).

    `fresh` tells whether the program is running and said so within the last seconds.
    """
    lines = must("systemctl", "show", UNIT, "--no-pager", "-p", _PROPERTIES).split("\n")
    values = dict(line.split("=", 1) for line in lines if "=" in line)
    active, now_s = values.get("ActiveState", "unknown"), time.monotonic()
    started_s = int(values.get("ActiveEnterTimestampMonotonic") or 0) / 1e6
    try:
        status = json.loads(values.get("StatusText", ""))
        age_s = now_s - status["monotonic_s"]
    except (ValueError, KeyError, TypeError):
        status, age_s = None, _STATUS_FRESH_S
    return {
        "active": active,
        "result": values.get("Result", ""),
        "restarts": int(values.get("NRestarts") or 0),
        "enabled": values.get("UnitFileState") == "enabled",
        "installed": values.get("LoadState") not in (None, "", "not-found"),
        "invocation": values.get("InvocationID", ""),
        "uptime_s": now_s - started_s if active == "active" else None,
        "status": status,
        "fresh": active == "active" and -1.0 < age_s < _STATUS_FRESH_S,
    }


@call
def require_disarmed(mavlink_port: int, doing: str) -> Result:
    """Raises Refused if the vehicle is armed, as far as anybody on the robot can tell."""
    if armed(mavlink_port):
        raise Refused("the vehicle is armed: %s is refused until it is disarmed" % doing)
    return {}


def armed(mavlink_port: int) -> bool:
    """Whether the vehicle's motors may turn, by the robot's program or else by the vehicle itself.

    A program that runs but has fallen silent may have an armed vehicle: its last word counts. If it
    had lost the vehicle by then, the vehicle's own word counts first.
    """
    state = service()
    runs = state["active"] in ("active", "reloading", "deactivating")
    status = (state["status"] if runs else None) or {}  # type: Result
    if status.get("autopilot") and status.get("armed") is not None:
        return bool(status["armed"])
    beat = hear_heartbeat(mavlink_port)["heartbeat"]
    return bool((status if beat is None else beat).get("armed"))


@call
def hear_heartbeat(port: int, wait_s: float = _HEARTBEAT_WAIT_S) -> Result:
    """The first `heartbeat` of an autopilot that comes to this host's UDP port, None if none.

    `sender` is the address and the port that it came from; another computer's counts only if none
    of this one's came in that time. Whoever has the port notices nothing.
    """
    heard = None
    kind = socket.SOCK_DGRAM  # IP packets, without the frames around them
    with contextlib.closing(socket.socket(socket.AF_PACKET, kind, socket.htons(_IP))) as packets:
        until_s = time.monotonic() + wait_s
        while time.monotonic() < until_s:
            packets.settimeout(max(1e-3, until_s - time.monotonic()))
            with contextlib.suppress(socket.timeout):
                sender, data = datagram(packets.recv(65535), port)
                beat = heartbeat(data)
                if beat is not None and (heard is None or sender[0].startswith("127.")):
                    heard = dict(beat._asdict(), sender=sender)
                    if sender[0].startswith("127."):
                        break
    return {"heartbeat": heard}


def datagram(packet: bytes, port: int) -> Tuple[Tuple[str, int], bytes]:
    """Sender and payload of an IPv4 packet to a UDP port; the payload of others is empty."""
    header = 4 * (packet[0] & 0x0F) if packet else 0
    if header < 20 or len(packet) < header + 8 or packet[9] != socket.IPPROTO_UDP:
        return ("", 0), b""
    source, destination = struct.unpack_from("!HH", packet, header)
    data = packet[header + 8 :] if destination == port else b""
    return (socket.inet_ntoa(packet[12:16]), source), data


@call
def send(port: int, to: List[Any], content: str) -> Result:
    """Send a datagram, in base64, as the robot's program would: from its port, unless it has it."""
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as udp:
        with contextlib.suppress(OSError):
            udp.bind(("0.0.0.0", port))
        udp.sendto(base64.b64decode(content), tuple(to))
    return {}


@call
def health() -> Result:
    """Return once the program has run well for 2 s; Refused, after 40 s, says why it does not.

    Well means: systemd has it active without a restart, all its loops tick without new failures,
    and it has joined the radio link. Vehicle, GPS and battery are preflight's matter.
    """
    until_s = time.monotonic() + _HEALTHY_S
    first, first_s = {}, 0.0  # type: Result, float
    restarts = service()["restarts"]
    while True:
        now = service()
        problem = _problem(now)
        if problem is None:
            if not first or first["boot_nonce"] != now["status"]["boot_nonce"]:
                first, first_s = now["status"], time.monotonic()
            problem = _loop_problem(first["loops"], now["status"]["loops"])
            if problem is None and time.monotonic() - first_s >= _STEADY_S:
                return {}
        hopeless = now["active"] == "failed" or now["restarts"] >= restarts + 2
        if hopeless or time.monotonic() > until_s:
            why = problem or "it runs for too short a time"
            raise Refused("%s; %s" % (why, last_words()["text"]))
        time.sleep(0.25)


def _problem(now: Result) -> Optional[str]:
    if now["active"] != "active":
        return "the unit is %s (%s)" % (now["active"], now["result"])
    if not now["fresh"]:
        return "the program says nothing"
    return None if now["status"]["link"] else "the radio link is not open"


def _loop_problem(before: Result, now: Result) -> Optional[str]:
    for name in sorted(now):
        if now[name]["failures"] > before[name]["failures"]:
            return "its %s loop fails" % name
        if now[name]["ticks"] <= before[name]["ticks"]:
            return "its %s loop does not tick" % name
    return None


@call
def last_words() -> Result:
    """`text`: the program's last line that says why it does not run, from the journal."""
    shown = run(["journalctl", "-u", UNIT, "-n", "20", "-o", "cat", "--no-pager"])["out"]
    for line in reversed(shown.split("\n")):
        if line.startswith("lpac: "):
            return {"text": "it says: %s" % line}
        with contextlib.suppress(ValueError):
            event = json.loads(line) if line.startswith("{") else {}
            if event.get("level") in ("error", "critical"):
                return {"text": "it says: %s" % event.get("event")}
    return {"text": "see `lpac fleet logs`"}


@call
def lock(directory: str, who: str, mavlink_port: int) -> Result:
    """Hold the robot for this session alone, and finish a switch that was interrupted.

    Returns what came of that (`recovered`). Raises Refused that says who has the robot.
    """
    descriptor = os.open(_LOCK, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        holder = os.pread(descriptor, 200, 0).decode(errors="replace")
        os.close(descriptor)
        raise Refused("%s is changing this robot: wait, then try again" % holder) from None
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, who.encode()[:200], 0)
    _lock.append(descriptor)
    return {"recovered": _recover(directory, mavlink_port)}


@call
def require_lock() -> Result:
    """Raises Refused if this session does not hold the robot."""
    if not _lock:
        raise Refused("lock was not called")
    return {}


@call
def check(folder: str) -> Result:
    """Raises Refused if a file is not what the release's manifest says, or there are others."""
    try:
        with open(os.path.join(folder, "manifest.json"), "rb") as manifest:
            wanted = dict(json.loads(manifest.read().decode())["files"])
    except (ValueError, KeyError, TypeError):
        raise Refused("manifest.json is not whole: deploy again") from None
    found = {}
    for parent, folders, files in os.walk(folder):
        for name in folders + files:
            path = os.path.join(parent, name)
            entry, mode = os.path.relpath(path, folder), os.lstat(path).st_mode
            if stat.S_ISLNK(mode):
                found[entry] = ["link", os.readlink(path)]
            elif not stat.S_ISDIR(mode):
                found[entry] = [oct(stat.S_IMODE(mode)), _sha256(path)]
    del found["manifest.json"]
    for name in sorted(set(wanted) | set(found)):
        if wanted.get(name) != found.get(name):
            raise Refused("%s is not what the release has: deploy again" % name)
    return {}


@call
def switch(directory: str, release: str, mavlink_port: int) -> Result:
    """Run `releases/RELEASE` if its program turns out well; else the former one again.

    One without robot.toml, a spare's, becomes current and nothing is started. Raises Refused if the
    vehicle is armed, also by then, or if the release did not run well, with the reason.
    """
    require_lock()
    check(os.path.join(directory, "releases", release))
    require_disarmed(mavlink_port, "switching")
    former = linked(directory)
    pending = json.dumps({"release": release, "former": former})
    write_whole(os.path.join(directory, "pending"), pending.encode())
    problem = _activate(directory, release, mavlink_port)
    if problem not in (None, _ARMED):
        back = _take_back(directory, former, mavlink_port)
        problem = "%s does not run well (%s); %s" % (_id(directory, release), problem, back)
    if problem is not None:
        raise Refused(problem)
    _settle(directory)
    return {}


def _activate(directory: str, release: str, mavlink_port: int) -> Optional[str]:
    """Check, switch and restart; why the program does not run well then, None if it does."""
    folder, link = os.path.join(directory, "releases", release), os.path.join(directory, "current")
    try:
        check(folder)
        must("ln", "-sfn", os.path.join("releases", release), link + ".part")
        os.replace(link + ".part", link)
        _sync(directory)
        _install_units(directory, folder)
        former = service()["invocation"]
        if armed(mavlink_port):  # All of that may have taken minutes.
            return _ARMED
        if not os.path.exists(os.path.join(folder, "robot.toml")):
            run(["systemctl", "disable", "--now", UNIT])
            return None
        _send({"progress": "restart"})
        run(["systemctl", "reset-failed", UNIT])
        # A program that cannot start shows in its health, with the reason.
        run(["systemctl", "restart", UNIT], 90.0)
        must("systemctl", "enable", UNIT)
        if former and service()["invocation"] == former:
            return "it was not restarted: see `systemctl status lpac-robot` on the robot"
        _send({"progress": "health"})
        health()
        return None
    except (Refused, OSError) as error:
        return str(error)
    except (KeyError, TypeError) as error:
        return "its status cannot be read: %r" % error


def _install_units(directory: str, folder: str) -> None:
    """Make the release's unit files, and their drop-ins if it has any, systemd's."""
    # The unit mounts the image over it.
    os.makedirs(os.path.join(directory, "sandbox"), mode=0o755, exist_ok=True)
    for unit in (UNIT, LAND_UNIT):
        conf = unit.replace(".service", ".conf")
        for name, place in ((unit, unit), (conf, os.path.join(unit + ".d", conf))):
            source, target = os.path.join(folder, name), _UNIT_PATH + place
            if os.path.exists(source):
                os.makedirs(os.path.dirname(target), exist_ok=True)
                with open(source, "rb") as file:
                    write_whole(target, file.read())
            elif os.path.exists(target):
                os.unlink(target)
    must("systemctl", "daemon-reload")


def _take_back(directory: str, former: Optional[str], mavlink_port: int) -> str:
    """Run the former release again; what came of it. The change is settled by that."""
    if armed(mavlink_port):
        return _ARMED
    _send({"progress": "rollback"})
    if former is None:
        run(["systemctl", "disable", "--now", UNIT])
        with contextlib.suppress(FileNotFoundError):
            os.unlink(os.path.join(directory, "current"))
        back = "nothing runs: it was the robot's first release"
    else:
        problem, name = _activate(directory, former, mavlink_port), _id(directory, former)
        if problem == _ARMED:
            return problem
        back = "the robot runs %s again" % name
        if problem is not None:
            back = "%s, to which it was taken back, does not run well either: %s" % (name, problem)
    _settle(directory)
    return back


def _settle(directory: str) -> None:
    """The change is over: nothing of it is pending any more."""
    _sync(directory, _UNIT_PATH)
    with contextlib.suppress(FileNotFoundError):
        os.unlink(os.path.join(directory, "pending"))


def _recover(directory: str, mavlink_port: int) -> Optional[str]:
    """Finish a change that a loss of power, or of its operator, left open; what came of it.

    Never fails, or nothing could be done to the robot any more.
    """
    current = linked(directory)
    try:
        with open(os.path.join(directory, "pending")) as file:
            pending = json.load(file)
        wanted, former = pending["release"], pending["former"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if current is None:
        _settle(directory)
        return None
    _send({"progress": "finish an interrupted switch"})
    name = _id(directory, current)
    problem = _ARMED if armed(mavlink_port) else _activate(directory, current, mavlink_port)
    if problem == _ARMED:
        return "a switch to %s was interrupted; %s" % (_id(directory, wanted), problem)
    ill = "%s does not run well (%s)" % (name, problem)
    end = ill if problem is not None else "the robot runs %s" % name
    if problem is not None and current == wanted and former != current:
        end = "%s; %s" % (end, _take_back(directory, former, mavlink_port))
    else:
        _settle(directory)
    return "an interrupted switch was finished: " + end


def linked(directory: str) -> Optional[str]:
    """The release that is current, None if there is none."""
    try:
        return os.path.basename(os.readlink(os.path.join(directory, "current")))
    except OSError:
        return None


def _id(directory: str, release: str) -> str:
    """A release's name by its content: the beginning of its manifest's hash."""
    path = os.path.join(directory, "releases", release, "manifest.json")
    return _sha256(path)[:16] if os.path.exists(path) else release


def _sha256(path: str) -> str:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        for block in iter(lambda: file.read(1 << 20), b""):
            digest.update(block)
    return digest.hexdigest()


def _sync(*paths: str) -> None:
    """Write out the file systems of these paths; another one's logs may take long."""
    with contextlib.suppress(Refused):
        if run(["sync", "--file-system", *paths], 120.0)["code"] == 0:
            return
    os.sync()
