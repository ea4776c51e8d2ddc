"""PX4's telemetry: MAVLink messages -> `VehicleState`. No socket, thread or clock.

Messages have the names, fields and units of MAVLink's common dialect.
"""

import math
import re
import struct
from collections import deque
from collections.abc import Mapping
from threading import Lock
from types import SimpleNamespace
from typing import Any, NamedTuple

from msgspec.structs import asdict

from edge.core.vehicle import (
    GPS_CONTROL,
    AutopilotReason,
    EstimatorStatus,
    GlobalOrigin,
    Gps,
    Mode,
    Vector,
    VehicleState,
)
from edge.drivers.px4.events import Px4Events, without_repetition
from edge.drivers.px4.raw_mavlink import mode_name

Fields = Mapping[str, Any]

# Message -> requested rate, Hz. PX4 sends HEARTBEAT at 1 Hz, whatever is requested.
RATES_HZ = {
    1: 5.0,  # SYS_STATUS
    24: 10.0,  # GPS_RAW_INT: so that a stuck receiver is noticed soon
    32: 20.0,  # LOCAL_POSITION_NED
    33: 5.0,  # GLOBAL_POSITION_INT
    49: 5.0,  # GPS_GLOBAL_ORIGIN: sent when it changes, so this bounds the delay
    74: 5.0,  # VFR_HUD: thrust
    230: 5.0,  # ESTIMATOR_STATUS: at a lower rate, a single glitch would stop a robot
    245: 5.0,  # EXTENDED_SYS_STATE
}
# Any message shows that the vehicle is connected. Its mode is unknown after a silence of the first
# duration, and without a heartbeat for the second. PX4 sends one every second, and on request.
_CONNECTED_WITHIN_S, _HEARTBEAT_WITHIN_S = 2.5, 10.0
_TWIN_WITHIN_S = 5.0
# Requested at 5 Hz; older values say nothing about the present.
_SYS_STATUS_VALID_S = 2.5
_THRUST_VALID_S = 2.5
# A single warning counts for this time, and as long as a failsafe lasts.
_WARNING_VALID_S = 15.0
# The reason for a failsafe precedes its state by up to a heartbeat.
_FAILSAFE_LATE_S = 2.5

# A position has jumped if it differs from the extrapolated one by more than this, plus as much for
# each second in between.
_JUMP_M, _JUMP_M_S = 1.0, 1.0
_ORIGIN_ANSWER_S = 0.5
# PX4 reports a landing for COM_DISARM_LAND, 2 s, before it disarms: at least this long.
_LANDED_BEFORE_S = 0.3
# After a longer silence, motion and a jump in height cannot be told apart.
_HEIGHT_JUMP_WITHIN_S = 1.0

# PX4 reports PREARM_CHECK in the health bits only, not among the sensors present.
_SENSOR_RC, _PREARM_CHECK = 1 << 16, 1 << 28
_VELOCITY_HORIZ, _POS_HORIZ_ABS, _GPS_GLITCH = 1 << 1, 1 << 4, 1 << 10
_SAFETY_ARMED = 1 << 7
_CRITICAL, _EMERGENCY = 5, 6  # MAV_STATE
_AUTOPILOT_INVALID = 8
_WARNING = 4
_ON_GROUND = 1
_UNKNOWN_UINT16 = 0xFFFF
_FIX_3D = 3
# PX4's default of EKF2_GPS_CTRL, 7: horizontal position, height and velocity.
_ALL_OF_GPS: float = struct.unpack("<f", struct.pack("<i", 7))[0]
# Time constant of a receiver's slip: short multipath errors fade, and a drift of 0.5 m/s adds up
# to 5 m.
_SLIP_S = 10.0
# After a longer pause the receiver's movement is unknown.
_SLIP_WITHIN_S, _SLIP_JUMP_M = 1.0, 3.0
_M_PER_DEG = 111_195.0  # of latitude, on a sphere, accurate enough for differences of metres
_REFUSAL = re.compile(r"^(?:\w+ denied|preflight fail)[:!]?\s*", re.IGNORECASE)


