"""What is asked of a vehicle before it flies: the real MAVSDK, and a simulated vehicle."""

import dataclasses
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.core.fence import Fence
from edge.core.position import PositionJudgement
from edge.drivers.px4.autopilot import MavsdkAutopilot
from edge.messages.codes import CheckCode
from edge.messages.mission import GroundState, Origin
from edge.robot.config import load_config
from edge.robot.readiness import Assignment, Checks, Readiness
from lpac.sim.px4.modes import MavResult
from lpac.sim.px4.vehicle import Px4Vehicle
from tests.robot_rig import ORIGIN, SYSTEM_ID, Rig, new_vehicle, rig, write_config
from tests.said import codes


@contextmanager
def readiness(
    folder: Path, vehicle: Px4Vehicle, parameters: str, **facts: Any
) -> Iterator[tuple[Readiness, Rig]]:
    changes = {"failsafe": {"rc": "none", "parameters": parameters}}
    with rig(folder, vehicle, changes=changes) as made:
        config = made.config
        with MavsdkAutopilot(config.autopilot.url, system_id=SYSTEM_ID) as autopilot:
            asked = Readiness(
                config, autopilot, autopilot,
                **{"bundle_id": "b", "bundle_problem": None} | facts,
            )  # fmt: skip
            deadline_s = time.monotonic() + 60.0
            while not (autopilot.state().connected and autopilot.state().armable):
                assert time.monotonic() < deadline_s, autopilot.state()
                time.sleep(0.05)
            yield asked, made


def assignment(asked: Readiness, origin: Origin | None = ORIGIN) -> Assignment:
    return Assignment(origin, asked._config.robot(boot_nonce=0), "w")


def checked(asked: Readiness, origin: Origin | None = ORIGIN, **facts: Any) -> Checks:
    now_s = time.monotonic()
    known: dict[str, Any] = {
        "assignment": assignment(asked, origin),
        "position": PositionJudgement(),
        "odometry": None,
        "peers": (),
        "unreadable_robots": (),
        "ground_release": "",
        "missing_robots": (),
        "fell_silent": (),
        "duplicate": False,
        "watchdog_alive": True,
        "is_member": True,
        "members_differ": "",
        "ground_age_s": 0.1,
        "time_uncertainty_s": 0.01,
        "answer_age_s": 0.3,
        "answer_problem": "",
    }
    return asked.checks(now_s, **known | facts)


def about_parameters(checks: Checks) -> list[str]:
    return [check.text for check in checks.failed if check.code is CheckCode.FAILSAFE_WRONG]


def test_refuse_explains_and_changes_nothing(tmp_path: Path) -> None:
    vehicle = new_vehicle(COM_OBL_RC_ACT=0, NAV_RCL_ACT=0)
    with readiness(tmp_path, vehicle, "refuse") as (asked, _):
        before = dict(vehicle.parameters)
        assert CheckCode.FAILSAFE_NOT_READ in codes(checked(asked).failed)
        asked.prepare(time.monotonic(), assignment(asked))
        problems = about_parameters(checked(asked))
        assert any("COM_OBL_RC_ACT = 0" in line and "must land" in line for line in problems)
        assert any("if this program dies" in line for line in asked.explanations)
        assert (
            "if this program hangs, its watchdog lets PX4 hold, 0.5 s later" in asked.explanations
        )
        assert asked.changes == ()
    assert vehicle.parameters == before


def test_set_makes_them_right_but_for_what_is_to_be_set_by_hand(tmp_path: Path) -> None:
    vehicle = new_vehicle(COM_OBL_RC_ACT=0, EKF2_HGT_REF=3)
    with readiness(tmp_path, vehicle, "set") as (asked, _):
        before = dict(vehicle.parameters)
        asked.prepare(time.monotonic(), assignment(asked))
        (problem,) = about_parameters(checked(asked))
        assert "EKF2_HGT_REF = 3" in problem
        assert "by hand" in problem
        changed = {n: v for n, v in vehicle.parameters.items() if v != before[n]}
        assert changed["COM_OBL_RC_ACT"] == 4
        assert "COM_OBL_RC_ACT from 0 to 4" in asked.changes
        assert len(asked.changes) == len(changed)
        assert "EKF2_HGT_REF" not in changed


def test_a_parameter_that_others_change_later_is_noticed(tmp_path: Path) -> None:
    vehicle = new_vehicle()
    with readiness(tmp_path, vehicle, "set") as (asked, _):
        now_s = time.monotonic()
        asked.prepare(now_s, assignment(asked))
        assert about_parameters(checked(asked)) == []
        vehicle.parameters["COM_OBL_RC_ACT"] = 3
        asked.prepare(now_s + 3.0, assignment(asked))
        assert vehicle.parameters["COM_OBL_RC_ACT"] == 3
        asked.prepare(now_s + 31.0, assignment(asked))
        assert vehicle.parameters["COM_OBL_RC_ACT"] == 4


