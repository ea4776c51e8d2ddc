"""Each engine refuses what it cannot do."""

import pickle
from pathlib import Path
from typing import Any

import pytest

from edge.core.frames import ModelScale
from edge.policy.bundle import load_bundle
from lpac.sim.engines import EngineName, fly
from lpac.sim.failure import Failure
from lpac.sim.fleet.layout import Layout
from lpac.sim.points import prepare
from lpac.sim.scenario import Scenario, UnableError
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
        (Scenario(max_speed_m_s=2.0), "max_speed_m_s = 2.0: must be left out for whole robots"),
        (Scenario(robots=1, position_bias=((1.0, 1.0),)), "position_bias = "),
        (Scenario(lag_s=0.5), "lag_s = 0.5: must be 0.0 for whole robots"),
        (Scenario(payload="int8"), "payload = int8: must be float16 for whole robots"),
        (Scenario(clocks=Clocks(synchronous=True)), "synchronous = True: must be False for whole"),
        (Scenario(failures=(Failure(1, 5.0),)), "failures: robot 1 has no until_s: whole robots"),
        (Scenario(robots=31), "robots = 31: must be from 1 to 30"),
    ],
)
def test_whole_robots_fly_as_they_do_in_the_field(scenario: Scenario, named: str) -> None:
    with pytest.raises(ValueError, match=f"^{named}"):
        Layout(scenario, SHIPPED)


@pytest.mark.parametrize(
    ("engine", "scenario", "said"),
    [
        ("simulated", Scenario(transport="multicast"), "transport = multicast: must be mesh"),
        ("mavlink", Scenario(loss=0.1), "loss = 0.1: must be 0.0 for programs in real time"),
        ("point", Scenario(wind_m_s=3.0), "wind_m_s = 3.0: must be left out for points"),
        ("simulated", Scenario(fault="landed", robots=1), "robots = 1: must be at least 2"),
        ("point", Scenario(fault="landed"), "fault = landed: must be '' for points"),
        ("simulated", Scenario(fault="nothing"), "fault = nothing: no such fault"),
        ("mavlink", Scenario(fault="radio-dies"), "fault = radio-dies: mavlink cannot do it"),
        ("nonsense", Scenario(), "engine = 'nonsense': allowed are 'point', 'simulated'"),
        ("px4", Scenario(), "engine = 'px4': needs PX4's build folder"),
    ],
)
def test_an_engine_says_what_it_cannot_do(
    engine: EngineName, scenario: Scenario, said: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=f"^{said}"):
        fly(scenario, SHIPPED, engine=engine, folder=tmp_path)
    assert not list(tmp_path.iterdir())


def test_what_an_engine_cannot_do_comes_from_another_process() -> None:
    error = UnableError("points", "wind_m_s", 3.0, None)
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.name) == (str(error), "wind_m_s")
    assert str(error).startswith("wind_m_s = 3.0: must be left out for points")


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"controller": "cvt"}, "controller = 'cvt': allowed are 'lpac', "),
        ({"robots": "3"}, "robots = '3': must be a whole number"),
        ({"duration_s": 1e12}, "duration_s = 1000000000000.0: must be above 0 and at most 86400"),
        ({"wind_m_s": 300.0}, "wind_m_s = 300.0: must be from 0 to 30"),
    ],
)
def test_a_scenario_that_cannot_be(values: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=f"^{said}"):
        Scenario(**values)
