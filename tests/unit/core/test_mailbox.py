"""Mailbox: only the newest of each neighbour, only while it is fresh, whoever writes meanwhile."""

import itertools
import math
import random
import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from threading import Barrier

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from edge.core.aggregation import AggregatedMessage
from edge.core.arrivals import Arrivals
from edge.core.mailbox import Mailbox
from edge.core.wire import Rejection

OWN_ID = 0


def message(robot_id: int, sequence: int, *, boot_epoch: int = 10) -> AggregatedMessage:
    payload = np.array([sequence], np.float32)
    position_m = (float(robot_id), float(sequence), 0.0)
    return AggregatedMessage(
        robot_id, boot_epoch, sequence, None, position_m, (0.5, 0.0, -0.5), 7, payload
    )


def receive(
    mailbox: Mailbox, received: AggregatedMessage, now_s: float = 0.0, age_s: float | None = 0.0
) -> Rejection | None:
    return mailbox.receive(received, now_s, age_s)


def orders(messages: tuple[AggregatedMessage, ...]) -> list[tuple[int, int, int]]:
    return [(known.robot_id, known.boot_epoch, known.sequence) for known in messages]


def ages(mailbox: Mailbox, now_s: float) -> dict[int, float]:
    return {known.robot_id: known.age_s for known in mailbox.neighbours(now_s)}


def test_it_counts_what_it_accepts_of_each() -> None:
    mailbox = Mailbox(OWN_ID)
    for robot_id, sequence in ((7, 1), (2, 5), (2, 6), (2, 6), (OWN_ID, 1)):
        receive(mailbox, message(robot_id, sequence))
    assert mailbox.accepted() == {7: 1, 2: 2}
    mailbox.clear()
    assert mailbox.accepted() == {7: 1, 2: 2}


def test_what_comes_late_or_overtaken_has_arrived_and_what_does_not_come_is_missed() -> None:
    mailbox = Mailbox(OWN_ID)
    assert mailbox.arrivals() == {}
    received = ((1, 0.01), (2, 0.3), (4, 0.9), (3, 2.0), (4, 0.9), (7, None), (8, 0.01))
    said = [receive(mailbox, message(1, sequence), age_s=age_s) for sequence, age_s in received]
    # The fourth overtook the third, both too old for the policy; 5 and 6 never came.
    assert said[2:5] == [Rejection.STALE] * 3
    assert said[5] is Rejection.AGE_UNKNOWN
    receive(mailbox, message(OWN_ID, 1))
    assert mailbox.arrivals() == {1: Arrivals(8, 1, (2, 0, 0, 0, 1, 0, 1, 1, 0))}
    mailbox.clear()
    assert mailbox.arrivals()[1].sent == 8


def test_a_sender_that_starts_again_goes_on_in_the_counts() -> None:
    mailbox = Mailbox(OWN_ID)
    receive(mailbox, message(1, 900))
    receive(mailbox, message(1, 901))
    receive(mailbox, message(1, 1, boot_epoch=11))
    receive(mailbox, message(1, 902))
    receive(mailbox, message(1, 3, boot_epoch=11))
    assert mailbox.arrivals()[1].sent == 5
    assert mailbox.arrivals()[1].arrived == 4


def test_the_newest_of_each_by_robot_id() -> None:
    mailbox = Mailbox(OWN_ID)
    for robot_id, sequence in ((7, 1), (2, 5), (300, 1), (2, 6), (1, 9)):
        assert receive(mailbox, message(robot_id, sequence)) is None
    assert orders(mailbox.swap(0.1)) == [(1, 10, 9), (2, 10, 6), (7, 10, 1), (300, 10, 1)]
    assert [known.robot_id for known in mailbox.neighbours(0.1)] == [1, 2, 7, 300]
    assert mailbox.neighbours(0.1)[1].position_m == (2.0, 6.0, 0.0)


@settings(deadline=None)
@given(st.permutations(range(6)))
def test_arrival_order_between_robots_is_no_matter(order: list[int]) -> None:
    mailbox = Mailbox(OWN_ID)
    for index in order:
        receive(mailbox, message(index + 1, 1))
    assert [known.robot_id for known in mailbox.swap(0.0)] == [1, 2, 3, 4, 5, 6]


