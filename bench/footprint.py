"""Memory and start-up time of a robot's policy process, against torch and torch_geometric."""

import json
import os
import subprocess
import sys
from time import perf_counter
from typing import Any

from bench import ROOT
from bench.first_tick import TICKED, TICKS
from bench.result import Result, Table, Target, progress
from bench.timing import quartiles, with_quartiles

EDGE, TORCH = "edge", "torch"
_NAMES = {EDGE: "lpac-edge", TORCH: "torch + PyG"}


def measure(runs: int = 3) -> Result:
    """Run separate processes in turn, after one warm-up each for the file cache."""
    processes: dict[str, list[dict[str, float]]] = {EDGE: [], TORCH: []}
    for run in range(runs + 1):
        for kind, results in processes.items():
            progress(f"footprint: {_NAMES[kind]}, {f'run {run} of {runs}' if run else 'warm-up'}")
            result = _run(kind)
            if run:
                results.append(result)
    keys = processes[EDGE][0].keys()
    figures: dict[str, Any] = {
        kind: {key: quartiles([result[key] for result in results]) for key in keys}
        for kind, results in processes.items()
    }
    figures["edge_over_torch"] = {
        key: quartiles(
            [
                ours[key] / theirs[key]
                for ours, theirs in zip(processes[EDGE], processes[TORCH], strict=True)
            ]
        )
        for key in keys
    }
    units = {"first_tick_s": "first tick, s", "rss": "RSS, MB", "private": "private, MB"}
    rows = [
        (
            units[key],
            *(with_quartiles(figures[kind][key]) for kind in (EDGE, TORCH)),
            with_quartiles(figures["edge_over_torch"][key], 3),
        )
        for key in keys
    ]
    ratios = figures["edge_over_torch"]
    return Result(
        "footprint",
        figures,
        [Table("A robot's policy process", ("", *_NAMES.values(), "ratio"), rows)],
        [
            Target("memory (RSS) over torch + PyG's", ratios["rss"]["median"], 1 / 4, False),
            Target("time to first tick over theirs", ratios["first_tick_s"]["median"], 0.1, False),
        ],
        [
            "Time from the start of the process to the end of its first tick, and memory after "
            f"{TICKS} ticks with ten neighbours; warm file cache. The policy alone: no radio, no "
            "autopilot."
        ],
    )


def _run(kind: str) -> dict[str, float]:
    """Time from the process's start to its first tick in s, and its memory in MB."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    start_s = perf_counter()
    with subprocess.Popen(
        [sys.executable, "-m", "bench.first_tick", kind],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout
        ticked = process.stdout.readline()
        first_tick_s = perf_counter() - start_s
        memory = process.stdout.read()
    if ticked != TICKED or process.returncode:
        raise RuntimeError(f"the {_NAMES[kind]} process failed: {process.returncode}")
    return {"first_tick_s": first_tick_s, **json.loads(memory)}
