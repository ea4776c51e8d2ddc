"""The sensor of type "camera": it photographs the ground, and lets a detector look at the image."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from edge.core import F64
from edge.core.perception import part_in_world, window_corner
from edge.core.ports import Look, SensorOver, SensorSetting
from edge.core.schema import Bounded, from_mapping
from lpac_camera.detector import MARGIN, Detector
from lpac_camera.ground import Ground, ground_of
from lpac_camera.pinhole import FieldOfView, Pinhole, Pixels, onto_cells, smoothed


@dataclass(frozen=True, slots=True)
class CameraOptions(Bounded):
    """`[sensor.options]` of robot.toml; `smoothing` is how many cells wide means are taken.

    Raises ValueError that names the option for an impossible value.
    """

    field_of_view_deg: FieldOfView = 40.0
    columns: Pixels = 120
    rows: Pixels = 90
    smoothing: Annotated[int, Meta(ge=1, le=201)] = 17

    def pinhole(self) -> Pinhole:
        """The camera that this describes."""
        return Pinhole(self.columns, self.rows, self.field_of_view_deg)


class RenderedCamera:
    """Implements `Camera`: what a camera would see of a `Ground`, and what its detector says of it.

    The image is as the robot's own position says. A real camera takes it at the true one, and is
    tilted and turned with the vehicle: whoever has one replaces `photograph`, and tells `look`
    where each pixel lay.
    """

    def __init__(
        self, ground: Ground, detector: Detector, options: CameraOptions, sensor_size: int
    ) -> None:
        self._ground, self._detector, self._size = ground, detector, sensor_size
        self._camera = options.pinhole()
        self._smoothing = options.smoothing
        # Of the image's noise.
        self._rng = np.random.default_rng(0)

    def photograph(self, position: F64, height: float) -> npt.NDArray[np.uint8]:
        """The image (rows, columns, 3) from there; model units, height above 0."""
        return self._ground.photograph(self._camera, position, height, self._rng)

    def look(self, position: F64, height: float) -> Look:
        """See `Camera`; on the ground it sees nothing."""
        if not height > 0.0:
            nothing = np.zeros((self._size, self._size), np.float32)
            return Look(nothing, nothing.astype(np.bool_))
        importance = self._detector.importance(self.photograph(position, height))
        x, y = self._camera.edges(position, height, MARGIN)
        cells, seen = onto_cells(importance, x, y, position, self._size)
        # Beyond the world there is no importance, and none is taken from within it.
        world = np.zeros_like(seen)
        corner = window_corner(position, self._size)
        world[part_in_world(corner, self._size, len(self._ground.importance))[1]] = True
        means = smoothed(cells, seen & world, self._smoothing)
        return Look(np.where(world, np.clip(means, 0.0, 1.0), np.float32(0.0)), seen)


@contextmanager
def camera(setting: SensorSetting) -> Iterator[SensorOver]:
    """The type "camera" of robot.toml's [sensor]. Raises ConfigError, ValueError or OSError."""
    options = from_mapping(CameraOptions, setting.options, "sensor: options")
    detector = Detector()
    perception = setting.perception

    def over(text: str, source: str) -> RenderedCamera:
        ground = ground_of(
            text, source, perception.world_size, setting.idf_truncation, setting.idf_norm
        )
        return RenderedCamera(ground, detector, options, perception.sensor_size)

    yield over
