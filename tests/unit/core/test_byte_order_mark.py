"""Some editors on Windows begin a file with a byte order mark: no reader of ours minds."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edge.core.toml import read_toml
from edge.robot.config import load_config
from export.parameters import read_parameters
from lpac.analysis.field_truth import TRUTH_TABLE, read_places
from lpac.fleet.settings import load_fleet
from lpac.ground.script import load_script
from lpac.ground.site import Sites
from lpac.radio.calibration import read_wifi
from lpac.study.file import read_study
from tests.conftest import ROOT

READERS: dict[str, tuple[Callable[[Path], object], str]] = {
    "robot.toml": (load_config, (ROOT / "docs" / "robot.toml").read_text()),
    "fleet.toml": (load_fleet, (ROOT / "docs" / "fleet.toml").read_text()),
    "script.toml": (
        lambda path: load_script(path, Sites(path)),
        (ROOT / "docs" / "script.toml").read_text(),
    ),
    "training.toml": (read_toml, (ROOT / "examples" / "quick.toml").read_text()),
    "policy.toml": (read_parameters, (ROOT / "policies" / "lpac_l2_k3_n10_512.toml").read_text()),
    "study.toml": (read_study, "worlds = 2"),
    "wifi.toml": (read_wifi, "frame_loss = 0.1"),
}


@pytest.mark.parametrize("name", READERS)
def test_toml(tmp_path: Path, name: str) -> None:
    read, text = READERS[name]
    (tmp_path / "world.env").write_text("CircularBND 100 100 20 1\n")  # of the script
    path = tmp_path / name
    path.write_text(text)
    plain = read(path)
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert read(path) == plain


def test_csv(tmp_path: Path) -> None:
    path = tmp_path / TRUTH_TABLE
    path.write_text("\ufeffunix_s,x_m,y_m,height_m\n1,2,3,4\n", "utf-8")
    np.testing.assert_array_equal(read_places(path).places, [[2.0, 3.0, 4.0]])
