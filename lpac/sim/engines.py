"""The engines: each flies scenarios, and what comes of a flight is its record."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, Protocol

from edge.policy.bundle import Bundle, load_bundle
from lpac.analysis.flight import FlightRecord
from lpac.sim.batch import PolicyFailedError, fly_batch
from lpac.sim.experiment import fly, require_points
from lpac.sim.fleet.clocked import fly_simulated
from lpac.sim.fleet.flight import FleetFlight
from lpac.sim.fleet.flight import fly as fly_fleet
from lpac.sim.fleet.layout import require_whole_robots
from lpac.sim.fleet.processes import Fleet
from lpac.sim.scenario import Scenario

EngineName = Literal["point", "simulated", "mavlink", "px4"]
# Flights of these go one after another, with nothing beside them.
IN_REAL_TIME: tuple[EngineName, ...] = ("mavlink", "px4")


class Engine(Protocol):
    """One way to fly scenarios.

    With `whole_robots` the programs' own loops fly, with takeoff and landing.
    """

    whole_robots: bool

    def require_able(self, scenario: Scenario) -> None:
        """Raise ValueError that names what this engine cannot do."""

    def fly(
        self, scenarios: Sequence[Scenario], bundle: Path, folder: Path | None = None
    ) -> list[FlightRecord]:
        """The record of each, in their order; whole robots' logs stay in `folder`, if there is one.

        Raises BundleError; ValueError for what it cannot do, and for a flight that came to nothing;
        OSError, and in real time FleetError, LinkError, GroundError or VehicleError.
        """


class Points:
    """Points that fly what the robots' loops decide, or a baseline.

    Several flights of a policy go together, in batches, and come out the same.
    """

    whole_robots = False

    def require_able(self, scenario: Scenario) -> None:
        """See `Engine`."""
        require_points(scenario)

    def fly(
        self, scenarios: Sequence[Scenario], bundle: Path, folder: Path | None = None
    ) -> list[FlightRecord]:
        """See `Engine`."""
        loaded = loaded_bundle(str(bundle))
        if any(scenario.controller != "lpac" for scenario in scenarios):
            return [fly(scenario, loaded).record for scenario in scenarios]
        try:
            return [flown.record for flown in fly_batch(scenarios, loaded)]
        except PolicyFailedError as error:
            raise ValueError(f"{bundle}: {error}") from None


class ClockedRobots:
    """Whole robots on simulated vehicles and one simulated clock, all in this process."""

    whole_robots = True

    def require_able(self, scenario: Scenario) -> None:
        """See `Engine`."""
        require_whole_robots(scenario)

    def fly(
        self, scenarios: Sequence[Scenario], bundle: Path, folder: Path | None = None
    ) -> list[FlightRecord]:
        """See `Engine`."""
        records = []
        for scenario in scenarios:
            with _folder_or_none(folder) as kept:
                flown = fly_simulated(scenario, kept, bundle, logs=folder is not None)
                records.append(_record(flown))
        return records


class Programs:
    """A program for each robot, in real time, on simulated vehicles or on PX4s of a build."""

    whole_robots = True

    def __init__(self, px4_build: Path | None) -> None:
        self._px4_build = px4_build

    def require_able(self, scenario: Scenario) -> None:
        """See `Engine`."""
        scenario.require_default("programs in real time", "loss", "delay_s")
        require_whole_robots(scenario)

    def fly(
        self, scenarios: Sequence[Scenario], bundle: Path, folder: Path | None = None
    ) -> list[FlightRecord]:
        """See `Engine`."""
        records = []
        for scenario in scenarios:
            with _folder_or_none(folder) as kept:
                fleet = Fleet(scenario, kept, bundle, px4_build=self._px4_build)
                records.append(_record(fly_fleet(fleet)))
        return records


def engine_of(name: EngineName, px4_build: Path | None = None) -> Engine:
    """The engine of that name; PX4s alone need their build. Raises ValueError."""
    if name == "px4" and px4_build is None:
        raise ValueError("px4: needs PX4's build folder")
    if name == "point":
        return Points()
    return ClockedRobots() if name == "simulated" else Programs(px4_build)


@contextmanager
def _folder_or_none(folder: Path | None) -> Iterator[Path]:
    """One that is gone afterwards if none is given."""
    if folder is not None:
        yield folder
        return
    with TemporaryDirectory() as temporary:
        yield Path(temporary)


def _record(flown: FleetFlight) -> FlightRecord:
    if flown.problem is not None or not len(flown.record.curve_time_s):
        raise ValueError(f"the flight came to nothing: {flown.problem or 'nobody flew'}")
    return flown.record


@cache
def loaded_bundle(path: str) -> Bundle:
    """The bundle at a path, read once in each process. Raises BundleError."""
    return load_bundle(Path(path))
