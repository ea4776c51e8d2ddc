"""PX4's EVENT messages -> reasons why it does not arm or takes over. No socket, thread or clock.

PX4 sends events on every link, also to a companion computer; STATUSTEXT goes only to ground
stations. An event has the hash of its name and arguments, but no text. The texts are defined here:
they are available at once, also for a vehicle that does not provide its own over MAVLink. Names and
arguments are those of v1.14 to v1.17, including ModalAI's v1.14.

PX4 sends a report of its checks whenever their result changes, and for RUN_PREARM_CHECKS: a
summary, the failed checks, another summary. Checks that a report does not name have passed.
"""

import re
import struct
from collections import deque
from collections.abc import Iterable, Mapping
from itertools import takewhile
from typing import Any, NamedTuple

from edge.core.vehicle import AutopilotReason, Mode

_WARNING, _ERROR = 4, 3

# Event arguments use struct's format characters; A, C, S and G are bytes with these meanings:
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

# Name -> text, or text and the formats of the arguments that it shows.
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
    "check_modes_manual_control": "no stick input arrives",
    "check_modes_offboard_signal": "offboard is not possible: setpoints or position are missing",
    "check_rc_dl_no_dllink": "no ground station is connected",
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
    "check_hardfault_present": "the autopilot crashed earlier: check its SD card",
    "check_system_safety_button": "the safety button must be pressed",
    "check_system_usb_connected": "USB is plugged in",
    "check_system_arm_auth_failed": "arming is not authorized",
    "check_system_avoidance_not_ready": "obstacle avoidance is not ready",
    "check_system_flight_term_active": "flight is terminated: restart the autopilot",
    "check_system_no_home_pos": "home is required",
    "check_modes_home_position": "home is not known",
    "check_modes_mission": "the autopilot has no mission",
    "check_modes_cannot_takeoff": "it does not arm in this mode",
    "check_mission_failure": "the autopilot's mission cannot be flown",
    "check_navigator_failure_hagl": "waypoint is too high",
    "check_external_modes_unavailable": "an external mode is not registered",
    "check_external_modes_unresponsive": "an external mode does not answer",
    "check_flight_time_limit": "the longest flight time is over",
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
    # Refusals
    "commander_arm_denied_calibrating": "it is being calibrated",
    "commander_arm_denied_not_manual": "it must be in a manual mode",
    "commander_arm_denied_resolve_failures": "its checks fail",
    "commander_arm_denied_throttle_center": "throttle is above its centre",
    "commander_arm_denied_throttle_high": "throttle is not down",
    "commander_disarm_denied_not_landed": "it has not landed",
    "commander_disarming_denied_not_landed": "it has not landed",
    "commander_modeswitch_not_avail": "it cannot fly in the requested mode",
    "commander_transition_denied": "it cannot be armed or disarmed now",
    # Actions
    "commander_failsafe_enter": ("failsafe, {2}: PX4 {1}", "IAC"),
    "commander_failsafe_enter_hold": ("failsafe, {3}: PX4 holds for {2} s, then {1}", "IAHC"),
    "commander_failsafe_enter_warn": ("failsafe, {1}: PX4 does nothing", "IC"),
    "commander_failsafe_enter_generic": ("failsafe: PX4 {1}", "IA"),
    "commander_failsafe_enter_generic_hold": ("failsafe: PX4 holds for {2} s, then {1}", "IAH"),
    "commander_failsafe_enter_generic_warn": "failsafe: PX4 does nothing",
    "commander_failsafe_enter_autopilot_disengaged":
        ("failsafe: PX4 {1}, and no longer keeps its position", "IA"),
    "commander_failsafe_enter_low_bat": "battery low",
    "commander_failsafe_enter_crit_bat_warn": "battery critical: land",
    "commander_failsafe_enter_crit_low_bat_warn": "battery nearly empty: land",
    "commander_failsafe_enter_low_flight_time_warn":
        "battery lasts for little more than the way home",
    "commander_low_bat_shutdown": "battery empty: the autopilot switches itself off",
    "commander_low_bat_shutdown_failed":
        "battery empty: the autopilot could not switch itself off",
    "commander_kill_sw_engaged": "the kill switch is on",
    "commander_rc_lost": "remote control lost",
    "commander_rc_loss_act": "PX4 acts on a lost remote control",
    "commander_gcs_lost": "ground station lost",
    "commander_mission_comp_lost": "no setpoints came from this program",
    "commander_open_drone_id_lost": "remote ID is lost",
    "commander_remote_id_lost": "remote ID is lost",
    "commander_max_flight_time_warning_minutes": ("PX4 returns in {0} minutes", "h"),
    "commander_max_flight_time_warning_seconds": ("PX4 returns in {0} s", "h"),
    "navigator_geofence_import_failed": "PX4 could not take the fence",
    "navigator_geofence_invalid_against_cur_pos": "PX4's fence does not contain the vehicle",
    "navigator_geofence_invalid_against_home": "PX4's fence does not contain home",
    "navigator_geofence_max_alt_from_home": ("PX4's fence: more than {0:.0f} m above home", "f"),
    "navigator_geofence_max_dist_from_home": ("PX4's fence: more than {0:.0f} m from home", "f"),
    "navigator_change_altitude_outside_geofence": "the requested height is outside PX4's fence",
    "navigator_reposition_outside_geofence": "the requested place is outside PX4's fence",
    "navigator_fail_max_hagl": "the requested height is above the highest allowed",
    "navigator_takeoff_already_higher": "it is already above its takeoff height",
    "navigator_terrain_collision_risk": "the ground is near: PX4 stops its descent",
    "orbit_radius_exceeded": "the requested orbit is too wide",
    "mc_throw_launch_ready": "it starts when thrown",
    "mc_throw_launch_not_ready": "it is disarmed, and does not start when thrown",
    "commander_mode_fallback_internal": "an external mode does not answer: PX4 flies its own",
    "commander_high_latency_lost": "the high-latency link is lost",
    "commander_ctrl_high_latency_failed": "the high-latency link cannot be switched",
    "commander_unsupported_auto_mode": "the requested mode does not exist",
    "commander_unsupported_arm_disarm_param": "arming was requested with an unknown value",
    # Parameters that PX4 changes because they do not fit others
    "mc_pos_ctrl_tilt_set": ("PX4 set MPC_TILTMAX_AIR to {0:.0f} degrees: more is not safe", "f"),
    "mc_pos_ctrl_land_tilt_set":
        ("PX4 set MPC_TILTMAX_LND to {0:.0f} degrees, which is MPC_TILTMAX_AIR", "f"),
    "mc_pos_ctrl_cruise_set":
        ("PX4 set MPC_XY_CRUISE to {0:.1f} m/s, which is MPC_XY_VEL_MAX", "f"),
    "mc_pos_ctrl_man_vel_set":
        ("PX4 set MPC_VEL_MANUAL to {0:.1f} m/s, which is MPC_XY_VEL_MAX", "f"),
    "mc_pos_ctrl_man_vel_back_set":
        ("PX4 set MPC_VEL_MAN_BACK to {0:.1f} m/s, which is MPC_VEL_MANUAL", "f"),
    "mc_pos_ctrl_man_vel_side_set":
        ("PX4 set MPC_VEL_MAN_SIDE to {0:.1f} m/s, which is MPC_VEL_MANUAL", "f"),
    "mc_pos_ctrl_up_vel_set":
        ("PX4 set MPC_Z_V_AUTO_UP to {0:.1f} m/s, which is MPC_Z_VEL_MAX_UP", "f"),
    "mc_pos_ctrl_down_vel_set":
        ("PX4 set MPC_Z_V_AUTO_DN to {0:.1f} m/s, which is MPC_Z_VEL_MAX_DN", "f"),
    "mc_pos_ctrl_hover_thrust_set":
        ("PX4 set MPC_THR_HOVER to {0:.2f}: from MPC_THR_MIN to MPC_THR_MAX", "f"),
    "ekf2_mag_type_invalid": "EKF2_MAG_TYPE is not valid: PX4 set its default",
    "nf_delay_max_too_small":
        ("PX4 set EKF2_DELAY_MAX to {1:.0f} ms, as its sensors need: restart the autopilot", "ff"),
    "ekf2_aid_mask_gps": "EKF2_AID_MASK is obsolete: PX4 set EKF2_GPS_CTRL",
    "ekf2_aid_mask_ev": "EKF2_AID_MASK is obsolete: PX4 set EKF2_EV_CTRL",
    "ekf2_aid_mask_imu": "EKF2_AID_MASK is obsolete: PX4 set EKF2_IMU_CTRL",
    "ekf2_aid_mask_drag": "EKF2_AID_MASK is obsolete: PX4 set EKF2_DRAG_CTRL",
    "ekf2_aid_mask_opt_flow": "EKF2_AID_MASK is obsolete: PX4 set EKF2_OF_CTRL",
    "ekf2_gps_ctrl_alt": "PX4 changed EKF2_GPS_CTRL: its height needs latitude and longitude",
    "ekf2_hgt_ref_baro": "PX4 set EKF2_BARO_CTRL, as EKF2_HGT_REF needs",
    "ekf2_hgt_ref_rng": "PX4 set EKF2_RNG_CTRL, as EKF2_HGT_REF needs",
    "ekf2_hgt_ref_gps": "PX4 set EKF2_GPS_CTRL, as EKF2_HGT_REF needs",
    "ekf2_hgt_ref_ev": "PX4 set EKF2_EV_CTRL, as EKF2_HGT_REF needs",
    "commander_airmode_requires_no_arm_gesture":
        "MC_AIRMODE with yaw does not go with arming by the sticks (MAN_ARM_GESTURE)",
    # Faults on the ground, or without effect on the flight
    "commander_load_param_failed": "its settings could not be loaded",
    "commander_save_param_failed": "its settings could not be saved",
    "commander_cal_cmd_denied": "it is being calibrated, and refused a command",
    "commander_cal_no_inputs": "no stick input arrives to calibrate",
    "commander_cal_trim_param_set_failed": "the sticks' trim could not be saved",
    "commander_esc_calibration_denied": "motor controllers cannot be calibrated now",
    "logger_storage_full": ("PX4 does not log: {0} MiB are free", "I"),
    "mavlink_log_not_enough_bw": ("the link is too slow to send PX4's log: {0} B/s", "I"),
    "mavlink_param_rc_chan_out_of_bounds": "a parameter was mapped to a missing channel",
    "col_prev_unsup_frame": ("obstacles arrived in an unknown frame ({0})", "B"),
    "mavlink_rcv_lnd_target_unsup_coord":
        ("a landing target arrived in an unknown frame ({0})", "B"),
    "mavlink_rcv_odom_unsup_estimator_type":
        ("odometry arrived from an unknown estimator ({0})", "B"),
    "mavlink_rcv_sp_target_unsup_coord":
        ("a setpoint arrived in an unknown frame ({0})", "B"),
    "mavlink_rcv_sp_target_gl_invalid_coord":
        ("a setpoint arrived in an unknown frame ({0})", "B"),
    "mavlink_rcv_sp_target_invalid": "a setpoint had no position, velocity or acceleration",
    "mavlink_rcv_sp_target_unsup_force": "setpoints of a force are not supported",
    "mavlink_rcv_sp_target_gl_unsup_force": "setpoints of a force are not supported",
    "px4io_comm_failed": "its input-output processor does not answer",
    "px4io_config_read_failed": "its input-output processor does not answer",
    "px4io_io_rc_config_upload_failed": "its input-output processor does not take its settings",
    "px4io_proto_fw_mismatch": "its input-output processor has other firmware",
    "mxs_system_fail": "the transponder has failed",
    "mxs_xpdr_fail": "the transponder has failed",
    "uavionix_adsb_out_cfg_unsupported_callsign_format": "the transponder's call sign is not valid",
    "camera_capture_trigger_rate_exceeded": "the camera's trigger is faulty",
    "pps_capture_pps_rate_exceeded": "GPS's pulse per second is faulty",
}  # fmt: skip

