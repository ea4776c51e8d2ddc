"""A fleet's certificate authority, and its list of members.

The folder is also the operator's own identity (see `edge.drivers.identity_folder`), and has the
secret `authority.key` and the group keys. Robots trust the keys on their list of members, which is
sent over SSH. Certificates of the same keys open TLS connections.
"""

import datetime
import fcntl
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import (
    Ed25519PrivateKey,
    Ed25519PublicKey,
)
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
from cryptography.x509.oid import NameOID

from edge.core.schema import ConfigError, require
from edge.drivers.identity_folder import (
    AUTHORITY_PEM,
    CERTIFICATE_PEM,
    GROUP_KEYS,
    KEY_PEM,
    MEMBERS,
    group_keys_text,
    read_group_keys,
    read_members,
    receiving_identity,
)
from edge.drivers.zenoh_link import MAX_CERTIFIED_ID
from edge.identity.group import KEY_BYTES
from edge.identity.members import Member, MemberName, Members, Role
from edge.robot.config import PlainName

_SECRET = "authority.key"
# The newest, and the one before, for robots that do not have the newest yet.
_MAX_GROUP_KEYS = 2
# Certificates never expire: flight must not depend on a wall clock.
_ALWAYS = (datetime.datetime(1970, 1, 1), datetime.datetime(9999, 12, 31, 23, 59, 59))


class AuthorityError(ValueError):
    """Failure of the authority. The message is one line: the cause, then what to do."""


class Issued(NamedTuple):
    """A new member, and the files of its folder by name. A robot's group keys are secret."""

    member: Member
    files: dict[str, bytes]


class Authority:
    """The authority in a folder. `create_authority` makes a new one."""

    def __init__(self, folder: Path, fleet: str) -> None:
        """Raises AuthorityError if there is none, or it belongs to another fleet."""
        self.folder = folder
        self.fleet = fleet
        path = folder / _SECRET
        try:
            if path.stat().st_mode & 0o077:
                raise AuthorityError(f"{path}: others can read it: chmod 600 {path}")
            key = serialization.load_pem_private_key(path.read_bytes(), None)
        except FileNotFoundError:
            raise AuthorityError(
                f"{folder}: has no authority of fleet {fleet}: make one with `lpac fleet init`, or "
                "copy the folder from the laptop or backup that has it"
            ) from None
        if not isinstance(key, Ed25519PrivateKey):
            raise AuthorityError(f"{path}: is not an Ed25519 key")
        self._key = key
        if self.members.fleet != fleet:
            raise AuthorityError(f"{folder}: is of fleet {self.members.fleet}, not of {fleet}")

    @property
    def members(self) -> Members:
        """The present list of members. Raises AuthorityError."""
        try:
            return read_members(self.folder)
        except FileNotFoundError:
            raise AuthorityError(
                f"{self.folder / MEMBERS}: is missing: copy it from a backup"
            ) from None
        except ValueError as error:
            raise AuthorityError(f"{self.folder}: {error}") from None

    def issue(
        self,
        role: Role,
        name: str,
        public_key: bytes,
        robot_id: int | None = None,
        *,
        renew_group_key: bool = True,
    ) -> Issued:
        """List a key and make its certificate; an earlier key of that member is removed.

        If that was a robot's, the group key is renewed too, unless the caller does it. Raises
        AuthorityError.
        """
        if robot_id is not None and not 0 <= robot_id <= MAX_CERTIFIED_ID:
            raise AuthorityError(f"robot_id = {robot_id}: must be from 0 to {MAX_CERTIFIED_ID}")
        require(MemberName, name, "name")
        member = Member(role, name, robot_id, public_key)
        with self._locked():
            known = self.members.members
            others = [m for m in known if m.place != member.place and m.public_key != public_key]
            if member not in known:
                self._write((*others, member), renew_group_key=renew_group_key)
        return Issued(member, self.files(member))

    def files(self, member: Member) -> dict[str, bytes]:
        """Files of a member's folder that the authority makes, by name."""
        common_name = member.role.value
        if member.robot_id is not None:
            common_name = f"robot-{member.robot_id}"
        key = Ed25519PublicKey.from_public_bytes(member.public_key)
        return {
            CERTIFICATE_PEM: _certificate(common_name, self.fleet, key, self._key),
            AUTHORITY_PEM: (self.folder / AUTHORITY_PEM).read_bytes(),
            **self.shared_files(is_robot=member.role is Role.ROBOT),
        }

    def shared_files(self, *, is_robot: bool) -> dict[str, bytes]:
        """Files that all members have: the list of members, and for robots the group keys."""
        names = (GROUP_KEYS, MEMBERS) if is_robot else (MEMBERS,)
        return {name: (self.folder / name).read_bytes() for name in names}

    def own_name(self) -> str | None:
        """Name of the operator whose identity this folder is, or None."""
        try:
            return receiving_identity(self.folder, fleet=self.fleet).membership.own.name
        except (OSError, ConfigError):
            return None

    def named(self, name: str) -> list[Member]:
        """Members of that name. Raises AuthorityError if there are none."""
        members = self.members.members
        known = [m for m in members if m.name == name]
        if not known:
            names = ", ".join(sorted({m.name for m in members})) or "none"
            raise AuthorityError(f"{name}: not a member of fleet {self.fleet}; members: {names}")
        return known

    def revoke(self, name: str) -> None:
        """Remove the members of that name. Raises AuthorityError."""
        self.named(name)
        with self._locked():
            self._write(tuple(m for m in self.members.members if m.name != name))

    def renew_group_key(self) -> None:
        """Make a new group key. Robots also accept the previous one."""
        with self._locked():
            self._renew_group_key()

    def _renew_group_key(self) -> None:
        path = self.folder / GROUP_KEYS
        keys = (secrets.token_bytes(KEY_BYTES), *read_group_keys(path))[:_MAX_GROUP_KEYS]
        write_file(path, group_keys_text(keys), 0o600)

    def _write(self, members: tuple[Member, ...], *, renew_group_key: bool = True) -> None:
        now = self.members
        later = replace(now, number=now.number + 1, members=members)
        # Before the list is written: if this failed after it, a repeat would find no robot removed.
        if renew_group_key and _robot_keys(now) - _robot_keys(later):
            self._renew_group_key()
        write_file(self.folder / MEMBERS, later.text.encode(), 0o644)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Exclude other programs that change the list."""
        with (self.folder / _SECRET).open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield


def create_authority(folder: Path, fleet: str) -> Authority:
    """Create an authority. Raises AuthorityError if the folder has one already, or OSError."""
    require(PlainName, fleet, "fleet")
    if (folder / _SECRET).exists():
        raise AuthorityError(f"{folder}: has an authority already")
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    key = Ed25519PrivateKey.generate()
    members = Members(fleet, 1, key.public_key().public_bytes_raw())
    write_file(folder / MEMBERS, members.text.encode(), 0o644)
    write_file(folder / GROUP_KEYS, group_keys_text([secrets.token_bytes(KEY_BYTES)]), 0o600)
    certificate = _certificate("authority", fleet, key.public_key(), key, is_authority=True)
    write_file(folder / AUTHORITY_PEM, certificate, 0o644)
    write_file(folder / _SECRET, private_pem(key), 0o600)
    return Authority(folder, fleet)


def write_member(folder: Path, issued: Issued, key: Ed25519PrivateKey) -> None:
    """Write a member's complete folder, for a key that was generated here."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    write_file(folder / KEY_PEM, private_pem(key), 0o600)
    for name, data in issued.files.items():
        write_file(folder / name, data, 0o600)


