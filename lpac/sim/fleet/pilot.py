"""A pilot who takes a robot of a simulated fleet out of the field, and brings it back."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from edge.core import F64
from edge.messages.mission import FlightState, RobotStatus
from lpac.ground.script import Perturbation
from lpac.sim.failure import Failure
from lpac.sim.fleet.layout import Layout
from lpac.sim.px4.modes import Px4Mode

LOOKS_S = 0.1
_GAIN_PER_S, _FASTEST_M_S = 0.8, 3.0
# Beyond the fence's line; when the pilot turns back, and lets the sticks go, before the end.
_BEYOND_M = 2.0
_BACK_S, _LETS_GO_S = 9.0, 1.0


class PilotedVehicle(Protocol):
    """A pilot's view of a vehicle, and its remote control: `Px4Vehicle`, or a PX4.

    `position_m` (3,) is where it really is, `rc_connected` whether the remote control is heard.
    """

    position_m: F64
    mode: Px4Mode
    rc_connected: bool

    def pilot(self, mode: Px4Mode = ..., stick_velocity_m_s: Sequence[float] = ()) -> Any:
        """The remote control is on, its switch on that mode, and its sticks are held so."""

    def move_sticks(self, velocity_m_s: Sequence[float]) -> None:
        """North, east, down; empty means centred."""

    def set_mode(self, mode: Px4Mode) -> Any:
        """Ask for a mode."""


def perturbations(failures: Sequence[Failure]) -> tuple[Perturbation, ...]:
    """Orders of the ground: pilots are given the robots, and they are taken back."""
    return tuple(
        each
        for failure in failures
        for each in (
            Perturbation(failure.from_s, f"r{failure.robot}", "pilot"),
            Perturbation(failure.until_s, f"r{failure.robot}", "rejoin"),
        )
    )


class Pilot:
    """Fly a robot out of the fence by its sticks while it is away, and back to about where it was.

    It keeps its height.

    `mission_began_s` is by the clock that `look` is told the time of.
    """

    def __init__(
        self, vehicle: PilotedVehicle, layout: Layout, failure: Failure, mission_began_s: float
    ) -> None:
        self.robot = failure.robot
        self._vehicle = vehicle
        self._layout = layout
        self._from_s = mission_began_s + failure.from_s
        self._until_s = mission_began_s + failure.until_s
        self._taken_at_m: F64 | None = None
        self._out_m: F64 = np.zeros(3)
        self._over = False

    def look(self, now_s: float, said: RobotStatus | None) -> None:
        """Some times a second; `said` is what the robot says of itself, None if nothing.

        The pilot takes it once it says that it is the pilot's.
        """
        if self._over or now_s < self._from_s:
            return
        left_s = self._until_s - now_s
        if left_s < _LETS_GO_S:
            self._vehicle.move_sticks(())
            self._over = True
        elif self._taken_at_m is not None:
            self._fly_to(self._out_m if left_s > _BACK_S else self._taken_at_m)
        elif said is not None and said.state is FlightState.PILOT:
            self._take()

    def _take(self) -> None:
        here_m = self._vehicle.position_m
        outwards, inside_m = self._layout.way_out(here_m)
        self._taken_at_m = here_m.copy()
        self._out_m = here_m + np.array([*(inside_m + _BEYOND_M) * outwards, 0.0])
        self._vehicle.pilot(Px4Mode.POSCTL)

    def _fly_to(self, target_m: F64) -> None:
        wanted_m_s = _GAIN_PER_S * (target_m - self._vehicle.position_m)
        fastest = max(1.0, float(np.linalg.norm(wanted_m_s)) / _FASTEST_M_S)
        self._vehicle.move_sticks((wanted_m_s / fastest).tolist())
