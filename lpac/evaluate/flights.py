"""The flights of an evaluation; this is the one place where they are flown."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np

import edge
from edge.core.world import GaussianFeature, rasterize
from edge.policy.bundle import Bundle, BundleError, load_bundle
from lpac import analysis, evaluate, sim
from lpac.analysis.coverage import Coverage
from lpac.evaluate.worlds import SET_UPS, SetUp, WorldSet, draw_world
from lpac.sim.baselines import BaselineName
from lpac.sim.cores import Pool
from lpac.sim.experiment import FIELD_SCALE, Scenario, SimulatedFlight, fly
from lpac.sim.kept import KeptOutcomes, code_digest

BASELINES: tuple[BaselineName, ...] = get_args(BaselineName)
# The best of ten runs of Lloyd's algorithm that knows the world: where robots would end, not a
# flight. A mark for comparison, and no bound.
LLOYD: Literal["best-of-ten-lloyd"] = "best-of-ten-lloyd"
POLICY: Literal["lpac"] = "lpac"
Flier = Literal["lpac", "best-of-ten-lloyd"] | BaselineName

_FLIGHTS = "flights.jsonl"
_LOST = re.compile(r"(\d+)@(\d+\.?\d*)")


class LostRobots(NamedTuple):
    """So many of the robots are gone from that time of the flight on, s; at 0, they never were."""

    robots: int
    at_s: float

    @classmethod
    def parse(cls, text: str) -> "LostRobots":
        """Of "2@20". Raises ValueError."""
        found = _LOST.fullmatch(text)
        if found is None:
            raise ValueError(f"lost robots {text!r}: must be ROBOTS@SECONDS, such as 2@20")
        return cls(int(found[1]), float(found[2]))


NONE_LOST = LostRobots(0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationFlight:
    """One flight over one world: all of it follows from this, and from what is in the bundle.

    `bundle` is the path of the one that flies, or gives a baseline the sizes of sensor and local
    map; `flown_by` is its id, or says these sizes.
    """

    flier: Flier
    bundle: str
    flown_by: str
    world_set: WorldSet
    world: int
    set_up: str
    duration_s: float
    loss: float = 0.0
    lost: LostRobots = NONE_LOST

    @property
    def key(self) -> str:
        """What tells it from all other flights, wherever the bundle lies."""
        return (
            f"{self.flier} {self.flown_by}: {self.world_set} {self.world} {self.set_up}, "
            f"{self.duration_s:g} s, loss {self.loss:g}, lost {self.lost.robots}@{self.lost.at_s:g}"
        )


class FlownCost(NamedTuple):
    """The coverage cost J (C,) in model units at times (C,), s, of the robots that are left."""

    time_s: tuple[float, ...]
    cost: tuple[float, ...]


def task_of(bundle: Bundle) -> str:
    """What policies must have in common to be compared. Raises BundleError without perception."""
    perception, training = bundle.manifest.perception, bundle.manifest.training
    if perception is None:
        raise BundleError(f"bundle {bundle.manifest.name!r} has no perception: it cannot fly")
    return (
        f"sensor {perception.sensor_size}, speed {training.max_speed:g}, "
        f"features cut at {training.idf_truncation:g}, scaled to {training.idf_norm:g}"
    )


def sizes_of(bundle: Bundle) -> str:
    """What baselines take from a bundle. Raises BundleError without perception."""
    task, perception = task_of(bundle), bundle.manifest.perception
    assert perception is not None
    unseen = perception.unknown_importance
    return f"local map {perception.local_map_size}, unseen {unseen:g}, {task}"


def cost_of(flight: EvaluationFlight) -> tuple[EvaluationFlight, FlownCost]:
    """Fly it, in whatever process this is. Raises BundleError, ValueError, OSError."""
    if flight.flier == LLOYD:
        return flight, _best_of_ten(flight)
    _, flown = fly_again(flight)
    return flight, FlownCost(tuple(flown.cost_time_s.tolist()), tuple(flown.cost.tolist()))


def fly_again(flight: EvaluationFlight) -> tuple[EvaluationFlight, SimulatedFlight]:
    """The flight with all that it was like. Raises BundleError, ValueError, OSError."""
    assert flight.flier != LLOYD
    drawn, bundle = _drawn(flight), _bundle(flight.bundle)
    perception = bundle.manifest.perception
    assert perception is not None
    sized = replace(
        perception,
        world_size=drawn.set_up.world_size,
        communication_range=drawn.set_up.communication_range,
    )
    return flight, fly(
        Scenario(
            controller=flight.flier,
            robots=len(drawn.starts_m),
            seed=drawn.seed,
            duration_s=flight.duration_s,
            features=drawn.features,
            starts_m=drawn.starts_m,
            scale=FIELD_SCALE,
            loss=flight.loss,
        ),
        replace(bundle, manifest=replace(bundle.manifest, perception=sized)),
    )


class _Drawn(NamedTuple):
    """A flight's world and who begins it where, m in the mission frame."""

    set_up: SetUp
    features: tuple[GaussianFeature, ...]
    starts_m: tuple[tuple[float, float], ...]
    seed: int


def _drawn(flight: EvaluationFlight) -> _Drawn:
    set_up = SET_UPS[flight.set_up]
    world = draw_world(flight.world_set, flight.world, set_up)
    starts_m = FIELD_SCALE.position_to_mission_m(np.array(world.starts)).tolist()
    # Starts are drawn alike for all: whoever is lost might be anybody.
    never = flight.lost.robots if flight.lost.at_s == 0.0 else 0
    begin_m = tuple((x_m, y_m) for x_m, y_m in starts_m[: set_up.robots - never])
    return _Drawn(set_up, world.features, begin_m, world.seed)


def _best_of_ten(flight: EvaluationFlight) -> FlownCost:
    """From the start to where Lloyd's algorithm ends, as if that took no time."""
    drawn, training = _drawn(flight), _bundle(flight.bundle).manifest.training
    importance = rasterize(
        drawn.features, drawn.set_up.world_size, training.idf_truncation, training.idf_norm
    )
    coverage = Coverage(importance, FIELD_SCALE.env_scale)
    starts_m = np.array(drawn.starts_m)
    return FlownCost((0.0, 0.0), (coverage.cost(starts_m), coverage.lloyd(starts_m)))


@cache
def _bundle(path: str) -> Bundle:
    """Loaded once in each process."""
    return load_bundle(Path(path))


class KeptFlights:
    """What came of flights, in a folder: who asks again for one that was flown there has it."""

    def __init__(self, folder: Path) -> None:
        """Raises OSError."""
        flown_by = {"code": code_digest(edge, analysis, evaluate, sim)}
        self._kept = KeptOutcomes(folder / _FLIGHTS, flown_by)
        self._costs = {
            line["flight"]: FlownCost(tuple(line["time_s"]), tuple(line["cost"]))
            for line in self._kept.lines
        }

    def fly(
        self, flights: Sequence[EvaluationFlight], pool: Pool
    ) -> Iterator[tuple[EvaluationFlight, FlownCost]]:
        """All of them: first what was flown before, and then the others as they come."""
        missing = []
        for flight in flights:
            if flight.key in self._costs:
                yield flight, self._costs[flight.key]
            else:
                missing.append(flight)
        if not missing:
            return
        for flight, flown in pool(cost_of, missing):
            self._costs[flight.key] = flown
            self._kept.add({"flight": flight.key, "time_s": flown.time_s, "cost": flown.cost})
            yield flight, flown
