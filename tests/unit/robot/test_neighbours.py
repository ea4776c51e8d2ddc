"""The newest of each neighbour alone, only while it is fresh, whoever writes meanwhile."""

import itertools
import math
import random
import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from threading import Barrier
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from edge.core.aggregation import AggregatedMessage
from edge.core.arrivals import Arrivals
from edge.core.wire import Rejection
from edge.messages.beacon import Beacon
from edge.robot.neighbours import NeighbourTable, ReceivedMessage

OWN_ID = 0


class Said(NamedTuple):
    beacon: Beacon
    number: tuple[int, int]
    message: AggregatedMessage


def message(robot_id: int, sequence: int, *, start: int = 10) -> Said:
    payload = np.array([sequence], np.float32)
    beacon = Beacon(
        robot_id=robot_id,
        sent=None,
        position_m=(float(robot_id), float(sequence), 0.0),
        velocity_m_s=(0.5, 0.0, -0.5),
        frame_id=7,
        bundle_tag=1,
    )
    return Said(beacon, (start, sequence), AggregatedMessage(payload))


def receive(
    table: NeighbourTable, said: Said, now_s: float = 0.0, age_s: float | None = 0.0
) -> Rejection | None:
    return table.receive(*said, now_s, age_s)


def sequences(received: tuple[ReceivedMessage, ...]) -> list[tuple[int, int]]:
    return [(each.beacon.robot_id, int(each.message.payload[0])) for each in received]


def robots(received: tuple[ReceivedMessage, ...]) -> list[int]:
    return [each.beacon.robot_id for each in received]


def ages(table: NeighbourTable, now_s: float) -> dict[int, float]:
    return {each.beacon.robot_id: now_s - each.sent_at_s for each in table.neighbours(now_s)}


def test_it_counts_what_it_accepts_of_each() -> None:
    table = NeighbourTable(OWN_ID)
    for robot_id, sequence in ((7, 1), (2, 5), (2, 6), (2, 6), (OWN_ID, 1)):
        receive(table, message(robot_id, sequence))
    assert table.accepted() == {7: 1, 2: 2}
    table.clear()
    assert table.accepted() == {7: 1, 2: 2}


def test_what_comes_late_or_overtaken_has_arrived_and_what_does_not_come_is_missed() -> None:
    table = NeighbourTable(OWN_ID)
    assert table.arrivals() == {}
    received = ((1, 0.01), (2, 0.3), (4, 0.9), (3, 2.0), (4, 0.9), (7, None), (8, 0.01))
    said = [receive(table, message(1, sequence), age_s=age_s) for sequence, age_s in received]
    # The fourth overtook the third, both too old for the policy; 5 and 6 never came.
    assert said[2:5] == [Rejection.STALE, Rejection.OUTDATED, Rejection.OUTDATED]
    assert said[5] is Rejection.AGE_UNKNOWN
    receive(table, message(OWN_ID, 1))
    assert table.arrivals() == {1: Arrivals(8, 1, (2, 0, 0, 0, 1, 0, 1, 1, 0))}
    table.clear()
    assert table.arrivals()[1].sent == 8


def test_a_sender_that_starts_again_goes_on_in_the_counts() -> None:
    table = NeighbourTable(OWN_ID)
    receive(table, message(1, 900))
    receive(table, message(1, 901))
    receive(table, message(1, 1, start=11))
    receive(table, message(1, 902))
    receive(table, message(1, 3, start=11))
    assert table.arrivals()[1].sent == 5
    assert table.arrivals()[1].arrived == 4


def test_the_newest_of_each_by_robot_id() -> None:
    table = NeighbourTable(OWN_ID)
    for robot_id, sequence in ((7, 1), (2, 5), (300, 1), (2, 6), (1, 9)):
        assert receive(table, message(robot_id, sequence)) is None
    assert sequences(table.swap(0.1)) == [(1, 9), (2, 6), (7, 1), (300, 1)]
    assert robots(table.neighbours(0.1)) == [1, 2, 7, 300]
    assert table.neighbours(0.1)[1].beacon.position_m == (2.0, 6.0, 0.0)


