"""Preflight checks: all reasons against a takeoff, with remedies."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from edge.core.counted import counted
from edge.core.fence import Fence
from edge.core.position import PositionJudgement, PositionQuality
from edge.core.px4_version import OLDEST, is_too_old
from edge.core.schema import Bounded, Positive
from edge.core.vehicle import Gps, VehicleState
from edge.flight.failsafe import RemoteControl
from edge.flight.landing import in_the_way, standing_robots
from edge.flight.margins import ErrorBudget, places_apart
from edge.flight.reach import Reach
from edge.flight.safety import SeparationLimits
from edge.flight.silence import deviation_m, highest_possible_m, nearest_place_m
from edge.messages.beacon import Beacon, Neighbour, ReceivedBeacon, tag
from edge.messages.codes import CheckCode, FailedCheck
from edge.messages.mission import Origin

_C = CheckCode
_FIX_3D = 3


@dataclass(frozen=True, slots=True)
class PreflightLimits(Bounded):
    """Limits of the checks; `min_battery` is a share, 0 to 1.

    Raises ValueError if a number is out of range.
    """

    min_battery: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.5
    min_satellites: Annotated[int, Meta(ge=4)] = 8
    max_hdop: Positive = 2.0
    max_position_age_s: Positive = 0.5
    max_ground_age_s: Positive = 3.0
    max_time_uncertainty_s: Positive = 0.2


@dataclass(frozen=True, slots=True)
class PreflightInputs:
    """Inputs of the checks.

    `bundle_problem` is None if the bundle was verified on this CPU. `system_id` is the configured
    one. `position` is the judged quality; `position_m` (3,) and `landing_point_m` (2,) are in the
    mission frame; the slot's height is above the takeoff point. `errors` determine the distances of
    robots. `failsafe_problems` come from `failsafe.check`, None before the vehicle's parameters
    were read. `fence_changed`: the vehicle had the right fence, and somebody else changed it.
    `neighbours` are the robots received recently, `unreadable_robots` those with messages of
    another version, `missing_robots` those received by the ground only. `fell_silent` are robots
    that fell silent in flight and may still be in the air, as of their last message; `separation`
    has the distance from them. `ground_release` is the ground's release, "" if it is this robot's.
    `ground_age_s` is the age of the ground's last message, None if there was none; the fleet's time
    is known to `time_uncertainty_s`, None if unknown. `has_answer`: the policy answered recently.
    `answer_problem` is the fault of the sensor's or policy's last result, "" if unknown.
    """

    now_s: float
    robot_id: int
    duplicate_id: bool
    bundle_problem: str | None
    bundle_id: str
    world_id: str
    system_id: int
    vehicle: VehicleState
    failsafe_problems: Sequence[str] | None
    fence: Fence
    reach: Reach
    fence_uploaded: bool
    fence_changed: bool
    origin: Origin | None
    position: PositionJudgement
    position_m: Sequence[float] | None
    slot_height_m: float
    landing_point_m: Sequence[float]
    min_separation_m: float
    errors: ErrorBudget
    neighbours: Sequence[ReceivedBeacon]
    unreadable_robots: Sequence[int]
    ground_release: str
    missing_robots: Sequence[int]
    fell_silent: Sequence[Neighbour]
    separation: SeparationLimits
    rc: RemoteControl
    ground_age_s: float | None
    time_uncertainty_s: float | None
    has_answer: bool
    answer_problem: str


def failed_checks(inputs: PreflightInputs, limits: PreflightLimits) -> tuple[FailedCheck, ...]:
    """All failed checks, one line each with a remedy; empty means ready.

    Faults that need action come first, then those that settle, which may be consequences.
    """
    found = (
        *_program(inputs, limits),
        *_vehicle(inputs, limits),
        *_place(inputs),
        *_fleet(inputs, limits),
    )
    return tuple(sorted(found, key=lambda check: check.settles_by_itself))


def _program(inputs: PreflightInputs, limits: PreflightLimits) -> Iterator[FailedCheck]:
    if inputs.bundle_problem is not None:
        yield FailedCheck(
            _C.BUNDLE_NOT_VERIFIED,
            f"bundle is not verified ({inputs.bundle_problem}): deploy it again",
        )
    age_s = inputs.ground_age_s
    if age_s is None:
        yield FailedCheck(
            _C.GROUND_NOT_HEARD,
            "ground was not heard: start `lpac ground`, check the radio and the fleet's name",
        )
    elif not age_s <= limits.max_ground_age_s:
        yield FailedCheck(
            _C.GROUND_SILENT, f"ground was last heard {age_s:.1f} s ago: check the radio"
        )
    error_s = inputs.time_uncertainty_s
    if age_s is not None and not (error_s is not None and error_s <= limits.max_time_uncertainty_s):
        known = "not known yet" if error_s is None else f"known to {error_s:.1f} s only"
        text = f"the ground's time is {known}: wait, or check the radio"
        yield _settles(_C.TIME_NOT_KNOWN, text)
    # Without a position there is nothing to perceive.
    if inputs.position_m is not None and not inputs.has_answer:
        why = inputs.answer_problem or "wait; if this stays, this robot's log says why"
        text = f"the policy has no fresh answer: {why}"
        yield FailedCheck(_C.NO_FRESH_ANSWER, text, not inputs.answer_problem)


def _vehicle(inputs: PreflightInputs, limits: PreflightLimits) -> Iterator[FailedCheck]:
    vehicle = inputs.vehicle
    if not vehicle.connected:
        # State received before says nothing about the present.
        others = ", ".join(map(str, vehicle.other_system_ids))
        if others:
            yield FailedCheck(
                _C.OTHER_AUTOPILOT,
                f"autopilot with system id {inputs.system_id} is not connected, but system id "
                f"{others} is: set MAV_SYS_ID or the config",
            )
        else:
            yield FailedCheck(
                _C.AUTOPILOT_NOT_CONNECTED,
                "autopilot is not connected: check its power and the connection's address",
            )
        return
    if vehicle.system_id != inputs.system_id:
        yield FailedCheck(
            _C.SYSTEM_ID_WRONG,
            f"autopilot has system id {_or_unknown(vehicle.system_id)}, configured is "
            f"{inputs.system_id}: check which vehicle this is, set MAV_SYS_ID or the config",
        )
    if is_too_old(vehicle.version):
        oldest = ".".join(map(str, OLDEST))
        yield FailedCheck(
            _C.PX4_TOO_OLD,
            f"autopilot has PX4 {vehicle.version}, must have {oldest} or newer: update it",
        )
    if vehicle.other_system_ids:
        others = ", ".join(map(str, vehicle.other_system_ids))
        yield FailedCheck(
            _C.OTHER_VEHICLES,
            f"other vehicles are on this link (system id {others}): give each its own port",
        )
    if inputs.rc == "pilot" and not vehicle.remote_control:
        yield FailedCheck(
            _C.REMOTE_CONTROL_NOT_HEARD,
            "remote control is not heard, and the config has a pilot: switch it on",
        )
    if vehicle.armed is not False:
        state = "armed" if vehicle.armed else "not known to be disarmed"
        yield FailedCheck(_C.NOT_DISARMED, f"vehicle is {state}: disarm it")
    yield from _estimate(vehicle, inputs, limits)
    yield from _gps(vehicle.gps, limits)
    yield from _battery(vehicle.battery, limits)
    yield from _arming(inputs)


def _battery(battery: float | None, limits: PreflightLimits) -> Iterator[FailedCheck]:
    if battery is None:
        yield FailedCheck(_C.BATTERY_NOT_KNOWN, "battery is not known: check the power module")
    elif not battery >= limits.min_battery:
        yield FailedCheck(
            _C.BATTERY_LOW,
            f"battery has {100.0 * battery:.0f} %, must have "
            f"{100.0 * limits.min_battery:.0f} %: charge or change it",
        )


def _arming(inputs: PreflightInputs) -> Iterator[FailedCheck]:
    vehicle = inputs.vehicle
    if not vehicle.armable:
        reasons = "; ".join(problem.text for problem in vehicle.problems) or "it does not say why"
        yield FailedCheck(
            _C.NOT_ARMABLE, f"autopilot would not arm ({reasons}): mend what it names"
        )
    if inputs.failsafe_problems is None:
        yield _settles(
            _C.FAILSAFE_NOT_READ,
            "autopilot's failsafe parameters were not read: wait, or check the link",
        )
    else:
        for problem in inputs.failsafe_problems:
            yield FailedCheck(_C.FAILSAFE_WRONG, f"autopilot's {problem}")
    # Without a mission origin there is no fence to upload; that is a check of its own.
    if inputs.fence_changed or not (inputs.fence_uploaded or inputs.origin is None):
        yield _settles(
            _C.FENCE_NOT_UPLOADED,
            "somebody else changed or cleared the autopilot's fence: find out who, and wait until "
            "it is uploaded again"
            if inputs.fence_changed
            else "autopilot does not have the fence: wait for the upload, or check the link",
        )


def _estimate(
    vehicle: VehicleState, inputs: PreflightInputs, limits: PreflightLimits
) -> Iterator[FailedCheck]:
    age_s = inputs.now_s - vehicle.position_at_s
    if vehicle.position_local_m is None:
        yield _settles(
            _C.POSITION_NOT_KNOWN, "position is not known: wait for the autopilot's estimate"
        )
    elif not age_s <= limits.max_position_age_s:
        yield FailedCheck(
            _C.POSITION_OLD, f"position is {age_s:.1f} s old: check the link to the autopilot"
        )
    elif inputs.position.quality is not PositionQuality.GOOD:
        yield _settles(
            _C.POSITION_NOT_GOOD,
            f"position is {inputs.position.quality} ({inputs.position.text}): wait, or move to "
            "open sky",
        )
    if vehicle.origin is None:
        yield _settles(
            _C.ESTIMATOR_ORIGIN_NOT_KNOWN, "estimator's origin is not known: wait for a GPS fix"
        )
    if vehicle.heading_rad is None:
        yield _settles(_C.HEADING_NOT_KNOWN, "heading is not known: check the compass")


def _gps(gps: Gps | None, limits: PreflightLimits) -> Iterator[FailedCheck]:
    if gps is None:
        yield FailedCheck(_C.GPS_NOT_HEARD, "GPS is not heard: check the receiver")
        return
    if gps.fix < _FIX_3D:
        yield _settles(_C.GPS_NO_FIX, "GPS has no 3-D fix: wait, or move to open sky")
    if gps.satellites < limits.min_satellites:
        yield _settles(
            _C.GPS_FEW_SATELLITES,
            f"GPS sees {counted(gps.satellites, 'satellite')}, must see {limits.min_satellites}: "
            "wait, or move to open sky",
        )
    if not gps.hdop <= limits.max_hdop:
        yield _settles(
            _C.GPS_IMPRECISE,
            f"GPS precision (HDOP) is {gps.hdop:.1f}, must be at most {limits.max_hdop:g}: "
            "wait, or move to open sky",
        )


def _place(inputs: PreflightInputs) -> Iterator[FailedCheck]:
    fence = inputs.fence
    if inputs.origin is None:
        yield FailedCheck(_C.ORIGIN_NOT_SET, "mission origin is not set: set it on the ground")
    if inputs.position_m is None:
        yield FailedCheck(
            _C.PLACE_NOT_KNOWN,
            "place in the fence is not known: it needs the position and the mission origin",
        )
    else:
        x_m, y_m, _ = inputs.position_m
        depth_m = fence.distance_m(x_m, y_m)
        if not depth_m >= fence.buffer_m:
            yield FailedCheck(
                _C.STANDS_OUTSIDE,
                f"robot stands {_where(depth_m)}, must be {fence.buffer_m:g} m inside: "
                "carry it there, or check the mission origin",
            )
        beyond = (
            inputs.reach.origin_beyond(inputs.position_m),
            inputs.reach.fence_beyond(fence, inputs.position_m),
        )
        yield from (failed for failed in beyond if failed is not None)
    depth_m = fence.distance_m(*inputs.landing_point_m)
    if not depth_m >= fence.buffer_m:
        yield FailedCheck(
            _C.LANDS_OUTSIDE,
            f"landing point lies {_where(depth_m)}, must be {fence.buffer_m:g} m inside: "
            "change it in the config, or on the ground",
        )
    if not fence.floor_m <= inputs.slot_height_m <= fence.ceiling_m:
        yield FailedCheck(
            _C.HEIGHT_OUTSIDE,
            f"slot height is {inputs.slot_height_m:g} m, must be from the floor at "
            f"{fence.floor_m:g} m to the ceiling at {fence.ceiling_m:g} m: "
            "change it in the config, or on the ground",
        )


def _fleet(inputs: PreflightInputs, limits: PreflightLimits) -> Iterator[FailedCheck]:
    others = [each.beacon for each in inputs.neighbours]
    if inputs.duplicate_id:
        yield FailedCheck(
            _C.DUPLICATE_ID,
            f"another program uses the id of robot {inputs.robot_id}: stop it, or change its id",
        )
    releases = [(f"robot {beacon.robot_id}", beacon.other_release) for beacon in others]
    unreadable = [(f"robot {each}", "not readable") for each in inputs.unreadable_robots]
    for who, release in (*releases, ("the ground", inputs.ground_release), *unreadable):
        if release:
            yield FailedCheck(
                _C.OTHER_RELEASE,
                f"{who} flies another release ({release}) than this robot: deploy one to all",
            )
    for robot_id in inputs.missing_robots:
        yield FailedCheck(
            _C.OTHER_NOT_HEARD,
            f"the ground hears robot {robot_id}, and this robot does not: they would not keep "
            "apart; `lpac fleet radio` tells who hears whom",
        )
    bundle_tag, world_tag = tag(inputs.bundle_id), tag(inputs.world_id)
    frame_id = None if inputs.origin is None else inputs.origin.frame().frame_id
    for beacon in others:
        other = f"robot {beacon.robot_id}"
        if beacon.system_id is not None and beacon.system_id == inputs.system_id:
            yield FailedCheck(
                _C.SAME_SYSTEM_ID,
                f"{other}'s vehicle has the same system id {beacon.system_id}: set MAV_SYS_ID",
            )
        if beacon.bundle_tag != bundle_tag:
            yield FailedCheck(_C.OTHER_BUNDLE, f"{other} has another bundle: deploy one to all")
        if beacon.world_tag != world_tag:
            yield FailedCheck(
                _C.OTHER_WORLD,
                f"{other} has another world: set one on the ground, or deploy it to all",
            )
        if frame_id is not None and beacon.frame_id != frame_id:
            yield FailedCheck(
                _C.OTHER_ORIGIN, f"{other} has another mission origin: set it again on the ground"
            )
        yield from _apart(inputs, beacon, other)
    yield from _in_the_way(inputs, others)
    if not inputs.vehicle.armed:
        yield from _may_come_down(inputs)
        yield from _too_late(inputs.errors, others)


def _may_come_down(inputs: PreflightInputs) -> Iterator[FailedCheck]:
    """Whether a robot that fell silent in flight may come down on this one."""
    if inputs.position_m is None:
        return
    place_m, limits = np.array(inputs.position_m[:2]), inputs.separation.silence
    for silent in inputs.fell_silent:
        near_m = nearest_place_m(silent, limits, place_m)
        apart_m = float(np.hypot(*(near_m - place_m)))
        least_m = inputs.separation.landed_m + deviation_m(silent, limits)
        if apart_m < least_m and highest_possible_m(silent, limits) > 0.0:
            yield _settles(
                _C.SILENT_NEAR,
                f"robot {silent.robot_id} fell silent in flight, and may come down here: wait "
                "until it is heard or surely down",
            )


def _too_late(errors: ErrorBudget, others: Sequence[Beacon]) -> Iterator[FailedCheck]:
    """Whether somebody took off so long ago that its height reference has drifted."""
    armed = [beacon for beacon in others if beacon.armed]
    known = [(s.robot_id, math.inf if s.flown_s is None else s.flown_s) for s in armed]
    robot_id, flown_s = max(known, key=lambda each: each[1], default=(-1, -math.inf))
    window_s = errors.takeoffs_window_s
    if flown_s > window_s:
        since = (
            f"for more than {window_s:.3g} s"
            if math.isfinite(flown_s)
            else "since before its program started"
        )
        # Without a number that changes, so that the text stays the same.
        yield FailedCheck(
            _C.TAKEOFFS_TOO_FAR_APART,
            f"robot {robot_id} has been in the air {since}: heights have walked since then; wait "
            "until all are down, or raise takeoffs_height_m of [errors]",
        )


def _in_the_way(inputs: PreflightInputs, others: Sequence[Beacon]) -> Iterator[FailedCheck]:
    """Whether a robot stands at this robot's place of landing."""
    frame_id = None if inputs.origin is None else inputs.origin.frame().frame_id
    standing = standing_robots(beacon for beacon in others if beacon.frame_id == frame_id)
    x_m, y_m = inputs.landing_point_m
    for other, _ in in_the_way((x_m, y_m), standing, inputs.errors):
        least_m = places_apart(inputs.errors.position_m, inputs.errors.position_m).least_m
        yield FailedCheck(
            _C.LANDING_POINT_TAKEN,
            f"robot {other.robot_id} stands less than {least_m:.3g} m from this robot's landing "
            "point, or comes down there, and not at its own: carry it there, or change the places "
            "on the ground",
        )


