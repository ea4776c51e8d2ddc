"""Frames of positions and velocities, and the transforms between them.

Paper: "A Scalable Multi-Robot Framework for Decentralized and Asynchronous
Perception-Action-Communication Loops". Its printed rotation, R_z(3 pi/2 - theta) R_x(pi),
contradicts its own convention, which is used here.

| frame | axes | origin |
| --- | --- | --- |
| mission M | x right, y forward, z up, m | the operator's: latitude, longitude, heading theta |
| local L | x north, y east, z down, m | the autopilot's estimator origin, which may jump |
| model | x and y of M, times `env_scale` | as M; the corner of the world that the policy covers |

theta is the compass heading of the mission y axis: rad, clockwise from true north.
"""

import math
import struct
import zlib
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, TypeVar

import numpy as np
from geographiclib.geodesic import Geodesic
from msgspec import Meta

from edge.core import F32, F64
from edge.core.schema import Bounded, Positive, require

Latitude = Annotated[float, Meta(ge=-90.0, le=90.0)]
Longitude = Annotated[float, Meta(ge=-180.0, le=180.0)]
_Array = TypeVar("_Array", F32, F64)


@lru_cache(maxsize=8)
def m_per_deg(latitude_deg: float) -> tuple[float, float]:
    """Lengths of a degree to the north and to the east on the WGS84 ellipsoid, m.

    Up to 45 degrees of latitude, the error is 1 mm at 100 m and 0.1 m at 1 km.
    """
    semi_major_m, eccentricity_2 = 6378137.0, 6.69437999014e-3
    latitude = math.radians(latitude_deg)
    w_2 = 1.0 - eccentricity_2 * math.sin(latitude) ** 2
    meridian_m = semi_major_m * (1.0 - eccentricity_2) / w_2**1.5
    normal_m = semi_major_m / math.sqrt(w_2) * math.cos(latitude)
    return math.radians(meridian_m), math.radians(normal_m)


@dataclass(frozen=True, slots=True)
class MissionFrame(Bounded):
    """The mission frame on the earth: WGS84 degrees, and heading theta in [0, 2 pi).

    Raises ValueError if a number is out of range.
    """

    latitude_deg: Latitude
    longitude_deg: Longitude
    heading_rad: Annotated[float, Meta(ge=0.0, lt=math.tau)]

    @property
    def frame_id(self) -> int:
        """CRC-32 of the three numbers: positions with different ids are not comparable."""
        return zlib.crc32(
            struct.pack("<3d", self.latitude_deg, self.longitude_deg, self.heading_rad)
        )

    def to_global_deg(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Latitude and longitude, deg, of a place in the mission frame."""
        sin, cos = math.sin(self.heading_rad), math.cos(self.heading_rad)
        north_m, east_m = cos * y_m - sin * x_m, sin * y_m + cos * x_m
        place = Geodesic.WGS84.Direct(
            self.latitude_deg,
            self.longitude_deg,
            math.degrees(math.atan2(east_m, north_m)),
            math.hypot(north_m, east_m),
        )
        return place["lat2"], place["lon2"]

    def relative_to(
        self,
        local_origin_latitude_deg: float,
        local_origin_longitude_deg: float,
        local_origin_altitude_m: float = 0.0,
    ) -> "LocalTransform":
        """The transform for a local origin, valid until that origin jumps.

        Mission z has the same zero as the origin's altitude, so heights stay the same when it
        jumps.

        R = [[-sin theta, cos theta, 0], [cos theta, sin theta, 0], [0, 0, -1]]; the geodesic of
        length d and azimuth alpha leads from the mission origin to the local one. North is taken to
        be the same direction at both origins, an error of d^2 tan(latitude) / 6371 km: 1.6 mm at d
        = 100 m and 45 degrees.

        Raises ValueError if the local origin is out of range.
        """
        require(Latitude, local_origin_latitude_deg, "local_origin_latitude_deg")
        require(Longitude, local_origin_longitude_deg, "local_origin_longitude_deg")
        geodesic = Geodesic.WGS84.Inverse(
            self.latitude_deg,
            self.longitude_deg,
            local_origin_latitude_deg,
            local_origin_longitude_deg,
        )
        d_m, alpha_rad = geodesic["s12"], math.radians(geodesic["azi1"])
        sin, cos = math.sin(self.heading_rad), math.cos(self.heading_rad)
        rotation = np.array([[-sin, cos, 0.0], [cos, sin, 0.0], [0.0, 0.0, -1.0]])
        local_origin_m = rotation @ (
            d_m * math.cos(alpha_rad),
            d_m * math.sin(alpha_rad),
            -local_origin_altitude_m,
        )
        rotation.setflags(write=False)
        local_origin_m.setflags(write=False)
        return LocalTransform(rotation, local_origin_m)


@dataclass(frozen=True, slots=True, eq=False)
class LocalTransform:
    """Transform between a local frame and the mission frame; see `MissionFrame.relative_to`.

    `rotation` (3, 3) is R, its own inverse. `local_origin_m` (3,) is in the mission frame. All
    methods take and return (3,) float64.
    """

    rotation: F64
    local_origin_m: F64

    def local_to_mission(self, position_local_m: F64) -> F64:
        """p_M = R (p_L + (d cos alpha, d sin alpha, -altitude)), m."""
        return self._turned(position_local_m) + self.local_origin_m

    def mission_to_local(self, position_mission_m: F64) -> F64:
        """p_L = R p_M - (d cos alpha, d sin alpha, -altitude), m."""
        return self._turned(position_mission_m - self.local_origin_m)

    def velocity_to_mission(self, velocity_local_m_s: F64) -> F64:
        """v_M = R v_L, m/s."""
        return self._turned(velocity_local_m_s)

    def velocity_to_local(self, velocity_mission_m_s: F64) -> F64:
        """v_L = R v_M, m/s."""
        return self._turned(velocity_mission_m_s)

    def _turned(self, vector: F64) -> F64:
        # `@` takes twice as long for such small arrays.
        turned: F64 = self.rotation.dot(vector)
        return turned


@dataclass(frozen=True, slots=True)
class ModelScale(Bounded):
    """Scales between the mission frame and the policy's model units.

    `env_scale` is in model units per m; `velocity_scale` is in m/s per model velocity. They are
    independent. Arrays may have any shape, and keep their dtype.

    Raises ValueError if a scale is not finite and above 0.
    """

    env_scale: Positive
    velocity_scale: Positive

    def position_to_model(self, position_mission_m: _Array) -> _Array:
        """Mission position, m, to model units."""
        return position_mission_m * self.env_scale

    def position_to_mission_m(self, position_model: _Array) -> _Array:
        """Model position to m in the mission frame."""
        return position_model / self.env_scale

    def velocity_to_mission_m_s(self, velocity_model: _Array) -> _Array:
        """The policy's velocity to m/s in the mission frame."""
        return velocity_model * self.velocity_scale

    def velocity_to_model(self, velocity_mission_m_s: _Array) -> _Array:
        """Mission velocity, m/s, to the policy's units."""
        return velocity_mission_m_s / self.velocity_scale