class Px4Telemetry:
    """The newest known state of one vehicle. Thread-safe.

    Times are by the robot's monotonic clock, s. Messages that were held up by this process or the
    link arrive together. The vehicle's own clock shows their age, so that `position_at_s` and
    `heartbeat_at_s` are the times at which they were due.

    Position and origin always belong together. A position that jumps is withheld until the origin
    has been received again, for at most 0.5 s. A new origin applies from the next position on.

    `messages` are the names of the messages that `receive` processes.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        # Fields of the `VehicleState`.
        self._newest = SimpleNamespace(**asdict(VehicleState()))
        # The last state and its other fields; None after a change.
        self._cached: tuple[dict[str, Any], VehicleState] | None = None
        self._clock = _VehicleClock()
        self._hardware_at_s: dict[tuple[int, ...], float] = {}
        self._alive_at_s = self._alive_since_s = -math.inf
        self._sys_status_at_s = self._thrust_at_s = -math.inf
        # Since arming: the last report to be in the air, and the first after it of a landing.
        self._in_air_at_s = self._landed_at_s = -math.inf
        # By the vehicle's clock, since held-up messages arrive together.
        self._boot_s = self._landed_at_boot_s = 0.0
        # The last disarming was not preceded by a report of a landing.
        self._disarmed_aloft = False
        self._fix: _Fix | None = None
        self._gps_time_us: int | None = None
        self._jump_at_s: float | None = None
        self._origin: GlobalOrigin | None = None
        self._origin_at_s = -math.inf
        # EKF2_GPS_CTRL before the receiver was ignored.
        self.gps_control = _ALL_OF_GPS
        self._texts: deque[tuple[float, str]] = deque(maxlen=16)
        self._events = Px4Events()
        self._failsafe_at_s = -math.inf
        self._fence: tuple[int, float] = 0, -math.inf
        self._handlers = {
            "HEARTBEAT": self._on_heartbeat,
            "SYS_STATUS": self._on_sys_status,
            "GPS_RAW_INT": self._on_gps_raw_int,
            "LOCAL_POSITION_NED": self._on_local_position_ned,
            "GLOBAL_POSITION_INT": self._on_global_position_int,
            "GPS_GLOBAL_ORIGIN": self._on_gps_global_origin,
            "ESTIMATOR_STATUS": self._on_estimator_status,
            "EXTENDED_SYS_STATE": self._on_extended_sys_state,
            "PARAM_VALUE": self._on_param_value,
            "VFR_HUD": self._on_vfr_hud,
            "STATUSTEXT": self._on_statustext,
            "EVENT": self._events.receive,
            "CURRENT_EVENT_SEQUENCE": self._events.receive_sequence,
            "AUTOPILOT_VERSION": self._on_autopilot_version,
            "MISSION_CURRENT": self._on_mission_current,
        }
        self.messages = tuple(self._handlers)

    def receive(self, name: str, fields: Fields, now_s: float) -> None:
        """Process one message of the autopilot.

        Raises KeyError, TypeError or ValueError for an invalid one; nothing changes then.
        """
        with self._lock:
            self._handlers[name](fields, now_s)
            at_s = now_s - self._clock.delay_s
            if at_s - self._alive_at_s > _CONNECTED_WITHIN_S:
                self._alive_since_s = at_s
            self._alive_at_s = at_s

    def state(self, now_s: float, **of_link: Any) -> VehicleState:
        """The newest state; `of_link` are the fields of the link and of commands.

        Returns the same object until something changes.
        """
        with self._lock:
            newest = self._newest
            is_alive = now_s - self._alive_at_s < _CONNECTED_WITHIN_S
            mode_known_s = max(self._alive_since_s, now_s - _HEARTBEAT_WITHIN_S)
            knows_mode = newest.heartbeat_at_s >= mode_known_s
            fields = of_link | {"connected": is_alive and knows_mode}
            armable = newest.armable
            if now_s - self._sys_status_at_s > _SYS_STATUS_VALID_S:
                armable = None
                fields |= dict.fromkeys(("armable", "battery", "voltage_v", "remote_control"))
            if now_s - self._thrust_at_s > _THRUST_VALID_S:
                fields["thrust"] = None
            if newest.armed:
                warnings = self._events.warnings(self._warnings_since_s(now_s))
                present = self._events.present_faults(newest.mode)
                fields["warnings"] = (
                    without_repetition((*warnings, *present)) if warnings else present
                )
            elif not armable:
                fields["problems"] = self._arming_problems(now_s - _WARNING_VALID_S)
            if self._cached is None or self._cached[0] != fields:
                self._cached = fields, VehicleState(**vars(newest) | fields)
            return self._cached[1]

    def needs_origin(self) -> bool:
        """Whether the position has jumped and the origin has not been received since."""
        return self._jump_at_s is not None

    def has_twin(self, now_s: float) -> bool:
        """Whether two vehicles use the same system id, by their hardware ids.

        Some boards all have the same hardware id.
        """
        with self._lock:
            since_s = now_s - _TWIN_WITHIN_S
            return sum(at_s > since_s for at_s in self._hardware_at_s.values()) > 1

    def restarts(self) -> int:
        """Number of detected restarts of the vehicle."""
        with self._lock:
            return self._clock.restarts

    def fence_id(self, since_s: float) -> int | None:
        """Id of PX4's fence received since then, 0 without a fence; None if none was received."""
        with self._lock:
            fence_id, at_s = self._fence
            return fence_id if at_s >= since_s else None

    def missing_events(self) -> tuple[int, int] | None:
        """First and last sequence number of lost events; None if none are missing."""
        with self._lock:
            return self._events.missing()

    def refusal_reasons(self, since_s: float) -> tuple[AutopilotReason, ...]:
        """Reasons for the refusal of a command sent then: warnings since, and present problems."""
        with self._lock:
            warnings = self._events.warnings(since_s)
            return without_repetition((*warnings, *self._arming_problems(since_s)))

    def _warnings_since_s(self, now_s: float) -> float:
        since_s = now_s - _WARNING_VALID_S
        if self._newest.failsafe:
            return min(since_s, self._failsafe_at_s - _FAILSAFE_LATE_S)
        return since_s

    def _arming_problems(self, since_s: float) -> tuple[AutopilotReason, ...]:
        """Problems by PX4's checks; without these, by texts received since then."""
        texts = {text: None for at_s, text in self._texts if at_s >= since_s}
        by_text = tuple(AutopilotReason("text", (), text) for text in texts)
        return self._events.arming_problems(self._newest.mode) or by_text

    def _change(self, **changes: Any) -> None:
        vars(self._newest).update(changes)
        self._cached = None

    def _on_heartbeat(self, fields: Fields, now_s: float) -> None:
        if fields["autopilot"] == _AUTOPILOT_INVALID:
            return
        failsafe = fields["system_status"] in (_CRITICAL, _EMERGENCY)
        if failsafe and not self._newest.failsafe:
            self._failsafe_at_s = now_s
        armed = bool(fields["base_mode"] & _SAFETY_ARMED)
        if armed and not self._newest.armed:
            self._in_air_at_s = self._landed_at_s = -math.inf
            self._change(height_jumped_m=0.0, fell=False)
        elif self._newest.armed and not armed:
            landed_s = max(now_s - self._landed_at_s, self._boot_s - self._landed_at_boot_s)
            landed = self._landed_at_s > -math.inf and landed_s >= _LANDED_BEFORE_S
            self._disarmed_aloft = self._in_air_at_s > -math.inf and not landed
            # No vehicle lands and is disarmed unnoticed within this time.
            lately = now_s - self._in_air_at_s < _CONNECTED_WITHIN_S
            self._change(fell=self._disarmed_aloft and lately)
        self._change(
            mode=Mode(mode_name(fields["custom_mode"])),
            armed=armed,
            failsafe=failsafe,
            heartbeat_at_s=now_s - self._clock.delay_s,
        )

    def _on_sys_status(self, fields: Fields, now_s: float) -> None:
        present = fields["onboard_control_sensors_present"]
        healthy = fields["onboard_control_sensors_health"]
        percent, millivolts = fields["battery_remaining"], fields["voltage_battery"]
        self._change(
            armable=bool(healthy & _PREARM_CHECK),
            battery=percent / 100.0 if percent >= 0 else None,
            voltage_v=None if millivolts == _UNKNOWN_UINT16 else millivolts / 1e3,
            remote_control=bool(present & healthy & _SENSOR_RC),
        )
        self._sys_status_at_s = now_s - self._clock.delay_s

    def _on_gps_raw_int(self, fields: Fields, now_s: float) -> None:
        hundredths, satellites = fields["eph"], fields["satellites_visible"]
        accuracy_mm, has_fix = fields["h_acc"], fields["fix_type"] >= _FIX_3D
        before = self._newest.gps or Gps(fix=0, satellites=0, hdop=math.inf)
        received_at_s = now_s - self._clock.delay_s
        # PX4 continues to send the last measurement of a silent receiver.
        is_new = fields["time_usec"] != self._gps_time_us
        self._gps_time_us = fields["time_usec"]
        last, fix = self._fix, self._measured(fields) if has_fix else None
        moved = last is None or fix is None or fix.place != last.place
        if is_new or fix is None:
            self._fix = fix if fix is None or last is None else fix.after(last)
        self._change(
            gps=Gps(
                fix=fields["fix_type"],
                satellites=0 if satellites == 0xFF else satellites,
                hdop=math.inf if hundredths == _UNKNOWN_UINT16 else hundredths / 100.0,
                accuracy_m=accuracy_mm / 1e3 if accuracy_mm and has_fix else None,
                offset_m=None if fix is None else self._offset_m(fix.place),
                velocity_offset_m_s=None if fix is None else self._velocity_offset_m_s(fix),
                slip_m=None if self._fix is None else self._fix.length_of_slip_m,
                at_s=received_at_s if is_new else before.at_s,
                repeats=0 if moved else before.repeats + is_new,
            )
        )

    def _measured(self, fields: Fields) -> "_Fix":
        place = GlobalOrigin(fields["lat"] / 1e7, fields["lon"] / 1e7, fields["alt"] / 1e3)
        speed, course = fields["vel"], fields["cog"]
        velocity_m_s = None
        if _UNKNOWN_UINT16 not in (speed, course):
            speed_m_s, estimated_m_s = speed / 100.0, self._newest.velocity_local_m_s
            if estimated_m_s is not None:
                # The speed of some of PX4's drivers, such as DroneCAN's, includes the climb rate.
                level_m_s = math.sqrt(max(speed_m_s**2 - estimated_m_s[2] ** 2, 0.0))
                expected_m_s = math.hypot(*estimated_m_s[:2])
                speed_m_s = min(speed_m_s, level_m_s, key=lambda each: abs(each - expected_m_s))
            course_rad = math.radians(course / 100.0)
            velocity_m_s = speed_m_s * math.cos(course_rad), speed_m_s * math.sin(course_rad)
        return _Fix(fields["time_usec"] / 1e6, place, velocity_m_s)

    def _offset_m(self, place: GlobalOrigin) -> float | None:
        """Horizontal distance of a place from the newest position."""
        origin, position_m = self._newest.origin, self._newest.position_local_m
        if origin is None or position_m is None:
            return None
        north_m, east_m, _ = _shift_m(origin, place)
        return math.hypot(north_m - position_m[0], east_m - position_m[1])

    def _velocity_offset_m_s(self, fix: "_Fix") -> float | None:
        velocity_m_s = self._newest.velocity_local_m_s
        if fix.velocity_m_s is None or velocity_m_s is None:
            return None
        return math.dist(fix.velocity_m_s, velocity_m_s[:2])

    def _on_estimator_status(self, fields: Fields, now_s: float) -> None:
        flags, wanted = fields["flags"], _VELOCITY_HORIZ | _POS_HORIZ_ABS
        # The estimator rejects what lies beyond a ratio of 1.
        ratios = fields["vel_ratio"], fields["pos_horiz_ratio"]
        rejects = any(ratio is not None and ratio > 1.0 for ratio in ratios)
        self._change(
            estimator=EstimatorStatus(
                horizontal=flags & wanted == wanted,
                glitch=bool(flags & _GPS_GLITCH) or rejects,
                at_s=now_s - self._clock.delay_s,
            )
        )

    def _on_param_value(self, fields: Fields, _: float) -> None:
        if fields["param_id"] == GPS_CONTROL:
            # An integer parameter is received as a float with the same bits.
            self.gps_control = fields["param_value"] or self.gps_control
            self._change(ignores_gps=fields["param_value"] == 0.0)

    def _on_global_position_int(self, fields: Fields, _: float) -> None:
        changes: dict[str, float] = {"height_above_home_m": fields["relative_alt"] / 1e3}
        if fields["hdg"] != _UNKNOWN_UINT16:
            changes["heading_rad"] = math.radians(fields["hdg"] / 100.0 % 360.0)
        self._change(**changes)

    def _on_mission_current(self, fields: Fields, now_s: float) -> None:
        # PX4 v1.14 has no fence id.
        self._fence = fields.get("fence_id", 0), now_s

    def _on_extended_sys_state(self, fields: Fields, now_s: float) -> None:
        state = fields["landed_state"]
        in_air = state > _ON_GROUND if state else None
        if in_air and self._newest.armed:
            self._in_air_at_s, self._landed_at_s = now_s, -math.inf
        elif in_air is False and self._landed_at_s == -math.inf:
            self._landed_at_s, self._landed_at_boot_s = now_s, self._boot_s
        self._change(in_air=in_air)

    def _on_vfr_hud(self, fields: Fields, now_s: float) -> None:
        self._change(thrust=fields["throttle"] / 100.0)
        self._thrust_at_s = now_s - self._clock.delay_s

    def _on_gps_global_origin(self, fields: Fields, now_s: float) -> None:
        self._origin = GlobalOrigin(
            fields["latitude"] / 1e7, fields["longitude"] / 1e7, fields["altitude"] / 1e3
        )
        self._origin_at_s = now_s
        if self._newest.position_local_m is None:
            self._change(origin=self._origin)

    def _on_local_position_ned(self, fields: Fields, now_s: float) -> None:
        position_m = _vector(fields, "x", "y", "z")
        velocity_m_s = _vector(fields, "vx", "vy", "vz")
        boot_s = fields["time_boot_ms"] / 1e3
        restarts, self._boot_s = self._clock.restarts, boot_s
        at_s = now_s - self._clock.receive(boot_s, now_s)
        if self._clock.restarts > restarts and not self._newest.armed:
            self._change(fell=self._disarmed_aloft)
        was_withheld = self._jump_at_s is not None
        last = self._newest
        between_s = max(at_s - last.position_at_s, 0.0)
        off_m = self._off_m(position_m, velocity_m_s, between_s)
        if self._withholds(off_m, between_s, now_s):
            return
        changed = (position_m, velocity_m_s) != (last.position_local_m, last.velocity_local_m_s)
        # The jump was seen without delay, so the time of withholding does not excuse it.
        unexplained = was_withheld and self._origin == last.origin
        uncertain_s = 0.0 if unexplained else between_s
        jumped = _is_jump(off_m, uncertain_s)
        height_jumped_m = last.height_jumped_m
        if jumped and last.armed and between_s <= _HEIGHT_JUMP_WITHIN_S:
            height_jumped_m -= off_m[2]
        self._change(
            position_local_m=position_m,
            velocity_local_m_s=velocity_m_s,
            position_at_s=at_s,
            position_changed_at_s=at_s if changed else last.position_changed_at_s,
            jumped_at_s=at_s if jumped else last.jumped_at_s,
            height_jumped_m=height_jumped_m,
            origin=self._origin,
        )

    def _withholds(self, off_m: Vector, between_s: float, now_s: float) -> bool:
        """Whether to withhold a position that may belong to an origin not received yet."""
        if self._origin != self._newest.origin:
            self._jump_at_s = None
        elif self._jump_at_s is not None:
            answered = self._origin_at_s > self._jump_at_s
            if answered or now_s - self._jump_at_s > _ORIGIN_ANSWER_S:
                self._jump_at_s = None
        elif _is_jump(off_m, between_s):
            self._jump_at_s = now_s
        return self._jump_at_s is not None

    def _off_m(self, position_m: Vector, velocity_m_s: Vector, between_s: float) -> Vector:
        """Offset of a position from the extrapolated last one, corrected for a changed origin."""
        last_m, last_m_s = self._newest.position_local_m, self._newest.velocity_local_m_s
        origin, last_origin = self._origin, self._newest.origin
        if last_m is None or last_m_s is None:
            return 0.0, 0.0, 0.0
        shift = (0.0, 0.0, 0.0)
        if origin is not None and last_origin is not None and origin != last_origin:
            shift = _shift_m(last_origin, origin)
        now, last, now_m_s = position_m, last_m, velocity_m_s
        return (
            now[0] + shift[0] - last[0] - (last_m_s[0] + now_m_s[0]) / 2.0 * between_s,
            now[1] + shift[1] - last[1] - (last_m_s[1] + now_m_s[1]) / 2.0 * between_s,
            now[2] + shift[2] - last[2] - (last_m_s[2] + now_m_s[2]) / 2.0 * between_s,
        )

    def _on_statustext(self, fields: Fields, now_s: float) -> None:
        text = fields["text"].strip()
        if fields["chunk_seq"] and self._texts:
            at_s, start = self._texts.pop()
            self._texts.append((at_s, start + text))
        elif fields["severity"] <= _WARNING:
            self._texts.append((now_s, _REFUSAL.sub("", text)))

    def _on_autopilot_version(self, fields: Fields, now_s: float) -> None:
        self._hardware_at_s[(fields["uid"], *fields["uid2"])] = now_s
        version = fields["flight_sw_version"]
        if version:
            self._change(version=".".join(str(version >> bits & 0xFF) for bits in (24, 16, 8)))


