"""Beacon: header of each message from robot to robots, the same in every release.

The policy's message follows it (`edge.core.wire`), if there is one. The sender, its program's start
and the message's number are in the envelope. With beacons, neighbours keep apart in flight and
compare their settings before it, without each other's statuses.

Little-endian:

| offset | type | field | unit |
| --- | --- | --- | --- |
| 0 | 3 x int32 | position x, y, z in the mission frame | mm |
| 12 | 3 x int16 | velocity x, y, z in the mission frame | cm/s |
| 18 | uint8 | flight state, by its place in `FlightState` | |
| 19 | uint8 | bits: 1 armed, 2 disarmed, 4 position and velocity known | |
| 20 | uint8 | system id of its vehicle, 0 if not known | |
| 21 | uint16 | accuracy that its GPS reports, rounded up; 65535 if none | cm |
| 23 | uint16 | time since it was armed; 65535 if not known | s |
| 25 | int32 | slot height | mm |
| 29 | 2 x int32 | landing point x, y | mm |
| 37 | uint32 | the mission frame's `frame_id`, 0 if none is set | |
| 41 | uint32 | `tag` of the bundle's id | |
| 45 | uint32 | `tag` of the world's id | |
| 49 | uint32 | ground whose clock `sent` is by, 0 if none is known | |
| 53 | float64 | send time by that clock | s |
| 61 | float32 | uncertainty of the send time | s |

Encoding clips a value to its field's bounds; decoding refuses one outside them.
"""

import functools
import math
import struct
import zlib
from dataclasses import dataclass
from typing import NamedTuple

from msgspec import Struct, structs

from edge.core.fleet_time import FleetTime
from edge.core.vehicle import Vector
from edge.messages.codec import MessageError
from edge.messages.mission import FlightState

_STATES = tuple(FlightState)
_ARMED, _DISARMED, _PLACED = 1, 2, 4
_UNKNOWN = 65_535


class _Number(NamedTuple):
    """A field: struct code, steps per unit, and bounds."""

    code: str
    steps: int
    least: float
    greatest: float


_METRES = _Number("i", 1000, -1e6, 1e6)
_METRES_PER_SECOND = _Number("h", 100, -327.67, 327.67)
_TAG = _Number("I", 1, 0, 2**32 - 1)
_FIELDS = {
    "x_m": _METRES,
    "y_m": _METRES,
    "z_m": _METRES,
    "vx_m_s": _METRES_PER_SECOND,
    "vy_m_s": _METRES_PER_SECOND,
    "vz_m_s": _METRES_PER_SECOND,
    "state": _Number("B", 1, 0, len(_STATES) - 1),
    "bits": _Number("B", 1, 0, 7),
    "system_id": _Number("B", 1, 0, 255),
    "accuracy_cm": _Number("H", 1, 0, _UNKNOWN),
    "flown_s": _Number("H", 1, 0, _UNKNOWN),
    "slot_height_m": _METRES,
    "landing_x_m": _METRES,
    "landing_y_m": _METRES,
    "frame_id": _TAG,
    "bundle_tag": _TAG,
    "world_tag": _TAG,
    "time_base": _TAG,
    "time_s": _Number("d", 1, -1e9, 1e9),
    "time_uncertainty_s": _Number("f", 1, 0, 1e9),
}
_STRUCT = struct.Struct("<" + "".join(number.code for number in _FIELDS.values()))
BEACON_BYTES = _STRUCT.size
_NO_TIME = 0, 0.0, 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Beacon:
    """A robot's own state; positions as in `RobotStatus`, to 1 mm.

    `sent` is the send time, None until the sender knows the time. `bundle_tag` and `world_tag` are
    the `tag`s of its bundle and world; `frame_id` is 0 without a mission origin. `other_release` is
    the sender's release from the envelope, "" if it is the receiver's own.
    """

    robot_id: int
    sent: FleetTime | None
    position_m: Vector | None
    velocity_m_s: Vector | None
    frame_id: int
    bundle_tag: int
    world_tag: int = 0
    state: FlightState = FlightState.INIT
    armed: bool | None = None
    system_id: int | None = None
    gps_accuracy_m: float | None = None
    flown_s: float | None = None
    slot_height_m: float = 0.0
    landing_point_m: tuple[float, float] = (0.0, 0.0)
    other_release: str = ""


class ReceivedBeacon(Struct, frozen=True):
    """Another robot's beacon, its arrival and its earliest send time: monotonic clock, s."""

    beacon: Beacon
    received_at_s: float
    sent_at_s: float


