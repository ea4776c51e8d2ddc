"""A robot's key and its list of members; each step may be repeated."""

import base64
import binascii
import os
from typing import Any, Dict, Optional

from lpac.fleet.agent import Refused, call, must, require_disarmed, require_lock, write_whole

# As `edge.drivers.identity_folder` reads it; the program sees it below /var/lib/lpac.
_MEMBERSHIP = "/var/lib/private/lpac/identity"
_KEY, _NEXT_KEY, _AUTHORITY, _MEMBERS = "key.pem", "next-key.pem", "authority.pem", "members"


@call
def identity_key(fresh: bool) -> Dict[str, Any]:
    """The public key of this robot, whose secret key is made here and never leaves.

    With `fresh` it is another one than before, which counts once `set_member` brings the rest.
    Returns the `public_key` in hexadecimal digits, and the certificate of the `authority` that the
    robot knows, in base64, None if none.
    """
    _make_identity()
    key = os.path.join(_MEMBERSHIP, _NEXT_KEY if fresh else _KEY)
    if fresh or not os.path.exists(key):
        made = must("openssl", "genpkey", "-algorithm", "ed25519")
        write_whole(key, made.encode(), 0o600)
        _own_identity()
    pem = must("openssl", "pkey", "-in", key, "-pubout")
    der = base64.b64decode("".join(pem.strip().split("\n")[1:-1]))
    authority = _read(_AUTHORITY)
    # An Ed25519 key is the last 32 bytes of its DER (RFC 8410).
    return {
        "public_key": binascii.hexlify(der[-32:]).decode(),
        "authority": authority and base64.b64encode(authority).decode(),
    }


@call
def set_member(files: Dict[str, str], fresh: bool, mavlink_port: int) -> Dict[str, Any]:
    """Write what belongs to the key, `fresh` or not; by name, in base64.

    The robot's program reads it when it starts.
    """
    require_lock()
    require_disarmed(mavlink_port, "a new key")
    _make_identity()
    if fresh:
        os.replace(os.path.join(_MEMBERSHIP, _NEXT_KEY), os.path.join(_MEMBERSHIP, _KEY))
    _write_changed(files)
    return {}


@call
def set_members(files: Dict[str, str], number: int) -> Dict[str, Any]:
    """Write the list of members, of this number, and the group's keys; by name, in base64.

    The robot's program takes them up, also in flight. Returns whether one was `changed`.
    """
    has = _read(_MEMBERS)
    if has is None:
        raise Refused("it has no key of the fleet: run `lpac fleet enroll`")
    known = _list_number(has)
    if known > number or (known == number and has != base64.b64decode(files[_MEMBERS])):
        raise Refused(
            "its list of members is number %d, and this computer's %d is not newer: bring "
            "`members` from the computer that changed it" % (known, number)
        )
    return {"changed": _write_changed(files)}


def _list_number(members: bytes) -> int:
    """The number in the list's first line; 0 of one that the program does not take up either."""
    for line in members.decode("utf-8", "replace").split("\n"):
        words = line.split()
        if words and not words[0].startswith("#"):
            return int(words[2]) if len(words) > 2 and words[2].isdigit() else 0
    return 0


def _write_changed(files: Dict[str, str]) -> bool:
    """Write those that are not there already; whether there were any."""
    changed = {name: data for name, data in files.items() if _read(name) != base64.b64decode(data)}
    for name, text in sorted(changed.items()):
        if os.path.basename(name) != name:
            raise Refused("%r is no file's name" % name)
        write_whole(os.path.join(_MEMBERSHIP, name), base64.b64decode(text), 0o600)
    _own_identity()
    return bool(changed)


def _read(name: str) -> Optional[bytes]:
    try:
        with open(os.path.join(_MEMBERSHIP, name), "rb") as file:
            return file.read()
    except FileNotFoundError:
        return None


def _make_identity() -> None:
    # As systemd makes it for a DynamicUser=.
    os.makedirs("/var/lib/private", mode=0o700, exist_ok=True)
    os.makedirs(_MEMBERSHIP, mode=0o700, exist_ok=True)


def _own_identity() -> None:
    """For the program's user, who owns the folder around, or will when it starts first."""
    owner = os.stat(os.path.dirname(_MEMBERSHIP))
    for path in [_MEMBERSHIP, *(os.path.join(_MEMBERSHIP, n) for n in os.listdir(_MEMBERSHIP))]:
        os.chown(path, owner.st_uid, owner.st_gid, follow_symlinks=False)
