"""The world: an importance density function (IDF) as features, and its raster.

Model units, x and y from the world's corner. The raster equals CoverageControl 1.3.1's for the same
features, because the policies are trained on its worlds, except for two of its faults:

- It computes integrals over cells as differences of float32 numbers. Their noise is up to 0.4 % of
  the maximum at a standard deviation of 60 cells, and rarely changes a cell on the edge of the
  truncation. Here they are exact.
- It treats every `BND` as circular with `sigma_x`. Here `sigma_y` and `rho` count.
"""

import itertools
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from edge.core import F32, F64
from edge.core.schema import Bounded, NonNegative

# A raster of more features takes a robot minutes.
MOST_FEATURES = 2000
# Numbers that the library's C++ streams accept; Python's float() accepts more, such as 1_0.
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_COUNT = re.compile(r"\+?\d+", re.ASCII)
# Far beyond every world, and small enough to be squared without loss.
_LONGEST = 1e7
_Coordinate = Annotated[float, Meta(ge=-_LONGEST, le=_LONGEST)]
_Width = Annotated[float, Meta(gt=0.0, le=_LONGEST)]
# Offsets from a cell's centre, and weights, of the quadrature along one axis of a cell.
_NODES, _WEIGHTS = (0.5 * values for values in np.polynomial.legendre.leggauss(4))


@dataclass(frozen=True, slots=True)
class GaussianFeature(Bounded):
    """A bivariate normal density times `scale`: its integral over the plane is `scale`.

    Raises ValueError unless all numbers are finite, sigma > 0, |correlation| < 1 and scale >= 0.
    """

    mean: tuple[_Coordinate, _Coordinate]
    sigma: tuple[_Width, _Width]
    correlation: Annotated[float, Meta(gt=-1.0, lt=1.0)] = 0.0
    scale: NonNegative = 1.0


@dataclass(frozen=True, slots=True)
class PolygonFeature(Bounded):
    """Constant importance in a polygon, possibly concave, with either orientation.

    Raises ValueError unless there are 3 vertices or more, all numbers are finite, importance >= 0.
    """

    vertices: Annotated[tuple[tuple[_Coordinate, _Coordinate], ...], Meta(min_length=3)]
    importance: NonNegative


Feature = GaussianFeature | PolygonFeature


def parse_world(text: str, source: str = "world") -> tuple[Feature, ...]:
    """Read the features of a CoverageControl world file (`.env`), in its order.

    Records are words separated by white space, including line ends: `CircularBND x y sigma scale`,
    `BND x y sigma_x sigma_y rho scale` and `Uniform num_vertices importance x1 y1 x2 y2 ...`. Until
    April 2024 the library wrote a polygon's importance last: that order is read if only it makes
    sense, and refused if both do. Raises ValueError, one line with `source`, the record's number
    and kind, and the cause.
    """
    words = _Reader(text)
    features: list[Feature] = []
    while kind := words.take():
        try:
            features.append(_read_feature(kind, words))
        except ValueError as error:
            record = f"record {len(features) + 1} ({kind})"
            raise ValueError(f"{source}: {record}: {error}") from None
    return tuple(features)


def rasterize(
    features: tuple[Feature, ...], world_size: int, truncation: float = 2.0, norm: float = 1.0
) -> F32:
    """The IDF on a raster (world_size, world_size), indexed [x, y]; cell side one model unit.

    A Gaussian adds its integral over each cell with a centre within `truncation` standard
    deviations of the mean (Mahalanobis distance). The largest of the polygons around the cell's
    centre is added to the sum of Gaussians; centres on an outline are outside, and so is every
    second layer of a polygon that overlaps itself. The raster is scaled to the maximum `norm`;
    without importance it is zero.

    Integrals are exact to rounding, except for correlated Gaussians: quadrature, good to 1e-6 of
    the maximum if the feature's smallest standard deviation in any direction is at least one cell.
    """
    raster = np.zeros((world_size, world_size), np.float32)
    polygons = np.zeros_like(raster)
    # Relative to the largest weight: float32 does not hold every number that a file may contain.
    largest = max((_weight(feature) for feature in features), default=0.0)
    if largest == 0.0:
        return raster
    for feature in features:
        if isinstance(feature, GaussianFeature):
            reach = (truncation * feature.sigma[0], truncation * feature.sigma[1])
            lower = (feature.mean[0] - reach[0], feature.mean[1] - reach[1])
            upper = (feature.mean[0] + reach[0], feature.mean[1] + reach[1])
            box = _cells_between(lower, upper, world_size)
            raster[box] += _gaussian_cells(feature, truncation, *_centres(box)) * (
                feature.scale / largest
            )
        else:
            xs, ys = zip(*feature.vertices, strict=True)
            box = _cells_between((min(xs), min(ys)), (max(xs), max(ys)), world_size)
            inside = _inside(feature.vertices, *_centres(box))
            layer = np.where(inside, np.float32(feature.importance / largest), np.float32(0.0))
            np.maximum(polygons[box], layer, out=polygons[box])
    raster += polygons
    maximum = raster.max(initial=0.0)
    if maximum > 0.0:
        raster /= maximum
        raster *= norm
    return raster


