"""Final costs of the shipped policy, with which `lpac demo` and `lpac sim` compare.

Points as in `lpac demo`, relative to the clairvoyant's flight from the same starts; whole robots as
in `make fly`, with their errors, relative to the best of Lloyd's runs.
"""

import json
from dataclasses import replace
from tempfile import TemporaryDirectory
from typing import NamedTuple

from rich.console import Console
from rich.progress import track

from bench.result import Result, Table
from edge.policy.bundle import load_bundle
from lpac.shipped import SHIPPED_BUNDLE
from lpac.sim.cores import over_cores
from lpac.sim.fleet.clocked import fly_simulated
from lpac.sim.points import fly_points
from lpac.sim.usual import POINTS, USUAL_JSON, WHOLE, Usual

# Reserved seeds: no figure of the documentation shows these flights.
_FIRST_SEED = 1000
_WHOLE_ROBOTS = (10, 5, 3, 1)


class _Flight(NamedTuple):
    kind: str
    robots: int
    seed: int


class _Ended(NamedTuple):
    flight: _Flight
    ratio: float


def measure(points: int = 100, whole: int = 30) -> Result:
    """Fly `points` worlds with ten points, and `whole` with each number of whole robots."""
    seeds = range(_FIRST_SEED, _FIRST_SEED + max(points, whole))
    flights = [
        *(_Flight("whole", robots, seed) for robots in _WHOLE_ROBOTS for seed in seeds[:whole]),
        *(_Flight("points", POINTS.robots, seed) for seed in seeds[:points]),
    ]
    ratios: dict[tuple[str, int], list[float]] = {}
    ended = over_cores(_fly, flights)
    for flight, ratio in track(ended, "usual: flights", len(flights), console=Console(stderr=True)):
        ratios.setdefault(flight[:2], []).append(ratio)
    usual = {key: Usual.of(key[1], found) for key, found in sorted(ratios.items())}
    measured = {
        "made_by": "python -m bench usual",
        "bundle_id": load_bundle(SHIPPED_BUNDLE).id,
        "columns": Usual._fields,
        **{
            kind: [each for (of, _), each in usual.items() if of == kind]
            for kind in ("points", "whole")
        },
    }
    USUAL_JSON.write_text(json.dumps(measured, indent=1) + "\n")
    rows = [(kind, *(f"{value:g}" for value in each)) for (kind, _), each in usual.items()]
    return Result(
        "usual",
        measured | {"ratios": {f"{kind} {n}": found for (kind, n), found in ratios.items()}},
        [Table("Cost over the clairvoyant's, of 8 flights in 10", ("", *Usual._fields), rows)],
        [],
    )


def _fly(flight: _Flight) -> _Ended:
    if flight.kind == "points":
        bundle = load_bundle(SHIPPED_BUNDLE)
        points = replace(POINTS, seed=flight.seed)
        flown = fly_points(points, bundle).cost[-1]
        best = fly_points(replace(points, controller="clairvoyant-cvt"), bundle).cost[-1]
        return _Ended(flight, float(flown / best))
    with TemporaryDirectory() as folder:
        whole = replace(WHOLE, seed=flight.seed, robots=flight.robots)
        record = fly_simulated(whole, folder, SHIPPED_BUNDLE)
    return _Ended(flight, float(record.true_cost[-1] / record.lloyd))
