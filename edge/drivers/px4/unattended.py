"""Lands an unattended vehicle, which hovers in PX4's hold mode.

The robot's program hangs or has died. This module shares only the socket with it, and needs the
standard library alone. Once anybody selects another mode, the vehicle is theirs and is not landed.
"""

import os
import select
import signal
import socket
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from edge.drivers.px4.raw_mavlink import Heartbeat, heartbeat, land_command

_COMPONENT = 197  # as the watchdog
# PX4 sends heartbeats at 1 Hz.
_FRESH_S = 2.5
# Heartbeats after a longer gap belong to another flight.
_GAP_S = 30.0
# If only the control loop hangs, the program still reads the same socket, perhaps every datagram.
_STARVED_S = 10.0
_REPEAT_S = 1.0
_POLL_S = 0.2
_HOVER_LAND_S = 60.0  # default of the configuration
_DATAGRAM_BYTES = 2048


def land_unattended(
    udp: socket.socket,
    system_id: int,
    after_s: float,
    pipe: int | None = None,
    program: int | None = None,
    *,
    local_only: bool = False,
) -> bool:
    """Land the vehicle once it has hovered for `after_s`.

    Returns True once the vehicle is disarmed, taken by somebody or silent, False as soon as `pipe`
    is readable. Datagrams are read from `udp`, and no other reader gets them. If `program`, the
    process that hangs, still reads all of them, it is killed. With `local_only`, datagrams of other
    computers are ignored. A vehicle in mode OFFBOARD is left to PX4, which lands it when setpoints
    end.
    """
    received_s = since_s = time.monotonic()
    commanded_s, sequence = -_REPEAT_S, 0
    hovered = holds = False
    peer: tuple[str, int] | None = None
    while True:
        inputs = [udp.fileno()] if pipe is None else [udp.fileno(), pipe]
        readable, _, _ = select.select(inputs, [], [], _POLL_S)
        now_s = time.monotonic()
        if pipe in readable:
            return False
        for beat, sender in _received(udp, local_only=local_only):
            if beat.system_id != system_id:
                continue
            if now_s - received_s > _GAP_S:
                since_s, hovered, holds = now_s, False, False
            received_s, peer = now_s, sender
            if not beat.armed:
                return _end("it is disarmed")
            if beat.mode in ("hold", "land"):
                # PX4 may return from land to hold; the command is then repeated.
                hovered, holds = True, beat.mode == "hold"
            elif hovered or beat.mode != "offboard":
                return _end(f"somebody has taken it: {beat.mode}")
        if program is not None and now_s - received_s > _STARVED_S:
            print_line("the hanging program reads all datagrams of the vehicle: kill it")
            with suppress(OSError):
                os.kill(program, signal.SIGKILL)
            program = None
        if now_s - received_s > max(after_s, _GAP_S) + _FRESH_S:
            return _end("no heartbeat arrives")
        due = holds and now_s - since_s >= after_s and now_s - received_s < _FRESH_S
        if due and peer is not None and now_s - commanded_s >= _REPEAT_S:
            print_line("nobody has taken the vehicle: land")
            commanded_s, sequence = now_s, sequence + 1
            with suppress(OSError):
                udp.sendto(land_command(sequence, system_id, _COMPONENT), peer)


def _received(
    udp: socket.socket, *, local_only: bool
) -> Iterator[tuple[Heartbeat, tuple[str, int]]]:
    """Yield the heartbeats received by now, with their senders."""
    with suppress(OSError):
        while True:
            data, address = udp.recvfrom(_DATAGRAM_BYTES, socket.MSG_DONTWAIT)
            if local_only and not address[0].startswith("127."):
                continue
            if (beat := heartbeat(data)) is not None:
                yield beat, (address[0], address[1])


def _end(how: str) -> bool:
    print_line(f"unattended vehicle: {how}")
    return True


def print_line(text: str) -> None:
    """Print to standard error; a closed one is no error."""
    with suppress(OSError):
        print(f"lpac: {text}", file=sys.stderr, flush=True)


def main() -> None:
    """Run for systemd when it has given up the robot's program; the argument is `robot.toml`."""
    (path,) = sys.argv[1:]
    try:
        # Read leniently: a file that the program refuses must not keep a vehicle in the air.
        config = tomllib.loads(Path(path).read_text("utf-8-sig"))
        host, port = config["autopilot"]["url"].rpartition("/")[2].rsplit(":", 1)
        port = int(port)
        system_id = int(config["autopilot"]["system_id"])
        after_s = float(config.get("flight", {}).get("hover_land_s", _HOVER_LAND_S))
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        print_line(f"{path}: does not say which vehicle to land: {error!r}")
        sys.exit(1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        # A restarted program binds later, and so gets the datagrams.
        udp.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        udp.bind(("0.0.0.0", port))
        land_unattended(udp, system_id, after_s, local_only=host.startswith("127."))


if __name__ == "__main__":
    main()
