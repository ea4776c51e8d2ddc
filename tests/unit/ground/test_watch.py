"""The lines of `lpac watch`."""

import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.cells import cell_len

from edge.messages.codes import Refusal, RefusalCode, texts
from edge.messages.mission import FlightState, GroundState, OrderResult
from lpac.analysis.snapshot import RobotSnapshot
from lpac.ground.alarms import Alarm, AlarmCode, alarms
from lpac.ground.rendering import MARKS, Row, age, in_order, number
from lpac.ground.station.protocol import (
    CommandReport,
    Problem,
    ProblemCode,
    ResultCode,
    RobotResult,
)
from lpac.ground.terminal.lines import Line, fit, plain, some
from lpac.ground.terminal.robots import columns, detail, heading, summary_lines, table_row
from lpac.ground.terminal.text import KEYS, connection_lost, few_alarms, full_view, header, outcome
from tests.said import checks, reason, reasons
from tests.unit.ground.snapshots import (
    FENCE,
    LOOP,
    ORIGIN,
    on_ground,
    robot,
    setup,
    snapshot,
    status,
)

_S = FlightState


def width_of(line: Line) -> int:
    return sum(cell_len(span.text) for span in line)


odd_numbers = st.none() | st.floats() | st.sampled_from([-12.3, 100.0, -0.04, 1e9, -123.45])


odd_statuses = st.builds(
    status,
    robot_id=st.just(1),
    state=st.sampled_from(_S),
    ready=st.booleans(),
    reason=st.builds(reason, st.text()),
    mode=st.none() | st.text(max_size=12),
    battery=odd_numbers,
    satellites=st.none() | st.integers(-1, 100000),
    position_m=st.none() | st.tuples(*[st.floats()] * 3),
    velocity_m_s=st.none() | st.tuples(*[st.floats()] * 3),
    feature_age_s=odd_numbers,
    neighbour_ages_s=st.dictionaries(st.sampled_from(["0", "2", "77"]), st.floats()),
    bundle_id=st.text(max_size=20),
)


@settings(max_examples=60)
@given(
    st.none() | odd_statuses,
    odd_numbers,
    st.text(min_size=1, max_size=20),
    st.integers(20, 200),
)
def test_no_value_moves_a_column(said: Any, age_s: Any, name: str, width: int) -> None:
    fleet = replace(setup(3), robots={name: 1, "r0": 0})
    shown = columns(fleet, width)
    row = Row(
        RobotSnapshot(name, 1, said, age_s, rates_hz={"0": math.nan}),
        Alarm("warning", name, AlarmCode.OWN, "x"),
        fleet,
    )
    ordinary = Row(robot(status(0)), None, fleet)
    cells = [column.width + 1 for column in shown]
    for line in (*heading(shown), table_row(shown, row), table_row(shown, ordinary)):
        assert width_of(line) == sum(cells) - 1 <= width
    for line in (table_row(shown, row), table_row(shown, ordinary)):
        assert [cell_len(span.text) for span in line[::2]] == [cell - 1 for cell in cells]
        assert all(span.text == " " for span in line[1::2])
    for line in (*detail(row, snapshot(row.robot), (), max(width, 40)), *summary_lines(row, width)):
        assert width_of(line) in (width, max(width, 40))


def test_what_is_seen_at_80_columns() -> None:
    tops = "".join(span.text for span in heading(columns(setup(30), 79))[0])
    assert " ".join(tops.split()) == "name state bat GPS mode h link reason"
    narrow = "".join(span.text for span in heading(columns(setup(30), 59))[0])
    assert " ".join(narrow.split()) == "name state bat link reason"
    wider = "".join(span.text for span in heading(columns(setup(30), 99))[0])
    assert " ".join(wider.split()) == "name state bat GPS mode x y h feat neigh link reason"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (number(-12.3, 5), "-12.3"), (number(-123.4, 5), " -123"), (number(None, 5), "    -"),
        (number(-0.04, 5), "  0.0"), (number(1e9, 5), ">9999"), (number(-1e9, 5), "<-999"),
        (number(math.nan, 3), "  -"),
        (number(100.0, 3, 0), "100"), (age(0.04), "0.0"), (age(9.96), " 10"), (age(999.0), "999"),
        (age(1200.0), "20m"), (age(4200.0), "70m"), (age(1e5), "28h"), (age(None), "  -"),
        (fit("hold", 3), "ho…"),
        (fit("世界", 3), "世…"), (fit("a\nb", 3), "a b"), (some(["r1", "r2", "r3"], 8), "r1 r2 r3"),
        (some(["r1", "r2", "r3"], 7), "r1 +2"),
    ],
)  # fmt: skip
def test_words_for_numbers(text: str, expected: str) -> None:
    assert text == expected


