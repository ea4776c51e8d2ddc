"""The part of a simulated fleet's fleet.toml that all robots share: field and flight."""

import math
from dataclasses import asdict
from typing import Any

from edge.core.fence import Fence
from edge.core.frames import ModelScale
from edge.flight.margins import ErrorBudget
from edge.flight.reach import Reach

# The paper's field tests: 32 m x 32 m for a world of 512 x 512 model units.
FIELD_SCALE = ModelScale(env_scale=16.0, velocity_scale=0.25)
ERRORS = ErrorBudget()
REACH = Reach()
_BASE_HEIGHT_M = 5.0
# Robots stop half a metre outside the field, with the fence 1.5 m further out.
_FENCE_BEYOND_FIELD_M = 2.0
_FENCE_BUFFER_M = 1.5


def fence_around(field_m: float, robots: int, errors: ErrorBudget = ERRORS) -> Fence:
    """Fence around a square field, m, with room for the flight heights of `robots` robots."""
    low_m, high_m = -_FENCE_BEYOND_FIELD_M, field_m + _FENCE_BEYOND_FIELD_M
    return Fence(
        vertices_m=((low_m, low_m), (high_m, low_m), (high_m, high_m), (low_m, high_m)),
        buffer_m=_FENCE_BUFFER_M,
        floor_m=_BASE_HEIGHT_M / 2.0,
        ceiling_m=_BASE_HEIGHT_M + robots * errors.slot_spacing.least_m + 2.0,
    )


def robot_table(fence: Fence, max_speed_m_s: float, errors: ErrorBudget = ERRORS) -> dict[str, Any]:
    """[robot] of fleet.toml: the settings that all robots share."""
    return {
        "on_stop": "land",
        "policy": {
            "env_scale": FIELD_SCALE.env_scale,
            "velocity_scale": FIELD_SCALE.velocity_scale,
        },
        "flight": {
            "base_height_m": _BASE_HEIGHT_M,
            "slot_spacing_m": errors.slot_spacing.least_m,
        },
        "fence": {
            "vertices_m": [list(vertex) for vertex in fence.vertices_m],
            "buffer_m": fence.buffer_m,
            "floor_m": fence.floor_m,
            "ceiling_m": fence.ceiling_m,
        },
        # Fields may be larger, and fleets fly higher, than the defaults.
        "reach": {
            "distance_m": max(REACH.distance_m, math.ceil(math.dist(*fence.vertices_m[::2]))),
            "ceiling_m": max(REACH.ceiling_m, fence.ceiling_m),
        },
        "limits": {
            "max_speed_m_s": max_speed_m_s,
            "max_climb_m_s": 2.0,
            "max_acceleration_m_s2": 2.0,
            "lag_s": 1.3,
        },
        "failsafe": {"rc": "none", "parameters": "set"},
        "errors": asdict(errors),
    }
