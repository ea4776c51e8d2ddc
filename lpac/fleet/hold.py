"""A robot for one operator alone: the right one, and nobody else changes it meanwhile."""

import contextlib
import getpass
import json
import os
import socket
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any, NamedTuple

from lpac.fleet.session import RemoteError, Session, connect
from lpac.fleet.settings import FleetConfig, RobotHost

# The step, and the share of it that is done where that is known.
Report = Callable[[str, float | None], None]

_OVERVIEW = {
    "identity": "cat /etc/lpac/robot.json",
    "machine": "uname -m",
    "sudo": "echo $SUDO_UID",
    "current": "readlink current",
    "pending": "cat pending",
    "manifests": "sha256sum releases/*/manifest.json",
    "images": "grep -H '\"image\"' releases/*/versions.json",
    "starts": "ls releases/*/robot.toml",
    "versions": "cat current/versions.json",
    "robot_toml": "sha256sum current/robot.toml",
    "unix_time_s": "date +%s.%N",
}


class Visit(NamedTuple):
    """A session with the right robot, and what was on it."""

    session: Session
    found: dict[str, Any]


class Held(NamedTuple):
    """A session that has the robot's lock, what was on the robot, and what `lock` mended there."""

    session: Session
    found: dict[str, Any]
    recovered: str | None


async def overview(session: Session, config: FleetConfig) -> dict[str, Any]:
    """State of the robot: its identity, releases, versions, unit, disk and clock.

    `releases` are by number, the newest first: their ids, images, and whether a program starts
    (`starts`). `current`, `earlier` and `pending` are ids: of what runs, of what a rollback goes
    back to, and of the one whose switch is not confirmed. `number` is the current one's.
    """
    prefix = f"cd {config.directory} || cd /; "
    said = await session.look({name: prefix + text for name, text in _OVERVIEW.items()})
    ids = {_name(path): digest[:16] for digest, path in _pairs(said["manifests"], "  ")}
    images = {_name(path): text.split('"')[3] for path, text in _pairs(said["images"], ":")}
    starts = {_name(path) for path in said["starts"].split()}
    releases = {
        name: {"id": ids[name], "image": images.get(name), "starts": name in starts}
        for name in sorted(ids, key=_number, reverse=True)
    }
    current, pending = said["current"].rpartition("/")[2], _object(said["pending"])
    earlier = earlier_than(current, releases)
    return {
        "identity": _object(said["identity"]),
        "machine": said["machine"],
        "sudo": bool(said["sudo"]),
        "current": ids.get(current),
        "number": current if current in ids else None,
        "earlier": ids[earlier] if earlier and {current, earlier} <= starts else None,
        "pending": pending and ids.get(pending["release"], pending["release"]),
        "releases": releases,
        "versions": _object(said["versions"]),
        "robot_toml": said["robot_toml"].partition(" ")[0] or None,
        "service": await session.call("service"),
        "unix_time_s": float(said["unix_time_s"]),
    }


def earlier_than(number: str | None, releases: Mapping[str, object]) -> str | None:
    """The newest release that is older than one, None if there is none."""
    names = list(releases)
    return next(iter(names[names.index(number) + 1 :]), None) if number in names else None


def _pairs(text: str, between: str) -> list[tuple[str, str]]:
    parts = [line.partition(between) for line in text.splitlines()]
    return [(before, after) for before, _, after in parts]


def _name(path: str) -> str:
    return path.split("/")[1]


def _number(name: str) -> int:
    return int(name) if name.isdigit() else 0


def _object(text: str) -> dict[str, Any] | None:
    """A JSON object, None if it is none."""
    try:
        found = json.loads(text)
    except ValueError:
        return None
    return found if isinstance(found, dict) else None


@contextlib.asynccontextmanager
async def visit(
    config: FleetConfig, robot: RobotHost, report: Report = lambda *_: None
) -> AsyncIterator[Visit]:
    """Look at the robot without holding it. Raises FleetError if another one answers, or none."""
    report("connect", None)
    async with connect(config, robot, lambda step: report(step, None)) as session:
        found = await overview(session, config)
        check_identity(found["identity"], config, robot)
        yield Visit(session, found)


@contextlib.asynccontextmanager
async def hold(
    config: FleetConfig, robot: RobotHost, report: Report = lambda *_: None
) -> AsyncIterator[Held]:
    """Hold the robot; a switch of releases that was interrupted is finished first.

    Raises FleetError if it does not answer, another robot does, or somebody else holds it.
    """
    async with visit(config, robot, report) as (session, found):
        recovered = await lock(session, config, robot)
        now = found if recovered is None else await overview(session, config)
        yield Held(session, now, recovered)


async def lock(session: Session, config: FleetConfig, robot: RobotHost) -> str | None:
    """Take the robot's lock until the session ends; what an interrupted switch came to, if any."""
    locked = await session.call(
        "lock",
        directory=config.directory,
        who=f"{_user()}@{socket.gethostname()}",
        mavlink_port=robot.mavlink_port,
    )
    recovered: str | None = locked["recovered"]
    return recovered


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # its uid has no name, as in a container
        return f"uid {os.getuid()}"


def check_identity(
    identity: dict[str, object] | None, config: FleetConfig, robot: RobotHost
) -> None:
    """Raises RemoteError if another robot answers at this one's address."""
    wrong = wrong_identity(identity, config, robot)
    if wrong is not None:
        raise RemoteError(": ".join(wrong))


def wrong_identity(
    identity: dict[str, object] | None, config: FleetConfig, robot: RobotHost
) -> tuple[str, str] | None:
    """Describe who answers instead of the robot, and what to do; None if the robot does."""
    if identity is None:
        return "it is not enrolled", f"run `lpac fleet enroll {robot.name} {robot.host}` once"
    other = other_identity(identity, config, robot)
    if other is None:
        return None
    fix = f"mend the host in {config.path.name}, or enroll it"
    return f"at {robot.host} answers {other}", fix


def other_identity(
    identity: dict[str, object] | None, config: FleetConfig, robot: RobotHost
) -> str | None:
    """Words for an identity that is not the robot's; None if it is, or there is none."""
    if identity is None or identity == identity_of(config, robot):
        return None
    return "{} of fleet {} (id {})".format(*map(identity.get, ("robot", "fleet", "robot_id")))


def identity_of(config: FleetConfig, robot: RobotHost) -> dict[str, object]:
    """Identity of the robot, as it is written on it."""
    return {"fleet": config.fleet, "robot": robot.name, "robot_id": robot.robot_id}
