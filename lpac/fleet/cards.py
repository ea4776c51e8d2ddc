"""Membership: cards for robots, whose keys stay on them, and for ground stations."""

import base64
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

from edge.identity.card import Role
from lpac.fleet.authority import Authority, AuthorityError, Member, create_authority, new_member
from lpac.fleet.hold import Report, hold
from lpac.fleet.program import restart
from lpac.fleet.session import Session
from lpac.fleet.settings import FleetConfig, RobotHost


class CardGiven(NamedTuple):
    """Outcome for a robot's card; None: the fleet has no keys."""

    outcome: Literal["done", "was so already"] | None
    new_authority: Path | None


def init(config: FleetConfig, operator: str) -> Authority:
    """Make the fleet's authority, and an operator's card for this computer.

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


async def give_card(
    session: Session, config: FleetConfig, robot: RobotHost, operator: Callable[[], str]
) -> CardGiven:
    """See that the robot has a good card, for the key that is on it; the session has its lock.

    The first robot's makes the authority, with `operator` as this computer's name.
    Raises FleetError, AuthorityError or OSError.
    """
    if config.keys is None:
        return CardGiven(None, None)
    new = None if config.keys.exists() else config.keys
    authority = open_authority(config) if new is None else init(config, operator())
    found = await session.call("identity_key", fresh=False)
    known = [m for m in authority.members() if _is_good(m, robot, found["public_key"])]
    if known and authority.identity_json(known[0]).decode() == found["card"]:
        return CardGiven("was so already", new)
    await _write_card(session, authority, robot, found["public_key"], fresh=False)
    return CardGiven("done", new)


async def renew_card(config: FleetConfig, robot: RobotHost, report: Report) -> None:
    """Give the robot a new key and its card, and start its program again if it ran.

    Raises FleetError if it flies, AuthorityError or OSError.
    """
    authority = open_authority(config)
    async with hold(config, robot, report) as (session, found, _):
        made = await session.call("identity_key", fresh=True)
        await _write_card(session, authority, robot, made["public_key"], fresh=True)
        if found["service"]["active"] == "active":
            await restart(session, config, robot, in_flight=False)


def has_group_keys(config: FleetConfig) -> bool:
    """Whether robots need keys of a multicast group, and this computer is where they are made."""
    if config.radio.transport != "multicast" or config.keys is None:
        return False
    try:
        open_authority(config)
    except AuthorityError:
        return False
    return True


async def give_group_keys(session: Session, config: FleetConfig, robot: RobotHost) -> bool:
    """See that the robot has the keys of the fleet's group; the session has its lock.

    Whether it had others. A program that runs is started again, to speak with the new one.
    Raises FleetError if it flies, AuthorityError or OSError.
    """
    keys = open_authority(config).group_keys()
    found = await session.call("identity_key", fresh=False)
    if found["group_keys"] == hashlib.sha256(keys).hexdigest():
        return False
    await session.call(
        "set_group_keys", text=base64.b64encode(keys).decode(), mavlink_port=robot.mavlink_port
    )
    if (await session.call("service"))["active"] == "active":
        await restart(session, config, robot, in_flight=False)
    return True


async def _write_card(
    session: Session, authority: Authority, robot: RobotHost, public_key: str, *, fresh: bool
) -> None:
    issued = authority.issue(Role.ROBOT, robot.name, bytes.fromhex(public_key), robot.robot_id)
    files = {name: base64.b64encode(data).decode() for name, data in issued.files.items()}
    await session.call("set_card", files=files, fresh=fresh, mavlink_port=robot.mavlink_port)


def _is_good(member: Member, robot: RobotHost, public_key: str) -> bool:
    same = (member.name, member.robot_id) == (robot.name, robot.robot_id)
    return same and not member.revoked and member.public_key.hex() == public_key
