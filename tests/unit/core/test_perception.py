"""The robot's memory and its images: against plain dense arrays, torch, and by hand."""

import copy
import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.core import F32
from edge.core.memory import TILE_SIZE, RobotMap, RobotMemory
from edge.core.perception import (
    PerceptionParameters,
    neighbours_in_range,
    part_in_world,
    window_corner,
)
from edge.policy.images import MAP_CHANNELS, PolicyImages, Resize, neighbour_maps, own_cell

PARAMETERS = PerceptionParameters(
    world_size=512, local_map_size=256, sensor_size=64, communication_range=256.0
)
corners = st.tuples(st.integers(-150, 400), st.integers(-150, 400))


@settings(deadline=None, max_examples=50)
@given(
    world_size=st.sampled_from([1, 100, TILE_SIZE, TILE_SIZE + 1, 300]),
    unknown=st.sampled_from([0.0, 0.5, np.nan]),
    views=st.lists(corners, max_size=6),
    window=corners,
)
def test_robot_map_is_a_dense_map_clipped_to_the_world(
    world_size: int, unknown: float, views: list[tuple[int, int]], window: tuple[int, int]
) -> None:
    rng = np.random.default_rng(0)
    robot_map = RobotMap(world_size, unknown)
    dense = np.full((world_size, world_size), unknown, np.float32)
    for corner in views:
        view = rng.random((64, 64), np.float32)
        robot_map.insert(view, corner)
        in_world, in_view = part_in_world(corner, 64, world_size)
        dense[in_world] = view[in_view]
    expected = np.zeros((256, 256), np.float32)
    in_world, in_window = part_in_world(window, 256, world_size)
    expected[in_window] = dense[in_world]
    found = robot_map.window(window, np.full((256, 256), np.nan, np.float32))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("size", "new_size"), [(256, 32), (128, 32), (100, 32), (32, 32), (16, 32)]
)
def test_resize_is_torchs_antialiased_bilinear_one(size: int, new_size: int) -> None:
    torch = pytest.importorskip("torch", reason="torch is the oracle here")
    image = np.random.default_rng(1).random((size, size), np.float32)
    resized = np.empty((new_size, new_size), np.float32)
    Resize(size, new_size).image(image, out=resized)
    expected = torch.nn.functional.interpolate(
        torch.from_numpy(image)[None, None], (new_size, new_size), mode="bilinear", antialias=True
    )[0, 0].numpy()
    np.testing.assert_allclose(resized, expected, atol=1e-6)


def images_at(position: tuple[float, float], neighbours: list[tuple[float, float]]) -> F32:
    own, memory = np.array(position), RobotMemory(PARAMETERS)
    others = np.array(neighbours, np.float64).reshape(-1, 2)
    images: F32 = PolicyImages(PARAMETERS, MAP_CHANNELS[4], 32).images(
        own, memory.local_map(own), others
    )[0]
    return images


def test_images_keep_x_and_y_and_left_and_right_apart() -> None:
    position = np.array([200.0, 300.0])
    memory = RobotMemory(PARAMETERS)
    view = np.zeros((64, 64), np.float32)
    view[60, 8] = 1.0  # 28 to the right (+x) and 24 behind (-y)
    memory.observe(position, view)
    neighbour = np.array([300.0, 250.0])
    importance, neighbours_x, neighbours_y, obstacles = PolicyImages(
        PARAMETERS, MAP_CHANNELS[4], 32
    ).images(position, memory.local_map(position), neighbour[None])[0]
    # 128 + 28 and 128 - 24 cells into a local map of 256, eight of them to one of the image.
    assert np.unravel_index(importance.argmax(), importance.shape) == (19, 13)
    cell = (22, 12)  # rint(100 / 16 + 15.5), rint(-50 / 16 + 15.5)
    assert neighbours_x[cell] == pytest.approx(100 / 256)
    assert neighbours_y[cell] == pytest.approx(-50 / 256)
    assert np.count_nonzero(neighbours_x) == np.count_nonzero(neighbours_y) == 1
    np.testing.assert_allclose(obstacles, 0.0, atol=1e-6)


def test_obstacles_are_on_the_side_of_the_border() -> None:
    left, bottom = images_at((0.0, 256.0), [])[3], images_at((256.0, 0.0), [])[3]
    np.testing.assert_allclose(left[:15], 1.0, atol=1e-6)
    np.testing.assert_allclose(left[17:], 0.0, atol=1e-6)
    np.testing.assert_array_equal(bottom, left.T)


def test_two_channels_leave_the_neighbours_out() -> None:
    own, unseen = np.array([0.0, 256.0]), np.zeros((256, 256), np.float32)
    images = PolicyImages(PARAMETERS, MAP_CHANNELS[2], 32).images(
        own, unseen, np.array([[10.0, 256.0]])
    )
    assert images.shape == (1, 2, 32, 32)
    np.testing.assert_array_equal(images[0, 1], images_at((0.0, 256.0), [])[3])


