"""Wire: what is sent arrives, and whatever else arrives is refused for the right reason."""

import dataclasses
import math
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from edge.core import F32
from edge.core.aggregation import AggregatedMessage
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

FLOAT16_MAX = 65504.0
COMPRESSED = 0x40
TYPES = pytest.mark.parametrize("payload_type", PAYLOAD_TYPES)

MESSAGE = AggregatedMessage(np.array([0.0, 1.0, -2.5, 100.0, 0.125], np.float32))


payloads = hnp.arrays(
    np.float32,
    st.integers(0, 40),
    elements=st.floats(width=32, allow_nan=False, allow_infinity=False),
)


def receive(
    data: bytes | memoryview,
    *,
    message_size: int = MESSAGE.payload.size,
    payload_limit: float | None = None,
    shared_side: int = 0,
) -> AggregatedMessage | Rejection:
    return decode(
        data, message_size=message_size, payload_limit=payload_limit, shared_side=shared_side
    )


def accepted(data: bytes | memoryview, message_size: int) -> AggregatedMessage:
    message = receive(data, message_size=message_size)
    assert isinstance(message, AggregatedMessage)
    assert (message.trial, message.shared) == (0, None)
    return message


@settings(deadline=None)
@given(payloads.map(AggregatedMessage))
def test_float32_arrives_exactly(message: AggregatedMessage) -> None:
    received = accepted(encode(message, "float32"), message.payload.size)
    assert received.payload.dtype == np.float32
    np.testing.assert_array_equal(received.payload, message.payload)


@settings(deadline=None)
@given(payloads.map(AggregatedMessage))
def test_float16_arrives_rounded_and_never_infinite(message: AggregatedMessage) -> None:
    received = accepted(encode(message, "float16"), message.payload.size)
    assert received.payload.dtype == np.float16
    saturated = np.clip(message.payload, -FLOAT16_MAX, FLOAT16_MAX)
    # Half a unit in the last of 11 bits, or half the smallest subnormal.
    allowed = np.maximum(np.abs(saturated) * 2.0**-11, 2.0**-25)
    assert (np.abs(received.payload.astype(np.float64) - saturated) <= allowed).all()


@settings(deadline=None)
@given(
    hnp.arrays(np.float32, st.integers(0, 200), elements=st.floats(-1e7, 1e7, width=32)).map(
        AggregatedMessage
    )
)
def test_int8_arrives_within_half_a_127th_of_its_block(message: AggregatedMessage) -> None:
    size = message.payload.size
    received = accepted(encode(message, "int8"), size)
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
        received = accepted(encode(message, payload_type), payload.size)
        np.testing.assert_array_equal(received.payload.astype(np.float32), expected)


def test_what_has_few_different_bytes_is_compressed() -> None:
    payload = np.zeros(870, np.float32)
    payload[::7] = 3.0
    codes = np.ones((32, 32), np.uint8)
    message = dataclasses.replace(MESSAGE, payload=payload, shared=SharedMap((0, 0), codes))
    for payload_type in PAYLOAD_TYPES:
        data = encode(message, payload_type)
        assert data[0] & COMPRESSED and len(data) < 200
        assert payload_type_of(data) == payload_type
        received = receive(data, message_size=870, shared_side=32)
        assert isinstance(received, AggregatedMessage) and received.shared is not None
        np.testing.assert_array_equal(received.shared.codes, codes)
        np.testing.assert_allclose(received.payload, payload, rtol=1e-3)
        assert not received.payload.flags.writeable


def compressed(body: bytes, kind: int) -> bytes:
    """A message with that body, compressed."""
    deflate = zlib.compressobj(wbits=-zlib.MAX_WBITS)
    return bytes([kind | COMPRESSED]) + deflate.compress(body) + deflate.flush()


