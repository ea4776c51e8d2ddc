"""Ways in which a simulated GPS receiver tells what is not so, and its vehicle does not know."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from edge.core import F64

_IN_THE_PLANE = np.array([1.0, 1.0, 0.0])


def _zeros() -> F64:
    return np.zeros(3)


@dataclass(eq=False)
class Receiver:
    """Faults of one receiver: a test may set `stuck` and what follows at any time.

    `stuck`: it repeats its last place, with a velocity of 0, as a fresh fix. `creep_m_s` (3,) is
    how fast its places walk off, unlike what its velocity says, `velocity_bias_m_s` (3,) what its
    velocity is wrong by, and `scatter_m` the standard deviation of its places, each by itself.
    North, east, down.
    """

    stuck: bool = False
    creep_m_s: F64 = field(default_factory=_zeros)
    velocity_bias_m_s: F64 = field(default_factory=_zeros)
    scatter_m: float = 0.0
    _crept_m: F64 = field(default_factory=_zeros)
    _scattered_m: F64 = field(default_factory=_zeros)
    _stuck_at_m: F64 | None = None

    def step(self, dt_s: float, fix_m: Callable[[], F64], rng: np.random.Generator) -> None:
        """One step of time; `fix_m` gives what it would tell, (3,)."""
        if not self.stuck:
            self._stuck_at_m = None
        elif self._stuck_at_m is None:
            self._stuck_at_m = fix_m()
        self._crept_m = self._crept_m + self.creep_m_s * dt_s
        if self.scatter_m:
            self._scattered_m = self.scatter_m * rng.standard_normal(3) * _IN_THE_PLANE

    def place_m(self, true_m: F64) -> F64:
        """(3,): the place that it tells; `true_m` if it is honest."""
        if self._stuck_at_m is not None:
            return self._stuck_at_m
        place_m: F64 = true_m + self._crept_m + self._scattered_m
        return place_m

    def velocity_m_s(self, true_m_s: F64) -> F64:
        """(3,): the velocity that it tells."""
        if self._stuck_at_m is not None:
            return _zeros()
        velocity_m_s: F64 = true_m_s + self.velocity_bias_m_s
        return velocity_m_s

    def off_m(self, true_m: F64) -> F64:
        """(3,): how far its place is off in the plane. Heights go by the barometer."""
        off_m: F64 = (self.place_m(true_m) - true_m) * _IN_THE_PLANE
        return off_m
