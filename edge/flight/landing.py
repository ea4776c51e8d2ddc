"""Place of landing: the landing point, or beside it if another robot stands there.

LAND does not avoid robots, so a returning robot checks before. Mission frame, m; pure.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from edge.core.fence import Fence
from edge.flight.margins import ErrorBudget, places_apart
from edge.flight.silence import SilenceLimits, deviation_m, possible_places_m
from edge.messages.beacon import Beacon, Neighbour
from edge.messages.mission import FlightState

Point = tuple[float, float]

# A robot this near to its own landing point has landed on it, given drift and gusts.
_ON_ITS_OWN_M = 2.0
# A chosen place is kept despite small apparent movements of standing robots.
_KEPT_M, _KEPT_SHARE = 2.0, 0.25
_GRID_M = 2.0


class StandingRobot(NamedTuple):
    """Another robot on the ground, motors off: its place and its own landing point.

    It may be up to `deviation_m` beside the place.
    """

    robot_id: int
    place_m: Point
    landing_point_m: Point
    deviation_m: float = 0.0

    def away_m(self, place_m: Point) -> float:
        """Least distance from a place."""
        return math.dist(self.place_m, place_m) - self.deviation_m

    @property
    def is_on_its_own(self) -> bool:
        """Whether it is at its own landing point, which is checked to be far from all others."""
        return math.dist(self.place_m, self.landing_point_m) <= _ON_ITS_OWN_M


def standing_robots(beacons: Iterable[Beacon]) -> list[StandingRobot]:
    """Robots that report to be on the ground or landing, with their places; of one frame."""
    return [
        StandingRobot(beacon.robot_id, beacon.position_m[:2], beacon.landing_point_m)
        for beacon in beacons
        if (beacon.armed is False or beacon.state is FlightState.LAND)
        and beacon.position_m is not None
    ]


def possible_landings(
    silent: Neighbour, its_landing_point_m: Point, limits: SilenceLimits
) -> list[StandingRobot]:
    """Places where a robot that fell silent in flight may stand, after landing on its way.

    It comes down at some time, unheard.
    """
    stopped = replace(silent, age_s=max(silent.age_s, limits.flies_on_s))
    return [
        StandingRobot(
            silent.robot_id, (x_m, y_m), its_landing_point_m, deviation_m(stopped, limits)
        )
        for x_m, y_m in possible_places_m(stopped, limits).tolist()
    ]


def in_the_way(
    landing_point_m: Point, standing: Iterable[StandingRobot], errors: ErrorBudget
) -> list[tuple[StandingRobot, float]]:
    """Robots standing at this landing point but not at their own, and their distances, m."""
    apart = places_apart(errors.position_m, errors.position_m)
    away = [(each, each.away_m(landing_point_m)) for each in standing]
    return [(each, m) for each, m in away if not apart.holds(m) and not each.is_on_its_own]


def place_to_land(
    landing_point_m: Point,
    before_m: Point | None,
    standing: Sequence[StandingRobot],
    others_m: Sequence[Point],
    fence: Fence,
    errors: ErrorBudget,
) -> Point | None:
    """The nearest free place inside the fence, or the freest; None for the landing point.

    A place is free if it is as far from standing robots and from `others_m` as landing points must
    be. `others_m` are the others' landing points, and the places of robots that return first.
    `before_m`, the last choice, is kept while it is free.
    """
    if not in_the_way(landing_point_m, standing, errors):
        return None
    apart_m = places_apart(errors.position_m, errors.position_m).least_m
    taken_m = np.array([*(each.place_m for each in standing), *others_m])
    strayed_m = np.array([*(each.deviation_m for each in standing), *(0.0 for _ in others_m)])
    if before_m is not None:
        kept_m = float((np.hypot(*(taken_m - before_m).T) - strayed_m).min())
        if kept_m >= apart_m - min(_KEPT_M, _KEPT_SHARE * apart_m):
            return before_m
    corners = np.array(fence.vertices_m)
    ranges = zip(corners.min(axis=0).tolist(), corners.max(axis=0).tolist(), strict=True)
    axes = (np.arange(low, high, _GRID_M) for low, high in ranges)
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    edges = fence.edges()
    places_m = grid[(grid @ edges.inward.T - edges.offsets_m).min(axis=1) >= fence.buffer_m]
    if not len(places_m):
        return None
    clear_m = (np.linalg.norm(places_m[:, None] - taken_m, axis=-1) - strayed_m).min(axis=1)
    away_m = np.hypot(*(places_m - landing_point_m).T)
    best = np.lexsort((away_m, -np.minimum(clear_m, apart_m)))[0]
    x_m, y_m = places_m[best].tolist()
    return x_m, y_m
