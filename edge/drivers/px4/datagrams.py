"""UDP socket between MAVSDK and the vehicle, which drops duplicate and late frames.

MAVSDK's own socket reports neither sequence numbers nor senders. With it, duplicate and late
frames would count as new, and lost ones could not be counted.
"""

import socket
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from threading import Lock, Thread
from typing import NamedTuple

from edge.drivers.px4.raw_mavlink import RawFrame, frames
from edge.drivers.px4.reception import Frame, VehicleFrames

_AUTOPILOT = 1  # component id
_BYTES = 65535
_RECEIVE_TIMEOUT_S = 0.2
# Message -> format of the vehicle's time at the payload's start, and its unit, s.
_TIMES = {
    32: (struct.Struct("<I"), 1e-3),  # LOCAL_POSITION_NED
    33: (struct.Struct("<I"), 1e-3),  # GLOBAL_POSITION_INT
    230: (struct.Struct("<Q"), 1e-6),  # ESTIMATOR_STATUS
}


class LinkState(NamedTuple):
    """State of one vehicle's link: see `VehicleFrames`."""

    lost: float = 0.0
    has_duplicates: bool = False
    has_twin: bool = False


class Datagrams:
    """One UDP port; its thread passes accepted frames to a callback.

    Outgoing frames go to the address that sent the vehicle's frames. Thread-safe.
    """

    def __init__(self, host: str, port: int, on_frames: Callable[[bytes], None]) -> None:
        """Raises OSError."""
        self._system_id: int | None = None
        self._on_frames = on_frames
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        # `edge.drivers.px4.unattended` may still have the port open.
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._socket.bind((host, port))
        except OSError:
            self._socket.close()
            raise
        self._socket.settimeout(_RECEIVE_TIMEOUT_S)
        self._lock = Lock()
        self._receptions: dict[int, VehicleFrames] = {}
        self._closing = False
        self._thread = Thread(target=self._receive, name="mavlink")

    def start(self) -> None:
        """Start receiving."""
        self._thread.start()

    def follow(self, system_id: int) -> None:
        """Select the vehicle by system ID."""
        self._system_id = system_id

    def close(self) -> None:
        """Stop receiving, and close the socket."""
        self._closing = True
        if self._thread.ident is not None:
            self._thread.join()
        self._socket.close()

    def send(self, data: bytes) -> None:
        """Send to the vehicle. Does nothing before its first frame."""
        with self._lock:
            reception = self._receptions.get(self._system_id or 0)
            path = None if reception is None else reception.path
        if isinstance(path, tuple):
            with suppress(OSError):
                self._socket.sendto(data, path)

    def state(self, now_s: float) -> LinkState:
        """State of the selected vehicle's link."""
        with self._lock:
            reception = self._receptions.get(self._system_id or 0)
            if reception is None:
                return LinkState()
            return LinkState(
                reception.lost(now_s), reception.has_duplicates(now_s), reception.has_twin(now_s)
            )

    def _receive(self) -> None:
        while not self._closing:
            try:
                data, address = self._socket.recvfrom(_BYTES)
            except OSError:
                continue
            accepted = b"".join(
                frame.content for frame in frames(data) if self._accept(frame, address)
            )
            if accepted:
                self._on_frames(accepted)

    def _accept(self, frame: RawFrame, address: tuple[str, int]) -> bool:
        if frame.component_id != _AUTOPILOT:
            return True  # other components and ground stations count their own sequences
        vehicle_s = None
        if frame.message_id in _TIMES:
            begin, unit_s = _TIMES[frame.message_id]
            # MAVLink 2 leaves out trailing zeros.
            (count,) = begin.unpack_from(frame.payload.ljust(begin.size, b"\0"))
            vehicle_s = count * unit_s
        received = Frame(address, frame.number, frame.content, frame.message_id, vehicle_s)
        with self._lock:
            reception = self._receptions.setdefault(frame.system_id, VehicleFrames())
            return reception.accept(received, time.monotonic())
