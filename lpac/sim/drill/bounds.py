"""Promises of the drill: figures of a flight's record, with limits stated beforehand.

`ALWAYS` counts in every flight, whatever is done to the fleet. Everything here is pure.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, NamedTuple, Protocol

import numpy as np

from edge.core import F64, Bools
from edge.core.fence import Fence
from edge.flight.margins import ErrorBudget
from lpac.analysis.flight import FlightRecord
from lpac.analysis.truth import TrueTrack
from lpac.sim.px4.errors import GREATEST_BIAS_M
from lpac.sim.px4.modes import PILOTED, Px4Mode

Whose = Literal["hit", "next", "others", "all", "first half", "second half"]

_BUDGET = ErrorBudget()
# What a simulated receiver errs by at worst, and how far wind carries half a drone.
POSITION_ERROR_M = GREATEST_BIAS_M + _BUDGET.wind_m + _BUDGET.drone_m / 2.0
# A mode is told once a second, and a tick later it is obeyed.
PILOT_NOTICED_S = 1.1
# The operator wants the vehicle's mode ended, which PX4 tells late.
_REJOIN_S = 4.0
# What holds its place in gusts of 8 m/s does not go faster.
AT_REST_M_S = 0.5
# Who lands beside another one lands so far away, by its own estimate and the other's, which may err
# by 6 m from each other.
_BESIDE_M, _ESTIMATES_ERR_M = 8.0, 6.0
_NEAR_M = _BESIDE_M + _ESTIMATES_ERR_M
_STEP_S = 0.06
# How long an operator's order may take to start a motor, once it is answered.
_ARMED_AFTER_S = 1.0
# From here a vehicle falls on its legs.
_FALLS_M = 0.5
# PX4 comes down at 1.5 m/s, and slower near what it takes to be the ground.
_TOUCHDOWN_M_S = 2.0

# A vehicle that is lower stands on the ground.
ON_GROUND_BELOW_M = 0.1

LANDING = (Px4Mode.LAND, Px4Mode.DESCEND)


class Figure(NamedTuple):
    """Something measured: it must be `at_least` the limit, or else at most that."""

    name: str
    value: float
    limit: float
    unit: str
    at_least: bool = False

    @property
    def broken(self) -> bool:
        """Whether it is beyond its limit, or not known."""
        return not (self.value >= self.limit if self.at_least else self.value <= self.limit)

    @property
    def room(self) -> float:
        """How far it is from its limit, as a share of that; below 0 if it is beyond.

        What must not happen at all, and did not, is not near.
        """
        if not self.unit and self.limit == 0.0 and not self.broken:
            return math.inf
        room = (self.value - self.limit) * (1.0 if self.at_least else -1.0)
        if not math.isfinite(self.value):
            return -math.inf if self.broken else math.inf
        return room / max(abs(self.limit), 1e-3)


class Criterion(Protocol):
    """One promise."""

    def figure(self, flight: FlightRecord) -> Figure:
        """Measure it in this flight."""
        ...


# In every flight


@dataclass(frozen=True, slots=True)
class Apart:
    """No two vehicles touch in the air, and nobody comes down on one that stands."""

    def figure(self, flight: FlightRecord) -> Figure:
        least_m = math.inf
        for one, other in combinations(flight.vehicles, 2):
            distance_m = _distances_m(one, other)
            if len(distance_m):
                least_m = min(least_m, float(distance_m.min()))
        return Figure("true separation", least_m, flight.fault.drone_m, "m", at_least=True)


@dataclass(frozen=True, slots=True)
class AllKnown:
    """The truth is known at all times: nothing that is not a number would break another promise."""

    def figure(self, flight: FlightRecord) -> Figure:
        unknown = sum(
            int((~np.isfinite(each)).sum())
            for vehicle in flight.vehicles
            for each in (vehicle.position_m, vehicle.velocity_m_s)
        )
        return Figure("what is not a number", unknown, 0, "")


@dataclass(frozen=True, slots=True)
class InsideFence:
    """Nobody but a pilot goes further beyond the fence's line than position errors explain.

    A fault may carry `whose` further.
    """

    beyond_m: float = POSITION_ERROR_M
    whose: Whose = "all"

    def figure(self, flight: FlightRecord) -> Figure:
        edges, margins_m = _fence(flight).edges(), [math.inf]
        for vehicle in _of(flight, self.whose):
            flown_m = vehicle.position_m[_above(vehicle) & vehicle.armed & ~_piloted(vehicle)]
            margins_m += [float(edges.distances_m(place_m).min()) for place_m in flown_m[:, :2]]
        of = " of who is carried" if self.beyond_m != POSITION_ERROR_M else ""
        return Figure(f"true fence margin{of}", min(margins_m), -self.beyond_m, "m", at_least=True)


@dataclass(frozen=True, slots=True)
class BelowCeiling:
    """Nobody but a pilot flies higher above the fence's ceiling than stated."""

    above_m: float = _BUDGET.height_m

    def figure(self, flight: FlightRecord) -> Figure:
        highest_m = max(
            float(np.where(_piloted(v), 0.0, v.position_m[:, 2]).max(initial=0.0))
            for v in flight.vehicles
        )
        limit_m = _fence(flight).ceiling_m + self.above_m
        return Figure("greatest height", highest_m, limit_m, "m")


