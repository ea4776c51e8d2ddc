"""Rates and asynchrony: what the paper argues, and does not measure.

Its modules run each at a rate of their own, and it argues both for an exchange of messages that is
slower than perception, and for a faster one. Here one policy, as it is trained, flies over the same
worlds

- with each of several rates of perception beside each of several rates of the policy, which is that
  of the exchange: every robot at its own moments, or all at the same ones;
- with the rates of the field, and messages that are late.

With all robots at the same moments messages cross one hop from one moment to the next, as they do
in the synchronous graph neural network, and what a robot says is never older than a period.

The missions of a field day's logs are held against each other by the rates that they were flown at.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from edge.core import F64
from lpac.analysis.flight import FlightRecord
from lpac.analysis.statistics import (
    Interval95,
    bootstrap,
    mean_over_time,
    paired_bootstrap,
    ratio_of_means,
)
from lpac.evaluate.evaluation import TrainedBundle
from lpac.evaluate.flights import (
    IN_REAL_TIME,
    POLICY,
    EvaluationFlight,
    FlownCost,
    RobotModel,
)
from lpac.evaluate.worlds import WorldSet
from lpac.sim.ticks import Clocks

# What is said of a flight: its cost at these times, s.
TIMES_S = (15.0, 30.0, 60.0)
# Whatever the rates are, messages, images and actions count for two periods at least, or a policy
# at half a hertz would stand still every other second.
_PERIODS = 2.0
_FIELD_AGE_S, _FIELD_INPUT_AGE_S = 0.8, 1.0


class Timing(NamedTuple):
    """When robots perceive, and decide and speak; and how late what they say is, on average."""

    perception_hz: float
    policy_hz: float
    synchronous: bool = False
    delay_s: float = 0.0

    @property
    def clocks(self) -> Clocks:
        """Control is the field's."""
        return Clocks(
            perception_s=1.0 / self.perception_hz,
            policy_s=1.0 / self.policy_hz,
            synchronous=self.synchronous,
        )

    @property
    def rounds(self) -> float:
        """How often messages are exchanged for each perception."""
        return self.policy_hz / self.perception_hz


FIELD = Timing(5.0, 2.5)


class Flown(NamedTuple):
    """What flew, and over what: the first `worlds` of a set, or so many missions of logs.

    `message_bytes` is the most that a robot says at a time.
    """

    bundle_id: str
    message_bytes: int
    robot: RobotModel | Literal["logs"]
    world_set: WorldSet | None
    worlds: int

    def said_kb_s(self, policy_hz: float) -> float:
        """What a robot says at most in a second, kB."""
        return policy_hz * self.message_bytes / 1000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class AsynchronyPlan:
    """The timings, and the first `worlds` worlds of a set, over which all of them are flown.

    `message_bytes` is the most that a robot says at a time. Whole robots (`robot`) are never all at
    the same moments, and in real time nothing is late but by its radio. `px4_build` is where real
    PX4s are from.
    """

    bundle: TrainedBundle
    message_bytes: int
    world_set: WorldSet
    worlds: int
    perception_hz: tuple[float, ...] = (1.0, 2.5, 5.0, 10.0)
    policy_hz: tuple[float, ...] = (0.5, 1.0, 2.5, 5.0, 10.0)
    delays_s: tuple[float, ...] = (0.0, 0.2, 0.4, 0.8, 1.6)
    robot: RobotModel = "point"
    px4_build: str = ""

    def __post_init__(self) -> None:
        if self.worlds < 1:
            raise ValueError(f"worlds = {self.worlds}: must be at least 1")

    @property
    def flown(self) -> Flown:
        """For the report."""
        return Flown(
            self.bundle.bundle_id, self.message_bytes, self.robot, self.world_set, self.worlds
        )

    @property
    def timings(self) -> list[Timing]:
        """Each once, the field's first."""
        rates = [
            Timing(perception_hz, policy_hz, synchronous)
            for synchronous in ((False, True) if self.robot == "point" else (False,))
            for perception_hz in self.perception_hz
            for policy_hz in self.policy_hz
        ]
        delays_s = () if self.robot in IN_REAL_TIME else self.delays_s
        late = [FIELD._replace(delay_s=delay_s) for delay_s in delays_s]
        return list(dict.fromkeys([FIELD, *rates, *late]))

    def flights_of(self, timing: Timing) -> list[EvaluationFlight]:
        """One over each world."""
        clocks = timing.clocks
        slowest_s = max(clocks.perception_s, clocks.policy_s)
        # A message travels one and a half times the mean delay at most.
        age_s = max(_FIELD_AGE_S, _PERIODS * clocks.policy_s) + 1.5 * timing.delay_s
        return [
            EvaluationFlight(
                flier=POLICY,
                bundle=self.bundle.path,
                flown_by=self.bundle.bundle_id,
                world_set=self.world_set,
                world=world,
                set_up="field",
                duration_s=TIMES_S[-1],
                delay_s=timing.delay_s,
                max_message_age_s=age_s,
                max_input_age_s=max(_FIELD_INPUT_AGE_S, _PERIODS * slowest_s),
                clocks=clocks,
                robot=self.robot,
                px4_build=self.px4_build,
            )
            for world in range(self.worlds)
        ]

    def flights(self) -> list[EvaluationFlight]:
        """All of them."""
        return [flight for timing in self.timings for flight in self.flights_of(timing)]


