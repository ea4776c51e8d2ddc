"""One scripted flight of a fleet of programs, in real time."""

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from edge.core.world import rasterize
from lpac.analysis.coverage import Coverage
from lpac.analysis.flight import (
    FlightRecord,
    ProgramRecord,
    ScriptRecord,
    changes_of,
)
from lpac.analysis.logs import LoggedStatus, Logs, read_files, simulated_name
from lpac.analysis.missions import find_missions, record_of, whole_record
from lpac.analysis.truth import TRUTH, TrueTrack, write_truth
from lpac.ground.station.client import GroundError
from lpac.sim.description import FIELD_SCALE
from lpac.sim.fleet.ground import GroundProgram
from lpac.sim.fleet.layout import WORLD, Layout
from lpac.sim.fleet.listener import Report, Statuses
from lpac.sim.fleet.pilot import Pilot, perturbations
from lpac.sim.fleet.processes import Backlog, Fleet, OverloadError, Usage, process_usage
from lpac.sim.fleet.scripted import ScriptedFlight
from lpac.sim.fleet.vehicles import SimulatedVehicles, VehicleError
from lpac.sim.sitl.build import Px4Build
from lpac.sim.sitl.ground_station import RealVehicles


@dataclass(frozen=True, slots=True)
class FleetMoment:
    """State of a fleet at `time_s` since the script's start; `statuses` are by robot id.

    `stop` ends the mission: all return and land. Before takeoff it ends the script.
    """

    time_s: float
    step: str
    statuses: Statuses
    stop: Callable[[], None]


def fly_programs(
    fleet: Fleet,
    report: Report = lambda _: None,
    watch: Callable[[FleetMoment], object] = lambda _: None,
) -> FlightRecord:
    """Run a fleet and its ground, and fly the script; `watch` is called several times a second.

    Ctrl-C, the end of a vehicle, or an overloaded machine lands all. Raises SimulatedFleetError if
    a robot's program ends before all are connected; OSError, LinkError, GroundError or VehicleError
    if a part cannot start.
    """
    scenario, moments = fleet.layout.scenario, dict[str, _Moment]()
    flying_by_hand: list[Pilot] = []
    problem, overloaded = None, False
    with (
        fleet,
        GroundProgram(fleet.fleet_toml, fleet.name) as ground,
        _piloted_vehicles(fleet) if scenario.failures else nullcontext() as seen,
    ):
        if seen is not None:
            with seen.stepped:
                for vehicle in seen.vehicles:
                    vehicle.rc_connected = True

        def begin(name: str) -> None:
            if name == "preflight":
                fleet.begin()
            report("landing all robots where they are" if name == "land" else name)
            moments.setdefault(name, _Moment.of(fleet, ground))
            if name == "mission" and seen is not None:
                now_s = ground.subscriber.now_s
                flying_by_hand[:] = [
                    Pilot(seen.vehicles[failure.robot], fleet.layout, failure, now_s)
                    for failure in scenario.failures
                ]

        def look() -> None:
            if flight.at == "assemble":
                fleet.require_running()
            if flight.at != "land":
                fleet.vehicles.require_running()
            if flight.at not in ("assemble", "land"):
                fleet.require_keeping_up()
            if seen is not None and flight.at == "mission":
                robots = ground.subscriber.snapshot.robots
                with seen.stepped:
                    for pilot in flying_by_hand:
                        pilot.look(ground.subscriber.now_s, robots[pilot.robot].status)
            show()

        def show() -> None:
            time_s = ground.subscriber.now_s - flight.began_s["assemble"]
            watch(FleetMoment(time_s, flight.at, fleet.listener.statuses(), flight.stop))

        flight = ScriptedFlight(
            ground.subscriber, fleet.fleet_toml, scenario.duration_s,
            perturb=perturbations(scenario.failures),
            on_step=begin, report=fleet.report_unless_behind,
        )  # fmt: skip
        try:
            try:
                problem = ground.subscriber.carry_out(flight.fly(), look)
            except GroundError:
                raise
            except BaseException:
                ground.subscriber.carry_out(flight.land(), show)
                raise
        except (OverloadError, VehicleError, GroundError) as error:
            problem, overloaded = str(error), isinstance(error, OverloadError)
        except KeyboardInterrupt:
            problem = "stopped by Ctrl-C"
        moments["end"] = _Moment.of(fleet, ground)
        lateness = fleet.lateness()
    # PX4's logs are complete only after its end.
    return _record(fleet, flight, moments, problem, lateness, overloaded)


@contextmanager
def _piloted_vehicles(fleet: Fleet) -> Iterator[SimulatedVehicles | RealVehicles]:
    """The vehicles, as pilots see and fly them."""
    if fleet.simulated is not None:
        yield fleet.simulated
        return
    assert isinstance(fleet.vehicles, Px4Build)
    with RealVehicles(fleet.vehicles, WORLD) as vehicles:
        yield vehicles


