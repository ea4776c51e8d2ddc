"""Bounds of the drill: figures of a flight's record, with limits stated before the flight.

`always` gives the bounds that hold for every fault. All functions are pure.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, Protocol

import numpy as np

from edge.core import F64, Bools
from edge.core.fence import Fence
from edge.flight.margins import ErrorBudget
from lpac.analysis.flight import FlightRecord
from lpac.analysis.truth import TrueTrack
from lpac.sim.px4.errors import GREATEST_BIAS_M
from lpac.sim.px4.modes import PILOTED, Px4Mode

RobotGroup = Literal["hit", "next", "others", "all", "first half", "second half"]

_BUDGET = ErrorBudget()
# The greatest error of a simulated receiver, drift in wind, and half a drone.
POSITION_ERROR_M = GREATEST_BIAS_M + _BUDGET.wind_m + _BUDGET.drone_m / 2.0
# PX4 sends its mode once a second; the robot reacts a tick later.
PILOT_NOTICED_S = 1.1
# After rejoin, until PX4 reports that the pilot's mode has ended.
_REJOIN_S = 4.0
# A vehicle that holds its position in gusts of 8 m/s stays below this.
AT_REST_M_S = 0.5
# Landing distance to another robot, by both robots' estimates, which may differ by 6 m.
_LANDING_APART_M, _ESTIMATES_ERR_M = 8.0, 6.0
_NEAR_M = _LANDING_APART_M + _ESTIMATES_ERR_M
_STEP_S = 0.06
# Motors may start this long after the answer to a command.
_ARMED_AFTER_S = 1.0
# A fall from this height does no harm.
FALLS_M = 0.5
# PX4 descends at 1.5 m/s, and slower near its estimate of the ground.
TOUCHDOWN_M_S = 2.0
# A lower vehicle stands on the ground.
ON_GROUND_BELOW_M = 0.1

LANDING = (Px4Mode.LAND, Px4Mode.DESCEND)


class Figure(NamedTuple):
    """A measured value and its limit: `at_least` a lower limit, else an upper one."""

    name: str
    value: float
    limit: float
    unit: str
    at_least: bool = False

    @property
    def broken(self) -> bool:
        """Whether the value is beyond its limit, or unknown."""
        return not (self.value >= self.limit if self.at_least else self.value <= self.limit)

    @property
    def room(self) -> float:
        """Distance from the limit, as a share of the limit; below 0 beyond it.

        inf for a count that must be 0, and is.
        """
        if not self.unit and self.limit == 0.0 and not self.broken:
            return math.inf
        room = (self.value - self.limit) * (1.0 if self.at_least else -1.0)
        if not math.isfinite(self.value):
            return -math.inf if self.broken else math.inf
        return room / max(abs(self.limit), 1e-3)


class Criterion(Protocol):
    """A bound of a flight."""

    def figure(self, flight: FlightRecord) -> Figure:
        """Measure it in a flight."""
        ...


class Part(NamedTuple):
    """One vehicle's `track` in the time window of a bound, which counts from `since_s`."""

    flight: FlightRecord
    robot: int
    track: TrueTrack
    since_s: float

    def first_s(self, holds: Bools) -> float:
        """Time from `since_s` until the condition (T,) first holds; inf if it never does."""
        at_s = self.track.time_s[holds]
        return float(at_s[0]) - self.since_s if len(at_s) else math.inf

    @property
    def killed(self) -> bool:
        """Whether the operator kills the robot in this flight."""
        return bool(self.flight.fault.ordered("kill", self.robot))

    @property
    def lands(self) -> Bools:
        """(T,): whether the vehicle is landing or disarmed."""
        return self.track.is_in(*LANDING) | ~self.track.armed

    @property
    def flies_offboard(self) -> Bools:
        """(T,): whether PX4 follows setpoints."""
        return self.track.is_in(Px4Mode.OFFBOARD)

    @property
    def mission_setpoints_s(self) -> F64:
        """Arrival times of the velocity setpoints that PX4 followed."""
        at_s: F64 = self.track.setpoint_at_s[self.track.is_velocity & self.flies_offboard]
        return at_s

    @property
    def heights_m(self) -> F64:
        """(T,): height above the ground."""
        heights_m: F64 = self.track.position_m[:, 2]
        return heights_m


