"""Limits of the vehicle's setpoints.

Mission frame: x right, y forward, z up, m, heights above the robot's own takeoff point. Positions
and velocities are (3,) float64 unless stated otherwise.

Commands of MISSION and RETURN pass `limit_speed`, `limit_acceleration`, `keep_inside`, and finally
`brake`, which also respects the fence: nothing may soften a stop. Commands of HOLD pass only
`make_room`.

No function raises in flight. Numbers that are not finite, or beyond 1000 km, are no measurements:
for these, velocities become 0 and points None.
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
from edge.flight.silence import SilenceLimits, deviation_m, highest_possible_m, nearest_place_m
from edge.messages.beacon import Neighbour

_ABSURD = 1e6
# A slack is used up in no less than this time: five control periods, with room for the estimate's
# age.
_SLACK_TIME_S = 0.5
_RECOVERY_SHARE = 0.5
_ROUNDING_M_S = 1e-9
_HEIGHT_GAIN_PER_S = 1.0
# Slower than any landing (PX4's last metres: 0.7 m/s), faster than gusts move a holding vehicle.
_PASSING_M_S = 0.5


@dataclass(frozen=True, slots=True)
class MotionLimits(Bounded):
    """Limits of the robot's motion, and its vehicle's response.

    `max_acceleration_m_s2` is at most 0.7 of the vehicle's, since it may have to brake and turn at
    the same time. `lag_s` is the measured time constant of its response to a velocity setpoint: PX4
    in offboard mode takes 1.3 s.

    Raises ValueError if one is not finite and above 0 (the lag: at least 0).
    """

    max_speed_m_s: Positive
    max_climb_m_s: Positive
    max_acceleration_m_s2: Positive
    lag_s: NonNegative


class SeparationLimits(NamedTuple):
    """Distances from other robots, as estimated, m.

    `level_m`: 3-D distance from each. `passing_m`, horizontal: from a robot that climbs or descends
    through this one's height without avoiding others, until it is `passing_height_m` above or
    below. `piloted_m`, horizontal: from a robot flown by a pilot at this height. `landed_m`,
    horizontal: from the place where another one lands, or may land after it fell silent in flight;
    `silence` bounds its flight until then.
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
    """Nearest robot in 3-D, extrapolated at constant velocity; None if there is none.

    Neighbours with unknown values are left out.
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
    """Height to which a robot may climb, m: `min_separation_m` below the lowest robot above it.

    Infinite without one. Robots within twice that distance horizontally count as above.
    """
    heights_m = [math.inf]
    for neighbour in filter(_is_known, neighbours):
        x_m, y_m, height_m = _extrapolated(neighbour)
        apart_m = math.hypot(x_m - position_m[0], y_m - position_m[1])
        if apart_m < 2.0 * min_separation_m and height_m > position_m[2]:
            heights_m.append(height_m - min_separation_m)
    return min(heights_m)


def limit_speed(velocity: F64, max_speed: float) -> F64:
    """`velocity` (2,), shortened to `max_speed` if it is longer, with the same direction.

    A velocity that is not finite becomes 0.
    """
    speed = float(np.hypot(*velocity))
    if not math.isfinite(speed):
        return np.zeros(2)
    return velocity if speed <= max_speed else velocity * (max_speed / speed)


def limit_acceleration(
    previous_m_s: F64, wanted_m_s: F64, max_acceleration_m_s2: float, dt_s: float
) -> F64:
    """`wanted_m_s`, or as close to it from `previous_m_s` as `dt_s` allows."""
    if not _plausible(previous_m_s, wanted_m_s, (dt_s,)):
        return np.zeros(3)
    change = wanted_m_s - previous_m_s
    largest = max_acceleration_m_s2 * max(dt_s, 0.0)
    size = math.hypot(*change)
    return wanted_m_s if size <= largest else previous_m_s + change * (largest / size)


def hold_height(height_m: float, wanted_height_m: float, max_climb_m_s: float) -> float:
    """Climb rate, m/s, up positive, towards a height: K_p (wanted - height), K_p = 1 / s."""
    if not _plausible((height_m, wanted_height_m)):
        return 0.0
    climb_m_s = _HEIGHT_GAIN_PER_S * (wanted_height_m - height_m)
    return min(max(climb_m_s, -max_climb_m_s), max_climb_m_s)


def leash(target_m: F64, position_m: F64, length_m: float) -> F64 | None:
    """`target_m`, or the point towards it at `length_m` from the position.

    With this, a position setpoint does not make the vehicle dash when its estimate jumps. None for
    invalid inputs; then command a velocity of 0 instead.
    """
    if not _plausible(target_m, position_m):
        return None
    offset_m = target_m - position_m
    distance_m = math.hypot(*offset_m)
    return target_m if distance_m <= length_m else position_m + offset_m * (length_m / distance_m)


def stopping_m(speed_m_s: float, limits: MotionLimits) -> float:
    """Stopping distance from a speed of 0 or more, m: v lag + v^2 / 2a."""
    return speed_m_s * (limits.lag_s + speed_m_s / (2.0 * limits.max_acceleration_m_s2))


def approach_speed(distance_m: float, limits: MotionLimits) -> float:
    """The largest speed that allows a stop within `distance_m`; 0 if none."""
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

    `velocity_m_s` is the vehicle's estimate: during its lag it moves on, whatever the command. The
    velocity towards each edge is shortened, not the one along it. A vehicle that was carried
    outside comes back at half the maximum speed until it is half the buffer inside: pass the second
    result as `recovering` in the next call. Heights stop at floor and ceiling in the same way, and
    come back to them. Not for takeoff and landing, which pass through the floor.
    """
    if not _plausible(position_m, velocity_m_s, wanted_m_s):
        return np.zeros(3), recovering
    edges = fence.edges()
    distances_m = edges.distances_m(position_m[:2])
    depth_m = float(np.minimum.reduce(distances_m))
    recovering = depth_m < 0.0 or (recovering and depth_m < fence.buffer_m / 2.0)
    if recovering:
        # Gradient descent on the sum of squared shortfalls, which is convex: it ends inside, also
        # in corners.
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
    """Limit `wanted_m_s` so that the robot keeps its distance from others.

    `velocity_m_s` is the robot's own estimate. Neighbours are extrapolated at constant velocity.
    Robots cross in their height slots, so a neighbour at least `level_m` above or below has no
    effect, with two exceptions: one that climbs or descends through this height before the robot
    could leave its way, and one that a pilot flies at about this height.

    The robot may close half the slack to another one, which does the same, and all of it to a
    piloted one. It may always fly away. From a robot that is too near it must, by half of the
    missing distance: otherwise estimation errors would only ever reduce distances. A passing robot
    does not give way, so the robot leaves all of its way. Its distance is measured from the place
    where the vehicle comes to rest, so that the robot does not turn back beneath. Climbing is not
    limited. Giving way leads over no edge of `fence`; None for no fence.

    `silent` robots fell silent in flight, and may fly on, hover or come down. A robot below or
    level with one leaves its possible places as for a passing robot: the way from its last place to
    its extrapolated one.

    A neighbour with an unknown value stops the robot.
    """
    if not _plausible(position_m, velocity_m_s, wanted_m_s):
        return np.zeros(3)
    if not all(map(_is_known, (*neighbours, *silent))):
        return np.zeros(3)
    near = _near_robots(position_m, velocity_m_s, neighbours, silent, separation, limits)
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
    """Limit `wanted_m_s` of a robot that holds its place: like `brake`, with fewer neighbours.

    Neighbours with unknown values are ignored, as are silent ones, which may not hear this robot
    and expect it to stay. With `lands`, the robot may soon land here, as its neighbours may. It
    then parts from each of them, at any height, by `landed_m` horizontally. Each flies half.
    """
    known = [each for each in neighbours if _is_known(each)]
    if not lands:
        return brake(position_m, velocity_m_s, wanted_m_s, known, (), separation, limits, fence)
    near = _near_robots(position_m, velocity_m_s, known, (), separation, limits)
    for neighbour in known:
        offset_m = np.array(_extrapolated(neighbour)[:2]) - position_m[:2]
        apart_m = math.hypot(*offset_m)
        # In a crowd, leaving one robot leads towards another, which leaves in turn.
        at_most_m = max(apart_m - separation.level_m, 0.0) / 2.0
        slack_m = (apart_m - separation.landed_m) / 2.0
        near.append(_Near(offset_m, slack_m, max(slack_m, at_most_m), from_rest=False))
    return _kept_apart(near, position_m, velocity_m_s, wanted_m_s, limits, fence)


