"""A pilot takes a whole simulated robot out of the field, and brings it back."""

from pathlib import Path

import numpy as np
import pytest

from lpac.sim.failure import Failure
from lpac.sim.fleet.clocked import fly_simulated
from lpac.sim.scenario import Scenario
from lpac.study.perturbation import absences_of, perturbed_by
from tests.conftest import SHIPPED


@pytest.mark.slow
def test_it_is_out_of_the_fence_and_back_in_its_mission(tmp_path: Path) -> None:
    taken = Failure(robot=0, from_s=3.0, until_s=23.0)
    scenario = Scenario(robots=2, seed=3, duration_s=28.0, failures=(taken,))
    flown = fly_simulated(scenario, tmp_path, SHIPPED)
    assert (flown.script.problem, flown.all_landed) == (None, True)
    [absence] = absences_of(flown)
    assert absence.robot == "r0"
    # It says so with its next status, and the script sees it with the next picture.
    assert np.allclose((absence.from_s, absence.until_s), (taken.from_s, taken.until_s), atol=2.0)
    away = flown.truth["r0"].between(absence.from_s, absence.until_s)
    fence, path_m = flown.fence, away.position_m
    assert fence is not None
    assert min(fence.distance_m(x, y) for x, y, _ in path_m[::25].tolist()) < -1.0
    assert np.linalg.norm((path_m[-1] - path_m[0])[:2]) < 2.0
    perturbed = perturbed_by(flown, [absence], range_m=8.0)
    assert [phase.away for phase in perturbed.phases] == [True, False]
    assert np.isnan(perturbed.speed_m_s).any(axis=0).tolist() == [True, False]
