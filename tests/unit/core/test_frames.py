"""Frames: the physical convention, and the transforms as maps of the plane and of the earth."""

import math

import numpy as np
import pytest
from geographiclib.geodesic import Geodesic
from hypothesis import example, given, settings
from hypothesis import strategies as st

from edge.core import F64
from edge.core.frames import LocalTransform, MissionFrame, ModelScale, m_per_deg

EARTH_RADIUS_M = 6.371e6


def number(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


headings = number(0.0, math.nextafter(math.tau, 0.0))
# Up to where a degree of longitude is still a length; both hemispheres, date line included.
latitudes = number(-89.0, 89.0)
longitudes = number(-180.0, 180.0)
missions = st.builds(MissionFrame, latitudes, longitudes, headings)
# A point by where it lies from another one: azimuth in degrees, distance in m.
azimuths = number(-180.0, 180.0)
distances = number(0.0, 2000.0)
vectors = st.tuples(*[number(-1e4, 1e4)] * 3).map(np.array)


def point_at(
    latitude_deg: float, longitude_deg: float, azimuth_deg: float, distance_m: float
) -> tuple[float, float]:
    end = Geodesic.WGS84.Direct(latitude_deg, longitude_deg, azimuth_deg, distance_m)
    return end["lat2"], end["lon2"]


@st.composite
def transforms(draw: st.DrawFn) -> tuple[MissionFrame, LocalTransform]:
    mission = draw(missions)
    origin = point_at(mission.latitude_deg, mission.longitude_deg, draw(azimuths), draw(distances))
    return mission, mission.relative_to(*origin)


def local_position(origin: tuple[float, float], point: tuple[float, float]) -> F64:
    """What an estimator with this origin reports at that point on the ground: north, east, down."""
    geodesic = Geodesic.WGS84.Inverse(*origin, *point)
    azimuth = math.radians(geodesic["azi1"])
    return np.array([geodesic["s12"] * math.cos(azimuth), geodesic["s12"] * math.sin(azimuth), 0.0])


def north_error_m(latitude_deg: float, distance_m: float) -> float:
    """How far p_M may be off because north turns between two origins that lie apart."""
    nearer_the_pole = min(abs(latitude_deg) + math.degrees(distance_m / 6.3e6), 89.9)
    return 1.1 * distance_m**2 * math.tan(math.radians(nearer_the_pole)) / EARTH_RADIUS_M + 1e-6


@settings(deadline=None)
@given(transforms(), vectors, number(0.1, 100.0))
def test_fly_forward_right_and_up(
    pair: tuple[MissionFrame, LocalTransform], start: F64, step: float
) -> None:
    mission, transform = pair
    theta = mission.heading_rad
    moves = {
        "forward": (step * np.array([math.cos(theta), math.sin(theta), 0.0]), (0.0, step, 0.0)),
        "right": (step * np.array([-math.sin(theta), math.cos(theta), 0.0]), (step, 0.0, 0.0)),
        "up": (np.array([0.0, 0.0, -step]), (0.0, 0.0, step)),
    }
    for local, expected in moves.values():
        moved = transform.local_to_mission(start + local) - transform.local_to_mission(start)
        np.testing.assert_allclose(moved, expected, atol=1e-8)
        np.testing.assert_allclose(transform.velocity_to_mission(local), expected, atol=1e-10)


@pytest.mark.parametrize(
    ("heading_deg", "north", "east"),
    [(0, (0, 1, 0), (1, 0, 0)), (90, (-1, 0, 0), (0, 1, 0)), (180, (0, -1, 0), (-1, 0, 0))],
)
def test_compass_points(
    heading_deg: int, north: tuple[int, int, int], east: tuple[int, int, int]
) -> None:
    transform = MissionFrame(47.0, 8.0, math.radians(heading_deg)).relative_to(47.0, 8.0)
    np.testing.assert_allclose(
        transform.velocity_to_mission(np.array([1.0, 0, 0])), north, atol=1e-15
    )
    np.testing.assert_allclose(
        transform.velocity_to_mission(np.array([0, 1.0, 0])), east, atol=1e-15
    )


def test_on_the_equator() -> None:
    # One thousandth of a degree of longitude is 6,378,137 m x pi / 180,000 = 111.319491 m there.
    facing_north = MissionFrame(0.0, 0.0, 0.0).relative_to(0.0, 0.001)
    np.testing.assert_allclose(
        facing_north.local_to_mission(np.array([10.0, 5.0, -2.0])),
        (116.319491, 10.0, 2.0),
        atol=1e-6,
    )
    facing_east = MissionFrame(0.0, 0.0, math.pi / 2).relative_to(0.0, 0.001)
    np.testing.assert_allclose(
        facing_east.local_to_mission(np.array([10.0, 5.0, -2.0])),
        (-10.0, 116.319491, 2.0),
        atol=1e-6,
    )


def test_in_the_north_east_by_hand() -> None:
    # At 45 N the WGS84 ellipsoid has a meridian radius of 6,367,381.8 m and a normal of
    # 6,388,838.3 m; the local origin lies 0.0001 deg north and 0.0002 deg east of the mission's:
    # 11.11318 m north and 15.76937 m east. The vehicle is 3 m north, 4 m west of it, 5 m up:
    # 14.11318 m north, 11.76937 m east. With theta = 30 deg, in mission axes:
    # x = -0.5 n + 0.8660254 e = 3.13598, y = 0.8660254 n + 0.5 e = 18.10705.
    transform = MissionFrame(45.0, 7.0, math.radians(30)).relative_to(45.0001, 7.0002)
    position_m = transform.local_to_mission(np.array([3.0, -4.0, -5.0]))
    np.testing.assert_allclose(position_m, (3.13598, 18.10705, 5.0), atol=1e-4)


@settings(deadline=None)
@given(transforms(), vectors)
def test_round_trips(pair: tuple[MissionFrame, LocalTransform], vector: F64) -> None:
    _, transform = pair
    for there, back in (
        (transform.local_to_mission, transform.mission_to_local),
        (transform.mission_to_local, transform.local_to_mission),
        (transform.velocity_to_mission, transform.velocity_to_local),
        (transform.velocity_to_local, transform.velocity_to_mission),
    ):
        np.testing.assert_allclose(back(there(vector)), vector, atol=1e-9)


@settings(deadline=None)
@given(missions)
def test_rotation_is_orthonormal_and_its_own_inverse(mission: MissionFrame) -> None:
    rotation = mission.relative_to(mission.latitude_deg, mission.longitude_deg).rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(rotation @ rotation, np.eye(3), atol=1e-15)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


@settings(deadline=None)
@given(transforms(), vectors, vectors)
def test_distances_are_kept(
    pair: tuple[MissionFrame, LocalTransform], one: F64, other: F64
) -> None:
    _, transform = pair
    apart = transform.local_to_mission(one) - transform.local_to_mission(other)
    assert np.linalg.norm(apart) == pytest.approx(np.linalg.norm(one - other), abs=1e-8)


@settings(deadline=None)
@given(missions, azimuths, distances)
@example(MissionFrame(0.0, 180.0, 1.0), 90.0, 500.0)
@example(MissionFrame(-17.0, -179.9999, 1.0), -90.0, 500.0)
@example(MissionFrame(78.2, 15.6, 5.0), 45.0, 2000.0)
@example(MissionFrame(-89.0, 0.0, 0.0), 90.0, 2000.0)
def test_at_the_mission_origin_is_zero_wherever_the_local_origin_is(
    mission: MissionFrame, azimuth_deg: float, distance_m: float
) -> None:
    here = (mission.latitude_deg, mission.longitude_deg)
    origin = point_at(*here, azimuth_deg, distance_m)
    position_m = mission.relative_to(*origin).local_to_mission(local_position(origin, here))
    assert np.linalg.norm(position_m) <= north_error_m(mission.latitude_deg, distance_m)


@settings(deadline=None)
@given(missions, azimuths, distances, azimuths, distances)
def test_a_local_origin_that_jumps_leaves_the_mission_position(
    mission: MissionFrame, azimuth: float, distance_m: float, azimuth_2: float, distance_2_m: float
) -> None:
    here = (mission.latitude_deg, mission.longitude_deg)
    vehicle = point_at(*here, 33.0, 50.0)
    before, after = (
        mission.relative_to(*origin).local_to_mission(local_position(origin, vehicle))
        for origin in (
            point_at(*here, azimuth, distance_m),
            point_at(*here, azimuth_2, distance_2_m),
        )
    )
    allowed_m = sum(
        north_error_m(mission.latitude_deg, far_m + 50.0) for far_m in (distance_m, distance_2_m)
    )
    # The plane itself ends somewhere: d^3 / radius^2.
    assert np.linalg.norm(before - after) <= allowed_m + 2 * 2050.0**3 / EARTH_RADIUS_M**2


@settings(deadline=None)
@given(missions, azimuths, number(0.1, 2000.0))
def test_local_origin_lies_where_the_map_says(
    mission: MissionFrame, azimuth_deg: float, distance_m: float
) -> None:
    origin = point_at(mission.latitude_deg, mission.longitude_deg, azimuth_deg, distance_m)
    x_m, y_m, z_m = mission.relative_to(*origin).local_to_mission(np.zeros(3))
    assert z_m == 0.0
    assert math.hypot(x_m, y_m) == pytest.approx(distance_m, abs=1e-6)
    bearing_rad = math.atan2(x_m, y_m) + mission.heading_rad
    off_rad = math.remainder(bearing_rad - math.radians(azimuth_deg), math.tau)
    assert abs(off_rad) * distance_m < 1e-5


def test_a_transform_cannot_be_changed() -> None:
    transform = MissionFrame(1.0, 2.0, 3.0).relative_to(1.0, 2.0)
    for array in (transform.rotation, transform.local_origin_m):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg", "heading_rad", "said"),
    [
        (90.1, 0.0, 0.0, "latitude_deg = 90.1: must be from -90 to 90"),
        (math.nan, 0.0, 0.0, "latitude_deg = nan: must be from -90 to 90"),
        (0.0, -180.5, 0.0, "longitude_deg = -180.5: must be from -180 to 180"),
        (0.0, math.inf, 0.0, "longitude_deg = inf: must be from -180 to 180"),
        (
            0.0,
            0.0,
            math.tau,
            "heading_rad = 6.283185307179586: must be at least 0 and below 6.28319",
        ),
        (0.0, 0.0, -0.1, "heading_rad = -0.1: must be at least 0 and below 6.28319"),
        (0.0, 0.0, math.nan, "heading_rad = nan: must be at least 0 and below 6.28319"),
    ],
)
def test_a_wrong_mission_frame_says_what_is_allowed(
    latitude_deg: float, longitude_deg: float, heading_rad: float, said: str
) -> None:
    with pytest.raises(ValueError) as error:
        MissionFrame(latitude_deg, longitude_deg, heading_rad)
    assert str(error.value) == said


