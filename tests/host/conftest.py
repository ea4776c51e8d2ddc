"""The robot's image, which hosts are made of."""

import fcntl
import functools
import platform
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from lpac.sim.hosts.base import NEEDED
from tests.conftest import ROOT
from tests.needs import missing

BuildImage = Callable[[str], Path]


@pytest.fixture(scope="session")
def build_image() -> BuildImage:
    """Builds the image for an architecture, if something in it changed; returns its tree."""
    if lacks := missing("buildah", "mmdebstrap", root=True):
        pytest.skip(lacks)

    @functools.cache
    def build(architecture: str) -> Path:
        folder = ROOT / "out" / "image"
        folder.mkdir(parents=True, exist_ok=True)
        # Test runs beside each other want the same image.
        with (folder / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            subprocess.run([ROOT / "deploy" / "docker" / "image.sh", architecture], check=True)
        return folder / architecture / "root"

    return build


@pytest.fixture(scope="session")
def amd64_image(request: pytest.FixtureRequest) -> Path:
    """The folder of the image for robot hosts on this machine."""
    if platform.machine() != "x86_64":
        pytest.skip("robot hosts are x86-64")
    if lacks := missing("buildah", *NEEDED, root=True):
        pytest.skip(lacks)
    build_image: BuildImage = request.getfixturevalue("build_image")
    return build_image("amd64").parent
