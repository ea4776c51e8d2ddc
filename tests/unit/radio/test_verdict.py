"""One sentence on a fleet's radio, and its problems."""

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.messages.mission import Origin, RadioCounts, RobotStatus
from lpac.radio.airtime import Traffic, Transport, Wifi, airtime, capacity
from lpac.radio.checked import Checked, WifiReading
from lpac.radio.pairs import Pair, Window
from lpac.radio.records import RadioRecord
from lpac.radio.verdict import WHAT_RUNS, RadioVerdict, obstacles, verdict
from tests.unit.ground import snapshots

N, SENT, BYTES = 10, 50, 1795
NAMES = tuple(f"r{i}" for i in range(N))


def spoken(robot: int, sent: int = SENT) -> Window:
    first = snapshots.status(robot, uptime_s=100.0, radio_counts=RadioCounts(500, 500 * BYTES))
    counts = RadioCounts(500 + sent, (500 + sent) * BYTES)
    return Window(first, replace(first, uptime_s=120.0, radio_counts=counts))


def checked(**changes: Any) -> Checked:
    windows = {name: spoken(i) for i, name in enumerate(NAMES)}
    return Checked(NAMES, windows, {}, "mesh", 85)._replace(**changes)


def heard(**bad: tuple[int, int]) -> list[Pair]:
    """All pairs are good, except "r1_r2": r2's receptions from r1, and how many were late."""
    found = []
    for sender in NAMES:
        for receiver in NAMES:
            if sender != receiver:
                received, late = bad.get(f"{sender}_{receiver}", (SENT, 0))
                p99_s = (0.05 if not late else 1.3) if received else None
                found.append(Pair(sender, receiver, SENT, received, late, p99_s, p99_s))
    return found


def wifi(**changes: float | None) -> dict[str, WifiReading]:
    return {n: WifiReading(**{"rate_mbit_s": 220.0, "signal_dbm": -50.0} | changes) for n in NAMES}


def test_a_fleet_that_hears_itself_well() -> None:
    traffic = Traffic(robots=N, message_bytes=BYTES + 85, message_hz=2.5)
    most = capacity("mesh", Wifi(), traffic)
    told = verdict(checked(), heard())
    assert told.problems == ()
    assert told.sentence == f"carries 10 robots; by the model there is room for {most - N} more"
    assert told.room is not None
    assert (told.room.rate_told, told.room.busy_share) == (False, None)
    assert (told.room.ground_bytes, told.room.message_hz) == (BYTES + 85, 2.5)
    assert told.room.ground_share == told.room.flight_share


@pytest.mark.parametrize(
    ("transport", "bytes_each", "received", "good"),
    [
        ("mesh", BYTES, SENT - 2, True), ("mesh", BYTES, SENT - 3, False),
        # One frame per message, and two.
        ("multicast", 900, SENT - 7, True), ("multicast", 900, SENT - 8, False),
        ("multicast", BYTES, SENT - 11, True), ("multicast", BYTES, SENT - 12, False),
    ],
)  # fmt: skip
def test_what_nobody_repeats_may_be_missing_as_chance_has_it(
    transport: Transport, bytes_each: int, received: int, good: bool
) -> None:
    counts = RadioCounts(500 + SENT, 500 * BYTES + SENT * bytes_each)
    windows = {
        name: window._replace(last=replace(window.last, radio_counts=counts))
        for name, window in checked().windows.items()
    }
    one = checked(transport=transport, windows=windows)
    assert (not verdict(one, heard(r1_r2=(received, 0))).problems) is good


def test_messages_that_grow_in_flight_leave_less_room() -> None:
    told, grown = (verdict(checked(flight_bytes=size), heard()).room for size in (900.0, 9000.0))
    assert told == verdict(checked(), heard()).room
    assert told and grown
    assert (grown.ground_share, grown.flight_bytes) == (told.ground_share, 9000.0)
    assert grown.flight_share > told.flight_share
    assert grown.carries < told.carries


def test_a_ground_in_the_wifi_itself_takes_more_of_it() -> None:
    wired, in_the_wifi = (
        verdict(checked(ground_wired=is_so), heard()).room for is_so in (True, False)
    )
    assert wired is not None and in_the_wifi is not None
    assert in_the_wifi.flight_share > 1.05 * wired.flight_share
    assert in_the_wifi.carries <= wired.carries