def _apart(inputs: PreflightInputs, beacon: Beacon, other: str) -> Iterator[FailedCheck]:
    """Whether two robots stay apart in truth, in height and where they land."""
    errors, gps = inputs.errors, inputs.vehicle.gps
    limit_m = inputs.min_separation_m
    heights = errors.slot_spacing.or_at_least(limit_m, "min_separation_m")
    apart_m = abs(beacon.slot_height_m - inputs.slot_height_m)
    if not heights.holds(apart_m):
        yield FailedCheck(
            _C.HEIGHTS_TOO_NEAR,
            f"{other} flies {apart_m:.1f} m above or below, {heights}: "
            "change the slots in the config, or on the ground",
        )
    places = places_apart(
        errors.reported_position_m(None if gps is None else gps.accuracy_m),
        errors.reported_position_m(beacon.gps_accuracy_m),
    ).or_at_least(limit_m, "min_separation_m")
    apart_m = math.dist(beacon.landing_point_m, inputs.landing_point_m)
    if not places.holds(apart_m):
        planned = places_apart(errors.position_m, errors.position_m)
        why = "too near for the GPS accuracy that is reported; " if planned.holds(apart_m) else ""
        yield FailedCheck(
            _C.LANDINGS_TOO_NEAR,
            f"{other} lands {apart_m:.1f} m away, {places}: "
            f"{why}change the landing points in the config, or on the ground",
        )


def _settles(code: CheckCode, text: str) -> FailedCheck:
    return FailedCheck(code, text, settles_by_itself=True)


def _where(depth_m: float) -> str:
    return f"{depth_m:.1f} m inside the fence" if depth_m >= 0.0 else f"{-depth_m:.1f} m outside it"


def _or_unknown(value: int | None) -> str:
    return "not known" if value is None else str(value)
