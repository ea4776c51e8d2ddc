"""Requests to PX4 and their timing, by the messages that would be on the wire."""

import itertools
import math
import struct
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.vehicle import Action, VehicleState
from edge.drivers.px4.dialogue import Dialogue, Message
from edge.drivers.px4.telemetry import RATES_HZ, Px4Telemetry

TICK_S = 0.01
_INTERVAL, _REQUEST, _MODE, _ARM = 511, 512, 176, 400

# What comes back of a message: the result of its command, None if no answer does.
Answer = Callable[[Message], int | None]


def position(telemetry: Px4Telemetry, north_m: float, now_s: float) -> None:
    fields = dict.fromkeys(("x", "y", "z", "vx", "vy", "vz"), 0.0)
    fields |= {"x": north_m, "time_boot_ms": now_s * 1e3}
    telemetry.receive("LOCAL_POSITION_NED", fields, now_s)


def origin(telemetry: Px4Telemetry, now_s: float) -> None:
    fields = {"latitude": 400_000_000, "longitude": 100_000_000, "altitude": 1000}
    telemetry.receive("GPS_GLOBAL_ORIGIN", fields, now_s)


class Conversation:
    """A dialogue with a vehicle whose answers come 10 ms later."""

    def __init__(self, answer: Answer = lambda _: 0) -> None:
        self.telemetry = Px4Telemetry()
        self.dialogue = Dialogue(self.telemetry)
        self.answer = answer
        self.said: list[tuple[float, int, float]] = []
        self.now_s = 0.0
        self.vehicle: VehicleState | None = VehicleState(
            connected=True, armed=False, armable=True, heartbeat_at_s=math.inf
        )

    def go_on(self, for_s: float, each: Callable[[float], None] = lambda _: None) -> None:
        until_s = self.now_s + for_s
        while self.now_s < until_s:
            each(self.now_s)
            heard: list[tuple[int, int]] = []
            for message in self.dialogue.due_messages(self.now_s, self.vehicle):
                name, fields = message
                if name == "COMMAND_LONG":
                    self.said.append((self.now_s, fields["command"], fields["param1"]))
                    result = self.answer(message)
                    heard += [] if result is None else [(fields["command"], result)]
            self.now_s += TICK_S
            for number, result in heard:
                self.dialogue.receive_ack(number, result, self.now_s)

    def most_within(self, seconds: float) -> int:
        at_s = [time_s for time_s, _, _ in self.said]
        return max(sum(begin <= each < begin + seconds for each in at_s) for begin in at_s)


def test_whether_to_use_the_gps_is_asked_five_times_a_second_and_set_back_to_what_it_was() -> None:
    talk = Conversation()
    said: list[tuple[float, float]] = []

    def as_often_as(action: Action, for_s: float) -> None:
        until_s = talk.now_s + for_s
        while talk.now_s < until_s:
            talk.dialogue.command(action, talk.now_s)
            for name, fields in talk.dialogue.due_messages(talk.now_s, talk.vehicle):
                if name == "PARAM_SET":
                    assert (fields["param_id"], fields["param_type"]) == ("EKF2_GPS_CTRL", 6)
                    said.append((talk.now_s, fields["param_value"]))
            talk.now_s += TICK_S

    def of_bits(number: int) -> float:
        (value,) = struct.unpack("<f", struct.pack("<i", number))
        return float(value)

    def px4_says(number: int) -> None:
        fields = {"param_id": "EKF2_GPS_CTRL", "param_value": of_bits(number)}
        talk.telemetry.receive("PARAM_VALUE", fields, talk.now_s)

    px4_says(5)
    assert talk.telemetry.state(talk.now_s).ignores_gps is False
    as_often_as(Action.IGNORE_GPS, 1.0)
    assert [value for _, value in said] == [0.0] * 5
    between_s = [b - a for (a, _), (b, _) in itertools.pairwise(said)]
    assert min(between_s) > 0.19
    px4_says(0)
    assert talk.telemetry.state(talk.now_s).ignores_gps is True
    said.clear()
    as_often_as(Action.USE_GPS, 0.1)
    assert [value for _, value in said] == [of_bits(5)]


def test_every_stream_is_asked_for_one_after_another() -> None:
    talk = Conversation()
    talk.go_on(1.0)
    streams = Counter(wanted for _, number, wanted in talk.said if number == _INTERVAL)
    assert streams == dict.fromkeys(map(float, RATES_HZ), 1)
    between_s = [b - a for (a, _, _), (b, _, _) in zip(talk.said, talk.said[1:], strict=False)]
    assert min(between_s) > 0.015


def test_a_stream_that_was_not_answered_is_asked_for_again() -> None:
    asked: Counter[float] = Counter()

    def second_time(message: Message) -> int | None:
        asked[message[1]["param1"]] += 1
        return 0 if asked[message[1]["param1"]] > 1 else None

    talk = Conversation(second_time)
    talk.go_on(8.0)
    streams = Counter(wanted for _, number, wanted in talk.said if number == _INTERVAL)
    assert streams == dict.fromkeys(map(float, RATES_HZ), 2)


