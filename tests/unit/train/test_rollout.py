"""Flights for data: their scenarios, their pilots, and their stored states."""

from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core import F32, F64
from edge.core.world import rasterize
from edge.policy.bundle import Bundle
from lpac.analysis.voronoi import coverage_cost, voronoi_cells
from lpac.analysis.worlds import random_features
from lpac.sim.batch import BatchedFlights, fly_batch
from lpac.sim.description import FIELD_SCALE
from lpac.study.worlds import FIELD, draw_world
from lpac.train.config import DaggerConfig, DataConfig, Disturbances, ExpertName, WorldRanges
from lpac.train.data import Dataset, Shards
from lpac.train.expert import Expert, assignment, make_expert
from lpac.train.rollout import (
    PlannedShard,
    ShardTask,
    States,
    fly_shard,
    plan_round,
)

pytestmark = pytest.mark.slow

DATA = DataConfig(flights=2, states=4, duration_s=6.0, disturbances=Disturbances(loss=(0.2, 0.5)))
DAGGER = DaggerConfig(rounds=1, flights=4, duration_s=6.0, expert_flights=0.5)


@pytest.fixture(scope="module")
def shard() -> PlannedShard:
    [shard] = plan_round(DATA, DAGGER, 7, 0)
    return shard


@pytest.fixture(scope="module")
def states(shard: PlannedShard, shipped_bundle: Bundle) -> States:
    return fly_shard(ShardTask(shard, shipped_bundle)).states


def test_flights_are_over_training_worlds_of_their_own() -> None:
    plans = [
        [
            planned
            for shard in plan_round(DATA, DAGGER, seed, round_)
            for planned in zip(shard.scenarios, shard.by_expert, strict=True)
        ]
        for seed in (0, 1)
        for round_ in (0, 1)
    ]
    assert [len(plan) for plan in plans] == [2, 4, 2, 4]
    assert [by_expert for _, by_expert in plans[1]] == [True, True, False, False]
    assert all(by_expert for _, by_expert in plans[0])
    features = [scenario.features for plan in plans for scenario, _ in plan]
    assert len(set(features)) == len(features)
    assert plans[0][1][0].features == draw_world("training", 1, FIELD).features
    assert plans[2][1][0].features == draw_world("training", 1_000_001, FIELD).features


@given(seed=st.integers(0, 20), robots=st.integers(1, 60))
def test_draws_are_within_the_ranges(seed: int, robots: int) -> None:
    worlds = WorldRanges(
        robots=(1, robots), world_size=(100, 300), communication_range=(50.0, 80.0),
        features=(1, 4), sigma=(10.0, 20.0),
    )  # fmt: skip
    wrong = Disturbances(
        loss=(0.1, 0.3), delay_s=(0.0, 0.2), lag_s=(0.5, 1.0), lost_robots=(0, 3), come_back=0.5
    )
    data = DataConfig(flights=9, worlds=(worlds,), disturbances=wrong)
    shards = plan_round(data, DAGGER, seed, 0)
    assert shards == plan_round(data, DAGGER, seed, 0)
    for shard in shards:
        assert len(shard.scenarios) == 1 or sum(s.robots for s in shard.scenarios) <= 40
        times_s = np.array(shard.times_s)
        assert (np.diff(times_s) > 0.0).all() and times_s[0] >= 0.5 and times_s[-1] <= 20.0
    flights = [scenario for shard in shards for scenario in shard.scenarios]
    assert len(flights) == 9
    for flight in flights:
        assert 1 <= flight.robots <= robots and 0.1 <= flight.loss <= 0.3
        assert flight.world_size is not None and 100 <= flight.world_size <= 300
        assert 0.5 <= flight.lag_s <= 1.0 and len(flight.failures) <= min(3, flight.robots - 1)


def test_states_are_what_robots_perceive_and_the_expert_says(
    states: States, shard: PlannedShard, shipped_bundle: Bundle
) -> None:
    """The policy flies and perceives; the expert's velocities are stored."""
    by_policy = replace(shard, by_expert=(False,) * len(shard.scenarios))
    kept = fly_shard(ShardTask(by_policy, shipped_bundle)).states
    flights = BatchedFlights(shard.scenarios, shipped_bundle)
    row = 0
    for moments in flights.moments(shard.times_s):
        for moment in moments:
            rows = slice(row, row := row + 10)
            inputs = moment.inputs().arrays
            np.testing.assert_array_equal(
                kept.inputs["images"][rows], inputs["images"].astype(np.float16)
            )
            np.testing.assert_array_equal(
                kept.inputs["position_feature"][rows], inputs["position_feature"]
            )
            expert = make_expert(DATA, moment.prepared)
            told = expert.velocities(moment.positions, moment.alive)
            np.testing.assert_allclose(kept.velocities[rows], told, rtol=1e-6)
    assert row == len(kept.velocities) == 80
    speeds = np.linalg.norm(kept.velocities, axis=1)
    assert speeds.max() <= 5.0 + 1e-5
    assert not np.array_equal(kept.velocities, states.velocities)


