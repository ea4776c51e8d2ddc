"""How the vehicles of a simulated world err: within what is stated, and so that it shows."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lpac.sim.px4.errors import (
    COMMON_HEIGHT_M,
    COMPASS_RAD,
    GREATEST_BIAS_M,
    GREATEST_WIND_M_S,
    LEAST_BIAS_M,
    Errors,
    draw_bias_m,
)
from lpac.sim.px4.modes import MavResult, Px4Mode
from lpac.sim.px4.vehicle import Px4Setpoint, Px4Vehicle

STEP_S = 0.02
FLIGHT_S = np.arange(0.0, 900.0, 7.0)
# edge.flight.margins: what heights of two vehicles come to differ by in one flight.
HEIGHT_APART_M = 2.0

seeds = st.integers(0, 2**32 - 1)


def horizontal_m(errors: Errors, bias_m: tuple[float, float]) -> np.ndarray:
    """Of a flight: (T, 2)."""
    bias = (*bias_m, 0.0)
    return np.array([errors.position_m(at_s, bias)[:2] for at_s in FLIGHT_S])


def flying(errors: Errors | None, seed: int = 1, height_m: float = 8.0) -> Px4Vehicle:
    vehicle = Px4Vehicle(seed=seed, ready_after_s=0.0, errors=errors)
    vehicle.parameters["MIS_TAKEOFF_ALT"] = height_m
    vehicle.step(STEP_S)
    assert vehicle.arm() is MavResult.ACCEPTED
    vehicle.take_off(math.nan)
    vehicle.step(STEP_S)
    fly(vehicle, 25.0)
    assert vehicle.mode is Px4Mode.HOLD
    return vehicle


def fly(vehicle: Px4Vehicle, duration_s: float) -> None:
    for _ in range(round(duration_s / STEP_S)):
        vehicle.step(STEP_S)


@given(seeds, st.floats(0.0, 1.0), st.floats(0.0, math.tau))
def test_a_receiver_errs_by_one_to_five_metres_and_walks(
    seed: int, share: float, bearing_rad: float
) -> None:
    error_m = horizontal_m(Errors(seed, 0), draw_bias_m(share, bearing_rad))
    length_m = np.hypot(*error_m.T)
    assert (length_m > LEAST_BIAS_M - 1e-9).all() and (length_m < GREATEST_BIAS_M + 1e-9).all()
    walked_m = np.hypot(*(error_m - error_m[0]).T)
    assert 0.1 < walked_m.max() < 3.0
    assert np.hypot(*np.diff(error_m, axis=0).T).max() < 0.05 * 7.0


def test_most_receivers_err_by_more_than_they_say_of_themselves() -> None:
    vehicles = [Px4Vehicle(seed=seed, errors=Errors(seed, 0)) for seed in range(200)]
    biases_m = [math.hypot(*vehicle.gps_bias_m[:2]) for vehicle in vehicles]
    assert 2.7 < np.median(biases_m) < 3.3
    told_m = [vehicle.gps_accuracy_m[0] for vehicle in vehicles]
    assert np.mean(np.array(biases_m) > told_m) > 0.8


@given(st.lists(seeds, min_size=2, max_size=6, unique=True), seeds)
def test_heights_walk_together_and_little_apart(own: list[int], common: int) -> None:
    """Three metres within five minutes for all, two metres between any two since any moment."""
    fleet = [Errors(seed, common) for seed in own]
    heights_m = np.array([[e.height_m(at_s) for at_s in FLIGHT_S] for e in fleet])
    after_5_min_m = [e.height_m(300.0) for e in fleet]
    assert all(abs(abs(h) - COMMON_HEIGHT_M) <= HEIGHT_APART_M / 2.0 for h in after_5_min_m)
    assert len({h > 0.0 for h in after_5_min_m}) == 1
    apart_m = heights_m[:, None] - heights_m[None]
    assert np.ptp(apart_m, axis=2).max() <= HEIGHT_APART_M


def test_fleets_differ_and_a_seed_is_one_world() -> None:
    assert Errors(1, 2).height_m(200.0) == Errors(1, 2).height_m(200.0)
    assert Errors(1, 2).height_m(200.0) != Errors(3, 2).height_m(200.0)
    assert {Errors(1, fleet).height_m(300.0) > 0.0 for fleet in range(10)} == {True, False}


@given(seeds, seeds)
def test_gusts_are_the_same_for_all_and_reach_their_greatest(seed: int, fleet: int) -> None:
    errors, other = Errors(seed, fleet), Errors(seed + 1, fleet)
    speeds_m_s = [float(np.linalg.norm(errors.wind_m_s(at_s))) for at_s in np.arange(0, 60, 0.2)]
    assert max(speeds_m_s) == pytest.approx(GREATEST_WIND_M_S, abs=0.1)
    assert min(speeds_m_s) < 4.1
    # Steepest is sin^3 with a period of 20 s between 1 and 8 m/s: its slope is at most 2.54 m/s^2.
    assert max(abs(b - a) for a, b in pairwise(speeds_m_s)) < 0.2 * 2.54
    assert errors.wind_m_s(17.0) == other.wind_m_s(17.0)


def test_a_compass_errs_and_is_reset_in_flight() -> None:
    fleet = [Errors(seed, 0) for seed in range(60)]
    before = np.array([e.heading_rad(0.0) for e in fleet])
    after = np.array([e.heading_rad(600.0) for e in fleet])
    assert COMPASS_RAD / 2.0 < np.abs(before).max() <= COMPASS_RAD
    assert 5 < (before != after).sum() < 30
    assert (np.abs(after) <= np.abs(before)).all()


def test_a_vehicle_that_holds_its_height_rises_or_falls_in_truth() -> None:
    errors = Errors(4, 5)
    vehicle = flying(errors)
    told_m, true_m, error_m = (
        vehicle.local_position_m[2], vehicle.position_m[2], errors.height_m(vehicle.time_s),
    )  # fmt: skip
    fly(vehicle, 200.0)
    walked_m = errors.height_m(vehicle.time_s) - error_m
    assert abs(walked_m) > 1.0
    assert vehicle.local_position_m[2] == pytest.approx(told_m, abs=0.6)
    assert vehicle.position_m[2] - true_m == pytest.approx(-walked_m, abs=0.8)


@pytest.mark.parametrize("seed", range(4))
def test_gusts_and_a_wrong_compass_move_a_vehicle_that_holds_by_less_than_a_metre(
    seed: int,
) -> None:
    vehicle = flying(Errors(seed, seed), seed)
    start_m = vehicle.estimated_position_m
    away_m = 0.0
    for _ in range(round(90.0 / STEP_S)):
        vehicle.step(STEP_S)
        away_m = max(away_m, float(np.hypot(*(vehicle.estimated_position_m - start_m)[:2])))
    assert 0.1 < away_m < 1.0


def test_gusts_and_its_estimate_disturb_a_velocity_that_is_followed() -> None:
    vehicle = flying(Errors(2, 2))
    setpoint = Px4Setpoint((math.nan,) * 3, (0.5, 0.0, 0.0))
    vehicle.offboard(setpoint)
    assert vehicle.set_mode(Px4Mode.OFFBOARD) is MavResult.ACCEPTED
    off_m_s = []
    for step in range(round(60.0 / STEP_S)):
        if step % 5 == 0:
            vehicle.offboard(setpoint)
        vehicle.step(STEP_S)
        off = np.array(vehicle.estimate_m_s()) - setpoint.velocity_m_s
        off_m_s.append(float(np.hypot(*off[:2])))
    settled = off_m_s[500:]
    # It follows a wandering estimate with a lag.
    assert np.median(settled) < 0.25
    assert 0.1 < max(settled) < 0.7


def test_a_velocity_is_estimated_as_badly_as_by_a_real_px4_in_its_own_simulation() -> None:
    """Of one the error was 0.1 to 0.5 m/s rms in flight, at most 0.9 m/s; below 0.1 m/s before."""
    errors_m_s = []
    for seed in range(8):
        vehicle = flying(Errors(seed, seed))
        vehicle.set_mode(Px4Mode.HOLD)
        before = len(vehicle.truth)
        fly(vehicle, 40.0)
        errors_m_s.append([entry.velocity_error_m_s for entry in vehicle.truth[before:]])
    rms_m_s = np.sqrt(np.mean(np.square(errors_m_s), axis=1))
    assert 0.1 < rms_m_s.min() < rms_m_s.max() < 0.5
    assert 0.5 < np.max(errors_m_s) < 0.9
    standing = Px4Vehicle(seed=1, ready_after_s=0.0, errors=Errors(1, 1))
    fly(standing, 10.0)
    assert not any(standing.estimate_m_s())


def test_who_lands_keeps_to_its_place_though_its_velocity_is_wrong() -> None:
    for seed in range(5):
        vehicle = flying(Errors(seed, seed))
        vehicle.set_mode(Px4Mode.LAND)
        fly(vehicle, 3.0)
        began_m = vehicle.estimated_position_m
        fly(vehicle, 25.0)
        off_m = (vehicle.estimated_position_m - began_m)[:2]
        assert vehicle.landed and np.hypot(*off_m) < 1.5, seed


def test_a_voltage_sags_under_load_and_pulls_the_charge_with_it() -> None:
    errors = next(e for e in (Errors(s, 0) for s in range(20)) if e.resistance_ohm > 0.027)
    vehicle = Px4Vehicle(seed=1, ready_after_s=0.0, errors=errors)
    vehicle.step(STEP_S)
    resting_v, resting = vehicle.voltage_v, vehicle.battery_reported
    flown = flying(errors)
    assert flown.voltage_v < resting_v - 0.25
    assert flown.battery_reported < flown.battery_remaining - 0.02 < resting
    flown.set_mode(Px4Mode.LAND)
    fly(flown, 30.0)
    assert not flown.armed
    assert flown.battery_reported == pytest.approx(flown.battery_remaining, abs=0.005)


def test_a_weak_motor_costs_charge() -> None:
    fleet = [Errors(seed, 0) for seed in range(100)]
    weak = [e for e in fleet if e.thrust_loss > 0.0]
    assert 5 < len(weak) < 30
    assert all(e.thrust_loss <= 0.2 for e in weak)
    for errors in (weak[0], next(e for e in fleet if e.thrust_loss == 0.0)):
        vehicle = flying(errors)
        assert vehicle.current_a == pytest.approx(12.5 + 12.0 * errors.thrust_loss)


def test_a_remote_control_goes_stale_now_and_then() -> None:
    errors = Errors(3, 0)
    vehicle = Px4Vehicle(seed=1, ready_after_s=0.0, errors=errors)
    vehicle.rc_connected = True
    heard = []
    for _ in range(round(260.0 / STEP_S)):
        vehicle.step(STEP_S)
        heard.append(vehicle.rc_received)
    gaps_s = heard.count(False) * STEP_S
    assert 0.2 < gaps_s < 10.0