@dataclass(frozen=True, slots=True)
class NoUnorderedStart:
    """No motor starts but on a takeoff order just given to that robot, and on each only once."""

    def figure(self, flight: FlightRecord) -> Figure:
        unordered = 0
        for robot, vehicle in enumerate(flight.vehicles):
            orders = flight.fault.ordered("takeoff", robot)
            for at_s in _rises_s(vehicle):
                obeyed = [o for o in orders if o.began_s <= at_s <= o.ended_s + _ARMED_AFTER_S]
                if obeyed:
                    orders.remove(obeyed[0])
                else:
                    unordered += 1
        return Figure("motors started without an order", unordered, 0, "")


@dataclass(frozen=True, slots=True)
class NobodyFalls:
    """No motor stops in the air, unless the operator kills that robot."""

    def figure(self, flight: FlightRecord) -> Figure:
        highest_m = 0.0
        for vehicle in _unkilled(flight):
            stops = np.flatnonzero(vehicle.armed[:-1] & ~vehicle.armed[1:]) + 1
            highest_m = max(highest_m, float(vehicle.position_m[stops, 2].max(initial=0.0)))
        return Figure("motors off at a height of", highest_m, _FALLS_M, "m")


@dataclass(frozen=True, slots=True)
class ComesDownGently:
    """Nobody hits the ground, unless the operator kills that robot."""

    def figure(self, flight: FlightRecord) -> Figure:
        fastest_m_s = 0.0
        for vehicle in _unkilled(flight):
            touches = np.flatnonzero(_above(vehicle)[:-1] & ~_above(vehicle)[1:])
            fastest_m_s = max(
                fastest_m_s, float(-vehicle.velocity_m_s[touches, 2].min(initial=0.0))
            )
        return Figure("touches the ground at", fastest_m_s, _TOUCHDOWN_M_S, "m/s")


@dataclass(frozen=True, slots=True)
class PilotIsAlone:
    """A vehicle that a pilot flies is sent nothing, once that can be known."""

    def figure(self, flight: FlightRecord) -> Figure:
        latest_s = 0.0
        for robot, vehicle in enumerate(flight.vehicles):
            rejoined_s = [order.began_s for order in flight.fault.ordered("rejoin", robot)]
            for begin_s, end_s in _spans_s(vehicle, _piloted(vehicle) & vehicle.armed):
                sent_s = np.unique(vehicle.between(begin_s, end_s).setpoint_at_s)
                sent_s = sent_s[(sent_s > begin_s) & (sent_s <= end_s)]
                for at_s in rejoined_s:
                    # A vehicle's clock is a step behind what is done in between.
                    sent_s = sent_s[(sent_s < at_s - _STEP_S) | (sent_s > at_s + _REJOIN_S)]
                if len(sent_s):
                    latest_s = max(latest_s, float(sent_s.max()) - begin_s)
        return Figure("last setpoint to a pilot's vehicle", latest_s, PILOT_NOTICED_S, "s")