@settings(deadline=None)
@given(st.permutations(range(6)))
def test_arrival_order_between_robots_is_no_matter(order: list[int]) -> None:
    table = NeighbourTable(OWN_ID)
    for index in order:
        receive(table, message(index + 1, 1))
    assert robots(table.swap(0.0)) == [1, 2, 3, 4, 5, 6]


def test_own_repeated_and_overtaken_messages_are_dropped() -> None:
    table = NeighbourTable(OWN_ID)
    assert receive(table, message(OWN_ID, 1)) is Rejection.OWN
    assert receive(table, message(1, 4)) is None
    assert receive(table, message(1, 4)) is Rejection.OUTDATED
    assert receive(table, message(1, 3)) is Rejection.OUTDATED
    assert sequences(table.swap(0.0)) == [(1, 4)]


def test_a_restarted_robot_is_accepted_at_once() -> None:
    table = NeighbourTable(OWN_ID)
    receive(table, message(1, 900, start=10))
    assert receive(table, message(1, 0, start=11)) is None
    assert receive(table, message(1, 901, start=10)) is Rejection.OUTDATED
    assert sequences(table.swap(0.0)) == [(1, 0)]


def test_a_smaller_start_is_accepted_after_a_silence() -> None:
    table = NeighbourTable(OWN_ID)
    receive(table, message(1, 900, start=10), now_s=0.0)
    # As late as a message of an earlier start can be.
    assert receive(table, message(1, 0, start=3), now_s=5.0) is Rejection.OUTDATED
    # What was refused does not count as hearing from it.
    assert receive(table, message(1, 1, start=3), now_s=5.01) is None
    assert receive(table, message(1, 0, start=3), now_s=5.02) is Rejection.OUTDATED
    assert sequences(table.swap(5.1)) == [(1, 1)]


def test_a_smaller_start_waits_for_the_age_limit_if_that_is_longer() -> None:
    table = NeighbourTable(OWN_ID, max_message_age_s=20.0)
    receive(table, message(1, 900, start=10), now_s=0.0)
    assert receive(table, message(1, 0, start=3), now_s=20.0) is Rejection.OUTDATED
    assert receive(table, message(1, 0, start=3), now_s=20.1) is None


@pytest.mark.parametrize("max_message_age_s", [0.8, 0.0])
def test_a_late_duplicate_is_never_accepted_again(max_message_age_s: float) -> None:
    table = NeighbourTable(OWN_ID, max_message_age_s)
    receive(table, message(1, 5))
    for _ in range(3):
        table.swap(100.0)
    assert table.neighbours(100.0) == ()
    assert receive(table, message(1, 5), now_s=100.0) is Rejection.OUTDATED
    table.clear()
    assert receive(table, message(1, 5), now_s=1000.0) is Rejection.OUTDATED
    assert receive(table, message(1, 6), now_s=1000.0) is None


def test_a_message_is_handed_out_until_it_is_too_old() -> None:
    table = NeighbourTable(OWN_ID, max_message_age_s=0.8)
    receive(table, message(1, 1), now_s=10.0)
    for now_s in (10.0, 10.4, 10.75):
        assert sequences(table.swap(now_s)) == [(1, 1)]
        assert ages(table, now_s) == {1: pytest.approx(now_s - 10.0)}
    assert table.swap(10.85) == ()
    assert table.neighbours(10.85) == ()


def test_age_counts_from_sending() -> None:
    table = NeighbourTable(OWN_ID, max_message_age_s=0.8)
    assert receive(table, message(1, 1), now_s=10.0, age_s=0.5) is None
    assert ages(table, 10.0) == {1: pytest.approx(0.5)}
    assert len(table.swap(10.25)) == 1
    assert table.swap(10.35) == ()


def test_a_message_that_arrives_too_old_or_of_unknown_age_is_not_kept() -> None:
    table = NeighbourTable(OWN_ID, max_message_age_s=0.8)
    assert receive(table, message(1, 1), 8.0) is None
    assert receive(table, message(1, 3), 10.0, age_s=1.6) is Rejection.STALE
    assert receive(table, message(1, 4), 10.0, age_s=None) is Rejection.AGE_UNKNOWN
    assert table.swap(10.0) == ()
    # They are the newest beacons all the same.
    assert receive(table, message(1, 2), 10.0, age_s=0.1) is Rejection.OUTDATED
    (heard,) = table.beacons(10.0, 3.0)
    assert heard.beacon == message(1, 4).beacon


