"""`lpac replay` as a user types it."""

import contextlib
import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from edge.drivers.flight_log import FlightLog, FlightMetadata
from edge.drivers.log_reader import read
from edge.flight.record import FlightTick, TickReader, TickWriter
from edge.messages.mission import FlightState
from edge.policy.bundle import Bundle
from edge.policy.lpac.policy import LpacPolicy
from tests.command import called, error_line, lpac
from tests.conftest import SHIPPED
from tests.record_flights import RECORDED
from tests.unit.policy.test_replay import Messages, fly


@pytest.fixture(scope="module")
def flown(shipped_policy: LpacPolicy) -> Messages:
    return fly(shipped_policy)


def write_log(
    directory: Path, bundle: Bundle, messages: Messages, bundle_path: Path = SHIPPED
) -> Path:
    metadata = FlightMetadata(0, 1, bundle.id, str(bundle_path), "{}", "0.1.0")
    with contextlib.closing(FlightLog(directory, metadata)) as log:
        for topic, unix_time_s, message in messages:
            log.record(topic, unix_time_s, message)
    return max(directory.glob("*.mcap"))


def altered(messages: Messages) -> Messages:
    """With one velocity that is off by a quarter."""
    at = max(n for n, (topic, _, _) in enumerate(messages) if topic == "policy")
    topic, unix_time_s, tick = messages[at]
    velocity = tick["velocity"] + np.array([0.25, 0.0], np.float32)
    return [*messages[:at], (topic, unix_time_s, {**tick, "velocity": velocity})]


def test_a_flight_is_computed_again(
    tmp_path: Path, shipped_bundle: Bundle, flown: Messages
) -> None:
    half = len(flown) // 2
    write_log(tmp_path / "a", shipped_bundle, flown[:half])
    last = write_log(tmp_path / "b", shipped_bundle, flown[half:])
    last.write_bytes(last.read_bytes()[:-500])  # the robot was killed
    text = lpac("replay", tmp_path)
    assert text.returncode == 0, text.stderr
    for output in ("features", "velocity", "message"):
        (line,) = [line for line in text.stdout.splitlines() if line.startswith(output)]
        assert line.split() == [
            output, "6", "ticks,", "0", "differ,", "largest", "difference", "0"
        ]  # fmt: skip
    assert f"{shipped_bundle.id[:12]}: computes what it computed in flight" in text.stdout

    report = json.loads(called("replay", tmp_path / "a", last, "--json").stdout)
    assert report["bundle"] == shipped_bundle.id and report["robots"] == [0]
    assert report["outputs"]["message"] == {"ticks": 6, "differing": 0, "largest_difference": 0.0}


def test_a_difference_is_shown_and_fails(
    tmp_path: Path, shipped_bundle: Bundle, flown: Messages
) -> None:
    log = write_log(tmp_path, shipped_bundle, altered(flown))
    result = called("replay", log)
    assert "1 differ, largest difference 0.25" in result.stdout
    assert "not what was computed in flight: velocity by up to 0.25" in error_line(result)
    result = called("replay", log, "--json")
    assert result.returncode != 0
    assert json.loads(result.stdout)["outputs"]["velocity"]["differing"] == 1


def test_flights_are_decided_again() -> None:
    """Logs without a policy need no bundle."""
    result = called("replay", RECORDED / "normal.mcap", RECORDED / "killed.mcap", "--json")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["bundle"] is None and report["outputs"] == {}
    for flight in report["flights"]:
        assert flight["robot"] == 0 and flight["ticks"] > 30
        assert flight["differing"] == 0 and flight["differences"] == []
    text = called("replay", RECORDED / "killed.mcap").stdout
    ticks = report["flights"][1]["ticks"]
    assert text.startswith(f"killed            {ticks} ticks, 0 differ\n")


def test_a_decision_that_differs_is_shown_and_fails(tmp_path: Path, shipped_bundle: Bundle) -> None:
    reader, writer = TickReader(), TickWriter()
    messages: Messages = []
    for topic, unix_time_s, message in read(RECORDED / "ground_lost.mcap"):
        tick = reader.tick(message)
        assert tick is not None
        if len(messages) == 40:  # As if it had landed there.
            landing = structs.replace(tick.made.flight, state=FlightState.LAND)
            tick = FlightTick(tick.given, structs.replace(tick.made, flight=landing))
        messages.append((topic, unix_time_s, writer.message(tick)))
    log = write_log(tmp_path, shipped_bundle, messages)
    result = called("replay", log)
    assert "1 differ" in result.stdout
    (row,) = [line for line in result.stdout.splitlines() if " state " in line]
    assert row.split()[2:] == ["4.0", "s", "1", "state", "land", "hold"]
    assert "not what was decided in flight: 1 ticks differ" in error_line(result)
    (flight,) = json.loads(called("replay", log, "--json").stdout)["flights"]
    (difference,) = [d for d in flight["differences"] if d["what"] == "state"]
    assert (difference["then"], difference["now"], difference["ticks"]) == ("land", "hold", 1)


def test_logs_of_the_version_before_say_that_they_hold_no_flight(
    tmp_path: Path, shipped_bundle: Bundle, flown: Messages
) -> None:
    result = lpac("replay", write_log(tmp_path, shipped_bundle, flown))
    assert result.returncode == 0, result.stderr
    assert "robot-0-0001 has no inputs of flight decisions" in result.stdout


def test_another_place_for_the_bundle(
    tmp_path: Path, shipped_bundle: Bundle, flown: Messages
) -> None:
    log = write_log(tmp_path, shipped_bundle, flown, tmp_path / "on the robot")
    line = error_line(called("replay", log))
    assert "on the robot: there is no such file or folder" in line and "give --bundle" in line
    assert called("replay", log, "--bundle", SHIPPED).returncode == 0


def test_mistakes_are_one_line(tmp_path: Path, shipped_bundle: Bundle, flown: Messages) -> None:
    other = dataclasses.replace(shipped_bundle, id="0123456789abcdef" * 4)
    cases = {
        "flew with bundle 0123456789ab, and": write_log(tmp_path / "other", other, flown),
        "no policy ticks": write_log(tmp_path / "idle", shipped_bundle, []),
        "is not an MCAP file": Path("README.md"),
        "holds no flight log (*.mcap)": tmp_path / "empty",
        "absent.mcap": tmp_path / "absent.mcap",
        "was not written by a robot": tmp_path / "cut.mcap",
        "images has shape (1, 4, 16, 16): must be (1, 4, 32, 32)": write_log(
            tmp_path / "foreign", shipped_bundle,
            [(t, s, {**m, "images": np.zeros((1, 4, 16, 16), "f4")}) for t, s, m in flown],
        ),
    }  # fmt: skip
    (tmp_path / "empty").mkdir()
    shutil.copy(cases["no policy ticks"], tmp_path / "cut.mcap")
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "cut.mcap").read_bytes()[:60])
    for text, log in cases.items():
        assert text in error_line(called("replay", log)), text
