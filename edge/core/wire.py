"""AggregatedMessage <-> the bytes that travel between robots.

Little-endian, a header of 104 bytes, then the payload, and then the map, if robots share maps:

| offset | type | field | unit |
| --- | --- | --- | --- |
| 0 | 8 bytes | magic, `LPAC-MSG` | |
| 8 | uint8 | version of this layout, 3 | |
| 9 | uint8 | payload type: 1 float32, 2 float16, 3 int8; plus 64 and 128, see below | |
| 10 | uint16 | robot id | |
| 12 | uint32 | sequence | |
| 16 | 16 bytes | first half of the bundle id (SHA-256 of the manifest) | |
| 32 | uint64 | boot epoch | |
| 40 | float64 | send time by the ground's clock | s |
| 48 | 3 x float64 | position x, y, z in the mission frame | m |
| 72 | 3 x float32 | velocity x, y, z in the mission frame | m/s |
| 84 | uint32 | the mission frame's `frame_id` | |
| 88 | uint32 | payload length | floats |
| 92 | uint32 | which ground's clock, 0 if none is known | |
| 96 | float32 | how wrong the send time may be | s |
| 100 | uint32 | CRC-32 (zlib) of all other bytes, payload included | |
| 104 | | payload | |

An int8 payload is a float16 for each 64 of its numbers, what a step of theirs comes to, and behind
them an int8 for each number, how many steps it is.

128 more in the payload type: robots share maps, and one begins behind the payload:

| offset | type | field | unit |
| --- | --- | --- | --- |
| 0 | uint32 | the mission that it was seen in: CRC-32 of the trial's name | |
| 4 | 2 x int32 | x, y of its first cell | cells |
| 12 | uint32 | n, its side | cells |
| 16 | n x n bytes | the cells, as `edge.core.shared_map` reads them, [x, y] | |

64 more: all behind the header is one raw deflate stream (RFC 1951).

Magic and version stay where they are in every version.
"""

import math
import struct
import zlib
from enum import StrEnum
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from edge.core import F32
from edge.core.aggregation import AggregatedMessage
from edge.core.fleet_time import FleetTime
from edge.core.shared_map import SharedMap

_MAGIC = b"LPAC-MSG"
_VERSION = 3
_VERSION_AT = len(_MAGIC)
_FIELDS = struct.Struct("<8sBBHI16sQ4d3f3If")
_CHECKSUM = struct.Struct("<I")
_MAP = struct.Struct("<I2iI")
_WITH_MAP, _COMPRESSED = 0x80, 0x40
# More effort saves 3 % more, and takes half as long again; of few bytes there is little to save.
_EFFORT, _WORTH_IT = 1, 256
# A multiple of 8, so that the payload is aligned wherever the message is.
_HEADER_SIZE = _FIELDS.size + _CHECKSUM.size
_BUNDLE_ID_SIZE = 16
# Far outside of what a fleet needs: boot epochs are ms of a wall clock, this is the year 2248.
_MOST_EPOCH = 2**43
_MOST_M, _MOST_M_S, _MOST_S = 1e6, 1e4, 1e9

MAX_ROBOT_ID = 2**16 - 1
_NO_TIME = FleetTime(0, 0.0, 0.0)

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
    """Why a message was not listened to."""

    MAGIC = "magic"
    VERSION = "version"
    TRUNCATED = "truncated"
    TOO_LONG = "too_long"
    PAYLOAD_TYPE = "payload_type"
    CHECKSUM = "checksum"
    COMPRESSION = "compression"
    OTHER_BUNDLE = "other_bundle"
    OTHER_FRAME = "other_frame"
    OWN = "own"
    OTHER_SENDER = "other_sender"
    PAYLOAD_LENGTH = "payload_length"
    NON_FINITE = "non_finite"
    IMPOSSIBLE = "impossible"
    PAYLOAD_RANGE = "payload_range"
    AGE_UNKNOWN = "age_unknown"
    OUTDATED = "outdated"
    STALE = "stale"


