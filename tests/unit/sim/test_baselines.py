"""The baselines: what each of them knows, and where it goes for that."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.core import F32, F64, Bools
from edge.core.perception import PerceptionParameters, part_in_world, window_corner
from lpac.analysis.voronoi import local_centroid
from lpac.sim.baselines import PRIOR, Baseline, BaselineName, connected, make_baseline

SIZE = 64
PERCEPTION = PerceptionParameters(
    world_size=SIZE, local_map_size=48, sensor_size=16, communication_range=20.0
)
PLACE = st.tuples(st.floats(0.0, SIZE), st.floats(0.0, SIZE))
# Where robots are at each of some steps.
TRACKS = st.integers(1, 5).flatmap(
    lambda robots: st.lists(
        st.lists(PLACE, min_size=robots, max_size=robots), min_size=1, max_size=4
    )
)
IMPORTANCE: F32 = np.random.default_rng(0).uniform(0.2, 1.0, (SIZE, SIZE)).astype(np.float32)


def baseline(name: BaselineName, robots: int) -> Baseline:
    return make_baseline(name, IMPORTANCE, PERCEPTION, robots)


def reached(positions: F64) -> Bools:
    """(N, N): who reaches whom, by as many hops as there are robots."""
    near = np.linalg.norm(positions[:, None] - positions, axis=2) < PERCEPTION.communication_range
    within: Bools = np.linalg.matrix_power(near.astype(int), len(positions)) > 0
    return within


def view(position: F64) -> tuple[slice, slice]:
    corner = window_corner(position, PERCEPTION.sensor_size)
    return part_in_world(corner, PERCEPTION.sensor_size, SIZE)[0]


def seen_by_each(track: list[F64], *, shared: bool) -> npt.NDArray[np.bool_]:
    """(N, SIZE, SIZE): what each robot knows in the end, the long way round."""
    robots = len(track[0])
    seen = np.zeros((robots, SIZE, SIZE), np.bool_)
    for positions in track:
        for robot, position in enumerate(positions):
            seen[robot][view(position)] = True
        if shared:
            who = reached(positions)
            seen = np.array([seen[who[robot]].any(axis=0) for robot in range(robots)])
    return seen


def local(known: F32, position: F64) -> tuple[F32, tuple[int, int]]:
    corner = window_corner(position, PERCEPTION.local_map_size)
    part, _ = part_in_world(corner, PERCEPTION.local_map_size, SIZE)
    return known[part], (part[0].start, part[1].start)


@given(st.lists(PLACE, min_size=1, max_size=12).map(np.array))
def test_groups_are_those_who_reach_each_other(positions: F64) -> None:
    groups = connected(positions, PERCEPTION.communication_range)
    assert sorted(np.concatenate(groups).tolist()) == list(range(len(positions)))
    who = reached(positions)
    for group in groups:
        for robot in group:
            assert np.flatnonzero(who[robot]).tolist() == group.tolist()


@pytest.mark.parametrize(
    ("name", "shared", "unseen"),
    [
        ("decentralized-cvt", False, 0.0),
        ("decentralized-cvt-prior", False, PRIOR),
        ("shared-cvt", True, 0.0),
        ("shared-cvt-prior", True, PRIOR),
    ],
)
@settings(max_examples=30)
@given(TRACKS)
def test_each_goes_to_the_centroid_of_what_it_knows(
    name: BaselineName, shared: bool, unseen: float, track: list[list[tuple[float, float]]]
) -> None:
    steps = [np.array(positions) for positions in track]
    flown = baseline(name, len(steps[0]))
    for positions in steps:
        goals = flown.goals(positions)
    positions = steps[-1]
    seen = seen_by_each(steps, shared=shared)
    distances = np.linalg.norm(positions[:, None] - positions, axis=2)
    heard = reached(positions) if shared else distances < PERCEPTION.communication_range
    for robot, position in enumerate(positions):
        known = np.where(seen[robot], IMPORTANCE, np.float32(unseen))
        others = np.delete(positions, robot, axis=0)[np.delete(heard[robot], robot)]
        expected = local_centroid(*local(known, position), position, others)
        np.testing.assert_allclose(goals[robot], expected, atol=1e-6)


@settings(max_examples=30)
@given(TRACKS)
def test_frontiers_are_unseen_near_and_nobody_elses(track: list[list[tuple[float, float]]]) -> None:
    steps = [np.array(positions) for positions in track]
    flown = baseline("frontier-cvt", len(steps[0]))
    for positions in steps:
        goals = flown.goals(positions)
    positions = steps[-1]
    seen = seen_by_each(steps, shared=True)
    who = reached(positions)
    lattice = np.stack(np.meshgrid(*[np.arange(4, SIZE, 8)] * 2, indexing="ij"), axis=-1)
    for robot, position in enumerate(positions):
        others = positions[who[robot] & (np.arange(len(positions)) != robot)]
        own = []
        for cell in lattice.reshape(-1, 2):
            point = cell + 0.5
            _, first = local(IMPORTANCE, position)
            shown, _ = local(IMPORTANCE, position)
            inside = np.all((cell >= first) & (cell < np.add(first, shown.shape)))
            nearer = [np.linalg.norm(point - other) for other in others]
            mine = np.linalg.norm(point - position) <= min(nearer, default=np.inf)
            if inside and mine and not seen[robot][tuple(cell)]:
                own.append(float(np.linalg.norm(point - position)))
        if own:
            assert np.linalg.norm(goals[robot] - position) == pytest.approx(min(own))
            assert not seen[robot][tuple(np.floor(goals[robot]).astype(int))]
        else:
            known = np.where(seen[robot], IMPORTANCE, np.float32(0.0))
            expected = local_centroid(*local(known, position), position, others)
            np.testing.assert_allclose(goals[robot], expected, atol=1e-6)


def test_who_parts_keeps_what_it_was_told() -> None:
    """One tells the other what it saw; then both are out of range."""
    left, right = (10.0, 10.0), (54.0, 54.0)
    told = baseline("shared-cvt", 2)
    told.goals(np.array([left, right]))
    told.goals(np.array([(30.0, 30.0), (34.0, 34.0)]))
    goals = told.goals(np.array([right, left]))
    never = baseline("shared-cvt", 2)
    apart = never.goals(np.array([right, left]))
    assert np.linalg.norm(goals - apart, axis=1).min() > 1.0


def test_frontiers_are_explored_to_the_last() -> None:
    """One robot that goes where it is told sees all that its local map shows, and then covers."""
    everywhere = replace(PERCEPTION, local_map_size=2 * SIZE)
    flown = make_baseline("frontier-cvt", IMPORTANCE, everywhere, 1)
    position = np.array([[5.0, 5.0]])
    seen = np.zeros((SIZE, SIZE), np.bool_)
    for _ in range(400):
        seen[view(position[0])] = True
        offset = flown.goals(position) - position
        position = position + offset / max(float(np.linalg.norm(offset)) / 4.0, 1.0)
    assert seen[4::8, 4::8].all()
    np.testing.assert_allclose(flown.goals(position), position, atol=0.5)
