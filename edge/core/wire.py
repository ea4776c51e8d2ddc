"""AggregatedMessage <-> bytes after the beacon in a robot's message.

Little-endian: a type byte, the payload, and the map if robots share maps. The type is 1 for
float32, 2 for float16 or 3 for int8, plus 128 with a map, plus 64 if compressed. With 64, all bytes
after the type are one raw deflate stream (RFC 1951).

An int8 payload has a step size (float16) for each block of 64 numbers, then the number of steps
(int8) of each number.

The map follows the payload:

| offset | type | field | unit |
| --- | --- | --- | --- |
| 0 | uint32 | the map's mission: CRC-32 of the trial's name | |
| 4 | 2 x int32 | x, y of its first cell | cells |
| 12 | uint32 | n, its side | cells |
| 16 | n x n bytes | its cells, as in `edge.core.shared_map`, [x, y] | |
"""

import struct
import zlib
from enum import StrEnum
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from edge.core import F32
from edge.core.aggregation import AggregatedMessage
from edge.core.shared_map import SharedMap

_MAP = struct.Struct("<I2iI")
_WITH_MAP, _COMPRESSED = 0x80, 0x40
# A higher level saves 3 % more and takes 1.5 times as long. Short data are not compressed.
_LEVEL, _LEAST_BYTES = 1, 256

MAX_ROBOT_ID = 2**16 - 1

PayloadType = Literal["float32", "float16", "int8"]
PAYLOAD_TYPES: tuple[PayloadType, ...] = get_args(PayloadType)
# Any policy's payload can be sent in these types.
FLOAT_PAYLOADS: tuple[PayloadType, ...] = ("float32", "float16")
_CODES: dict[int, PayloadType] = dict(enumerate(PAYLOAD_TYPES, 1))
_FLOATS: dict[PayloadType, np.dtype[Any]] = {"float32": np.dtype("<f4"), "float16": np.dtype("<f2")}
# int8 payloads: numbers per block, and the largest number of steps.
_BLOCK, _MOST_STEPS = 64, 127
_STEP = np.dtype("<f2")


class Rejection(StrEnum):
    """Reason why the policy ignored a message."""

    TRUNCATED = "truncated"
    TOO_LONG = "too_long"
    PAYLOAD_TYPE = "payload_type"
    COMPRESSION = "compression"
    OTHER_RELEASE = "other_release"
    OTHER_BUNDLE = "other_bundle"
    OTHER_FRAME = "other_frame"
    OWN = "own"
    PAYLOAD_LENGTH = "payload_length"
    NON_FINITE = "non_finite"
    PAYLOAD_RANGE = "payload_range"
    AGE_UNKNOWN = "age_unknown"
    OUTDATED = "outdated"
    STALE = "stale"


def encode(
    message: AggregatedMessage, payload_type: PayloadType, *, as_in_flight: bool = False
) -> bytes:
    """Encode a message.

    Receivers get the numbers of `rounded`, and refuse a message with one that is not finite. With
    `as_in_flight` the payload is not compressed: before a robot has seen anything, most numbers are
    0, and the message then has about the size that it has in flight.

    Raises ValueError for another payload type.
    """
    if payload_type not in PAYLOAD_TYPES:
        raise ValueError(f"payload = {payload_type!r}: must be one of {', '.join(PAYLOAD_TYPES)}")
    kind = PAYLOAD_TYPES.index(payload_type) + 1
    if payload_type == "int8":
        steps, counts = _in_steps(message.payload)
        data = steps.tobytes() + counts.tobytes()
    else:
        data = _saturated(message.payload, _FLOATS[payload_type]).tobytes()
    payload_size = len(data)
    if message.shared is not None:
        kind |= _WITH_MAP
        (x, y), codes = message.shared
        data += _MAP.pack(message.trial, x, y, len(codes)) + codes.tobytes()
    if len(data) >= _LEAST_BYTES:
        stored = payload_size if as_in_flight else 0
        smaller = deflate(data[stored:], after=data[:stored])
        if len(smaller) < len(data):
            kind, data = kind | _COMPRESSED, smaller
    return bytes((kind,)) + data


def rounded(payload: F32, payload_type: PayloadType) -> F32:
    """Payloads (..., message_size) as receivers get them.

    float16 rounds to nearest and saturates at +-65504. int8 rounds each number to a 127th of the
    largest in its block of 64.
    """
    if payload_type == "int8":
        return _from_steps(*_in_steps(payload))
    return _saturated(payload, _FLOATS[payload_type]).astype(np.float32)


def payload_type_of(data: bytes) -> PayloadType:
    """Payload type of a message that `decode` accepts."""
    return _CODES[data[0] & ~(_WITH_MAP | _COMPRESSED)]


def _saturated(payload: F32, dtype: np.dtype[Any]) -> npt.NDArray[np.floating[Any]]:
    limit = np.finfo(dtype).max
    saturated = np.clip(payload, -limit, limit)
    return np.where(np.isfinite(payload), saturated, payload).astype(dtype)