def test_own_repeated_and_overtaken_messages_are_dropped() -> None:
    mailbox = Mailbox(OWN_ID)
    assert receive(mailbox, message(OWN_ID, 1)) is Rejection.OWN
    assert receive(mailbox, message(1, 4)) is None
    assert receive(mailbox, message(1, 4)) is Rejection.OUTDATED
    assert receive(mailbox, message(1, 3)) is Rejection.OUTDATED
    assert orders(mailbox.swap(0.0)) == [(1, 10, 4)]


def test_a_restarted_robot_is_heard_at_once() -> None:
    mailbox = Mailbox(OWN_ID)
    receive(mailbox, message(1, 900, boot_epoch=10))
    assert receive(mailbox, message(1, 0, boot_epoch=11)) is None
    assert receive(mailbox, message(1, 901, boot_epoch=10)) is Rejection.OUTDATED
    assert orders(mailbox.swap(0.0)) == [(1, 11, 0)]


def test_a_smaller_boot_epoch_is_heard_once_its_robot_was_silent() -> None:
    mailbox = Mailbox(OWN_ID)
    receive(mailbox, message(1, 900, boot_epoch=10), now_s=0.0)
    # As late as a message of an earlier start can be.
    assert receive(mailbox, message(1, 0, boot_epoch=3), now_s=5.0) is Rejection.OUTDATED
    # What was refused does not count as hearing from it.
    assert receive(mailbox, message(1, 1, boot_epoch=3), now_s=5.01) is None
    assert receive(mailbox, message(1, 0, boot_epoch=3), now_s=5.02) is Rejection.OUTDATED
    assert orders(mailbox.swap(5.1)) == [(1, 3, 1)]


def test_a_smaller_boot_epoch_waits_for_the_age_limit_if_that_is_longer() -> None:
    mailbox = Mailbox(OWN_ID, max_message_age_s=20.0)
    receive(mailbox, message(1, 900, boot_epoch=10), now_s=0.0)
    assert receive(mailbox, message(1, 0, boot_epoch=3), now_s=20.0) is Rejection.OUTDATED
    assert receive(mailbox, message(1, 0, boot_epoch=3), now_s=20.1) is None


@pytest.mark.parametrize("max_message_age_s", [0.8, 0.0])
def test_a_late_duplicate_is_never_accepted_again(max_message_age_s: float) -> None:
    mailbox = Mailbox(OWN_ID, max_message_age_s)
    receive(mailbox, message(1, 5))
    for _ in range(3):
        mailbox.swap(100.0)
    assert mailbox.neighbours(100.0) == ()
    assert receive(mailbox, message(1, 5), now_s=100.0) is Rejection.OUTDATED
    mailbox.clear()
    assert receive(mailbox, message(1, 5), now_s=1000.0) is Rejection.OUTDATED
    assert receive(mailbox, message(1, 6), now_s=1000.0) is None


def test_a_message_is_handed_out_until_it_is_too_old() -> None:
    mailbox = Mailbox(OWN_ID, max_message_age_s=0.8)
    receive(mailbox, message(1, 1), now_s=10.0)
    for now_s in (10.0, 10.4, 10.75):
        assert orders(mailbox.swap(now_s)) == [(1, 10, 1)]
        assert ages(mailbox, now_s) == {1: pytest.approx(now_s - 10.0)}
    assert mailbox.swap(10.85) == ()
    assert mailbox.neighbours(10.85) == ()


def test_age_counts_from_sending() -> None:
    mailbox = Mailbox(OWN_ID, max_message_age_s=0.8)
    assert receive(mailbox, message(1, 1), now_s=10.0, age_s=0.5) is None
    assert ages(mailbox, 10.0) == {1: pytest.approx(0.5)}
    assert len(mailbox.swap(10.25)) == 1
    assert mailbox.swap(10.35) == ()


def test_a_message_that_arrives_too_old_or_of_unknown_age_is_not_kept() -> None:
    mailbox = Mailbox(OWN_ID, max_message_age_s=0.8)
    assert receive(mailbox, message(1, 1), 8.0) is None
    assert receive(mailbox, message(1, 3), 10.0, age_s=1.6) is Rejection.STALE
    assert receive(mailbox, message(1, 4), 10.0, age_s=None) is Rejection.AGE_UNKNOWN
    assert mailbox.swap(10.0) == ()
    # They were not taken for the newest either.
    assert receive(mailbox, message(1, 2), 10.0, age_s=0.1) is None


