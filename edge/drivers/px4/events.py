"""Why PX4 does not arm, and why it takes over: its EVENT messages in, reasons out.

No socket, thread or clock. PX4 sends events on every link, also to a companion, where STATUSTEXT
goes only to a ground station. An event carries the hash of its name and arguments, no words: the
words here are ours, so that they are there at once and on any vehicle, also on one that does not
give its own over MAVLink. Names and arguments are those of v1.14 to v1.17, ModalAI's v1.14 too.

PX4 reports all that its checks find in one go, whenever that changes or RUN_PREARM_CHECKS asks for
it: a summary, the checks that fail, another summary. What a report does not name has passed.
"""

import re
import struct
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from edge.core.vehicle import AutopilotReason, Mode

_WARNING, _ERROR = 4, 3

# An event's arguments, as struct has them; capitals A, C, S and G stand for one byte that says:
_VALUES: dict[str, dict[int, str]] = {
    "A": {
        1: "warns",
        2: "gives it to the sticks, in position mode",
        3: "gives it to the sticks, in altitude mode",
        4: "gives it to the sticks, stabilized",
        5: "holds",
        6: "returns",
        7: "lands",
        8: "descends",
        9: "disarms",
        10: "stops its motors",
    },
    "C": {
        1: "remote control lost",
        2: "ground station lost",
        3: "battery low",
        4: "battery critical",
        5: "battery nearly empty",
        6: "battery lasts for little more than the way home",
    },
    "S": {0: "accelerometer", 1: "gyroscope", 2: "compass"},
    "G": {0: "too far from home", 1: "too high above home", 2: "at or beyond the fence"},
}