@dataclass(frozen=True, slots=True)
class AllDown:
    """In the end all stand on the ground, with their motors off."""

    def figure(self, flight: FlightRecord) -> Figure:
        up = sum(bool(v.armed[-1] or _above(v)[-1]) for v in flight.vehicles)
        return Figure("not down in the end", up, 0, "")


@dataclass(frozen=True, slots=True)
class FewCommands:
    """No vehicle is sent more commands within any time so long: PX4 loses answers in a burst.

    A real PX4 does not tell how many it is sent.
    """

    within_s: float
    most: int

    def figure(self, flight: FlightRecord) -> Figure:
        most = 0
        for vehicle in flight.vehicles:
            before = np.searchsorted(vehicle.time_s, vehicle.time_s - self.within_s)
            most = max(most, int((vehicle.commands - vehicle.commands[before]).max(initial=0)))
        return Figure(f"commands within {self.within_s:g} s", most, self.most, "")


def always(beyond_fence_m: float, carried: Whose) -> tuple[Criterion, ...]:
    """Bounds of every flight; a fault may itself bring the `carried` so far outside."""
    inside: tuple[Criterion, ...] = (InsideFence(),)
    if beyond_fence_m != POSITION_ERROR_M:
        inside = (InsideFence(beyond_fence_m, carried),)
        if carried == "hit":
            inside = (InsideFence(whose="others"), *inside)
    return (
        AllKnown(), Apart(), *inside, BelowCeiling(), NoUnorderedStart(), NobodyFalls(),
        ComesDownGently(), PilotIsAlone(), AllDown(), FewCommands(1.0, 20), FewCommands(10.0, 60),
    )  # fmt: skip


# Of one fault; times count from it, or from a mark


@dataclass(frozen=True, slots=True)
class Lands:
    """The vehicle is told to land, or lands by itself, in time, and not sooner than stated."""

    within_s: float
    whose: Whose = "hit"
    after: str = ""

    def figure(self, flight: FlightRecord) -> Figure:
        since_s = _since_s(flight, self.after)
        delays_s = []
        for vehicle in _of(flight, self.whose):
            later = vehicle.between(since_s, math.inf)
            at_s = later.time_s[later.is_in(*LANDING) | ~later.armed]
            delays_s.append(float(at_s[0]) - since_s if len(at_s) else math.inf)
        return Figure("lands", max(delays_s), self.within_s, "s")


@dataclass(frozen=True, slots=True)
class NotLandedBefore:
    """It does not land, or return, sooner than that."""

    before_s: float
    whose: Whose = "hit"

    def figure(self, flight: FlightRecord) -> Figure:
        delays_s = []
        for later in _parts(flight, self.whose):
            at_s = later.time_s[later.is_in(*LANDING) | ~later.armed]
            delays_s.append(float(at_s[0]) - flight.fault.begin_s if len(at_s) else math.inf)
        return Figure("lands no sooner", min(delays_s), self.before_s, "s", at_least=True)


@dataclass(frozen=True, slots=True)
class Down:
    """It stands on the ground, motors off, in time."""

    within_s: float
    whose: Whose = "hit"

    def figure(self, flight: FlightRecord) -> Figure:
        latest_s = 0.0
        for later in _parts(flight, self.whose):
            up = np.flatnonzero(later.armed | _above(later))
            down = not len(up) or up[-1] + 1 < len(later.time_s)
            at_s = float(later.time_s[up[-1]]) if len(up) else flight.fault.begin_s
            latest_s = max(latest_s, at_s - flight.fault.begin_s if down else math.inf)
        return Figure("down", latest_s, self.within_s, "s")


@dataclass(frozen=True, slots=True)
class Stands:
    """From then on, and until then, it is not faster than what holds its place in wind.

    That is, by its own estimate, which nobody tells that it wanders. Who `may_part` may leave
    somebody who is near.
    """

    from_s: float
    until_s: float
    whose: Whose = "hit"
    speed_m_s: float = AT_REST_M_S
    after: str = ""
    may_part: bool = False

    def figure(self, flight: FlightRecord) -> Figure:
        since_s, fastest_m_s = _since_s(flight, self.after), 0.0
        for vehicle in _of(flight, self.whose):
            part = vehicle.between(since_s + self.from_s, since_s + self.until_s)
            moving = _above(part) & part.armed & ~part.is_in(*LANDING)
            if self.may_part:
                moving &= _alone_m(flight, vehicle, part.time_s) > _NEAR_M
            speeds_m_s = np.hypot(*part.velocity_m_s[moving, :2].T)
            speeds_m_s -= part.velocity_error_m_s[moving]
            fastest_m_s = max(fastest_m_s, float(speeds_m_s.max(initial=0.0)))
        return Figure("speed at rest", fastest_m_s, self.speed_m_s, "m/s")


