"""Sites: mission frame, fence, pads and landing points, measured by the robots and kept in files.

A site is a file `sites/NAME.toml` beside fleet.toml, in the mission frame, m. Positions are
averages over the robots' statuses.
"""

import cmath
import itertools
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from geographiclib.geodesic import Geodesic

from edge.core.fence import Fence
from edge.core.schema import Bounded, ConfigError, PointXY, from_mapping, require
from edge.core.toml import read_toml
from edge.flight.margins import ErrorBudget, places_apart
from edge.messages.mission import GroundState, Origin, Place, RobotStatus, SlotNumber
from edge.robot.config import PlainName
from lpac.analysis.snapshot import FleetSetup, FleetSnapshot

# With a larger spread, a robot moves or does not know its position.
MAX_SPREAD_M = 2.0
MAX_HEADING_SPREAD_DEG = 10.0
# Shortest distance of two robots that gives a heading.
MIN_BASELINE_M = 2.0
# A robot beyond this distance from the origin is not at the mission's site.
FAR_M = 500.0
# Largest distance from a robot to its pad by GPS, and how much further any other pad must be.
MAX_PAD_DISTANCE_M = 3.0
CLEARLY_FURTHER_M = 1.0
# Side of the fence around the origin while the fence is off.
WIDE_FENCE_M = 200.0

_USED = "used"

Point = tuple[float, float]


class CircularMean(NamedTuple):
    """A mean direction in [0, 360), and the largest deviation from it, deg."""

    mean_deg: float
    spread_deg: float


class Standing(NamedTuple):
    """Mean position (latitude, longitude) and heading of a standing robot; heading None if unknown.

    `spread_m` is the largest deviation from the mean.
    """

    robot: str
    position_deg: Point
    spread_m: float
    heading: CircularMean | None


def circular_mean_deg(headings_deg: Sequence[float]) -> CircularMean:
    """Circular mean of compass headings. Raises ValueError if there is none."""
    total = sum(cmath.rect(1.0, math.radians(h)) for h in headings_deg)
    if not abs(total) > 1e-6 * max(len(headings_deg), 1):
        raise ValueError("the headings have no mean")
    mean_deg = _compass_deg(math.degrees(cmath.phase(total)))
    return CircularMean(mean_deg, max(abs(turn_deg(mean_deg, h)) for h in headings_deg))


def turn_deg(from_deg: float, to_deg: float) -> float:
    """Angle from one compass heading to another, clockwise positive, in [-180, 180]."""
    return math.remainder(to_deg - from_deg, 360.0)


def average_position(positions_deg: Sequence[Point]) -> Point:
    """Mean of nearby positions (latitude, longitude), also at the poles and the date line.

    Averages the normals. Raises ValueError if there is no mean.
    """
    normals = [_normal(*position) for position in positions_deg]
    x, y, z = (math.fsum(n[axis] for n in normals) for axis in range(3))
    if not math.hypot(x, y, z) > 1e-6 * max(len(normals), 1):
        raise ValueError("the positions have no mean")
    return math.degrees(math.atan2(z, math.hypot(x, y))), math.degrees(math.atan2(y, x))


def distance_m(from_deg: Point, to_deg: Point) -> float:
    """Length of the geodesic between two positions, m."""
    return float(Geodesic.WGS84.Inverse(*from_deg, *to_deg)["s12"])


def bearing_deg(from_deg: Point, to_deg: Point) -> float:
    """Compass heading from the first position to the second, in [0, 360)."""
    return _compass_deg(Geodesic.WGS84.Inverse(*from_deg, *to_deg)["azi1"])


def standing(robot: str, statuses: Sequence[RobotStatus]) -> Standing:
    """Average the position and heading that a robot's statuses report.

    Raises ValueError, one line, if it was not heard, is armed, does not know its position, or
    moves.
    """
    _require_disarmed(robot, statuses)
    places = [(s.global_deg[0], s.global_deg[1]) for s in statuses if s.global_deg is not None]
    if not places:
        raise ValueError(f"{robot} does not know its position yet: wait for its GPS")
    try:
        middle = average_position(places)
    except ValueError as error:
        raise ValueError(f"{robot}: {error}") from None
    spread_m = max(distance_m(middle, place) for place in places)
    _require_still(robot, spread_m)
    headings = [math.degrees(s.heading_rad) for s in statuses if s.heading_rad is not None]
    return Standing(robot, middle, spread_m, circular_mean_deg(headings) if headings else None)


