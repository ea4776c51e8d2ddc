"""Speed of whole robots on one simulated clock, relative to real time, on one core."""

import gc
import tempfile
from pathlib import Path
from time import perf_counter, process_time

from bench import BUNDLE
from bench.result import Result, Table, Target, progress
from bench.timing import in_own_process
from edge.core.logger import show
from lpac.sim.engines import require_flown
from lpac.sim.fleet.clocked import fly_simulated
from lpac.sim.scenario import Scenario


def measure(robots: int = 10, mission_s: float = 20.0, runs: int = 3) -> Result:
    """Fly in separate processes, one at a time, from takeoff to landing."""
    flights = []
    for run in range(runs):
        progress(f"simulated: {robots} robots, flight {run + 1} of {runs}")
        flights.append(in_own_process(_fly, robots, mission_s))
    flights.sort(key=lambda flight: flight["real_time_factor"])
    median = flights[runs // 2]
    return Result(
        "simulated",
        {str(robots): flights},
        [
            Table(
                "Whole robots, vehicles, radio and ground on one simulated clock, one core",
                ("robots", "simulated, s", "x real time", "x by CPU", "CPU ms per robot and s"),
                [
                    (
                        f"{robots}",
                        f"{median['simulated_s']:.0f}",
                        f"{median['real_time_factor']:.2f}",
                        f"{median['simulated_s'] / median['cpu_s']:.2f}",
                        f"{1e3 * median['cpu_s'] / robots / median['simulated_s']:.1f}",
                    )
                ],
            )
        ],
        [
            Target(
                f"{robots} whole robots: times real time",
                median["real_time_factor"],
                10.0,
                at_least=True,
            )
        ],
        [
            f"`lpac sim --vehicle simulated` from takeoff to landing with {mission_s:g} s of "
            "mission, without loading the program. Median of several equal flights."
        ],
    )


def _fly(robots: int, mission_s: float) -> dict[str, float]:
    show("error")
    gc.freeze()  # loaded modules stay
    with tempfile.TemporaryDirectory() as folder:
        wall_s, cpu_s = perf_counter(), process_time()
        scenario = Scenario(robots=robots, seed=3, duration_s=mission_s)
        flight = fly_simulated(scenario, Path(folder), BUNDLE)
        wall_s, cpu_s = perf_counter() - wall_s, process_time() - cpu_s
    require_flown(flight)
    simulated_s = flight.script.began_s["end"]
    return {
        "simulated_s": simulated_s,
        "wall_s": wall_s,
        "cpu_s": cpu_s,
        "real_time_factor": simulated_s / wall_s,
    }
