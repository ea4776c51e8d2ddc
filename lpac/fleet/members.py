"""The fleet's members: robots, whose keys stay on them, and ground stations."""

import base64
import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal, NamedTuple

from edge.core.schema import ConfigError
from edge.drivers.identity_folder import (
    AUTHORITY_PEM,
    CERTIFICATE_PEM,
    GROUP_KEYS,
    KEY_PEM,
    MEMBERS,
    read_members,
)
from edge.identity.members import Member, Role, parse_members
from lpac.fleet.authority import Authority, AuthorityError, create_authority, new_member
from lpac.fleet.hold import Report, hold, visit
from lpac.fleet.program import require_disarmed, restart
from lpac.fleet.session import RemoteError, Session
from lpac.fleet.settings import FleetConfig, RobotHost

# As `edge.drivers.identity_folder` reads it; the program sees it below /var/lib/lpac. The names
# are as systemd makes them for a DynamicUser=.
_IDENTITY = "/var/lib/private/lpac/identity"
_NEXT_KEY, _NEXT_CERTIFICATE = "next-key.pem", "next-certificate.pem"


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
    Raises FleetError, also if it is no member yet and flies, AuthorityError or OSError.
    """
    if config.keys is None:
        return Joined(None, None)
    new = None if config.keys.exists() else config.keys
    authority = open_authority(config) if new is None else init(config, operator())
    digests = await _digests(session)
    authority_pem = (authority.folder / AUTHORITY_PEM).read_bytes()
    knows = digests.get(AUTHORITY_PEM) == _sha256(authority_pem)
    if knows and {KEY_PEM, MEMBERS} <= digests.keys():
        member = _member(robot, await _public_key(session, fresh=False))
        if member in authority.members.members:
            await bring_members(session, config)
            return Joined("was so already", new)
    await _admit(session, authority, robot, fresh=False)
    return Joined("done", new)


async def renew_key(config: FleetConfig, robot: RobotHost, report: Report) -> None:
    """Give the robot a new key, and start its program again if it ran; the group's stays.

    Raises FleetError if it flies, AuthorityError or OSError.
    """
    authority = open_authority(config)
    async with hold(config, robot, report) as (session, found, _):
        await _admit(session, authority, robot, fresh=True)
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
        name: (config.keys / name).read_bytes()
        for name in (GROUP_KEYS, MEMBERS)
        if (config.keys / name).exists()
    }
    digests = await _digests(session)
    if MEMBERS not in digests:
        raise RemoteError("it has no key of the fleet: run `lpac fleet enroll`")
    is_same = digests[MEMBERS] == _sha256(files[MEMBERS])
    known = await _list_number(session)
    if known > number or (known == number and not is_same):
        raise RemoteError(
            f"its list of members is number {known}, and this computer's {number} is not newer: "
            "bring `members` from the computer that changed it"
        )
    changed = {name: data for name, data in files.items() if digests.get(name) != _sha256(data)}
    if not changed:
        return None
    await _write(session, changed)
    return f"it was given the list of members {number}"


async def bring_members_to(config: FleetConfig, robot: RobotHost, report: Report) -> None:
    """Bring one robot the list, whatever it does. Raises as above, and if it does not answer."""
    async with visit(config, robot, report) as (session, _):
        await bring_members(session, config)


async def _admit(session: Session, authority: Authority, robot: RobotHost, *, fresh: bool) -> None:
    """Put the robot's key, a `fresh` one or its own, on the list; its program reads it at a start.

    On the list is only a key that the robot has: it takes a fresh one, with its certificate, first.
    A repeat mends what a lost connection left. Raises as `join`.
    """
    await session.call("require_lock")
    await require_disarmed(session, robot, "a new key")
    public_key = await _public_key(session, fresh=fresh)
    if fresh:
        files = authority.files(_member(robot, public_key))
        await _write(session, {_NEXT_CERTIFICATE: files[CERTIFICATE_PEM]})
        await session.must("sh", "-c", f"""cd {_IDENTITY} && mv {_NEXT_KEY} {KEY_PEM} &&
mv {_NEXT_CERTIFICATE} {CERTIFICATE_PEM}""")  # fmt: skip
    issued = authority.issue(
        Role.ROBOT, robot.name, public_key, robot.robot_id, renew_group_key=not fresh
    )
    await _write(session, issued.files)


def _member(robot: RobotHost, public_key: bytes) -> Member:
    return Member(Role.ROBOT, robot.name, robot.robot_id, public_key)


async def _write(session: Session, files: Mapping[str, bytes]) -> None:
    await session.write({f"{_IDENTITY}/{name}": data for name, data in files.items()}, 0o600)


async def _public_key(session: Session, *, fresh: bool) -> bytes:
    """The public key of the robot, whose secret key is made there and never leaves.

    With `fresh` it is another one than before, which counts once `_admit` brings the rest.
    """
    key = _NEXT_KEY if fresh else KEY_PEM
    pem = await session.must("sh", "-c", f"""set -eC; umask 077; mkdir -p {_IDENTITY}
cd {_IDENTITY}; if [ {int(fresh)} = 1 ] || [ ! -e {key} ]; then
    rm -f part; openssl genpkey -algorithm ed25519 > part; sync part; mv part {key}
fi
# For the program's user, who owns the folder around, or will when it starts first.
chown -R --no-dereference --reference=.. .; openssl pkey -in {key} -pubout""")  # fmt: skip
    der = base64.b64decode("".join(pem.strip().splitlines()[1:-1]))
    # An Ed25519 key is the last 32 bytes of its DER (RFC 8410).
    return der[-32:]


async def _digests(session: Session) -> dict[str, str]:
    """The sha256 of each file of the robot's identity, in hexadecimal. Raises as `must`."""
    # Not of what its program replaces meanwhile.
    named = f"-name '*.pem' -o -name {MEMBERS} -o -name {GROUP_KEYS}"
    find = f"find {_IDENTITY} -type f '(' {named} ')' -exec sha256sum {{}} +"
    said = await session.must("sh", "-c", f"[ ! -d {_IDENTITY} ] || {find}")
    return {line.rpartition("/")[2]: line[:64] for line in said.splitlines()}


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


async def _list_number(session: Session) -> int:
    """The number of the robot's list; 0 of one that its program does not take up either."""
    try:
        text = await session.must("cat", f"{_IDENTITY}/{MEMBERS}")
        return parse_members(text).number
    except ValueError:
        return 0