class _Near(NamedTuple):
    """A robot that limits this one: its offset (2,) from here, or from where the vehicle stops.

    `slack_m` may be flown towards it; below 0, away from it. `at_most_m`, 0 or more, bounds the way
    towards it while others must be left more urgently.
    """

    offset_m: F64
    slack_m: float
    at_most_m: float
    from_rest: bool


class _Way(NamedTuple):
    """Direction (2,) to a neighbour and the largest commanded speed, m/s; below 0, away from it.

    `at_most`, 0 or more, applies while others must be left more urgently.
    """

    direction: F64
    cap: float
    at_most: float


def _near_robots(
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
        highest_m = highest_possible_m(robot, separation.silence)
        if position_m[2] < highest_m + separation.passing_height_m:
            stopped_m = nearest_place_m(robot, separation.silence, rest_m)
            least_m = separation.landed_m + deviation_m(robot, separation.silence)
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
    """Limit `wanted_m_s` relative to all near robots."""
    if not all(each.offset_m.any() for each in near):
        return np.zeros(3)  # at the same place: any direction may be wrong
    ways = []
    for offset_m, slack_m, at_most_m, from_rest in near:
        direction = offset_m / math.hypot(*offset_m)
        speed_m_s = 0.0 if from_rest else float(direction @ velocity_m_s[:2])
        cap = _speed_to(slack_m, speed_m_s, limits)
        ways.append(_Way(direction, cap, _speed_to(at_most_m, speed_m_s, limits)))
    horizontal = wanted_m_s[:2]
    if all(float(way.direction @ horizontal) <= way.cap for way in ways):
        return wanted_m_s
    # The most urgent robot is applied last.
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
    """A robot that does not keep the distance `least_m` itself."""
    apart_m = math.hypot(*offset_m)
    slack_m = apart_m - least_m
    at_most_m = slack_m if slack_m >= 0.0 else max(apart_m - separation.level_m, 0.0)
    return _Near(offset_m, slack_m, at_most_m, from_rest)


def _passes(
    up_m: float, climb_m_s: float, separation: SeparationLimits, limits: MotionLimits
) -> bool:
    """Whether a robot `up_m` higher reaches this height before this robot has left its way."""
    if abs(climb_m_s) < _PASSING_M_S:
        return False
    to_leave_s = limits.lag_s + separation.passing_m / limits.max_speed_m_s
    lowest_m, highest_m = sorted((up_m, up_m + climb_m_s * to_leave_s))
    near_m = separation.passing_height_m
    return lowest_m < near_m and highest_m > -near_m


def _speed_to(slack_m: float, speed_m_s: float, limits: MotionLimits) -> float:
    """Commanded speed towards a line, or back if it is passed, at the present speed `speed_m_s`."""
    if slack_m >= 0.0:
        return _speed_towards(slack_m, speed_m_s, limits)
    return -_speed_towards(-slack_m, -speed_m_s, limits)


def _extrapolated(neighbour: Neighbour) -> Vector:
    """Present position, extrapolated at constant velocity."""
    (x_m, y_m, z_m), age_s = neighbour.position_m, neighbour.age_s
    x_m_s, y_m_s, z_m_s = neighbour.velocity_m_s
    return x_m + x_m_s * age_s, y_m + y_m_s * age_s, z_m + z_m_s * age_s


def _is_known(neighbour: Neighbour) -> bool:
    """Whether its numbers are plausible; False for NaN and infinity."""
    return math.hypot(*neighbour.position_m, *neighbour.velocity_m_s, neighbour.age_s) < _ABSURD


def _caps_at_edges(
    fence: Fence, position_m: F64, velocity_m_s: F64, limits: MotionLimits
) -> list[float]:
    """Largest commanded outward speed at each edge."""
    edges = fence.edges()
    slacks_m = edges.distances_m(position_m[:2]) - fence.buffer_m
    outward_m_s = -(edges.inward @ velocity_m_s[:2])
    return [
        _speed_towards(slack_m, speed_m_s, limits)
        for slack_m, speed_m_s in zip(slacks_m.tolist(), outward_m_s.tolist(), strict=True)
    ]


def _speed_towards(slack_m: float, speed_m_s: float, limits: MotionLimits) -> float:
    """Commanded speed towards a line `slack_m` away, at the present speed `speed_m_s`.

    `approach_speed` alone overshoots by a third of the way, since the vehicle follows a falling
    command late. The slack beyond the stopping distance shrinks no faster than by the commanded
    speed, and never below 0 if that uses up a small part of it.
    """
    left_m = slack_m - stopping_m(max(speed_m_s, 0.0), limits)
    return min(approach_speed(slack_m, limits), max(left_m, 0.0) / _SLACK_TIME_S)


def _limit_towards(velocity: F64, directions: Iterable[F64], caps: Sequence[float]) -> F64:
    """`velocity` (2,) with at most `caps`, 0 or more, along each of `directions` (2,)."""
    limited = velocity
    pairs = list(zip(directions, caps, strict=True))
    for direction, cap in pairs:
        limited = limited - direction * max(float(direction @ limited) - cap, 0.0)
    # With opposing directions, fixing one breaks another: shorten the whole vector.
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
