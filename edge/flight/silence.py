"""Robots that fell silent in flight, and their possible places. Mission frame, m and s; pure.

Such a robot may fly on, hover or come down: its program, radio or position may have failed.
"""

import math
from typing import NamedTuple

import numpy as np

from edge.core import F64
from edge.messages.beacon import Beacon, Neighbour
from edge.messages.mission import FlightState

# Slower than any landing of PX4, whose last metres take 0.7 m/s.
_DESCENT_M_S = 0.5
_PLACES_APART_M = 2.0
# It may turn on a mission. Of 48 simulated robots, 90 % stopped within 2.2 m of the extrapolated
# way of up to 5.9 m, and all within 3.0 m.
_DEVIATION_SHARE = 0.5
_CLIMBS = (FlightState.ARMING, FlightState.TAKEOFF, FlightState.RETURN)


class SilenceLimits(NamedTuple):
    """Limits of a robot that fell silent in flight, while nobody else flies it.

    It is no faster than `max_speed_m_s` and no higher than `ceiling_m`, whatever it sent. It flies
    on for at most `flies_on_s`, and comes down at any time, after at most `hovers_s`.
    """

    max_speed_m_s: float
    ceiling_m: float
    flies_on_s: float
    hovers_s: float


def last_state(beacon: Beacon, limits: SilenceLimits) -> Neighbour | None:
    """Its last position and velocity, at its own height if it was climbing; None if unknown."""
    if not beacon.armed or beacon.position_m is None or beacon.velocity_m_s is None:
        return None
    x_m, y_m, height_m = beacon.position_m
    if beacon.state in _CLIMBS:
        height_m = max(height_m, beacon.slot_height_m)
    vx_m_s, vy_m_s, _ = beacon.velocity_m_s
    share = min(1.0, limits.max_speed_m_s / max(math.hypot(vx_m_s, vy_m_s), 1e-9))
    return Neighbour(
        beacon.robot_id,
        (x_m, y_m, min(height_m, limits.ceiling_m)),
        (share * vx_m_s, share * vy_m_s, 0.0),
        0.0,
    )


def highest_possible_m(silent: Neighbour, limits: SilenceLimits) -> float:
    """Its greatest possible height; 0 or less if it is down."""
    descends_s = max(silent.age_s - limits.hovers_s, 0.0)
    return silent.position_m[2] - _DESCENT_M_S * descends_s


def possible_places_m(silent: Neighbour, limits: SilenceLimits) -> F64:
    """Its possible places (n, 2) on a straight way, at most 2 m apart."""
    first_m, along_m = _way_m(silent, limits)
    count = math.ceil(math.hypot(*along_m) / _PLACES_APART_M) + 1
    return first_m + np.linspace(0.0, 1.0, count)[:, None] * along_m


def nearest_place_m(silent: Neighbour, limits: SilenceLimits, place_m: F64) -> F64:
    """The nearest of its possible places to a place, (2,)."""
    first_m, along_m = _way_m(silent, limits)
    square = float(along_m @ along_m)
    share = float((place_m - first_m) @ along_m) / square if square > 0.0 else 0.0
    return first_m + along_m * min(max(share, 0.0), 1.0)


def deviation_m(silent: Neighbour, limits: SilenceLimits) -> float:
    """Largest deviation from the straight way."""
    _, along_m = _way_m(silent, limits)
    return _DEVIATION_SHARE * math.hypot(*along_m)


def _way_m(silent: Neighbour, limits: SilenceLimits) -> tuple[F64, F64]:
    """Begin and vector of the way, (2,) each."""
    on_s = min(silent.age_s, limits.flies_on_s)
    return np.array(silent.position_m[:2]), np.array(silent.velocity_m_s[:2]) * on_s
