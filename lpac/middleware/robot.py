"""`python -m lpac.middleware.robot INDEX ENDPOINT...`: the radio traffic of a robot's program.

Sends messages of a robot's size and rate, and reports received ones. Each start is a process forked
from this one with the middleware already loaded: imports would load the processors for seconds.
Commands are lines on standard input; its end ends the process:

- `load MIDDLEWARE`: import it before forking; answered with `loaded`;
- `start MIDDLEWARE ROBOTS START`: run program number `START` in a fleet of `ROBOTS`. A running one
  is terminated first, as by systemd;
- `stop`: answered with `stopped`.

Output lines, times in ns of this machine's monotonic clock:

- `sent START SEQUENCE AT` and `received START FROM FROM_START SEQUENCE SENT AT`;
- `failed TEXT`: a program ended unexpectedly, or does not terminate.
"""

import os
import random
import signal
import struct
import sys
import time
from collections.abc import Sequence

from edge.drivers.stop import Stop
from edge.messages.topics import MESSAGE
from lpac.middleware.kinds import MIDDLEWARES
from lpac.radio.airtime import MESSAGE_BYTES

SIZE_BYTES = round(MESSAGE_BYTES["float16"])
# Robot, start, sequence, time sent.
_HEAD = struct.Struct("<HHIq")
_LEAVES_WITHIN_S = 10.0
_LOOK_AGAIN_S = 0.01


def _write_line(*words: object) -> None:
    """Write one whole line, from any thread and process."""
    os.write(sys.stdout.fileno(), " ".join(map(str, words)).encode() + b"\n")


class _Program:
    """The process that is the robot's present program."""

    def __init__(self, index: int, endpoints: Sequence[str]) -> None:
        self._index = index
        self._endpoints = endpoints
        self._pid: int | None = None

    def start(self, middleware: str, robots: int, start: int) -> None:
        self.stop()
        parent = os.getpid()
        self._pid = os.fork()
        if self._pid == 0:
            status = 1
            try:
                self._run(middleware, robots, start, parent)
                status = 0
            except BaseException as error:
                _write_line("failed", *str(error).split())
            finally:
                # Threads of a middleware can block a normal exit of the interpreter.
                os._exit(status)

    def stop(self) -> None:
        if self._pid is None:
            return
        pid, self._pid = self._pid, None
        os.kill(pid, signal.SIGTERM)
        patience_until_s = time.monotonic() + _LEAVES_WITHIN_S
        while (ended := os.waitpid(pid, os.WNOHANG)) == (0, 0):
            if time.monotonic() > patience_until_s:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
                _write_line("failed", "its program hangs and does not terminate")
                return
            time.sleep(_LOOK_AGAIN_S)
        # Before the handler is installed, SIGTERM itself ends the process.
        if ended[1] not in (0, signal.SIGTERM):
            _write_line("failed", "its program ended unexpectedly, with status", ended[1])

    def _run(self, middleware: str, robots: int, start: int, parent: int) -> None:
        stopped = Stop()
        signal.signal(signal.SIGTERM, lambda *_: stopped.set())

        def receive(data: bytes) -> None:
            at_ns = time.monotonic_ns()
            robot, sender_start, sequence, sent_ns = _HEAD.unpack_from(data)
            if robot != self._index:
                _write_line("received", start, robot, sender_start, sequence, sent_ns, at_ns)

        open_peer = MIDDLEWARES[middleware].open_peer()
        period_s = 1.0 / MESSAGE.rate_hz
        with open_peer(self._index, self._endpoints[:robots], receive) as peer:
            # Robots are not synchronised.
            due_s = time.monotonic() + random.SystemRandom().uniform(0.0, period_s)
            sequence = 0
            while not stopped.wait(max(0.0, due_s - time.monotonic())) and os.getppid() == parent:
                sent_ns = time.monotonic_ns()
                head = _HEAD.pack(self._index, start, sequence, sent_ns)
                peer.publish(head.ljust(SIZE_BYTES, b"\0"))
                _write_line("sent", start, sequence, sent_ns)
                sequence += 1
                due_s += period_s


def main() -> None:
    """Execute the commands on standard input."""
    index, endpoints = int(sys.argv[1]), sys.argv[2:]
    program = _Program(index, endpoints)
    for line in sys.stdin:
        match line.split():
            case ["load", middleware]:
                MIDDLEWARES[middleware].open_peer()
                _write_line("loaded")
            case ["start", middleware, robots, start]:
                program.start(middleware, int(robots), int(start))
            case ["stop"]:
                program.stop()
                _write_line("stopped")
    program.stop()


if __name__ == "__main__":
    main()
