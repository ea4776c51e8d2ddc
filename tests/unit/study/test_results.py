"""Numbers that follow from a study's flights."""

import json
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from lpac.radio.modelled import ModelledRadio
from lpac.sim.failure import Failure, LostRobots
from lpac.sim.scenario import Scenario
from lpac.study.figures import pairs
from lpac.study.flights import CLAIRVOYANT, CostCurve, PlannedFlight
from lpac.study.results import (
    as_json,
    mission_times_s,
    over_mission,
    results_of,
    verdict_of,
    worst_worlds,
)
from lpac.study.study import Condition, Method, Study, TrainedBundle
from lpac.study.worlds import FIELD, SET_UPS
from tests.conftest import SHIPPED

WORLDS = 8
RIVAL = Method(name="decentralized-cvt")
ONE = Method(name="one", trainings=(TrainedBundle(str(SHIPPED), "ida"),))
THREE = Method(
    name="three", trainings=tuple(TrainedBundle(str(SHIPPED), f"id{name}") for name in "bcd")
)
TIMES = FIELD.scenario(duration_s=40.0)
PLAIN = Condition(scenario=TIMES)
LOSSY = Condition(scenario=replace(TIMES, loss=0.3))
EIGHT = Condition(scenario=TIMES, lost=LostRobots(2, 20.0))
LANDED = FIELD.scenario(fault="landed")
STUDY = Study(
    methods=(ONE, THREE, RIVAL, Method(name=CLAIRVOYANT)),
    conditions=(PLAIN, LOSSY, EIGHT),
    worlds=WORLDS,
)
# Final costs, initially 100; in world 3 the first policy is bad, and rises again.
ENDS = {"ida": 30.0, "idb": 31.0, "idc": 32.0, "idd": 33.0}
# Seeds identify the worlds.
WORLD_OF = {
    flight.scenario.seed: draw.world
    for draw in STUDY.draws
    for flight in STUDY.flights_of(ONE, PLAIN, draw)
}


def flown(flight: PlannedFlight) -> CostCurve:
    """Worlds differ by 10 % each; robots missing from the start cost 20 % more."""
    scenario, world = flight.scenario, WORLD_OF[flight.scenario.seed]
    scale = 1.0 + 0.1 * world
    if scenario.robots < FIELD.robots:
        scale *= 1.2
    end = {"lpac": ENDS.get(flight.flown_by, 0.0), RIVAL.name: 60.0, CLAIRVOYANT: 25.0}
    last = end[scenario.controller] + (10.0 if scenario.loss else 0.0)
    middle = last
    if flight.flown_by == "ida" and world == 3:
        last, middle = 70.0, 50.0
    values = tuple(scale * value for value in (100.0, middle, last))
    lloyd = 20.0 * scale if scenario.controller == CLAIRVOYANT else None
    return CostCurve((0.0, 20.0, 40.0), values, lloyd)


RESULTS = results_of(STUDY, {flight: flown(flight) for flight in STUDY.flights()})
TOLD = json.loads(json.dumps(as_json(STUDY, RESULTS, compared=True)))


def test_each_flight_is_flown_once() -> None:
    keys = [flight.key for flight in STUDY.flights()]
    # Four bundles under three conditions; two baselines with all robots and with eight.
    assert len(set(keys)) == len(keys) == WORLDS * (4 * 3 + 2 * 2)


def test_costs_are_over_those_at_the_start() -> None:
    one, three, rival, clairvoyant = RESULTS[PLAIN]
    expected = np.full((1, WORLDS), 0.3)
    expected[0, 3] = 0.7
    np.testing.assert_allclose(one.final, expected)
    np.testing.assert_allclose(one.over_clairvoyant, expected / 0.25)
    np.testing.assert_allclose(one.over_best_of_ten, expected / 0.2)
    np.testing.assert_allclose(three.final, np.repeat([[0.31], [0.32], [0.33]], WORLDS, axis=1))
    np.testing.assert_allclose(rival.area, (0.5 * (1.0 + 0.6) + 0.6) / 2.0)
    np.testing.assert_allclose(clairvoyant.over_clairvoyant, 1.0)
    assert one.rises_again[0].tolist() == [world == 3 for world in range(WORLDS)]
    assert worst_worlds(one, 2)[0] == 3 and len(worst_worlds(one, 99)) == WORLDS


