"""The UDP socket between MAVSDK and the vehicle: what comes in is sorted before MAVSDK has it.

MAVSDK's own socket tells neither the frames' numbers nor where they came from, so that a frame that
comes twice or late would count as news, and nobody would know how many are lost.
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
_LOOK_S = 0.2
# Message -> how its payload begins, with the vehicle's time, and that in s.
_TIMES = {
    32: (struct.Struct("<I"), 1e-3),  # LOCAL_POSITION_NED
    33: (struct.Struct("<I"), 1e-3),  # GLOBAL_POSITION_INT
    230: (struct.Struct("<Q"), 1e-6),  # ESTIMATOR_STATUS
}


class LinkState(NamedTuple):
    """How one vehicle's frames arrive: see `VehicleFrames`."""

    lost: float = 0.0
    twice: bool = False
    has_others: bool = False


class Datagrams:
    """One UDP port; a thread of its own passes on the frames that are taken.

    Answers go to where the vehicle's frames come from. Every method may be called from any thread.
    """

    def __init__(self, host: str, port: int, pass_on: Callable[[bytes], None]) -> None:
        """Raises OSError."""
        self._system_id: int | None = None
        self._pass_on = pass_on
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        # What lands a vehicle that was left alone may have the port still.
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._socket.bind((host, port))
        except OSError:
            self._socket.close()
            raise
        self._socket.settimeout(_LOOK_S)
        self._lock = Lock()
        self._receptions: dict[int, VehicleFrames] = {}
        self._closing = False
        self._thread = Thread(target=self._receive, name="mavlink")

    def start(self) -> None:
        """Begin to receive."""
        self._thread.start()

    def follow(self, system_id: int) -> None:
        """Select the vehicle by system ID."""
        self._system_id = system_id

    def close(self) -> None:
        """Neither receive nor send any more."""
        self._closing = True
        if self._thread.ident is not None:
            self._thread.join()
        self._socket.close()

    def send(self, data: bytes) -> None:
        """To the vehicle, if it was heard."""
        with self._lock:
            reception = self._receptions.get(self._system_id or 0)
            path = None if reception is None else reception.path
        if isinstance(path, tuple):
            # UDP: what cannot be sent is lost.
            with suppress(OSError):
                self._socket.sendto(data, path)

    def state(self, now_s: float) -> LinkState:
        """How the vehicle's frames arrive."""
        with self._lock:
            reception = self._receptions.get(self._system_id or 0)
            if reception is None:
                return LinkState()
            return LinkState(
                reception.lost(now_s), reception.arrives_twice(now_s), reception.has_others(now_s)
            )

    def _receive(self) -> None:
        while not self._closing:
            try:
                data, address = self._socket.recvfrom(_BYTES)
            except OSError:
                continue
            taken = b"".join(frame.content for frame in frames(data) if self._take(frame, address))
            if taken:
                self._pass_on(taken)

    def _take(self, frame: RawFrame, address: tuple[str, int]) -> bool:
        """Other parts of the vehicle, and ground stations, have numbers of their own."""
        if frame.component_id != _AUTOPILOT:
            return True
        vehicle_s = None
        if frame.message_id in _TIMES:
            begin, unit_s = _TIMES[frame.message_id]
            # Trailing zeros are left out.
            (count,) = begin.unpack_from(frame.payload.ljust(begin.size, b"\0"))
            vehicle_s = count * unit_s
        told = Frame(address, frame.number, frame.content, frame.message_id, vehicle_s)
        with self._lock:
            reception = self._receptions.setdefault(frame.system_id, VehicleFrames())
            return reception.take(told, time.monotonic())
