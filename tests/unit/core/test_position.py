"""What a position is worth: doubtful soon, lost late, good again for certain."""

import dataclasses
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from edge.core.position import (
    PositionCause,
    PositionJudgement,
    PositionLimits,
    PositionQuality,
    judge,
)
from edge.core.vehicle import EstimatorStatus, GlobalOrigin, Gps, VehicleState
from edge.drivers.px4.telemetry import RATES_HZ
from tests.conftest import ROOT

LIMITS = PositionLimits()
TICK_S = 0.1
GPS = Gps(fix=3, satellites=12, hdop=0.8, accuracy_m=0.9, offset_m=0.3)

_Q = PositionQuality


def heard(now_s: float, gps: Gps | None = GPS, **changes: Any) -> VehicleState:
    """A vehicle of which all is known, and new."""
    known: dict[str, Any] = {
        "position_local_m": (1.0, 2.0, -3.0),
        "position_at_s": now_s,
        "position_changed_at_s": now_s,
        "origin": GlobalOrigin(47.0, 8.0, 400.0),
        "gps": gps and dataclasses.replace(gps, at_s=now_s),
        "estimator": EstimatorStatus(horizontal=True, glitch=False, at_s=now_s),
    }
    return VehicleState(**known | changes)


class Watch:
    """Looks ten times a second."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.judgement = PositionJudgement()
        assert self.run(LIMITS.good_after_s + 2 * TICK_S) is _Q.GOOD

    def run(self, seconds: float, **changes: Any) -> PositionQuality:
        """How good it is found in the end."""
        for _ in range(round(seconds / TICK_S)):
            self.now_s += TICK_S
            self.look(heard(self.now_s, **changes))
        return self.judgement.quality

    def look(self, vehicle: VehicleState) -> PositionQuality:
        self.judgement = judge(self.judgement, vehicle, LIMITS, self.now_s)
        return self.judgement.quality


WITHOUT: list[tuple[dict[str, Any], PositionCause, str]] = [
    ({"gps": dataclasses.replace(GPS, fix=0)}, PositionCause.NO_FIX, "GPS has no fix"),
    ({"gps": dataclasses.replace(GPS, fix=2)}, PositionCause.NO_FIX, "GPS has no fix"),
    ({"gps": None}, PositionCause.GPS_SILENT, "nothing new comes from the GPS receiver"),
    (
        {"gps": dataclasses.replace(GPS, accuracy_m=10.1)},
        PositionCause.INACCURATE,
        "GPS is accurate to 10.1 m only",
    ),
    (
        {"estimator": EstimatorStatus(False, False, 1e9)},
        PositionCause.NOT_ESTIMATED,
        "the autopilot's estimator does not consider it valid",
    ),
    (
        {"gps": dataclasses.replace(GPS, offset_m=7.0)},
        PositionCause.DISAGREES,
        "the GPS fix is 7.0 m away from the estimate",
    ),
    (
        {"gps": dataclasses.replace(GPS, velocity_offset_m_s=2.1)},
        PositionCause.VELOCITY_DISAGREES,
        "the GPS velocity is 2.1 m/s off the estimate",
    ),
    (
        {"gps": dataclasses.replace(GPS, slip_m=5.1)},
        PositionCause.SLIPS,
        "the GPS place moved by 5.1 m, contrary to its velocity",
    ),
    ({"position_local_m": None}, PositionCause.UNKNOWN, "it is not known"),
    ({"origin": None}, PositionCause.UNKNOWN, "it is not known"),
]
POOR: list[tuple[dict[str, Any], PositionCause, str]] = [
    (
        {"gps": dataclasses.replace(GPS, accuracy_m=5.1)},
        PositionCause.INACCURATE,
        "GPS is accurate to 5.1 m only",
    ),
    (
        {"gps": dataclasses.replace(GPS, satellites=5)},
        PositionCause.FEW_SATELLITES,
        "GPS sees 5 satellites only",
    ),
    (
        {"estimator": EstimatorStatus(True, True, 1e9)},
        PositionCause.GLITCH,
        "the autopilot's estimator rejects the GPS",
    ),
]


@pytest.mark.parametrize(("changes", "cause", "text"), [*WITHOUT, *POOR])
def test_whatever_speaks_against_it_is_doubted_and_forgiven(
    changes: dict[str, Any], cause: PositionCause, text: str
) -> None:
    watch = Watch()
    assert watch.run(0.4, **changes) is _Q.GOOD
    watch.run(0.2, **changes)
    assert (watch.judgement.quality, watch.judgement.cause) == (_Q.DOUBTFUL, cause)
    assert watch.judgement.text == text
    assert watch.run(2.9) is _Q.DOUBTFUL
    assert watch.judgement.cause is cause  # Until it is good again, people read why it is not.
    assert watch.run(0.3) is _Q.GOOD
    assert watch.judgement.text == ""


@pytest.mark.parametrize(("changes", "cause", "text"), WITHOUT)
def test_no_position_for_two_seconds_is_lost(
    changes: dict[str, Any], cause: PositionCause, text: str
) -> None:
    watch = Watch()
    assert watch.run(1.9, **changes) is _Q.DOUBTFUL
    assert watch.run(0.3, **changes) is _Q.LOST


@pytest.mark.parametrize(("changes", "cause", "text"), POOR)
def test_a_poor_position_is_lost_after_a_minute(
    changes: dict[str, Any], cause: PositionCause, text: str
) -> None:
    watch = Watch()
    assert watch.run(60.0, **changes) is _Q.DOUBTFUL
    assert watch.run(1.0, **changes) is _Q.LOST


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
    assert watch.judgement.cause is PositionCause.OLD


def test_a_position_that_stands_still_is_no_estimate() -> None:
    watch = Watch()
    frozen_s = watch.now_s
    assert watch.run(1.3, position_changed_at_s=frozen_s) is _Q.GOOD
    watch.run(0.2, position_changed_at_s=frozen_s)
    assert (watch.judgement.quality, watch.judgement.cause) == (_Q.DOUBTFUL, PositionCause.FROZEN)
    assert watch.run(1.6, position_changed_at_s=frozen_s) is _Q.LOST


NO_FIX: dict[str, Any] = {"gps": dataclasses.replace(GPS, fix=0)}
FLICKERS: list[dict[str, Any]] = [NO_FIX, NO_FIX, {}, {}]


def test_a_fix_that_flickers_is_doubted_until_it_is_steady() -> None:
    watch = Watch()
    since_s, qualities = watch.now_s, []
    while watch.now_s < since_s + 20.0:
        for changes in FLICKERS:
            watch.run(TICK_S, **changes)
            qualities.append(watch.judgement.quality)
    assert set(qualities[:4]) == {_Q.GOOD} and set(qualities[6:]) == {_Q.DOUBTFUL}
    assert watch.run(2.5) is _Q.DOUBTFUL
    assert watch.run(0.7) is _Q.GOOD


def test_glitches_far_apart_are_none() -> None:
    watch = Watch()
    for _ in range(10):
        watch.run(0.3, **NO_FIX)
        watch.run(0.6)
        assert watch.judgement.quality is _Q.GOOD


def test_one_sample_with_a_doubt_does_not_stop_a_robot() -> None:
    """At the rate that the estimator's word is asked for, told late by a tick."""
    watch = Watch()
    told_s = watch.now_s
    watch.run(1.0 / RATES_HZ[230] + TICK_S, estimator=EstimatorStatus(True, True, told_s))
    assert watch.run(1.0) is _Q.GOOD


