"""Stop request from a signal handler to the main thread."""

import os
import select
from contextlib import suppress


class Stop:
    """Flag that a signal handler or any thread sets, and that the main thread waits for.

    A `threading.Event` could deadlock: a handler interrupts the main thread within `wait`, and its
    `set` waits for the lock that `wait` holds. This flag is a byte in a pipe, never read back.
    """

    def __init__(self) -> None:
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)

    def set(self) -> None:
        """Ask the program to end. May be repeated."""
        with suppress(BlockingIOError):
            os.write(self._writer, b"\0")

    def is_set(self) -> bool:
        """Whether the program must end."""
        return self.wait(0.0)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the flag is set, for at most `timeout_s`; returns whether it is set."""
        readable, _, _ = select.select([self._reader], [], [], timeout_s)
        return bool(readable)
