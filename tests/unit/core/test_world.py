"""World files and rasters, against the reference library where it is right."""

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.core import F32
from edge.core.world import Feature, GaussianFeature, PolygonFeature, parse_world, rasterize
from lpac.analysis.worlds import format_world, random_features
from tests.unit.core.reference import (
    coverage_control_core,
    point_vector,
    reference_parameters,
    reference_world,
)

# The library sums float32 quarter-plane integrals: what that leaves on sharp and on broad features.
SHARP_NOISE = 5e-5
BROAD_NOISE = 5e-3
BROAD_MEAN_NOISE = 2e-4

SQUARE = ((10.0, 12.0), (20.0, 12.0), (20.0, 25.0), (10.0, 25.0))
CONCAVE = ((5.0, 5.0), (50.1, 7.0), (49.3, 20.2), (20.2, 18.7), (21.1, 40.9), (52.2, 41.0), (6, 57))
BOW_TIE = ((5.0, 5.0), (40.2, 45.1), (40.4, 6.1), (6.1, 46.2))


def library_raster(
    features: Iterable[Feature], size: int, truncation: float = 2.0, norm: float = 1.0
) -> F32:
    parameters = reference_parameters(1, size, truncation, norm)
    return np.array(reference_world(features, parameters).GetWorldMap())


def circle(x: float, y: float, sigma: float, scale: float) -> GaussianFeature:
    return GaussianFeature((x, y), (sigma, sigma), 0.0, scale)


@pytest.mark.parametrize("seed", range(3))
def test_training_worlds_match_the_library(seed: int) -> None:
    features = random_features(np.random.default_rng(seed), 10, 512)
    difference = np.abs(rasterize(features, 512) - library_raster(features, 512))
    assert difference.max() < BROAD_NOISE
    assert difference.mean() < BROAD_MEAN_NOISE


@pytest.mark.parametrize("truncation", [1.0, 2.0, 3.5])
@pytest.mark.parametrize("norm", [1.0, 7.5])
def test_sharp_features_match_the_library_over_the_borders_too(
    truncation: float, norm: float
) -> None:
    features = (
        circle(20.3, 71.2, 5.0, 3.0),
        circle(24.0, 75.0, 3.0, 2.0),
        circle(-2.0, 30.0, 4.0, 1.0),
        circle(90.0, 97.5, 3.0, 1.0),
        circle(400.0, 40.0, 3.0, 9.0),
    )
    ours = rasterize(features, 96, truncation, norm)
    theirs = library_raster(features, 96, truncation, norm)
    assert ours.shape == (96, 96)
    assert ours.dtype == np.float32
    np.testing.assert_array_equal(ours > 0, theirs > 0)
    np.testing.assert_allclose(ours, theirs, atol=SHARP_NOISE * norm)


@pytest.mark.parametrize(
    "features",
    [
        (PolygonFeature(SQUARE, 3.0),),
        (PolygonFeature(SQUARE[::-1], 3.0),),
        (PolygonFeature(tuple((x + 0.5, y + 0.5) for x, y in SQUARE), 3.0),),
        (PolygonFeature(CONCAVE, 2.0),),
        (PolygonFeature(BOW_TIE, 2.0),),
        (PolygonFeature(((-20.0, -10.0), (30.2, -5.0), (20.1, 80.0), (-8.0, 30.0)), 1.0),),
        (PolygonFeature(((0.0, 0.0), (40.0, 40.0), (0.0, 40.0)), 1.0),),
        (PolygonFeature(CONCAVE, 2.0), PolygonFeature(SQUARE, 3.0), PolygonFeature(BOW_TIE, 1.0)),
        (PolygonFeature(SQUARE, 0.02), PolygonFeature(BOW_TIE, 0.03), circle(18.3, 17.2, 6.0, 4.0)),
    ],
    ids=lambda features: f"{len(features)} features",
)
def test_polygons_match_the_library(features: tuple[Feature, ...]) -> None:
    np.testing.assert_allclose(
        rasterize(features, 64), library_raster(features, 64), atol=SHARP_NOISE
    )


vertex = st.tuples(st.integers(-40, 200), st.integers(-40, 200)).map(lambda v: (v[0] / 4, v[1] / 4))


@settings(max_examples=60, deadline=None)
@given(st.lists(vertex, min_size=3, max_size=8))
def test_any_polygon_matches_the_library(vertices: list[tuple[float, float]]) -> None:
    features = (PolygonFeature(tuple(vertices), 1.0),)
    np.testing.assert_array_equal(rasterize(features, 40), library_raster(features, 40))


