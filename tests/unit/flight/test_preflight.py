"""Preflight: a robot that is ready has no failed check, and each thing that is wrong is named."""

import dataclasses
import math
from typing import Any

import pytest
from msgspec import structs

from edge.core.fence import Fence
from edge.core.position import PositionCause, PositionJudgement, PositionQuality
from edge.core.px4_version import in_words
from edge.core.schema import ConfigError, from_mapping
from edge.core.vehicle import AutopilotReason, GlobalOrigin, Gps, Mode, VehicleState
from edge.flight.margins import ErrorBudget
from edge.flight.preflight import (
    PreflightInputs,
    PreflightLimits,
    failed_checks,
)
from edge.flight.reach import Reach
from edge.flight.safety import SeparationLimits
from edge.flight.silence import SilenceLimits
from edge.messages.beacon import Beacon, Neighbour, ReceivedBeacon, tag
from edge.messages.codes import CheckCode
from edge.messages.mission import FlightState, Origin

_C = CheckCode
UNIX_S = 1_790_000_000.0
ORIGIN = Origin(47.4, 8.5, 90.0)
LIMITS = PreflightLimits()
VEHICLE = VehicleState(
    connected=True,
    system_id=1,
    position_local_m=(1.0, 2.0, 0.0),
    velocity_local_m_s=(0.0, 0.0, 0.0),
    position_at_s=99.9,
    heading_rad=1.0,
    origin=GlobalOrigin(47.4, 8.5, 400.0),
    mode=Mode.HOLD,
    armed=False,
    in_air=False,
    heartbeat_at_s=99.0,
    battery=0.9,
    gps=Gps(3, 14, 0.8, accuracy_m=0.9),
    armable=True,
)
NEIGHBOUR = Beacon(
    robot_id=2,
    sent=None,
    position_m=(16.0, 8.0, 0.0),
    velocity_m_s=(0.0, 0.0, 0.0),
    state=FlightState.IDLE,
    armed=False,
    system_id=2,
    gps_accuracy_m=None,
    flown_s=None,
    slot_height_m=9.5,
    landing_point_m=(16.0, 8.0),
    frame_id=ORIGIN.frame().frame_id,
    bundle_tag=tag("b"),
    world_tag=tag("w"),
)
READY = PreflightInputs(
    now_s=100.0,
    robot_id=1,
    duplicate_id=False,
    bundle_problem=None,
    bundle_id="b",
    world_id="w",
    system_id=1,
    vehicle=VEHICLE,
    failsafe_problems=(),
    fence=Fence(((0.0, 0.0), (32.0, 0.0), (32.0, 32.0), (0.0, 32.0)), 2.0, 3.0, 25.0),
    reach=Reach(),
    fence_uploaded=True,
    fence_changed=False,
    origin=ORIGIN,
    position=PositionJudgement(PositionQuality.GOOD, None),
    position_m=(8.0, 8.0, 0.0),
    slot_height_m=5.0,
    landing_point_m=(8.0, 8.0),
    min_separation_m=2.0,
    errors=ErrorBudget(),
    neighbours=(ReceivedBeacon(NEIGHBOUR, 99.8, 99.8),),
    unreadable_robots=(),
    ground_release="",
    missing_robots=(),
    fell_silent=(),
    separation=SeparationLimits(
        level_m=1.5,
        passing_m=6.5,
        passing_height_m=3.5,
        piloted_m=7.25,
        landed_m=8.0,
        silence=SilenceLimits(max_speed_m_s=2.0, ceiling_m=25.0, flies_on_s=4.6, hovers_s=66.0),
    ),
    rc="none",
    ground_age_s=0.4,
    time_uncertainty_s=0.05,
    has_answer=True,
    answer_problem="",
)

