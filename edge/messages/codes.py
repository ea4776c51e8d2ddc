"""Codes for programs and texts for people: failed checks, reasons and refusals.

Programs decide by `code`. `text` is for people, and its wording may change in any release.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Self

from edge.messages.bounds import MOST_LETTERS, Text


class _Code(StrEnum):
    """Codes; one that is unknown in this release becomes OTHER."""

    @classmethod
    def _missing_(cls, value: object) -> Self | None:
        return cls["OTHER"] if isinstance(value, str) else None


class CheckCode(_Code):
    """Checks that keep a robot on the ground."""

    OTHER = "other"
    CHECKS_RUNNING = "checks_running"
    # The program, its clock and its ground.
    BUNDLE_NOT_VERIFIED = "bundle_not_verified"
    WATCHDOG_ENDED = "watchdog_ended"
    TIME_NOT_KNOWN = "time_not_known"
    GROUND_NOT_HEARD = "ground_not_heard"
    GROUND_SILENT = "ground_silent"
    NOT_A_MEMBER = "not_a_member"
    MEMBERS_DIFFER = "members_differ"
    NO_FRESH_ANSWER = "no_fresh_answer"
    # The vehicle.
    AUTOPILOT_NOT_CONNECTED = "autopilot_not_connected"
    OTHER_AUTOPILOT = "other_autopilot"
    SYSTEM_ID_WRONG = "system_id_wrong"
    PX4_TOO_OLD = "px4_too_old"
    OTHER_VEHICLES = "other_vehicles"
    REMOTE_CONTROL_NOT_HEARD = "remote_control_not_heard"
    NOT_DISARMED = "not_disarmed"
    BATTERY_NOT_KNOWN = "battery_not_known"
    BATTERY_LOW = "battery_low"
    NOT_ARMABLE = "not_armable"
    FAILSAFE_NOT_READ = "failsafe_not_read"
    FAILSAFE_WRONG = "failsafe_wrong"
    FENCE_NOT_UPLOADED = "fence_not_uploaded"
    # Its estimate.
    POSITION_NOT_KNOWN = "position_not_known"
    POSITION_OLD = "position_old"
    POSITION_NOT_GOOD = "position_not_good"
    ESTIMATOR_ORIGIN_NOT_KNOWN = "estimator_origin_not_known"
    HEADING_NOT_KNOWN = "heading_not_known"
    GPS_NOT_HEARD = "gps_not_heard"
    GPS_NO_FIX = "gps_no_fix"
    GPS_FEW_SATELLITES = "gps_few_satellites"
    GPS_IMPRECISE = "gps_imprecise"
    # Standing, flying and landing places.
    ORIGIN_NOT_SET = "origin_not_set"
    PLACE_NOT_KNOWN = "place_not_known"
    STANDS_OUTSIDE = "stands_outside"
    LANDS_OUTSIDE = "lands_outside"
    HEIGHT_OUTSIDE = "height_outside"
    ORIGIN_OUT_OF_REACH = "origin_out_of_reach"
    FENCE_OUT_OF_REACH = "fence_out_of_reach"
    # The other robots.
    DUPLICATE_ID = "duplicate_id"
    OTHER_RELEASE = "other_release"
    OTHER_NOT_HEARD = "other_not_heard"
    SAME_SYSTEM_ID = "same_system_id"
    OTHER_BUNDLE = "other_bundle"
    OTHER_WORLD = "other_world"
    OTHER_ORIGIN = "other_origin"
    HEIGHTS_TOO_NEAR = "heights_too_near"
    LANDINGS_TOO_NEAR = "landings_too_near"
    LANDING_POINT_TAKEN = "landing_point_taken"
    SILENT_NEAR = "silent_near"
    TAKEOFFS_TOO_FAR_APART = "takeoffs_too_far_apart"
    # Parts of the ground's state that it does not adopt: in flight, or because it cannot.
    KEEPS_ORIGIN = "keeps_origin"
    KEEPS_FENCE = "keeps_fence"
    KEEPS_PLACE = "keeps_place"
    KEEPS_WORLD = "keeps_world"
    FENCE_OR_PLACE_UNFIT = "fence_or_place_unfit"
    WORLD_NOT_ARRIVED = "world_not_arrived"
    WORLD_UNUSABLE = "world_unusable"


@dataclass(frozen=True, slots=True)
class FailedCheck:
    """A failed check, which keeps a robot on the ground; `text` says what to do.

    `settles_by_itself`: waiting under open sky usually clears it.
    """

    code: CheckCode
    text: Text
    settles_by_itself: bool = False

    def __post_init__(self) -> None:
        _shorten(self)


class ReasonCode(_Code):
    """Reasons for a robot's change of state, and for alarms."""

    OTHER = "other"
    PROGRAM_STARTED = "program_started"
    # Orders.
    KILLED = "killed"
    DISARM_ORDERED = "disarm_ordered"
    GIVEN_TO_PILOT = "given_to_pilot"
    TAKEOFF_ORDERED = "takeoff_ordered"
    MISSION_STARTED = "mission_started"
    TAKEN_BACK = "taken_back"
    # The vehicle.
    DISARMED = "disarmed"
    AUTOPILOT_SILENT = "autopilot_silent"
    DISARMED_IN_AIR = "disarmed_in_air"
    ARMED_BEFORE = "armed_before"
    ARMED_BY_OTHERS = "armed_by_others"
    PILOT = "pilot"
    LEFT_OFFBOARD = "left_offboard"
    LEFT_LAND = "left_land"
    AUTOPILOT_LANDS = "autopilot_lands"
    FAILSAFE = "failsafe"
    OFFBOARD_REFUSED = "offboard_refused"
    ARMING_FAILED = "arming_failed"
    ARMED = "armed"
    PX4 = "px4"
    LINK_LOSES = "link_loses"
    LINK_TWICE = "link_twice"
    # The robot itself.
    CONTROL_SILENT = "control_silent"
    POSITION_LOST = "position_lost"
    POSITION_DOUBTFUL = "position_doubtful"
    BATTERY_CRITICAL = "battery_critical"
    BATTERY_LOW = "battery_low"
    BATTERY_NOT_KNOWN = "battery_not_known"
    ON_GROUND = "on_ground"
    DISARM_REFUSED = "disarm_refused"
    OFF_HEIGHT = "off_height"
    TOO_CLOSE = "too_close"
    OUTSIDE_FENCE = "outside_fence"
    LANDS_BESIDE = "lands_beside"
    REMOTE_CONTROL_LOST = "remote_control_lost"
    PX4_CHANGED = "px4_changed"
    NOBODY_ANSWERED = "nobody_answered"
    HOVERS_ALONE = "hovers_alone"
    POLICY_STALE = "policy_stale"
    FOUND = "found"
    AT_HEIGHT = "at_height"
    NOT_CLIMBING = "not_climbing"
    AT_LANDING_POINT = "at_landing_point"
    # The ground.
    ENABLED = "enabled"
    NOT_ENABLED = "not_enabled"
    GROUND_LOST = "ground_lost"
    GROUND_HOLDS = "ground_holds"
    GROUND_RETURNS = "ground_returns"
    GROUND_LANDS = "ground_lands"
    GROUND_ENDS_TAKEOFF = "ground_ends_takeoff"
    ARMING_CALLED_OFF = "arming_called_off"
    # The program.
    DUPLICATE_ID = "duplicate_id"
    SAID_TWICE = "said_twice"
    STRANGERS_FLOOD = "strangers_flood"
    RADIO_QUEUE_FULL = "radio_queue_full"
    DESCRIPTORS_SHORT = "descriptors_short"
    WATCHDOG_ENDED = "watchdog_ended"
    LOG_NOT_WRITTEN = "log_not_written"
    IDENTITY_NOT_WRITTEN = "identity_not_written"
    NOT_A_MEMBER = "not_a_member"
    MEMBERS_DIFFER = "members_differ"
    GROUND_NOT_UNDERSTOOD = "ground_not_understood"


