"""From policies to results."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.policy.bundle import BundleError
from lpac.evaluate.evaluation import Condition, Evaluation
from lpac.evaluate.run import evaluate, make_evaluation, policy_method
from tests.conftest import SHIPPED

CONDITION = Condition("n1")


@pytest.fixture(scope="module")
def evaluation() -> Evaluation:
    return make_evaluation(
        [policy_method("ours", SHIPPED)],
        baselines=["shared-cvt"],
        conditions=[CONDITION],
        worlds=2,
        duration_s=1.0,
    )


def test_the_clairvoyant_is_always_there(evaluation: Evaluation) -> None:
    assert [m.name for m in evaluation.methods] == ["ours", "shared-cvt", "clairvoyant-cvt"]
    alone = make_evaluation([], baselines=[], sizes_from=SHIPPED)
    assert [m.name for m in alone.methods] == ["clairvoyant-cvt"]


def test_a_folder_keeps_what_was_flown(evaluation: Evaluation, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    [results] = evaluate(evaluation, tell=lambda *done: told.append(done)).values()
    flights = len(evaluation.flights())
    assert told == [(number, flights) for number in range(1, flights + 1)]
    assert results[0].curves.shape == (1, 2, 2)
    for _ in range(2):
        again = evaluate(evaluation, folder=tmp_path)[CONDITION]
        for one, other in zip(results, again, strict=True):
            np.testing.assert_array_equal(one.curves, other.curves)
    lines = (tmp_path / "flights.jsonl").read_text().splitlines()
    assert len(lines) == 1 + flights  # the first says of which code


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"world_set": "tests"}, "world_set = 'tests': must be one of training, validation, test"),
        ({"baselines": ["cvt"]}, "baseline = 'cvt': must be one of decentralized-cvt, "),
        ({"conditions": [Condition("desert")]}, "set_up = 'desert': must be one of field, "),
        ({}, "no policy flies: sizes_from must name the bundle"),
    ],
)
def test_what_cannot_be_is_named(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        make_evaluation([], **changes)


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda: policy_method("none"), ValueError),
        (lambda: policy_method("gone", Path("nowhere")), BundleError),
    ],
)
def test_a_policy_needs_its_bundles(make: Callable[[], object], error: type[Exception]) -> None:
    with pytest.raises(error, match=r"none|nowhere"):
        make()
