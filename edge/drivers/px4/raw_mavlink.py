"""Encoder and parser of the few MAVLink frames that are used without a MAVLink library.

Needs Python 3.6 and its standard library only: the watchdog loads nothing else, and `lpac fleet`
sends this file to the robot's own Python.
"""

import struct
from typing import Iterator, NamedTuple, Optional

_AUTOPILOT = 1  # component id
_HEARTBEAT, _COMMAND_LONG = 0, 76
_COMMAND_LONG_CRC = 152
_ARMED = 0x80
_NAV_LAND, _DO_SET_MODE = 21, 176
_CUSTOM_MODE, _MAIN_AUTO, _SUB_HOLD = 1.0, 4.0, 3.0
# PX4's main modes, and the sub modes of AUTO; `edge.core.vehicle.Mode` has the same names.
_AUTO = 4
_MAIN_MODES = {
    1: "manual",
    2: "altitude",
    3: "position",
    5: "manual",  # acro
    6: "offboard",
    7: "stabilized",
}
_AUTO_MODES = {2: "takeoff", 3: "hold", 4: "mission", 5: "return", 6: "land"}


class Heartbeat(NamedTuple):
    """An autopilot's HEARTBEAT; `autopilot` is a MAV_AUTOPILOT, `mode` the mode's name."""

    system_id: int
    autopilot: int
    armed: bool
    mode: str


def mode_name(custom_mode: int) -> str:
    """Name of PX4's custom mode; "other" for modes that no caller distinguishes."""
    main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
    return (_AUTO_MODES.get(sub) if main == _AUTO else _MAIN_MODES.get(main)) or "other"


def hold_command(sequence: int, system_id: int, component_id: int) -> bytes:
    """Command for PX4's hold mode; `system_id` is the vehicle's, `component_id` the sender's."""
    return _command(sequence, system_id, component_id, _DO_SET_MODE, _CUSTOM_MODE, _MAIN_AUTO,
                    _SUB_HOLD)  # fmt: skip


def land_command(sequence: int, system_id: int, component_id: int) -> bytes:
    """Command to land at the present place."""
    return _command(sequence, system_id, component_id, _NAV_LAND)


def _command(
    sequence: int, system_id: int, component_id: int, number: int, *parameters: float
) -> bytes:
    padded = parameters + (0.0,) * (7 - len(parameters))
    payload = struct.pack("<7fH3B", *padded, number, system_id, _AUTOPILOT, 0)
    header = struct.pack(
        "<6B3s", len(payload), 0, 0, sequence & 0xFF, system_id, component_id,
        _COMMAND_LONG.to_bytes(3, "little"),
    )  # fmt: skip
    checksum = _crc(header + payload + bytes([_COMMAND_LONG_CRC]))
    return b"\xfd" + header + payload + struct.pack("<H", checksum)


def _crc(data: bytes) -> int:
    """MAVLink's checksum, CRC-16/MCRF4XX."""
    crc = 0xFFFF
    for byte in data:
        mixed = byte ^ (crc & 0xFF)
        mixed ^= (mixed << 4) & 0xFF
        crc = (crc >> 8) ^ (mixed << 8) ^ (mixed << 3) ^ (mixed >> 4)
    return crc


class RawFrame(NamedTuple):
    """One MAVLink frame; `number` is its sequence number, `content` the whole frame."""

    system_id: int
    component_id: int
    message_id: int
    number: int
    payload: bytes
    content: bytes


def frames(data: bytes) -> Iterator[RawFrame]:
    """Yield a datagram's frames, up to the first invalid one."""
    while len(data) >= 8:
        if data[0] == 0xFD:  # MAVLink 2
            size, header = data[1], 10
            total = header + size + 2 + (13 if data[2] & 1 else 0)
        elif data[0] == 0xFE:  # MAVLink 1
            size, header = data[1], 6
            total = header + size + 2
        else:
            return
        if len(data) < total:
            return
        if header == 10:
            number, system, component = data[4], data[5], data[6]
            message = data[7] | data[8] << 8 | data[9] << 16
        else:
            number, system, component, message = data[2], data[3], data[4], data[5]
        payload = data[header : header + size]
        yield RawFrame(system, component, message, number, payload, data[:total])
        data = data[total:]


def heartbeat(data: bytes) -> Optional[Heartbeat]:
    """First heartbeat of an autopilot in a datagram; None if there is none."""
    for frame in frames(data):
        if frame.message_id == _HEARTBEAT and frame.component_id == _AUTOPILOT:
            # MAVLink 2 leaves out trailing zeros.
            payload = frame.payload.ljust(9, b"\0")
            custom_mode, _, autopilot, base_mode, _, _ = struct.unpack("<IBBBBB", payload[:9])
            return Heartbeat(
                frame.system_id, autopilot, bool(base_mode & _ARMED), mode_name(custom_mode)
            )
    return None
