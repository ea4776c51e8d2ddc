"""A fleet's authority: it says who is a member, and whose key is not good any more.

Its folder is the operator's own identity too (see `edge.drivers.identity_folder`), with two files
more: `authority.key`, the secret that the whole fleet's safety hangs on, and `members.json`, what
was issued. Cards are what robots decide by; certificates of the same keys let their holders in.
"""

import datetime
import fcntl
import os
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import msgspec
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import (
    Ed25519PrivateKey,
    Ed25519PublicKey,
)
from cryptography.x509.oid import NameOID

from edge.core.schema import ConfigError, require
from edge.drivers.identity_folder import (
    AUTHORITY_PEM,
    CERTIFICATE_PEM,
    GROUP_KEYS,
    IDENTITY_JSON,
    KEY_PEM,
    group_keys_text,
    identity_json,
    load_card,
)
from edge.drivers.zenoh_link import MAX_CERTIFIED_ID
from edge.identity.card import MOST_REVOKED, Card, Revocations, Role, signed
from edge.identity.group import KEY_BYTES
from edge.identity.signature import Signer, fingerprint
from edge.robot.config import PlainName

_SECRET = "authority.key"
_MEMBERS = "members.json"
_REVOKED = "revoked"
# The newest, and the one that robots have that were not given it yet.
_MOST_KEYS = 2
_VALID_S = 2.0 * 365.0 * 86400.0
# Flight depends on no wall clock: a certificate lets its holder in whatever the time is.
_ALWAYS = (datetime.datetime(1970, 1, 1), datetime.datetime(9999, 12, 31, 23, 59, 59))


class AuthorityError(ValueError):
    """It cannot be done; one line says why, and what to do."""


@dataclass(frozen=True, slots=True)
class Member:
    """A key that was issued a card."""

    role: Role
    name: str
    robot_id: int | None
    public_key: bytes
    serial: int
    expires_unix_s: float
    revoked: bool = False

    @property
    def fingerprint(self) -> str:
        """Its key's, in hexadecimal digits."""
        return fingerprint(self.public_key).hex()


class _Ledger(msgspec.Struct):
    fleet: str
    serial: int = 0
    revocations: int = 0
    members: list[Member] = []
    # Hexadecimal digits, the newest first; somebody who has the first is a member no more, if so.
    group_keys: list[str] = []
    group_key_leaked: bool = False


class Issued(NamedTuple):
    """A new member, and the files of its folder by name.

    A robot's keys of the group are secret: the way there must be.
    """

    member: Member
    files: dict[str, bytes]


