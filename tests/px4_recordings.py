"""Recordings of what a real PX4 and a robot's program said to each other: data/px4_v1.17."""

import gzip
import struct
from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from tests.conftest import ROOT

FOLDER = ROOT / "tests" / "data" / "px4_v1.17"
RECORDINGS = (
    "normal", "gps", "kill", "stop", "pilot", "battery", "battery_fast", "refused", "sensors_die",
)  # fmt: skip

_TIME_BYTES, _FRAME_BYTES, _SIGNATURE_BYTES = 8, 12, 13
_SIGNED = 1


class Recorded(NamedTuple):
    """One message of the dialect, and when it was on the link: s from the first."""

    time_s: float
    message: Any

    @property
    def is_px4(self) -> bool:
        """Whether the autopilot sent it, and not the robot's program or a ground station."""
        return bool(self.message.get_srcComponent() == mavlink.MAV_COMP_ID_AUTOPILOT1)


def frames(name: str) -> Iterator[tuple[float, bytes]]:
    """Each frame of one recording, both directions in order: s from the first."""
    data, at = gzip.decompress((FOLDER / f"{name}.tlog.gz").read_bytes()), 0
    first_us = struct.unpack_from(">Q", data)[0]
    while at < len(data):
        time_us = struct.unpack_from(">Q", data, at)[0]
        at += _TIME_BYTES
        signature_bytes = _SIGNATURE_BYTES if data[at + 2] & _SIGNED else 0
        end = at + _FRAME_BYTES + data[at + 1] + signature_bytes
        yield (time_us - first_us) / 1e6, data[at:end]
        at = end


@cache
def recorded(name: str) -> tuple[Recorded, ...]:
    """Everything in one recording, in order."""
    parser = mavlink.MAVLink(None)
    return tuple(
        Recorded(time_s, message)
        for time_s, frame in frames(name)
        for message in parser.parse_buffer(frame) or ()
    )