def test_with_losses_baselines_are_the_same_and_policies_are_not() -> None:
    without, lossy = RESULTS[PLAIN], RESULTS[LOSSY]
    assert np.array_equal(lossy[2].curves, without[2].curves)
    assert lossy[1].final.min() > without[1].final.max()


def test_costs_of_a_long_flight_are_at_three_times_and_rises_count_from_the_best() -> None:
    time_s = np.arange(0.0, 301.0, 20.0)
    costs = np.interp(time_s, [0.0, 60.0, 80.0, 120.0, 140.0, 300.0], [1, 0.4, 0.3, 0.6, 0.5, 0.5])
    assert over_mission(time_s, costs).tolist() == pytest.approx([0.4, 0.6, 0.5])
    assert mission_times_s(300.0) == (60.0, 120.0, 300.0)
    assert mission_times_s(150.0) == (60.0, 120.0)
    assert mission_times_s(60.0) == (60.0,) and mission_times_s(10.0) == (10.0,)
    long = replace(RESULTS[PLAIN][0], time_s=time_s, curves=costs[None, None])
    assert long.worst_rise.tolist() == [[pytest.approx(1.0)]]
    assert replace(long, lost_at_s=130.0).worst_rise[0, 0] == pytest.approx(0.0)
    # While robots explore, costs may rise.
    early = replace(
        long, curves=np.interp(time_s, [0, 20, 40, 60], [1.0, 0.5, 0.9, 0.4])[None, None]
    )
    assert early.worst_rise[0, 0] == pytest.approx(0.0)


def test_lost_robots_are_held_against_those_who_never_had_them() -> None:
    one, _, rival, clairvoyant = RESULTS[EIGHT]
    # All relative to the initial cost of ten robots.
    np.testing.assert_allclose(rival.curves[..., 0], 1.2)
    np.testing.assert_allclose(clairvoyant.final, 0.25 * 1.2)
    assert one.over_clairvoyant[0, 0] == pytest.approx(0.3 / 0.3)


def test_what_is_told_is_what_was_flown() -> None:
    field, _, _ = TOLD["conditions"]
    one, three, *_ = field["results"]
    assert [each["name"] for each in field["results"]] == [m.name for m in STUDY.methods]
    assert (one["trainings"], three["trainings"]) == (1, 3)
    assert one["final"]["mean"][0] == pytest.approx(0.35)
    assert one["final"]["worst"] == pytest.approx(0.7) and one["final"]["worst_world"] == 3
    assert one["over_clairvoyant"]["ratio_of_means"][0] == pytest.approx(1.4)
    assert one["fails"]["share"] == one["rises_again"]["share"] == 1 / WORLDS
    assert one["fails"]["at_most_share"] > 1 / WORLDS
    assert one["above"]["decentralized-cvt"]["share"] == 1 / WORLDS
    assert three["above"]["clairvoyant-cvt"]["share"] == 1.0
    assert one["final"]["interquartile_mean"][0] == pytest.approx(0.3)
    assert three["against"]["decentralized-cvt"]["better"] == "a"
    # The first has a worse mean, but only because of one world: no verdict.
    assert field["compared"]["better"] is None
    assert field["compared"]["a_below_b"][0] == pytest.approx(7 / 8)
    assert not field["compared"]["of_methods"]


def test_pairs_say_whose_dots_these_are() -> None:
    [legend] = pairs(PLAIN, RESULTS[PLAIN]).legends
    assert [text.get_text() for text in legend.get_texts()] == ["one", "three"]