def test_the_papers_rule_hands_each_message_out_once() -> None:
    table = NeighbourTable(OWN_ID, max_message_age_s=0.0)
    receive(table, message(1, 1), now_s=0.0)
    receive(table, message(2, 1), now_s=0.0)
    assert list(ages(table, 0.0)) == [1, 2]
    assert sequences(table.swap(0.4)) == [(1, 1), (2, 1)]
    assert ages(table, 0.5) == {1: 0.5, 2: 0.5}
    receive(table, message(1, 2), now_s=0.6)
    assert ages(table, 0.6) == pytest.approx({1: 0.0, 2: 0.6}, abs=1e-6)
    assert sequences(table.swap(0.8)) == [(1, 2)]
    assert list(ages(table, 0.8)) == [1]
    assert table.swap(1.2) == ()
    assert table.neighbours(1.2) == ()


@pytest.mark.parametrize("max_message_age_s", [0.8, 0.0])
def test_a_new_mission_starts_without_neighbours(max_message_age_s: float) -> None:
    table = NeighbourTable(OWN_ID, max_message_age_s)
    receive(table, message(1, 1))
    table.swap(0.0)
    receive(table, message(2, 1))
    table.clear()
    assert table.neighbours(0.0) == ()
    assert table.swap(0.0) == ()


def test_the_papers_rule_knows_no_age() -> None:
    table = NeighbourTable(OWN_ID, max_message_age_s=0.0)
    assert receive(table, message(1, 1), age_s=None) is None
    assert len(table.swap(100.0)) == 1


def test_every_message_is_counted() -> None:
    table = NeighbourTable(OWN_ID)
    assert table.counts() == {"accepted": 0} | dict.fromkeys(map(str, Rejection), 0)
    for sequence in (1, 2, 2):
        receive(table, message(1, sequence))
    receive(table, message(2, 1))
    receive(table, message(2, 2), age_s=3.0)
    receive(table, message(OWN_ID, 1))
    beacon, number, _ = message(2, 3)
    table.receive(beacon, number, Rejection.OTHER_BUNDLE, 0.0, 0.0)
    table.clear()
    counted = {reason: count for reason, count in table.counts().items() if count}
    assert counted == {"accepted": 3, "outdated": 1, "stale": 1, "own": 1, "other_bundle": 1}
    assert table.swap(0.0) == ()


def test_what_is_handed_out_does_not_change() -> None:
    table = NeighbourTable(OWN_ID)
    receive(table, message(1, 1))
    handed_out, neighbours, counts = table.swap(0.0), table.neighbours(0.0), table.counts()
    receive(table, message(1, 2))
    table.clear()
    assert sequences(handed_out) == [(1, 1)]
    assert neighbours[0].beacon.position_m == (1.0, 1.0, 0.0)
    assert counts["accepted"] == 1
    with pytest.raises(AttributeError):
        neighbours[0].sent_at_s = 1.0  # type: ignore[misc]


@pytest.mark.parametrize("max_message_age_s", [-0.1, math.inf, math.nan])
def test_a_wrong_age_limit_is_named(max_message_age_s: float) -> None:
    with pytest.raises(
        ValueError, match=f"^max_message_age_s = {max_message_age_s}: must be at least 0 and finite"
    ):
        NeighbourTable(OWN_ID, max_message_age_s)


@dataclass(frozen=True)
class Accepted:
    said: Said
    at_s: float
    born_s: float
    swaps: int  # how many swaps there were before


