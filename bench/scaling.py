"""The simulator with more and more robots at constant density."""

import gc
import math
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from time import perf_counter, process_time
from typing import Any

from bench import BUNDLE
from bench.memory import memory_mb
from bench.report import Report, Table, Target, progress
from edge.core.coverage import coverage_cost
from edge.policy.bundle import Bundle, load_bundle
from lpac.sim.experiment import SAMPLE_S, Scenario, SimulatedFlight, fly

# Of training: ten robots and ten features in one world.
_ROBOTS_PER_WORLD = 10
# (robots, simulated seconds, flights)
_FLIGHTS = ((10, 30.0, 3), (100, 6.0, 1), (1000, 2.0, 1))
# Robots see more of the world the longer they fly, so all are weighed at the same age.
_MEMORY_AT_S = 2.0


def measure(flights: Sequence[tuple[int, float, int]] = _FLIGHTS) -> Report:
    """Flights in processes of their own, one at a time; `flights` are robots, seconds, repeats."""
    figures: dict[str, Any] = {}
    with ProcessPoolExecutor(
        max_workers=1, max_tasks_per_child=1, mp_context=get_context("spawn")
    ) as processes:
        for robots, duration_s, repeats in flights:
            progress(f"scaling: {robots} robots, {duration_s:g} s, {repeats} times")
            runs = [
                processes.submit(_measure_flight, robots, duration_s, seed).result()
                for seed in range(repeats)
            ]
            runs.sort(key=lambda run: float(run["real_time_factor"]))
            figures[str(robots)] = runs[repeats // 2]
    rows = [
        (
            f"{robots}",
            f"{run['world_size']}",
            f"{run['duration_s']:g}",
            f"{run['real_time_factor']:.2f}",
            f"{run['cpu_ms_per_robot_s']:.2f}",
            f"{run['memory_mb_per_robot']:.2f}",
            f"{100 * run['cost_evaluation_share']:.0f} %",
        )
        for robots, run in figures.items()
    ]
    columns = (
        "robots", "world", "simulated, s", "x real time", "CPU ms per robot and s",
        f"MB per robot at {_MEMORY_AT_S:g} s", "cost J's share",
    )  # fmt: skip
    smallest = figures[str(flights[0][0])]
    return Report(
        "scaling",
        figures,
        [Table("Simulator at constant density, one core", columns, rows)],
        [
            Target(
                f"{flights[0][0]} robots: times real time",
                smallest["real_time_factor"],
                20.0,
                at_least=True,
            )
        ],
        [
            "Field scale; the world's area and its features grow with the robots. Of several "
            "flights the median. Real time leaves out making the world, but includes the coverage "
            "cost J once a second; memory includes the world's raster, but not the program."
        ],
    )


def world_for(bundle: Bundle, robots: int) -> Bundle:
    """The bundle for a world with room for so many robots."""
    perception = bundle.manifest.perception
    assert perception
    size = round(perception.world_size * math.sqrt(robots / _ROBOTS_PER_WORLD))
    larger = replace(perception, world_size=size)
    return replace(bundle, manifest=replace(bundle.manifest, perception=larger))


def _measure_flight(robots: int, duration_s: float, seed: int) -> dict[str, float]:
    bundle = world_for(load_bundle(BUNDLE), robots)
    # What the libraries allocate once is not the robots'.
    fly(Scenario(robots=1, duration_s=1.0, random_feature_count=1), world_for(bundle, 1))
    gc.freeze()  # as `lpac sim` does
    empty_mb = memory_mb()["rss"]
    flying_mb = wall_s = cpu_s = 0.0

    def note(time_s: float) -> None:
        nonlocal flying_mb, wall_s, cpu_s
        if time_s == 0.0:
            wall_s, cpu_s = -perf_counter(), -process_time()
        if time_s <= min(_MEMORY_AT_S, duration_s) + SAMPLE_S / 2:
            flying_mb = memory_mb()["rss"]
        if time_s >= duration_s:
            wall_s, cpu_s = wall_s + perf_counter(), cpu_s + process_time()

    scenario = Scenario(
        robots=robots, seed=seed, duration_s=duration_s, random_feature_count=robots
    )
    flight = fly(scenario, bundle, note)
    return {
        "robots": robots,
        "world_size": flight.perception.world_size,
        "duration_s": duration_s,
        "real_time_factor": duration_s / wall_s,
        "cpu_ms_per_robot_s": 1e3 * cpu_s / robots / duration_s,
        "memory_mb_per_robot": (flying_mb - empty_mb) / robots,
        "cost_evaluation_share": _cost_evaluation_s(flight) / wall_s,
    }


def _cost_evaluation_s(flight: SimulatedFlight) -> float:
    """What evaluating J took in the flight, but for the one at its start."""
    start_s = perf_counter()
    for time_s in flight.cost_time_s[1:]:
        positions_m = flight.positions_m[round(time_s / SAMPLE_S)]
        coverage_cost(flight.importance, flight.scenario.scale.position_to_model(positions_m))
    return perf_counter() - start_s