def test_what_is_claimed_of_a_method_needs_its_trainings() -> None:
    one, three, rival, _ = RESULTS[PLAIN]
    assert verdict_of(three, rival).of_methods and not verdict_of(one, rival).of_methods


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"worlds": 0}, "worlds = 0: must be from 1 to 10000"),
        ({"world_set": "tests"}, "world_set = 'tests': allowed are 'training', 'validation'"),
        ({"methods": (ONE, ONE)}, "methods one, one, clairvoyant-cvt: must differ"),
        ({"conditions": (PLAIN, replace(PLAIN, title="field"))}, "title = 'field': is used twi"),
        ({"conditions": ()}, "conditions = .*: must be at least 1 long"),
        (
            {"conditions": (Condition(scenario=SET_UPS["n32"].scenario(), engine="simulated"),)},
            "robots = 32: must be from 1 to 30",
        ),
        (
            {"conditions": (Condition(engine="simulated", lost=LostRobots(2, 20.0)),)},
            "lost = 2@20: must not be given for whole robots",
        ),
        (
            {
                "conditions": (
                    Condition(scenario=FIELD.scenario(fault="landed"), engine="simulated"),
                )
            },
            "fault = landed: must not be given in a study",
        ),
        ({"conditions": (Condition(engine="px4"),)}, "engine = 'px4': needs PX4's build folder"),
        ({"conditions": (Condition(methods=("two",)),)}, "methods = 'two': must be one of one, "),
        ({"receiver_error_m": (5.0, 1.0)}, "receiver_error_m = .*: must be .least, greatest."),
    ],
)
def test_a_study_that_cannot_be(change: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        replace(STUDY, **change)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"scenario": Scenario()}, "world_size, communication_range: must be given"),
        ({"lost": LostRobots(2, 60.0)}, "lost = 2@60: must be in flight, before 60 s"),
        (
            {"scenario": SET_UPS["n1"].scenario(), "lost": LostRobots(1, 20.0)},
            "lost = 1@20: must be fewer than robots = 1",
        ),
    ],
)
def test_a_condition_that_cannot_be(change: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        Condition(**change)


def test_a_condition_is_named_by_what_is_otherwise_than_usual() -> None:
    assert PLAIN.name == "field" and LOSSY.name == "field, 30 % of messages lost"
    assert EIGHT.name == "field, 2 of 10 robots lost at 20 s"
    other = FIELD.scenario(world_size=640, max_message_age_s=1.5)
    assert Condition(scenario=other, engine="simulated", title="").name == (
        "10 robots in 640 x 640 units, 10 features, range 256, max_message_age_s = 1.5, "
        "whole robots"
    )


def test_the_radio_model_says_what_messages_suffer() -> None:
    radio = ModelledRadio("mesh")
    condition = Condition(scenario=SET_UPS["n100"].scenario(radio=radio, duration_s=40.0))
    study = Study(methods=(ONE,), conditions=(condition,), worlds=1)
    flights = study.flights()
    WORLD_OF.update({flight.scenario.seed: 0 for flight in flights})
    told = as_json(study, results_of(study, {f: flown(f) for f in flights}))
    [of_condition] = told["conditions"]
    assert of_condition["name"] == "n100, mesh by the model"
    link = radio.link(100, "float16")
    assert of_condition["scenario"]["link"] == link._asdict()
    assert of_condition["scenario"]["radio"] == asdict(radio)
    assert TOLD["conditions"][0]["scenario"]["radio"] is None


def test_lost_robots_are_read() -> None:
    assert LostRobots.parse("2@20") == LostRobots(2, 20.0)
    for text in ("2", "2@", "two@20", "2@-1"):
        with pytest.raises(ValueError, match="must be ROBOTS@SECONDS, such as 2@20"):
            LostRobots.parse(text)
    assert Failure.parse("3@60-80.5") == Failure(3, 60.0, 80.5)
    for text in ("3", "3@60", "r3@60-80", "3@-1-80"):
        with pytest.raises(ValueError, match="must be ROBOT@FROM-UNTIL in s, such as 3@60-80"):
            Failure.parse(text)
