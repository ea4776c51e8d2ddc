"""The engines: each flies scenarios and returns a record of each flight."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, Protocol

from edge.core.logger import errors_only
from edge.core.schema import require
from edge.policy.bundle import Bundle, load_bundle, write_bundle
from lpac.analysis.flight import FlightRecord
from lpac.sim.batch import PolicyFailedError, fly_batch
from lpac.sim.drill.faults import FAULTS, Fault
from lpac.sim.drill.field import settings_of, supports
from lpac.sim.drill.processes import MAVLINK, PX4, fly_fault
from lpac.sim.drill.simulated import SUPPORTED, SimulatedDrill
from lpac.sim.fleet.clocked import fly_simulated
from lpac.sim.fleet.flight import fly_programs
from lpac.sim.fleet.layout import require_whole_robots
from lpac.sim.fleet.listener import Report
from lpac.sim.fleet.processes import Fleet
from lpac.sim.points import fly_points, require_points
from lpac.sim.scenario import Scenario

EngineName = Literal["point", "simulated", "mavlink", "px4"]
# Injections of the drill that each engine supports.
INJECTIONS: dict[EngineName, tuple[object, ...]] = {
    "point": (), "simulated": SUPPORTED, "mavlink": MAVLINK, "px4": PX4,
}  # fmt: skip
# Flights of these run one at a time, on an otherwise idle machine.
IN_REAL_TIME: tuple[EngineName, ...] = ("mavlink", "px4")
# Called with a `FlightMoment` of points, or a `FleetMoment`: both have `time_s`, `step`, `stop`.
Watch = Callable[[Any], object]


class Engine(Protocol):
    """One way to fly scenarios.

    With `whole_robots` the robot programs' own loops fly, including takeoff and landing.
    """

    whole_robots: bool

    def require_able(self, scenario: Scenario) -> None:
        """Raise ValueError that names the field this engine does not support."""

    def fly(
        self,
        scenarios: Sequence[Scenario],
        bundle: Bundle | Path,
        folder: Path | None = None,
        watch: Watch | None = None,
    ) -> list[FlightRecord]:
        """Fly the scenarios in order, and return their records.

        Whole robots' logs stay in `folder`, if given. `watch` is called several times a second, and
        may stop the flight; a fault's flight is not watched. If a fleet's script did not reach its
        end, `script` in its record says why.

        Raises BundleError; ValueError for an unsupported scenario, and for points that were stopped
        at the start; OSError, and in real time SimulatedFleetError, LinkError, GroundError or
        VehicleError.
        """


class Points:
    """Point robots under the policy or a baseline.

    Unwatched flights of a policy run in batches, with the same results.
    """

    whole_robots = False

    def require_able(self, scenario: Scenario) -> None:
        """See `Engine`."""
        require_points(scenario)

    def fly(
        self,
        scenarios: Sequence[Scenario],
        bundle: Bundle | Path,
        folder: Path | None = None,
        watch: Watch | None = None,
    ) -> list[FlightRecord]:
        """See `Engine`."""
        loaded = bundle if isinstance(bundle, Bundle) else loaded_bundle(str(bundle))
        if watch is not None or any(scenario.controller != "lpac" for scenario in scenarios):
            return [fly_points(scenario, loaded, watch) for scenario in scenarios]
        try:
            return fly_batch(scenarios, loaded)
        except PolicyFailedError as error:
            raise ValueError(f"{loaded.manifest.name}: {error}") from None


class _WholeRobots(ABC):
    """Fleets, one after another."""

    whole_robots = True

    def fly(
        self,
        scenarios: Sequence[Scenario],
        bundle: Bundle | Path,
        folder: Path | None = None,
        watch: Watch | None = None,
    ) -> list[FlightRecord]:
        """See `Engine`."""
        records = []
        for scenario in scenarios:
            with TemporaryDirectory(prefix="lpac-sim-") as nowhere:
                if isinstance(bundle, Bundle):
                    path = Path(nowhere) / "bundle"
                    write_bundle(bundle, path)
                else:
                    path = bundle
                flown_in = folder or Path(nowhere) / "flight"
                records.append(self._fly(scenario, path, flown_in, watch, logs=bool(folder)))
        return records

    @abstractmethod
    def _fly(
        self, scenario: Scenario, bundle: Path, folder: Path, watch: Watch | None, *, logs: bool
    ) -> FlightRecord: ...


@dataclass(frozen=True, slots=True)
class ClockedRobots(_WholeRobots):
    """Whole robots on simulated vehicles and one simulated clock, all in this process.

    `recorded` is the folder of an earlier flight whose policy outputs are replayed.
    """

    report: Report = lambda _: None
    recorded: Path | None = None

    def require_able(self, scenario: Scenario) -> None:
        """See `Engine`."""
        scenario.require_default("robots on a simulated clock", "transport")
        require_whole_robots(scenario)
        _require_fault("simulated", scenario)

    def _fly(
        self, scenario: Scenario, bundle: Path, folder: Path, watch: Watch | None, *, logs: bool
    ) -> FlightRecord:
        if scenario.fault:
            with errors_only():
                drill = drill_of(str(bundle), load_bundle(bundle).id)
                return drill.fly(scenario, folder if logs else None)
        return fly_simulated(
            scenario, folder, bundle, self.report, watch, logs=logs, recorded=self.recorded
        )


@dataclass(frozen=True, slots=True)
class Programs(_WholeRobots):
    """A program for each robot, in real time, on simulated vehicles or on PX4s of a build.

    `carries` measures how many robots this machine can run, once the fleet is laid out; it returns
    None if not measured.
    """

    px4_build: Path | None = None
    report: Report = lambda _: None
    carries: Callable[[], int | None] = lambda: None

    def require_able(self, scenario: Scenario) -> None:
        """See `Engine`."""
        scenario.require_default("programs in real time", "loss", "delay_s")
        require_whole_robots(scenario)
        _require_fault("px4" if self.px4_build else "mavlink", scenario)

    def _fly(
        self, scenario: Scenario, bundle: Path, folder: Path, watch: Watch | None, *, logs: bool
    ) -> FlightRecord:
        fault = FAULTS.get(scenario.fault)
        settings = settings_of(fault) if fault else {}
        fleet = Fleet(
            scenario,
            folder,
            bundle,
            px4_build=self.px4_build,
            settings=settings,
            report=self.report,
        )
        if fault:
            return fly_fault(fleet, fault)
        fleet.carried = self.carries()
        return fly_programs(fleet, self.report, watch or (lambda _: None))


def engine_of(
    name: EngineName, px4_build: Path | None = None, report: Report = lambda _: None
) -> Engine:
    """The engine of that name; `report` gets the progress of a fleet.

    Raises ValueError for an unknown name, and for px4 without its build.
    """
    require(EngineName, name, "engine")
    if name == "px4" and px4_build is None:
        raise ValueError("engine = 'px4': needs PX4's build folder: give px4_build")
    if name == "point":
        return Points()
    return ClockedRobots(report) if name == "simulated" else Programs(px4_build, report)


def flies(engine: EngineName, fault: Fault) -> bool:
    """Whether the engine supports all injections of a fault."""
    return supports(INJECTIONS[engine], fault)


def require_faults(engine: EngineName, names: Sequence[str], where: str) -> None:
    """Raise ValueError, which begins with `where`, unless the engine flies all these faults."""
    for name in names:
        if name not in FAULTS:
            raise ValueError(f"{where} {name}: no such fault; `lpac drill --list` shows all")
    others = [name for name in names if not flies(engine, FAULTS[name])]
    if others:
        raise ValueError(
            f"{where} {', '.join(others)}: {engine} cannot do it; `lpac drill --list` shows which "
            "engines can"
        )


def _require_fault(engine: EngineName, scenario: Scenario) -> None:
    if not scenario.fault:
        return
    if scenario.robots < 2:
        raise ValueError(f"robots = {scenario.robots}: must be at least 2 for a fault")
    require_faults(engine, (scenario.fault,), "fault =")


def fly(
    scenario: Scenario,
    bundle: Bundle | Path,
    watch: Watch | None = None,
    *,
    engine: EngineName = "point",
    folder: Path | None = None,
    px4_build: Path | None = None,
    report: Report = lambda _: None,
) -> FlightRecord:
    """Fly one scenario on the engine of that name; `bundle` flies, or sizes a baseline's maps.

    `folder` keeps the logs of whole robots. Raises what `engine_of` and `Engine.fly` do, and
    ValueError for `watch` with a fault.
    """
    if scenario.fault and watch is not None:
        raise ValueError(f"fault = {scenario.fault}: cannot be watched: leave out watch")
    chosen = engine_of(engine, px4_build, report)
    chosen.require_able(scenario)
    loaded = load_bundle(bundle) if engine == "point" and isinstance(bundle, Path) else bundle
    # A failing policy ends a batch; with a watcher, points show how the robots react to it.
    [record] = chosen.fly([scenario], loaded, folder, watch or (lambda _: None))
    return record


def require_flown(record: FlightRecord) -> None:
    """Raise ValueError for a flight without a mission."""
    problem = record.script.problem
    if problem is not None or not len(record.curve_time_s):
        raise ValueError(f"the flight came to nothing: {problem or 'nobody flew'}")


# Cached, so that flights share their start.
@lru_cache(maxsize=1)
def drill_of(bundle: str, bundle_id: str) -> SimulatedDrill:
    """The drill with the bundle at a path; the id tells a changed bundle from the cached one."""
    return SimulatedDrill(Path(bundle))


@cache
def loaded_bundle(path: str) -> Bundle:
    """The bundle at a path, read once in each process. Raises BundleError."""
    return load_bundle(Path(path))