def robots_of(group: RobotGroup, hit: tuple[int, ...], count: int) -> tuple[int, ...]:
    """Robots of a group, where a fault hits some of that many robots."""
    everybody = tuple(range(count))
    half = (count + 1) // 2
    return {
        "hit": hit, "next": tuple((robot + 1) % count for robot in hit),
        "others": tuple(robot for robot in everybody if robot not in hit), "all": everybody,
        "first half": everybody[:half], "second half": everybody[half:],
    }[group]  # fmt: skip


@dataclass(frozen=True)
class Bound(ABC):
    """A bound on a group of vehicles, in a time window from the fault, or from the mark `after`.

    The figure is the worst vehicle's value: the greatest (`worst` is max) must be at most the
    limit, the least (min) at least; counts are summed (sum). `start` is the figure without any
    vehicle.
    """

    name: ClassVar[str]
    unit: ClassVar[str]
    worst: ClassVar[Callable[[Iterable[float]], float]]
    start: ClassVar[float]

    limit: float = 0
    robots: RobotGroup = "hit"
    from_s: float = 0.0
    until_s: float = math.inf
    after: str = ""

    def __init_subclass__(
        cls, name: str = "", unit: str = "", worst: Any = max, start: float | None = None
    ) -> None:
        cls.name, cls.unit, cls.worst = name, unit, worst
        cls.start = {max: 0.0, min: math.inf, sum: 0}[worst] if start is None else start

    def figure(self, flight: FlightRecord) -> Figure:
        """Measure the worst vehicle."""
        cls, fault = type(self), flight.fault
        since_s = fault.marks[self.after] if self.after else fault.begin_s
        values = [cls.start]
        for robot in robots_of(self.robots, fault.hit, len(flight.vehicles)):
            track = flight.vehicles[robot].between(since_s + self.from_s, since_s + self.until_s)
            values.append(self.measure(Part(flight, robot, track, since_s)))
        limit, at_least = self.limit_in(flight), cls.worst is min
        return Figure(self.figure_name, cls.worst(values), limit, self.unit, at_least)

    @property
    def figure_name(self) -> str:
        """Name of the figure."""
        return self.name

    def limit_in(self, flight: FlightRecord) -> float:
        """The limit in this flight; it may depend on the fleet."""
        return self.limit

    @abstractmethod
    def measure(self, part: Part) -> float:
        """Value of one vehicle."""


@dataclass(frozen=True)
class Always(Bound):
    """A bound on all vehicles in the whole flight."""

    robots: RobotGroup = "all"
    from_s: float = -math.inf


class Apart(Always, name="true separation", unit="m", worst=min):
    """No two vehicles touch in the air, and none comes down on a standing one."""

    def limit_in(self, flight: FlightRecord) -> float:
        return flight.fault.drone_m

    def measure(self, part: Part) -> float:
        others = part.flight.vehicles[part.robot + 1 :]
        return min([math.inf, *(_least_distance_m(part.track, other) for other in others)])


class AllKnown(Always, name="values that are not numbers", worst=sum):
    """The true track is known throughout: NaN would break no other bound."""

    def measure(self, part: Part) -> float:
        return sum(
            int((~np.isfinite(each)).sum())
            for each in (part.track.position_m, part.track.velocity_m_s)
        )


class InsideFence(Always, name="true fence margin", unit="m", worst=min):
    """Only a pilot flies further beyond the fence than position errors explain."""

    def measure(self, part: Part) -> float:
        edges, track = _fence(part.flight).edges(), part.track
        flown_m = track.position_m[_above(track) & track.armed & ~_piloted(track), :2]
        return min([math.inf, *(float(edges.distances_m(place_m).min()) for place_m in flown_m)])


