"""Rates and late messages: references, and reports."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from lpac.analysis.flight import FlightRecord
from lpac.analysis.logs import LoopRates
from lpac.sim.fleet.layout import settings_of
from lpac.sim.scenario import Scenario
from lpac.sim.ticks import Clocks
from lpac.study.flights import CLAIRVOYANT, CostCurve, curves_of
from lpac.study.rates import FIELD, Timing, TimingResult, rates, results_of, results_of_logs
from lpac.study.results import results_of as results_of_study
from lpac.study.study import Condition, Draw, Method, Study
from lpac.study.worlds import FIELD as FIELD_SET_UP
from lpac.study.worlds import SET_UPS
from tests.conftest import SHIPPED


def condition_of(**changes: object) -> Condition:
    return Condition(scenario=FIELD_SET_UP.scenario(**changes))


STUDY = Study(
    methods=(Method.of("lpac", SHIPPED),),
    conditions=(
        condition_of(clocks=Clocks(policy_s=2.0), max_message_age_s=4.0),
        condition_of(),
        condition_of(clocks=Clocks(synchronous=True)),
        condition_of(delay_s=0.8),
    ),
    worlds=3,
)


def flown() -> list[TimingResult]:
    """Costs that fall to a value determined by timing and world."""
    curves = {}
    for condition in STUDY.conditions:
        for draw in STUDY.draws:
            for method in STUDY.all_methods:
                [flight] = STUDY.flights_of(method, condition, draw)
                scenario = flight.scenario
                slow = 0.1 * scenario.clocks.policy_s + 0.1 * scenario.delay_s
                end = 100.0 * (0.2 + 0.1 * draw.world + slow)
                lloyd = 10.0 if scenario.controller == CLAIRVOYANT else None
                values = (100.0, (100.0 + end) / 2.0, end)
                curves[flight] = CostCurve((0.0, 30.0, 60.0), values, lloyd)
    return results_of(results_of_study(STUDY, curves), ["0", "1", "2"])


def reported(results: list[TimingResult], folder: Path, *, paired: bool = True) -> str:
    """Text of README.md."""
    section = rates(results, 2000, folder, paired=paired)
    made_by = {"command": "lpac paper async --quick"}
    section.report("async", "Rates", "Flown.", made_by).write(folder)
    return (folder / "README.md").read_text()


def test_results_are_held_against_the_fields() -> None:
    results = flown()
    assert results[0].timing == FIELD and len(results) == 4
    by_timing = {result.timing: result for result in results}
    field, slow = by_timing[FIELD], by_timing[Timing(5.0, 0.5)]
    assert field.times_s == (15.0, 30.0, 60.0)
    assert field.over_field == ((1.0, 1.0, 1.0),) * 3
    np.testing.assert_allclose(field.costs[:, -1], [0.24, 0.34, 0.44])
    np.testing.assert_allclose(field.costs[0], [0.81, 0.62, 0.24])
    assert field.means[-1].value == pytest.approx(0.34)
    np.testing.assert_allclose(field.area[0], 0.25 * 1.0 + 0.5 * 0.62 + 0.25 * 0.24)
    ratio = slow.over_field[-1]
    assert ratio.value == pytest.approx(0.5 / 0.34) and 1.0 < ratio.low < ratio.value < ratio.high
    late = by_timing[FIELD._replace(delay_s=0.8)]
    assert late.over_field[-1].value == pytest.approx(0.42 / 0.34)
    with pytest.raises(ValueError, match="no condition has the field's"):
        results_of({}, [])


def test_the_report_has_every_flight_and_says_what_made_it(tmp_path: Path) -> None:
    text = reported(flown(), tmp_path)
    rows = list(csv.DictReader((tmp_path / "async.csv").read_text().splitlines()))
    assert len(rows) == 12
    first = {name: float(value) for name, value in rows[0].items()}
    assert (first["perception_hz"], first["policy_hz"], first["world"]) == (5.0, 2.5, 0.0)
    assert first["cost_at_60_s"] == pytest.approx(0.24)
    assert (first["rounds_per_perception"], first["said_kb_s"]) == (0.5, 5.0)
    told = json.loads((tmp_path / "async.json").read_text())
    assert told["made_by"] == {"command": "lpac paper async --quick"}
    assert told["times_s"] == [15.0, 30.0, 60.0] and len(told["timings"]) == 4
    assert text.count("\n| ") == 2 + 4 and "`lpac paper async --quick`" in text
    assert "dashed" in text and "paired by world" in text
    for name in ("rates", "staleness"):
        assert f"({name}.png)" in text
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
        assert (tmp_path / f"{name}.pdf").stat().st_size > 5_000


def test_without_late_messages_nothing_is_told_of_them(tmp_path: Path) -> None:
    some = [each for each in flown() if not each.timing.delay_s and not each.timing.synchronous]
    text = reported(some, tmp_path)
    assert "staleness" not in text and "dashed" not in text
    assert not (tmp_path / "staleness.png").exists()


def mission(rates: LoopRates | None, end: float, duration_s: float = 60.0) -> FlightRecord:
    """A mission with a cost that falls from 1 to `end` in half a minute."""
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
    # A single one; those with the field's rates end at 0.2 to 0.4.
    assert (value, low, high) == pytest.approx((2.0, 1.5, 3.0))
    text = reported(results, tmp_path, paired=False)
    assert "paired by world" not in text and "unpaired missions" in text
    rows = csv.DictReader((tmp_path / "async.csv").read_text().splitlines())
    assert [row["world"] for row in rows] == ["field-1", "field-2", "slow-1"]
    with pytest.raises(ValueError, match="no mission of 60 s has perception at 5 Hz"):
        results_of_logs({"slow-1": missions["slow-1"], "short": missions["short"]})


@pytest.mark.slow
def test_whole_robots_have_the_rates_and_ages_of_a_timing() -> None:
    costs = []
    for clocks, age_s in ((Clocks(), 0.8), (Clocks(policy_s=2.0), 4.0)):
        scenario = SET_UPS["n1"].scenario(clocks=clocks, max_message_age_s=age_s, duration_s=4.0)
        settings = settings_of(scenario)
        assert settings["rates"]["policy_hz"] == pytest.approx(1.0 / clocks.policy_s)
        assert settings["rates"]["perception_hz"] == 5.0
        assert settings["policy"]["max_message_age_s"] == age_s
        assert settings["policy"]["max_input_age_s"] == max(1.0, 2.0 * clocks.policy_s)
        condition = Condition(scenario=scenario, engine="simulated")
        study = replace(STUDY, conditions=(condition,), worlds=1)
        [flight] = study.flights_of(study.methods[0], condition, Draw(0))
        [(_, curve)] = curves_of((flight,))
        costs.append(curve)
    field, slow = costs
    assert field.time_s == slow.time_s == (0.0, 1.0, 2.0, 3.0, 4.0)
    assert field.cost[0] == pytest.approx(slow.cost[0], rel=1e-3) and field.cost != slow.cost
    at_once = replace(condition, scenario=Scenario(world_size=512, communication_range=256.0,
                                                  clocks=Clocks(synchronous=True)))  # fmt: skip
    with pytest.raises(ValueError, match="synchronous = True: must be False for whole robots"):
        replace(STUDY, conditions=(at_once,))
