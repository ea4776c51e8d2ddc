"""The worlds of the sets are fixed, and sets have no common worlds."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lpac.study.worlds import FIELD, SET_UPS, WORLD_SETS, WorldSet, at_equal_density, draw_world


@given(st.sampled_from(WORLD_SETS), st.integers(0, 2**31), st.sampled_from(sorted(SET_UPS)))
def test_a_world_follows_from_its_set_and_its_number(world_set, index, name) -> None:  # type: ignore[no-untyped-def]
    set_up = SET_UPS[name]
    world = draw_world(world_set, index, set_up)
    assert world == draw_world(world_set, index, set_up)
    assert len(world.features) == set_up.features and len(world.starts) == set_up.robots
    places = np.array([*world.starts, *(feature.mean for feature in world.features)])
    assert np.all((places >= 0.0) & (places <= set_up.world_size))
    low, high = set_up.sigma
    assert all(low <= feature.sigma[0] <= high for feature in world.features)


def test_no_two_worlds_of_all_sets_are_alike() -> None:
    worlds = [draw_world(name, index, FIELD) for name in WORLD_SETS for index in range(200)]
    for what in zip(*worlds, strict=True):
        assert len(set(what)) == len(worlds)
    means = {feature.mean for world in worlds for feature in world.features}
    starts = {start for world in worlds for start in world.starts}
    assert len(means) == len(starts) == 10 * len(worlds) and not means & starts


def test_the_worlds_stay_what_they_are() -> None:
    """Also with another numpy: results of different days must be over the same worlds."""
    for name, told in FIRST_WORLDS.items():
        world = draw_world(name, 0, FIELD)
        first = (world.seed, *world.features[0].mean, *world.starts[0])
        assert tuple(round(number, 3) for number in first) == told


FIRST_WORLDS: dict[WorldSet, tuple[float, ...]] = {
    "training": (8090512717965604708, 12.877, 437.297, 73.475, 247.625),
    "validation": (1033391688535241728, 171.488, 204.768, 341.285, 79.47),
    "test": (11742670808009207037, 378.803, 476.328, 57.226, 45.508),
}


def test_density_is_equal() -> None:
    assert at_equal_density(10) == FIELD == SET_UPS["field"]
    for robots, other in itertools.product((1, 3, 1000), repeat=2):
        one, two = at_equal_density(robots), at_equal_density(other)
        for each in (one, two):
            assert each.world_size**2 / each.robots == pytest.approx(512**2 / 10, rel=0.01)
            assert each.features == each.robots


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"robots": 0}, "robots = 0: must be from 1 to "),
        ({"sigma": (2.0, 1.0)}, "sigma = "),
        ({"communication_range": 0.0}, "communication_range = 0.0: must be above 0"),
    ],
)
def test_a_set_up_that_cannot_be(change: dict[str, object], text: str) -> None:
    values = {"robots": 1, "world_size": 512, "communication_range": 1.0, "features": 1}
    with pytest.raises(ValueError, match=text):
        type(FIELD)(**{**values, **change})  # type: ignore[arg-type]


def test_there_is_no_world_before_the_first() -> None:
    with pytest.raises(ValueError, match="world = -1: must be at least 0"):
        draw_world("test", -1, FIELD)
