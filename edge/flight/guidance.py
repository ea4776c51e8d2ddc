"""Guidance: one control tick's setpoint for the flight state, in the mission frame.

Heights are above the robot's own takeoff point. HOLD, TAKEOFF and RETURN are flown as positions a
short way ahead of the estimate: PX4 stops at these much sooner than at a velocity of 0, and the
vehicle never dashes when the estimate jumps. MISSION is flown as a velocity. Neighbours and the
fence limit MISSION and RETURN; HOLD makes room for neighbours and comes back. With a doubtful
position the robot stands still in all of them.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from edge.core import F64
from edge.core.position import PositionQuality
from edge.core.vehicle import Vector
from edge.flight.safety import (
    MotionLimits,
    approach_speed,
    brake,
    clear_height_m,
    hold_height,
    keep_inside,
    leash,
    limit_acceleration,
    make_room,
)
from edge.flight.state import FlightInputs, FlightMemory, Robot, Tick, height_m, is_silent
from edge.messages.mission import STEERED, FlightState

# PX4 flies towards a position at about 0.95 of the distance per second (MPC_XY_P, MPC_Z_P). This
# must exceed the error of its estimated velocity, with which the vehicle drifts: up to 0.94 m/s in
# PX4's own simulation.
_HOLD_LEASH_M = 1.0
_AHEAD_S = 1.0
# RETURN does not move horizontally before it is this near its own height.
_AT_OWN_HEIGHT_M = 1.0
# A robot that was carried out of the fence makes room only when it is this far inside again, as a
# share of the buffer. HOLD then stays at half of it.
_BACK_INSIDE_SHARE = 0.25
# After a longer tick the movement is unknown.
_LONGEST_TICK_S = 0.5


class MissionVelocity(NamedTuple):
    """Setpoint of a velocity in the mission frame, m/s."""

    velocity_m_s: Vector


class MissionPosition(NamedTuple):
    """Setpoint of x and y in the mission frame, and a height, m."""

    position_m: Vector


MissionSetpoint = MissionVelocity | MissionPosition

_NO_SPEED_M_S = (0.0, 0.0, 0.0)
_STOP = MissionVelocity(_NO_SPEED_M_S)


class Parted(NamedTuple):
    """Replacement of HOLD's target after making room for others."""

    from_m: Vector
    to_m: Vector


@dataclass(frozen=True, slots=True, eq=False)
class Guidance:
    """Memory of guidance: last commanded velocity (3,), recovery to the fence, HOLD's new place."""

    velocity_m_s: F64 = field(default_factory=lambda: np.zeros(3))
    recovering: bool = False
    parted: Parted | None = None


def guide(
    robot: Robot, flight: FlightMemory, inputs: FlightInputs, guidance: Guidance, dt_s: float
) -> tuple[MissionSetpoint | None, Guidance]:
    """This tick's setpoint, None to send nothing, and the memory for the next tick.

    `flight` is the result of `step.step` for the same inputs; `dt_s` is the time since the last
    tick.
    """
    state, limits = flight.state, robot.limits
    if state not in (FlightState.ARMING, *STEERED) or is_silent(flight, inputs.now_s):
        return None, Guidance()
    height = height_m(flight, inputs.odometry)
    nowhere = Guidance(parted=guidance.parted)
    if state is FlightState.ARMING or inputs.odometry is None or height is None:
        return _STOP, nowhere
    x_m, y_m, _ = inputs.odometry.position_m
    if not all(map(math.isfinite, (x_m, y_m, height))):
        return _STOP, nowhere
    position_m = np.array([x_m, y_m, height])
    if inputs.position.quality is not PositionQuality.GOOD:
        return _stay(robot, flight, height), Guidance()
    if state is FlightState.HOLD:
        return _hold(robot, flight, inputs, guidance, position_m, dt_s)
    if state is FlightState.TAKEOFF:
        # A silent robot may still hover at its last place.
        silent = (replace(each, velocity_m_s=_NO_SPEED_M_S) for each in inputs.fell_silent)
        separation_m = robot.parameters.min_separation_m
        clear_m = clear_height_m(position_m, (*inputs.neighbours, *silent), separation_m)
        return _towards(flight.target_m, max(height, clear_m), position_m, limits), Guidance()
    wanted_m_s = np.zeros(3)
    if state is FlightState.RETURN:
        wanted_m_s[:2] = _return_velocity(robot, inputs, position_m)
    elif inputs.policy_velocity_m_s is not None:
        wanted_m_s[:2] = inputs.policy_velocity_m_s
    wanted_m_s = limit_acceleration(
        guidance.velocity_m_s, wanted_m_s, limits.max_acceleration_m_s2, dt_s
    )
    wanted_m_s[2] = hold_height(height, robot.parameters.slot_height_m, limits.max_climb_m_s)
    velocity_m_s = np.array(inputs.odometry.velocity_m_s)
    inside_m_s, recovering = keep_inside(
        robot.fence, position_m, velocity_m_s, wanted_m_s, limits, guidance.recovering
    )
    safe_m_s = brake(
        position_m,
        velocity_m_s,
        inside_m_s,
        inputs.neighbours,
        inputs.fell_silent,
        robot.separation,
        limits,
        robot.fence,
    )
    memory = Guidance(np.array([*safe_m_s[:2], 0.0]), recovering)
    if state is FlightState.RETURN:
        return MissionPosition(vector(position_m + safe_m_s * _AHEAD_S)), memory
    return MissionVelocity(vector(safe_m_s)), memory


