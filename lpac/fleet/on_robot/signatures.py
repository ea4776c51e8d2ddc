"""Signatures of releases: only the fleet's authority's, and none older than the robot has had.

A release's signature is a certificate that the authority made out to the sha256 of its manifest,
with a serial number that only grows: that much OpenSSL 1.1.1 can check.
"""

import hashlib
import os
import re
from typing import Optional, Tuple

from lpac.fleet.on_robot.calls import Refused, must, reason, run, write_whole

SIGNATURE = "signature.pem"
# Root's alone, unlike the identity that the robot's program reads.
AUTHORITY = "/etc/lpac/authority.pem"
_NEWEST = "/etc/lpac/newest-release"
_NEXT = "/etc/lpac/signature.pem"
_UNSIGNED = "the release is not signed: deploy from the laptop that has the fleet's authority"


def trust_authority(certificate: bytes) -> None:
    """Take releases of this authority alone from now on; another one's count begins anew."""
    os.makedirs(os.path.dirname(AUTHORITY), mode=0o755, exist_ok=True)
    if not os.path.exists(AUTHORITY) or _read(AUTHORITY) != certificate:
        write_whole(_NEWEST, b"0\n")
        write_whole(AUTHORITY, certificate)


def sign(folder: str, signature: Optional[str]) -> None:
    """Keep a release's signature with it, if it is good and the newest so far. Raises Refused."""
    if not os.path.exists(AUTHORITY):
        return
    if signature is None:
        raise Refused(_UNSIGNED)
    # Beside the one that it may have, which stays if this one is no good.
    write_whole(_NEXT, signature.encode())
    number = _forward(_number(folder, _NEXT))
    write_whole(os.path.join(folder, SIGNATURE), signature.encode())
    write_whole(_NEWEST, b"%d\n" % number)


def require_signed(folder: str, forward: bool) -> None:
    """Raises Refused if a release has no good signature on a robot that knows an authority.

    Or, with `forward`, if the robot has had a newer one.
    """
    if os.path.exists(AUTHORITY):
        number = _number(folder, os.path.join(folder, SIGNATURE))
        if forward:
            _forward(number)


def _forward(number: int) -> int:
    newest = int(_read(_NEWEST)) if os.path.exists(_NEWEST) else 0
    if number < newest:
        raise Refused(
            "the release is older than one that the robot has had: deploy from the laptop with "
            "the fleet's authority, or `lpac fleet rollback`"
        )
    return number


def _number(folder: str, path: str) -> int:
    """Of the signature in that file, if it is good and the release's."""
    if not os.path.exists(path):
        raise Refused(_UNSIGNED)
    # Neither a lost clock nor time takes a signature away.
    done = run(["openssl", "verify", "-no_check_time", "-CAfile", AUTHORITY, path])
    if done.returncode != 0:
        raise Refused("the release's signature is not the fleet's authority's: %s" % reason(done))
    number, manifest = _said(path)
    if manifest != hashlib.sha256(_read(os.path.join(folder, "manifest.json"))).hexdigest():
        raise Refused("the signature is another release's: deploy again")
    return number


def _said(path: str) -> Tuple[int, str]:
    """The serial number, and the manifest's sha256; of a member's certificate no such thing."""
    text = must(
        ["openssl", "x509", "-in", path, "-noout", "-serial", "-subject", "-nameopt", "RFC2253"]
    )
    serial = re.search(r"^serial=([0-9A-F]+)$", text, re.MULTILINE)
    subject = re.search(r"^subject=\s*CN=([0-9a-f]{64}),", text, re.MULTILINE)
    if serial is None or subject is None:
        raise Refused("the release's signature is a certificate for something else")
    return int(serial.group(1), 16), subject.group(1)


def _read(path: str) -> bytes:
    with open(path, "rb") as file:
        return file.read()
