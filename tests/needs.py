"""What tests need of the machine, and what was skipped since it is not there."""

import os
import re
import shutil
from collections.abc import Iterable

import pytest

from lpac.sim.hosts.base import NEEDED

# Debian's package of each program.
PACKAGES = {
    **NEEDED,
    "buildah": "buildah",
    "chromium": "chromium",
    "iptables": "iptables",
    "ssh-keygen": "openssh-client",
    "systemd-analyze": "systemd",
    "unshare": "util-linux",
}


def missing(*programs: str, root: bool = False) -> str:
    """Return what this machine lacks of these, and how to get it; empty if it has them all."""
    packages = sorted({PACKAGES[program] for program in programs if not shutil.which(program)})
    lacks = ["root"] if root and os.geteuid() != 0 else []
    if packages:
        lacks.append(f"sudo apt install {' '.join(packages)}")
    return f"needs: {', '.join(lacks)}" if lacks else ""


def needs(*programs: str, root: bool = False) -> pytest.MarkDecorator:
    """Mark a test that is skipped where one of these is missing."""
    lacks = missing(*programs, root=root)
    return pytest.mark.skipif(bool(lacks), reason=lacks)


def in_one_line(skipped: Iterable[tuple[str, str]]) -> str:
    """Summarise skips, each a test's id and its reason: where, and what would run them."""
    places: set[str] = set()
    packages: set[str] = set()
    root, tests, others = False, 0, 0
    for test, reason in skipped:
        tests += 1
        places.add(test.partition("::")[0].rpartition("/")[0])
        named = re.search(r"apt install ([\w.+ -]+)", reason)
        packages.update(named[1].split() if named else ())
        needs_root = bool(re.search(r"\broot\b", reason))
        root |= needs_root
        others += not named and not needs_root
    if not tests:
        return ""
    lacks = ["root"] if root else []
    if packages:
        lacks.append(f"sudo apt install {' '.join(sorted(packages))}")
    line = f"skipped: {tests} in {', '.join(sorted(places))}"
    if lacks:
        line += f"; to run them: {', and '.join(lacks)}"
    return line + (f"; {others} for reasons given above" if others else "")