# Name -> text, or text and the types of the arguments that it shows.
_WORDS: dict[str, str | tuple[str, str]] = {
    # Sensors
    "check_accel_missing": ("accelerometer {0} is missing", "B"),
    "check_accel_no_data": ("no data from accelerometer {0}", "B"),
    "check_accel_not_calibrated": ("accelerometer {0} is not calibrated", "B"),
    "check_gyro_missing": ("gyroscope {0} is missing", "B"),
    "check_gyro_no_data": ("no data from gyroscope {0}", "B"),
    "check_gyro_not_calibrated": ("gyroscope {0} is not calibrated", "B"),
    "check_baro_missing": ("barometer {0} is missing", "B"),
    "check_baro_no_data": ("no data from barometer {0}", "B"),
    "check_mag_missing": ("compass {0} is missing", "B"),
    "check_mag_no_data": ("no data from compass {0}", "B"),
    "check_mag_not_calibrated": ("compass {0} is not calibrated", "B"),
    "check_mag_fault": ("compass {0} disturbs the estimator", "B"),
    "check_mag_consistency": ("compasses differ by {0} degrees", "h"),
    "check_mag_sys_has_mag_missing": ("{0} compasses work, {1} must", "BB"),
    "check_imu_accel_inconsistent": ("accelerometer {0} differs from the others", "B"),
    "check_imu_gyro_inconsistent": ("gyroscope {0} differs from the others", "B"),
    "check_distance_sensor_missing": ("range sensor {0} is missing", "B"),
    "check_distance_sensor_invalid": ("no data from range sensor {0}", "B"),
    "check_optical_sensor_missing": "optical flow sensor is missing",
    "check_optical_flow_sensor_invalid": "no data from the optical flow sensor",
    "check_airspeed_no_data": "no data from the airspeed sensor",
    "check_airspeed_invalid": "airspeed is not valid",
    "check_airspeed_too_high": "airspeed is too high",
    "sensor_failover": ("{0} {1} failed: land", "SB"),
    "sensor_failover_baro": ("barometer {0} failed: land", "B"),
    "sensor_failover_mag": ("compass {0} failed: land", "B"),
    "vehicle_imu_accel_clipping": ("accelerometer {0} is shaken beyond its range", "B"),
    "vehicle_imu_gyro_clipping": ("gyroscope {0} is shaken beyond its range", "B"),
    # Estimator
    "check_estimator_missing_data": "the estimator has not started yet",
    "check_estimator_heading_not_stable": "heading is not stable",
    "check_estimator_hgt_not_stable": "height is not stable",
    "check_estimator_hor_pos_not_stable": "horizontal position is not stable",
    "check_estimator_hor_vel_not_stable": "horizontal velocity is not stable",
    "check_estimator_vert_vel_not_stable": "vertical velocity is not stable",
    "check_estimator_hgt_est_err": "height estimate is poor",
    "check_estimator_pos_est_err": "position estimate is poor",
    "check_estimator_vel_est_err": "velocity estimate is poor",
    "check_estimator_yaw_est_err": "heading estimate is poor",
    "check_estimator_nav_failure": "the estimator has failed",
    "check_estimator_low_position_accuracy": "position is not accurate",
    "check_estimator_position_failure_imminent": "position is about to be lost",
    "check_estimator_high_accel_bias": "an accelerometer's bias is high: calibrate it",
    "check_estimator_high_gyro_bias": "a gyroscope's bias is high: calibrate it",
    "check_estimator_mag_interference": "strong magnetic disturbance",
    "check_estimator_mag_fault": "compass is no longer used: land",
    "check_modes_angular_velocity": "angular velocity is not known",
    "check_modes_attitude": "attitude is not known",
    "check_modes_local_alt": "height is not known",
    "check_modes_local_pos": "position is not known",
    "check_modes_global_pos": "latitude and longitude are not known",
    "check_system_no_global_pos": "latitude and longitude are required",
    # GPS
    "check_estimator_gnss_fault": "heading by GPS is not to be trusted",
    "check_estimator_gnss_fusion_stopped": "GPS is no longer used",
    "check_estimator_gnss_warning_spoofing": "GPS is being spoofed",
    "check_estimator_gps_spoofed": "GPS is being spoofed",
    "check_estimator_gps_spoofing_indicated": "GPS is being spoofed",
    "check_estimator_gps_multiple_spoofing_indicated": "GPS is being spoofed, in several ways",
    "check_estimator_gps_jamming_critical": "GPS is being jammed",
    "check_estimator_gps_generic": "GPS is poor",
    "check_estimator_gps_not_fusing": "the estimator does not use GPS",
    "check_estimator_gps_fix_too_low": "GPS has no 3-D fix",
    "check_estimator_gps_num_sats_too_low": "GPS has too few satellites",
    "check_estimator_gps_pdop_too_high": "GPS has its satellites badly placed (PDOP)",
    "check_estimator_gps_hor_pos_err_too_high": "GPS position is not accurate",
    "check_estimator_gps_vert_pos_err_too_high": "GPS height is not accurate",
    "check_estimator_gps_speed_acc_too_low": "GPS velocity is not accurate",
    "check_estimator_gps_hor_pos_drift_too_high": "GPS position drifts",
    "check_estimator_gps_vert_pos_drift_too_high": "GPS height drifts",
    "check_estimator_gps_hor_speed_drift_too_high": "GPS velocity drifts",
    "check_estimator_gps_vert_speed_drift_too_high": "GPS vertical velocity drifts",
    # Power and motors
    "check_battery_missing": ("battery {0} is missing", "B"),
    "check_battery_disconnected": ("battery {0} is disconnected", "B"),
    "check_battery_fault": ("battery {0} reports fault {1}", "BB"),
    "check_battery_mode": ("battery {0} is in a mode that does not fly ({1})", "BB"),
    "check_battery_unhealthy": "battery is not healthy",
    "check_battery_preflight_low": "battery is too low to arm",
    "check_battery_low": "battery low",
    "check_battery_critical": "battery critical",
    "check_battery_emergency": "battery nearly empty",
    "check_battery_rem_flight_time_low": "battery lasts for little more than the way home",
    "check_avionics_power_missing": "power module is not connected",
    "check_avionics_power_low": ("supply voltage is low: {0:.2f} V", "f"),
    "check_avionics_power_high": ("supply voltage is high: {0:.2f} V", "f"),
    "check_avionics_power_redundancy": ("{0} power modules work, {1} must", "BB"),
    "check_missing_system_power": "supply voltage is not known",
    "check_power_oc_hipower": "too much current on the high-power 5 V supply",
    "check_power_oc_periph": "too much current on the 5 V supply",
    "check_power_oc_report": "too much current on the 5 V supply: land",
    "check_escs_telem_missing": "no data from the motor controllers",
    "check_escs_offline": ("motor controller {0} is silent", "B"),
    "check_escs_fault": ("motor controller {0} reports fault {1}", "BB"),
    "check_failure_detector_arm_esc": "a motor controller failed to arm",
    "check_failure_detector_motor": "a motor has failed",
    "check_failure_detector_imbalanced_prop": "a propeller is out of balance",
    "check_failure_detector_pitch": "tipped over, in pitch",
    "check_failure_detector_roll": "tipped over, in roll",
    "check_failure_detector_alt": "lost height",
    "check_failure_detector_ext": "an external failure detector fired",
    # Remote control and links
    "check_modes_manual_control": "no sticks are heard",
    "check_modes_offboard_signal": "offboard is not possible: setpoints or position are missing",
    "check_rc_dl_no_dllink": "no ground station is heard",
    "check_rc_dz_too_high": ("remote control's channel {0}: dead zone is above {1}", "BH"),
    "check_rc_max_too_high": ("remote control's channel {0}: maximum is above {1}", "BH"),
    "check_rc_min_too_small": ("remote control's channel {0}: minimum is below {1}", "BH"),
    "check_rc_trim_too_high": ("remote control's channel {0}: trim {1} is above {2}", "Bhh"),
    "check_rc_trim_too_small": ("remote control's channel {0}: trim {1} is below {2}", "Bhh"),
    "check_man_control_kill_engaged": "the kill switch is on",
    "check_man_control_rtl_engaged": "the return switch is on",
    "check_man_control_landing_gear_up": "the landing gear switch is up",
    # The rest of the vehicle
    "check_armable_configuration": "the vehicle is configured as one that must not arm",
    "check_cpuload_too_high": ("autopilot's processor is busy at {0:.0f} %", "f"),
    "check_ram_usage_too_high": ("autopilot's memory is full at {0:.0f} %", "f"),
    "check_missing_cpuload": "autopilot's load is not known",
    "check_missing_fmu_sdcard": "autopilot's SD card is missing",
    "check_hardfault_present": "the autopilot crashed before: look at its SD card",
    "check_system_safety_button": "the safety button must be pressed",
    "check_system_usb_connected": "USB is plugged in",
    "check_system_arm_auth_failed": "arming is not authorized",
    "check_system_avoidance_not_ready": "obstacle avoidance is not ready",
    "check_system_flight_term_active": "flight is terminated: restart the autopilot",
    "check_system_no_home_pos": "home is required",
    "check_modes_home_position": "home is not known",
    "check_modes_mission": "the autopilot has no mission",
    "check_modes_cannot_takeoff": "it is not armed in this mode",
    "check_mission_failure": "the autopilot's mission cannot be flown",
    "check_navigator_failure_hagl": "waypoint is too high",
    "check_external_modes_unavailable": "an external mode is not registered",
    "check_external_modes_unresponsive": "an external mode does not answer",
    "check_flight_time_limit": "longest flight time is over",
    "check_gf_no_home": "the fence's return needs home",
    "check_gf_violation": ("PX4's fence: {0}", "G"),
    "check_gf_violation_custom_gf": "PX4's fence: at or beyond it",
    "check_gf_violation_max_alt": "PX4's fence: too high above home",
    "check_gf_violation_max_hor_dist": "PX4's fence: too far from home",
    "check_open_drone_id_missing": "remote ID is missing",
    "check_open_drone_id_unhealthy": "remote ID is not ready",
    "check_parachute_missing": "parachute is missing",
    "check_parachute_unhealthy": "parachute is not ready",
    "check_wind_too_high": ("wind is too strong: {0:.1f} m/s", "f"),
    "check_high_wind_warning": ("wind is strong: {0:.1f} m/s", "f"),
    "check_above_wind_limits_warning": ("wind is too strong: {0:.1f} m/s", "f"),
    # What it refuses
    "commander_arm_denied_calibrating": "it is being calibrated",
    "commander_arm_denied_not_manual": "it must be in a manual mode",
    "commander_arm_denied_resolve_failures": "its checks fail",
    "commander_arm_denied_throttle_center": "throttle is above its centre",
    "commander_arm_denied_throttle_high": "throttle is not down",
    "commander_disarm_denied_not_landed": "it has not landed",
    "commander_disarming_denied_not_landed": "it has not landed",
    "commander_modeswitch_not_avail": "it cannot fly in the mode that was asked for",
    "commander_transition_denied": "it cannot be armed or disarmed now",
    # What it does
    "commander_failsafe_enter": ("failsafe, {2}: PX4 {1}", "IAC"),
    "commander_failsafe_enter_hold": ("failsafe, {3}: PX4 holds for {2} s, then {1}", "IAHC"),
    "commander_failsafe_enter_warn": ("failsafe, {1}: PX4 does nothing", "IC"),
    "commander_failsafe_enter_generic": ("failsafe: PX4 {1}", "IA"),
    "commander_failsafe_enter_generic_hold": ("failsafe: PX4 holds for {2} s, then {1}", "IAH"),
    "commander_failsafe_enter_generic_warn": "failsafe: PX4 does nothing",
    "commander_failsafe_enter_autopilot_disengaged": (
        "failsafe: PX4 {1}, and no longer keeps its position", "IA",
    ),
    "commander_failsafe_enter_low_bat": "battery low",
    "commander_failsafe_enter_crit_bat_warn": "battery critical: land",
    "commander_failsafe_enter_crit_low_bat_warn": "battery nearly empty: land",
    "commander_failsafe_enter_low_flight_time_warn": (
        "battery lasts for little more than the way home"
    ),
    "commander_low_bat_shutdown": "battery empty: the autopilot switches itself off",
    "commander_low_bat_shutdown_failed": (
        "battery empty: the autopilot could not switch itself off"
    ),
    "commander_kill_sw_engaged": "the kill switch is on",
    "commander_rc_lost": "remote control lost",
    "commander_rc_loss_act": "PX4 acts on a lost remote control",
    "commander_gcs_lost": "ground station lost",
    "commander_mission_comp_lost": "this program was silent",
    "commander_open_drone_id_lost": "remote ID is lost",
    "commander_remote_id_lost": "remote ID is lost",
    "commander_max_flight_time_warning_minutes": ("PX4 returns in {0} minutes", "h"),
    "commander_max_flight_time_warning_seconds": ("PX4 returns in {0} s", "h"),
    "navigator_geofence_import_failed": "PX4 could not take the fence",
    "navigator_geofence_invalid_against_cur_pos": "PX4's fence does not contain the vehicle",
    "navigator_geofence_invalid_against_home": "PX4's fence does not contain home",
}  # fmt: skip

