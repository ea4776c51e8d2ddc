"""The bench of processes runs, at its smallest size; how fast anything is plays no part."""

from pathlib import Path

import pytest

pytest.importorskip("torch_geometric", reason="the benches compare with it")

from bench import command, footprint
from tests.unit.test_bench import check_frame, kept

pytestmark = pytest.mark.alone


def test_footprint(tmp_path: Path) -> None:
    result = kept(footprint.measure(runs=1), tmp_path)
    check_frame(result, "footprint", targets=2)
    for kind in (footprint.EDGE, footprint.TORCH):
        assert {"first_tick_s", "rss"} <= result["figures"][kind].keys()


def test_command(tmp_path: Path) -> None:
    result = kept(command.measure(runs=1), tmp_path)
    check_frame(result, "command", targets=1)
    figures = result["figures"]
    assert 0.0 < figures["python -c pass"]["median"] < figures["lpac --help"]["median"]