# What is wrong with the inputs, and the one line that says so.
INPUTS: list[tuple[dict[str, Any], CheckCode, str]] = [
    (
        {"bundle_problem": "cnn differs"},
        _C.BUNDLE_NOT_VERIFIED,
        "bundle is not verified (cnn differs): deploy it again",
    ),
    ({"ground_age_s": None}, _C.GROUND_NOT_HEARD, "ground was not heard: start"),
    ({"ground_age_s": 3.1}, _C.GROUND_SILENT, "ground was last heard 3.1 s ago: check the radio"),
    ({"time_uncertainty_s": None}, _C.TIME_NOT_KNOWN, "the ground's time is not known yet: wait"),
    ({"time_uncertainty_s": 0.3}, _C.TIME_NOT_KNOWN, "the ground's time is known to 0.3 s only"),
    ({"has_answer": False}, _C.NO_FRESH_ANSWER, "the policy has no fresh answer: wait; if this"),
    (
        {"has_answer": False, "answer_problem": "sensor: it shows nothing"},
        _C.NO_FRESH_ANSWER,
        "the policy has no fresh answer: sensor: it shows nothing",
    ),
    (
        {"system_id": 9},
        _C.SYSTEM_ID_WRONG,
        "autopilot has system id 1, configured is 9: check which vehicle this is",
    ),
    (
        {"rc": "pilot"},
        _C.REMOTE_CONTROL_NOT_HEARD,
        "remote control is not heard, and the config has a pilot: switch it on",
    ),
    (
        {"missing_robots": (4,)},
        _C.OTHER_NOT_HEARD,
        "the ground hears robot 4, and this robot does not: they would not keep apart",
    ),
    (
        {"unreadable_robots": (4,)},
        _C.OTHER_RELEASE,
        "robot 4 flies another release (not readable) than this robot: deploy one to all",
    ),
    (
        {"ground_release": "01020304"},
        _C.OTHER_RELEASE,
        "the ground flies another release (01020304) than this robot",
    ),
    (
        {
            "neighbours": (
                ReceivedBeacon(
                    dataclasses.replace(NEIGHBOUR, other_release="01020304"), 99.8, 99.8
                ),
            )
        },
        _C.OTHER_RELEASE,
        "robot 2 flies another release (01020304) than this robot",
    ),
    (
        {"failsafe_problems": None},
        _C.FAILSAFE_NOT_READ,
        "autopilot's failsafe parameters were not read",
    ),
    (
        {"failsafe_problems": ("COM_OF_LOSS_T = 1",)},
        _C.FAILSAFE_WRONG,
        "autopilot's COM_OF_LOSS_T = 1",
    ),
    (
        {"fence_uploaded": False},
        _C.FENCE_NOT_UPLOADED,
        "autopilot does not have the fence: wait for the upload",
    ),
    ({"origin": None}, _C.ORIGIN_NOT_SET, "mission origin is not set: set it on the ground"),
    # The cause alone: a fence that has no place cannot be uploaded.
    (
        {"origin": None, "fence_uploaded": False},
        _C.ORIGIN_NOT_SET,
        "mission origin is not set: set it on the ground",
    ),
    ({"position_m": None}, _C.PLACE_NOT_KNOWN, "place in the fence is not known"),
    # From nowhere there is nothing to look at.
    ({"position_m": None, "has_answer": False}, _C.PLACE_NOT_KNOWN, "place in the fence is not"),
    (
        {"position_m": (1.0, 8.0, 0.0)},
        _C.STANDS_OUTSIDE,
        "robot stands 1.0 m inside the fence, must be 2 m inside",
    ),
    (
        {"position_m": (-1.0, 8.0, 0.0)},
        _C.STANDS_OUTSIDE,
        "robot stands 1.0 m outside it, must be 2 m inside",
    ),
    ({"position_m": (math.nan, 8.0, 0.0)}, _C.STANDS_OUTSIDE, "robot stands nan m outside it"),
    (
        {"landing_point_m": (31.5, 8.0)},
        _C.LANDS_OUTSIDE,
        "landing point lies 0.5 m inside the fence, must be 2 m",
    ),
    (
        {"slot_height_m": 2.0},
        _C.HEIGHT_OUTSIDE,
        "slot height is 2 m, must be from the floor at 3 m to the ceiling",
    ),
    (
        {"reach": Reach(distance_m=33.0)},
        _C.FENCE_OUT_OF_REACH,
        "fence reaches to 34 m from this robot, must be within its reach of 33 m: carry it nearer",
    ),
    ({"slot_height_m": 26.0}, _C.HEIGHT_OUTSIDE, "slot height is 26 m"),
    ({"duplicate_id": True}, _C.DUPLICATE_ID, "another program uses the id of robot 1: stop it"),
    ({"bundle_id": "c"}, _C.OTHER_BUNDLE, "robot 2 has another bundle: deploy one to all"),
    ({"world_id": "v"}, _C.OTHER_WORLD, "robot 2 has another world: set one on the ground"),
    ({"origin": Origin(47.4, 8.5, 91.0)}, _C.OTHER_ORIGIN, "robot 2 has another mission origin"),
    (
        {"slot_height_m": 6.0},
        _C.HEIGHTS_TOO_NEAR,
        "robot 2 flies 3.5 m above or below, must be 4.5 m (",
    ),
    (
        {"landing_point_m": (8.1, 8.0)},
        _C.LANDINGS_TOO_NEAR,
        "robot 2 lands 7.9 m away, must be 8 m (",
    ),
    (
        {"min_separation_m": 5.0},
        _C.HEIGHTS_TOO_NEAR,
        "robot 2 flies 4.5 m above or below, must be 5 m (min_separ",
    ),
    (
        {"min_separation_m": 8.05, "slot_height_m": 20.0},
        _C.LANDINGS_TOO_NEAR,
        "robot 2 lands 8.0 m away, must be 8.05 m (min_separ",
    ),
    # Where it stands by another origin tells nothing.
    (
        {
            "neighbours": (
                ReceivedBeacon(
                    dataclasses.replace(
                        NEIGHBOUR, frame_id=7, armed=False, position_m=(8.0, 8.0, 0.0)
                    ),
                    99.8,
                    99.8,
                ),
            )
        },
        _C.OTHER_ORIGIN,
        "robot 2 has another mission origin",
    ),
]
DOUBTFUL = PositionJudgement(PositionQuality.DOUBTFUL, PositionCause.GLITCH)
LOST = PositionJudgement(PositionQuality.LOST, PositionCause.NO_FIX)
# In the place of a position that is missing or old.
POSITIONS: list[tuple[dict[str, Any], CheckCode, str]] = [
    (
        {"position": DOUBTFUL},
        _C.POSITION_NOT_GOOD,
        f"position is doubtful ({DOUBTFUL.text}): wait, or move",
    ),
    (
        {"position": LOST},
        _C.POSITION_NOT_GOOD,
        f"position is lost ({LOST.text}): wait, or move to open sky",
    ),
]
VEHICLES: list[tuple[dict[str, Any], CheckCode, str]] = [
    (
        {"connected": False},
        _C.AUTOPILOT_NOT_CONNECTED,
        "autopilot is not connected: check its power",
    ),
    ({"system_id": None}, _C.SYSTEM_ID_WRONG, "autopilot has system id not known, configured is 1"),
    (
        {"other_system_ids": (4, 6)},
        _C.OTHER_VEHICLES,
        "other vehicles are on this link (system id 4, 6)",
    ),
    (
        {"version": "1.13.3"},
        _C.PX4_TOO_OLD,
        "autopilot has PX4 1.13.3, must have 1.14 or newer: update it",
    ),
    ({"armed": True}, _C.NOT_DISARMED, "vehicle is armed: disarm it"),
    ({"armed": None}, _C.NOT_DISARMED, "vehicle is not known to be disarmed: disarm it"),
    ({"position_local_m": None}, _C.POSITION_NOT_KNOWN, "position is not known: wait"),
    ({"position_at_s": 99.0}, _C.POSITION_OLD, "position is 1.0 s old: check the link"),
    (
        {"origin": None},
        _C.ESTIMATOR_ORIGIN_NOT_KNOWN,
        "estimator's origin is not known: wait for a GPS fix",
    ),
    ({"heading_rad": None}, _C.HEADING_NOT_KNOWN, "heading is not known: check the compass"),
    ({"gps": None}, _C.GPS_NOT_HEARD, "GPS is not heard: check the receiver"),
    ({"gps": Gps(2, 14, 0.8)}, _C.GPS_NO_FIX, "GPS has no 3-D fix: wait"),
    ({"gps": Gps(3, 5, 0.8)}, _C.GPS_FEW_SATELLITES, "GPS sees 5 satellites, must see 8: wait"),
    (
        {"gps": Gps(3, 14, math.nan)},
        _C.GPS_IMPRECISE,
        "GPS precision (HDOP) is nan, must be at most 2",
    ),
    ({"battery": None}, _C.BATTERY_NOT_KNOWN, "battery is not known: check the power module"),
    ({"battery": math.nan}, _C.BATTERY_LOW, "battery has nan %, must have 50 %"),
    ({"battery": 0.3}, _C.BATTERY_LOW, "battery has 30 %, must have 50 %: charge or change it"),
    (
        {"armable": False, "problems": (AutopilotReason("check_mag_missing", (0,), "no mag"),)},
        _C.NOT_ARMABLE,
        "autopilot would not arm (no mag): mend",
    ),
    ({"armable": None}, _C.NOT_ARMABLE, "autopilot would not arm (it does not say why)"),
]


