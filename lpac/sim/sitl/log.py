"""True flight of a real PX4's vehicle, from PX4's log (ULog)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from edge.core import F64, Bools
from lpac.analysis.ulog import Topic, read_topics
from lpac.sim.px4.world import WorldOrigin

_PLACE, _STATUS = "vehicle_local_position_groundtruth", "vehicle_status"
_ESTIMATE, _SETPOINT = "vehicle_local_position", "offboard_control_mode"
_ARMED = 2


@dataclass(frozen=True, slots=True, eq=False)
class Px4Truth:
    """Truth in the log; times are PX4's own, s since it started, ascending.

    `position_m` and `velocity_m_s` (T, 3) are north, east, down in the world, heights from where
    the vehicle stood. `velocity_error_m_s` (T,) is the error of PX4's estimated horizontal
    velocity. `status_s` (S,) are the times from which on `navigation_state` and `armed` (S,) held.
    """

    time_s: F64
    position_m: F64
    velocity_m_s: F64
    velocity_error_m_s: F64
    status_s: F64
    navigation_state: npt.NDArray[np.int64]
    armed: npt.NDArray[np.bool_]


class Px4Setpoints(NamedTuple):
    """Times of external setpoints, (S,), PX4's time, s, ascending; whether each is a velocity."""

    time_s: F64
    is_velocity: Bools


def read_truth(paths: Sequence[Path], world: WorldOrigin) -> Px4Truth | None:
    """Truth in the logs of one PX4, in the order of time; None if they have none.

    A truncated log, as of a killed PX4, is read as far as it goes.
    """
    logs = [read_topics(path, (_PLACE, _ESTIMATE, _STATUS)) for path in paths]
    places = [topics[_PLACE] for topics in logs if _PLACE in topics]
    if not places:
        return None
    time_s = _joined([place["timestamp"] for place in places]) * 1e-6
    order = np.argsort(time_s, kind="stable")
    starts_m = [
        world.to_world(float(place["ref_lat"][-1]), float(place["ref_lon"][-1])) for place in places
    ]
    position_m = np.stack(
        [
            _joined([p["x"] + start_m[0] for p, start_m in zip(places, starts_m, strict=True)]),
            _joined([p["y"] + start_m[1] for p, start_m in zip(places, starts_m, strict=True)]),
            _joined([p["z"] for p in places]),
        ],
        axis=1,
    )
    velocity_m_s = np.stack([_joined([p[axis] for p in places]) for axis in ("vx", "vy", "vz")], 1)
    statuses = [topics[_STATUS] for topics in logs if _STATUS in topics]
    status_s = _joined([s["timestamp"] for s in statuses]) * 1e-6
    status_order = np.argsort(status_s, kind="stable")
    estimates = [topics[_ESTIMATE] for topics in logs if _ESTIMATE in topics]
    return Px4Truth(
        time_s=time_s[order],
        position_m=position_m[order],
        velocity_m_s=velocity_m_s[order],
        velocity_error_m_s=_velocity_errors_m_s(estimates, time_s[order], velocity_m_s[order]),
        status_s=status_s[status_order],
        navigation_state=_joined([s["nav_state"] for s in statuses])[status_order].astype(np.int64),
        armed=_joined([s["arming_state"] for s in statuses])[status_order] == _ARMED,
    )


def read_setpoints(paths: Sequence[Path]) -> Px4Setpoints:
    """All setpoints in the logs of one PX4, which logs at most ten a second."""
    logs = [topics[_SETPOINT] for path in paths if (topics := read_topics(path, (_SETPOINT,)))]
    time_s = _joined([log["timestamp"] for log in logs]) * 1e-6
    is_velocity = _joined([(log["velocity"] > 0) & (log["position"] == 0) for log in logs]) > 0.0
    order = np.argsort(time_s, kind="stable")
    return Px4Setpoints(time_s[order], is_velocity[order])


def _joined(parts: Sequence[npt.NDArray[Any]]) -> F64:
    return np.concatenate([np.zeros(0), *parts])


def _velocity_errors_m_s(estimates: Sequence[Topic], time_s: F64, velocity_m_s: F64) -> F64:
    """Errors of the estimated velocity at these times; 0 without an estimate."""
    at_s = _joined([estimate["timestamp"] for estimate in estimates]) * 1e-6
    if len(at_s) == 0:
        return np.zeros(len(time_s))
    estimated_m_s = [
        np.interp(time_s, at_s, _joined([estimate[axis] for estimate in estimates]))
        for axis in ("vx", "vy")
    ]
    errors_m_s: F64 = np.hypot(*(np.array(estimated_m_s) - velocity_m_s[:, :2].T))
    return errors_m_s
