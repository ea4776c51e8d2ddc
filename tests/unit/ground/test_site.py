"""Measuring where robots stand, who stands at which pad, and the files of sites."""

import itertools
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.fence import Fence
from edge.flight.margins import ErrorBudget
from edge.messages.mission import FlightState, GroundState, Origin, Place, RobotStatus
from lpac.ground.site import (
    CLEARLY_FURTHER_M,
    MAX_PAD_DISTANCE_M,
    OnPad,
    SavedSite,
    Sites,
    SiteSlot,
    Standing,
    assign,
    assign_places,
    average_position,
    bearing_deg,
    circular_mean_deg,
    distance_m,
    furthest_m,
    mean_position_m,
    measure_site,
    origin_at,
    places_at,
    require_apart,
    standing,
    to_mission_frame_m,
    turn_deg,
    wide_fence,
)
from tests.said import reason
from tests.unit.ground.snapshots import robot, setup, snapshot

FENCE = Fence(((-2.0, -2.0), (34.0, -2.0), (34.0, 34.0), (-2.0, 34.0)), 1.5, 2.0, 30.0)
SITE = SavedSite(
    Origin(-33.86, 151.2, 359.99),
    FENCE,
    (SiteSlot(0, (2.0, 2.0), (4.0, 4.0)), SiteSlot(3, (6.0, 2.0), (8.0, 4.0))),
)

headings = st.floats(0.0, 360.0, exclude_max=True)
latitudes = st.floats(-89.9, 89.9)
longitudes = st.floats(-180.0, 180.0)


def status(position_deg: tuple[float, float] | None, heading_deg: float | None) -> RobotStatus:
    return RobotStatus(
        robot_id=1, boot_nonce=1, sequence=1, uptime_s=1.0, unix_time_s=1.0,
        state=FlightState.IDLE, reason=reason(""), ready=False, failed_checks=(), alarms=(),
        obeyed_sequence=0, operator="", orders=(), bundle_id="", world_id="", trial="",
        origin=None, system_id=None, slot_height_m=4.0, landing_point_m=(4.0, 4.0),
        position_m=None, velocity_m_s=None,
        heading_rad=None if heading_deg is None else math.radians(heading_deg),
        mode=None, armed=False, battery=None, satellites=None, message_counts={},
        neighbour_ages_s={}, loops={}, global_deg=position_deg,
    )  # fmt: skip


def place_at(origin: Origin, x_m: float, y_m: float) -> tuple[float, float]:
    return origin.frame().to_global_deg(x_m, y_m)


def moved(start: tuple[float, float], azimuth_deg: float, by_m: float) -> tuple[float, float]:
    """The place that far away, by the mission frame's own geodesic."""
    return place_at(Origin(*start, azimuth_deg % 360.0), 0.0, by_m)


# Means


@given(st.lists(st.floats(-80.0, 80.0), min_size=1, max_size=20), headings)
def test_headings_have_the_same_mean_wherever_north_lies(
    turns: list[float], north_deg: float
) -> None:
    mean_deg, spread_deg = circular_mean_deg([(turn + north_deg) % 360.0 for turn in turns])
    assert 0.0 <= mean_deg < 360.0
    around_zero = circular_mean_deg([turn % 360.0 for turn in turns])
    assert abs(turn_deg(mean_deg, around_zero.mean_deg + north_deg)) < 1e-6
    assert spread_deg == pytest.approx(around_zero.spread_deg, abs=1e-6)
    assert min(turns) - 1e-6 <= turn_deg(0.0, around_zero.mean_deg) <= max(turns) + 1e-6


def test_headings_on_both_sides_of_north_have_their_mean_in_the_north() -> None:
    mean_deg, spread_deg = circular_mean_deg([358.0, 4.0])
    assert mean_deg == pytest.approx(1.0)
    assert spread_deg == pytest.approx(3.0)
    with pytest.raises(ValueError, match="no mean"):
        circular_mean_deg([0.0, 180.0])