class Neighbour(Struct, frozen=True, array_like=True):
    """Another robot: its position and velocity in the mission frame, as of `age_s` ago.

    `is_piloted`: its program does not fly it, or it is off its height, so its path is unknown.
    """

    robot_id: int
    position_m: Vector
    velocity_m_s: Vector
    age_s: float
    is_piloted: bool = False


def tag(name: str) -> int:
    """32-bit hash of a bundle's or a world's id, for robots to compare."""
    return zlib.crc32(name.encode())


def encode_beacon(beacon: Beacon) -> bytes:
    """The beacon's bytes, without the sender, which the envelope has."""
    position_m, velocity_m_s = beacon.position_m, beacon.velocity_m_s
    numbers = (*(position_m or ()), *(velocity_m_s or ()))
    placed = len(numbers) == 6 and all(map(math.isfinite, numbers))
    bits = _PLACED if placed else 0
    if beacon.armed is not None:
        bits |= _ARMED if beacon.armed else _DISARMED
    accuracy_m, flown_s = beacon.gps_accuracy_m, beacon.flown_s
    values = (
        *(numbers if placed else (0.0,) * 6),
        _STATES.index(beacon.state),
        bits,
        beacon.system_id or 0,
        _UNKNOWN if accuracy_m is None else _ceil_cm(accuracy_m),
        _UNKNOWN if flown_s is None else min(flown_s, _UNKNOWN - 1.0),
        beacon.slot_height_m,
        *beacon.landing_point_m,
        beacon.frame_id,
        beacon.bundle_tag,
        beacon.world_tag,
        *(structs.astuple(beacon.sent) if beacon.sent else _NO_TIME),
    )
    return _STRUCT.pack(*map(_packed, _FIELDS.values(), values))


def decode_beacon(data: bytes | memoryview, robot_id: int, other_release: str = "") -> Beacon:
    """The beacon at the start of `data`. Raises MessageError."""
    if len(data) < BEACON_BYTES:
        raise MessageError(f"Beacon: {len(data)} bytes: must be {BEACON_BYTES}")
    return _decoded(bytes(data[:BEACON_BYTES]), robot_id, other_release)


# In a simulator, the robots of one process decode the same bytes in turn.
@functools.lru_cache(maxsize=8)
def _decoded(body: bytes, robot_id: int, other_release: str) -> Beacon:
    values = []
    for (name, number), packed in zip(_FIELDS.items(), _STRUCT.unpack(body), strict=True):
        value = packed / number.steps if number.steps > 1 else packed
        if not number.least <= value <= number.greatest:
            raise MessageError(
                f"Beacon: {name} = {value}: must be from {number.least:g} to {number.greatest:g}"
            )
        values.append(value)
    (
        x_m, y_m, z_m, vx_m_s, vy_m_s, vz_m_s, state, bits, system_id, accuracy_cm, flown_s,
        slot_height_m, landing_x_m, landing_y_m, frame_id, bundle_tag, world_tag, base, time_s,
        uncertainty_s,
    ) = values  # fmt: skip
    placed = bool(bits & _PLACED)
    return Beacon(
        robot_id=robot_id,
        sent=FleetTime(base, time_s, uncertainty_s) if base else None,
        position_m=(x_m, y_m, z_m) if placed else None,
        velocity_m_s=(vx_m_s, vy_m_s, vz_m_s) if placed else None,
        frame_id=frame_id,
        bundle_tag=bundle_tag,
        world_tag=world_tag,
        state=_STATES[state],
        armed=True if bits & _ARMED else False if bits & _DISARMED else None,
        system_id=system_id or None,
        gps_accuracy_m=None if accuracy_cm == _UNKNOWN else accuracy_cm / 1e2,
        flown_s=None if flown_s == _UNKNOWN else float(flown_s),
        slot_height_m=slot_height_m,
        landing_point_m=(landing_x_m, landing_y_m),
        other_release=other_release,
    )


def _ceil_cm(value_m: float) -> int:
    # A rounding error must not make 2.0 cm 3.
    return math.ceil(min(value_m * 1e2, _UNKNOWN - 1.0) - 1e-6)


def _packed(number: _Number, value: float) -> float:
    # Bounded first: round() raises for infinity and NaN.
    bounded = min(max(value, number.least), number.greatest)
    return bounded if number.code in "fd" else round(bounded * number.steps)
