"""True positions from files beside a field day's logs."""

import dataclasses
import struct
from pathlib import Path

import numpy as np
import pytest

from edge.messages.mission import Origin
from lpac.analysis.field_truth import read_places
from lpac.analysis.truth import TRUTH, TrueTrack, write_truth
from lpac.analysis.voronoi import coverage_cost
from tests.ulog import HEADER, message
from tests.unit.analysis.test_examination import BEGAN_S, FIRST, IMPORTANCE, SCALE, Writer, examined

ORIGIN = Origin(40.0, -75.0, 30.0)
# Error of the robots' positions: x, y, m.
OFF_M = np.array([0.6, -0.4])
TIMES_S = np.arange(FIRST.begin_s - 3.0, FIRST.begin_s + FIRST.duration_s + 3.0, 0.2)


@pytest.fixture
def day(tmp_path: Path) -> Path:
    """One trial's logs, of robots that know the origin."""
    writer = Writer((FIRST,))
    writer.change = lambda status, _: dataclasses.replace(status, origin=ORIGIN)
    writer.robots(tmp_path)
    writer.ground(tmp_path / "logs")
    return tmp_path


def truly_m(robot: int, at_s: float) -> list[float]:
    return [*(np.array(FIRST.place_m(robot, at_s)) + OFF_M).tolist(), 4.0 + 2.0 * robot]


def write_table(path: Path, robot: int, *, is_global: bool = False) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    names = "latitude_deg,longitude_deg" if is_global else "x_m,y_m"
    lines = [f"unix_s,{names},height_m"]
    for at_s in TIMES_S.tolist():
        x_m, y_m, height_m = truly_m(robot, at_s)
        place = ORIGIN.frame().to_global_deg(x_m, y_m) if is_global else (x_m, y_m)
        lines.append(",".join(repr(v) for v in (BEGAN_S + at_s, *place, height_m)))
    path.write_text("\n".join(lines) + "\n")


