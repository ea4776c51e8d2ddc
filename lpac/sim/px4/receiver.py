"""Faults of a simulated GPS receiver that its vehicle does not know of."""

from collections.abc import Callable
from dataclasses import dataclass

from edge.core.vehicle import Vector
from lpac.sim.px4.vector import ZERO, Draws, level, minus, plus, times, total


@dataclass(eq=False)
class Receiver:
    """Faults of one receiver; the public fields may be set at any time.

    `stuck`: it repeats its last position, with velocity 0, as a fresh fix. `creep_m_s` is the drift
    rate of its position, not included in its velocity, `velocity_bias_m_s` the error of its
    velocity, and `scatter_m` the standard deviation of independent position errors. North, east,
    down.
    """

    stuck: bool = False
    creep_m_s: Vector = ZERO
    velocity_bias_m_s: Vector = ZERO
    scatter_m: float = 0.0
    _crept_m: Vector = ZERO
    _scattered_m: Vector = ZERO
    _stuck_at_m: Vector | None = None

    def step(self, dt_s: float, fix_m: Callable[[], Vector], draws: Draws) -> None:
        """Advance by one step; `fix_m` returns the fix without these faults."""
        if not self.stuck:
            self._stuck_at_m = None
        elif self._stuck_at_m is None:
            self._stuck_at_m = fix_m()
        if self.creep_m_s != ZERO:
            self._crept_m = plus(self._crept_m, times(self.creep_m_s, dt_s))
        if self.scatter_m:
            self._scattered_m = level(times(draws.take(3), self.scatter_m))

    @property
    def faulty(self) -> bool:
        """Whether the reported position or velocity is wrong."""
        wrong = (self._crept_m, self._scattered_m, self.velocity_bias_m_s)
        return self._stuck_at_m is not None or wrong != (ZERO, ZERO, ZERO)

    def place_m(self, true_m: Vector) -> Vector:
        """The reported position; `true_m` without a fault."""
        if self._stuck_at_m is not None:
            return self._stuck_at_m
        return total(true_m, self._crept_m, self._scattered_m)

    def velocity_m_s(self, true_m_s: Vector) -> Vector:
        """The reported velocity; `true_m_s` without a fault."""
        if self._stuck_at_m is not None:
            return ZERO
        return plus(true_m_s, self.velocity_bias_m_s)

    def off_m(self, true_m: Vector) -> Vector:
        """Horizontal error of the reported position. Heights come from the barometer."""
        return level(minus(self.place_m(true_m), true_m))

    def off_m_s(self, true_m_s: Vector) -> Vector:
        """Horizontal error of the reported velocity."""
        return level(minus(self.velocity_m_s(true_m_s), true_m_s))
