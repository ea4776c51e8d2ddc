"""One flight of a fleet by the script, and what is to be said of it."""

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from edge.core import F32, F64
from edge.core.coverage import coverage_cost
from edge.core.fence import Fence
from edge.core.world import rasterize
from edge.messages.codes import Reason
from edge.messages.mission import AIRBORNE, ON_GROUND, FlightState, RobotStatus
from lpac.ground.station.client import GroundError
from lpac.ground.station.commands import in_words
from lpac.sim.experiment import FIELD_SCALE
from lpac.sim.fleet.ground import GroundProgram
from lpac.sim.fleet.layout import FleetScenario, Layout
from lpac.sim.fleet.listener import Heard, Say
from lpac.sim.fleet.processes import Backlog, Fleet, OverloadError, Usage, process_usage
from lpac.sim.fleet.scripted import CommandOutcome, ScriptedFlight
from lpac.sim.fleet.vehicles import TrueTrack, VehicleError

COST_PERIOD_S = 1.0
SEPARATION_PERIOD_S = 0.04

_LOOPS = ("perception", "policy", "control")
_IN_TIME = Backlog(0.0, 0.0)


class StateChange(NamedTuple):
    """A robot entered a state."""

    time_s: float
    state: FlightState
    reason: Reason


@dataclass(frozen=True, slots=True, eq=False)
class RobotFlight:
    """What one robot did; times in s from the script's start, positions in the mission frame, m.

    As it said itself: `time_s` (T,), `position_m` (T, 3) with heights above its own pad, `in_air`
    (T,) and `changes` of its state. As it really was: `truth`, with heights above the ground, of no
    entries where nothing tells. `last` is its last status in the mission.
    """

    time_s: F64
    position_m: F64
    in_air: npt.NDArray[np.bool_]
    changes: tuple[StateChange, ...]
    truth: TrueTrack
    last: RobotStatus | None
    mission_share: float
    cpu_share: float
    peak_memory_mb: float
    logs: tuple[str, ...]

    @property
    def restarts(self) -> int:
        """How often it came back into its mission."""
        return max(0, sum(c.state is FlightState.MISSION for c in self.changes) - 1)

    def state_at(self, time_s: float) -> FlightState | None:
        """The state at a time, None before the first."""
        past = [change.state for change in self.changes if change.time_s <= time_s]
        return past[-1] if past else None


class TrueSeparation(NamedTuple):
    """The least true distance of two robots in the air, 3-D, m."""

    distance_m: float
    robots: tuple[int, int]
    time_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetFlight:
    """A flight of a fleet; times in s from the script's start.

    `problem` is what kept the script from its end, None if nothing did. `began_s` tells when each
    step began; the last entry, `end`, when all was over. `cost_time_s` (C,) is in the mission;
    `cost` and `true_cost` (C,) are the coverage cost J of the robots in the air, for where they
    take themselves to be and for where they really are, NaN where that is not known.
    `commands` are those that the ground was given. `launcher` is what the processes of the ground
    and of the simulated vehicles took: share of a core, and MB.
    """

    scenario: FleetScenario
    vehicle: str
    bundle_id: str
    field_m: float
    fence: Fence
    importance: F32
    pads_m: F64
    landing_points_m: F64
    robots: tuple[RobotFlight, ...]
    began_s: Mapping[str, float]
    problem: str | None
    commands: tuple[CommandOutcome, ...]
    cost_time_s: F64
    cost: F64
    true_cost: F64
    separation: TrueSeparation | None
    launcher: tuple[float, float]
    lateness: Backlog
    overloaded: bool

    @property
    def any_took_off(self) -> bool:
        """Whether a vehicle was in the air; where that is not known, whether its robot says so."""
        return any(
            (robot.truth.airborne if len(robot.truth.time_s) else robot.in_air).any()
            for robot in self.robots
        )

    @property
    def flew_mission(self) -> bool:
        """Whether there was a mission, in which somebody flew."""
        return "mission" in self.began_s and any(r.mission_share > 0.0 for r in self.robots)

    @property
    def all_landed(self) -> bool:
        """Whether they flew, and each says that it is down and disarmed, and is, where known."""
        return self.any_took_off and all(
            robot.changes
            and robot.changes[-1].state in ON_GROUND
            and not robot.truth.airborne[-1:].any()
            for robot in self.robots
        )

    def fence_margin_m(self) -> float:
        """How far inside the fence the estimates stayed, horizontally; NaN without a flight."""
        return _least(self._margin_m(r.position_m[r.in_air]) for r in self.robots)

    def true_fence_margin_m(self) -> float:
        """How far inside the fence the vehicles really stayed."""
        return _least(self._margin_m(r.truth.position_m[r.truth.airborne]) for r in self.robots)

    def _margin_m(self, positions_m: F64) -> float:
        return min(
            (self.fence.distance_m(x, y) for x, y, _ in positions_m.tolist()), default=np.nan
        )

    def summary(self) -> dict[str, Any]:
        """The flight as JSON-ready values."""
        margin_m, true_margin_m = self.fence_margin_m(), self.true_fence_margin_m()
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
            "cost": _cost_summary(self.cost),
            "true_cost": _cost_summary(self.true_cost),
            "cost_curve": {
                "time_s": self.cost_time_s.round(2).tolist(),
                "normalized_cost": _numbers(normalized(self.cost)),
                "normalized_true_cost": _numbers(normalized(self.true_cost)),
            },
            "start_positions_m": self.start_positions_m().round(3).tolist(),
            "separation": None if self.separation is None else self.separation._asdict(),
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

    def start_positions_m(self) -> F64:
        """Where the robots took themselves to be when the mission began: (N, 2)."""
        at_s = self.began_s.get("mission", 0.0)
        return np.array([_place_at(r.time_s, r.position_m, at_s) for r in self.robots])


