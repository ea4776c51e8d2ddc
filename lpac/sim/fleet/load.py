"""Measurement of how many robots this machine can run in real time.

`python -m lpac.sim.fleet.load BUNDLE` is one of its worker processes.
"""

import json
import os
import statistics
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Literal

from edge.policy.bundle import load_bundle
from lpac.sim.points import fly_points
from lpac.sim.programs import python_program
from lpac.sim.scenario import Scenario

# Units of work per second that one robot takes, program and vehicle. A core does 27 a second. A
# PX4 takes 0.1 to 0.2 of a core and a robot's program 0.05 to 0.14, so two cores run three.
_UNITS_PER_S = {"mavlink": 3.0, "px4": 8.0}

# Share of the cores for robots. The rest is for bursts: programs that start, and other load.
_SHARE_TO_USE = 0.55
_ROUNDS = 5
_ROUND_S = 0.4
_MAX_WORKERS = 8
# One unit of work: two point robots fly for two seconds.
_UNIT = Scenario(robots=2, duration_s=2.0)


def robots_carried(bundle: Path, vehicle: Literal["mavlink", "px4"]) -> float:
    """Number of robots that this machine can fly in real time, under its present load.

    The measurement takes two seconds, and loads all cores that this process may use.

    Raises OSError or BundleError for a bundle that cannot be loaded.
    """
    load_bundle(bundle)
    return _SHARE_TO_USE * _units_per_s(bundle) / _UNITS_PER_S[vehicle]


def _units_per_s(bundle: Path) -> float:
    """Speed of all cores together, as the median of rounds, to ignore short bursts of load."""
    with ExitStack() as stack:
        workers = [
            stack.enter_context(
                subprocess.Popen(
                    python_program("lpac.sim.fleet.load", str(bundle)),
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                )
            )
            for _ in range(min(len(os.sched_getaffinity(0)), _MAX_WORKERS))
        ]  # fmt: skip
        for worker in workers:
            assert worker.stdout is not None
            worker.stdout.readline()
        for worker in workers:
            assert worker.stdin is not None
            worker.stdin.close()
        rounds = [json.load(worker.stdout) for worker in workers if worker.stdout is not None]
    return statistics.median(map(sum, zip(*rounds, strict=True)))


def _work(bundle_path: Path) -> None:
    """Print a line when ready, wait for the end of stdin, then print each round's units/s."""
    bundle = load_bundle(bundle_path)
    fly_points(_UNIT, bundle)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    sys.stdin.read()
    units_per_s = []
    for _ in range(_ROUNDS):
        began_s, units = time.monotonic(), 0
        while (past_s := time.monotonic() - began_s) < _ROUND_S:
            fly_points(_UNIT, bundle)
            units += 1
        units_per_s.append(units / past_s)
    json.dump(units_per_s, sys.stdout)


if __name__ == "__main__":
    _work(Path(sys.argv[1]))
