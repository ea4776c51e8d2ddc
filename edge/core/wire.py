"""AggregatedMessage <-> the bytes that travel between robots.

Little-endian, a header of 104 bytes, then the payload, and then the map, if robots share maps:

| offset | type | field | unit |
| --- | --- | --- | --- |
| 0 | 8 bytes | magic, `LPAC-MSG` | |
| 8 | uint8 | version of this layout, 3 | |
| 9 | uint8 | payload type: 1 float32, 2 float16 | |
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
| 104 | float32 or float16 | payload | |

The map begins behind the payload; its type is the payload's, plus 128:

| offset | type | field | unit |
| --- | --- | --- | --- |
| 0 | uint32 | the mission that it was seen in: CRC-32 of the trial's name | |
| 4 | 2 x int32 | x, y of its first cell | cells |
| 12 | uint32 | n, its side | cells |
| 16 | n x n bytes | the cells, as `edge.core.shared_map` reads them, [x, y] | |

Magic and version stay where they are in every version.
"""

import math
import struct
import zlib
from enum import StrEnum
from typing import Any

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
_WITH_MAP = 0x80
# A multiple of 8, so that the payload is aligned wherever the message is.
_HEADER_SIZE = _FIELDS.size + _CHECKSUM.size
_BUNDLE_ID_SIZE = 16
# Far outside of what a fleet needs: boot epochs are ms of a wall clock, this is the year 2248.
_MOST_EPOCH = 2**43
_MOST_M, _MOST_M_S, _MOST_S = 1e6, 1e4, 1e9

MAX_ROBOT_ID = 2**16 - 1
_NO_TIME = FleetTime(0, 0.0, 0.0)
_PAYLOAD_TYPES: dict[int, np.dtype[Any]] = {1: np.dtype("<f4"), 2: np.dtype("<f2")}


class Rejection(StrEnum):
    """Why a message was not listened to."""

    MAGIC = "magic"
    VERSION = "version"
    TRUNCATED = "truncated"
    TOO_LONG = "too_long"
    PAYLOAD_TYPE = "payload_type"
    CHECKSUM = "checksum"
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