class Authority:
    """The authority in a folder. `create_authority` makes one."""

    def __init__(self, folder: Path, fleet: str) -> None:
        """Raises AuthorityError if there is none, or it is another fleet's."""
        self.folder = folder
        self.fleet = fleet
        path = folder / _SECRET
        try:
            if path.stat().st_mode & 0o077:
                raise AuthorityError(f"{path} is readable for others: chmod 600 {path}")
            key = serialization.load_pem_private_key(path.read_bytes(), None)
        except FileNotFoundError:
            raise AuthorityError(
                f"{folder}: has no authority of fleet {fleet}: make one with `lpac fleet init`, or "
                f"bring {_SECRET} and {_MEMBERS} from the laptop or the backup that has them"
            ) from None
        if not isinstance(key, Ed25519PrivateKey):
            raise AuthorityError(f"{path}: is no Ed25519 key")
        self._key = key
        self._signer = Signer(key.private_bytes_raw())
        if self._read().fleet != fleet:
            raise AuthorityError(f"{folder}: is of fleet {self._read().fleet}, not of {fleet}")

    @property
    def public_key(self) -> bytes:
        """By which members tell each other's cards."""
        return self._signer.public_key

    def members(self) -> list[Member]:
        """All that were issued a card, in that order."""
        return self._read().members

    def issue(
        self, role: Role, name: str, public_key: bytes, robot_id: int | None = None
    ) -> Issued:
        """A card and a certificate for a key. An earlier key of the same member is revoked.

        Raises AuthorityError.
        """
        if robot_id is not None and not 0 <= robot_id <= MAX_CERTIFIED_ID:
            raise AuthorityError(f"robot_id = {robot_id}: must be from 0 to {MAX_CERTIFIED_ID}")
        with self._changed() as ledger:
            ledger.serial += 1
            member = Member(role, name, robot_id, public_key, ledger.serial, time.time() + _VALID_S)
            before = [m for m in ledger.members if _is_same(m, member)]
            revoked = [m for m in before if m.public_key != public_key and not m.revoked]
            kept = [m for m in ledger.members if m not in before or m in revoked]
            ledger.members = [replace(m, revoked=True) if m in revoked else m for m in kept]
            ledger.members.append(member)
            if revoked:
                self._write_revoked(ledger)
        return Issued(member, self.files(member))

    def files(self, member: Member) -> dict[str, bytes]:
        """Files of the member's folder that are the authority's, by name."""
        common_name = member.role.value
        if member.robot_id is not None:
            common_name = f"robot-{member.robot_id}"
        key = Ed25519PublicKey.from_public_bytes(member.public_key)
        return {
            IDENTITY_JSON: self.identity_json(member),
            CERTIFICATE_PEM: _certificate(common_name, self.fleet, key, self._key),
            AUTHORITY_PEM: _certificate(
                "authority", self.fleet, self._key.public_key(), self._key, is_authority=True
            ),
            _REVOKED: self.revocations,
            **({GROUP_KEYS: self.group_keys()} if member.role is Role.ROBOT else {}),
        }

    def group_keys(self) -> bytes:
        """Keys of the multicast group for robots: the file of that name."""
        return group_keys_text(list(map(bytes.fromhex, self._read().group_keys)))

    def renew_group_key(self) -> bool:
        """Make a new key of the group if somebody who has the last is a member no more.

        Whether there is one. Robots hear each other by the one before, too, until all have it.
        """
        with self._changed() as ledger:
            leaked = ledger.group_key_leaked or not ledger.group_keys
            if leaked:
                ledger.group_keys = [secrets.token_hex(KEY_BYTES), *ledger.group_keys][:_MOST_KEYS]
                ledger.group_key_leaked = False
        return leaked

    def identity_json(self, member: Member) -> bytes:
        """The member's file of that name, with its card."""
        card = Card(
            self.fleet, member.role, member.name, member.public_key, member.serial,
            member.expires_unix_s, member.robot_id,
        )  # fmt: skip
        return identity_json(self.fleet, self.public_key, signed(card, self._signer))

    @property
    def revocations(self) -> bytes:
        """The signed list of revoked keys."""
        return (self.folder / _REVOKED).read_bytes()

    def own_name(self) -> str | None:
        """Of the operator in this very folder; None if there is nobody's identity."""
        try:
            card = load_card(self.folder, self.public_key)
        except (OSError, ConfigError):
            return None
        return card.name

    def named(self, name: str) -> list[Member]:
        """The members of that name, revoked ones too. Raises AuthorityError if there are none."""
        members = self.members()
        known = [m for m in members if m.name == name]
        if not known:
            names = ", ".join(sorted({m.name for m in members})) or "nobody"
            raise AuthorityError(f"{name}: is no member of fleet {self.fleet}; known: {names}")
        return known

    def revoke(self, name: str) -> list[Member]:
        """Revoke all keys of the member of that name; those that were. Raises AuthorityError."""
        known = self.named(name)
        with self._changed() as ledger:
            ledger.members = [
                replace(m, revoked=True) if m.name == name else m for m in ledger.members
            ]
            self._write_revoked(ledger)
        return known

    def _write_revoked(self, ledger: _Ledger) -> None:
        fingerprints = tuple(dict.fromkeys(m.fingerprint for m in ledger.members if m.revoked))
        if len(fingerprints) > MOST_REVOKED:
            raise AuthorityError(
                f"{len(fingerprints)} keys are revoked, and a list holds {MOST_REVOKED}: make a "
                "new authority"
            )
        ledger.revocations += 1
        ledger.group_key_leaked = True
        data = signed(Revocations(ledger.revocations, fingerprints), self._signer)
        write_file(self.folder / _REVOKED, data, 0o644)

    def _read(self) -> _Ledger:
        path = self.folder / _MEMBERS
        try:
            return msgspec.json.decode(path.read_bytes(), type=_Ledger)
        except FileNotFoundError:
            raise AuthorityError(f"{path}: is missing: bring it from the backup") from None
        except msgspec.MsgspecError as error:
            raise AuthorityError(f"{path}: {error}") from None

    @contextmanager
    def _changed(self) -> Iterator[_Ledger]:
        """Write the changes to members that are made meanwhile, unless something is raised."""
        with (self.folder / _SECRET).open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            ledger = self._read()
            yield ledger
            write_file(
                self.folder / _MEMBERS, msgspec.json.format(msgspec.json.encode(ledger)), 0o600
            )


