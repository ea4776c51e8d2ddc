"""Quality of links, and blame."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.arrivals import Arrivals
from edge.messages.mission import RadioCounts, RobotStatus
from lpac.radio.pairs import Blame, Link, Pair, Window, blame, pairs
from tests.unit.ground import snapshots

HZ, SECONDS = 2.5, 20.0
NONE = Arrivals()
SENT = round(HZ * SECONDS)


def said(robot: int, heard: dict[int, Arrivals], *, after_s: float = 0.0) -> RobotStatus:
    """Status of a robot after a time, with counts of its own and received messages."""
    sent = round(HZ * after_s)
    return snapshots.on_ground(
        robot,
        uptime_s=100.0 + after_s,
        radio_counts=RadioCounts(
            500 + sent, (500 + sent) * 1800, {str(r): each.counts for r, each in heard.items()}
        ),
    )


def two(before: Arrivals, after: Arrivals) -> Pair:
    """Reception of r0's messages by r1."""
    windows = {
        "r0": Window(said(0, {}), said(0, {}, after_s=SECONDS)),
        "r1": Window(said(1, {0: before}), said(1, {0: after}, after_s=SECONDS)),
    }
    by_link = {(pair.sender, pair.receiver): pair for pair in pairs(windows)}
    assert by_link.keys() == {("r0", "r1"), ("r1", "r0")}
    return by_link["r0", "r1"]


def came(sent: int, *ages_s: float, since: Arrivals = NONE) -> Arrivals:
    for n, age_s in enumerate(ages_s):
        since = since.plus(sent if n == 0 else 0, age_s)
    return since


def test_all_that_came() -> None:
    before = came(500, *[0.04] * 500)
    pair = two(before, came(SENT, *[0.04] * (SENT - 3), 0.3, 0.9, 2.0, since=before))
    assert (pair.sent, pair.received, pair.late) == (SENT, SENT, 2)
    assert pair.delivered == 1.0
    assert pair.late_share == pytest.approx(2 / SENT)
    assert pair.in_time == pytest.approx(1.0 - 2 / SENT)
    assert pair.age_p50_s is not None and 0.025 <= pair.age_p50_s <= 0.05
    assert pair.age_p99_s is not None and 1.6 <= pair.age_p99_s <= 3.2


def test_what_is_missing_between_what_came() -> None:
    pair = two(came(7, 0.1), came(SENT, *[0.1] * 31, since=came(7, 0.1)))
    assert pair.delivered == pytest.approx(31 / SENT)


def test_of_a_robot_that_is_not_heard_at_all_the_sender_tells() -> None:
    pair = two(Arrivals(), Arrivals())
    assert SENT - 4 <= pair.sent <= SENT
    assert (pair.received, pair.delivered, pair.late_share, pair.age_p99_s) == (0, 0.0, 0.0, None)


def test_what_was_lost_long_before_does_not_count() -> None:
    before = came(500, *[0.04] * 500)
    # The first arrivals after a gap of minutes.
    pair = two(before, came(300, *[0.04] * SENT, since=before))
    assert pair.sent <= SENT + 4
    assert pair.delivered >= 0.9


def test_who_says_nothing_cannot_be_heard() -> None:
    silent = said(0, {})
    windows = {
        "r0": Window(silent, replace(silent, uptime_s=silent.uptime_s + SECONDS)),
        "r1": Window(said(1, {}), said(1, {}, after_s=SECONDS)),
    }
    assert pairs(windows) == (Pair("r1", "r0", SENT - 4, 0, 0, None, None),)


def test_a_window_tells_rate_and_size() -> None:
    window = Window(said(0, {}), said(0, {}, after_s=SECONDS))
    assert (window.rate_hz, window.bytes_sent / window.sent) == (HZ, 1800.0)
    assert Window(window.last, window.last).rate_hz == 0.0


@given(st.integers(0, 400), st.lists(st.floats(0.0, 5.0), max_size=400), st.integers(0, 300))
def test_shares_are_shares(sent: int, ages_s: list[float], before: int) -> None:
    begun = came(before, *[0.1] * before)
    pair = two(begun, came(sent, *ages_s, since=begun))
    assert 0 <= pair.late <= pair.received <= pair.sent
    assert 0.0 <= pair.in_time <= pair.delivered <= 1.0


# Blame

NAMES = [f"r{i}" for i in range(6)]
ALL = [(a, b) for a in NAMES for b in NAMES if a != b]


def links(*bad: Link) -> dict[Link, bool]:
    return {link: link not in bad for link in ALL}


def from_(name: str) -> list[Link]:
    return [link for link in ALL if link[0] == name]


def to(name: str) -> list[Link]:
    return [link for link in ALL if link[1] == name]


def test_who_is_to_blame() -> None:
    assert blame(links()) == Blame((), (), ())
    assert blame(links(("r1", "r2"))) == Blame((), (), (("r1", "r2"),))
    assert blame(links(*to("r3"))) == Blame(("r3",), (), ())
    assert blame(links(*from_("r3"))) == Blame((), ("r3",), ())
    assert blame(links(*to("r3"), *from_("r3"))) == Blame(("r3",), ("r3",), ())
    assert blame(links(*to("r3"), *from_("r4"), ("r1", "r2"))) == Blame(
        ("r3",), ("r4",), (("r1", "r2"),)
    )
    # All links are bad: each robot is named once.
    assert blame(links(*ALL)) == Blame(tuple(NAMES), (), ())
    assert blame({("r0", "r1"): False, ("r1", "r0"): False}) == Blame(
        (), (), (("r0", "r1"), ("r1", "r0"))
    )


def test_who_hears_only_two_that_nobody_hears_is_not_deaf() -> None:
    is_good = links(*from_("r4"), *from_("r5"))
    for name in ("r1", "r2", "r3"):
        del is_good[name, "r0"]
    assert blame(is_good) == Blame((), ("r4", "r5"), ())


@given(st.dictionaries(st.sampled_from(ALL), st.booleans()))
def test_each_bad_link_is_told_and_no_good_one(is_good: dict[Link, bool]) -> None:
    told = blame(is_good)
    for (sender, receiver), good in is_good.items():
        named = (
            (sender, receiver) in told.links or receiver in told.receivers or sender in told.senders
        )
        assert named is not good
