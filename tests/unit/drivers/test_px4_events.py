"""Why PX4 does not arm, and why it takes over, from its EVENTs alone."""

import struct
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.vehicle import Mode, VehicleState
from edge.drivers.px4.events import _WORDS, Px4Events, event_id, to_reason
from edge.drivers.px4.telemetry import Px4Telemetry
from tests.px4_recordings import RECORDINGS, Recorded, recorded

BEGIN_S = 100.0
ALL_MODES = 0xFFFFFFFF
HOLD = 1 << 4
ERROR, INFO, PROTOCOL = 3, 6, 8


class Heard(NamedTuple):
    """One message of PX4's, as MAVSDK gives it."""

    at_s: float
    name: str
    fields: dict[str, Any]


def _unpacked(recorded: Recorded) -> Heard:
    """EVENTs too, which pymavlink does not have."""
    time_s, message = recorded
    frame = bytes(message.get_msgbuf())
    if message.get_type() == "UNKNOWN_410":
        payload = frame[10:-2].ljust(53, b"\0")
        number, _, sequence, _, _, level = struct.unpack_from("<IIHBBB", payload)
        return Heard(time_s, *event(sequence, number, level, payload[13:])[1:])
    if message.get_type() == "UNKNOWN_411":
        (newest,) = struct.unpack_from("<H", frame[10:-2].ljust(3, b"\0"))
        return Heard(time_s, "CURRENT_EVENT_SEQUENCE", {"sequence": newest})
    return Heard(time_s, message.get_type(), message.to_dict())


@cache
def heard(name: str) -> tuple[Heard, ...]:
    """What PX4 says in a recording, without the texts, which a companion does not get."""
    known = set(Px4Telemetry().messages) - {"STATUSTEXT"}
    messages = (_unpacked(message) for message in recorded(name) if _is_px4(message))
    return tuple(message for message in messages if message.name in known)


def _is_px4(message: Recorded) -> bool:
    return bytes(message.message.get_msgbuf())[6] == 1


def state_at(name: str, at_s: float) -> VehicleState:
    """What is concluded from a recording until then."""
    telemetry = Px4Telemetry()
    for message in heard(name):
        if message.at_s <= at_s:
            telemetry.receive(message.name, message.fields, BEGIN_S + message.at_s)
    return telemetry.state(BEGIN_S + at_s)


def problems(name: str, at_s: float) -> list[str]:
    return [problem.text for problem in state_at(name, at_s).problems]


def warnings(name: str, at_s: float) -> list[str]:
    return [warning.text for warning in state_at(name, at_s).warnings]


def test_the_reason_for_not_arming_comes_without_a_ground_station() -> None:
    state = state_at("refused", 15.0)
    assert state.armable is False
    (problem,) = state.problems
    assert problem == ("check_baro_no_data", (0,), "no data from barometer 0")


def test_reasons_for_not_arming_are_told_until_they_are_gone() -> None:
    at_first = ["attitude is not known", "position is not known"]
    assert problems("refused", 2.5)[:2] == at_first
    assert problems("refused", 5.0)[:1] == ["position is not known"]
    assert problems("refused", 8.0) == []
    assert problems("refused", 30.0) == ["no data from barometer 0"]


def test_why_a_command_was_refused() -> None:
    telemetry = Px4Telemetry()
    for message in heard("refused"):
        telemetry.receive(message.name, message.fields, BEGIN_S + message.at_s)
    # ARM was refused at 58.56 s, without a ground station's heartbeat.
    reasons = telemetry.refusal_reasons(BEGIN_S + 58.5)
    assert "its checks fail" in [reason.text for reason in reasons]
    assert "no data from barometer 0" in [reason.text for reason in reasons]


@pytest.mark.parametrize(
    ("name", "at_s", "said"),
    [
        ("gps", 33.7, "failsafe: PX4 descends, and no longer keeps its position"),
        ("gps", 36.0, "position is not known"),
        ("gps", 50.0, "failsafe: PX4 descends, and no longer keeps its position"),
        ("sensors_die", 11.0, "no data from barometer 0"),
        ("sensors_die", 11.0, "compass 0 failed: land"),
        ("battery", 45.0, "battery low"),
        ("battery_fast", 36.0, "failsafe, battery critical: PX4 holds for 5 s, then lands"),
        ("battery_fast", 45.0, "failsafe, battery nearly empty: PX4 lands"),
        ("kill", 24.3, "failsafe: PX4 lands"),
    ],
)
def test_why_px4_takes_over_in_flight(name: str, at_s: float, said: str) -> None:
    assert said in warnings(name, at_s)


