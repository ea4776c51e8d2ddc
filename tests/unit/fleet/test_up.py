"""What is done on a robot that answers, before a day in the field."""

import asyncio
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.flight.energy import EnergyParameters, home_s
from lpac.fleet import up
from lpac.fleet.doctor import ClockOffset
from lpac.fleet.settings import load_fleet
from lpac.fleet.up import trials
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


HOME: dict[str, Any] = {
    "away_m": 21.0, "slot": 2, "slot_height_m": 8.0, "max_speed_m_s": 1.0, "max_climb_m_s": 2.0
}  # fmt: skip


@given(
    share=st.floats(0.0, 1.0),
    min_battery=st.floats(0.01, 1.0),
    endurance_s=st.floats(60.0, 3600.0),
    trial_s=st.floats(1.0, 1000.0),
    slot=st.integers(0, 9),
)
def test_a_pack_is_good_for_the_trials_in_which_nobody_returns_by_himself(
    share: float, min_battery: float, endurance_s: float, trial_s: float, slot: int
) -> None:
    """One after another, by the rules that flights go by."""
    parameters, drain = EnergyParameters(), 1.0 / endurance_s
    home = HOME | {"slot": slot}
    needs_s = home_s(parameters, height_m=8.0, **home)
    count = trials(
        parameters, share=share, min_battery=min_battery, battery_low=0.25, battery_critical=0.15,
        endurance_s=endurance_s, trial_s=trial_s, **home,
    )  # fmt: skip

    def flown(share: float) -> int:
        trials_flown = 0
        while share >= min_battery:
            share -= (2.0 * 8.0 / 2.0 + trial_s) * drain
            if share < 0.25 or (share - 0.15) * endurance_s < needs_s:
                break
            trials_flown += 1
            share -= (needs_s - parameters.reserve_s) * drain
        return trials_flown

    # But for rounding.
    assert flown(share - 1e-9) <= count <= flown(share + 1e-9)


def test_trials_cost_the_queue_and_the_way_home() -> None:
    def count(**changed: Any) -> int:
        numbers = {
            "share": 0.95, "min_battery": 0.3, "battery_low": 0.25, "battery_critical": 0.15,
            "endurance_s": 900.0, "trial_s": 120.0,
        }  # fmt: skip
        return trials(EnergyParameters(), **(HOME | numbers | changed))

    # 128 s to the mission's end, 71 s down; it returns by itself with 29.6 %: 460 s are left for
    # what comes before the last mission's end.
    assert count() == 3
    # The last of ten queues for 90 s: 141 s down, and it returns with 37.3 %.
    assert count(slot=9) == 2
    assert count(min_battery=0.6) == 2
    assert count(share=0.4) == 0
