"""What the laptop makes of ssh's last words, and how it leaves robots when it is interrupted."""

import asyncio

import pytest

from lpac.fleet.operations import for_each
from lpac.fleet.session import explain
from lpac.fleet.settings import RobotHost, load_fleet
from tests.conftest import ROOT


@pytest.mark.parametrize(
    ("words", "meaning"),
    [
        ("Host key verification failed.", "its host key is not known here"),
        (
            "No ED25519 host key is known for r1 and you have requested strict checking.\n"
            "Host key verification failed.",
            "its host key is not known here",
        ),
        (
            "@ WARNING: REMOTE HOST IDENTIFICATION HAS CHANGED! @\nHost key verification failed.",
            "only in that case run `ssh-keygen -R r1.field`",
        ),
        ("env: 'python3': No such file or directory", "python3 is missing"),
        ("env: \u2018python3\u2019: No such file or directory", "python3 is missing"),
        ("sh: 1: python3: not found", "python3 is missing"),
        ("bash: line 1: rsync: command not found", "rsync is missing"),
        (
            'rsync: [receiver] write failed on "/opt/lpac/x": No space left on device (28)\n'
            "rsync: connection unexpectedly closed (37 bytes received so far) [sender]",
            "its disk is full",
        ),
        ("rsync: connection unexpectedly closed (0 bytes received so far)", "it does not answer"),
        ("this and\n that\n", "that"),
        ("", "it no longer answers"),
    ],
)
def test_last_words_mean_something(words: str, meaning: str) -> None:
    assert meaning in explain(words, "r1.field")


def test_an_answer_that_lacks_something_is_one_robots_outcome() -> None:
    robots = list(load_fleet(ROOT / "docs" / "fleet.toml").robots.values())[:2]

    async def task(robot: RobotHost) -> int:
        return {robots[1].name: 1}[robot.name]

    first, second = asyncio.run(for_each(robots, task))
    assert first.problem == f"its answer lacks something: KeyError('{robots[0].name}')"
    assert second.value == 1


def test_every_robot_is_left_in_order_however_long_that_takes() -> None:
    robots = list(load_fleet(ROOT / "docs" / "fleet.toml").robots.values())
    begun, left = [], []

    async def task(robot: RobotHost) -> None:
        begun.append(robot.name)
        try:
            await asyncio.Event().wait()
        finally:
            for _ in range(100 * begun.index(robot.name)):
                await asyncio.sleep(0)
            left.append(robot.name)

    async def interrupted() -> None:
        running = asyncio.create_task(for_each(robots, task))
        while len(begun) < len(robots):
            await asyncio.sleep(0)
        running.cancel()
        with pytest.raises(asyncio.CancelledError):
            await running
        assert sorted(left) == sorted(begun)

    asyncio.run(interrupted())
