"""Whether a vehicle holds its height, and whether it stands on the ground."""

from collections.abc import Iterable

import pytest

from edge.flight.lift import Lift, Motion, update

TICK_S = 0.1
HOVERS = Motion(
    height_m=5.0, climb_m_s=0.0, wanted_m=5.0, approach_m_s=0.5, thrust=0.5, in_air=True,
    ground_below_m=4.5,
)  # fmt: skip


def flown(motions: Iterable[Motion], lift: Lift | None = None) -> tuple[Lift, float]:
    """The memory after these ticks, and the time."""
    lift, now_s = lift or Lift(), 100.0
    for motion in motions:
        now_s += TICK_S
        lift = update(lift, motion, now_s, TICK_S)
    return lift, now_s


def for_s(seconds: float, motion: Motion) -> list[Motion]:
    return [motion] * round(seconds / TICK_S)


def moving(seconds: float, from_m: float, climb_m_s: float, motion: Motion) -> list[Motion]:
    """It climbs or sinks so fast from a height on."""
    return [
        motion._replace(height_m=from_m + climb_m_s * tick * TICK_S, climb_m_s=climb_m_s)
        for tick in range(round(seconds / TICK_S))
    ]


def off_s(motions: Iterable[Motion]) -> float:
    lift, now_s = flown(motions)
    return lift.off_s(now_s)


def stands(motions: Iterable[Motion]) -> bool:
    lift, now_s = flown([*for_s(5.0, HOVERS), *motions])
    return lift.stands(now_s)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_two_seconds_at_more_than_a_metre_and_a_half_off_its_height(side: float) -> None:
    off = HOVERS._replace(height_m=5.0 + 1.6 * side)
    hovering = for_s(5.0, HOVERS)
    assert off_s([*hovering, *for_s(1.9, off)]) < 0.0
    assert off_s([*hovering, *for_s(2.2, off)]) >= 0.0
    assert off_s([*hovering, *for_s(60.0, HOVERS._replace(height_m=5.0 + 1.4 * side))]) < 0.0


def test_a_gust_is_forgotten_and_a_lost_height_is_not() -> None:
    off = HOVERS._replace(height_m=3.0)
    gusts = [*for_s(1.8, off), *for_s(0.1, HOVERS)] * 10
    assert off_s([*for_s(5.0, HOVERS), *gusts]) < 0.0
    assert off_s([*for_s(5.0, HOVERS), *for_s(2.2, off), *for_s(5.0, HOVERS)]) >= 5.0


def test_who_flies_to_its_height_is_given_the_time() -> None:
    """It climbs 8 m at 1 m/s, and is to climb at 0.5 m/s at least."""
    returns = HOVERS._replace(wanted_m=10.0)
    assert (
        off_s([*moving(8.0, 2.0, 1.0, returns), *for_s(60.0, returns._replace(height_m=10.0))]) < 0
    )
    assert off_s(moving(6.0, 2.0, 0.0, returns)) >= 0.0
    assert off_s(moving(4.0, 2.0, -1.0, returns)) >= 0.0


def test_a_takeoff_may_pause_but_not_sink() -> None:
    climbs = HOVERS._replace(wanted_m=10.0, approach_m_s=0.0)
    up = moving(6.0, 0.0, 1.0, climbs)
    assert off_s([*up, *for_s(60.0, climbs._replace(height_m=6.0))]) < 0.0
    assert off_s([*up, *for_s(2.2, climbs._replace(height_m=4.3))]) >= 0.0


def test_a_height_that_is_not_known_is_not_lost() -> None:
    unknown = HOVERS._replace(height_m=None, climb_m_s=None)
    assert off_s([*for_s(5.0, HOVERS), *for_s(60.0, unknown)]) < 0.0


GROUND = HOVERS._replace(height_m=0.3)


@pytest.mark.parametrize(
    "motion",
    [
        # PX4 pushes upwards, and takes it to be in the air.
        GROUND._replace(thrust=1.0),
        GROUND._replace(thrust=0.65),
        # Heights have walked since takeoff.
        GROUND._replace(thrust=1.0, height_m=3.0, climb_m_s=0.2),
        # It lands, or its motors idle.
        GROUND._replace(thrust=0.1, wanted_m=None),
        GROUND._replace(thrust=0.0),
    ],
)
def test_stands_whatever_the_autopilot_says(motion: Motion) -> None:
    assert stands(for_s(2.2, motion))
    assert not stands(for_s(1.8, motion))


@pytest.mark.parametrize(
    "motion",
    [
        # Low over a roof, at the height that it is told to keep, also with a motor that weakens.
        HOVERS._replace(height_m=1.0, wanted_m=1.0),
        HOVERS._replace(height_m=1.0, wanted_m=1.0, thrust=0.9),
        # It comes down, however slowly, or slows down near the ground.
        GROUND._replace(thrust=0.45, wanted_m=None),
        GROUND._replace(thrust=0.7, wanted_m=None),
        GROUND._replace(thrust=0.1, wanted_m=None, climb_m_s=-0.5),
        # It sinks, though it pushes upwards, or climbs again.
        GROUND._replace(thrust=1.0, height_m=3.0, climb_m_s=-0.4),
        GROUND._replace(thrust=0.7, height_m=2.0, climb_m_s=0.8),
        # Too high for any ground, however heights err.
        HOVERS._replace(height_m=6.0, wanted_m=9.5, thrust=1.0),
        # A downdraught presses it down, and it hovers there.
        GROUND._replace(thrust=0.55, height_m=2.0),
        GROUND._replace(thrust=None),
        GROUND._replace(thrust=1.0, height_m=None),
    ],
)
def test_what_flies_does_not_stand(motion: Motion) -> None:
    assert not stands(for_s(30.0, motion))


def test_without_having_flown_nobody_knows_what_carries_it() -> None:
    lift, now_s = flown(for_s(30.0, GROUND._replace(thrust=0.0)))
    assert not lift.stands(now_s)


def test_a_pack_that_empties_still_carries_it() -> None:
    """The thrust that hovers rises from a half to 0.9 in a quarter of an hour."""
    sagging = [HOVERS._replace(thrust=0.5 + 0.4 * n / 9000) for n in range(9000)]
    lift, now_s = flown(sagging)
    assert lift.hover_thrust == pytest.approx(0.9, abs=0.01)
    assert not lift.stands(now_s)


def test_a_vehicle_whose_full_thrust_lifts_nothing_stands() -> None:
    heavy = for_s(5.0, HOVERS._replace(thrust=0.85))
    lift, now_s = flown([*heavy, *for_s(2.2, GROUND._replace(thrust=1.0))])
    assert lift.stands(now_s)


def test_what_carries_it_is_learned_in_the_air_at_its_height_alone() -> None:
    hovering, pushes = for_s(5.0, HOVERS), HOVERS._replace(thrust=0.9)
    for motions in (
        for_s(5.0, pushes._replace(in_air=False)),
        for_s(5.0, pushes._replace(height_m=4.4)),
        # Its height is lost, and it passes through it.
        [*for_s(3.0, HOVERS._replace(height_m=3.0)), *for_s(5.0, pushes)],
    ):
        lift, now_s = flown([*hovering, *motions])
        assert lift.hover_thrust == pytest.approx(0.5)
    # Of a long pause nobody knows more than of half a second.
    lift, now_s = flown(hovering)
    after = update(lift, pushes, now_s + 60.0, 60.0)
    assert after.hover_thrust == pytest.approx(0.5 + 0.4 * 0.05)