def test_a_vehicle_that_never_answers_is_asked_less() -> None:
    talk = Conversation(lambda _: None)
    talk.go_on(60.0)
    assert talk.most_within(1.0) <= 4


def test_an_estimator_that_resets_again_and_again_causes_no_storm() -> None:
    """Each of its positions asks for the origin, and each answer comes at once."""
    talk = Conversation()

    def resets(now_s: float) -> None:
        position(talk.telemetry, 100.0 * (round(now_s * 20.0) % 2), now_s)
        origin(talk.telemetry, now_s)

    talk.go_on(2.0)
    before = len(talk.said)
    talk.go_on(10.0, resets)
    assert 0 < len(talk.said) - before < 200
    assert talk.most_within(0.1) <= 6
    assert talk.most_within(1.0) <= 20


def test_the_origin_is_asked_for_as_soon_as_the_position_jumps() -> None:
    talk = Conversation()
    origin(talk.telemetry, 0.0)
    position(talk.telemetry, 0.0, 0.0)
    talk.go_on(5.03, lambda now_s: position(talk.telemetry, 0.0, now_s))
    jumped_s = talk.now_s
    talk.go_on(0.3, lambda now_s: position(talk.telemetry, 50.0, now_s))
    asked_s = [s for s, number, wanted in talk.said if (number, wanted) == (_REQUEST, 49.0)]
    assert any(jumped_s <= s <= jumped_s + 0.1 for s in asked_s)


@pytest.mark.parametrize(
    ("action", "times", "text"),
    [
        (Action.ARM, 1, "no answer"),
        (Action.OFFBOARD, 1, "no answer"),
        (Action.HOLD, 3, "no answer"),
        (Action.LAND, 3, "no answer"),
        (Action.KILL, 5, "no answer"),
    ],
)
def test_an_unanswered_command_is_repeated_so_often(action: Action, times: int, text: str) -> None:
    talk = Conversation(lambda _: None)
    talk.go_on(1.0)
    talk.dialogue.command(action, talk.now_s)
    talk.said.clear()
    talk.go_on(3.0)
    assert sum(number not in (_INTERVAL, _REQUEST) for _, number, _ in talk.said) == times
    assert talk.dialogue.result is not None
    assert (talk.dialogue.result.action, talk.dialogue.result.text) == (action, text)


def test_a_command_waits_for_no_request() -> None:
    talk = Conversation(lambda message: 0 if message[1]["command"] == _MODE else None)
    talk.go_on(1.0)
    talk.dialogue.command(Action.HOLD, talk.now_s)
    ordered_s = talk.now_s
    talk.go_on(0.1)
    assert [s for s, number, _ in talk.said if number == _MODE] == [ordered_s]
    assert talk.dialogue.result is not None and talk.dialogue.result.accepted


def test_a_refused_command_says_why() -> None:
    talk = Conversation(lambda message: 2 if message[1]["command"] == _ARM else 0)
    talk.dialogue.command(Action.ARM, talk.now_s)
    text = {"severity": 2, "text": "Preflight Fail: Compass 0 missing", "id": 0, "chunk_seq": 0}
    talk.go_on(0.1)
    talk.telemetry.receive("STATUSTEXT", text, talk.now_s)
    talk.go_on(1.0)
    assert talk.dialogue.result is not None
    assert talk.dialogue.result.text == "denied: Compass 0 missing"


def test_without_a_vehicle_nothing_is_said() -> None:
    talk = Conversation()
    talk.vehicle = None
    talk.dialogue.command(Action.LAND, 0.0)
    talk.go_on(1.0)
    assert talk.said == []
    assert talk.dialogue.result is not None and talk.dialogue.result.text == "no vehicle"


@given(
    st.lists(st.tuples(st.floats(0.0, 8.0), st.sampled_from(Action)), max_size=6),
    st.lists(st.sampled_from([None, 0, 1]), min_size=1, max_size=40),
    st.floats(0.0, 0.3),
)
def test_whatever_is_ordered_and_answered(
    orders: list[tuple[float, Action]], answers: list[int | None], jump_m: float
) -> None:
    """There is no storm, and each order ends."""
    count = iter(range(10**6))
    talk = Conversation(lambda _: answers[next(count) % len(answers)])
    waiting = sorted(orders, key=lambda order: order[0])

    def order(now_s: float) -> None:
        while waiting and waiting[0][0] <= now_s:
            talk.dialogue.command(waiting.pop(0)[1], now_s)
        position(talk.telemetry, now_s * 100.0 * jump_m, now_s)

    talk.go_on(20.0, order)
    # A kill is sent five times on purpose.
    kills = sum(action is Action.KILL for _, action in orders)
    assert talk.most_within(1.0) <= 20 + 5 * max(kills - 1, 0)
    assert talk.dialogue.running is None
    result: Any = talk.dialogue.result
    # What the GPS is used for is no command: PX4 tells it with its parameter.
    of_gps = (Action.IGNORE_GPS, Action.USE_GPS)
    assert (result is not None) == any(action not in of_gps for _, action in orders)
    assert result is None or math.isfinite(result.at_s)
