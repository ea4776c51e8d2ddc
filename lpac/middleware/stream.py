"""`python -m lpac.middleware.stream receive ADDRESS`, or `send ADDRESS PORT`: a TCP bulk stream.

The receiver prints `listening PORT`. It answers each line on standard input with
`received BYTES AT`: the total, and the time in ns of this machine's monotonic clock. Both end with
their standard input.
"""

import os
import select
import socket
import sys
import time
from contextlib import ExitStack

_BLOCK = 2**17
_CONNECT_WITHIN_S = 20.0


def _write_line(*words: object) -> None:
    os.write(sys.stdout.fileno(), " ".join(map(str, words)).encode() + b"\n")


def _read_input() -> bool:
    """Consume input; False at its end."""
    return bool(os.read(sys.stdin.fileno(), 1024))


def receive(address: str) -> None:
    """Receive from the first sender that connects."""
    asks, buffer, count = sys.stdin.fileno(), bytearray(_BLOCK), 0
    with ExitStack() as stack:
        server = stack.enter_context(socket.create_server((address, 0)))
        _write_line("listening", server.getsockname()[1])
        stream: socket.socket | None = None
        listened: list[socket.socket | int] = [asks, server]
        while True:
            readable, _, _ = select.select(listened, [], [])
            if server in readable:
                stream = stack.enter_context(server.accept()[0])
                listened = [asks, stream]
            if stream in readable:
                assert stream is not None
                got = stream.recv_into(buffer)
                count += got
                if not got:
                    listened = [asks]
            if asks in readable:
                if not _read_input():
                    return
                _write_line("received", count, time.monotonic_ns())


def send(address: str, port: int) -> None:
    """Send until standard input or the receiver closes."""
    asks, block = sys.stdin.fileno(), bytes(_BLOCK)
    with socket.create_connection((address, port), timeout=_CONNECT_WITHIN_S) as stream:
        stream.setblocking(False)
        while True:
            readable, writable, _ = select.select([asks], [stream], [])
            if readable:
                return
            if writable:
                stream.send(block)


def main() -> None:
    """Run; a failure is one line, `failed TEXT`."""
    try:
        match sys.argv[1:]:
            case ["receive", address]:
                receive(address)
            case ["send", address, port]:
                send(address, int(port))
    except OSError as error:
        _write_line("failed", *str(error).split())


if __name__ == "__main__":
    main()
