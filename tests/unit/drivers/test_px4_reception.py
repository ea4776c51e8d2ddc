"""Which frames are taken of those that come twice, late, out of order or not at all."""

import heapq
import itertools
import math
import random
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from edge.drivers.px4.reception import Frame, VehicleFrames

POSITION, HEARTBEAT, STATE, OTHERS = 32, 0, 245, 105
RATES_HZ = {POSITION: 20.0, HEARTBEAT: 1.0, STATE: 5.0, OTHERS: 60.0}


class Arrival(NamedTuple):
    at_s: float
    order: int
    frame: Frame
    sent_s: float


def stream(
    path: str, begin_s: float, end_s: float, *,
    boot_s: float = 0.0, name: str = "a", first: int = 0, others_hz: float = RATES_HZ[OTHERS],
) -> Iterator[Arrival]:  # fmt: skip
    """Yield a vehicle's messages; heartbeats and states never change their content."""
    rates_hz = {**RATES_HZ, OTHERS: others_hz}
    due = [(begin_s + 0.001 * kind, kind) for kind in rates_hz]
    heapq.heapify(due)
    number = first
    while due[0][0] < end_s:
        at_s, kind = heapq.heappop(due)
        heapq.heappush(due, (at_s + 1.0 / rates_hz[kind], kind))
        vehicle_s = at_s - boot_s if kind == POSITION else None
        said = vehicle_s if kind in (POSITION, OTHERS) else "as ever"
        said = at_s if kind == OTHERS else said
        content = (name, kind, number % 256, said)
        yield Arrival(at_s, number, Frame(path, number % 256, content, kind, vehicle_s), at_s)
        number += 1


def heard(frames: VehicleFrames, arrivals: Iterable[Arrival]) -> list[Arrival]:
    """Those that are taken."""
    return [a for a in sorted(arrivals, key=lambda a: a[:2]) if frames.accept(a.frame, a.at_s)]


def later(arrivals: Iterable[Arrival], by_s: float, path: str | None = None) -> Iterator[Arrival]:
    for a in arrivals:
        frame = a.frame if path is None else structs.replace(a.frame, path=path)
        yield a._replace(at_s=a.at_s + by_s, frame=frame)


def is_in_order(taken: list[Arrival]) -> bool:
    return all(a.sent_s <= b.sent_s for a, b in itertools.pairwise(taken))


def test_a_good_link() -> None:
    frames, said = VehicleFrames(), list(stream("a", 0.0, 30.0))
    assert heard(frames, said) == said
    assert frames.lost(30.0) == 0.0
    assert not frames.has_duplicates(30.0) and not frames.has_twin(30.0)


def merged(first: int) -> list[Arrival]:
    """Two MAVLink channels of one vehicle, 150 and 60 frames a second, on one path."""
    return [
        *stream("a", 0.0, 60.0, name="1", others_hz=124.0),
        *stream("a", 0.0, 60.0, name="2", others_hz=34.0, first=first),
    ]


@pytest.mark.parametrize("first", [70, 100, 180])
def test_merged_channels_of_one_vehicle_are_all_taken(first: int) -> None:
    frames, said = VehicleFrames(), merged(first)
    assert len(heard(frames, said)) == len(said)
    assert all(frames.lost(float(now_s)) == 0.0 for now_s in range(60))
    assert not frames.has_duplicates(60.0) and not frames.has_twin(60.0)


@pytest.mark.parametrize("first", [70, 100, 180])
def test_what_merged_channels_lose_is_counted(first: int) -> None:
    draw = random.Random(4)
    frames = VehicleFrames()
    arrived = [a for a in merged(first) if draw.random() >= 0.2]
    assert len(heard(frames, arrived)) > 0.9 * len(arrived)
    assert frames.lost(60.0) == pytest.approx(0.2, abs=0.051)
    assert not frames.has_duplicates(60.0) and not frames.has_twin(60.0)


@pytest.mark.parametrize("by_s", [0.0, 0.08, 1.0])
def test_merged_channels_that_come_twice_are_taken_once(by_s: float) -> None:
    frames, said = VehicleFrames(), merged(100)
    taken = heard(frames, [*said, *later(said, by_s)])
    assert len(taken) == len({(a.order, a.frame.content) for a in taken})
    assert frames.has_duplicates(60.0) and not frames.has_twin(60.0)


def test_a_copy_older_than_what_is_remembered_is_not_taken_for_another_channel() -> None:
    frames, said = VehicleFrames(), list(stream("a", 0.0, 60.0))
    taken = heard(frames, [*said, *later(said, 4.0)])
    assert len(taken) - len(said) < 0.005 * len(said)


def test_what_is_remembered_is_bounded() -> None:
    frames, most = VehicleFrames(), 0
    for n in range(200 * 256):
        # The numbers come round each second: the heartbeat is the same, byte for byte.
        content = "heartbeat" if n % 256 == 0 else n
        assert frames.accept(Frame("a", n % 256, content, HEARTBEAT), n / 256.0)
        most = max(most, len(frames._accepted))
    assert most <= 4 * 256


@pytest.mark.parametrize("share", [0.05, 0.1, 0.2, 0.3])
def test_what_is_lost_is_counted(share: float) -> None:
    draw = random.Random(1)
    frames = VehicleFrames()
    arrived = [a for a in stream("a", 0.0, 60.0) if draw.random() >= share]
    taken = heard(frames, arrived)
    # A message that says what one said before, with the same number, may pass for that.
    assert len(taken) > 0.97 * len(arrived)
    assert frames.lost(60.0) == pytest.approx(share, abs=0.051)
    assert not frames.has_duplicates(60.0) and not frames.has_twin(60.0)