@dataclass(frozen=True, slots=True)
class StaysNear:
    """From then on, and until then, it stays that near to where it was, in the plane."""

    from_s: float
    until_s: float
    within_m: float
    whose: Whose = "hit"
    after: str = ""

    def figure(self, flight: FlightRecord) -> Figure:
        since_s, farthest_m = _since_s(flight, self.after), 0.0
        for vehicle in _of(flight, self.whose):
            part = vehicle.between(since_s + self.from_s, since_s + self.until_s)
            if len(part.time_s):
                offsets_m = part.position_m[:, :2] - part.position_m[0, :2]
                farthest_m = max(farthest_m, float(np.hypot(*offsets_m.T).max()))
        return Figure("from where it held", farthest_m, self.within_m, "m")


@dataclass(frozen=True, slots=True)
class StraightDown:
    """From where it began to land it comes down within so many metres."""

    within_m: float
    whose: Whose = "hit"

    def figure(self, flight: FlightRecord) -> Figure:
        farthest_m = 0.0
        for later in _parts(flight, self.whose):
            landing = later.position_m[later.is_in(*LANDING)]
            if len(landing):
                offset_m = landing[:, :2] - landing[0, :2]
                farthest_m = max(farthest_m, float(np.hypot(*offset_m.T).max()))
            else:
                farthest_m = math.inf
        return Figure("drift while it lands", farthest_m, self.within_m, "m")


@dataclass(frozen=True, slots=True)
class LandApart:
    """They come down as far from each other as robots that looked."""

    whose: Whose = "all"

    def figure(self, flight: FlightRecord) -> Figure:
        landed = [v for v in _of(flight, self.whose) if v.is_in(*LANDING).any()]
        least_m = min(
            (
                math.dist(one.position_m[-1, :2], other.position_m[-1, :2])
                for one, other in combinations(landed, 2)
            ),
            default=math.inf,
        )
        return Figure("landed apart", least_m, _BESIDE_M - _ESTIMATES_ERR_M, "m", at_least=True)


@dataclass(frozen=True, slots=True)
class LandsAtPad:
    """It lands within so many metres of the pad it stood on.

    Where somebody lies near that came down elsewhere than on its own, it may land beside.
    """

    within_m: float
    whose: Whose = "hit"

    def figure(self, flight: FlightRecord) -> Figure:
        farthest_m = 0.0
        places_m = [vehicle.position_m[-1, :2] for vehicle in flight.vehicles]
        strays_m = [
            place_m
            for place_m, pad_m in zip(places_m, flight.fault.pads_m, strict=False)
            if math.dist(place_m, pad_m) > self.within_m
        ]
        for robot in _robots(flight, self.whose):
            place_m, pad_m = places_m[robot], flight.fault.pads_m[robot]
            away_m = math.dist(place_m, pad_m)
            is_beside = any(
                place_m is not stray_m and math.dist(stray_m, pad_m) < _NEAR_M
                for stray_m in strays_m
            )
            farthest_m = max(farthest_m, away_m - _BESIDE_M if is_beside else away_m)
        return Figure("from its pad", farthest_m, self.within_m, "m")


@dataclass(frozen=True, slots=True)
class FliesOn:
    """It flies its mission for at least that share of the time."""

    until_s: float
    share: float = 0.9
    whose: Whose = "others"
    from_s: float = 0.0
    after: str = ""

    def figure(self, flight: FlightRecord) -> Figure:
        since_s, shares = _since_s(flight, self.after), [1.0]
        for vehicle in _of(flight, self.whose):
            part = vehicle.between(since_s + self.from_s, since_s + self.until_s)
            flown = part.is_in(Px4Mode.OFFBOARD) & part.is_velocity & _above(part)
            shares.append(float(flown.mean()) if len(flown) else -math.inf)
        least = min(shares)
        return Figure("share of the mission", least, self.share, "", at_least=True)


