"""Lands a vehicle that hovers in PX4's hold mode while nobody has it: the robot's program does not.

Hangs share nothing with it but the socket; it needs the standard library alone. Whoever takes the
vehicle meanwhile, by any other mode, keeps it.
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
# After so long it is another flight.
_GAP_S = 30.0
# A program whose control loop alone hangs reads the same socket, and may take all that comes.
_DEAF_S = 10.0
_AGAIN_S = 1.0
_LOOK_S = 0.2
_HOVER_LAND_S = 60.0  # where the configuration says nothing: its own default
_DATAGRAM_BYTES = 2048


def land_if_left(
    udp: socket.socket,
    system_id: int,
    after_s: float,
    pipe: int | None = None,
    program: int | None = None,
    *,
    only_here: bool = False,
) -> bool:
    """Land the vehicle once it has hovered for `after_s`; True once it is down, or somebody's.

    False as soon as `pipe` can be read. `udp` hears the vehicle: its datagrams are read here, and
    nobody else gets them, unless `program`, the process that hangs, takes them still: it is killed
    if none comes. With `only_here` other computers' datagrams are nobody's. Mode OFFBOARD is PX4's
    to end: without setpoints it lands by itself.
    """
    heard_s = since_s = time.monotonic()
    asked_s, sequence = -_AGAIN_S, 0
    hovered = holds = False
    peer: tuple[str, int] | None = None
    while True:
        inputs = [udp.fileno()] if pipe is None else [udp.fileno(), pipe]
        readable, _, _ = select.select(inputs, [], [], _LOOK_S)
        now_s = time.monotonic()
        if pipe in readable:
            return False
        for beat, sender in _waiting(udp, only_here=only_here):
            if beat.system_id != system_id:
                continue
            if now_s - heard_s > _GAP_S:
                since_s, hovered, holds = now_s, False, False
            heard_s, peer = now_s, sender
            if not beat.armed:
                return _end("it is disarmed")
            if beat.mode in ("hold", "land"):
                # PX4 may go back to hold, and is asked again then.
                hovered, holds = True, beat.mode == "hold"
            elif hovered or beat.mode != "offboard":
                return _end(f"somebody has it: {beat.mode}")
        if program is not None and now_s - heard_s > _DEAF_S:
            say("the vehicle is not heard beside the program that hangs: kill the program")
            with suppress(OSError):
                os.kill(program, signal.SIGKILL)
            program = None
        if now_s - heard_s > max(after_s, _GAP_S) + _FRESH_S:
            return _end("it is not heard")
        due = holds and now_s - since_s >= after_s and now_s - heard_s < _FRESH_S
        if due and peer is not None and now_s - asked_s >= _AGAIN_S:
            say("nobody has taken the vehicle: land")
            asked_s, sequence = now_s, sequence + 1
            with suppress(OSError):
                udp.sendto(land_command(sequence, system_id, _COMPONENT), peer)


def _waiting(udp: socket.socket, *, only_here: bool) -> Iterator[tuple[Heartbeat, tuple[str, int]]]:
    """The heartbeats that have come, and from where."""
    with suppress(OSError):
        while True:
            data, address = udp.recvfrom(_DATAGRAM_BYTES, socket.MSG_DONTWAIT)
            if only_here and not address[0].startswith("127."):
                continue
            if (beat := heartbeat(data)) is not None:
                yield beat, (address[0], address[1])


def _end(how: str) -> bool:
    say(f"the vehicle that was left alone: {how}")
    return True


def say(text: str) -> None:
    """A line to whoever is left to read it."""
    with suppress(OSError):
        print(f"lpac: {text}", file=sys.stderr, flush=True)


def main() -> None:
    """For systemd, when it has given the robot's program up: `robot.toml` is the argument."""
    (path,) = sys.argv[1:]
    try:
        # Not as the program reads it: what the program refuses must not keep a vehicle in the air.
        config = tomllib.loads(Path(path).read_text("utf-8-sig"))
        host, port = config["autopilot"]["url"].rpartition("/")[2].rsplit(":", 1)
        port = int(port)
        system_id = int(config["autopilot"]["system_id"])
        after_s = float(config.get("flight", {}).get("hover_land_s", _HOVER_LAND_S))
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        say(f"{path}: the vehicle is not known: {error!r}")
        sys.exit(1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        # A program that is started again has the datagrams, since it asks for the port later.
        udp.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        udp.bind(("0.0.0.0", port))
        land_if_left(udp, system_id, after_s, only_here=host.startswith("127."))


if __name__ == "__main__":
    main()
