"""Refusal of a world with nothing to cover, by `lpac sim` and scripts."""

from pathlib import Path

import pytest

from edge.core.world import parse_world
from lpac.cli.sim import require_something_to_cover
from lpac.ground.script import read_world


def test_a_world_of_scale_0_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "zero.env"
    path.write_text("CircularBND 100 100 20 0\n")
    with pytest.raises(ValueError, match=r"zero\.env: the world would have nothing in it to cover"):
        require_something_to_cover(path, parse_world(path.read_text()), 0)
    with pytest.raises(ValueError, match=r"zero\.env: has no features of any importance"):
        read_world(path)
