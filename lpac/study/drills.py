"""Drills: studies in which each flight has a fault, judged by the fault's promises."""

import os
import signal
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from edge.core.logger import show
from edge.core.schema import AtLeastOne, AtLeastZero, Bounded, ConfigError, from_mapping
from edge.core.toml import read_toml
from edge.drivers.registry import open_sensor
from edge.policy.bundle import load_bundle
from lpac.analysis.flight import FlightRecord
from lpac.shipped import SHIPPED_BUNDLE
from lpac.sim.cores import Pool, in_this_process, over_processes
from lpac.sim.drill.faults import FAULTS, Fault
from lpac.sim.drill.field import scenario_of
from lpac.sim.drill.outcome import FlightOutcome, outcome_of
from lpac.sim.engines import flies, require_faults
from lpac.sim.scenario import WORLD_SENSOR
from lpac.sim.sitl.build import require_build
from lpac.study.flights import FlightGroup, KeptFlights, PlannedFlight, require_planned

DrillEngine = Literal["simulated", "mavlink", "px4"]
# CPU use of a robot with its vehicle and its share of a ground, averaged over a flight, is 0.12.
_CORES_EACH = 0.16

# Called with the numbers of flights done and planned, and a remark.
OnProgress = Callable[[int, int, str], object]


@dataclass(frozen=True, slots=True, kw_only=True)
class Drill(Bounded):
    """Flights of each of `faults` (none: all that the engine can do), with seeds from `first_seed`.

    `sensor` is the `type` in robot.toml's [sensor]. Raises ValueError that names the impossible
    value.
    """

    faults: tuple[str, ...] = ()
    seeds: AtLeastOne = 1
    first_seed: AtLeastZero = 0
    robots: Annotated[int, Meta(ge=2, le=10)] = 4
    engine: DrillEngine = "simulated"
    bundle: str = str(SHIPPED_BUNDLE)
    sensor: str = WORLD_SENSOR

    def check_rules(self) -> None:
        """See `Bounded`."""
        faults_of(self.faults, self.engine, "faults:")

    def flights(self, px4_build: Path | None = None) -> list[PlannedFlight]:
        """All flights; those with a common start are adjacent.

        Raises BundleError, ConfigError for the sensor, ValueError for PX4's build.
        """
        bundle, px4 = load_bundle(Path(self.bundle)), ""
        if self.engine == "px4":
            if px4_build is None:
                raise ValueError("engine = 'px4': needs PX4's build folder")
            px4 = str(require_build(px4_build).resolve())
        # Flights of one scenario with equal settings have a common start.
        faults = sorted(
            faults_of(self.faults, self.engine), key=lambda fault: (fault.exact, fault.settings)
        )
        flights = [
            PlannedFlight(
                scenario=scenario_of(fault, seed, self.robots, self.sensor),
                bundle=str(Path(self.bundle).resolve()),
                flown_by=bundle.id,
                engine=self.engine,
                px4_build=px4,
            )
            for seed in range(self.first_seed, self.first_seed + self.seeds)
            for fault in faults
        ]
        flights[0].scenario.perception_of(bundle)
        open_sensor(self.sensor, {}, bundle.manifest)
        return flights


def faults_of(names: Sequence[str], engine: DrillEngine, where: str = "") -> list[Fault]:
    """The named faults, or all that the engine flies. Raises ValueError as `require_faults`."""
    require_faults(engine, names, where)
    return [fault for fault in map(FAULTS.__getitem__, names or FAULTS) if flies(engine, fault)]


def read_drill(path: Path) -> Drill:
    """Read a drill from a TOML file; the bundle's path is relative to its folder.

    Raises ConfigError that names file, key, value and what is allowed.
    """
    table = read_toml(path)
    known = [each.name for each in fields(Drill)]
    for key in table:
        if key not in known:
            raise ConfigError(
                f"{path}: unknown key {key!r}: a file with `faults` is a drill, whose keys are "
                f"{', '.join(known)}"
            )
    drill = from_mapping(Drill, table, str(path))
    return replace(drill, bundle=str(path.parent / drill.bundle))


def fly_drill(
    flights: Sequence[PlannedFlight],
    folder: Path,
    pool: Pool = in_this_process,
    on_progress: OnProgress = lambda *_: None,
) -> dict[PlannedFlight, FlightOutcome]:
    """Fly the flights without a stored outcome in `folder`; returns all, by fault, then seed.

    On the simulated clock they run in a `pool`; in real time, as many at once as this machine can
    carry, and each leaves its logs and a figure in `folder`. Raises OSError.
    """
    one = flights[0]
    do = outcomes_of if one.engine == "simulated" else partial(_in_worker, folder=folder)
    kept = KeptFlights(folder, FlightOutcome, lambda outcome: not outcome.error)
    at_once = 1
    # All fleets use the same PX4 ports.
    if one.engine == "mavlink":
        at_once = int(len(os.sched_getaffinity(0)) / (_CORES_EACH * one.scenario.robots))
    beside = partial(over_processes, at_most=max(1, at_once))
    outcomes: dict[PlannedFlight, FlightOutcome] = {}
    broken = 0
    with closing(kept.fly(do, flights, pool, beside)) as flown:
        for flight, outcome in flown:
            outcomes[flight] = outcome
            broken += not outcome.held
            on_progress(len(outcomes), len(flights), f"{broken} broke a promise" if broken else "")
    places = {name: place for place, name in enumerate(FAULTS)}
    in_order = sorted(
        flights, key=lambda flight: (places[flight.scenario.fault], flight.scenario.seed)
    )
    return {flight: outcomes[flight] for flight in in_order}


def outcomes_of(
    group: FlightGroup, folder: Path | None = None
) -> list[tuple[PlannedFlight, FlightOutcome]]:
    """Fly one fault, in any process; logs and a figure are stored below `folder`.

    Raises BundleError, and ValueError if the bundle has changed.
    """
    [flight] = group
    require_planned(flight)
    fault, engine = FAULTS[flight.scenario.fault], flight.flown_on()
    logs = logs_of(flight, folder) if folder else None

    def flown() -> FlightRecord:
        [record] = engine.fly([flight.scenario], Path(flight.bundle), logs)
        return record

    # Logs of thousands of flights would be too long to read.
    show("error")
    if logs is None:
        return [(flight, outcome_of(fault, flown))]
    # Without a folder, do not load what draws.
    from lpac.sim.drill.logged import fly_logged  # noqa: PLC0415

    return [(flight, fly_logged(fault, flown, logs))]


def logs_of(flight: PlannedFlight, folder: Path) -> Path:
    """Folder of a flight's logs."""
    return folder / f"{flight.scenario.fault}-{flight.scenario.seed}"


def _in_worker(group: FlightGroup, folder: Path) -> list[tuple[PlannedFlight, FlightOutcome]]:
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return outcomes_of(group, folder)
    except KeyboardInterrupt:
        # Its programs have ended. Exit, or the pool's worker would start the next flight.
        os._exit(1)
