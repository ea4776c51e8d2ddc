"""A member's identity on its disk: what `lpac fleet` put there, and a secret key that never leaves.

| file | what |
| --- | --- |
| `members` | the fleet's list of members: see `edge.identity.members` |
| `key.pem` | the secret key, PKCS #8; for nobody else to read |
| `certificate.pem`, `authority.pem` | for TLS: of the same key, and of the authority |
| `start` | the number of this start of the program, greater than those before |
| `room` | nothing: kept for the files above, should the disk be full |
| `group-keys` | of a robot: the fleet's keys of its multicast group, in hexadecimal digits, a line
each, the newest first; for nobody else to read |
"""

import base64
import errno
import os
import re
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from edge.core.logger import log
from edge.core.schema import ConfigError
from edge.identity.group import GroupKey
from edge.identity.guard import Membership, SignedGuard
from edge.identity.members import Member, Members, Role, parse_members
from edge.identity.signature import SEED_BYTES, Signer
from edge.messages.topics import GroupKeys, TlsFiles

# The DER of an Ed25519 secret key (RFC 8410) is this, and then its seed.
_PKCS8_HEAD = bytes.fromhex("302e020100300506032b657004220420")
_MOST_BYTES = 2**18
_START, _ROOM = "start", "room"
_ROOM_BYTES = 2**16
_DAY_MS = 86_400_000
AUTHORITY_PEM, CERTIFICATE_PEM, KEY_PEM = "authority.pem", "certificate.pem", "key.pem"
MEMBERS = "members"
GROUP_KEYS = "group-keys"


@dataclass(slots=True)
class Identity:
    """One start of a member's program; `start_is_kept` says whether the disk has its number.

    `group_keys` are None for a member that was given none, which is not in the group.
    """

    folder: Path
    membership: Membership
    tls: TlsFiles
    group_keys: GroupKeys | None
    start_is_kept: bool = True
    _given_keys: tuple[bytes, ...] = ()
    _stamps: tuple[object, ...] = ()
    _problems: set[str] = field(default_factory=set)

    def guard(self, clock_s: Callable[[], float]) -> SignedGuard:
        """The guard that the program speaks and hears through; `clock_s` is its monotonic clock."""
        return SignedGuard(self.membership, clock_s)

    def take_up(self, guard: SignedGuard, *, in_flight: bool = False) -> None:
        """Follow the list of members and the group's keys on the disk; then write the start.

        Files that cannot be used change nothing, and are reported once. In flight the spoken key of
        the group stays, and all keys that are heard: others may not have been given the newest.

        Raises OSError that names the file, if the start cannot be written.
        """
        stamps = tuple(_stamp(self.folder / name) for name in (MEMBERS, GROUP_KEYS))
        if stamps != self._stamps:
            self._stamps = stamps
            self._take(lambda: guard.update_members(read_members(self.folder)))
            self._take(self._take_keys)
        if self.group_keys is not None and self._given_keys:
            self.group_keys = _followed(self.group_keys, self._given_keys, in_flight=in_flight)
        if not self.start_is_kept:
            _keep_start(self)

    def _take_keys(self) -> None:
        self._given_keys = read_group_keys(self.folder / GROUP_KEYS)

    def _take(self, take: Callable[[], None]) -> None:
        try:
            take()
        except (ValueError, OSError) as error:
            if isinstance(error, OSError):
                self._stamps = ()  # The next attempt may succeed.
            if str(error) not in self._problems:
                self._problems.add(str(error))
                log.warning("list of members not taken up", why=str(error))


def _followed(now: GroupKeys, given: tuple[bytes, ...], *, in_flight: bool) -> GroupKeys:
    if not in_flight:
        return now if now.receiving == given else GroupKeys(given, given[0])
    older = tuple(key for key in now.receiving if key not in given)
    return now if now.receiving == given + older else GroupKeys(given + older, now.sending)


def load_identity(
    folder: Path, *, fleet: str, unix_s: float, robot_id: int | None = None
) -> Identity:
    """The identity in the folder, for a new start of the program.

    Starts are numbered by the wall clock, ms, or by one more than the last where that is behind:
    a computer whose clock was lost is heard all the same. A number that cannot be written is no
    obstacle: `Identity.take_up` says so, and tries again. With `robot_id` it must be that robot's;
    one that is not in the list of members starts all the same, as it may be in the air.

    Raises ConfigError, in one line, for what cannot be used; OSError.
    """
    last, unix_ms = _last_start(folder / _START), int(unix_s * 1e3)
    identity = _load(folder, fleet, max(last + 1, unix_ms), robot_id)
    try:
        _keep_start(identity)
    except OSError:
        if unix_ms <= last:
            # The next start would have the same number; this grows until the computer restarts.
            start = last + 1 + time.monotonic_ns() // 10**6 % _DAY_MS
            identity = _load(folder, fleet, start, robot_id)
        identity.start_is_kept = False
    return identity