def test_a_robot_that_is_ready_fails_no_check() -> None:
    assert failed_checks(READY, LIMITS) == ()
    alone = dataclasses.replace(READY, neighbours=())
    assert failed_checks(alone, LIMITS) == ()


@pytest.mark.parametrize(("change", "code", "said"), [*INPUTS, *POSITIONS])
def test_whatever_is_wrong_is_named_alone(
    change: dict[str, Any], code: CheckCode, said: str
) -> None:
    (failed,) = failed_checks(dataclasses.replace(READY, **change), LIMITS)
    assert failed.code is code
    assert failed.text.startswith(said)


@pytest.mark.parametrize(("change", "code", "said"), VEHICLES)
def test_whatever_is_wrong_with_the_vehicle_is_named_alone(
    change: dict[str, Any], code: CheckCode, said: str
) -> None:
    vehicle = structs.replace(VEHICLE, **change)
    (failed,) = failed_checks(dataclasses.replace(READY, vehicle=vehicle), LIMITS)
    assert failed.code is code
    assert failed.text.startswith(said)


def test_what_settles_under_open_sky_is_marked() -> None:
    settling = set()
    changes = [change for change, _, _ in INPUTS + POSITIONS]
    changes += [{"vehicle": structs.replace(VEHICLE, **change)} for change, _, _ in VEHICLES]
    for change in changes:
        failed = failed_checks(dataclasses.replace(READY, **change), LIMITS)
        settling |= {each.code for each in failed if each.settles_by_itself}
    assert settling == {
        _C.FAILSAFE_NOT_READ, _C.FENCE_NOT_UPLOADED, _C.POSITION_NOT_KNOWN, _C.POSITION_NOT_GOOD,
        _C.ESTIMATOR_ORIGIN_NOT_KNOWN, _C.HEADING_NOT_KNOWN, _C.GPS_NO_FIX,
        _C.GPS_FEW_SATELLITES, _C.GPS_IMPRECISE, _C.TIME_NOT_KNOWN, _C.NO_FRESH_ANSWER,
    }  # fmt: skip
    # A policy that is broken does not mend itself; and what somebody has to do comes first.
    broken: dict[str, Any] = {"has_answer": False, "answer_problem": "it raises"}
    no_fix = structs.replace(VEHICLE, gps=Gps(2, 14, 0.8))
    failed = failed_checks(
        dataclasses.replace(READY, vehicle=no_fix, **broken, origin=None), LIMITS
    )
    assert [(each.code, each.settles_by_itself) for each in failed] == [
        (_C.NO_FRESH_ANSWER, False), (_C.ORIGIN_NOT_SET, False), (_C.GPS_NO_FIX, True),
    ]  # fmt: skip