@dataclass(frozen=True, slots=True)
class ComesBack:
    """Once so much time has passed, it is back inside, or PX4 holds or lands it.

    Inside as far as position errors explain.
    """

    within_s: float
    whose: Whose = "hit"

    def figure(self, flight: FlightRecord) -> Figure:
        edges, latest_s = _fence(flight).edges(), 0.0
        for part in _parts(flight, self.whose):
            flown = _above(part) & part.armed & ~part.is_in(Px4Mode.HOLD, *LANDING)
            for at_s, place_m in zip(part.time_s[flown], part.position_m[flown, :2], strict=True):
                if edges.distances_m(place_m).min() < -POSITION_ERROR_M:
                    latest_s = max(latest_s, float(at_s) - flight.fault.begin_s)
        return Figure("flown beyond the fence", latest_s, self.within_s, "s")


@dataclass(frozen=True, slots=True)
class Moves:
    """In its mission it gets about: the way that it flies, in the plane."""

    least_m: float
    until_s: float
    whose: Whose = "all"

    def figure(self, flight: FlightRecord) -> Figure:
        ways_m = [
            float(np.hypot(*np.diff(part.position_m[:, :2], axis=0).T).sum())
            for part in _parts(flight, self.whose, until_s=self.until_s)
        ]
        return Figure("flies at least", min(ways_m), self.least_m, "m", at_least=True)


@dataclass(frozen=True, slots=True)
class Holds:
    """PX4 holds it in time, as the watchdog asks."""

    within_s: float
    whose: Whose = "hit"

    def figure(self, flight: FlightRecord) -> Figure:
        delays_s = []
        for later in _parts(flight, self.whose):
            at_s = later.time_s[later.is_in(Px4Mode.HOLD)]
            delays_s.append(float(at_s[0]) - flight.fault.begin_s if len(at_s) else math.inf)
        return Figure("PX4 holds", max(delays_s), self.within_s, "s")


@dataclass(frozen=True, slots=True)
class KeepsAway:
    """The one that it was not done to, but whom it concerns, stays so far away, in the air."""

    least_m: float

    def figure(self, flight: FlightRecord) -> Figure:
        least_m = math.inf
        for robot, following in zip(flight.fault.hit, _robots(flight, "next"), strict=True):
            one, other = flight.vehicles[robot], flight.vehicles[following]
            least_m = min(least_m, float(_distances_m(one, other).min(initial=math.inf)))
        return Figure("keeps away", least_m, self.least_m, "m", at_least=True)


@dataclass(frozen=True, slots=True)
class MissionEnds:
    """The last velocity setpoint comes in time; until then nothing like it comes again."""

    within_s: float
    until_s: float = math.inf
    whose: Whose = "hit"
    after: str = ""

    def figure(self, flight: FlightRecord) -> Figure:
        since_s, latest_s = _since_s(flight, self.after), 0.0
        for vehicle in _of(flight, self.whose):
            part = vehicle.between(since_s, since_s + self.until_s)
            flown = part.setpoint_at_s[part.is_velocity & part.is_in(Px4Mode.OFFBOARD)]
            latest_s = max(latest_s, float(flown.max(initial=since_s)) - since_s)
        return Figure("last of the mission", latest_s, self.within_s, "s")


@dataclass(frozen=True, slots=True)
class LeavesMission:
    """So long after it was so far below its height, the last velocity setpoint has come."""

    below_m: float
    within_s: float
    whose: Whose = "hit"

    def figure(self, flight: FlightRecord) -> Figure:
        latest_s = -math.inf
        for part in _parts(flight, self.whose):
            height_m = part.position_m[:, 2]
            low = np.flatnonzero(height_m < height_m[0] - self.below_m)
            flown = part.setpoint_at_s[part.is_velocity & part.is_in(Px4Mode.OFFBOARD)]
            ended_s = float(flown.max(initial=flight.fault.begin_s))
            latest_s = max(latest_s, ended_s - float(part.time_s[low[0]]) if len(low) else math.inf)
        return Figure("leaves the mission", latest_s, self.within_s, "s")


