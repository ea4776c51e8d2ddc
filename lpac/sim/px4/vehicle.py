"""A PX4-like multicopter: modes, refusals, failsafes and flight; no socket and no clock.

World frame: north, east, down from `WorldOrigin`, m; the ground is at down = 0. The estimated
position has a GPS bias and slow noise, and with `Errors` many more errors. The local frame starts
at the estimator's origin, which differs from the launch point in the plane and in height.

Times of estimator, checks and failsafes are those measured with a real PX4 v1.17, on its own clock:
tests/sim/sim/test_px4_recordings.py compares them.
"""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, NamedTuple

import numpy as np

from edge.core import F64
from edge.core.vehicle import Vector
from lpac.sim.px4 import checks
from lpac.sim.px4.checks import (
    ArmingProblem,
    Component,
    HealthReport,
    HealthReporter,
    Level,
    Px4Event,
)
from lpac.sim.px4.errors import GPS_VERTICAL, Errors, draw_bias_m
from lpac.sim.px4.estimator import NOISE_M, Estimator
from lpac.sim.px4.failsafe import Failsafe
from lpac.sim.px4.modes import (
    ACTION_MODES,
    CAN_LEAVE_GROUND,
    CUSTOM_MODES,
    FENCE_ACTIONS,
    LINK_LOSS_ACTIONS,
    NEED_POSITION,
    OFFBOARD_LOSS_ACTIONS,
    PILOTED,
    PREVENT_ARMING,
    FailsafeAction,
    FailsafeCause,
    MavResult,
    Px4Mode,
)
from lpac.sim.px4.parameters import PARAMETERS
from lpac.sim.px4.receiver import Receiver
from lpac.sim.px4.vector import ZERO, Draws, level, minus, plus, times, total, vector
from lpac.sim.px4.wire import MavlinkWire
from lpac.sim.px4.world import FencePolygon, WorldOrigin

GRAVITY_M_S2 = 9.81
# Full thrust, and drag on a sinking vehicle, as in PX4's own simulator.
GREATEST_LIFT_M_S2, SINKING_DRAG_PER_S = 20.0, 1.0
# Acceleration per uncompensated wind, 1/s, and the time constant of its compensation.
DRAG_PER_S = 0.3
WIND_COMPENSATION_S = 5.0
CHECKS_PERIOD_S = 0.1
SENSOR_TIMEOUT_S = 1.0
BATTERY_TIMEOUT_S = 5.0
# Times after disarming at which the log ends and the estimator detects rest; time after arming at
# which it detects motion.
LOG_ENDS_S = 3.4
AT_REST_AFTER_S = 2.3
MOVES_AFTER_S = 0.5
VERTICAL_DRIFT_M_S = 0.04
VERTICAL_DRIFT_TIME_S = 20.0
YAW_RATE_RAD_S = 1.0
LANDED_AFTER_S = 1.0
IN_AIR_AFTER_S = 0.9
STOPPED_M_S = 0.5
ARRIVED_M = 0.3
# Height from which on the estimated velocity has its full error.
_ERRS_FROM_M = 1.0
SLOW_DESCENT_BELOW_M = 5.0
TRUTH_PERIOD_S = 0.04
# Voltage of four empty cells, and its rise to full; current of the motors, and of all else.
EMPTY_V, FULL_ABOVE_EMPTY_V = 14.0, 2.8
HOVER_A, IDLE_A = 12.0, 0.5
# The battery's resistance as PX4 assumes it.
ASSUMED_OHM = 0.02
# Accuracy and satellites of the receiver in PX4's own simulator.
GPS_ACCURACY_M, GPS_ACCURACY_M_S, GPS_SATELLITES = (0.9, 1.78), 0.4, 10
# Real receivers never repeat a position exactly.
FIX_NOISE_M, FIX_NOISE_RAD_S = 0.02, (7.3, 9.1, 5.7)
# Age of a fix when it is sent.
GPS_LAG_S = 0.1


@dataclass(frozen=True, slots=True)
class Airframe:
    """Dynamics of the vehicle.

    `offboard_velocity_lag_s` is for pure velocity setpoints: 1 m/s for 10 s covers 8.7 m, as
    measured. PX4's own modes also feed the acceleration forward and respond within `lag_s`.
    """

    lag_s: float = 0.3
    offboard_velocity_lag_s: float = 1.3
    max_airspeed_m_s: float = 15.0
    endurance_s: float = 1200.0


@dataclass(frozen=True, slots=True)
class Px4Setpoint:
    """An offboard setpoint in the local frame; NaN where an axis is not commanded.

    North, east, down. yaw_rad: NaN keeps the heading.
    """

    position_m: Vector
    velocity_m_s: Vector
    yaw_rad: float = math.nan


class SimulatedSensor(StrEnum):
    """Sensor whose hardware or driver can fail."""

    GPS = "gps"
    BAROMETER = "barometer"
    COMPASS = "compass"
    BATTERY = "battery"


_ALWAYS_PRESENT = (
    Component.BAROMETER, Component.BATTERY, Component.LOCAL_POSITION_ESTIMATE, Component.COMPASS,
    Component.ACCELEROMETER, Component.GYROSCOPE,
)  # fmt: skip
_ARMED_BY, _DISARMED_BY = 9489139, 16017271
_BY_COMMAND, _BY_LANDING, _BEFORE_FLIGHT, _BY_FAILSAFE = 4, 6, 7, 14
_ARMING_DENIED, _DISARMING_DENIED = 133277, 9091509
_TAKEOFF_DETECTED, _LANDING_DETECTED, _LANDING_ORDERED = 4277609, 9844908, 3322590
_FUSION_STOPPED, _FUSION_STARTED = 14699175, 15292483
# Event numbers with a cause, and without.
_FAILSAFE_ACTS, _FAILSAFE_HOLDS, _FAILSAFE_WARNS = (
    (9751178, 14605264),
    (13704694, 4502496),
    (8557551, 13277401),
)
_POSITION_FAILSAFE, _TAKEN_OVER = 12770418, 961599
_BATTERY_WARNINGS = {2: 12216659, 3: 2474944, 4: 51327}
# PX4's numbers of actions and causes, in events.
_ACTIONS = {
    FailsafeAction.POSCTL: 2,
    FailsafeAction.HOLD: 5,
    FailsafeAction.RETURN: 6,
    FailsafeAction.LAND: 7,
    FailsafeAction.DESCEND: 8,
    FailsafeAction.STOP_MOTORS: 10,
}
# Looking up an enum member takes ten times as long, and this one is used 400 times a second.
_NONE = FailsafeAction.NONE
_CAUSES = {FailsafeCause.MANUAL_CONTROL_LOST: 1, FailsafeCause.GROUND_STATION_LOST: 2}