@pytest.mark.parametrize(("change", "code", "said"), INPUTS)
def test_everything_that_is_wrong_at_once_is_named(
    change: dict[str, Any], code: CheckCode, said: str
) -> None:
    for vehicle_change, vehicle_code, _ in VEHICLES:
        if vehicle_change.get("connected") is False or (
            "system_id" in change and "system_id" in vehicle_change
        ):
            continue
        vehicle = structs.replace(VEHICLE, **vehicle_change)
        failed = failed_checks(dataclasses.replace(READY, vehicle=vehicle, **change), LIMITS)
        assert sorted(each.code for each in failed) == sorted((code, vehicle_code)), said


def test_what_a_lost_autopilot_said_before_counts_for_nothing() -> None:
    lost = structs.replace(VEHICLE, connected=False, battery=0.1, armed=True)
    (failed,) = failed_checks(dataclasses.replace(READY, vehicle=lost), LIMITS)
    assert failed.code is _C.AUTOPILOT_NOT_CONNECTED


def test_a_neighbour_without_an_origin_has_not_ours() -> None:
    neighbour = ReceivedBeacon(dataclasses.replace(NEIGHBOUR, frame_id=0), 99.8, 99.8)
    (failed,) = failed_checks(dataclasses.replace(READY, neighbours=(neighbour,)), LIMITS)
    assert failed.code is _C.OTHER_ORIGIN