@dataclass(frozen=True, slots=True)
class Reason:
    """Reason for a robot's state, or an alarm."""

    code: ReasonCode
    text: Text

    def __post_init__(self) -> None:
        _shorten(self)


class RefusalCode(_Code):
    """Reasons to refuse an order."""

    OTHER = "other"
    NOT_UNDERSTOOD = "not_understood"
    OTHER_RELEASE = "other_release"
    OTHER_START = "other_start"
    EXPIRED = "expired"
    VALID_TOO_LONG = "valid_too_long"
    OTHER_COMMANDER = "other_commander"
    WRONG_STATE = "wrong_state"
    OLDER = "older"
    CONTROL_SILENT = "control_silent"
    GROUND_NOT_HEARD = "ground_not_heard"
    GROUND_COMMANDS = "ground_commands"
    OVERRULED = "overruled"
    NOT_READY = "not_ready"
    CHECKS_RUNNING = "checks_running"
    NOT_ARMED = "not_armed"
    IN_THE_AIR = "in_the_air"
    ARMED_NOT_KNOWN = "armed_not_known"
    POSITION_NOT_GOOD = "position_not_good"
    PLACE_NOT_KNOWN = "place_not_known"
    NOT_IN_THE_AIR = "not_in_the_air"
    FAILSAFE = "failsafe"
    NOT_AT_HEIGHT = "not_at_height"
    OUTSIDE_FENCE = "outside_fence"
    NOT_IN_OFFBOARD = "not_in_offboard"
    POLICY_STALE = "policy_stale"
    NOT_TAKEN_UP = "not_taken_up"
    REMOTE_CONTROL_LOST = "remote_control_lost"
    OTHERS_TAKE_OFF = "others_take_off"
    TOO_CLOSE = "too_close"
    # Set by the ground for an order without an answer.
    STARTED_AGAIN = "started_again"
    NOT_ANSWERED = "not_answered"
    INTERRUPTED = "interrupted"


@dataclass(frozen=True, slots=True)
class Refusal:
    """A robot's reason to refuse an order."""

    code: RefusalCode
    text: Text

    def __post_init__(self) -> None:
        _shorten(self)


def texts(items: Iterable[FailedCheck | Reason]) -> str:
    """Their texts, on one line."""
    return "; ".join(each.text for each in items)


def _shorten(item: FailedCheck | Reason | Refusal) -> None:
    # Receivers refuse a longer text, and its whole message.
    if len(item.text) > MOST_LETTERS:
        object.__setattr__(item, "text", f"{item.text[: MOST_LETTERS - 4]} ...")