def test_the_papers_rule_hands_each_message_out_once() -> None:
    mailbox = Mailbox(OWN_ID, max_message_age_s=0.0)
    receive(mailbox, message(1, 1), now_s=0.0)
    receive(mailbox, message(2, 1), now_s=0.0)
    assert list(ages(mailbox, 0.0)) == [1, 2]
    assert orders(mailbox.swap(0.4)) == [(1, 10, 1), (2, 10, 1)]
    assert ages(mailbox, 0.5) == {1: 0.5, 2: 0.5}
    receive(mailbox, message(1, 2), now_s=0.6)
    assert ages(mailbox, 0.6) == pytest.approx({1: 0.0, 2: 0.6}, abs=1e-6)
    assert orders(mailbox.swap(0.8)) == [(1, 10, 2)]
    assert list(ages(mailbox, 0.8)) == [1]
    assert mailbox.swap(1.2) == ()
    assert mailbox.neighbours(1.2) == ()


@pytest.mark.parametrize("max_message_age_s", [0.8, 0.0])
def test_a_new_mission_starts_without_neighbours(max_message_age_s: float) -> None:
    mailbox = Mailbox(OWN_ID, max_message_age_s)
    receive(mailbox, message(1, 1))
    mailbox.swap(0.0)
    receive(mailbox, message(2, 1))
    mailbox.clear()
    assert mailbox.neighbours(0.0) == ()
    assert mailbox.swap(0.0) == ()


def test_the_papers_rule_knows_no_age() -> None:
    mailbox = Mailbox(OWN_ID, max_message_age_s=0.0)
    assert receive(mailbox, message(1, 1), age_s=None) is None
    assert len(mailbox.swap(100.0)) == 1


def test_every_message_is_counted() -> None:
    mailbox = Mailbox(OWN_ID)
    assert mailbox.counts() == {"accepted": 0} | dict.fromkeys(map(str, Rejection), 0)
    for sequence in (1, 2, 2):
        receive(mailbox, message(1, sequence))
    receive(mailbox, message(2, 1))
    receive(mailbox, message(2, 2), age_s=3.0)
    receive(mailbox, message(OWN_ID, 1))
    mailbox.reject(Rejection.CHECKSUM)
    mailbox.clear()
    counted = {reason: count for reason, count in mailbox.counts().items() if count}
    assert counted == {"accepted": 3, "outdated": 1, "stale": 1, "own": 1, "checksum": 1}
    assert mailbox.swap(0.0) == ()


def test_what_is_handed_out_does_not_change() -> None:
    mailbox = Mailbox(OWN_ID)
    receive(mailbox, message(1, 1))
    handed_out, neighbours, counts = mailbox.swap(0.0), mailbox.neighbours(0.0), mailbox.counts()
    receive(mailbox, message(1, 2))
    mailbox.clear()
    assert orders(handed_out) == [(1, 10, 1)]
    assert neighbours[0].position_m == (1.0, 1.0, 0.0)
    assert counts["accepted"] == 1
    with pytest.raises(AttributeError):
        neighbours[0].age_s = 1.0  # type: ignore[misc]


@pytest.mark.parametrize("max_message_age_s", [-0.1, math.inf, math.nan])
def test_a_wrong_age_limit_is_named(max_message_age_s: float) -> None:
    with pytest.raises(
        ValueError, match=f"^max_message_age_s = {max_message_age_s}: must be at least 0 and finite"
    ):
        Mailbox(OWN_ID, max_message_age_s)


@dataclass(frozen=True)
class Accepted:
    message: AggregatedMessage
    at_s: float
    born_s: float
    swaps: int  # how many swaps there were before


