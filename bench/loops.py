"""Lateness of a robot's loops: ten robots in flight on this machine, and one beside a busy process.

The processes are those of a fleet: each with its radio, autopilot and flight log.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

from bench import BUNDLE
from bench.report import Report, Table, Target, progress
from edge.messages.mission import LoopStatus, RobotStatus
from lpac.sim.fleet.flight import fly
from lpac.sim.fleet.layout import FleetScenario
from lpac.sim.fleet.processes import Fleet

LOOPS = ("perception", "policy", "control")
_FLEET = 10
_MISSION_S = 60.0


def measure() -> Report:
    """Two flights, each with a minute of mission."""
    progress(f"loops: {_FLEET} robots fly, about two minutes")
    crowd = _fly(_FLEET)
    progress("loops: one robot flies beside busy processes, about two minutes")
    with _busy():
        disturbed = _fly(1)
    flights = {f"{_FLEET} robots": crowd, "1 robot, every core busy": disturbed}
    rows = []
    figures: dict[str, Any] = {}
    for name, statuses in flights.items():
        for loop in LOOPS:
            of_all = [status.loops[loop] for status in statuses]
            figures.setdefault(name, {})[loop] = _summary(of_all)
            rows.append((name, loop, *_cells(of_all)))
    return Report(
        "loops",
        figures,
        [
            Table(
                "Lateness of the loops, ms: the median robot, and the worst",
                ("", "loop", "p50", "p99", "max", "ticks left out"),
                rows,
            )
        ],
        [
            Target(
                "worst lateness of a control tick over the watchdog's 0.5 s",
                max(status.loops["control"].lateness_max_ms for status in crowd) / 500.0,
                1.0,
                False,
            )
        ],
        [
            "Over the last minute of the mission. The vehicles and the operator share the cores; "
            "a busy process runs Python without a pause, at the same priority."
        ],
    )


def _fly(robots: int) -> list[RobotStatus]:
    """The robots' last statuses of a mission."""
    with tempfile.TemporaryDirectory() as folder:
        scenario = FleetScenario(robots=robots, seed=7, duration_s=_MISSION_S)
        with Fleet(scenario, Path(folder), BUNDLE) as fleet:
            flight = fly(fleet)
    if flight.problem is not None:
        raise RuntimeError(f"the flight did not go as planned: {flight.problem}")
    return [robot.last for robot in flight.robots if robot.last is not None]


@contextmanager
def _busy() -> Iterator[None]:
    """A process without a pause on each core."""
    command = [sys.executable, "-c", "while True: pass"]
    processes = [subprocess.Popen(command) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _summary(loops: Sequence[LoopStatus]) -> dict[str, Any]:
    names = ("lateness_p50_ms", "lateness_p99_ms", "lateness_max_ms", "overruns")
    values = {name: [getattr(loop, name) for loop in loops] for name in names}
    return {
        name: {"median": median(numbers), "worst": max(numbers)} for name, numbers in values.items()
    }


def _cells(loops: Sequence[LoopStatus]) -> tuple[str, ...]:
    summary = _summary(loops)
    cells = [
        f"{summary[name]['median']:.1f}, {summary[name]['worst']:.1f}"
        for name in ("lateness_p50_ms", "lateness_p99_ms", "lateness_max_ms")
    ]
    overruns = summary["overruns"]
    return (*cells, f"{overruns['median']:.0f}, {overruns['worst']:.0f}")