@settings(deadline=None)
@given(number(-500.0, 500.0), number(-500.0, 500.0), number(0.0, 6.28))
def test_a_place_of_the_mission_frame_is_found_on_the_earth(
    x_m: float, y_m: float, heading_rad: float
) -> None:
    frame = MissionFrame(39.95, -75.16, heading_rad)
    origin_m = frame.relative_to(*frame.to_global_deg(x_m, y_m)).local_origin_m
    np.testing.assert_allclose(origin_m, (x_m, y_m, 0.0), atol=1e-6)


@given(number(-45.0, 45.0), number(0.0, math.tau))
def test_lengths_of_a_degree_hold_for_a_kilometre(latitude_deg: float, azimuth: float) -> None:
    north_m, east_m = m_per_deg(latitude_deg)
    for distance_m, off_m in ((100.0, 1e-3), (1000.0, 0.1)):
        x_m, y_m = distance_m * math.sin(azimuth), distance_m * math.cos(azimuth)
        frame = MissionFrame(latitude_deg, 7.0, 0.0)
        place_deg = latitude_deg + y_m / north_m, 7.0 + x_m / east_m
        there_m = frame.relative_to(*place_deg).local_origin_m
        assert math.dist(there_m[:2], (x_m, y_m)) < off_m


def test_a_wrong_local_origin_says_what_is_allowed() -> None:
    with pytest.raises(
        ValueError, match=r"^local_origin_latitude_deg = nan: must be from -90 to 90$"
    ):
        MissionFrame(1.0, 2.0, 3.0).relative_to(math.nan, 2.0)


