"""Geofence: a convex polygon in the mission frame, with a floor and a ceiling."""

import functools
import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta

from edge.core import F64
from edge.core.schema import Bounded, NonNegative, Positive

_Coordinate = Annotated[float, Meta(ge=-1e4, le=1e4)]
_Vertex = Annotated[tuple[_Coordinate, ...], Meta(min_length=2, max_length=2, description="[x, y]")]
# Three vertices with a smaller angle, rad, are on one line.
_STRAIGHT_RAD = 1e-9


@dataclass(frozen=True, slots=True)
class Fence(Bounded):
    """Permitted volume: a convex polygon, m, and heights from `floor_m` to `ceiling_m`.

    `vertices_m` are 3 to 100 points (x, y) in either orientation, closed. Robots stop `buffer_m`
    inside the line.

    Raises ValueError if the polygon is not convex or has no room within the buffer, or a number is
    out of range.
    """

    vertices_m: Annotated[tuple[_Vertex, ...], Meta(min_length=3, max_length=100)]
    buffer_m: Positive
    floor_m: NonNegative
    ceiling_m: Positive

    def check_rules(self) -> None:
        if not self.floor_m < self.ceiling_m:
            raise ValueError(
                f"ceiling_m = {self.ceiling_m}: must be above floor_m = {self.floor_m}"
            )
        depth_m = _depth_m(self.vertices_m)
        if depth_m is None:
            raise ValueError(
                f"vertices_m = {[list(vertex) for vertex in self.vertices_m]}: must be the "
                "corners of a convex polygon, in order, none twice"
            )
        if not depth_m > self.buffer_m:
            raise ValueError(
                f"buffer_m = {self.buffer_m}: must be below {depth_m:.3g}, "
                "the distance from the fence's centroid to its line"
            )

    def distance_m(self, x_m: float, y_m: float) -> float:
        """Distance to the line, m: positive inside; outside, minus the distance to the worst edge.

        NaN if x or y is.
        """
        return float(np.minimum.reduce(self.edges().distances_m(np.array([x_m, y_m]))))

    def moved_inside_m(self, x_m: float, y_m: float, depth_m: float) -> tuple[float, float]:
        """The nearest place that is `depth_m` inside every line, m, possibly the place itself.

        `depth_m` is at most `buffer_m`, so there is one. NaN if x or y is.
        """
        if self.distance_m(x_m, y_m) >= depth_m:
            return x_m, y_m
        place = np.array([x_m, y_m])
        corners = np.array(self.grown_m(-depth_m))
        sides = np.roll(corners, -1, axis=0) - corners
        shares = ((place - corners) * sides).sum(axis=1) / (sides**2).sum(axis=1)
        nearest = corners + np.clip(shares, 0.0, 1.0)[:, None] * sides
        x_m, y_m = nearest[((nearest - place) ** 2).sum(axis=1).argmin()]
        return float(x_m), float(y_m)

    def grown_m(self, margin_m: float) -> tuple[tuple[float, float], ...]:
        """Corners (x, y) of the polygon with every line moved outward by `margin_m`.

        A negative margin, of at most `buffer_m`, may remove short edges.
        """
        edges = self.edges()
        if margin_m < 0.0:
            corners = np.array(self.vertices_m)
            for inward, offset_m in zip(edges.inward, edges.offsets_m - margin_m, strict=True):
                corners = _cut(corners, inward, offset_m)
            return tuple((float(x_m), float(y_m)) for x_m, y_m in corners)
        after = edges.inward
        before = np.roll(after, 1, axis=0)
        outward = (before + after) / (1.0 + (before * after).sum(axis=1, keepdims=True))
        corners = np.array(self.vertices_m) - margin_m * outward
        return tuple((float(x_m), float(y_m)) for x_m, y_m in corners)

    def edges(self) -> "Edges":
        """Half planes of the polygon."""
        return _edges(self.vertices_m)


class Edges(NamedTuple):
    """Half planes of a polygon: inward unit normals (n, 2), and offsets (n,), m."""

    inward: F64
    offsets_m: F64

    def distances_m(self, point_m: F64) -> F64:
        """Distances (n,) of a point (2,) inside each edge's line."""
        along_m: F64 = self.inward.dot(point_m)
        return along_m - self.offsets_m


@functools.lru_cache(maxsize=64)  # used many times in each tick of the control loop
def _edges(vertices_m: tuple[tuple[float, ...], ...]) -> Edges:
    corners = np.array(vertices_m)
    along = np.roll(corners, -1, axis=0) - corners
    along = along / np.hypot(along[:, :1], along[:, 1:])
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)
    inward = left if _area(corners) > 0.0 else -left
    edges = Edges(inward, (inward * corners).sum(axis=1))
    for shared in edges:
        shared.flags.writeable = False
    return edges


@functools.lru_cache(maxsize=64)  # robots send the same polygon with every status
def _depth_m(vertices_m: tuple[tuple[float, ...], ...]) -> float | None:
    """Depth of the polygon's centroid inside its line; None if it is not convex."""
    corners = np.array(vertices_m)
    if not _is_convex(corners):
        return None
    return float(_edges(vertices_m).distances_m(np.array(_centroid(corners))).min())


def _cut(corners: F64, inward: F64, offset_m: float) -> F64:
    """Clip a convex polygon (n, 2) to the inner side of a line."""
    inside_m = corners @ inward - offset_m
    kept = []
    for k in range(len(corners)):
        if inside_m[k - 1] * inside_m[k] < 0.0:
            share = inside_m[k - 1] / (inside_m[k - 1] - inside_m[k])
            kept.append(corners[k - 1] + share * (corners[k] - corners[k - 1]))
        if inside_m[k] >= 0.0:
            kept.append(corners[k])
    return np.array(kept)


def _area(corners: F64) -> float:
    """Area within corners (n, 2), positive if they are counterclockwise."""
    x, y = corners.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def _centroid(corners: F64) -> tuple[float, float]:
    base, rest = corners[0], corners[1:] - corners[0]
    x, y = rest.T
    weights = x[:-1] * y[1:] - y[:-1] * x[1:]
    x_m, y_m = base + (weights[:, None] * (rest[:-1] + rest[1:])).sum(axis=0) / (3 * weights.sum())
    return float(x_m), float(y_m)


def _is_convex(corners: F64) -> bool:
    """Whether the corners turn in one direction, once around."""
    if abs(_area(corners - corners[0])) < 1e-9:
        return False
    along = np.roll(corners, -1, axis=0) - corners
    if not (np.abs(along).max(axis=1) > 0.0).all():
        return False
    after = np.roll(along, -1, axis=0)
    turns = np.arctan2(
        along[:, 0] * after[:, 1] - along[:, 1] * after[:, 0], (along * after).sum(axis=1)
    ) * math.copysign(1.0, _area(corners))
    return bool((turns > -_STRAIGHT_RAD).all()) and math.isclose(turns.sum(), math.tau)
