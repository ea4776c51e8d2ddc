"""Wire: what is sent arrives, and whatever else arrives is refused for the right reason."""

import dataclasses
import hashlib
import math
import struct
import zlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from edge.core import F32
from edge.core.aggregation import AggregatedMessage
from edge.core.fleet_time import FleetTime
from edge.core.shared_map import Codes, SharedMap
from edge.core.wire import (
    PAYLOAD_TYPES,
    PayloadType,
    Rejection,
    decode,
    encode,
    payload_type_of,
    rounded,
)

BUNDLE_ID = hashlib.sha256(b"manifest").digest()
OTHER_BUNDLE_ID = hashlib.sha256(b"another manifest").digest()
HEADER_SIZE = 104
FRAME_ID = 0x0A0B0C0D
FLOAT16_MAX = 65504.0
COMPRESSED = 0x40
TYPES = pytest.mark.parametrize("payload_type", PAYLOAD_TYPES)

MESSAGE = AggregatedMessage(
    robot_id=3,
    boot_epoch=0x010203040506,
    sequence=258,
    sent=FleetTime(0x04030201, 1.5, 0.25),
    position_m=(1.0, -2.0, 0.5),
    velocity_m_s=(0.25, -1.5, 0.125),
    frame_id=FRAME_ID,
    payload=np.array([0.0, 1.0, -2.5, 100.0, 0.125], np.float32),
)


def messages(payload: st.SearchStrategy[F32]) -> st.SearchStrategy[AggregatedMessage]:
    return st.builds(
        AggregatedMessage,
        robot_id=st.integers(0, 2**16 - 1),
        boot_epoch=st.integers(0, 2**43 - 1),
        sequence=st.integers(0, 2**32 - 1),
        sent=st.none()
        | st.builds(
            FleetTime, st.integers(1, 2**32 - 1), st.floats(-1e9, 1e9), st.floats(0, 1e9, width=32)
        ),
        position_m=st.tuples(*[st.floats(-1e6, 1e6)] * 3),
        velocity_m_s=st.tuples(*[st.floats(-1e4, 1e4, width=32)] * 3),
        frame_id=st.just(FRAME_ID),
        payload=payload,
    )


payloads = hnp.arrays(
    np.float32,
    st.integers(0, 40),
    elements=st.floats(width=32, allow_nan=False, allow_infinity=False),
)


def receive(
    data: bytes | memoryview,
    *,
    message_size: int = MESSAGE.payload.size,
    bundle_id: bytes = BUNDLE_ID,
    payload_limit: float | None = None,
    shared_side: int = 0,
) -> AggregatedMessage | Rejection:
    return decode(
        data,
        bundle_id=bundle_id,
        frame_id=FRAME_ID,
        message_size=message_size,
        payload_limit=payload_limit,
        shared_side=shared_side,
    )


def accepted(data: bytes | memoryview, message_size: int) -> AggregatedMessage:
    message = receive(data, message_size=message_size)
    assert isinstance(message, AggregatedMessage)
    return message


def seal(data: bytes) -> bytes:
    """The same message with the checksum that its content asks for."""
    checksum = zlib.crc32(data[HEADER_SIZE:], zlib.crc32(data[: HEADER_SIZE - 4]))
    return data[: HEADER_SIZE - 4] + struct.pack("<I", checksum) + data[HEADER_SIZE:]


def without_payload(message: AggregatedMessage) -> tuple[object, ...]:
    fields = dataclasses.fields(message)
    arrays = "payload", "shared"
    return tuple(getattr(message, field.name) for field in fields if field.name not in arrays)


@settings(deadline=None)
@given(messages(payloads))
def test_float32_arrives_exactly(message: AggregatedMessage) -> None:
    received = accepted(encode(message, BUNDLE_ID, "float32"), message.payload.size)
    assert without_payload(received) == without_payload(message)
    assert received.payload.dtype == np.float32
    np.testing.assert_array_equal(received.payload, message.payload)