class _Fix(NamedTuple):
    """One measurement of a receiver: time, place, and north and east velocity.

    `slip_m` is the recent difference, north and east, between the movement of its place and its
    velocity.
    """

    time_s: float
    place: GlobalOrigin
    velocity_m_s: tuple[float, float] | None
    slip_m: tuple[float, float] = (0.0, 0.0)

    @property
    def length_of_slip_m(self) -> float | None:
        return None if self.velocity_m_s is None else math.hypot(*self.slip_m)

    def after(self, last: "_Fix") -> "_Fix":
        """This measurement with the slip since an earlier one added."""
        between_s = self.time_s - last.time_s
        if self.velocity_m_s is None or last.velocity_m_s is None:
            return self
        if not 0.0 < between_s <= _SLIP_WITHIN_S:
            return self
        north_m, east_m, _ = _shift_m(last.place, self.place)
        (was_north, was_east), (is_north, is_east) = last.velocity_m_s, self.velocity_m_s
        north_m -= (was_north + is_north) / 2.0 * between_s
        east_m -= (was_east + is_east) / 2.0 * between_s
        # Jumps are detected separately.
        if math.hypot(north_m, east_m) >= _SLIP_JUMP_M:
            north_m = east_m = 0.0
        kept, (last_north_m, last_east_m) = math.exp(-between_s / _SLIP_S), last.slip_m
        slip_m = kept * last_north_m + north_m, kept * last_east_m + east_m
        return _Fix(self.time_s, self.place, self.velocity_m_s, slip_m)


