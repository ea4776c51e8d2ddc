"""Rates and asynchrony: what is flown, and what is made of it."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge.policy.bundle import load_bundle
from lpac.cli.options import DEFAULT_BUNDLE
from lpac.evaluate.evaluation import TrainedBundle
from lpac.evaluate.flights import EvaluationFlight, FlownCost, costs_of, settings_of
from lpac.paper.asynchrony import FIELD, TIMES_S, AsynchronyPlan, Timing, as_json, results_of
from lpac.paper.asynchrony_report import write_report

SHIPPED_ID = load_bundle(DEFAULT_BUNDLE).id
PLAN = AsynchronyPlan(
    bundle=TrainedBundle("somewhere", "0123456789abcdef01"),
    message_bytes=2000,
    world_set="validation",
    worlds=3,
    perception_hz=(1.0, 5.0),
    policy_hz=(0.5, 2.5),
    delays_s=(0.0, 0.8),
)


def flown(plan: AsynchronyPlan) -> dict[EvaluationFlight, FlownCost]:
    """Costs that fall to what the timing and the world make of them."""
    costs = {}
    for flight in plan.flights():
        slow = 0.1 * flight.clocks.policy_s + 0.1 * flight.delay_s
        end = 100.0 * (0.2 + 0.1 * flight.world + slow)
        costs[flight] = FlownCost((0.0, 30.0, 60.0), (100.0, (100.0 + end) / 2.0, end))
    return costs


def test_each_timing_is_flown_once_over_the_same_worlds() -> None:
    timings = PLAN.timings
    assert timings[0] == FIELD and len(timings) == len(set(timings)) == 9
    assert (
        Timing(5.0, 2.5, synchronous=True) in timings and Timing(5.0, 2.5, delay_s=0.8) in timings
    )
    flights = PLAN.flights()
    assert len(flights) == len({flight.key for flight in flights}) == 27
    for timing in timings:
        of_timing = PLAN.flights_of(timing)
        assert [flight.world for flight in of_timing] == [0, 1, 2]
        for flight in of_timing:
            assert flight.clocks.policy_s == pytest.approx(1.0 / timing.policy_hz)
            assert flight.clocks.perception_s == pytest.approx(1.0 / timing.perception_hz)
            # What is used is never younger than two periods, and late messages not forgotten.
            slowest_s = max(flight.clocks.policy_s, flight.clocks.perception_s)
            assert flight.max_input_age_s >= 2.0 * slowest_s
            assert flight.max_message_age_s >= 2.0 * flight.clocks.policy_s + 1.5 * timing.delay_s
    field = PLAN.flights_of(FIELD)[0]
    assert (field.max_message_age_s, field.max_input_age_s) == (0.8, 1.0)


def test_whole_robots_are_never_all_at_the_same_moments(tmp_path: Path) -> None:
    plan = replace(PLAN, robot="whole")
    assert [t for t in PLAN.timings if not t.synchronous] == plan.timings
    assert {flight.robot for flight in plan.flights()} == {"whole"}
    write_report(plan, results_of(plan, flown(plan)), tmp_path, {"command": "..."}, "Whole robots.")
    text = (tmp_path / "README.md").read_text()
    assert "Whole robots." in text and "dashed" not in text


def test_whole_robots_have_the_rates_and_ages_of_a_timing() -> None:
    plan = replace(
        PLAN, robot="whole", worlds=1, bundle=TrainedBundle(str(DEFAULT_BUNDLE), SHIPPED_ID)
    )
    costs = {}
    for timing in (FIELD, Timing(5.0, 0.5)):
        [flight] = plan.flights_of(timing)
        settings = settings_of(flight)
        assert settings["rates"]["policy_hz"] == pytest.approx(timing.policy_hz)
        assert settings["rates"]["perception_hz"] == 5.0
        assert settings["policy"]["max_message_age_s"] == flight.max_message_age_s
        [(_, costs[timing])] = costs_of((replace(flight, set_up="n1", duration_s=4.0),))
    (field, slow) = costs.values()
    assert field.time_s == slow.time_s == (0.0, 1.0, 2.0, 3.0, 4.0)
    assert field.cost[0] == pytest.approx(slow.cost[0], rel=1e-3) and field.cost != slow.cost
    at_once = replace(flight, clocks=replace(flight.clocks, synchronous=True))
    with pytest.raises(ValueError, match="whole robots have moments of their own"):
        costs_of((at_once,))


def test_results_are_held_against_the_fields() -> None:
    results = {result.timing: result for result in results_of(PLAN, flown(PLAN))}
    field, slow = results[FIELD], results[Timing(5.0, 0.5)]
    assert field.over_field == ((1.0, 1.0, 1.0),) * 3
    np.testing.assert_allclose(field.costs[:, -1], [0.24, 0.34, 0.44])
    np.testing.assert_allclose(field.costs[0], [0.81, 0.62, 0.24])
    assert field.means[-1].value == pytest.approx(0.34)
    np.testing.assert_allclose(field.area[0], 0.25 * 1.0 + 0.5 * 0.62 + 0.25 * 0.24)
    ratio = slow.over_field[-1]
    assert ratio.value == pytest.approx(0.5 / 0.34) and 1.0 < ratio.low < ratio.value < ratio.high
    late = results[FIELD._replace(delay_s=0.8)]
    assert late.over_field[-1].value == pytest.approx(0.42 / 0.34)


def test_the_report_has_every_flight_and_says_what_made_it(tmp_path: Path) -> None:
    results = results_of(PLAN, flown(PLAN))
    write_report(PLAN, results, tmp_path, {"command": "lpac paper async --quick"})
    rows = list(csv.DictReader((tmp_path / "async.csv").read_text().splitlines()))
    assert len(rows) == 27
    first = {name: float(value) for name, value in rows[0].items()}
    assert (first["perception_hz"], first["policy_hz"], first["world"]) == (5.0, 2.5, 0.0)
    assert first["cost_at_60_s"] == pytest.approx(0.24)
    assert (first["rounds_per_perception"], first["said_kb_s"]) == (0.5, 5.0)
    told = json.loads((tmp_path / "async.json").read_text())
    assert told.pop("made_by") == {"command": "lpac paper async --quick"}
    assert told.pop("flown") in (tmp_path / "README.md").read_text()
    assert told == json.loads(json.dumps(as_json(PLAN, results)))
    assert told["times_s"] == list(TIMES_S)
    text = (tmp_path / "README.md").read_text()
    assert text.count("\n| ") == 2 + 9 and "`lpac paper async --quick`" in text
    for name in ("rates", "staleness"):
        assert f"({name}.png)" in text
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
        assert (tmp_path / f"{name}.pdf").stat().st_size > 5_000


def test_impossible_numbers_of_worlds_are_named() -> None:
    with pytest.raises(ValueError, match="worlds = 0: must be at least 1"):
        replace(PLAN, worlds=0)