@dataclass(frozen=True, slots=True)
class FallsSilent:
    """Nothing is sent to the vehicle any more."""

    within_s: float
    until_s: float = math.inf
    whose: Whose = "hit"

    def figure(self, flight: FlightRecord) -> Figure:
        latest_s = 0.0
        for part in _parts(flight, self.whose, until_s=self.until_s):
            sent_s = float(part.setpoint_at_s.max(initial=flight.fault.begin_s))
            latest_s = max(latest_s, sent_s - flight.fault.begin_s)
        return Figure("last setpoint", latest_s, self.within_s, "s")


@dataclass(frozen=True, slots=True)
class SentNothing:
    """No setpoint comes from then on, and until then."""

    from_s: float
    until_s: float
    whose: Whose = "hit"

    def figure(self, flight: FlightRecord) -> Figure:
        """How many came."""
        begin_s, end_s = flight.fault.begin_s + self.from_s, flight.fault.begin_s + self.until_s
        sent = 0
        for vehicle in _of(flight, self.whose):
            at_s = np.unique(vehicle.between(begin_s, end_s).setpoint_at_s)
            sent += int(((at_s > begin_s) & (at_s < end_s)).sum())
        return Figure("setpoints after the lapse", sent, 0, "")


@dataclass(frozen=True, slots=True)
class StaysDown:
    """Its motors never start."""

    whose: Whose = "hit"

    def figure(self, flight: FlightRecord) -> Figure:
        started = sum(
            bool(v.between(flight.fault.begin_s, math.inf).armed.any())
            for v in _of(flight, self.whose)
        )
        return Figure("took off", started, 0, "")


@dataclass(frozen=True, slots=True)
class TakesOff:
    """It flies, somewhen after the fault."""

    whose: Whose = "all"

    def figure(self, flight: FlightRecord) -> Figure:
        flew = min(
            bool((v.armed & _above(v))[v.time_s > flight.fault.begin_s].any())
            for v in _of(flight, self.whose)
        )
        return Figure("took off", flew, 1, "", at_least=True)


@dataclass(frozen=True, slots=True)
class MotorsOff:
    """They stop in time, also in the air."""

    within_s: float
    whose: Whose = "hit"

    def figure(self, flight: FlightRecord) -> Figure:
        latest_s = 0.0
        for later in _parts(flight, self.whose):
            off_s = later.time_s[~later.armed]
            latest_s = max(
                latest_s, float(off_s[0]) - flight.fault.begin_s if len(off_s) else math.inf
            )
        return Figure("motors off", latest_s, self.within_s, "s")


@dataclass(frozen=True, slots=True)
class KeepsHeight:
    """As long as it flies offboard it is not further from its height at the fault than that."""

    within_m: float
    until_s: float
    whose: Whose = "hit"

    def figure(self, flight: FlightRecord) -> Figure:
        farthest_m = 0.0
        for part in _parts(flight, self.whose, until_s=self.until_s):
            heights_m = part.position_m[part.is_in(Px4Mode.OFFBOARD), 2]
            if len(heights_m):
                farthest_m = max(farthest_m, float(np.abs(heights_m - heights_m[0]).max()))
        return Figure("leaves its height", farthest_m, self.within_m, "m")


@dataclass(frozen=True, slots=True)
class Climbs:
    """Wherever it has got to, it climbs no further than that again."""

    at_most_m: float
    whose: Whose = "hit"

    def figure(self, flight: FlightRecord) -> Figure:
        farthest_m = 0.0
        for part in _parts(flight, self.whose):
            heights_m = part.position_m[:, 2]
            climbed_m = heights_m - np.minimum.accumulate(heights_m)
            farthest_m = max(farthest_m, float(climbed_m.max(initial=0.0)))
        return Figure("climbs again", farthest_m, self.at_most_m, "m")