class CarriedBeyond(InsideFence, name="true fence margin, carried robots", unit="m", worst=min):
    """The fault itself carries vehicles no further beyond the fence."""


class BelowCeiling(Always, name="greatest height", unit="m"):
    """Only a pilot flies higher than this above the fence's ceiling."""

    def limit_in(self, flight: FlightRecord) -> float:
        return _fence(flight).ceiling_m + self.limit

    def measure(self, part: Part) -> float:
        return float(np.where(_piloted(part.track), 0.0, part.heights_m).max(initial=0.0))


class NoUnorderedStart(Always, name="motors started without an order", worst=sum):
    """Motors start only on a fresh takeoff command to that robot, once for each command."""

    def measure(self, part: Part) -> float:
        orders = part.flight.fault.ordered("takeoff", part.robot)
        armed, unordered = part.track.armed, 0
        for at_s in part.track.time_s[1:][armed[1:] & ~armed[:-1]].tolist():
            obeyed = [o for o in orders if o.began_s <= at_s <= o.ended_s + _ARMED_AFTER_S]
            if obeyed:
                orders.remove(obeyed[0])
            else:
                unordered += 1
        return unordered


class NobodyFalls(Always, name="motors off at a height of", unit="m"):
    """No motor stops in the air, unless the operator kills the robot."""

    def measure(self, part: Part) -> float:
        if part.killed:
            return 0.0
        armed = part.track.armed
        return float(part.heights_m[1:][armed[:-1] & ~armed[1:]].max(initial=0.0))


class ComesDownGently(Always, name="touches the ground at", unit="m/s"):
    """No vehicle hits the ground, unless the operator kills the robot."""

    def measure(self, part: Part) -> float:
        if part.killed:
            return 0.0
        above = _above(part.track)
        touches = np.flatnonzero(above[:-1] & ~above[1:])
        return float(-part.track.velocity_m_s[touches, 2].min(initial=0.0))


class PilotIsAlone(Always, name="last setpoint to a pilot's vehicle", unit="s"):
    """A piloted vehicle gets no setpoints once the program can know of the pilot."""

    def measure(self, part: Part) -> float:
        latest_s, track = 0.0, part.track
        for begin_s, end_s in _spans_s(track, _piloted(track) & track.armed):
            sent_s = np.unique(track.between(begin_s, end_s).setpoint_at_s)
            sent_s = sent_s[(sent_s > begin_s) & (sent_s <= end_s)]
            for order in part.flight.fault.ordered("rejoin", part.robot):
                # The vehicle's clock is a step behind the command.
                sent_s = sent_s[
                    (sent_s < order.began_s - _STEP_S) | (sent_s > order.began_s + _REJOIN_S)
                ]
            if len(sent_s):
                latest_s = max(latest_s, float(sent_s.max()) - begin_s)
        return latest_s


class AllDown(Always, name="not down in the end", worst=sum):
    """All vehicles stand on the ground at the end, motors off."""

    def measure(self, part: Part) -> float:
        return bool(part.track.armed[-1] or _above(part.track)[-1])


@dataclass(frozen=True)
class FewCommands(Always):
    """No vehicle gets more commands within any `within_s`: PX4 loses answers in a burst.

    A real PX4 does not count them.
    """

    within_s: float = 1.0

    @property
    def figure_name(self) -> str:
        return f"commands within {self.within_s:g} s"

    def measure(self, part: Part) -> float:
        time_s, commands = part.track.time_s, part.track.commands
        before = np.searchsorted(time_s, time_s - self.within_s)
        return int((commands - commands[before]).max(initial=0))


