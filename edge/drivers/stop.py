"""Request to end the program, passed from a signal handler to the main thread."""

import os
import select
from contextlib import suppress


class Stop:
    """Asked for by a signal handler, or from any thread; awaited by the main thread.

    A `threading.Event` would not do: a handler interrupts the main thread in the midst of its
    `wait`, whose lock the handler's `set` would then wait for for ever. Here it is a byte in a
    pipe, which stays for as long as the program runs.
    """

    def __init__(self) -> None:
        self._asked, self._ask = os.pipe()
        os.set_blocking(self._ask, False)

    def set(self) -> None:
        """The program is to end; again is no error."""
        with suppress(BlockingIOError):
            os.write(self._ask, b"\0")

    def is_set(self) -> bool:
        """Whether it is to end."""
        return self.wait(0.0)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it is to end, but no longer than that; whether it is."""
        asked, _, _ = select.select([self._asked], [], [], timeout_s)
        return bool(asked)