# This program uses no PX4 missions, so their faults share a few texts.
_MISSION_WORDS = {
    "a mission that somebody sent to PX4 cannot be flown": (
        "feasibility_mis_in_air_landing_req mission_do_jump_cycle mission_index_out_of_bound "
        "mission_invalid_mission_state mission_item_set_failed mission_not_valid_loiter "
        "mission_not_valid_refuse commander_mission_start_denied_no_mission "
        "navigator_mis_add_land_or_rm_to navigator_mis_add_to_or_rm_land "
        "navigator_mis_approach_wp_below_land navigator_mis_correct_glide_slope "
        "navigator_mis_first_wp_far navigator_mis_first_wp_too_far navigator_mis_geofence_no_home "
        "navigator_mis_geofence_no_home2 navigator_mis_geofence_violation "
        "navigator_mis_glide_slope_too_steep navigator_mis_invalid_land "
        "navigator_mis_land_before_rtl navigator_mis_land_missing "
        "navigator_mis_land_wp_inside_orbit_radius navigator_mis_multiple_land "
        "navigator_mis_no_home_rel_alt navigator_mis_starts_w_landing "
        "navigator_mis_starts_w_landing2 navigator_mis_takeoff_missing "
        "navigator_mis_takeoff_not_first navigator_mis_takeoff_or_land_missing "
        "navigator_mis_takeoff_too_low navigator_mis_unsup_cmd "
        "navigator_mis_unsupported_landing_approach_wp navigator_mis_vtol_items "
        "navigator_mis_wp_below_home navigator_mis_wp_gate_too_close "
        "navigator_mission_failure_heading rtl_unsupported_mav_frame"
    ),
    "PX4 could not read or store its mission": (
        "mavlink_mission_err_id mavlink_mission_storage_failure "
        "mavlink_mission_storage_read_failure mavlink_mission_storage_write_failure "
        "mavlink_mission_storage_write_failure2 mavlink_mission_storage_write_failure3 "
        "mission_cannot_read_mission mission_failed_set_closest mission_failed_set_jump_count "
        "mission_failed_to_read_wp mission_failed_to_write_do_jump rtl_failed_to_read_land_item"
    ),
    "a mission or fence was not transferred to or from PX4": (
        "mavlink_mission_getlist_busy mavlink_mission_ignore_clear "
        "mavlink_mission_ignore_mis_count mavlink_mission_item_partner_id_mismatch "
        "mavlink_mission_mis_item_busy mavlink_mission_mis_item_invalid "
        "mavlink_mission_mis_req_ignored_busy mavlink_mission_no_transfer "
        "mavlink_mission_op_timeout mavlink_mission_partner_id_mismatch "
        "mavlink_mission_partner_id_mismatch2 mavlink_mission_recv_unknown_mis_type "
        "mavlink_mission_req_ignored mavlink_mission_seq_out_of_bounds "
        "mavlink_mission_state_busy mavlink_mission_unknown_mis_type "
        "mavlink_mission_wp_index_exceeds_list mavlink_mission_wp_index_out_of_bounds "
        "mavlink_mission_wp_unexpected mavlink_mission_wp_unexpected2"
    ),
}
_WORDS |= {name: text for text, names in _MISSION_WORDS.items() for name in names.split()}

