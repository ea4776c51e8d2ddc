"""From a study to its results."""

from pathlib import Path

import numpy as np
import pytest

from edge.policy.bundle import BundleError
from lpac.study.run import run
from lpac.study.study import Condition, Method, Study
from lpac.study.worlds import SET_UPS
from tests.conftest import SHIPPED

CONDITION = Condition(scenario=SET_UPS["n1"].scenario(duration_s=1.0))
STUDY = Study(
    methods=(Method.of("ours", SHIPPED), Method.of("shared-cvt")),
    conditions=(CONDITION,),
    worlds=2,
)


def test_the_clairvoyant_is_always_there() -> None:
    assert [m.name for m in STUDY.all_methods] == ["ours", "shared-cvt", "clairvoyant-cvt"]
    alone = Study(methods=(), sizes_from=str(SHIPPED))
    assert [m.name for m in alone.all_methods] == ["clairvoyant-cvt"]


def test_a_folder_keeps_what_was_flown(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    [results] = run(STUDY, tell=lambda *done: told.append(done)).values()
    flights = len(STUDY.flights())
    assert told == [(number, flights) for number in range(1, flights + 1)]
    assert results[0].curves.shape == (1, 2, 2)
    for _ in range(2):
        again = run(STUDY, folder=tmp_path)[CONDITION]
        for one, other in zip(results, again, strict=True):
            np.testing.assert_array_equal(one.curves, other.curves)
    lines = (tmp_path / "flights.jsonl").read_text().splitlines()
    assert len(lines) == 1 + flights  # the first says of which code


def test_a_method_needs_its_bundles() -> None:
    with pytest.raises(ValueError, match="baseline 'none': must be one of decentralized-cvt, "):
        Method.of("none")
    with pytest.raises(BundleError, match="nowhere"):
        Method.of("gone", Path("nowhere"))
