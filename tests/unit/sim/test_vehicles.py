"""Point vehicles: inside the world, and with a lag."""

import numpy as np
import pytest

from lpac.sim.vehicles import PointVehicles


@pytest.mark.parametrize("lag_s", [0.0, 0.3, 1.3])
def test_velocity_follows_with_its_lag(lag_s: float) -> None:
    vehicles = PointVehicles(np.array([[50.0, 50.0], [1.0, 2.0]]), 100.0, lag_s)
    told = {0.0: np.array([1.0, -2.0]), 0.5: np.array([-1.0, 0.5]), 2.0: np.zeros(2)}
    step_s = 1e-4
    position, velocity, command = np.array([50.0, 50.0]), np.zeros(2), np.zeros(2)
    for step in range(30_000):
        time_s = step * step_s
        for at_s, velocity_m_s in told.items():
            if step == round(at_s / step_s):
                vehicles.now_s = time_s
                vehicles.fly(0, velocity_m_s)
                command = velocity_m_s
        velocity = velocity + (command - velocity) * (step_s / lag_s if lag_s else 1.0)
        position = position + velocity * step_s
    vehicles.now_s = 3.0
    np.testing.assert_allclose(vehicles.position_m(0), position, atol=1e-3)
    np.testing.assert_array_equal(vehicles.positions_m(), [vehicles.position_m(0), [1.0, 2.0]])


def test_who_stops_does_not_coast() -> None:
    vehicles = PointVehicles(np.array([[5.0, 5.0]]), 10.0, lag_s=1.0)
    vehicles.fly(0, np.array([1.0, 0.0]))
    vehicles.now_s = 2.0
    vehicles.stop(0)
    stopped_m = vehicles.position_m(0)
    vehicles.now_s = 4.0
    np.testing.assert_array_equal(vehicles.position_m(0), stopped_m)
    assert stopped_m[0] > 5.5


@pytest.mark.parametrize("lag_s", [-0.1, float("nan"), float("inf")])
def test_an_impossible_lag_is_named(lag_s: float) -> None:
    with pytest.raises(ValueError, match=f"lag_s = {lag_s}: must be at least 0"):
        PointVehicles(np.zeros((1, 2)), 10.0, lag_s)
