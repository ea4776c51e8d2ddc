"""World files written, and random worlds; `edge.core.world` reads them."""

import numpy as np

from edge.core.world import Feature, GaussianFeature, PolygonFeature


def format_world(features: tuple[Feature, ...]) -> str:
    """Write the world file of `features` in the library's form, except a record's first line end.

    `parse_world` reads it back exactly: each vertex of a polygon is on its own line.
    """
    return "".join(f"{_record(feature)}\n" for feature in features)


def random_features(
    rng: np.random.Generator,
    count: int,
    world_size: int,
    sigma: tuple[float, float] = (40.0, 60.0),
    scale: tuple[float, float] = (6.0, 10.0),
) -> tuple[GaussianFeature, ...]:
    """Draw `count` circular Gaussians, uniform in mean over the world, in sigma and in scale.

    `sigma` and `scale` are (least, greatest). The reference library draws worlds in this way; its
    feature's peak, `MinPeak` to `MaxPeak`, is the scale: the integral, not the maximum.
    """
    means = rng.uniform(0.0, world_size, (count, 2)).tolist()
    sigmas = rng.uniform(*sigma, count).tolist()
    scales = rng.uniform(*scale, count).tolist()
    return tuple(
        GaussianFeature(mean=(x, y), sigma=(s, s), scale=c)
        for (x, y), s, c in zip(means, sigmas, scales, strict=True)
    )


def _record(feature: Feature) -> str:
    if isinstance(feature, PolygonFeature):
        vertices = "".join(f"\n{_words(*vertex)}" for vertex in feature.vertices)
        return f"Uniform {len(feature.vertices)} {_words(feature.importance)}{vertices}"
    if feature.sigma[0] == feature.sigma[1] and feature.correlation == 0.0:
        return f"CircularBND {_words(*feature.mean, feature.sigma[0], feature.scale)}"
    return f"BND {_words(*feature.mean, *feature.sigma, feature.correlation, feature.scale)}"


def _words(*numbers: float) -> str:
    # NumPy's scalars have another repr.
    return " ".join(repr(float(number)) for number in numbers)
