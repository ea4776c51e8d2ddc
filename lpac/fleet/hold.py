"""Sessions with the right robot, with or without its lock."""

import contextlib
import getpass
import json
import os
import socket
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any, NamedTuple

from lpac.fleet.session import RemoteError, Session, connect
from lpac.fleet.settings import FleetConfig, RobotHost

# Called with a step and the share of it that is done (0 to 1), None if unknown.
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
    """Session with a robot, and its `overview`."""

    session: Session
    found: dict[str, Any]


class Held(NamedTuple):
    """Session that holds the robot's lock, its `overview`, and the result of `lock`."""

    session: Session
    found: dict[str, Any]
    recovered: str | None


async def overview(session: Session, config: FleetConfig) -> dict[str, Any]:
    """State of the robot: identity, releases, versions, unit and clock.

    `releases` maps numbers, the newest first, to `id`, `image`, and `starts` (whether it has a
    program to start). `current`, `earlier` (the target of a rollback) and `pending` (a switch that
    is not confirmed) are ids. `number` is the current release's.
    """
    prefix = f"cd {config.directory} || cd /; "
    output = await session.capture({name: prefix + text for name, text in _OVERVIEW.items()})
    ids = {_name(path): digest[:16] for digest, path in _pairs(output["manifests"], "  ")}
    images = {_name(path): text.split('"')[3] for path, text in _pairs(output["images"], ":")}
    starts = {_name(path) for path in output["starts"].split()}
    releases = {
        name: {"id": ids[name], "image": images.get(name), "starts": name in starts}
        for name in sorted(ids, key=_number, reverse=True)
    }
    current, pending = output["current"].rpartition("/")[2], json_object(output["pending"])
    earlier = earlier_than(current, releases)
    return {
        "identity": json_object(output["identity"]),
        "machine": output["machine"],
        "sudo": bool(output["sudo"]),
        "current": ids.get(current),
        "number": current if current in ids else None,
        "earlier": ids[earlier] if earlier and {current, earlier} <= starts else None,
        "pending": pending and ids.get(pending["release"], pending["release"]),
        "releases": releases,
        "versions": json_object(output["versions"]),
        "robot_toml": output["robot_toml"].partition(" ")[0] or None,
        "service": await session.call("service"),
        "unix_time_s": float(output["unix_time_s"]),
    }


def earlier_than(number: str | None, releases: Mapping[str, object]) -> str | None:
    """Newest release that is older than `number`, or None."""
    names = list(releases)
    return next(iter(names[names.index(number) + 1 :]), None) if number in names else None


def _pairs(text: str, between: str) -> list[tuple[str, str]]:
    parts = [line.partition(between) for line in text.splitlines()]
    return [(before, after) for before, _, after in parts]


def _name(path: str) -> str:
    return path.split("/")[1]


def _number(name: str) -> int:
    return int(name) if name.isdigit() else 0


def json_object(text: str) -> dict[str, Any] | None:
    """Parse a JSON object; None if it is not one."""
    try:
        found = json.loads(text)
    except ValueError:
        return None
    return found if isinstance(found, dict) else None


@contextlib.asynccontextmanager
async def visit(
    config: FleetConfig, robot: RobotHost, report: Report = lambda *_: None
) -> AsyncIterator[Visit]:
    """Open a session without the lock.

    Raises FleetError if the robot does not answer or another one does.
    """
    report("connect", None)
    async with connect(config, robot, lambda step: report(step, None)) as session:
        found = await overview(session, config)
        check_identity(found["identity"], config, robot)
        yield Visit(session, found)


@contextlib.asynccontextmanager
async def hold(
    config: FleetConfig, robot: RobotHost, report: Report = lambda *_: None
) -> AsyncIterator[Held]:
    """Open a session with the lock; an interrupted switch of releases is finished first.

    Raises FleetError if the robot does not answer, another one does, or it is locked.
    """
    async with visit(config, robot, report) as (session, found):
        recovered = await lock(session, config, robot)
        now = found if recovered is None else await overview(session, config)
        yield Held(session, now, recovered)


async def lock(session: Session, config: FleetConfig, robot: RobotHost) -> str | None:
    """Take the robot's lock until the session ends; return the result of an interrupted switch."""
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
    except (KeyError, OSError):  # The uid has no name, as in a container.
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
    """Other robot that answers at the address, and the remedy; None if the right one answers."""
    if identity is None:
        return "it is not enrolled", f"run `lpac fleet enroll {robot.name} {robot.host}` once"
    other = other_identity(identity, config, robot)
    if other is None:
        return None
    fix = f"correct the host in {config.path.name}, or enroll it"
    return f"at {robot.host} answers {other}", fix


def other_identity(
    identity: dict[str, object] | None, config: FleetConfig, robot: RobotHost
) -> str | None:
    """Describe an identity that is not the robot's; None if it is, or there is none."""
    if identity is None or identity == identity_of(config, robot):
        return None
    return "{} of fleet {} (id {})".format(*map(identity.get, ("robot", "fleet", "robot_id")))


def identity_of(config: FleetConfig, robot: RobotHost) -> dict[str, object]:
    """Identity as written to the robot's /etc/lpac/robot.json."""
    return {"fleet": config.fleet, "robot": robot.name, "robot_id": robot.robot_id}