_AUTOPILOT = 1


def event_id(name: str) -> int:
    """Id of a PX4 event: component 1, and 24 bits of the name's FNV-1a hash."""
    value = 0x811C9DC5
    for byte in name.encode():
        value = (value ^ byte) * 0x01000193 & 0xFFFFFFFF
    return _AUTOPILOT << 24 | value & 0xFFFFFF


_NAMES = {event_id(name): name for name in _WORDS}
_REPORT_BEGINS = event_id("commander_arming_check_summary")
_REPORT_ENDS = event_id("commander_health_summary")

# A check's modes, and the modes in which PX4 can arm, are bit masks.
_MODES_AND_COMPONENT = "<IB"
_SUMMARY = "<BIIII"
_ALL_MODES = 0xFFFFFFFF
_BITS = {
    Mode.MANUAL: 0, Mode.ALTITUDE: 1, Mode.POSITION: 2, Mode.MISSION: 3, Mode.HOLD: 4,
    Mode.RETURN: 5, Mode.OFFBOARD: 14, Mode.STABILIZED: 15, Mode.TAKEOFF: 17, Mode.LAND: 18,
}  # fmt: skip

_SEQUENCES = 1 << 16
# More than PX4 queues.
_MOST_CHECKS = 32
# PX4 keeps its last 20 events, and sends requested ones at once.
_ANSWER_S = 2.0


