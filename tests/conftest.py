"""What many tests share: the shipped policy, and the robot's image."""

import functools
import os
import platform
import shutil
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from edge.policy.bundle import Bundle, load_bundle
from edge.policy.lpac.graphs import Policy

ROOT = Path(__file__).parents[1]
SHIPPED = ROOT / "policies" / "lpac_l2_k3_n10_512"

BuildImage = Callable[[str], Path]

# A busy machine is slow now and then; and whatever fails is to fail again.
settings.register_profile(
    "project", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("project")

# Tests that run in the background inherit that Ctrl-C is ignored; so would what they interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("vehicles")
    group.addoption(
        "--vehicle",
        choices=("simulated", "px4"),
        default="simulated",
        help="what tests/sim/test_faults.py flies",
    )
    group.addoption(
        "--px4", type=Path, metavar="DIR", help="PX4's build folder, as `make px4_sitl` fills it"
    )


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers", "simulated_only(reason): not flown with --vehicle px4, and why"
    )
    if config.getoption("--vehicle") == "px4" and config.getoption("--px4") is None:
        raise pytest.UsageError("--vehicle px4 needs --px4 with PX4's build folder")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--vehicle") != "px4":
        return
    for item in items:
        for marker in item.iter_markers("simulated_only"):
            item.add_marker(pytest.mark.skip(reason=marker.args[0]))


@pytest.fixture(scope="session")
def shipped_bundle() -> Bundle:
    return load_bundle(SHIPPED)


@pytest.fixture(scope="session")
def shipped_policy(shipped_bundle: Bundle) -> Policy:
    return Policy(shipped_bundle)


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
        subprocess.run([ROOT / "deploy" / "docker" / "image.sh", architecture], check=True)
        return ROOT / "out" / "image" / architecture / "root"

    return build


@pytest.fixture(scope="session")
def amd64_image(build_image: BuildImage) -> Path:
    """The folder of the image for robot hosts on this machine."""
    if platform.machine() != "x86_64":
        pytest.skip("robot hosts are x86-64")
    return build_image("amd64").parent
