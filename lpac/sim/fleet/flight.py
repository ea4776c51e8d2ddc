"""One flight of a fleet by the script, and what is to be said of it beside its record."""

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from edge.core import F64
from edge.core.counted import counted
from edge.core.world import rasterize
from edge.messages.mission import AIRBORNE, ON_GROUND, FlightState
from lpac.analysis.coverage import Coverage
from lpac.analysis.flight import FlightRecord, StateChange, changes_of
from lpac.analysis.logs import LoggedStatus, Logs, read_files, simulated_name
from lpac.analysis.missions import find_missions, record_of, whole_record
from lpac.analysis.truth import TRUTH, TrueTrack, write_truth
from lpac.ground.station.client import GroundError
from lpac.ground.station.commands import in_words
from lpac.sim.description import FIELD_SCALE
from lpac.sim.fleet.ground import GroundProgram
from lpac.sim.fleet.layout import WORLD, Layout
from lpac.sim.fleet.listener import Say
from lpac.sim.fleet.pilot import Pilot, perturbations
from lpac.sim.fleet.processes import Backlog, Fleet, OverloadError, Usage, process_usage
from lpac.sim.fleet.scripted import CommandOutcome, ScriptedFlight
from lpac.sim.fleet.vehicles import SimulatedVehicles, VehicleError
from lpac.sim.scenario import Scenario
from lpac.sim.sitl.build import Px4Build
from lpac.sim.sitl.ground_station import RealVehicles
from lpac.sim.usual import judgement, usual_whole