def new_member(
    authority: Authority, folder: Path, role: Role, name: str, robot_id: int | None = None
) -> Member:
    """Make a member with a new key and write its folder. Raises AuthorityError or OSError."""
    key = Ed25519PrivateKey.generate()
    issued = authority.issue(role, name, key.public_key().public_bytes_raw(), robot_id)
    write_member(folder, issued, key)
    return issued.member


def _robot_keys(members: Members) -> set[bytes]:
    return {m.public_key for m in members.members if m.role is Role.ROBOT}


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
        .subject_name(x509_name(fleet, common_name))
        .issuer_name(x509_name(fleet, "authority"))
        .public_key(public_key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(_ALWAYS[0])
        .not_valid_after(_ALWAYS[1])
        .add_extension(x509.BasicConstraints(is_authority, 0 if is_authority else None), True)
        # zenoh's rustls requires it.
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(common_name)]), False)
        .sign(issuer, None)
    )
    return certificate.public_bytes(serialization.Encoding.PEM)


def x509_name(fleet: str, common_name: str) -> x509.Name:
    """Subject or issuer of the fleet's certificates."""
    return x509.Name(
        [
            x509.NameAttribute(NameOID.ORGANIZATION_NAME, f"LPAC fleet {fleet}"),
            x509.NameAttribute(NameOID.COMMON_NAME, common_name),
        ]
    )


def private_pem(key: PrivateKeyTypes) -> bytes:
    """The key as PEM (PKCS #8), not encrypted."""
    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


def write_file(path: Path, data: bytes, mode: int) -> None:
    """Replace a file atomically; it is never readable beyond `mode`."""
    new = path.with_name(f"{path.name}-new")
    new.unlink(missing_ok=True)
    with os.fdopen(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)
