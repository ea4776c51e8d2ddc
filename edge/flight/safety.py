"""Limits on what the vehicle is told to do.

Mission frame: x right, y forward, z up, m, heights above the robot's own takeoff point. Positions
and velocities are (3,) float64 unless said otherwise.

What MISSION and RETURN command passes `limit_speed` and `limit_acceleration` first, then
`keep_inside`, and `brake` last, which keeps to the fence too: nothing may soften a stop. What HOLD
commands passes `make_room` alone.

Nothing here raises in flight. A number that is not finite, or beyond 1000 km, is no measurement:
where one comes in, a velocity goes out as 0, and a point as None.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from edge.core import F64
from edge.core.fence import Fence
from edge.core.schema import Bounded, NonNegative, Positive
from edge.core.vehicle import Vector
from edge.flight.silence import SilenceLimits, highest_still_m, nearest_on_way_m, strays_m
from edge.messages.beacon import Neighbour

_ABSURD = 1e6
# A slack is used up no faster than in this time: five control periods, which leaves room for the
# age of the estimate.
_SLACK_TIME_S = 0.5
_RECOVERY_SHARE = 0.5
_ROUNDING_M_S = 1e-9
_HEIGHT_GAIN_PER_S = 1.0
# Slower than any landing (PX4's last metres: 0.7 m/s), faster than a gust moves who holds a height.
_PASSING_M_S = 0.5


@dataclass(frozen=True, slots=True)
class MotionLimits(Bounded):
    """How fast the robot may move, and how its vehicle answers.

    `max_acceleration_m_s2` is at most 0.7 of what the vehicle reaches: it may have to brake and to
    turn at once. `lag_s` is the measured time constant of its answer to a velocity setpoint: PX4 in
    offboard mode takes 1.3 s.

    Raises ValueError if one is not finite and above 0 (the lag: at least 0).
    """

    max_speed_m_s: Positive
    max_climb_m_s: Positive
    max_acceleration_m_s2: Positive
    lag_s: NonNegative


class SeparationLimits(NamedTuple):
    """How far to stay from other robots, as estimated, m.

    `level_m`: from each, by 3-D distance. `passing_m`, in the plane: from one that climbs or comes
    down through the robot's height, since it keeps to its place and looks for nobody; it has not
    passed before it is `passing_height_m` away in height. `piloted_m`, in the plane: from one that
    somebody flies at its height. `landed_m`, in the plane: from where another one comes down,
    or may come down since it fell silent in flight; `silence` takes it to fly on for a while.
    """

    level_m: float
    passing_m: float
    passing_height_m: float
    piloted_m: float
    landed_m: float
    silence: SilenceLimits


class Closest(NamedTuple):
    """The nearest other robot, and its 3-D distance, m."""

    robot_id: int
    distance_m: float


def nearest(position_m: Sequence[float], neighbours: Iterable[Neighbour]) -> Closest | None:
    """Find the nearest robot, in 3-D, each taken to have flown on as it did; None if there is none.

    Neighbours of which something is not known are left out.
    """
    distances = [
        (neighbour.robot_id, math.dist(_extrapolated(neighbour), position_m))
        for neighbour in neighbours
        if _is_known(neighbour)
    ]
    return Closest(*min(distances, key=itemgetter(1))) if distances else None


def clear_height_m(
    position_m: F64, neighbours: Iterable[Neighbour], min_separation_m: float
) -> float:
    """How high a robot may climb from here, m: `min_separation_m` below whoever is above it.

    Infinite if nobody is. Who is less than twice that distance away in the plane counts as above.
    """
    heights_m = [math.inf]
    for neighbour in filter(_is_known, neighbours):
        x_m, y_m, height_m = _extrapolated(neighbour)
        apart_m = math.hypot(x_m - position_m[0], y_m - position_m[1])
        if apart_m < 2.0 * min_separation_m and height_m > position_m[2]:
            heights_m.append(height_m - min_separation_m)
    return min(heights_m)


def limit_speed(velocity: F64, max_speed: float) -> F64:
    """`velocity` (2,), shortened to `max_speed` if it is longer; the direction stays.

    A velocity that is not finite becomes 0.
    """
    speed = float(np.hypot(*velocity))
    if not math.isfinite(speed):
        return np.zeros(2)
    return velocity if speed <= max_speed else velocity * (max_speed / speed)


def limit_acceleration(
    previous_m_s: F64, wanted_m_s: F64, max_acceleration_m_s2: float, dt_s: float
) -> F64:
    """`wanted_m_s`, or as far on the way to it from `previous_m_s` as `dt_s` allows."""
    if not _plausible(previous_m_s, wanted_m_s, (dt_s,)):
        return np.zeros(3)
    change = wanted_m_s - previous_m_s
    largest = max_acceleration_m_s2 * max(dt_s, 0.0)
    size = math.hypot(*change)
    return wanted_m_s if size <= largest else previous_m_s + change * (largest / size)


def hold_height(height_m: float, wanted_height_m: float, max_climb_m_s: float) -> float:
    """The climb rate, m/s, up positive, towards a height: K_p (wanted - height), K_p = 1 / s."""
    if not _plausible((height_m, wanted_height_m)):
        return 0.0
    climb_m_s = _HEIGHT_GAIN_PER_S * (wanted_height_m - height_m)
    return min(max(climb_m_s, -max_climb_m_s), max_climb_m_s)


def leash(target_m: F64, position_m: F64, length_m: float) -> F64 | None:
    """`target_m`, or the point towards it that is `length_m` away from the position.

    So a position setpoint does not make the vehicle dash when its estimate jumps. None if there is
    no telling where that is: then command no velocity instead.
    """
    if not _plausible(target_m, position_m):
        return None
    offset_m = target_m - position_m
    distance_m = math.hypot(*offset_m)
    return target_m if distance_m <= length_m else position_m + offset_m * (length_m / distance_m)


def stopping_m(speed_m_s: float, limits: MotionLimits) -> float:
    """The way that it takes to stop from a speed of 0 or more, m: v lag + v^2 / 2a."""
    return speed_m_s * (limits.lag_s + speed_m_s / (2.0 * limits.max_acceleration_m_s2))


def approach_speed(distance_m: float, limits: MotionLimits) -> float:
    """The largest speed that `distance_m` is enough to stop from; 0 if none."""
    if not 0.0 < distance_m < _ABSURD:
        return 0.0
    lag_s, acceleration = limits.lag_s, limits.max_acceleration_m_s2
    return 2.0 * distance_m / (lag_s + math.sqrt(lag_s * lag_s + 2.0 * distance_m / acceleration))


def keep_inside(
    fence: Fence,
    position_m: F64,
    velocity_m_s: F64,
    wanted_m_s: F64,
    limits: MotionLimits,
    recovering: bool,
) -> tuple[F64, bool]:
    """Limit `wanted_m_s` so that the vehicle stops at the buffer inside the line.

    `velocity_m_s` is the vehicle's own, as estimated: for its lag it moves on, whatever is told.
    Towards each edge the velocity is shortened, along it not. A vehicle that was carried outside is
    brought back, at half the greatest speed, until it is half the buffer inside: pass the second
    result in again as `recovering`. Heights stop at the floor and at the ceiling themselves, and
    come back to them. Not for takeoff and landing, which pass through the floor.
    """
    if not _plausible(position_m, velocity_m_s, wanted_m_s):
        return np.zeros(3), recovering
    edges = fence.edges()
    distances_m = edges.distances_m(position_m[:2])
    depth_m = float(np.minimum.reduce(distances_m))
    recovering = depth_m < 0.0 or (recovering and depth_m < fence.buffer_m / 2.0)
    if recovering:
        # Downhill on the sum of the squared shortfalls, which is convex: it ends inside, in
        # corners too.
        inward = np.maximum(fence.buffer_m - distances_m, 0.0) @ edges.inward
        speed_m_s = _RECOVERY_SHARE * limits.max_speed_m_s
        horizontal = inward * (speed_m_s / max(math.hypot(*inward), 1e-9))
    else:
        caps = _caps_at_edges(fence, position_m, velocity_m_s, limits)
        horizontal = _limit_towards(wanted_m_s[:2], -edges.inward, caps)
    climb_m_s = _keep_height(fence, position_m[2], velocity_m_s[2], wanted_m_s[2], limits)
    return np.array([*horizontal, climb_m_s]), recovering


def brake(
    position_m: F64,
    velocity_m_s: F64,
    wanted_m_s: F64,
    neighbours: Sequence[Neighbour],
    silent: Sequence[Neighbour],
    separation: SeparationLimits,
    limits: MotionLimits,
    fence: Fence | None,
) -> F64:
    """Limit `wanted_m_s` so that the robot stays as far from others as it must.

    `velocity_m_s` is the robot's own, as estimated. Neighbours are taken to have flown on as they
    did. One that is `level_m` or more above or below brakes nothing, since robots cross in their
    height slots, unless it climbs or comes down and passes before the robot could be out of its
    way, or somebody flies it at about this height. Towards another one the robot may close half the
    slack, since that one does the same, and all of it towards one that somebody flies. Away from
    it, it may always fly, and from one that is too near it has to, by half of what is missing: else
    each error of an estimate would let them close in, and none part them. Who passes does nothing
    of the kind: the robot leaves all of its way, and by where the vehicle comes to rest, so that it
    does not turn round under it. Climbing is not limited. Giving way to a neighbour leads over no
    edge of `fence`; None where there is none to keep to.

    Those who are `silent` fell so in flight, and nobody knows whether they fly on, hover or come
    down. Who is below one, or level with it, leaves where it may be as it leaves who passes: the
    way from its last place to where it would be if it had flown on as it did.

    A neighbour of which something is not known stops the robot.
    """
    if not _plausible(position_m, velocity_m_s, wanted_m_s):
        return np.zeros(3)
    if not all(map(_is_known, (*neighbours, *silent))):
        return np.zeros(3)
    near = _who_is_near(position_m, velocity_m_s, neighbours, silent, separation, limits)
    return _kept_apart(near, position_m, velocity_m_s, wanted_m_s, limits, fence)


def make_room(
    position_m: F64,
    velocity_m_s: F64,
    wanted_m_s: F64,
    neighbours: Iterable[Neighbour],
    separation: SeparationLimits,
    limits: MotionLimits,
    fence: Fence,
    *,
    lands: bool,
) -> F64:
    """Limit `wanted_m_s` of a robot that holds its place: as `brake`, but it looks at less.

    Neighbours of which something is not known do not keep it from its place; nor do those who are
    silent, who may not hear it either, and take it to stand there. Who is to come down where it is,
    as they may be too, `lands`: it parts from each neighbour, whatever its height is, by `landed_m`
    in the plane, of which each flies half.
    """
    known = [each for each in neighbours if _is_known(each)]
    if not lands:
        return brake(position_m, velocity_m_s, wanted_m_s, known, (), separation, limits, fence)
    near = _who_is_near(position_m, velocity_m_s, known, (), separation, limits)
    for neighbour in known:
        offset_m = np.array(_extrapolated(neighbour)[:2]) - position_m[:2]
        apart_m = math.hypot(*offset_m)
        # In a crowd one is left towards another, which leaves in turn.
        at_most_m = max(apart_m - separation.level_m, 0.0) / 2.0
        slack_m = (apart_m - separation.landed_m) / 2.0
        near.append(_Near(offset_m, slack_m, max(slack_m, at_most_m), from_rest=False))
    return _kept_apart(near, position_m, velocity_m_s, wanted_m_s, limits, fence)


class _Near(NamedTuple):
    """A robot that limits this one: its place from here, (2,), or from where the vehicle stops.

    `slack_m` may be flown towards it, below 0 away from it; and no more than `at_most_m`, 0 or
    more, if others have to be left more than this one.
    """

    offset_m: F64
    slack_m: float
    at_most_m: float
    from_rest: bool


class _Way(NamedTuple):
    """The way to a neighbour, (2,), and how fast to be told to fly it, m/s: away if below 0.

    `at_most`, 0 or more, if others have to be left more than this one.
    """

    direction: F64
    cap: float
    at_most: float


def _who_is_near(
    position_m: F64,
    velocity_m_s: F64,
    neighbours: Sequence[Neighbour],
    silent: Sequence[Neighbour],
    separation: SeparationLimits,
    limits: MotionLimits,
) -> list[_Near]:
    rest_m = position_m[:2] + velocity_m_s[:2] * limits.lag_s
    near: list[_Near] = []
    own_height_m = float(position_m[2])
    for neighbour in neighbours:
        *place_m, height_m = _extrapolated(neighbour)
        up_m = height_m - own_height_m
        least_m = separation.piloted_m if neighbour.is_piloted else separation.passing_m
        if _passes(up_m, neighbour.velocity_m_s[2], separation, limits):
            near.append(_to_leave(place_m - rest_m, least_m, separation, from_rest=True))
        elif neighbour.is_piloted and abs(up_m) < separation.passing_height_m:
            here_m = place_m - position_m[:2]
            near.append(_to_leave(here_m, least_m, separation, from_rest=False))
        elif abs(up_m) < separation.level_m:
            here_m = place_m - position_m[:2]
            # Squares of far smaller numbers than a separation may vanish: never below 0.
            needed_m = math.sqrt(max(separation.level_m**2 - up_m * up_m, 0.0))
            slack_m = (math.hypot(*here_m) - needed_m) / 2.0
            near.append(_Near(here_m, slack_m, max(slack_m, 0.0), from_rest=False))
    for robot in silent:
        highest_m = highest_still_m(robot, separation.silence)
        if position_m[2] < highest_m + separation.passing_height_m:
            stopped_m = nearest_on_way_m(robot, separation.silence, rest_m)
            least_m = separation.landed_m + strays_m(robot, separation.silence)
            near.append(_to_leave(stopped_m - rest_m, least_m, separation, from_rest=True))
    return near


def _kept_apart(
    near: Sequence[_Near],
    position_m: F64,
    velocity_m_s: F64,
    wanted_m_s: F64,
    limits: MotionLimits,
    fence: Fence | None,
) -> F64:
    """Limit `wanted_m_s` towards, and away from, all robots that are near."""
    if not all(each.offset_m.any() for each in near):
        return np.zeros(3)  # One is just here: every way may be the wrong one.
    ways = []
    for offset_m, slack_m, at_most_m, from_rest in near:
        direction = offset_m / math.hypot(*offset_m)
        speed_m_s = 0.0 if from_rest else float(direction @ velocity_m_s[:2])
        cap = _speed_to(slack_m, speed_m_s, limits)
        ways.append(_Way(direction, cap, _speed_to(at_most_m, speed_m_s, limits)))
    horizontal = wanted_m_s[:2]
    if all(float(way.direction @ horizontal) <= way.cap for way in ways):
        return wanted_m_s
    # Whom it has to leave most has the last word.
    for way in sorted(ways, key=lambda way: -way.cap):
        if way.cap < 0.0:
            excess = max(float(way.direction @ horizontal) - way.cap, 0.0)
            horizontal = horizontal - way.direction * excess
    horizontal = limit_speed(horizontal, limits.max_speed_m_s)
    directions = [way.direction for way in ways]
    caps = [way.at_most for way in ways]
    if fence is not None:
        directions += list(-fence.edges().inward)
        caps += _caps_at_edges(fence, position_m, velocity_m_s, limits)
    horizontal = _limit_towards(horizontal, directions, caps)
    return np.array([*horizontal, wanted_m_s[2]])


def _to_leave(
    offset_m: F64, least_m: float, separation: SeparationLimits, *, from_rest: bool
) -> _Near:
    """One that does nothing for the distance of `least_m` itself."""
    apart_m = math.hypot(*offset_m)
    slack_m = apart_m - least_m
    at_most_m = slack_m if slack_m >= 0.0 else max(apart_m - separation.level_m, 0.0)
    return _Near(offset_m, slack_m, at_most_m, from_rest)


def _passes(
    up_m: float, climb_m_s: float, separation: SeparationLimits, limits: MotionLimits
) -> bool:
    """Whether who is `up_m` higher is at the robot's height before that has left its way."""
    if abs(climb_m_s) < _PASSING_M_S:
        return False
    to_leave_s = limits.lag_s + separation.passing_m / limits.max_speed_m_s
    lowest_m, highest_m = sorted((up_m, up_m + climb_m_s * to_leave_s))
    near_m = separation.passing_height_m
    return lowest_m < near_m and highest_m > -near_m


