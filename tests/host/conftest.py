"""The robot's image, which hosts are made of."""

import fcntl
import functools
import os
import platform
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.conftest import ROOT

BuildImage = Callable[[str], Path]


@pytest.fixture(scope="session")
def build_image() -> BuildImage:
    """Builds the image for an architecture, if something in it changed; returns its tree."""
    if os.geteuid() != 0:
        pytest.skip("needs root: the image is built and entered with chroot")
    missing = [tool for tool in ("buildah", "mmdebstrap") if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"needs: sudo apt install {' '.join(missing)}")

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
def amd64_image(build_image: BuildImage) -> Path:
    """The folder of the image for robot hosts on this machine."""
    if platform.machine() != "x86_64":
        pytest.skip("robot hosts are x86-64")
    return build_image("amd64").parent
