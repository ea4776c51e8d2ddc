"""Releases on the robot: taking them in, proving them, switching between them.

`current` is what runs, `last-good` what a rollback goes back to. Both are symlinks that are
replaced in one step, and `pending` says that a switch is not confirmed yet: whoever comes next
confirms it or takes it back. What changes releases needs the lock.
"""

import contextlib
import fcntl
import hashlib
import json
import os
import shutil
import stat
import time
from typing import Any, Dict, List, Optional, Set

from lpac.fleet.on_robot import service, signatures
from lpac.fleet.on_robot.calls import Refused, call, must, reason, run, say, write_whole

_MARGIN_BYTES = 100000000
_KEPT = 3
_VERIFY_S = 150.0
# The robot's, whatever folder its releases are in; it can be taken when no disk can be written.
_LOCK = "/run/lpac-fleet.lock"

# Of a release's files: what its manifest cannot have.
_UNLISTED = ("manifest.json", signatures.SIGNATURE)

_lock = []  # type: List[int]


@call
def overview(directory: str) -> Dict[str, Any]:
    """State of the robot: its identity, releases, versions, unit, disk and clock."""
    current = linked(directory, "current")
    versions = _versions(directory, current)
    if versions is not None:
        versions.pop("packages", None)
    return {
        "identity": identity(),
        "machine": os.uname().machine,
        "sudo": os.environ.get("SUDO_UID") is not None,
        "current": current,
        "last_good": linked(directory, "last-good"),
        "pending": _pending(directory),
        "releases": _releases(directory),
        "versions": versions,
        "robot_toml": _configuration(directory),
        "service": service.service(),
        "unix_time_s": time.time(),
    }


def identity() -> Optional[Dict[str, Any]]:
    """Identity that the robot was enrolled with, None if it was not."""
    try:
        with open("/etc/lpac/robot.json") as file:
            found = json.load(file)
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


@call
def lock(directory: str, who: str, mavlink_port: int) -> Dict[str, Any]:
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


def require_lock() -> None:
    """Raises RuntimeError if this session does not hold the robot."""
    if not _lock:
        raise RuntimeError("lock was not called")


