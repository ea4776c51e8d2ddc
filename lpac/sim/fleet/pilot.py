"""A pilot who takes a robot of a simulated fleet out of the field, and brings it back."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from edge.core import F64
from edge.messages.mission import FlightState, RobotStatus
from lpac.ground.script import Perturbation
from lpac.sim.fleet.layout import Layout
from lpac.sim.px4.modes import Px4Mode

# What robots' configuration says where a pilot may take them: PX4 obeys no other remote control.
FOR_A_PILOT: Mapping[str, Mapping[str, object]] = {"failsafe": {"rc": "pilot"}}
LOOKS_S = 0.1
_GAIN_PER_S, _FASTEST_M_S = 0.8, 3.0
# Beyond the fence's line; when the pilot turns back, and lets the sticks go, before the end.
_BEYOND_M = 2.0
_BACK_S, _LETS_GO_S = 9.0, 1.0


class PilotedVehicle(Protocol):
    """What a pilot sees of a vehicle, and does with its remote control: `Px4Vehicle`, or a PX4.

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


class PilotFlight(NamedTuple):
    """From `from_s` of the mission on a pilot has a robot; at `until_s` it is to rejoin.

    Meanwhile it was out of the fence, and is back at about where it was. s, from the mission's
    start.
    """

    robot: int
    from_s: float
    until_s: float

    @property
    def perturbations(self) -> tuple[Perturbation, Perturbation]:
        """What the ground orders: the pilot is given the robot, and it is taken back."""
        robot = f"r{self.robot}"
        return (
            Perturbation(self.from_s, robot, "pilot"),
            Perturbation(self.until_s, robot, "rejoin"),
        )


class Pilot:
    """Flies a robot by its sticks, by sight, at the height that it has.

    `mission_began_s` is by the clock that `look` is told the time of.
    """

    def __init__(
        self, vehicle: PilotedVehicle, layout: Layout, flight: PilotFlight, mission_began_s: float
    ) -> None:
        self.robot = flight.robot
        self._vehicle = vehicle
        self._layout = layout
        self._from_s = mission_began_s + flight.from_s
        self._until_s = mission_began_s + flight.until_s
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
