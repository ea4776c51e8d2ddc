"""Does it cover? The shipped policy against the baselines over seeded worlds, at field scale."""

import math
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from multiprocessing import get_context
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from bench import BUNDLE
from bench.report import Report, Table, Target
from edge.core.world import random_features
from edge.policy.bundle import Bundle, load_bundle
from lpac.sim.baselines import BaselineName
from lpac.sim.experiment import fly
from lpac.sim.scenario import Scenario

LPAC, LOSSY = "lpac", "lpac, 30 % loss"
RIVAL: BaselineName = "decentralized-cvt"
BASELINES: tuple[BaselineName, ...] = (RIVAL, "centralized-cvt", "clairvoyant-cvt")
_CORES = 2
_LOSS = 0.3
_ROBOTS = 10
_FEATURES = 10


def measure(
    worlds: int = 20, duration_s: float = 60.0, draws: int = 3, draws_with_loss: int = 1
) -> Report:
    """Cost after `duration_s` over the initial cost; the policy's is a mean over clock draws.

    A draw is one of the robots' clock phases, jitter and lost messages.
    """
    flights = [
        (world, name, scenario)
        for world in range(worlds)
        for name, scenario in _scenarios(world, duration_s, draws, draws_with_loss)
    ]
    with ProcessPoolExecutor(_CORES, mp_context=get_context("spawn")) as processes:
        costs = list(
            track(
                processes.map(_final_cost, [scenario for _, _, scenario in flights]),
                "closed loop: flights",
                len(flights),
                console=Console(stderr=True),
            )
        )
    drawn: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for (world, name, _), cost in zip(flights, costs, strict=True):
        drawn[name][world].append(cost)
    names = (LPAC, LOSSY, *BASELINES)
    costs_of = {name: [float(np.mean(drawn[name][w])) for w in range(worlds)] for name in names}
    below_rival = {
        name: sum(a < b for a, b in zip(costs_of[name], costs_of[RIVAL], strict=True))
        for name in names
    }
    figures: dict[str, Any] = {
        "duration_s": duration_s,
        "draws": {LPAC: draws, LOSSY: draws_with_loss},
        "normalized_cost": {
            name: {
                "mean": float(np.mean(costs_of[name])),
                "median": float(np.median(costs_of[name])),
                "worlds_below_decentralized_cvt": below_rival[name],
                "by_world": costs_of[name],
                "draws_by_world": list(drawn[name].values()),
            }
            for name in names
        },
    }
    rows = [(f"world {w}", *(f"{costs_of[name][w]:.3f}" for name in names)) for w in range(worlds)]
    for statistic in ("mean", "median"):
        figure = [f"{figures['normalized_cost'][name][statistic]:.3f}" for name in names]
        rows.append((statistic, *figure))
    counts = [f"{below_rival[name]} of {worlds}" if name != RIVAL else "" for name in names]
    rows.append((f"below {RIVAL}", *counts))
    limit = math.ceil(0.9 * worlds)
    return Report(
        "closed_loop",
        figures,
        [Table(f"Coverage cost after {duration_s:g} s over the initial cost", ("", *names), rows)],
        [
            Target(f"worlds of {worlds}: {name} below {RIVAL}", below_rival[name], limit, True)
            for name in (LPAC, LOSSY)
        ],
        [
            f"{_ROBOTS} robots, {_FEATURES} features, field scale. Mean over {draws} draws of the "
            f"robots' clocks, and {draws_with_loss} with loss. The baselines know true positions, "
            "and lose no messages."
        ],
    )


def _scenarios(
    world: int, duration_s: float, draws: int, draws_with_loss: int
) -> Iterator[tuple[str, Scenario]]:
    """All flights in one world, from the same starting positions."""
    perception, scale = _bundle().manifest.perception, Scenario().scale
    assert perception
    rng = np.random.default_rng(world)
    features = random_features(rng, _FEATURES, perception.world_size)
    starts = rng.uniform(0.0, perception.world_size, (_ROBOTS, 2))
    flight = Scenario(
        robots=_ROBOTS,
        duration_s=duration_s,
        features=features,
        starts_m=tuple((x, y) for x, y in scale.position_to_mission_m(starts).tolist()),
        scale=scale,
    )
    for draw in range(draws):
        yield LPAC, replace(flight, seed=draw)
    for draw in range(draws_with_loss):
        yield LOSSY, replace(flight, seed=draw, loss=_LOSS)
    for name in BASELINES:
        yield name, replace(flight, controller=name)


def _final_cost(scenario: Scenario) -> float:
    return float(fly(scenario, _bundle()).normalized_cost[-1])


@cache
def _bundle() -> Bundle:
    """Loaded once in each process."""
    return load_bundle(BUNDLE)
