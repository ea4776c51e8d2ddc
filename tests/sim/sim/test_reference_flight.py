"""A study's flights with the reference library in the loop: its world, sensors and cost."""

from typing import Any

import numpy as np
import pytest

from edge.core import F32, F64
from edge.core.ports import OdometrySource
from edge.core.world import GaussianFeature
from edge.drivers.registry import load_policy
from edge.policy.bundle import load_bundle
from lpac.sim.points import cost_times_s, fly_points, prepare
from lpac.sim.scenario import Scenario
from lpac.sim.swarm import ClockedPac, Swarm
from lpac.sim.vehicles import PointVehicles
from lpac.study.study import Condition, Draw, Method, Study
from lpac.study.worlds import FIELD as SET_UP
from tests.conftest import ROOT
from tests.unit.core.reference import point_vector, reference_environment

FIELD = ROOT / "policies" / "field" / "field"
# On the border the library ends the process.
_INSIDE = 1e-6


class LibrarySensor:
    """What one robot's sensor shows, as the library has it."""

    def __init__(self, environment: Any, robot: int) -> None:
        self._environment = environment
        self._robot = robot

    def view(self, position: F64) -> F32:
        self._environment.SetGlobalRobotPosition(self._robot, inside(position))
        view: F32 = self._environment.GetRobotSensorView(self._robot)
        return view


def inside(positions: F64) -> F64:
    return np.clip(positions, _INSIDE, 512.0 - _INSIDE)


def flown_in_the_library(scenario: Scenario) -> F64:
    """The costs (C,) of the same flight there."""
    bundle = load_bundle(FIELD)
    prepared = prepare(scenario, bundle)
    scale = scenario.scale
    features = [f for f in prepared.features if isinstance(f, GaussianFeature)]
    environment = reference_environment(
        features, inside(scale.position_to_model(prepared.starts_m))
    )
    policy = load_policy(prepared.bundle)

    def boot(robot: int, start: int, odometry: OdometrySource) -> ClockedPac:
        return ClockedPac(
            start=start,
            robot_id=robot,
            policy=policy,
            sensor=LibrarySensor(environment, robot),
            odometry=odometry,
            parameters=prepared.parameters,
        )

    swarm = Swarm(
        boot=boot,
        vehicles=PointVehicles(prepared.starts_m, 512.0 / scale.env_scale),
        medium=prepared.medium,
        rng=prepared.clock_rng,
        clocks=scenario.clocks,
    )
    costs = []
    for positions_m in swarm.run(cost_times_s(scenario.duration_s).tolist()):
        environment.SetGlobalRobotPositions(
            point_vector(inside(scale.position_to_model(positions_m)))
        )
        costs.append(environment.GetObjectiveValue())
    return np.array(costs)


@pytest.mark.slow
def test_the_library_sees_about_the_same_flight() -> None:
    """60 s of the policy that ships, over a world that it was neither trained nor chosen on.

    The library's raster differs by some 1e-4 from ours, and so, in time, do the flights: in ten of
    them by up to 0.09 of the first cost at some time, and by 0.025 at the end (on average 0.286
    here and 0.290 there). Flights that had nothing in common would by 0.3.
    """
    condition = Condition(scenario=SET_UP.scenario(loss=0.3))
    study = Study(methods=(Method.of("field", FIELD),), conditions=(condition,))
    [flight] = study.flights_of(study.methods[0], condition, Draw(102))
    flown = fly_points(flight.scenario, load_bundle(FIELD))
    costs = flown_in_the_library(flight.scenario)
    np.testing.assert_allclose(flown.cost[0], costs[0], rtol=1e-3)
    apart = np.abs(flown.normalized - costs / costs[0])
    assert apart[:5].max() < 0.002 and apart.max() < 0.15 and apart[-1] < 0.05
    assert costs[-1] < 0.5 * costs[0]
