"""What neighbours tell each other in 64 bytes survives the way, and nothing else passes for it."""

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.messages.beacon import BEACON_BYTES, Beacon, decode_beacon, encode_beacon, tag
from edge.messages.codec import MessageError
from edge.messages.mission import FlightState

BEACON = Beacon(
    robot_id=513, boot_epoch=1_795_000_000_123, sequence=70_000, sent_at_s=1_795_000_100.456,
    position_m=(-12.34, 8.5, 9.01), velocity_m_s=(0.25, -1.5, 0.0), state=FlightState.MISSION,
    armed=True, system_id=7, gps_accuracy_m=0.02, flown_s=63.0, slot_height_m=9.5,
    landing_point_m=(16.125, -8.0), frame_id=0xDEADBEEF, bundle_tag=tag("b"), world_tag=tag("w"),
)  # fmt: skip
RECORDED = bytes.fromhex(
    "4c420101027b5e56eea1017011010068e657eea1012efbff5203008503001900"
    "6aff000006050702003f001c2500fd3e00c0e0ffefbeaddef9ef120b0b64d70b"
)


def some(least: float, greatest: float, per_unit: float) -> st.SearchStrategy[float]:
    """What the field can say exactly."""
    return st.integers(int(least * per_unit), int(greatest * per_unit)).map(lambda n: n / per_unit)


METRES, SPEEDS, EXACT_M = some(-8e4, 8e4, 1e2), some(-300.0, 300.0, 1e2), some(-8e3, 8e3, 1e3)


@given(
    st.builds(
        Beacon,
        robot_id=st.integers(0, 65_535),
        boot_epoch=st.integers(0, 2**48 - 1),
        sequence=st.integers(0, 2**32 - 1),
        sent_at_s=some(0.0, 4e9, 1e3),
        position_m=st.tuples(METRES, METRES, METRES),
        velocity_m_s=st.tuples(SPEEDS, SPEEDS, SPEEDS),
        state=st.sampled_from(FlightState),
        armed=st.none() | st.booleans(),
        system_id=st.none() | st.integers(1, 255),
        gps_accuracy_m=st.none() | some(0.0, 600.0, 1e2),
        flown_s=st.none() | some(0.0, 65_000.0, 1.0),
        slot_height_m=some(0.0, 8e3, 1e3),
        landing_point_m=st.tuples(EXACT_M, EXACT_M),
        frame_id=st.integers(0, 2**32 - 1),
        bundle_tag=st.integers(0, 65_535),
        world_tag=st.integers(0, 65_535),
    )
)
def test_what_it_can_say_exactly_arrives_exactly(beacon: Beacon) -> None:
    data = encode_beacon(beacon)
    assert len(data) == BEACON_BYTES == 64
    assert decode_beacon(data) == beacon
    assert decode_beacon(memoryview(data + b"what the policy says")) == beacon


def test_this_version_stays_as_it_is_on_the_air() -> None:
    assert encode_beacon(BEACON) == RECORDED
    assert decode_beacon(RECORDED) == BEACON


@given(st.floats(), st.floats(), st.floats())
def test_every_number_can_be_said(x_m: float, y_m: float, other: float) -> None:
    beacon = dataclasses.replace(BEACON, position_m=(x_m, y_m, 0.0), velocity_m_s=(0.0, 0.0, x_m))
    heard = decode_beacon(encode_beacon(beacon))
    known = math.isfinite(x_m) and math.isfinite(y_m)
    assert (heard.position_m is not None) == (heard.velocity_m_s is not None) == known
    if known and abs(x_m) < 8e4 and abs(y_m) < 8e4:
        assert heard.position_m == pytest.approx((x_m, y_m, 0.0), abs=0.00501)
    if other >= 0.0 and math.isfinite(other):
        heard = decode_beacon(
            encode_beacon(dataclasses.replace(BEACON, flown_s=other, gps_accuracy_m=other))
        )
        assert heard.flown_s is not None and abs(heard.flown_s - min(other, 65_534.0)) <= 0.5
        # A receiver is never made better than it says.
        assert heard.gps_accuracy_m is not None
        assert heard.gps_accuracy_m >= min(other, 655.34) - 1e-6


@given(st.integers(0, 63), st.integers(1, 255))
def test_a_changed_byte_shows(at: int, change: int) -> None:
    data = bytearray(encode_beacon(BEACON))
    data[at] ^= change
    with pytest.raises(MessageError, match=r"^Beacon: "):
        decode_beacon(bytes(data))


@given(st.binary(max_size=100))
def test_bytes_are_no_beacon(data: bytes) -> None:
    with pytest.raises(MessageError, match=r"^Beacon: "):
        decode_beacon(data)