def test_a_pause_of_the_receiver_stops_a_robot_and_does_not_land_it() -> None:
    watch = Watch()
    silent_s = watch.now_s
    for _ in range(34):
        watch.now_s += TICK_S
        silent = dataclasses.replace(GPS, at_s=silent_s)
        watch.look(structs.replace(heard(watch.now_s), gps=silent))
    assert (watch.judgement.quality, watch.judgement.cause) == (
        _Q.DOUBTFUL,
        PositionCause.GPS_SILENT,
    )


# Each row of docs/faults.md's table of wrong positions that the judgement has times for: the cause,
# when it stops and when it lands as they stand there; what is told; and when, in s after it is
# told (or after the last that was), the position is doubtful and lost.
_LANDS = "2 s after the report"
WRONG: list[tuple[str, str, str, list[dict[str, Any]], float, float]] = [
    ("no fix", "reported within 0.3 s, and 0.4 s", _LANDS, [NO_FIX], 0.4, 2.0),
    ("a fix that comes and goes, never there for 0.5 s", "as no fix", "after 60 s",
     FLICKERS, 0.4, 60.4),
    ("nothing new from the receiver", "1.5 s and 0.4 s", "2 s after it is noticed",
     [{"gps_at_s": 0.0}], 1.9, 3.5),
    ("positions do not come", "0.6 s", "2 s after the last one",
     [{"position_at_s": 0.0}], 0.6, 2.0),
    ("accuracy reported worse than 5 m", "0.2 s and 0.4 s",
     "after 60 s, worse than 10 m after 2 s",
     [{"gps": dataclasses.replace(GPS, accuracy_m=5.1)}], 0.4, 60.4),
    ("accuracy reported worse than 5 m", "0.2 s and 0.4 s",
     "after 60 s, worse than 10 m after 2 s",
     [{"gps": dataclasses.replace(GPS, accuracy_m=10.1)}], 0.4, 2.0),
    ("accuracy between 1.5 m and 5 m", "not in flight",
     "no: heights keep robots apart; before takeoff more room is asked for",
     [{"gps": dataclasses.replace(GPS, accuracy_m=5.0)}], math.inf, math.inf),
    ("the position jumps by 1 m or more", "0.4 s",
     "no: flies on once nothing spoke against it for 3 s", [{"jumped_at_s": 0.0}], 0.4, math.inf),
    ("fix and estimate are more than 5 m or 2 m/s apart", "0.2 s and 0.4 s", _LANDS,
     [{"gps": dataclasses.replace(GPS, offset_m=5.1)}], 0.4, 2.0),
    ("fix and estimate are more than 5 m or 2 m/s apart", "0.2 s and 0.4 s", _LANDS,
     [{"gps": dataclasses.replace(GPS, velocity_offset_m_s=2.1)}], 0.4, 2.0),
    ("the fix departs from its own velocity by more than 5 m in 10 s",
     "as long as that takes, and 0.4 s",
     "2 s after it is noticed; PX4 goes without it at once",
     [{"gps": dataclasses.replace(GPS, slip_m=5.1)}], 0.4, 2.0),
    ("the receiver repeats the same fix", "three repeats, 0.3 s to 0.8 s, and 0.4 s",
     "2 s after it is noticed; PX4 goes without it at once", [{"gps_repeats": 3}],
     0.4, 2.0),
    ("the receiver jumps by less than 5 m", "never", "no: PX4 believes it and follows smoothly",
     [{"gps": dataclasses.replace(GPS, offset_m=4.9)}], math.inf, math.inf),
    ("frozen values", "1 s and 0.4 s", "2 s after it is noticed",
     [{"position_changed_at_s": 0.0}], 1.4, 3.0),
]  # fmt: skip


