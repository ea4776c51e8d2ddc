"""Point vehicles that fly the velocity that they are told, inside the world."""

import numpy as np

from edge.core import F64
from edge.core.ports import Odometry


class PointVehicles:
    """N planar vehicles in the mission frame, m and s.

    The world's border holds a vehicle as a wall would; one that starts outside may come back in
    and go no further out.
    """

    def __init__(self, positions_m: F64, world_size_m: float) -> None:
        """`positions_m` is (N, 2), at time 0."""
        self._start_m = positions_m.copy()
        self._since_s = np.zeros(len(positions_m))
        self._velocity_m_s = np.zeros_like(self._start_m)
        self._world_size_m = world_size_m
        # The caller moves the time on, never back.
        self.now_s = 0.0

    def positions_m(self) -> F64:
        """Positions (N, 2) now."""
        moved_m = self._start_m + self._velocity_m_s * (self.now_s - self._since_s)[:, None]
        return self._held_inside(moved_m, self._start_m)

    def position_m(self, robot: int) -> F64:
        """Position (2,) of one vehicle now."""
        start_m = self._start_m[robot]
        moved_m = start_m + self._velocity_m_s[robot] * (self.now_s - self._since_s[robot])
        return self._held_inside(moved_m, start_m)

    def velocity_m_s(self, robot: int) -> F64:
        """The velocity (2,) that one vehicle was told."""
        velocity_m_s: F64 = self._velocity_m_s[robot]
        return velocity_m_s

    def fly(self, robot: int, velocity_m_s: F64) -> None:
        """From now on the vehicle moves with `velocity_m_s` (2,)."""
        self._start_m[robot] = self.position_m(robot)
        self._since_s[robot] = self.now_s
        self._velocity_m_s[robot] = velocity_m_s

    def _held_inside(self, moved_m: F64, start_m: F64) -> F64:
        lowest_m = np.minimum(start_m, 0.0)
        highest_m = np.maximum(start_m, self._world_size_m)
        return np.minimum(np.maximum(moved_m, lowest_m), highest_m)


class VehicleOdometry:
    """Where one vehicle is, as its robot is told (an OdometrySource)."""

    def __init__(self, vehicles: PointVehicles, robot: int) -> None:
        self._vehicles = vehicles
        self._robot = robot

    def odometry(self) -> Odometry:
        """The truth; the vehicles are planar."""
        x_m, y_m = self._vehicles.position_m(self._robot).tolist()
        x_m_s, y_m_s = self._vehicles.velocity_m_s(self._robot).tolist()
        return Odometry((x_m, y_m, 0.0), (x_m_s, y_m_s, 0.0))
