"""Flights of an evaluation: those of its worlds, and kept."""

import dataclasses
import json
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.policy.bundle import Bundle, load_bundle
from lpac.evaluate.flights import (
    LLOYD,
    POLICY,
    EvaluationFlight,
    FlownCost,
    KeptFlights,
    costs_of,
    fly_group,
    whole_scenario,
)
from lpac.evaluate.worlds import FIELD, SET_UPS, draw_world
from lpac.radio.airtime import Wifi
from lpac.radio.modelled import ModelledRadio
from lpac.sim.cores import Outcome, in_this_process
from lpac.sim.failure import LostRobots
from lpac.sim.fleet.layout import Layout
from lpac.sim.ticks import Clocks
from tests.conftest import SHIPPED


@pytest.fixture(scope="module")
def flight(shipped_bundle: Bundle) -> EvaluationFlight:
    return EvaluationFlight(
        flier=POLICY, bundle=str(SHIPPED), flown_by=shipped_bundle.id, world_set="training",
        world=3, set_up="field", duration_s=1.0,
    )  # fmt: skip


def test_all_fly_over_the_sets_world(flight: EvaluationFlight) -> None:
    world = draw_world("training", 3, FIELD)
    for flier in (POLICY, "clairvoyant-cvt"):
        [(_, flown)] = fly_group((dataclasses.replace(flight, flier=flier),))
        assert flown.features == world.features
        np.testing.assert_allclose(flown.positions_m[0] * 16.0, world.starts)
        assert flown.scenario.seed == world.seed
        assert flown.perception.communication_range == FIELD.communication_range


def test_a_batch_tells_what_its_flights_tell(flight: EvaluationFlight) -> None:
    changes: list[dict[str, Any]] = [
        {}, {"loss": 0.5}, {"world": 4}, {"delay_s": 0.3}, {"max_message_age_s": 0.1},
        {"payload": "float32"}, {"clocks": Clocks(perception_s=0.1, policy_s=0.2)},
        {"lag_s": 0.6}, {"position_error_m": 1.5},
        {"radio": ModelledRadio("multicast", Wifi(frame_loss=0.3))},
    ]  # fmt: skip
    group = tuple(dataclasses.replace(flight, **change) for change in changes)
    assert len({one.key for one in group}) == len({costs for _, costs in costs_of(group)}) == 10
    assert costs_of(group) == [pair for one in group for pair in costs_of((one,))]


def test_who_is_lost_does_not_count(flight: EvaluationFlight) -> None:
    lost = dataclasses.replace(flight, lost=LostRobots(2, 0.5))
    never = dataclasses.replace(flight, flier="clairvoyant-cvt", lost=LostRobots(2, 0.0))
    [(_, whole), (_, of_lost)] = costs_of((flight, lost))
    [(_, of_eight)] = costs_of((never,))
    assert of_lost.cost[0] == whole.cost[0] < of_eight.cost[0]
    assert of_lost.cost[-1] > whole.cost[-1]
    [(_, flown)] = fly_group((never,))
    assert flown.positions_m.shape[1] == 8


@pytest.mark.slow
def test_whole_robots_begin_where_points_from_pads_do(flight: EvaluationFlight) -> None:
    point = dataclasses.replace(flight, robot="point-from-pad", set_up="n3", world=4)
    [(_, of_point)] = costs_of((point,))
    [(_, of_whole)] = costs_of((dataclasses.replace(point, robot="simulated"),))
    assert of_whole.time_s == of_point.time_s == (0.0, 1.0)
    # They hold above their pads, in wind.
    assert of_whole.cost[0] == pytest.approx(of_point.cost[0], rel=0.05)
    assert of_whole.cost != of_point.cost
    for set_up in ("n3", "field"):
        [(_, flown)] = fly_group((dataclasses.replace(point, set_up=set_up),))
        assert flown.features == draw_world("training", 4, SET_UPS[set_up]).features


def test_whole_robots_fly_a_bundle_of_their_set_ups_world_and_range(
    flight: EvaluationFlight, tmp_path: Path
) -> None:
    for set_up, own in (("field", False), ("n3", True)):
        layout = Layout(whole_scenario(dataclasses.replace(flight, set_up=set_up)), SHIPPED)
        robots: dict[str, dict[str, object]] = {
            f"r{i}": {
                "system_id": i + 1,
                "mavlink_url": f"udpin://127.0.0.1:{14551 + i}",
                "zenoh_port": 7447 + i,
            }
            for i in range(SET_UPS[set_up].robots)
        }
        layout.write(tmp_path, "fleet", robots)
        assert (layout.bundle_path == SHIPPED) is not own
        perception = load_bundle(layout.bundle_path).manifest.perception
        assert perception is not None
        assert perception.world_size == SET_UPS[set_up].world_size
    assert SET_UPS["n3"].world_size < FIELD.world_size


def test_the_best_of_ten_is_no_more_than_clairvoyants(flight: EvaluationFlight) -> None:
    best = costs_of((dataclasses.replace(flight, flier=LLOYD),))[0][1]
    clairvoyant = costs_of((dataclasses.replace(flight, flier="clairvoyant-cvt"),))[0][1]
    assert best.cost[0] == clairvoyant.cost[0] and best.cost[-1] < clairvoyant.cost[-1]


def test_another_bundle_is_not_taken_for_it(flight: EvaluationFlight) -> None:
    with pytest.raises(ValueError, match="is another bundle by now"):
        costs_of((dataclasses.replace(flight, flown_by="0" * 64),))


def test_what_was_flown_is_kept(flight: EvaluationFlight, tmp_path: Path) -> None:
    first = dict(KeptFlights(tmp_path).fly([flight], in_this_process))

    def refuse(do: object, tasks: Sequence[object]) -> Generator[Outcome, None, None]:
        raise AssertionError(f"{tasks} were flown")
        yield

    assert dict(KeptFlights(tmp_path).fly([flight], refuse)) == first
    # What another version of the code has flown does not count.
    path = tmp_path / "flights.jsonl"
    came_of, *lines = path.read_text().splitlines()
    other = json.dumps({**json.loads(came_of), "code": "x"})
    path.write_text("\n".join([other, *lines]) + "\n")
    with pytest.raises(AssertionError, match="were flown"):
        dict(KeptFlights(tmp_path).fly([flight], refuse))
    assert first[flight] == FlownCost(*first[flight]) and len(first[flight].cost) == 2
