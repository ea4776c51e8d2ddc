"""A process of its own that lets the vehicle hold when the robot's control loop falls silent.

Whatever hangs in the robot's program, a loop, the interpreter or the whole process, this one does
not hang with it. When it ends itself, or both do, PX4's own failsafe lands the vehicle a moment
later. A vehicle that it let hold, and that nobody has taken since, it lands. It starts with the
standard library alone, so that it weighs little, and speaks the two MAVLink messages that it needs
through the same socket that the robot's program talks to PX4 with.
"""

import os
import select
import socket
import stat
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from edge.drivers.px4.left_alone import land_if_left, say
from edge.drivers.px4.raw_mavlink import hold_command

_FLYING, _IDLE = b"\1", b"\0"
_TIMES, _APART_S = 3, 0.1
_DATAGRAM_BYTES = 1

_WATCHDOG = 197  # component id
# A program that is back sooner has missed nothing that it was told.
_LEAVE_S = 3.0
# The package's folder is on no path of an isolated interpreter.
_PROGRAM = """
import sys
sys.path.append(sys.argv.pop(1))
from edge.drivers.px4.watchdog import main
main()
"""


class WatchdogError(OSError):
    """The watchdog cannot be started; the text says why."""


class WatchdogProcess:
    """Starts and feeds the watchdog, as a context. `feed` belongs to the control thread.

    The vehicle holds `timeout_s` after the last `feed(flying=True)` that none followed, and lands
    `hover_land_s` later, unless `feed` was called or anybody gave it another mode.
    """

    def __init__(self, port: int, system_id: int, timeout_s: float, hover_land_s: float) -> None:
        """`port` is the UDP port that this process receives the vehicle's datagrams on."""
        self._port = port
        self._system_id = system_id
        self._timeout_s = timeout_s
        self._hover_land_s = hover_land_s
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe = -1

    def __enter__(self) -> "WatchdogProcess":
        """Raises WatchdogError if this process does not have the port open."""
        udp = _socket_on(self._port)
        reader, self._pipe = os.pipe()
        # A watchdog that hangs must not hang the control loop with it.
        os.set_blocking(self._pipe, False)
        numbers = (reader, udp, self._system_id, self._timeout_s, self._hover_land_s)
        root = str(Path(__file__).resolve().parents[3])
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _PROGRAM, root, *map(str, numbers)],
            stdin=subprocess.DEVNULL,
            pass_fds=(reader, udp),
            # It ends when the robot does, not by the terminal's signals.
            start_new_session=True,
        )
        os.close(reader)
        return self

    def __exit__(self, *_: object) -> None:
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
    raise WatchdogError(f"no UDP socket on port {port} to guard: is the autopilot's url right?")


def _watch(
    pipe: int, udp: socket.socket, system_id: int, timeout_s: float, hover_land_s: float
) -> None:
    """Hold the vehicle whenever the robot that flies it falls silent, and land what is left so.

    Ends with the pipe, but not before a vehicle that holds has somebody or has landed.
    """
    peer: tuple[str, int] | None = None
    flying = held = False
    fed_s = time.monotonic()
    while True:
        # The peer is told by datagrams that the robot's program has not read yet.
        waited = [pipe] if peer else [pipe, udp.fileno()]
        readable, _, _ = select.select(waited, [], [], timeout_s)
        peer = _peer(udp) or peer
        if flying and not readable and peer is not None:
            _hold(udp, peer, system_id)
            say(f"control loop silent for {timeout_s} s: hold")
            held = True
            if not select.select([pipe], [], [], _LEAVE_S)[0]:
                # What is read there the robot's program misses: it would be old by then.
                left_s = fed_s + hover_land_s - time.monotonic()
                held = not land_if_left(udp, system_id, left_s, pipe, os.getppid())
        elif pipe not in readable:
            continue
        fed = os.read(pipe, 4096)
        if not fed:
            break
        fed_s = time.monotonic()
        flying = fed[-1:] == _FLYING
        held = held and not flying
    if held:
        land_if_left(udp, system_id, fed_s + hover_land_s - time.monotonic())


def _peer(udp: socket.socket) -> tuple[str, int] | None:
    """Sender of the next datagram, which stays for the robot's program to read."""
    try:
        _, address = udp.recvfrom(_DATAGRAM_BYTES, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except OSError:
        return None
    return address[0], address[1]


def _hold(udp: socket.socket, peer: tuple[str, int], system_id: int) -> None:
    for sequence in range(_TIMES):
        try:
            udp.sendto(hold_command(sequence, system_id, _WATCHDOG), peer)
        except OSError as error:
            say(f"hold not sent: {error}")
        time.sleep(_APART_S)


def main() -> None:
    """The watchdog's own process."""
    pipe, udp, system_id, timeout_s, hover_land_s = sys.argv[1:]
    _watch(
        int(pipe), socket.socket(fileno=int(udp)), int(system_id), float(timeout_s),
        float(hover_land_s),
    )  # fmt: skip
