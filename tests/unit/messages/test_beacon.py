"""What neighbours tell each other survives the way, and nothing out of bounds passes for it."""

import dataclasses
import math
import re
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from edge.core.aggregation import AggregatedMessage
from edge.core.fleet_time import FleetTime
from edge.core.wire import encode
from edge.identity.envelope import OVERHEAD_BYTES
from edge.messages.beacon import BEACON_BYTES, Beacon, decode_beacon, encode_beacon, tag
from edge.messages.codec import MessageError
from edge.messages.mission import FlightState

BEACON = Beacon(
    robot_id=513, sent=FleetTime(0x04030201, 1.5, 0.25), position_m=(-12.345, 8.5, 9.01),
    velocity_m_s=(0.25, -1.5, 0.0), state=FlightState.MISSION, armed=True, system_id=7,
    gps_accuracy_m=0.02, flown_s=63.0, slot_height_m=9.5, landing_point_m=(16.125, -8.0),
    frame_id=0xDEADBEEF, bundle_tag=tag("b"), world_tag=tag("w"),
)  # fmt: skip
RECORDED = bytes.fromhex(
    "c7cfffff3421000032230000"  # position
    "19006aff0000"  # velocity
    "06050702003f00"  # state, bits, system id, accuracy, flown
    "1c250000fd3e0000c0e0ffff"  # slot height, landing point
    "efbeaddef9efbe71120b631c"  # mission frame, bundle, world
    "01020304000000000000f83f0000803e"  # time
)


def some(least: float, greatest: float, per_unit: float) -> st.SearchStrategy[float]:
    """What the field can say exactly."""
    return st.integers(int(least * per_unit), int(greatest * per_unit)).map(lambda n: n / per_unit)


METRES, SPEEDS = some(-1e6, 1e6, 1e3), some(-327.67, 327.67, 1e2)
TAGS = st.integers(0, 2**32 - 1)


@given(
    st.builds(
        Beacon,
        robot_id=st.integers(0, 65_535),
        sent=st.none()
        | st.builds(
            FleetTime, st.integers(1, 2**32 - 1), st.floats(-1e9, 1e9), st.floats(0, 1e9, width=32)
        ),
        position_m=st.tuples(METRES, METRES, METRES),
        velocity_m_s=st.tuples(SPEEDS, SPEEDS, SPEEDS),
        state=st.sampled_from(FlightState),
        armed=st.none() | st.booleans(),
        system_id=st.none() | st.integers(1, 255),
        gps_accuracy_m=st.none() | some(0.0, 600.0, 1e2),
        flown_s=st.none() | some(0.0, 65_000.0, 1.0),
        slot_height_m=METRES,
        landing_point_m=st.tuples(METRES, METRES),
        frame_id=TAGS,
        bundle_tag=TAGS,
        world_tag=TAGS,
    )
)
def test_what_it_can_say_exactly_arrives_exactly(beacon: Beacon) -> None:
    data = encode_beacon(beacon)
    assert len(data) == BEACON_BYTES
    assert decode_beacon(data, beacon.robot_id) == beacon
    more = memoryview(data + b"what the policy says")
    assert decode_beacon(more, beacon.robot_id) == beacon


def test_around_a_payload_there_are_at_most_160_bytes() -> None:
    payload = np.zeros(100, np.float32)
    said = encode_beacon(BEACON) + encode(AggregatedMessage(payload), "float32")
    assert len(said) - payload.nbytes + OVERHEAD_BYTES <= 160


def test_this_version_stays_as_it_is_on_the_air() -> None:
    assert encode_beacon(BEACON) == RECORDED
    assert decode_beacon(RECORDED, 513) == BEACON


@given(st.floats(), st.floats(), st.floats())
def test_every_number_can_be_encoded(x_m: float, y_m: float, other: float) -> None:
    beacon = dataclasses.replace(BEACON, position_m=(x_m, y_m, 0.0), velocity_m_s=(0.0, 0.0, x_m))
    heard = decode_beacon(encode_beacon(beacon), 513)
    known = math.isfinite(x_m) and math.isfinite(y_m)
    assert (heard.position_m is not None) == (heard.velocity_m_s is not None) == known
    if known and abs(x_m) < 1e6 and abs(y_m) < 1e6:
        assert heard.position_m == pytest.approx((x_m, y_m, 0.0), abs=0.000501)
    if other >= 0.0 and math.isfinite(other):
        heard = decode_beacon(
            encode_beacon(dataclasses.replace(BEACON, flown_s=other, gps_accuracy_m=other)), 513
        )
        assert heard.flown_s is not None and abs(heard.flown_s - min(other, 65_534.0)) <= 0.5
        # A receiver is never made better than it says.
        assert heard.gps_accuracy_m is not None
        assert heard.gps_accuracy_m >= min(other, 655.34) - 1e-6


@pytest.mark.parametrize(
    ("at", "packed", "problem"),
    [
        (0, struct.pack("<i", 2**31 - 1), "x_m = 2147483.647: must be from -1e+06 to 1e+06"),
        (12, struct.pack("<h", -(2**15)), "vx_m_s = -327.68: must be from -327.67 to 327.67"),
        (18, b"\x0c", "state = 12: must be from 0 to 11"),
        (19, b"\x08", "bits = 8: must be from 0 to 7"),
        (53, struct.pack("<d", math.inf), "time_s = inf: must be from -1e+09 to 1e+09"),
        (61, struct.pack("<f", math.nan), "time_uncertainty_s = nan: must be from 0 to 1e+09"),
    ],
)
def test_what_is_out_of_bounds_is_refused(at: int, packed: bytes, problem: str) -> None:
    data = RECORDED[:at] + packed + RECORDED[at + len(packed) :]
    with pytest.raises(MessageError, match=f"^Beacon: {re.escape(problem)}$"):
        decode_beacon(data, 513)


@given(st.binary(max_size=100))
def test_any_bytes_are_within_bounds_or_refused(data: bytes) -> None:
    try:
        beacon = decode_beacon(data, 513)
    except MessageError as error:
        assert str(error).startswith("Beacon: ")
        return
    sent = () if beacon.sent is None else structs.astuple(beacon.sent)
    numbers = (*(beacon.position_m or ()), *(beacon.velocity_m_s or ()), *sent)
    assert all(map(math.isfinite, numbers))