def error_deg(apart_m: float) -> float:
    """How far 1 m of GPS error turns the bearing between two robots."""
    return math.degrees(math.atan2(1.0, apart_m))


def origin_at(first: Standing, toward: Standing | None) -> Origin:
    """Mission frame with its origin at the first robot.

    Its y axis points along the robot's nose, or toward the second robot. Raises ValueError if the
    heading is unknown or not accurate enough.
    """
    if toward is not None:
        apart_m = distance_m(first.position_deg, toward.position_deg)
        if not apart_m >= MIN_BASELINE_M:
            raise ValueError(
                f"{toward.robot} stands {apart_m:.1f} m from {first.robot}: must be at least "
                f"{MIN_BASELINE_M:g} m; more gives a better heading"
            )
        heading_deg = bearing_deg(first.position_deg, toward.position_deg)
    elif first.heading is None:
        raise ValueError(f"{first.robot} does not know its heading yet")
    elif first.heading.spread_deg > MAX_HEADING_SPREAD_DEG:
        raise ValueError(
            f"{first.robot}: its heading moved by {first.heading.spread_deg:.0f} deg, must be at "
            f"most {MAX_HEADING_SPREAD_DEG:g}: let it stand still, or use --toward another robot"
        )
    else:
        heading_deg = first.heading.mean_deg
    latitude_deg, longitude_deg = (round(angle, 8) for angle in first.position_deg)
    return Origin(latitude_deg, longitude_deg, _compass_deg(round(heading_deg, 2)))


def furthest_m(origin: Origin, snapshot: FleetSnapshot) -> float:
    """Distance from the origin to the furthest robot that is heard, m; 0 if none is."""
    place_deg = origin.latitude_deg, origin.longitude_deg
    return max(
        (
            distance_m(place_deg, (robot.status.global_deg[0], robot.status.global_deg[1]))
            for robot in snapshot.robots
            if robot.fresh and robot.status is not None and robot.status.global_deg is not None
        ),
        default=0.0,
    )


def to_mission_frame_m(origin: Origin, position_deg: Point) -> Point:
    """Convert (latitude, longitude) to (x, y) of the mission frame, m."""
    x_m, y_m, _ = origin.frame().relative_to(*position_deg).local_origin_m.tolist()
    return x_m, y_m


class OnPad(NamedTuple):
    """A robot's pad, by the number of its height, and the robot's distance from it, m."""

    height: int
    distance_m: float


def assign(places_m: Mapping[str, Point], pads_m: Mapping[int, Point]) -> dict[str, OnPad]:
    """Assign robots, by name, to their nearest pads, by the number of the slot's height.

    Raises ValueError, one line for all robots, if a robot is more than `MAX_PAD_DISTANCE_M` from
    every pad, if another pad is not at least `CLEARLY_FURTHER_M` further than its own, or if two
    robots are at one pad.
    """
    assigned: dict[str, OnPad] = {}
    problems: list[str] = []
    for robot, place in places_m.items():
        near = sorted((math.dist(place, pad), height) for height, pad in pads_m.items())
        if not near or not near[0][0] <= MAX_PAD_DISTANCE_M:
            nearest = f"; the nearest, {near[0][1]}, is {near[0][0]:.1f} m away" if near else ""
            problems.append(
                f"{robot} at {_format_point(place)} m is not within {MAX_PAD_DISTANCE_M:g} m of "
                f"any pad{nearest}"
            )
            continue
        own_m, height = near[0]
        if len(near) > 1 and near[1][0] < own_m + CLEARLY_FURTHER_M:
            problems.append(
                f"{robot} at {_format_point(place)} m is ambiguous: pad {height} is {own_m:.1f} m "
                f"and pad {near[1][1]} {near[1][0]:.1f} m away, must be {CLEARLY_FURTHER_M:g} m "
                "more"
            )
            continue
        beside = next((name for name, its in assigned.items() if its.height == height), None)
        if beside is not None:
            problems.append(f"{beside} and {robot} stand at one pad, {height}")
        assigned[robot] = OnPad(height, own_m)
    if problems:
        raise ValueError("; ".join(problems))
    return assigned