@call
def prepare(
    directory: str, release: str, size_bytes: int, image: str, mavlink_port: int
) -> Dict[str, Any]:
    """Make room for a release; what is already here of it need not travel.

    A release that is here, but damaged, is mended. Returns whether it is here whole (`complete`),
    the folder to fill (`incoming`), whether that has the `image` of an earlier release already
    (`has_image`; unchecked), and folders of releases that may hold equal files (`like`).
    Raises Refused if the vehicle is armed, or the disk has no room.
    """
    require_lock()
    service.refuse_in_flight(mavlink_port, "deploying")
    incoming = os.path.join(directory, "incoming")
    target = os.path.join(incoming, release)
    with contextlib.suppress(FileNotFoundError):
        for name in os.listdir(incoming):
            if name != release:
                _remove(os.path.join(incoming, name))
    current = linked(directory, "current")
    answer = {"complete": _is_whole(directory, release, target), "incoming": target}
    # rsync takes at most 20 such folders.
    likely = [current] if current else []
    likely += [name for name in _releases(directory) if name != current]
    answer["like"] = [os.path.join(directory, "releases", name) for name in likely[:_KEPT]]
    if not answer["complete"]:
        os.makedirs(target, exist_ok=True)
        same = [n for n in likely if (_versions(directory, n) or {}).get("image") == image]
        answer["has_image"] = bool(same)
        needed = 0 if same else size_bytes
        needed = max(0, needed - _size(target)) + _MARGIN_BYTES
        free = shutil.disk_usage(directory).free
        if free < needed:
            raise Refused(
                "the disk has %d MB free, and the release needs %d MB: remove old logs, "
                "but not the newest (`lpac fleet pull`, then `lpac fleet exec`)"
                % (free // 1e6, needed // 1e6)
            )
        if same and not os.path.isdir(os.path.join(target, "root")):
            # Links, which take no room.
            must(["cp", "-al", os.path.join(directory, "releases", same[0], "root"), target])
    return answer


def _is_whole(directory: str, release: str, incoming: str) -> bool:
    """Whether the release is here and as it was made; a damaged one is incoming again."""
    path = os.path.join(directory, "releases", release)
    os.makedirs(os.path.dirname(path), exist_ok=True)
    if not os.path.isdir(path):
        return False
    try:
        _check(path, release)
    except (Refused, OSError, ValueError):
        os.makedirs(os.path.dirname(incoming), exist_ok=True)
        _remove(incoming)
        os.rename(path, incoming)
        return False
    return True


@call
def discard(directory: str, release: str) -> Dict[str, Any]:
    """Remove what has come of a release that will not be completed, so that the disk is free."""
    require_lock()
    _remove(os.path.join(directory, "incoming", release))
    return {}


@call
def accept(directory: str, release: str) -> Dict[str, Any]:
    """Check every file that has come against the manifest, and take the release in whole."""
    require_lock()
    incoming = os.path.join(directory, "incoming", release)
    _check(incoming, release)
    _sync_disks(directory)
    os.rename(incoming, os.path.join(directory, "releases", release))
    _sync_folder(os.path.join(directory, "releases"))
    return {}


@call
def sign(directory: str, release: str, signature: Optional[str]) -> Dict[str, Any]:
    """Keep the authority's signature of a release that is here; a robot without one needs none.

    Raises Refused if the robot must not run it: it is not the authority's, or an older one.
    """
    require_lock()
    signatures.sign(os.path.join(directory, "releases", release), signature)
    return {}


@call
def prove(directory: str, release: str) -> Dict[str, Any]:
    """Run the release's own verification of its policy, and its benchmark, on this CPU.

    Raises Refused that says what it does not compute, or that it is too slow.
    """
    require_lock()
    path = os.path.join(directory, "releases", release)
    signatures.require_signed(path, forward=True)
    reports = {}
    for command, options in (("verify", []), ("benchmark", ["--seconds", "1"])):
        say(command)
        lpac = ["/usr/bin/lpac", "bundle", command, "/release/bundle", "--json"]
        done = run_inside(path, [*lpac, *options])
        if done.returncode != 0 and command == "benchmark":
            # Something else may have run beside the first.
            done = run_inside(path, [*lpac, *options])
        if done.returncode != 0:
            raise Refused("bundle %s on the robot: %s" % (command, reason(done)))
        reports[command] = json.loads(done.stdout)
    return reports


@call
def switch(directory: str, release: str, mavlink_port: int) -> Dict[str, Any]:
    """Run this release from now on, if its program turns out well; else the former one again.

    A release without robot.toml, a spare's, becomes current and nothing is started. Raises Refused
    if the vehicle is armed, or if the new release did not run well, with the reason.
    """
    require_lock()
    signatures.require_signed(os.path.join(directory, "releases", release), forward=True)
    _prune(directory, {release})
    service.refuse_in_flight(mavlink_port, "switching")
    former, last_good = linked(directory, "current"), linked(directory, "last-good")
    if not _starts(directory, release):
        last_good = None  # Where a spare once flew, another robot may fly now.
    elif former not in (None, release) and _starts(directory, str(former)):
        last_good = former
    _change(directory, release, last_good, mavlink_port)
    _prune(directory, set())
    return overview(directory)


@call
def rollback(directory: str, mavlink_port: int) -> Dict[str, Any]:
    """Run the last good release again; if it does not run well, the present one."""
    require_lock()
    service.refuse_in_flight(mavlink_port, "rolling back")
    current, last_good = linked(directory, "current"), linked(directory, "last-good")
    if last_good in (None, current) or not _starts(directory, str(last_good)):
        raise Refused("there is no earlier release to go back to")
    signatures.require_signed(os.path.join(directory, "releases", str(last_good)), forward=False)
    _change(directory, str(last_good), last_good, mavlink_port)
    return overview(directory)


def _change(directory: str, release: str, last_good: Optional[str], mavlink_port: int) -> None:
    """Let `release` run, with `last_good` to go back to; or the former one, and raise Refused."""
    pending = {
        "release": release,
        "former": linked(directory, "current"),
        "last_good": last_good,
    }
    write_whole(os.path.join(directory, "pending"), json.dumps(pending).encode())
    problem = _activate(directory, release)
    if problem is not None:
        back = _take_back(directory, pending["former"], mavlink_port)
        raise Refused("%s does not run well (%s); %s" % (release, problem, back))
    _settle(directory, last_good)


def _activate(directory: str, release: str) -> Optional[str]:
    """Switch and restart; why the program does not run well then, None if it does."""
    path = os.path.join(directory, "releases", release)
    _link(directory, "current", release)
    try:
        service.install_unit(directory, path)
        if not _starts(directory, release):
            service.halt()
            return None
        return service.run_now()
    except (Refused, OSError) as error:
        return str(error)


def _take_back(directory: str, former: Optional[str], mavlink_port: int) -> str:
    """Run the former release again; what came of it. The change is settled by that."""
    if service.armed(mavlink_port):
        return "the vehicle is armed by now: nothing is restarted in flight"
    say("rollback")
    if former is None:
        service.halt()
        _unlink(directory, "current")
        back = "nothing runs: it was the robot's first release"
    else:
        problem = _activate(directory, former)
        back = "the robot runs %s again" % former
        if problem is not None:
            back = "%s, to which it was taken back, does not run well either: %s" % (
                former,
                problem,
            )
    _settle(directory, linked(directory, "last-good"))
    return back


def _settle(directory: str, last_good: Optional[str]) -> None:
    """The change is over: nothing of it is pending any more."""
    if last_good is None:
        _unlink(directory, "last-good")
    elif last_good != linked(directory, "last-good"):
        _link(directory, "last-good", last_good)
    _sync_disks(directory, service.UNIT_PATH)
    _unlink(directory, "pending")


def _recover(directory: str, mavlink_port: int) -> Optional[str]:
    """Finish a change that a loss of power, or of its operator, left open; what came of it.

    Never fails, or nothing could be done to the robot any more.
    """
    pending, current = _pending(directory), linked(directory, "current")
    if pending is None:
        return None
    release, former = pending["release"], pending["former"]
    if service.armed(mavlink_port):
        return "a switch to %s was interrupted; nothing is restarted in flight" % release
    last_good = linked(directory, "last-good")
    if current is None:
        _settle(directory, last_good)
        return None
    say("finish an interrupted switch")
    problem = _activate(directory, current)
    if problem is None:
        _settle(directory, pending["last_good"] if current == release else last_good)
        return "an interrupted switch was finished: the robot runs %s" % current
    if current == release and former != release:
        problem = "%s; %s" % (problem, _take_back(directory, former, mavlink_port))
    else:
        _settle(directory, last_good)
    return "an interrupted switch was finished: %s does not run well (%s)" % (current, problem)


def _starts(directory: str, release: str) -> bool:
    return os.path.exists(os.path.join(directory, "releases", release, "robot.toml"))


def _check(folder: str, release: str) -> None:
    """Raises Refused if a file is not what the release's manifest says, or there are others."""
    with open(os.path.join(folder, "manifest.json"), "rb") as file:
        data = file.read()
    if hashlib.sha256(data).hexdigest()[:16] != release:
        raise Refused("the manifest that came is not the release's: deploy again")
    wanted = json.loads(data.decode())["files"]
    found = set()
    for parent, folders, files in os.walk(folder):
        for name in folders + files:
            path = os.path.join(parent, name)
            relative = os.path.relpath(path, folder)
            if relative in _UNLISTED or (os.path.isdir(path) and not os.path.islink(path)):
                continue
            found.add(relative)
            if wanted.get(relative) != _entry(path):
                raise Refused("%s has not come whole: deploy again" % relative)
    if len(found) != len(wanted):
        missing = sorted(set(wanted) - found)[0]
        raise Refused("%s has not come: deploy again" % missing)


def _entry(path: str) -> List[str]:
    """A file's mode and sha256, or a symlink's target, as the manifest has them."""
    info = os.lstat(path)
    if stat.S_ISLNK(info.st_mode):
        return ["link", os.readlink(path)]
    return [oct(stat.S_IMODE(info.st_mode)), sha256(path)]


def sha256(path: str, size_bytes: float = float("inf")) -> str:
    """Of a file's content, or as much of it from its beginning, in hexadecimal."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while True:
            block = file.read(int(min(size_bytes, 1 << 20)))
            if not block:
                return digest.hexdigest()
            digest.update(block)
            size_bytes -= len(block)


def run_inside(release: str, command: List[str], state: str = "") -> Any:
    """Run a program in the release's file system, as the unit does, but before any switch.

    It runs as nobody; with `state`, a folder that it sees at /var/lib and may only read, as root.
    """
    script = (
        'set -e; cd "$1/root"; state=$2; shift 2; mount --bind .. release; '
        "user=--userspec=65534:65534; "
        'if [ "$state" ]; then user=--userspec=0:0; '
        'mount --bind "$state" var/lib; mount -o remount,bind,ro var/lib; fi; '
        "mount -t proc proc proc; mount --rbind /sys sys; mount --rbind /dev dev; "
        'mount -t tmpfs tmpfs tmp; exec nice -n 5 chroot "$user" . "$@"'
    )
    inside = ["unshare", "--mount", "sh", "-c", script, "sh", release, state]
    return run([*inside, *command], _VERIFY_S)


def _prune(directory: str, besides: Set[str]) -> None:
    """Remove the oldest releases; never the current and the last good one."""
    keep = {linked(directory, "current"), linked(directory, "last-good")} | besides
    spare = [name for name in _releases(directory) if name not in keep]
    for name in spare[max(0, _KEPT - len(keep)) :]:
        _remove(os.path.join(directory, "releases", name))


def _releases(directory: str) -> List[str]:
    """The releases that are here whole, the newest first."""
    folder = os.path.join(directory, "releases")
    with contextlib.suppress(FileNotFoundError):
        names = os.listdir(folder)
        return sorted(names, key=lambda n: -os.lstat(os.path.join(folder, n)).st_ctime)
    return []


def _versions(directory: str, release: Optional[str]) -> Optional[Dict[str, Any]]:
    if release is None:
        return None
    try:
        with open(os.path.join(directory, "releases", release, "versions.json")) as file:
            versions = json.load(file)
    except (OSError, ValueError):
        return None
    return versions if isinstance(versions, dict) else None


def _configuration(directory: str) -> Optional[str]:
    """The sha256 of the current release's robot.toml; None if it has none, as a spare's."""
    try:
        return sha256(os.path.join(directory, "current", "robot.toml"))
    except FileNotFoundError:
        return None


def _pending(directory: str) -> Optional[Dict[str, Any]]:
    try:
        with open(os.path.join(directory, "pending")) as file:
            return dict(json.load(file))
    except (OSError, ValueError):
        return None


def linked(directory: str, name: str) -> Optional[str]:
    """The release that a symlink names, None if there is none."""
    try:
        return os.path.basename(os.readlink(os.path.join(directory, name)))
    except OSError:
        return None


def _link(directory: str, name: str, release: str) -> None:
    part = os.path.join(directory, name + ".part")
    with contextlib.suppress(FileNotFoundError):
        os.unlink(part)
    os.symlink(os.path.join("releases", release), part)
    os.replace(part, os.path.join(directory, name))
    _sync_folder(directory)


def _unlink(directory: str, name: str) -> None:
    with contextlib.suppress(FileNotFoundError):
        os.unlink(os.path.join(directory, name))


def _sync_disks(*paths: str) -> None:
    """Write out the file systems of these paths; another one's logs may take long."""
    with contextlib.suppress(Refused):
        if run(["sync", "--file-system", *paths], timeout_s=120.0).returncode == 0:
            return
    os.sync()


def _sync_folder(path: str) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _remove(path: str) -> None:
    """Remove a release: first its name, so that no half of one is ever taken for whole."""
    parent, name = os.path.split(path)
    gone = os.path.join(os.path.dirname(parent), "incoming", name + ".gone")
    with contextlib.suppress(FileNotFoundError):
        os.makedirs(os.path.dirname(gone), exist_ok=True)
        os.rename(path, gone)
        shutil.rmtree(gone)


def _size(path: str) -> int:
    total = 0
    for parent, _, files in os.walk(path):
        for name in files:
            with contextlib.suppress(OSError):
                total += os.lstat(os.path.join(parent, name)).st_size
    return total