def test_the_expert_covers_better_than_it_began(
    shard: PlannedShard, shipped_bundle: Bundle
) -> None:
    longer = replace(shard.scenarios[0], duration_s=30.0)
    task = replace(shard, scenarios=(longer,), by_expert=(True,), times_s=(1.0, 25.0))
    first, last = fly_shard(ShardTask(task, shipped_bundle)).states.velocities.reshape(2, 10, 2)
    # It has nearly reached its goals.
    assert np.linalg.norm(last, axis=1).mean() < 0.2 * np.linalg.norm(first, axis=1).mean()


def test_who_decides_changes_nothing_else(shard: PlannedShard, shipped_bundle: Bundle) -> None:
    """The policy's flights equal those of the simulator, including payloads."""
    by_policy = replace(
        shard, by_expert=(False,) * len(shard.scenarios), times_s=(DATA.duration_s,)
    )
    kept = fly_shard(ShardTask(by_policy, shipped_bundle)).states
    flown = fly_batch(shard.scenarios, shipped_bundle)
    assert kept.largest_payload == max(each.largest_payload for each in flown)


@pytest.mark.parametrize("expert", ["clairvoyant-cvt", "best-of-lloyd", "exploring-cvt"])
def test_experts_leave_out_who_is_lost(
    expert: str, shard: PlannedShard, shipped_bundle: Bundle
) -> None:
    prepared = BatchedFlights([shard.scenarios[0]], shipped_bundle).prepared[0]
    told = make_expert(replace(DATA, expert=expert, lloyd_runs=2), prepared)  # type: ignore[arg-type]
    positions = FIELD_SCALE.position_to_model(prepared.starts_m)
    alive = np.arange(10) != 4
    velocities = told.velocities(positions, alive)
    assert not velocities[4].any() and velocities[alive].any(axis=1).all()
    np.testing.assert_allclose(
        velocities[alive], told.velocities(positions[alive], np.ones(9, np.bool_))
    )
    for few in ([7], [4], [9, 4, 0], []):
        np.testing.assert_array_equal(told.velocities(positions, alive, few), velocities[few])


def test_what_overshoots_is_flown_no_faster(shard: PlannedShard, shipped_bundle: Bundle) -> None:
    ends = {}
    for overshoot in (1.0, 3.0):
        task = replace(
            shard, scenarios=shard.scenarios[:1], by_expert=shard.by_expert[:1], times_s=(2.0,),
            data=replace(DATA, overshoot=overshoot),
        )  # fmt: skip
        told = fly_shard(ShardTask(task, shipped_bundle)).states.velocities
        ends[overshoot] = np.linalg.norm(told, axis=1)
    assert ends[1.0].max() == pytest.approx(5.0) and 5.0 < ends[3.0].max() <= 15.0 + 1e-5
    # Both flights are equal until then: slower velocities than max_speed are equal.
    slow = ends[1.0] < 5.0 - 1e-5
    np.testing.assert_allclose(ends[3.0][slow], ends[1.0][slow])


def test_the_best_of_lloyd_ends_below_the_clairvoyant(shipped_bundle: Bundle) -> None:
    ends = {}
    for expert in ("clairvoyant-cvt", "best-of-lloyd"):
        costs = []
        for shard in plan_round(DATA, DAGGER, 1, 0):
            for world in BatchedFlights(shard.scenarios, shipped_bundle).prepared:
                told = make_expert(replace(DATA, expert=expert), world)
                positions = FIELD_SCALE.position_to_model(world.starts_m)
                for _ in range(30):
                    positions = positions + 4.0 * told.velocities(positions, np.ones(10, np.bool_))
                costs.append(coverage_cost(world.importance, positions))
        ends[expert] = sum(costs)
    assert ends["best-of-lloyd"] < ends["clairvoyant-cvt"]


class FineCentroids(NamedTuple):
    """ClairvoyantCVT's centroids on the fine raster."""

    importance: F32

    def __call__(self, positions: F64, robots: npt.NDArray[np.intp]) -> F64:
        return voronoi_cells(self.importance, positions).centroid[robots]

    def look(self, positions: F64) -> None:
        pass