class Pads(NamedTuple):
    """The slots whose pads are used, and their source in words."""

    source: str
    slots: tuple["SiteSlot", ...]


def pads_in_use(sites: "Sites", name: str, setup: FleetSetup, origin: Origin) -> Pads:
    """The pads of the site `name`; if "", of the site used last, if its origin is the fleet's.

    Otherwise fleet.toml's pads. Raises ValueError if the named site has another origin.
    """
    chosen = name or sites.used()
    if chosen is not None:
        site = sites.load(chosen)
        if site.origin == origin:
            return Pads(f"site {chosen}", site.slots)
        if name:
            raise ValueError(
                f"site {name} has another origin than the fleet: `lpac site use {name}` sets it"
            )
    slots = tuple(
        SiteSlot(slot.place.slot, slot.pad_m, slot.place.landing_point_m) for slot in setup.slots
    )
    return Pads("fleet.toml", slots)


def mean_position_m(robot: str, statuses: Sequence[RobotStatus], origin: Origin) -> Point:
    """Mean position (x, y), mission frame, m.

    Raises ValueError, one line, if the robot is not heard, is armed, has another origin, does not
    know its position, or moves.
    """
    _require_disarmed(robot, statuses)
    if statuses[-1].origin != origin:
        raise ValueError(f"{robot} does not have the mission's origin yet")
    points = [s.position_m[:2] for s in statuses if s.position_m is not None and s.origin == origin]
    if not points:
        raise ValueError(f"{robot} does not know its position yet: wait for its GPS")
    x_m, y_m = (math.fsum(axis) / len(points) for axis in zip(*points, strict=True))
    _require_still(robot, max(math.dist((x_m, y_m), point) for point in points))
    return x_m, y_m


def assign_places(
    places_m: Mapping[str, Point], slots: Sequence["SiteSlot"], setup: FleetSetup
) -> tuple[dict[str, OnPad], dict[str, Place]]:
    """`assign` robots to the slots' pads; return that, and the resulting places.

    Also raises ValueError if a robot stands at the pad of a robot that is not included, or places
    are too close to each other.
    """
    assigned = assign(places_m, {slot.height: (slot.pad_m[0], slot.pad_m[1]) for slot in slots})
    owners = {slot.place.slot: slot.robot for slot in setup.slots if slot.robot}
    for robot, on_pad in assigned.items():
        owner = owners.get(on_pad.height, robot)
        if owner not in assigned:
            raise ValueError(
                f"{robot} stands at pad {on_pad.height} of {owner}: assign both at once"
            )
    by_height = {slot.height: slot for slot in slots}
    its = {robot: by_height[on_pad.height] for robot, on_pad in assigned.items()}
    require_apart(its.values(), setup.errors)
    return assigned, {
        robot: Place(slot.height, slot.landing_point_m) for robot, slot in its.items()
    }


def places_at(site: "SavedSite", setup: FleetSetup, robots: Iterable[str]) -> dict[str, Place]:
    """Places of these robots at the site: each takes the slot with its present height.

    Raises ValueError for a robot without a slot, for a height that the site does not have, or if
    places are too close to each other.
    """
    heights = {slot.robot: slot.place.slot for slot in setup.slots if slot.robot}
    chosen = {}
    for robot in robots:
        height = heights.get(robot)
        if height is None:
            raise ValueError(_is_spare(robot))
        slot = site.slot(height)
        if slot is None:
            known = ", ".join(str(slot.height) for slot in site.slots) or "none"
            raise ValueError(f"{robot} has height {height}: the site has {known}")
        chosen[robot] = slot
    require_apart(chosen.values(), setup.errors)
    return {robot: Place(slot.height, slot.landing_point_m) for robot, slot in chosen.items()}


def wide_fence(configured: Fence) -> Fence:
    """Fence in use while it is off: a square around the origin, with the same heights."""
    half_m = WIDE_FENCE_M / 2.0
    corners = ((-half_m, -half_m), (half_m, -half_m), (half_m, half_m), (-half_m, half_m))
    return Fence(corners, configured.buffer_m, configured.floor_m, configured.ceiling_m)


