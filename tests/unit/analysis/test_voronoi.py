"""Coverage cost, Voronoi cells and CVT steps, against the reference library and brute force."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from edge.core import F32, F64
from edge.core.world import Feature, GaussianFeature, PolygonFeature
from lpac.analysis.voronoi import coverage_cost, cvt_velocity, local_centroid, voronoi_cells
from lpac.analysis.worlds import random_features
from tests.unit.core.reference import (
    coverage_control_core,
    point_vector,
    reference_environment,
    reference_parameters,
)

SIZE = 512
MAX_SPEED, TIME_STEP = 5.0, 0.2
# A few features on one side only: most robots start with nothing in their cells.
SPARSE = (
    GaussianFeature((90.0, 400.0), (20.0, 20.0), 0.0, 3.0),
    PolygonFeature(((30.0, 20.0), (160.0, 45.0), (70.0, 60.0), (60.0, 130.0)), 0.001),
)


def rich(seed: int) -> tuple[Feature, ...]:
    return random_features(np.random.default_rng(seed), 10, SIZE)


def random_positions(seed: int, robots: int) -> F64:
    return np.random.default_rng(seed).uniform(1.0, SIZE - 1.0, (robots, 2))


def library_goals_and_actions(name: str, environment: Any, robots: int) -> tuple[F64, F64]:
    core = coverage_control_core()
    algorithm = getattr(core, name)(reference_parameters(robots), robots, environment)
    algorithm.ComputeActions()
    return np.array(algorithm.GetGoals()), np.array(algorithm.GetActions())


def clairvoyant_goals(environment: Any, positions: F64) -> F64:
    return voronoi_cells(environment.GetWorldMap(), positions).centroid


def centralized_goals(environment: Any, positions: F64) -> F64:
    return voronoi_cells(environment.GetSystemExploredIDFMap(), positions).centroid


def decentralized_goals(environment: Any, positions: F64) -> F64:
    goals = []
    for i, position in enumerate(positions):
        centre = np.floor(position + 0.5).astype(int)
        lower, upper = np.maximum(centre - 128, 0), np.minimum(centre + 128, SIZE)
        window = environment.GetRobotMap(i)[lower[0] : upper[0], lower[1] : upper[1]]
        others = np.delete(positions, i, axis=0)
        neighbours = others[np.linalg.norm(others - position, axis=1) < 256.0]
        goals.append(local_centroid(window, (lower[0], lower[1]), position, neighbours))
    return np.array(goals)


@pytest.mark.parametrize("robots", [1, 2, 10, 40])
@pytest.mark.parametrize("features", [rich(0), rich(1), SPARSE], ids=["rich", "rich", "sparse"])
def test_cost_and_cells_match_the_library(features: tuple[Feature, ...], robots: int) -> None:
    positions = random_positions(robots, robots)
    environment = reference_environment(features, positions)
    raster = environment.GetWorldMap()
    cells = voronoi_cells(raster, positions)
    assert coverage_cost(raster, positions) == pytest.approx(
        environment.GetObjectiveValue(), rel=1e-12
    )
    environment.ComputeVoronoiCells()
    theirs = environment.GetVoronoiCells()
    np.testing.assert_allclose(cells.mass, [cell.mass for cell in theirs], rtol=1e-11)
    np.testing.assert_allclose(cells.centroid, [cell.centroid for cell in theirs], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "our_goals"),
    [
        ("ClairvoyantCVT", clairvoyant_goals),
        ("CentralizedCVT", centralized_goals),
        ("DecentralizedCVT", decentralized_goals),
    ],
)
@pytest.mark.parametrize(
    ("features", "robots"), [(rich(2), 10), (SPARSE, 6)], ids=["rich", "sparse"]
)
def test_baselines_match_the_library_along_their_way(
    name: str,
    our_goals: Callable[[Any, F64], F64],
    features: tuple[Feature, ...],
    robots: int,
) -> None:
    positions = random_positions(3, robots)
    environment = reference_environment(features, positions)
    for _ in range(30):
        goals, actions = library_goals_and_actions(name, environment, robots)
        np.testing.assert_allclose(our_goals(environment, positions), goals, atol=1e-9)
        velocity = cvt_velocity(positions, goals, MAX_SPEED, TIME_STEP)
        np.testing.assert_allclose(velocity, actions, atol=1e-9)
        positions = positions + velocity * TIME_STEP
        environment.SetGlobalRobotPositions(point_vector(positions))


@pytest.mark.parametrize("factor", [1e-13, 1e-14])
def test_a_cell_counts_as_empty_from_the_librarys_mass_on(factor: float) -> None:
    positions = np.array([(60.0, 410.0), (400.0, 100.0)])
    environment = reference_environment((SPARSE[0],), positions)
    environment.GetWorldMapMutable()[:] *= np.float32(factor)
    goals, _ = library_goals_and_actions("ClairvoyantCVT", environment, 2)
    np.testing.assert_allclose(clairvoyant_goals(environment, positions), goals, atol=1e-9)


def square_grid(spacing: float, angle: float = 0.0) -> F64:
    """9 robots around the world's centre; the fifth is in the middle."""
    steps = (np.arange(3) - 1.0) * spacing
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned: F64 = grid @ rotation.T + SIZE / 2
    return turned


