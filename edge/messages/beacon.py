"""Beacon: what a robot tells its neighbours besides its policy's message, in 64 bytes.

A robot's message is a beacon, and behind it what its policy says (see `edge.core.wire`); while the
policy is silent, the beacon alone. So neighbours keep apart, and compare themselves before a
flight, without hearing each other's statuses.

Little-endian:

| offset | type | field | unit |
| --- | --- | --- | --- |
| 0 | 2 bytes | magic, `LB` | |
| 2 | uint8 | version of this layout, 1 | |
| 3 | uint16 | robot id | |
| 5 | uint48 | boot epoch | |
| 11 | uint32 | sequence | |
| 15 | uint48 | send time, Unix | ms |
| 21 | 3 x int24 | position x, y, z in the mission frame | cm |
| 30 | 3 x int16 | velocity x, y, z in the mission frame | cm/s |
| 36 | uint8 | flight state, by its place in `FlightState` | |
| 37 | uint8 | bits: 1 armed, 2 disarmed, 4 position and velocity known | |
| 38 | uint8 | system id of its vehicle, 0 if not known | |
| 39 | uint16 | accuracy that its receiver reports, rounded up; 65535 if none | cm |
| 41 | uint16 | since it was armed; 65535 if not known | s |
| 43 | int24 | slot height | mm |
| 46 | 2 x int24 | landing point x, y | mm |
| 52 | uint32 | the mission frame's `frame_id`, 0 if none is set | |
| 56 | uint16 | `tag` of the bundle's id | |
| 58 | uint16 | `tag` of the world's id | |
| 60 | uint32 | CRC-32 (zlib) of all other bytes | |

What is out of a field's range is said as the field's greatest or least.
"""

import functools
import math
import struct
import zlib
from dataclasses import dataclass
from typing import NamedTuple

from edge.core.vehicle import Vector
from edge.messages.codec import MessageError
from edge.messages.mission import FlightState

BEACON_BYTES = 64
_HEAD = b"LB\x01"
_CRC_AT = 60
_FIELDS = struct.Struct("<3xH6sI6s9s3h3B2H3s6sI2HI")
assert _FIELDS.size == BEACON_BYTES
_STATES = tuple(FlightState)
_ARMED, _DISARMED, _PLACED = 1, 2, 4
_UNKNOWN = 65_535


@dataclass(frozen=True, slots=True)
class Beacon:
    """A robot's own state; positions as in `RobotStatus`, to 1 cm, heights to 1 mm.

    `bundle_tag` and `world_tag` are the `tag`s of what it flies by; `frame_id` is 0 as long as it
    has no mission origin.
    """

    robot_id: int
    boot_epoch: int
    sequence: int
    sent_at_s: float
    position_m: Vector | None
    velocity_m_s: Vector | None
    state: FlightState
    armed: bool | None
    system_id: int | None
    gps_accuracy_m: float | None
    flown_s: float | None
    slot_height_m: float
    landing_point_m: tuple[float, float]
    frame_id: int
    bundle_tag: int
    world_tag: int


class HeardBeacon(NamedTuple):
    """Another robot's, and when it came by this robot's monotonic clock, s."""

    beacon: Beacon
    heard_at_s: float


def tag(name: str) -> int:
    """16 bits of a bundle's or a world's id, to tell whether two robots have the same."""
    return zlib.crc32(name.encode()) & 0xFFFF


