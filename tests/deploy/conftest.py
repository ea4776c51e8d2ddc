"""The image as `make image` builds it: once for all tests, and only if something in it changed."""

import functools
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.conftest import ROOT

BuildImage = Callable[[str], Path]


@pytest.fixture(scope="session")
def build_image() -> BuildImage:
    """Builds the image for an architecture; returns its unpacked tree."""
    if os.geteuid() != 0:
        pytest.skip("needs root: it enters the image with chroot")
    missing = [tool for tool in ("buildah", "mmdebstrap") if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"needs: sudo apt install {' '.join(missing)}")

    @functools.cache
    def build(architecture: str) -> Path:
        command = ["deploy/docker/image.sh", architecture]
        subprocess.run(command, cwd=ROOT, check=True)
        return ROOT / "out" / "image" / architecture / "root"

    return build


def inside(tree: Path, release: Path, *arguments: str) -> list[str]:
    """A command line that runs `arguments` as the unit does: in the tree, under no known user.

    `release` is seen as /release. The mounts are gone with the process.
    """
    script = """
        tree=$1 release=$2; shift 2
        mount --bind "$release" "$tree/release"
        mount -t proc proc "$tree/proc"
        mount -t sysfs sys "$tree/sys"
        mount -t tmpfs tmp "$tree/tmp"
        mount --rbind /dev "$tree/dev"
        exec chroot --userspec 65532:65532 "$tree" "$@"
    """
    return ["unshare", "--mount", "sh", "-ec", script, "sh", str(tree), str(release), *arguments]