def _blocks(length: int) -> int:
    return -(-length // _BLOCK)


def _in_steps(payload: F32) -> tuple[npt.NDArray[np.float16], npt.NDArray[np.int8]]:
    """Step size of each block (..., blocks) and number of steps of each number (..., n)."""
    size = payload.shape[-1]
    blocks = _blocks(size)
    padded = np.zeros((*payload.shape[:-1], blocks * _BLOCK), np.float32)
    padded[..., :size] = payload
    padded = padded.reshape(*payload.shape[:-1], blocks, _BLOCK)
    largest = np.abs(padded).max(axis=-1) / np.float32(_MOST_STEPS)
    # Numbers that are not finite stay so.
    largest = np.where(np.isfinite(largest), np.minimum(largest, np.finfo(_STEP).max), largest)
    steps = largest.astype(_STEP)
    with np.errstate(over="ignore"):
        longer = np.nextafter(steps, np.inf, dtype=_STEP)
    steps = np.where(steps < largest, longer, steps)
    of_each = steps.astype(np.float32)[..., None]
    finite = np.isfinite(of_each) & (of_each > 0.0)
    counts = np.divide(padded, of_each, out=np.zeros_like(padded), where=finite)
    counts = np.rint(counts).clip(-_MOST_STEPS, _MOST_STEPS).astype(np.int8)
    return steps, counts.reshape(*payload.shape[:-1], blocks * _BLOCK)[..., :size]


def _from_steps(steps: npt.NDArray[np.float16], counts: npt.NDArray[np.int8]) -> F32:
    each = steps.astype(np.float32).repeat(_BLOCK, axis=-1)[..., : counts.shape[-1]]
    with np.errstate(invalid="ignore"):
        return each * counts.astype(np.float32)


def most_bytes(message_size: int, payload_type: PayloadType, shared_side: int = 0) -> int:
    """Size of a message whose numbers cannot be compressed; see `decode` for the two sizes."""
    return 1 + _size(message_size, payload_type, shared_side)


def decode(
    data: bytes | memoryview,
    *,
    message_size: int,
    payload_limit: float | None = None,
    shared_side: int = 0,
) -> AggregatedMessage | Rejection:
    """Decode a message, or return the reason to refuse it. Never raises, whatever the bytes.

    `message_size` is the number of floats of the policy's payload, `payload_limit` the largest
    absolute value (None: any finite one), `shared_side` the side of the map, cells (0: no map).
    Payload and map are read-only and may be views of `data`, which must not change afterwards.
    """
    view = memoryview(data).toreadonly()
    if not view:
        return Rejection.TRUNCATED
    kind, body = view[0], view[1:]
    payload_type = _CODES.get(kind & ~(_WITH_MAP | _COMPRESSED))
    if payload_type is None:
        return Rejection.PAYLOAD_TYPE
    if bool(kind & _WITH_MAP) != bool(shared_side):
        return Rejection.PAYLOAD_LENGTH
    size = _size(message_size, payload_type, shared_side)
    if kind & _COMPRESSED:
        unpacked = inflate(body, size)
        if unpacked is None:
            return Rejection.COMPRESSION
        body = unpacked
    trial, shared, at = 0, None, _size(message_size, payload_type, 0)
    if shared_side and len(body) >= at + _MAP.size:
        trial, x, y, side = _MAP.unpack_from(body, at)
        if side != shared_side:
            return Rejection.PAYLOAD_LENGTH
    if len(body) != size:
        return Rejection.TRUNCATED if len(body) < size else Rejection.TOO_LONG
    if shared_side:
        codes = np.frombuffer(body, np.uint8, side * side, at + _MAP.size)
        shared = SharedMap((x, y), codes.reshape(side, side))
    payload = _payload(body, message_size, payload_type)
    # NaN if any number is.
    largest = float(np.abs(payload).max()) if payload.size else 0.0
    if not np.isfinite(largest):
        return Rejection.NON_FINITE
    if payload_limit is not None and largest > payload_limit:
        return Rejection.PAYLOAD_RANGE
    return AggregatedMessage(payload, trial, shared)


def _size(length: int, payload_type: PayloadType, shared_side: int) -> int:
    """Size of payload and map, bytes."""
    size = _MAP.size + shared_side * shared_side if shared_side else 0
    if payload_type == "int8":
        return size + _blocks(length) * _STEP.itemsize + length
    return size + length * _FLOATS[payload_type].itemsize


def deflate(data: bytes, *, after: bytes = b"") -> bytes:
    """Compress data to one raw deflate stream (RFC 1951), in which `after` is stored before it."""
    head = b""
    if after:
        store = zlib.compressobj(0, wbits=-zlib.MAX_WBITS)
        head = store.compress(after) + store.flush(zlib.Z_SYNC_FLUSH)
    return head + zlib.compress(data, _LEVEL, -zlib.MAX_WBITS)


def inflate(data: bytes | memoryview, size: int) -> memoryview | None:
    """Decompress one raw deflate stream, up to `size` + 1 bytes; None for other data."""
    stream = zlib.decompressobj(wbits=-zlib.MAX_WBITS)
    try:
        unpacked = memoryview(stream.decompress(data, size + 1))
    except zlib.error:
        return None
    if stream.unused_data or not (stream.eof or len(unpacked) > size):
        return None
    return unpacked


def _payload(
    body: memoryview, length: int, payload_type: PayloadType
) -> npt.NDArray[np.floating[Any]]:
    if payload_type in _FLOATS:
        return np.frombuffer(body, _FLOATS[payload_type], length)
    blocks = _blocks(length)
    payload = _from_steps(
        np.frombuffer(body, _STEP, blocks),
        np.frombuffer(body, np.int8, length, blocks * _STEP.itemsize),
    )
    payload.flags.writeable = False
    return payload
