"""What the camera sees, its detector says, and is true: `python -m lpac_camera.figure`."""

import argparse
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from edge.core.perception import PerceptionParameters, window_corner
from edge.core.ports import SensorSetting
from edge.core.world import rasterize
from edge.drivers.world_sensor import WorldSensor
from lpac.analysis.worlds import format_world, random_features
from lpac_camera.sensor import CameraOptions, RenderedCamera, camera

# As in the field: 16 cells a metre, the policy sees 4 m x 4 m.
_CELLS_PER_M, _WORLD, _SIZE = 16.0, 512, 64
_HEIGHTS_M = (5.0, 9.5)
_PLACE = np.array([232.0, 268.0])
_LABEL = {"facecolor": "white", "alpha": 0.7, "linewidth": 0}


def main() -> None:
    """Draw it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("camera.png"), help="the file to write")
    out: Path = parser.parse_args().out
    features = random_features(np.random.default_rng(2), 10, _WORLD)
    setting = SensorSetting(PerceptionParameters(_WORLD, 256, _SIZE, 128.0), 2.0, 1.0, {})
    true = WorldSensor(rasterize(features, _WORLD), _SIZE).view(_PLACE)
    corner = np.array(window_corner(_PLACE, _SIZE))
    # left, right, bottom, top, m
    square_m = np.stack([corner, corner + _SIZE], 1).ravel() / _CELLS_PER_M
    figure, axes = plt.subplots(2, 3, figsize=(10.0, 6.0), layout="constrained")
    with camera(setting) as over:
        sensor = over(format_world(features), "world")
        assert isinstance(sensor, RenderedCamera)
        for row, height_m in zip(axes, _HEIGHTS_M, strict=True):
            height = height_m * _CELLS_PER_M
            x, y = CameraOptions().pinhole().edges(_PLACE, height)
            shown_m = np.array([x[0], x[-1], y[0], y[-1]]) / _CELLS_PER_M
            look = sensor.look(_PLACE, height)
            row[0].imshow(sensor.photograph(_PLACE, height), extent=shown_m)
            row[0].set_ylabel(f"from {height_m:g} m")
            said = np.where(look.seen, look.importance, np.nan)
            error = np.sqrt(np.mean((look.importance - true)[look.seen] ** 2))
            for axis, values in ((row[1], said), (row[2], true)):
                drawn = axis.imshow(values.T, origin="lower", extent=square_m, vmin=0.0, vmax=1.0)
                axis.set_facecolor("0.75")
            row[1].text(
                0.03, 0.03, f"error {error:.3f} (rms)", transform=row[1].transAxes, bbox=_LABEL
            )
            for axis in row:
                axis.set_aspect("equal")
    titles = ("the image; m", "importance by the detector; grey: unseen", "true importance")
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=10)
    figure.colorbar(drawn, ax=axes[:, 2], shrink=0.8)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main()