@settings(deadline=None)
@given(messages(payloads))
def test_float16_arrives_rounded_and_never_infinite(message: AggregatedMessage) -> None:
    received = accepted(encode(message, BUNDLE_ID, "float16"), message.payload.size)
    assert without_payload(received) == without_payload(message)
    assert received.payload.dtype == np.float16
    saturated = np.clip(message.payload, -FLOAT16_MAX, FLOAT16_MAX)
    # Half a unit in the last of 11 bits, or half the smallest subnormal.
    allowed = np.maximum(np.abs(saturated) * 2.0**-11, 2.0**-25)
    assert (np.abs(received.payload.astype(np.float64) - saturated) <= allowed).all()


@settings(deadline=None)
@given(
    messages(hnp.arrays(np.float32, st.integers(0, 200), elements=st.floats(-1e7, 1e7, width=32)))
)
def test_int8_arrives_within_half_a_127th_of_its_block(message: AggregatedMessage) -> None:
    size = message.payload.size
    received = accepted(encode(message, BUNDLE_ID, "int8"), size)
    assert without_payload(received) == without_payload(message)
    sent = message.payload.astype(np.float64)
    for start in range(0, size, 64):
        block, came = sent[start : start + 64], received.payload[start : start + 64]
        saturated = np.clip(block, -127 * FLOAT16_MAX, 127 * FLOAT16_MAX)
        # Steps are float16: at most half a unit in the last of 11 bits too long, or the smallest.
        step = max(np.abs(saturated).max() / 127 * (1 + 2.0**-10), 2.0**-24)
        assert (np.abs(came - saturated) <= step / 2 * (1 + 1e-6)).all()


@TYPES
@settings(deadline=None)
@given(
    hnp.arrays(
        np.float32,
        st.tuples(st.integers(1, 3), st.integers(0, 200)),
        elements=st.floats(width=32, allow_nan=False, allow_infinity=False),
    )
)
def test_rounded_is_what_arrives(payload_type: PayloadType, payloads: F32) -> None:
    came = rounded(payloads, payload_type)
    assert came.dtype == np.float32
    for payload, expected in zip(payloads, came, strict=True):
        message = dataclasses.replace(MESSAGE, payload=payload)
        received = accepted(encode(message, BUNDLE_ID, payload_type), payload.size)
        np.testing.assert_array_equal(received.payload.astype(np.float32), expected)


def test_what_has_few_different_bytes_is_compressed() -> None:
    payload = np.zeros(870, np.float32)
    payload[::7] = 3.0
    codes = np.ones((32, 32), np.uint8)
    message = dataclasses.replace(MESSAGE, payload=payload, shared=SharedMap((0, 0), codes))
    for payload_type in PAYLOAD_TYPES:
        data = encode(message, BUNDLE_ID, payload_type)
        assert data[9] & COMPRESSED and len(data) < HEADER_SIZE + 200
        assert payload_type_of(data) == payload_type
        received = receive(data, message_size=870, shared_side=32)
        assert isinstance(received, AggregatedMessage) and received.shared is not None
        np.testing.assert_array_equal(received.shared.codes, codes)
        np.testing.assert_allclose(received.payload, payload, rtol=1e-3)
        assert not received.payload.flags.writeable


def compressed(body: bytes, kind: int) -> bytes:
    """A message of five numbers with that body, compressed, and a checksum that is right."""
    deflate = zlib.compressobj(wbits=-zlib.MAX_WBITS)
    good = encode(MESSAGE, BUNDLE_ID, "float32")
    packed = deflate.compress(body) + deflate.flush()
    return seal(good[:9] + bytes([kind | COMPRESSED]) + good[10:HEADER_SIZE] + packed)


@TYPES
def test_on_the_ground_a_message_is_as_large_as_in_flight(payload_type: PayloadType) -> None:
    """Whatever its numbers are, which have few different bytes there; its map is compressed."""
    codes: Codes = np.zeros((32, 32), np.uint8)
    nothing = dataclasses.replace(
        MESSAGE, payload=np.zeros(870, np.float32), shared=SharedMap((3, 4), codes)
    )
    something = np.random.default_rng(1).normal(size=870).astype(np.float32)
    said = encode(nothing, BUNDLE_ID, payload_type, as_in_flight=True)
    payload_size = {"float32": 3480, "float16": 1740, "int8": 870 + 2 * 14}[payload_type]
    assert HEADER_SIZE + payload_size < len(said) < HEADER_SIZE + payload_size + 60
    assert len(encode(nothing, BUNDLE_ID, payload_type)) < 200
    for payload in (nothing.payload, something):
        message = dataclasses.replace(nothing, payload=payload)
        arrived, in_flight = (
            decode(
                encode(message, BUNDLE_ID, payload_type, as_in_flight=as_in_flight),
                bundle_id=BUNDLE_ID, frame_id=FRAME_ID, message_size=870,
                shared_side=32,
            )
            for as_in_flight in (True, False)
        )  # fmt: skip
        assert isinstance(arrived, AggregatedMessage) and isinstance(in_flight, AggregatedMessage)
        np.testing.assert_array_equal(arrived.payload, in_flight.payload)
        assert arrived.shared is not None
        np.testing.assert_array_equal(arrived.shared.codes, codes)


