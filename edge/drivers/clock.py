"""The computer's own clocks."""

import time


class SystemClock:
    """The computer's own clocks."""

    def monotonic_s(self) -> float:
        """Time that never jumps."""
        return time.monotonic()

    def unix_s(self) -> float:
        """The wall clock."""
        return time.time()
