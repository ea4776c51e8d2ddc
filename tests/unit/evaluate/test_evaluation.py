"""What an evaluation flies, and the numbers that it tells of it."""

import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest

from lpac.evaluate.evaluation import (
    Condition,
    Evaluation,
    Method,
    TrainedBundle,
    as_json,
    results_of,
    verdict_of,
    worst_worlds,
)
from lpac.evaluate.flights import (
    LLOYD,
    POLICY,
    EvaluationFlight,
    FlownCost,
    groups_of,
)
from lpac.radio.modelled import ModelledRadio
from lpac.sim.failure import Failure, LostRobots

WORLDS = 8
CLAIRVOYANT = Method(name="clairvoyant-cvt", flier="clairvoyant-cvt")
RIVAL = Method(name="decentralized-cvt", flier="decentralized-cvt")
ONE = Method(name="one", flier=POLICY, trainings=(TrainedBundle("a", "ida"),))
THREE = Method(
    name="three",
    flier=POLICY,
    trainings=tuple(TrainedBundle(name, f"id{name}") for name in "bcd"),
)
LOSSY, EIGHT = Condition("field", loss=0.3), Condition("field", lost=LostRobots(2, 20.0))
EVALUATION = Evaluation(
    methods=(ONE, THREE, RIVAL, CLAIRVOYANT),
    conditions=(Condition("field"), LOSSY, EIGHT),
    world_set="validation",
    worlds=WORLDS,
    duration_s=40.0,
    sizes_from="a",
    sizes="sizes",
)
# What each ends at, of 100 at the start; in world 3 the first policy is bad, and rises again.
ENDS = {"a": 30.0, "b": 31.0, "c": 32.0, "d": 33.0}


def flown(flight: EvaluationFlight) -> FlownCost:
    """Worlds differ by 10 % each; robots that are missing from the start cost 20 % more."""
    scale = 1.0 + 0.1 * flight.world
    if flight.lost.robots and not flight.lost.at_s:
        scale *= 1.2
    if flight.flier == LLOYD:
        return FlownCost((0.0, 0.0), (100.0 * scale, 20.0 * scale))
    end = {POLICY: ENDS.get(flight.bundle, 0.0), RIVAL.flier: 60.0, CLAIRVOYANT.flier: 25.0}
    last = end[flight.flier] + (10.0 if flight.loss else 0.0)
    middle = last
    if flight.bundle == "a" and flight.flier == POLICY and flight.world == 3:
        last, middle = 70.0, 50.0
    values = (100.0, middle, last)
    return FlownCost((0.0, 20.0, 40.0), tuple(scale * value for value in values))


COSTS = {flight: flown(flight) for flight in EVALUATION.flights()}
RESULTS = results_of(EVALUATION, COSTS)
TOLD = json.loads(json.dumps(as_json(EVALUATION, RESULTS, compared=True)))


def test_each_flight_is_flown_once() -> None:
    flights = EVALUATION.flights()
    keys = [flight.key for flight in flights]
    assert len(set(keys)) == len(keys)
    # Four bundles under three conditions; two baselines and Lloyd's with all robots and with eight.
    assert len(flights) == WORLDS * (4 * 3 + 3 * 2)
    assert all(flight.loss == 0.0 for flight in flights if flight.flier != POLICY)
    # Wherever the bundle lies.
    assert replace(flights[0], bundle="elsewhere").key == flights[0].key
    assert replace(flights[0], flown_by="another").key != flights[0].key


def test_policies_fly_together_and_nothing_gets_lost() -> None:
    groups = groups_of(EVALUATION.flights())
    assert sorted(f.key for g in groups for f in g) == sorted(f.key for f in EVALUATION.flights())
    for group in groups:
        assert len({(flight.flier, flight.bundle, flight.set_up) for flight in group}) == 1
        assert len(group) == 1 or group[0].flier == POLICY
    assert max(map(len, groups)) == 8


