"""Results of a study: costs of methods over its worlds, and their comparison.

Costs are normalised by the world's initial cost with all robots. Definitions:

- **final** is the cost at the end, **area** the mean over the flight (the area under the curve over
  the duration).
- **x clairvoyant** and **x best of ten** are relative to ClairvoyantCVT in the same world and time,
  and to the best of ten runs of Lloyd's algorithm on the true density. Neither is a bound. Over all
  worlds they are ratios of means, else world by world.
- A world **fails** if it ends above `FAILS_ABOVE` x clairvoyant. Costs **rise again** if they end
  more than 5 % above their own minimum. The **worst rise** is the largest share, from 60 s
  on, by which a cost is above its best before.
- Where robots are lost in flight, baselines and Lloyd's algorithm never had them.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from edge.core import F64, Bools
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
from lpac.sim.scenario import Scenario
from lpac.study.flights import CLAIRVOYANT, CostCurve, PlannedFlight
from lpac.study.study import Condition, Method, Study

FAILS_ABOVE = 1.5
# When costs are shown of a flight that lasts as long: up to a battery's length.
MISSION_TIMES_S = (60.0, 120.0, 300.0)
_ROUNDING_S = 1e-6
_RISEN = 1.05
_QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9, 0.95)


@dataclass(frozen=True, slots=True, eq=False)
class MethodResult:
    """Costs of a method under one condition, in S trainings over K worlds.

    `time_s` (C,), `curves` (S, K, C) are normalised costs. `clairvoyant` and `best_of_ten` (1, K)
    are the normalised costs for comparison, `clairvoyant_over_mission` (1, K, M) those at the M of
    `mission_times_s`. `lost_at_s` is the time at which robots are lost.
    """

    method: Method
    time_s: F64
    curves: F64
    clairvoyant: F64
    clairvoyant_over_mission: F64
    best_of_ten: F64
    lost_at_s: float

    @property
    def final(self) -> F64:
        """(S, K)."""
        return self.curves[..., -1]

    @property
    def over_mission(self) -> F64:
        """(S, K, M)."""
        return over_mission(self.time_s, self.curves)

    @property
    def worst_rise(self) -> F64:
        """(S, K); after the loss of robots, if there is one."""
        since = self.time_s >= self.lost_at_s
        return worst_rise(self.time_s[since], self.curves[..., since])

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
        """(S, K); after the loss of robots, if there is one."""
        since = self.curves[..., self.time_s >= self.lost_at_s]
        risen: Bools = self.final > _RISEN * since.min(axis=-1)
        return risen


def mission_times_s(duration_s: float) -> tuple[float, ...]:
    """Those of MISSION_TIMES_S that a flight reaches; its end if it reaches none."""
    reached = [time_s for time_s in MISSION_TIMES_S if time_s <= duration_s + _ROUNDING_S]
    return tuple(reached) or (duration_s,)


def over_mission(time_s: F64, curves: F64) -> F64:
    """Costs (..., M) of `curves` (..., C) at `time_s` (C,), at the M of `mission_times_s`."""
    at_s = np.array(mission_times_s(float(time_s[-1])))
    return curves[..., np.searchsorted(time_s, at_s + _ROUNDING_S) - 1]


def worst_rise(time_s: F64, curves: F64) -> F64:
    """Largest share (...) by which `curves` (..., C) rise above their best before.

    It counts from 60 s on: while robots explore, costs may rise.
    """
    rise = curves / np.minimum.accumulate(curves, axis=-1)
    counts = time_s >= mission_times_s(float(time_s[-1]))[0] - _ROUNDING_S
    worst: F64 = rise[..., counts].max(axis=-1) - 1.0
    return worst


def results_of(
    study: Study, curves: Mapping[PlannedFlight, CostCurve]
) -> dict[Condition, list[MethodResult]]:
    """Results of all methods under each condition, in the study's order."""
    return {condition: _of_condition(study, condition, curves) for condition in study.conditions}