class Truth(NamedTuple):
    """True state at one time: world frame, m and m/s.

    `setpoint_at_s` is the time of the last setpoint, -inf before the first, and `follows` its kind:
    a stop is a horizontal velocity of zero. `velocity_error_m_s` is the error of the estimated
    horizontal velocity, and `commands` the number of commands received.
    """

    time_s: float
    position_m: Vector
    velocity_m_s: Vector
    mode: Px4Mode
    armed: bool
    landed: bool
    setpoint_at_s: float = -math.inf
    follows: Literal["position", "velocity", "stop"] | None = None
    velocity_error_m_s: float = 0.0
    commands: int = 0


class Px4Vehicle:
    """One vehicle; deterministic for a seed, its steps and its commands.

    Fields that may be set at any time: `parameters`, `wind_m_s`, `gust_m_s` (standard deviation),
    `gps_bias_m`, `gps_lost` (the receiver runs, without satellites), `gps_jump_m` (sudden error of
    the fix, which the estimator may reject or follow, as the other faults of its `receiver`),
    `gps_offset_m` and `gps_drift_m_s` (error that fix and estimate share, and its unbounded rate),
    `compass_jump_rad`, `gps_accuracy_override_m` (reported instead of the receiver's own accuracy),
    `estimate_frozen` (old position and velocity are sent on), `dead_sensors` (their drivers are
    silent), `battery_remaining` (0 to 1), `rc_connected`, `motor_loss` (share of thrust lost in
    flight: above 0.51 the vehicle sinks), `wire` (faults of its messages). `thrust` is the
    commanded share of full thrust. `truth` grows by one entry every 0.04 s.
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
        errors: Errors | None = None,
    ) -> None:
        """`start_m` is north and east. Checks pass `ready_after_s` after the start.

        It is drawn from 3 to 6 s unless given. The GPS bias, 1 to 5 m horizontally, and the
        estimator's origin are always drawn. Without `errors` the bias is constant, the compass is
        exact, there is no wind and the voltage does not sag.
        """
        rng = np.random.default_rng(seed)
        self._world = origin or WorldOrigin()
        self._airframe = airframe or Airframe()
        drawn_ready_s = float(rng.uniform(3.0, 6.0))
        bearing_rad, share = rng.uniform(0.0, math.tau), rng.uniform()
        self.gps_bias_m = vector(
            np.array([*draw_bias_m(share, bearing_rad), rng.uniform(-1.5, 1.5)])
        )
        self._errors = errors
        self._walk_m = self._velocity_error_m_s = ZERO
        self._compass_rad = self.compass_jump_rad = self.motor_loss = self.thrust = 0.0
        self.parameters: dict[str, int | float] = dict(PARAMETERS)
        self.fence: tuple[FencePolygon, ...] = ()
        self.truth: list[Truth] = []

        self.time_s, self.commands, self.wire = 0.0, 0, MavlinkWire()
        self._position_m: Vector = (*start_m, 0.0)
        self._velocity_m_s = self.acceleration_m_s2 = ZERO
        self.heading_rad, self.yaw_rate_rad_s = heading_rad, 0.0

        self.wind_m_s = self._gust_m_s = self._air_m_s = self._compensated_wind_m_s = ZERO
        self.battery_remaining, self._battery_warning = 1.0, 1

        self.gps_lost = self.estimate_frozen = False
        self.gps_jump_m = self.gps_offset_m = self.gps_drift_m_s = ZERO
        self.gps_accuracy_override_m: float | None = None
        self.receiver = Receiver()
        self._frozen: tuple[Vector, Vector] | None = None
        self.dead_sensors: set[SimulatedSensor] = set()
        self._dead_since_s: dict[SimulatedSensor, float] = {}
        self.estimator = Estimator(
            drawn_ready_s if ready_after_s is None else ready_after_s,
            vector(rng.standard_normal(3) * NOISE_M),
        )
        self._vertical_drift_m_s = self.gust_m_s = 0.0
        self.estimator_origin_m = vector(
            self.estimated_position_m + rng.normal(0.0, (1.0, 1.0, 0.5))
        )
        self._draws = Draws(rng)

        self.armed = self._took_off = False
        self.mode = self.intended_mode = self._mode_after_disarm = Px4Mode.HOLD
        self._mode_commands = 0
        self.landed = True
        self.home_m: Vector | None = None
        self._armed_at_s = 0.0
        self._lift_began_s: float | None = None
        self._on_ground_since_s, self._off_ground_since_s = -math.inf, math.inf
        self._takeoff_down_m = 0.0
        self._hold_m: Vector | None = None

        self._setpoint: Px4Setpoint | None = None
        self._setpoint_at_s = -math.inf
        self.rc_connected = self._rc_at_arming = self._outside_fence = False
        self._sticks_m_s = ZERO
        self._ground_station_at_s = -math.inf
        self._fence_latch = -1
        self.failsafe = Failsafe()
        self._disarmed_at_s: float | None = None
        self._reporter = HealthReporter()
        self._events: list[Px4Event] = []

    @property
    def position_m(self) -> F64:
        """(3,), world frame: true position. It may be set."""
        return np.array(self._position_m)

    @position_m.setter
    def position_m(self, position_m: F64) -> None:
        self._position_m = vector(position_m)

    @property
    def velocity_m_s(self) -> F64:
        """(3,), world frame: true velocity."""
        return np.array(self._velocity_m_s)

    @property
    def estimated_position_m(self) -> F64:
        """(3,), world frame: estimated position."""
        return np.array(self.estimate_m())

    def estimate_m(self) -> Vector:
        """Estimated position as plain floats."""
        if self._frozen is not None:
            return self._frozen[0]
        return total(self._position_m, self._shared_error_m(), self.estimator.error_m)

    def estimate_m_s(self) -> Vector:
        """Estimated velocity as plain floats."""
        if self._frozen is not None:
            return self._frozen[1]
        return plus(self._velocity_m_s, self._velocity_error_m_s)

    @property
    def estimated_heading_rad(self) -> float:
        """Estimated heading, rad."""
        return self.heading_rad + self._compass_rad

    @property
    def local_position_m(self) -> F64:
        """(3,): estimated position from the estimator's origin, north, east, down."""
        return self.estimated_position_m - self.estimator_origin_m

    @property
    def global_position(self) -> tuple[float, float, float]:
        """Estimated latitude and longitude, deg, and height above mean sea level, m."""
        return self._world.to_global(self.estimate_m())

    @property
    def global_fix(self) -> tuple[float, float, float]:
        """The receiver's position: latitude and longitude, deg, and height, m.

        It has the error of the estimate, which follows it, plus noise, and it is late.
        """
        return self._world.to_global(self.receiver.place_m(self._faultless_fix_m()))

    @property
    def fix_velocity_m_s(self) -> Vector:
        """World frame: the receiver's velocity."""
        return self.receiver.velocity_m_s(self._velocity_m_s)

    def _faultless_fix_m(self) -> Vector:
        noise_m: Sequence[float] = [
            FIX_NOISE_M * math.sin(self.time_s * rate_rad_s) for rate_rad_s in FIX_NOISE_RAD_S
        ]
        if self._errors is not None:
            noise_m = plus(noise_m, self._errors.fix_m(self.time_s))
        late_m = minus(self._position_m, times(self._velocity_m_s, GPS_LAG_S))
        faultless_m = plus(late_m, self._shared_error_m())
        return total(faultless_m, self.gps_jump_m, noise_m)

    def _shared_error_m(self) -> Vector:
        """Error that fix and estimate have in common."""
        return total(self.gps_bias_m, self._walk_m, self.gps_offset_m)

    @property
    def gps_accuracy_m(self) -> tuple[float, float, float]:
        """The receiver's own accuracy: horizontally and vertically, m, and m/s."""
        accuracy_m = GPS_ACCURACY_M
        if self._errors is not None:
            accuracy_m = self._errors.gps_accuracy_m(self.time_s)
        if self.gps_accuracy_override_m is not None:
            accuracy_m = self.gps_accuracy_override_m, GPS_VERTICAL * self.gps_accuracy_override_m
        return *accuracy_m, GPS_ACCURACY_M_S

    @property
    def gps_satellites(self) -> int:
        """Number of satellites, while the receiver has a fix."""
        return GPS_SATELLITES if self._errors is None else self._errors.satellites(self.time_s)

    @property
    def global_origin(self) -> tuple[float, float, float]:
        """The estimator's origin: latitude and longitude, deg, height above mean sea level, m."""
        return self._world.to_global(self.estimator_origin_m)

    @property
    def global_home(self) -> tuple[float, float, float] | None:
        """Home as latitude, longitude, deg, and height, m; None if not set."""
        return None if self.home_m is None else self._world.to_global(self.home_m)

    @property
    def position_valid(self) -> bool:
        """Whether the estimated position is valid."""
        return self.estimator.position_valid

    def silent_s(self, sensor: SimulatedSensor) -> float:
        """Time since a sensor's driver died, s; below 0 while it runs."""
        return self.time_s - self._dead_since_s.get(sensor, math.inf)

    @property
    def at_rest(self) -> bool:
        """Whether the estimator detects that the vehicle is at rest."""
        if self.armed:
            return self.time_s - self._armed_at_s < MOVES_AFTER_S
        return self._disarmed_at_s is None or self.time_s - self._disarmed_at_s > AT_REST_AFTER_S

    @property
    def health(self) -> HealthReport | None:
        """Problems in PX4's last report; None in the first seconds."""
        return self._reporter.published

    @property
    def current_a(self) -> float:
        """Current of the battery, A."""
        loss = 0.0 if self._errors is None else self._errors.thrust_loss
        return IDLE_A + (HOVER_A * (1.0 + loss) if self.armed and not self.landed else 0.0)

    @property
    def voltage_v(self) -> float:
        """Voltage of the whole battery under load, V."""
        sag_v = 0.0 if self._errors is None else self.current_a * self._errors.resistance_ohm
        return EMPTY_V + FULL_ABOVE_EMPTY_V * self.battery_remaining - sag_v

    @property
    def battery_reported(self) -> float:
        """PX4's estimate of the charge, 0 to 1; too low if the voltage sags more than assumed."""
        if self._errors is None:
            return self.battery_remaining
        unknown_v = self.current_a * (self._errors.resistance_ohm - ASSUMED_OHM)
        return max(0.0, self.battery_remaining - unknown_v / FULL_ABOVE_EMPTY_V)

    @property
    def rc_received(self) -> bool:
        """Whether a remote control is received, and enabled."""
        is_stale = self._errors is not None and self._errors.is_remote_control_stale(self.time_s)
        return self.rc_connected and not is_stale and not self._no_manual_control

    @property
    def _no_manual_control(self) -> bool:
        return int(self.parameters["COM_RC_IN_MODE"]) == 4

    @property
    def battery_warning(self) -> int:
        """MAV_BATTERY_CHARGE_STATE: 1 is ok, 2 low, 3 critical, 4 emergency."""
        charge, parameters = self.battery_reported, self.parameters
        if charge >= parameters["BAT_LOW_THR"]:
            return 1
        return 2 + (charge < parameters["BAT_CRIT_THR"]) + (charge < parameters["BAT_EMERGEN_THR"])

    @property
    def armable(self) -> bool:
        """Whether the arming checks pass in the current mode."""
        return self._checks().can_arm(self.mode)

    def take_events(self) -> list[Px4Event]:
        """Events since the last call."""
        events, self._events = self._events, []
        return events

    def _emit(self, number: int, level: Level, text: str = "", arguments: bytes = b"") -> None:
        self._events.append(Px4Event(number, level, arguments, text, level))

    def arm(self, *, force: bool = False) -> MavResult:
        """Arm; TEMPORARILY_REJECTED if a check fails. Clients cannot set `force`."""
        if self.armed:
            return MavResult.ACCEPTED
        self._run_checks()
        if not (force or self._reporter.newest.can_arm(self.mode)):
            text = "Arming denied: Resolve system health failures first\t"
            self._emit(_ARMING_DENIED, Level.CRITICAL, text)
            return MavResult.TEMPORARILY_REJECTED
        self.armed = True
        self._armed_at_s = self.time_s
        self._took_off = False
        self._lift_began_s = None
        self._rc_at_arming = self.rc_connected
        self.failsafe.reset()
        self.home_m = self.estimate_m()
        text = "Armed by external command\t"
        self._emit(_ARMED_BY, Level.INFO, text, bytes([_BY_COMMAND]))
        return MavResult.ACCEPTED

    def disarm(self, *, force: bool = False, reason: int = _BY_COMMAND) -> MavResult:
        """Disarm; TEMPORARILY_REJECTED in the air without `force`, with which the vehicle falls."""
        if not self.armed:
            return MavResult.ACCEPTED
        if not self.landed and not force:
            self._emit(_DISARMING_DENIED, Level.CRITICAL, "Disarming denied: not landed\t")
            return MavResult.TEMPORARILY_REJECTED
        self.armed = False
        self._disarmed_at_s = self.time_s
        self.failsafe.reset()
        self._set_intended_mode(self._mode_after_disarm)
        self.mode = self.intended_mode
        self._emit(_DISARMED_BY, Level.INFO, "Disarmed\t", bytes([reason]))
        return MavResult.ACCEPTED

    def set_mode(self, mode: Px4Mode) -> MavResult:
        """Command a mode, which is set in the next step.

        TEMPORARILY_REJECTED while armed, if a requirement of the mode is missing. LAND is always
        accepted: without a position the vehicle descends.
        """
        if self.armed and mode is not Px4Mode.LAND:
            self._run_checks()
            if not self._reporter.newest.can_run(mode):
                return MavResult.TEMPORARILY_REJECTED
        if mode is Px4Mode.TAKEOFF:
            self._takeoff_down_m = self._home_down_m() - self.parameters["MIS_TAKEOFF_ALT"]
        if mode is Px4Mode.LAND:
            self._emit(_LANDING_ORDERED, Level.INFO, "Landing at current position\t")
        if self.failsafe.take_over():
            self._emit(_TAKEN_OVER, Level.INFO)
        self._set_intended_mode(mode)
        return MavResult.ACCEPTED

    def run_prearm_checks(self) -> MavResult:
        """Run the arming checks and report all problems."""
        self._run_checks(on_request=True)
        return MavResult.ACCEPTED

    def take_off(self, altitude_m: float) -> MavResult:
        """Climb to a height above mean sea level, m; NaN takes MIS_TAKEOFF_ALT above home."""
        result = self.set_mode(Px4Mode.TAKEOFF)
        if result is MavResult.ACCEPTED and not math.isnan(altitude_m):
            self._takeoff_down_m = self._world.altitude_m - altitude_m
        return result

    def offboard(self, setpoint: Px4Setpoint) -> None:
        """Receive a setpoint of the stream that OFFBOARD needs."""
        self._setpoint, self._setpoint_at_s = setpoint, self.time_s

    def ground_station_heartbeat(self) -> None:
        """Receive a ground station's heartbeat."""
        self._ground_station_at_s = self.time_s

    def pilot(
        self, mode: Px4Mode = Px4Mode.POSCTL, stick_velocity_m_s: Sequence[float] = ()
    ) -> MavResult:
        """Switch the remote control on, with this mode and these sticks.

        `stick_velocity_m_s` is north, east, down; empty means centred.
        """
        self.rc_connected = True
        result = self.set_mode(mode)
        self.move_sticks(stick_velocity_m_s)
        return result

    def move_sticks(self, velocity_m_s: Sequence[float]) -> None:
        """Move the sticks; they take over the vehicle only if COM_RC_OVERRIDE allows it."""
        north, east, down = velocity_m_s or ZERO
        self._sticks_m_s = north, east, down
        if self.mode in PILOTED:
            # Hold the position at which the sticks are released now, not an earlier one.
            self._hold_m = None
        bit = 2 if self.mode is Px4Mode.OFFBOARD else 1
        override = int(self.parameters["COM_RC_OVERRIDE"]) & bit
        if self.mode not in PILOTED and override and self.rc_received and any(self._sticks_m_s):
            self.set_mode(Px4Mode.POSCTL)

    def jump_estimator_origin(self, north_m: float, east_m: float, down_m: float = 0.0) -> None:
        """Reset the estimator to another origin: local positions jump, global ones stay."""
        self.estimator_origin_m = plus(self.estimator_origin_m, (north_m, east_m, down_m))

    def step(self, dt_s: float) -> None:
        """Advance by one step; 0.02 s suits the model."""
        if not self.estimate_frozen:
            self._frozen = None
        elif self._frozen is None:
            self._frozen = self.estimate_m(), self.estimate_m_s()
        self.time_s += dt_s
        if self.dead_sensors or self._dead_since_s:
            self._watch_sensors()
        self._estimate(dt_s)
        if self.gps_drift_m_s != ZERO:
            self.gps_offset_m = plus(self.gps_offset_m, times(self.gps_drift_m_s, dt_s))
        self._air_m_s = plus(self.wind_m_s, self._gust_m_s)
        self._velocity_error_m_s = self.estimator.velocity_error_m_s
        if self._errors is not None:
            errs_m = self._errors.position_m(self.time_s, self.gps_bias_m)
            self._walk_m = minus(errs_m, self.gps_bias_m)
            self._compass_rad = self._errors.heading_rad(self.time_s) + self.compass_jump_rad
            self._air_m_s = plus(self._air_m_s, self._errors.wind_m_s(self.time_s))
            lifted = min(-self._position_m[2] / _ERRS_FROM_M, 1.0)
            # On the ground PX4 knows that it does not move.
            if lifted > 0.0:
                errors_m_s = times(self._errors.velocity_m_s(self.time_s), lifted)
                self._velocity_error_m_s = plus(self._velocity_error_m_s, errors_m_s)
        if self.home_m is None and self.estimator.has_attitude and self.estimator.has_gps:
            self.home_m = self.estimate_m()
        if self.armed:
            drain = 1.0 if self._errors is None else self._errors.drain
            drained = drain * self.current_a / (IDLE_A + HOVER_A) * dt_s
            self.battery_remaining = max(
                0.0, self.battery_remaining - drained / self._airframe.endurance_s
            )
            self._apply_failsafes()
        else:
            self._enter(self.intended_mode)
        if self.time_s - self._reporter.checked_at_s >= CHECKS_PERIOD_S - 1e-9:
            self._run_checks()
        self._move(dt_s)
        self._watch_ground()
        if not self.truth or self.time_s - self.truth[-1].time_s >= TRUTH_PERIOD_S - 1e-9:
            self._record_truth()

    def _estimate(self, dt_s: float) -> None:
        draws = self._draws.take(10)
        has_gps = not self.gps_lost and SimulatedSensor.GPS not in self.dead_sensors
        has_gps = has_gps and bool(self.parameters["EKF2_GPS_CTRL"])
        self.receiver.step(dt_s, self._faultless_fix_m, self._draws)
        off_m, off_m_s = self.gps_jump_m, ZERO
        if self.receiver.faulty:
            faultless_m = plus(self._position_m, self._shared_error_m())
            off_m = plus(off_m, self.receiver.off_m(faultless_m))
            off_m_s = self.receiver.off_m_s(self._velocity_m_s)
        self.estimator.step(self.time_s, dt_s, has_gps, off_m, off_m_s, draws[:6])
        decay = dt_s / VERTICAL_DRIFT_TIME_S
        grows_m_s = VERTICAL_DRIFT_M_S * draws[6] * math.sqrt(2.0 * decay)
        self._vertical_drift_m_s += -self._vertical_drift_m_s * decay + grows_m_s
        if self.gust_m_s or self._gust_m_s != ZERO:
            decay = dt_s / WIND_COMPENSATION_S
            pushes_m_s = times(times(draws[7:10], self.gust_m_s), math.sqrt(2.0 * decay))
            self._gust_m_s = plus(times(self._gust_m_s, 1.0 - decay), pushes_m_s)

    def _watch_sensors(self) -> None:
        self._dead_since_s = {
            sensor: self._dead_since_s.get(sensor, self.time_s) for sensor in self.dead_sensors
        }

    def _run_checks(self, *, on_request: bool = False) -> None:
        used_gps = Component.GPS in self._reporter.newest.present
        self._events += self._reporter.update(self._checks(), self.time_s, on_request=on_request)
        if not self.armed and not self.estimator.has_gps and not self.estimator.position_valid:
            self.home_m = None
        uses_gps = self.estimator.uses_gps
        if self.armed and uses_gps is not used_gps:
            number = _FUSION_STARTED if uses_gps else _FUSION_STOPPED
            text = f"GNSS data fusion {'started' if uses_gps else 'stopped'}\t"
            self._emit(number, Level.INFO, text)

    def _checks(self) -> HealthReport:
        """All current problems, in PX4's order."""
        parameters = self.parameters
        rc_received, ground_station_lost = self.rc_received, self._ground_station_lost()
        position_valid = self.estimator.position_valid
        present = set(_ALWAYS_PRESENT)
        if self.estimator.uses_gps:
            present.add(Component.GPS)
        if (
            self.armed
            or self._disarmed_at_s is None
            or self.time_s - self._disarmed_at_s < LOG_ENDS_S
        ):
            present.add(Component.LOGGING)
        if rc_received:
            present.add(Component.REMOTE_CONTROL)
        if not ground_station_lost:
            present.add(Component.COMMUNICATION_LINKS)
        required = int(parameters["NAV_DLL_ACT"]) > 0
        # In flight the battery warning never decreases.
        self._battery_warning = max(
            self.battery_warning, self._battery_warning if self.armed else 1
        )
        battery = (None, checks.BATTERY_LOW, checks.BATTERY_CRITICAL, checks.BATTERY_EMERGENCY)
        found = (
            (self.silent_s(SimulatedSensor.BAROMETER) > SENSOR_TIMEOUT_S, checks.NO_BAROMETER),
            (self.silent_s(SimulatedSensor.COMPASS) > SENSOR_TIMEOUT_S, checks.NO_COMPASS),
            (not self.estimator.has_gps and not self.armed, checks.GPS_FIX_TOO_LOW),
            (self.mode in PREVENT_ARMING and not self.armed, checks.MODE_PREVENTS_ARMING),
            (not self.estimator.has_attitude, checks.NO_ATTITUDE),
            (not position_valid, checks.NO_LOCAL_POSITION),
            (not position_valid, checks.NO_GLOBAL_POSITION),
            (True, checks.NO_MISSION),
            (not self._offboard_signal(), checks.NO_OFFBOARD_SIGNAL),
            (self.home_m is None and self.estimator.is_ready, checks.NO_HOME),
            (
                not rc_received,
                checks.MANUAL_CONTROL_DISABLED
                if self._no_manual_control
                else checks.NO_MANUAL_CONTROL,
            ),
            (True, battery[self._battery_warning - 1]),
            (self.silent_s(SimulatedSensor.BATTERY) > BATTERY_TIMEOUT_S, checks.BATTERY_SILENT),
            (parameters["GF_ACTION"] > 0 and self._is_outside_fence(), checks.FENCE_BREACHED),
            (
                ground_station_lost,
                checks.GROUND_STATION_REQUIRED if required else checks.NO_GROUND_STATION,
            ),
        )
        problems: list[ArmingProblem] = [p for is_so, p in found if is_so and p is not None]
        return HealthReport(tuple(problems), frozenset(present))

    def _offboard_signal(self) -> bool:
        """Whether setpoints are fresh, and the position to follow them is valid."""
        fresh = self.time_s - self._setpoint_at_s <= self.parameters["COM_OF_LOSS_T"]
        return fresh and self.estimator.position_valid

    def _ground_station_lost(self) -> bool:
        return self.time_s - self._ground_station_at_s > self.parameters["COM_DL_LOSS_T"]

    def _set_intended_mode(self, mode: Px4Mode) -> None:
        self._mode_commands += 1
        self.intended_mode = mode
        if mode not in PREVENT_ARMING and mode is not Px4Mode.TAKEOFF:
            self._mode_after_disarm = mode

    def _enter(self, mode: Px4Mode) -> None:
        if mode is not self.mode:
            self.mode = mode
            self._hold_m = None

    def _apply_failsafes(self) -> None:
        # In the order of `FailsafeCause`.
        wanted = (
            self._on_offboard_loss(), self._on_manual_control_loss(),
            self._on_ground_station_loss(), self._on_battery(), self._on_silent_battery(),
            self._on_geofence(), self._on_position_loss(),
        )  # fmt: skip
        if not any(wanted):
            self.failsafe.end()
            self._enter(self.intended_mode)
            return
        causes = dict(zip(FailsafeCause, wanted, strict=True))
        before = self.failsafe.action
        cause = self.failsafe.decide(
            causes,
            self.time_s,
            self.parameters["COM_FAIL_ACT_T"],
            intended_mode=self.intended_mode,
            position_valid=self.estimator.position_valid,
        )
        action = self.failsafe.action
        if action > before:
            self._report_failsafe(cause, causes[cause], action)
        if action is FailsafeAction.STOP_MOTORS:
            self.disarm(force=True, reason=_BY_FAILSAFE)
            return
        self._enter(ACTION_MODES.get(action, self.intended_mode))

    def _report_failsafe(
        self, cause: FailsafeCause, wanted: FailsafeAction, action: FailsafeAction
    ) -> None:
        self._run_checks()
        self._events += self._reporter.before_failsafe(self.time_s)
        main, sub = CUSTOM_MODES[self.intended_mode]
        mode = struct.pack("<I", main << 16 | sub << 24)
        is_battery = cause is FailsafeCause.BATTERY
        number = self.battery_warning + 1 if is_battery else _CAUSES.get(cause, 0)
        generic, cause_bytes = not number, bytes([number] if number else [])
        if action is FailsafeAction.WARN and is_battery:
            level = Level.WARNING if self.battery_warning == 2 else Level.CRITICAL
            self._emit(_BATTERY_WARNINGS[self.battery_warning], level)
        elif action is FailsafeAction.WARN:
            self._emit(_FAILSAFE_WARNS[generic], Level.WARNING, arguments=mode + cause_bytes)
        elif action is FailsafeAction.HOLD and wanted is not FailsafeAction.HOLD:
            wait_s = round(self.parameters["COM_FAIL_ACT_T"])
            text = f"Failsafe activated: entering Hold for {wait_s} seconds\t"
            arguments = mode + struct.pack("<BH", _ACTIONS[wanted], wait_s) + cause_bytes
            self._emit(_FAILSAFE_HOLDS[generic], Level.CRITICAL, text, arguments)
        else:
            event = (
                _FAILSAFE_ACTS[generic]
                if action is not FailsafeAction.DESCEND
                else _POSITION_FAILSAFE
            )
            arguments = mode + bytes([_ACTIONS[action]]) + cause_bytes
            self._emit(event, Level.CRITICAL, "Failsafe activated\t", arguments)

    def _on_offboard_loss(self) -> FailsafeAction:
        if self.intended_mode is not Px4Mode.OFFBOARD or self._offboard_signal():
            return _NONE
        if not self.estimator.position_valid:
            return FailsafeAction.DESCEND
        setting = int(self.parameters["COM_OBL_RC_ACT"])
        if setting in OFFBOARD_LOSS_ACTIONS:
            return OFFBOARD_LOSS_ACTIONS[setting]
        if self.rc_received:
            return FailsafeAction.POSCTL
        return LINK_LOSS_ACTIONS.get(int(self.parameters["NAV_RCL_ACT"]), _NONE)

    def _on_manual_control_loss(self) -> FailsafeAction:
        if not self._rc_at_arming or self.rc_received or self._no_manual_control:
            return _NONE
        excepted = {Px4Mode.HOLD: 2, Px4Mode.OFFBOARD: 4}.get(self.intended_mode, 0)
        if int(self.parameters["COM_RCL_EXCEPT"]) & excepted:
            return _NONE
        return LINK_LOSS_ACTIONS.get(int(self.parameters["NAV_RCL_ACT"]), _NONE)

    def _on_ground_station_loss(self) -> FailsafeAction:
        if not self._ground_station_lost():
            return _NONE
        return LINK_LOSS_ACTIONS.get(int(self.parameters["NAV_DLL_ACT"]), _NONE)

    def _on_battery(self) -> FailsafeAction:
        warning = self.battery_warning
        if warning == 1:
            return _NONE
        setting = int(self.parameters["COM_LOW_BAT_ACT"])
        if warning == 2 or setting not in (2, 3):
            return FailsafeAction.WARN
        return FailsafeAction.RETURN if setting == 3 and warning == 3 else FailsafeAction.LAND

    def _on_silent_battery(self) -> FailsafeAction:
        is_silent = self.silent_s(SimulatedSensor.BATTERY) > BATTERY_TIMEOUT_S
        return FailsafeAction.WARN if is_silent else _NONE

    def _on_geofence(self) -> FailsafeAction:
        """A breach acts until a mode is commanded; after that, only at the next breach."""
        outside = self._is_outside_fence()
        if outside and not self._outside_fence:
            self._fence_latch = self._mode_commands
        self._outside_fence = outside
        if self._fence_latch != self._mode_commands:
            return _NONE
        return FENCE_ACTIONS.get(int(self.parameters["GF_ACTION"]), _NONE)

    def _is_outside_fence(self) -> bool:
        estimate_m = self.estimate_m()
        if self.home_m is not None:
            north_m, east_m, down_m = minus(estimate_m, self.home_m)
            radius_m = self.parameters["GF_MAX_HOR_DIST"]
            height_m = self.parameters["GF_MAX_VER_DIST"]
            if 0.0 < radius_m < math.hypot(north_m, east_m) or 0.0 < height_m < -down_m:
                return True
        north_m, east_m, _ = estimate_m
        for polygon in self.fence:
            if polygon.contains(self._world, north_m, east_m) != polygon.inclusion:
                return True
        return False

    def _on_position_loss(self) -> FailsafeAction:
        lost = self.intended_mode in NEED_POSITION and not self.estimator.position_valid
        return FailsafeAction.DESCEND if lost else _NONE

    def _home_down_m(self) -> float:
        home_m = self.estimate_m() if self.home_m is None else self.home_m
        return home_m[2]

    def _move(self, dt_s: float) -> None:
        if not self.armed:
            self.thrust = 0.0
            self._fall(dt_s)
            return
        command, yaw_rad, lag_s = self._command()
        to_north, to_east, to_down = self._limit(command)
        on_ground = self._position_m[2] >= 0.0
        if on_ground and to_down >= 0.0:
            to_north = to_east = to_down = 0.0
        parameters = self.parameters
        # A level vehicle is slowed by the air, whatever its estimated velocity.
        is_level = self.mode is Px4Mode.DESCEND
        error_m_s = ZERO if is_level else self._velocity_error_m_s
        v_north, v_east, v_down = plus(self._velocity_m_s, error_m_s)
        north, east = _shorten(
            (to_north - v_north) / lag_s, (to_east - v_east) / lag_s, parameters["MPC_ACC_HOR"]
        )
        if self._compass_rad:
            # With a wrong heading it accelerates in the wrong direction.
            cos, sin = math.cos(self._compass_rad), math.sin(self._compass_rad)
            north, east = cos * north + sin * east, cos * east - sin * north
        acceleration = north, east, self._lift(to_down, v_down)
        unmet_m_s = minus(self._air_m_s, self._compensated_wind_m_s)
        if not on_ground:
            # Its resistance to wind does not depend on the lag of its commands.
            pushed = times(unmet_m_s, DRAG_PER_S * self._airframe.lag_s / lag_s)
            acceleration = plus(acceleration, pushed)
        compensation_m_s = times(unmet_m_s, dt_s / WIND_COMPENSATION_S)
        self._compensated_wind_m_s = plus(self._compensated_wind_m_s, compensation_m_s)
        self.acceleration_m_s2 = acceleration
        self._velocity_m_s = plus(self._velocity_m_s, times(acceleration, dt_s))
        self._turn(yaw_rad, dt_s)
        self._advance(dt_s)

    def _lift(self, to_down: float, v_down: float) -> float:
        """The resulting downward acceleration; also sets the commanded thrust."""
        parameters = self.parameters
        built_in_loss = 0.0 if self._errors is None else self._errors.thrust_loss
        power = 1.0 - max(built_in_loss, self.motor_loss)
        wanted = min(
            max((to_down - v_down) / self._airframe.lag_s, -power * parameters["MPC_ACC_UP_MAX"]),
            parameters["MPC_ACC_DOWN_MAX"],
        )
        full_lift = power * GREATEST_LIFT_M_S2
        stands = self._position_m[2] >= 0.0 and self._lift_began_s is None
        wanted_lift = 0.0 if stands else GRAVITY_M_S2 - wanted
        self.thrust = min(wanted_lift / max(full_lift, 1e-9), 1.0)
        # With too little lift the vehicle sinks, against drag.
        return max(wanted, GRAVITY_M_S2 - full_lift - SINKING_DRAG_PER_S * max(v_down, 0.0))

    def _fall(self, dt_s: float) -> None:
        self.yaw_rate_rad_s = 0.0
        if self._position_m[2] >= 0.0:
            self._velocity_m_s = self.acceleration_m_s2 = ZERO
            return
        self.acceleration_m_s2 = (0.0, 0.0, GRAVITY_M_S2)
        self._velocity_m_s = plus(self._velocity_m_s, times(self.acceleration_m_s2, dt_s))
        self._advance(dt_s)

    def _advance(self, dt_s: float) -> None:
        self._position_m = plus(self._position_m, times(self._velocity_m_s, dt_s))
        if self._position_m[2] >= 0.0:
            self._position_m, self._velocity_m_s = level(self._position_m), ZERO

    def _turn(self, yaw_rad: float, dt_s: float) -> None:
        if math.isnan(yaw_rad):
            self.yaw_rate_rad_s = 0.0
            return
        error_rad = math.remainder(yaw_rad - self.estimated_heading_rad, math.tau)
        self.yaw_rate_rad_s = min(max(error_rad / dt_s, -YAW_RATE_RAD_S), YAW_RATE_RAD_S)
        self.heading_rad = (self.heading_rad + self.yaw_rate_rad_s * dt_s) % math.tau

    def _limit(self, command: Vector) -> Vector:
        """Limit a command by PX4's speed limits, the takeoff ramp, and the airspeed in wind."""
        parameters = self.parameters
        north, east = _shorten(command[0], command[1], parameters["MPC_XY_VEL_MAX"])
        wind_north, wind_east, _ = self._air_m_s
        north, east = _shorten(
            north - wind_north, east - wind_east, self._airframe.max_airspeed_m_s
        )
        down = max(command[2], -parameters["MPC_Z_VEL_MAX_UP"])
        down = down * self._ramp() if down < 0.0 else min(down, parameters["MPC_Z_VEL_MAX_DN"])
        if self._position_m[2] < 0.0:
            return north + wind_north, east + wind_east, down
        # The first command upwards after spool-up starts the ramp.
        spooled = self.time_s - self._armed_at_s >= parameters["COM_SPOOLUP_TIME"]
        if spooled and command[2] < -0.1 and self._lift_began_s is None:
            self._lift_began_s = self.time_s
        if command[2] >= -0.1:
            self._lift_began_s = None
        return 0.0, 0.0, down

    def _ramp(self) -> float:
        if self._lift_began_s is None:
            return 0.0 if self._position_m[2] >= 0.0 else 1.0
        ramp_s = self.parameters["MPC_TKO_RAMP_T"]
        return min(1.0, (self.time_s - self._lift_began_s) / ramp_s) if ramp_s > 0.0 else 1.0

    def _command(self) -> tuple[Vector, float, float]:
        """Velocity, world frame, m/s; yaw, rad or NaN; horizontal lag, s."""
        lag_s = self._airframe.lag_s
        if self.landed and self.mode not in CAN_LEAVE_GROUND:
            return ZERO, math.nan, lag_s
        wind_north, wind_east, _ = self._air_m_s
        if self.mode is Px4Mode.DESCEND:
            # A level vehicle drifts with the wind, as fast as drag allows.
            descent = wind_north, wind_east, self.parameters["MPC_LAND_SPEED"]
            return descent, math.nan, 1.0 / DRAG_PER_S
        if self.mode is Px4Mode.OFFBOARD and self._setpoint is not None:
            return self._follow(self._setpoint)
        if self.mode is Px4Mode.TAKEOFF:
            return self._climb(), math.nan, lag_s
        if self.mode is Px4Mode.LAND:
            return self._descend(), math.nan, lag_s
        if self.mode is Px4Mode.RETURN:
            return self._return(), math.nan, lag_s
        if self.mode in PILOTED and any(self._sticks_m_s):
            return self._sticks_m_s, math.nan, lag_s
        if self.mode in PILOTED and self.mode is not Px4Mode.POSCTL:
            return (wind_north, wind_east, 0.0), math.nan, lag_s
        return self._hold(), math.nan, lag_s

    def _follow(self, setpoint: Px4Setpoint) -> tuple[Vector, float, float]:
        parameters = self.parameters
        gain, gain_down = parameters["MPC_XY_P"], parameters["MPC_Z_P"]
        here_m = minus(self.estimate_m(), self.estimator_origin_m)
        off_north, off_east, off_down = minus(setpoint.position_m, here_m)
        to_north, to_east, to_down = setpoint.velocity_m_s
        north, east = _shorten(
            _axis(to_north, off_north, gain, 0.0),
            _axis(to_east, off_east, gain, 0.0),
            parameters["MPC_XY_VEL_MAX"],
        )
        down = _axis(to_down, off_down, gain_down, self._vertical_drift_m_s)
        airframe = self._airframe
        bare_velocity = math.isnan(off_north)
        lag_s = airframe.offboard_velocity_lag_s if bare_velocity else airframe.lag_s
        return (north, east, down), setpoint.yaw_rad, lag_s

    def _hold(self) -> Vector:
        """Brake, then hold the position of rest."""
        if self._hold_m is None:
            north, east, _ = plus(self._velocity_m_s, self._velocity_error_m_s)
            if math.hypot(north, east) > STOPPED_M_S:
                return ZERO
            self._hold_m = self.estimate_m()
        return self._toward(self._hold_m)

    def _climb(self) -> Vector:
        north, east, _ = self._hold()
        error_m = self.estimate_m()[2] - self._takeoff_down_m
        if error_m < ARRIVED_M and self._took_off:
            self._set_intended_mode(Px4Mode.HOLD)
        speed_m_s = min(error_m * self.parameters["MPC_Z_P"], self.parameters["MPC_TKO_SPEED"])
        return north, east, -speed_m_s

    def _descend(self) -> Vector:
        north, east, _ = self._hold()
        return north, east, self._descent_m_s(-self._position_m[2])

    def _descent_m_s(self, height_m: float) -> float:
        near = height_m < SLOW_DESCENT_BELOW_M
        return self.parameters["MPC_LAND_SPEED" if near else "MPC_Z_VEL_MAX_DN"]

    def _return(self) -> Vector:
        """Climb to the return altitude, fly home, land."""
        assert self.home_m is not None
        off_north_m, off_east_m, height_m = minus(self.home_m, self.estimate_m())
        if math.hypot(off_north_m, off_east_m) < 1.0:
            north, east, _ = self._toward(self.home_m)
            return north, east, self._descent_m_s(height_m)
        missing_m = self.parameters["RTL_RETURN_ALT"] - height_m
        if missing_m > ARRIVED_M:
            north, east, _ = self._hold()
            return north, east, -min(missing_m, self.parameters["MPC_Z_VEL_MAX_UP"])
        north, east, _ = self._toward(self.home_m)
        return north, east, 0.0

    def _toward(self, target_m: Vector) -> Vector:
        off_north, off_east, off_down = minus(target_m, self.estimate_m())
        gain, gain_down = self.parameters["MPC_XY_P"], self.parameters["MPC_Z_P"]
        north, east = _shorten(gain * off_north, gain * off_east, self.parameters["MPC_XY_CRUISE"])
        return north, east, gain_down * off_down

    def _watch_ground(self) -> None:
        if self._position_m[2] < 0.0:
            self._on_ground_since_s = math.inf
            self._off_ground_since_s = min(self._off_ground_since_s, self.time_s)
            if self.time_s - self._off_ground_since_s < IN_AIR_AFTER_S:
                return
            if self.landed and self.armed:
                self._emit(_TAKEOFF_DETECTED, Level.INFO, "Takeoff detected\t")
            self._took_off = self._took_off or self.armed
            self.landed = False
            return
        self._off_ground_since_s = math.inf
        if self._lift_began_s is not None and self.armed:
            return
        self._on_ground_since_s = min(self._on_ground_since_s, self.time_s)
        on_ground_s = self.time_s - self._on_ground_since_s
        if not self.landed and on_ground_s >= LANDED_AFTER_S:
            self.landed = True
            self._emit(_LANDING_DETECTED, Level.INFO, "Landing detected\t")
        if self.armed and self.landed:
            self._disarm_when_idle(on_ground_s - LANDED_AFTER_S)

    def _disarm_when_idle(self, landed_s: float) -> None:
        parameters = self.parameters
        armed_s = self.time_s - self._armed_at_s
        after_landing = 0.0 < parameters["COM_DISARM_LAND"] <= landed_s
        preflight_s = parameters["COM_DISARM_PRFLT"]
        if self._took_off and after_landing:
            self.disarm(reason=_BY_LANDING)
        elif not self._took_off and 0.0 < preflight_s <= armed_s - parameters["COM_SPOOLUP_TIME"]:
            self.disarm(reason=_BEFORE_FLIGHT)

    def _record_truth(self) -> None:
        self.truth.append(
            Truth(
                self.time_s,
                self._position_m,
                self._velocity_m_s,
                self.mode,
                self.armed,
                self.landed,
                self._setpoint_at_s,
                self._follows(),
                math.hypot(*self._velocity_error_m_s[:2]),
                self.commands,
            )
        )

    def _follows(self) -> Literal["position", "velocity", "stop"] | None:
        if self._setpoint is None:
            return None
        if not math.isnan(self._setpoint.position_m[0]):
            return "position"
        return "velocity" if any(self._setpoint.velocity_m_s[:2]) else "stop"


def _axis(velocity_m_s: float, error_m: float, gain: float, drift_m_s: float) -> float:
    """Velocity of a setpoint along one axis; NaN parts are not commanded."""
    feed_m_s = 0.0 if math.isnan(velocity_m_s) else velocity_m_s
    return feed_m_s + (drift_m_s if math.isnan(error_m) else gain * error_m)


def _shorten(north: float, east: float, length: float) -> tuple[float, float]:
    norm = math.hypot(north, east)
    if norm <= length:
        return north, east
    share = length / norm
    return share * north, share * east
