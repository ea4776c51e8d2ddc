"""An evaluation: methods over the worlds of a set under some conditions, and what it comes to.

Costs are normalised by a world's at the start, with all robots. What the numbers mean:

- **final** is the cost at the end, **area** the mean over the flight: the area under the curve over
  its duration.
- **x clairvoyant** and **x best of ten** are over what ClairvoyantCVT comes to in the same world in
  the same time, and over the best of ten runs of Lloyd's algorithm on the true density. Neither is
  a bound. Of values over all worlds it is the ratio of the means; else world by world.
- A world **fails** if it ends above `FAILS_ABOVE` x clairvoyant. Costs **rise again** if they end
  more than 5 % above their own least.
- Where robots are lost in flight, baselines and Lloyd's algorithm never had them.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from edge.core import F64, Bools
from edge.core.wire import PayloadType
from lpac.analysis.statistics import (
    Verdict,
    at_most_share,
    bootstrap,
    compare,
    interquartile_mean,
    mean_over_time,
    paired_bootstrap,
    ratio_of_means,
)
from lpac.evaluate.flights import (
    IN_REAL_TIME,
    LLOYD,
    POLICY,
    WHOLE_ROBOTS,
    EvaluationFlight,
    Flier,
    FlownCost,
    RobotModel,
)
from lpac.evaluate.worlds import SET_UPS, WorldSet
from lpac.radio.modelled import ModelledRadio
from lpac.sim.baselines import BaselineName
from lpac.sim.failure import NONE_LOST, LostRobots
from lpac.sim.fleet.layout import MAX_ROBOTS

FAILS_ABOVE = 1.5
_RISEN = 1.05
_QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9, 0.95)
CLAIRVOYANT: BaselineName = "clairvoyant-cvt"


class TrainedBundle(NamedTuple):
    """A bundle: its path, and its id."""

    path: str
    bundle_id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """A baseline, or a policy by the bundles of its trainings, which differ in their seed alone."""

    name: str
    flier: Flier
    trainings: tuple[TrainedBundle, ...] = ()

    @property
    def trained(self) -> bool:
        return self.flier == POLICY


class Condition(NamedTuple):
    """Under which all methods fly: a set-up of `SET_UPS`, by its name, and what is hard about it.

    `loss` is the probability that a message is lost, `lost` robots fail in flight, `lag_s` is the
    time constant of vehicles, `position_error_m` the standard deviation of robots' errors along
    each axis, `robot` what flies, `payload` how numbers are sent; a `radio` says what is lost and
    late instead of `loss`.
    """

    set_up: str
    loss: float = 0.0
    lost: LostRobots = NONE_LOST
    lag_s: float = 0.0
    position_error_m: float = 0.0
    robot: RobotModel = "point"
    payload: PayloadType = "float16"
    radio: ModelledRadio | None = None

    @property
    def name(self) -> str:
        """For people."""
        words = [self.set_up]
        if self.loss:
            words.append(f"{100.0 * self.loss:g} % of messages lost")
        if self.radio:
            words.append(f"{self.radio.transport} by the model")
        if self.lost.robots:
            robots = SET_UPS[self.set_up].robots
            words.append(f"{self.lost.robots} of {robots} robots lost at {self.lost.at_s:g} s")
        if self.lag_s:
            words.append(f"lag {self.lag_s:g} s")
        if self.position_error_m:
            words.append(f"positions off by {self.position_error_m:g} m")
        if self.payload != "float16":
            words.append(f"payloads in {self.payload}")
        if self.robot != "point":
            words.append(_ROBOTS[self.robot])
        return ", ".join(words)


_ROBOTS: dict[RobotModel, str] = {
    "point-from-pad": "points from pads, GPS off",
    "simulated": "whole robots",
    "mavlink": "whole robots, as programs",
    "px4": "whole robots, on PX4",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """Methods, the first `worlds` worlds of a set, and the conditions.

    Baselines take their sizes from the bundle at `sizes_from`; `sizes` says which. `px4_build` is
    where real PX4s are taken from.
    Raises ValueError that names what is impossible.
    """

    methods: tuple[Method, ...]
    conditions: tuple[Condition, ...]
    world_set: WorldSet
    worlds: int
    duration_s: float
    sizes_from: str
    sizes: str
    px4_build: str = ""

    def __post_init__(self) -> None:
        if self.worlds < 1:
            raise ValueError(f"worlds = {self.worlds}: must be at least 1")
        if not 0.0 < self.duration_s < math.inf:
            raise ValueError(f"duration = {self.duration_s}: must be positive and finite")
        for condition in self.conditions:
            loss, lost = condition.loss, condition.lost
            if not 0.0 <= loss <= 1.0:
                raise ValueError(f"loss = {loss}: must be from 0 to 1")
            for name in ("lag_s", "position_error_m"):
                if not 0.0 <= getattr(condition, name) < math.inf:
                    raise ValueError(
                        f"{name} = {getattr(condition, name)}: must be at least 0 and finite"
                    )
            if condition.robot != "point" and SET_UPS[condition.set_up].robots > MAX_ROBOTS:
                raise ValueError(f"{condition.set_up}: of whole robots {MAX_ROBOTS} fly at most")
            if condition.robot in IN_REAL_TIME and (loss or condition.radio):
                raise ValueError("programs in real time lose what their own radio loses")
            if lost.robots and not 0.0 < lost.at_s < self.duration_s:
                raise ValueError(f"robots lost at {lost.at_s:g} s: must be in flight")
            if lost.robots >= SET_UPS[condition.set_up].robots:
                raise ValueError(f"{lost.robots} robots lost: {condition.set_up} has no more")
        names = [method.name for method in self.methods]
        if len(set(names)) < len(names):
            raise ValueError(f"methods {', '.join(names)}: each once")

    def flights(self) -> list[EvaluationFlight]:
        """All of them, each once; those over one world beside each other."""
        wanted = [
            flight
            for condition in self.conditions
            for world in range(self.worlds)
            for method in (*self.methods, _BEST_OF_TEN)
            for flight in self.flights_of(method, condition, world)
        ]
        return list(dict.fromkeys(wanted))

    def flights_of(
        self, method: Method, condition: Condition, world: int
    ) -> Iterator[EvaluationFlight]:
        """One of each training; of a baseline one, which loses no messages, and no robots late."""
        lost = LostRobots(condition.lost.robots, 0.0)
        for path, bundle_id in method.trainings or [TrainedBundle(self.sizes_from, self.sizes)]:
            yield EvaluationFlight(
                flier=method.flier,
                bundle=path,
                flown_by=bundle_id,
                world_set=self.world_set,
                world=world,
                set_up=condition.set_up,
                duration_s=self.duration_s,
                loss=condition.loss if method.trained else 0.0,
                radio=condition.radio if method.trained else None,
                lost=condition.lost if method.trained else lost,
                lag_s=condition.lag_s,
                position_error_m=condition.position_error_m,
                robot=condition.robot if method.trained else _AS_POINT[condition.robot],
                payload=condition.payload if method.trained else "float16",
                px4_build=self.px4_build if method.trained else "",
            )


_AS_POINT: dict[RobotModel, RobotModel] = {
    "point": "point",
    **dict.fromkeys(("point-from-pad", *WHOLE_ROBOTS), "point-from-pad"),
}
_BEST_OF_TEN = Method(name=LLOYD, flier=LLOYD)


@dataclass(frozen=True, slots=True, eq=False)
class MethodResult:
    """What a method came to under one condition, in S trainings over K worlds.

    `time_s` (C,), and `curves` (S, K, C): the normalised cost then. `clairvoyant` and `best_of_ten`
    (1, K) are the normalised costs that it is held against. `lost_at_s` is when robots were lost.
    """

    method: Method
    time_s: F64
    curves: F64
    clairvoyant: F64
    best_of_ten: F64
    lost_at_s: float

    @property
    def final(self) -> F64:
        """(S, K)."""
        return self.curves[..., -1]

    @property
    def area(self) -> F64:
        """(S, K)."""
        return mean_over_time(self.time_s, self.curves)

    @property
    def over_clairvoyant(self) -> F64:
        """(S, K)."""
        return self.final / self.clairvoyant

    @property
    def over_best_of_ten(self) -> F64:
        """(S, K)."""
        return self.final / self.best_of_ten

    @property
    def rises_again(self) -> Bools:
        """(S, K); since robots were lost, if any were."""
        since = self.curves[..., self.time_s >= self.lost_at_s]
        risen: Bools = self.final > _RISEN * since.min(axis=-1)
        return risen


def results_of(
    evaluation: Evaluation, costs: Mapping[EvaluationFlight, FlownCost]
) -> dict[Condition, list[MethodResult]]:
    """Of all its flights: under each condition each method's, in the evaluation's order."""
    found: dict[Condition, list[MethodResult]] = {}
    for condition in evaluation.conditions:
        curves: dict[str, F64] = {}
        for method in (*evaluation.methods, _BEST_OF_TEN):
            flown = [
                [costs[flight].cost for flight in evaluation.flights_of(method, condition, world)]
                for world in range(evaluation.worlds)
            ]
            curves[method.name] = np.swapaxes(np.array(flown), 0, 1)
        # Baselines begin without those who are lost later, and so with more cost.
        initial = np.min([of_method[:, :, 0].min(axis=0) for of_method in curves.values()], axis=0)
        flight = next(evaluation.flights_of(evaluation.methods[0], condition, 0))
        found[condition] = [
            MethodResult(
                method=method,
                time_s=np.array(costs[flight].time_s),
                curves=curves[method.name] / initial[:, None],
                clairvoyant=curves[CLAIRVOYANT][:, :, -1] / initial,
                best_of_ten=curves[LLOYD][:, :, -1] / initial,
                lost_at_s=condition.lost.at_s if method.trained else 0.0,
            )
            for method in evaluation.methods
        ]
    return found


def as_json(
    evaluation: Evaluation,
    results: Mapping[Condition, Sequence[MethodResult]],
    *,
    compared: bool,
) -> dict[str, Any]:
    """All numbers, for scripts; `compared` sets the first method against the second."""
    return {
        "world_set": evaluation.world_set,
        "worlds": evaluation.worlds,
        "duration_s": evaluation.duration_s,
        "methods": [
            {
                "name": method.name,
                "bundles": [training._asdict() for training in method.trainings],
            }
            for method in evaluation.methods
        ],
        "baselines_with": evaluation.sizes,
        "fails_above": FAILS_ABOVE,
        "conditions": conditions_json(results, compared=compared),
    }


def conditions_json(
    results: Mapping[Condition, Sequence[MethodResult]], *, compared: bool = False
) -> list[dict[str, Any]]:
    """What each method came to under each condition; see `as_json`."""
    return [
        {
            "name": condition.name,
            "set_up": condition.set_up,
            "loss": condition.loss,
            "radio_model": _radio_json(condition),
            "payload": condition.payload,
            "lost_robots": condition.lost.robots,
            "lost_at_s": condition.lost.at_s,
            "lag_s": condition.lag_s,
            "position_error_m": condition.position_error_m,
            "robot": condition.robot,
            "results": [_result_json(result, of_all) for result in of_all],
            "compared": _verdict_json(verdict_of(of_all[0], of_all[1])) if compared else None,
        }
        for condition, of_all in results.items()
    ]


def _radio_json(condition: Condition) -> dict[str, Any] | None:
    if condition.radio is None:
        return None
    link = condition.radio.link(SET_UPS[condition.set_up].robots, condition.payload)
    return {**asdict(condition.radio), **link._asdict()}


def verdict_of(a: MethodResult, b: MethodResult) -> Verdict:
    """By the cost at the end."""
    return compare(a.final, b.final, trained_a=a.method.trained, trained_b=b.method.trained)


def _verdict_json(verdict: Verdict) -> dict[str, Any]:
    """Intervals as [value, low, high]."""
    return {**verdict._asdict(), **{name: list(getattr(verdict, name)) for name in _INTERVALS}}


_INTERVALS = ("difference", "ratio", "a_below_b")


def _result_json(result: MethodResult, of_all: Iterable[MethodResult]) -> dict[str, Any]:
    final = result.final
    return {
        "name": result.method.name,
        "trainings": len(final),
        "final": _distribution(final),
        "area": _distribution(result.area),
        "over_clairvoyant": {
            **_distribution(result.over_clairvoyant),
            "ratio_of_means": list(paired_bootstrap(final, result.clairvoyant, ratio_of_means)),
        },
        "over_best_of_ten": {
            **_distribution(result.over_best_of_ten),
            "ratio_of_means": list(paired_bootstrap(final, result.best_of_ten, ratio_of_means)),
        },
        "fails": _share_json(result.over_clairvoyant > FAILS_ABOVE),
        "rises_again": _share_json(result.rises_again),
        "above": {
            other.method.name: _share_json(final > other.final.mean(axis=0))
            for other in of_all
            if other is not result
        },
        "against": {
            other.method.name: _verdict_json(verdict_of(result, other))
            for other in of_all
            if other is not result and not other.method.trained
        },
        "by_world": {
            "final": final.tolist(),
            "over_clairvoyant": result.over_clairvoyant.tolist(),
            "over_best_of_ten": result.over_best_of_ten.tolist(),
        },
        "median_curve": {
            "time_s": result.time_s.tolist(),
            "normalized_cost": np.median(result.curves, axis=(0, 1)).tolist(),
        },
    }


def _distribution(values: F64) -> dict[str, Any]:
    """Of (S, K); intervals as [value, low, high]."""
    worst = np.unravel_index(values.argmax(), values.shape)
    return {
        "mean": list(bootstrap(values)),
        "interquartile_mean": list(bootstrap(values, interquartile_mean)),
        "deviation": float(values.std(ddof=1)) if values.size > 1 else None,
        "quantiles": {f"{share:g}": float(np.quantile(values, share)) for share in _QUANTILES},
        "worst": float(values[worst]),
        "worst_world": int(worst[1]),
    }


def _share_json(failed: Bools) -> dict[str, Any]:
    """How many of (S, K) bools, and how many in truth at most, at 95 % confidence.

    Flights of several trainings over one world are not independent: so the bound counts worlds,
    each with the share of its trainings.
    """
    of, share = failed.shape[1], float(failed.mean())
    return {
        "share": share,
        "worlds": of,
        "at_most_share": at_most_share(of, math.ceil(share * of - 1e-9)),
    }


def worst_worlds(result: MethodResult, count: int) -> list[int]:
    """Those where the method ends highest over clairvoyant, on average over its trainings."""
    ascending = np.argsort(result.over_clairvoyant.mean(axis=0), kind="stable")
    return [int(world) for world in ascending[::-1][:count]]