def _of_condition(
    study: Study, condition: Condition, curves: Mapping[PlannedFlight, CostCurve]
) -> list[MethodResult]:
    methods = study.methods_of(condition)
    flown = {
        method.name: [
            [curves[flight] for flight in study.flights_of(method, condition, draw)]
            for draw in study.draws
        ]
        for method in methods
    }
    costs = {
        name: np.array([[flight.cost for flight in draw] for draw in draws]).swapaxes(0, 1)
        for name, draws in flown.items()
    }
    best_of_ten = np.array([[flight.lloyd for flight in draw] for draw in flown[CLAIRVOYANT]]).T
    # Baselines start without the robots that are lost later, and so at a higher cost.
    initial = np.min([each[:, :, 0].min(axis=0) for each in costs.values()], axis=0)
    return [
        MethodResult(
            method=method,
            time_s=np.array(flown[method.name][0][0].time_s),
            curves=costs[method.name] / initial[:, None],
            clairvoyant=costs[CLAIRVOYANT][:, :, -1] / initial,
            clairvoyant_over_mission=over_mission(
                np.array(flown[CLAIRVOYANT][0][0].time_s), costs[CLAIRVOYANT] / initial[:, None]
            ),
            best_of_ten=best_of_ten / initial,
            lost_at_s=condition.lost.at_s if method.trained else 0.0,
        )
        for method in methods
    ]


def as_json(
    study: Study, results: Mapping[Condition, Sequence[MethodResult]], *, compared: bool = False
) -> dict[str, Any]:
    """All numbers for scripts; `compared` adds a comparison of the first method with the second."""
    return {
        "world_set": study.world_set,
        "first_world": study.first_world,
        "worlds": study.worlds,
        "trials_per_world": study.trials,
        "methods": [
            {"name": method.name, "bundles": [each._asdict() for each in method.trainings]}
            for method in study.all_methods
        ],
        "baselines_with": study.sizes,
        "fails_above": FAILS_ABOVE,
        "conditions": conditions_json(results, compared=compared),
    }


def conditions_json(
    results: Mapping[Condition, Sequence[MethodResult]], *, compared: bool = False
) -> list[dict[str, Any]]:
    """Results of all methods under each condition; see `as_json`."""
    return [
        {
            "name": condition.name,
            "set_up": condition.set_up,
            "sizes": condition.sizes,
            "engine": condition.engine,
            "from_pads": condition.from_pads,
            "lost_robots": condition.lost.robots,
            "lost_at_s": condition.lost.at_s,
            "scenario": scenario_json(condition.scenario),
            "results": [_result_json(result, of_all) for result in of_all],
            "compared": _verdict_json(verdict_of(of_all[0], of_all[1])) if compared else None,
        }
        for condition, of_all in results.items()
    ]


def scenario_json(scenario: Scenario) -> dict[str, Any]:
    """A scenario without what is drawn for each world, and the quality of its links."""
    keys = asdict(replace(scenario, features=None))
    drawn = ("features", "seed", "controller")
    return {
        **{name: value for name, value in keys.items() if name not in drawn},
        "link": scenario.link._asdict(),
    }


def verdict_of(a: MethodResult, b: MethodResult) -> Verdict:
    """Comparison by the final cost."""
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
        "over_mission": [
            {
                "time_s": time_s,
                "mean": float(costs.mean()),
                "over_clairvoyant": float(costs.mean() / clairvoyant.mean()),
            }
            for time_s, costs, clairvoyant in zip(
                mission_times_s(float(result.time_s[-1])),
                np.moveaxis(result.over_mission, -1, 0),
                np.moveaxis(result.clairvoyant_over_mission, -1, 0),
                strict=True,
            )
        ],
        "worst_rise": _distribution(result.worst_rise),
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
    """Distribution of (S, K) values; intervals as [value, low, high]."""
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
    """Share of true values in (S, K), and its upper bound at 95 % confidence.

    Flights of several trainings over one world are not independent, so the bound counts worlds,
    each with the share of its trainings.
    """
    of, share = failed.shape[1], float(failed.mean())
    return {
        "share": share,
        "worlds": of,
        "at_most_share": at_most_share(of, math.ceil(share * of - 1e-9)),
    }


def worst_worlds(result: MethodResult, count: int) -> list[int]:
    """Indices of the study's worlds with the highest mean final cost over clairvoyant."""
    ascending = np.argsort(result.over_clairvoyant.mean(axis=0), kind="stable")
    return [int(world) for world in ascending[::-1][:count]]