def fly(
    fleet: Fleet, say: Say = lambda _: None, watch: Callable[[str], None] = lambda _: None
) -> FleetFlight:
    """Run a fleet and its ground, and fly the script; `watch` gets the step's name now and then.

    Ctrl-C lands all, and so do a vehicle that ends, and a machine that does not keep up. Raises
    FleetError if a robot's program ends before all are heard; OSError, LinkError, GroundError or
    VehicleError if something cannot start.
    """
    moments: dict[str, _Moment] = {}
    step = "assemble"
    problem, overloaded = None, False
    with fleet, GroundProgram(fleet.fleet_toml, fleet.name) as ground:

        def begin(name: str) -> None:
            nonlocal step
            if name == "preflight":
                fleet.begin()
            say("landing all robots where they are" if name == "land" else name)
            moments.setdefault(name, _Moment.of(fleet, ground))
            step = name

        def look() -> None:
            if step == "assemble":
                fleet.require_running()
            if step != "land":
                fleet.vehicles.require_running()
            if step not in ("assemble", "land"):
                fleet.require_keeping_up()
            watch(step)

        flight = ScriptedFlight(
            ground.told, fleet.fleet_toml, fleet.layout.scenario.duration_s,
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


class _Moment(NamedTuple):
    """What everybody said last and has used at one time."""

    time_s: float
    statuses: Mapping[int, RobotStatus]
    usages: tuple[Usage, ...]
    launcher: Usage

    @classmethod
    def of(cls, fleet: Fleet, ground: GroundProgram) -> "_Moment":
        programs = [process_usage(os.getpid())]
        if ground.running:
            programs.append(process_usage(ground.pid))
        return cls(
            time.monotonic(),
            {
                robot: heard[-1].status
                for robot in range(fleet.layout.scenario.robots)
                if (heard := fleet.heard.history(robot))
            },
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
    tracks = fleet.vehicles.tracks()
    return flight_of(
        fleet.layout,
        "px4" if fleet.simulated is None else "mavlink",
        [
            RobotRecord(
                history=fleet.heard.history(robot),
                track=tracks[robot],
                last=last.statuses.get(robot),
                cpu_share=_share(first, last, first.usages[robot], last.usages[robot]),
                peak_memory_mb=moments["end"].usages[robot].peak_memory_mb,
                logs=tuple(str(p.relative_to(fleet.folder)) for p in fleet.robots[robot].logs()),
            )
            for robot in range(fleet.layout.scenario.robots)
        ],
        start_s,
        began_s,
        problem=problem,
        commands=tuple(flight.commands),
        launcher=(
            _share(first, last, first.launcher, last.launcher),
            moments["end"].launcher.peak_memory_mb,
        ),
        lateness=lateness,
        overloaded=overloaded,
    )


class RobotRecord(NamedTuple):
    """What was noted of one robot, in the clock of whoever noted it."""

    history: tuple[Heard, ...]
    track: TrueTrack
    last: RobotStatus | None
    cpu_share: float = 0.0
    peak_memory_mb: float = 0.0
    logs: tuple[str, ...] = ()


def flight_of(
    layout: Layout,
    vehicle: str,
    records: Sequence[RobotRecord],
    start_s: float,
    began_s: Mapping[str, float],
    *,
    problem: str | None,
    commands: tuple[CommandOutcome, ...] = (),
    launcher: tuple[float, float] = (0.0, 0.0),
    lateness: Backlog = _IN_TIME,
    overloaded: bool = False,
) -> FleetFlight:
    """The flight that was noted; `began_s` counts from `start_s` of the records' clock."""
    manifest = layout.bundle.manifest
    assert manifest.perception is not None and layout.features is not None
    mission_s = (0.0, 0.0)
    if "mission" in began_s:
        mission_s = began_s["mission"], began_s.get("return", began_s["end"])
    tracks = [_in_mission_frame(layout, record.track, start_s) for record in records]
    robots = tuple(
        _robot_flight(
            record.history,
            start_s,
            mission_s,
            truth=track,
            last=record.last,
            cpu_share=record.cpu_share,
            peak_memory_mb=record.peak_memory_mb,
            logs=record.logs,
        )
        for record, track in zip(records, tracks, strict=True)
    )
    importance = rasterize(
        layout.features,
        manifest.perception.world_size,
        manifest.training.idf_truncation,
        manifest.training.idf_norm,
    )
    cost_time_s = np.append(
        np.arange(mission_s[0], mission_s[1] - COST_PERIOD_S / 2.0, COST_PERIOD_S), mission_s[1]
    )
    costs = np.array([_costs(importance, robots, at_s) for at_s in cost_time_s.tolist()])
    return FleetFlight(
        scenario=layout.scenario,
        vehicle=vehicle,
        bundle_id=layout.bundle.id,
        field_m=layout.field_m,
        fence=layout.fence,
        importance=importance,
        pads_m=layout.pads_m,
        landing_points_m=layout.landing_points_m,
        robots=robots,
        began_s=began_s,
        problem=problem,
        commands=commands,
        cost_time_s=cost_time_s - mission_s[0],
        cost=costs[:, 0],
        true_cost=costs[:, 1],
        separation=least_separation(tracks),
        launcher=launcher,
        lateness=lateness,
        overloaded=overloaded,
    )


def _share(first: _Moment, last: _Moment, before: Usage, after: Usage) -> float:
    """The share of a core that a process took between two moments."""
    return max(0.0, after.cpu_s - before.cpu_s) / max(last.time_s - first.time_s, 1e-9)


def _in_mission_frame(layout: Layout, track: TrueTrack, start_s: float) -> TrueTrack:
    rotation, origin_m = layout.to_mission.rotation, layout.to_mission.local_origin_m
    return TrueTrack(
        track.time_s - start_s, track.position_m @ rotation.T + origin_m, track.airborne
    )


def _robot_flight(
    history: tuple[Heard, ...], start_s: float, mission_s: tuple[float, float], **rest: Any
) -> RobotFlight:
    placed = [heard for heard in history if heard.status.position_m is not None]
    changes: list[StateChange] = []
    for at_s, status in history:
        if not changes or changes[-1].state is not status.state:
            changes.append(StateChange(at_s - start_s, status.state, status.reason))
    return RobotFlight(
        time_s=np.array([heard.at_s - start_s for heard in placed]),
        position_m=np.array([heard.status.position_m for heard in placed]).reshape(-1, 3),
        in_air=np.array([heard.status.state in AIRBORNE for heard in placed], np.bool_),
        changes=tuple(changes),
        mission_share=_mission_share(changes, *mission_s),
        **rest,
    )


def _mission_share(changes: list[StateChange], begin_s: float, end_s: float) -> float:
    """The share of the mission's time that a robot flew the mission."""
    if end_s <= begin_s:
        return 0.0
    ends_s = [after.time_s for _, after in pairwise(changes)] + [end_s]
    flown_s = (
        max(0.0, min(until_s, end_s) - max(change.time_s, begin_s))
        for change, until_s in zip(changes, ends_s, strict=True)
        if change.state is FlightState.MISSION
    )
    return sum(flown_s) / (end_s - begin_s)


def _place_at(time_s: F64, position_m: F64, at_s: float) -> tuple[float, float]:
    """x and y at a time, m; NaN where nothing is known."""
    if len(time_s) == 0:
        return np.nan, np.nan
    x_m, y_m = (float(np.interp(at_s, time_s, position_m[:, axis])) for axis in (0, 1))
    return x_m, y_m


def _costs(importance: F32, robots: tuple[RobotFlight, ...], at_s: float) -> tuple[float, float]:
    """The cost for where the robots in the air take themselves to be, and for where they are."""
    flying = [robot for robot in robots if robot.state_at(at_s) in AIRBORNE]
    return (
        _cost(importance, [_place_at(r.time_s, r.position_m, at_s) for r in flying]),
        _cost(importance, [_place_at(r.truth.time_s, r.truth.position_m, at_s) for r in flying]),
    )


def _cost(importance: F32, places_m: list[tuple[float, float]]) -> float:
    positions: F64 = FIELD_SCALE.position_to_model(np.array(places_m, np.float64).reshape(-1, 2))
    if len(positions) == 0 or not np.isfinite(positions).all():
        return np.nan
    return coverage_cost(importance, positions)


def least_separation(tracks: list[TrueTrack]) -> TrueSeparation | None:
    """The least distance of two vehicles while both are in the air; None if none ever were."""
    flown = [track for track in tracks if len(track.time_s)]
    if len(flown) < 2 or len(flown) < len(tracks):
        return None
    first_s = max(track.time_s[0] for track in flown)
    last_s = min(track.time_s[-1] for track in flown)
    times_s = np.arange(first_s, last_s, SEPARATION_PERIOD_S)
    times_s = times_s[times_s <= last_s]  # which rounding exceeds
    places_m = np.stack(
        [
            np.stack([np.interp(times_s, t.time_s, t.position_m[:, a]) for a in range(3)], axis=1)
            for t in flown
        ]
    )
    airborne = np.stack([t.airborne[np.searchsorted(t.time_s, times_s)] for t in flown])
    least: TrueSeparation | None = None
    for i in range(len(flown)):
        for j in range(i):
            distances_m = np.linalg.norm(places_m[i] - places_m[j], axis=1)
            distances_m = np.where(airborne[i] & airborne[j], distances_m, np.inf)
            k = int(distances_m.argmin()) if len(distances_m) else 0
            closest_m = float(distances_m[k]) if len(distances_m) else np.inf
            if np.isfinite(closest_m) and (least is None or closest_m < least.distance_m):
                least = TrueSeparation(closest_m, (j, i), float(times_s[k]))
    return least


def normalized(cost: F64) -> F64:
    """Costs (C,) over the first; all 0 over a world without importance."""
    return cost / cost[0] if cost[0] != 0.0 else np.zeros_like(cost)


def _least(values: Any) -> float:
    known = [value for value in values if np.isfinite(value)]
    return min(known, default=np.nan)


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _numbers(values: F64) -> list[float | None]:
    return [_number(value) for value in values.round(6).tolist()]


def _cost_summary(cost: F64) -> dict[str, float | None]:
    return {
        "initial": _number(cost[0]),
        "final": _number(cost[-1]),
        "final_normalized": _number(normalized(cost)[-1]),
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
    scenario, robots = flight.scenario, flight.robots
    restarts = sum(robot.restarts for robot in robots)
    not_done = sum(not report.done for _, report in flight.commands)
    lines = [f"{scenario.robots} robots, seed {scenario.seed}: {_outcome(flight)}"]
    if flight.problem is not None:
        lines.append(f"PROBLEM: {flight.problem}")
    if flight.overloaded or not flight.any_took_off:
        # All else that there is to tell follows from that.
        return lines
    if not flight.flew_mission:
        lines.append("no mission was flown")
    elif flight.importance.any():
        lines.append(
            f"coverage cost: {_shown(normalized(flight.cost)[-1])} of the initial cost for where "
            f"the robots take themselves to be, {_shown(normalized(flight.true_cost)[-1])} for "
            "where they are"
        )
    else:
        lines.append("the world has no importance anywhere, so that there was nothing to cover")
    if flight.separation is not None:
        (i, j), at_s = flight.separation.robots, flight.separation.time_s
        lines.append(
            f"least true separation in the air: {flight.separation.distance_m:.2f} m, robots {i} "
            f"and {j} at {at_s:.0f} s"
        )
    margin_m, true_margin_m = flight.fence_margin_m(), flight.true_fence_margin_m()
    crossed = "CROSSED" if margin_m < 0.0 else "not crossed"
    lines.append(
        f"fence {crossed}: {_shown(margin_m)} m inside at least as estimated, "
        f"{_shown(true_margin_m)} m in truth"
    )
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
    lines.append(f"{sum(len(robot.logs) for robot in robots)} flight logs")
    return lines


def _outcome(flight: FleetFlight) -> str:
    """What became of the robots, and of their mission."""
    if not flight.any_took_off:
        return "nobody took off"
    landed = "all landed and disarmed" if flight.all_landed else "NOT ALL LANDED"
    if not flight.flew_mission:
        return f"no mission; {landed} after {flight.began_s['end']:.0f} s"
    mission_s = flight.cost_time_s[-1]
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