_LOOPS = ("perception", "policy", "control")
_IN_TIME = Backlog(0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class RobotFlight:
    """What one robot did; times in s from the script's start.

    `changes` of its state as it said itself; `truth` in the mission frame, of no entries where
    nothing tells. `last` is its last status in the mission, and `mission_share` the share of that
    in which it flew it.
    """

    changes: tuple[StateChange, ...]
    truth: TrueTrack
    last: LoggedStatus | None
    mission_share: float
    cpu_share: float
    peak_memory_mb: float
    logs: tuple[str, ...]

    @property
    def restarts(self) -> int:
        """How often it came back into its mission."""
        return max(0, sum(c.state is FlightState.MISSION for c in self.changes) - 1)

    @property
    def took_off(self) -> bool:
        """Whether its vehicle was in the air; where that is not known, whether it says so."""
        if len(self.truth.time_s):
            return bool(self.truth.airborne.any())
        return any(change.state in AIRBORNE for change in self.changes)


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetFlight:
    """A flight of a fleet; `record` is that of its mission, or of all if there was none.

    `problem` is what kept the script from its end, None if nothing did. `began_s` tells when each
    step began, s from the script's start, which was at `start_unix_s`; the last entry, `end`, when
    all was over. `commands` are those that the ground was given. `launcher` is what the processes
    of the ground and of the simulated vehicles took: share of a core, and MB.
    """

    scenario: Scenario
    vehicle: str
    bundle_id: str
    record: FlightRecord
    robots: tuple[RobotFlight, ...]
    start_unix_s: float
    began_s: Mapping[str, float]
    problem: str | None
    commands: tuple[CommandOutcome, ...]
    launcher: tuple[float, float]
    lateness: Backlog
    overloaded: bool

    @property
    def any_took_off(self) -> bool:
        """Whether a vehicle was in the air."""
        return any(robot.took_off for robot in self.robots)

    @property
    def flew_mission(self) -> bool:
        """Whether there was a mission, in which somebody flew."""
        return self.record.duration_s > 0.0

    @property
    def all_landed(self) -> bool:
        """Whether they flew, and each says that it is down and disarmed, and is, where known."""
        return self.any_took_off and all(
            robot.changes
            and robot.changes[-1].state in ON_GROUND
            and not robot.truth.airborne[-1:].any()
            for robot in self.robots
        )

    def summary(self) -> dict[str, Any]:
        """The flight as JSON-ready values."""
        record = self.record
        margin_m, true_margin_m = record.fence_margin_m, record.true_fence_margin_m
        return {
            "vehicle": self.vehicle,
            "bundle_id": self.bundle_id,
            "robots": self.scenario.robots,
            "seed": self.scenario.seed,
            "duration_s": self.scenario.duration_s,
            "errors": self.scenario.errors,
            "problem": self.problem,
            "all_landed": self.all_landed,
            "commands": [
                {
                    "command": in_words(request),
                    "problem": report.problem and report.problem.code,
                    "results": {result.robot: result.code for result in report.results},
                }
                for request, report in self.commands
            ],
            "steps_s": {name: round(at_s, 2) for name, at_s in self.began_s.items()},
            "cost": _cost_summary(record.cost, record.normalized),
            "true_cost": _cost_summary(record.true_cost, record.normalized_true),
            "cost_curve": {
                "time_s": record.curve_time_s.round(2).tolist(),
                "normalized_cost": _numbers(record.normalized),
                "normalized_true_cost": _numbers(record.normalized_true),
            },
            "start_positions_m": self._start_positions_m(),
            "separation": self._separation(),
            "fence": {
                "margin_m": _number(margin_m),
                "true_margin_m": _number(true_margin_m),
                "crossed": bool(margin_m < 0.0),
                "truly_crossed": bool(true_margin_m < 0.0),
            },
            "launcher": {"cpu_share": self.launcher[0], "peak_memory_mb": self.launcher[1]},
            "took_off": self.any_took_off,
            "overloaded": self.overloaded,
            "behind_s": self.lateness._asdict(),
            "fleet": [_robot_summary(robot) for robot in self.robots],
        }

    def since_start_s(self, time_s: float) -> float:
        """A time of the record, from the script's start."""
        return self.record.begin_s + time_s - self.start_unix_s

    def _start_positions_m(self) -> list[tuple[float, ...] | None]:
        """(x, y) where each robot took itself to be when the mission began; None if nowhere."""
        places_m = self.record.places_at(0.0)
        return [
            tuple(round(metres, 3) for metres in places_m[name]) if name in places_m else None
            for name in (simulated_name(robot) for robot in range(len(self.robots)))
        ]

    def _separation(self) -> dict[str, Any] | None:
        least = self.record.true_separation
        if least is None:
            return None
        return {
            "distance_m": least.distance_m,
            "robots": [r.robot_id for r in self.record.robots if r.name in least.robots],
            "time_s": self.since_start_s(least.time_s),
        }


def fly(
    fleet: Fleet,
    say: Say = lambda _: None,
    watch: Callable[[str], None] = lambda _: None,
) -> FleetFlight:
    """Run a fleet and its ground, and fly the script; `watch` gets the step's name now and then.

    Ctrl-C lands all, and so do a vehicle that ends, and a machine that does not keep up. Raises
    FleetError if a robot's program ends before all are heard; OSError, LinkError, GroundError or
    VehicleError if something cannot start.
    """
    scenario, moments = fleet.layout.scenario, dict[str, _Moment]()
    flying_by_hand: list[Pilot] = []
    step = "assemble"
    problem, overloaded = None, False
    with (
        fleet,
        GroundProgram(fleet.fleet_toml, fleet.name) as ground,
        _in_sight(fleet) if scenario.failures else nullcontext() as seen,
    ):
        if seen is not None:
            with seen.stepped:
                for vehicle in seen.vehicles:
                    vehicle.rc_connected = True

        def begin(name: str) -> None:
            nonlocal step
            if name == "preflight":
                fleet.begin()
            say("landing all robots where they are" if name == "land" else name)
            moments.setdefault(name, _Moment.of(fleet, ground))
            step = name
            if name == "mission" and seen is not None:
                now_s = ground.told.now_s
                flying_by_hand[:] = [
                    Pilot(seen.vehicles[failure.robot], fleet.layout, failure, now_s)
                    for failure in scenario.failures
                ]

        def look() -> None:
            if step == "assemble":
                fleet.require_running()
            if step != "land":
                fleet.vehicles.require_running()
            if step not in ("assemble", "land"):
                fleet.require_keeping_up()
            if seen is not None and step == "mission":
                told = ground.told.snapshot.robots
                with seen.stepped:
                    for pilot in flying_by_hand:
                        pilot.look(ground.told.now_s, told[pilot.robot].status)
            watch(step)

        flight = ScriptedFlight(
            ground.told, fleet.fleet_toml, scenario.duration_s,
            perturb=perturbations(scenario.failures),
            on_step=begin, say=fleet.say_unless_behind,
        )  # fmt: skip
        try:
            try:
                problem = ground.told.carry_out(flight.fly(), look)
            except GroundError:
                raise
            except BaseException:
                ground.told.carry_out(flight.land(), lambda: watch(step))
                raise
        except (OverloadError, VehicleError, GroundError) as error:
            problem, overloaded = str(error), isinstance(error, OverloadError)
        except KeyboardInterrupt:
            problem = "stopped by Ctrl-C"
        moments["end"] = _Moment.of(fleet, ground)
        lateness = fleet.lateness()
    # The vehicles' own logs are whole once they have ended.
    return _record(fleet, flight, moments, problem, lateness, overloaded)


@contextmanager
def _in_sight(fleet: Fleet) -> Iterator[SimulatedVehicles | RealVehicles]:
    """Its vehicles, as pilots see and fly them."""
    if fleet.simulated is not None:
        yield fleet.simulated
        return
    assert isinstance(fleet.vehicles, Px4Build)
    with RealVehicles(fleet.vehicles, WORLD) as vehicles:
        yield vehicles


class _Moment(NamedTuple):
    """What everybody has used at one time."""

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
) -> FleetFlight:
    start_s = moments["assemble"].time_s if "assemble" in moments else moments["end"].time_s
    began_s = {name: at_s - start_s for name, at_s in flight.began_s.items()}
    began_s["end"] = moments["end"].time_s - start_s
    # The mission's own figures; of the whole flight where there was none.
    first = moments.get("mission", next(iter(moments.values())))
    last = moments.get("return", moments["end"])
    unix_s = time.time() - time.monotonic()
    logs = [robot.logs() for robot in fleet.robots]
    return flight_of(
        fleet.layout,
        "px4" if fleet.simulated is None else "mavlink",
        read_files([path for own in logs for path in own]),
        fleet.vehicles.tracks(),
        unix_s,
        start_s,
        began_s,
        [
            RobotUsage(
                _share(first, last, first.usages[robot], last.usages[robot]),
                moments["end"].usages[robot].peak_memory_mb,
                tuple(str(path.relative_to(fleet.folder)) for path in own),
            )
            for robot, own in enumerate(logs)
        ],
        fleet.folder,
        problem=problem,
        commands=tuple(flight.commands),
        launcher=(
            _share(first, last, first.launcher, last.launcher),
            moments["end"].launcher.peak_memory_mb,
        ),
        lateness=lateness,
        overloaded=overloaded,
    )