@pytest.mark.parametrize(("cause", "stops", "lands", "told", "doubted_s", "lost_s"), WRONG)
def test_wrong_positions_are_noticed_when_the_table_says(
    cause: str,
    stops: str,
    lands: str,
    told: list[dict[str, Any]],
    doubted_s: float,
    lost_s: float,
) -> None:
    page = (ROOT / "docs" / "faults.md").read_text()
    (row,) = (line for line in page.splitlines() if line.startswith(f"| {cause} | "))
    assert [cell.strip() for cell in row.split("|")[2:4]] == [stops, lands]
    watch = Watch()
    since_s = watch.now_s
    found: dict[PositionQuality, float] = {}
    for tick in range(round(65.0 / TICK_S)):
        watch.now_s += TICK_S
        changes = dict(told[tick % len(told)])
        # Times count from the beginning; what is told is told for the first time in its first tick.
        for name in changes.keys() & {"position_at_s", "position_changed_at_s", "jumped_at_s"}:
            changes[name] += since_s
        silent = changes.pop("gps_at_s", None) is not None
        repeats = changes.pop("gps_repeats", 0)
        vehicle = heard(watch.now_s, **changes)
        if silent:
            vehicle = structs.replace(vehicle, gps=dataclasses.replace(GPS, at_s=since_s))
        if repeats:
            stuck = dataclasses.replace(GPS, repeats=repeats, at_s=watch.now_s)
            vehicle = structs.replace(vehicle, gps=stuck)
        watch.look(vehicle)
        found.setdefault(watch.judgement.quality, watch.now_s - since_s)
    assert found[_Q.GOOD] == pytest.approx(TICK_S)
    for quality, at_s in ((_Q.DOUBTFUL, doubted_s), (_Q.LOST, lost_s)):
        # A tick until it is told; another, and a third after a minute, until it is looked at.
        assert at_s - 1e-6 <= found.get(quality, math.inf) <= at_s + 3.0 * TICK_S + 1e-6


def test_a_jump_is_doubted_until_it_was_good_for_a_while() -> None:
    watch = Watch()
    jumped_s = watch.now_s
    watch.run(0.6, jumped_at_s=jumped_s)
    assert (watch.judgement.quality, watch.judgement.cause) == (_Q.DOUBTFUL, PositionCause.JUMPED)
    assert watch.run(3.2, jumped_at_s=jumped_s) is _Q.DOUBTFUL
    assert watch.run(0.6, jumped_at_s=jumped_s) is _Q.GOOD


def test_an_estimator_that_says_nothing_counts_for_nothing() -> None:
    watch = Watch()
    watch.run(5.0, estimator=None)
    assert watch.run(5.0, estimator=EstimatorStatus(False, True, watch.now_s - 3.0)) is _Q.GOOD


def test_who_did_not_look_does_not_know() -> None:
    """A program that was stopped finds old telemetry: that says nothing about the position."""
    watch = Watch()
    watch.run(0.3, gps=None)
    watch.now_s += 10.0
    assert watch.look(heard(watch.now_s, gps=None)) is _Q.GOOD
    assert watch.run(1.8, gps=None) is _Q.DOUBTFUL
    assert watch.run(0.4, gps=None) is _Q.LOST


STRETCHES = st.lists(
    st.tuples(st.sampled_from(["good", "poor", "none"]), st.integers(1, 45)), max_size=12
)


@given(STRETCHES)
def test_it_is_doubted_soon_lost_late_and_good_only_after_good_times(
    stretches: list[tuple[str, int]],
) -> None:
    watch = Watch()
    kinds = ["good"] * 40
    changes: dict[str, dict[str, Any]] = {
        "good": {}, "poor": POOR[0][0], "none": WITHOUT[0][0],
    }  # fmt: skip
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
