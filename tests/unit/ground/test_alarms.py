"""What an operator is told at once, and that nothing else is."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.fence import Fence
from edge.messages.codes import CheckCode, FailedCheck, ReasonCode
from edge.messages.mission import FlightState, GroundState, LoopStatus, Origin
from lpac.analysis.snapshot import FleetSnapshot
from lpac.ground.alarms import SEVERITIES, Alarm, AlarmCode, Severity, SnapshotHistory, alarms
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

_S, _C = FlightState, AlarmCode
SETUP = setup(3)


def told(seen: FleetSnapshot, before: FleetSnapshot | None = None) -> tuple[Alarm, ...]:
    return alarms(SETUP, seen, before)


def fleet(
    *, said: dict[str, Any] | None = None, known: dict[str, Any] | None = None
) -> FleetSnapshot:
    """Three robots that fly well; r1 is different."""
    r1 = robot(status(1, **(said or {})), **(known or {}))
    return snapshot(robot(status(0)), r1, robot(status(2)))


def test_nothing_of_a_fleet_that_flies_well() -> None:
    assert told(fleet(), fleet()) == ()


def test_robots_before_enable_are_not_alarming() -> None:
    seen = snapshot(*(robot(on_ground(i)) for i in range(3)), commander="", ground=None)
    assert told(seen, seen) == (
        Alarm("note", "", _C.NOBODY_COMMANDS, "nobody commands the fleet yet"),
    )


def test_robots_after_enable_say_why_they_are_not_ready() -> None:
    robots = [robot(on_ground(i, state=_S.PREFLIGHT)) for i in range(3)]
    assert told(snapshot(*robots)) == tuple(
        Alarm("note", f"r{i}", _C.NOT_READY, "not ready: GPS sees 3 satellites") for i in range(3)
    )


OTHER_FENCE = replace(FENCE, ceiling_m=30.0)


@pytest.mark.parametrize(
    ("said", "severity", "code", "text"),
    [
        (
            {"alarms": reasons("position lost", "ground lost")},
            "critical",
            _C.OWN,
            "position lost; ground lost",
        ),
        (
            {"state": _S.PILOT, "alarms": reasons("a pilot flies it")},
            "warning",
            _C.OWN,
            "a pilot flies it",
        ),
        ({"battery": 0.15}, "critical", _C.BATTERY, "battery critical: 15%"),
        ({"battery": 0.3}, "warning", _C.BATTERY, "battery low: 30%"),
        # In the air in whatever state, or with motors that turn; or neither.
        ({"state": _S.FAULT, "battery": 0.15}, "critical", _C.BATTERY, "battery critical: 15%"),
        (
            {"state": _S.PILOT, "in_air": None, "battery": 0.3},
            "warning",
            _C.BATTERY,
            "battery low: 30%",
        ),
        (
            {"state": _S.PILOT, "in_air": False, "armed": False, "battery": 0.15},
            "note",
            _C.BATTERY,
            "battery low: 15%",
        ),
        (
            {"battery": 0.2, "alarms": (reason("battery low: 20%", ReasonCode.BATTERY_LOW),)},
            "critical",
            _C.OWN,
            "battery low: 20%",
        ),
        (
            {"bundle_id": "0123456789"},
            "warning",
            _C.OTHER_BUNDLE,
            "bundle 01234567, not the fleet's 79929121",
        ),
        ({"world_id": ""}, "warning", _C.OTHER_WORLD, "world none, not the fleet's c64e4b1b"),
        (
            {"origin": Origin(47.0, 8.0, 0.0)},
            "warning",
            _C.OTHER_ORIGIN,
            "its origin is not the fleet's",
        ),
        ({"fence": OTHER_FENCE}, "warning", _C.OTHER_FENCE, "its fence is not the fleet's"),
        (
            {"not_taken": (FailedCheck(CheckCode.KEEPS_FENCE, "fence: not in flight"),)},
            "warning",
            _C.NOT_TAKEN,
            "fence: not in flight",
        ),
        # Of one difference there is one alarm.
        (
            {
                "origin": Origin(47.0, 8.0, 0.0),
                "not_taken": (
                    FailedCheck(CheckCode.KEEPS_ORIGIN, "in flight: keeps its mission origin"),
                ),
            },
            "warning",
            _C.NOT_TAKEN,
            "in flight: keeps its mission origin",
        ),
        (
            {
                "world_id": "",
                "not_taken": (
                    FailedCheck(
                        CheckCode.WORLD_NOT_ARRIVED,
                        "world c64e4b1b of the ground has not arrived: wait",
                    ),
                ),
            },
            "warning",
            _C.NOT_TAKEN,
            "world c64e4b1b of the ground has not arrived: wait",
        ),
        (
            {
                "alarms": reasons("a pilot flies it (position)"),
                "state": _S.PILOT,
                "remote_control": True,
            },
            "warning",
            _C.OWN,
            "a pilot flies it (position)",
        ),
        (
            {"alarms": reasons("remote control lost"), "state": _S.PILOT, "remote_control": False},
            "critical",
            _C.OWN,
            "remote control lost",
        ),
        ({"satellites": 7}, "warning", _C.GPS, "GPS sees 7 satellites"),
        ({"hdop": 2.5}, "warning", _C.GPS, "GPS precision (HDOP) is 2.5"),
        ({"feature_age_s": 1.4}, "warning", _C.FEATURES, "features are 1.4 s old"),
        ({"feature_age_s": 1.4, "state": _S.HOLD}, "note", _C.FEATURES, "features are 1.4 s old"),
        ({"feature_age_s": None}, "warning", _C.FEATURES, "has no features for its policy"),
        ({"neighbour_ages_s": {"0": 0.1}}, "warning", _C.NEIGHBOURS, "receives badly from r2"),
        (
            {"loops": {"control": replace(LOOP, lateness_p99_ms=80.0)}},
            "warning",
            _C.LOOPS,
            "its control loop is late by 80 ms",
        ),
    ],
)
def test_what_a_robot_says_of_itself(
    said: dict[str, Any], severity: Severity, code: AlarmCode, text: str
) -> None:
    assert told(fleet(said=said)) == (Alarm(severity, "r1", code, text),)


@pytest.mark.parametrize(
    ("known", "severity", "code", "text"),
    [
        (
            {"duplicate": True},
            "critical",
            _C.DUPLICATE_ID,
            "two programs have this robot's id: end one, or revoke its key",
        ),
        ({"clock_offset_s": -3.2}, "warning", _C.CLOCK, "its clock is 3 s behind"),
        ({"rates_hz": {"0": 0.5, "2": 2.5}}, "warning", _C.NEIGHBOURS, "receives badly from r0"),
    ],
)
def test_what_the_ground_knows_of_a_robot(
    known: dict[str, Any], severity: Severity, code: AlarmCode, text: str
) -> None:
    assert told(fleet(known=known)) == (Alarm(severity, "r1", code, text),)


IN_TIME, LATE = (25, 0, 24), (25, 0, 10, 0, 0, 0, 0, 0, 15)
LOST = (25, 0, 12)


@pytest.mark.parametrize("arrivals", [LATE, LOST])
def test_messages_that_come_late_are_as_bad_as_lost_ones(arrivals: tuple[int, ...]) -> None:
    known = {"arrivals": {"0": IN_TIME, "2": arrivals}}
    assert told(fleet(known=known)) == (
        Alarm("warning", "r1", _C.NEIGHBOURS, "receives badly from r2"),
    )
    # Three of four: a policy flies with that.
    assert told(fleet(known={"arrivals": {"2": (4, 0, 3)}})) == ()
    assert told(fleet(known={"arrivals": {"2": (2, 0, 0)}})) == (), "too few to tell"
    assert told(fleet(known={"rates_hz": {}})) == (), "no rates are known yet"


def beside_each_other(*numbers: int, badly: Callable[[int, int], bool]) -> FleetSnapshot:
    """Robots that all are in range; `badly` tells of a sender and a receiver."""
    return snapshot(*(
        robot(
            status(i, position_m=(0.5 * i, 12.0, 4.0),
                   neighbour_ages_s={str(j): 0.1 for j in numbers}),
            rates_hz={str(j): 2.5 for j in numbers},
            arrivals={str(j): LOST if badly(j, i) else IN_TIME for j in numbers if j != i},
        )
        for i in numbers
    ))  # fmt: skip


@pytest.mark.parametrize(
    ("badly", "text"),
    [
        (lambda sender, receiver: receiver == 2, "receives no robot in range well"),
        (lambda sender, receiver: sender == 2, "no robot in range receives it well"),
        (
            lambda sender, receiver: 2 in (sender, receiver),
            "receives no robot in range well; no robot in range receives it well",
        ),
    ],
)
def test_what_one_robot_is_to_blame_for_it_alone_is_told(
    badly: Callable[[int, int], bool], text: str
) -> None:
    seen = beside_each_other(0, 1, 2, 3, 4, badly=badly)
    assert alarms(setup(5), seen) == (Alarm("warning", "r2", _C.NEIGHBOURS, text),)


def test_where_nobody_hears_anybody_each_robot_is_told_once() -> None:
    seen = beside_each_other(0, 1, 2, 3, badly=lambda *_: True)
    assert [(a.robot, a.text) for a in alarms(setup(4), seen)] == [
        (f"r{i}", "receives no robot in range well") for i in range(4)
    ]


def test_a_robot_that_falls_silent_says_nothing_else() -> None:
    said = {"battery": 0.1, "alarms": reasons("position lost")}
    text = "no longer heard, last in the air in mission"
    silent = Alarm("critical", "r1", _C.SILENT, text)
    assert told(fleet(said=said, known={"age_s": 2.5})) == (silent,)
    # Who speaks in its name is heard by the envelopes.
    found = told(fleet(said=said, known={"age_s": 2.5, "duplicate": True}))
    assert found[0] == silent and [alarm.code for alarm in found[1:]] == [_C.DUPLICATE_ID]


def test_a_silent_robot_on_the_ground_is_less_grave() -> None:
    robots = robot(status(0)), robot(on_ground(1), age_s=60.0), robot(status(2))
    assert told(snapshot(*robots)) == (
        Alarm("warning", "r1", _C.SILENT, "no longer heard, last in idle"),
    )


def test_robots_that_were_never_heard_are_one_alarm() -> None:
    silent = [replace(robot(status(i)), status=None, age_s=None) for i in (1, 2)]
    seen = snapshot(robot(on_ground(0, failed_checks=())), *silent)
    assert told(seen) == (Alarm("note", "", _C.NOT_HEARD_YET, "not heard yet: r1 r2"),)
    # A spare may be switched off.
    (alarm,) = alarms(replace(SETUP, slots=SETUP.slots[:2]), seen)
    assert alarm.text == "not heard yet: r1"
    assert told(snapshot(*silent)) == (
        Alarm("note", "", _C.NOT_HEARD_YET, "no robot is heard yet"),
    )


def test_robots_out_of_range_need_not_be_heard() -> None:
    far = robot(status(1, position_m=(30.0, 30.0, 4.0), neighbour_ages_s={}))
    assert told(snapshot(robot(status(0)), far, robot(status(2)))) == ()


def test_a_new_state_may_take_a_moment_to_be_obeyed() -> None:
    hold = GroundState(5, "alice", ORIGIN, enabled=True, safety_action="hold", trial="t1")
    now = replace(fleet(), ground=hold)
    assert told(now, fleet()) == ()
    assert {a.text for a in told(now, now)} == {"does not obey the ground's state"}
    assert {a.severity for a in told(now, now)} == {"critical"}
    late = replace(fleet(known={"age_s": 1.5}), ground=hold)
    assert {a.robot for a in told(late, late)} == {"r0", "r2"}
    history = SnapshotHistory()
    assert [history.add(fleet(), 0.0), history.add(now, 1.9)] == [None, None]
    assert [history.add(late, 3.8), history.add(now, 4.5)] == [fleet(), now]


def test_a_robot_obeys_another_operator() -> None:
    seen = fleet(said={"operator": "bob"})
    assert told(seen, seen) == (Alarm("critical", "r1", _C.NOT_OBEYED, "obeys bob, not alice"),)


def test_a_robot_obeys_what_nobody_is_known_to_have_said() -> None:
    seen = fleet(said={"obeyed_sequence": 2**48})
    assert told(seen, fleet()) == ()
    (alarm,) = told(seen, seen)
    assert alarm[:3] == ("critical", "r1", _C.NOT_OBEYED)
    assert alarm.text == "obeys sequence 281474976710656, but the ground is at 4"


def test_loops_that_miss_ticks_or_fail() -> None:
    def with_loop(loop: LoopStatus) -> FleetSnapshot:
        return fleet(said={"loops": {"control": loop}})

    missed, failed = replace(LOOP, overruns=3), replace(LOOP, overruns=3, failures=1)
    assert [a.text for a in told(with_loop(missed), fleet())] == ["its control loop misses ticks"]
    assert [a.text for a in told(with_loop(failed), with_loop(missed))] == [
        "its control loop fails"
    ]
    assert told(with_loop(failed), with_loop(failed)) == ()


GROUND = GroundState(4, "alice", ORIGIN, enabled=True, safety_action="hold")


@pytest.mark.parametrize(
    ("changes", "seen", "expected"),
    [
        (
            {},
            {"commander": "", "ground": None},
            (
                "critical",
                _C.NOBODY_COMMANDS,
                "nobody commands the fleet while 3 robots fly: hold or land",
            ),
        ),
        (
            {},
            {"commander": "bob", "commander_age_s": 2.5},
            ("critical", _C.COMMANDER_SILENT, "the commander bob is not heard: hold takes command"),
        ),
        (
            {},
            {"shares_name": True},
            (
                "critical",
                _C.NAME_SHARED,
                "another ground station uses the name alice: both may command",
            ),
        ),
        (
            {"insecure": True},
            {},
            ("warning", _C.INSECURE, "insecure: anyone on the network can fly this fleet"),
        ),
        (
            {"world": ""},
            {},
            (
                "warning",
                _C.WORLD_NOT_HERE,
                "this station lacks the robots' world c64e4b1b: no density, no cost; "
                "`lpac mission world FILE`",
            ),
        ),
        (
            {},
            {"ground": replace(GROUND, safety_action_by="bob")},
            ("warning", _C.HELD_BY_OTHERS, "bob commands 3 robots to hold"),
        ),
        ({}, {"ground": replace(GROUND, safety_action_by="alice")}, None),
    ],
)
def test_what_the_whole_fleet_has(
    changes: dict[str, Any],
    seen: dict[str, Any],
    expected: tuple[Severity, AlarmCode, str] | None,
) -> None:
    found = alarms(replace(SETUP, **changes), replace(fleet(), **seen))
    assert found == (() if expected is None else (Alarm(expected[0], "", *expected[1:]),))


def test_a_fleet_whose_files_say_when_a_battery_is_critical() -> None:
    seen = fleet(said={"battery": 0.22})
    (alarm,) = alarms(replace(SETUP, battery_critical=0.25), seen)
    assert alarm == ("critical", "r1", _C.BATTERY, "battery critical: 22%")


def test_robots_have_another_world_than_the_ground_told() -> None:
    seen = replace(fleet(), ground=replace(GROUND, safety_action="none", world_id="0123456789"))
    assert {alarm.text for alarm in told(seen)} == {"world c64e4b1b, not the fleet's 01234567"}


numbers = st.none() | st.floats(0.0, 3.0)
statuses = st.builds(
    status,
    robot_id=st.just(0),
    state=st.sampled_from(_S),
    in_air=st.none() | st.booleans(),
    battery=numbers,
    hdop=numbers,
    feature_age_s=numbers,
    satellites=st.none() | st.integers(0, 20),
    origin=st.sampled_from([None, ORIGIN, Origin(1.0, 2.0, 3.0)]),
    fence=st.sampled_from([None, FENCE, Fence(FENCE.vertices_m, 1.0, 0.0, 9.0)]),
    alarms=st.sampled_from([(), reasons("ground lost")]),
    not_taken=st.sampled_from([(), checks("fence: not in flight")]),
    obeyed_sequence=st.integers(0, 6),
)


@given(st.lists(statuses, min_size=3, max_size=3), st.lists(numbers, min_size=3, max_size=3))
def test_the_gravest_comes_first_and_each_once(said: list[Any], ages_s: list[Any]) -> None:
    robots = [
        robot(replace(s, robot_id=i), age_s=age_s)
        for i, (s, age_s) in enumerate(zip(said, ages_s, strict=True))
    ]
    found = told(snapshot(*robots), fleet())
    order = [SEVERITIES.index(alarm.severity) for alarm in found]
    assert order == sorted(order)
    assert len(found) == len(set(found))
    assert all(alarm.text and len(alarm.text.splitlines()) == 1 for alarm in found)
    silent = {f"r{i}" for i, age_s in enumerate(ages_s) if age_s is None or age_s > 2.0}
    for name in silent:
        assert len([alarm for alarm in found if alarm.robot == name]) == 1