def always(beyond_fence_m: float, carried: RobotGroup) -> tuple[Criterion, ...]:
    """Bounds of every flight; the fault itself may carry a group beyond the fence."""
    inside: tuple[Criterion, ...] = (InsideFence(-POSITION_ERROR_M),)
    if beyond_fence_m != POSITION_ERROR_M:
        others = (InsideFence(-POSITION_ERROR_M, "others"),) if carried == "hit" else ()
        inside = (*others, CarriedBeyond(-beyond_fence_m, carried))
    return (
        AllKnown(), Apart(), *inside, BelowCeiling(_BUDGET.height_m), NoUnorderedStart(),
        NobodyFalls(FALLS_M), ComesDownGently(TOUCHDOWN_M_S), PilotIsAlone(PILOT_NOTICED_S),
        AllDown(), FewCommands(20), FewCommands(60, within_s=10.0),
    )  # fmt: skip


class Lands(Bound, name="lands", unit="s"):
    """The vehicle begins to land in time, on command or on its own."""

    def measure(self, part: Part) -> float:
        return part.first_s(part.lands)


class NotLandedBefore(Bound, name="lands no sooner", unit="s", worst=min):
    """The vehicle does not land before the limit."""

    def measure(self, part: Part) -> float:
        return part.first_s(part.lands)


class Down(Bound, name="down", unit="s"):
    """The vehicle stands on the ground, motors off, in time."""

    def measure(self, part: Part) -> float:
        time_s, up = part.track.time_s, np.flatnonzero(part.track.armed | _above(part.track))
        if not len(up):
            return 0.0
        return float(time_s[up[-1]]) - part.since_s if up[-1] + 1 < len(time_s) else math.inf


@dataclass(frozen=True)
class Stands(Bound, name="speed at rest", unit="m/s"):
    """The vehicle holds its position, by its own estimate, which may wander.

    With `may_part` it may move away from a nearby vehicle.
    """

    limit: float = AT_REST_M_S
    may_part: bool = False

    def measure(self, part: Part) -> float:
        track = part.track
        moving = _above(track) & ~part.lands
        if self.may_part:
            moving &= _alone_m(part) > _NEAR_M
        speeds_m_s = np.hypot(*track.velocity_m_s[moving, :2].T) - track.velocity_error_m_s[moving]
        return float(speeds_m_s.max(initial=0.0))


class StaysNear(Bound, name="from where it held", unit="m"):
    """The vehicle stays near its position at the start of the window, in the plane."""

    def measure(self, part: Part) -> float:
        return _farthest_m(part.track.position_m)


class StraightDown(Bound, name="drift while it lands", unit="m"):
    """The vehicle comes down near the place where it began to land."""

    def measure(self, part: Part) -> float:
        landing_m = part.track.position_m[part.track.is_in(*LANDING)]
        return _farthest_m(landing_m) if len(landing_m) else math.inf


@dataclass(frozen=True)
class LandApart(Always, name="landed apart", unit="m", worst=min):
    """Landing vehicles avoid each other."""

    limit: float = _LANDING_APART_M - _ESTIMATES_ERR_M

    def measure(self, part: Part) -> float:
        vehicles = part.flight.vehicles
        robots = robots_of(self.robots, part.flight.fault.hit, len(vehicles))
        others = [vehicles[robot] for robot in robots if robot > part.robot]
        if not part.track.is_in(*LANDING).any():
            return math.inf
        place_m = part.track.position_m[-1, :2]
        landed = (other for other in others if other.is_in(*LANDING).any())
        return min([math.inf, *(math.dist(place_m, each.position_m[-1, :2]) for each in landed)])


class LandsAtPad(Bound, name="from its pad", unit="m"):
    """The vehicle lands near its own pad, or further off if a stray vehicle lies near it."""

    def measure(self, part: Part) -> float:
        pads_m = part.flight.fault.pads_m
        places_m = [vehicle.position_m[-1, :2] for vehicle in part.flight.vehicles]
        away_m = [math.dist(*each) for each in zip(places_m, pads_m, strict=False)]
        is_displaced = any(
            away > self.limit and math.dist(other_m, pads_m[part.robot]) < _NEAR_M
            for robot, (other_m, away) in enumerate(zip(places_m, away_m, strict=False))
            if robot != part.robot
        )
        return away_m[part.robot] - (_LANDING_APART_M if is_displaced else 0.0)