def _keep_start(identity: Identity) -> None:
    """Write its number, once: `lpac fleet up` resets one that a wrong clock made too great."""
    path, start = identity.folder / _START, identity.membership.start
    if _last_start(path) < start:
        _write(path, f"{start}\n".encode())
    identity.start_is_kept = True


def listening_identity(folder: Path, *, fleet: str, robot_id: int | None = None) -> Identity:
    """The same for a program that says nothing: it is no new start, and nothing is written.

    Raises as above.
    """
    return _load(folder, fleet, 0, robot_id)


def _load(folder: Path, fleet: str, start: int, robot_id: int | None) -> Identity:
    try:
        members = read_members(folder)
        signer = Signer(_seed(folder / KEY_PEM))
        keys = read_group_keys(folder / GROUP_KEYS)
    except FileNotFoundError as error:
        raise ConfigError(
            f"{folder}: {Path(error.filename).name} is missing: enroll it first (`lpac fleet "
            "enroll` for a robot, `lpac fleet operator` for a ground station)"
        ) from None
    except ValueError as error:
        raise ConfigError(f"{folder}: {error}") from None
    if members.fleet != fleet:
        raise ConfigError(f"{folder}: is of fleet {members.fleet!r}, not of {fleet!r}")
    own = members.by_key.get(signer.fingerprint)
    if own is None and robot_id is None:
        raise ConfigError(
            f"{folder}: its key is not in the list of members: make a new one with `lpac fleet "
            "operator`"
        )
    if own is None:
        own = Member(Role.ROBOT, f"robot-{robot_id}", robot_id, signer.public_key)
    if robot_id not in (None, own.robot_id):
        raise ConfigError(f"{folder}: is {own.role} {own.name}'s, not robot {robot_id}'s")
    paths = (str(folder / name) for name in (AUTHORITY_PEM, CERTIFICATE_PEM, KEY_PEM))
    group_keys = GroupKeys(keys, keys[0]) if keys else None
    membership = Membership(own, signer, members, start)
    return Identity(folder, membership, TlsFiles(*paths), group_keys, _given_keys=keys)


def read_members(folder: Path) -> Members:
    """The list of members in the folder. Raises MembersError, OSError."""
    return parse_members(_bytes_of(folder / MEMBERS).decode("utf-8", "replace"))


def _stamp(path: Path) -> tuple[int, ...] | None:
    """Whatever changes with a file's content, as it is never written in place."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size


def group_keys_text(keys: Sequence[bytes]) -> bytes:
    """The file of a robot's keys of the group, the newest first."""
    return "".join(f"{key.hex()}\n" for key in keys).encode()


def read_group_keys(path: Path) -> tuple[bytes, ...]:
    """The keys in the file, none if there is no file. Raises ValueError, OSError."""
    try:
        _require_private(path)
        keys = tuple(map(bytes.fromhex, _bytes_of(path).decode("ascii", "replace").split()))
    except FileNotFoundError:
        return ()
    for key in keys:
        GroupKey.of(key)
    return keys


def _require_private(path: Path) -> None:
    if path.stat().st_mode & 0o077:
        raise ValueError(f"{path.name} is readable for others: chmod 600 {path}")


def _seed(path: Path) -> bytes:
    _require_private(path)
    match = re.search(
        r"-----BEGIN PRIVATE KEY-----([A-Za-z0-9+/=\s]+)-----END PRIVATE KEY-----",
        _bytes_of(path).decode("ascii", "replace"),
    )
    der = base64.b64decode(match[1]) if match else b""
    if len(der) != len(_PKCS8_HEAD) + SEED_BYTES or not der.startswith(_PKCS8_HEAD):
        raise ValueError(f"{path.name}: is no Ed25519 key (PKCS #8, PEM)")
    return der[len(_PKCS8_HEAD) :]


def _last_start(path: Path) -> int:
    try:
        return min(max(int(_bytes_of(path)), 0), 2**47)
    except (FileNotFoundError, ValueError):  # The first one, or its disk was full.
        return 0


def _bytes_of(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_MOST_BYTES)


def _write(path: Path, data: bytes) -> None:
    """Raises OSError that names the file."""
    room = path.with_name(_ROOM)
    try:
        _replace(path, data)
    except OSError as error:
        if error.errno != errno.ENOSPC or not room.exists():
            raise
        room.unlink()
        _replace(path, data)
    if not room.exists():
        with suppress(OSError):
            _replace(room, bytes(_ROOM_BYTES))


def _replace(path: Path, data: bytes) -> None:
    new = path.with_name(f"{path.name}-new")
    try:
        with new.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
    except OSError as error:
        with suppress(OSError):
            new.unlink()
        raise OSError(error.errno, error.strerror, str(path)) from None
