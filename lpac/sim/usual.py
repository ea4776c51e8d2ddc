"""Usual results of the shipped policy, with which single flights are compared.

A flight's *ratio* is its final coverage cost J over the one that Lloyd's algorithm reaches with
full knowledge of the world, from the robots' true positions. `usual.json` has the range of eight
flights in ten; `python -m bench usual` flies them and writes it.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from edge.core.counted import counted
from lpac.sim.scenario import Scenario

USUAL_JSON = Path(__file__).with_suffix(".json")
# The scenarios flown: points as in `lpac demo`, and whole robots with receiver errors.
POINTS, WHOLE = Scenario(), Scenario(duration_s=50.0)
_SHARES = (0.1, 0.9)


class Usual(NamedTuple):
    """Range of the final ratio of eight in ten flights with that many robots."""

    robots: int
    flights: int
    least: float
    greatest: float

    @classmethod
    def of(cls, robots: int, ratios: Sequence[float]) -> "Usual":
        least, greatest = np.quantile(ratios, _SHARES).round(2).tolist()
        return cls(robots, len(ratios), least, greatest)


def usual_points(scenario: Scenario, bundle_id: str) -> Usual | None:
    """Usual results of such a flight of points; None if none were measured."""
    if replace(scenario, seed=POINTS.seed) != POINTS:
        return None
    return _nearest("points", scenario.robots, bundle_id)


def usual_whole(scenario: Scenario, bundle_id: str) -> Usual | None:
    """Usual results for the nearest number of whole robots; None if none were measured."""
    alike = replace(
        WHOLE, seed=scenario.seed, robots=scenario.robots, duration_s=scenario.duration_s,
        secure=scenario.secure, transport=scenario.transport,
    )  # fmt: skip
    if alike != scenario or scenario.duration_s < WHOLE.duration_s:
        return None
    return _nearest("whole", scenario.robots, bundle_id)


def _nearest(what: str, robots: int, bundle_id: str) -> Usual | None:
    measured = json.loads(USUAL_JSON.read_text())
    if measured["bundle_id"] != bundle_id:
        return None
    return min(
        (Usual(*each) for each in measured[what]), key=lambda each: abs(each.robots - robots)
    )


def judgement(ratio: float, usual: Usual | None) -> str:
    """Text that compares a flight's ratio with the usual ones."""
    text = f"{ratio:.2f} times the cost of Lloyd's algorithm, which knows the whole world"
    if usual is None:
        return f"is that good? {text}"
    verdict = "as usual"
    if ratio < usual.least:
        verdict = "better than usual"
    elif ratio > usual.greatest:
        verdict = "worse than usual"
    return (
        f"is that good? {verdict}: {text}; 8 in 10 such flights of "
        f"{counted(usual.robots, 'robot')}: {usual.least:.2f} to {usual.greatest:.2f} "
        f"({usual.flights} were flown)"
    )