def in_the_air(*flown_s: float | None) -> tuple[ReceivedBeacon, ...]:
    """Neighbours from robot 2 on, each for so long."""
    return tuple(
        ReceivedBeacon(
            dataclasses.replace(
                NEIGHBOUR, robot_id=2 + i, system_id=2 + i, state=FlightState.HOLD, armed=True,
                flown_s=each_s, slot_height_m=9.5 + 4.5 * i, landing_point_m=(16.0 + 8.0 * i, 8.0),
            ), 99.8, 99.8,
        )
        for i, each_s in enumerate(flown_s)
    )  # fmt: skip


def test_nobody_follows_those_who_took_off_long_ago() -> None:
    def said(*flown_s: float | None, **changed: Any) -> list[str]:
        inputs = dataclasses.replace(READY, neighbours=in_the_air(*flown_s))
        failed = failed_checks(dataclasses.replace(inputs, **changed), LIMITS)
        assert {each.code for each in failed} <= {_C.TAKEOFFS_TOO_FAR_APART, _C.NOT_DISARMED}
        return [each.text for each in failed]

    assert said(49.9, 10.0) == []
    (line,) = said(30.0, 63.0)
    assert line == (
        "robot 3 has been in the air for more than 50 s: heights have walked since then; wait "
        "until all are down, or raise takeoffs_height_m of [errors]"
    )
    # Its program has started since: it may have been long.
    (line,) = said(63.0, None)
    assert line.startswith("robot 3 has been in the air since before its program started: heights")
    for patient in (ErrorBudget(takeoffs_height_m=1.0), ErrorBudget(height_common_m=0.0)):
        wide = tuple(
            structs.replace(
                heard, beacon=dataclasses.replace(heard.beacon, slot_height_m=20.0 + 5.0 * i)
            )
            for i, heard in enumerate(in_the_air(63.0, 63.0))
        )
        assert said(errors=patient, neighbours=wide) == []
    # Who is in the air himself took off with them.
    (line,) = said(63.0, 63.0, vehicle=structs.replace(VEHICLE, armed=True))
    assert line == "vehicle is armed: disarm it"


def lines(
    own: Gps, its_accuracy_m: float | None, landing_x_m: float, errors: ErrorBudget
) -> list[str]:
    """What fails if the robot lands at (8, 8), and its neighbour beside it."""
    neighbour = dataclasses.replace(
        NEIGHBOUR, landing_point_m=(landing_x_m, 8.0), gps_accuracy_m=its_accuracy_m
    )
    heard = ReceivedBeacon(neighbour, 99.8, 99.8)
    vehicle = structs.replace(VEHICLE, gps=own)
    inputs = dataclasses.replace(READY, vehicle=vehicle, neighbours=(heard,), errors=errors)
    failed = failed_checks(inputs, LIMITS)
    assert {each.code for each in failed} <= {_C.LANDINGS_TOO_NEAR}
    return [each.text for each in failed]


# It flew on towards the robot, from 16 m away, and stopped 9.2 m nearer.
SILENT = Neighbour(3, (24.0, 8.0, 9.5), (-2.0, 0.0, 0.0), 10.0)


def test_nobody_takes_off_where_somebody_may_come_down_who_fell_silent() -> None:
    (failed,) = failed_checks(dataclasses.replace(READY, fell_silent=(SILENT,)), LIMITS)
    assert failed.code is _C.SILENT_NEAR and failed.settles_by_itself
    assert failed.text.startswith("robot 3 fell silent in flight, and may come down here: wait")


