"""Does it cover? The policy against the baseline that knows as much, over seeded worlds.

`lpac evaluate` compares with all baselines, over worlds that are the same for everybody.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from rich.console import Console
from rich.progress import track

from bench import BUNDLE
from bench.result import Result, Table, Target
from edge.core.world import random_features
from edge.policy.bundle import load_bundle
from lpac.sim.cores import over_cores
from lpac.sim.experiment import fly
from lpac.sim.scenario import Scenario

LPAC, LOSSY, RIVAL = "lpac", "lpac, 30 % loss", "decentralized-cvt"
_LOSS = 0.3
_ROBOTS = _FEATURES = 10


def measure(worlds: int = 20, duration_s: float = 60.0, draws: int = 3) -> Result:
    """Cost after `duration_s` over the initial cost; the policy's without loss is a mean.

    It is over so many draws of the robots' clock phases and jitter.
    """
    flown = over_cores(partial(_costs_in, duration_s, draws), range(worlds))
    costs = dict(track(flown, "closed loop: worlds", worlds, console=Console(stderr=True)))
    by_name = {name: [costs[w][name] for w in range(worlds)] for name in (LPAC, LOSSY, RIVAL)}
    below = {
        name: sum(ours < rival for ours, rival in zip(by_name[name], by_name[RIVAL], strict=True))
        for name in (LPAC, LOSSY)
    }
    rows = [(f"world {w}", *(f"{by_name[name][w]:.3f}" for name in by_name)) for w in range(worlds)]
    rows += [
        (what, *(f"{statistic(each):.3f}" for each in by_name.values()))
        for what, statistic in (("mean", np.mean), ("median", np.median))
    ]
    return Result(
        "closed_loop",
        {"duration_s": duration_s, "normalized_cost": by_name, "worlds_below_rival": below},
        [Table(f"Cost after {duration_s:g} s over the initial cost", ("", *by_name), rows)],
        [
            Target(
                f"of {worlds} worlds: {name} below {RIVAL}", count, math.ceil(0.9 * worlds), True
            )
            for name, count in below.items()
        ],
        [
            f"{_ROBOTS} robots, {_FEATURES} features, field scale. Mean over {draws} draws of the "
            "robots' clocks, and one with loss. The baseline knows true positions, and loses no "
            "messages."
        ],
    )


def _costs_in(duration_s: float, draws: int, world: int) -> tuple[int, dict[str, float]]:
    """The world, and the cost of each there."""
    bundle = load_bundle(BUNDLE)
    costs: dict[str, list[float]] = {}
    for name, scenario in _scenarios(world, duration_s, draws):
        costs.setdefault(name, []).append(float(fly(scenario, bundle).normalized_cost[-1]))
    return world, {name: float(np.mean(each)) for name, each in costs.items()}


def _scenarios(world: int, duration_s: float, draws: int) -> Iterator[tuple[str, Scenario]]:
    """All flights in one world, from the same starting positions."""
    perception, scale = load_bundle(BUNDLE).manifest.perception, Scenario().scale
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
    yield LOSSY, replace(flight, loss=_LOSS)
    yield RIVAL, replace(flight, controller="decentralized-cvt")