@pytest.mark.parametrize("correlation", [0.0, 0.6, -0.8])
def test_a_gaussian_is_integrated_over_each_cell(correlation: float) -> None:
    feature = GaussianFeature((21.3, 14.8), (7.0, 4.0), correlation, 5.0)
    covariance = np.array([[49.0, 28.0 * correlation], [28.0 * correlation, 16.0]])
    precision = np.linalg.inv(covariance)
    # 20 x 20 points per cell, on the plane.
    fine = np.arange(40 * 20) / 20 + 1 / 40
    offset = np.stack(np.meshgrid(fine - 21.3, fine - 14.8, indexing="ij"), axis=-1)
    density = np.exp(-0.5 * np.einsum("xyi,ij,xyj->xy", offset, precision, offset))
    cells = density.reshape(40, 20, 40, 20).mean(axis=(1, 3))
    centre = offset.reshape(40, 20, 40, 20, 2).mean(axis=(1, 3))
    cells[np.einsum("xyi,ij,xyj->xy", centre, precision, centre) > 4.0] = 0.0
    np.testing.assert_allclose(rasterize((feature,), 40), cells / cells.max(), atol=2e-5)


@pytest.mark.parametrize("correlation", [0.0, 0.5])
def test_the_scale_is_the_integral(correlation: float) -> None:
    narrow = GaussianFeature((50.0, 50.0), (3.0, 5.0), correlation, 2.0)
    wide = GaussianFeature((50.0, 150.0), (12.0, 9.0), 0.0, 6.0)
    raster = rasterize((narrow, wide), 200, truncation=5.0)
    assert raster[:, 100:].sum(dtype=float) == pytest.approx(
        3.0 * raster[:, :100].sum(dtype=float), rel=1e-4
    )


def test_the_library_takes_every_bnd_for_circular() -> None:
    """Its fault, and the reason why our raster of such a feature is not the library's."""
    elliptic = GaussianFeature((20.3, 41.2), (6.0, 3.0), 0.5, 7.0)
    theirs = library_raster((elliptic,), 64)
    np.testing.assert_allclose(
        theirs, rasterize((circle(20.3, 41.2, 6.0, 7.0),), 64), atol=SHARP_NOISE
    )


def test_the_maximum_is_the_norm() -> None:
    features = random_features(np.random.default_rng(1), 5, 100, sigma=(5.0, 9.0))
    assert rasterize(features, 100).max() == 1.0
    np.testing.assert_allclose(
        rasterize(features, 100, norm=2.5), 2.5 * rasterize(features, 100), rtol=1e-6
    )


@pytest.mark.parametrize(
    "features",
    [
        (),
        (circle(500.0, 20.0, 5.0, 1.0),),
        (circle(20.0, 20.0, 5.0, 0.0), PolygonFeature(SQUARE, 0.0)),
        (PolygonFeature(((5.0, 5.6), (60.0, 5.9), (60.0, 6.1)), 1.0),),
    ],
    ids=["none", "outside", "without importance", "between the cells' centres"],
)
def test_a_world_without_importance_is_zero(features: tuple[Feature, ...]) -> None:
    importance = rasterize(features, 64)
    assert importance.shape == (64, 64)
    assert not importance.any()


@pytest.mark.parametrize("weight", [1e-320, 1e-44, 1.0, 1e300])
def test_only_the_ratios_of_weights_matter(weight: float) -> None:
    features = (circle(20.0, 20.0, 5.0, weight), PolygonFeature(SQUARE, weight / 2))
    unit = (circle(20.0, 20.0, 5.0, 1.0), PolygonFeature(SQUARE, 0.5))
    np.testing.assert_allclose(rasterize(features, 64), rasterize(unit, 64), rtol=2e-3)