@pytest.mark.parametrize("spacing", [110.3, 160.0])
def test_empty_cells_of_a_grid_match_the_library(spacing: float) -> None:
    positions = square_grid(spacing)
    goals, _ = library_goals_and_actions("ClairvoyantCVT", reference_environment((), positions), 9)
    empty = np.zeros((SIZE, SIZE), np.float32)
    np.testing.assert_allclose(voronoi_cells(empty, positions).centroid, goals, atol=1e-9)


@pytest.mark.parametrize("angle", [0.1, 0.3, 0.7])
def test_a_corner_that_four_cells_share_counts_once(angle: float) -> None:
    """Also where rounding tears it apart; the library's goal then jumps."""
    positions = square_grid(110.3, angle)
    empty = np.zeros((SIZE, SIZE), np.float32)
    np.testing.assert_allclose(voronoi_cells(empty, positions).centroid[4], positions[4])


def brute_force(raster: F32, positions: F64) -> tuple[npt.NDArray[np.intp], F64]:
    """(owner, squared distance to it) of every raster cell."""
    x, y = (np.arange(cells) + 0.5 for cells in raster.shape)
    dx2 = (x - positions[:, :1]) ** 2
    dy2 = (y - positions[:, 1:]) ** 2
    d2 = dx2[:, :, None] + dy2[:, None, :]
    return d2.argmin(axis=0), d2.min(axis=0)


def assert_equals_brute_force(raster: F32, positions: F64) -> None:
    owner, d2 = brute_force(raster, positions)
    x, y = np.indices(raster.shape) + 0.5
    weight = raster.astype(np.float64)
    cells = voronoi_cells(raster, positions)
    assert coverage_cost(raster, positions) == pytest.approx((weight * d2).sum(), rel=1e-12)
    for robot in range(len(positions)):
        own = np.where(owner == robot, weight, 0.0)
        assert cells.mass[robot] == pytest.approx(own.sum(), rel=1e-12)
        assert cells.cost[robot] == pytest.approx((own * d2).sum(), rel=1e-12)
        if own.any():
            centroid = np.array([(own * x).sum(), (own * y).sum()]) / own.sum()
            np.testing.assert_allclose(cells.centroid[robot], centroid, rtol=1e-12)


# Eighths are exact in floating point, so that ties are ties in every order of evaluation.
coordinate = st.integers(-400, 1600).map(lambda eighths: eighths / 8)
swarm = st.lists(st.tuples(coordinate, coordinate), min_size=1, max_size=12).map(np.array)
importance = hnp.arrays(
    np.float32,
    st.tuples(st.integers(1, 150), st.integers(1, 150)),
    elements=st.sampled_from([0.0, 0.25, 1.0]).map(np.float32),
    fill=st.sampled_from([np.float32(0.0), np.float32(0.5)]),
)


@settings(max_examples=200, deadline=None)
@given(importance, swarm)
def test_any_swarm_anywhere_equals_brute_force(raster: F32, positions: F64) -> None:
    """Robots on the border, outside and at one point included; the first of equals owns."""
    assert_equals_brute_force(raster, positions)