@dataclass(frozen=True, slots=True)
class SiteSlot(Bounded):
    """A place in the flight: the number of its height, its pad and its landing point, (x, y)."""

    height: SlotNumber
    pad_m: PointXY
    landing_point_m: PointXY


@dataclass(frozen=True, slots=True)
class SavedSite:
    """A place to fly at.

    Raises ValueError if two slots have one height, or a pad or landing point is outside the fence.
    """

    origin: Origin
    fence: Fence
    slots: tuple[SiteSlot, ...]

    def __post_init__(self) -> None:
        for i, slot in enumerate(self.slots):
            if not self.fence.distance_m(*slot.pad_m) > 0.0:
                raise ValueError(f"height {slot.height}: pad_m = {list(slot.pad_m)}: must be "
                                 "inside the fence")  # fmt: skip
            if not self.fence.distance_m(*slot.landing_point_m) >= self.fence.buffer_m:
                raise ValueError(
                    f"height {slot.height}: landing_point_m = {list(slot.landing_point_m)}: must "
                    f"be inside the fence, at least buffer_m = {self.fence.buffer_m:g} from its "
                    "line"
                )
            for other in self.slots[:i]:
                if other.height == slot.height:
                    raise ValueError(f"height {slot.height}: two slots have it")

    def slot(self, height: int) -> SiteSlot | None:
        """The slot with that height."""
        return next((slot for slot in self.slots if slot.height == height), None)


def require_apart(slots: Iterable[SiteSlot], errors: ErrorBudget) -> None:
    """Raises ValueError if robots at these slots could touch, within the error budget."""
    places = places_apart(errors.position_m, errors.position_m)
    for slot, other in itertools.combinations(slots, 2):
        for name, beside in itertools.product(("pad_m", "landing_point_m"), repeat=2):
            apart_m = math.dist(getattr(slot, name), getattr(other, beside))
            if not places.holds(apart_m):
                raise ValueError(
                    f"height {slot.height}: {name} = {_format_point(getattr(slot, name))}: is "
                    f"{apart_m:.1f} m from {beside} of height {other.height}, {places}"
                )


def measure_site(
    setup: FleetSetup,
    state: GroundState,
    stands: Mapping[str, Standing],
    first: Standing | None,
    toward: Standing | None,
    *,
    land_at_pads: bool,
) -> SavedSite:
    """Make a site whose pads are the present places of the robots in `stands`.

    The origin is that of `origin_at(first, toward)`, or the fleet's. Fence, heights and landing
    points are the fleet's; with `land_at_pads`, the pads are the landing points. Raises ValueError
    if there is no origin, a robot has no slot, or the site would not be valid.
    """
    origin = state.origin if first is None else origin_at(first, toward)
    if origin is None:
        raise ValueError("the origin is not set: `lpac mission origin` sets it, or use --from")
    seated = {slot.robot: slot.place for slot in setup.slots if slot.robot}
    fence = state.fence or setup.fence
    slots = []
    for robot, its in stands.items():
        if robot not in seated:
            raise ValueError(_is_spare(robot))
        # Adding 0 turns -0.0 into 0.0.
        x_m, y_m = (round(value, 2) + 0.0 for value in to_mission_frame_m(origin, its.position_deg))
        _require_inside(robot, (x_m, y_m), fence, lands=land_at_pads)
        landing_m = (x_m, y_m) if land_at_pads else seated[robot].landing_point_m
        slots.append(SiteSlot(seated[robot].slot, (x_m, y_m), landing_m))
    slots.sort(key=lambda slot: slot.height)
    require_apart(slots, setup.errors)
    return SavedSite(origin, fence, tuple(slots))


