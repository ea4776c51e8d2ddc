"""Free ports for programs that bind them some seconds later.

The system may assign any of its ephemeral ports to another socket in the meantime. So these come
from below that range, in blocks, and each process keeps one block while it lives.
"""

import itertools
import random
import socket
from collections.abc import Iterator

_BLOCKS = range(20_000, 32_000, 200)


def free_ports(count: int) -> tuple[int, ...]:
    """Ports that are free now, and that this function gives to no other process.

    Raises OSError if too few are free.
    """
    found: list[int] = []
    for _ in range(_BLOCKS.step):
        if len(found) == count:
            return tuple(found)
        port = next(_own_ports)
        if _is_free(port):
            found.append(port)
    raise OSError(f"fewer than {count} ports from {_BLOCKS.start} to {_BLOCKS.stop} are free")


def _ports_of_a_block() -> Iterator[int]:
    """Cycle through the ports of a block that no other process holds."""
    for first in random.sample(_BLOCKS, len(_BLOCKS)):
        # Binding the first port of a block claims it among the processes.
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
