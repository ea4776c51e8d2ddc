"""True positions of real vehicles, measured externally or by RTK receivers.

A robot's own estimate can be metres off, and its virtual sensor is at the estimate, so costs from
the robots' positions hide this error. Measurements lie beside the robot's logs, in the folder of
its name: `truth.csv` from motion capture or video, or PX4's logs (`*.ulg`), whose fixes count while
the receiver has a fixed carrier-phase solution (centimetres). The log of a PX4 in software has the
simulated vehicle's true position.
"""

import csv
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from edge.core import F64
from lpac.analysis.truth import TrueTrack
from lpac.analysis.ulog import Topic, read_topics

TRUTH_TABLE, AUTOPILOT_LOGS = "truth.csv", "*.ulg"
_MISSION = ("unix_s", "x_m", "y_m", "height_m")
_GLOBAL = ("unix_s", "latitude_deg", "longitude_deg", "height_m")
# Unix time and PX4's time, s: written by `lpac sim` with the logs of its PX4s, which have no time
# of day.
CLOCK_TABLE = "clock.csv"
_RECEIVER, _GROUND_TRUTH = "sensor_gps", "vehicle_global_position_groundtruth"
_RTK_FIXED = 6
# Heights of a vehicle on the ground, or carried by hand, stay below this.
_AIRBORNE_ABOVE_M = 0.3
# Positions further apart are not interpolated.
_GAP_S = 0.5


class Measured(NamedTuple):
    """Measurements in one file: Unix time (T,), ascending, and places (T, 3).

    Places are x, y, m, in the mission frame, or latitude and longitude, deg, if `is_global`; then
    the height above the ground, m.
    """

    unix_s: F64
    places: F64
    is_global: bool


_NOWHERE = Measured(np.zeros(0), np.zeros((0, 3)), is_global=True)

# From latitude and longitude, deg, and Unix time, s, to x and y, m, in that time's mission frame.
ToMission = Callable[[float, float, float], tuple[float, float]]


def read_places(path: Path) -> Measured:
    """Read `truth.csv`, or the RTK fixes in a log of PX4, of which there may be none.

    Raises ValueError that names the fault, OSError.
    """
    places = _of_table(path) if path.name == TRUTH_TABLE else _of_autopilot(path)
    if not np.isfinite(places.unix_s).all() or not np.isfinite(places.places).all():
        raise ValueError(f"{path}: has numbers that are not finite")
    order = np.argsort(places.unix_s, kind="stable")
    return Measured(places.unix_s[order], places.places[order], places.is_global)


def track_of(files: Iterable[Measured], to_mission: ToMission) -> TrueTrack:
    """Join all files of one robot; gaps in the measurements become NaN."""
    parts = [(file.unix_s, _in_mission(file, to_mission)) for file in files]
    time_s = np.concatenate([np.zeros(0), *(part[0] for part in parts)])
    position_m = np.concatenate([np.zeros((0, 3)), *(part[1] for part in parts)])
    order = np.argsort(time_s, kind="stable")
    time_s, position_m = time_s[order], position_m[order]
    after = np.flatnonzero(np.diff(time_s) > _GAP_S) + 1
    # A NaN just after the gap's begin, and another just before its end.
    gaps_s = np.stack([np.nextafter(time_s[after - 1], math.inf), time_s[after] - 1e-6], axis=1)
    time_s = np.insert(time_s, np.repeat(after, 2), gaps_s.ravel())
    position_m = np.insert(position_m, np.repeat(after, 2), np.nan, axis=0)
    return TrueTrack(time_s, position_m, position_m[:, 2] > _AIRBORNE_ABOVE_M)


def _in_mission(file: Measured, to_mission: ToMission) -> F64:
    if not file.is_global:
        return file.places
    plane_m = [
        to_mission(latitude_deg, longitude_deg, unix_s)
        for unix_s, (latitude_deg, longitude_deg, _) in zip(
            file.unix_s.tolist(), file.places.tolist(), strict=True
        )
    ]
    return np.column_stack([np.array(plane_m).reshape(-1, 2), file.places[:, 2]])


def _of_table(path: Path) -> Measured:
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = csv.reader(file)
        header = tuple(name.strip() for name in next(rows, []))
        if header not in (_MISSION, _GLOBAL):
            raise ValueError(
                f"{path}: begins with {','.join(header)!r}: must be {','.join(_MISSION)} "
                f"or {','.join(_GLOBAL)}"
            )
        numbers = [_numbers(row, f"{path}: line {rows.line_num}") for row in rows if row]
    table = np.array(numbers).reshape(-1, len(header))
    return Measured(table[:, 0], table[:, 1:], header == _GLOBAL)


def _numbers(row: Sequence[str], where: str) -> list[float]:
    try:
        numbers = [float(word) for word in row]
    except ValueError:
        numbers = []
    if len(numbers) != len(_MISSION):
        raise ValueError(f"{where}: {','.join(row)!r}: must be {len(_MISSION)} numbers")
    return numbers


def _of_autopilot(path: Path) -> Measured:
    """Heights are relative to the first fix: PX4 starts a log when arming on the ground."""
    topics = read_topics(path, (_RECEIVER, _GROUND_TRUTH))
    if _GROUND_TRUTH in topics:
        return _of_simulator(topics[_GROUND_TRUTH], path)
    fixes = topics.get(_RECEIVER)
    if fixes is None:
        return _NOWHERE
    fixed = (fixes["fix_type"] == _RTK_FIXED) & (fixes["time_utc_usec"] > 0)
    if not fixed.any():
        return _NOWHERE
    boot_s = fixes["timestamp"][fixed] * 1e-6
    started_unix_s = np.median(fixes["time_utc_usec"][fixed] * 1e-6 - boot_s)
    if "latitude_deg" in fixes:
        columns = [fixes["latitude_deg"], fixes["longitude_deg"], fixes["altitude_msl_m"]]
    else:  # before PX4 v1.15
        columns = [fixes["lat"] * 1e-7, fixes["lon"] * 1e-7, fixes["alt"] * 1e-3]
    latitude_deg, longitude_deg, altitude_m = (column[fixed] for column in columns)
    places = np.column_stack([latitude_deg, longitude_deg, altitude_m - altitude_m[0]])
    return Measured(boot_s + started_unix_s, places, is_global=True)


def _of_simulator(truth: Topic, path: Path) -> Measured:
    """Empty if there is no clock table."""
    clock = next((at for folder in path.parents if (at := folder / CLOCK_TABLE).is_file()), None)
    if clock is None:
        return _NOWHERE
    try:
        unix_s, px4_s = np.loadtxt(clock, delimiter=",", ndmin=2).T
    except ValueError as error:
        raise ValueError(f"{clock}: {error}") from None
    if not (np.diff(px4_s) >= 0.0).all():
        raise ValueError(f"{clock}: its PX4 was started more than once")
    boot_s, altitude_m = truth["timestamp"] * 1e-6, truth["alt"]
    known = (boot_s >= px4_s[0]) & (boot_s <= px4_s[-1])
    places = np.column_stack([truth["lat"], truth["lon"], altitude_m - altitude_m[0]])
    return Measured(np.interp(boot_s[known], px4_s, unix_s), places[known], is_global=True)
