"""A member's identity on its disk, written by `lpac fleet`; the secret key never leaves it.

| file | content |
| --- | --- |
| `members` | the fleet's list of members: see `edge.identity.members` |
| `key.pem` | the secret key, PKCS #8, mode 600 |
| `certificate.pem`, `authority.pem` | TLS certificates of this key and of the fleet's authority |
| `start` | number of the program's last start, increasing |
| `room` | zeros: space reserved for the files above on a full disk |
| `group-keys` | robots only: the multicast group's keys in hexadecimal, newest first, mode 600 |
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
    """One start of a member's program; `start_saved`: its number is on the disk.

    `group_keys` is None for a member that is not in the multicast group.
    """

    folder: Path
    membership: Membership
    tls: TlsFiles
    group_keys: GroupKeys | None
    start_saved: bool = True
    _file_keys: tuple[bytes, ...] = ()
    _stamps: tuple[object, ...] = ()
    _logged: set[str] = field(default_factory=set)

    def guard(self, clock_s: Callable[[], float]) -> SignedGuard:
        """The program's guard, which signs and verifies; `clock_s` is a monotonic clock."""
        return SignedGuard(self.membership, clock_s)

    def update(self, guard: SignedGuard, *, in_flight: bool = False) -> None:
        """Apply changes of the members and the group's keys on the disk; then save the start.

        An unusable file changes nothing and is logged once. In flight the group's sending key does
        not change and no key is dropped, since others may not have the newest yet.

        Raises OSError that names the file, if the start cannot be saved.
        """
        stamps = tuple(_stamp(self.folder / name) for name in (MEMBERS, GROUP_KEYS))
        if stamps != self._stamps:
            self._stamps = stamps
            self._read(lambda: guard.update_members(read_members(self.folder)))
            self._read(self._read_keys)
        if self.group_keys is not None and self._file_keys:
            self.group_keys = _updated(self.group_keys, self._file_keys, in_flight=in_flight)
        if not self.start_saved:
            _save_start(self)

    def _read_keys(self) -> None:
        self._file_keys = read_group_keys(self.folder / GROUP_KEYS)

    def _read(self, read: Callable[[], None]) -> None:
        try:
            read()
        except (ValueError, OSError) as error:
            if isinstance(error, OSError):
                self._stamps = ()  # try again next time
            if str(error) not in self._logged:
                self._logged.add(str(error))
                log.warning("identity not updated", why=str(error))


def _updated(now: GroupKeys, new: tuple[bytes, ...], *, in_flight: bool) -> GroupKeys:
    if not in_flight:
        return now if now.receiving == new else GroupKeys(new, new[0])
    older = tuple(key for key in now.receiving if key not in new)
    return now if now.receiving == new + older else GroupKeys(new + older, now.sending)


def load_identity(
    folder: Path, *, fleet: str, unix_s: float, robot_id: int | None = None
) -> Identity:
    """Load the identity in the folder for a new start of the program.

    A start's number is the wall clock, ms, or the last number plus one if the clock is behind it:
    others accept messages only from increasing starts. `lpac fleet up` resets a number that a wrong
    clock left far in the future. If the number cannot be saved, the start goes on, and
    `Identity.update` tries again and raises the error. With `robot_id` the identity must be that
    robot's. A robot that is not in the list of members starts, too: it may be in the air.

    Raises ConfigError, one line, if the folder's content cannot be used; OSError.
    """
    last, unix_ms = _last_start(folder / _START), int(unix_s * 1e3)
    identity = _load(folder, fleet, max(last + 1, unix_ms), robot_id)
    try:
        _save_start(identity)
    except OSError:
        if unix_ms <= last:
            # The next start would get the same number. The uptime makes it differ.
            start = last + 1 + time.monotonic_ns() // 10**6 % _DAY_MS
            identity = _load(folder, fleet, start, robot_id)
        identity.start_saved = False
    return identity


def _save_start(identity: Identity) -> None:
    path, start = identity.folder / _START, identity.membership.start
    if _last_start(path) < start:
        _write(path, f"{start}\n".encode())
    identity.start_saved = True


def receiving_identity(folder: Path, *, fleet: str, robot_id: int | None = None) -> Identity:
    """Load the identity for a program that only receives: no new start, nothing is written.

    Raises as `load_identity`.
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
        raise ConfigError(f"{folder}: belongs to fleet {members.fleet!r}, not {fleet!r}")
    own = members.by_key.get(signer.fingerprint)
    if own is None and robot_id is None:
        raise ConfigError(
            f"{folder}: its key is not in the list of members: make a new one with `lpac fleet "
            "operator`"
        )
    if own is None:
        own = Member(Role.ROBOT, f"robot-{robot_id}", robot_id, signer.public_key)
    if robot_id not in (None, own.robot_id):
        raise ConfigError(f"{folder}: belongs to {own.role} {own.name}, not robot {robot_id}")
    paths = (str(folder / name) for name in (AUTHORITY_PEM, CERTIFICATE_PEM, KEY_PEM))
    group_keys = GroupKeys(keys, keys[0]) if keys else None
    membership = Membership(own, signer, members, start)
    return Identity(folder, membership, TlsFiles(*paths), group_keys, _file_keys=keys)


def read_members(folder: Path) -> Members:
    """Read the list of members. Raises MembersError, OSError."""
    return parse_members(_bytes_of(folder / MEMBERS).decode("utf-8", "replace"))


def _stamp(path: Path) -> tuple[int, ...] | None:
    """Values that change with the file's content; files are replaced, never written in place."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size


def group_keys_text(keys: Sequence[bytes]) -> bytes:
    """Content of the file of the group's keys, newest first."""
    return "".join(f"{key.hex()}\n" for key in keys).encode()


def read_group_keys(path: Path) -> tuple[bytes, ...]:
    """Read the group's keys; none if there is no file. Raises ValueError, OSError."""
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
        raise ValueError(f"{path.name} is readable by others: chmod 600 {path}")


def _seed(path: Path) -> bytes:
    _require_private(path)
    match = re.search(
        r"-----BEGIN PRIVATE KEY-----([A-Za-z0-9+/=\s]+)-----END PRIVATE KEY-----",
        _bytes_of(path).decode("ascii", "replace"),
    )
    der = base64.b64decode(match[1]) if match else b""
    if len(der) != len(_PKCS8_HEAD) + SEED_BYTES or not der.startswith(_PKCS8_HEAD):
        raise ValueError(f"{path.name}: is not an Ed25519 key (PKCS #8, PEM)")
    return der[len(_PKCS8_HEAD) :]


def _last_start(path: Path) -> int:
    try:
        return min(max(int(_bytes_of(path)), 0), 2**47)
    except (FileNotFoundError, ValueError):  # the first start, or the disk was full
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
