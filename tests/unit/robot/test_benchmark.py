"""What the benchmark says of times that a machine may have."""

import pytest

from edge.policy.lpac.policy import LpacPolicy
from edge.robot.benchmark import StepTimes, benchmark


def test_a_step_may_take_half_of_its_period() -> None:
    assert StepTimes("infer", 100, 400.0, 1.0, 200.0, 900.0).fits
    assert not StepTimes("infer", 100, 400.0, 1.0, 201.0, 900.0).fits


@pytest.mark.parametrize("neighbours", [0, 10])
def test_every_step_is_called_equally_often(shipped_policy: LpacPolicy, neighbours: int) -> None:
    result = benchmark(shipped_policy, neighbours, 0.01)
    assert [step.step for step in result.steps] == ["perceive", "infer"]
    assert len({step.calls for step in result.steps}) == 1
    assert result.steps[0].calls >= 20