class AgainstHistory(RuleBasedStateMachine):
    """The mailbox against a model that keeps all that it accepted and asks it anew each time.

    Times are multiples of 1/16 s: exact, so that limits are met.
    """

    @initialize(max_message_age_s=st.sampled_from([0.0, 0.5, 1.0, 7.0]))
    def start(self, max_message_age_s: float) -> None:
        self.mailbox = Mailbox(OWN_ID, max_message_age_s)
        self.limit_s = max_message_age_s
        self.now_s = 0.0
        self.accepted: list[Accepted] = []
        self.cleared = 0
        self.swaps = 0
        self.counts: Counter[str] = Counter()

    @rule(sixteenths=st.sampled_from([1, 4, 8, 16, 40, 80, 81, 112, 113]))
    def wait(self, sixteenths: int) -> None:
        self.now_s += sixteenths / 16

    @rule(
        robot_id=st.integers(0, 3),
        boot_epoch=st.integers(1, 3),
        sequence=st.integers(0, 6),
        age_sixteenths=st.sampled_from([0, 1, 8, 16, 80, 81, 10**6, None]),
    )
    def receive(
        self, robot_id: int, boot_epoch: int, sequence: int, age_sixteenths: int | None
    ) -> None:
        age_s = None if age_sixteenths is None else age_sixteenths / 16
        sent = message(robot_id, sequence, boot_epoch=boot_epoch)
        before = [known for known in self.accepted if known.message.robot_id == robot_id]
        expected: Rejection | None = None
        if robot_id == OWN_ID:
            expected = Rejection.OWN
        elif before and not self.is_news(sent, before[-1]):
            expected = Rejection.OUTDATED
        elif self.limit_s > 0 and age_s is None:
            expected = Rejection.AGE_UNKNOWN
        elif self.limit_s > 0 and age_s is not None and age_s >= self.limit_s:
            expected = Rejection.STALE
        else:
            born_s = self.now_s - (age_s or 0.0)
            self.accepted.append(Accepted(sent, self.now_s, born_s, self.swaps))
        assert receive(self.mailbox, sent, self.now_s, age_s) is expected
        self.counts["accepted" if expected is None else expected.value] += 1

    def is_news(self, sent: AggregatedMessage, last: Accepted) -> bool:
        if sent.boot_epoch == last.message.boot_epoch:
            return sent.sequence > last.message.sequence
        return sent.boot_epoch > last.message.boot_epoch or self.silent(last)

    def silent(self, last: Accepted) -> bool:
        return self.now_s - last.at_s > max(self.limit_s, 5.0)

    def newest(self, since_swap: int) -> dict[int, Accepted]:
        """By robot id: what may be handed out, of all that was accepted since that swap."""
        newest = {
            known.message.robot_id: known
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
        expected = [known.message for known in self.newest(self.swaps).values()]
        handed_out = self.mailbox.swap(self.now_s)
        assert len(handed_out) == len(expected)
        assert all(map(lambda one, other: one is other, handed_out, expected))
        self.swaps += 1

    @rule()
    def clear(self) -> None:
        self.mailbox.clear()
        self.cleared = len(self.accepted)

    @invariant()
    def neighbours_are_the_newest(self) -> None:
        seen = [
            (known.robot_id, known.position_m, known.age_s)
            for known in self.mailbox.neighbours(self.now_s)
        ]
        assert seen == [
            (robot_id, known.message.position_m, self.now_s - known.born_s)
            for robot_id, known in self.newest(self.swaps - 1).items()
        ]

    @invariant()
    def counts_add_up(self) -> None:
        assert Counter(self.mailbox.counts()) == self.counts


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
    threads, robots, last_sequence = 8, 4, 500
    mailbox = Mailbox(OWN_ID, max_message_age_s)
    sent = [message(1 + n % robots, n // robots) for n in range(robots * (last_sequence + 1))]

    together = Barrier(threads + 1)

    def link(seed: int) -> list[Rejection | None]:
        # Every link brings everything, roughly in order: repetitions and overtaking without end.
        disorder = random.Random(seed)
        arriving = sorted(sent, key=lambda known: known.sequence + 8 * disorder.random())
        together.wait()
        return [receive(mailbox, known) for known in arriving]

    swapped: list[list[tuple[int, int]]] = []
    seen: list[list[tuple[int, float]]] = []
    with ThreadPoolExecutor(threads) as pool:
        links = [pool.submit(link, seed) for seed in range(threads)]
        together.wait()
        while not all(done.done() for done in links):
            swapped.append([(known.robot_id, known.sequence) for known in mailbox.swap(0.1)])
            seen.append(
                [(known.robot_id, known.position_m[1]) for known in mailbox.neighbours(0.1)]
            )
        swapped.append([(known.robot_id, known.sequence) for known in mailbox.swap(0.1)])
    results = Counter(result for done in links for result in done.result())

    counts = mailbox.counts()
    assert counts["accepted"] == results[None]
    assert counts["outdated"] == results[Rejection.OUTDATED]
    assert results[None] + results[Rejection.OUTDATED] == threads * len(sent)
    for robot_id in range(1, robots + 1):
        handed_out = [dict(tick)[robot_id] for tick in swapped if robot_id in dict(tick)]
        positions = [dict(look)[robot_id] for look in seen if robot_id in dict(look)]
        assert handed_out[-1] == last_sequence
        assert positions == sorted(positions)
        once = max_message_age_s == 0.0
        assert all(
            one < other if once else one <= other for one, other in itertools.pairwise(handed_out)
        )
