"""What the benchmark says of times that a machine may have."""

from pathlib import Path

import pytest

from edge.policy.bundle import load_bundle
from edge.policy.lpac.policy import LpacPolicy
from edge.robot.benchmark import StepTimes, benchmark
from lpac.cli.options import DEFAULT_BUNDLE
from tests.conftest import SHIPPED


def test_a_step_may_take_half_of_its_period() -> None:
    assert StepTimes("infer", 100, 400.0, 1.0, 200.0, 900.0).fits
    assert not StepTimes("infer", 100, 400.0, 1.0, 201.0, 900.0).fits


@pytest.mark.parametrize("neighbours", [0, 10])
@pytest.mark.parametrize("bundle", [SHIPPED, DEFAULT_BUNDLE], ids=["without map", "with map"])
def test_every_step_is_called_equally_often(bundle: Path, neighbours: int) -> None:
    result = benchmark(LpacPolicy(load_bundle(bundle)), neighbours, 0.01)
    assert [step.step for step in result.steps] == ["perceive", "infer"]
    assert len({step.calls for step in result.steps}) == 1
    assert result.steps[0].calls >= 20
