"""`lpac bench network` in network namespaces."""

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.command import error_line, lpac
from tests.needs import missing

NAMES = ("lpac-t1", "lpac-t2")


def ip(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["ip", *arguments], check=False, capture_output=True, text=True)


@pytest.fixture
def namespaces() -> Iterator[tuple[str, ...]]:
    """Two, joined by a cable, of which the second has no address."""
    if lacks := missing("ip", root=True):
        pytest.skip(lacks)
    for name in NAMES:
        ip("netns", "delete", name)
        if ip("netns", "add", name).returncode:
            pytest.skip("network namespaces cannot be made here")
    cable = ("name", "radio", "netns", NAMES[0], "type", "veth", "peer", "name", "radio")
    try:
        assert ip("link", "add", *cable, "netns", NAMES[1]).returncode == 0
        for name in NAMES:
            ip("-n", name, "link", "set", "radio", "up")
        ip("-n", NAMES[0], "address", "add", "10.99.0.1/24", "dev", "radio")
        yield NAMES
    finally:
        for name in NAMES:
            ip("netns", "delete", name)


def test_each_robot_is_in_its_namespace(namespaces: tuple[str, ...], tmp_path: Path) -> None:
    asked = (
        "bench", "network", "robots", "-n", 2, "--middleware", "zenoh", "--repetitions", 1,
        "--seconds", 1, "--namespaces", ",".join(namespaces), "--out", tmp_path, "--json",
    )  # fmt: skip
    refused = error_line(lpac(*asked))
    assert refused.startswith("lpac: --namespaces: lpac-t2 has no IPv4 address")
    ip("-n", namespaces[1], "address", "add", "10.99.0.2/24", "dev", "radio")
    result = lpac(*asked)
    assert result.returncode == 0, (result.stdout, result.stderr)
    told = json.loads(result.stdout)
    assert told["measured_on"]["where"] == "namespaces"
    assert told["measured_on"]["namespaces"] == list(namespaces)
    [together] = [run for run in told["runs"] if (run["robots"], run["middleware"]) == (2, "zenoh")]
    # There is no way from one to the other but the cable.
    assert together["throughput_mbit_s"] > 0.0 and together["delivered"] > 0.0


def test_a_namespace_that_is_not_there_is_named(namespaces: tuple[str, ...]) -> None:
    names = f"{namespaces[0]},no-such-place"
    asked = ("bench", "network", "robots", "-n", 2, "--middleware", "zenoh", "--namespaces", names)
    assert "there is no network namespace no-such-place" in error_line(lpac(*asked))
