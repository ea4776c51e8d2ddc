"""One flight of a fleet on the simulated clock, by a script of the real ground station."""

import zlib
from collections.abc import Callable
from pathlib import Path

from edge.core.logger import errors_only
from edge.messages.mission import RobotStatus
from edge.policy.bundle import load_bundle
from lpac.analysis.flight import FlightRecord, ScriptRecord
from lpac.analysis.logs import logs_of
from lpac.ground.procedure import NoSnapshotError
from lpac.ground.station.protocol import SNAPSHOT_PERIOD_S
from lpac.sim.air import Air
from lpac.sim.failure import Failure
from lpac.sim.fleet.flight import FleetMoment, RobotUsage, flight_of
from lpac.sim.fleet.listener import Report
from lpac.sim.fleet.pilot import LOOK_PERIOD_S, Pilot, perturbations
from lpac.sim.fleet.scripted import ScriptedFlight
from lpac.sim.fleet.simulated import EPOCH_S, SimulatedFleet
from lpac.sim.fleet.vehicles import track_of
from lpac.sim.points import SAMPLE_S
from lpac.sim.scenario import Scenario

# Start times this far apart, longer than any flight, and so many that all end before 2038.
_APART_S, _BEGINNINGS = 1000.0, 340_000


def fly_simulated(
    scenario: Scenario,
    folder: Path | str,
    bundle: Path | str,
    report: Report = lambda _: None,
    watch: Callable[[FleetMoment], object] | None = None,
    *,
    logs: bool = False,
    recorded: Path | None = None,
) -> FlightRecord:
    """Prepare a fleet in `folder`, fly a mission of `scenario.duration_s`, and land.

    Robots read the bundle at the path `bundle`; `report` gets each step of the script with its
    start on the simulated clock. With `logs` the robots write logs to robots/ID/logs in `folder`.
    `recorded` is the folder of such a flight, whose policy outputs are replayed. The `problem` of
    the record says why the script did not reach its end. Of the robots' log messages only errors
    are shown.

    Raises BundleError, ValueError for too little room for the pads and for fields that whole robots
    do not support, OSError for a folder that cannot be written, RecordingError, and PartError if a
    policy or a sensor raises an error.
    """
    # The log messages of ten robots would drown the output.
    with errors_only():
        return _fly(scenario, Path(folder).resolve(), Path(bundle), report, watch, logs, recorded)


def _fly(
    scenario: Scenario,
    folder: Path,
    bundle: Path,
    report: Report,
    watch: Callable[[FleetMoment], object] | None,
    logs: bool,
    recorded: Path | None,
) -> FlightRecord:
    earlier = set(folder.rglob("*.mcap"))
    # Different flights need different times, so that their logs can be read together; the same
    # flight, flown again, gets the same time.
    beginning = zlib.crc32(repr((scenario, load_bundle(bundle).id)).encode()) % _BEGINNINGS
    fleet = SimulatedFleet(
        scenario,
        folder,
        bundle,
        logs=logs,
        recorded=recorded,
        epoch_s=EPOCH_S + _APART_S * beginning,
    )
    ground = fleet.ground
    for each in fleet.vehicles:
        each.vehicle.rc_connected = bool(scenario.failures)

    def report_timed(text: str) -> None:
        report(f"{ground.now_s:6.1f} s  {text}")

    def begin(step: str) -> None:
        report_timed(step)
        if step == "mission":
            if scenario.loss or scenario.delay_s:
                delay_s = max(scenario.delay_s, Air().delay_s)
                fleet.radio.air = Air(loss=scenario.loss, delay_s=delay_s)
            for failure in scenario.failures:
                fly_by_hand(failure)

    def fly_by_hand(failure: Failure) -> None:
        robot, vehicle = fleet.robots[failure.robot], fleet.vehicles[failure.robot].vehicle
        pilot = Pilot(vehicle, fleet.layout, failure, ground.now_s)
        fleet.schedule.every(LOOK_PERIOD_S, lambda: pilot.look(ground.now_s, robot.status))

    flight = ScriptedFlight(
        ground, folder / "fleet.toml", scenario.duration_s,
        perturb=perturbations(scenario.failures),
        on_step=begin, report=report_timed,
    )  # fmt: skip
    if watch is not None:
        fleet.schedule.every(SAMPLE_S, lambda: watch(_moment(fleet, flight)))
    statuses = _StatusLog(fleet)
    try:
        problem = ground.carry_out(flight.fly())
    except NoSnapshotError as error:
        problem = str(error)
    fleet.close()
    return statuses.flight(flight, problem, earlier, folder if logs else None)


def _moment(fleet: SimulatedFleet, flight: ScriptedFlight) -> FleetMoment:
    statuses = {robot.config.robot_id: robot.status for robot in fleet.robots}
    return FleetMoment(
        fleet.ground.now_s, flight.at,
        {robot: status for robot, status in statuses.items() if status is not None},
        flight.stop,
    )  # fmt: skip


class _StatusLog:
    """Statuses of each robot, as its own log has them."""

    def __init__(self, fleet: SimulatedFleet) -> None:
        self._fleet = fleet
        self._statuses: dict[tuple[int, int, int], RobotStatus] = {}
        # More often than a robot publishes its status.
        fleet.schedule.every(SNAPSHOT_PERIOD_S, self._look)

    def _look(self) -> None:
        for robot in self._fleet.robots:
            status = robot.status
            if status is not None:
                self._statuses[status.robot_id, status.boot_nonce, status.sequence] = status

    def flight(
        self, flown: ScriptedFlight, problem: str | None, earlier: set[Path], logged: Path | None
    ) -> FlightRecord:
        self._look()
        fleet = self._fleet
        logs = sorted(set(fleet.folder.rglob("*.mcap")) - earlier)
        return flight_of(
            fleet.layout,
            logs_of(self._statuses.values()),
            [track_of(each.vehicle.truth) for each in fleet.vehicles],
            fleet.schedule.unix_s() - fleet.schedule.monotonic_s(),
            0.0,
            [
                RobotUsage(
                    logs=tuple(
                        str(path.relative_to(fleet.folder))
                        for path in logs
                        if path.is_relative_to(robot.config.log.folder)
                    )
                )
                for robot in fleet.robots
            ],
            logged,
            ScriptRecord(
                vehicle="simulated",
                began_s=flown.began_s | {"end": fleet.ground.now_s},
                problem=problem,
                commands=flown.recorded_commands(),
            ),
        )
