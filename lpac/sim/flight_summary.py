"""Summaries of a flight's record: JSON, and text lines."""

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np

from edge.core import F64
from edge.core.counted import counted
from lpac.analysis.flight import LOOPS, FlightRecord
from lpac.analysis.logs import simulated_name
from lpac.analysis.statistics import finite
from lpac.sim.scenario import Scenario
from lpac.sim.usual import judgement, usual_whole


def summary(scenario: Scenario, record: FlightRecord) -> dict[str, Any]:
    """The flight as JSON-ready values."""
    values = {
        "controller": scenario.controller,
        "bundle_id": record.bundle_id,
        "robots": scenario.robots,
        "seed": scenario.seed,
        "duration_s": scenario.duration_s,
        "cost": _cost_summary(record.cost, record.normalized),
    }
    return values | (_of_script if record.script.vehicle else _of_points)(scenario, record)


def _of_points(scenario: Scenario, record: FlightRecord) -> dict[str, Any]:
    link, radio = scenario.link, scenario.radio
    return {
        "duration_s": record.duration_s,
        "scale": {
            "env_scale": scenario.scale.env_scale,
            "velocity_scale": scenario.scale.velocity_scale,
        },
        "link": {
            "loss": link.loss,
            "delay_s": link.delay_s,
            "by_model": None if radio is None else asdict(radio),
            "max_message_age_s": scenario.max_message_age_s,
        },
        "messages": dict(record.message_counts),
        "cost_curve": {
            "time_s": record.curve_time_s.tolist(),
            "normalized_cost": record.normalized.tolist(),
        },
        "final_positions_m": record.positions_m[-1].tolist(),
    }


def _of_script(scenario: Scenario, record: FlightRecord) -> dict[str, Any]:
    script, least = record.script, record.true_separation
    margin_m, true_margin_m = record.fence_margin_m, record.true_fence_margin_m
    return {
        "vehicle": script.vehicle,
        "errors": scenario.errors,
        "wind_m_s": scenario.wind_m_s,
        "link": {"loss": scenario.loss, "delay_s": scenario.delay_s},
        "problem": script.problem,
        "all_landed": record.all_landed,
        "commands": [
            {"command": command, "problem": problem, "results": results}
            for command, _, problem, results in script.commands
        ],
        "steps_s": {name: round(at_s, 2) for name, at_s in script.began_s.items()},
        "true_cost": _cost_summary(record.true_cost, record.normalized_true),
        "cost_curve": {
            "time_s": record.curve_time_s.round(2).tolist(),
            "normalized_cost": _numbers(record.normalized),
            "normalized_true_cost": _numbers(record.normalized_true),
        },
        "start_positions_m": _start_positions_m(record),
        "separation": least
        and {
            "distance_m": least.distance_m,
            "robots": [r.robot_id for r in record.robots if r.name in least.robots],
            "time_s": least.time_s - script.start_s,
        },
        "fence": {
            "margin_m": finite(margin_m),
            "true_margin_m": finite(true_margin_m),
            "crossed": bool(margin_m < 0.0),
            "truly_crossed": bool(true_margin_m < 0.0),
        },
        "launcher": {"cpu_share": script.launcher[0], "peak_memory_mb": script.launcher[1]},
        "took_off": record.took_off,
        "overloaded": script.overloaded,
        "behind_s": {"vehicles_s": script.vehicles_behind_s, "robots_s": script.robots_behind_s},
        "fleet": [_program_summary(record, robot) for robot in range(len(script.programs))],
    }


def _start_positions_m(record: FlightRecord) -> list[tuple[float, ...] | None]:
    """Estimated (x, y) of each robot when the mission began; None if unknown."""
    places_m = record.places_at(0.0)
    return [
        tuple(round(metres, 3) for metres in places_m[name]) if name in places_m else None
        for name in map(simulated_name, range(len(record.script.programs)))
    ]


def _mission_share(record: FlightRecord, robot_id: int) -> float:
    """Share of the mission that the robot flew; 0 if it took no part."""
    return sum(record.mission_share(r) for r in record.robots if r.robot_id == robot_id)


def _numbers(values: F64) -> list[float | None]:
    return [finite(value) for value in values.round(6).tolist()]


def _cost_summary(cost: F64, normalized: F64) -> dict[str, float | None]:
    def at(values: F64, index: int) -> float | None:
        return finite(values[index]) if len(values) else None

    return {
        "initial": at(cost, 0),
        "final": at(cost, -1),
        "final_normalized": at(normalized, -1),
    }


