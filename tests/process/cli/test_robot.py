"""`lpac robot` as a user types it: the checks, and every way in which it cannot start."""

import json
import os
import socket
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest

from edge.core import F32, F64
from edge.messages.codes import CheckCode, FailedCheck, ReasonCode
from edge.robot import process
from edge.robot.config import load_config
from lpac.sim.px4.link import Px4Link
from tests.robot_rig import (
    SYSTEM_ID,
    Changes,
    Rig,
    lpac_robot,
    new_vehicle,
    rig,
    write_config,
)
from tests.said import codes


def failures(made: Rig, wait_s: float) -> tuple[list[FailedCheck], list[str]]:
    """What did not pass, of a check that said no; and what PX4 would do when something fails."""
    result = lpac_robot("check", "--config", made.config_path, "--wait", wait_s, "--json")
    assert result.returncode == 1
    report = json.loads(result.stdout)
    failed = [FailedCheck(**{**each, "code": CheckCode(each["code"])}) for each in report["failed"]]
    assert failed
    plural = "s" if len(failed) > 1 else ""
    assert result.stderr == f"lpac: not ready to fly: {len(failed)} check{plural} failed\n"
    return failed, report["explanations"]


def failures_in_the_end(
    made: Rig, are_so: Callable[[list[CheckCode | ReasonCode]], bool]
) -> tuple[list[FailedCheck], list[str]]:
    """The same; what is not known yet does not pass either.

    So on a busy machine it is asked again, and given more time.
    """
    for wait_s in (4, 15, 60):
        failed, explanations = failures(made, wait_s)
        if are_so(codes(failed)):
            break
    return failed, explanations


def test_check_explains_unsafe_failsafes_and_refuses_them(tmp_path: Path) -> None:
    vehicle = new_vehicle(COM_OBL_RC_ACT=0, NAV_RCL_ACT=0)
    changes: Changes = {"failsafe": {"parameters": "refuse"}}
    with rig(tmp_path, vehicle, changes=changes) as made:
        made.enable()
        before = dict(vehicle.parameters)
        # Only the parameters are wrong.
        failed, explanations = failures_in_the_end(
            made, lambda failed: set(failed) == {CheckCode.FAILSAFE_WRONG}
        )
        assert vehicle.parameters == before
    assert set(codes(failed)) == {CheckCode.FAILSAFE_WRONG}, failed
    assert any("COM_OBL_RC_ACT = 0" in check.text for check in failed)
    # The first tells what the watchdog does, the second PX4 if the program dies.
    assert "land" not in explanations[1]


def test_check_passes_a_good_vehicle_and_says_what_it_set(tmp_path: Path) -> None:
    vehicle = new_vehicle()
    with rig(tmp_path, vehicle) as made:
        made.enable()
        result = lpac_robot("check", "--config", made.config_path, "--wait", 60)
        assert (result.returncode, result.stderr) == (0, "")
        lines = result.stdout.splitlines()
        assert lines[0] == "PX4 1.17.0 (tested: PX4 SITL 1.17.0)"
        assert lines[-1] == "ready to fly"
        assert "set: COM_OBL_RC_ACT from 0 to 4" in lines
        assert any("if this program dies" in line and "land" in line for line in lines)

        again = lpac_robot("check", "--config", made.config_path, "--wait", 60, "--json")
        assert (again.returncode, again.stderr) == (0, "ready to fly\n")
        report = json.loads(again.stdout)
        assert (report["failed"], report["changes"]) == ([], [])
        assert report["explanations"]
    assert not any(truth.armed for truth in vehicle.truth)


def test_check_tries_the_sensor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Blind:
        def view(self, position: F64) -> F32 | None:
            return None

    monkeypatch.setattr(process, "open_sensor", lambda *_: nullcontext(lambda *_: Blind()))
    with rig(tmp_path, new_vehicle()) as made:
        report = process.check(load_config(made.config_path), 0.0)
    assert "sensor world: it shows nothing" in [each.text for each in report.failed]