@given(latitudes, longitudes, st.lists(st.tuples(headings, st.floats(0.0, 50.0)), max_size=8))
def test_places_have_their_middle_between_them(
    latitude: float, longitude: float, offsets: list[tuple[float, float]]
) -> None:
    """Also at the date line and beside the poles: pairs opposite each other leave the middle."""
    centre = (latitude, longitude)
    places = [centre]
    for azimuth, by_m in offsets:
        places += [moved(centre, azimuth, by_m), moved(centre, azimuth + 180.0, by_m)]
    assert distance_m(average_position(places), centre) < 1e-3


@given(latitudes, longitudes, headings, st.floats(1.0, 1000.0))
def test_bearing_and_distance_lead_to_the_second_place(
    latitude: float, longitude: float, azimuth_deg: float, by_m: float
) -> None:
    start = (latitude, longitude)
    end = moved(start, azimuth_deg, by_m)
    assert 0.0 <= bearing_deg(start, end) < 360.0
    assert abs(turn_deg(bearing_deg(start, end), azimuth_deg)) < 1e-3
    assert distance_m(start, end) == pytest.approx(by_m, abs=1e-4)
    origin = Origin(*start, azimuth_deg)
    assert to_mission_frame_m(origin, end) == pytest.approx((0.0, by_m), abs=1e-3)


# Origins


def test_origin_is_where_the_robot_stands_and_points() -> None:
    centre = (48.0, 11.0)
    heard = [status(moved(centre, 90.0 * i, 0.5), h) for i, h in enumerate((359.0, 3.0, 1.0, 1.0))]
    first = standing("r1", heard)
    assert first.spread_m == pytest.approx(0.5, abs=1e-3)
    assert first.heading is not None
    assert first.heading.spread_deg == pytest.approx(2.0)
    origin = origin_at(first, None)
    assert distance_m((origin.latitude_deg, origin.longitude_deg), centre) < 0.01
    assert origin.heading_deg == 1.0

    second = standing("r2", [status(moved(centre, 359.999, 30.0), None)])
    assert abs(turn_deg(origin_at(first, second).heading_deg, 0.0)) < 0.02
    with pytest.raises(ValueError, match="r2 does not know its heading yet"):
        origin_at(second, None)
    close = standing("r2", [status(moved(centre, 20.0, 1.0), None)])
    with pytest.raises(ValueError, match=r"r2 stands 1.0 m from r1: must be at least 2 m"):
        origin_at(first, close)


def test_robot_that_moves_or_knows_nothing_gives_no_origin() -> None:
    centre = (48.0, 11.0)
    with pytest.raises(ValueError, match="r1 is not heard"):
        standing("r1", [])
    with pytest.raises(ValueError, match="r1 is armed: land first"):
        standing("r1", [status(centre, 10.0), replace(status(centre, 10.0), armed=True)])
    with pytest.raises(ValueError, match="r1 does not know its position yet"):
        standing("r1", [status(None, 10.0)])
    with pytest.raises(ValueError, match="r1: the positions have no mean"):
        standing("r1", [status((0.0, 0.0), 10.0), status((0.0, 180.0), 10.0)])
    carried = [*[status(centre, 10.0)] * 2, status(moved(centre, 0.0, 12.0), 10.0)]
    with pytest.raises(ValueError, match=r"r1: its position moved by 8.0 m, must be at most 2 m"):
        standing("r1", carried)
    turned = standing("r1", [status(centre, 10.0), status(centre, 60.0)])
    with pytest.raises(ValueError, match="r1: its heading moved by 25 deg, must be at most 10"):
        origin_at(turned, None)


# Robots and pads

PADS = {0: (2.0, 2.0), 1: (6.0, 2.0), 2: (10.0, 2.0)}


def test_robots_are_at_the_pads_nearest_to_them() -> None:
    assigned = assign({"r1": (9.5, 2.0), "r2": (2.0, 3.0)}, PADS)
    assert assigned == {"r1": OnPad(2, 0.5), "r2": OnPad(0, 1.0)}