def test_random_features_are_drawn_as_the_library_draws_them(tmp_path: Path) -> None:
    parameters = reference_parameters(1)
    parameters.pMinSigma, parameters.pMaxSigma = 40.0, 60.0
    parameters.pMinPeak, parameters.pMaxPeak = 6.0, 10.0
    environment = coverage_control_core().CoverageSystem(parameters, 50, 1)
    environment.WriteEnvironment(str(tmp_path / "positions"), str(tmp_path / "world.env"))
    theirs = parse_world((tmp_path / "world.env").read_text())
    ours = random_features(np.random.default_rng(0), 50, 512)
    for drawn in (theirs, ours):
        features = [f for f in drawn if isinstance(f, GaussianFeature)]
        assert len(features) == len(drawn) == 50
        assert all(f.sigma[0] == f.sigma[1] and f.correlation == 0 for f in features)
        for value, least, greatest in (
            ([c for f in features for c in f.mean], 0.0, 512.0),
            ([f.sigma[0] for f in features], 40.0, 60.0),
            ([f.scale for f in features], 6.0, 10.0),
        ):
            assert least <= min(value) < least + 0.2 * (greatest - least)
            assert greatest - 0.2 * (greatest - least) < max(value) <= greatest


def test_files_of_the_library_are_read(tmp_path: Path) -> None:
    parameters = reference_parameters(1)
    features = (
        circle(71.74586665200018, 300.8065409189059, 57.83458920506547, 9.754416062304808),
        circle(150.0, 30.0, 45.0, 7.0),
        PolygonFeature(((131.6, 182.6), (121.8, 138.2), (193.4, 180.4)), 0.25),
    )
    environment = coverage_control_core().CoverageSystem(
        parameters, reference_world(features, parameters), point_vector([(5.0, 5.0)])
    )
    environment.WriteEnvironment(str(tmp_path / "positions"), str(tmp_path / "world.env"))
    assert parse_world((tmp_path / "world.env").read_text()) == features


def test_the_library_reads_our_files(tmp_path: Path) -> None:
    features = (circle(20.25, 41.2, 6.0, 7.0), PolygonFeature(CONCAVE, 0.01))
    path = tmp_path / "world.env"
    path.write_text(format_world(features))
    theirs = coverage_control_core().WorldIDF(reference_parameters(1, 64), str(path))
    np.testing.assert_array_equal(theirs.GetWorldMap(), library_raster(features, 64))


number = st.floats(-1e7, 1e7)
positive = st.floats(0.0, 1e7, exclude_min=True)
not_negative = st.floats(0.0, allow_infinity=False)
any_feature = st.one_of(
    st.builds(
        GaussianFeature,
        st.tuples(number, number),
        st.tuples(positive, positive),
        st.floats(-1.0, 1.0, exclude_min=True, exclude_max=True),
        not_negative,
    ),
    st.builds(
        PolygonFeature,
        st.lists(st.tuples(number, number), min_size=3, max_size=6).map(tuple),
        not_negative,
    ),
)


@given(st.lists(any_feature, max_size=5).map(tuple))
def test_a_world_file_gives_its_features_back_exactly(features: tuple[Feature, ...]) -> None:
    assert parse_world(format_world(features)) == features


def test_records_may_span_lines() -> None:
    text = "CircularBND\n1 2\t3\n4 BND 1 2 3 4 0.5 6\n\nUniform 3 .5 0 0 1e1 0\n+5 -5."
    assert parse_world(text) == (
        GaussianFeature((1.0, 2.0), (3.0, 3.0), 0.0, 4.0),
        GaussianFeature((1.0, 2.0), (3.0, 4.0), 0.5, 6.0),
        PolygonFeature(((0.0, 0.0), (10.0, 0.0), (5.0, -5.0)), 0.5),
    )
    assert parse_world(" \n") == ()


PARK = (PolygonFeature(((100.0, 100.0), (200.0, 100.0), (200.0, 200.0), (100.0, 200.0)), 0.7),)


@pytest.mark.parametrize(
    "text",
    [
        # As the library wrote it until April 2024, and since.
        "Uniform\n4\n100 100\n200 100\n200 200\n100 200\n0.7\n",
        "Uniform\n4 0.7\n100 100\n200 100\n200 200\n100 200\n",
        # In the wrong order corners are doubled.
        "Uniform 4 100 100 200 100 200 200 100 200 0.7",
        "Uniform 4 0.7 100 100 200 100 200 200 100 200",
        "Uniform\n4\n100\n100\n200\n100\n200\n200\n100\n200\n0.7",
    ],
    ids=["until", "since", "until, in a line", "since, in a line", "a number a line"],
)
def test_the_importance_of_a_polygon_is_second_or_last(text: str) -> None:
    assert parse_world(text) == PARK


