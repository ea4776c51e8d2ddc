"""Keys and cards of a robot; each step may be repeated."""

import base64
import binascii
import hashlib
import os
from typing import Any, Dict, Optional

from lpac.fleet.agent import Refused, call, must, require_disarmed, require_lock, write_whole

# As `edge.drivers.identity_folder` reads it; the program sees it below /var/lib/lpac.
_MEMBERSHIP = "/var/lib/private/lpac/identity"
_KEY, _NEXT_KEY, _CARD = "key.pem", "next-key.pem", "identity.json"
_GROUP_KEYS = "group-keys"


@call
def identity_key(fresh: bool) -> Dict[str, Any]:
    """The public key of this robot, whose secret key is made here and never leaves.

    With `fresh` it is another one than before, which counts once `set_card` brings its card.
    Returns the `public_key` in hexadecimal digits, the text of the `card` that is there, and
    the SHA-256 of the `group_keys` that are, in hexadecimal digits; None where there is none.
    """
    _make_identity()
    key = os.path.join(_MEMBERSHIP, _NEXT_KEY if fresh else _KEY)
    if fresh or not os.path.exists(key):
        made = must("openssl", "genpkey", "-algorithm", "ed25519")
        write_whole(key, made.encode(), 0o600)
        _own_identity()
    pem = must("openssl", "pkey", "-in", key, "-pubout")
    der = base64.b64decode("".join(pem.strip().split("\n")[1:-1]))
    card, group_keys = _read(_CARD), _read(_GROUP_KEYS)
    # An Ed25519 key is the last 32 bytes of its DER (RFC 8410).
    public_key = binascii.hexlify(der[-32:]).decode()
    return {
        "public_key": public_key,
        "card": card and card.decode(),
        "group_keys": group_keys and hashlib.sha256(group_keys).hexdigest(),
    }


@call
def set_card(files: Dict[str, str], fresh: bool, mavlink_port: int) -> Dict[str, Any]:
    """Write what the fleet's authority gave for the key, `fresh` or not; by name, in base64.

    The robot's program reads it when it starts.
    """
    require_lock()
    require_disarmed(mavlink_port, "a new card")
    _make_identity()
    if fresh:
        os.replace(os.path.join(_MEMBERSHIP, _NEXT_KEY), os.path.join(_MEMBERSHIP, _KEY))
    for name, text in sorted(files.items()):
        if os.path.basename(name) != name:
            raise Refused("%r is no file's name" % name)
        write_whole(os.path.join(_MEMBERSHIP, name), base64.b64decode(text), 0o600)
    _own_identity()
    return {}


@call
def set_group_keys(text: str, mavlink_port: int) -> Dict[str, Any]:
    """Write the fleet's keys of its multicast group, in base64, which the program starts with."""
    require_lock()
    require_disarmed(mavlink_port, "a new key of the group")
    _make_identity()
    write_whole(os.path.join(_MEMBERSHIP, _GROUP_KEYS), base64.b64decode(text), 0o600)
    _own_identity()
    return {}


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