class FliesOn(Bound, name="share of the mission", worst=min, start=1.0):
    """The vehicle flies its mission for at least this share of the window."""

    def measure(self, part: Part) -> float:
        flown = part.flies_offboard & part.track.is_velocity & _above(part.track)
        return float(flown.mean()) if len(flown) else -math.inf


class ComesBack(Bound, name="flown beyond the fence", unit="s"):
    """The vehicle is back inside in time, up to position errors, or PX4 holds or lands it."""

    def measure(self, part: Part) -> float:
        edges, track, latest_s = _fence(part.flight).edges(), part.track, 0.0
        flown = _above(track) & ~part.lands & ~track.is_in(Px4Mode.HOLD)
        for at_s, place_m in zip(track.time_s[flown], track.position_m[flown, :2], strict=True):
            if edges.distances_m(place_m).min() < -POSITION_ERROR_M:
                latest_s = float(at_s) - part.since_s
        return latest_s


class Moves(Bound, name="flies at least", unit="m", worst=min):
    """The vehicle flies at least this distance, in the plane."""

    def measure(self, part: Part) -> float:
        return float(np.hypot(*np.diff(part.track.position_m[:, :2], axis=0).T).sum())


class Holds(Bound, name="PX4 holds", unit="s"):
    """PX4 holds the vehicle in time, as the watchdog asks."""

    def measure(self, part: Part) -> float:
        return part.first_s(part.track.is_in(Px4Mode.HOLD))


@dataclass(frozen=True)
class KeepsAway(Always, name="keeps away", unit="m", worst=min):
    """The next vehicle keeps at least this distance from the hit one, in the air."""

    robots: RobotGroup = "hit"

    def measure(self, part: Part) -> float:
        vehicles = part.flight.vehicles
        return _least_distance_m(part.track, vehicles[(part.robot + 1) % len(vehicles)])


class MissionEnds(Bound, name="last of the mission", unit="s"):
    """The last velocity setpoint of the window comes in time."""

    def measure(self, part: Part) -> float:
        return float(part.mission_setpoints_s.max(initial=part.since_s)) - part.since_s


@dataclass(frozen=True, kw_only=True)
class LeavesMission(Bound, name="leaves the mission", unit="s", start=-math.inf):
    """The last velocity setpoint comes in time once the vehicle has sunk by `below_m`."""

    below_m: float

    def measure(self, part: Part) -> float:
        low = np.flatnonzero(part.heights_m < part.heights_m[0] - self.below_m)
        ended_s = float(part.mission_setpoints_s.max(initial=part.since_s))
        return ended_s - float(part.track.time_s[low[0]]) if len(low) else math.inf


class FallsSilent(Bound, name="last setpoint", unit="s"):
    """The last setpoint of the window comes in time."""

    def measure(self, part: Part) -> float:
        return float(part.track.setpoint_at_s.max(initial=part.since_s)) - part.since_s


class SentNothing(Bound, name="setpoints after the lapse", worst=sum):
    """No setpoint comes in the window."""

    def measure(self, part: Part) -> float:
        at_s = np.unique(part.track.setpoint_at_s)
        begin_s, end_s = part.since_s + self.from_s, part.since_s + self.until_s
        return int(((at_s > begin_s) & (at_s < end_s)).sum())


class StaysDown(Bound, name="took off", worst=sum):
    """The motors never start."""

    def measure(self, part: Part) -> float:
        return bool(part.track.armed.any())


@dataclass(frozen=True)
class TakesOff(Bound, name="took off", worst=min):
    """The vehicle takes off after the fault."""

    limit: float = 1

    def measure(self, part: Part) -> float:
        return bool((part.track.armed & _above(part.track)).any())


class MotorsOff(Bound, name="motors off", unit="s"):
    """The motors stop in time, also in the air."""

    def measure(self, part: Part) -> float:
        return part.first_s(~part.track.armed)


