"""Benches with processes run at their smallest size; speed is not tested."""

from pathlib import Path

import pytest

pytest.importorskip("torch_geometric", reason="the benches compare with it")

from bench import footprint, loops, scaling, simulated
from tests.unit.test_bench import check_frame, kept


def test_footprint(tmp_path: Path) -> None:
    result = kept(footprint.measure(runs=1), tmp_path)
    check_frame(result, "footprint", targets=2)
    for kind in (footprint.EDGE, footprint.TORCH):
        assert {"first_tick_s", "rss"} <= result["figures"][kind].keys()


@pytest.mark.real_time
def test_loops(tmp_path: Path) -> None:
    result = kept(loops.measure(robots=1, mission_s=6.0), tmp_path)
    check_frame(result, "loops", targets=6)
    (taken,) = result["figures"][loops.PLAIN]["taken"]
    assert set(loops.LOOPS) | {"preflight", "status", "log", "rx"} <= taken["cpu_percent"].keys()
    assert len(result["figures"][loops.WITH_KEYS]["taken"]) == 1
    assert taken["threads"] > 8 and 10.0 < taken["private_mb"] < taken["resident_mb"]


def test_scaling(tmp_path: Path) -> None:
    result = kept(scaling.measure([(2, 0.4, 1)]), tmp_path)
    check_frame(result, "scaling", targets=3)
    flights = result["figures"]["2"]
    assert set(flights) == {scaling.EXACT, scaling.BATCHED}
    assert {flight["world_size"] for flight in flights.values()} == {229}


def test_simulated(tmp_path: Path) -> None:
    result = kept(simulated.measure(robots=1, mission_s=1.0, runs=1), tmp_path)
    check_frame(result, "simulated", targets=1)
    (flight,) = result["figures"]["1"]
    assert flight["simulated_s"] > 10.0 and flight["cpu_s"] > 0.0