def test_what_is_compressed_is_as_large_as_it_may_be() -> None:
    five = MESSAGE.payload.tobytes()
    assert isinstance(receive(compressed(five, 1)), AggregatedMessage)
    assert receive(compressed(five[:-1], 1)) is Rejection.TRUNCATED
    for much in (1, 100_000_000):
        assert receive(compressed(five + bytes(much), 1)) is Rejection.TOO_LONG
    good = compressed(five, 1)
    for packed in (good[HEADER_SIZE:-1], good[HEADER_SIZE:] + b"\0", b"\xff" * 20, b""):
        assert receive(seal(good[:HEADER_SIZE] + packed)) is Rejection.COMPRESSION


@settings(deadline=None)
@given(st.binary(max_size=60), st.integers(0, 255), st.integers(0, 6))
def test_arbitrary_bytes_after_a_good_header_raise_nothing(
    body: bytes, kind: int, shared_side: int
) -> None:
    good = encode(MESSAGE, BUNDLE_ID, "float32")
    receive(seal(good[:9] + bytes([kind]) + good[10:HEADER_SIZE] + body), shared_side=shared_side)
    receive(compressed(body, kind), shared_side=shared_side)


INT32 = st.integers(-(2**31), 2**31 - 1)


@TYPES
@settings(deadline=None)
@given(
    trial=st.integers(0, 2**32 - 1),
    corner=st.tuples(INT32, INT32),
    codes=hnp.arrays(np.uint8, st.integers(1, 9).map(lambda side: (side, side))),
)
def test_a_map_arrives_behind_the_payload(
    payload_type: PayloadType, trial: int, corner: tuple[int, int], codes: Codes
) -> None:
    sent = dataclasses.replace(MESSAGE, trial=trial, shared=SharedMap(corner, codes))
    data, side = encode(sent, BUNDLE_ID, payload_type), len(codes)
    received = receive(data, shared_side=side)
    assert isinstance(received, AggregatedMessage) and received.shared is not None
    assert (received.trial, received.shared.corner) == (trial, corner)
    np.testing.assert_array_equal(received.shared.codes, codes)
    np.testing.assert_array_equal(received.payload, rounded(MESSAGE.payload, payload_type))
    # Who takes no map, or another one, and a map that was cut or is too long.
    assert receive(data) is Rejection.PAYLOAD_LENGTH
    assert receive(data, shared_side=side + 1) is Rejection.PAYLOAD_LENGTH
    without = encode(MESSAGE, BUNDLE_ID, payload_type)
    assert receive(without, shared_side=side) is Rejection.PAYLOAD_LENGTH
    if data[9] & COMPRESSED:
        # The sizes of what was compressed are in it.
        damaged = (Rejection.CHECKSUM,) * 3
    else:
        damaged = (Rejection.TRUNCATED, Rejection.TRUNCATED, Rejection.TOO_LONG)
    for bytes_, reason in zip(
        (data[:-1], data[: len(without) + 3], data + b"\0"), damaged, strict=True
    ):
        assert receive(bytes_, shared_side=side) is reason


@settings(deadline=None)
@given(st.binary(max_size=300), st.integers(0, 60))
def test_arbitrary_bytes_are_refused(data: bytes, message_size: int) -> None:
    assert isinstance(receive(data, message_size=message_size), Rejection)