class _Check(NamedTuple):
    """A failed check; `modes` is a bit mask, `level` a MAVLink severity, 0 the most severe."""

    modes: int
    level: int
    reason: AutopilotReason


class _Warning(NamedTuple):
    """Warning from a single event, outside the reports."""

    at_s: float
    reason: AutopilotReason


class Px4Events:
    """State of one vehicle's events. Times are by the robot's monotonic clock, s."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._newest = 0
        self._missing_since_s: float | None = None
        self._report: list[_Check] | None = None
        self._can_arm = self._report_can_arm = 0
        self._checks: tuple[_Check, ...] = ()
        # Cache of `present_faults`.
        self._faults: dict[Mode | None, tuple[AutopilotReason, ...]] = {}
        self._warnings: deque[_Warning] = deque(maxlen=16)

    def receive(self, fields: Mapping[str, Any], now_s: float) -> None:
        """Process an EVENT. One that arrives before its predecessor must be sent again: `missing`.

        Raises KeyError, TypeError or ValueError for an invalid one.
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
                self._faults.clear()
            self._report = None
        elif self._report is not None and _NAMES.get(event, "check_").startswith("check_"):
            modes = struct.unpack_from(_MODES_AND_COMPONENT, arguments)[0]
            rest = arguments[struct.calcsize(_MODES_AND_COMPONENT) :]
            if len(self._report) < _MOST_CHECKS:
                self._report.append(_Check(modes, level, to_reason(event, rest)))
        elif level <= _WARNING:
            self._warnings.append(_Warning(now_s, to_reason(event, arguments)))

    def receive_sequence(self, fields: Mapping[str, Any], now_s: float) -> None:
        """Process a CURRENT_EVENT_SEQUENCE, which shows whether the newest event was lost."""
        newest = fields["sequence"]
        if self._last is None or _ahead(newest, self._last) >= _SEQUENCES // 2:
            # The first message, or the vehicle has restarted.
            self._last, self._missing_since_s, self._report = newest, None, None
        else:
            self._is_next(newest, now_s, arrived=False)

    def missing(self) -> tuple[int, int] | None:
        """First and last sequence number for REQUEST_EVENT; None if no event is missing."""
        if self._last is None or self._missing_since_s is None:
            return None
        return (self._last + 1) % _SEQUENCES, self._newest

    def arming_problems(self, mode: Mode | None) -> tuple[AutopilotReason, ...]:
        """Reasons of the last report not to arm in this mode, most severe first."""
        bits = _bits(mode)
        if self._can_arm & bits == bits:
            return ()
        checks = [check for check in self._checks if check.modes & bits]
        errors = [check for check in checks if check.level <= _ERROR]
        # Without errors, less severe checks prevent arming; usually they only warn.
        return _reasons(errors or checks)

    def warnings(self, since_s: float) -> tuple[AutopilotReason, ...]:
        """Single warnings since then, newest first."""
        if not self._warnings or self._warnings[-1].at_s < since_s:
            return ()
        recent = takewhile(lambda warning: warning.at_s >= since_s, reversed(self._warnings))
        return _reasons(recent)

    def present_faults(self, mode: Mode | None) -> tuple[AutopilotReason, ...]:
        """Failed checks of the last report that concern this mode, most severe first."""
        if mode not in self._faults:
            bits = _bits(mode)
            severe = (c for c in self._checks if c.level <= _WARNING and c.modes & bits)
            self._faults[mode] = _reasons(severe)
        return self._faults[mode]

    def _is_next(self, sequence: int, now_s: float, *, arrived: bool = True) -> bool:
        """Whether this event comes next; if not, those in between are missing."""
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


