"""Ground-station link to real PX4s, for faults, pilots and the vehicles' true positions.

Faults and the remote control go over this link. The remote control is RC_CHANNELS_OVERRIDE, since
PX4 does not count MANUAL_CONTROL as a remote control, and a pilot's robots must obey that alone.
True positions come from PX4's own vehicle model. Names are those of
`lpac.sim.px4.vehicle.Px4Vehicle`.
"""

import math
import socket
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Self

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from edge.core import F64
from lpac.sim.px4.modes import CUSTOM_MODES, MODE_BY_CUSTOM, Px4Mode
from lpac.sim.px4.world import WorldOrigin
from lpac.sim.sitl.build import AIRBORNE_ABOVE_M, GROUND_PORT, Px4Build, frames

_PERIOD_S = 0.02
_HEARTBEAT_PERIOD_S = 0.5
# PX4 loses a remote control after half a second, and accepts a pilot's mode only with one.
_STICKS_PERIOD_S, _MODE_AGAIN_S, _PARAMETERS_AGAIN_S = 0.05, 0.3, 0.5
# Full sticks; PX4's default (v1.17) has a dead zone, and 10 m/s. The curve is fixed.
_STICKS_M_S = 4.0
_STICKS = np.linspace(-1.0, 1.0, 201)
_CURVE = 0.4 * _STICKS + 0.6 * _STICKS**3
_STICK_PARAMETERS = {
    "MPC_VEL_MANUAL": _STICKS_M_S, "MPC_Z_VEL_MAX_UP": 3.0, "MPC_Z_VEL_MAX_DN": 1.5,
    "MAN_DEADZONE": 0.0,
}  # fmt: skip
# Calibrated receiver: channels of the sticks, from 1 on, 1000 to 2000 us each.
_CHANNELS = {
    "RC_CHAN_CNT": 4, "RC_MAP_ROLL": 1, "RC_MAP_PITCH": 2, "RC_MAP_THROTTLE": 3, "RC_MAP_YAW": 4,
}  # fmt: skip
# PX4's own default.
_SATELLITES = 10
# SIH_T_MAX of PX4's own quadrotor: full thrust of each motor, N.
_FULL_THRUST_N = 5.0
# BAT1_SOURCE: MAVLink instead of PX4's own simulator; cells as in the simulator.
_EXTERNAL_BATTERY = 1
_CELLS, _EMPTY_CELL_V, _FULL_CELL_V = 4, 3.6, 4.05
_UNKNOWN_UINT16, _UNKNOWN_INT16 = 0xFFFF, 0x7FFF
_RATES_HZ = {
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 20,
    mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION: 25,
}
_RECEIVED = {
    *_RATES_HZ, mavlink.MAVLINK_MSG_ID_HEARTBEAT, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
    mavlink.MAVLINK_MSG_ID_PARAM_VALUE,
}  # fmt: skip