def test_the_fence_is_uploaded_with_its_margin_for_each_new_origin(tmp_path: Path) -> None:
    vehicle = new_vehicle()
    with readiness(tmp_path, vehicle, "set") as (asked, made):
        asked.prepare(time.monotonic(), assignment(asked, None))
        assert not made.vehicle.fence
        for heading_deg in (30.0, 200.0):
            origin = dataclasses.replace(ORIGIN, heading_deg=heading_deg)
            assert CheckCode.FENCE_NOT_UPLOADED in codes(checked(asked, origin).failed)
            asked.prepare(time.monotonic() + heading_deg, assignment(asked, origin))
            assert CheckCode.FENCE_NOT_UPLOADED not in codes(checked(asked, origin).failed)
            (polygon,) = made.vehicle.fence
            transform = origin.frame().relative_to(origin.latitude_deg, origin.longitude_deg)
            # Our fence ends at 34 m, PX4's 5 m further out.
            for along_m, inside in ((38.9, True), (39.1, False), (-6.9, True), (-7.1, False)):
                for place_m in ((along_m, 16.0), (16.0, along_m)):
                    local_m = transform.mission_to_local(np.array([*place_m, 0.0]))
                    assert polygon.contains(made.vehicle._world, *local_m[:2]) is inside, place_m


def test_the_vehicle_gets_the_fence_that_the_ground_sets_and_a_ceiling_to_match(
    tmp_path: Path,
) -> None:
    vehicle = new_vehicle(GF_MAX_VER_DIST=25)
    with readiness(tmp_path, vehicle, "refuse") as (asked, made):
        now_s = time.monotonic()
        configured = assignment(asked)
        asked.prepare(now_s, configured)
        (before,) = made.vehicle.fence
        assert not any("GF_MAX_VER_DIST" in text for text in about_parameters(checked(asked)))
        fence = Fence(((0.0, 0.0), (30.0, 0.0), (30.0, 30.0), (0.0, 30.0)), 1.5, 2.0, 28.0)
        ground = GroundState(1, "op", fence=fence)
        higher = configured._replace(robot=configured.robot.assigned(ground))
        failed = checked(asked, assignment=higher).failed
        assert CheckCode.FENCE_NOT_UPLOADED in codes(failed)
        asked.prepare(now_s + 3.0, higher)
        checks = checked(asked, assignment=higher)
        assert CheckCode.FENCE_NOT_UPLOADED not in codes(checks.failed)
        assert any("GF_MAX_VER_DIST" in text for text in about_parameters(checks))
        assert checks.assignment == higher
        (after,) = made.vehicle.fence
        assert after != before


def test_an_armed_vehicle_is_left_alone(tmp_path: Path) -> None:
    vehicle = new_vehicle()
    with readiness(tmp_path, vehicle, "set") as (asked, made):
        with made.server.stepped:
            assert vehicle.arm() is MavResult.ACCEPTED
        before = dict(vehicle.parameters)
        deadline_s = time.monotonic() + 60.0
        while asked._vehicle.state().armed is not True:
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
        asked.prepare(time.monotonic(), assignment(asked))
        assert (vehicle.parameters, vehicle.fence) == (before, ())
        assert CheckCode.NOT_DISARMED in codes(checked(asked).failed)


def test_a_look_that_fails_before_arming_ends_no_watch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vehicle = new_vehicle()
    with readiness(tmp_path, vehicle, "set") as (asked, made):
        now_s = time.monotonic()
        asked.prepare(now_s, assignment(asked))

        def unanswered(_: object) -> None:
            raise OSError("no answer")

        with monkeypatch.context() as link:
            link.setattr(asked._setup, "read_parameters", unanswered)
            asked.prepare(now_s + 31.0, assignment(asked))
        assert CheckCode.FAILSAFE_NOT_READ in codes(checked(asked).failed)
        with made.server.stepped:
            assert vehicle.arm() is MavResult.ACCEPTED
        vehicle.parameters["COM_OBL_RC_ACT"] = 3
        deadline_s = time.monotonic() + 60.0
        while asked._vehicle.state().armed is not True:
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
        asked.prepare(now_s + 62.0, assignment(asked))
        assert asked.px4_change is not None and "COM_OBL_RC_ACT" in asked.px4_change.text


@pytest.mark.parametrize(
    ("facts", "code"),
    [
        ({"watchdog_alive": False}, CheckCode.WATCHDOG_ENDED),
        ({"duplicate": True}, CheckCode.DUPLICATE_ID),
        ({"is_member": False}, CheckCode.NOT_A_MEMBER),
        ({"members_differ": "r2 has list 8"}, CheckCode.MEMBERS_DIFFER),
        ({"ground_age_s": float("inf")}, CheckCode.GROUND_NOT_HEARD),
        ({"ground_age_s": 9.0}, CheckCode.GROUND_SILENT),
        ({"time_uncertainty_s": None}, CheckCode.TIME_NOT_KNOWN),
    ],
)
def test_what_the_program_knows_itself(
    tmp_path: Path, facts: dict[str, Any], code: CheckCode
) -> None:
    url, endpoint = "udpin://127.0.0.1:14551", "tcp/127.0.0.1:7447"
    config = load_config(write_config(tmp_path, url=url, endpoint=endpoint))
    asked = Readiness(
        config, MavsdkAutopilot(config.autopilot.url), MavsdkAutopilot(config.autopilot.url),
        bundle_id="b", bundle_problem="cnn.onnx does not fit",
    )  # fmt: skip
    checks = checked(asked, **facts)
    assert checks.assignment == assignment(asked)
    assert code in codes(checks.failed)
    assert code not in codes(checked(asked).failed)
    assert CheckCode.BUNDLE_NOT_VERIFIED in codes(checks.failed)
