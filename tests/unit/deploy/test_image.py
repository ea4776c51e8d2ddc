"""The robot's image: its locks, and what its files belong to."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.conftest import ROOT

DOCKER = ROOT / "deploy" / "docker"


def pinned(lock: Path) -> dict[str, str]:
    """Package -> version, in a lock of Python packages."""
    entries = re.findall(r"^([\w.-]+)==(\S+) .*\\\n((?:    --hash=sha256:\w{64}.*\n)+)",
                         lock.read_text(), re.MULTILINE)  # fmt: skip
    lines = [line for line in lock.read_text().splitlines() if re.match(r"\w", line)]
    assert len(entries) == len(lines), "each has hashes"
    return {canonicalize_name(name): version for name, version, _ in entries}


@pytest.mark.parametrize("lock", ["requirements.lock", "build.lock"])
def test_the_locks_are_what_the_project_asks_for(lock: str) -> None:
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text())
    asked = {
        "requirements.lock": pyproject["project"]["dependencies"],
        "build.lock": pyproject["build-system"]["requires"],
    }
    versions = pinned(DOCKER / lock)
    for requirement in map(Requirement, asked[lock]):
        version = versions.get(canonicalize_name(requirement.name))
        assert version is not None, f"{requirement.name}: run `make lock`"
        assert requirement.specifier.contains(version), f"{requirement}: run `make lock`"