@pytest.mark.parametrize("name", RECORDINGS)
def test_every_reason_of_the_recordings_has_words(name: str) -> None:
    events = Px4Events()
    for message in heard(name):
        if message.name == "EVENT":
            events.receive(message.fields, message.at_s)
            told = events.warnings(0.0), events.present_faults(None), events.arming_problems(None)
            assert not [reason for reasons in told for reason in reasons if "0x" in reason.code]
    assert events.missing() is None


def test_nothing_is_wrong_in_a_normal_flight() -> None:
    for at_s in range(10, 64, 2):
        state = state_at("normal", at_s)
        assert state.warnings == (), at_s


def event(sequence: int, name: str | int, level: int = ERROR, arguments: bytes = b"") -> Heard:
    number = name if isinstance(name, int) else event_id(name)
    fields = {
        "id": number,
        "sequence": sequence % (1 << 16),
        "log_levels": 0x60 | level,
        "arguments": list(arguments.ljust(40, b"\0")),
    }
    return Heard(0.0, "EVENT", fields)


def report(sequence: int, *checks: tuple[str | int, int, bytes], can_arm: int = 0) -> list[Heard]:
    """A report of PX4's checks: each failing one's name, modes, and arguments."""
    begins = struct.pack("<BIIII", 0, 0, 0, can_arm, can_arm)
    found = [(name, struct.pack("<IB", modes, 1) + rest) for name, modes, rest in checks]
    return [
        event(sequence, "commander_arming_check_summary", PROTOCOL, begins),
        *(event(sequence + i, name, ERROR, rest) for i, (name, rest) in enumerate(found, 1)),
        event(sequence + 1 + len(found), "commander_health_summary", PROTOCOL),
    ]


BAROMETER = ("check_baro_no_data", ALL_MODES, b"\1")
COMPASS = ("check_mag_no_data", ALL_MODES, b"\2")
UNKNOWN = (0x01ABCDEF, ALL_MODES, b"")


def told(events: Px4Events, messages: Iterable[Heard], now_s: float = 0.0) -> None:
    for message in messages:
        events.receive(message.fields, now_s)


def why(events: Px4Events, mode: Mode | None = Mode.HOLD) -> list[str]:
    return [reason.text for reason in events.arming_problems(mode)]


def test_a_report_counts_as_a_whole_and_replaces_the_one_before() -> None:
    events = Px4Events()
    told(events, report(7, BAROMETER, COMPASS))
    assert why(events) == ["no data from barometer 1", "no data from compass 2"]
    second = report(11, COMPASS)
    told(events, second[:-1])
    assert why(events) == ["no data from barometer 1", "no data from compass 2"]
    told(events, second[-1:])
    assert why(events) == ["no data from compass 2"]
    told(events, report(14, can_arm=ALL_MODES))
    assert why(events) == []


def test_what_does_not_concern_the_mode_is_no_reason() -> None:
    events = Px4Events()
    told(events, report(0, ("check_modes_offboard_signal", 1 << 14, b""), can_arm=HOLD))
    assert why(events) == []
    assert len(why(events, Mode.OFFBOARD)) == 1


def test_a_reason_without_words_is_said_by_its_number() -> None:
    events = Px4Events()
    told(events, report(0, UNKNOWN))
    told(events, [event(3, 0x01FEDCBA, ERROR), event(4, 0x01000001, INFO)])
    assert why(events) == ["event 0x01abcdef, which this program does not know"]
    assert [reason.code for reason in events.warnings(0.0)] == ["0x01fedcba"]


def test_a_parameter_that_px4_lowers_in_flight_is_told_by_its_name() -> None:
    events = Px4Events()
    told(events, [event(0, 0x01D7F608, 4, struct.pack("<f", 3.0))])
    (reason,) = events.warnings(0.0)
    text = "PX4 set MPC_VEL_MANUAL to 3.0 m/s, which is MPC_XY_VEL_MAX"
    assert reason == ("mc_pos_ctrl_man_vel_set", (3.0,), text)