@pytest.mark.parametrize(
    ("places", "problem"),
    [
        ({"r1": (2.0, 6.5)}, r"r1 at \(2.0, 6.5\) m is not within 3 m of any pad; the nearest, 0, "
                             r"is 4.5 m away"),
        ({"r1": (4.2, 2.0)}, r"r1 at \(4.2, 2.0\) m is ambiguous: pad 1 is 1.8 m and pad 0 2.2 m"),
        ({"r1": (2.0, 2.0), "r2": (1.0, 2.0)}, "r1 and r2 stand at one pad, 0"),
        ({"r1": (20.0, 2.0), "r2": (21.0, 2.0)}, "r1 at .*; r2 at "),
    ],
)  # fmt: skip
def test_doubtful_places_are_refused(places: dict[str, tuple[float, float]], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        assign(places, PADS)


coordinates = st.tuples(st.floats(0.0, 12.0), st.floats(0.0, 4.0))


@given(
    st.lists(coordinates, min_size=1, max_size=4, unique=True),
    st.lists(coordinates, min_size=4, max_size=5, unique=True),
)
def test_what_is_assigned_has_the_least_total_distance(
    places: list[tuple[float, float]], pads: list[tuple[float, float]]
) -> None:
    named = {f"r{i}": place for i, place in enumerate(places)}
    try:
        assigned = assign(named, dict(enumerate(pads)))
    except ValueError:
        return
    total_m = sum(on_pad.distance_m for on_pad in assigned.values())
    least_m = min(
        sum(map(math.dist, places, chosen)) for chosen in itertools.permutations(pads, len(places))
    )
    assert total_m == pytest.approx(least_m)
    assert len({on_pad.height for on_pad in assigned.values()}) == len(places)
    for name, on_pad in assigned.items():
        assert on_pad.distance_m <= MAX_PAD_DISTANCE_M
        others = [math.dist(named[name], p) for h, p in enumerate(pads) if h != on_pad.height]
        assert min(others) >= on_pad.distance_m + CLEARLY_FURTHER_M


def test_fence_that_is_off_keeps_the_heights_only() -> None:
    wide = wide_fence(FENCE)
    assert wide.distance_m(0.0, 0.0) == 100.0
    assert (wide.floor_m, wide.ceiling_m) == (2.0, 30.0)


def at(place_m: tuple[float, float], **changes: Any) -> RobotStatus:
    """Status of a robot on the ground at a place in the mission frame, m."""
    here = replace(status((48.0, 11.0), 10.0), origin=SITE.origin, position_m=(*place_m, 0.0))
    return replace(here, **changes)


def test_a_robots_place_is_the_mean_of_what_it_says_in_this_frame() -> None:
    before = at((90.0, 90.0), origin=None)
    assert mean_position_m("r1", [before, at((1.0, 2.0)), at((3.0, 2.0))], SITE.origin) == (
        2.0,
        2.0,
    )
    for statuses, problem in (
        ([at((1.0, 2.0)), at((9.0, 2.0))], r"r1: its position moved by 4.0 m"),
        ([at((1.0, 2.0)), before], "r1 does not have the mission's origin yet"),
        ([at((1.0, 2.0)), at((1.0, 2.0), armed=True)], "r1 is armed: land first"),
    ):
        with pytest.raises(ValueError, match=problem):
            mean_position_m("r1", statuses, SITE.origin)


def test_nobody_gets_places_that_are_too_close_for_how_the_fleet_measures() -> None:
    fleet, precise = setup(2), replace(setup(2), errors=ErrorBudget(gps_m=0.1))
    site = replace(SITE, slots=(SITE.slots[0], replace(SITE.slots[1], height=1)))
    places_m = {"r0": (2.0, 2.0), "r1": (6.0, 2.0)}
    expected = {"r0": Place(0, (4.0, 4.0)), "r1": Place(1, (8.0, 4.0))}
    assert places_at(site, precise, places_m) == expected
    assert assign_places(places_m, site.slots, precise)[1] == expected
    for place in (
        lambda: places_at(site, fleet, places_m),
        lambda: assign_places(places_m, site.slots, fleet),
    ):
        with pytest.raises(ValueError, match="must be 8 m"):
            place()


def test_a_site_as_it_stands_has_the_fence_that_the_ground_told() -> None:
    ground = GroundState(4, "alice", SITE.origin, fence=replace(FENCE, buffer_m=3.0))
    here = place_at(SITE.origin, 0.0, 0.0)
    stands = {"r0": Standing("r0", here, 0.1, None)}
    saved = measure_site(setup(1), ground, stands, None, None, land_at_pads=False)
    assert (saved.origin, saved.fence) == (SITE.origin, ground.fence)
    with pytest.raises(ValueError, match=r"2\.0 m inside the fence, must be 3 m to land there"):
        measure_site(setup(1), ground, stands, None, None, land_at_pads=True)


def test_the_furthest_robot_is_one_that_is_heard() -> None:
    near, far = (place_at(SITE.origin, 0.0, y_m) for y_m in (30.0, 900.0))
    seen = snapshot(robot(status(near, None)), robot(status(far, None), age_s=60.0))
    assert furthest_m(SITE.origin, seen) == pytest.approx(30.0)


# Files


def test_site_is_read_as_it_was_saved(tmp_path: Path) -> None:
    sites = Sites(tmp_path / "fleet.toml")
    assert sites.names() == []
    assert sites.used() is None
    path = sites.save("park", SITE)
    assert path == tmp_path / "sites" / "park.toml"
    assert sites.load("park") == SITE
    sites.use("park")
    assert sites.used() == "park"
    assert sites.names() == ["park"]

    other = replace(SITE, slots=SITE.slots[:1])
    with pytest.raises(ValueError, match=r"park.toml: exists already: add --force"):
        sites.require_new("park")
    sites.save("park", other)
    assert sites.load("park") == other
    assert sorted(p.name for p in path.parent.iterdir()) == ["park.toml", "used"]
    path.unlink()
    assert sites.used() is None


@pytest.mark.parametrize(
    ("before", "after", "problem"),
    [
        ("latitude_deg = -33.86", "latitude_deg = 91.0", "origin: latitude_deg = 91.0: must be"),
        ("heading_deg = 359.99", "heading_deg = 360.0", "= 360.0: must be at least 0 and below"),
        ("height = 3", "height = 0", "height 0: two slots have it"),
        ("pad_m = [2.0, 2.0]", "pad_m = [2.0, 200.0]", "height 0: pad_m = .*inside the fence"),
        ("[4.0, 4.0]", "[-1.0, 4.0]", r"height 0: landing_point_m = .*at least buffer_m = 1.5"),
        ("buffer_m = 1.5", "bufer_m = 1.5", "fence: unknown key 'bufer_m'"),
        ("[origin]", "[origin", "is not TOML"),
    ],
)  # fmt: skip
def test_mistake_in_a_site_is_one_line(
    tmp_path: Path, before: str, after: str, problem: str
) -> None:
    sites = Sites(tmp_path / "fleet.toml")
    path = sites.save("park", SITE)
    path.write_text(path.read_text().replace(before, after))
    with pytest.raises(ValueError, match=problem) as raised:
        sites.load("park")
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_places_are_as_far_apart_as_positions_err() -> None:
    budget, alone = ErrorBudget(), SiteSlot(0, (2.0, 2.0), (2.0, 2.0))
    require_apart((alone,), budget)
    require_apart((alone, SiteSlot(3, (10.0, 2.0), (10.0, 2.0))), budget)
    near = (SiteSlot(0, (2.0, 2.0), (9.0, 4.0)), SiteSlot(3, (10.0, 2.0), (17.0, 4.0)))
    with pytest.raises(
        ValueError,
        match=r"height 0: landing_point_m = \(9.0, 4.0\): is 2.2 m from "
        r"pad_m of height 3, must be 8 m",
    ):
        require_apart(near, budget)
    require_apart(near, ErrorBudget(gps_m=0.1))


def test_sites_names_are_names(tmp_path: Path) -> None:
    sites = Sites(tmp_path / "fleet.toml")
    for name in ("../park", "", "a b", "-x"):
        with pytest.raises(ValueError, match="must be 1 to 32 letters"):
            sites.save(name, SITE)
    with pytest.raises(ValueError, match=r"field.toml: no such site; known are none"):
        sites.load("field")
