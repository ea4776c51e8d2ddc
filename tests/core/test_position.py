"""What a position is worth: doubtful soon, lost late, good again for certain."""

import dataclasses
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.position import Cause, Judgement, PositionLimits, Quality, judge
from edge.core.vehicle import Estimator, GlobalOrigin, Gps, VehicleState

LIMITS = PositionLimits()
TICK_S = 0.1
GPS = Gps(fix=3, satellites=12, hdop=0.8, accuracy_m=0.9, offset_m=0.3)

_Q = Quality


def heard(now_s: float, gps: Gps | None = GPS, **changes: Any) -> VehicleState:
    """A vehicle of which all is known, and new."""
    known: dict[str, Any] = {
        "position_local_m": (1.0, 2.0, -3.0),
        "position_at_s": now_s,
        "position_changed_at_s": now_s,
        "origin": GlobalOrigin(47.0, 8.0, 400.0),
        "gps": gps and dataclasses.replace(gps, at_s=now_s),
        "estimator": Estimator(horizontal=True, glitch=False, at_s=now_s),
    }
    return VehicleState(**known | changes)


class Watch:
    """Looks ten times a second."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.judgement = Judgement()
        self.run(LIMITS.good_after_s + 2 * TICK_S)
        assert self.judgement.quality is _Q.GOOD

    def run(self, seconds: float, **changes: Any) -> None:
        for _ in range(round(seconds / TICK_S)):
            self.now_s += TICK_S
            self.look(heard(self.now_s, **changes))

    def look(self, vehicle: VehicleState) -> None:
        self.judgement = judge(self.judgement, vehicle, LIMITS, self.now_s)


WITHOUT = [
    ({"gps": dataclasses.replace(GPS, fix=0)}, Cause.NO_FIX, "GPS has no fix"),
    ({"gps": dataclasses.replace(GPS, fix=2)}, Cause.NO_FIX, "GPS has no fix"),
    ({"gps": None}, Cause.GPS_SILENT, "nothing new comes from the GPS receiver"),
    (
        {"gps": dataclasses.replace(GPS, accuracy_m=10.1)},
        Cause.INACCURATE,
        "GPS is accurate to 10.1 m only",
    ),
    (
        {"estimator": Estimator(False, False, 1e9)},
        Cause.NOT_ESTIMATED,
        "the autopilot's estimator does not vouch for it",
    ),
    ({"position_local_m": None}, Cause.UNKNOWN, "it is not known"),
    ({"origin": None}, Cause.UNKNOWN, "it is not known"),
]
POOR = [
    (
        {"gps": dataclasses.replace(GPS, accuracy_m=5.1)},
        Cause.INACCURATE,
        "GPS is accurate to 5.1 m only",
    ),
    (
        {"gps": dataclasses.replace(GPS, offset_m=7.0)},
        Cause.DISAGREES,
        "the GPS fix is 7.0 m away from the estimate",
    ),
    (
        {"gps": dataclasses.replace(GPS, satellites=5)},
        Cause.FEW_SATELLITES,
        "GPS sees 5 satellites only",
    ),
    (
        {"estimator": Estimator(True, True, 1e9)},
        Cause.GLITCH,
        "the autopilot's estimator takes the GPS for wrong",
    ),
]


@pytest.mark.parametrize(("changes", "cause", "text"), [*WITHOUT, *POOR])
def test_whatever_speaks_against_it_is_doubted_and_forgiven(
    changes: dict[str, Any], cause: Cause, text: str
) -> None:
    watch = Watch()
    watch.run(0.4, **changes)
    assert watch.judgement.quality is _Q.GOOD
    watch.run(0.2, **changes)
    assert (watch.judgement.quality, watch.judgement.cause) == (_Q.DOUBTFUL, cause)
    assert watch.judgement.text == text
    watch.run(2.9)
    assert watch.judgement.quality is _Q.DOUBTFUL
    assert watch.judgement.cause is cause  # Until it is good again, people read why it is not.
    watch.run(0.3)
    assert watch.judgement.quality is _Q.GOOD
    assert watch.judgement.text == ""


@pytest.mark.parametrize(("changes", "cause", "text"), WITHOUT)
def test_no_position_for_two_seconds_is_lost(
    changes: dict[str, Any], cause: Cause, text: str
) -> None:
    watch = Watch()
    watch.run(1.9, **changes)
    assert watch.judgement.quality is _Q.DOUBTFUL
    watch.run(0.3, **changes)
    assert watch.judgement.quality is _Q.LOST


@pytest.mark.parametrize(("changes", "cause", "text"), POOR)
def test_a_poor_position_is_lost_after_a_minute(
    changes: dict[str, Any], cause: Cause, text: str
) -> None:
    watch = Watch()
    watch.run(60.0, **changes)
    assert watch.judgement.quality is _Q.DOUBTFUL
    watch.run(1.0, **changes)
    assert watch.judgement.quality is _Q.LOST


def test_a_position_that_does_not_come_counts_from_the_last_one() -> None:
    watch = Watch()
    last = heard(watch.now_s)
    qualities = []
    for _ in range(25):
        watch.now_s += TICK_S
        watch.look(last)
        qualities.append(watch.judgement.quality)
    assert set(qualities[:6]) == {_Q.GOOD}
    assert set(qualities[6:19]) == {_Q.DOUBTFUL}
    assert set(qualities[20:]) == {_Q.LOST}
    assert watch.judgement.cause is Cause.OLD


def test_a_position_that_stands_still_is_no_estimate() -> None:
    watch = Watch()
    frozen_s = watch.now_s
    watch.run(1.0, position_changed_at_s=frozen_s)
    assert watch.judgement.quality is _Q.GOOD
    watch.run(0.2, position_changed_at_s=frozen_s)
    assert (watch.judgement.quality, watch.judgement.cause) == (_Q.DOUBTFUL, Cause.FROZEN)
    watch.run(1.0, position_changed_at_s=frozen_s)
    assert watch.judgement.quality is _Q.LOST


def test_a_jump_is_doubted_until_it_was_good_for_a_while() -> None:
    watch = Watch()
    jumped_s = watch.now_s
    watch.run(0.6, jumped_at_s=jumped_s)
    assert (watch.judgement.quality, watch.judgement.cause) == (_Q.DOUBTFUL, Cause.JUMPED)
    watch.run(3.2, jumped_at_s=jumped_s)
    assert watch.judgement.quality is _Q.DOUBTFUL
    watch.run(0.6, jumped_at_s=jumped_s)
    assert watch.judgement.quality is _Q.GOOD


def test_an_estimator_that_says_nothing_counts_for_nothing() -> None:
    watch = Watch()
    watch.run(5.0, estimator=None)
    watch.run(5.0, estimator=Estimator(False, True, watch.now_s - 3.0))
    assert watch.judgement.quality is _Q.GOOD


def test_who_did_not_look_does_not_know() -> None:
    """A program that was stopped finds old telemetry: that says nothing about the position."""
    watch = Watch()
    watch.run(0.3, gps=None)
    watch.now_s += 10.0
    watch.look(heard(watch.now_s, gps=None))
    assert watch.judgement.quality is _Q.GOOD
    watch.run(1.8, gps=None)
    assert watch.judgement.quality is _Q.DOUBTFUL
    watch.run(0.4, gps=None)
    assert watch.judgement.quality is _Q.LOST


STRETCHES = st.lists(
    st.tuples(st.sampled_from(["good", "poor", "none"]), st.integers(1, 45)), max_size=12
)


@given(STRETCHES)
def test_it_is_doubted_soon_lost_late_and_good_only_after_good_times(
    stretches: list[tuple[str, int]],
) -> None:
    watch = Watch()
    kinds = ["good"] * 40
    changes = {"good": {}, "poor": POOR[0][0], "none": WITHOUT[0][0]}
    for kind, ticks in stretches:
        for _ in range(ticks):
            before = watch.judgement.quality
            watch.run(TICK_S, **changes[kind])
            kinds.append(kind)
            quality = watch.judgement.quality
            if all(k != "good" for k in kinds[-6:]):
                assert quality is not _Q.GOOD
            if all(k == "none" for k in kinds[-22:]):
                assert quality is _Q.LOST
            if quality is _Q.LOST and before is not _Q.LOST:
                longest_doubt = LIMITS.doubtful_lost_after_s / TICK_S
                assert all(k == "none" for k in kinds[-20:]) or len(kinds) > longest_doubt
            if all(k == "good" for k in kinds[-32:]):
                assert quality is _Q.GOOD
            if quality is _Q.GOOD and before is not _Q.GOOD:
                assert all(k == "good" for k in kinds[-30:])
            assert (watch.judgement.text == "") is (quality is _Q.GOOD and kind == "good")


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"min_satellites": 3}, "min_satellites = 3: must be at least 4"),
        ({"max_accuracy_m": 0.0}, "max_accuracy_m = 0.0: must be above 0"),
        ({"max_offset_m": math.nan}, "max_offset_m = nan: must be above 0"),
        ({"good_after_s": math.inf}, "good_after_s = inf: must be above 0 and finite"),
        ({"doubtful_after_s": 1.0}, "doubtful_after_s = 1.0: must be above 0 and below 1"),
        ({"lost_after_s": 0.4}, "lost_after_s = 0.4, doubtful_lost_after_s = 60.0: must be"),
        ({"doubtful_lost_after_s": 2.0}, "doubtful_lost_after_s = 2.0: must be"),
    ],
)
def test_impossible_limits_are_named(wrong: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError) as error:
        PositionLimits(**wrong)
    assert named in str(error.value)