def test_a_report_that_began_before_is_not_taken_for_one() -> None:
    events = Px4Events()
    told(events, report(0, BAROMETER)[1:])
    assert why(events) == []


@given(st.lists(st.booleans(), min_size=60, max_size=60), st.integers(0, (1 << 16) - 1))
def test_lost_events_are_asked_for_and_come_in_order(lost: list[bool], first: int) -> None:
    sent: list[Heard] = []
    for checks in ((BAROMETER,), (BAROMETER, COMPASS), (), (UNKNOWN, COMPASS), (COMPASS,)):
        sent += report(first + len(sent), *checks)
        sent.append(event(first + len(sent), "sensor_failover_baro", 0))
    by_number = {message.fields["sequence"]: message for message in sent}
    whole, events = Px4Events(), Px4Events()
    told(whole, sent)
    events.receive(sent[0].fields, 0.0)
    for message, is_lost in zip(sent[1:], lost, strict=False):
        if not is_lost:
            events.receive(message.fields, 0.0)
    events.receive_sequence({"sequence": sent[-1].fields["sequence"]}, 0.0)
    missing = events.missing()
    if missing is not None:
        count = (missing[1] - missing[0]) % (1 << 16) + 1
        told(events, [by_number[(missing[0] + i) % (1 << 16)] for i in range(count)])
    assert events.missing() is None
    assert why(events) == why(whole)
    assert events.warnings(0.0) == whole.warnings(0.0)


def test_events_that_never_come_are_given_up() -> None:
    events = Px4Events()
    told(events, report(0, BAROMETER))
    told(events, report(30, COMPASS), now_s=1.0)
    assert events.missing() == (3, 32)
    assert why(events) == ["no data from barometer 1"]
    told(events, report(40, COMPASS)[1:], now_s=3.5)
    assert events.missing() is None
    assert why(events) == ["no data from barometer 1"]
    told(events, report(43, COMPASS), now_s=3.6)
    assert why(events) == ["no data from compass 2"]


def test_a_repeat_is_no_news_when_others_were_given_up() -> None:
    events = Px4Events()
    told(events, report(0, BAROMETER))
    told(events, report(30, COMPASS), now_s=1.0)
    told(events, [event(1, "sensor_failover_baro", 0), event(2, "sensor_failover_baro", 0)], 3.5)
    assert events.warnings(0.0) == ()
    told(events, report(33, COMPASS), now_s=3.6)
    told(events, report(36, COMPASS), now_s=3.7)
    assert why(events) == ["no data from compass 2"]


def test_a_vehicle_that_was_switched_on_anew_is_heard_again() -> None:
    events = Px4Events()
    told(events, report(40, BAROMETER))
    told(events, report(5, COMPASS))
    assert why(events) == ["no data from barometer 1"]
    events.receive_sequence({"sequence": 7}, 0.0)
    told(events, report(8, COMPASS))
    assert why(events) == ["no data from compass 2"]


@given(arguments=st.binary(min_size=40, max_size=40))
def test_every_event_is_put_in_words_whatever_its_arguments(arguments: bytes) -> None:
    for name in _WORDS:
        reason = to_reason(event_id(name), arguments)
        assert reason.code == name
        assert reason.text and "{" not in reason.text and "\n" not in reason.text


@given(
    st.lists(
        st.tuples(
            st.integers(0, (1 << 16) - 1),
            st.sampled_from([event_id(name) for name in _WORDS])
            | st.sampled_from(
                [event_id("commander_arming_check_summary"), event_id("commander_health_summary")]
            )
            | st.integers(0, (1 << 32) - 1),
            st.integers(0, 255),
            st.binary(max_size=40),
        )
    ),
    st.sampled_from([None, *Mode]),
)
def test_whatever_comes_is_survived(
    messages: Sequence[tuple[int, int, int, bytes]], mode: Mode | None
) -> None:
    events = Px4Events()
    for sequence, number, level, arguments in messages:
        fields = {
            "sequence": sequence, "id": number, "log_levels": level, "arguments": list(arguments),
        }  # fmt: skip
        events.receive(fields, 0.0)
        events.receive_sequence({"sequence": sequence ^ 1}, 0.0)
        events.missing()
        for reason in (
            *events.arming_problems(mode),
            *events.present_faults(mode),
            *events.warnings(0.0),
        ):
            assert reason.text
