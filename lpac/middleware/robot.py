"""`python -m lpac.middleware.robot INDEX ENDPOINT...`: a robot's program, as far as the radio goes.

It says a message as large, and as often, as a robot does, and tells what it hears. Each start is a
process of its own, forked from this one, so that it has its middleware at once: seconds of imports
would take the processors from what is measured. The commands are lines on its standard input,
whose end ends it:

- `load MIDDLEWARE`: what the forks will need; answered with `loaded`;
- `start MIDDLEWARE ROBOTS START`: the `START`th program, in a fleet of so many. One that runs is
  told to leave first, as systemd does it;
- `stop`: answered with `stopped`.

It says, times in ns of this machine's monotonic clock:

- `sent START SEQUENCE AT` and `heard START FROM FROM_START SEQUENCE SENT AT`;
- `failed TEXT`: its program has ended by itself, or does not leave.
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
# Robot, start, sequence, when it was sent.
_HEAD = struct.Struct("<HHIq")
_LEAVES_WITHIN_S = 10.0
_LOOK_AGAIN_S = 0.01


def _say(*words: object) -> None:
    """One line, whole, from whatever thread and process."""
    os.write(sys.stdout.fileno(), " ".join(map(str, words)).encode() + b"\n")


class _Program:
    """The process that is the robot's program now."""

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
                _say("failed", *str(error).split())
            finally:
                # A middleware's threads may hold an interpreter that ends in the ordinary way.
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
                _say("failed", "its program stands still, and does not leave")
                return
            time.sleep(_LOOK_AGAIN_S)
        # Of a signal that came before it listened to any, it leaves too.
        if ended[1] not in (0, signal.SIGTERM):
            _say("failed", "its program has ended by itself, with", ended[1])

    def _run(self, middleware: str, robots: int, start: int, parent: int) -> None:
        stopped = Stop()
        signal.signal(signal.SIGTERM, lambda *_: stopped.set())

        def receive(data: bytes) -> None:
            at_ns = time.monotonic_ns()
            robot, its_start, sequence, sent_ns = _HEAD.unpack_from(data)
            if robot != self._index:
                _say("heard", start, robot, its_start, sequence, sent_ns, at_ns)

        open_peer = MIDDLEWARES[middleware].open_peer()
        period_s = 1.0 / MESSAGE.rate_hz
        with open_peer(self._index, self._endpoints[:robots], receive) as peer:
            # Robots do not keep step.
            due_s = time.monotonic() + random.SystemRandom().uniform(0.0, period_s)
            sequence = 0
            while not stopped.wait(max(0.0, due_s - time.monotonic())) and os.getppid() == parent:
                sent_ns = time.monotonic_ns()
                head = _HEAD.pack(self._index, start, sequence, sent_ns)
                peer.publish(head.ljust(SIZE_BYTES, b"\0"))
                _say("sent", start, sequence, sent_ns)
                sequence += 1
                due_s += period_s


def main() -> None:
    """Obey the lines of the standard input."""
    index, endpoints = int(sys.argv[1]), sys.argv[2:]
    program = _Program(index, endpoints)
    for line in sys.stdin:
        match line.split():
            case ["load", middleware]:
                MIDDLEWARES[middleware].open_peer()
                _say("loaded")
            case ["start", middleware, robots, start]:
                program.start(middleware, int(robots), int(start))
            case ["stop"]:
                program.stop()
                _say("stopped")
    program.stop()


if __name__ == "__main__":
    main()