@dataclass(frozen=True, slots=True)
class NotFaster:
    """As long as it flies offboard, no dash: it stays below that speed, in the plane."""

    speed_m_s: float
    until_s: float
    whose: Whose = "hit"

    def figure(self, flight: FlightRecord) -> Figure:
        fastest_m_s = 0.0
        for part in _parts(flight, self.whose, until_s=self.until_s):
            flown = part.velocity_m_s[part.is_in(Px4Mode.OFFBOARD) & _above(part), :2]
            fastest_m_s = max(fastest_m_s, float(np.hypot(*flown.T).max(initial=0.0)))
        return Figure("greatest speed", fastest_m_s, self.speed_m_s, "m/s")


def judge(bounds: Sequence[Criterion], flight: FlightRecord) -> tuple[Figure, ...]:
    """All figures, those of every flight and the fault's own."""
    return tuple(bound.figure(flight) for bound in bounds)


def _robots(flight: FlightRecord, whose: Whose) -> tuple[int, ...]:
    everybody = tuple(range(len(flight.vehicles)))
    following = tuple((robot + 1) % len(everybody) for robot in flight.fault.hit)
    others = tuple(robot for robot in everybody if robot not in flight.fault.hit)
    half = (len(everybody) + 1) // 2
    return {
        "hit": flight.fault.hit, "next": following, "others": others, "all": everybody,
        "first half": everybody[:half], "second half": everybody[half:],
    }[whose]  # fmt: skip


def _fence(flight: FlightRecord) -> Fence:
    assert flight.fence is not None
    return flight.fence


def _parts(flight: FlightRecord, whose: Whose, *, until_s: float = math.inf) -> Iterator[TrueTrack]:
    """Of each of them what it did from the fault on, and until then."""
    begin_s = flight.fault.begin_s
    return (vehicle.between(begin_s, begin_s + until_s) for vehicle in _of(flight, whose))


def _above(vehicle: TrueTrack) -> Bools:
    """(T,): whether it is off the ground, by its place alone."""
    above: Bools = vehicle.position_m[:, 2] > ON_GROUND_BELOW_M
    return above


def _piloted(vehicle: TrueTrack) -> Bools:
    """(T,): whether somebody flies it by hand."""
    return vehicle.is_in(*PILOTED)


def _of(flight: FlightRecord, whose: Whose) -> Iterator[TrueTrack]:
    return (flight.vehicles[robot] for robot in _robots(flight, whose))


def _unkilled(flight: FlightRecord) -> Iterator[TrueTrack]:
    return (
        vehicle
        for robot, vehicle in enumerate(flight.vehicles)
        if not flight.fault.ordered("kill", robot)
    )


def _since_s(flight: FlightRecord, mark: str) -> float:
    return flight.fault.marks[mark] if mark else flight.fault.begin_s


def _rises_s(vehicle: TrueTrack) -> list[float]:
    rises = np.flatnonzero(vehicle.armed[1:] & ~vehicle.armed[:-1]) + 1
    starts: list[float] = vehicle.time_s[rises].tolist()
    return starts


def _spans_s(vehicle: TrueTrack, holds: Bools) -> list[tuple[float, float]]:
    """From when to when something holds."""
    steps = np.diff(np.concatenate([[False], holds, [False]]).astype(np.int8))
    begins, ends = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1) - 1
    times_s = vehicle.time_s
    return [(float(times_s[b]), float(times_s[e])) for b, e in zip(begins, ends, strict=True)]


def _alone_m(flight: FlightRecord, vehicle: TrueTrack, times_s: F64) -> F64:
    """(T,): how far the nearest other vehicle is at each time, in the plane."""

    def place_m(of: TrueTrack) -> F64:
        axes = [np.interp(times_s, of.time_s, of.position_m[:, axis]) for axis in range(2)]
        return np.stack(axes, axis=1)

    own_m = place_m(vehicle)
    away_m = [
        np.linalg.norm(place_m(other) - own_m, axis=1)
        for other in flight.vehicles
        if other is not vehicle
    ]
    nearest_m: F64 = np.min([np.full(len(times_s), np.inf), *away_m], axis=0)
    return nearest_m


def _distances_m(one: TrueTrack, other: TrueTrack) -> F64:
    """3-D, at all times when at least one of the two is in the air."""
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
    distances_m: F64 = np.linalg.norm(first_m - second_m, axis=1)
    return distances_m[(_above(one)[: len(distances_m)]) | second_up]