def _stay(robot: Robot, flight: FlightMemory, height_m: float) -> MissionVelocity:
    """Stand still at one height, by the estimated velocity alone."""
    wanted_m = robot.parameters.slot_height_m
    if flight.state is FlightState.TAKEOFF:
        wanted_m = height_m
    elif flight.target_m is not None:
        wanted_m = flight.target_m[2]
    climb_m_s = hold_height(height_m, wanted_m, robot.limits.max_climb_m_s)
    return MissionVelocity((0.0, 0.0, climb_m_s))


def _towards(
    target_m: Vector | None, highest_m: float, position_m: F64, limits: MotionLimits
) -> MissionSetpoint:
    """A position on the way to the target: near in the plane, and a second's climb away."""
    if target_m is None:
        return _STOP
    place_m = leash(np.array(target_m[:2]), position_m[:2], _HOLD_LEASH_M)
    if place_m is None:
        return _STOP
    height = float(position_m[2])
    wanted_m = min(target_m[2], highest_m)
    climb_m = hold_height(height, wanted_m, limits.max_climb_m_s) * _AHEAD_S
    return MissionPosition(vector(np.array([*place_m, height + climb_m])))


def _hold(
    robot: Robot,
    flight: FlightMemory,
    inputs: FlightInputs,
    guidance: Guidance,
    position_m: F64,
    dt_s: float,
) -> tuple[MissionSetpoint, Guidance]:
    """Setpoint at the target, or at its replacement, with room for others."""
    target_m, parted, fence, limits = flight.target_m, guidance.parted, robot.fence, robot.limits
    if parted is not None and parted.from_m != target_m:
        parted = None
    stays_m = target_m if parted is None else parted.to_m
    place = _towards(stays_m, math.inf, position_m, limits)
    if (
        inputs.odometry is None
        or target_m is None
        or stays_m is None
        or isinstance(place, MissionVelocity)
    ):
        return place, Guidance()
    depth_m = fence.distance_m(*position_m[:2].tolist())
    back_inside_m = _BACK_INSIDE_SHARE * fence.buffer_m
    recovering = depth_m < 0.0 or (guidance.recovering and depth_m < back_inside_m)
    tick = Tick(robot, flight, inputs)
    lands = not recovering and (not tick.ground_heard or tick.off_height_s >= 0.0)
    wanted_m_s = (np.array(place.position_m) - position_m) / _AHEAD_S
    velocity_m_s = make_room(
        position_m,
        np.array(inputs.odometry.velocity_m_s),
        wanted_m_s,
        inputs.neighbours,
        robot.separation,
        limits,
        fence,
        lands=lands,
    )
    pushed_m_s = (velocity_m_s - wanted_m_s)[:2]
    if not pushed_m_s.any():
        return place, Guidance(recovering=recovering, parted=parted)
    # A bound, whatever neighbours do or send. A robot that is further away does not dash back
    # through them.
    around_m = np.array(target_m[:2])
    farthest_m = max(robot.separation.landed_m, math.dist(target_m[:2], position_m[:2].tolist()))
    ahead_m = leash((position_m + velocity_m_s * _AHEAD_S)[:2], around_m, farthest_m)
    goal_m = None if ahead_m is None else leash(ahead_m, position_m[:2], limits.max_speed_m_s)
    pushed_m = pushed_m_s * min(dt_s, _LONGEST_TICK_S)
    left_m = leash(np.array(stays_m[:2]) + pushed_m, around_m, farthest_m) if lands else None
    if goal_m is None:
        return _STOP, Guidance()
    if left_m is not None:
        # Do not come back over a neighbour that is no longer heard.
        x_m, y_m = left_m.tolist()
        x_m, y_m = fence.moved_inside_m(x_m, y_m, fence.buffer_m)
        parted = Parted(target_m, (x_m, y_m, target_m[2]))
    goal = MissionPosition((*goal_m.tolist(), place.position_m[2]))
    return goal, Guidance(recovering=recovering, parted=parted)


def _return_velocity(robot: Robot, inputs: FlightInputs, position_m: F64) -> F64:
    """Velocity (2,) towards the place of landing, 0 before the robot is at its own height."""
    if abs(position_m[2] - robot.parameters.slot_height_m) >= _AT_OWN_HEIGHT_M:
        return np.zeros(2)
    landing_m = inputs.lands_beside_m or robot.parameters.landing_point_m
    offset_m = np.array(landing_m) - position_m[:2]
    distance_m = float(np.hypot(*offset_m))
    speed_m_s = min(approach_speed(distance_m, robot.limits), robot.limits.max_speed_m_s)
    return offset_m * (speed_m_s / max(distance_m, 1e-9))


def vector(values: F64) -> Vector:
    """The numbers of an array (3,)."""
    x, y, z = values.tolist()
    return x, y, z
