"""Recorded flights are decided as they were; and what if not.

A test that fails here says that a robot would now fly otherwise. `lpac replay
tests/unit/flight/recorded` shows where; to accept it, `python -m tests.record_flights`.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from msgspec import structs

from edge.core.changes import changed, changes, same
from edge.drivers.log_reader import read
from edge.flight import guidance, orders, safety, state, step
from edge.flight.record import FlightTick, TickError, TickReader, TickWriter
from edge.flight.transitions import TRANSITIONS, Rows, by_state
from edge.messages.codes import ReasonCode
from edge.messages.mission import FlightState
from lpac.analysis.flight_replay import FlightReplay, differing
from tests.record_flights import FLIGHTS, RECORDED

_S = FlightState
# The position is lost first, which calls arming off.
NOT_RECORDED = {(ReasonCode.AUTOPILOT_SILENT, _S.ARMING)}


@cache
def ticks(name: str) -> tuple[FlightTick, ...]:
    reader = TickReader()
    messages = [message for _, _, message in read(RECORDED / f"{name}.mcap", "flight")]
    found = [reader.tick(message) for message in messages]
    return tuple(tick for tick in found if tick is not None)


def differ(*names: str) -> set[str]:
    """What differs in these flights now, rounding aside."""
    found = {each for name in names for tick in ticks(name) for each in differing(tick)}
    return {each.what for each in found if not each.is_rounding}


def test_each_flight_is_recorded_and_small() -> None:
    assert {path.stem for path in RECORDED.iterdir()} == FLIGHTS.keys()
    assert sum(path.stat().st_size for path in RECORDED.iterdir()) < 1.5e6


@pytest.mark.parametrize("name", FLIGHTS)
def test_a_recorded_flight_is_decided_as_it_was(name: str) -> None:
    replay = FlightReplay()
    for _, unix_time_s, message in read(RECORDED / f"{name}.mcap", "flight"):
        replay.run(unix_time_s, message)
    assert replay.ticks > 20 and not replay.passed_over
    # Another kind of processor may round otherwise.
    assert [d for d in replay.differences if not d.differing.is_rounding] == []


def test_each_row_of_the_table_leads_somewhere_in_a_recorded_flight() -> None:
    """A new one needs a flight that takes it: see `tests/record_flights.py`."""
    taken = set()
    for name in FLIGHTS:
        for tick in ticks(name):
            given = tick.given
            row = step.step(given.robot, given.flight, given.inputs).taken
            taken.add(row and TRANSITIONS.index(row))
    left = [row for number, row in enumerate(TRANSITIONS) if number not in taken]
    assert {(row.code, row.sources[0]) for row in left} == NOT_RECORDED


def _swapped(one: ReasonCode, other: ReasonCode, source: FlightState) -> Rows:
    """The table with these two rows in each other's places."""
    rows = list(TRANSITIONS)
    i, j = (
        next(n for n, row in enumerate(rows) if row.code is code and source in row.sources)
        for code in (one, other)
    )
    rows[i], rows[j] = rows[j], rows[i]
    return by_state(rows)


def _without(code: ReasonCode) -> Rows:
    return by_state([row for row in TRANSITIONS if row.code is not code])


