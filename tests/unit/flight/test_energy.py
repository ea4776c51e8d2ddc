"""How long a battery lasts, by what this flight has taken from it."""

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.flight.energy import Consumption, Energy, EnergyParameters, home_s

CRITICAL = 0.15


def fly(
    consumption: Consumption,
    endurance_s: float,
    flight_s: float,
    *,
    from_share: float = 1.0,
    noise: float = 0.0,
    sag: float = 0.0,
    wrong_every: int = 0,
    begin_s: float = 0.0,
) -> float:
    """A flight whose battery falls evenly, told twice a second; the share at its end."""
    draw = random.Random(1)
    share = from_share
    consumption.add(begin_s, False, share, None)
    for i in range(1, round(2.0 * flight_s)):
        share = from_share - sag - 0.5 * i / endurance_s
        told = round(share + draw.uniform(-noise, noise), 2)
        if wrong_every and i % wrong_every == 0:
            told = draw.random()
        consumption.add(begin_s + 0.5 * i, True, told, 16.0)
    return share


@given(
    endurance_s=st.floats(300.0, 1700.0),
    flight_s=st.floats(90.0, 250.0),
    sag=st.floats(0.0, 0.1),
    noise=st.floats(0.0, 0.01),
    wrong_every=st.sampled_from([0, 40, 15]),
)
def test_a_minute_of_flight_tells_how_long_the_pack_lasts(
    endurance_s: float, flight_s: float, sag: float, noise: float, wrong_every: int
) -> None:
    consumption = Consumption(EnergyParameters(endurance_s=900.0))
    share = fly(consumption, endurance_s, flight_s, sag=sag, noise=noise, wrong_every=wrong_every)
    assert consumption.endurance_s == pytest.approx(endurance_s, rel=0.25)
    energy = consumption.energy(CRITICAL, None)
    assert energy is not None
    # A percent of a share is not seen, nor what the last seconds took.
    lasts_s = max(share - CRITICAL, 0.0) * endurance_s
    assert energy.lasts_s == pytest.approx(lasts_s, rel=0.25, abs=0.02 * endurance_s + 5.0)


def test_until_then_what_is_configured_counts_and_a_pack_never_lasts_for_ever() -> None:
    consumption = Consumption(EnergyParameters(endurance_s=600.0))
    assert consumption.energy(CRITICAL, None) is None
    fly(consumption, 200.0, 30.0)
    assert consumption.endurance_s == 600.0
    fly(consumption, 1e9, 120.0)
    assert consumption.endurance_s == 1200.0


def test_the_next_flight_begins_with_what_the_last_one_took() -> None:
    consumption = Consumption(EnergyParameters(endurance_s=900.0))
    share = fly(consumption, 400.0, 120.0)
    consumption.add(121.0, False, share, 16.2)
    assert consumption.endurance_s == pytest.approx(400.0, rel=0.1)
    # After a quarter of a minute, in which it settles, and a whole one the next is measured.
    fly(consumption, 800.0, 70.0, from_share=share, begin_s=130.0)
    assert consumption.endurance_s == pytest.approx(400.0, rel=0.1)


def test_a_pack_that_weakens_in_flight_shows_within_three_minutes() -> None:
    consumption, share = Consumption(EnergyParameters(endurance_s=900.0)), 1.0
    for i in range(1590):
        share -= 0.5 / (1200.0 if i < 1200 else 400.0)
        consumption.add(0.5 * i, True, share, None)
    assert consumption.endurance_s == pytest.approx(400.0, rel=0.1)


def test_a_battery_that_falls_silent_is_not_known() -> None:
    consumption = Consumption(EnergyParameters())
    consumption.add(0.0, True, 0.8, None)
    consumption.add(0.5, True, math.nan, None)
    energy = consumption.energy(CRITICAL, None)
    assert energy is not None and energy.lasts_s == pytest.approx((0.8 - CRITICAL) * 900.0)
    consumption.add(1.0, True, None, None)
    assert consumption.energy(CRITICAL, None) is None


@pytest.mark.parametrize(("cells", "cell_v"), [(0, None), (4, 3.45)])
def test_the_voltage_of_a_cell_counts_where_their_number_is_known(
    cells: int, cell_v: float | None
) -> None:
    consumption = Consumption(EnergyParameters(cells=cells, low_cell_v=3.5))
    # A single dip is not believed.
    for i, voltage_v in enumerate((13.8, 13.8, 9.0, 13.8, 13.8)):
        consumption.add(0.5 * i, True, 0.9, voltage_v)
    energy = consumption.energy(CRITICAL, 60.0)
    assert energy is not None
    assert energy.cell_v == (None if cell_v is None else pytest.approx(cell_v))
    said = energy.shortage()
    assert said == (None if cell_v is None else "battery low under load: 3.45 V per cell")


def test_home_is_the_way_the_wait_the_landing_and_the_reserve() -> None:
    def needed_s(**changed: float) -> float:
        numbers = {"away_m": 21.0, "height_m": 8.0, "slot": 2, "slot_height_m": 8.0} | changed
        return home_s(
            EnergyParameters(queue_s=10.0, reserve_s=60.0),
            max_speed_m_s=1.0,
            max_climb_m_s=2.0,
            **numbers,  # type: ignore[arg-type]
        )

    # 30 s of flight at 0.7 m/s, 2 robots to wait for, 21 s of landing.
    assert needed_s() == pytest.approx(30.0 + 20.0 + 21.0 + 60.0)
    assert needed_s(height_m=4.0) == pytest.approx(needed_s() + 2.0)
    assert needed_s(height_m=12.0) == pytest.approx(needed_s() + 2.0)
    assert needed_s(slot=9) == pytest.approx(needed_s() + 70.0)
    assert needed_s(away_m=0.0) == pytest.approx(needed_s() - 30.0)


def test_who_cannot_come_home_any_more_later_must_go_now() -> None:
    enough = Energy(lasts_s=100.0, home_s=99.0, cell_v=None, low_cell_v=3.4)
    assert enough.shortage() is None
    assert enough._replace(home_s=None, lasts_s=0.0).shortage() is None
    # In steps of 10 s, so that views show the same words for a while.
    assert enough._replace(lasts_s=98.0).shortage() == (
        "battery lasts 90 s more, home and landing take 100 s"
    )


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"endurance_s": 0.0}, "endurance_s = 0.0"),
        ({"cells": -1}, "cells = -1"),
        ({"low_cell_v": 34.0}, "low_cell_v = 34.0"),
        ({"queue_s": math.nan}, "queue_s = nan"),
        ({"reserve_s": -1.0}, "reserve_s = -1.0"),
    ],
)
def test_impossible_parameters_are_named(wrong: dict[str, float], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        EnergyParameters(**wrong)  # type: ignore[arg-type]
