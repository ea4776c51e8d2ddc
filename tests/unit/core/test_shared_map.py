"""What robots tell each other of what they have seen."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.core.memory import RobotMemory
from edge.core.perception import PerceptionParameters, window_corner
from edge.core.shared_map import (
    Codes,
    SharedCells,
    SharedMap,
    cell_means,
    codes_of,
    importance_of,
)

PARAMETERS = PerceptionParameters(512, 256, 64, 256.0, 0.0, True, 8)


@given(st.floats(0.0, 1e5, width=32))
def test_importance_is_told_to_a_sixteenth_and_passed_on_unchanged(importance: float) -> None:
    codes = codes_of(np.array([importance], np.float32))
    [told] = importance_of(codes)
    assert told == pytest.approx(min(importance, 61440.0), rel=1 / 16 + 1e-3, abs=2.0**-18)
    np.testing.assert_array_equal(codes_of(np.array([told], np.float32)), codes)


def test_what_is_nothing_is_known_to_be_nothing() -> None:
    assert importance_of(codes_of(np.array([0.0, -1.0], np.float32))).tolist() == [0.0, 0.0]
    assert np.isnan(importance_of(np.array([0, 0xF9, 0xFF], np.uint8))).all()
    assert np.isfinite(importance_of(np.arange(1, 0xF9, dtype=np.uint8))).all()


@settings(deadline=None)
@given(
    corner=st.tuples(st.integers(-20, 70), st.integers(-20, 70)),
    size=st.sampled_from([2, 6, 16, 32]),
    cell=st.sampled_from([1, 4, 8]),
    world_size=st.integers(8, 64),
)
def test_cells_are_known_that_were_seen_whole(
    corner: tuple[int, int], size: int, cell: int, world_size: int
) -> None:
    parameters = PerceptionParameters(world_size, 64, size, 50.0, 0.0, True, cell)
    cells = SharedCells(parameters)
    view = np.random.default_rng(0).random((size, size), np.float32)
    cells.see(view, corner)
    side = -(-world_size // cell)
    expected = np.full((side * cell, side * cell), np.nan, np.float32)
    for x, y in itertools.product(range(side), repeat=2):
        in_x, in_y = x * cell - corner[0], y * cell - corner[1]
        if min(in_x, in_y) >= 0 and max(in_x, in_y) + cell <= size:
            mean = cell_means(view[in_x : in_x + cell, in_y : in_y + cell], cell)
            assert mean == pytest.approx(view[in_x : in_x + cell, in_y : in_y + cell].mean())
            at = slice(x * cell, (x + 1) * cell), slice(y * cell, (y + 1) * cell)
            expected[at] = importance_of(codes_of(mean))
    np.testing.assert_array_equal(cells.importance((0, 0), side * cell), expected)
    if side * cell > 5:
        np.testing.assert_array_equal(
            cells.importance((3, 2), side * cell - 5), expected[3:-2, 2:-3]
        )


def look(memory: RobotMemory, place: tuple[float, float], importance: float) -> SharedMap:
    """The sensor shows the same everywhere; what is told then."""
    position = np.array(place)
    memory.observe(position, np.full((64, 64), importance, np.float32))
    told = memory.shared_map(position)
    assert told is not None
    return told


def known(memory: RobotMemory, place: tuple[float, float]) -> float:
    local = memory.local_map(np.array([256.0, 256.0]))
    x, y = window_corner(np.array([256.0, 256.0]), 256)
    return float(local[int(place[0]) - x, int(place[1]) - y])


def test_news_goes_from_robot_to_robot_and_does_not_grow() -> None:
    first, second, third = (RobotMemory(PARAMETERS) for _ in range(3))
    told = look(first, (160.0, 160.0), 0.5)
    assert told.codes.shape == (32, 32)
    second.merge(told)
    passed_on = look(second, (256.0, 256.0), 0.25)
    assert passed_on.codes.shape == (32, 32)
    third.merge(passed_on)
    assert known(third, (160.0, 160.0)) == 0.5
    assert known(third, (256.0, 256.0)) == 0.25
    assert np.isnan(known(third, (340.0, 340.0)))
    # For people it has explored what it has seen itself.
    assert not third.explored.any()


def test_what_one_saw_itself_comes_before_what_it_is_told() -> None:
    first, second = RobotMemory(PARAMETERS), RobotMemory(PARAMETERS)
    look(second, (256.0, 256.0), 0.3)
    second.merge(look(first, (256.0, 256.0), 0.5))
    assert known(second, (256.0, 256.0)) == pytest.approx(0.3)
    told = second.shared_map(np.array([256.0, 256.0]))
    assert told is not None
    assert importance_of(told.codes).max(initial=0.0, where=told.codes > 0) < 0.4


def test_who_does_not_share_tells_nothing_and_hears_nothing() -> None:
    alone = RobotMemory(PerceptionParameters(512, 256, 64, 256.0, 0.0, True))
    assert alone.shared_map(np.array([256.0, 256.0])) is None
    alone.merge(look(RobotMemory(PARAMETERS), (256.0, 256.0), 0.5))
    assert np.isnan(known(alone, (256.0, 256.0)))


@given(
    st.tuples(*[st.integers(-(2**31), 2**31 - 1) | st.integers(-40, 80)] * 2),
    st.binary(min_size=1024, max_size=1024),
)
@settings(deadline=None)
def test_whatever_is_told_becomes_a_map(corner: tuple[int, int], data: bytes) -> None:
    memory = RobotMemory(PARAMETERS)
    codes: Codes = np.frombuffer(data, np.uint8).reshape(32, 32)
    memory.merge(SharedMap(corner, codes))
    local = memory.local_map(np.array([256.0, 256.0]))
    assert not np.isinf(local).any() and (np.isnan(local) | (local >= 0.0)).all()


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        (-1, "shared_map_cell = -1: must be 0, or divide local_map_size = 256"),
        (7, "shared_map_cell = 7: must be 0, or divide local_map_size = 256"),
    ],
)
def test_impossible_cells_are_named(cell: int, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        PerceptionParameters(512, 256, 64, 256.0, shared_map_cell=cell)