def test_check_without_a_ground_or_on_a_wrong_vehicle(tmp_path: Path) -> None:
    with rig(tmp_path, new_vehicle(), changes={"autopilot": {"system_id": 9}}) as made:
        failed, _ = failures(made, 3)
    assert {CheckCode.GROUND_NOT_HEARD, CheckCode.OTHER_AUTOPILOT} <= set(codes(failed))


def test_check_refuses_two_vehicles_on_one_link(tmp_path: Path) -> None:
    """And sets nothing, on neither."""
    vehicles = new_vehicle(), new_vehicle()
    before = dict(vehicles[0].parameters)
    with rig(tmp_path, vehicles[0], Px4Link(vehicles[1], system_id=SYSTEM_ID + 1)) as made:
        made.enable()
        expected = [
            CheckCode.OTHER_VEHICLES, CheckCode.FAILSAFE_NOT_READ, CheckCode.FENCE_NOT_UPLOADED,
        ]  # fmt: skip
        failed, _ = failures_in_the_end(made, lambda failed: failed == expected)
    assert codes(failed) == expected
    for vehicle in vehicles:
        assert {**vehicle.parameters, "MAV_SYS_ID": 1} == {**before, "MAV_SYS_ID": 1}


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"policy": {"bundle": "nothing"}}, "nothing"),
        ({"policy": {"payload": "int8"}}, "was judged with float32, float16 alone"),
        ({"policy": {"world": "nothing.env"}}, "nothing.env"),
        ({"policy": {"world": "broken.env"}}, "broken.env: record 1 (CircularBND)"),
        ({"flight": {"slot": 99}}, "slot = 99 flies at 450.5 m"),
        (
            {"link": {"listen": ["tcp/192.0.2.1:1"], "insecure": True}},
            "this machine has no such address",
        ),
        ({"link": {"listen": ["TAKEN"]}}, "another program has this port"),
    ],
)
def test_what_keeps_it_from_starting_is_one_line(
    tmp_path: Path, changes: Changes, error: str
) -> None:
    (tmp_path / "broken.env").write_text("CircularBND 1 2")
    with socket.socket() as taken, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        free.bind(("127.0.0.1", 0))
        url, endpoint = (
            f"{kind}://127.0.0.1:{each.getsockname()[1]}"
            for kind, each in (("udpin", free), ("tcp", taken))
        )
        endpoint = endpoint.replace("://", "/")
        free.close()
        if "link" in changes:
            listen = [e.replace("TAKEN", endpoint) for e in changes["link"]["listen"]]
            changes = {"link": {**changes["link"], "listen": listen}}
        path = write_config(tmp_path, url=url, endpoint=endpoint, changes=changes)
        result = lpac_robot("run", "--config", path)
    assert result.returncode == 1
    # What it did until then is in JSON.
    *log, line = result.stderr.splitlines()
    assert all(json.loads(entry) for entry in log)
    assert line.startswith("lpac: ")
    assert error in line


@pytest.mark.parametrize("command", ["run", "check"])
def test_a_vehicle_that_another_program_has(tmp_path: Path, command: str) -> None:
    path = write_config(tmp_path, url="udpin://127.0.0.1:14998", endpoint="tcp/127.0.0.1:1")
    with socket.socket(socket.AF_UNIX) as held:
        held.bind("\0lpac the autopilot's port 14998")
        held.listen()
        result = lpac_robot(command, "--config", path)
    assert result.returncode == 1
    assert result.stderr == (
        f"lpac: the autopilot's port 14998 is in use by process {os.getpid()} on this machine: "
        "stop that first\n"
    )


def test_a_configuration_that_is_not_there() -> None:
    for command in ("run", "check"):
        result = lpac_robot(command, "--config", "none.toml")
        assert result.returncode == 1
        assert result.stderr == "lpac: none.toml: cannot be read: there is no such file or folder\n"
