"""The fleet's members: robots, whose keys stay on them, and ground stations."""

import base64
from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

from edge.core.schema import ConfigError
from edge.drivers.identity_folder import AUTHORITY_PEM, GROUP_KEYS, MEMBERS, read_members
from edge.identity.members import Member, Role
from lpac.fleet.authority import Authority, AuthorityError, create_authority, new_member
from lpac.fleet.hold import Report, hold, visit
from lpac.fleet.program import restart
from lpac.fleet.session import Session
from lpac.fleet.settings import FleetConfig, RobotHost


class Joined(NamedTuple):
    """Outcome for a robot's membership; None: the fleet has no keys."""

    outcome: Literal["done", "was so already"] | None
    new_authority: Path | None


def init(config: FleetConfig, operator: str) -> Authority:
    """Make the fleet's authority, and this computer an operator's.

    Raises AuthorityError if the fleet has one here, or needs none; OSError.
    """
    authority = create_authority(_folder(config), config.fleet)
    new_member(authority, authority.folder, Role.OPERATOR, operator)
    return authority


def open_authority(config: FleetConfig) -> Authority:
    """The fleet's authority. Raises AuthorityError."""
    return Authority(_folder(config), config.fleet)


def _folder(config: FleetConfig) -> Path:
    if config.keys is None:
        why = "insecure = true" if config.insecure else "all of it is on this computer"
        raise AuthorityError(f"{config.path}: fleet {config.fleet} has no keys: {why}")
    return config.keys


async def join(
    session: Session, config: FleetConfig, robot: RobotHost, operator: Callable[[], str]
) -> Joined:
    """See that the robot is a member with the key that is on it; the session has its lock.

    The first robot makes the authority, with `operator` as this computer's name.
    Raises FleetError, AuthorityError or OSError.
    """
    if config.keys is None:
        return Joined(None, None)
    new = None if config.keys.exists() else config.keys
    authority = open_authority(config) if new is None else init(config, operator())
    found = await session.call("identity_key", fresh=False)
    public_key = bytes.fromhex(found["public_key"])
    member = Member(Role.ROBOT, robot.name, robot.robot_id, public_key)
    files = authority.files(member)
    if member in authority.members.members and found["authority"] == _text(files[AUTHORITY_PEM]):
        await bring_members(session, config)
        return Joined("was so already", new)
    issued = authority.issue(Role.ROBOT, robot.name, public_key, robot.robot_id)
    await _write_member(session, robot, issued.files, fresh=False)
    return Joined("done", new)


async def renew_key(config: FleetConfig, robot: RobotHost, report: Report) -> None:
    """Give the robot a new key, and start its program again if it ran; the group's stays.

    Raises FleetError if it flies, AuthorityError or OSError.
    """
    authority = open_authority(config)
    async with hold(config, robot, report) as (session, found, _):
        made = bytes.fromhex((await session.call("identity_key", fresh=True))["public_key"])
        issued = authority.issue(
            Role.ROBOT, robot.name, made, robot.robot_id, renew_group_key=False
        )
        await _write_member(session, robot, issued.files, fresh=True)
        if found["service"]["active"] == "active":
            await restart(session, config, robot, in_flight=False)


async def bring_members(session: Session, config: FleetConfig) -> str | None:
    """Bring the robot this computer's list of members, and the group's keys, if it has any.

    Its program takes them up by itself, also in flight. What was done, None if nothing was to do.
    Raises FleetError if the robot's list is newer, ConfigError or OSError.
    """
    if config.keys is None or not (config.keys / MEMBERS).exists():
        return None
    try:
        number = read_members(config.keys).number
    except ValueError as error:
        raise ConfigError(f"{config.keys}: {error}") from None
    files = {
        name: _text((config.keys / name).read_bytes())
        for name in (GROUP_KEYS, MEMBERS)
        if (config.keys / name).exists()
    }
    brought = await session.call("set_members", files=files, number=number)
    return f"it was given the list of members {number}" if brought["changed"] else None


async def bring_members_to(config: FleetConfig, robot: RobotHost, report: Report) -> None:
    """Bring one robot the list, whatever it does. Raises as above, and if it does not answer."""
    async with visit(config, robot, report) as (session, _):
        await bring_members(session, config)


async def _write_member(
    session: Session, robot: RobotHost, files: dict[str, bytes], *, fresh: bool
) -> None:
    texts = {name: _text(data) for name, data in files.items()}
    await session.call("set_member", files=texts, fresh=fresh, mavlink_port=robot.mavlink_port)


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()
