"""Scenarios, flown by processes."""

from collections.abc import Generator, Sequence
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import NamedTuple

from edge.policy.bundle import Bundle, load_bundle
from lpac.sim.cores import Pool
from lpac.sim.experiment import Scenario, SimulatedFlight, fly


class _Task(NamedTuple):
    number: int
    bundle: str
    scenario: Scenario


class _Flown(NamedTuple):
    number: int
    flight: SimulatedFlight


def fly_all(
    scenarios: Sequence[Scenario], bundle: Path, pool: Pool
) -> Generator[tuple[int, SimulatedFlight], None, None]:
    """Each flight as it is done, with its number. Raises BundleError, ValueError."""
    tasks = [_Task(number, str(bundle), scenario) for number, scenario in enumerate(scenarios)]
    with closing(pool(_fly, tasks)) as flown:
        yield from flown


def _fly(task: _Task) -> _Flown:
    return _Flown(task.number, fly(task.scenario, _bundle(task.bundle)))


@cache
def _bundle(path: str) -> Bundle:
    return load_bundle(Path(path))