def test_a_channel_that_is_busier_than_the_model_says_has_less_room() -> None:
    traffic = Traffic(robots=N, message_bytes=BYTES + 85, message_hz=2.5)
    # Radios count without gaps.
    model = airtime("mesh", Wifi(data_rate_mbit_s=220.0), traffic).busy
    same, busier = (
        verdict(checked(wifi=wifi(busy_share=share)), heard()) for share in (model, 1.5 * model)
    )
    unscaled = verdict(checked(), heard()).room
    assert same.room and busier.room and unscaled
    assert same.room == unscaled._replace(rate_told=True, busy_share=model)
    assert N < busier.room.carries < same.room.carries
    assert busier.room.busy_share == pytest.approx(1.5 * model)
    assert busier.room.flight_share == pytest.approx(1.5 * unscaled.flight_share)


def test_a_slow_rate_has_less_room() -> None:
    readings = wifi() | {"r3": WifiReading(6.0)}
    told = verdict(checked(wifi=readings), heard())
    assert told.room is not None and told.room.rate_told
    assert told.room.rate_mbit_s == pytest.approx(N / (9 / 220.0 + 1 / 6.0))
    assert N < told.room.carries < verdict(checked(wifi=wifi()), heard()).room.carries  # type: ignore[union-attr]


def test_a_channel_that_is_too_small_for_these_robots_is_a_problem() -> None:
    slow = verdict(checked(wifi=wifi(rate_mbit_s=6.0)), heard())
    assert slow.problems == (
        "by the model these 10 robots need 214 % of the channel in flight, of which they can "
        "use 60 %: it carries 5",
    )
    assert slow.sentence == slow.problems[0]
    # Also beside a stream, which does not change it.
    assert verdict(checked(wifi=wifi(rate_mbit_s=6.0), loaded=True), heard()).problems
    grown = verdict(checked(flight_bytes=1e6), heard())
    assert grown.sentence.endswith("it carries 1")


def test_where_a_few_are_judged_the_others_still_take_airtime() -> None:
    few = checked(robots=NAMES[:2], windows={**checked().windows, "r9": spoken(9, sent=0)})
    assert {(pair.sender, pair.receiver) for pair in few.pairs()} == {("r0", "r1"), ("r1", "r0")}
    told = verdict(few, [pair for pair in heard() if {pair.sender, pair.receiver} <= {"r0", "r1"}])
    # r9 is silent, which is no fault of the judged robots.
    assert told.problems == ()
    assert told.sentence == (
        "carries 9 robots, of which r0, r1 were judged; by the model there is room for 8 more"
    )


@pytest.mark.parametrize(
    ("bad", "problem"),
    [
        ({"r7_r3": (31, 0)}, "r3 hears 62 % of r7"),
        ({"r7_r3": (0, 0)}, "r3 hears 0 % of r7"),
        ({"r5_r3": (SENT, 5)}, "r5's messages come late to r3: 10 % at 0.8 s or older, p99 1.3 s"),
        ({f"{n}_r3": (40, 0) for n in NAMES}, "r3 hears 80 % of the others"),
        ({f"r3_{n}": (40, 0) for n in NAMES}, "the others hear 80 % of r3"),
        ({f"r3_{n}": (SENT, 25) for n in NAMES},
         "r3's messages come late: 50 % at 0.8 s or older, p99 1.3 s"),
        ({f"{n}_r3": (SENT, 25) for n in NAMES},
         "messages come late to r3: 50 % at 0.8 s or older, p99 1.3 s"),
    ],
)  # fmt: skip
def test_what_is_wrong(bad: dict[str, tuple[int, int]], problem: str) -> None:
    told = verdict(checked(), heard(**bad))
    assert (told.sentence, told.problems) == (problem, (problem,))


def test_one_of_fifty_is_chance_and_one_of_twenty_is_allowed() -> None:
    assert verdict(checked(), heard(r1_r2=(SENT, 1), r2_r1=(SENT - 1, 0))).problems == ()
    assert verdict(checked(), heard(r1_r2=(48, 0))).problems == ()
    assert verdict(checked(), heard(r1_r2=(47, 0))).problems == ("r2 hears 94 % of r1",)


def test_the_worst_comes_first() -> None:
    windows = {name: spoken(i) for i, name in enumerate(NAMES) if name != "r4"}
    windows["r6"] = spoken(6, sent=0)
    pairs = [p for p in heard(r1_r2=(45, 0), r3_r2=(10, 0)) if p.sender not in ("r4", "r6")]
    told = verdict(checked(windows=windows), pairs)
    assert told.problems == (
        f"r4 is not heard here: {WHAT_RUNS}",
        "r6 sends nothing to the others: `lpac watch` shows why",
        "r2 hears 20 % of r3",
        "r2 hears 90 % of r1",
    )
    assert told.sentence == f"{told.problems[0]}; and 3 more"