def test_costs_are_over_those_at_the_start() -> None:
    one, three, rival, clairvoyant = RESULTS[Condition("field")]
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
    without, lossy = RESULTS[Condition("field")], RESULTS[LOSSY]
    assert np.array_equal(lossy[2].curves, without[2].curves)
    assert lossy[1].final.min() > without[1].final.max()


def test_lost_robots_are_held_against_those_who_never_had_them() -> None:
    one, _, rival, clairvoyant = RESULTS[EIGHT]
    # All over what all ten began with.
    np.testing.assert_allclose(rival.curves[..., 0], 1.2)
    np.testing.assert_allclose(clairvoyant.final, 0.25 * 1.2)
    assert one.over_clairvoyant[0, 0] == pytest.approx(0.3 / 0.3)


def test_what_is_told_is_what_was_flown() -> None:
    field, _, _ = TOLD["conditions"]
    one, three, *_ = field["results"]
    assert [each["name"] for each in field["results"]] == [m.name for m in EVALUATION.methods]
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
    # On average the first is worse, but for one world: the data do not tell.
    assert field["compared"]["better"] is None
    assert field["compared"]["a_below_b"][0] == pytest.approx(7 / 8)
    assert not field["compared"]["of_methods"]


def test_what_is_claimed_of_a_method_needs_its_trainings() -> None:
    one, three, rival, _ = RESULTS[Condition("field")]
    assert verdict_of(three, rival).of_methods and not verdict_of(one, rival).of_methods


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"worlds": 0}, "worlds = 0: must be at least 1"),
        ({"duration_s": float("inf")}, "duration = inf: must be positive and finite"),
        ({"conditions": (Condition("field", loss=1.5),)}, "loss = 1.5: must be from 0 to 1"),
        (
            {"conditions": (Condition("n32", robot="simulated"),)},
            "n32: of whole robots 30 fly at most",
        ),
        ({"conditions": (Condition("field", lag_s=-1.0),)}, "lag_s = -1.0: must be at least 0"),
        (
            {"conditions": (Condition("field", position_error_m=math.nan),)},
            "position_error_m = nan: must be at least 0 and finite",
        ),
        ({"conditions": (Condition("field", lost=LostRobots(2, 40.0)),)}, "must be in flight"),
        ({"conditions": (Condition("n1", lost=LostRobots(1, 20.0)),)}, "n1 has no more"),
        ({"methods": (ONE, ONE, CLAIRVOYANT)}, "methods one, one, clairvoyant-cvt: each once"),
    ],
)
def test_an_evaluation_that_cannot_be(change: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        replace(EVALUATION, **change)  # type: ignore[arg-type]


def test_with_a_modelled_radio_policies_alone_fly_with_it() -> None:
    radio = ModelledRadio("mesh")
    condition = Condition("n100", radio=radio)
    evaluation = replace(EVALUATION, conditions=(condition,))
    flights = evaluation.flights()
    assert {f.radio for f in flights if f.flier == POLICY} == {radio}
    assert {f.radio for f in flights if f.flier != POLICY} == {None}
    told = as_json(
        evaluation, results_of(evaluation, {f: flown(f) for f in flights}), compared=False
    )
    [of_condition] = told["conditions"]
    assert of_condition["name"] == "n100, mesh by the model" and of_condition["loss"] == 0.0
    link = radio.link(100, "float16")
    assert of_condition["radio_model"] == {
        "transport": "mesh", "wifi": asdict(radio.wifi), "loss": link.loss,
        "delay_s": link.delay_s,
    }  # fmt: skip
    assert TOLD["conditions"][0]["radio_model"] is None


def test_lost_robots_are_read() -> None:
    assert LostRobots.parse("2@20") == LostRobots(2, 20.0)
    for text in ("2", "2@", "two@20", "2@-1"):
        with pytest.raises(ValueError, match="must be ROBOTS@SECONDS, such as 2@20"):
            LostRobots.parse(text)
    assert Failure.parse("3@60-80.5") == Failure(3, 60.0, 80.5)
    for text in ("3", "3@60", "r3@60-80", "3@-1-80"):
        with pytest.raises(ValueError, match="must be ROBOT@FROM-UNTIL in s, such as 3@60-80"):
            Failure.parse(text)
