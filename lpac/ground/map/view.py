"""JSON messages to the live map's page, small enough for 5 Hz.

Pure. Positions are (x, y) or (x, y, z), mission frame, m; `yaw_rad` is clockwise from its y axis.
"""

import base64
import dataclasses
import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from edge.messages.mission import GroundState
from lpac.analysis.coverage import Coverage, in_air
from lpac.analysis.snapshot import FleetSetup, FleetSnapshot
from lpac.ground.alarms import Alarm
from lpac.ground.rendering import (
    Row,
    cell,
    facts,
    is_ready,
    nose_rad,
    not_ready,
    problem,
    quantity,
    rows,
    state_style,
    tables,
)
from lpac.ground.station.protocol import CommandReport

Json = dict[str, Any]

# Resolution of the density, finer than a laptop shows.
DENSITY_CELLS = 256
# Cells of a robot's row, and the style of a robot that is not heard.
_CELLS = ("height", "battery", "satellites", "link")
_LOST = "lost"
_MAX_POINTS = 3000
_PATH_POINTS = 400
_PATH_STEP_M = 0.15


def setup_view(setup: FleetSetup, coverage: Coverage | None) -> Json:
    """Values that seldom change. Without `coverage` (unknown world) there is no density."""
    return {
        "kind": "setup",
        "slots": [
            {
                "robot": site.robot,
                "pad": _rounded(site.pad_m),
                "landing": _rounded(site.place.landing_point_m),
            }
            for site in setup.slots
        ],
        "side_m": setup.world_size / setup.env_scale,
        "range_m": setup.communication_range / setup.env_scale,
        "sensor_m": setup.sensor_size / setup.env_scale,
        "density": coverage
        and {
            "cells": DENSITY_CELLS,
            "levels": base64.b64encode(coverage.density(DENSITY_CELLS).tobytes()).decode(),
        },
    }


def snapshot_view(setup: FleetSetup, snapshot: FleetSnapshot, alarms: tuple[Alarm, ...]) -> Json:
    """Present state of the fleet."""
    state = snapshot.state
    fence, origin = state.fence or setup.fence, state.origin
    heading_deg = None if origin is None else origin.heading_deg
    index = {robot.robot_id: n for n, robot in enumerate(snapshot.robots)}
    return {
        "kind": "snapshot",
        "unix_time_s": snapshot.unix_time_s,
        "commander": snapshot.commander,
        "own": snapshot.commander == setup.operator,
        "trial": state.trial,
        "safety_action": state.safety_action,
        "safety_action_by": state.safety_action_by or state.operator,
        "heading_deg": heading_deg,
        "origin": origin and [origin.latitude_deg, origin.longitude_deg],
        "fence": [_rounded(corner) for corner in fence.vertices_m],
        "buffer": [_rounded(corner) for corner in fence.grown_m(-fence.buffer_m)],
        "running": list(snapshot.running),
        "alarms": [alarm._asdict() for alarm in alarms],
        "robots": [
            _robot_view(row, state, heading_deg, index) for row in rows(setup, snapshot, alarms)
        ],
    }


def _robot_view(
    row: Row, state: GroundState, heading_deg: float | None, index: dict[int, int]
) -> Json:
    robot, status = row.robot, row.robot.status
    view: Json = {
        "name": robot.name,
        "fresh": robot.fresh,
        "enabled": state.enabled_for(robot.robot_id),
        "word": cell(row, "state").text,
        "look": _LOST,
        "letter": "?",
        "problem": problem(row).text,
        "severity": "" if row.alarm is None else row.alarm.severity,
        "not_ready": not_ready(row),
        "cells": {key: quantity(row, key) for key in _CELLS},
    }
    if status is None:
        return view
    if robot.fresh:
        view["look"] = "ready" if is_ready(status) else status.state
        view["letter"] = state_style(status).letter
    return view | {
        "state": status.state,
        "in_air": in_air(status),
        "position_m": _rounded(status.position_m),
        "yaw_rad": _number(nose_rad(status, heading_deg), 3),
        "wanted_m_s": _rounded(status.policy_velocity_m_s),
        "landing_m": _rounded(status.landing_point_m),
        # [index in `robots`, age of its last message, s] of each neighbour.
        "hears": [
            [index[int(neighbour)], _number(age_s, 2) if robot.fresh else None]
            for neighbour, age_s in status.neighbour_ages_s.items()
            if neighbour.isdecimal() and int(neighbour) in index
        ],
    }


def detail_view(row: Row, snapshot: FleetSnapshot, alarms: Iterable[Alarm]) -> Json:
    """Details of one robot."""
    return {
        "kind": "detail",
        "name": row.robot.name,
        "facts": facts(row, snapshot, alarms),
        "tables": [table._asdict() for table in tables(row)],
    }


def report_view(action: str, report: CommandReport) -> Json:
    """Result of an action."""
    results = [{"done": result.done, **dataclasses.asdict(result)} for result in report.results]
    problem = report.problem and dataclasses.asdict(report.problem)
    outcome = {"done": report.done, "results": results, "problem": problem}
    return {"kind": "report", "action": action, **outcome}


@dataclass(slots=True)
class Curve:
    """Coverage cost of one mission: `points` are (mission time, s; J / J at the start).

    `began_s` is when the mission began, Unix time; if not `whole`, when it was first observed.
    `lloyd` is J / J at the start of Lloyd's algorithm, which knows the world.
    """

    trial: str
    began_s: float
    whole: bool
    lloyd: float | None = None
    points: list[tuple[float, float]] = field(default_factory=list)

    def add(self, time_s: float, share: float) -> None:
        """Add a point; every second one is dropped when there are too many."""
        if len(self.points) >= _MAX_POINTS:
            del self.points[1::2]
        self.points.append((round(time_s, 2), share))

    def view(self) -> Json:
        """The message."""
        return {"kind": "curve", **dataclasses.asdict(self)}


class Paths:
    """The robots' paths in this mission."""

    def __init__(self) -> None:
        self._paths: dict[str, deque[tuple[float, float]]] = {}

    def clear(self) -> None:
        """Start a new mission."""
        self._paths.clear()

    def take(self, snapshot: FleetSnapshot, places_m: Mapping[str, tuple[float, float]]) -> None:
        """Extend the paths of robots in the air."""
        for robot in snapshot.robots:
            if robot.name not in places_m or robot.status is None or not in_air(robot.status):
                continue
            place_m = places_m[robot.name]
            path = self._paths.setdefault(robot.name, deque(maxlen=_PATH_POINTS))
            if not path or math.dist(path[-1], place_m) >= _PATH_STEP_M:
                path.append((round(place_m[0], 2), round(place_m[1], 2)))

    def view(self) -> Json:
        """The message with all paths, for a new page."""
        return {"kind": "paths", "paths": {name: list(p) for name, p in self._paths.items()}}


def _rounded(numbers: tuple[float, ...] | None) -> list[float] | None:
    if numbers is None or not all(map(math.isfinite, numbers)):
        return None
    return [round(number, 2) for number in numbers]


def _number(number: float | None, digits: int) -> float | None:
    return None if number is None or not math.isfinite(number) else round(number, digits)