@settings(deadline=None, max_examples=50)
@given(
    data=st.data(),
    world_size=st.integers(8, 300),
    sensor_size=st.sampled_from([2, 10, 32]),
    unknown=st.sampled_from([0.0, 0.25]),
)
def test_explored_is_one_where_the_sensor_has_been(
    data: st.DataObject, world_size: int, sensor_size: int, unknown: float
) -> None:
    """Cell by cell, and the other images are those of a robot that does not tell."""
    other = PerceptionParameters(world_size, 64, sensor_size, 50.0, unknown)
    parameters = dataclasses.replace(other, unseen_as_nan=True)
    memory, other_memory = RobotMemory(parameters), RobotMemory(other)
    policy_images = PolicyImages(parameters, MAP_CHANNELS[5], 16)
    other_images = PolicyImages(other, MAP_CHANNELS[4], 16)
    seen: set[tuple[int, int]] = set()
    coordinates = st.floats(-0.2 * world_size, 1.2 * world_size)
    path = data.draw(st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=6))
    rng = np.random.default_rng(0)
    for place in map(np.array, path):
        # Some of what is seen is worth nothing.
        view = rng.integers(0, 2, (sensor_size, sensor_size)).astype(np.float32)
        low_x, low_y = window_corner(place, sensor_size)
        seen |= {(low_x + i, low_y + j) for i in range(sensor_size) for j in range(sensor_size)}
        memory.observe(place, view)
        other_memory.observe(place, view)
        position, neighbours = np.clip(place, 0.0, world_size), rng.uniform(0, world_size, (3, 2))

        images = policy_images.images(position, memory.local_map(position), neighbours)[0]
        image = dict(zip(MAP_CHANNELS[5], images, strict=True))
        explored = np.zeros((64, 64), np.float32)
        corner_x, corner_y = window_corner(position, 64)
        for x, y in seen:
            in_x, in_y = x - corner_x, y - corner_y
            if min(x, y, in_x, in_y) >= 0 and max(x, y) < world_size and max(in_x, in_y) < 64:
                explored[in_x, in_y] = 1.0
        expected = np.empty((16, 16), np.float32)
        Resize(64, 16).image(explored, out=expected)
        np.testing.assert_array_equal(image["explored"], expected)

        without = other_images.images(position, other_memory.local_map(position), neighbours)[0]
        for name, values in zip(MAP_CHANNELS[4], without, strict=True):
            np.testing.assert_array_equal(image[name], values)


@given(st.lists(st.tuples(*[st.floats(-255.9, 255.9)] * 2), max_size=12))
def test_neighbour_maps_hold_every_neighbour(offsets: list[tuple[float, float]]) -> None:
    array = np.array(offsets, np.float64).reshape(-1, 2)
    maps = neighbour_maps(array, 256.0, 32)
    np.testing.assert_allclose(maps.sum(axis=(1, 2)), array.sum(axis=0) / 256.0, atol=1e-4)
    np.testing.assert_allclose(
        neighbour_maps(array[:, ::-1], 256.0, 32), maps[::-1].transpose(0, 2, 1), atol=1e-6
    )


@settings(deadline=None)
@given(st.lists(st.tuples(*[st.floats(-255.9, 255.9)] * 2), max_size=9), st.sampled_from([8, 32]))
def test_the_own_cell_is_what_is_nearer_to_oneself_than_to_anybody(
    offsets: list[tuple[float, float]], size: int
) -> None:
    array = np.array(offsets, np.float64).reshape(-1, 2)
    cells = own_cell(array, 256.0, size)
    places = (np.arange(size) + 0.5) * 256.0 / size - 128.0
    for x, y in itertools.product(range(size), repeat=2):
        place = np.array([places[x], places[y]])
        room = np.linalg.norm(array - place, axis=1).min(initial=np.inf) - np.linalg.norm(place)
        assert cells[x, y] == (room >= 0.0) or abs(room) < 1e-9


def test_range_is_open_and_two_robots_at_one_point_are_neighbours() -> None:
    own = np.array([10.0, 10.0])
    others = own + np.array([[0.0, 0.0], [256.0, 0.0], [0.0, -255.999]])
    assert neighbours_in_range(own, others, 256.0).tolist() == [True, False, True]
    assert neighbours_in_range(own, others[:0], 256.0).tolist() == []
    assert np.all(neighbour_maps(np.zeros((1, 2)), 256.0, 32) == 0.0)


@pytest.mark.parametrize(
    ("position", "corner"),
    [((100.0, 200.0), (68, 168)), ((100.49, 199.5), (68, 168)), ((0.0, -0.6), (-32, -33))],
)
def test_window_is_centred_at_the_nearest_cell_corner(
    position: tuple[float, float], corner: tuple[int, int]
) -> None:
    assert window_corner(np.array(position), 64) == corner


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"world_size": 0}, "world_size = 0: must be from 1 to 32768"),
        ({"sensor_size": 63}, "sensor_size = 63: must be positive and even"),
        ({"local_map_size": -2}, "local_map_size = -2: must be positive and even"),
        ({"communication_range": float("nan")}, "communication_range = nan"),
        ({"unknown_importance": -1.0}, "unknown_importance = -1.0"),
    ],
)
def test_impossible_parameters_are_named(change: dict[str, Any], text: str) -> None:
    parameters = PerceptionParameters(512, 256, 64, 256.0)
    with pytest.raises(ValueError, match=text):
        dataclasses.replace(parameters, **change)


