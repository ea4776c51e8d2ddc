"""Watchdog process: commands hold when the robot's control loop falls silent.

As a separate process it survives a hang of a loop, the interpreter or the whole program. After its
hold command it lands the vehicle unless somebody has taken it. If the watchdog dies too, PX4's own
failsafe lands the vehicle a moment later. To save memory it loads the standard library only. Its
two MAVLink messages go through the socket that the robot's program uses for PX4.
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

from edge.drivers.px4.raw_mavlink import hold_command
from edge.drivers.px4.unattended import land_unattended, print_line

_FLYING, _IDLE = b"\1", b"\0"
_REPEATS, _REPEAT_S = 3, 0.1
_DATAGRAM_BYTES = 1

_WATCHDOG = 197  # component id
# Datagrams stay in the socket this long, so that a program that recovers misses none.
_KEEP_DATAGRAMS_S = 3.0
# The path of an isolated interpreter does not include the package.
_PROGRAM = """
import sys
sys.path.append(sys.argv.pop(1))
from edge.drivers.px4.watchdog import main
main()
"""


class WatchdogError(OSError):
    """The watchdog cannot be started; the text says why."""


class WatchdogProcess:
    """Context that starts, feeds and ends the watchdog.

    The vehicle holds `timeout_s` after the last call of `feed`, if that had `flying=True`. It lands
    `hover_land_s` after that call unless `feed` is called again or anybody selects another mode.
    """

    def __init__(self, port: int, system_id: int, timeout_s: float, hover_land_s: float) -> None:
        """`port` is the UDP port on which this process receives the vehicle's datagrams."""
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
            # The terminal's signals must not end it: it ends with the robot's program.
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
        """Report that the control loop runs; `flying`: whether PX4 follows the robot's setpoints.

        Called from the control thread only.
        """
        try:
            os.write(self._pipe, _FLYING if flying else _IDLE)
        except OSError:
            return  # the watchdog hangs or has died: see `alive`

    def alive(self) -> bool:
        """Whether the watchdog runs. Thread-safe."""
        return self._process is not None and self._process.poll() is None


def _socket_on(port: int) -> int:
    """Find the descriptor of this process's UDP socket on that port."""
    for link in Path("/proc/self/fd").iterdir():
        with suppress(OSError):
            descriptor = int(link.name)
            if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                continue
            with socket.socket(fileno=os.dup(descriptor)) as found:
                if found.type == socket.SOCK_DGRAM and found.getsockname()[1:2] == (port,):
                    return descriptor
    raise WatchdogError(f"no UDP socket on port {port}: check the autopilot's url")


def _watch(
    pipe: int, udp: socket.socket, system_id: int, timeout_s: float, hover_land_s: float
) -> None:
    """Command hold whenever a flying robot falls silent, and then land the vehicle if unattended.

    Returns once the pipe is closed and a vehicle in hold has landed or been taken.
    """
    peer: tuple[str, int] | None = None
    flying = held = False
    fed_s = time.monotonic()
    while True:
        # Unread datagrams show the vehicle's address.
        waited = [pipe] if peer else [pipe, udp.fileno()]
        readable, _, _ = select.select(waited, [], [], timeout_s)
        peer = _peer(udp) or peer
        if flying and not readable and peer is not None:
            _hold(udp, peer, system_id)
            print_line(f"control loop silent for {timeout_s} s: hold")
            held = True
            if not select.select([pipe], [], [], _KEEP_DATAGRAMS_S)[0]:
                # Datagrams read here never reach the robot's program; they would be stale by then.
                left_s = fed_s + hover_land_s - time.monotonic()
                held = not land_unattended(udp, system_id, left_s, pipe, os.getppid())
        elif pipe not in readable:
            continue
        fed = os.read(pipe, 4096)
        if not fed:
            break
        fed_s = time.monotonic()
        flying = fed[-1:] == _FLYING
        held = held and not flying
    if held:
        land_unattended(udp, system_id, fed_s + hover_land_s - time.monotonic())


def _peer(udp: socket.socket) -> tuple[str, int] | None:
    """Sender of the next datagram, which stays unread for the robot's program."""
    try:
        _, address = udp.recvfrom(_DATAGRAM_BYTES, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except OSError:
        return None
    return address[0], address[1]


def _hold(udp: socket.socket, peer: tuple[str, int], system_id: int) -> None:
    for sequence in range(_REPEATS):
        try:
            udp.sendto(hold_command(sequence, system_id, _WATCHDOG), peer)
        except OSError as error:
            print_line(f"hold not sent: {error}")
        time.sleep(_REPEAT_S)


def main() -> None:
    """Run in the watchdog's process."""
    pipe, udp, system_id, timeout_s, hover_land_s = sys.argv[1:]
    _watch(
        int(pipe), socket.socket(fileno=int(udp)), int(system_id), float(timeout_s),
        float(hover_land_s),
    )  # fmt: skip