def test_who_explores_ends_about_as_well_as_who_knows(shipped_bundle: Bundle) -> None:
    """And its goals are continuous: a small step changes them little."""
    everybody = np.ones(10, np.bool_)
    ends: dict[ExpertName, float] = {}
    largest = 0.0
    for expert in ("clairvoyant-cvt", "exploring-cvt"):
        costs = []
        [shard] = plan_round(DATA, DAGGER, 0, 0)
        for world in BatchedFlights(shard.scenarios, shipped_bundle).prepared:
            told = make_expert(replace(DATA, expert=expert), world)
            positions = FIELD_SCALE.position_to_model(world.starts_m)
            for _ in range(100):
                velocities = told.velocities(positions, everybody)
                if expert == "exploring-cvt":
                    beside = told.velocities(positions + 0.01, everybody)
                    largest = max(largest, float(np.abs(beside - velocities).max()))
                positions = positions + 1.6 * velocities
            costs.append(coverage_cost(world.importance, positions))
        ends[expert] = sum(costs)
    assert ends["exploring-cvt"] < 1.1 * ends["clairvoyant-cvt"]
    assert largest < 1.0


def test_the_coarse_raster_is_good_enough(shipped_bundle: Bundle) -> None:
    """See `lpac.train.expert._Centroids`."""
    errors, fine, coarse = [], 0.0, 0.0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        importance = rasterize(random_features(rng, 10, 512), 512)
        scenario = replace(
            plan_round(DATA, DAGGER, 0, 0)[0].scenarios[0],
            features=random_features(np.random.default_rng(seed), 10, 512),
        )
        [world] = BatchedFlights([scenario], shipped_bundle).prepared
        np.testing.assert_array_equal(world.importance, importance)
        ours = make_expert(DATA, world)
        exact = Expert(FineCentroids(importance), 5.0, 0.8)
        everybody = np.ones(10, np.bool_)
        positions = rng.uniform(0, 512, (10, 2))
        by_exact = by_ours = positions
        for _ in range(25):
            # Far from its goal a robot flies at full speed: velocities differ only near the goals.
            difference = ours.velocities(by_exact, everybody) - exact.velocities(
                by_exact, everybody
            )
            errors.append(np.abs(difference).mean() * 0.8)
            by_exact = by_exact + 4.0 * exact.velocities(by_exact, everybody)
            by_ours = by_ours + 4.0 * ours.velocities(by_ours, everybody)
        fine += coverage_cost(importance, by_exact)
        coarse += coverage_cost(importance, by_ours)
    assert np.mean(errors) < 0.2
    assert abs(coarse / fine - 1.0) < 0.01


@given(n=st.integers(1, 7), seed=st.integers(0, 1000))
def test_assignments_are_the_cheapest(n: int, seed: int) -> None:
    cost = np.random.default_rng(seed).random((n, n))
    columns = assignment(cost)
    assert sorted(columns) == list(range(n))
    rows = np.arange(n)
    least = min(cost[rows, list(order)].sum() for order in permutations(range(n)))
    assert cost[rows, columns].sum() == pytest.approx(least)


def test_shards_are_added_and_never_replaced(states: States, tmp_path: Path) -> None:
    shards = Shards(tmp_path, "config")
    shards.add("01-0000", states, {"seed": 1})
    shards.add("00-0000", states, {"seed": 0})
    again = Shards(tmp_path, "config")
    assert list(again.facts) == ["01-0000", "00-0000"] and again.facts["01-0000"]["seed"] == 1
    assert len(again.load(0)) == 8 and len(again.load(1)) == 16
    (tmp_path / "00-0000.npz").unlink()
    assert list(Shards(tmp_path, "config").facts) == ["01-0000"]
    assert Shards(tmp_path, "another").facts == {}


def test_a_broken_shard_is_one_line(states: States, tmp_path: Path) -> None:
    shards = Shards(tmp_path, "config")
    shards.add("00-0000", states, {})
    (tmp_path / "00-0000.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"00-0000\.npz: unreadable shard"):
        shards.load(0)


@given(
    sizes=st.lists(st.integers(1, 6), min_size=1, max_size=12), robots=st.integers(1, 12),
    seed=st.integers(0, 99),
)  # fmt: skip
def test_batches_hold_each_state_once(sizes: list[int], robots: int, seed: int) -> None:
    rows = sum(sizes)
    which = np.repeat(np.arange(len(sizes)), sizes)
    data = Dataset(
        {"number": which.astype(np.float32)[:, None]},
        np.zeros((rows, 2), np.float32),
        np.array(sizes, np.int32),
        np.concatenate([np.full(n * n, n % 2 == 0) for n in sizes]),
    )
    batches = data.batches(np.random.default_rng(seed), robots)
    assert sorted(np.concatenate(batches)) == list(range(len(sizes)))
    for states in batches:
        batch = data.batch(states)
        taken = [sizes[state] for state in states]
        assert len(states) == 1 or sum(taken) <= robots
        assert batch.present.sum(axis=1).tolist() == taken
        assert batch.inputs["number"][:, 0].tolist() == np.repeat(states, taken).tolist()
        pairs = np.array([n * n if n % 2 == 0 else 0 for n in taken])
        assert batch.adjacency.sum(axis=(1, 2)).tolist() == pairs.tolist()