@pytest.mark.parametrize("world_size", [512, 300, 40])
def test_a_coarse_cell_counts_as_seen_when_its_centre_was(world_size: int) -> None:
    parameters = dataclasses.replace(PARAMETERS, world_size=world_size)
    memory = RobotMemory(parameters)
    centres = (np.arange(64) + 0.5) * world_size / 64
    seen = np.zeros((64, 64), np.bool_)
    assert not memory.explored.any()
    for x, y in ((0.0, 100.0), (70.3, 250.0), (world_size + 20.0, 10.0), (-500.0, 9e3)):
        memory.observe(np.array([x, y]), np.ones((64, 64), np.float32))
        corner_x, corner_y = window_corner(np.array([x, y]), 64)
        in_x = (centres >= corner_x) & (centres < corner_x + 64)
        in_y = (centres >= corner_y) & (centres < corner_y + 64)
        seen |= np.outer(in_x, in_y)
        np.testing.assert_array_equal(memory.explored, seen)
    assert seen.any()


@pytest.mark.parametrize("channels", [2, 4, 5, 6])
def test_a_copied_robot_looks_at_images_of_its_own(channels: int) -> None:
    parameters = PerceptionParameters(
        world_size=64, local_map_size=32, sensor_size=16, communication_range=20.0,
        unseen_as_nan=channels >= 5,
    )  # fmt: skip
    images = PolicyImages(parameters, MAP_CHANNELS[channels], 8)
    looks = [
        (np.array([30.0, 30.0]), np.zeros((32, 32), np.float32), np.zeros((0, 2))),
        (np.array([5.0, 40.0]), np.ones((32, 32), np.float32), np.array([[9.0, 42.0]])),
    ]
    first = images.images(*looks[0]).copy()
    copied = copy.deepcopy(images)
    second = copied.images(*looks[1]).copy()
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(images.images(*looks[0]), first)
    np.testing.assert_array_equal(images.images(*looks[1]), second)


@settings(deadline=None, max_examples=50)
@given(
    data=st.data(),
    world_size=st.integers(8, 300),
    sensor_size=st.sampled_from([2, 10, 32]),
    cell=st.sampled_from([0, 4]),
)
def test_of_what_a_camera_did_not_see_nothing_is_known(
    data: st.DataObject, world_size: int, sensor_size: int, cell: int
) -> None:
    """Two memories: what was not seen has another importance for each, and both know the same."""
    parameters = PerceptionParameters(
        world_size, 64, sensor_size, 50.0, unseen_as_nan=True, shared_map_cell=cell
    )
    first, second, whole = (RobotMemory(parameters) for _ in range(3))
    coordinates = st.floats(-0.2 * world_size, 1.2 * world_size)
    path = data.draw(st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=4))
    rng = np.random.default_rng(0)
    ever = np.zeros((world_size, world_size), np.bool_)
    for place in map(np.array, path):
        seen = rng.random((sensor_size, sensor_size)) < 0.8
        view, other = rng.random((2, sensor_size, sensor_size), np.float32)
        first.observe(place, view, seen)
        second.observe(place, np.where(seen, view, other), seen)
        whole.observe(place, view)
        corner = window_corner(place, sensor_size)
        in_world, in_view = part_in_world(corner, sensor_size, world_size)
        ever[in_world] |= seen[in_view]
    position = np.clip(path[-1], 0.0, world_size)
    local = first.local_map(position).copy()
    np.testing.assert_array_equal(local, second.local_map(position))
    in_world, in_local = part_in_world(window_corner(position, 64), 64, world_size)
    np.testing.assert_array_equal(np.isnan(local[in_local]), ~ever[in_world])
    centres = ((np.arange(64) + 0.5) * world_size / 64).astype(int)
    np.testing.assert_array_equal(first.explored, ever[np.ix_(centres, centres)])
    if cell:
        tells, knows = (memory.shared_map(position) for memory in (first, whole))
        assert tells is not None and knows is not None
        known = tells.codes != 0
        # A cell of which one look has shown a part is not told.
        np.testing.assert_array_equal(tells.codes[known], second.shared_map(position).codes[known])  # type: ignore[union-attr]
        assert not known[knows.codes == 0].any()


def test_a_camera_that_sees_everything_is_a_sensor() -> None:
    parameters = dataclasses.replace(PARAMETERS, shared_map_cell=8)
    memory, other = RobotMemory(parameters), RobotMemory(parameters)
    rng, everywhere = np.random.default_rng(0), np.ones((64, 64), np.bool_)
    for place in rng.uniform(-40.0, 552.0, (20, 2)):
        view = rng.random((64, 64), np.float32)
        memory.observe(place, view)
        other.observe(place, view, everywhere)
        np.testing.assert_array_equal(memory.local_map(place), other.local_map(place))
        np.testing.assert_array_equal(memory.explored, other.explored)
        mine, its = memory.shared_map(place), other.shared_map(place)
        assert mine is not None and its is not None
        np.testing.assert_array_equal(mine.codes, its.codes)