class RobotUsage(NamedTuple):
    """What the program of one robot took, and the logs that it left."""

    cpu_share: float = 0.0
    peak_memory_mb: float = 0.0
    logs: tuple[str, ...] = ()


def flight_of(
    layout: Layout,
    vehicle: str,
    logs: Logs,
    tracks: Sequence[TrueTrack],
    unix_s: float,
    start_s: float,
    began_s: Mapping[str, float],
    usages: Sequence[RobotUsage],
    truth_in: Path | None,
    *,
    problem: str | None,
    commands: tuple[CommandOutcome, ...] = (),
    launcher: tuple[float, float] = (0.0, 0.0),
    lateness: Backlog = _IN_TIME,
    overloaded: bool = False,
) -> FleetFlight:
    """The flight that `logs` and the vehicles' `tracks` tell of.

    `began_s` counts from `start_s` of the tracks' clock, of which 0 is `unix_s`. The truth is left
    in `truth_in`, beside logs of robots that are kept, for `lpac report`.
    """
    manifest = layout.bundle.manifest
    assert manifest.perception is not None and layout.features is not None
    truth = {robot: _in_mission_frame(layout, t, unix_s) for robot, t in enumerate(tracks)}
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
    return FleetFlight(
        scenario=layout.scenario,
        vehicle=vehicle,
        bundle_id=layout.bundle.id,
        record=record,
        robots=tuple(
            _robot_flight(logs, record, robot, truth[robot].shifted(-start_unix_s), start_unix_s, u)
            for robot, u in enumerate(usages)
        ),
        start_unix_s=start_unix_s,
        began_s=began_s,
        problem=problem,
        commands=commands,
        launcher=launcher,
        lateness=lateness,
        overloaded=overloaded,
    )


