"""The baseline controllers: Lloyd's algorithm with three degrees of knowledge.

As in CoverageControl, all robots step at once and know the true positions (the decentralised one:
those within communication range), whatever happens to messages.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Literal, Protocol

import numpy as np

from edge.core import F32, F64
from edge.core.coverage import cvt_velocity, local_centroid, voronoi_cells
from edge.core.frames import ModelScale
from edge.core.perception import (
    PerceptionParameters,
    RobotMap,
    neighbours_in_range,
    part_in_world,
    window_corner,
)
from edge.drivers.world_sensor import WorldSensor
from lpac.sim.vehicles import PointVehicles

BaselineName = Literal["decentralized-cvt", "centralized-cvt", "clairvoyant-cvt"]


class Baseline(Protocol):
    """Where robots at `positions` (N, 2), in model units, should go next."""

    def goals(self, positions: F64) -> F64:
        """Sense at `positions`, then decide."""


class ClairvoyantCvt:
    """Knows the whole world from the start."""

    def __init__(self, importance: F32) -> None:
        self._importance = importance

    def goals(self, positions: F64) -> F64:
        """The centroids of the Voronoi cells of the true world."""
        return voronoi_cells(self._importance, positions).centroid


class CentralizedCvt:
    """Knows what all robots together have seen."""

    def __init__(self, importance: F32, perception: PerceptionParameters) -> None:
        self._importance = importance
        self._sensor_size = perception.sensor_size
        self._seen = np.zeros_like(importance)

    def goals(self, positions: F64) -> F64:
        """The centroids of the Voronoi cells of the part that has been seen."""
        for position in positions:
            corner = window_corner(position, self._sensor_size)
            view, _ = part_in_world(corner, self._sensor_size, len(self._seen))
            self._seen[view] = self._importance[view]
        return voronoi_cells(self._seen, positions).centroid


class DecentralizedCvt:
    """Each robot knows what it has seen, within its local map, and the neighbours' positions."""

    def __init__(self, importance: F32, perception: PerceptionParameters, robots: int) -> None:
        self._perception = perception
        self._sensor = WorldSensor(importance, perception.sensor_size)
        self._maps = [
            RobotMap(perception.world_size, perception.unknown_importance) for _ in range(robots)
        ]

    def goals(self, positions: F64) -> F64:
        """The centroid of each robot's Voronoi cell in its own local map."""
        goals = np.empty_like(positions)
        for i, (position, robot_map) in enumerate(zip(positions, self._maps, strict=True)):
            corner = window_corner(position, self._perception.sensor_size)
            robot_map.insert(self._sensor.view(position), corner)
            goals[i] = local_centroid(
                *self._local_map(robot_map, position),
                position,
                self._neighbours(positions, i),
            )
        return goals

    def _local_map(self, robot_map: RobotMap, position: F64) -> tuple[F32, tuple[int, int]]:
        """The part of the local map that is in the world, and its first cell."""
        size = self._perception.local_map_size
        corner = window_corner(position, size)
        local = robot_map.window(corner, np.empty((size, size), np.float32))
        in_world, in_window = part_in_world(corner, size, self._perception.world_size)
        return local[in_window], (in_world[0].start, in_world[1].start)

    def _neighbours(self, positions: F64, robot: int) -> F64:
        others = np.delete(positions, robot, axis=0)
        near = neighbours_in_range(positions[robot], others, self._perception.communication_range)
        return others[near]


def make_baseline(
    name: BaselineName, importance: F32, perception: PerceptionParameters, robots: int
) -> Baseline:
    """The baseline of that name, for a world's raster and the sizes of the robots' perception."""
    if name == "clairvoyant-cvt":
        return ClairvoyantCvt(importance)
    if name == "centralized-cvt":
        return CentralizedCvt(importance, perception)
    return DecentralizedCvt(importance, perception, robots)


class BaselineSwarm:
    """A baseline's robots: all decide at every sample, and fly there until the next."""

    # They say nothing.
    largest_payload = 0.0

    def __init__(
        self,
        baseline: Baseline,
        vehicles: PointVehicles,
        scale: ModelScale,
        max_speed_m_s: float,
    ) -> None:
        self._baseline = baseline
        self._vehicles = vehicles
        self._scale = scale
        self._max_speed_m_s = max_speed_m_s

    def run(self, times_s: Sequence[float]) -> Iterator[F64]:
        """Yields the positions (N, 2), m, at each of `times_s`, which ascend."""
        for now_s, next_s in pairwise([*times_s, math.inf]):
            self._vehicles.now_s = now_s
            positions_m = self._vehicles.positions_m()
            yield positions_m
            goals = self._baseline.goals(self._scale.position_to_model(positions_m))
            goals_m = self._scale.position_to_mission_m(goals)
            velocities_m_s = cvt_velocity(positions_m, goals_m, self._max_speed_m_s, next_s - now_s)
            for robot, velocity_m_s in enumerate(velocities_m_s):
                self._vehicles.fly(robot, velocity_m_s)

    def message_counts(self) -> dict[str, int]:
        """Empty: a baseline's knowledge does not come by messages."""
        return {}
