"""Airtime: what a fleet's messages take of a channel, and what becomes of them."""

import math
import random
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from edge.core.memory import EXPLORED_CELLS
from edge.core.wire import PayloadType, deflate
from edge.identity.envelope import OVERHEAD_BYTES
from edge.messages.bounds import MOST_ROBOTS
from edge.messages.codec import encode
from edge.messages.mission import Echo, GroundState, RadioCounts, explored_to_bytes
from edge.messages.topics import EXPLORED, MESSAGE, STATE, STATUS
from lpac.radio.airtime import (
    EXPLORED_BYTES,
    MESSAGE_BYTES,
    TRANSPORTS,
    Traffic,
    Transport,
    Wifi,
    airtime,
    capacity,
    link_quality,
    state_bytes,
    status_bytes,
)
from tests.conftest import ROOT
from tests.unit.ground import snapshots

WIFI = Wifi(data_rate_mbit_s=220.0)
LOSSLESS = replace(WIFI, frame_loss=0.0)
TEN = Traffic(robots=10)
EACH = pytest.mark.parametrize("transport", TRANSPORTS)
INT8 = MESSAGE_BYTES["int8"]

wifis = st.builds(
    Wifi,
    data_rate_mbit_s=st.floats(6.0, 1200.0),
    multicast_rate_mbit_s=st.floats(1.0, 54.0),
    frame_loss=st.floats(0.0, 0.5),
    queue_s=st.floats(0.0, 1.0),
    ground_wired=st.booleans(),
)
traffics = st.builds(
    Traffic,
    robots=st.integers(1, 1000),
    message_bytes=st.floats(100.0, 20_000.0),
    message_hz=st.floats(0.0, 20.0),
    status_hz=st.floats(0.0, 4.0),
)
transports = st.sampled_from(TRANSPORTS)


def total(transport: Transport, wifi: Wifi = WIFI, traffic: Traffic = TEN) -> float:
    return airtime(transport, wifi, traffic).total


# One message, by hand. Next to nobody else wants the channel, so that a station waits for 7.5 of
# the slots 0 to 15.
DIFS_US, BACKOFF_US, SIFS_US, ACK_US = 34.0, 7.5 * 9.0, 16.0, 32.0
PREAMBLE_US, OLD_PREAMBLE_US, MAC_BYTES = 40.0, 20.0, 54


def unicast_us(packet_bytes: float, rate_mbit_s: float) -> float:
    data_us = 8.0 * (packet_bytes + MAC_BYTES) / rate_mbit_s
    return DIFS_US + BACKOFF_US + PREAMBLE_US + data_us + SIFS_US + ACK_US


def group_us(packet_bytes: float, rate_mbit_s: float) -> float:
    return DIFS_US + BACKOFF_US + OLD_PREAMBLE_US + 8.0 * (packet_bytes + MAC_BYTES) / rate_mbit_s


def test_one_datagram_goes_up_once_and_down_once() -> None:
    packet_bytes = 1000 + 52 + 8 + 20  # seal and fragment, UDP, IP
    expected_us = unicast_us(packet_bytes, 220.0) + group_us(packet_bytes, 6.0)
    found = airtime("multicast", LOSSLESS, Traffic(robots=2, message_bytes=1000.0))
    assert 1e6 * found.message_s == pytest.approx(expected_us, rel=2e-3)


def test_the_channel_is_busy_while_somebody_sends() -> None:
    one = LOSSLESS, Traffic(robots=2, message_bytes=1000.0, status_hz=0.0, message_hz=1e-9)
    often = LOSSLESS, Traffic(robots=2, message_bytes=1000.0, status_hz=0.0, message_hz=0.1)
    sent_us = (
        PREAMBLE_US + 8.0 * (1080 + MAC_BYTES) / 220.0 + ACK_US
        + OLD_PREAMBLE_US + 8.0 * (1080 + MAC_BYTES) / 6.0
    )  # fmt: skip
    more = airtime("multicast", *often).busy - airtime("multicast", *one).busy
    assert more == pytest.approx(1e-6 * sent_us * 2 * 0.1, rel=5e-3)