class RealVehicle:
    """One PX4, over its ground-station link; hold `stepped` to change its fields.

    `time_s` is the `time.monotonic()` of the last true state; 0 before the first.
    """

    def __init__(self, instance: int, world: WorldOrigin) -> None:
        self.time_s = 0.0
        self.mode = Px4Mode.HOLD
        self.armed = False
        self.position_m: F64 = np.zeros(3)
        self._rc_connected = False
        self._world = world
        self._local_m: F64 = np.zeros(3)
        self._origin_m: F64 = np.zeros(3)
        self._ground_altitude_m = math.nan
        self._heartbeat_due_s = self._sticks_due_s = self._mode_due_s = 0.0
        self._heading_rad = 0.0
        # Parameters not confirmed yet, by name: the value's bits as a float, and its type.
        self._unconfirmed: dict[str, tuple[float, int]] = {}
        self._parameters_due_s = 0.0
        self._sticks_m_s: tuple[float, ...] = (0.0, 0.0, 0.0)
        self._pilots_mode: Px4Mode | None = None
        self._system = instance + 1
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.connect(("127.0.0.1", GROUND_PORT + instance))
        self._udp.setblocking(False)
        self._mav: Any = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self._mav.robust_parsing = True
        self._battery: float | None = None
        self._battery_mav: Any = mavlink.MAVLink(
            None, srcSystem=self._system, srcComponent=mavlink.MAV_COMP_ID_BATTERY
        )

    @property
    def rc_connected(self) -> bool:
        """Whether a remote control is on and received."""
        return self._rc_connected

    @rc_connected.setter
    def rc_connected(self, connected: bool) -> None:
        if connected and not self._rc_connected:
            self._calibrate()
        self._rc_connected = connected

    @property
    def unconfirmed(self) -> tuple[str, ...]:
        """Parameters sent to PX4 and not confirmed yet."""
        return tuple(self._unconfirmed)

    @property
    def landed(self) -> bool:
        """Whether it truly stands on the ground."""
        return bool(self.position_m[2] > -AIRBORNE_ABOVE_M)

    @property
    def estimated_position_m(self) -> F64:
        """PX4's estimated position, in the world's frame."""
        return self._local_m + self._origin_m

    def set_mode(self, mode: Px4Mode) -> None:
        """Command a mode, as a ground station."""
        custom = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        self._command(mavlink.MAV_CMD_DO_SET_MODE, custom, *CUSTOM_MODES[mode])

    def pilot(
        self, mode: Px4Mode = Px4Mode.POSCTL, stick_velocity_m_s: Sequence[float] = ()
    ) -> None:
        """Switch the remote control on, with this mode and these sticks."""
        self.rc_connected, self._pilots_mode = True, mode
        self.move_sticks(stick_velocity_m_s)

    def move_sticks(self, velocity_m_s: Sequence[float]) -> None:
        """Hold the sticks for a velocity: north, east, down, m/s; empty means centred."""
        self._sticks_m_s = tuple(velocity_m_s) or (0.0, 0.0, 0.0)

    def lose_gps(self, *, lost: bool = True) -> None:
        """Take all satellites from the receiver, or give them back."""
        satellites = 0 if lost else _SATELLITES
        self.set_parameter("SIM_GPS_USED", satellites)

    def weaken_motors(self, loss: float) -> None:
        """Reduce the motors' full thrust by this share."""
        thrust_n = (1.0 - loss) * _FULL_THRUST_N
        self.set_parameter("SIH_T_MAX", thrust_n)

    def drain(self, remaining: float) -> None:
        """Drain the battery of an armed vehicle to this share within a second.

        In PX4's simulator the battery is at 100 % while disarmed.
        """
        self.set_parameter("SIM_BAT_MIN_PCT", 100.0 * remaining)
        self.set_parameter("SIM_BAT_DRAIN", 1.0)

    def change_battery(self, remaining: float) -> None:
        """Set the battery of a disarmed vehicle to this share.

        The battery is external, over MAVLink, and not for flights: it reports no remaining time,
        which PX4 takes for 0 s, and returns.
        """
        self.set_parameter("BAT1_SOURCE", _EXTERNAL_BATTERY)
        self._battery = remaining

    def jump_estimator_origin(self, north_m: float, east_m: float, down_m: float = 0.0) -> None:
        """Move the estimator's origin, as a ground station."""
        moved_m = self._origin_m + np.array([north_m, east_m, down_m])
        latitude, longitude, altitude_m = self._world.to_global(moved_m)
        self._send(
            mavlink.MAVLink_set_gps_global_origin_message(
                self._system, round(latitude * 1e7), round(longitude * 1e7),
                round(altitude_m * 1e3), 0,
            )
        )  # fmt: skip

    def set_parameter(self, name: str, value: int | float) -> None:
        """Set a parameter, repeated until PX4 confirms it; integers are encoded bytewise."""
        raw, kind = float(np.float32(value)), mavlink.MAV_PARAM_TYPE_REAL32
        if isinstance(value, int):
            raw = float(np.array([value], np.int32).view(np.float32)[0])
            kind = mavlink.MAV_PARAM_TYPE_INT32
        self._unconfirmed[name] = raw, kind
        self._parameters_due_s = 0.0

    def clear_fence(self) -> None:
        """Clear the fence, as another ground station would."""
        fence = mavlink.MAV_MISSION_TYPE_FENCE
        self._send(mavlink.MAVLink_mission_clear_all_message(self._system, 1, fence))

    def _send_battery(self, remaining: float) -> None:
        cell_v = _EMPTY_CELL_V + remaining * (_FULL_CELL_V - _EMPTY_CELL_V)
        self._send(
            mavlink.MAVLink_battery_status_message(
                0, mavlink.MAV_BATTERY_FUNCTION_ALL, mavlink.MAV_BATTERY_TYPE_LIPO, _UNKNOWN_INT16,
                [round(cell_v * 1e3)] * _CELLS + [_UNKNOWN_UINT16] * (10 - _CELLS), -1, -1, -1,
                round(100.0 * remaining),
            ),
            self._battery_mav,
        )  # fmt: skip

    def _command(self, command: int, *parameters: float) -> None:
        filled = [*parameters, *[0.0] * (7 - len(parameters))]
        self._send(mavlink.MAVLink_command_long_message(self._system, 1, command, 0, *filled))

    def _send(self, message: Any, mav: Any = None) -> None:
        with suppress(ConnectionError):  # PX4 does not listen yet, or no longer.
            self._udp.send(message.pack(mav or self._mav))

    def exchange(self) -> None:
        """Send messages that are due, and handle all received ones."""
        now_s = time.monotonic()
        self._send_due(now_s)
        while datagram := self._receive():
            for message_id, frame in frames(datagram):
                if message_id in _RECEIVED:
                    for message in self._mav.parse_buffer(frame) or ():
                        if (message.get_srcSystem(), message.get_srcComponent()) == (
                            self._system, 1,
                        ):  # fmt: skip
                            self._handle(now_s, message)

    def _send_due(self, now_s: float) -> None:
        if now_s >= self._heartbeat_due_s:
            self._heartbeat_due_s = now_s + _HEARTBEAT_PERIOD_S
            self._send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3
                )
            )
            if self._battery is not None:
                self._send_battery(self._battery)
            # Repeat until it answers: it does not listen from the start.
            if not self.time_s:
                for message, rate_hz in _RATES_HZ.items():
                    self._command(
                        mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message, round(1e6 / rate_hz)
                    )
        if self.rc_connected and now_s >= self._sticks_due_s:
            self._sticks_due_s = now_s + _STICKS_PERIOD_S
            self._send(self._sticks())
        if now_s >= self._parameters_due_s:
            self._parameters_due_s = now_s + _PARAMETERS_AGAIN_S
            for name, (raw, kind) in self._unconfirmed.items():
                self._send(
                    mavlink.MAVLink_param_set_message(self._system, 1, name.encode(), raw, kind)
                )
        if self._pilots_mode is self.mode:
            self._pilots_mode = None
        if self._pilots_mode is not None and now_s >= self._mode_due_s:
            self._mode_due_s = now_s + _MODE_AGAIN_S
            self.set_mode(self._pilots_mode)

    def close(self) -> None:
        """Close the socket."""
        self._udp.close()

    def _calibrate(self) -> None:
        for name, value in (_STICK_PARAMETERS | _CHANNELS).items():
            self.set_parameter(name, value)

    def _sticks(self) -> Any:
        """Sticks in the vehicle's body frame."""
        north, east, down = self._sticks_m_s
        cos, sin = math.cos(self._heading_rad), math.sin(self._heading_rad)
        shares = (
            (cos * east - sin * north) / _STICKS_M_S,
            (cos * north + sin * east) / _STICKS_M_S,
            -down / _STICK_PARAMETERS["MPC_Z_VEL_MAX_UP" if down < 0.0 else "MPC_Z_VEL_MAX_DN"],
        )
        roll, pitch, throttle = np.rint(1500.0 + 500.0 * np.interp(shares, _CURVE, _STICKS))
        return mavlink.MAVLink_rc_channels_override_message(
            self._system, 1, int(roll), int(pitch), int(throttle), 1500, 0, 0, 0, 0
        )

    def _receive(self) -> bytes:
        with suppress(ConnectionError, BlockingIOError):
            return self._udp.recv(2048)
        return b""

    def _handle(self, now_s: float, message: Any) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT":
            self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            custom = message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24
            self.mode = MODE_BY_CUSTOM.get(custom, self.mode)
        elif kind == "LOCAL_POSITION_NED":
            self._local_m = np.array([message.x, message.y, message.z])
        elif kind == "PARAM_VALUE":
            # Compare bits: most integers are NaN as floats.
            confirmed = np.float32(message.param_value).tobytes()
            sent = self._unconfirmed.get(message.param_id)
            if sent is not None and np.float32(sent[0]).tobytes() == confirmed:
                del self._unconfirmed[message.param_id]
        elif kind == "GPS_GLOBAL_ORIGIN":
            latitude, longitude = message.latitude * 1e-7, message.longitude * 1e-7
            north_m, east_m = self._world.to_world(latitude, longitude)
            down_m = self._world.altitude_m - message.altitude * 1e-3
            self._origin_m = np.array([north_m, east_m, down_m])
        elif kind == "HIL_STATE_QUATERNION":
            self._take_truth(now_s, message)

    def _take_truth(self, now_s: float, message: Any) -> None:
        if math.isnan(self._ground_altitude_m):
            self._ground_altitude_m = message.alt * 1e-3
        north_m, east_m = self._world.to_world(message.lat * 1e-7, message.lon * 1e-7)
        self.time_s = now_s
        self.position_m = np.array([north_m, east_m, self._ground_altitude_m - message.alt * 1e-3])
        w, x, y, z = message.attitude_quaternion
        self._heading_rad = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


class RealVehicles:
    """The PX4s of a running build; a context, in which a thread of this process serves them."""

    def __init__(self, px4s: Px4Build, world: WorldOrigin) -> None:
        self.stepped = threading.Condition()
        self.vehicles = tuple(RealVehicle(i, world) for i in range(len(px4s.autopilots)))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ground-station")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        for vehicle in self.vehicles:
            vehicle.close()

    def _run(self) -> None:
        while not self._stop.wait(_PERIOD_S):
            with self.stepped:
                for vehicle in self.vehicles:
                    vehicle.exchange()
                self.stepped.notify_all()