@settings(deadline=None)
@given(st.binary(max_size=200), st.booleans(), st.integers(0, 60))
def test_arbitrary_bytes_behind_a_good_start_never_raise(
    data: bytes, sealed: bool, message_size: int
) -> None:
    data = encode(MESSAGE, BUNDLE_ID, "float32")[:9] + data
    if sealed and len(data) >= HEADER_SIZE:
        data = seal(data)
    assert isinstance(receive(data, message_size=message_size), Rejection)


@settings(deadline=None)
@given(st.binary(min_size=20, max_size=20), st.binary(min_size=44, max_size=44))
def test_arbitrary_floats_in_a_sealed_message_arrive_or_are_not_finite(
    payload: bytes, header_floats: bytes
) -> None:
    good = encode(MESSAGE, BUNDLE_ID, "float32")
    data = seal(good[:40] + header_floats + good[84:HEADER_SIZE] + payload)
    header = struct.unpack("<4d3f", header_floats)
    floats = header + struct.unpack("<5f", payload)
    limits = (1e9, *[1e6] * 3, *[1e4] * 3)
    if not all(map(math.isfinite, floats)):
        assert receive(data) is Rejection.NON_FINITE
    elif any(abs(value) > limit for value, limit in zip(header, limits, strict=True)):
        assert receive(data) is Rejection.IMPOSSIBLE
    else:
        message = accepted(data, 5)
        assert message.sent is not None
        assert (
            message.sent.time_s,
            *message.position_m,
            *message.velocity_m_s,
            *message.payload.tolist(),
        ) == floats


@TYPES
def test_every_changed_byte_is_noticed(payload_type: PayloadType) -> None:
    good = encode(MESSAGE, BUNDLE_ID, payload_type)
    for place in range(len(good)):
        for change in range(1, 256):
            data = bytearray(good)
            data[place] ^= change
            assert isinstance(receive(bytes(data)), Rejection), (place, change)


@TYPES
def test_every_truncation_and_extension_is_named(payload_type: PayloadType) -> None:
    good = encode(MESSAGE, BUNDLE_ID, payload_type)
    for size in range(len(good)):
        assert receive(good[:size]) is Rejection.TRUNCATED
    for tail in (b"\0", b"\0" * 2, b"\0" * 4, good):
        assert receive(good + tail) is Rejection.TOO_LONG


def test_the_layout_is_a_contract() -> None:
    head = (
        "4c5041432d4d5347"  # LPAC-MSG
        "03"  # version
        "{payload_type}"
        "0300"  # robot id 3
        "02010000"  # sequence 258
        "05b3abf2579a5eb66403cd78be557fd8"  # the first 16 bytes of BUNDLE_ID
        "0605040302010000"  # boot epoch
        "000000000000f83f"  # sent at 1.5
        "000000000000f03f"  # x 1
        "00000000000000c0"  # y -2
        "000000000000e03f"  # z 0.5
        "0000803e"  # velocity x 0.25
        "0000c0bf"  # y -1.5
        "0000003e"  # z 0.125
        "0d0c0b0a"  # frame id
        "05000000"  # payload length
        "01020304"  # which ground's clock
        "0000803e"  # to 0.25
    )
    # CRC-32, and then 0, 1, -2.5, 100, 0.125.
    float32 = (
        head.format(payload_type="01") + "8b4e9941" + "000000000000803f000020c00000c8420000003e"
    )
    float16 = head.format(payload_type="02") + "4fb75a3f" + "0000003c00c140560030"
    # A step of 100 / 127, rounded up, and 0, 1, -3, 127, 0 of it.
    int8 = head.format(payload_type="03") + "4dfdfaec" + "4d3a" + "0001fd7f00"
    assert encode(MESSAGE, BUNDLE_ID, "float32").hex() == float32
    assert encode(MESSAGE, BUNDLE_ID, "float16").hex() == float16
    assert encode(MESSAGE, BUNDLE_ID, "int8").hex() == int8
    mapped = dataclasses.replace(
        MESSAGE, trial=0x0A0B0C0D, shared=SharedMap((5, -2), np.array([[1, 2], [3, 4]], np.uint8))
    )
    assert (
        encode(mapped, BUNDLE_ID, "float16")
        .hex()
        .endswith(
            "0000003c00c140560030"
            "0d0c0b0a"  # trial
            "05000000feffffff"  # first cell
            "02000000"  # side
            "01020304"
        )
    )
    assert accepted(bytes.fromhex(float32), 5).sequence == 258


