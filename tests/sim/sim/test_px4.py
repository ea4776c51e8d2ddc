"""The simulated vehicle: how it behaves, in simulated time."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from lpac.sim.px4 import checks
from lpac.sim.px4.checks import Component
from lpac.sim.px4.link import Px4Link
from lpac.sim.px4.modes import MavResult, Px4Mode
from lpac.sim.px4.vector import vector
from lpac.sim.px4.vehicle import Px4Setpoint, Px4Vehicle, SimulatedSensor
from lpac.sim.px4.world import FencePolygon, WorldOrigin

STEP_S = 0.02
DENIED = "Arming denied: Resolve system health failures first"
NAN_3 = (math.nan,) * 3


def run(vehicle: Px4Vehicle, duration_s: float, setpoint: Px4Setpoint | None = None) -> None:
    """Let time pass, with the setpoint streamed at 10 Hz."""
    for step in range(round(duration_s / STEP_S)):
        if setpoint is not None and step % 5 == 0:
            vehicle.offboard(setpoint)
        vehicle.step(STEP_S)


def run_until(vehicle: Px4Vehicle, condition: Callable[[], bool], timeout_s: float) -> float:
    start_s = vehicle.time_s
    while not condition():
        assert vehicle.time_s - start_s < timeout_s, vehicle.truth[-1]
        vehicle.step(STEP_S)
    return vehicle.time_s - start_s


def hovering(seed: int = 1, altitude_m: float = 5.0, *, rc: bool = False) -> Px4Vehicle:
    vehicle = Px4Vehicle(seed=seed, ready_after_s=0.0)
    vehicle.rc_connected = rc
    vehicle.parameters["MIS_TAKEOFF_ALT"] = altitude_m
    vehicle.step(STEP_S)
    assert vehicle.arm() is MavResult.ACCEPTED
    assert vehicle.take_off(math.nan) is MavResult.ACCEPTED
    run(vehicle, STEP_S)
    run_until(vehicle, lambda: vehicle.mode is Px4Mode.HOLD, 20.0)
    run(vehicle, 2.0)
    return vehicle


def velocity(north: float, east: float = 0.0, down: float = 0.0) -> Px4Setpoint:
    return Px4Setpoint(NAN_3, (north, east, down))


def in_offboard(setpoint: Px4Setpoint, *, rc: bool = False, **parameters: int) -> Px4Vehicle:
    """Flying a setpoint whose last packet has just arrived."""
    vehicle = hovering(rc=rc)
    vehicle.parameters |= parameters
    vehicle.offboard(setpoint)
    assert vehicle.set_mode(Px4Mode.OFFBOARD) is MavResult.ACCEPTED
    run(vehicle, 3.0, setpoint)
    assert mode_of(vehicle) is Px4Mode.OFFBOARD
    vehicle.offboard(setpoint)
    return vehicle


def speed_m_s(vehicle: Px4Vehicle) -> float:
    return float(np.linalg.norm(vehicle.velocity_m_s))


def mode_of(vehicle: Px4Vehicle) -> Px4Mode:
    return vehicle.mode


def texts(vehicle: Px4Vehicle) -> list[str]:
    return [event.text.rstrip() for event in vehicle.take_events() if event.text]


@pytest.mark.parametrize("seed", range(5))
def test_arming_is_denied_until_health_is_good(seed: int) -> None:
    vehicle = Px4Vehicle(seed=seed)
    assert vehicle.arm() is MavResult.TEMPORARILY_REJECTED
    assert texts(vehicle) == [DENIED]
    assert 3.0 <= run_until(vehicle, lambda: vehicle.armable, 10.0) <= 6.1
    assert vehicle.arm() is MavResult.ACCEPTED


@pytest.mark.parametrize(
    ("spoil", "problem"),
    [
        (lambda v: setattr(v, "gps_lost", True), checks.NO_GLOBAL_POSITION),
        (lambda v: setattr(v, "battery_remaining", 0.06), checks.BATTERY_CRITICAL),
        (lambda v: v.dead_sensors.add(SimulatedSensor.BAROMETER), checks.NO_BAROMETER),
        (lambda v: v.dead_sensors.add(SimulatedSensor.COMPASS), checks.NO_COMPASS),
        (lambda v: v.dead_sensors.add(SimulatedSensor.BATTERY), checks.BATTERY_SILENT),
        (lambda v: v.set_mode(Px4Mode.LAND), checks.MODE_PREVENTS_ARMING),
        (lambda v: v.set_mode(Px4Mode.OFFBOARD), checks.NO_OFFBOARD_SIGNAL),
        (lambda v: v.set_mode(Px4Mode.POSCTL), checks.NO_MANUAL_CONTROL),
        (lambda v: v.parameters.update(NAV_DLL_ACT=2), checks.GROUND_STATION_REQUIRED),
    ],
)
def test_arming_is_denied_with_a_reason(
    spoil: Callable[[Any], object], problem: checks.ArmingProblem
) -> None:
    vehicle = Px4Vehicle(seed=0, ready_after_s=0.0)
    run(vehicle, 0.1)
    assert vehicle.armable
    spoil(vehicle)
    run(vehicle, 6.0)
    assert not vehicle.armable
    vehicle.take_events()
    vehicle.run_prearm_checks()
    assert problem.event() in vehicle.take_events()
    assert vehicle.arm() is MavResult.TEMPORARILY_REJECTED
    assert texts(vehicle) == [DENIED]
    assert vehicle.arm(force=True) is MavResult.ACCEPTED


def test_a_low_battery_is_told_but_does_not_keep_from_arming() -> None:
    vehicle = Px4Vehicle(seed=0, ready_after_s=0.0)
    vehicle.battery_remaining = 0.12
    run(vehicle, 2.5)
    assert vehicle.health is not None and Component.BATTERY in vehicle.health.unhealthy
    assert "Low battery" in texts(vehicle)
    assert vehicle.arm() is MavResult.ACCEPTED


def test_an_armed_vehicle_that_stays_on_the_ground_disarms_itself() -> None:
    vehicle = Px4Vehicle(seed=0, ready_after_s=0.0)
    vehicle.step(STEP_S)
    vehicle.arm()
    assert 10.0 <= run_until(vehicle, lambda: not vehicle.armed, 15.0) <= 12.5
    assert vehicle.landed


def test_disarming_in_the_air_is_denied_but_a_kill_drops_the_vehicle() -> None:
    vehicle = hovering()
    assert vehicle.disarm() is MavResult.TEMPORARILY_REJECTED
    assert vehicle.armed
    assert vehicle.disarm(force=True) is MavResult.ACCEPTED
    assert run_until(vehicle, lambda: vehicle.landed, 5.0) < 2.5


def test_take_off_and_landing_take_as_long_as_measured() -> None:
    vehicle = Px4Vehicle(seed=2, ready_after_s=0.0)
    vehicle.step(STEP_S)
    vehicle.parameters["MIS_TAKEOFF_ALT"] = 5.0
    vehicle.arm()
    vehicle.take_off(math.nan)
    run(vehicle, STEP_S)
    assert 6.0 <= run_until(vehicle, lambda: vehicle.mode is Px4Mode.HOLD, 20.0) <= 9.0
    assert vehicle.position_m[2] == pytest.approx(-5.0, abs=0.6)
    vehicle.set_mode(Px4Mode.LAND)
    assert 8.0 <= run_until(vehicle, lambda: not vehicle.armed, 20.0) <= 19.0
    assert vehicle.landed
    run(vehicle, STEP_S)
    assert mode_of(vehicle) is Px4Mode.HOLD
    assert vehicle.arm() is MavResult.ACCEPTED


def test_a_velocity_setpoint_lags_and_lets_the_height_drift() -> None:
    vehicle = hovering()
    before_m = vehicle.position_m
    vehicle.offboard(velocity(1.0))
    vehicle.set_mode(Px4Mode.OFFBOARD)
    run(vehicle, 10.0, velocity(1.0))
    moved_m = vehicle.position_m - before_m
    assert 7.0 <= moved_m[0] <= 8.8
    assert abs(moved_m[1]) < 0.3
    assert 0.01 < abs(moved_m[2]) < 1.6


def test_an_offboard_position_is_one_of_the_local_frame() -> None:
    vehicle = hovering()
    target_m = vehicle.local_position_m + np.array([2.0, -3.0, -1.0])
    setpoint = Px4Setpoint(vector(target_m), NAN_3, yaw_rad=1.0)
    vehicle.offboard(setpoint)
    vehicle.set_mode(Px4Mode.OFFBOARD)
    run(vehicle, 12.0, setpoint)
    assert vehicle.local_position_m == pytest.approx(target_m, abs=0.3)
    assert vehicle.heading_rad == pytest.approx(1.0)
    assert speed_m_s(vehicle) < 0.2


def test_its_truth_tells_a_stop_from_a_flight() -> None:
    vehicle = in_offboard(velocity(1.0))
    before = vehicle.truth[-1]
    run(vehicle, 0.5, velocity(0.0, down=0.3))
    assert (before.follows, vehicle.truth[-1].follows) == ("velocity", "stop")


def test_hold_stops_at_once() -> None:
    vehicle = in_offboard(velocity(1.0))
    run(vehicle, 5.0, velocity(1.0))
    vehicle.set_mode(Px4Mode.HOLD)
    run(vehicle, 1.0)
    assert speed_m_s(vehicle) < 0.2


def test_return_climbs_flies_home_and_lands() -> None:
    vehicle = in_offboard(velocity(3.0))
    vehicle.parameters["RTL_RETURN_ALT"] = 12.0
    run(vehicle, 5.0, velocity(3.0))
    vehicle.set_mode(Px4Mode.RETURN)
    run_until(vehicle, lambda: not vehicle.armed, 90.0)
    assert np.linalg.norm(vehicle.position_m) < 1.5
    assert min(sample.position_m[2] for sample in vehicle.truth) == pytest.approx(-12.0, abs=1.0)


def test_offboard_needs_a_stream() -> None:
    vehicle = hovering()
    assert vehicle.set_mode(Px4Mode.OFFBOARD) is MavResult.TEMPORARILY_REJECTED
    vehicle.offboard(velocity(0.0))
    run(vehicle, 2.0)
    assert vehicle.set_mode(Px4Mode.OFFBOARD) is MavResult.TEMPORARILY_REJECTED


@pytest.mark.parametrize(
    ("offboard_loss", "manual_loss", "then"),
    [
        (4, 2, Px4Mode.LAND),
        (5, 2, Px4Mode.HOLD),
        (3, 0, Px4Mode.RETURN),
        (0, 2, Px4Mode.RETURN),
        (0, 3, Px4Mode.LAND),
        (0, 0, Px4Mode.OFFBOARD),
    ],
)
def test_what_a_lost_stream_leads_to(offboard_loss: int, manual_loss: int, then: Px4Mode) -> None:
    """At once, without the delay that COM_FAIL_ACT_T puts before other failsafes."""
    vehicle = in_offboard(velocity(1.0), COM_OBL_RC_ACT=offboard_loss, NAV_RCL_ACT=manual_loss)
    run(vehicle, 0.98)
    assert mode_of(vehicle) is Px4Mode.OFFBOARD
    run(vehicle, 0.12)
    assert mode_of(vehicle) is then
    if then is Px4Mode.OFFBOARD:
        assert vehicle.velocity_m_s[0] == pytest.approx(1.0, abs=0.1)
    if then is Px4Mode.RETURN:
        run(vehicle, 2.0)
        assert vehicle.velocity_m_s[2] < -0.5
    if then is Px4Mode.LAND:
        run_until(vehicle, lambda: not vehicle.armed, 30.0)
        assert mode_of(vehicle) is Px4Mode.OFFBOARD
        assert vehicle.arm() is MavResult.TEMPORARILY_REJECTED


def test_a_lost_stream_gives_the_vehicle_to_a_pilot_who_is_there() -> None:
    vehicle = in_offboard(velocity(1.0), rc=True)
    run(vehicle, 3.0)
    assert mode_of(vehicle) is Px4Mode.POSCTL
    assert speed_m_s(vehicle) < 0.2


def test_a_stream_that_comes_back_takes_the_vehicle_along_again() -> None:
    vehicle = in_offboard(velocity(1.0), COM_OBL_RC_ACT=5)
    run(vehicle, 3.0)
    assert mode_of(vehicle) is Px4Mode.HOLD
    run(vehicle, 4.0, velocity(1.0))
    assert mode_of(vehicle) is Px4Mode.OFFBOARD
    assert vehicle.velocity_m_s[0] > 0.8
    run(vehicle, 3.0)
    vehicle.set_mode(Px4Mode.HOLD)
    run(vehicle, 3.0, velocity(1.0))
    assert mode_of(vehicle) is Px4Mode.HOLD


def test_a_pilot_takes_over_and_the_client_gets_the_vehicle_back() -> None:
    vehicle = in_offboard(velocity(1.0), rc=True)
    assert vehicle.pilot(Px4Mode.POSCTL, (0.0, -2.0, 0.0)) is MavResult.ACCEPTED
    run(vehicle, 3.0, velocity(1.0))
    assert mode_of(vehicle) is Px4Mode.POSCTL
    assert vehicle.velocity_m_s == pytest.approx([0.0, -2.0, 0.0], abs=0.1)
    vehicle.move_sticks(())
    run(vehicle, 3.0, velocity(1.0))
    assert speed_m_s(vehicle) < 0.2
    assert vehicle.set_mode(Px4Mode.OFFBOARD) is MavResult.ACCEPTED
    run(vehicle, 1.0, velocity(1.0))
    assert mode_of(vehicle) is Px4Mode.OFFBOARD


def test_a_vehicle_stays_where_the_sticks_were_let_go_last() -> None:
    vehicle = hovering(rc=True)
    for north_m_s in (2.0, -2.0):
        vehicle.pilot(Px4Mode.POSCTL, (north_m_s, 0.0, 0.0))
        run(vehicle, 5.0)
        vehicle.move_sticks(())
        let_go_m = vehicle.position_m.copy()
        run(vehicle, 5.0)
        assert speed_m_s(vehicle) < 0.2
        assert np.linalg.norm(vehicle.position_m - let_go_m) < 1.5


@pytest.mark.parametrize(("override", "mode"), [(1, Px4Mode.OFFBOARD), (2, Px4Mode.POSCTL)])
def test_sticks_alone_leave_offboard_only_where_a_parameter_allows_it(
    override: int, mode: Px4Mode
) -> None:
    vehicle = in_offboard(velocity(1.0), rc=True, COM_RC_OVERRIDE=override)
    vehicle.move_sticks((1.0, 0.0, 0.0))
    run(vehicle, 0.2)
    assert mode_of(vehicle) is mode


@pytest.mark.parametrize(("excepted", "mode"), [(0, Px4Mode.LAND), (4, Px4Mode.OFFBOARD)])
def test_a_lost_remote_control_counts_unless_excepted(excepted: int, mode: Px4Mode) -> None:
    vehicle = in_offboard(velocity(0.0), rc=True, COM_RCL_EXCEPT=excepted, NAV_RCL_ACT=3)
    vehicle.rc_connected = False
    run(vehicle, 5.2, velocity(0.0))
    assert mode_of(vehicle) is mode


def test_manual_modes_need_a_remote_control() -> None:
    assert hovering().set_mode(Px4Mode.POSCTL) is MavResult.TEMPORARILY_REJECTED


def test_nobody_takes_a_vehicle_that_listens_to_no_remote_control() -> None:
    vehicle = in_offboard(velocity(1.0), rc=True, COM_RC_IN_MODE=4, COM_RC_OVERRIDE=3)
    assert vehicle.pilot(Px4Mode.POSCTL, (0.0, -2.0, 0.0)) is MavResult.TEMPORARILY_REJECTED
    run(vehicle, 3.0, velocity(1.0))
    assert mode_of(vehicle) is Px4Mode.OFFBOARD


def test_without_gps_it_descends_where_the_wind_takes_it() -> None:
    vehicle = hovering()
    vehicle.gps_lost = True
    run(vehicle, 4.5)
    assert mode_of(vehicle) is Px4Mode.HOLD
    run(vehicle, 1.0)
    assert mode_of(vehicle) is Px4Mode.DESCEND
    vehicle.wind_m_s = (0.0, 1.5, 0.0)
    east_m = vehicle.position_m[1]
    run_until(vehicle, lambda: not vehicle.armed, 30.0)
    assert vehicle.position_m[1] - east_m > 3.0
    assert not vehicle.armable
    vehicle.gps_lost = False
    run(vehicle, 1.0)
    assert not vehicle.armable
    run(vehicle, 0.5)
    assert vehicle.armable


def test_a_short_gap_of_gps_passes_unnoticed() -> None:
    vehicle = hovering()
    vehicle.gps_lost = True
    run(vehicle, 4.0)
    vehicle.gps_lost = False
    run(vehicle, 3.0)
    assert vehicle.position_valid and mode_of(vehicle) is Px4Mode.HOLD


def test_a_critical_battery_interrupts_a_landing() -> None:
    """Time to take over, as before any other action: PX4 holds, and lands after that."""
    vehicle = hovering()
    vehicle.parameters["COM_LOW_BAT_ACT"] = 2
    vehicle.set_mode(Px4Mode.LAND)
    run(vehicle, 1.0)
    vehicle.battery_remaining = 0.06
    run(vehicle, 0.1)
    assert mode_of(vehicle) is Px4Mode.HOLD and vehicle.failsafe.is_active
    run(vehicle, 4.8)
    assert mode_of(vehicle) is Px4Mode.HOLD
    run(vehicle, 0.2)
    assert mode_of(vehicle) is Px4Mode.LAND and vehicle.failsafe.is_active


def test_whoever_asks_for_a_mode_ends_a_failsafe_that_is_not_of_need() -> None:
    vehicle = hovering()
    vehicle.parameters["COM_LOW_BAT_ACT"] = 2
    vehicle.battery_remaining = 0.06
    run(vehicle, 6.0)
    assert mode_of(vehicle) is Px4Mode.LAND
    assert vehicle.set_mode(Px4Mode.HOLD) is MavResult.ACCEPTED
    run(vehicle, 1.0)
    assert mode_of(vehicle) is Px4Mode.HOLD and not vehicle.failsafe.is_active
    vehicle.gps_lost = True
    run(vehicle, 5.2)
    assert mode_of(vehicle) is Px4Mode.DESCEND
    vehicle.set_mode(Px4Mode.LAND)
    run(vehicle, 1.0)
    assert mode_of(vehicle) is Px4Mode.DESCEND and vehicle.failsafe.is_active


@pytest.mark.parametrize(
    ("setting", "remaining", "mode"),
    [
        (0, 0.01, Px4Mode.HOLD),
        (2, 0.10, Px4Mode.HOLD),
        (2, 0.06, Px4Mode.LAND),
        (3, 0.06, Px4Mode.RETURN),
        (3, 0.04, Px4Mode.LAND),
    ],
)
def test_low_battery(setting: int, remaining: float, mode: Px4Mode) -> None:
    vehicle = hovering()
    vehicle.parameters["COM_LOW_BAT_ACT"] = setting
    vehicle.battery_remaining = remaining
    run(vehicle, 5.2)
    assert mode_of(vehicle) is mode
    assert vehicle.battery_remaining < remaining
    assert any("battery" in text.lower() for text in texts(vehicle))


def test_a_silent_ground_station_counts_only_if_a_parameter_says_so() -> None:
    vehicle = hovering()
    vehicle.parameters["NAV_DLL_ACT"] = 3
    vehicle.ground_station_heartbeat()
    run(vehicle, 9.0)
    assert mode_of(vehicle) is Px4Mode.HOLD
    run(vehicle, 7.0)
    assert mode_of(vehicle) is Px4Mode.LAND


@pytest.mark.parametrize("polygon", [False, True])
def test_the_fence_acts_once_on_a_breach(polygon: bool) -> None:
    vehicle = in_offboard(velocity(2.0))
    if polygon:
        assert vehicle.home_m is not None
        offsets_m = np.array([(-10, -10, 0), (10, -10, 0), (10, 10, 0), (-10, 10, 0)])
        corners = [WorldOrigin().to_global(vehicle.home_m + offset_m) for offset_m in offsets_m]
        vehicle.fence = (FencePolygon(True, tuple(corner[:2] for corner in corners)),)
    else:
        vehicle.parameters["GF_MAX_HOR_DIST"] = 10.0
    run(vehicle, 8.0, velocity(2.0))
    assert mode_of(vehicle) is Px4Mode.HOLD
    assert vehicle.home_m is not None
    assert 10.0 < (vehicle.estimated_position_m - vehicle.home_m)[0] < 12.0
    vehicle.set_mode(Px4Mode.OFFBOARD)
    run(vehicle, 1.0, velocity(-2.0))
    assert mode_of(vehicle) is Px4Mode.OFFBOARD


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_gps_is_wrong_by_one_to_five_metres(seed: int) -> None:
    bias_m = Px4Vehicle(seed=seed).gps_bias_m
    assert 1.0 <= math.hypot(bias_m[0], bias_m[1]) <= 5.0


def test_the_same_seed_flies_the_same_flight() -> None:
    assert hovering(3).truth == hovering(3).truth
    assert hovering(3).truth != hovering(4).truth


def test_wind_pushes_at_first_and_a_storm_carries_away() -> None:
    vehicle = hovering()
    before_m = vehicle.position_m
    vehicle.wind_m_s = (6.0, 0.0, 0.0)
    run(vehicle, 2.0)
    assert 0.1 < vehicle.position_m[0] - before_m[0] < 4.0
    run(vehicle, 30.0)
    assert np.linalg.norm((vehicle.position_m - before_m)[:2]) < 1.0
    vehicle.wind_m_s = (20.0, 0.0, 0.0)
    run(vehicle, 10.0)
    assert vehicle.position_m[0] - before_m[0] > 30.0


def test_gusts_shake_it() -> None:
    vehicle = hovering()
    vehicle.gust_m_s = 2.0
    run(vehicle, 20.0)
    speeds = [np.linalg.norm(sample.velocity_m_s) for sample in vehicle.truth[-300:]]
    assert max(speeds) > 0.15


def test_an_origin_jump_moves_local_positions_and_what_follows_them() -> None:
    vehicle = hovering()
    local_m, place = vehicle.local_position_m, vehicle.global_position
    vehicle.jump_estimator_origin(7.0, 0.0)
    assert vehicle.local_position_m - local_m == pytest.approx([-7.0, 0.0, 0.0])
    assert vehicle.global_position == place
    north_m = vehicle.position_m[0]
    run(vehicle, 3.0)
    assert vehicle.position_m[0] == pytest.approx(north_m, abs=0.5)
    setpoint = Px4Setpoint(vector(local_m), NAN_3)
    vehicle.offboard(setpoint)
    vehicle.set_mode(Px4Mode.OFFBOARD)
    run(vehicle, 10.0, setpoint)
    assert vehicle.position_m[0] - north_m == pytest.approx(7.0, abs=1.0)


def test_an_origin_that_moves_in_height_lets_the_vehicle_climb_unseen() -> None:
    vehicle = hovering()
    here_m, height_m = vehicle.local_position_m, -vehicle.position_m[2]
    vehicle.jump_estimator_origin(0.0, 0.0, -6.0)
    assert vehicle.local_position_m - here_m == pytest.approx([0.0, 0.0, 6.0])
    setpoint = Px4Setpoint(vector(here_m), NAN_3)
    vehicle.offboard(setpoint)
    vehicle.set_mode(Px4Mode.OFFBOARD)
    run(vehicle, 10.0, setpoint)
    assert vehicle.local_position_m[2] == pytest.approx(here_m[2], abs=0.3)
    assert -vehicle.position_m[2] == pytest.approx(height_m + 6.0, abs=0.7)
    home = vehicle.global_home
    assert home is not None
    assert vehicle.global_position[2] - home[2] == pytest.approx(height_m + 6.0, abs=0.7)


@given(
    st.binary(max_size=80),
    st.integers(0, 1000),
    st.lists(st.floats(width=32), min_size=7, max_size=7),
)
def test_no_datagram_upsets_the_link(noise: bytes, command: int, values: list[float]) -> None:
    vehicle = Px4Vehicle(seed=0, ready_after_s=0.0)
    link = Px4Link(vehicle, system_id=1)
    client = mavlink.MAVLink(None, srcSystem=245, srcComponent=191)
    link.receive(noise)
    for message in (
        mavlink.MAVLink_command_long_message(1, 1, command, 0, *values),
        mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_DO_SET_MODE, 0, *values),
        mavlink.MAVLink_command_long_message(
            1, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, *values
        ),
        mavlink.MAVLink_set_position_target_local_ned_message(
            0, 1, 1, 1, 0, *values, 0.0, 0.0, values[0], 0.0
        ),
    ):
        link.receive(message.pack(client))
    vehicle.arm()
    vehicle.set_mode(Px4Mode.OFFBOARD)
    run(vehicle, 0.1)
    assert all(len(datagram) <= 1400 for datagram in link.due())
    assert np.isfinite(vehicle.position_m).all()


def test_a_message_for_another_system_is_not_obeyed() -> None:
    vehicle = Px4Vehicle(seed=0, ready_after_s=0.0)
    vehicle.step(STEP_S)
    link = Px4Link(vehicle, system_id=2)
    client = mavlink.MAVLink(None, srcSystem=245, srcComponent=191)
    arm = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
    for target, armed in ((1, False), (2, True)):
        message = mavlink.MAVLink_command_long_message(target, 1, arm, 0, 1, 0, 0, 0, 0, 0, 0)
        link.receive(message.pack(client))
        assert vehicle.armed is armed