def test_the_order_is_what_makes_a_polygon_of_it() -> None:
    (crossing_else,) = parse_world("Uniform 4 3 2 5 2 8 8 8 7 4")
    assert crossing_else == PolygonFeature(((2.0, 5.0), (2.0, 8.0), (8.0, 8.0), (7.0, 4.0)), 3.0)
    (negative_else,) = parse_world("Uniform 3 -1 0 0 1 1 0 2")
    assert negative_else == PolygonFeature(((-1.0, 0.0), (0.0, 1.0), (1.0, 0.0)), 2.0)


def test_a_polygon_that_makes_sense_in_both_orders_is_refused() -> None:
    numbers = "0.25 131.6 182.6 121.8 138.2 193.4 180.4"
    with pytest.raises(ValueError, match=r"^world: record 1 \(Uniform\): ") as error:
        parse_world(f"Uniform 3 {numbers}")
    assert "either of importance 0.25, before its vertices" in str(error.value)
    assert "April 2024, or of importance 180.4, behind them" in str(error.value)
    assert "each vertex on a line of its own" in str(error.value)
    (second,) = parse_world("Uniform 3 0.25\n131.6 182.6\n121.8 138.2\n193.4 180.4")
    assert isinstance(second, PolygonFeature) and second.importance == 0.25
    (last,) = parse_world("Uniform 3\n0.25 131.6\n182.6 121.8\n138.2 193.4\n180.4")
    assert isinstance(last, PolygonFeature) and last.importance == 180.4


GAUSSIAN_FIELDS = "(expected: x y sigma_x sigma_y rho scale)"


@pytest.mark.parametrize(
    ("record", "message"),
    [
        ("Disc 1 2", "(Disc): unknown kind, must be CircularBND, BND or Uniform"),
        ("# comment", "(#): unknown kind, must be CircularBND, BND or Uniform"),
        (
            "CircularBND 1 2 3",
            "(CircularBND): scale is missing, must be a finite number (expected: x y sigma scale)",
        ),
        ("BND 1 2 3 4 x 6", f"(BND): rho is x, must be a finite number {GAUSSIAN_FIELDS}"),
        ("BND 1 2 3 BND", f"(BND): sigma_y is BND, must be a finite number {GAUSSIAN_FIELDS}"),
        ("BND nan 2 3 4 0 6", f"(BND): x is nan, must be a finite number {GAUSSIAN_FIELDS}"),
        ("BND 1e999 2 3 4 0 6", f"(BND): x is 1e999, must be a finite number {GAUSSIAN_FIELDS}"),
        ("BND 1_0 2 3 4 0 6", f"(BND): x is 1_0, must be a finite number {GAUSSIAN_FIELDS}"),
        ("BND 1 2 3 0 0 6", "(BND): sigma[1] = 0.0: must be above 0 and at most 1e+07"),
        (
            "CircularBND 1 2 -3 4",
            "(CircularBND): sigma[0] = -3.0: must be above 0 and at most 1e+07",
        ),
        ("BND 1 2 3 4 -1 6", "(BND): correlation = -1.0: must be above -1 and below 1"),
        ("CircularBND 1 2 3 -4", "(CircularBND): scale = -4.0: must be at least 0 and finite"),
        ("Uniform", "(Uniform): num_vertices is missing, must be a whole number >= 3"),
        ("Uniform 3.0 1", "(Uniform): num_vertices is 3.0, must be a whole number >= 3"),
        ("Uniform 2 1 0 0 1 1", "(Uniform): num_vertices is 2, must be a whole number >= 3"),
        (
            "Uniform 3 -1\n0 0\n1 1\n0 1",
            "(Uniform): importance = -1.0: must be at least 0 and finite",
        ),
        (
            "Uniform 3 1 0 0 1 1 5",
            "(Uniform): y3 is missing, must be a finite number (expected: x3 y3)",
        ),
    ],
)
def test_a_faulty_file_is_refused_in_one_line(record: str, message: str) -> None:
    with pytest.raises(ValueError) as error:
        parse_world(f"CircularBND 1 2 3 4\n{record}", "park.env")
    assert str(error.value) == f"park.env: record 2 {message}"


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_features_must_be_finite(bad: float) -> None:
    with pytest.raises(ValueError, match=rf"^mean\[0\] = {bad}: must be from -1e\+07 to 1e\+07$"):
        GaussianFeature((bad, 0.0), (1.0, 1.0))
    with pytest.raises(ValueError, match=rf"^vertices\[1\]\[1\] = {bad}: must be from -1e\+07 to"):
        PolygonFeature(((0.0, 0.0), (1.0, bad), (1.0, 0.0)), 1.0)
