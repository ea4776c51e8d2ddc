"""System clock."""

import time


class SystemClock:
    """Clock of this computer; implements `edge.core.ports.Clock`."""

    def monotonic_s(self) -> float:
        """Time that never jumps, s."""
        return time.monotonic()

    def unix_s(self) -> float:
        """Wall clock, s."""
        return time.time()
