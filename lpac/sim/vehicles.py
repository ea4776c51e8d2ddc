"""Point vehicles that fly the velocity that they are told, inside the world."""

import math

import numpy as np

from edge.core import F64
from edge.core.ports import Odometry
from edge.core.schema import NonNegative, require


class PointVehicles:
    """N planar vehicles in the mission frame, m and s.

    The world's border holds a vehicle as a wall would; one that starts outside may come back in
    and go no further out.
    """

    def __init__(self, positions_m: F64, world_size_m: float, lag_s: float = 0.0) -> None:
        """`positions_m` is (N, 2), at time 0.

        `lag_s` is the time constant of the first order with which a vehicle's velocity follows the
        one that it is told; 0: at once. Raises ValueError if it is not finite and at least 0.
        """
        require(NonNegative, lag_s, "lag_s")
        # (2, N) each, so that what is computed of all runs along the memory.
        self._start_m = np.ascontiguousarray(positions_m.T)
        self._velocity_m_s = np.zeros_like(self._start_m)
        # What is left, of the velocity before, of its difference from the one that was told.
        self._excess_m_s = np.zeros_like(self._start_m)
        self._since_s = np.zeros(len(positions_m))
        self._world_size_m = world_size_m
        self._lag_s = lag_s
        # The caller moves the time on, never back.
        self.now_s = 0.0

    def positions_m(self) -> F64:
        """Positions (N, 2) now."""
        return self._now_m(slice(None)).T

    def position_m(self, robot: int) -> F64:
        """Position (2,) of one vehicle now."""
        return self._now_m(robot)

    def velocities_m_s(self) -> F64:
        """The velocities (N, 2) that the vehicles were told."""
        return self._velocity_m_s.T.copy()

    def velocity_m_s(self, robot: int) -> F64:
        """The velocity (2,) that one vehicle was told."""
        return self._velocity_m_s[:, robot]

    def fly(self, robot: int, velocity_m_s: F64) -> None:
        """From now on the vehicle is told `velocity_m_s` (2,)."""
        self._start_m[:, robot] = self.position_m(robot)
        if self._lag_s:
            left = math.exp(-(self.now_s - self._since_s[robot]) / self._lag_s)
            before_m_s = self._velocity_m_s[:, robot] + self._excess_m_s[:, robot] * left
            self._excess_m_s[:, robot] = before_m_s - velocity_m_s
        self._since_s[robot] = self.now_s
        self._velocity_m_s[:, robot] = velocity_m_s

    def stop(self, robot: int) -> None:
        """The vehicle stands still at once."""
        self.fly(robot, np.zeros(2))
        self._excess_m_s[:, robot] = 0.0

    def _now_m(self, which: int | slice) -> F64:
        start_m, elapsed_s = self._start_m[:, which], self.now_s - self._since_s[which]
        moved_m = start_m + self._velocity_m_s[:, which] * elapsed_s
        if self._lag_s:
            faded_s = -self._lag_s * np.expm1(-elapsed_s / self._lag_s)
            moved_m += self._excess_m_s[:, which] * faded_s
        lowest_m = np.minimum(start_m, 0.0)
        highest_m = np.maximum(start_m, self._world_size_m)
        return np.minimum(np.maximum(moved_m, lowest_m), highest_m)


class VehicleOdometry:
    """OdometrySource of one vehicle, with the position error that its robot receives."""

    def __init__(self, vehicles: PointVehicles, robot: int, bias_m: F64 | None = None) -> None:
        """`bias_m` (2,) is by how much what it is told of its position is wrong, all the time."""
        self._vehicles = vehicles
        self._robot = robot
        self._bias_m = bias_m

    def odometry(self) -> Odometry:
        """The truth, but for the bias; the vehicles are planar."""
        position_m = self._vehicles.position_m(self._robot)
        if self._bias_m is not None:
            position_m = position_m + self._bias_m
        x_m, y_m = position_m.tolist()
        x_m_s, y_m_s = self._vehicles.velocity_m_s(self._robot).tolist()
        return Odometry((x_m, y_m, 0.0), (x_m_s, y_m_s, 0.0))