def test_header_says_who_commands_and_who_asked() -> None:
    ground = GroundState(
        5, "bob", ORIGIN, enabled=True, safety_action="hold", safety_action_by="carol", trial="t2"
    )
    seen = snapshot(
        robot(status(0)), commander="bob", ground=ground, running=("takeoff",), mission_s=125.0
    )
    lines = ["".join(span.text for span in line) for line in header(setup(1), seen, 90)]
    assert [s.style for s in header(setup(1), seen, 90)[0]][2] == "foreign"
    assert lines[0].split("  ")[:3] == ["field", "bob commands, alice observes", "trial t2"]
    assert lines[0].rstrip().endswith("mission 02:05")
    assert plain([KEYS]) == (
        " h HOLD   l land   r resume   Enter robot   a alarms   ? help   q quit"
    )
    assert plain(connection_lost(setup(1), "it has ended", 65.0, 80)).splitlines()[:3] == [
        " NO GROUND STATION for 01:05",
        " It has ended.",
        " Robots without a ground: hold after 3 s, land where they are after 13 s.",
    ]
    assert lines[1].startswith("ENABLED  HOLD by carol  now: takeoff  fence 36x36 m, 2-100 m high")
    assert "origin 47.39774 8.54559 30°  bundle 79929121  world c64e4b1b" in lines[2]


def test_a_heading_is_below_360_degrees_however_it_is_rounded() -> None:
    origin = replace(ORIGIN, heading_deg=359.96)
    ground = GroundState(5, "alice", origin, enabled=True)
    lines = header(setup(1), snapshot(robot(status(0)), ground=ground), 90)
    assert " 0°  bundle" in "".join(span.text for span in lines[2])
    row = Row(robot(status(0, origin=origin, heading_rad=math.radians(-0.1))), None, setup(1))
    known = "\n".join("".join(s.text for s in line) for line in detail(row, snapshot(), (), 90))
    assert "heading 0°" in known and " 0.0°" in known and "360" not in known


def test_safety_action_of_single_robots() -> None:
    ground = GroundState(5, "alice", enabled=True, robot_safety_actions={"1": "land", "0": "hold"})
    lines = header(setup(2), snapshot(ground=ground), 80)
    assert "HOLD r0, LAND r1 by alice" in "".join(span.text for span in lines[1])
    fence = replace(FENCE, vertices_m=((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)))
    ground = GroundState(
        5, "alice", enabled=False, safety_action="hold", robot_enabled={"1": True}, fence=fence,
        robot_safety_actions={"0": "none", "1": "hold"}, world_id="0123456789",
    )  # fmt: skip
    lines = header(setup(2), snapshot(ground=ground), 80)
    assert plain(lines[1:]) == (
        "not enabled but 1  HOLD, FLY r0 by alice  fence 4x4 m, 2-100 m high\n"
        "no origin  bundle 79929121  world 01234567"
    )


def test_alarms_of_many_robots_with_one_text_are_one_line() -> None:
    told = [Alarm("critical", f"r{i}", AlarmCode.OWN, "ground lost") for i in range(30)]
    told += [Alarm("note", f"r{i}", AlarmCode.BATTERY, f"battery low: {i}%") for i in range(9)]
    lines = ["".join(s.text for s in line).rstrip() for line in few_alarms(told, 60, 4)]
    assert lines == [
        "! r0 r1 r2 +27   ground lost",
        "- r0             battery low: 0%",
        "- r1             battery low: 1%",
        "  7 more: a shows all",
    ]


