"""Lock that only one process on a machine can hold."""

import errno
import socket
import struct
from typing import Self


class ProcessLock:
    """Context that reserves `what` for this process.

    The lock is an abstract socket name: it needs no file and vanishes with its process. Containers
    in one network namespace share these names, as they share ports.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._socket = socket.socket(socket.AF_UNIX)

    def __enter__(self) -> Self:
        """Raises OSError, one line, if another process holds the lock."""
        name = f"\0lpac {self._what}"
        try:
            self._socket.bind(name)
        except OSError as error:
            self._socket.close()
            if error.errno != errno.EADDRINUSE:
                raise
            raise OSError(
                f"{self._what} is in use by {_holder(name)} on this machine: stop that first"
            ) from None
        self._socket.listen()
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()


def _holder(name: str) -> str:
    with socket.socket(socket.AF_UNIX) as caller:
        try:
            caller.connect(name)
        except OSError:
            return "another process"
        pid, _, _ = struct.unpack(
            "3i", caller.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
        )
    return f"process {pid}" if pid else "another container"