@TYPES
def test_the_payload_is_aligned_and_read_only(payload_type: PayloadType) -> None:
    data = encode(MESSAGE, BUNDLE_ID, payload_type)
    for buffer in (data, memoryview(data), memoryview(bytearray(data))):
        payload = accepted(buffer, MESSAGE.payload.size).payload
        if payload_type != "int8":
            assert np.shares_memory(payload, np.frombuffer(buffer, np.uint8))
        assert payload.flags.aligned
        assert not payload.flags.writeable
        with pytest.raises(ValueError, match="read-only"):
            payload[0] = 1.0


def test_the_reason_is_the_most_telling_one() -> None:
    good = encode(MESSAGE, BUNDLE_ID, "float32")
    longer = dataclasses.replace(MESSAGE, payload=np.ones(7, np.float32))
    reasons = {
        Rejection.MAGIC: b"lpac" + good[4:],
        # Another version may have any length and any checksum.
        Rejection.VERSION: good[:8] + b"\2" + good[9:70],
        Rejection.PAYLOAD_TYPE: good[:9] + b"\4" + good[10:],
        Rejection.CHECKSUM: good[:-1] + b"\x7f",
        # Another bundle's payload may have any length.
        Rejection.OTHER_BUNDLE: encode(longer, OTHER_BUNDLE_ID, "float16"),
        Rejection.PAYLOAD_LENGTH: encode(longer, BUNDLE_ID, "float32"),
        Rejection.OTHER_FRAME: encode(
            dataclasses.replace(MESSAGE, frame_id=FRAME_ID + 1), BUNDLE_ID, "float32"
        ),
    }
    assert {reason: receive(data) for reason, data in reasons.items()} == {
        reason: reason for reason in reasons
    }


def test_damage_is_not_taken_for_another_bundle() -> None:
    good = encode(MESSAGE, BUNDLE_ID, "float32")
    assert receive(good[:16] + bytes([good[16] ^ 1]) + good[17:]) is Rejection.CHECKSUM


@TYPES
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_refused(payload_type: PayloadType, value: float) -> None:
    payload = MESSAGE.payload.copy()
    payload[-1] = value
    for message in (
        dataclasses.replace(MESSAGE, payload=payload),
        dataclasses.replace(MESSAGE, sent=FleetTime(1, value, 0.0)),
        dataclasses.replace(MESSAGE, sent=FleetTime(1, 0.0, value)),
        dataclasses.replace(MESSAGE, position_m=(value, 0.0, 0.0)),
        dataclasses.replace(MESSAGE, position_m=(0.0, value, 0.0)),
        dataclasses.replace(MESSAGE, position_m=(0.0, 0.0, value)),
        dataclasses.replace(MESSAGE, velocity_m_s=(0.0, value, 0.0)),
    ):
        assert receive(encode(message, BUNDLE_ID, payload_type)) is Rejection.NON_FINITE


@TYPES
@pytest.mark.parametrize(
    "changes",
    [
        {"boot_epoch": 2**43},
        {"boot_epoch": 2**63},
        {"position_m": (0.0, -1.1e6, 0.0)},
        {"velocity_m_s": (0.0, 0.0, 1.1e4)},
        {"sent": FleetTime(1, 1.1e9, 0.0)},
        {"sent": FleetTime(1, 0.0, -1.0)},
    ],
)
def test_what_cannot_be_is_refused(payload_type: PayloadType, changes: dict[str, Any]) -> None:
    message = dataclasses.replace(MESSAGE, **changes)
    assert receive(encode(message, BUNDLE_ID, payload_type)) is Rejection.IMPOSSIBLE


def test_a_payload_beyond_the_bundles_limit_is_refused() -> None:
    data = encode(MESSAGE, BUNDLE_ID, "float32")
    assert isinstance(receive(data, payload_limit=100.0), AggregatedMessage)
    assert receive(data, payload_limit=99.9) is Rejection.PAYLOAD_RANGE


def test_a_wrong_payload_type_is_named() -> None:
    problem = r"^payload = 'float64': must be one of float32, float16, int8$"
    with pytest.raises(ValueError, match=problem):
        encode(MESSAGE, BUNDLE_ID, "float64")  # type: ignore[arg-type]