class AgainstHistory(RuleBasedStateMachine):
    """The table against a model that keeps all that it accepted and asks it anew each time.

    Times are multiples of 1/16 s: exact, so that limits are met.
    """

    @initialize(max_message_age_s=st.sampled_from([0.0, 0.5, 1.0, 7.0]))
    def start(self, max_message_age_s: float) -> None:
        self.table = NeighbourTable(OWN_ID, max_message_age_s)
        self.limit_s = max_message_age_s
        self.now_s = 0.0
        self.accepted: list[Accepted] = []
        self.heard: dict[int, tuple[Said, float]] = {}
        self.numbers: dict[int, tuple[int, int]] = {}
        self.cleared = 0
        self.swaps = 0
        self.counts: Counter[str] = Counter()

    @rule(sixteenths=st.sampled_from([1, 4, 8, 16, 40, 80, 81, 112, 113]))
    def wait(self, sixteenths: int) -> None:
        self.now_s += sixteenths / 16

    @rule(
        robot_id=st.integers(0, 3),
        start=st.integers(1, 3),
        sequence=st.integers(0, 6),
        age_sixteenths=st.sampled_from([0, 1, 8, 16, 80, 81, 10**6, None]),
    )
    def receive(self, robot_id: int, start: int, sequence: int, age_sixteenths: int | None) -> None:
        age_s = None if age_sixteenths is None else age_sixteenths / 16
        sent = message(robot_id, sequence, start=start)
        expected: Rejection | None = None
        if robot_id == OWN_ID:
            expected = Rejection.OWN
        elif not self.is_news(sent) and not self.begins_anew(sent):
            expected = Rejection.OUTDATED
        elif self.limit_s > 0 and age_s is None:
            expected = Rejection.AGE_UNKNOWN
        elif self.limit_s > 0 and age_s is not None and age_s >= self.limit_s:
            expected = Rejection.STALE
        else:
            born_s = self.now_s - (age_s or 0.0)
            self.accepted.append(Accepted(sent, self.now_s, born_s, self.swaps))
        if expected not in (Rejection.OWN, Rejection.OUTDATED):
            self.numbers[robot_id] = sent.number
        if robot_id != OWN_ID and self.is_news_as_beacon(sent):
            self.heard[robot_id] = sent, self.now_s
        assert receive(self.table, sent, self.now_s, age_s) is expected
        self.counts["accepted" if expected is None else expected.value] += 1

    def is_news(self, sent: Said) -> bool:
        last = self.numbers.get(sent.beacon.robot_id, (0, 0))
        return self.is_news_as_beacon(sent) and sent.number > last

    def is_news_as_beacon(self, sent: Said) -> bool:
        last = self.heard.get(sent.beacon.robot_id)
        return last is None or sent.number > last[0].number or self.is_silent(sent)

    def begins_anew(self, sent: Said) -> bool:
        last = self.numbers.get(sent.beacon.robot_id)
        return self.is_silent(sent) and last is not None and sent.number[0] != last[0]

    def is_silent(self, sent: Said) -> bool:
        last = self.heard.get(sent.beacon.robot_id)
        return last is not None and self.now_s - last[1] > max(self.limit_s, 5.0)

    def newest(self, since_swap: int) -> dict[int, Accepted]:
        """By robot id: what may be handed out, of all that was accepted since that swap."""
        newest = {
            known.said.beacon.robot_id: known
            for known in self.accepted[self.cleared :]
            if self.limit_s > 0 or known.swaps >= since_swap
        }
        return {
            robot_id: newest[robot_id]
            for robot_id in sorted(newest)
            if self.limit_s == 0 or self.now_s - newest[robot_id].born_s < self.limit_s
        }

    @rule()
    def swap(self) -> None:
        expected = [known.said.message for known in self.newest(self.swaps).values()]
        handed_out = self.table.swap(self.now_s)
        assert len(handed_out) == len(expected)
        assert all(map(lambda one, other: one.message is other, handed_out, expected))
        self.swaps += 1

    @rule()
    def clear(self) -> None:
        self.table.clear()
        self.cleared = len(self.accepted)

    @invariant()
    def neighbours_are_the_newest(self) -> None:
        seen = [
            (known.beacon.robot_id, known.beacon.position_m, self.now_s - known.sent_at_s)
            for known in self.table.neighbours(self.now_s)
        ]
        assert seen == [
            (robot_id, known.said.beacon.position_m, self.now_s - known.born_s)
            for robot_id, known in self.newest(self.swaps - 1).items()
        ]

    @invariant()
    def beacons_are_the_newest(self) -> None:
        assert [
            (heard.beacon, heard.received_at_s) for heard in self.table.beacons(self.now_s, 3.0)
        ] == [
            (sent.beacon, at_s)
            for _, (sent, at_s) in sorted(self.heard.items())
            if self.now_s - at_s <= 3.0
        ]

    @invariant()
    def counts_add_up(self) -> None:
        assert Counter(self.table.counts()) == self.counts


