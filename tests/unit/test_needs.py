"""What a run of the tests says that it skipped."""

import pytest

from tests.needs import in_one_line

ROOT_ONLY = ("tests/host/drivers/test_door.py::test_flood[20]", "Skipped: needs: root")
HOSTS = (
    "tests/host/fleet/test_swap.py::test_swap",
    "Skipped: needs: root, sudo apt install rsync systemd-container",
)
COMPILER = (
    "tests/process/network/test_network.py::test_robots[fastdds]",
    "Skipped: Fast DDS is not installed: `sudo apt install g++ libfastrtps-dev`",
)
REFERENCE = ("tests/unit/core/test_world.py::test_reference", "Skipped: no such package here")


@pytest.mark.parametrize(
    ("skipped", "line"),
    [
        ([], ""),
        ([ROOT_ONLY], "skipped: 1 in tests/host/drivers; to run them: root"),
        (
            [COMPILER, COMPILER],
            "skipped: 2 in tests/process/network; to run them: sudo apt install g++ "
            "libfastrtps-dev",
        ),
        ([REFERENCE], "skipped: 1 in tests/unit/core; 1 for reasons given above"),
        (
            [ROOT_ONLY, HOSTS, COMPILER, REFERENCE],
            "skipped: 4 in tests/host/drivers, tests/host/fleet, tests/process/network, "
            "tests/unit/core; to run them: root, and sudo apt install g++ libfastrtps-dev rsync "
            "systemd-container; 1 for reasons given above",
        ),
    ],
)  # fmt: skip
def test_skips_are_told_in_one_line(skipped: list[tuple[str, str]], line: str) -> None:
    assert in_one_line(skipped) == line
