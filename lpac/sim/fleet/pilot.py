"""Simulated pilot who flies a robot out of the field and back."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from edge.core import F64
from edge.messages.mission import FlightState, RobotStatus
from lpac.ground.script import Perturbation
from lpac.sim.failure import Failure
from lpac.sim.fleet.layout import Layout
from lpac.sim.px4.modes import Px4Mode

LOOK_PERIOD_S = 0.1
_GAIN_PER_S, _FASTEST_M_S = 0.8, 3.0
# Distance beyond the fence; times before the end at which the pilot turns back, and lets go.
_BEYOND_M = 2.0
_BACK_S, _LETS_GO_S = 9.0, 1.0


class PilotedVehicle(Protocol):
    """A pilot's view of a vehicle and its remote control: `Px4Vehicle`, or a real PX4.

    `position_m` (3,) is its true position, `rc_connected` whether the remote control is received.
    """

    position_m: F64
    mode: Px4Mode
    rc_connected: bool

    def pilot(self, mode: Px4Mode = ..., stick_velocity_m_s: Sequence[float] = ()) -> Any:
        """Switch the remote control on, with this mode and these sticks."""

    def move_sticks(self, velocity_m_s: Sequence[float]) -> None:
        """Hold the sticks for a velocity: north, east, down, m/s; empty means centred."""

    def set_mode(self, mode: Px4Mode) -> Any:
        """Command a mode."""


def perturbations(failures: Sequence[Failure]) -> tuple[Perturbation, ...]:
    """Commands of the ground station that give robots to pilots, and take them back."""
    return tuple(
        each
        for failure in failures
        for each in (
            Perturbation(failure.from_s, f"r{failure.robot}", "pilot"),
            Perturbation(failure.until_s, f"r{failure.robot}", "rejoin"),
        )
    )


class Pilot:
    """Pilot who flies a robot out of the fence and back to about where it was, at its height.

    `mission_began_s` is on the clock of `look`.
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

    def look(self, now_s: float, status: RobotStatus | None) -> None:
        """Act; to be called several times a second with the robot's last status, if any.

        The pilot takes over once the status says PILOT.
        """
        if self._over or now_s < self._from_s:
            return
        left_s = self._until_s - now_s
        if left_s < _LETS_GO_S:
            self._vehicle.move_sticks(())
            self._over = True
        elif self._taken_at_m is not None:
            self._fly_to(self._out_m if left_s > _BACK_S else self._taken_at_m)
        elif status is not None and status.state is FlightState.PILOT:
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
