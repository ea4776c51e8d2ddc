"""Rates and asynchrony: what is flown, and what is made of it."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from edge.policy.bundle import load_bundle
from lpac.analysis.flight import FlightRecord
from lpac.analysis.logs import LoopRates
from lpac.cli.options import DEFAULT_BUNDLE
from lpac.evaluate.evaluation import TrainedBundle
from lpac.evaluate.flights import EvaluationFlight, FlownCost, costs_of, whole_scenario
from lpac.paper.asynchrony import (
    FIELD,
    TIMES_S,
    AsynchronyPlan,
    Flown,
    Timing,
    as_json,
    results_of,
    results_of_logs,
)
from lpac.paper.asynchrony_report import write_report
from lpac.sim.fleet.layout import settings_of

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
    plan = replace(PLAN, robot="simulated")
    assert [t for t in PLAN.timings if not t.synchronous] == plan.timings
    assert {flight.robot for flight in plan.flights()} == {"simulated"}
    results = results_of(plan, flown(plan))
    write_report(plan.flown, results, tmp_path, {"command": "..."}, "Whole robots.")
    text = (tmp_path / "README.md").read_text()
    assert "Whole robots." in text and "dashed" not in text


def test_in_real_time_messages_are_as_late_as_their_radio_makes_them(tmp_path: Path) -> None:
    plan = replace(PLAN, robot="px4", px4_build="build")
    assert plan.timings == [t for t in PLAN.timings if not t.synchronous and not t.delay_s]
    flights = plan.flights()
    assert {(flight.robot, flight.px4_build) for flight in flights} == {("px4", "build")}
    # Where it was built does not make it another flight.
    assert [f.key for f in flights] == [f.key for f in replace(plan, px4_build="there").flights()]
    write_report(plan.flown, results_of(plan, flown(plan)), tmp_path, {"command": "..."})
    assert "staleness" not in (tmp_path / "README.md").read_text()
    assert not (tmp_path / "staleness.png").exists()
    [late] = replace(plan, worlds=1).flights_of(FIELD._replace(delay_s=0.4))
    late = replace(late, bundle=str(DEFAULT_BUNDLE), flown_by=SHIPPED_ID)
    with pytest.raises(ValueError, match=r"delay_s = 0.4: must be 0.0 for programs in real time"):
        costs_of((late,))


def mission(rates: LoopRates | None, end: float, duration_s: float = 60.0) -> FlightRecord:
    """Its cost falls from 1 to `end` in half a minute."""
    times_s = np.linspace(0.0, duration_s, 61)
    falling = np.interp(times_s, (0.0, 30.0), (1.0, end))
    its = SimpleNamespace(rates=rates, curve_time_s=times_s, normalized=falling)
    return cast(FlightRecord, its)


def test_missions_of_logs_are_held_against_those_at_the_fields_rates(tmp_path: Path) -> None:
    field, slow = LoopRates(5.0, 2.5), LoopRates(5.0, 1.0)
    missions = {
        "slow-1": mission(slow, 0.6),
        "field-1": mission(field, 0.2),
        "field-2": mission(field, 0.4),
        "short": mission(field, 0.9, duration_s=40.0),
        "unknown": mission(None, 0.9),
    }
    results = results_of_logs(missions)
    assert [(result.timing, result.worlds) for result in results] == [
        (FIELD, ("field-1", "field-2")), (Timing(5.0, 1.0), ("slow-1",)),
    ]  # fmt: skip
    in_field, slowly = results
    np.testing.assert_allclose(in_field.costs[:, -1], [0.2, 0.4])
    np.testing.assert_allclose(slowly.costs, [[0.8, 0.6, 0.6]])
    np.testing.assert_allclose(slowly.area, [0.7])
    value, low, high = slowly.over_field[-1]
    # There is one of these, and those with the field's rates come to 0.2 to 0.4.
    assert (value, low, high) == pytest.approx((2.0, 1.5, 3.0))
    flown = Flown("0123456789abcdef01", 2000, "logs", None, 3)
    write_report(flown, results, tmp_path, {"command": "lpac paper async --logs day"}, "Logs.")
    text = (tmp_path / "README.md").read_text()
    assert "flies over 3 missions" in text and "in pairs" not in text and "Logs." in text
    rows = csv.DictReader((tmp_path / "async.csv").read_text().splitlines())
    assert [row["world"] for row in rows] == ["field-1", "field-2", "slow-1"]
    with pytest.raises(ValueError, match="no mission of 60 s was flown with perception at 5 Hz"):
        results_of_logs({"slow-1": missions["slow-1"], "short": missions["short"]})


def test_whole_robots_have_the_rates_and_ages_of_a_timing() -> None:
    plan = replace(
        PLAN, robot="simulated", worlds=1, bundle=TrainedBundle(str(DEFAULT_BUNDLE), SHIPPED_ID)
    )
    costs = {}
    for timing in (FIELD, Timing(5.0, 0.5)):
        [flight] = plan.flights_of(timing)
        settings = settings_of(whole_scenario(flight))
        assert settings["rates"]["policy_hz"] == pytest.approx(timing.policy_hz)
        assert settings["rates"]["perception_hz"] == 5.0
        assert settings["policy"]["max_message_age_s"] == flight.max_message_age_s
        [(_, costs[timing])] = costs_of((replace(flight, set_up="n1", duration_s=4.0),))
    (field, slow) = costs.values()
    assert field.time_s == slow.time_s == (0.0, 1.0, 2.0, 3.0, 4.0)
    assert field.cost[0] == pytest.approx(slow.cost[0], rel=1e-3) and field.cost != slow.cost
    at_once = replace(flight, clocks=replace(flight.clocks, synchronous=True))
    with pytest.raises(ValueError, match="synchronous = True: must be False for whole robots"):
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
    write_report(PLAN.flown, results, tmp_path, {"command": "lpac paper async --quick"})
    rows = list(csv.DictReader((tmp_path / "async.csv").read_text().splitlines()))
    assert len(rows) == 27
    first = {name: float(value) for name, value in rows[0].items()}
    assert (first["perception_hz"], first["policy_hz"], first["world"]) == (5.0, 2.5, 0.0)
    assert first["cost_at_60_s"] == pytest.approx(0.24)
    assert (first["rounds_per_perception"], first["said_kb_s"]) == (0.5, 5.0)
    told = json.loads((tmp_path / "async.json").read_text())
    assert told.pop("made_by") == {"command": "lpac paper async --quick"}
    assert told.pop("flown") in (tmp_path / "README.md").read_text()
    assert told == json.loads(json.dumps(as_json(PLAN.flown, results)))
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