def to_reason(event: int, arguments: bytes) -> AutopilotReason:
    """Convert an event to a reason; `arguments` are those after a check's modes."""
    name = _NAMES.get(event)
    if name is None:
        code = f"0x{event:08x}"
        return AutopilotReason(code, (), f"event {code}, which this program does not know")
    words = _WORDS[name]
    text, types = (words, "") if isinstance(words, str) else words
    values = struct.unpack_from("<" + re.sub("[ACSG]", "B", types), arguments)
    shown = [
        _VALUES[kind].get(value, f"{value}") if kind in _VALUES else value
        for kind, value in zip(types, values, strict=True)
    ]
    return AutopilotReason(name, values, text.format(*shown))


def without_repetition(reasons: Iterable[AutopilotReason]) -> tuple[AutopilotReason, ...]:
    """Drop reasons with the text of an earlier one."""
    first: dict[str, AutopilotReason] = {}
    for reason in reasons:
        first.setdefault(reason.text, reason)
    return tuple(first.values())


def _ahead(sequence: int, last: int) -> int:
    return (sequence - last) % _SEQUENCES


def _bits(mode: Mode | None) -> int:
    return 1 << _BITS[mode] if mode in _BITS else _ALL_MODES


def _reasons(entries: Iterable[_Check | _Warning]) -> tuple[AutopilotReason, ...]:
    return without_repetition(entry.reason for entry in entries)
