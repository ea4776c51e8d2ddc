"""The baseline controllers: Lloyd's algorithm with several degrees of knowledge.

As in CoverageControl, all robots step at once and know the true positions; decentralised ones know
those within communication range. They use no messages, so that losses do not affect them, but
position errors do. None of them is a lower bound of the cost: Lloyd's algorithm ends in local
minima, even with full knowledge.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt
import scipy  # its parts are loaded on first use

from edge.core import F32, F64, Bools
from edge.core.frames import ModelScale
from edge.core.memory import RobotMap
from edge.core.perception import (
    PerceptionParameters,
    clamp_to_world,
    neighbours_in_range,
    part_in_world,
    window_corner,
)
from edge.drivers.world_sensor import WorldSensor
from lpac.analysis.voronoi import cvt_velocity, local_centroid, voronoi_cells
from lpac.sim.vehicles import PointVehicles

BaselineName = Literal[
    "decentralized-cvt",
    "decentralized-cvt-prior",
    "shared-cvt",
    "shared-cvt-prior",
    "frontier-cvt",
    "centralized-cvt",
    "clairvoyant-cvt",
]
# Importance that baselines with a prior assume for unseen cells. Without it nothing draws them to
# unexplored ground.
PRIOR = 0.1
# Pitch of the lattice on which frontiers are sought, in cells; the sensor sees 64.
_FRONTIER_PITCH = 8


class Baseline(Protocol):
    """Controller that gives each robot its next goal."""

    def goals(self, positions: F64) -> F64:
        """Sense at `positions` (N, 2), in model units; return the goals, (N, 2)."""


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


class SharedMaps:
    """Maps of robots that share everything they see at once, over any number of hops.

    They observe and exchange maps at each `sense`, and forget nothing.
    """

    def __init__(self, importance: F32, perception: PerceptionParameters, robots: int) -> None:
        self._importance = importance
        self._perception = perception
        # Robots with equal knowledge share one array, which is never written to again.
        self._seen: list[Bools] = [np.zeros(importance.shape, np.bool_)] * robots
        self._others: list[npt.NDArray[np.intp]] = []

    def sense(self, positions: F64) -> None:
        """Observe at `positions` (N, 2), model units, and merge the maps of connected robots."""
        size, world_size = self._perception.sensor_size, self._perception.world_size
        self._others = [np.zeros(0, np.intp)] * len(positions)
        for group in connected(positions, self._perception.communication_range):
            known = {id(self._seen[robot]): self._seen[robot] for robot in group}
            seen = np.logical_or.reduce(list(known.values()))
            for robot in group:
                view, _ = part_in_world(window_corner(positions[robot], size), size, world_size)
                seen[view] = True
                self._seen[robot] = seen
                self._others[robot] = group[group != robot]

    def others(self, robot: int) -> npt.NDArray[np.intp]:
        """Robots that this one can reach now, over any number of hops."""
        return self._others[robot]

    def around(self, robot: int, position: F64) -> tuple[F32, Bools, tuple[int, int]]:
        """The part of the robot's local map that is in the world.

        Returns the importance as the robot knows it, the mask of seen cells, and the first cell.
        """
        size = self._perception.local_map_size
        corner = window_corner(position, size)
        part, _ = part_in_world(corner, size, self._perception.world_size)
        seen = self._seen[robot][part]
        unknown = np.float32(self._perception.unknown_importance)
        return np.where(seen, self._importance[part], unknown), seen, (part[0].start, part[1].start)


class SharedCvt:
    """Decentralised, but robots share their maps and positions over the communication graph."""

    def __init__(self, importance: F32, perception: PerceptionParameters, robots: int) -> None:
        self._maps = SharedMaps(importance, perception, robots)

    def goals(self, positions: F64) -> F64:
        """The goal of each robot, by its local map and the others that it can reach."""
        self._maps.sense(positions)
        goals = np.empty_like(positions)
        for robot, position in enumerate(positions):
            around, others = self._maps.around(robot, position), self._maps.others(robot)
            goals[robot] = self._goal(position, *around, positions[others])
        return goals

    def _goal(
        self, position: F64, local: F32, seen: Bools, origin: tuple[int, int], others: F64
    ) -> F64:
        """The centroid of the robot's Voronoi cell in its local map."""
        return local_centroid(local, origin, position, others)