def test_a_weak_signal_is_told_of_who_is_heard_badly() -> None:
    readings = wifi() | {"r3": WifiReading(20.0, -81.0, None)}
    assert verdict(checked(wifi=readings), heard()).problems == ()
    bad = {f"r3_{n}": (40, 0) for n in NAMES}
    assert verdict(checked(wifi=readings), heard(**bad)).problems == (
        "the others hear 80 % of r3 (its signal is weak: -81 dBm)",
    )


def test_a_channel_that_others_take() -> None:
    (problem,) = verdict(checked(wifi=wifi(busy_share=0.31)), heard()).problems
    assert problem == (
        "by the model these 10 robots need 31 % of the channel in flight, of which they can use "
        "30 %: it carries 9; other networks take 30 %: look for another channel"
    )
    # Smaller foreign traffic leaves room for some.
    alone, beside = (verdict(checked(wifi=wifi(busy_share=busy)), heard()) for busy in (None, 0.25))
    assert alone.room is not None and beside.room is not None and beside.problems == ()
    assert N <= beside.room.carries < alone.room.carries
    # The check's own stream is not foreign.
    loaded = verdict(checked(wifi=wifi(busy_share=0.8), loaded=True), heard())
    assert loaded.problems == ()
    assert loaded.sentence.startswith("carries 10 robots beside a bulk stream; by the model ")


@given(st.floats(0.01, 1.0), st.floats(0.01, 1.0))
def test_a_busier_channel_never_has_more_room(one: float, other: float) -> None:
    room = [verdict(checked(wifi=wifi(busy_share=b)), heard()).room for b in sorted((one, other))]
    assert room[0] is not None and room[1] is not None
    assert room[0].carries >= room[1].carries


def test_where_nobody_speaks_nothing_is_known_of_room() -> None:
    told = verdict(checked(windows={}), [])
    assert (len(told.problems), told.room) == (N, None)


@given(
    st.dictionaries(
        st.sampled_from([f"{a}_{b}" for a in NAMES[:4] for b in NAMES[:4] if a != b]),
        st.integers(0, SENT).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, n))),
    ),
    st.none() | st.floats(0.0, 1.0),
)
def test_there_is_always_one_sentence(bad: dict[str, tuple[int, int]], busy: float | None) -> None:
    told: RadioVerdict = verdict(checked(wifi=wifi(busy_share=busy)), heard(**bad))
    assert told.sentence and "\n" not in told.sentence
    assert told.sentence.startswith("carries") is not bool(told.problems)
    assert len(set(told.problems)) == len(told.problems)


def test_a_record_of_each_pair() -> None:
    readings = {"r2": WifiReading(130.0, -61.0, 0.3)}
    records = checked(wifi=readings).records(heard(r1_r2=(40, 5)))
    assert len(records) == N * (N - 1)
    by_link = {(record.sender, record.receiver): record for record in records}
    assert by_link["r1", "r2"] == RadioRecord(
        sender="r1", receiver="r2", transport="mesh", robots=N, message_bytes=BYTES + 85,
        message_hz=2.5, sent=SENT, received=40, age_p50_s=1.3, age_p99_s=1.3, distance_m=5.0,
        sender_heading_deg=0.0, receiver_height_m=4.0, rate_mbit_s=130.0, signal_dbm=-61.0,
        busy_share=0.3, loaded=False, ground_wired=True,
    )  # fmt: skip
    assert by_link["r2", "r1"].signal_dbm is None
    (beside, *_) = checked(loaded=True, ground_wired=False).records(heard())
    assert (beside.loaded, beside.ground_wired) == (True, False)


# Before

STATUSES: dict[str, RobotStatus] = {
    name: snapshots.status(i, radio_counts=RadioCounts(5, 9000)) for i, name in enumerate(NAMES[:3])
}


def test_robots_that_speak_already() -> None:
    assert obstacles(STATUSES) == ()
    assert obstacles({}) == ()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"radio_counts": None}, "r1: an older program"),
        ({"origin": None, "position_m": None}, "r1: no mission origin"),
        ({"position_m": None}, "r1: no position"),
        ({"bundle_id": "ab"}, "r1: another policy than most"),
        ({"origin": Origin(1.0, 2.0, 3.0)}, "r1: another mission origin than most"),
    ],
)
def test_what_keeps_them_from_it(changes: dict[str, Any], said: str) -> None:
    (told,) = obstacles(STATUSES | {"r1": replace(STATUSES["r1"], **changes)})
    assert told.startswith(said)
