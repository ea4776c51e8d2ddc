"""The robot's position in the mission frame, from the autopilot's local one."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from edge.core.frames import LocalTransform, MissionFrame, m_per_deg
from edge.core.ports import Odometry, Vehicle
from edge.core.position import PositionJudgement, PositionLimits, PositionQuality, judge
from edge.core.vehicle import GlobalOrigin, Position, Setpoint, VehicleState, Velocity
from edge.flight.guidance import MissionPosition, MissionSetpoint, vector

# A dozen missing positions at 20 Hz.
MAX_POSITION_AGE_S = 0.6
_MAX_SETPOINT_POSITION_AGE_S = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class _Fixed:
    """A transform, and the two origins for which it is valid."""

    frame: MissionFrame
    local_origin: GlobalOrigin
    transform: LocalTransform


class Navigation:
    """The robot's position (an OdometrySource). Thread-safe.

    The control thread replaces `frame` (the mission frame), `datum_m` (the takeoff point's
    altitude) and `position` (the position's quality) whole.

    Height jumps of the estimate since arming are subtracted from altitudes: the vehicle did not
    move then, and must not move through others' heights because of a jump.
    """

    def __init__(
        self, vehicle: Vehicle, clock_s: Callable[[], float], limits: PositionLimits
    ) -> None:
        """Take the vehicle's monotonic clock as `clock_s`, s."""
        self._vehicle = vehicle
        self._clock_s = clock_s
        self._limits = limits
        self._fixed: _Fixed | None = None
        self.position = PositionJudgement()
        self.frame: MissionFrame | None = None
        self.datum_m: float | None = None

    def update(self, vehicle: VehicleState, now_s: float) -> None:
        """Judge the position's quality, a few times a second. Control thread only."""
        self.position = judge(self.position, vehicle, self._limits, now_s)

    def odometry(self) -> Odometry | None:
        """Position and velocity; z is the height above the takeoff point, 0 before takeoff.

        None if the estimate is, or if the vehicle is armed and its takeoff point unknown.
        """
        vehicle = self._vehicle.state()
        estimate = self.estimate(vehicle)
        if estimate is None or (self.datum_m is None and vehicle.armed):
            return None
        x_m, y_m, z_m = estimate.position_m
        height_m = 0.0 if self.datum_m is None else z_m - self.datum_m
        return Odometry((x_m, y_m, height_m), estimate.velocity_m_s)

    def estimate(self, vehicle: VehicleState) -> Odometry | None:
        """Position and velocity; z is the altitude above sea level, less its jumps in flight.

        None when lost or too old.
        """
        transform = self._transform(vehicle)
        position_m, velocity_m_s = vehicle.position_local_m, vehicle.velocity_local_m_s
        if transform is None or position_m is None or velocity_m_s is None:
            return None
        if not self._is_known(vehicle):
            return None
        x_m, y_m, z_m = vector(transform.local_to_mission(np.array(position_m)))
        return Odometry(
            (x_m, y_m, z_m - vehicle.height_jumped_m),
            vector(transform.velocity_to_mission(np.array(velocity_m_s))),
        )

    def place_in(self, frame: MissionFrame, vehicle: VehicleState) -> tuple[float, float] | None:
        """Position of the robot in `frame`, (x, y), m; None when lost or too old."""
        origin, position_m = vehicle.origin, vehicle.position_local_m
        if origin is None or position_m is None or not self._is_known(vehicle):
            return None
        transform = frame.relative_to(*origin)
        x_m, y_m, _ = vector(transform.local_to_mission(np.array(position_m)))
        return x_m, y_m

    def global_deg(self, vehicle: VehicleState) -> tuple[float, float] | None:
        """Latitude and longitude, also without a mission frame; None when lost or too old."""
        origin, position_m = vehicle.origin, vehicle.position_local_m
        if origin is None or position_m is None or not self._is_known(vehicle):
            return None
        # Exact enough for display: the geodesic takes fifty times as long.
        north_m, east_m = m_per_deg(origin.latitude_deg)
        longitude_deg = (origin.longitude_deg + position_m[1] / east_m + 180.0) % 360.0 - 180.0
        return origin.latitude_deg + position_m[0] / north_m, longitude_deg

    def to_local(self, setpoint: MissionSetpoint, vehicle: VehicleState) -> Setpoint | None:
        """The setpoint in the vehicle's local frame; None if the transform is unknown.

        Without fresh positions, a position setpoint becomes a zero velocity: the estimator's origin
        may have jumped, and the same numbers mean another place.
        """
        transform = self._transform(vehicle)
        if transform is None:
            return None
        if isinstance(setpoint, MissionPosition):
            if self.datum_m is None:
                return None
            if self._clock_s() - vehicle.position_at_s > _MAX_SETPOINT_POSITION_AGE_S:
                return Velocity((0.0, 0.0, 0.0))
            x_m, y_m, height_m = setpoint.position_m
            place_m = np.array([x_m, y_m, height_m + self.datum_m + vehicle.height_jumped_m])
            return Position(vector(transform.mission_to_local(place_m)))
        return Velocity(vector(transform.velocity_to_local(np.array(setpoint.velocity_m_s))))

    def _is_known(self, vehicle: VehicleState) -> bool:
        age_s = self._clock_s() - vehicle.position_at_s
        return self.position.quality is not PositionQuality.LOST and age_s <= MAX_POSITION_AGE_S

    def _transform(self, vehicle: VehicleState) -> LocalTransform | None:
        frame, origin, fixed = self.frame, vehicle.origin, self._fixed
        if frame is None or origin is None:
            return None
        if fixed is None or fixed.frame is not frame or fixed.local_origin != origin:
            fixed = _Fixed(frame, origin, frame.relative_to(*origin))
            self._fixed = fixed
        return fixed.transform
