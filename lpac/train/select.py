"""Selects weights by their closed-loop cost over validation worlds."""

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from edge.core import F64
from edge.core.wire import PayloadType
from edge.policy.bundle import Bundle
from lpac.sim.baselines import BaselineName
from lpac.sim.cores import Pool
from lpac.sim.kept import KeptOutcomes
from lpac.study.flights import CostCurve, KeptFlights, PlannedFlight
from lpac.study.results import mission_times_s, over_mission, worst_rise
from lpac.study.study import Condition, Method, Study, TrainedBundle
from lpac.study.worlds import SET_UPS
from lpac.train.config import SelectConfig
from lpac.train.task import Task


class Candidate(NamedTuple):
    """The weights after `epoch` epochs of a round."""

    round: int
    epoch: int

    @property
    def name(self) -> str:
        """Name of the candidate's folder."""
        return f"{self.round:02d}-{self.epoch:04d}"


class ClosedLoopCost(NamedTuple):
    """Final cost over initial cost, over the worlds."""

    mean: float
    p90: float
    worst: float
    worst_flight: int

    @classmethod
    def of(cls, costs: F64) -> "ClosedLoopCost":
        """Summarise `costs` (flights,)."""
        return cls(
            float(costs.mean()), float(np.quantile(costs, 0.9)), float(costs.max()),
            int(costs.argmax()),
        )  # fmt: skip


class MissionCost(NamedTuple):
    """Mean cost over initial cost at `times_s`, and the worst rise above the best before."""

    times_s: list[float]
    mean: list[float]
    worst_rise: float


class JudgedCandidate(NamedTuple):
    """A candidate and its cost."""

    candidate: Candidate
    cost: ClosedLoopCost


def candidates_of(round_: int, epochs: int, every: int) -> list[Candidate]:
    """Candidates of a round: every `every` epochs, and the last."""
    return [Candidate(round_, epoch) for epoch in sorted({*range(every, epochs, every), epochs})]


def policy_of(path: Path, bundle: Bundle) -> Method:
    """The trained policy as a method of a study."""
    return Method(name="lpac", trainings=(TrainedBundle(str(path.resolve()), bundle.id),))


def flights_of(
    select: SelectConfig, method: Method, sizes_from: Path, payload: PayloadType = "float16"
) -> list[PlannedFlight]:
    """Flights over validation worlds that evaluate a policy, or a baseline at a bundle's sizes.

    Baselines lose no messages.
    """
    conditions = [
        Condition(
            scenario=SET_UPS[set_up].scenario(
                duration_s=select.duration_s, loss=select.loss, payload=payload
            )
        )
        for set_up in select.set_ups
    ]
    study = Study(
        methods=(method,),
        conditions=tuple(dict.fromkeys(conditions)),
        worlds=select.worlds,
        sizes_from=str(sizes_from.resolve()),
    )
    return [
        flight
        for condition in conditions
        for draw in study.draws
        for flight in study.flights_of(method, condition, draw)
    ]


class Selection:
    """The evaluated candidates of a run, saved in a folder."""

    def __init__(self, folder: Path, config: str, select: SelectConfig, task: Task) -> None:
        """`config` is the digest of the run's configuration. Raises OSError."""
        self._select = select
        self._task = task
        self._flights = KeptFlights(folder, CostCurve)
        self._kept = KeptOutcomes(folder / "candidates.jsonl", {"config": config})

    @property
    def judged(self) -> list[JudgedCandidate]:
        """Evaluated candidates, in the order of training."""
        return sorted(
            JudgedCandidate(Candidate(*line["candidate"]), ClosedLoopCost(*line["cost"]))
            for line in self._kept.lines
        )

    @property
    def best(self) -> JudgedCandidate | None:
        """The candidate of least mean cost, the earlier one in a tie."""
        return min(self.judged, key=lambda judged: judged.cost.mean, default=None)

    @property
    def seconds(self) -> float:
        """Time of all evaluations."""
        return float(sum(line["seconds"] for line in self._kept.lines))

    def judge(
        self,
        candidate: Candidate,
        path: Path,
        bundle: Bundle,
        pool: Pool,
        report: Callable[[int], None],
    ) -> None:
        """Fly a candidate, unless done before; calls `report` with the number of flights done."""
        if any(judged.candidate == candidate for judged in self.judged):
            return
        begun_s = time.monotonic()
        costs = self._fly(flights_of(self._select, policy_of(path, bundle), path), pool, report)
        self._kept.add(
            {
                "candidate": list(candidate),
                "bundle_id": bundle.id,
                "cost": list(ClosedLoopCost.of(costs)),
                "seconds": round(time.monotonic() - begun_s, 3),
            }
        )

    def baselines(self, path: Path, pool: Pool) -> dict[BaselineName, ClosedLoopCost]:
        """Costs over the same worlds, with the sizes of the bundle at `path`."""
        names = self._task.baselines
        if not names:
            return {}
        flights = [
            flight for name in names for flight in flights_of(self._select, Method.of(name), path)
        ]
        costs = self._fly(flights, pool, lambda _: None).reshape(len(names), -1)
        return {name: ClosedLoopCost.of(of) for name, of in zip(names, costs, strict=True)}

    def over_mission(self, path: Path, bundle: Bundle, pool: Pool) -> dict[str, MissionCost]:
        """Costs of the policy, "", and of the baselines over a battery's time."""
        select = replace(self._select, duration_s=self._select.mission_s)
        methods = {"": policy_of(path, bundle)} | {
            name: Method.of(name) for name in self._task.baselines
        }
        return {
            name: _mission_cost(self._curves(flights_of(select, method, path), pool))
            for name, method in methods.items()
        }

    def with_payload(
        self, payload: PayloadType, path: Path, bundle: Bundle, pool: Pool
    ) -> ClosedLoopCost:
        """Cost of the same flights with another payload type."""
        flights = flights_of(self._select, policy_of(path, bundle), path, payload)
        return ClosedLoopCost.of(self._fly(flights, pool, lambda _: None))

    def _fly(self, flights: list[PlannedFlight], pool: Pool, report: Callable[[int], None]) -> F64:
        """Final cost over initial cost of each flight."""
        curves = self._curves(flights, pool, report)
        return np.array([curve.cost[-1] / curve.cost[0] for curve in curves])

    def _curves(
        self,
        flights: list[PlannedFlight],
        pool: Pool,
        report: Callable[[int], None] = lambda _: None,
    ) -> list[CostCurve]:
        flown: dict[PlannedFlight, CostCurve] = {}
        with closing(self._flights.fly(self._task.costs, flights, pool)) as outcomes:
            for flight, curve in outcomes:
                flown[flight] = curve
                report(len(flown))
        return [flown[flight] for flight in flights]


def _mission_cost(curves: Sequence[CostCurve]) -> MissionCost:
    costs = np.array([curve.cost for curve in curves])
    costs /= costs[:, :1]
    time_s = np.array(curves[0].time_s)
    at = over_mission(time_s, costs)
    return MissionCost(
        list(mission_times_s(curves[0].time_s[-1])),
        at.mean(axis=0).tolist(),
        float(worst_rise(time_s, costs).max()),
    )