def write_log(path: Path, robot: int, *, fix_type: int = 6, old: bool = False) -> None:
    """Write a log of PX4 v1.15 or older: it begins on the ground and lacks a fix while climbing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    place = "int32_t lat;int32_t lon;int32_t alt;"
    if not old:
        place = "double latitude_deg;double longitude_deg;double altitude_msl_m;"
    fields = f"sensor_gps:uint64_t timestamp;uint64_t time_utc_usec;{place}uint8_t fix_type;"
    data = HEADER + message("B", bytes(40)) + message("F", fields.encode())
    data += message("A", struct.pack("<BH", 0, 0) + b"sensor_gps")
    began_s = TIMES_S[0] - 5.0
    for at_s in [began_s, *TIMES_S.tolist()]:
        x_m, y_m, height_m = truly_m(robot, at_s)
        latitude, longitude = ORIGIN.frame().to_global_deg(x_m, y_m)
        height_m = 0.0 if at_s == began_s else height_m
        times_us = round((at_s + 100.0) * 1e6), round((BEGAN_S + at_s) * 1e6)
        packed = struct.pack("<3d", latitude, longitude, 200.0 + height_m)
        if old:
            whole = (latitude * 1e7, longitude * 1e7, (200.0 + height_m) * 1e3)
            packed = struct.pack("<3i", *map(round, whole))
        data += message("D", struct.pack("<HQQ", 0, *times_us) + packed + bytes([fix_type]))
    path.write_bytes(data)


def true_cost(at_s: float) -> float:
    places_m = np.array([truly_m(robot, at_s)[:2] for robot in range(3)])
    return coverage_cost(IMPORTANCE, places_m * SCALE)


def test_the_true_cost_is_that_of_where_the_instruments_saw_them(day: Path) -> None:
    write_table(day / "r0" / "truth.csv", 0)
    write_table(day / "r1" / "video" / "truth.csv", 1, is_global=True)
    write_log(day / "r2" / "px4" / "sess001" / "log100.ulg", 2)
    found = examined(day)
    (values,) = found.summary()["trials"]
    assert found.notes == ()
    cost = values["truth"]["cost"]
    assert cost["initial"] == pytest.approx(true_cost(FIRST.begin_s), rel=3e-3)
    assert cost["final"] == pytest.approx(true_cost(FIRST.begin_s + FIRST.duration_s), rel=3e-3)
    assert abs(values["cost"]["final"] / cost["final"] - 1.0) > 0.01
    apart_m, believed_m = (each["separation"]["distance_m"] for each in (values["truth"], values))
    assert apart_m == pytest.approx(believed_m, abs=0.01)


def test_of_whom_nothing_is_known_leaves_the_true_figures_open(day: Path) -> None:
    write_table(day / "r0" / "truth.csv", 0)
    write_log(day / "r1" / "log.ulg", 1, old=True)
    write_log(day / "r2" / "log.ulg", 2, fix_type=5)
    write_table(day / "elsewhere" / "truth.csv", 2)
    found = examined(day)
    (values,) = found.summary()["trials"]
    elsewhere, unfixed = found.notes
    assert "is not in the folder of a robot (r0, r1, r2): skipped" in elsewhere
    assert unfixed == "no RTK fix in the PX4 log of r2: true positions are incomplete"
    assert values["truth"]["cost"]["final"] is None and values["truth"]["separation"] is None


def test_what_lies_between_two_places_is_not_made_up(day: Path) -> None:
    for robot in range(3):
        write_table(day / f"r{robot}" / "truth.csv", robot)
    path = day / "r0" / "truth.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:20] + lines[30:]))
    (record,) = examined(day).records
    # NaN in the gap only.
    at_s = TIMES_S[18:31] - FIRST.begin_s - 0.1
    known = np.isfinite(record.truth["r0"].positions_at(at_s)[:, 0])
    assert known[0] and known[-1] and not known[1:-1].any()
    assert np.isfinite(record.truth["r1"].places_at(at_s)).all()


def test_a_simulation_knows_better(day: Path) -> None:
    write_table(day / "r0" / "truth.csv", 0)
    times_s = BEGAN_S + TIMES_S
    standing = TrueTrack(times_s, np.zeros((len(times_s), 3)), np.ones(len(times_s), bool))
    write_truth({0: standing}, day / TRUTH)
    (record,) = examined(day).records
    assert not record.truth["r0"].position_m.any()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "begins with '': must be unix_s,x_m,y_m,height_m or unix_s,latitude_deg,"),
        ("t,x,y,z\n1,2,3,4\n", "begins with 't,x,y,z': must be unix_s,"),
        ("unix_s,x_m,y_m,height_m\n1,2,3\n", "line 2: '1,2,3': must be 4 numbers"),
        ("unix_s,x_m,y_m,height_m\n1,2,3,4\n\n1,2,3,up\n", "line 4: '1,2,3,up': must be 4 numbers"),
        ("unix_s,x_m,y_m,height_m\n1,2,nan,4\n", "has numbers that are not finite"),
    ],
)
def test_a_table_that_is_none_is_named(day: Path, text: str, why: str) -> None:
    path = day / "r0" / "truth.csv"
    path.parent.mkdir()
    path.write_text(text)
    with pytest.raises(ValueError, match=r"truth\.csv") as error:
        read_places(path)
    assert why in str(error.value)
    (note,) = examined(day).notes
    assert why in note and note.endswith("skipped")


def write_simulated_log(folder: Path, robot: int, ahead_s: float) -> None:
    """Write a log of a PX4 in software, with a clock 10 % slow and no time of day."""
    path = folder / "log" / "2026-11-29" / "19_50_11.ulg"
    path.parent.mkdir(parents=True)
    fields = (
        "vehicle_global_position_groundtruth:uint64_t timestamp;double lat;double lon;float alt;"
    )
    data = HEADER + message("B", bytes(40)) + message("F", fields.encode())
    data += message("A", struct.pack("<BH", 0, 0) + b"vehicle_global_position_groundtruth")
    clock = []
    for at_s in [float(TIMES_S[0]) - 5.0, *TIMES_S.tolist()]:
        x_m, y_m, height_m = truly_m(robot, at_s)
        height_m = 0.0 if at_s < TIMES_S[0] else height_m
        px4_s = 0.9 * at_s + ahead_s
        clock.append(f"{BEGAN_S + at_s!r},{px4_s!r}\n")
        packed = struct.pack("<2df", *ORIGIN.frame().to_global_deg(x_m, y_m), 10.0 + height_m)
        data += message("D", struct.pack("<HQ", 0, round(px4_s * 1e6)) + packed)
    path.write_bytes(data)
    (folder / "clock.csv").write_text("".join(clock))


def test_logs_of_px4s_in_software_tell_where_their_vehicles_were(day: Path) -> None:
    for robot in range(3):
        write_simulated_log(day / "px4" / str(robot), robot, 200.0 + robot)
    found = examined(day)
    (values,) = found.summary()["trials"]
    assert found.notes == ()
    cost = values["truth"]["cost"]
    assert cost["initial"] == pytest.approx(true_cost(FIRST.begin_s), rel=3e-3)
    assert cost["final"] == pytest.approx(true_cost(FIRST.begin_s + FIRST.duration_s), rel=3e-3)
