"""List of a fleet's members: a text file like authorized_keys, which the laptop writes.

    fleet demo 7 2 <the authority's public key>
    operator ann - <public key>
    robot r3 3 <public key>

The first line has the fleet's name, the list's number, the count of members, and the authority's
public key. The number grows with every change; the count reveals a torn file. Each member has a
role, name, robot id, and public key. Keys are hexadecimal. Empty lines, and lines that begin with
#, are ignored.
"""

import hashlib
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Annotated

import msgspec
from msgspec import Meta

from edge.identity.signature import PUBLIC_KEY_BYTES, fingerprint
from edge.messages.bounds import RobotId

MOST_MEMBERS = 1000
_NUMBER_BYTES, _HASH_BYTES = 2, 2
_FIELDS = ("role", "name", "robot_id", "public_key")
_HEAD = ("fleet", "NAME", "NUMBER", "MEMBERS", "KEY")

MemberName = Annotated[
    str, Meta(pattern=r"\A\S{1,128}\Z", description="1 to 128 letters, none of them a space")
]
PublicKey = Annotated[bytes, Meta(min_length=PUBLIC_KEY_BYTES, max_length=PUBLIC_KEY_BYTES)]
ListNumber = Annotated[int, Meta(ge=1, lt=2 ** (8 * _NUMBER_BYTES))]


class MembersError(ValueError):
    """A list of members that cannot be used: not this fleet's, older or malformed; one line."""


class Role(StrEnum):
    """Role of a member: operators command, observers may only ask for a hold."""

    ROBOT = "robot"
    OPERATOR = "operator"
    OBSERVER = "observer"


@dataclass(frozen=True, slots=True)
class Member:
    """A robot or a ground station, and its public key."""

    role: Role
    name: MemberName
    robot_id: RobotId | None
    public_key: PublicKey

    def __post_init__(self) -> None:
        if (self.role is Role.ROBOT) != (self.robot_id is not None):
            raise ValueError(f"robot_id = {self.robot_id}: robots alone must have one")

    @property
    def fingerprint(self) -> bytes:
        """Fingerprint of its key."""
        return fingerprint(self.public_key)

    @property
    def place(self) -> tuple[Role, str]:
        """Unique place in the fleet: a robot's id, or a ground station's name."""
        return self.role, self.name if self.robot_id is None else str(self.robot_id)

    @property
    def line(self) -> str:
        """Its line in the file."""
        robot_id = "-" if self.robot_id is None else self.robot_id
        return f"{self.role} {self.name} {robot_id} {self.public_key.hex()}"


@dataclass(frozen=True)
class Members:
    """A list of members. Raises MembersError if two have one key or one place."""

    fleet: str
    number: int
    authority: bytes
    members: tuple[Member, ...] = ()

    def __post_init__(self) -> None:
        for what, values in (("key", "fingerprint"), ("place", "place")):
            if len({getattr(m, values) for m in self.members}) < len(self.members):
                raise MembersError(f"members: two have one {what}")

    @cached_property
    def by_key(self) -> dict[bytes, Member]:
        """Members, by the fingerprints of their keys."""
        return {member.fingerprint: member for member in self.members}

    @property
    def robot_ids(self) -> frozenset[int]:
        """Ids of all robots."""
        return frozenset(m.robot_id for m in self.members if m.robot_id is not None)

    @cached_property
    def text(self) -> str:
        """Content of the file."""
        head = f"fleet {self.fleet} {self.number} {len(self.members)} {self.authority.hex()}"
        return "".join(f"{line}\n" for line in (head, *(m.line for m in self.members)))

    @cached_property
    def digest(self) -> bytes:
        """Digest in each message's head: the number, and two bytes of the text's SHA-256."""
        text = hashlib.sha256(self.text.encode()).digest()
        return self.number.to_bytes(_NUMBER_BYTES, "big") + text[:_HASH_BYTES]

    def require_newer(self, later: "Members") -> None:
        """Raise MembersError unless `later` is this list, or a newer one of the same fleet."""
        if (later.fleet, later.authority) != (self.fleet, self.authority):
            raise MembersError(f"members: is another fleet's {later.fleet!r}, not {self.fleet!r}")
        if later.number < self.number or (later.number == self.number and later != self):
            raise MembersError(f"members: list {later.number} is not newer than {self.number}")


def number_of(digest: bytes) -> int:
    """Number of the list with this digest."""
    return int.from_bytes(digest[:_NUMBER_BYTES], "big")


def parse_members(text: str) -> Members:
    """The list in a file's text. Raises MembersError."""
    lines = [line.split() for line in text.splitlines()]
    lines = [line for line in lines if line and not line[0].startswith("#")]
    if not lines or len(lines[0]) != len(_HEAD) or lines[0][0] != _HEAD[0]:
        raise MembersError(f"members: does not begin with `{' '.join(_HEAD)}`")
    (_, fleet, number, count, authority), *rest = lines
    if count != str(len(rest)) or len(rest) > MOST_MEMBERS:
        raise MembersError(f"members: has {len(rest)} of {count[:9]} members")
    try:
        return Members(
            msgspec.convert(fleet, MemberName),
            msgspec.convert(number, ListNumber, strict=False),
            msgspec.convert(bytes.fromhex(authority), PublicKey),
            tuple(map(_member, rest)),
        )
    except ValueError as error:
        raise MembersError(f"members: {str(error).removeprefix('members: ')}") from None


def _member(fields: list[str]) -> Member:
    role, name, robot_id, public_key = fields
    values = (role, name, None if robot_id == "-" else robot_id, bytes.fromhex(public_key))
    return msgspec.convert(dict(zip(_FIELDS, values, strict=True)), Member, strict=False)
