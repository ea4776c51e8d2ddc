"""examples/camera: how far it sees, and what its detector finds."""

from pathlib import Path

import numpy as np
import pytest
from lpac_camera import fit
from lpac_camera.detector import Detector
from lpac_camera.pinhole import Pinhole
from lpac_camera.sensor import CameraOptions, camera

from edge.core import F64
from edge.core.perception import PerceptionParameters
from edge.core.ports import Camera, Look, SensorSetting
from edge.core.world import rasterize
from edge.drivers.world_sensor import WorldSensor
from lpac.analysis.worlds import format_world, random_features

CELLS_PER_M = 16.0
PERCEPTION = PerceptionParameters(512, 256, 64, 128.0)
FEATURES = random_features(np.random.default_rng(7), 10, 512)
TRUTH = rasterize(FEATURES, 512)


def setting(**options: object) -> SensorSetting:
    return SensorSetting(PERCEPTION, 2.0, 1.0, options)


@pytest.fixture(scope="module")
def sensor() -> Camera:
    with camera(setting()) as over:
        made = over(format_world(FEATURES), "world")
    assert isinstance(made, Camera)
    return made


def look(sensor: Camera, position: F64, height_m: float) -> Look:
    found = sensor.look(position, height_m * CELLS_PER_M)
    assert found is not None
    return found


@pytest.mark.parametrize("height_m", [1.0, 3.0, 5.0, 6.0, 30.0])
def test_what_it_sees_follows_from_its_height(sensor: Camera, height_m: float) -> None:
    seen = look(sensor, np.array([200.0, 300.0]), height_m).seen
    across_m = 2.0 * height_m * np.tan(np.radians(20.0))
    # The outermost pixels are not seen; of the square of the policy no more than all.
    sides = [across_m * share * CELLS_PER_M for share in (118 / 120, 88 / 120)]
    expected = [min(64, 2 * int(side / 2.0)) for side in sides]
    assert [int(seen.any(axis=1).sum()), int(seen.any(axis=0).sum())] == expected
    assert seen.sum() == np.prod(expected)
    # In the middle of the square.
    np.testing.assert_array_equal(seen, seen[::-1, ::-1])


def test_on_the_ground_it_sees_nothing(sensor: Camera) -> None:
    for height_m in (0.0, -0.5):
        assert not look(sensor, np.array([200.0, 300.0]), height_m).seen.any()


def test_importance_is_recovered(sensor: Camera) -> None:
    """As README.md says: within 0.05 (rms), and without leaning to a side."""
    rng, truth = np.random.default_rng(1), WorldSensor(TRUTH, 64)
    errors = []
    for height_m in (3.0, 5.0, 9.5, 14.0):
        # Beyond the world nothing is important.
        for position in rng.uniform(0.0, 512.0, (10, 2)):
            found = look(sensor, position, height_m)
            errors.append((found.importance - truth.view(position))[found.seen])
    everywhere = np.concatenate(errors)
    assert np.sqrt(np.mean(everywhere**2)) < 0.055
    assert abs(everywhere.mean()) < 0.01
    # Whoever said the mean of the world everywhere would be wrong by five times as much.
    assert TRUTH.std() > 0.2


def test_the_image_is_the_right_way_round() -> None:
    """Flowers in one corner of the world: the same corner of the view, at the image's top right."""
    with camera(setting(smoothing=5)) as over:
        sensor = over("Uniform 4 1 200 300 216 300 216 316 200 316", "world")
    assert isinstance(sensor, Camera)
    found = look(sensor, np.array([200.0, 300.0]), 6.0)
    half = found.importance > 0.5
    assert half[34:46, 34:46].mean() > 0.9
    assert half[:30].sum() == 0 and half[:, :30].sum() == 0


def test_the_shipped_graph_is_what_fit_makes(tmp_path: Path) -> None:
    fresh = tmp_path / "detector.onnx"
    fresh.write_bytes(fit.graph(fit.fitted(list(fit.examples()))).SerializeToString())
    image = np.random.default_rng(0).integers(0, 256, (90, 120, 3), np.uint8)
    shipped, made = (detector.importance(image) for detector in (Detector(), Detector(fresh)))
    assert shipped.shape == (88, 118)
    np.testing.assert_allclose(shipped, made, atol=1e-3)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"field_of_view_deg": 0.0}, "field_of_view_deg = 0.0: must be from 1 to 170"),
        ({"rows": 4}, "rows = 4: must be from 8 to 4096"),
        ({"smoothing": 0}, "smoothing = 0: must be from 1 to 201"),
        ({"focus": 1}, "focus"),
    ],
)
def test_impossible_options_are_named(options: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text), camera(setting(**options)):
        pass
    assert CameraOptions().pinhole() == Pinhole()