_AUTOPILOT = 1


def event_id(name: str) -> int:
    """An event of PX4's own, by its name: component 1, and 24 bits of the name's FNV-1a hash."""
    value = 0x811C9DC5
    for byte in name.encode():
        value = (value ^ byte) * 0x01000193 & 0xFFFFFFFF
    return _AUTOPILOT << 24 | value & 0xFFFFFF


_NAMES = {event_id(name): name for name in _WORDS}
_REPORT_BEGINS = event_id("commander_arming_check_summary")
_REPORT_ENDS = event_id("commander_health_summary")

# The modes that a check names, and those that may be armed, are bits.
_MODES_AND_COMPONENT = "<IB"
_SUMMARY = "<BIIII"
_ALL_MODES = 0xFFFFFFFF
_BITS = {
    Mode.MANUAL: 0, Mode.ALTITUDE: 1, Mode.POSITION: 2, Mode.MISSION: 3, Mode.HOLD: 4,
    Mode.RETURN: 5, Mode.OFFBOARD: 14, Mode.STABILIZED: 15, Mode.TAKEOFF: 17, Mode.LAND: 18,
}  # fmt: skip

_SEQUENCES = 1 << 16
# PX4 queues fewer.
_MOST_CHECKS = 32
# PX4 keeps its last 20 events, and answers at once for those that it has.
_ANSWER_S = 2.0