def encode_beacon(beacon: Beacon) -> bytes:
    """The 64 bytes."""
    position_m, velocity_m_s = beacon.position_m, beacon.velocity_m_s
    numbers = (*(position_m or ()), *(velocity_m_s or ()))
    placed = len(numbers) == 6 and all(map(math.isfinite, numbers))
    bits = _PLACED if placed else 0
    if beacon.armed is not None:
        bits |= _ARMED if beacon.armed else _DISARMED
    accuracy_m, flown_s = beacon.gps_accuracy_m, beacon.flown_s
    fields = (
        (beacon.robot_id, 2, False),
        (beacon.boot_epoch, 6, False),
        (beacon.sequence, 4, False),
        (beacon.sent_at_s * 1e3, 6, False),
        *((c * 1e2, 3, True) for c in (numbers[:3] if placed else (0.0,) * 3)),
        *((c * 1e2, 2, True) for c in (numbers[3:] if placed else (0.0,) * 3)),
        (_STATES.index(beacon.state), 1, False),
        (bits, 1, False),
        (beacon.system_id or 0, 1, False),
        (_UNKNOWN if accuracy_m is None else _ceil_cm(accuracy_m), 2, False),
        (_UNKNOWN if flown_s is None else min(flown_s, _UNKNOWN - 1.0), 2, False),
        (beacon.slot_height_m * 1e3, 3, True),
        *((c * 1e3, 3, True) for c in beacon.landing_point_m),
        (beacon.frame_id, 4, False),
        (beacon.bundle_tag, 2, False),
        (beacon.world_tag, 2, False),
    )
    body = _HEAD + b"".join(_packed(value, size, signed) for value, size, signed in fields)
    return body + zlib.crc32(body).to_bytes(4, "little")


def decode_beacon(data: bytes | memoryview) -> Beacon:
    """The beacon at the start of `data`. Raises MessageError."""
    if len(data) < BEACON_BYTES:
        raise MessageError(f"Beacon: {len(data)} bytes: must be {BEACON_BYTES}")
    return _decoded(bytes(data[:BEACON_BYTES]))


# The robots of one process, as in a simulator, hear the same bytes within a moment.
@functools.lru_cache(maxsize=8)
def _decoded(body: bytes) -> Beacon:
    if not body.startswith(_HEAD):
        raise MessageError("Beacon: of another version, or none")
    (
        robot_id, epoch, sequence, sent_at, place, *velocity_cm_s, state, bits, system_id,
        accuracy_cm, flown_s, slot_height, landing_point, frame_id, bundle_tag, world_tag, checksum,
    ) = _FIELDS.unpack(body)  # fmt: skip
    if zlib.crc32(body[:_CRC_AT]) != checksum:
        raise MessageError("Beacon: its checksum is wrong")
    if state >= len(_STATES):
        raise MessageError(f"Beacon: state {state} is not known")
    x_m, y_m, z_m = (number / 1e2 for number in _int24s(place))
    vx_m_s, vy_m_s, vz_m_s = (number / 1e2 for number in velocity_cm_s)
    slot_height_m, landing_x_m, landing_y_m = (
        number / 1e3 for number in _int24s(slot_height + landing_point)
    )
    placed = bool(bits & _PLACED)
    return Beacon(
        robot_id=robot_id,
        boot_epoch=int.from_bytes(epoch, "little"),
        sequence=sequence,
        sent_at_s=int.from_bytes(sent_at, "little") / 1e3,
        position_m=(x_m, y_m, z_m) if placed else None,
        velocity_m_s=(vx_m_s, vy_m_s, vz_m_s) if placed else None,
        state=_STATES[state],
        armed=True if bits & _ARMED else False if bits & _DISARMED else None,
        system_id=system_id or None,
        gps_accuracy_m=None if accuracy_cm == _UNKNOWN else accuracy_cm / 1e2,
        flown_s=None if flown_s == _UNKNOWN else float(flown_s),
        slot_height_m=slot_height_m,
        landing_point_m=(landing_x_m, landing_y_m),
        frame_id=frame_id,
        bundle_tag=bundle_tag,
        world_tag=world_tag,
    )


def _ceil_cm(value_m: float) -> int:
    # 2.0 cm are not 3, whatever the last bit says.
    return math.ceil(min(value_m * 1e2, _UNKNOWN - 1.0) - 1e-6)


def _packed(value: float, size: int, signed: bool) -> bytes:
    bits = 8 * size
    least, greatest = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    # Bounded first: not every float has an integer.
    return round(min(max(value, least), greatest)).to_bytes(size, "little", signed=signed)


def _int24s(data: bytes) -> list[int]:
    return [
        int.from_bytes(data[at : at + 3], "little", signed=True) for at in range(0, len(data), 3)
    ]
