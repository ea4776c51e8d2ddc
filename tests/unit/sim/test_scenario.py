"""Each engine refuses what it cannot do."""

from pathlib import Path
from typing import Any

import pytest

from edge.core.frames import ModelScale
from edge.policy.bundle import load_bundle
from lpac.sim.failure import Failure
from lpac.sim.fleet.clocked import fly_simulated
from lpac.sim.fleet.layout import Layout
from lpac.sim.fleet.processes import Fleet
from lpac.sim.points import prepare
from lpac.sim.scenario import Scenario
from lpac.sim.ticks import Clocks
from tests.conftest import SHIPPED


@pytest.mark.parametrize(
    ("field", "asked", "named"),
    [
        ("errors", False, "errors = False: must be True"),
        ("sensor", "camera", "sensor = camera: must be world"),
        ("secure", True, "secure = True: must be False"),
        ("transport", "multicast", "transport = multicast: must be mesh"),
    ],
)
def test_points_have_no_vehicles_sensors_or_keys(field: str, asked: Any, named: str) -> None:
    with pytest.raises(ValueError, match=f"^{named} for points"):
        prepare(Scenario(**{field: asked}), load_bundle(SHIPPED))


@pytest.mark.parametrize(
    ("scenario", "named"),
    [
        (Scenario(controller="shared-cvt"), "controller = shared-cvt: must be lpac for whole rob"),
        (Scenario(scale=ModelScale(1.0, 1.0)), "scale = "),
        (Scenario(max_speed_m_s=2.0), "max_speed_m_s = 2.0: must be None for whole robots"),
        (Scenario(robots=1, position_bias=((1.0, 1.0),)), "position_bias = "),
        (Scenario(lag_s=0.5), "lag_s = 0.5: must be 0.0 for whole robots"),
        (Scenario(payload="int8"), "payload = int8: must be float16 for whole robots"),
        (Scenario(clocks=Clocks(synchronous=True)), "synchronous = True: must be False for whole"),
        (Scenario(failures=(Failure(1, 5.0),)), "robot 1 is lost: whole robots can only be away"),
        (Scenario(robots=31), "robots = 31: must be from 1 to 30"),
    ],
)
def test_whole_robots_fly_as_they_do_in_the_field(scenario: Scenario, named: str) -> None:
    with pytest.raises(ValueError, match=f"^{named}"):
        Layout(scenario, SHIPPED)


def test_a_radio_is_simulated_or_real(tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match=r"^transport = multicast: must be mesh for robots on a sim"
    ):
        fly_simulated(Scenario(transport="multicast"), tmp_path, SHIPPED)
    with pytest.raises(ValueError, match=r"^loss = 0.1: must be 0.0 for programs in real time"):
        Fleet(Scenario(loss=0.1), tmp_path, SHIPPED)
    assert not list(tmp_path.iterdir())
