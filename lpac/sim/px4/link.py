"""MAVLink 2 for one simulated vehicle, as messages or as datagrams; no socket and no clock.

Contents, times and bits are those of PX4 v1.17: tests/sim/sim/test_px4_recordings.py compares them
with recordings of a real one, on its link to a companion computer. Parameters are encoded bytewise
in the float, an unknown parameter gets no answer, a fence is uploaded as a mission. Changes are
sent to all clients: a parameter at once, the fence's id once a second.
"""

import math
import struct
import zlib
from collections import deque
from collections.abc import Callable, Collection, Sequence
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from lpac.sim.px4.checks import Component, Px4Event
from lpac.sim.px4.modes import CUSTOM_MODES, MODE_BY_CUSTOM, PILOTED, MavResult, Px4Mode
from lpac.sim.px4.vector import minus
from lpac.sim.px4.vehicle import GRAVITY_M_S2, Px4Setpoint, Px4Vehicle, SimulatedSensor
from lpac.sim.px4.wire import OnTheWire
from lpac.sim.px4.world import FencePolygon

FORCE = 21196.0  # MAV_CMD_COMPONENT_ARM_DISARM: param 2 that skips the checks
FIRMWARE_VERSION = 1 << 24 | 17 << 16 | 0 << 8 | 255  # 1.17.0, release
PARAMETERS_AT_ONCE = 10
MAX_DATAGRAM_BYTES = 1400
# Maximum age of a ground station's last heartbeat for texts to be sent, and of the texts.
GROUND_STATION_TIMEOUT_S = 2.5
TEXT_KEPT_S = 5.0
TEXT_BYTES = 50
GPS_SILENT_S = 1.0
EVENTS_KEPT = 40

_STATUS_BITS = {
    Component.GYROSCOPE: mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO,
    Component.ACCELEROMETER: mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL,
    Component.COMPASS: mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG,
    Component.BAROMETER: mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE,
    Component.GPS: mavlink.MAV_SYS_STATUS_SENSOR_GPS,
    Component.ATTITUDE_ESTIMATE: mavlink.MAV_SYS_STATUS_SENSOR_ATTITUDE_STABILIZATION
    | mavlink.MAV_SYS_STATUS_AHRS,
    Component.LOCAL_POSITION_ESTIMATE: mavlink.MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL,
    Component.REMOTE_CONTROL: mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER,
    Component.BATTERY: mavlink.MAV_SYS_STATUS_SENSOR_BATTERY,
    Component.LOGGING: mavlink.MAV_SYS_STATUS_LOGGING,
}
# Their failures are not simulated.
_NEVER_ILL = (
    mavlink.MAV_SYS_STATUS_SENSOR_DIFFERENTIAL_PRESSURE
    | mavlink.MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
)
_FLAGS_AT_START = (
    mavlink.ESTIMATOR_VELOCITY_VERT
    | mavlink.ESTIMATOR_POS_VERT_ABS
    | mavlink.ESTIMATOR_CONST_POS_MODE
)
_FLAGS_WITH_POSITION = (
    mavlink.ESTIMATOR_VELOCITY_HORIZ
    | mavlink.ESTIMATOR_POS_HORIZ_REL
    | mavlink.ESTIMATOR_POS_HORIZ_ABS
)
_FLAGS_WITH_GPS = mavlink.ESTIMATOR_PRED_POS_HORIZ_REL | mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS
_FENCE_VERTICES = {
    mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION: True,
    mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION: False,
}
_FENCE = mavlink.MAV_MISSION_TYPE_FENCE
_CHECKSUM = "_HASH_CHECK"
_EVENT, _CURRENT_EVENT_SEQUENCE = 410, 411
_COMMAND_KINDS = ("COMMAND_LONG", "COMMAND_INT")
_UNKNOWN_COVARIANCE = [math.nan] + [0.0] * 20


class _Message(mavlink.MAVLink_message):  # type: ignore[misc]
    """A message of PX4 that pymavlink lacks, or has without its last fields.

    `fields` are in the order of the format `packed`.
    """

    def __init__(self, number: int, name: str, crc_extra: int, packed: str, **fields: Any) -> None:
        super().__init__(number, name)
        self.__dict__.update(fields)
        self._number, self._crc_extra = number, crc_extra
        self._packed, self._names = packed, tuple(fields)

    def pack(self, mav: Any, force_mavlink1: bool = False) -> Any:
        payload = struct.pack(self._packed, *(getattr(self, name) for name in self._names))
        return self._pack(mav, self._crc_extra, payload, force_mavlink1=force_mavlink1)


def request_event(first_sequence: int, last_sequence: int) -> Any:
    """The message that requests events from PX4 again."""
    return _Message(
        412, "REQUEST_EVENT", 33, "<HHBB", first_sequence=first_sequence,
        last_sequence=last_sequence, target_system=0, target_component=0,
    )  # fmt: skip