def has_importance(features: Iterable[Feature]) -> bool:
    """Whether any feature has a scale or importance above 0."""
    return any(_weight(feature) > 0.0 for feature in features)


def _weight(feature: Feature) -> float:
    return feature.scale if isinstance(feature, GaussianFeature) else feature.importance


_Box = tuple[slice, slice]


def _cells_between(lower: tuple[float, float], upper: tuple[float, float], world_size: int) -> _Box:
    """The world's cells in the rectangle from `lower` to `upper`."""
    x, y = (
        slice(min(max(math.floor(a), 0), world_size), min(max(math.ceil(b), 0), world_size))
        for a, b in zip(lower, upper, strict=True)
    )
    return x, y


def _centres(box: _Box) -> tuple[F64, F64]:
    x, y = (np.arange(side.start, side.stop, dtype=np.float64) + 0.5 for side in box)
    return x, y


def _gaussian_cells(feature: GaussianFeature, truncation: float, x: F64, y: F64) -> F64:
    """Shares (len(x), len(y)) of the feature's integral in the cells with these centres."""
    rho = feature.correlation
    u = (x - feature.mean[0]) / feature.sigma[0]
    v = (y - feature.mean[1]) / feature.sigma[1]
    if rho == 0.0:
        in_x = _normal_integral(u, 0.5 / feature.sigma[0])
        in_y = _normal_integral(v, 0.5 / feature.sigma[1])
        cells = np.outer(in_x, in_y)
    else:
        peak = 1.0 / (2 * math.pi * math.prod(feature.sigma) * math.sqrt(1 - rho * rho))
        cells = np.zeros((len(x), len(y)))
        for dx, weight_x in zip(_NODES, _WEIGHTS, strict=True):
            for dy, weight_y in zip(_NODES, _WEIGHTS, strict=True):
                distance2 = _mahalanobis2(u + dx / feature.sigma[0], v + dy / feature.sigma[1], rho)
                cells += weight_x * weight_y * peak * np.exp(-0.5 * distance2)
    cells[_mahalanobis2(u, v, rho) > truncation * truncation] = 0.0
    return cells


def _normal_integral(z: F64, half_width: float) -> F64:
    """Integrals (len(z),) of the standard normal density from z - half_width to z + half_width.

    `z` are ascending centres, two half widths apart.
    """
    edges = np.append(z - half_width, z[-1:] + half_width)
    cumulated = [0.5 * math.erf(edge / math.sqrt(2.0)) for edge in edges.tolist()]
    return np.diff(np.array(cumulated))


def _mahalanobis2(u: F64, v: F64, rho: float) -> F64:
    """Squared Mahalanobis distances (len(u), len(v)); `u` and `v` in standard deviations."""
    u = u[:, None]
    distance2: F64 = (u * u - 2.0 * rho * u * v + v * v) / (1.0 - rho * rho)
    return distance2


def _inside(vertices: tuple[tuple[float, float], ...], x: F64, y: F64) -> npt.NDArray[np.bool_]:
    """Whether an odd number of edges lies to one side, (len(x), len(y)); `y` ascending."""
    inside = np.zeros((len(x), len(y)), np.bool_)
    on_edge = np.zeros_like(inside)
    for (xa, ya), (xb, yb) in zip(vertices, vertices[1:] + vertices[:1], strict=True):
        rows = slice(
            np.searchsorted(y, min(ya, yb), side="left"),
            np.searchsorted(y, max(ya, yb), side="right"),
        )
        left = (xb - xa) * (y[rows] - ya) - (yb - ya) * (x[:, None] - xa)
        crosses = (ya > y[rows]) != (yb > y[rows])
        inside[:, rows] ^= crosses & ((left > 0.0) == (yb > ya))
        in_span = (x >= min(xa, xb)) & (x <= max(xa, xb))
        on_edge[:, rows] |= (left == 0.0) & in_span[:, None]
    return inside & ~on_edge


