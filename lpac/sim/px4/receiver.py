"""Ways in which a simulated GPS receiver tells what is not so, and its vehicle does not know."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from edge.core import F64
from edge.core.vehicle import Vector
from lpac.sim.px4.vector import ZERO, level, minus, plus, times, total


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
    _crept_m: Vector = ZERO
    _scattered_m: Vector = ZERO
    _stuck_at_m: Vector | None = None

    def step(self, dt_s: float, fix_m: Callable[[], Vector], rng: np.random.Generator) -> None:
        """One step of time; `fix_m` gives what it would tell."""
        if not self.stuck:
            self._stuck_at_m = None
        elif self._stuck_at_m is None:
            self._stuck_at_m = fix_m()
        creep_m_s = self.creep_m_s.tolist()
        if any(creep_m_s):
            self._crept_m = plus(self._crept_m, times(creep_m_s, dt_s))
        if self.scatter_m:
            self._scattered_m = level(times(rng.standard_normal(3).tolist(), self.scatter_m))

    @property
    def lies(self) -> bool:
        """Whether the place or the velocity that it tells is wrong."""
        misplaces = (self._crept_m, self._scattered_m) != (ZERO, ZERO)
        return self._stuck_at_m is not None or misplaces or any(self.velocity_bias_m_s.tolist())

    def place_m(self, true_m: Vector) -> Vector:
        """The place that it tells; `true_m` if it is honest."""
        if self._stuck_at_m is not None:
            return self._stuck_at_m
        return total(true_m, self._crept_m, self._scattered_m)

    def velocity_m_s(self, true_m_s: Vector) -> Vector:
        """The velocity that it tells."""
        if self._stuck_at_m is not None:
            return ZERO
        return plus(true_m_s, self.velocity_bias_m_s.tolist())

    def off_m(self, true_m: Vector) -> Vector:
        """How far its place is off in the plane. Heights go by the barometer."""
        return level(minus(self.place_m(true_m), true_m))

    def off_m_s(self, true_m_s: Vector) -> Vector:
        """How far its velocity is off in the plane."""
        return level(minus(self.velocity_m_s(true_m_s), true_m_s))