@TYPES
def test_on_the_ground_a_message_is_as_large_as_in_flight(payload_type: PayloadType) -> None:
    """Whatever its numbers are, which have few different bytes there; its map is compressed."""
    codes: Codes = np.zeros((32, 32), np.uint8)
    nothing = dataclasses.replace(
        MESSAGE, payload=np.zeros(870, np.float32), shared=SharedMap((3, 4), codes)
    )
    something = np.random.default_rng(1).normal(size=870).astype(np.float32)
    said = encode(nothing, payload_type, as_in_flight=True)
    payload_size = {"float32": 3480, "float16": 1740, "int8": 870 + 2 * 14}[payload_type]
    assert payload_size < len(said) < payload_size + 60
    assert len(encode(nothing, payload_type)) < 200
    for payload in (nothing.payload, something):
        message = dataclasses.replace(nothing, payload=payload)
        arrived, in_flight = (
            decode(
                encode(message, payload_type, as_in_flight=as_in_flight),
                message_size=870, shared_side=32,
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
    for packed in (good[1:-1], good[1:] + b"\0", b"\xff" * 20, b""):
        assert receive(good[:1] + packed) is Rejection.COMPRESSION


@settings(deadline=None)
@given(st.binary(max_size=60), st.integers(0, 255), st.integers(0, 6))
def test_arbitrary_bytes_of_any_type_raise_nothing(
    body: bytes, kind: int, shared_side: int
) -> None:
    receive(bytes([kind]) + body, shared_side=shared_side)
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
    data, side = encode(sent, payload_type), len(codes)
    received = receive(data, shared_side=side)
    assert isinstance(received, AggregatedMessage) and received.shared is not None
    assert (received.trial, received.shared.corner) == (trial, corner)
    np.testing.assert_array_equal(received.shared.codes, codes)
    np.testing.assert_array_equal(received.payload, rounded(MESSAGE.payload, payload_type))
    # Who takes no map, or another one, and a map that was cut or is too long.
    assert receive(data) is Rejection.PAYLOAD_LENGTH
    assert receive(data, shared_side=side + 1) is Rejection.PAYLOAD_LENGTH
    without = encode(MESSAGE, payload_type)
    assert receive(without, shared_side=side) is Rejection.PAYLOAD_LENGTH
    if data[0] & COMPRESSED:
        damaged = (Rejection.COMPRESSION,) * 3
    else:
        damaged = (Rejection.TRUNCATED, Rejection.TRUNCATED, Rejection.TOO_LONG)
    for bytes_, reason in zip(
        (data[:-1], data[: len(without) + 3], data + b"\0"), damaged, strict=True
    ):
        assert receive(bytes_, shared_side=side) is reason


@settings(deadline=None)
@given(st.binary(max_size=300), st.integers(0, 60))
def test_of_arbitrary_bytes_finite_numbers_come_or_none(data: bytes, message_size: int) -> None:
    message = receive(data, message_size=message_size)
    if isinstance(message, AggregatedMessage):
        assert message.payload.shape == (message_size,) and np.isfinite(message.payload).all()


@TYPES
def test_every_truncation_and_extension_is_named(payload_type: PayloadType) -> None:
    good = encode(MESSAGE, payload_type)
    for size in range(len(good)):
        assert receive(good[:size]) is Rejection.TRUNCATED
    for tail in (b"\0", b"\0" * 2, b"\0" * 4, good):
        assert receive(good + tail) is Rejection.TOO_LONG


def test_the_layout_is_a_contract() -> None:
    # The type, and 0, 1, -2.5, 100, 0.125.
    float32 = "01" + "000000000000803f000020c00000c8420000003e"
    float16 = "02" + "0000003c00c140560030"
    # A step of 100 / 127, rounded up, and 0, 1, -3, 127, 0 of it.
    int8 = "03" + "4d3a" + "0001fd7f00"
    assert encode(MESSAGE, "float32").hex() == float32
    assert encode(MESSAGE, "float16").hex() == float16
    assert encode(MESSAGE, "int8").hex() == int8
    mapped = dataclasses.replace(
        MESSAGE, trial=0x0A0B0C0D, shared=SharedMap((5, -2), np.array([[1, 2], [3, 4]], np.uint8))
    )
    assert encode(mapped, "float16").hex() == (
        "82"
        "0000003c00c140560030"
        "0d0c0b0a"  # trial
        "05000000feffffff"  # first cell
        "02000000"  # side
        "01020304"
    )


@TYPES
def test_the_payload_is_read_only(payload_type: PayloadType) -> None:
    data = encode(MESSAGE, payload_type)
    for buffer in (data, memoryview(data), memoryview(bytearray(data))):
        payload = accepted(buffer, MESSAGE.payload.size).payload
        if payload_type != "int8":
            assert np.shares_memory(payload, np.frombuffer(buffer, np.uint8))
        assert not payload.flags.writeable
        with pytest.raises(ValueError, match="read-only"):
            payload[0] = 1.0


@pytest.mark.parametrize("kind", [0, 4, 0x3F, 0x40, 0x44, 0xFF])
def test_a_type_that_is_none_is_named(kind: int) -> None:
    good = encode(MESSAGE, "float32")
    assert receive(bytes([kind]) + good[1:]) is Rejection.PAYLOAD_TYPE


@TYPES
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_refused(payload_type: PayloadType, value: float) -> None:
    payload = MESSAGE.payload.copy()
    payload[-1] = value
    assert receive(encode(AggregatedMessage(payload), payload_type)) is Rejection.NON_FINITE


def test_a_payload_beyond_the_bundles_limit_is_refused() -> None:
    data = encode(MESSAGE, "float32")
    assert isinstance(receive(data, payload_limit=100.0), AggregatedMessage)
    assert receive(data, payload_limit=99.9) is Rejection.PAYLOAD_RANGE


def test_a_wrong_payload_type_is_named() -> None:
    problem = r"^payload = 'float64': must be one of float32, float16, int8$"
    with pytest.raises(ValueError, match=problem):
        encode(MESSAGE, "float64")  # type: ignore[arg-type]
