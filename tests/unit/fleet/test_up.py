"""What is done on a robot that answers, before a day in the field."""

import asyncio
from typing import Any

import pytest

from lpac.fleet import up
from lpac.fleet.doctor import ClockOffset
from lpac.fleet.settings import load_fleet
from tests.conftest import ROOT


class Robot:
    """A session with a robot whose last start was numbered by a clock far ahead."""

    async def capture(self, _: object) -> dict[str, str]:
        return {"start": "1800000000000", "now": "1700000000000"}

    async def write(self, *_: object) -> None:
        """Nothing is kept."""

    async def call(self, _: str) -> dict[str, Any]:
        return {"enabled": True, "active": "active"}


def test_a_start_far_ahead_is_reported_although_the_clock_is_right_by_now(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def right(*_: object) -> ClockOffset:
        return ClockOffset(0.0, 0.0)

    async def locked(*_: object) -> None:
        return None

    monkeypatch.setattr(up, "measure_clock", right)
    monkeypatch.setattr(up, "lock", locked)
    monkeypatch.setattr(up, "send_members", locked)
    config = load_fleet(ROOT / "docs" / "fleet.toml")
    robot = config.robots["r1"]
    arrival = asyncio.run(up._bring_up(config, robot, Robot(), lambda: 0.0))  # type: ignore[arg-type]
    (problem,) = arrival.problems
    assert "`lpac fleet restart --robots r1`" in problem