@pytest.mark.parametrize(
    ("silent", "armed"),
    [
        # It stops too far away; it must be down; the robot flies itself.
        (structs.replace(SILENT, velocity_m_s=(2.0, 0.0, 0.0)), False),
        (structs.replace(SILENT, age_s=66.0 + 9.5 / 0.5), False),
        (SILENT, True),
    ],
)
def test_nobody_waits_for_who_cannot_come_down_here(silent: Neighbour, armed: bool) -> None:
    vehicle = structs.replace(VEHICLE, armed=armed)
    inputs = dataclasses.replace(READY, fell_silent=(silent,), vehicle=vehicle)
    assert _C.SILENT_NEAR not in {check.code for check in failed_checks(inputs, LIMITS)}


def test_a_receiver_that_reports_worse_than_the_budget_wants_more_room() -> None:
    good, bad = Gps(3, 14, 0.8, accuracy_m=0.02), Gps(3, 14, 0.8, accuracy_m=2.0)
    budget = ErrorBudget()
    assert lines(good, 0.02, 16.0, budget) == []
    # A good report alone makes nothing legal.
    (line,) = lines(good, 0.02, 15.9, budget)
    assert "must be 8 m" in line
    for own, its_accuracy_m in ((bad, 0.02), (good, 2.0)):
        (line,) = lines(own, its_accuracy_m, 16.0, budget)
        assert "must be 9 m" in line
        assert ": too near for the GPS accuracy that is reported; change the landing" in line
    assert failed_checks(
        dataclasses.replace(
            READY, vehicle=structs.replace(VEHICLE, gps=bad), neighbours=()
        ), LIMITS
    ) == ()  # fmt: skip


def test_receivers_with_corrections_stand_nearer_as_long_as_they_report_it() -> None:
    rtk = ErrorBudget(gps_m=0.1)
    fixed = Gps(6, 20, 0.6, accuracy_m=0.02)
    assert lines(fixed, 0.02, 10.2, rtk) == []
    (line,) = lines(fixed, 0.02, 10.1, rtk)
    assert "robot 2 lands 2.1 m away, must be 2.2 m" in line
    for own, its_accuracy_m in (
        (dataclasses.replace(fixed, accuracy_m=None), 0.02),
        (fixed, None),
        (dataclasses.replace(fixed, accuracy_m=0.4), 0.02),
    ):
        (line,) = lines(own, its_accuracy_m, 10.2, rtk)
        assert ": too near for the GPS accuracy that is reported" in line


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"min_battery": 0.0}, "min_battery = 0.0: must be above 0 and at most 1"),
        ({"min_battery": 50.0}, "min_battery = 50.0"),
        ({"min_satellites": 3}, "min_satellites = 3: must be at least 4"),
        ({"max_hdop": math.inf}, "max_hdop = inf: must be above 0 and finite"),
        ({"max_position_age_s": 0.0}, "max_position_age_s = 0.0"),
        ({"max_ground_age_s": math.nan}, "max_ground_age_s = nan"),
        ({"max_time_uncertainty_s": -1.0}, "max_time_uncertainty_s = -1.0"),
    ],
)
def test_limits_that_make_no_sense_are_refused_by_name(
    change: dict[str, object], said: str
) -> None:
    assert from_mapping(PreflightLimits, {}, "robot.toml: preflight") == LIMITS
    with pytest.raises(ConfigError, match=said):
        from_mapping(PreflightLimits, change, "robot.toml: preflight")


@pytest.mark.parametrize(
    ("version", "words"),
    [
        ("1.14.0", "PX4 1.14.0 (tested: PX4 SITL 1.14.4)"),
        ("1.16.2", "PX4 1.16.2 (read in its sources, never tried)"),
        ("1.17.0", "PX4 1.17.0 (tested: PX4 SITL 1.17.0)"),
        ("1.18.0", "PX4 1.18.0 (not tested: newer than 1.17)"),
        ("2.0.0", "PX4 2.0.0 (not tested: newer than 1.17)"),
        (None, "PX4 did not report its version"),
    ],
)
def test_a_version_is_told_with_how_far_it_was_tried_and_not_refused(
    version: str | None, words: str
) -> None:
    vehicle = structs.replace(READY.vehicle, version=version)
    assert failed_checks(dataclasses.replace(READY, vehicle=vehicle), LIMITS) == ()
    assert in_words(version) == words
