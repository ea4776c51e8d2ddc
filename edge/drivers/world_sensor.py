"""Simulated sensor of a known world: robots fly over a virtual importance density function."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np

from edge.core import F32, F64
from edge.core.perception import part_in_world, window_corner
from edge.core.ports import SensorOver, SensorSetting
from edge.core.schema import no_options
from edge.core.world import MOST_FEATURES, parse_world, rasterize


class WorldSensor:
    """Sensor that reads the world's raster as a downward camera would see it."""

    def __init__(self, importance: F32, sensor_size: int) -> None:
        """`importance` is (world_size, world_size), indexed [x, y]."""
        self._importance = importance
        self._size = sensor_size

    def view(self, position: F64) -> F32:
        """View (sensor_size, sensor_size) around `position` (2,), model units; 0 off the world."""
        view = np.zeros((self._size, self._size), np.float32)
        corner = window_corner(position, self._size)
        in_world, in_view = part_in_world(corner, self._size, len(self._importance))
        view[in_view] = self._importance[in_world]
        return view


@contextmanager
def world_sensor(setting: SensorSetting) -> Iterator[SensorOver]:
    """Open the sensor of `type = "world"` in [sensor]; it has no options. Raises ConfigError."""
    no_options("sensor", setting.options)
    yield partial(_sensor_over, setting)


def _sensor_over(setting: SensorSetting, text: str, source: str) -> WorldSensor:
    """Make a sensor from a world file's text. Raises ValueError, one line with `source`."""
    perception = setting.perception
    features = parse_world(text, source)
    if len(features) > MOST_FEATURES:
        raise ValueError(f"{source}: has {len(features)} features: must be at most {MOST_FEATURES}")
    importance = rasterize(
        features, perception.world_size, setting.idf_truncation, setting.idf_norm
    )
    return WorldSensor(importance, perception.sensor_size)
