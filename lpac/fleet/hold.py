"""A robot for one operator alone: the right one, and nobody else changes it meanwhile."""

import contextlib
import getpass
import os
import socket
from collections.abc import AsyncIterator, Callable
from typing import Any, NamedTuple

from lpac.fleet.session import RemoteError, Session, connect
from lpac.fleet.settings import FleetConfig, RobotHost

# The step, and the share of it that is done where that is known.
Report = Callable[[str, float | None], None]


class Visit(NamedTuple):
    """A session with the right robot, and what was on it."""

    session: Session
    found: dict[str, Any]


class Held(NamedTuple):
    """A session that has the robot's lock, what was on the robot, and what `lock` mended there."""

    session: Session
    found: dict[str, Any]
    recovered: str | None


@contextlib.asynccontextmanager
async def visit(
    config: FleetConfig, robot: RobotHost, report: Report = lambda *_: None
) -> AsyncIterator[Visit]:
    """Look at the robot without holding it. Raises FleetError if another one answers, or none."""
    report("connect", None)
    async with connect(config, robot, lambda step: report(step, None)) as session:
        found = await session.call("overview", directory=config.directory)
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
        if recovered is None:
            yield Held(session, found, None)
        else:
            mended = await session.call("overview", directory=config.directory)
            yield Held(session, mended, recovered)


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
    wanted = {"fleet": config.fleet, "robot": robot.name, "robot_id": robot.robot_id}
    if {key: identity.get(key) for key in wanted} == wanted:
        return None
    return (
        f"at {robot.host} answers {identity.get('robot')} of fleet {identity.get('fleet')} "
        f"(id {identity.get('robot_id')})",
        f"mend the host in {config.path.name}, or enroll it",
    )