@given(transports, wifis, traffics)
def test_gaps_are_not_busy(transport: Transport, wifi: Wifi, traffic: Traffic) -> None:
    found = airtime(transport, wifi, traffic)
    assert 0.0 < found.busy < found.total


def test_one_segment_of_a_mesh_of_two_goes_up_and_down_and_so_does_its_acknowledgement() -> None:
    packet_bytes = 1000 + 27 + 22 + 52  # zenoh, TLS, TCP and IP
    expected_us = 2.0 * unicast_us(packet_bytes, 220.0) + 2.0 * unicast_us(52, 220.0)
    found = airtime("mesh", LOSSLESS, Traffic(robots=2, message_bytes=1000.0))
    assert 1e6 * found.message_s == pytest.approx(expected_us, rel=2e-3)


def test_a_message_too_large_for_a_datagram_takes_two_turns_of_a_group() -> None:
    small, large = (
        airtime("multicast", LOSSLESS, Traffic(robots=2, message_bytes=size))
        for size in (1421.0, 1422.0)
    )
    assert large.message_s - small.message_s == pytest.approx(1e-6 * group_us(109, 6.0), rel=0.1)


# Where it stands: shares of the field policy's fleet


@pytest.mark.parametrize(
    ("transport", "robots", "wifi", "size", "share"),
    [
        ("mesh", 10, WIFI, MESSAGE_BYTES["float16"], 0.18),
        ("multicast", 10, WIFI, MESSAGE_BYTES["float16"], 0.08),
        ("multicast", 100, replace(WIFI, multicast_rate_mbit_s=24.0), INT8, 0.21),
    ],
)
def test_shares_of_the_channel_that_messages_take(
    transport: Transport, robots: int, wifi: Wifi, size: float, share: float
) -> None:
    found = airtime(transport, wifi, Traffic(robots=robots, message_bytes=size))
    assert found.shares["message"] == pytest.approx(share, abs=0.01)


@EACH
def test_the_total_is_that_of_all_topics(transport: Transport) -> None:
    found = airtime(transport, WIFI, TEN)
    assert found.total == pytest.approx(sum(found.shares.values()))
    assert found.shares["message"] == max(found.shares.values())


def test_a_mesh_grows_with_the_square_and_multicast_with_the_number() -> None:
    for transport, power in (("mesh", 2.0), ("multicast", 1.0)):
        few, many = (
            airtime(transport, WIFI, Traffic(robots=n)).shares["message"]  # type: ignore[arg-type]
            for n in (5, 10)
        )
        assert math.log2(many / few) == pytest.approx(power, abs=0.25)


def test_multicast_pays_from_a_few_robots_on() -> None:
    """At a low rate it takes as long as several unicasts; it does not take more with receivers."""
    slow = replace(WIFI, multicast_rate_mbit_s=6.0)
    two, ten = Traffic(robots=2), Traffic(robots=10)
    assert total("multicast", slow, two) > total("mesh", slow, two)
    assert total("multicast", slow, ten) < total("mesh", slow, ten)


# Properties


@given(transports, wifis, traffics, st.integers(1, 50))
def test_more_robots_take_more(
    transport: Transport, wifi: Wifi, traffic: Traffic, more: int
) -> None:
    larger = replace(traffic, robots=traffic.robots + more)
    assert total(transport, wifi, larger) >= total(transport, wifi, traffic)


@given(transports, wifis, traffics, st.floats(1.05, 4.0))
def test_a_faster_channel_takes_less(
    transport: Transport, wifi: Wifi, traffic: Traffic, faster: float
) -> None:
    for name in ("data_rate_mbit_s", "multicast_rate_mbit_s"):
        changed = replace(wifi, **{name: faster * getattr(wifi, name)})
        assert total(transport, changed, traffic) <= total(transport, wifi, traffic) * (1 + 1e-9)