class Sites:
    """The sites of one fleet, in `sites` beside its fleet.toml.

    Every method raises ConfigError or OSError, one line that names the file.
    """

    def __init__(self, fleet_toml: Path) -> None:
        self.folder = fleet_toml.parent / "sites"

    def path(self, name: str) -> Path:
        """Path of a site's file."""
        try:
            require(PlainName, name, "site")
        except ValueError as error:
            raise ConfigError(str(error)) from None
        return self.folder / f"{name}.toml"

    def names(self) -> list[str]:
        """Names of all sites, in alphabetical order."""
        return sorted(path.stem for path in self.folder.glob("*.toml"))

    def load(self, name: str) -> SavedSite:
        """Load a saved site."""
        path = self.path(name)
        if not path.exists():
            known = ", ".join(self.names()) or "none"
            raise ConfigError(f"{path}: no such site; known are {known}")
        return from_mapping(SavedSite, read_toml(path), str(path))

    def require_new(self, name: str) -> None:
        """Raises ConfigError if a site of that name exists."""
        path = self.path(name)
        if path.exists():
            raise ConfigError(f"{path}: exists already: add --force to replace it")

    def save(self, name: str, site: SavedSite) -> Path:
        """Write the site's file atomically; return its path."""
        path = self.path(name)
        _write(path, _toml(name, site))
        return path

    def use(self, name: str) -> None:
        """Note that this site is in use."""
        _write(self.folder / _USED, f"{name}\n")

    def used(self) -> str | None:
        """Name of the site that was used last; None if there was none or it is gone."""
        try:
            name = (self.folder / _USED).read_text().strip()
        except FileNotFoundError:
            return None
        return name if name in self.names() else None


def _require_disarmed(robot: str, statuses: Sequence[RobotStatus]) -> None:
    if not statuses:
        raise ValueError(f"{robot} is not heard")
    if statuses[-1].armed:
        raise ValueError(f"{robot} is armed: land first")


def _require_still(robot: str, spread_m: float) -> None:
    if not spread_m <= MAX_SPREAD_M:
        raise ValueError(
            f"{robot}: its position moved by {spread_m:.1f} m, must be at most {MAX_SPREAD_M:g} m: "
            "let it stand still until its GPS has settled"
        )


def _require_inside(robot: str, place: Point, fence: Fence, *, lands: bool) -> None:
    inside_m = fence.distance_m(*place)
    if inside_m > 0.0 and (inside_m >= fence.buffer_m or not lands):
        return
    if inside_m > 0.0:
        where = f"{inside_m:.1f} m inside the fence, must be {fence.buffer_m:g} m to land there"
    else:
        where = "outside the fence"
    raise ValueError(
        f"{robot} stands at {_format_point(place)} m, {where}: another --from/--toward, or `lpac "
        "mission fence set`"
    )


def _is_spare(robot: str) -> str:
    return f"{robot} is a spare: `lpac fleet swap` gives it a slot"


def _normal(latitude_deg: float, longitude_deg: float) -> tuple[float, float, float]:
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    cos = math.cos(latitude)
    return cos * math.cos(longitude), cos * math.sin(longitude), math.sin(latitude)


def _compass_deg(angle_deg: float) -> float:
    # The remainder of a tiny negative angle rounds to 360 itself.
    heading_deg = angle_deg % 360.0
    return heading_deg if heading_deg < 360.0 else 0.0


def _format_point(point: Iterable[float]) -> str:
    return f"({', '.join(f'{value:.1f}' for value in point)})"


def _toml(name: str, site: SavedSite) -> str:
    origin, fence = site.origin, site.fence
    slots = (
        f"""
[[slots]]
height = {slot.height}
pad_m = {_pair(slot.pad_m)}
landing_point_m = {_pair(slot.landing_point_m)}
"""
        for slot in site.slots
    )
    return f"""\
# Site {name}: `lpac site save` wrote it, `lpac site use {name}` takes it. All points
# are (x, y) of the mission frame, m; heights are above the pads.

[origin]
latitude_deg = {origin.latitude_deg!r}
longitude_deg = {origin.longitude_deg!r}
heading_deg = {origin.heading_deg!r}  # of the y axis, clockwise from true north

[fence]
vertices_m = [{", ".join(map(_pair, fence.vertices_m))}]
buffer_m = {fence.buffer_m!r}
floor_m = {fence.floor_m!r}
ceiling_m = {fence.ceiling_m!r}
{"".join(slots)}"""


def _pair(point: Iterable[float]) -> str:
    return str([float(value) for value in point])


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(f".{path.name}.new")
    try:
        with new.open("w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)