def test_model_scale_of_the_field_tests() -> None:
    scale = ModelScale(env_scale=16.0, velocity_scale=0.25)
    np.testing.assert_array_equal(scale.position_to_model(np.array([32.0, 1.0])), (512.0, 16.0))
    np.testing.assert_array_equal(scale.position_to_mission_m(np.array([512.0, 8.0])), (32.0, 0.5))
    velocity = scale.velocity_to_mission_m_s(np.array([4.0, -2.0], np.float32))
    np.testing.assert_array_equal(velocity, (1.0, -0.5))
    assert velocity.dtype == np.float32


@settings(deadline=None)
@given(vectors, number(0.01, 1000.0))
def test_model_scale_round_trip(position_m: F64, env_scale: float) -> None:
    scale = ModelScale(env_scale, 1.0)
    back = scale.position_to_mission_m(scale.position_to_model(position_m))
    np.testing.assert_allclose(back, position_m, rtol=1e-14)


@pytest.mark.parametrize("value", [0.0, -1.0, math.inf, math.nan])
def test_a_wrong_scale_is_named(value: float) -> None:
    with pytest.raises(ValueError, match=f"^env_scale = {value}: must be above 0 and finite$"):
        ModelScale(value, 1.0)
    with pytest.raises(ValueError, match=f"^velocity_scale = {value}: must be above 0 and finite$"):
        ModelScale(1.0, value)