@given(transports, wifis, traffics)
@example(
    "multicast",
    Wifi(data_rate_mbit_s=6.0, multicast_rate_mbit_s=1.0, ground_wired=False),
    Traffic(robots=28, message_hz=0.0),
)
def test_loss_and_delay_are_bounded(transport: Transport, wifi: Wifi, traffic: Traffic) -> None:
    loss, delay_s = link_quality(transport, wifi, traffic)
    assert 0.0 <= loss <= 1.0
    # In a queue, and on its way.
    assert 0.0 <= delay_s <= 2.0 * wifi.queue_s + 1e-9


@given(transports, wifis, traffics, st.floats(0.05, 5.0))
def test_carries_is_the_last_that_fits(
    transport: Transport, wifi: Wifi, traffic: Traffic, most: float
) -> None:
    robots = capacity(transport, wifi, traffic, most=most, most_robots=500)
    assert 0 <= robots <= 500
    if robots:
        assert total(transport, wifi, replace(traffic, robots=robots)) <= most
    if robots < 500:
        assert total(transport, wifi, replace(traffic, robots=robots + 1)) > most


# What becomes of messages


@EACH
def test_where_there_is_time_for_all_nothing_is_lost_but_by_noise(transport: Transport) -> None:
    quality = link_quality(transport, LOSSLESS, TEN)
    assert quality.loss == pytest.approx(0.0, abs=0.01)
    assert 0.0 < quality.delay_s < 0.02


def test_multicast_loses_what_has_two_frames_twice_as_often() -> None:
    one, two = (
        link_quality("multicast", WIFI, replace(TEN, message_bytes=size)).loss
        for size in (INT8, 2.0 * INT8)
    )
    assert one == pytest.approx(0.05, abs=0.01)
    assert two == pytest.approx(2.0 * one, rel=0.1)


@EACH
def test_beyond_the_channel_messages_wait_and_are_lost(transport: Transport) -> None:
    quality = link_quality(transport, WIFI, Traffic(robots=1000))
    assert quality.loss > 0.95
    assert quality.delay_s >= WIFI.queue_s


def test_a_full_channel_still_carries_what_is_sent_together() -> None:
    thirty = Traffic(robots=30)
    assert total("mesh", WIFI, thirty) > 1.0
    quality = link_quality("mesh", WIFI, thirty)
    assert quality.loss == 0.0
    assert quality.delay_s > 5.0 * link_quality("mesh", WIFI, TEN).delay_s


# What is impossible


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("data_rate_mbit_s", 0.0, "above 0"),
        ("data_rate_mbit_s", math.inf, "finite"),
        ("multicast_rate_mbit_s", -6.0, "above 0"),
        ("multicast_rate_mbit_s", math.nan, "above 0"),
        ("frame_loss", 1.0, "below 1"),
        ("frame_loss", -0.1, "at least 0"),
        ("queue_s", -1.0, "at least 0"),
    ],
)
def test_an_impossible_channel_is_named(name: str, value: Any, allowed: str) -> None:
    with pytest.raises(ValueError, match=f"^{name} = {value}: must be .*{allowed}"):
        replace(WIFI, **{name: value})


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("robots", 0, "at least 1"),
        ("message_bytes", 0.0, "above 0"),
        ("message_hz", math.inf, "finite"),
        ("status_hz", -2.0, "at least 0"),
    ],
)
def test_impossible_traffic_is_named(name: str, value: Any, allowed: str) -> None:
    with pytest.raises(ValueError, match=f"^{name} = {value}: must be .*{allowed}"):
        replace(TEN, **{name: value})


def test_impossible_questions_are_named() -> None:
    unknown: Any = "pigeon"
    with pytest.raises(ValueError, match=r"^transport = 'pigeon': allowed are 'mesh', 'multicast'"):
        airtime(unknown, WIFI, TEN)
    with pytest.raises(ValueError, match=r"^most = 0\.0: must be above 0"):
        capacity("mesh", WIFI, TEN, most=0.0)


