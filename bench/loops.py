"""Robots in flight on this machine: lateness of their loops, and resources of their programs.

Ten robots, without and with keys. Each robot's process has its radio, autopilot and flight log, as
in a fleet; its watchdog, another process, is not counted.
"""

import math
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from bench import BUNDLE
from bench.result import Result, Table, Target, progress
from bench.usage import Usage, usage
from edge.messages.mission import LoopStatus
from lpac.analysis.logs import LoggedStatus
from lpac.sim.engines import require_flown
from lpac.sim.fleet.flight import FleetMoment, fly_programs
from lpac.sim.fleet.processes import Fleet
from lpac.sim.scenario import Scenario

LOOPS = ("perception", "policy", "control")
PLAIN, WITH_KEYS = "without keys", "with keys"

# Time after the mission's begin, when everything is loaded.
_SETTLED_S = 3.0
_LOOK_EVERY_S = 1.0


class _Taken(NamedTuple):
    """Resources of a robot's program: `cpu_percent` of one core, by thread; the rest as `Usage`."""

    cpu_percent: dict[str, float]
    threads: int
    private_mb: float
    resident_mb: float

    @property
    def all_cpu_percent(self) -> float:
        """Sum over all threads."""
        return sum(self.cpu_percent.values())


class _Flight(NamedTuple):
    """The robots' last statuses of a mission, and their programs' resources."""

    statuses: list[LoggedStatus]
    taken: list[_Taken]

    def of(self, loop: str) -> list[LoopStatus]:
        """Status of a loop of each robot."""
        return [status.loops[loop] for status in self.statuses]


def measure(robots: int = 10, mission_s: float = 60.0) -> Result:
    """Fly two flights of `robots` robots."""
    flights: dict[str, _Flight] = {}
    for keys in (PLAIN, WITH_KEYS):
        progress(f"loops: {robots} robots fly {keys}, about two minutes")
        flights[keys] = _fly(robots, mission_s, secure=keys == WITH_KEYS)
    plain, with_keys = (
        (
            median(each.all_cpu_percent for each in flight.taken),
            median(each.private_mb for each in flight.taken),
        )
        for flight in flights.values()
    )
    taken = flights[PLAIN].taken
    late_ms = max(each.loops["control"].lateness_max_ms for each in flights[PLAIN].statuses)
    return Result(
        "loops",
        {
            keys: {
                "lateness": {loop: _summary(flight.of(loop)) for loop in LOOPS},
                "taken": [each._asdict() for each in flight.taken],
            }
            for keys, flight in flights.items()
        },
        [
            Table(
                f"Lateness of {robots} robots' loops, ms: the median robot, and the worst",
                ("", "loop", "p50", "p99", "max", "missed ticks"),
                [
                    (keys, loop, *_cells(flight.of(loop)))
                    for keys, flight in flights.items()
                    for loop in LOOPS
                ],
            ),
            *(
                Table(
                    f"Resources of each of {robots} robots' programs in flight, {keys}",
                    ("", "median", "most"),
                    _taken_rows(flight.taken),
                )
                for keys, flight in flights.items()
            ),
        ],
        [
            Target(what, measured, limit, at_least=False)
            for what, measured, limit in (
                ("worst lateness of a control tick over the watchdog's 0.5 s", late_ms / 500.0, 1),
                ("processor, % of a core of a robot", plain[0], 4),
                ("threads of a robot", median(each.threads for each in taken), 40),
                ("private memory of a robot, MB", plain[1], 45),
                ("processor, % of a core, that keys cost", with_keys[0] - plain[0], 1),
                ("private memory, MB, that keys cost", with_keys[1] - plain[1], 8),
            )
        ],
        ["Over the last minute of the mission. Vehicles and operator share the cores."],
    )


def _fly(robots: int, mission_s: float, *, secure: bool) -> _Flight:
    looks: list[tuple[float, list[Usage]]] = []
    began_s = looked_s = -math.inf

    def watch(moment: FleetMoment) -> None:
        nonlocal began_s, looked_s
        now_s = time.monotonic()
        if moment.step != "mission":
            return
        began_s = now_s if began_s == -math.inf else began_s
        if now_s - began_s >= _SETTLED_S and now_s - looked_s >= _LOOK_EVERY_S:
            looked_s = now_s
            looks.append((now_s, [usage(robot.pid) for robot in fleet.robots]))

    with tempfile.TemporaryDirectory() as folder:
        scenario = Scenario(robots=robots, seed=7, duration_s=mission_s, secure=secure)
        fleet = Fleet(scenario, Path(folder), BUNDLE)
        flight = fly_programs(fleet, watch=watch)
    require_flown(flight)
    statuses = [each.last for each in flight.script.programs if each.last is not None]
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
