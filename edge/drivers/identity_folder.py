"""A member's identity on its disk: what `lpac fleet` put there, and a secret key that never leaves.

| file | what |
| --- | --- |
| `identity.json` | fleet, authority (its public key) and card, both in hexadecimal digits |
| `key.pem` | the secret key, PKCS #8; for nobody else to read |
| `certificate.pem`, `authority.pem` | for TLS: of the same key, and of the authority |
| `revoked` | the newest list of revoked keys that was heard |
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
from dataclasses import dataclass
from pathlib import Path

import msgspec

from edge.core.schema import ConfigError
from edge.identity.card import Card, CardError, verified
from edge.identity.group import GroupKey
from edge.identity.guard import Membership, SignedGuard
from edge.identity.signature import SEED_BYTES, Signer
from edge.messages.topics import TlsFiles

# The DER of an Ed25519 secret key (RFC 8410) is this, and then its seed.
_PKCS8_HEAD = bytes.fromhex("302e020100300506032b657004220420")
_MOST_BYTES = 2**16
_REVOKED, _START, _ROOM = "revoked", "start", "room"
_ROOM_BYTES = 2**16
_DAY_MS = 86_400_000
AUTHORITY_PEM, CERTIFICATE_PEM, KEY_PEM = "authority.pem", "certificate.pem", "key.pem"
IDENTITY_JSON = "identity.json"
GROUP_KEYS = "group-keys"


@dataclass(slots=True)
class Identity:
    """One start of a member's program; `start_is_kept` says whether the disk has its number."""

    folder: Path
    membership: Membership
    card: Card
    tls: TlsFiles
    revocations: bytes
    group_keys: tuple[bytes, ...]
    start_is_kept: bool = True

    def guard(self, clock_s: Callable[[], float]) -> SignedGuard:
        """The guard that the program speaks and hears through; `clock_s` is its monotonic clock."""
        return SignedGuard(self.membership, clock_s, self.revocations)

    def keep(self, guard: SignedGuard) -> None:
        """Write what the next start has to know, unless it is on the disk: this start, and the
        revocations that the guard heard. Tell the guard of newer ones on the disk.

        Raises OSError that names the file.
        """
        if not self.start_is_kept:
            _keep_start(self)
        kept = _revocations_in(self.folder)
        if kept == guard.revocations:
            return
        guard.hear_revocations(kept)
        if guard.revocations != kept:
            _write(self.folder / _REVOKED, guard.revocations)


def load_identity(folder: Path, *, fleet: str, unix_s: float) -> Identity:
    """The identity in the folder, for a new start of the program.

    Starts are numbered by the wall clock, ms, or by one more than the last where that is behind:
    a computer whose clock was lost is heard all the same. A number that cannot be written is no
    obstacle: `Identity.keep` says so, and tries again.

    Raises ConfigError, in one line, for what cannot be used; OSError.
    """
    last, unix_ms = _last_start(folder / _START), int(unix_s * 1e3)
    identity = _load(folder, fleet, max(last + 1, unix_ms))
    try:
        _keep_start(identity)
    except OSError:
        if unix_ms <= last:
            # The next start would have the same number; this grows until the computer restarts.
            identity = _load(folder, fleet, last + 1 + time.monotonic_ns() // 10**6 % _DAY_MS)
        identity.start_is_kept = False
    return identity


def _keep_start(identity: Identity) -> None:
    """Write its number, once: `lpac fleet up` resets one that a wrong clock made too great."""
    path, start = identity.folder / _START, identity.membership.start
    if _last_start(path) < start:
        _write(path, f"{start}\n".encode())
    identity.start_is_kept = True


def listening_identity(folder: Path, *, fleet: str) -> Identity:
    """The same for a program that says nothing: it is no new start, and nothing is written.

    Raises as above.
    """
    return _load(folder, fleet, 0)


def _load(folder: Path, fleet: str, start: int) -> Identity:
    try:
        written = _Written.read(folder / IDENTITY_JSON)
        signer = Signer(_seed(folder / KEY_PEM))
        membership = Membership(written.authority_key, signer, written.card_data, start)
        card = membership.card
        revocations = _revocations_in(folder)
        # Before anything counts on it.
        SignedGuard(membership, lambda: 0.0, revocations)
        group_keys = _group_keys(folder / GROUP_KEYS)
    except FileNotFoundError as error:
        raise ConfigError(
            f"{folder}: {Path(error.filename).name} is missing: enroll it first (`lpac fleet "
            "enroll` for a robot, `lpac fleet operator` for a ground station)"
        ) from None
    except (CardError, ValueError) as error:
        raise ConfigError(f"{folder}: {error}") from None
    if card.fleet != fleet or written.fleet != fleet:
        raise ConfigError(f"{folder}: is of fleet {card.fleet!r}, not of {fleet!r}")
    paths = (str(folder / name) for name in (AUTHORITY_PEM, CERTIFICATE_PEM, KEY_PEM))
    return Identity(folder, membership, card, TlsFiles(*paths), revocations, group_keys)


def load_card(folder: Path, authority: bytes) -> Card:
    """The card alone, as the authority of that public key signed it.

    Raises ConfigError for what is none; OSError.
    """
    try:
        return verified(Card, _Written.read(folder / IDENTITY_JSON).card_data, authority)
    except (CardError, ValueError) as error:
        raise ConfigError(f"{folder}: {error}") from None


def card_in(text: str, keys: Path) -> Card:
    """The card in the text of an `identity.json`, of the same fleet as the one in `keys`.

    Raises ConfigError for what is none; OSError.
    """
    own = _Written.read(keys / IDENTITY_JSON)
    try:
        return verified(Card, _Written.parse(text.encode()).card_data, own.authority_key)
    except (CardError, ValueError) as error:
        raise ConfigError(f"its card: {error}") from None


@dataclass(frozen=True, slots=True)
class _Written:
    fleet: str
    authority: str
    card: str

    @classmethod
    def read(cls, path: Path) -> "_Written":
        try:
            return cls.parse(_bytes_of(path))
        except msgspec.MsgspecError as error:
            raise ValueError(f"{path.name}: {error}") from None

    @classmethod
    def parse(cls, data: bytes) -> "_Written":
        return msgspec.json.decode(data, type=cls)

    @property
    def authority_key(self) -> bytes:
        return bytes.fromhex(self.authority)

    @property
    def card_data(self) -> bytes:
        return bytes.fromhex(self.card)


def identity_json(fleet: str, authority: bytes, card_data: bytes) -> bytes:
    """The file of that name."""
    return msgspec.json.encode(_Written(fleet, authority.hex(), card_data.hex()))


def group_keys_text(keys: Sequence[bytes]) -> bytes:
    """The file of a robot's keys of the group, the newest first."""
    return "".join(f"{key.hex()}\n" for key in keys).encode()


def _group_keys(path: Path) -> tuple[bytes, ...]:
    """None of them, if there is no file. Raises ValueError."""
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


def _revocations_in(folder: Path) -> bytes:
    try:
        return _bytes_of(folder / _REVOKED)
    except FileNotFoundError:
        return b""


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
