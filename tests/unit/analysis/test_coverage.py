"""Evaluation of the fleet's positions, compared with the core's coverage."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.core import F64
from edge.core.world import parse_world, rasterize
from edge.messages.mission import FlightState, RobotStatus
from lpac.analysis.coverage import Coverage, LastPositions
from lpac.analysis.snapshot import FleetSnapshot, RobotSnapshot
from lpac.analysis.voronoi import coverage_cost, voronoi_cells
from lpac.analysis.worlds import format_world, random_features
from tests.said import reason

SIZE, SCALE = 128, 4.0
S = FlightState


@dataclasses.dataclass(frozen=True)
class Model:
    world: str
    world_id: str = "abc"
    world_size: int = SIZE
    env_scale: float = SCALE
    truncation: float = 2.0
    norm: float = 1.0


def model(seed: int = 0) -> Model:
    rng = np.random.default_rng(seed)
    return Model(format_world(random_features(rng, 5, SIZE, sigma=(6.0, 15.0))))


COVERAGE = Coverage.of(model())
PLACE_M = st.tuples(st.floats(-10.0, 42.0), st.floats(-10.0, 42.0))
FLEETS_M = st.lists(PLACE_M, min_size=1, max_size=12).map(np.array)


def area(corners_m: list[tuple[float, float]]) -> float:
    x, y = np.array(corners_m).reshape(-1, 2).T
    return float(abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2.0)


def inside(corners_m: list[tuple[float, float]], points_m: F64) -> F64:
    """Distance of points inside a convex polygon, the least over its sides; m."""
    corners = np.array(corners_m)
    sides = np.roll(corners, -1, axis=0) - corners
    sides, corners = (part[np.linalg.norm(sides, axis=1) > 1e-6] for part in (sides, corners))
    offsets = points_m[:, None] - corners
    cross = sides[:, 0] * offsets[..., 1] - sides[:, 1] * offsets[..., 0]
    depth: F64 = (cross / np.linalg.norm(sides, axis=1)).min(axis=1)
    return depth


@settings(deadline=None, max_examples=50)
@given(FLEETS_M)
def test_cost_is_the_cores_in_model_units(positions_m: F64) -> None:
    raster = rasterize(parse_world(model().world), SIZE, 2.0, 1.0)
    assert np.array_equal(COVERAGE.importance, raster) and COVERAGE.size_m == 32.0
    assert COVERAGE.cost(positions_m) == coverage_cost(raster, positions_m * SCALE)


@settings(deadline=None, max_examples=50)
@given(FLEETS_M)
def test_cells_part_the_world_by_the_nearest_robot(positions_m: F64) -> None:
    positions_m = np.unique(positions_m, axis=0)
    cells_m = COVERAGE.cells_m(positions_m)
    assert len(cells_m) == len(positions_m)
    nearest = np.linalg.norm(positions_m[:, None] - positions_m, axis=2)
    np.fill_diagonal(nearest, np.inf)
    if nearest.min() < 1e-3:  # rounding decides between equally near robots
        return
    assert sum(map(area, cells_m)) == pytest.approx(32.0**2, rel=1e-6)
    points_m = np.random.default_rng(0).uniform(0.0, 32.0, (300, 2))
    distances_m = np.linalg.norm(points_m[:, None] - positions_m, axis=2)
    for robot, cell_m in enumerate(cells_m):
        own = points_m[distances_m.argmin(axis=1) == robot]
        if len(own):
            assert inside(cell_m, own).min() > -1e-6
        assert all(-1e-9 <= c <= 32.0 + 1e-9 for corner in cell_m for c in corner)


def test_robots_at_one_point_and_outside_have_cells_too() -> None:
    shared, other, far = COVERAGE.cells_m(np.array([(5.0, 5.0), (5.0, 5.0), (-100.0, 5.0)]))
    assert shared == other and area(shared) == pytest.approx(32.0**2) and far == []


@settings(deadline=None, max_examples=5)
@given(FLEETS_M)
def test_the_bound_is_below_what_lloyd_reaches_from_there(positions_m: F64) -> None:
    least = COVERAGE.lloyd(positions_m)
    assert least == COVERAGE.lloyd(positions_m)
    assert 0.0 < least <= COVERAGE.cost(positions_m)
    positions = positions_m * SCALE
    for _ in range(300):
        positions = voronoi_cells(COVERAGE.importance, positions).centroid
    assert least <= coverage_cost(COVERAGE.importance, positions) * 1.01


def test_the_bound_of_one_robot_is_the_centre_of_mass() -> None:
    centre = voronoi_cells(COVERAGE.importance, np.array([(1.0, 1.0)])).centroid
    least = coverage_cost(COVERAGE.importance, centre)
    assert COVERAGE.lloyd(np.array([(1.0, 1.0)])) == pytest.approx(least, rel=1e-3)


@pytest.mark.parametrize("size", [50, SIZE, 200])
def test_the_density_keeps_the_worlds_shape(size: int) -> None:
    image = COVERAGE.density(size)
    assert image.shape == (size, size) and image.dtype == np.uint8 and image.max() == 255
    # The position of the maximum, relative to the world: [x, y], not transposed.
    highest = np.array(np.unravel_index(COVERAGE.importance.argmax(), (SIZE, SIZE))) / SIZE
    found = np.array(np.unravel_index(image.argmax(), image.shape)) / size
    assert np.abs(found - highest).max() < 2.0 / min(size, SIZE)


def test_an_empty_world_costs_nothing() -> None:
    empty = Coverage.of(Model(""))
    positions_m = np.array([(1.0, 2.0), (3.0, 4.0)])
    assert empty.cost(positions_m) == empty.lloyd(positions_m) == 0.0
    assert empty.density(10).max() == 0 and len(empty.cells_m(positions_m)) == 2


def test_a_broken_world_is_one_line() -> None:
    with pytest.raises(ValueError, match=r"world abc: record 1 \(Circle\): unknown kind"):
        Coverage.of(Model("Circle 1 2"))


STATUS = RobotStatus(
    robot_id=0, boot_nonce=1, sequence=1, uptime_s=1.0, unix_time_s=1.0, state=S.IDLE,
    reason=reason(""), ready=True, failed_checks=(), alarms=(), obeyed_sequence=0, operator="",
    orders=(),
    bundle_id="", world_id="", trial="", origin=None, system_id=1, slot_height_m=4.0,
    landing_point_m=(0.0, 0.0), position_m=(1.0, 2.0, 3.0), velocity_m_s=None, heading_rad=None,
    mode=None, armed=False, battery=None, satellites=None, message_counts={}, neighbour_ages_s={},
    loops={},
)  # fmt: skip


def snapshot(
    *robots: tuple[S, bool, float, float | None], unix_time_s: float = 0.0
) -> FleetSnapshot:
    """Robots of (state, armed, age_s, x_m)."""
    snapshots = (
        RobotSnapshot(
            f"r{i}", i,
            dataclasses.replace(
                STATUS, robot_id=i, state=state, armed=armed,
                position_m=None if x_m is None else (x_m, 2.0, 3.0),
            ),
            age_s,
        )
        for i, (state, armed, age_s, x_m) in enumerate(robots)
    )  # fmt: skip
    return FleetSnapshot(unix_time_s, "", None, (*snapshots, RobotSnapshot("silent", 99)))


def counted(seen: FleetSnapshot) -> dict[str, tuple[float, float]]:
    return LastPositions().counted(seen)


def test_who_counts() -> None:
    waiting = snapshot(
        (S.IDLE, False, 0.1, 1.0), (S.IDLE, False, 9.0, 2.0), (S.IDLE, False, 0.1, None)
    )
    assert counted(waiting) == {"r0": (1.0, 2.0)}
    flying = snapshot(
        (S.MISSION, True, 0.1, 1.0), (S.IDLE, False, 0.1, 2.0), (S.LAND, True, 0.1, 3.0),
        (S.LAND, False, 0.1, 4.0), (S.PILOT, True, 0.1, 5.0), (S.PILOT, False, 0.1, 6.0),
        (S.HOLD, True, 3.0, 7.0), (S.MISSION, True, 0.1, math.nan), (S.MISSION, True, 0.1, None),
    )  # fmt: skip
    assert counted(flying) == {"r0": (1.0, 2.0), "r2": (3.0, 2.0), "r4": (5.0, 2.0)}
    assert counted(snapshot()) == {}


def test_who_does_not_know_where_it_is_counts_in_the_air_where_it_was() -> None:
    last_positions = LastPositions()
    here, nowhere = (S.HOLD, True, 0.1, 1.0), (S.HOLD, True, 0.1, None)
    other = (S.HOLD, True, 0.1, 5.0)
    last_positions.counted(snapshot(here, other))
    assert last_positions.counted(snapshot(nowhere, other, unix_time_s=1.9))["r0"] == (1.0, 2.0)
    assert last_positions.counted(snapshot(nowhere, other, unix_time_s=60.0))["r0"] == (1.0, 2.0)
    last_positions.counted(snapshot(here, other, unix_time_s=3.0))
    on_ground = (S.LANDED, False, 0.1, None)
    assert "r0" not in last_positions.counted(snapshot(on_ground, other, unix_time_s=3.5))