def _speed_to(slack_m: float, speed_m_s: float, limits: MotionLimits) -> float:
    """How fast to be told to fly to a line, and back if it is passed, already doing `speed_m_s`."""
    if slack_m >= 0.0:
        return _speed_towards(slack_m, speed_m_s, limits)
    return -_speed_towards(-slack_m, -speed_m_s, limits)


def _extrapolated(neighbour: Neighbour) -> Vector:
    """Where it is now, if it has flown on as it did."""
    (x_m, y_m, z_m), age_s = neighbour.position_m, neighbour.age_s
    x_m_s, y_m_s, z_m_s = neighbour.velocity_m_s
    return x_m + x_m_s * age_s, y_m + y_m_s * age_s, z_m + z_m_s * age_s


def _is_known(neighbour: Neighbour) -> bool:
    """Whether its numbers are plausible: NaN and infinity are not."""
    return math.hypot(*neighbour.position_m, *neighbour.velocity_m_s, neighbour.age_s) < _ABSURD


def _caps_at_edges(
    fence: Fence, position_m: F64, velocity_m_s: F64, limits: MotionLimits
) -> list[float]:
    """How fast to be told to fly outwards at each edge."""
    edges = fence.edges()
    slacks_m = edges.distances_m(position_m[:2]) - fence.buffer_m
    outward_m_s = -(edges.inward @ velocity_m_s[:2])
    return [
        _speed_towards(slack_m, speed_m_s, limits)
        for slack_m, speed_m_s in zip(slacks_m.tolist(), outward_m_s.tolist(), strict=True)
    ]