class _Reader:
    """Words of a file in order."""

    def __init__(self, text: str) -> None:
        lines = enumerate(text.splitlines())
        self._words = ((word, number) for number, line in lines for word in line.split())
        # Line of the last word.
        self.line = 0

    def take(self) -> str:
        """The next word; "" at the end."""
        word, self.line = next(self._words, ("", self.line))
        return word


def _read_feature(kind: str, words: _Reader) -> Feature:
    match kind:
        case "CircularBND":
            x, y, sigma, scale = _read_numbers(words, "x y sigma scale")
            return GaussianFeature((x, y), (sigma, sigma), 0.0, scale)
        case "BND":
            x, y, sigma_x, sigma_y, rho, scale = _read_numbers(
                words, "x y sigma_x sigma_y rho scale"
            )
            return GaussianFeature((x, y), (sigma_x, sigma_y), rho, scale)
        case "Uniform":
            return _read_polygon(words)
        case _:
            raise ValueError("unknown kind, must be CircularBND, BND or Uniform")


def _read_polygon(words: _Reader) -> PolygonFeature:
    count = words.take() or "missing"
    if not (_COUNT.fullmatch(count) and int(count) >= 3):
        raise ValueError(f"num_vertices is {count}, must be a whole number >= 3")
    names = itertools.chain(["importance"], (f"x{i} y{i}" for i in range(1, int(count) + 1)))
    numbers, lines = [], []
    for expected in names:
        for name in expected.split():
            numbers.append(_read_number(words, name, expected))
            lines.append(words.line)
    orders = [_Order(numbers[0], numbers[1:], lines[1:]), _Order(numbers[-1], numbers[:-1], lines)]
    # Lines end anywhere except within a vertex, so the layout says more than the values.
    for makes_sense in (_Order.is_whole, _Order.is_weighted, _Order.is_simple):
        orders = [order for order in orders if makes_sense(order)] or orders
    if len(orders) == 2:
        raise ValueError(
            f"is either of importance {numbers[0]:g}, before its vertices, as in CoverageControl "
            f"since April 2024, or of importance {numbers[-1]:g}, behind them, as until then: put "
            "each vertex on a line of its own"
        )
    (order,) = orders
    return PolygonFeature(order.vertices, order.importance)


class _Order:
    """One of the two possible orders of a polygon's numbers."""

    def __init__(self, importance: float, coordinates: list[float], lines: list[int]) -> None:
        self.importance = importance
        self.vertices = tuple(zip(coordinates[::2], coordinates[1::2], strict=True))
        self._lines = lines

    def is_whole(self) -> bool:
        """Whether no line ends between a vertex's x and y."""
        return all(a == b for a, b in zip(self._lines[::2], self._lines[1::2], strict=False))

    def is_weighted(self) -> bool:
        return self.importance >= 0.0

    def is_simple(self) -> bool:
        return _is_simple(self.vertices)


def _is_simple(vertices: tuple[tuple[float, float], ...]) -> bool:
    """Whether no corner is repeated, and sides only meet in the corners between them."""
    a = np.array(vertices)
    b = np.roll(a, -1, axis=0)
    side = b - a
    following = np.roll(side, -1, axis=0)
    back = (_cross(side, following) == 0.0) & ((side * following).sum(axis=1) <= 0.0)
    if back.any():
        return False
    lower, upper = np.minimum(a, b), np.maximum(a, b)
    for i in range(len(a) - 2):
        others = slice(i + 2, len(a) - 1 if i == 0 else len(a))
        across = _cross(side[i], a[others] - a[i]) * _cross(side[i], b[others] - a[i]) <= 0.0
        across &= _cross(side[others], a[i] - a[others]) * _cross(
            side[others], b[i] - a[others]
        ) <= 0.0  # fmt: skip
        beside = (lower[others] > upper[i]) | (upper[others] < lower[i])
        if (across & ~beside.any(axis=1)).any():
            return False
    return True


def _cross(u: F64, v: F64) -> F64:
    product: F64 = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    return product


def _read_numbers(words: _Reader, names: str) -> list[float]:
    return [_read_number(words, name, names) for name in names.split()]


def _read_number(words: _Reader, name: str, expected: str) -> float:
    word = words.take() or "missing"
    if not (_NUMBER.fullmatch(word) and math.isfinite(float(word))):
        raise ValueError(f"{name} is {word}, must be a finite number (expected: {expected})")
    return float(word)