class _VehicleClock:
    """Estimates the delay of messages from the vehicle's clock.

    While a backlog drains, the vehicle's time passes faster than ours. Once messages arrive at the
    vehicle's pace again, the delay is 0, and any remaining difference is clock drift.
    """

    _RESTART_S = 1.0
    _AT_PACE = 10

    def __init__(self) -> None:
        self.delay_s = 0.0
        self.restarts = 0
        self._last: tuple[float, float] | None = None
        self._at_pace = 0

    def receive(self, vehicle_s: float, now_s: float) -> float:
        """Add a message sent at `vehicle_s` by the vehicle's clock; returns its delay, s."""
        last_vehicle_s, last_now_s = self._last or (vehicle_s, now_s)
        self._last = vehicle_s, now_s
        sent_between_s, between_s = vehicle_s - last_vehicle_s, now_s - last_now_s
        if sent_between_s < -self._RESTART_S:
            self.restarts += 1
            self.delay_s = 0.0
            return 0.0
        self.delay_s = max(self.delay_s + between_s - sent_between_s, 0.0)
        regular = 0.5 * sent_between_s <= between_s <= 2.0 * sent_between_s + 0.1
        self._at_pace = self._at_pace + 1 if regular else 0
        if self._at_pace >= self._AT_PACE:
            self._at_pace = 0
            self.delay_s = 0.0
        return self.delay_s


def _vector(fields: Fields, x: str, y: str, z: str) -> Vector:
    """Raises TypeError for a number that is not finite, which the message has as None."""
    return float(fields[x]), float(fields[y]), float(fields[z])


def _is_jump(off_m: Vector, between_s: float) -> bool:
    return math.hypot(*off_m) > _JUMP_M + _JUMP_M_S * between_s


def _shift_m(start: GlobalOrigin, end: GlobalOrigin) -> Vector:
    """North, east and down, m, from one place to a near one."""
    east_deg = math.remainder(end.longitude_deg - start.longitude_deg, 360.0)
    return (
        (end.latitude_deg - start.latitude_deg) * _M_PER_DEG,
        east_deg * _M_PER_DEG * math.cos(math.radians(start.latitude_deg)),
        start.altitude_m - end.altitude_m,
    )