class Px4Link:
    """MAVLink of one vehicle: its messages, their times, and its commands.

    Over a wire it receives datagrams (`receive`) and returns those due (`due`). Within one process
    it exchanges message objects (`handle`, `due_messages`), at a tenth of the cost: the caller must
    round their numbers as MAVLink does. The vehicle's `wire` has loss, delay and repeats. Each
    outgoing message has a `link_number`, from 1 on.
    """

    def __init__(
        self, vehicle: Px4Vehicle, *, system_id: int, hardware_uid: int | None = None
    ) -> None:
        """`hardware_uid` defaults to the system id; some boards all have the same."""
        self.vehicle = vehicle
        self.system_id = system_id
        vehicle.parameters["MAV_SYS_ID"] = system_id
        self._hardware_uid = system_id if hardware_uid is None else hardware_uid
        self._mavlink: Any = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=1)
        self._mavlink.robust_parsing = True
        self._out: list[Any] = []
        self._parameters_to_send: list[str] = []
        self._parameters_sent = dict(vehicle.parameters)
        self._upload: list[Any] = []
        self._upload_count = 0
        self._ground_station_at_s = -math.inf
        self._texts: deque[tuple[float, Px4Event]] = deque()
        self._text_id = 0
        self._on_the_wire = OnTheWire(system_id)
        self._link_number = 0
        self._event_sequence = 0xFFF5
        self._sent_events: deque[_Message] = deque(maxlen=EVENTS_KEPT)
        self._gps_sent_at_s = -math.inf
        self._origin_sent: tuple[float, float, float] | None = None
        # Message id -> builder; PX4's default rates on the onboard link, Hz.
        streams: dict[int, tuple[float, Callable[[], Any]]] = {
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: (1.0, self._heartbeat),
            mavlink.MAVLINK_MSG_ID_SYS_STATUS: (5.0, self._sys_status),
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: (5.0, self._extended_sys_state),
            mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: (1.0, self._moved_origin),
            mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: (0.5, self._battery_status),
            mavlink.MAVLINK_MSG_ID_HOME_POSITION: (0.5, self._home_position),
            mavlink.MAVLINK_MSG_ID_RC_CHANNELS: (20.0, self._rc_channels),
            mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: (1.0, self._estimator_status),
            mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: (8.0, self._gps_raw_int),
            mavlink.MAVLINK_MSG_ID_ATTITUDE: (50.0, self._attitude),
            mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: (50.0, self._global_position_int),
            mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: (30.0, self._local_position_ned),
            mavlink.MAVLINK_MSG_ID_VFR_HUD: (10.0, self._vfr_hud),
            mavlink.MAVLINK_MSG_ID_ODOMETRY: (30.0, self._odometry),
            mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: (0.0, self._autopilot_version),
            _CURRENT_EVENT_SEQUENCE: (0.33, self._current_event_sequence),
            mavlink.MAVLINK_MSG_ID_MISSION_CURRENT: (1.0, self._mission_current),
        }
        self._builders = {message: build for message, (_, build) in streams.items()}
        # Builders for messages on request, where they differ from the stream's.
        self._on_request = {mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: self._gps_global_origin}
        self._default_rates_hz = {message: rate_hz for message, (rate_hz, _) in streams.items()}
        self._intervals_s: dict[int, float] = {}
        self._due_s = dict.fromkeys(streams, vehicle.time_s)
        self._next_due_s = vehicle.time_s
        for message, rate_hz in self._default_rates_hz.items():
            self._intervals_s[message] = 0.0
            self._set_interval(message, 1.0 / rate_hz if rate_hz else math.inf)
        self._handlers: dict[str, Callable[[Any], None]] = {
            "HEARTBEAT": self._on_heartbeat,
            "COMMAND_LONG": self._on_command,
            "COMMAND_INT": self._on_command,
            "SET_MODE": self._on_set_mode,
            "SET_POSITION_TARGET_LOCAL_NED": self._on_setpoint,
            "PARAM_REQUEST_LIST": self._on_param_request_list,
            "PARAM_REQUEST_READ": self._on_param_request_read,
            "PARAM_SET": self._on_param_set,
            "MISSION_COUNT": self._on_mission_count,
            "MISSION_ITEM_INT": self._on_mission_item,
            "MISSION_REQUEST_LIST": self._on_mission_request_list,
            "MISSION_REQUEST_INT": self._on_mission_request,
            "MISSION_CLEAR_ALL": self._on_mission_clear_all,
            "REQUEST_EVENT": self._on_request_event,
            "UNKNOWN_412": self._on_request_event,
        }
        self._commands: dict[int, Callable[[Any], MavResult]] = {
            mavlink.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_or_disarm,
            mavlink.MAV_CMD_DO_SET_MODE: self._set_mode,
            mavlink.MAV_CMD_NAV_TAKEOFF: self._take_off,
            mavlink.MAV_CMD_RUN_PREARM_CHECKS: self._run_prearm_checks,
            mavlink.MAV_CMD_NAV_LAND: self._land,
            mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: self._return_to_launch,
            mavlink.MAV_CMD_DO_FLIGHTTERMINATION: self._terminate,
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_message_interval,
            mavlink.MAV_CMD_REQUEST_MESSAGE: self._request_message,
            mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: self._request_capabilities,
        }

    def silence(self, but: Collection[str]) -> None:
        """Stop all streams except those of these messages."""
        for message_id in self._builders:
            kind = mavlink.mavlink_map.get(message_id)
            if message_id and kind is not None and kind.msgname not in but:
                self._set_interval(message_id, math.inf)

    def receive(self, datagram: bytes) -> None:
        """Handle a client's datagram; other data, and messages to others, are ignored."""
        for message in self._mavlink.parse_buffer(datagram) or ():
            self.handle(message)

    def handle(self, message: Any) -> None:
        """Handle a client's message; those to others are ignored."""
        kind = message.get_type()
        self.vehicle.commands += kind in _COMMAND_KINDS
        if self._on_the_wire.is_lost(self.vehicle.wire):
            return
        handler = self._handlers.get(kind)
        target = getattr(message, "target_system", 0)
        if handler is not None and target in (0, self.system_id):
            handler(message)

    def due(self) -> list[bytes]:
        """The datagrams to send now."""
        datagrams = [b""]
        for message in self.due_messages():
            self._mavlink.seq = message.link_number % 256
            packet = bytes(message.pack(self._mavlink))
            if len(datagrams[-1]) + len(packet) > MAX_DATAGRAM_BYTES:
                datagrams.append(b"")
            datagrams[-1] += packet
        return [datagram for datagram in datagrams if datagram]

    def due_messages(self) -> list[Any]:
        """The messages that arrive now: answers first, then the streams that are due."""
        vehicle = self.vehicle
        for event in vehicle.take_events():
            self._event_sequence = (self._event_sequence + 1) % 0x10000
            self._sent_events.append(self._event(event))
            self._send(self._sent_events[-1])
            self._texts.append((vehicle.time_s, event))
        if self._texts:
            self._send_texts()
        if vehicle.parameters != self._parameters_sent:
            for name, value in vehicle.parameters.items():
                if value != self._parameters_sent.get(name):
                    self._send_parameter(name)
            self._parameters_sent = dict(vehicle.parameters)
        if self._parameters_to_send:
            for name in self._parameters_to_send[:PARAMETERS_AT_ONCE]:
                self._send_parameter(name)
            del self._parameters_to_send[:PARAMETERS_AT_ONCE]
        now_s = vehicle.time_s + 1e-6
        if self._next_due_s <= now_s:
            for message in [each for each, due_s in self._due_s.items() if due_s <= now_s]:
                # A late message does not make the next one early.
                next_s = self._due_s[message] + self._intervals_s[message]
                self._due_s[message] = max(next_s, now_s)
                self._send_now(message)
            self._next_due_s = min(self._due_s.values())
        messages, self._out = self._out, []
        for message in messages:
            self._link_number += 1
            message.link_number = self._link_number
        return self._on_the_wire.pass_on(messages, vehicle.wire, vehicle.time_s)

    def _send(self, message: Any) -> None:
        self._out.append(message)

    def _send_now(self, message_id: int, build: Callable[[], Any] | None = None) -> bool:
        """Send a message; returns whether there was one."""
        message = (build or self._builders[message_id])()
        if message is not None:
            self._send(message)
        return message is not None

    def _send_texts(self) -> None:
        """Send fresh texts while a ground station is connected, long ones in chunks."""
        now_s = self.vehicle.time_s
        if now_s - self._ground_station_at_s <= GROUND_STATION_TIMEOUT_S:
            for at_s, event in self._texts:
                if not event.text or now_s - at_s >= TEXT_KEPT_S:
                    continue
                text = event.text.encode()
                for chunk, start in enumerate(range(0, len(text), TEXT_BYTES)):
                    part = text[start : start + TEXT_BYTES]
                    self._send(
                        mavlink.MAVLink_statustext_message(
                            event.text_level, part, self._text_id, chunk
                        )
                    )
                self._text_id = (self._text_id + 1) % 0x10000
            self._texts.clear()
        while self._texts and now_s - self._texts[0][0] >= TEXT_KEPT_S:
            self._texts.popleft()

    def _set_interval(self, message_id: int, interval_s: float) -> None:
        """Set a stream's interval, counted from its last message."""
        last_s = self._due_s[message_id] - self._intervals_s[message_id]
        if math.isnan(last_s):
            last_s = self.vehicle.time_s
        self._intervals_s[message_id] = interval_s
        self._due_s[message_id] = last_s + interval_s
        self._next_due_s = min(self._due_s.values())

    def _boot_ms(self) -> int:
        return int(self.vehicle.time_s * 1e3)

    def _heartbeat(self) -> Any:
        vehicle = self.vehicle
        main, sub = CUSTOM_MODES[vehicle.mode]
        flags = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
        if vehicle.mode in PILOTED:
            flags |= mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
        elif vehicle.mode is not Px4Mode.OFFBOARD:
            flags |= mavlink.MAV_MODE_FLAG_GUIDED_ENABLED | mavlink.MAV_MODE_FLAG_AUTO_ENABLED
        if vehicle.armed:
            flags |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
            in_failsafe = vehicle.failsafe.is_active
            status = mavlink.MAV_STATE_CRITICAL if in_failsafe else mavlink.MAV_STATE_ACTIVE
        else:
            status = mavlink.MAV_STATE_STANDBY if vehicle.armable else mavlink.MAV_STATE_UNINIT
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR,
            mavlink.MAV_AUTOPILOT_PX4,
            flags,
            main << 16 | sub << 24,
            status,
            3,
        )

    def _sys_status(self) -> Any:
        """The health bits alone have PREARM_CHECK: armable in this mode by the last report."""
        vehicle = self.vehicle
        report = vehicle.health
        present, healthy = 0, _NEVER_ILL
        has, ill = (frozenset(),) * 2 if report is None else (report.present, report.unhealthy)
        for component, bits in _STATUS_BITS.items():
            if component in has:
                present |= bits
            if component not in ill:
                healthy |= bits
        enabled = present | sum(bits for bits in _STATUS_BITS.values() if not healthy & bits)
        if report is not None and report.can_arm(vehicle.mode):
            healthy |= mavlink.MAV_SYS_STATUS_PREARM_CHECK
        return mavlink.MAVLink_sys_status_message(
            present,
            enabled,
            healthy,
            300,
            round(vehicle.voltage_v * 1e3),
            round(vehicle.current_a * 100.0),
            math.ceil(vehicle.battery_reported * 100.0),
            *(0,) * 6,
        )

    def _extended_sys_state(self) -> Any:
        vehicle = self.vehicle
        if vehicle.landed:
            state = mavlink.MAV_LANDED_STATE_ON_GROUND
        elif vehicle.mode is Px4Mode.TAKEOFF:
            state = mavlink.MAV_LANDED_STATE_TAKEOFF
        elif vehicle.mode is Px4Mode.LAND:
            state = mavlink.MAV_LANDED_STATE_LANDING
        else:
            state = mavlink.MAV_LANDED_STATE_IN_AIR
        return mavlink.MAVLink_extended_sys_state_message(mavlink.MAV_VTOL_STATE_UNDEFINED, state)

    def _gps_global_origin(self) -> Any:
        if not self.vehicle.estimator.has_origin:
            return None
        self._origin_sent = self.vehicle.global_origin
        return mavlink.MAVLink_gps_global_origin_message(
            *_as_integers(self._origin_sent), self._boot_ms() * 1000
        )

    def _moved_origin(self) -> Any:
        """The origin if it has changed: the stream sends it only then."""
        is_known = self._origin_sent == self.vehicle.global_origin
        return None if is_known else self._gps_global_origin()

    def _current_event_sequence(self) -> Any:
        return _Message(
            _CURRENT_EVENT_SEQUENCE, "CURRENT_EVENT_SEQUENCE", 106, "<HB",
            sequence=self._event_sequence, flags=0,
        )  # fmt: skip

    def _event(self, event: Px4Event) -> _Message:
        return _Message(
            _EVENT, "EVENT", 160, "<IIHBBB40s", id=1 << 24 | event.number,
            event_time_boot_ms=self._boot_ms(), sequence=self._event_sequence,
            destination_component=0, destination_system=0,
            log_levels=event.level << 4 | event.level, arguments=event.arguments.ljust(40, b"\0"),
        )  # fmt: skip

    def _mission_current(self) -> Any:
        """There is no mission; the message carries the fence's id."""
        return _Message(
            mavlink.MAVLINK_MSG_ID_MISSION_CURRENT, "MISSION_CURRENT", 28, "<HHBBIII", seq=0,
            total=0xFFFF, mission_state=1, mission_mode=0, mission_id=0, fence_id=self._fence_id(),
            rally_points_id=0,
        )  # fmt: skip

    def _estimator_status(self) -> Any:
        estimator = self.vehicle.estimator
        flags = _FLAGS_AT_START
        if estimator.is_aligned:
            flags |= mavlink.ESTIMATOR_ATTITUDE | mavlink.ESTIMATOR_POS_VERT_AGL
        if not self.vehicle.at_rest:
            flags &= ~mavlink.ESTIMATOR_CONST_POS_MODE
        if estimator.doubts_gps:
            flags |= mavlink.ESTIMATOR_GPS_GLITCH
        if estimator.uses_gps:
            flags |= _FLAGS_WITH_GPS
            if estimator.is_held:
                flags |= _FLAGS_WITH_POSITION
        return mavlink.MAVLink_estimator_status_message(
            self._boot_ms() * 1000, flags, *(0.05,) * 4, 0.01, math.nan, *estimator.accuracy_m
        )

    def _battery_status(self) -> Any:
        if SimulatedSensor.BATTERY in self.vehicle.dead_sensors:
            return None
        vehicle = self.vehicle
        cell_mv = round(vehicle.voltage_v * 250.0)
        return mavlink.MAVLink_battery_status_message(
            0,
            mavlink.MAV_BATTERY_FUNCTION_ALL,
            mavlink.MAV_BATTERY_TYPE_LIPO,
            2500,
            [cell_mv] * 4 + [0xFFFF] * 6,
            round(vehicle.current_a * 100.0),
            -1,
            -1,
            int(vehicle.battery_reported * 100.0),
            0,
            vehicle.battery_warning,
        )

    def _home_position(self) -> Any:
        home, home_m = self.vehicle.global_home, self.vehicle.home_m
        if home is None or home_m is None:
            return None
        local_m = minus(home_m, self.vehicle.estimator_origin_m)
        no_rotation, no_approach = [1.0, 0.0, 0.0, 0.0], [math.nan] * 3
        return mavlink.MAVLink_home_position_message(
            *_as_integers(home), *local_m, no_rotation, *no_approach, self._boot_ms() * 1000
        )

    def _rc_channels(self) -> Any:
        if not self.vehicle.rc_received:
            return None
        return mavlink.MAVLink_rc_channels_message(
            self._boot_ms(), 8, *(1500,) * 8, *(0xFFFF,) * 10, 254
        )

    def _gps_raw_int(self) -> Any:
        vehicle = self.vehicle
        if vehicle.silent_s(SimulatedSensor.GPS) >= 0.0:
            if vehicle.time_s - self._gps_sent_at_s <= GPS_SILENT_S:
                return None
            # Without a driver all fields are unknown, even the accuracy.
            self._gps_sent_at_s = vehicle.time_s
            unknown = 0xFFFF
            return mavlink.MAVLink_gps_raw_int_message(
                0, 0, 0, 0, 0, unknown, unknown, unknown, unknown, 0xFF
            )
        self._gps_sent_at_s = vehicle.time_s
        v_north, v_east, _ = vehicle.fix_velocity_m_s
        speed_cm_s = round(100.0 * math.hypot(v_north, v_east))
        course_cdeg = round(100.0 * math.degrees(math.atan2(v_east, v_north))) % 36000
        place = _as_integers(vehicle.global_fix)
        if vehicle.gps_lost:
            fix, satellites, dilutions, accuracies_m = 0, 0, (10000, 10000), (100.0,) * 3
        else:
            fix, satellites, dilutions = 3, vehicle.gps_satellites, (70, 110)
            accuracies_m = vehicle.gps_accuracy_m
        return mavlink.MAVLink_gps_raw_int_message(
            self._boot_ms() * 1000,
            fix,
            *place,
            *dilutions,
            speed_cm_s,
            course_cdeg,
            satellites,
            place[2],
            *(round(accuracy_m * 1e3) for accuracy_m in accuracies_m),
        )

    def _attitude(self) -> Any:
        roll, pitch = self._tilt_rad()
        yaw_rad = math.remainder(self.vehicle.estimated_heading_rad, math.tau)
        return mavlink.MAVLink_attitude_message(
            self._boot_ms(), roll, pitch, yaw_rad, 0.0, 0.0, self.vehicle.yaw_rate_rad_s
        )

    def _body(self, vector: Sequence[float]) -> tuple[float, float, float]:
        """From the world frame to the level body frame: forward, right, down."""
        north, east, down = vector
        cos, sin = (
            math.cos(self.vehicle.estimated_heading_rad),
            math.sin(self.vehicle.estimated_heading_rad),
        )
        return cos * north + sin * east, cos * east - sin * north, down

    def _tilt_rad(self) -> tuple[float, float]:
        """Roll and pitch for the horizontal acceleration."""
        forward, right, _ = self._body(self.vehicle.acceleration_m_s2)
        return math.atan2(right, GRAVITY_M_S2), math.atan2(-forward, GRAVITY_M_S2)

    def _global_position_int(self) -> Any:
        """Sent from the first use of GPS on; without GPS by dead reckoning."""
        vehicle = self.vehicle
        if not vehicle.estimator.has_used_gps:
            return None
        latitude, longitude, altitude_mm = _as_integers(vehicle.global_position)
        home = vehicle.global_home
        relative_mm = 0 if home is None else altitude_mm - round(home[2] * 1e3)
        velocity_cm_s = [round(each_m_s * 100.0) for each_m_s in vehicle.estimate_m_s()]
        heading_cdeg = round(math.degrees(vehicle.estimated_heading_rad) * 100.0) % 36000
        return mavlink.MAVLink_global_position_int_message(
            self._boot_ms(),
            latitude,
            longitude,
            altitude_mm,
            relative_mm,
            *velocity_cm_s,
            heading_cdeg,
        )

    def _local_position_ned(self) -> Any:
        """Sent from the start, valid or not."""
        vehicle = self.vehicle
        return mavlink.MAVLink_local_position_ned_message(
            self._boot_ms(),
            *minus(vehicle.estimate_m(), vehicle.estimator_origin_m),
            *vehicle.estimate_m_s(),
        )

    def _vfr_hud(self) -> Any:
        vehicle = self.vehicle
        north_m_s, east_m_s, down_m_s = vehicle.estimate_m_s()
        return mavlink.MAVLink_vfr_hud_message(
            math.nan,
            math.hypot(north_m_s, east_m_s),
            round(math.degrees(vehicle.estimated_heading_rad)) % 360,
            int(100.0 * vehicle.thrust),
            vehicle.global_position[2],
            -down_m_s,
        )

    def _odometry(self) -> Any:
        vehicle = self.vehicle
        half_yaw_rad = vehicle.estimated_heading_rad / 2.0
        level = [math.cos(half_yaw_rad), 0.0, 0.0, math.sin(half_yaw_rad)]
        return mavlink.MAVLink_odometry_message(
            self._boot_ms() * 1000,
            mavlink.MAV_FRAME_LOCAL_NED,
            mavlink.MAV_FRAME_BODY_FRD,
            *vehicle.local_position_m.tolist(),
            level,
            *self._body(vehicle.estimate_m_s()),
            0.0,
            0.0,
            vehicle.yaw_rate_rad_s,
            _UNKNOWN_COVARIANCE,
            _UNKNOWN_COVARIANCE,
            estimator_type=mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT,
        )

    def _autopilot_version(self) -> Any:
        capabilities = (
            mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
            | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
            | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
            | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE
            | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
            | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
        )
        return mavlink.MAVLink_autopilot_version_message(
            capabilities,
            FIRMWARE_VERSION,
            0,
            0,
            0,
            [0] * 8,
            [0] * 8,
            [0] * 8,
            0,
            0,
            self._hardware_uid,
            list(self._hardware_uid.to_bytes(18, "little")),
        )

    def _on_heartbeat(self, message: Any) -> None:
        if message.type == mavlink.MAV_TYPE_GCS:
            self._ground_station_at_s = self.vehicle.time_s
            self.vehicle.ground_station_heartbeat()

    def _on_command(self, message: Any) -> None:
        run = self._commands.get(message.command)
        result = MavResult.UNSUPPORTED if run is None else run(message)
        # Two modules of PX4 handle a mode command, and both answer.
        times = 2 if message.command == mavlink.MAV_CMD_DO_SET_MODE else 1
        for _ in range(times):
            self._send(
                mavlink.MAVLink_command_ack_message(
                    message.command,
                    result,
                    target_system=message.get_srcSystem(),
                    target_component=message.get_srcComponent(),
                )
            )

    def _on_request_event(self, message: Any) -> None:
        """Send missed events again; those too old are ignored."""
        if isinstance(message, _Message):
            first, last = message.first_sequence, message.last_sequence
        else:
            frame = bytes(message.data)
            first, last = struct.unpack("<HH", frame[10 : 10 + frame[1]].ljust(4, b"\0")[:4])
        for event in self._sent_events:
            if (event.sequence - first) % 0x10000 <= (last - first) % 0x10000:
                self._send(event)

    def _arm_or_disarm(self, message: Any) -> MavResult:
        """Force applies to disarming only: no client can arm past the checks."""
        if message.param1 > 0.5:
            return self.vehicle.arm()
        return self.vehicle.disarm(force=message.param2 == FORCE)

    def _set_mode(self, message: Any) -> MavResult:
        return self._enter(_to_int(message.param2), _to_int(message.param3))

    def _on_set_mode(self, message: Any) -> None:
        self._enter(message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24)

    def _enter(self, main_mode: int, sub_mode: int) -> MavResult:
        mode = MODE_BY_CUSTOM.get((main_mode, sub_mode))
        return MavResult.TEMPORARILY_REJECTED if mode is None else self.vehicle.set_mode(mode)

    def _take_off(self, message: Any) -> MavResult:
        long = message.get_type() == "COMMAND_LONG"
        return self.vehicle.take_off(message.param7 if long else message.z)

    def _run_prearm_checks(self, _: Any) -> MavResult:
        return self.vehicle.run_prearm_checks()

    def _land(self, _: Any) -> MavResult:
        return self.vehicle.set_mode(Px4Mode.LAND)

    def _return_to_launch(self, _: Any) -> MavResult:
        return self.vehicle.set_mode(Px4Mode.RETURN)

    def _terminate(self, message: Any) -> MavResult:
        return self.vehicle.disarm(force=True) if message.param1 > 0.5 else MavResult.ACCEPTED

    def _set_message_interval(self, message: Any) -> MavResult:
        """Interval, us; 0 is the default rate, below 0 is off. FAILED for HEARTBEAT."""
        message_id, interval_us = _to_int(message.param1), message.param2
        if message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT or message_id not in self._builders:
            return MavResult.FAILED
        if interval_us == 0.0:
            rate_hz = self._default_rates_hz[message_id]
            self._set_interval(message_id, 1.0 / rate_hz if rate_hz else math.inf)
        else:
            self._set_interval(message_id, interval_us * 1e-6 if interval_us > 0.0 else math.inf)
        return MavResult.ACCEPTED

    def _request_message(self, message: Any) -> MavResult:
        message_id = _to_int(message.param1)
        if message_id not in self._builders:
            return MavResult.DENIED
        sent = self._send_now(message_id, self._on_request.get(message_id))
        return MavResult.ACCEPTED if sent else MavResult.DENIED

    def _request_capabilities(self, _: Any) -> MavResult:
        self._send(self._autopilot_version())
        return MavResult.ACCEPTED

    def _on_setpoint(self, message: Any) -> None:
        if message.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
            return
        values = [message.x, message.y, message.z, message.vx, message.vy, message.vz]
        x, y, z, vx, vy, vz = [
            math.nan if message.type_mask >> bit & 1 or not math.isfinite(value) else value
            for bit, value in enumerate(values)
        ]
        no_yaw = message.type_mask & mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE
        yaw_rad = math.nan if no_yaw or not math.isfinite(message.yaw) else message.yaw
        self.vehicle.offboard(Px4Setpoint((x, y, z), (vx, vy, vz), yaw_rad))

    def _send_parameter(self, name: str) -> None:
        value = self.vehicle.parameters[name]
        if isinstance(value, int):
            kind = mavlink.MAV_PARAM_TYPE_INT32
            value = struct.unpack("<f", struct.pack("<i", value))[0]
        else:
            kind = mavlink.MAV_PARAM_TYPE_REAL32
        names = list(self.vehicle.parameters)
        self._send(
            mavlink.MAVLink_param_value_message(
                name.encode(), value, kind, len(names), names.index(name)
            )
        )

    def _on_param_request_list(self, _: Any) -> None:
        self._parameters_to_send = list(self.vehicle.parameters)

    def _on_param_request_read(self, message: Any) -> None:
        names = list(self.vehicle.parameters)
        if message.param_id == _CHECKSUM:
            # Checksum of all names and values, encoded bytewise in the float.
            checksum = zlib.crc32(repr(sorted(self.vehicle.parameters.items())).encode())
            bits = struct.unpack("<f", struct.pack("<I", checksum))[0]
            self._send(
                mavlink.MAVLink_param_value_message(
                    _CHECKSUM.encode(), bits, mavlink.MAV_PARAM_TYPE_UINT32, len(names), 0xFFFF
                )
            )
        elif 0 <= message.param_index < len(names):
            self._send_parameter(names[message.param_index])
        elif message.param_id in self.vehicle.parameters:
            self._send_parameter(message.param_id)

    def _on_param_set(self, message: Any) -> None:
        name, parameters = message.param_id, self.vehicle.parameters
        if name not in parameters:
            return
        is_int = isinstance(parameters[name], int)
        kind = mavlink.MAV_PARAM_TYPE_INT32 if is_int else mavlink.MAV_PARAM_TYPE_REAL32
        if message.param_type != kind:
            return
        packed = struct.pack("<f", message.param_value)
        parameters[name] = struct.unpack("<i" if is_int else "<f", packed)[0]
        self._send_parameter(name)

    def _fence_id(self) -> int:
        """Checksum of the fence; 0 without one."""
        corners_deg = [(each.inclusion, each.vertices_deg) for each in self.vehicle.fence]
        return zlib.crc32(repr(corners_deg).encode()) if corners_deg else 0

    def _answer_mission(self, message: Any, result: int, fence_id: int = 0) -> None:
        self._send(
            _Message(
                mavlink.MAVLINK_MSG_ID_MISSION_ACK, "MISSION_ACK", 153, "<BBBBI",
                target_system=message.get_srcSystem(),
                target_component=message.get_srcComponent(), type=result,
                mission_type=message.mission_type, opaque_id=fence_id,
            )
        )  # fmt: skip

    def _on_mission_count(self, message: Any) -> None:
        if message.mission_type != _FENCE:
            self._answer_mission(message, mavlink.MAV_MISSION_UNSUPPORTED)
            return
        self._upload, self._upload_count = [], message.count
        self._request_next_item(message)

    def _on_mission_item(self, message: Any) -> None:
        if message.mission_type != _FENCE or message.seq != len(self._upload):
            return
        if message.command not in _FENCE_VERTICES:
            self._answer_mission(message, mavlink.MAV_MISSION_UNSUPPORTED)
            return
        self._upload.append(message)
        self._request_next_item(message)

    def _request_next_item(self, message: Any) -> None:
        if len(self._upload) < self._upload_count:
            self._send(
                mavlink.MAVLink_mission_request_int_message(
                    message.get_srcSystem(), message.get_srcComponent(), len(self._upload), _FENCE
                )
            )
            return
        polygons = _to_polygons(self._upload)
        if polygons is None:
            self._answer_mission(message, mavlink.MAV_MISSION_INVALID_PARAM1)
            return
        self.vehicle.fence = polygons
        self._answer_mission(message, mavlink.MAV_MISSION_ACCEPTED, self._fence_id())

    def _on_mission_request_list(self, message: Any) -> None:
        vertices, fence_id = 0, 0
        if message.mission_type == _FENCE:
            vertices = sum(len(polygon.vertices_deg) for polygon in self.vehicle.fence)
            fence_id = self._fence_id()
        self._send(
            _Message(
                mavlink.MAVLINK_MSG_ID_MISSION_COUNT, "MISSION_COUNT", 221, "<HBBBI",
                count=vertices, target_system=message.get_srcSystem(),
                target_component=message.get_srcComponent(), mission_type=message.mission_type,
                opaque_id=fence_id,
            )
        )  # fmt: skip

    def _on_mission_request(self, message: Any) -> None:
        items = [(polygon, v) for polygon in self.vehicle.fence for v in polygon.vertices_deg]
        if message.mission_type != _FENCE or message.seq >= len(items):
            self._answer_mission(message, mavlink.MAV_MISSION_INVALID_SEQUENCE)
            return
        polygon, (latitude_deg, longitude_deg) = items[message.seq]
        command = next(c for c, inside in _FENCE_VERTICES.items() if inside is polygon.inclusion)
        self._send(
            mavlink.MAVLink_mission_item_int_message(
                message.get_srcSystem(),
                message.get_srcComponent(),
                message.seq,
                mavlink.MAV_FRAME_GLOBAL_INT,
                command,
                0,
                0,
                float(len(polygon.vertices_deg)),
                0.0,
                0.0,
                0.0,
                round(latitude_deg * 1e7),
                round(longitude_deg * 1e7),
                0.0,
                _FENCE,
            )
        )

    def _on_mission_clear_all(self, message: Any) -> None:
        if message.mission_type in (_FENCE, mavlink.MAV_MISSION_TYPE_ALL):
            self.vehicle.fence = ()
        self._answer_mission(message, mavlink.MAV_MISSION_ACCEPTED)


def _to_int(parameter: float) -> int:
    """A command's integer parameter; -1 if it is not finite."""
    return int(parameter) if math.isfinite(parameter) else -1


def _as_integers(place: tuple[float, float, float]) -> tuple[int, int, int]:
    """Degrees and metres in MAVLink's units: 1e-7 degrees and mm."""
    latitude_deg, longitude_deg, altitude_m = place
    return round(latitude_deg * 1e7), round(longitude_deg * 1e7), round(altitude_m * 1e3)


def _to_polygons(items: list[Any]) -> tuple[FencePolygon, ...] | None:
    """Polygons of the vertices; None if a vertex count (param 1) is inconsistent."""
    polygons: list[FencePolygon] = []
    while items:
        count = max(_to_int(items[0].param1), 0)
        polygon, items = items[:count], items[count:]
        if count < 3 or [item.param1 for item in polygon] != [count] * count:
            return None
        polygons.append(
            FencePolygon(
                _FENCE_VERTICES[polygon[0].command],
                tuple((item.x * 1e-7, item.y * 1e-7) for item in polygon),
            )
        )
    return tuple(polygons)