def encode(
    message: AggregatedMessage,
    bundle_id: bytes,
    payload_type: PayloadType,
    *,
    as_in_flight: bool = False,
) -> bytes:
    """The bytes of `message`; `bundle_id` is the 32 bytes of the manifest's SHA-256.

    Numbers come out at the receivers as `rounded` says. If one is not finite, they refuse the
    message. `as_in_flight`: the payload is not compressed, so that a robot which has seen nothing
    yet, and whose numbers are mostly 0, says about as much as it will in flight.

    Raises ValueError for another payload type, and struct.error if a number does not fit its field.
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
    base, time_s, uncertainty_s = message.sent or _NO_TIME
    fields = _FIELDS.pack(
        _MAGIC,
        _VERSION,
        kind,
        message.robot_id,
        message.sequence,
        bundle_id[:_BUNDLE_ID_SIZE],
        message.boot_epoch,
        time_s,
        *message.position_m,
        *message.velocity_m_s,
        message.frame_id,
        message.payload.size,
        base,
        uncertainty_s,
    )
    return b"".join((fields, _CHECKSUM.pack(zlib.crc32(data, zlib.crc32(fields))), data))


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
    """That of a message which `decode` accepts."""
    return _CODES[data[_VERSION_AT + 1] & ~(_WITH_MAP | _COMPRESSED)]


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
    map_bytes = _MAP.size + shared_side * shared_side if shared_side else 0
    return _HEADER_SIZE + _payload_size(message_size, payload_type) + map_bytes


def decode(
    data: bytes | memoryview,
    *,
    bundle_id: bytes,
    frame_id: int | None,
    message_size: int,
    payload_limit: float | None = None,
    shared_side: int = 0,
) -> AggregatedMessage | Rejection:
    """The message in `data`, or why it is refused; raises nothing, whatever the bytes.

    `bundle_id` is the 32 bytes of the own manifest's SHA-256, `frame_id` that of the own mission
    frame (None takes messages of any), `message_size` the number of floats that the own network
    takes, `payload_limit` the largest that one of them can be (None: any that is finite),
    `shared_side` the side of the map that it takes, in cells (0: none). Payload and map are
    read-only, and may be views of `data`, which must not change afterwards.
    """
    view = memoryview(data).toreadonly()
    header = _header_of(view)
    if isinstance(header, Rejection):
        return header
    # First whether these are the bytes that were sent; only then does what they say mean anything.
    body = view[_HEADER_SIZE:]
    if wrong := _damage(view, header):
        return wrong
    if header.bundle_id != bundle_id[:_BUNDLE_ID_SIZE]:
        return Rejection.OTHER_BUNDLE
    if header.payload_length != message_size:
        return Rejection.PAYLOAD_LENGTH
    if header.kind & _COMPRESSED:
        unpacked = _unpacked(body, header, shared_side)
        if isinstance(unpacked, Rejection):
            return unpacked
        body = unpacked
    trial, shared = (
        _shared_map(body[header.payload_size :]) if header.kind & _WITH_MAP else (0, None)
    )
    if (len(shared.codes) if shared else 0) != shared_side:
        return Rejection.PAYLOAD_LENGTH
    if frame_id is not None and header.frame_id != frame_id:
        return Rejection.OTHER_FRAME
    message = AggregatedMessage(
        header.robot_id,
        header.boot_epoch,
        header.sequence,
        FleetTime(header.base, header.time_s, header.uncertainty_s) if header.base else None,
        (header.x_m, header.y_m, header.z_m),
        (header.vx_m_s, header.vy_m_s, header.vz_m_s),
        header.frame_id,
        _payload(body, header),
        trial,
        shared,
    )
    return _out_of_range(message, (header.time_s, header.uncertainty_s), payload_limit) or message


class _Header(NamedTuple):
    magic: bytes
    version: int
    kind: int
    robot_id: int
    sequence: int
    bundle_id: bytes
    boot_epoch: int
    time_s: float
    x_m: float
    y_m: float
    z_m: float
    vx_m_s: float
    vy_m_s: float
    vz_m_s: float
    frame_id: int
    payload_length: int
    base: int
    uncertainty_s: float

    @property
    def payload_type(self) -> PayloadType | None:
        return _CODES.get(self.kind & ~(_WITH_MAP | _COMPRESSED))

    @property
    def payload_size(self) -> int:
        """In bytes."""
        return _payload_size(self.payload_length, self.payload_type or "int8")


def _payload_size(length: int, payload_type: PayloadType) -> int:
    if payload_type == "int8":
        return _blocks(length) * _STEP.itemsize + length
    return length * _FLOATS[payload_type].itemsize


def _header_of(view: memoryview) -> _Header | Rejection:
    # Nothing behind the version can be read in a layout that is not this one.
    start = bytes(view[: len(_MAGIC)])
    if start != _MAGIC[: len(start)]:
        return Rejection.MAGIC
    if len(view) > _VERSION_AT and view[_VERSION_AT] != _VERSION:
        return Rejection.VERSION
    if len(view) < _HEADER_SIZE:
        return Rejection.TRUNCATED
    header = _Header(*_FIELDS.unpack_from(view))
    return Rejection.PAYLOAD_TYPE if header.payload_type is None else header


def _damage(view: memoryview, header: _Header) -> Rejection | None:
    """Why these are not the bytes that were sent."""
    body = view[_HEADER_SIZE:]
    if not header.kind & _COMPRESSED and (wrong := _wrong_size(body, header)):
        return wrong
    (checksum,) = _CHECKSUM.unpack_from(view, _FIELDS.size)
    if zlib.crc32(body, zlib.crc32(view[: _FIELDS.size])) != checksum:
        return Rejection.CHECKSUM
    return None


def _wrong_size(body: memoryview, header: _Header) -> Rejection | None:
    """Of a body that is not compressed."""
    size = header.payload_size
    if header.kind & _WITH_MAP:
        if len(body) < size + _MAP.size:
            return Rejection.TRUNCATED
        *_, side = _MAP.unpack_from(body, size)
        size += _MAP.size + side * side
    if len(body) == size:
        return None
    return Rejection.TRUNCATED if len(body) < size else Rejection.TOO_LONG


def _unpacked(body: memoryview, header: _Header, shared_side: int) -> memoryview | Rejection:
    """Decompress a body, unless it has another size than that of the own robots."""
    size = header.payload_size
    if header.kind & _WITH_MAP:
        size += _MAP.size + shared_side * shared_side
    inflate = zlib.decompressobj(wbits=-zlib.MAX_WBITS)
    try:
        # One byte too many tells that there are more: nobody makes a robot unpack them.
        unpacked = memoryview(inflate.decompress(body, size + 1))
    except zlib.error:
        return Rejection.COMPRESSION
    if inflate.unused_data or not (inflate.eof or len(unpacked) > size):
        return Rejection.COMPRESSION
    if header.kind & _WITH_MAP and len(unpacked) >= header.payload_size + _MAP.size:
        *_, side = _MAP.unpack_from(unpacked, header.payload_size)
        if side != shared_side:
            return Rejection.PAYLOAD_LENGTH
    if len(unpacked) == size:
        return unpacked
    return Rejection.TRUNCATED if len(unpacked) < size else Rejection.TOO_LONG


def _payload(body: memoryview, header: _Header) -> npt.NDArray[np.floating[Any]]:
    length, payload_type = header.payload_length, header.payload_type
    if payload_type in _FLOATS:
        return np.frombuffer(body, _FLOATS[payload_type], length)
    blocks = _blocks(length)
    payload = _from_steps(
        np.frombuffer(body, _STEP, blocks),
        np.frombuffer(body, np.int8, length, blocks * _STEP.itemsize),
    )
    payload.flags.writeable = False
    return payload


def _shared_map(body: memoryview) -> tuple[int, SharedMap]:
    """The mission that a map was seen in, and the map."""
    trial, x, y, side = _MAP.unpack_from(body)
    codes = np.frombuffer(body, np.uint8, side * side, _MAP.size)
    return trial, SharedMap((x, y), codes.reshape(side, side))


def _out_of_range(
    message: AggregatedMessage, times_s: tuple[float, float], payload_limit: float | None
) -> Rejection | None:
    """Which number in it no honest robot says."""
    (time_s, uncertainty_s), payload = times_s, message.payload
    # NaN where one of them is.
    largest = float(np.abs(payload).max()) if payload.size else 0.0
    numbers = (*times_s, *message.position_m, *message.velocity_m_s, largest)
    if not all(map(math.isfinite, numbers)):
        return Rejection.NON_FINITE
    possible = (
        message.boot_epoch < _MOST_EPOCH
        and all(abs(c) <= _MOST_M for c in message.position_m)
        and all(abs(c) <= _MOST_M_S for c in message.velocity_m_s)
        and abs(time_s) <= _MOST_S
        and 0.0 <= uncertainty_s <= _MOST_S
    )
    if not possible:
        return Rejection.IMPOSSIBLE
    if payload_limit is not None and largest > payload_limit:
        return Rejection.PAYLOAD_RANGE
    return None