@pytest.mark.parametrize("by_s", [0.0, 0.005, 0.08, 0.5, 2.0])
@pytest.mark.parametrize("path", [None, "b"])
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_what_comes_twice_is_taken_once(by_s: float, path: str | None, loss: float) -> None:
    draw = random.Random(2)
    frames, said = VehicleFrames(), list(stream("a", 0.0, 30.0))
    first = [a for a in said if draw.random() >= loss]
    taken = heard(frames, [*first, *later(said, by_s, path)])
    again = len(taken) - len({a.order for a in taken})
    assert again <= (0.01 * len(taken) if path is None and loss else 0)
    assert frames.has_duplicates(30.0)
    assert not frames.has_twin(30.0)
    positions = [a for a in taken if a.frame.message_id == POSITION]
    assert len(positions) >= 0.9 * (1.0 - loss) * 20.0 * 30.0
    assert is_in_order(positions)
    # What tells the mode, and has no time, is not much older than what was taken before.
    stale_s = [a.at_s - a.sent_s for a in taken if a.frame.message_id == HEARTBEAT]
    late = sum(age_s > 0.6 for age_s in stale_s)
    assert late <= (1 if path is None and loss else 0)
    assert len(stale_s) >= 0.6 * 30.0 * (1.0 - loss)


def test_by_the_faster_of_two_paths() -> None:
    frames, said = VehicleFrames(), list(stream("a", 0.0, 20.0))
    taken = heard(frames, [*later(said, 1.5, "slow"), *said])
    assert [a.frame.path for a in taken] == ["a"] * len(said)
    assert frames.path == "a"


def test_when_one_path_ends_the_other_takes_over() -> None:
    frames, said = VehicleFrames(), list(stream("a", 0.0, 20.0))
    taken = heard(frames, [*said[: len(said) // 2], *later(said, 0.1, "b")])
    assert is_in_order([a for a in taken if a.frame.message_id == POSITION])
    assert taken[-1] in list(later(said, 0.1, "b"))
    assert frames.path == "b"


def test_what_was_overtaken_is_lost() -> None:
    draw = random.Random(3)
    frames, said = VehicleFrames(), list(stream("a", 0.0, 30.0))
    arrived = [a._replace(at_s=a.at_s + (0.1 if draw.random() < 0.1 else 0.0)) for a in said]
    taken = heard(frames, arrived)
    assert is_in_order([a for a in taken if a.frame.message_id == POSITION])
    assert is_in_order([a for a in taken if a.frame.message_id != POSITION])
    assert len(taken) > 0.85 * len(said)
    assert not frames.has_twin(30.0) and not frames.has_duplicates(30.0)


@pytest.mark.parametrize("silent_s", [1.5, 4.0, 20.0])
@pytest.mark.parametrize("first", [0, 40, 200])
def test_a_vehicle_that_is_switched_on_anew_is_heard(silent_s: float, first: int) -> None:
    frames = VehicleFrames()
    heard(frames, stream("a", 100.0, 130.0, first=5))
    again_s = 130.0 + silent_s
    said = list(stream("a", again_s, again_s + 20.0, boot_s=again_s - 1.0, name="b", first=first))
    taken = heard(frames, said)
    assert len(taken) > 0.97 * len(said)
    assert not frames.has_twin(again_s + 20.0)


def test_another_vehicle_in_its_place_is_heard_after_a_while() -> None:
    frames = VehicleFrames()
    heard(frames, stream("a", 100.0, 130.0))
    said = list(stream("a", 140.0, 160.0, boot_s=90.0, name="b"))
    assert len(heard(frames, said)) > 0.97 * len(said)


# Not two on one path that started at the same time: only their hardware ids tell them apart.
@pytest.mark.parametrize(
    ("path", "boot_s"),
    [*itertools.product("ab", (-3.0, 0.4, 50.0)), ("b", 0.0)],
)
@pytest.mark.parametrize("first", [3, 100, 200])
def test_two_vehicles_with_one_system_id(boot_s: float, path: str, first: int) -> None:
    frames = VehicleFrames()
    other = stream(path, 50.0, 80.0, boot_s=boot_s, name="b", first=first)
    heard(frames, [*stream("a", 50.0, 80.0), *other])
    assert frames.has_twin(80.0)


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["a", "b"]), st.integers(0, 255), st.integers(0, 40),
            st.sampled_from([POSITION, HEARTBEAT]), st.floats(0.0, 1e6), st.floats(0.0, 0.3),
        ),
        max_size=60,
    )
)  # fmt: skip
def test_nothing_that_comes_breaks_it(
    frames_said: list[tuple[str, int, int, int, float, float]],
) -> None:
    frames, now_s = VehicleFrames(), 0.0
    for path, number, content, kind, vehicle_s, after_s in frames_said:
        now_s += after_s
        told = vehicle_s if kind == POSITION else None
        frames.accept(Frame(path, number, content, kind, told), now_s)
        assert 0.0 <= frames.lost(now_s) <= 1.0
        assert math.isfinite(frames.lost(now_s))
        frames.has_twin(now_s), frames.has_duplicates(now_s)