def encode(message: AggregatedMessage, bundle_id: bytes, payload_dtype: npt.DTypeLike) -> bytes:
    """The bytes of `message`; `bundle_id` is the 32 bytes of the manifest's SHA-256.

    float16 rounds to nearest and saturates at +-65504. A value that is not finite stays so, and the
    receivers refuse the message.

    Raises ValueError if `payload_dtype` is neither float32 nor float16, and struct.error if a
    number does not fit its field.
    """
    dtype = np.dtype(payload_dtype)
    payload_type = next((code for code, known in _PAYLOAD_TYPES.items() if known == dtype), None)
    if payload_type is None:
        raise ValueError(f"payload dtype = {dtype}: must be float32 or float16")
    data = rounded(message.payload, _PAYLOAD_TYPES[payload_type]).tobytes()
    if message.shared is not None:
        payload_type |= _WITH_MAP
        (x, y), codes = message.shared
        data += _MAP.pack(message.trial, x, y, len(codes)) + codes.tobytes()
    base, time_s, uncertainty_s = message.sent or _NO_TIME
    fields = _FIELDS.pack(
        _MAGIC,
        _VERSION,
        payload_type,
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


def rounded(payload: F32, dtype: npt.DTypeLike) -> F32:
    """A payload, of any shape, as it comes out at the receivers: see `encode`."""
    limit = np.finfo(dtype).max
    saturated = np.clip(payload, -limit, limit)
    return np.where(np.isfinite(payload), saturated, payload).astype(dtype)


def decode(
    data: bytes | memoryview,
    *,
    bundle_id: bytes,
    frame_id: int | None,
    own_robot_id: int,
    message_size: int,
    payload_limit: float | None = None,
    shared_side: int = 0,
) -> AggregatedMessage | Rejection:
    """The message in `data`, or why it is refused; raises nothing, whatever the bytes.

    `bundle_id` is the 32 bytes of the own manifest's SHA-256, `frame_id` that of the own mission
    frame (None takes messages of any), `message_size` the number of floats that the own network
    takes, `payload_limit` the largest that one of them can be (None: any that is finite),
    `shared_side` the side of the map that it takes, in cells (0: none). Payload and map are
    read-only views of `data`, not copies: `data` must not change afterwards.
    """
    view = memoryview(data).toreadonly()
    # Nothing behind the version can be read in a layout that is not this one.
    start = bytes(view[: len(_MAGIC)])
    if start != _MAGIC[: len(start)]:
        return Rejection.MAGIC
    if len(view) > _VERSION_AT and view[_VERSION_AT] != _VERSION:
        return Rejection.VERSION
    if len(view) < _HEADER_SIZE:
        return Rejection.TRUNCATED
    (
        _,
        _,
        payload_type,
        robot_id,
        sequence,
        sender_bundle_id,
        boot_epoch,
        time_s,
        x_m,
        y_m,
        z_m,
        vx_m_s,
        vy_m_s,
        vz_m_s,
        sender_frame_id,
        payload_length,
        base,
        uncertainty_s,
    ) = _FIELDS.unpack_from(view)
    # First whether these are the bytes that were sent; only then does what they say mean anything.
    dtype = _PAYLOAD_TYPES.get(payload_type & ~_WITH_MAP)
    if dtype is None:
        return Rejection.PAYLOAD_TYPE
    map_at = _HEADER_SIZE + payload_length * dtype.itemsize
    trial = x = y = side = 0
    sent_size = map_at
    if payload_type & _WITH_MAP:
        if len(view) < map_at + _MAP.size:
            return Rejection.TRUNCATED
        trial, x, y, side = _MAP.unpack_from(view, map_at)
        sent_size += _MAP.size + side * side
    if len(view) != sent_size:
        return Rejection.TRUNCATED if len(view) < sent_size else Rejection.TOO_LONG
    (checksum,) = _CHECKSUM.unpack_from(view, _FIELDS.size)
    if zlib.crc32(view[_HEADER_SIZE:], zlib.crc32(view[: _FIELDS.size])) != checksum:
        return Rejection.CHECKSUM
    if sender_bundle_id != bundle_id[:_BUNDLE_ID_SIZE]:
        return Rejection.OTHER_BUNDLE
    if robot_id == own_robot_id:
        return Rejection.OWN
    if (payload_length, side) != (message_size, shared_side):
        return Rejection.PAYLOAD_LENGTH
    if frame_id is not None and sender_frame_id != frame_id:
        return Rejection.OTHER_FRAME
    message = AggregatedMessage(
        robot_id,
        boot_epoch,
        sequence,
        FleetTime(base, time_s, uncertainty_s) if base else None,
        (x_m, y_m, z_m),
        (vx_m_s, vy_m_s, vz_m_s),
        sender_frame_id,
        np.frombuffer(view, dtype, payload_length, _HEADER_SIZE),
        trial,
        _shared_map((x, y), side, view[map_at + _MAP.size :]) if side else None,
    )
    return _out_of_range(message, (time_s, uncertainty_s), payload_limit) or message


def _shared_map(corner: tuple[int, int], side: int, cells: memoryview) -> SharedMap:
    return SharedMap(corner, np.frombuffer(cells, np.uint8).reshape(side, side))


def _out_of_range(
    message: AggregatedMessage, times_s: tuple[float, float], payload_limit: float | None
) -> Rejection | None:
    """Which number in it no honest robot says."""
    (time_s, uncertainty_s), payload = times_s, message.payload
    numbers = (*times_s, *message.position_m, *message.velocity_m_s)
    if not (all(map(math.isfinite, numbers)) and np.isfinite(payload).all()):
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
    if payload_limit is not None and payload.size and np.abs(payload).max() > payload_limit:
        return Rejection.PAYLOAD_RANGE
    return None
