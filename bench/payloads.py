"""How large numbers in messages get: what a policy's `payload_limit` is measured by.

Robots refuse payloads beyond ten times the largest number that 200 simulated flights have seen: no
honest robot sends one, and a liar's do not swamp what the others say.
"""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from rich.console import Console
from rich.progress import track

from bench import BUNDLE
from bench.report import Report, Table, Target
from edge.policy.bundle import load_bundle
from lpac.sim.experiment import fly
from lpac.sim.scenario import Scenario

_CORES = 2
_TIMES = 10.0


def measure(flights: int = 200, duration_s: float = 60.0) -> Report:
    """Flights of 2 to 20 robots over worlds of their own, half of them with 30 % loss."""
    scenarios = [
        Scenario(
            robots=2 + seed % 19, duration_s=duration_s, seed=seed, loss=0.3 if seed % 2 else 0.0
        )
        for seed in range(flights)
    ]
    with ProcessPoolExecutor(_CORES, mp_context=get_context("spawn")) as processes:
        largest = list(
            track(
                processes.map(_largest, scenarios),
                "payloads: flights",
                flights,
                console=Console(stderr=True),
            )
        )
    limit = load_bundle(BUNDLE).manifest.payload_limit
    return Report(
        "payloads",
        {"largest": max(largest), "of_each_flight": largest, "limit": limit},
        [
            Table(
                f"The largest number in a payload, of {flights} flights",
                ("", ""),
                [("largest", f"{max(largest):.3g}"), ("the bundle's limit", f"{limit}")],
            )
        ],
        [
            Target(
                f"largest number in a payload, times {_TIMES:g}, over the bundle's limit",
                _TIMES * max(largest) / limit if limit else 0.0,
                1.05,
                at_least=False,
            )
        ],
        [],
    )


def _largest(scenario: Scenario) -> float:
    return fly(scenario, load_bundle(BUNDLE)).largest_payload
