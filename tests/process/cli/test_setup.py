"""`lpac robot setup`: a vehicle's parameters, set once through MAVSDK."""

import json
from pathlib import Path

from lpac.sim.px4.link import Px4Link
from tests.robot_rig import SYSTEM_ID, lpac_robot, new_vehicle, rig


def setup(url: str, system_id: int = SYSTEM_ID, *more: str) -> tuple[int, str, str]:
    done = lpac_robot(
        "setup", "--url", url, "--system-id", system_id, "--rc", "none", "--ceiling", 20,
        "--wait", 60, *more,
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


def test_all_that_decides_about_safety_is_set_and_then_was_so_already(tmp_path: Path) -> None:
    with rig(tmp_path, new_vehicle(EKF2_HGT_REF=3)) as made:
        url = made.config.autopilot.url
        code, text, errors = setup(url, 11)
        assert code == 0, errors
        assert "set: COM_OBL_RC_ACT from 0 to 4" in text
        assert "set: EKF2_HGT_REF from 3 to 1" in text
        assert f"set: MAV_SYS_ID from {SYSTEM_ID} to 11" in text
        assert "restart the autopilot" in text
        assert made.vehicle.parameters["EKF2_HGT_REF"] == 1
        assert made.vehicle.parameters["MAV_SYS_ID"] == 11
        # It was not restarted, and answers as before.
        code, text, _ = setup(url, 11, "--json")
        assert code == 0
        report = json.loads(text)
        assert report == {
            "system_id": SYSTEM_ID, "changes": [], "problems": [], "needs_reboot": True,
        }  # fmt: skip
        made.vehicle.parameters["MAV_SYS_ID"] = SYSTEM_ID
        assert setup(url, SYSTEM_ID)[:2] == (0, "nothing had to be changed\n")


def test_nothing_is_set_on_an_armed_vehicle_nor_where_there_are_two(tmp_path: Path) -> None:
    vehicle = new_vehicle(COM_DISARM_PRFLT=0.0)
    with rig(tmp_path, vehicle) as made:
        assert made.vehicle_is(lambda vehicle: vehicle.arm().name == "ACCEPTED")
        before = dict(vehicle.parameters)
        code, _, errors = setup(made.config.autopilot.url, 11)
        assert code == 1
        assert errors == "lpac: the vehicle is armed: nothing was set; disarm it first\n"
        assert vehicle.parameters == before
    other = Px4Link(new_vehicle(), system_id=9)
    with rig(tmp_path, new_vehicle(), other) as made:
        before = dict(made.vehicle.parameters)
        code, _, errors = setup(made.config.autopilot.url, 11)
        assert code == 1
        assert "more than one vehicle is on this link (system ids 7, 9)" in errors
        assert made.vehicle.parameters == before


def test_silence_is_said(tmp_path: Path) -> None:
    code, _, errors = setup("udpin://127.0.0.1:14999", 11, "--wait", "1")
    assert code == 1
    assert "no autopilot connected within 1 s" in errors
    assert tmp_path.exists()