class FrontierCvt(SharedCvt):
    """Explore, then cover; robots share maps and positions as in `SharedCvt`.

    Each robot goes to the nearest unseen point of its Voronoi cell in its local map, or to the
    cell's centroid if all of it was seen. Frontiers: Yamauchi, "Frontier-based exploration using
    multiple robots" (Agents 1998); one Voronoi cell a robot, so that no two go to one: Hu et al.,
    "Voronoi-based multi-robot autonomous exploration in unknown environments via deep reinforcement
    learning" (IEEE Trans. Vehicular Technology, 2020).
    """

    def _goal(
        self, position: F64, local: F32, seen: Bools, origin: tuple[int, int], others: F64
    ) -> F64:
        """The nearest unseen point of the robot's cell, or the cell's centroid."""
        unseen = _unseen_points(seen, origin)
        distance = np.linalg.norm(unseen - position, axis=1)
        to_others = np.linalg.norm(unseen[:, None] - others, axis=2).min(axis=1, initial=np.inf)
        own = distance <= to_others
        if not own.any():
            return super()._goal(position, local, seen, origin, others)
        goal: F64 = unseen[own][distance[own].argmin()]
        return goal


def connected(positions: F64, communication_range: float) -> list[npt.NDArray[np.intp]]:
    """Groups of robots that reach each other over any number of hops; robots ascend in each."""
    offsets = positions[:, None] - positions
    near = np.hypot(offsets[..., 0], offsets[..., 1]) < communication_range
    count, group_of = scipy.sparse.csgraph.connected_components(near, directed=False)
    return [np.flatnonzero(group_of == group) for group in range(count)]


def _unseen_points(seen: Bools, origin: tuple[int, int]) -> F64:
    """(n, 2): centres of the unseen cells on the lattice, in model units."""
    # Offset by half a pitch, since that much stays unseen at the world's border.
    first = [(_FRONTIER_PITCH // 2 - start) % _FRONTIER_PITCH for start in origin]
    lattice = seen[first[0] :: _FRONTIER_PITCH, first[1] :: _FRONTIER_PITCH]
    cells = np.argwhere(~lattice) * _FRONTIER_PITCH + first + origin
    return np.asarray(cells + 0.5, np.float64)


def make_baseline(
    name: BaselineName, importance: F32, perception: PerceptionParameters, robots: int
) -> Baseline:
    """The baseline of that name, for a world's raster and the sizes of the robots' perception."""
    with_prior = replace(perception, unknown_importance=PRIOR)
    match name:
        case "clairvoyant-cvt":
            return ClairvoyantCvt(importance)
        case "centralized-cvt":
            return CentralizedCvt(importance, perception)
        case "decentralized-cvt":
            return DecentralizedCvt(importance, perception, robots)
        case "decentralized-cvt-prior":
            return DecentralizedCvt(importance, with_prior, robots)
        case "shared-cvt":
            return SharedCvt(importance, perception, robots)
        case "shared-cvt-prior":
            return SharedCvt(importance, with_prior, robots)
        case "frontier-cvt":
            return FrontierCvt(importance, perception, robots)


class BaselineSwarm:
    """Robots of a baseline: all choose goals at every sample, and fly there until the next."""

    # Baselines send no messages.
    largest_payload = 0.0

    def __init__(
        self,
        baseline: Baseline,
        vehicles: PointVehicles,
        scale: ModelScale,
        max_speed_m_s: float,
        bias_m: F64 | None,
        world_size: int,
    ) -> None:
        """`bias_m` (N, 2) is the robots' position error: they sense at the wrong position.

        `world_size` is in model units.
        """
        self._baseline = baseline
        self._vehicles = vehicles
        self._scale = scale
        self._max_speed_m_s = max_speed_m_s
        self._bias_m = bias_m
        self._world_size = world_size

    def run(self, times_s: Sequence[float]) -> Iterator[F64]:
        """Yields the positions (N, 2), m, at each of `times_s`, which ascend."""
        for now_s, next_s in pairwise([*times_s, math.inf]):
            self._vehicles.now_s = now_s
            positions_m = self._vehicles.positions_m()
            yield positions_m
            if self._bias_m is not None:
                positions_m = positions_m + self._bias_m
            positions = clamp_to_world(self._scale.position_to_model(positions_m), self._world_size)
            goals = self._baseline.goals(positions)
            goals_m = self._scale.position_to_mission_m(goals)
            velocities_m_s = cvt_velocity(positions_m, goals_m, self._max_speed_m_s, next_s - now_s)
            for robot, velocity_m_s in enumerate(velocities_m_s):
                self._vehicles.fly(robot, velocity_m_s)

    def positions_m(self) -> F64:
        """The positions (N, 2) now."""
        return self._vehicles.positions_m()

    def velocities_m_s(self) -> F64:
        """The velocities (N, 2) commanded now."""
        return self._vehicles.velocities_m_s()

    def received(self, _: float) -> Bools:
        """(N, N): all False; baselines use no messages."""
        return np.zeros((len(self.alive),) * 2, np.bool_)

    @property
    def alive(self) -> Bools:
        """(N,): all; a baseline's robots do not fail."""
        return np.ones(len(self._vehicles.positions_m()), np.bool_)

    def message_counts(self) -> dict[str, int]:
        """Empty: baselines use no messages."""
        return {}