@dataclass(frozen=True, slots=True, eq=False)
class TimingResult:
    """What a timing came to over K worlds: `costs` (K, 3) at `TIMES_S`, over those at the start.

    `worlds` names them, or the missions. `area` (K,) is the mean cost over the flight, `over_field`
    at each of the times the ratio of the mean cost to that with the field's timing, with its
    interval: over the same worlds in pairs, and of missions over these and those, which may differ.
    """

    timing: Timing
    worlds: tuple[str, ...]
    costs: F64
    area: F64
    over_field: tuple[Interval95, ...]

    @property
    def means(self) -> tuple[Interval95, ...]:
        """At each of `TIMES_S`, with the interval over other worlds."""
        return tuple(bootstrap(costs[None]) for costs in self.costs.T)


def results_of(
    plan: AsynchronyPlan, flown: Mapping[EvaluationFlight, FlownCost]
) -> list[TimingResult]:
    """Of all of its flights, in the order of its timings."""
    results = []
    in_field, _ = _costs(plan, FIELD, flown)
    for timing in plan.timings:
        costs, area = _costs(plan, timing, flown)
        over_field = tuple(
            paired_bootstrap(own[None], its[None], ratio_of_means, same_trainings=True)
            for own, its in zip(costs.T, in_field.T, strict=True)
        )
        results.append(
            TimingResult(timing, tuple(map(str, range(plan.worlds))), costs, area, over_field)
        )
    return results


def results_of_logs(records: Mapping[str, FlightRecord]) -> list[TimingResult]:
    """Of missions by name, by the rates that they were flown at; the field's first.

    Those that are not in `is_comparable` are left out. Raises ValueError if none of the others has
    the field's rates.
    """
    by_timing: dict[Timing, dict[str, FlightRecord]] = {FIELD: {}}
    for name, record in records.items():
        if record.rates is not None and is_comparable(record):
            by_timing.setdefault(Timing(*record.rates), {})[name] = record
    if not by_timing[FIELD]:
        raise ValueError(
            f"no mission of {TIMES_S[-1]:g} s was flown with perception at "
            f"{FIELD.perception_hz:g} Hz and policy at {FIELD.policy_hz:g} Hz, with which the "
            "others are compared"
        )
    in_field = _costs_of_logs(by_timing[FIELD].values())
    results = []
    for timing, its in by_timing.items():
        costs = _costs_of_logs(its.values())
        over_field = tuple(
            # As many trainings of one world: each side's are drawn by themselves.
            paired_bootstrap(own[:, None], theirs[:, None], ratio_of_means)
            for own, theirs in zip(costs.T, in_field.T, strict=True)
        )
        area = np.array([_area(record) for record in its.values()])
        results.append(TimingResult(timing, tuple(its), costs, area, over_field))
    return results


def is_comparable(record: FlightRecord) -> bool:
    """Whether its rates are known, and it lasted as long as costs are looked at, or nearly."""
    return record.rates is not None and bool(record.curve_time_s[-1] > TIMES_S[-1] - 1.0)


def _costs_of_logs(records: Iterable[FlightRecord]) -> F64:
    """(K, 3)."""
    return np.array([np.interp(TIMES_S, r.curve_time_s, r.normalized) for r in records])


def _area(record: FlightRecord) -> float:
    times_s = np.linspace(0.0, TIMES_S[-1], 1 + int(TIMES_S[-1]))
    curve = np.interp(times_s, record.curve_time_s, record.normalized)
    return float(mean_over_time(times_s, curve))


def _costs(
    plan: AsynchronyPlan, timing: Timing, flown: Mapping[EvaluationFlight, FlownCost]
) -> tuple[F64, F64]:
    of_worlds = [flown[flight] for flight in plan.flights_of(timing)]
    time_s = np.array(of_worlds[0].time_s)
    curves = np.array([np.array(told.cost) / told.cost[0] for told in of_worlds])
    costs = np.array([np.interp(TIMES_S, time_s, curve) for curve in curves])
    return costs, mean_over_time(time_s, curves)


def as_json(flown: Flown, results: Sequence[TimingResult]) -> dict[str, Any]:
    """All numbers, for scripts; intervals as [value, low, high]."""
    return {
        "bundle_id": flown.bundle_id,
        "world_set": flown.world_set,
        "worlds": flown.worlds,
        "robot": flown.robot,
        "times_s": list(TIMES_S),
        "timings": [
            {
                **result.timing._asdict(),
                "rounds_per_perception": result.timing.rounds,
                "said_kb_s": flown.said_kb_s(result.timing.policy_hz),
                "means": [list(mean) for mean in result.means],
                "over_field": [list(ratio) for ratio in result.over_field],
                "area": list(bootstrap(result.area[None])),
                "over": list(result.worlds),
                "by_world": result.costs.tolist(),
            }
            for result in results
        ],
    }
