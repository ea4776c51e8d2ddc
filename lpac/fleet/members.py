"""Membership of the fleet's robots. A robot's secret key is made on it and never leaves."""

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

# The host's path for a unit with DynamicUser=; the robot's program finds it below /var/lib/lpac
# (`edge.drivers.identity_folder`).
_IDENTITY = "/var/lib/private/lpac/identity"
_NEXT_KEY, _NEXT_CERTIFICATE = "next-key.pem", "next-certificate.pem"


class Joined(NamedTuple):
    """Result of `join`; `outcome` is None in a fleet without keys.

    `new_authority` is the folder of keys, if this robot was the first.
    """

    outcome: Literal["done", "was so already"] | None
    new_authority: Path | None


def init(config: FleetConfig, operator: str) -> Authority:
    """Create the fleet's authority, with this computer as an operator.

    Raises AuthorityError if there is one here or the fleet needs none, or OSError.
    """
    authority = create_authority(_folder(config), config.fleet)
    new_member(authority, authority.folder, Role.OPERATOR, operator)
    return authority


def open_authority(config: FleetConfig) -> Authority:
    """Open the fleet's authority. Raises AuthorityError."""
    return Authority(_folder(config), config.fleet)


def _folder(config: FleetConfig) -> Path:
    if config.keys is None:
        why = "insecure = true" if config.insecure else "it runs on this computer alone"
        raise AuthorityError(f"{config.path}: fleet {config.fleet} has no keys: {why}")
    return config.keys


async def join(
    session: Session, config: FleetConfig, robot: RobotHost, operator: Callable[[], str]
) -> Joined:
    """Make the robot a member with its own key. The session must hold the robot's lock.

    The first robot creates the authority, with `operator()` as this computer's name. Raises
    FleetError (also if the robot is not a member yet and is armed), AuthorityError or OSError.
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
            await send_members(session, config)
            return Joined("was so already", new)
    await _admit(session, authority, robot, fresh=False)
    return Joined("done", new)


async def renew_key(config: FleetConfig, robot: RobotHost, report: Report) -> None:
    """Give the robot a new key and restart its program if it ran. The group key stays.

    Raises FleetError (also if the robot is armed), AuthorityError or OSError.
    """
    authority = open_authority(config)
    async with hold(config, robot, report) as (session, found, _):
        await _admit(session, authority, robot, fresh=True)
        if found["service"]["active"] == "active":
            await restart(session, config, robot, in_flight=False)


async def send_members(session: Session, config: FleetConfig) -> str | None:
    """Send the robot this computer's list of members and group keys, if there are any.

    The robot's program reloads them, also in flight. Returns what was done, or None. Raises
    FleetError if the robot's list is newer, ConfigError or OSError.
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
        raise RemoteError("it has no key of this fleet: run `lpac fleet enroll`")
    is_same = digests[MEMBERS] == _sha256(files[MEMBERS])
    known = await _list_number(session)
    if known > number or (known == number and not is_same):
        raise RemoteError(
            f"its list of members, number {known}, is newer than or differs from this computer's, "
            f"number {number}: copy `members` here from the computer that changed it"
        )
    changed = {name: data for name, data in files.items() if digests.get(name) != _sha256(data)}
    if not changed:
        return None
    await _write(session, changed)
    return f"list of members {number} sent"


async def send_members_to(config: FleetConfig, robot: RobotHost, report: Report) -> None:
    """`send_members` in a session of its own, without the lock."""
    async with visit(config, robot, report) as (session, _):
        await send_members(session, config)


async def _admit(session: Session, authority: Authority, robot: RobotHost, *, fresh: bool) -> None:
    """Put the robot's key (a `fresh` one, or its present one) on the list of members.

    The robot installs a fresh key and its certificate before the key is listed, so that every
    listed key is in use. A repeat completes what a lost connection interrupted. Raises as `join`.
    """
    await session.call("require_lock")
    await require_disarmed(session, robot, "a new key")
    public_key = await _public_key(session, fresh=fresh)
    if fresh:
        files = authority.files(_member(robot, public_key))
        await _write(session, {_NEXT_CERTIFICATE: files[CERTIFICATE_PEM]})
        await session.check_output("sh", "-c", f"""cd {_IDENTITY} && mv {_NEXT_KEY} {KEY_PEM} &&
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
    """Public key of the robot; its secret key is generated there if need be.

    With `fresh`, a new pair is generated; `_admit` puts it into use.
    """
    key = _NEXT_KEY if fresh else KEY_PEM
    pem = await session.check_output("sh", "-c", f"""set -eC; umask 077; mkdir -p {_IDENTITY}
cd {_IDENTITY}; if [ {int(fresh)} = 1 ] || [ ! -e {key} ]; then
    rm -f part; openssl genpkey -algorithm ed25519 > part; sync part; mv part {key}
fi
# For the program's user, the owner of the parent folder.
chown -R --no-dereference --reference=.. .; openssl pkey -in {key} -pubout""")  # fmt: skip
    der = base64.b64decode("".join(pem.strip().splitlines()[1:-1]))
    # An Ed25519 key is the last 32 bytes of its DER (RFC 8410).
    return der[-32:]


async def _digests(session: Session) -> dict[str, str]:
    """Hex sha256 of each file of the robot's identity, by name. Raises as `check_output`."""
    # Not of files that the program itself may replace meanwhile.
    named = f"-name '*.pem' -o -name {MEMBERS} -o -name {GROUP_KEYS}"
    find = f"find {_IDENTITY} -type f '(' {named} ')' -exec sha256sum {{}} +"
    output = await session.check_output("sh", "-c", f"[ ! -d {_IDENTITY} ] || {find}")
    return {line.rpartition("/")[2]: line[:64] for line in output.splitlines()}


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


async def _list_number(session: Session) -> int:
    """Number of the robot's list of members; 0 if the list is damaged."""
    try:
        text = await session.check_output("cat", f"{_IDENTITY}/{MEMBERS}")
        return parse_members(text).number
    except ValueError:
        return 0
