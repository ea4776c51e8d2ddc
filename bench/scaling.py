"""The simulators of points with growing fleets at constant density."""

import gc
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from time import perf_counter, process_time
from typing import Any

import numpy as np

from bench import BUNDLE
from bench.result import Result, Table, Target, progress
from bench.timing import in_own_process
from bench.usage import usage
from edge.policy.bundle import Bundle, load_bundle
from lpac.sim.batch import BatchedFlights
from lpac.sim.points import SAMPLE_S, fly_points
from lpac.sim.scenario import Scenario

EXACT, BATCHED = "exact", "batched"
# As in training: ten robots and ten features in one world.
_ROBOTS_PER_WORLD = 10
# (robots, simulated seconds, flights)
_FLIGHTS = ((10, 30.0, 3), (100, 6.0, 3), (1000, 2.0, 1))
# A robot's memory grows with time, so all are measured at the same time.
_MEMORY_AT_S = 2.0


def measure(flights: Sequence[tuple[int, float, int]] = _FLIGHTS) -> Result:
    """Fly in separate processes, one at a time; `flights` are (robots, seconds, repeats)."""
    figures: dict[str, dict[str, Any]] = {}
    for robots, duration_s, repeats in flights:
        progress(f"scaling: {robots} robots, {duration_s:g} s, {repeats} times")
        runs: dict[str, list[dict[str, float]]] = {name: [] for name in (EXACT, BATCHED)}
        # Alternate, so that other load on the machine affects all.
        for seed in range(repeats):
            for name, of_simulator in runs.items():
                flight = in_own_process(_measure_flight, name, robots, duration_s, seed)
                of_simulator.append(flight)
        figures[str(robots)] = {
            name: sorted(each, key=lambda run: run["cpu_ms_per_robot_s"])[repeats // 2]
            for name, each in runs.items()
        }
    rows = [
        (
            f"{robots}",
            name,
            f"{run['world_size']}",
            f"{run['duration_s']:g}",
            f"{run['real_time_factor']:.2f}",
            f"{run['cpu_ms_per_robot_s']:.2f}",
            f"{run['memory_mb_per_robot']:.2f}",
        )
        for robots, runs_of in figures.items()
        for name, run in runs_of.items()
    ]
    columns = (
        "robots", "simulator", "world", "simulated, s", "x real time", "CPU ms per robot and s",
        f"MB per robot at {_MEMORY_AT_S:g} s",
    )  # fmt: skip
    return Result(
        "scaling",
        figures,
        [Table("Simulators of points at constant density", columns, rows)],
        list(_targets(figures)),
        [
            "One core each. Field scale; the world's area and its features grow with the robots. "
            "The median of several flights by processor time. Times exclude making the world and "
            "include the coverage cost J once a second; memory includes the world's raster, not "
            "the program."
        ],
    )


def world_for(bundle: Bundle, robots: int) -> Bundle:
    """The bundle with a world for `robots` robots."""
    perception = bundle.manifest.perception
    assert perception
    size = round(perception.world_size * math.sqrt(robots / _ROBOTS_PER_WORLD))
    larger = replace(perception, world_size=size)
    return replace(bundle, manifest=replace(bundle.manifest, perception=larger))


def _targets(figures: dict[str, dict[str, Any]]) -> Iterator[Target]:
    smallest = next(iter(figures))
    for name, limit in ((EXACT, 20.0), (BATCHED, 30.0)):
        factor = figures[smallest][name]["real_time_factor"]
        yield Target(f"{smallest} robots, {name}: times real time", factor, limit, at_least=True)
    memory_mb_per_robot = max(of[BATCHED]["memory_mb_per_robot"] for of in figures.values())
    yield Target(f"{BATCHED}: MB per robot", memory_mb_per_robot, 1.0, at_least=False)


def _measure_flight(name: str, robots: int, duration_s: float, seed: int) -> dict[str, float]:
    bundle = load_bundle(BUNDLE)
    # Allocate the libraries' own memory first.
    small = Scenario(robots=2, duration_s=1.0, random_feature_count=1)
    _fly(name, small, world_for(bundle, 2), lambda _: None)
    gc.freeze()  # as `lpac sim` does
    empty_mb = usage(os.getpid()).resident_mb
    flying_mb = wall_s = cpu_s = 0.0

    def note(time_s: float) -> None:
        nonlocal flying_mb, wall_s, cpu_s
        if time_s == 0.0:
            wall_s, cpu_s = perf_counter(), process_time()
        if time_s <= _MEMORY_AT_S + SAMPLE_S / 2:
            flying_mb = usage(os.getpid()).resident_mb

    scenario = Scenario(
        robots=robots, seed=seed, duration_s=duration_s, random_feature_count=robots
    )
    larger = world_for(bundle, robots)
    _fly(name, scenario, larger, note)
    wall_s, cpu_s = perf_counter() - wall_s, process_time() - cpu_s
    assert larger.manifest.perception
    return {
        "robots": robots,
        "world_size": larger.manifest.perception.world_size,
        "duration_s": duration_s,
        "real_time_factor": duration_s / wall_s,
        "cpu_ms_per_robot_s": 1e3 * cpu_s / robots / duration_s,
        "memory_mb_per_robot": (flying_mb - empty_mb) / robots,
    }


def _fly(name: str, scenario: Scenario, bundle: Bundle, note: Callable[[float], None]) -> None:
    """Fly; call `note` with the simulated time, from 0 to the flight's end."""
    if name == EXACT:
        fly_points(scenario, bundle, lambda moment: note(moment.time_s))
        return
    flights = BatchedFlights([scenario], bundle)
    [prepared], [swarm] = flights.prepared, flights.swarms
    positions_m = []
    for [moment] in flights.moments(prepared.times_s):
        positions_m.append(moment.positions_m)
        note(moment.time_s)
    prepared.record(np.array(positions_m), swarm.message_counts(), swarm.largest_payload)