class _Check(NamedTuple):
    """One check that fails: in which modes (bits), and how grave it is (0 is the gravest)."""

    modes: int
    level: int
    reason: AutopilotReason


class _Told(NamedTuple):
    """What was told once."""

    at_s: float
    reason: AutopilotReason


class Px4Events:
    """What one vehicle's events say now. Times are the robot's monotonic clock, s."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._newest = 0
        self._missing_since_s: float | None = None
        self._report: list[_Check] | None = None
        self._can_arm = self._report_can_arm = 0
        self._checks: tuple[_Check, ...] = ()
        self._told: deque[_Told] = deque(maxlen=16)

    def hear(self, fields: Mapping[str, Any], now_s: float) -> None:
        """Take in one EVENT; one that overtook another must be sent again, see `missing`.

        Raises KeyError, TypeError or ValueError for what is no EVENT.
        """
        sequence, event, level = fields["sequence"], fields["id"], fields["log_levels"] & 0xF
        arguments = bytes(fields["arguments"]).ljust(40, b"\0")
        if not self._is_next(sequence, now_s):
            return
        if event == _REPORT_BEGINS:
            self._report, self._report_can_arm = [], struct.unpack_from(_SUMMARY, arguments)[3]
        elif event == _REPORT_ENDS:
            if self._report is not None:
                self._can_arm = self._report_can_arm
                self._checks = tuple(sorted(self._report, key=lambda check: check.level))
            self._report = None
        elif self._report is not None and _NAMES.get(event, "check_").startswith("check_"):
            modes = struct.unpack_from(_MODES_AND_COMPONENT, arguments)[0]
            rest = arguments[struct.calcsize(_MODES_AND_COMPONENT) :]
            if len(self._report) < _MOST_CHECKS:
                self._report.append(_Check(modes, level, to_reason(event, rest)))
        elif level <= _WARNING:
            self._told.append(_Told(now_s, to_reason(event, arguments)))

    def hear_sequence(self, fields: Mapping[str, Any], now_s: float) -> None:
        """Take in a CURRENT_EVENT_SEQUENCE: the newest event may have been lost."""
        newest = fields["sequence"]
        if self._last is None or _ahead(newest, self._last) >= _SEQUENCES // 2:
            # The vehicle was switched on anew.
            self._start_at(newest)
        else:
            self._is_next(newest, now_s, arrived=False)

    def missing(self) -> tuple[int, int] | None:
        """The first and last sequence number of what REQUEST_EVENT must ask for."""
        if self._last is None or self._missing_since_s is None:
            return None
        return (self._last + 1) % _SEQUENCES, self._newest

    def why_not_armed(self, mode: Mode | None) -> tuple[AutopilotReason, ...]:
        """Why PX4 would not arm in this mode, the gravest first, by its last report."""
        bits = _bits(mode)
        if self._can_arm & bits == bits:
            return ()
        checks = [check for check in self._checks if check.modes & bits]
        errors = [check for check in checks if check.level <= _ERROR]
        # Some that are less grave keep it from arming, too; most only warn.
        return _reasons(errors or checks)

    def told(self, since_s: float) -> tuple[AutopilotReason, ...]:
        """What PX4 warned of once since then, the newest first."""
        return _reasons(told for told in reversed(self._told) if told.at_s >= since_s)

    def wrong(self, mode: Mode | None) -> tuple[AutopilotReason, ...]:
        """What PX4 finds wrong now that concerns this mode, the gravest first."""
        bits = _bits(mode)
        return _reasons(c for c in self._checks if c.level <= _WARNING and c.modes & bits)

    def _is_next(self, sequence: int, now_s: float, *, arrived: bool = True) -> bool:
        """Whether the event with that number comes next; if not, what lies between is missing."""
        ahead = 1 if self._last is None else _ahead(sequence, self._last)
        given_up = self._missing_since_s is not None and now_s - self._missing_since_s > _ANSWER_S
        if (ahead == 1 and arrived) or (given_up and 0 < ahead < _SEQUENCES // 2):
            if given_up:
                self._report = None
            self._last = sequence
            if given_up or sequence == self._newest:
                self._missing_since_s = None
            return arrived
        if 0 < ahead < _SEQUENCES // 2:
            self._newest = sequence
            if self._missing_since_s is None:
                self._missing_since_s = now_s
        return False

    def _start_at(self, sequence: int) -> None:
        self._last, self._missing_since_s, self._report = sequence, None, None


def to_reason(event: int, arguments: bytes) -> AutopilotReason:
    """An event in words; `arguments` are those that it shows, after a check's modes."""
    name = _NAMES.get(event)
    if name is None:
        code = f"0x{event:08x}"
        return AutopilotReason(
            code, (), f"a reason that this program has no words for: event {code}"
        )
    words = _WORDS[name]
    text, types = (words, "") if isinstance(words, str) else words
    values = struct.unpack_from("<" + re.sub("[ACSG]", "B", types), arguments)
    shown = [
        _VALUES[kind].get(value, f"{value}") if kind in _VALUES else value
        for kind, value in zip(types, values, strict=True)
    ]
    return AutopilotReason(name, values, text.format(*shown))


def without_repetition(reasons: Iterable[AutopilotReason]) -> tuple[AutopilotReason, ...]:
    """In the same order; of those that read alike, the first."""
    first: dict[str, AutopilotReason] = {}
    for reason in reasons:
        first.setdefault(reason.text, reason)
    return tuple(first.values())


def _ahead(sequence: int, last: int) -> int:
    return (sequence - last) % _SEQUENCES


def _bits(mode: Mode | None) -> int:
    return 1 << _BITS[mode] if mode in _BITS else _ALL_MODES


def _reasons(entries: Iterable[_Check | _Told]) -> tuple[AutopilotReason, ...]:
    return without_repetition(entry.reason for entry in entries)
