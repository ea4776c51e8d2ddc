"""Verdict on a flight, and the flights that it is compared with."""

import json
import math
from dataclasses import replace

import pytest

from edge.policy.bundle import load_bundle
from lpac.shipped import SHIPPED_BUNDLE
from lpac.sim.flight_summary import _fence_line
from lpac.sim.scenario import Scenario
from lpac.sim.usual import USUAL_JSON, Usual, judgement, usual_points, usual_whole

BUNDLE_ID = load_bundle(SHIPPED_BUNDLE).id
USUAL = Usual(robots=10, flights=30, least=1.2, greatest=1.9)


def test_the_policy_that_ships_is_the_one_that_was_measured() -> None:
    """Else run `python -m bench usual` again."""
    measured = json.loads(USUAL_JSON.read_text())
    assert measured["bundle_id"] == BUNDLE_ID
    assert tuple(measured["columns"]) == Usual._fields
    for robots in (*measured["points"], *measured["whole"]):
        usual = Usual(*robots)
        assert usual.flights >= 5 and 0.5 < usual.least < usual.greatest < 10.0


@pytest.mark.parametrize(
    ("ratio", "verdict"), [(1.1, "better than usual"), (1.5, "as usual"), (2.5, "worse than usual")]
)
def test_it_is_compared_with_the_clairvoyant_and_with_flights_like_it(
    ratio: float, verdict: str
) -> None:
    said = judgement(ratio, USUAL)
    assert said.startswith(f"is that good? {verdict}: {ratio:.2f} times the cost of Lloyd's")
    assert "8 in 10 such flights of 10 robots: 1.20 to 1.90 (30 were flown)" in said
    assert verdict not in judgement(ratio, None)
    assert f"{ratio:.2f} times the cost of Lloyd's" in judgement(ratio, None)


def test_eight_flights_in_ten_are_usual() -> None:
    ratios = [1.0 + n / 100.0 for n in range(101)]
    assert Usual.of(5, ratios) == (5, 101, 1.1, 1.9)


def test_only_flights_like_those_that_were_flown_are_compared() -> None:
    assert usual_points(Scenario(seed=7), BUNDLE_ID) is not None
    assert usual_points(Scenario(seed=7, loss=0.3), BUNDLE_ID) is None
    assert usual_points(Scenario(seed=7), "another") is None
    whole = Scenario(seed=5, robots=4, duration_s=50.0)
    near = usual_whole(replace(whole, secure=True), BUNDLE_ID)
    assert near is not None and near.robots in (3, 5)
    assert usual_whole(replace(whole, errors=False), BUNDLE_ID) is None
    assert usual_whole(replace(whole, duration_s=20.0), BUNDLE_ID) is None
    assert usual_whole(replace(whole, random_feature_count=3), BUNDLE_ID) is None
    pads_m = tuple((4.0 * i, 4.0) for i in range(4))
    assert usual_whole(replace(whole, starts_m=pads_m), BUNDLE_ID) is None


@pytest.mark.parametrize(
    ("margin_m", "true_margin_m", "line"),
    [
        (2.26, 1.1, "kept: at the nearest 2.26 m inside by the robots' estimates, 1.10 m inside"),
        (2.26, -0.03, "kept: at the nearest 2.26 m inside by the robots' estimates, 0.03 m beyond"),
        (2.26, -4.5, "CROSSED: at the nearest 2.26 m inside by the robots' estimates, 4.50 m be"),
        (-0.5, 1.0, "CROSSED: at the nearest 0.50 m beyond it by the robots' estimates, 1.00 m in"),
        (0.5, math.nan, "kept: at the nearest 0.50 m inside by the robots' estimates, not known"),
    ],
)
def test_the_fence_has_one_verdict(margin_m: float, true_margin_m: float, line: str) -> None:
    """Count a crossing within the estimates' error as kept, and explain it."""
    told = _fence_line(margin_m, true_margin_m, 4.0)
    assert told.startswith(f"fence {line}")
    explained = "within the 4 m by which estimates may err" in told
    assert explained == (true_margin_m == -0.03)
