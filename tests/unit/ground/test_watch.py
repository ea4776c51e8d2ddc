"""The lines of `lpac watch`."""

import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.cells import cell_len

from edge.messages.codes import texts
from edge.messages.mission import FlightState, GroundState
from lpac.analysis.snapshot import RobotSnapshot
from lpac.ground.alarms import Alarm, AlarmCode, alarms
from lpac.ground.station.protocol import (
    CommandReport,
    Problem,
    ProblemCode,
    ResultCode,
    RobotResult,
)
from lpac.ground.terminal.lines import Line, age, fit, number, plain, some
from lpac.ground.terminal.robot import detail, in_short
from lpac.ground.terminal.table import Row, columns, heading, in_order, table_row
from lpac.ground.terminal.text import all_of_it, few_alarms, header, outcome
from tests.said import checks, reason, reasons
from tests.unit.ground.snapshots import ORIGIN, on_ground, robot, setup, snapshot, status

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
    for line in (*detail(row, snapshot(row.robot), (), max(width, 40)), *in_short(row, width)):
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
        (age(1200.0), "20m"), (age(1e5), "28h"), (age(None), "  -"), (fit("hold", 3), "ho…"),
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
    seen = snapshot(robot(status(0)), commander="bob", ground=ground, running=("takeoff",))
    lines = ["".join(span.text for span in line) for line in header(setup(1), seen, 125.0, 90)]
    assert lines[0].split("  ")[:3] == ["field", "bob commands, alice observes", "trial t2"]
    assert lines[0].rstrip().endswith("mission 02:05")
    assert lines[1].startswith("ENABLED  HOLD by carol  now: takeoff  fence 36x36 m, 2-100 m high")
    assert "origin 47.39774 8.54559 30°  bundle 79929121  world c64e4b1b" in lines[2]


def test_a_heading_is_below_360_degrees_however_it_is_rounded() -> None:
    origin = replace(ORIGIN, heading_deg=359.96)
    ground = GroundState(5, "alice", origin, enabled=True)
    lines = header(setup(1), snapshot(robot(status(0)), ground=ground), None, 90)
    assert " 0°  bundle" in "".join(span.text for span in lines[2])
    row = Row(robot(status(0, origin=origin, heading_rad=math.radians(-0.1))), None, setup(1))
    known = "\n".join("".join(s.text for s in line) for line in detail(row, snapshot(), (), 90))
    assert "heading 0°" in known and " 0.0°" in known and "360" not in known


def test_safety_action_of_single_robots() -> None:
    ground = GroundState(5, "alice", enabled=True, robot_safety_actions={"1": "land", "0": "hold"})
    lines = header(setup(2), snapshot(ground=ground), None, 80)
    assert "HOLD r0, LAND r1 by alice" in "".join(span.text for span in lines[1])


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
    text = all_of_it(setup(2), seen, alarms(setup(2), seen), 79)
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
    text = all_of_it(setup(4), seen, told, 79).splitlines()
    rows = {line[2:4]: line for line in text[-4:]}
    assert "position lost: no horizontal accur…" in rows["r1"]
    assert "not heard any more, last in the ai…" in rows["r2"]
    assert rows["r3"].endswith(" mission origin is not set")
    assert rows["r0"].endswith(" mission started")
    views = (
        all_of_it(setup(4), seen, told, 79),
        plain(detail(Row(seen.robots[1], told[0], setup(4)), seen, told, 79)),
    )
    for view in views:
        assert texts(own) in " ".join(view.split())
