"""AggregatedMessage <-> the bytes behind the beacon of a robot's message.

Little-endian: a byte for the type, then the payload, and then the map, if robots share maps. The
type is 1 for float32, 2 for float16, 3 for int8; plus 64 and 128, see below.

An int8 payload is a float16 for each 64 of its numbers, what a step of theirs comes to, and behind
them an int8 for each number, how many steps it is.

128 more in the type: robots share maps, and one begins behind the payload:

| offset | type | field | unit |
| --- | --- | --- | --- |
| 0 | uint32 | the mission that it was seen in: CRC-32 of the trial's name | |
| 4 | 2 x int32 | x, y of its first cell | cells |
| 12 | uint32 | n, its side | cells |
| 16 | n x n bytes | the cells, as `edge.core.shared_map` reads them, [x, y] | |

64 more: all behind the type is one raw deflate stream (RFC 1951).
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
# More effort saves 3 % more, and takes half as long again; of few bytes there is little to save.
_EFFORT, _WORTH_IT = 1, 256

MAX_ROBOT_ID = 2**16 - 1

PayloadType = Literal["float32", "float16", "int8"]
PAYLOAD_TYPES: tuple[PayloadType, ...] = get_args(PayloadType)
# Any policy can be sent in these.
FLOAT_PAYLOADS: tuple[PayloadType, ...] = ("float32", "float16")
_CODES: dict[int, PayloadType] = dict(enumerate(PAYLOAD_TYPES, 1))
_FLOATS: dict[PayloadType, np.dtype[Any]] = {"float32": np.dtype("<f4"), "float16": np.dtype("<f2")}
# Of an int8 payload: so many numbers have one step, and none is more steps than that.
_BLOCK, _MOST_STEPS = 64, 127
_STEP = np.dtype("<f2")


class Rejection(StrEnum):
    """Why the policy did not listen to a message."""

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
    """The bytes of `message`.

    Numbers come out at the receivers as `rounded` says. If one is not finite, they refuse the
    message. `as_in_flight`: the payload is not compressed, so that a robot which has seen nothing
    yet, and whose numbers are mostly 0, says about as much as it will in flight.

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
    if len(data) >= _WORTH_IT:
        stored = payload_size if as_in_flight else 0
        smaller = _deflated(data[:stored], data[stored:])
        if len(smaller) < len(data):
            kind, data = kind | _COMPRESSED, smaller
    return bytes((kind,)) + data


def _deflated(stored: bytes, compressed: bytes) -> bytes:
    """One raw deflate stream of both, the first as it is."""
    store, deflate = (zlib.compressobj(effort, wbits=-zlib.MAX_WBITS) for effort in (0, _EFFORT))
    head = store.compress(stored) + store.flush(zlib.Z_SYNC_FLUSH) if stored else b""
    return head + deflate.compress(compressed) + deflate.flush()


def rounded(payload: F32, payload_type: PayloadType) -> F32:
    """Payloads (..., message_size) as they come out at the receivers.

    float16 rounds to nearest and saturates at +-65504. int8 rounds each number to a 127th of the
    largest among the 64 that it is sent with.
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
    """The step of each block (..., blocks), and of each number how many of them it is (..., n)."""
    size = payload.shape[-1]
    blocks = _blocks(size)
    padded = np.zeros((*payload.shape[:-1], blocks * _BLOCK), np.float32)
    padded[..., :size] = payload
    padded = padded.reshape(*payload.shape[:-1], blocks, _BLOCK)
    largest = np.abs(padded).max(axis=-1) / np.float32(_MOST_STEPS)
    # One that is not finite stays so.
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
    """The message in `data`, or why it is refused; raises nothing, whatever the bytes.

    `message_size` is the number of floats that the own network takes, `payload_limit` the largest
    that one of them can be (None: any that is finite), `shared_side` the side of the map that it
    takes, in cells (0: none). Payload and map are read-only, and may be views of `data`, which must
    not change afterwards.
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
    # NaN where one of them is.
    largest = float(np.abs(payload).max()) if payload.size else 0.0
    if not np.isfinite(largest):
        return Rejection.NON_FINITE
    if payload_limit is not None and largest > payload_limit:
        return Rejection.PAYLOAD_RANGE
    return AggregatedMessage(payload, trial, shared)


def _size(length: int, payload_type: PayloadType, shared_side: int) -> int:
    """Of payload and map, in bytes."""
    size = _MAP.size + shared_side * shared_side if shared_side else 0
    if payload_type == "int8":
        return size + _blocks(length) * _STEP.itemsize + length
    return size + length * _FLOATS[payload_type].itemsize


def deflate(data: bytes) -> bytes:
    """Compress data to one raw deflate stream (RFC 1951)."""
    return zlib.compress(data, _EFFORT, -zlib.MAX_WBITS)


def inflate(data: bytes | memoryview, size: int) -> memoryview | None:
    """Decompress one whole raw deflate stream, but at most `size` + 1 bytes; None if it is none."""
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
