"""What cannot be evaluated or studied."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from edge.policy.bundle import BundleError
from lpac.cli.evaluate import evaluate
from lpac.cli.study import study
from tests.conftest import SHIPPED


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"world_set": "tests"}, "--set tests: must be one of training, validation, test"),
        ({"baselines": ["cvt"]}, "--baseline cvt: must be one of decentralized-cvt, "),
        ({"set_ups": ["desert"]}, "--set-up desert: must be one of field, n1, "),
        ({"set_ups": ["field"], "transfer": True}, "--set-up does nothing beside it"),
        ({"lost": ["2"]}, "lost = '2': must be ROBOTS@SECONDS, such as 2@20"),
        ({"lost": ["2@60"]}, "lost = 2@60: must be in flight"),
        ({"losses": [1.5]}, "loss = 1.5: must be from 0 to 1"),
        ({"transports": ["mesh"], "losses": [0.1]}, "--loss and --transport: the model of"),
        ({"wifi": Path("wifi.toml")}, "--wifi does nothing without --transport"),
        ({"transports": ["mesh"], "wifi": Path("w.yaml")}, "w.yaml: must be a .toml file"),
        ({"worlds": 0}, "--worlds = 0: must be at least 1"),
        ({"methods": ["frontier-cvt"], "compare": True}, "--compare needs two methods; 1 given"),
        ({"methods": [str(SHIPPED)] * 2}, "must differ"),
    ],
)
def test_options_that_cannot_be(options: dict[str, Any], text: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=text):
        evaluate(**options, out=tmp_path)


def test_a_build_of_px4_that_nothing_flies(tmp_path: Path) -> None:
    file = tmp_path / "points.toml"
    file.write_text("worlds = 1\n")
    with pytest.raises(ValueError, match=r"--px4 does nothing: no condition of .*points\.toml has"):
        study(file=file, px4=tmp_path, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_bundles_that_cannot_fly(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nothing"):
        evaluate(methods=[str(tmp_path / "nothing")], out=tmp_path)
    broken = tmp_path / "broken"
    shutil.copytree(SHIPPED, broken)
    (broken / "action.onnx").write_bytes(b"")
    with pytest.raises(BundleError, match=r"action\.onnx"):
        evaluate(methods=[str(broken)], out=tmp_path)