def _speed_towards(slack_m: float, speed_m_s: float, limits: MotionLimits) -> float:
    """How fast to be told to fly towards a line `slack_m` away, already doing `speed_m_s`.

    `approach_speed` alone is overshot by a third of the way: the vehicle follows a falling command
    late. What the slack leaves after the way that it needs to stop falls by itself no faster than
    by what is commanded, and never below 0 if that is a small part of it.
    """
    left_m = slack_m - stopping_m(max(speed_m_s, 0.0), limits)
    return min(approach_speed(slack_m, limits), max(left_m, 0.0) / _SLACK_TIME_S)


def _limit_towards(velocity: F64, directions: Iterable[F64], caps: Sequence[float]) -> F64:
    """`velocity` (2,) with at most `caps`, 0 or more, along each of `directions` (2,)."""
    limited = velocity
    pairs = list(zip(directions, caps, strict=True))
    for direction, cap in pairs:
        limited = limited - direction * max(float(direction @ limited) - cap, 0.0)
    # Where directions oppose each other, mending one breaks another: the whole vector gives way.
    share = 1.0
    for direction, cap in pairs:
        speed = float(direction @ limited)
        if speed > cap + _ROUNDING_M_S:
            share = min(share, cap / speed)
    return limited * share


def _keep_height(
    fence: Fence, height_m: float, climb_m_s: float, wanted_m_s: float, limits: MotionLimits
) -> float:
    highest, lowest = (
        hold_height(height_m, limit_m, limits.max_climb_m_s)
        if (limit_m - height_m) * sign < 0.0
        else sign * _speed_towards((limit_m - height_m) * sign, climb_m_s * sign, limits)
        for limit_m, sign in ((fence.ceiling_m, 1.0), (fence.floor_m, -1.0))
    )
    return max(min(wanted_m_s, highest), lowest)


def _plausible(*vectors: Iterable[float]) -> bool:
    for vector in vectors:
        for number in vector:
            if not -_ABSURD < number < _ABSURD:
                return False
    return True
