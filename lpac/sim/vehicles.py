"""Point vehicles that follow velocity commands inside the world."""

import math

import numpy as np

from edge.core import F64
from edge.core.ports import Odometry
from edge.core.schema import NonNegative, require


class PointVehicles:
    """N planar vehicles in the mission frame, m and s.

    The world's border stops a vehicle like a wall; one that starts outside may come back in, but
    go no further out.
    """

    def __init__(self, positions_m: F64, world_size_m: float, lag_s: float = 0.0) -> None:
        """`positions_m` is (N, 2), at time 0.

        `lag_s` is the first-order time constant with which a velocity follows its command; 0: no
        lag. Raises ValueError if it is not finite and at least 0.
        """
        require(NonNegative, lag_s, "lag_s")
        # (2, N) each: operations on all vehicles then run along contiguous memory.
        self._start_m = np.ascontiguousarray(positions_m.T)
        self._velocity_m_s = np.zeros_like(self._start_m)
        # Velocity before the command, minus the command.
        self._excess_m_s = np.zeros_like(self._start_m)
        self._since_s = np.zeros(len(positions_m))
        self._world_size_m = world_size_m
        self._lag_s = lag_s
        # Set by the caller; it never decreases.
        self.now_s = 0.0

    def positions_m(self) -> F64:
        """Positions (N, 2) now."""
        return self._now_m(slice(None)).T

    def position_m(self, robot: int) -> F64:
        """Position (2,) of one vehicle now."""
        return self._now_m(robot)

    def velocities_m_s(self) -> F64:
        """Commanded velocities (N, 2)."""
        return self._velocity_m_s.T.copy()

    def velocity_m_s(self, robot: int) -> F64:
        """Commanded velocity (2,) of one vehicle."""
        return self._velocity_m_s[:, robot]

    def fly(self, robot: int, velocity_m_s: F64) -> None:
        """Command the velocity (2,) from now on."""
        self._start_m[:, robot] = self.position_m(robot)
        if self._lag_s:
            left = math.exp(-(self.now_s - self._since_s[robot]) / self._lag_s)
            before_m_s = self._velocity_m_s[:, robot] + self._excess_m_s[:, robot] * left
            self._excess_m_s[:, robot] = before_m_s - velocity_m_s
        self._since_s[robot] = self.now_s
        self._velocity_m_s[:, robot] = velocity_m_s

    def stop(self, robot: int) -> None:
        """Stop the vehicle at once."""
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
    """OdometrySource of one vehicle, with a constant position error."""

    def __init__(self, vehicles: PointVehicles, robot: int, bias_m: F64 | None = None) -> None:
        """`bias_m` (2,) is added to the true position."""
        self._vehicles = vehicles
        self._robot = robot
        self._bias_m = bias_m

    def odometry(self) -> Odometry:
        """True state plus the bias; the vehicles are planar."""
        position_m = self._vehicles.position_m(self._robot)
        if self._bias_m is not None:
            position_m = position_m + self._bias_m
        x_m, y_m = position_m.tolist()
        x_m_s, y_m_s = self._vehicles.velocity_m_s(self._robot).tolist()
        return Odometry((x_m, y_m, 0.0), (x_m_s, y_m_s, 0.0))
