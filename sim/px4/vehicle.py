"""A PX4-like multicopter: modes, refusals, failsafes and flight; no socket and no clock.

World frame: north, east, down from `WorldOrigin`, m; the ground is at down = 0. The vehicle knows
its position with an error: a constant GPS bias and slow noise. Its local frame starts at the
estimator's origin, which is neither the launch point nor its height.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.core import F64
from sim.px4.modes import (
    ACTION_MODES,
    CAN_LEAVE_GROUND,
    FENCE_ACTIONS,
    LINK_LOSS_ACTIONS,
    NEED_POSITION,
    OFFBOARD_LOSS_ACTIONS,
    PILOTED,
    PREVENT_ARMING,
    Action,
    Mode,
    Result,
)
from sim.px4.parameters import PARAMETERS
from sim.px4.world import FencePolygon, WorldOrigin

GRAVITY_M_S2 = 9.81
# Share of the wind that its change pushes the vehicle with, 1/s, and how soon control makes up.
DRAG_PER_S = 0.3
WIND_COMPENSATION_S = 5.0
GPS_NOISE_M = np.array([0.15, 0.15, 0.1])
GPS_NOISE_TIME_S = 10.0
DEAD_RECKONING_S = 5.0
DEAD_RECKONING_DRIFT_M = 0.5  # per square root of a second
VERTICAL_DRIFT_M_S = 0.04
VERTICAL_DRIFT_TIME_S = 20.0
YAW_RATE_RAD_S = 1.0
LANDED_AFTER_S = 1.0
STOPPED_M_S = 0.15
ARRIVED_M = 0.3
SLOW_DESCENT_BELOW_M = 5.0
TRUTH_PERIOD_S = 0.04


@dataclass(frozen=True, slots=True)
class Airframe:
    """How the vehicle answers to commands.

    `offboard_velocity_lag_s` holds for bare velocity setpoints: 1 m/s for 10 s covers 8.7 m, as
    measured. PX4's own modes also feed the acceleration forward and answer within `lag_s`.
    """

    lag_s: float = 0.3
    offboard_velocity_lag_s: float = 1.3
    max_airspeed_m_s: float = 15.0
    endurance_s: float = 1200.0


@dataclass(frozen=True, slots=True)
class Setpoint:
    """An offboard setpoint in the local frame; NaN where an axis is not commanded.

    position_m (3,), velocity_m_s (3,): north, east, down. yaw_rad: NaN keeps the heading.
    """

    position_m: F64
    velocity_m_s: F64
    yaw_rad: float = math.nan


@dataclass(frozen=True, slots=True)
class Event:
    """One line for whoever operates the vehicle."""

    text: str
    is_warning: bool


@dataclass(frozen=True, slots=True)
class Truth:
    """What is really so at one time: world frame, m and m/s."""

    time_s: float
    position_m: tuple[float, float, float]
    velocity_m_s: tuple[float, float, float]
    mode: Mode
    armed: bool
    landed: bool


class Px4Vehicle:
    """One vehicle; deterministic for a seed, its steps and its commands.

    Fields that a test may set at any time: `parameters`, `wind_m_s`, `gust_m_s` (standard
    deviation), `gps_bias_m`, `gps_lost`, `battery_remaining` (0 to 1), `rc_connected`.
    `truth` grows by one entry every 0.04 s.
    """

    def __init__(
        self,
        *,
        seed: int,
        start_m: tuple[float, float] = (0.0, 0.0),
        heading_rad: float = 0.0,
        origin: WorldOrigin | None = None,
        airframe: Airframe | None = None,
        ready_after_s: float | None = None,
    ) -> None:
        """`start_m` is north and east. Health becomes good `ready_after_s` after the start.

        It is drawn from 3 to 6 s unless given; so are the GPS bias, 1 to 5 m horizontally, and the
        place of the estimator's origin.
        """
        self._rng = np.random.default_rng(seed)
        self._world = origin or WorldOrigin()
        self._airframe = airframe or Airframe()
        drawn_ready_s = float(self._rng.uniform(3.0, 6.0))
        self._ready_after_s = drawn_ready_s if ready_after_s is None else ready_after_s
        bearing, length_m = self._rng.uniform(0.0, math.tau), self._rng.uniform(1.0, 5.0)
        self.gps_bias_m: F64 = np.array(
            [
                length_m * math.cos(bearing),
                length_m * math.sin(bearing),
                self._rng.uniform(-1.5, 1.5),
            ]
        )
        self.parameters: dict[str, int | float] = dict(PARAMETERS)
        self.fence: tuple[FencePolygon, ...] = ()
        self.truth: list[Truth] = []

        self.time_s = 0.0
        self.position_m: F64 = np.array([*start_m, 0.0])
        self.velocity_m_s: F64 = np.zeros(3)
        self.acceleration_m_s2: F64 = np.zeros(3)
        self.heading_rad = heading_rad
        self.yaw_rate_rad_s = 0.0

        self.wind_m_s: F64 = np.zeros(3)
        self.gust_m_s = 0.0
        self._gust: F64 = np.zeros(3)
        self._compensated_wind: F64 = np.zeros(3)
        self.battery_remaining = 1.0

        self.gps_lost = False
        self._gps_lost_since_s = math.inf
        self._noise_m: F64 = GPS_NOISE_M * self._rng.standard_normal(3)
        self._dead_reckoning_m: F64 = np.zeros(3)
        self._vertical_drift_m_s = 0.0
        self.estimator_origin_m: F64 = self.estimated_position_m + self._rng.normal(
            0.0, (1.0, 1.0, 0.5)
        )

        self.armed = False
        self.mode = self.intended_mode = self._mode_after_disarm = Mode.HOLD
        self._mode_commands = 0
        self.landed = True
        self.home_m: F64 | None = None
        self._armed_at_s = 0.0
        self._took_off = False
        self._lift_began_s: float | None = None
        self._on_ground_since_s = -math.inf
        self._takeoff_down_m = 0.0
        self._hold_m: F64 | None = None

        self._setpoint: Setpoint | None = None
        self._setpoint_at_s = -math.inf
        self.rc_connected = False
        self._rc_at_arming = False
        self._sticks_m_s: F64 = np.zeros(3)
        self._ground_station_at_s = -math.inf
        self._outside_fence = False
        self._fence_latch = -1
        self.failsafe = Action.NONE
        self._failsafe_since_s = 0.0
        self._events: list[Event] = []

    # What the vehicle believes

    @property
    def estimated_position_m(self) -> F64:
        """(3,), world frame: where the vehicle takes itself to be."""
        return self.position_m + self.gps_bias_m + self._noise_m + self._dead_reckoning_m

    @property
    def local_position_m(self) -> F64:
        """(3,): the estimate from the estimator's origin, north, east, down."""
        return self.estimated_position_m - self.estimator_origin_m

    @property
    def global_position(self) -> tuple[float, float, float]:
        """The estimate: latitude and longitude, deg, height above mean sea level, m."""
        return self._world.to_global(self.estimated_position_m)

    @property
    def global_origin(self) -> tuple[float, float, float]:
        """The estimator's origin: latitude and longitude, deg, height above mean sea level, m."""
        return self._world.to_global(self.estimator_origin_m)

    @property
    def global_home(self) -> tuple[float, float, float] | None:
        """Home in the same terms, None before there is one."""
        return None if self.home_m is None else self._world.to_global(self.home_m)

    @property
    def position_valid(self) -> bool:
        """Whether the estimator still vouches for its position."""
        return (
            self.time_s >= self._ready_after_s
            and self.time_s - self._gps_lost_since_s < DEAD_RECKONING_S
        )

    @property
    def armable(self) -> bool:
        """Whether the checks before arming pass."""
        return self._arming_refusal() is None

    def take_events(self) -> list[Event]:
        """What the vehicle has to say since the last call."""
        events, self._events = self._events, []
        return events

    def _say(self, text: str, is_warning: bool = False) -> None:
        self._events.append(Event(text, is_warning))

    # What a client commands

    def arm(self, *, force: bool = False) -> Result:
        """Arm; DENIED, with an event that says why, unless every check passes or by force."""
        if self.armed:
            return Result.ACCEPTED
        refusal = self._arming_refusal()
        if refusal and not force:
            self._say(f"Arming denied: {refusal}", True)
            return Result.DENIED
        self.armed = True
        self._armed_at_s = self.time_s
        self._took_off = False
        self._lift_began_s = None
        self._rc_at_arming = self.rc_connected
        self.home_m = self.estimated_position_m
        self._say("Armed")
        return Result.ACCEPTED

    def disarm(self, *, force: bool = False) -> Result:
        """Disarm; DENIED in the air, unless by force: then the vehicle falls."""
        if not self.armed:
            return Result.ACCEPTED
        if not self.landed and not force:
            self._say("Disarming denied: not landed", True)
            return Result.DENIED
        self.armed = False
        self.failsafe = Action.NONE
        self._set_intended_mode(self._mode_after_disarm)
        self._say("Disarmed")
        return Result.ACCEPTED

    def set_mode(self, mode: Mode) -> Result:
        """Ask for a mode; DENIED where the vehicle lacks what the mode needs."""
        if mode is Mode.OFFBOARD and not self._offboard_signal():
            self._say("Offboard denied: no setpoints", True)
            return Result.DENIED
        if self.armed and mode in NEED_POSITION and not self.position_valid:
            self._say(f"{mode.name} denied: no position", True)
            return Result.DENIED
        if self.armed and mode in PILOTED and not self.rc_connected:
            self._say(f"{mode.name} denied: no manual control", True)
            return Result.DENIED
        if mode is Mode.TAKEOFF:
            self._takeoff_down_m = self._home_down_m() - self.parameters["MIS_TAKEOFF_ALT"]
        self._set_intended_mode(mode)
        return Result.ACCEPTED

    def take_off(self, altitude_m: float) -> Result:
        """Climb to a height above mean sea level, m; NaN takes MIS_TAKEOFF_ALT above home."""
        result = self.set_mode(Mode.TAKEOFF)
        if result is Result.ACCEPTED and not math.isnan(altitude_m):
            self._takeoff_down_m = self._world.altitude_m - altitude_m
        return result

    def offboard(self, setpoint: Setpoint) -> None:
        """A setpoint of the stream that OFFBOARD needs."""
        self._setpoint, self._setpoint_at_s = setpoint, self.time_s

    def ground_station_heartbeat(self) -> None:
        """A ground station was heard."""
        self._ground_station_at_s = self.time_s

    # What a test does to it

    def pilot(self, mode: Mode = Mode.POSCTL, stick_velocity_m_s: Sequence[float] = ()) -> Result:
        """A pilot switches on the remote control, to `mode`, and holds the sticks.

        `stick_velocity_m_s` is north, east, down; empty means centred.
        """
        self.rc_connected = True
        result = self.set_mode(mode)
        self.move_sticks(stick_velocity_m_s)
        return result

    def move_sticks(self, velocity_m_s: Sequence[float]) -> None:
        """Sticks alone take the vehicle only where COM_RC_OVERRIDE allows it."""
        self._sticks_m_s = np.array([*velocity_m_s] or [0.0] * 3)
        if self.mode in PILOTED:
            # It stays where the sticks are let go, not where they were let go before.
            self._hold_m = None
        bit = 2 if self.mode is Mode.OFFBOARD else 1
        override = int(self.parameters["COM_RC_OVERRIDE"]) & bit
        if self.mode not in PILOTED and override and self.rc_connected and self._sticks_m_s.any():
            self.set_mode(Mode.POSCTL)

    def jump_estimator_origin(self, north_m: float, east_m: float, down_m: float = 0.0) -> None:
        """The estimator starts over from another origin: local positions jump, global ones stay."""
        self.estimator_origin_m = self.estimator_origin_m + np.array([north_m, east_m, down_m])

    # Time

    def step(self, dt_s: float) -> None:
        """One step of time; 0.02 s suits the model."""
        self.time_s += dt_s
        self._estimate(dt_s)
        if self.home_m is None and self.position_valid:
            self.home_m = self.estimated_position_m
        if self.armed:
            self.battery_remaining = max(
                0.0, self.battery_remaining - dt_s / self._airframe.endurance_s
            )
            self._apply_failsafes()
        self._move(dt_s)
        self._watch_ground()
        if not self.truth or self.time_s - self.truth[-1].time_s >= TRUTH_PERIOD_S - 1e-9:
            self._record_truth()

    def _estimate(self, dt_s: float) -> None:
        draws = self._rng.standard_normal(10)
        decay = dt_s / GPS_NOISE_TIME_S
        self._noise_m = self._noise_m * (1.0 - decay) + GPS_NOISE_M * draws[:3] * math.sqrt(
            2.0 * decay
        )
        decay = dt_s / VERTICAL_DRIFT_TIME_S
        self._vertical_drift_m_s += -self._vertical_drift_m_s * decay + VERTICAL_DRIFT_M_S * float(
            draws[3]
        ) * math.sqrt(2.0 * decay)
        decay = dt_s / WIND_COMPENSATION_S
        self._gust = self._gust * (1.0 - decay) + self.gust_m_s * draws[4:7] * math.sqrt(
            2.0 * decay
        )
        if not self.gps_lost:
            self._gps_lost_since_s = math.inf
            self._dead_reckoning_m = np.zeros(3)
            return
        self._gps_lost_since_s = min(self._gps_lost_since_s, self.time_s)
        step_m = DEAD_RECKONING_DRIFT_M * math.sqrt(dt_s)
        self._dead_reckoning_m = self._dead_reckoning_m + step_m * draws[7:10] * (1.0, 1.0, 0.0)

    # Modes

    def _arming_refusal(self) -> str | None:
        if not self.position_valid or self.gps_lost:
            return "no global position"
        if self.intended_mode in PREVENT_ARMING:
            return f"mode {self.intended_mode.name}"
        if self.intended_mode is Mode.OFFBOARD and not self._offboard_signal():
            return "no offboard signal"
        if self.intended_mode in PILOTED and not self.rc_connected:
            return "no manual control"
        if self.battery_remaining < self.parameters["BAT_LOW_THR"]:
            return "low battery"
        if self.parameters["NAV_DLL_ACT"] and self._ground_station_lost():
            return "no connection to a ground station"
        return None

    def _offboard_signal(self) -> bool:
        return self.time_s - self._setpoint_at_s <= self.parameters["COM_OF_LOSS_T"]

    def _ground_station_lost(self) -> bool:
        return self.time_s - self._ground_station_at_s > self.parameters["COM_DL_LOSS_T"]

    def _set_intended_mode(self, mode: Mode) -> None:
        self._mode_commands += 1
        self.intended_mode = mode
        self._enter(mode)
        if mode not in PREVENT_ARMING:
            self._mode_after_disarm = mode

    def _enter(self, mode: Mode) -> None:
        if mode is not self.mode:
            self.mode = mode
            self._hold_m = None

    def _apply_failsafes(self) -> None:
        cause, action = max(
            (
                ("offboard signal lost", self._on_offboard_loss()),
                ("manual control lost", self._on_manual_control_loss()),
                ("ground station lost", self._on_ground_station_loss()),
                ("battery", self._on_battery()),
                ("geofence", self._on_geofence()),
                ("position lost", self._on_position_loss()),
            ),
            key=lambda entry: entry[1],
        )
        if action is not self.failsafe:
            if self.failsafe < Action.HOLD:
                self._failsafe_since_s = self.time_s
            self.failsafe = action
            self._say(
                f"Failsafe {action.name}: {cause}" if action else "Failsafe over", bool(action)
            )
        if action is Action.STOP_MOTORS:
            self.disarm(force=True)
            return
        # Time for a pilot to take over; a mode that lost what it needs is left at once.
        waiting = self.time_s - self._failsafe_since_s < self.parameters["COM_FAIL_ACT_T"]
        delayed = cause not in ("offboard signal lost", "position lost")
        if waiting and delayed and action in (Action.RETURN, Action.LAND):
            action = Action.HOLD
        mode = ACTION_MODES.get(action, self.intended_mode)
        # A landing or return that was asked for goes on under a milder failsafe.
        if self.intended_mode is Mode.LAND or (
            self.intended_mode is Mode.RETURN and mode is Mode.HOLD
        ):
            mode = self.intended_mode
        self._enter(mode)

    def _on_offboard_loss(self) -> Action:
        if self.intended_mode is not Mode.OFFBOARD or self._offboard_signal():
            return Action.NONE
        setting = int(self.parameters["COM_OBL_RC_ACT"])
        if setting in OFFBOARD_LOSS_ACTIONS:
            return OFFBOARD_LOSS_ACTIONS[setting]
        if self.rc_connected:
            return Action.POSCTL
        return LINK_LOSS_ACTIONS.get(int(self.parameters["NAV_RCL_ACT"]), Action.NONE)

    def _on_manual_control_loss(self) -> Action:
        excepted = {Mode.HOLD: 2, Mode.OFFBOARD: 4}.get(self.intended_mode, 0)
        if (
            not self._rc_at_arming
            or self.rc_connected
            or int(self.parameters["COM_RC_IN_MODE"]) == 4
            or int(self.parameters["COM_RCL_EXCEPT"]) & excepted
        ):
            return Action.NONE
        return LINK_LOSS_ACTIONS.get(int(self.parameters["NAV_RCL_ACT"]), Action.NONE)

    def _on_ground_station_loss(self) -> Action:
        if not self._ground_station_lost():
            return Action.NONE
        return LINK_LOSS_ACTIONS.get(int(self.parameters["NAV_DLL_ACT"]), Action.NONE)

    def _on_battery(self) -> Action:
        parameters, setting = self.parameters, int(self.parameters["COM_LOW_BAT_ACT"])
        if self.battery_remaining >= parameters["BAT_LOW_THR"]:
            return Action.NONE
        if self.battery_remaining >= parameters["BAT_CRIT_THR"] or setting not in (2, 3):
            return Action.WARN
        if setting == 3 and self.battery_remaining >= parameters["BAT_EMERGEN_THR"]:
            return Action.RETURN
        return Action.LAND

    def _on_geofence(self) -> Action:
        """A breach acts until another mode is asked for; then not until the next breach."""
        outside = self._is_outside_fence()
        if outside and not self._outside_fence:
            self._fence_latch = self._mode_commands
        self._outside_fence = outside
        if self._fence_latch != self._mode_commands:
            return Action.NONE
        return FENCE_ACTIONS.get(int(self.parameters["GF_ACTION"]), Action.NONE)

    def _is_outside_fence(self) -> bool:
        estimate_m = self.estimated_position_m
        if self.home_m is not None:
            north_m, east_m, down_m = (estimate_m - self.home_m).tolist()
            radius_m = self.parameters["GF_MAX_HOR_DIST"]
            height_m = self.parameters["GF_MAX_VER_DIST"]
            if 0.0 < radius_m < math.hypot(north_m, east_m) or 0.0 < height_m < -down_m:
                return True
        north_m, east_m, _ = estimate_m.tolist()
        return any(
            polygon.contains(self._world, north_m, east_m) != polygon.inclusion
            for polygon in self.fence
        )

    def _on_position_loss(self) -> Action:
        lost = self.mode in NEED_POSITION | {Mode.LAND} and not self.position_valid
        return Action.LAND if lost else Action.NONE

    # Motion

    def _home_down_m(self) -> float:
        home_m = self.estimated_position_m if self.home_m is None else self.home_m
        return float(home_m[2])

    def _move(self, dt_s: float) -> None:
        if not self.armed:
            self._fall(dt_s)
            return
        velocity_m_s, yaw_rad, lag_s = self._command()
        velocity_m_s = self._limit(velocity_m_s)
        on_ground = self.position_m[2] >= 0.0
        if on_ground and velocity_m_s[2] >= 0.0:
            velocity_m_s = np.zeros(3)
        wind_m_s = self.wind_m_s + self._gust
        acceleration = (velocity_m_s - self.velocity_m_s) / (lag_s, lag_s, self._airframe.lag_s)
        parameters = self.parameters
        acceleration[:2] = _shorten(acceleration[:2], parameters["MPC_ACC_HOR"])
        acceleration[2] = min(
            max(acceleration[2], -parameters["MPC_ACC_UP_MAX"]), parameters["MPC_ACC_DOWN_MAX"]
        )
        if not on_ground:
            acceleration += DRAG_PER_S * (wind_m_s - self._compensated_wind)
        self._compensated_wind = self._compensated_wind + (wind_m_s - self._compensated_wind) * (
            dt_s / WIND_COMPENSATION_S
        )
        self.acceleration_m_s2 = acceleration
        self.velocity_m_s = self.velocity_m_s + acceleration * dt_s
        self._turn(yaw_rad, dt_s)
        self._advance(dt_s)

    def _fall(self, dt_s: float) -> None:
        self.yaw_rate_rad_s = 0.0
        if self.position_m[2] >= 0.0:
            self.velocity_m_s = self.acceleration_m_s2 = np.zeros(3)
            return
        self.acceleration_m_s2 = np.array([0.0, 0.0, GRAVITY_M_S2])
        self.velocity_m_s = self.velocity_m_s + self.acceleration_m_s2 * dt_s
        self._advance(dt_s)

    def _advance(self, dt_s: float) -> None:
        self.position_m = self.position_m + self.velocity_m_s * dt_s
        if self.position_m[2] >= 0.0:
            self.position_m[2] = 0.0
            self.velocity_m_s = np.zeros(3)

    def _turn(self, yaw_rad: float, dt_s: float) -> None:
        if math.isnan(yaw_rad):
            self.yaw_rate_rad_s = 0.0
            return
        error_rad = math.remainder(yaw_rad - self.heading_rad, math.tau)
        self.yaw_rate_rad_s = min(max(error_rad / dt_s, -YAW_RATE_RAD_S), YAW_RATE_RAD_S)
        self.heading_rad = (self.heading_rad + self.yaw_rate_rad_s * dt_s) % math.tau

    def _limit(self, velocity_m_s: F64) -> F64:
        """The vehicle's own speed limits, the ramp of a takeoff, and what the wind leaves."""
        parameters = self.parameters
        horizontal = _shorten(velocity_m_s[:2], parameters["MPC_XY_VEL_MAX"])
        wind = self.wind_m_s[:2] + self._gust[:2]
        horizontal = _shorten(horizontal - wind, self._airframe.max_airspeed_m_s) + wind
        down = max(velocity_m_s[2], -parameters["MPC_Z_VEL_MAX_UP"])
        down = down * self._ramp() if down < 0.0 else min(down, parameters["MPC_Z_VEL_MAX_DN"])
        if self.position_m[2] >= 0.0:
            # The first command upwards after spool-up starts the ramp.
            spooled = self.time_s - self._armed_at_s >= parameters["COM_SPOOLUP_TIME"]
            if spooled and velocity_m_s[2] < -0.1 and self._lift_began_s is None:
                self._lift_began_s = self.time_s
            if velocity_m_s[2] >= -0.1:
                self._lift_began_s = None
            horizontal = np.zeros(2)
        return np.array([horizontal[0], horizontal[1], down])

    def _ramp(self) -> float:
        if self._lift_began_s is None:
            return 0.0 if self.position_m[2] >= 0.0 else 1.0
        ramp_s = self.parameters["MPC_TKO_RAMP_T"]
        return min(1.0, (self.time_s - self._lift_began_s) / ramp_s) if ramp_s > 0.0 else 1.0

    def _command(self) -> tuple[F64, float, float]:
        """Velocity, world frame, m/s; yaw, rad or NaN; horizontal lag, s."""
        lag_s = self._airframe.lag_s
        if self.landed and self.mode not in CAN_LEAVE_GROUND:
            return np.zeros(3), math.nan, lag_s
        if not self.position_valid and self.mode not in PILOTED:
            descent = [*self.wind_m_s[:2], self.parameters["MPC_LAND_SPEED"]]
            return np.array(descent), math.nan, lag_s
        if self.mode is Mode.OFFBOARD and self._setpoint is not None:
            return self._follow(self._setpoint)
        if self.mode is Mode.TAKEOFF:
            return self._climb(), math.nan, lag_s
        if self.mode is Mode.LAND:
            return self._descend(), math.nan, lag_s
        if self.mode is Mode.RETURN:
            return self._return(), math.nan, lag_s
        if self.mode in PILOTED and self._sticks_m_s.any():
            return self._sticks_m_s, math.nan, lag_s
        if self.mode in PILOTED and self.mode is not Mode.POSCTL:
            return np.array([*self.wind_m_s[:2], 0.0]), math.nan, lag_s
        return self._hold(), math.nan, lag_s

    def _follow(self, setpoint: Setpoint) -> tuple[F64, float, float]:
        gains = (self.parameters["MPC_XY_P"],) * 2 + (self.parameters["MPC_Z_P"],)
        error_m = setpoint.position_m - self.local_position_m
        bare_velocity = np.isnan(error_m)
        drift = (0.0, 0.0, self._vertical_drift_m_s)
        command = np.nan_to_num(setpoint.velocity_m_s) + np.where(
            bare_velocity, drift, gains * np.nan_to_num(error_m)
        )
        command[:2] = _shorten(command[:2], self.parameters["MPC_XY_VEL_MAX"])
        airframe = self._airframe
        lag_s = airframe.offboard_velocity_lag_s if bare_velocity[0] else airframe.lag_s
        return command, setpoint.yaw_rad, lag_s

    def _hold(self) -> F64:
        """Brake, then stay where the vehicle came to rest."""
        if self._hold_m is None:
            if math.sqrt(float(self.velocity_m_s @ self.velocity_m_s)) > STOPPED_M_S:
                return np.zeros(3)
            self._hold_m = self.estimated_position_m
        return self._toward(self._hold_m)

    def _climb(self) -> F64:
        command = self._hold()
        error_m = float(self.estimated_position_m[2]) - self._takeoff_down_m
        if error_m < ARRIVED_M and self._took_off:
            self._set_intended_mode(Mode.HOLD)
        speed_m_s = min(error_m * self.parameters["MPC_Z_P"], self.parameters["MPC_TKO_SPEED"])
        command[2] = -speed_m_s
        return command

    def _descend(self) -> F64:
        command = self._hold()
        near = -self.position_m[2] < SLOW_DESCENT_BELOW_M
        command[2] = self.parameters["MPC_LAND_SPEED" if near else "MPC_Z_VEL_MAX_DN"]
        return command

    def _return(self) -> F64:
        """Climb to the return altitude, fly home, land."""
        assert self.home_m is not None
        offset_m = self.home_m - self.estimated_position_m
        height_m = float(offset_m[2])
        if math.hypot(offset_m[0], offset_m[1]) < 1.0:
            command = self._toward(self.home_m)
            near = height_m < SLOW_DESCENT_BELOW_M
            command[2] = self.parameters["MPC_LAND_SPEED" if near else "MPC_Z_VEL_MAX_DN"]
            return command
        return_height_m = self.parameters["RTL_RETURN_ALT"]
        if height_m < return_height_m - ARRIVED_M:
            command = self._hold()
            command[2] = -min(return_height_m - height_m, self.parameters["MPC_Z_VEL_MAX_UP"])
            return command
        command = self._toward(self.home_m)
        command[2] = 0.0
        return command

    def _toward(self, target_m: F64) -> F64:
        error_m = target_m - self.estimated_position_m
        command = np.empty(3)
        command[:2] = _shorten(
            self.parameters["MPC_XY_P"] * error_m[:2], self.parameters["MPC_XY_CRUISE"]
        )
        command[2] = self.parameters["MPC_Z_P"] * error_m[2]
        return command

    # Ground

    def _watch_ground(self) -> None:
        if self.position_m[2] < 0.0:
            self._on_ground_since_s = math.inf
            self._took_off = self._took_off or self.armed
            self.landed = False
            return
        if self._lift_began_s is not None and self.armed:
            return
        self._on_ground_since_s = min(self._on_ground_since_s, self.time_s)
        on_ground_s = self.time_s - self._on_ground_since_s
        if not self.landed and on_ground_s >= LANDED_AFTER_S:
            self.landed = True
            self._say("Landing detected")
        if self.armed and self.landed:
            self._disarm_when_idle(on_ground_s - LANDED_AFTER_S)

    def _disarm_when_idle(self, landed_s: float) -> None:
        parameters = self.parameters
        armed_s = self.time_s - self._armed_at_s
        after_landing = 0.0 < parameters["COM_DISARM_LAND"] <= landed_s
        preflight_s = parameters["COM_DISARM_PRFLT"]
        if (self._took_off and after_landing) or (
            not self._took_off and 0.0 < preflight_s <= armed_s - parameters["COM_SPOOLUP_TIME"]
        ):
            self.disarm()

    def _record_truth(self) -> None:
        north_m, east_m, down_m = self.position_m.tolist()
        v_north, v_east, v_down = self.velocity_m_s.tolist()
        self.truth.append(
            Truth(
                self.time_s,
                (north_m, east_m, down_m),
                (v_north, v_east, v_down),
                self.mode,
                self.armed,
                self.landed,
            )
        )


def _shorten(vector: F64, length: float) -> F64:
    norm = math.sqrt(float(vector @ vector))
    return vector if norm <= length else vector * (length / norm)