# The sizes are those of real messages


def sealed(message: object) -> int:
    return len(deflate(encode(message))) + OVERHEAD_BYTES


def heard(robots: int) -> float:
    """The statuses of one that hears so many, on average."""
    rng, ids = random.Random(robots), [str(robot) for robot in range(robots)]
    ages_s = {robot: rng.randrange(400) / 1e3 for robot in ids}
    messages = {robot: rng.randrange(1200, 1300) for robot in ids}
    arrivals: dict[str, tuple[int, ...]] = {
        robot: (1234, 0, rng.randrange(1100, 1200), rng.randrange(99)) for robot in ids
    }
    counts = RadioCounts(1234, 2_000_000, arrivals)
    status = snapshots.status(0, neighbour_ages_s=ages_s, neighbour_messages=messages)
    return (3 * sealed(status) + sealed(replace(status, radio_counts=counts))) / 4


def told(robots: int) -> int:
    """A state with an echo of so many."""
    rng = random.Random(robots)
    echoes = {
        str(robot): Echo(rng.getrandbits(47), rng.randrange(10**7) / 1e4, rng.randrange(4000) / 1e4)
        for robot in range(robots)
    }
    return sealed(GroundState(sequence=4, operator="alice", echoes=echoes))


def test_a_status_grows_with_each_that_is_heard() -> None:
    assert (heard(90) - heard(20)) / 70 == pytest.approx(
        (status_bytes(90) - status_bytes(20)) / 70, rel=0.2
    )


def test_a_state_has_an_echo_of_32_at_most() -> None:
    grows = (told(90) - told(20)) / 70
    assert state_bytes(20) - state_bytes(10) == pytest.approx(10 * grows, rel=0.1)
    assert state_bytes(90) - state_bytes(0) == pytest.approx(32 * grows, rel=0.1)


def test_a_track_of_explored_cells_takes_a_fourth_of_their_bits() -> None:
    cells = np.zeros((EXPLORED_CELLS, EXPLORED_CELLS), np.bool_)
    cells[10:20, 5:50] = cells[15:60, 40:50] = True
    size = len(deflate(explored_to_bytes(cells))) + OVERHEAD_BYTES
    assert size == pytest.approx(EXPLORED_BYTES, rel=0.2)


def test_all_sizes_are_within_their_topics_limits() -> None:
    for topic, size in (
        (MESSAGE, max(MESSAGE_BYTES.values())),
        (STATUS, status_bytes(MOST_ROBOTS)),
        (STATE, state_bytes(MOST_ROBOTS)),
        (EXPLORED, EXPLORED_BYTES),
    ):
        assert size <= topic.limit_bytes


@pytest.mark.parametrize(
    ("robots", "transport", "payload", "emulated"),
    [
        (10, "mesh", "float16", 0.304), (10, "mesh", "int8", 0.240),
        (10, "multicast", "float16", 0.142), (10, "multicast", "int8", 0.109),
        (20, "multicast", "int8", 0.217), (30, "multicast", "int8", 0.323),
    ],
)  # fmt: skip
def test_it_asks_for_what_the_programs_links_took_of_emulated_air(
    robots: int, transport: Any, payload: PayloadType, emulated: float
) -> None:
    """docs/network.md, "On emulated Wi-Fi"."""
    wifi = Wifi(data_rate_mbit_s=60.0, ground_wired=False)
    traffic = Traffic(robots=robots, message_bytes=MESSAGE_BYTES[payload])
    assert airtime(transport, wifi, traffic).total == pytest.approx(emulated, rel=0.2)


def test_the_docs_tables_are_the_models() -> None:
    pytest.importorskip("matplotlib")
    from handbook.scaling import tables  # noqa: PLC0415

    text = (ROOT / "docs" / "network.md").read_text()
    for name, table in tables().items():
        assert table in text, f"{name}: python -m handbook.scaling prints it anew"