MUTATIONS: dict[str, tuple[Callable[[pytest.MonkeyPatch], None], tuple[str, ...]]] = {
    "a lapse is taken for a pilot's doing": (
        lambda patch: patch.setattr(
            step, "ROWS",
            _swapped(ReasonCode.CONTROL_SILENT, ReasonCode.LEFT_OFFBOARD, _S.MISSION),
        ),
        ("program_hangs",),
    ),
    "a critical battery returns": (
        lambda patch: patch.setattr(
            step, "ROWS",
            _swapped(ReasonCode.BATTERY_CRITICAL, ReasonCode.BATTERY_LOW, _S.MISSION),
        ),
        ("battery_critical",),
    ),
    "no row for a lost ground": (
        lambda patch: patch.setattr(step, "ROWS", _without(ReasonCode.GROUND_LOST)),
        ("ground_lost",),
    ),
    "no brake before a neighbour": (
        lambda patch: patch.setattr(guidance, "brake", lambda *given: given[2]),
        ("near_neighbour",),
    ),
    "nobody parts before they come down": (
        lambda patch: patch.setattr(guidance, "make_room", lambda *given, **_: given[2]),
        ("ground_lost_below_another",),
    ),
    "no way for who comes down": (
        lambda patch: patch.setattr(safety, "_PASSING_M_S", math.inf),
        ("comes_down_above",),
    ),
    "nobody remembers who fell silent": (
        lambda patch: patch.setattr(safety, "highest_possible_m", lambda *_: -math.inf),
        ("falls_silent",),
    ),
    "no fence": (
        lambda patch: patch.setattr(
            guidance, "keep_inside", lambda *given: (given[3], given[-1])
        ),
        ("wind_over_the_fence",),
    ),
    "no limit of acceleration": (
        lambda patch: patch.setattr(guidance, "limit_acceleration", lambda *given: given[1]),
        ("normal",),
    ),
    "a watchdog's lapse that is noticed late": (
        lambda patch: patch.setattr(state, "_LAPSE_SHARE", 9.0),
        ("program_hangs",),
    ),
    "setpoints at once after a lapse": (
        lambda patch: patch.setattr(step, "STALE_TELEMETRY_S", 0.0),
        ("program_hangs",),
    ),
    "a start that ignores the fence": (
        lambda patch: patch.setitem(
            vars(orders)["ORDERS"], "start", replace(orders.ORDERS["start"], checks=())
        ),
        ("orders_refused",),
    ),
    "a landing on who stands there": (
        lambda patch: patch.setattr(
            state.Tick, "landing_place_m",
            property(lambda tick: tick.robot.parameters.landing_point_m),
        ),
        ("landing_point_taken",),
    ),
    "an operator whose orders nobody answers": (
        lambda patch: patch.setattr(step, "answered", lambda flight, *_: flight),
        ("ordered",),
    ),
    "no order is refused": (
        lambda patch: patch.setattr(step, "refusal", lambda *_: None),
        ("orders_refused",),
    ),
    "offboard that is asked for without end": (
        lambda patch: patch.setattr(state, "OFFBOARD_TIMEOUT_S", 60.0),
        ("offboard_refused",),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_change_of_behaviour_is_seen(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    change, flights = MUTATIONS[name]
    assert not differ(*flights)
    change(monkeypatch)
    assert differ(*flights)


# The messages


def test_a_difference_is_told_once_with_its_times() -> None:
    messages = list(read(RECORDED / "ground_lost.mcap", "flight"))
    replay = FlightReplay()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(step, "ROWS", _without(ReasonCode.GROUND_LOST))
        for _, unix_time_s, message in messages:
            replay.run(unix_time_s, message)
    told = [d for d in replay.differences if d.differing.what == "state"]
    assert [(d.differing.then, d.differing.now) for d in told] == [
        ("hold", "mission"), ("land", "hold"),
    ]  # fmt: skip
    assert all(d.ticks == 1 and d.since_unix_s == d.until_unix_s for d in told)
    reason = next(d.differing for d in replay.differences if d.differing.what == "reason")
    assert reason.then == "ground_lost: ground lost"
    assert replay.differing == 2 and replay.ticks == len(messages)
    assert replay.began_unix_s == messages[0][1]


def test_what_guidance_remembers_is_compared_too() -> None:
    replay = FlightReplay()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guidance, "keep_inside", lambda *given: (given[3], False))
        for _, unix_time_s, message in read(RECORDED / "wind_over_the_fence.mcap", "flight"):
            replay.run(unix_time_s, message)
    told = {d.differing.what for d in replay.differences}
    assert {"guidance: velocity", "guidance: recovering"} <= told


def test_a_tick_is_what_it_was_after_the_log() -> None:
    """To the last bit, also of what is not a number."""
    writer, reader = TickWriter(), TickReader()
    for tick in ticks("autopilot_silent")[:150]:
        again = reader.tick(writer.message(tick))
        assert again is not None
        assert same(again.given, tick.given) and same(again.made, tick.made)
        assert isinstance(again.given.guidance.velocity_m_s, np.ndarray)


def test_after_a_gap_it_goes_on_with_the_next_whole_message() -> None:
    messages = [m for _, _, m in read(RECORDED / "normal.mcap", "flight")]
    reader = TickReader()
    read_again = [reader.tick(m) is not None for m in (*messages[3:40], *messages[41:])]
    assert [m["whole"] for m in messages].count(True) == len(messages) // 100 + 1
    first_whole = 100 - 3 - 1
    assert not any(read_again[:first_whole]) and all(read_again[first_whole:])
    reader = TickReader()
    read_again = [reader.tick(m) is not None for m in (*messages[:40], *messages[41:])]
    assert all(read_again[:40]) and not any(read_again[40:99]) and all(read_again[99:])


def test_what_is_no_tick_is_one_line() -> None:
    first = next(m for _, _, m in read(RECORDED / "normal.mcap", "flight"))
    for message, why in (
        ({}, "'number' is missing"),
        ({**first, "given": {}}, "Missing required argument"),
        ({**first, "given": {**first["given"], "dt_s": "soon"}}, "Expected `float`"),
        ({**first, "given": {**first["given"], "luck": 1}}, "Given has no luck"),
        ({**first, "made": 7}, "items"),
    ):
        with pytest.raises(TickError, match=why):
            TickReader().tick(message)


def test_what_changed_is_told_alone_and_exactly() -> None:
    first = ticks("normal")[0].given.inputs
    vehicle = structs.replace(first.vehicle, height_jumped_m=-0.0, battery=math.nan)
    second = structs.replace(first, vehicle=vehicle, order=None, uptime_s=first.uptime_s)
    told = changes(first, second)
    assert told.keys() == {"vehicle"} and told["vehicle"].keys() == {"height_jumped_m", "battery"}
    again = changed(type(first), first, told)
    assert same(again, second) and not same(again, first)
    assert again.ground is first.ground