def create_authority(folder: Path, fleet: str) -> Authority:
    """A new authority. Raises AuthorityError if the folder has one already; OSError."""
    require(PlainName, fleet, "fleet")
    if (folder / _SECRET).exists():
        raise AuthorityError(f"{folder}: has an authority already")
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    key = Ed25519PrivateKey.generate()
    ledger = _Ledger(fleet, revocations=1, group_keys=[secrets.token_hex(KEY_BYTES)])
    write_file(folder / _MEMBERS, msgspec.json.encode(ledger), 0o600)
    write_file(folder / _REVOKED, signed(Revocations(1), Signer(key.private_bytes_raw())), 0o644)
    write_file(folder / _SECRET, _pem(key), 0o600)
    return Authority(folder, fleet)


def write_member(folder: Path, issued: Issued, key: Ed25519PrivateKey) -> None:
    """A member's folder, complete, for a key that was made here."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    write_file(folder / KEY_PEM, _pem(key), 0o600)
    for name, data in issued.files.items():
        write_file(folder / name, data, 0o600)


def new_member(
    authority: Authority, folder: Path, role: Role, name: str, robot_id: int | None = None
) -> Member:
    """A member with a new key, all of it in the folder. Raises AuthorityError, OSError."""
    key = Ed25519PrivateKey.generate()
    issued = authority.issue(role, name, key.public_key().public_bytes_raw(), robot_id)
    write_member(folder, issued, key)
    return issued.member


def _is_same(one: Member, other: Member) -> bool:
    if one.role is not other.role:
        return False
    return one.name == other.name if one.robot_id is None else one.robot_id == other.robot_id


def _certificate(
    common_name: str,
    fleet: str,
    public_key: Ed25519PublicKey,
    issuer: Ed25519PrivateKey,
    *,
    is_authority: bool = False,
) -> bytes:
    certificate = (
        x509.CertificateBuilder()
        .subject_name(_name(common_name, fleet))
        .issuer_name(_name("authority", fleet))
        .public_key(public_key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(_ALWAYS[0])
        .not_valid_after(_ALWAYS[1])
        .add_extension(x509.BasicConstraints(is_authority, 0 if is_authority else None), True)
        # rustls, which zenoh has, takes no certificate without one.
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(common_name)]), False)
        .sign(issuer, None)
    )
    return certificate.public_bytes(serialization.Encoding.PEM)


def _name(common_name: str, fleet: str) -> x509.Name:
    return x509.Name(
        [
            x509.NameAttribute(NameOID.ORGANIZATION_NAME, f"LPAC fleet {fleet}"),
            x509.NameAttribute(NameOID.COMMON_NAME, common_name),
        ]
    )


def _pem(key: Ed25519PrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


def write_file(path: Path, data: bytes, mode: int) -> None:
    """Write a file that is whole whenever it is there, and never readable for more than `mode`."""
    new = path.with_name(f"{path.name}-new")
    new.unlink(missing_ok=True)
    with os.fdopen(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)