def test_a_number_far_ahead_silences_a_robot_for_five_seconds_only() -> None:
    table = NeighbourTable(OWN_ID)
    receive(table, message(1, 2**32 - 1), now_s=0.0)
    for sequence in range(16):
        receive(table, message(1, sequence), now_s=sequence / 2.5)
    beacons = [heard.beacon for heard in table.beacons(6.0, 1.0)]
    assert beacons == [message(1, 15).beacon]


def test_a_message_in_this_robots_own_name_is_noticed() -> None:
    table = NeighbourTable(OWN_ID)
    assert not table.is_own_id_received(0.0)
    assert receive(table, message(OWN_ID, 1), now_s=10.0) is Rejection.OWN
    assert table.is_own_id_received(13.0) and not table.is_own_id_received(13.1)


def test_a_start_with_an_earlier_clock_is_accepted_after_a_beacon_alone() -> None:
    table = NeighbourTable(OWN_ID)
    assert receive(table, message(1, 9, start=3)) is None
    alone = message(1, 1, start=2)
    assert table.receive(alone.beacon, alone.number, None, 6.0, 0.0) is None
    assert receive(table, message(1, 2, start=2), now_s=6.4) is None


TestAgainstHistory = AgainstHistory.TestCase
TestAgainstHistory.settings = settings(max_examples=300, stateful_step_count=40, deadline=None)


@pytest.fixture
def frequent_thread_switches() -> Iterator[None]:
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval_s)


@pytest.mark.usefixtures("frequent_thread_switches")
@pytest.mark.parametrize("max_message_age_s", [0.8, 0.0])
def test_eight_link_threads_lose_nothing_and_turn_nothing_back(max_message_age_s: float) -> None:
    threads, fleet, last_sequence = 8, 4, 500
    table = NeighbourTable(OWN_ID, max_message_age_s)
    sent = [message(1 + n % fleet, n // fleet) for n in range(fleet * (last_sequence + 1))]

    together = Barrier(threads + 1)

    def link(seed: int) -> list[Rejection | None]:
        # Every link brings everything, roughly in order: repetitions and overtaking without end.
        disorder = random.Random(seed)
        arriving = sorted(sent, key=lambda known: known.number[1] + 8 * disorder.random())
        together.wait()
        return [receive(table, known) for known in arriving]

    swapped: list[list[tuple[int, int]]] = []
    seen: list[list[tuple[int, float]]] = []
    with ThreadPoolExecutor(threads) as pool:
        links = [pool.submit(link, seed) for seed in range(threads)]
        together.wait()
        while not all(done.done() for done in links):
            swapped.append(sequences(table.swap(0.1)))
            seen.append(
                [
                    (beacon.robot_id, beacon.position_m[1])
                    for heard in table.beacons(0.1, 1.0)
                    if (beacon := heard.beacon).position_m
                ]
            )
        swapped.append(sequences(table.swap(0.1)))
    results = Counter(result for done in links for result in done.result())

    counts = table.counts()
    assert counts["accepted"] == results[None]
    assert counts["outdated"] == results[Rejection.OUTDATED]
    assert results[None] + results[Rejection.OUTDATED] == threads * len(sent)
    for robot_id in range(1, fleet + 1):
        handed_out = [dict(tick)[robot_id] for tick in swapped if robot_id in dict(tick)]
        positions = [dict(look)[robot_id] for look in seen if robot_id in dict(look)]
        assert handed_out[-1] == last_sequence
        assert positions == sorted(positions)
        once = max_message_age_s == 0.0
        assert all(
            one < other if once else one <= other for one, other in itertools.pairwise(handed_out)
        )
