"""Scenarios, flown: points and whole robots on a clock by processes, programs in real time."""

from collections.abc import Generator, Sequence
from contextlib import closing
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from edge.policy.bundle import Bundle, load_bundle
from lpac.analysis.flight import FlightRecord
from lpac.sim.cores import Pool
from lpac.sim.experiment import SimulatedFlight, fly
from lpac.sim.fleet.clocked import fly_simulated
from lpac.sim.fleet.flight import FleetFlight
from lpac.sim.fleet.flight import fly as fly_fleet
from lpac.sim.fleet.processes import Fleet
from lpac.sim.scenario import Scenario


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


class _WholeTask(NamedTuple):
    number: int
    bundle: str
    scenario: Scenario


class _WholeFlown(NamedTuple):
    number: int
    record: FlightRecord


def fly_whole(
    scenarios: Sequence[Scenario], bundle: Path, pool: Pool
) -> Generator[tuple[int, FlightRecord], None, None]:
    """Each flight of whole robots on a simulated clock as it is done, with its number.

    Raises BundleError; ValueError if one came to no mission.
    """
    tasks = [_WholeTask(n, str(bundle), scenario) for n, scenario in enumerate(scenarios)]
    with closing(pool(_fly_whole, tasks)) as flown:
        yield from flown


def _fly_whole(task: _WholeTask) -> _WholeFlown:
    with TemporaryDirectory() as folder:
        flown = fly_simulated(task.scenario, Path(folder), Path(task.bundle))
    return _WholeFlown(task.number, _record(flown))


def fly_programs(
    scenario: Scenario,
    folder: Path,
    bundle: Path,
    px4_build: Path | None = None,
) -> FlightRecord:
    """A flight of a program for each robot, in real time; its logs stay in `folder`.

    Their vehicles are PX4s of that build, or simulated. Raises what `lpac sim` does, and ValueError
    if it came to no mission.
    """
    return _record(fly_fleet(Fleet(scenario, folder, bundle, px4_build=px4_build)))


def _record(flown: FleetFlight) -> FlightRecord:
    if flown.problem is not None or not len(flown.record.curve_time_s):
        raise ValueError(f"the flight came to nothing: {flown.problem or 'nobody flew'}")
    return flown.record


@cache
def _bundle(path: str) -> Bundle:
    return load_bundle(Path(path))
