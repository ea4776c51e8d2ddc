"""Robots in flight on this machine: how late their loops are, and what their programs take.

Ten robots, without keys and with them, and one beside busy processes. The processes are those of a
fleet: each robot's with its radio, autopilot and flight log; its watchdog, a process of its own, is
not counted.
"""

import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from operator import attrgetter
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from bench import BUNDLE
from bench.result import Result, Table, Target, progress
from bench.usage import Usage, usage
from edge.messages.mission import LoopStatus
from lpac.analysis.logs import LoggedStatus
from lpac.sim.fleet.flight import fly
from lpac.sim.fleet.processes import Fleet
from lpac.sim.scenario import Scenario

LOOPS = ("perception", "policy", "control")

# Once the mission has begun, all has been loaded that a flight needs.
_SETTLED_S = 3.0
_LOOK_EVERY_S = 1.0


class _Taken(NamedTuple):
    """What a robot's program takes: `cpu_percent` of one core, by thread; the rest as `Usage`."""

    cpu_percent: dict[str, float]
    threads: int
    private_mb: float
    resident_mb: float

    @property
    def all_cpu_percent(self) -> float:
        """All threads together."""
        return sum(self.cpu_percent.values())


class _Flight(NamedTuple):
    """The robots' last statuses of a mission, and what their programs took in it."""

    statuses: list[LoggedStatus]
    taken: list[_Taken]


def measure(robots: int = 10, mission_s: float = 60.0, *, beside_busy: bool = True) -> Result:
    """A flight of so many robots; and with `beside_busy` one of a single robot."""
    progress(f"loops: {robots} robots fly, about two minutes")
    crowd = _fly(robots, mission_s)
    progress(f"loops: {robots} robots with keys fly, about two minutes")
    with_keys = _fly(robots, mission_s, secure=True)
    flights = {
        f"{robots} robots": crowd.statuses,
        f"{robots} robots with keys": with_keys.statuses,
    }
    if beside_busy:
        progress("loops: one robot flies beside busy processes, about two minutes")
        with _busy():
            flights["1 robot, every core busy"] = _fly(1, mission_s).statuses
    rows = []
    figures: dict[str, Any] = {}
    for name, statuses in flights.items():
        for loop in LOOPS:
            of_all = [status.loops[loop] for status in statuses]
            figures.setdefault(name, {})[loop] = _summary(of_all)
            rows.append((name, loop, *_cells(of_all)))
    figures["taken"] = [each._asdict() for each in crowd.taken]
    figures["taken_with_keys"] = [each._asdict() for each in with_keys.taken]
    cpu, private = (
        {
            name: median(what(each) for each in flight.taken)
            for name, flight in (("plain", crowd), ("with keys", with_keys))
        }
        for what in (attrgetter("all_cpu_percent"), attrgetter("private_mb"))
    )
    medians = {
        "processor, % of a core": (cpu["plain"], 4.0),
        "threads": (median(each.threads for each in crowd.taken), 40.0),
        "private memory, MB": (private["plain"], 45.0),
        "processor, % of a core, that keys cost": (cpu["with keys"] - cpu["plain"], 1.0),
        "private memory, MB, that keys cost": (private["with keys"] - private["plain"], 8.0),
    }
    return Result(
        "loops",
        figures,
        [
            Table(
                "Lateness of the loops, ms: the median robot, and the worst",
                ("", "loop", "p50", "p99", "max", "ticks left out"),
                rows,
            ),
            Table(
                f"What each of {robots} robots' programs takes in flight: the median, the most",
                ("", "median", "most"),
                _taken_rows(crowd.taken),
            ),
            Table(
                "The same with keys: messages signed, and TLS",
                ("", "median", "most"),
                _taken_rows(with_keys.taken),
            ),
        ],
        [
            Target(
                "worst lateness of a control tick over the watchdog's 0.5 s",
                max(status.loops["control"].lateness_max_ms for status in crowd.statuses) / 500.0,
                1.0,
                False,
            ),
            *(
                Target(f"{what} of a robot", figure, limit, at_least=False)
                for what, (figure, limit) in medians.items()
            ),
        ],
        [
            "Over the last minute of the mission. The vehicles and the operator share the cores; "
            "a busy process runs Python without a pause, at the same priority."
        ],
    )


def _fly(robots: int, mission_s: float, *, secure: bool = False) -> _Flight:
    looks: list[tuple[float, list[Usage]]] = []
    began_s = looked_s = -math.inf

    def watch(step: str) -> None:
        nonlocal began_s, looked_s
        now_s = time.monotonic()
        if step != "mission":
            return
        began_s = now_s if began_s == -math.inf else began_s
        if now_s - began_s >= _SETTLED_S and now_s - looked_s >= _LOOK_EVERY_S:
            looked_s = now_s
            looks.append((now_s, [usage(robot.pid) for robot in fleet.robots]))

    with tempfile.TemporaryDirectory() as folder:
        scenario = Scenario(robots=robots, seed=7, duration_s=mission_s, secure=secure)
        fleet = Fleet(scenario, Path(folder), BUNDLE)
        flight = fly(fleet, watch=watch)
    if flight.problem is not None:
        raise RuntimeError(f"the flight did not go as planned: {flight.problem}")
    statuses = [robot.last for robot in flight.robots if robot.last is not None]
    (first_s, first), (last_s, last) = looks[0], looks[-1]
    return _Flight(
        statuses,
        [
            _Taken(
                {
                    name: 100.0 * (cpu_s - before.cpu_s.get(name, 0.0)) / (last_s - first_s)
                    for name, cpu_s in after.cpu_s.items()
                },
                *after[1:],
            )
            for before, after in zip(first, last, strict=True)
        ],
    )


def _taken_rows(taken: Sequence[_Taken]) -> list[tuple[str, ...]]:
    names = sorted({name for each in taken for name in each.cpu_percent})
    columns = {
        "processor, % of a core": [each.all_cpu_percent for each in taken],
        **{f"    {name}": [each.cpu_percent.get(name, 0.0) for each in taken] for name in names},
        "threads": [float(each.threads) for each in taken],
        "private memory, MB": [each.private_mb for each in taken],
        "resident memory, MB": [each.resident_mb for each in taken],
    }
    return [
        (name, f"{median(numbers):.2f}", f"{max(numbers):.2f}") for name, numbers in columns.items()
    ]


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