class _Moment(NamedTuple):
    """CPU time and memory of all processes at one time."""

    time_s: float
    usages: tuple[Usage, ...]
    launcher: Usage

    @classmethod
    def of(cls, fleet: Fleet, ground: GroundProgram) -> "_Moment":
        programs = [process_usage(os.getpid())]
        if ground.running:
            programs.append(process_usage(ground.pid))
        if isinstance(fleet.vehicles, Px4Build):
            programs += map(process_usage, fleet.vehicles.pids())
        return cls(
            time.monotonic(),
            tuple(robot.usage() for robot in fleet.robots),
            Usage(*map(sum, zip(*programs, strict=True))),
        )


def _record(
    fleet: Fleet,
    flight: ScriptedFlight,
    moments: Mapping[str, _Moment],
    problem: str | None,
    lateness: Backlog,
    overloaded: bool,
) -> FlightRecord:
    start_s = moments["assemble"].time_s if "assemble" in moments else moments["end"].time_s
    began_s = {name: at_s - start_s for name, at_s in flight.began_s.items()}
    began_s["end"] = moments["end"].time_s - start_s
    # Figures are of the mission, or of the whole flight without one.
    first = moments.get("mission", next(iter(moments.values())))
    last = moments.get("return", moments["end"])
    unix_s = time.time() - time.monotonic()
    logs = [robot.logs() for robot in fleet.robots]
    return flight_of(
        fleet.layout,
        read_files([path for own in logs for path in own]),
        fleet.vehicles.tracks(),
        unix_s,
        start_s,
        [
            RobotUsage(
                _share(first, last, first.usages[robot], last.usages[robot]),
                moments["end"].usages[robot].peak_memory_mb,
                tuple(str(path.relative_to(fleet.folder)) for path in own),
            )
            for robot, own in enumerate(logs)
        ],
        fleet.folder,
        ScriptRecord(
            vehicle="px4" if fleet.simulated is None else "mavlink",
            began_s=began_s,
            problem=problem,
            commands=flight.recorded_commands(),
            launcher=(
                _share(first, last, first.launcher, last.launcher),
                moments["end"].launcher.peak_memory_mb,
            ),
            vehicles_behind_s=lateness.vehicles_s,
            robots_behind_s=lateness.robots_s,
            overloaded=overloaded,
        ),
    )


class RobotUsage(NamedTuple):
    """CPU share, memory and logs of one robot's program."""

    cpu_share: float = 0.0
    peak_memory_mb: float = 0.0
    logs: tuple[str, ...] = ()


def flight_of(
    layout: Layout,
    logs: Logs,
    tracks: Sequence[TrueTrack],
    unix_s: float,
    start_s: float,
    usages: Sequence[RobotUsage],
    truth_in: Path | None,
    script: ScriptRecord,
) -> FlightRecord:
    """Record of a flight, from its logs, the vehicles' `tracks` and its `script`.

    The script began at `start_s` on the tracks' clock, which is 0 at Unix time `unix_s`. The truth
    is written to the folder `truth_in`, if given, for `lpac report`.
    """
    manifest = layout.bundle.manifest
    assert manifest.perception is not None and layout.features is not None
    truth = {robot: layout.mission_track(t).shifted(unix_s) for robot, t in enumerate(tracks)}
    logs.truths.append(truth)
    logs.names |= {robot: simulated_name(robot) for robot in truth}
    if truth_in is not None:
        write_truth(truth, truth_in / TRUTH)
    importance = rasterize(
        layout.features,
        manifest.perception.world_size,
        manifest.training.idf_truncation,
        manifest.training.idf_norm,
    )
    of = Coverage(importance, FIELD_SCALE.env_scale), manifest.perception.sensor_size, layout.fence
    missions = find_missions(logs)
    if missions:
        record = record_of(logs, missions[-1], missions[:-1], *of)
    else:
        record = whole_record(logs, range(len(tracks)), *of)
    start_unix_s = start_s + unix_s
    return replace(
        record,
        bundle_id=layout.bundle.id,
        features=layout.features,
        script=replace(
            script,
            start_s=start_unix_s - record.begin_s,
            programs=tuple(
                _program(logs.statuses.get(robot, []), record, start_unix_s, usage)
                for robot, usage in enumerate(usages)
            ),
        ),
    )


def _program(
    statuses: list[LoggedStatus], record: FlightRecord, start_unix_s: float, usage: RobotUsage
) -> ProgramRecord:
    end_s = record.begin_s + record.duration_s if record.flew_mission else math.inf
    past = [each for each in statuses if each.time_s <= end_s]
    return ProgramRecord(
        changes_of([each.time_s - start_unix_s for each in statuses], statuses),
        past[-1] if past else None,
        *usage,
    )


def _share(first: _Moment, last: _Moment, before: Usage, after: Usage) -> float:
    """The share of a core that a process took between two moments."""
    return max(0.0, after.cpu_s - before.cpu_s) / max(last.time_s - first.time_s, 1e-9)
