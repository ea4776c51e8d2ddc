"""Ports of this machine for programs that will bind them later, some seconds from now.

A port that the system finds free can be anybody's a moment later: it gives them to every socket
that asks for none in particular. So these are of a range that it does not give away by itself, in
blocks, and each process keeps one block for as long as it lives.
"""

import itertools
import random
import socket
from collections.abc import Iterator

_BLOCKS = range(20_000, 32_000, 200)


def free_ports(count: int) -> tuple[int, ...]:
    """Ports that nobody has now, and that no other process gets from here.

    Raises OSError if there are not so many.
    """
    found: list[int] = []
    for _ in range(_BLOCKS.step):
        if len(found) == count:
            return tuple(found)
        port = next(_own_ports)
        if _is_free(port):
            found.append(port)
    raise OSError(f"no {count} free ports from {_BLOCKS.start} to {_BLOCKS.stop}")


def _ports_of_a_block() -> Iterator[int]:
    """Those of a block that no other process has, again and again."""
    for first in random.sample(_BLOCKS, len(_BLOCKS)):
        # The first port of a block is held, and says so to the other processes.
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as held:
            try:
                held.bind(("127.0.0.1", first))
            except OSError:
                continue
            yield from itertools.cycle(range(first + 1, first + _BLOCKS.step))
    raise OSError(f"all ports from {_BLOCKS.start} to {_BLOCKS.stop} are claimed")


_own_ports = _ports_of_a_block()


def _is_free(port: int) -> bool:
    for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM):
        with socket.socket(socket.AF_INET, kind) as probe:
            try:
                probe.bind(("", port))
            except OSError:
                return False
    return True
