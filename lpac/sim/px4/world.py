"""Geographic origin of the simulated world, and fence polygons."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

from edge.core import F64
from edge.core.frames import m_per_deg


class WorldOrigin(NamedTuple):
    """Origin of the world frame: WGS84 degrees, and the ground's height above mean sea level."""

    latitude_deg: float = 39.9526
    longitude_deg: float = -75.1652
    altitude_m: float = 10.0

    def to_global(self, position_m: Sequence[float] | F64) -> tuple[float, float, float]:
        """Latitude and longitude, deg, and height above mean sea level, m, of a world position."""
        north_m, east_m = m_per_deg(self.latitude_deg)
        return (
            self.latitude_deg + float(position_m[0]) / north_m,
            self.longitude_deg + float(position_m[1]) / east_m,
            self.altitude_m - float(position_m[2]),
        )

    def to_world(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """North and east of a place, m."""
        north_m, east_m = m_per_deg(self.latitude_deg)
        return (
            (latitude_deg - self.latitude_deg) * north_m,
            (longitude_deg - self.longitude_deg) * east_m,
        )


@dataclass(frozen=True, slots=True, eq=False)
class FencePolygon:
    """Inclusion or exclusion polygon of PX4's geofence: (latitude, longitude) in deg, in order.

    Compared and hashed by identity: comparing vertices fifty times a second would be too slow.
    """

    inclusion: bool
    vertices_deg: tuple[tuple[float, float], ...]

    def contains(self, world: WorldOrigin, north_m: float, east_m: float) -> bool:
        """Whether a place of the world lies inside the polygon (even-odd rule)."""
        inside = False
        for (n_1, e_1), (n_2, e_2) in _edges_m(self, world):
            crosses = (e_1 > east_m) != (e_2 > east_m)
            if crosses and north_m < n_1 + (east_m - e_1) * (n_2 - n_1) / (e_2 - e_1):
                inside = not inside
        return inside


@lru_cache
def _edges_m(
    polygon: FencePolygon, world: WorldOrigin
) -> tuple[tuple[tuple[float, float], tuple[float, float]], ...]:
    """Edges as pairs of corners, each north and east."""
    corners_m = [world.to_world(*vertex_deg) for vertex_deg in polygon.vertices_deg]
    return tuple(zip(corners_m, corners_m[1:] + corners_m[:1], strict=True))