def test_outcome_says_first_who_did_not() -> None:
    report = CommandReport(
        (
            RobotResult("r1", ResultCode.DONE, "holds"),
            RobotResult("r2", ResultCode.REFUSED, "does not answer"),
        )
    )
    assert outcome("hold", report) == ("hold: NOT r2: does not answer; r1: holds", "critical")
    everybody = CommandReport(
        tuple(RobotResult(f"r{i}", ResultCode.DONE, "holds") for i in range(30))
    )
    assert outcome("hold", everybody) == ("hold: all 30: holds", "good")
    nothing = CommandReport(problem=Problem(ProblemCode.OTHER_COMMANDS, "bob commands"))
    assert outcome("land", nothing).text == "land NOT DONE: bob commands"


def test_robots_with_alarms_are_on_top_and_stay_there_for_a_while() -> None:
    seen = snapshot(*(robot(status(i)) for i in range(4)))
    told = [
        Alarm("critical", "r3", AlarmCode.OWN, "x"),
        Alarm("warning", "r2", AlarmCode.OWN, "x"),
        Alarm("note", "r1", AlarmCode.OWN, "x"),
    ]
    rows = in_order(setup(4), seen, told)
    assert [row.robot.name for row in rows] == ["r3", "r2", "r0", "r1"]
    rows = in_order(setup(4), seen, told[1:], {"r3": "critical"})
    assert [(row.robot.name, row.alarm) for row in rows[:2]] == [("r3", None), ("r2", told[1])]


def test_what_is_printed_once() -> None:
    seen = snapshot(robot(status(0)), robot(status(1, alarms=reasons("position lost"))))
    text = full_view(setup(2), seen, alarms(setup(2), seen), 79)
    assert text.splitlines()[3] == "! r1             position lost"
    row = "! r1   mission    90  14 offboard  4.0  0.1 position lost"
    assert text.splitlines()[-2].startswith(row)


def test_80_columns_show_all_that_is_critical() -> None:
    """Why a robot has its mark is in its row, before why it is in its state; no alarm is cut."""
    own = reasons("position lost: no horizontal accuracy is estimated", "only 1.2 m to robot 2")
    seen = snapshot(
        robot(status(0)),
        robot(status(1, alarms=own)),
        robot(status(2), age_s=9.0),
        robot(on_ground(3, state=_S.PREFLIGHT, failed_checks=checks("mission origin is not set"))),
    )
    told = alarms(setup(4), seen)
    text = full_view(setup(4), seen, told, 79).splitlines()
    rows = {line[2:4]: line for line in text[-4:]}
    assert "position lost: no horizontal accur…" in rows["r1"]
    assert "no longer heard, last in the air i…" in rows["r2"]
    assert rows["r3"].endswith(" mission origin is not set")
    assert rows["r0"].endswith(" mission started")
    views = (
        full_view(setup(4), seen, told, 79),
        plain(detail(Row(seen.robots[1], told[0], setup(4)), seen, told, 79)),
    )
    for view in views:
        assert texts(own) in " ".join(view.split())