def _share(first: _Moment, last: _Moment, before: Usage, after: Usage) -> float:
    """The share of a core that a process took between two moments."""
    return max(0.0, after.cpu_s - before.cpu_s) / max(last.time_s - first.time_s, 1e-9)


def _in_mission_frame(layout: Layout, track: TrueTrack, unix_s: float) -> TrueTrack:
    rotation, origin_m = layout.to_mission.rotation, layout.to_mission.local_origin_m
    return TrueTrack(
        track.time_s + unix_s, track.position_m @ rotation.T + origin_m, track.airborne
    )


def _robot_flight(
    logs: Logs,
    record: FlightRecord,
    robot_id: int,
    truth: TrueTrack,
    start_unix_s: float,
    usage: RobotUsage,
) -> RobotFlight:
    statuses = logs.statuses.get(robot_id, [])
    end_s = record.begin_s + record.duration_s if record.duration_s else math.inf
    past = [said for said in statuses if said.time_s <= end_s]
    return RobotFlight(
        changes=changes_of([said.time_s - start_unix_s for said in statuses], statuses),
        truth=truth,
        last=past[-1] if past else None,
        mission_share=sum(
            record.mission_share(robot) for robot in record.robots if robot.robot_id == robot_id
        ),
        **usage._asdict(),
    )


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _numbers(values: F64) -> list[float | None]:
    return [_number(value) for value in values.round(6).tolist()]


def _cost_summary(cost: F64, normalized: F64) -> dict[str, float | None]:
    def at(values: F64, index: int) -> float | None:
        return _number(values[index]) if len(values) else None

    return {
        "initial": at(cost, 0),
        "final": at(cost, -1),
        "final_normalized": at(normalized, -1),
    }


def _robot_summary(robot: RobotFlight) -> dict[str, Any]:
    counts = dict(robot.last.message_counts) if robot.last else {}
    accepted = counts.pop("accepted", 0)
    return {
        "timeline": [
            {
                "time_s": round(time_s, 2),
                "state": state,
                "code": reason.code,
                "reason": reason.text,
            }
            for time_s, state, reason in robot.changes
        ],
        "restarts": robot.restarts,
        "mission_share": round(robot.mission_share, 4),
        "cpu_share": round(robot.cpu_share, 4),
        "peak_memory_mb": round(robot.peak_memory_mb, 1),
        "messages": {
            "accepted": accepted,
            "rejected": {reason: count for reason, count in counts.items() if count},
        },
        "loops": {
            name: {
                "ticks": loop.ticks,
                "overruns": loop.overruns,
                "failures": loop.failures,
                "lateness_p50_ms": round(loop.lateness_p50_ms, 2),
                "lateness_p99_ms": round(loop.lateness_p99_ms, 2),
                "lateness_max_ms": round(loop.lateness_max_ms, 2),
            }
            for name, loop in (robot.last.loops if robot.last else {}).items()
        },
        "logs": list(robot.logs),
    }


