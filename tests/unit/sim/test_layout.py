"""Where a fleet stands, and over which world it flies."""

import re
from pathlib import Path

import numpy as np
import pytest

from edge.core.world import parse_world
from edge.flight.margins import places_apart
from edge.policy.bundle import Bundle
from lpac.sim.description import ERRORS
from lpac.sim.fleet.layout import Layout
from lpac.sim.points import fly_points
from lpac.sim.scenario import Scenario
from tests.conftest import SHIPPED


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("robots", [1, 10, 16])
def test_where_a_fleet_stands(seed: int, robots: int) -> None:
    layout = Layout(Scenario(robots=robots, seed=seed), SHIPPED)
    least_m = places_apart(ERRORS.position_m, ERRORS.position_m).least_m
    for places_m in (layout.pads_m, layout.landing_points_m):
        assert min(layout.fence.distance_m(x, y) for x, y in places_m) > layout.fence.buffer_m
        away_m = np.linalg.norm(places_m[:, None] - places_m, axis=2)
        assert away_m[~np.eye(robots, dtype=bool)].min(initial=np.inf) >= least_m
    true_m = [layout.to_mission.local_to_mission(each.position_m) for each in layout.vehicles]
    np.testing.assert_allclose(np.array(true_m)[:, :2], layout.pads_m, atol=1e-9)
    errors_m = np.linalg.norm(layout.landing_points_m - layout.pads_m, axis=1)
    assert np.all((errors_m >= 1.0) & (errors_m <= 5.0))


@pytest.mark.slow
def test_more_robots_than_fit_are_refused_with_how_many_do() -> None:
    with pytest.raises(
        ValueError, match=r"robots = 20: (\d+) fit on 32 x 32 m, with pads 8 m apart"
    ) as refused:
        Layout(Scenario(robots=20), SHIPPED)
    (fit,) = map(int, re.findall(r": (\d+) fit", str(refused.value)))
    assert Layout(Scenario(robots=fit), SHIPPED).pads_m.shape == (fit, 2)
    # Twenty that know where they are stand on the same field.
    Layout(Scenario(robots=20, errors=False), SHIPPED)


def test_a_seed_has_the_world_of_the_swarm_in_simulated_time(
    tmp_path: Path, shipped_bundle: Bundle
) -> None:
    layout = Layout(Scenario(robots=1, seed=11), SHIPPED)
    swarm = fly_points(Scenario(robots=1, seed=11, duration_s=0.1), shipped_bundle)
    assert layout.features == swarm.features
    r0 = {"zenoh_port": 7447, "system_id": 1, "mavlink_url": "udpin://127.0.0.1:14551"}
    layout.write(tmp_path, "a-fleet", {"r0": r0})
    assert parse_world((tmp_path / "world.env").read_text()) == swarm.features