class KeepsHeight(Bound, name="leaves its height", unit="m"):
    """In offboard flight the vehicle keeps its height at the start of the window."""

    def measure(self, part: Part) -> float:
        heights_m = part.heights_m[part.flies_offboard]
        return float(np.abs(heights_m - heights_m[:1]).max(initial=0.0))


class Climbs(Bound, name="climbs again", unit="m"):
    """The vehicle never climbs by more than this above its lowest height."""

    def measure(self, part: Part) -> float:
        climbed_m = part.heights_m - np.minimum.accumulate(part.heights_m)
        return float(climbed_m.max(initial=0.0))


class NotFaster(Bound, name="greatest speed", unit="m/s"):
    """In offboard flight the vehicle stays below this speed, in the plane."""

    def measure(self, part: Part) -> float:
        flown_m_s = part.track.velocity_m_s[part.flies_offboard & _above(part.track), :2]
        return float(np.hypot(*flown_m_s.T).max(initial=0.0))


def judge(bounds: Sequence[Criterion], flight: FlightRecord) -> tuple[Figure, ...]:
    """All figures of a flight."""
    return tuple(bound.figure(flight) for bound in bounds)


def _fence(flight: FlightRecord) -> Fence:
    assert flight.fence is not None
    return flight.fence


def _above(vehicle: TrueTrack) -> Bools:
    """(T,): whether the vehicle is off the ground, by its position alone."""
    above: Bools = vehicle.position_m[:, 2] > ON_GROUND_BELOW_M
    return above


def _piloted(vehicle: TrueTrack) -> Bools:
    """(T,): whether a pilot flies the vehicle."""
    return vehicle.is_in(*PILOTED)


def _farthest_m(places_m: F64) -> float:
    """Greatest distance from the first place, in the plane."""
    offsets_m = places_m[:, :2] - places_m[:1, :2]
    return float(np.hypot(*offsets_m.T).max(initial=0.0))


def _spans_s(vehicle: TrueTrack, holds: Bools) -> list[tuple[float, float]]:
    """Start and end times of the spans in which the condition holds."""
    steps = np.diff(np.concatenate([[False], holds, [False]]).astype(np.int8))
    begins, ends = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1) - 1
    times_s = vehicle.time_s
    return [(float(times_s[b]), float(times_s[e])) for b, e in zip(begins, ends, strict=True)]


def _alone_m(part: Part) -> F64:
    """(T,): distance to the nearest other vehicle, in the plane."""
    times_s, own_m = part.track.time_s, part.track.position_m[:, :2]
    away_m = [np.full(len(times_s), np.inf)]
    for robot, other in enumerate(part.flight.vehicles):
        if robot != part.robot:
            axes = [np.interp(times_s, other.time_s, other.position_m[:, axis]) for axis in (0, 1)]
            away_m.append(np.linalg.norm(np.stack(axes, axis=1) - own_m, axis=1))
    nearest_m: F64 = np.min(away_m, axis=0)
    return nearest_m


def _least_distance_m(one: TrueTrack, other: TrueTrack) -> float:
    """Least distance in 3-D while at least one of the two is in the air; inf if never."""
    times_s = one.time_s
    if len(times_s) == len(other.time_s) and np.abs(times_s - other.time_s).max(initial=0) < 1e-6:
        first_m, second_m, second_up = one.position_m, other.position_m, _above(other)
    else:
        first_s, last_s = max(times_s[0], other.time_s[0]), min(times_s[-1], other.time_s[-1])
        times_s = times_s[(times_s >= first_s) & (times_s <= last_s)]
        keep = np.searchsorted(one.time_s, times_s)
        first_m = one.position_m[keep]
        second_m = np.stack(
            [np.interp(times_s, other.time_s, other.position_m[:, a]) for a in range(3)], axis=1
        )
        second_up = _above(other)[np.searchsorted(other.time_s, times_s)]
        one = one.between(times_s[0], times_s[-1] + _STEP_S / 2.0)
    distances_m = np.linalg.norm(first_m - second_m, axis=1)
    up = _above(one)[: len(distances_m)] | second_up
    return float(distances_m[up].min(initial=math.inf))