def summary_lines(flight: FleetFlight) -> list[str]:
    """The flight for people, a line each."""
    scenario, robots, record = flight.scenario, flight.robots, flight.record
    restarts = sum(robot.restarts for robot in robots)
    not_done = sum(not report.done for _, report in flight.commands)
    lines = [f"{counted(scenario.robots, 'robot')}, seed {scenario.seed}: {_outcome(flight)}"]
    if flight.problem is not None:
        lines.append(f"PROBLEM: {flight.problem}")
    if flight.overloaded or not flight.any_took_off:
        # All else that there is to tell follows from that.
        return lines
    if not flight.flew_mission:
        lines.append("no mission was flown")
    elif len(record.normalized):
        lines.append(
            f"coverage cost: {_shown(record.normalized[-1])} of the initial cost for where "
            f"the robots take themselves to be, {_shown(record.normalized_true[-1])} for "
            "where they are"
        )
        ratio = record.true_cost[-1] / record.lloyd
        if np.isfinite(ratio):
            simulated = flight.vehicle != "px4"
            usual = usual_whole(scenario, flight.bundle_id) if simulated else None
            lines.append(judgement(ratio, usual))
    else:
        lines.append("the world has no importance anywhere, so that there was nothing to cover")
    least = record.true_separation
    if least is not None:
        lines.append(
            f"least true separation in the air: {least.distance_m:.2f} m, "
            f"{' and '.join(least.robots)} at {flight.since_start_s(least.time_s):.0f} s"
        )
    position_error_m = scenario.budget.position_m
    lines.append(_fence_line(record.fence_margin_m, record.true_fence_margin_m, position_error_m))
    lines.append(
        f"in the mission {100.0 * min(r.mission_share for r in robots):.0f} to "
        f"{100.0 * max(r.mission_share for r in robots):.0f} % of its time; restarts: {restarts}; "
        f"commands not done: {not_done}"
    )
    lines += _loop_lines(flight)
    if flight.vehicle == "simulated":
        # On a simulated clock nobody is late, and all of it is one process.
        return lines
    cpu_shares = [100.0 * robot.cpu_share for robot in robots]
    memory_mb = [robot.peak_memory_mb for robot in robots]
    lines.append(
        f"each robot: {min(cpu_shares):.1f} to {max(cpu_shares):.1f} % of a core, at most "
        f"{max(memory_mb):.0f} MB; ground and vehicles: {100.0 * flight.launcher[0]:.0f} %; all: "
        f"{(sum(cpu_shares) / 100.0 + flight.launcher[0]):.2f} cores"
    )
    if max(flight.lateness) > 0.0:
        lines.append(
            f"the vehicles fell {flight.lateness.vehicles_s:.1f} s behind real time, the robots "
            f"left out {flight.lateness.robots_s:.1f} s of control"
        )
    lines.append(counted(sum(len(robot.logs) for robot in robots), "flight log"))
    return lines


def _fence_line(margin_m: float, true_margin_m: float, position_error_m: float) -> str:
    """Robots keep the fence as they estimate their places, which may truly err by so much."""
    estimated, true = (
        "not known"
        if not np.isfinite(m)
        else f"{m:.2f} m inside"
        if m >= 0.0
        else f"{-m:.2f} m beyond it"
        for m in (margin_m, true_margin_m)
    )
    said = f"at the nearest {estimated} by the robots' estimates, {true} in truth"
    if margin_m < 0.0 or true_margin_m < -position_error_m:
        return f"fence CROSSED: {said}"
    if true_margin_m < 0.0:
        said = f"{said}, within the {position_error_m:g} m by which estimates may err"
    return f"fence kept: {said}"


def _outcome(flight: FleetFlight) -> str:
    """What became of the robots, and of their mission."""
    if not flight.any_took_off:
        return "nobody took off"
    landed = "all landed and disarmed" if flight.all_landed else "NOT ALL LANDED"
    if not flight.flew_mission:
        return f"no mission; {landed} after {flight.began_s['end']:.0f} s"
    mission_s = flight.record.duration_s
    return f"mission of {mission_s:.0f} s in {flight.began_s['end']:.0f} s of flight; {landed}"


def _loop_lines(flight: FleetFlight) -> Iterator[str]:
    statuses = [robot.last for robot in flight.robots if robot.last is not None]
    accepted = [status.message_counts.get("accepted", 0) for status in statuses]
    rejected = sum(sum(s.message_counts.values()) for s in statuses) - sum(accepted)
    for name in _LOOPS:
        loops = [status.loops[name] for status in statuses if name in status.loops]
        if loops:
            yield (
                f"{name} loops: late by {np.median([x.lateness_p50_ms for x in loops]):.1f} ms "
                f"(p50), at worst {max(x.lateness_p99_ms for x in loops):.1f} ms (p99), "
                f"{max(x.lateness_max_ms for x in loops):.0f} ms (max); overruns "
                f"{sum(x.overruns for x in loops)}, failures {sum(x.failures for x in loops)}"
            )
    if accepted:
        yield (
            f"messages accepted per robot: {min(accepted)} to {max(accepted)}; "
            f"rejected in all: {rejected}"
        )


def _shown(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "unknown"
