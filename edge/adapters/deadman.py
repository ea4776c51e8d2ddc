"""A process of its own that lets the vehicle hold when the robot's control loop falls silent.

Whatever hangs in the robot's program, a loop, the interpreter or the whole process, this one does
not hang with it. When it ends itself, or both do, PX4's own failsafe lands the vehicle a moment
later. It starts with the standard library alone, so that it weighs little, and speaks the one
MAVLink message that it needs, through the same socket that the robot's program talks to PX4 with.
"""

import os
import select
import socket
import stat
import struct
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType

_FLYING, _IDLE = b"\1", b"\0"
_TIMES, _APART_S = 3, 0.1
_DATAGRAM_BYTES = 1

# COMMAND_LONG: message id, CRC seed, and DO_SET_MODE to PX4's main mode AUTO, sub mode LOITER.
_COMMAND_LONG, _CRC_EXTRA = 76, 152
_HOLD = (176, (1.0, 4.0, 3.0, 0.0, 0.0, 0.0, 0.0))
_AUTOPILOT, _WATCHDOG = 1, 197  # component ids


class DeadmanError(OSError):
    """The watchdog cannot be started; the text says why."""


class Deadman:
    """Starts and feeds the watchdog, as a context. `feed` belongs to the control thread.

    The vehicle holds `timeout_s` after the last `feed(flying=True)` that none followed.
    """

    def __init__(self, port: int, system_id: int, timeout_s: float) -> None:
        """`port` is the UDP port that this process receives the vehicle's datagrams on."""
        self._port = port
        self._system_id = system_id
        self._timeout_s = timeout_s
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe = -1

    def __enter__(self) -> "Deadman":
        """Raises DeadmanError if this process does not have the port open."""
        udp = _socket_on(self._port)
        reader, self._pipe = os.pipe()
        # A watchdog that hangs must not hang the control loop with it.
        os.set_blocking(self._pipe, False)
        arguments = [str(x) for x in (reader, udp, self._system_id, self._timeout_s)]
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", str(Path(__file__).resolve()), *arguments],
            stdin=subprocess.DEVNULL,
            pass_fds=(reader, udp),
            # It ends when the robot does, not by the terminal's signals.
            start_new_session=True,
        )
        os.close(reader)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        os.close(self._pipe)
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def feed(self, *, flying: bool) -> None:
        """The control loop is alive; `flying`: PX4 follows its setpoints."""
        try:
            os.write(self._pipe, _FLYING if flying else _IDLE)
        except OSError:
            # It hangs or is gone, which `alive` tells.
            return

    def alive(self) -> bool:
        """Whether the watchdog runs. Called from any thread."""
        return self._process is not None and self._process.poll() is None


def _socket_on(port: int) -> int:
    """The descriptor of this process's UDP socket on that port."""
    for link in Path("/proc/self/fd").iterdir():
        with suppress(OSError):
            descriptor = int(link.name)
            if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                continue
            with socket.socket(fileno=os.dup(descriptor)) as found:
                if found.type == socket.SOCK_DGRAM and found.getsockname()[1:2] == (port,):
                    return descriptor
    raise DeadmanError(f"no UDP socket on port {port} to guard: is the autopilot's url right?")


def _watch(pipe: int, udp: socket.socket, system_id: int, timeout_s: float) -> None:
    """Until the pipe ends: hold the vehicle whenever the robot that flies it falls silent."""
    peer: tuple[str, int] | None = None
    flying = False
    while True:
        # The peer is told by datagrams that the robot's program has not read yet.
        waited = [pipe] if peer else [pipe, udp.fileno()]
        readable, _, _ = select.select(waited, [], [], timeout_s)
        peer = _peer(udp) or peer
        if pipe in readable:
            fed = os.read(pipe, 4096)
            if not fed:
                return
            flying = fed[-1:] == _FLYING
        elif flying and not readable and peer is not None:
            _hold(udp, peer, system_id)
            _say(f"control loop silent for {timeout_s} s: hold")
            flying = False


def _peer(udp: socket.socket) -> tuple[str, int] | None:
    """Who sent the next datagram, which stays for the robot's program to read."""
    try:
        _, address = udp.recvfrom(_DATAGRAM_BYTES, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except OSError:
        return None
    return address[0], address[1]


def _hold(udp: socket.socket, peer: tuple[str, int], system_id: int) -> None:
    for sequence in range(_TIMES):
        try:
            udp.sendto(_hold_command(sequence, system_id), peer)
        except OSError as error:
            _say(f"hold not sent: {error}")
        time.sleep(_APART_S)


def _say(text: str) -> None:
    # Nobody may be left to read it.
    with suppress(OSError):
        print(f"lpac: {text}", file=sys.stderr, flush=True)


def _hold_command(sequence: int, system_id: int) -> bytes:
    """The MAVLink 2 frame that sets PX4's hold mode."""
    command, parameters = _HOLD
    payload = struct.pack("<7fH3B", *parameters, command, system_id, _AUTOPILOT, 0)
    header = struct.pack(
        "<6B3s", len(payload), 0, 0, sequence, system_id, _WATCHDOG,
        _COMMAND_LONG.to_bytes(3, "little"),
    )  # fmt: skip
    checksum = _crc(header + payload + bytes([_CRC_EXTRA]))
    return b"\xfd" + header + payload + struct.pack("<H", checksum)


def _crc(data: bytes) -> int:
    """CRC-16/MCRF4XX, as MAVLink has it."""
    crc = 0xFFFF
    for byte in data:
        mixed = byte ^ (crc & 0xFF)
        mixed ^= (mixed << 4) & 0xFF
        crc = (crc >> 8) ^ (mixed << 8) ^ (mixed << 3) ^ (mixed >> 4)
    return crc


if __name__ == "__main__":
    pipe_fd, udp_fd, vehicle, silence_s = sys.argv[1:]
    _watch(int(pipe_fd), socket.socket(fileno=int(udp_fd)), int(vehicle), float(silence_s))