@pytest.mark.parametrize("robots", [1, 3, 60])
def test_large_rasters_equal_brute_force(robots: int) -> None:
    rng = np.random.default_rng(robots)
    raster = rng.random((700, 570), np.float32)
    raster[200:450, :300] = 0.0
    positions = rng.uniform((-50.0, 0.0), (750.0, 570.0), (robots, 2))
    assert_equals_brute_force(raster, positions)


def test_a_crowd_at_one_point_is_parted() -> None:
    raster = np.ones((40, 30), np.float32)
    positions = np.array([(10.0, 10.0), (10.0, 10.0), (30.0, 10.0)])
    cells = voronoi_cells(raster, positions)
    np.testing.assert_allclose(cells.mass, [600.0, 0.0, 600.0])
    np.testing.assert_allclose(cells.centroid, [(10, 15), (10, 15), (30, 15)])
    raster[:20, :20] = 0.0
    cells = voronoi_cells(raster, positions)
    np.testing.assert_allclose(cells.mass, [200.0, 0.0, 600.0])
    np.testing.assert_allclose(cells.centroid, [(10, 25), (10, 15), (30, 15)])


def test_a_robot_whose_cell_is_outside_returns_to_the_nearest_point() -> None:
    raster = np.ones((40, 30), np.float32)
    positions = np.array([(20.0, 15.0), (-60.0, 10.0), (90.0, 200.0)])
    cells = voronoi_cells(raster, positions)
    np.testing.assert_allclose(cells.mass, [1200.0, 0.0, 0.0])
    np.testing.assert_allclose(cells.centroid, [(20, 15), (0, 10), (40, 30)])


@pytest.mark.parametrize("robots", [1, 5])
def test_a_world_without_importance_costs_nothing(robots: int) -> None:
    raster = np.zeros((40, 30), np.float32)
    positions = np.random.default_rng(0).uniform(0.0, 30.0, (robots, 2))
    cells = voronoi_cells(raster, positions)
    assert coverage_cost(raster, positions) == 0.0
    assert not cells.mass.any()
    assert not cells.cost.any()
    assert np.all((cells.centroid > 0.0) & (cells.centroid < (40.0, 30.0)))
    if robots == 1:
        np.testing.assert_array_equal(cells.centroid, [(20.0, 15.0)])


def test_a_window_is_a_part_of_the_world() -> None:
    """Neither the world outside the window nor neighbours beyond reach count; origins do."""
    rng = np.random.default_rng(4)
    raster = rng.random((200, 160), np.float32)
    position = np.array([70.3, 90.1])
    neighbours = np.array([(60.0, 120.5), (110.0, 80.0), (400.0, 90.0)])
    seen = np.zeros_like(raster)
    seen[40:100, 60:130] = raster[40:100, 60:130]
    whole = voronoi_cells(seen, np.vstack([position, neighbours]))
    goal = local_centroid(raster[40:100, 60:130], (40, 60), position, neighbours)
    np.testing.assert_allclose(goal, whole.centroid[0], rtol=1e-12)


def test_a_window_may_hold_nothing_at_all() -> None:
    position, nobody = np.array([70.0, 90.0]), np.empty((0, 2))
    empty = np.zeros((60, 80), np.float32)
    np.testing.assert_array_equal(local_centroid(empty, (40, 60), position, nobody), (70.0, 100.0))
    far_outside = np.zeros((0, 80), np.float32)
    goal = local_centroid(far_outside, (200, 60), np.array([900.0, 90.0]), nobody)
    assert goal[0] == 200.0


def test_velocity_is_limited_and_does_not_overshoot() -> None:
    positions = np.array([(0.0, 0.0), (1.0, 1.0), (2.0, 2.0)])
    goals = np.array([(30.0, -40.0), (1.03, 1.04), (2.0, 2.0)])
    velocity = cvt_velocity(positions, goals, max_speed=5.0, time_step=0.1)
    np.testing.assert_allclose(velocity, [(3.0, -4.0), (0.3, 0.4), (0.0, 0.0)])