def _program_summary(record: FlightRecord, robot: int) -> dict[str, Any]:
    program = record.script.programs[robot]
    last = program.last
    counts = dict(last.message_counts) if last else {}
    accepted = counts.pop("accepted", 0)
    return {
        "timeline": [
            {
                "time_s": round(time_s, 2),
                "state": state,
                "code": reason.code,
                "reason": reason.text,
            }
            for time_s, state, reason in program.changes
        ],
        "restarts": program.restarts,
        "mission_share": round(_mission_share(record, robot), 4),
        "cpu_share": round(program.cpu_share, 4),
        "peak_memory_mb": round(program.peak_memory_mb, 1),
        "messages": {
            "accepted": accepted,
            "rejected": {reason: count for reason, count in counts.items() if count},
        },
        "loops": {
            name: {each: round(value, 2) for each, value in asdict(loop).items()}
            for name, loop in (last.loops if last else {}).items()
        },
        "logs": list(program.logs),
    }


def summary_lines(scenario: Scenario, record: FlightRecord) -> list[str]:
    """Text lines on a scripted flight."""
    script = record.script
    restarts = sum(program.restarts for program in script.programs)
    not_done = sum(not command.done for command in script.commands)
    lines = [f"{counted(scenario.robots, 'robot')}, seed {scenario.seed}: {_outcome(record)}"]
    if script.problem is not None:
        lines.append(f"PROBLEM: {script.problem}")
    if script.overloaded or not record.took_off:
        # All other figures follow from that.
        return lines
    if not record.flew_mission:
        lines.append("no mission was flown")
    elif len(record.normalized):
        lines.append(
            f"coverage cost: {_shown(record.normalized[-1])} of the initial cost for where "
            f"the robots take themselves to be, {_shown(record.normalized_true[-1])} for "
            "where they are"
        )
        ratio = record.true_cost[-1] / record.lloyd
        if np.isfinite(ratio):
            simulated = script.vehicle != "px4"
            usual = usual_whole(scenario, record.bundle_id) if simulated else None
            lines.append(judgement(ratio, usual))
    else:
        lines.append("the world has no importance anywhere, so that there was nothing to cover")
    least = record.true_separation
    if least is not None:
        lines.append(
            f"least true separation in the air: {least.distance_m:.2f} m, "
            f"{' and '.join(least.robots)} at {least.time_s - script.start_s:.0f} s"
        )
    position_error_m = scenario.budget.position_m
    lines.append(_fence_line(record.fence_margin_m, record.true_fence_margin_m, position_error_m))
    shares = [100.0 * _mission_share(record, robot) for robot in range(scenario.robots)]
    lines.append(
        f"in the mission {min(shares):.0f} to {max(shares):.0f} % of its time; restarts: "
        f"{restarts}; commands not done: {not_done}"
    )
    lines += _loop_lines(record)
    if script.vehicle == "simulated":
        # On a simulated clock no loop is late, and one process runs all.
        return lines
    cpu_shares = [100.0 * program.cpu_share for program in script.programs]
    memory_mb = [program.peak_memory_mb for program in script.programs]
    lines.append(
        f"each robot: {min(cpu_shares):.1f} to {max(cpu_shares):.1f} % of a core, at most "
        f"{max(memory_mb):.0f} MB; ground and vehicles: {100.0 * script.launcher[0]:.0f} %; all: "
        f"{(sum(cpu_shares) / 100.0 + script.launcher[0]):.2f} cores"
    )
    if max(script.vehicles_behind_s, script.robots_behind_s) > 0.0:
        lines.append(
            f"the vehicles fell {script.vehicles_behind_s:.1f} s behind real time, the robots "
            f"left out {script.robots_behind_s:.1f} s of control"
        )
    lines.append(counted(sum(len(program.logs) for program in script.programs), "flight log"))
    return lines


def _fence_line(margin_m: float, true_margin_m: float, position_error_m: float) -> str:
    """Robots keep the fence by their estimates, so the true margin may be short by their error."""
    estimated, true = (
        "not known"
        if not np.isfinite(m)
        else f"{m:.2f} m inside"
        if m >= 0.0
        else f"{-m:.2f} m beyond it"
        for m in (margin_m, true_margin_m)
    )
    text = f"at the nearest {estimated} by the robots' estimates, {true} in truth"
    if margin_m < 0.0 or true_margin_m < -position_error_m:
        return f"fence CROSSED: {text}"
    if true_margin_m < 0.0:
        text = f"{text}, within the {position_error_m:g} m by which estimates may err"
    return f"fence kept: {text}"


def _outcome(record: FlightRecord) -> str:
    """Outcome of the mission and of the landing, in words."""
    if not record.took_off:
        return "nobody took off"
    landed = "all landed and disarmed" if record.all_landed else "NOT ALL LANDED"
    if not record.flew_mission:
        return f"no mission; {landed} after {record.script.began_s['end']:.0f} s"
    mission_s = record.duration_s
    return (
        f"mission of {mission_s:.0f} s in {record.script.began_s['end']:.0f} s of flight; {landed}"
    )


def _loop_lines(record: FlightRecord) -> Iterator[str]:
    statuses = [each.last for each in record.script.programs if each.last is not None]
    accepted = [status.message_counts.get("accepted", 0) for status in statuses]
    rejected = sum(sum(s.message_counts.values()) for s in statuses) - sum(accepted)
    for name in LOOPS:
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