def test_all_that_is_known_of_a_robot() -> None:
    late = replace(LOOP, overruns=2, failures=1, lateness_p99_ms=80.0, lateness_max_ms=90.0)
    said = status(
        1, operator="bob", obeyed_sequence=3, not_taken=checks("fence: not in flight"),
        orders=(OrderResult("1"), OrderResult("2", Refusal(RefusalCode.EXPIRED, "expired"))),
        fence=replace(FENCE, vertices_m=((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0))),
        battery_lasts_s=300.0, home_s=40.0, position_m=(5.0, 2.0, 4.5), gps_accuracy_m=0.4,
        velocity_m_s=(3.0, 4.0, 0.0), policy_velocity_m_s=(0.5, -0.25), global_deg=(47.1, 8.2),
        loops={"control": late, "radio": LOOP}, neighbour_ages_s={"0": 0.2},
        message_counts={"accepted": 70, "replayed": 3, "expired": 0},
        failed_checks=checks("GPS sees 3 satellites"),
    )  # fmt: skip
    ground = GroundState(4, "alice", ORIGIN, enabled=True, robot_safety_actions={"1": "land"})
    seen = snapshot(robot(said, age_s=9.0, clock_offset_s=-0.25), ground=ground)
    told = [Alarm("critical", "r1", AlarmCode.OWN, "position lost")]
    row = Row(seen.robots[0], told[0], setup(3))
    lines = detail(row, seen, [*told, Alarm("note", "r0", AlarmCode.OWN, "of another")], 100)
    assert (
        plain(lines)
        == """\
r1 (id 1)  mission: mission started                                                  heard 9.0 s ago
alarm      position lost
not taken  fence: not in flight
vehicle    offboard, armed, in the air, battery 90%, for 300 s of which home takes 40, system id 1
GPS        14 satellites, HDOP 0.8, accurate to 0.4 m, at 47.100000 8.200000
position   x 5.0, y 2.0, height 4.5 of 4 m, 5.0 m/s, heading 0°
landing    at x 2.0 m, y 2.0 m, 3.0 m away; fence margin -1.0 m
policy     asks for 0.50 -0.25 m/s, features 0.1 s old, trial t1
obeys      bob, state 3 of 4, asked to land
orders     refused: expired; accepted
release    bundle 79929121, world c64e4b1b, fence 4x4 m, 2-100 m high
origin     47.3977420 8.5455940 30.0°
program    up 00:30, start 7, clock -0.25 s

neighbour messages   Hz   s   loop         ticks missed failed  p50  p99  max
r0              50  2.5 0.2   control        100      2      1  0.2 80.0 90.0
r1              50  2.5   -   radio          100      0      0  0.2  1.1  3.0
r2              50  2.5   -
replayed         3"""
    )
    assert plain(summary_lines(row, 100)) == (
        " r1  mission started\n fence margin -1.0 m   bundle 79929121   world c64e4b1b   trial t1"
    )
    styled = [s for shown in (*lines, *summary_lines(row, 100)) for s in shown if s.style in MARKS]
    assert [(span.text.strip()[:15], span.style) for span in styled] == [
        ("heard 9.0 s ago", "critical"),
        ("position lost", "critical"),
        ("fence: not in f", "warning"),
        ("control        ", "warning"),
        ("-1.0 m", "critical"),
    ]
    grounded = Row(robot(on_ground(1)), None, setup(3))
    assert "not ready  GPS sees 3 satellites" in plain(detail(grounded, seen, (), 100))


def test_cells_say_what_is_wrong() -> None:
    """Compare each cell's text and style in a row of all columns."""
    fence = replace(FENCE, vertices_m=((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)))
    said = status(
        1, battery=0.22, satellites=7, position_m=(5.0, 2.0, 4.5), velocity_m_s=(3.0, 4.0, 0.0),
        feature_age_s=1.4, neighbour_ages_s={"0": 0.2, "2": 0.7}, fence=fence,
        loops={"control": replace(LOOP, lateness_p99_ms=80.0)},
    )  # fmt: skip
    fleet = replace(setup(3), battery_critical=0.2)
    heard = robot(said, rates_hz={"0": 2.0, "1": 9.0, "2": 3.0})
    alarm = Alarm("warning", "r1", AlarmCode.OWN, "battery low")

    def cells(row: Row) -> list[tuple[str, str]]:
        shown = columns(fleet, 200)
        return [(span.text.strip(), span.style) for span in table_row(shown, row)[::2]]

    expected = [
        ("*", "warning"), ("r1", "warning"), ("mission", "good"), ("22", "warning"),
        ("7", "warning"), ("offboard", ""), ("5.0", ""), ("2.0", ""), ("4.5", ""), ("5.0", ""),
        ("1.4", "warning"), ("2", ""), ("2.5", ""), ("0.7", ""), ("80", "warning"), ("0.1", ""),
        ("-1.0", "critical"), ("79929121", ""), ("c64e4b1b", ""), ("battery low", "warning"),
    ]  # fmt: skip
    assert cells(Row(heard, alarm, fleet)) == expected
    empty = replace(heard, status=replace(said, battery=0.2, ready=True), age_s=9.0)
    loud = {0: "warning", 1: "warning", 15: "critical", 19: "warning"}
    assert [style for _, style in cells(Row(empty, alarm, fleet))] == [
        loud.get(i, "faint") for i in range(len(expected))
    ]
    fresh = cells(Row(replace(empty, age_s=0.1), alarm, fleet))
    assert fresh[2:4] == [("mission", "good"), ("20", "critical")]
