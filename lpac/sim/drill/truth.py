"""What the vehicles of a flight really did, and what they were told and ordered: pure data.

Positions are in the mission frame, heights above the ground, m; times are s of the vehicles' clock.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from edge.core import F64, Bools
from edge.core.fence import Fence
from edge.core.frames import LocalTransform
from lpac.analysis.truth import TrueTrack
from lpac.sim.px4.modes import PILOTED, Px4Mode
from lpac.sim.px4.vehicle import Truth

# A vehicle that stands on the ground, for whoever judges by its place alone.
ON_GROUND_BELOW_M = 0.1


class GivenOrder(NamedTuple):
    """The operator ordered something of robots, from when it was asked for until it was answered.

    `ended_s` is inf while it is not.
    """

    kind: str
    robots: tuple[int, ...]
    began_s: float
    ended_s: float


@dataclass(frozen=True, slots=True, eq=False)
class VehicleTruth:
    """One vehicle: `time_s` (T,) ascending, `position_m` and `velocity_m_s` (T, 3).

    `mode` (T,) has `Px4Mode`s' numbers, `setpoint_at_s` (T,) when the last setpoint had come,
    `is_velocity` (T,) whether that moved it in the plane, as in a mission. `velocity_error_m_s` and
    `commands` (T,) are as in `Truth`.
    """

    time_s: F64
    position_m: F64
    velocity_m_s: F64
    mode: npt.NDArray[np.int64]
    armed: Bools
    landed: Bools
    setpoint_at_s: F64
    is_velocity: Bools
    velocity_error_m_s: F64
    commands: npt.NDArray[np.int64]

    @property
    def airborne(self) -> Bools:
        """(T,): whether it is off the ground, motors on or off."""
        above: Bools = self.position_m[:, 2] > ON_GROUND_BELOW_M
        return above

    @property
    def piloted(self) -> Bools:
        """(T,): whether somebody flies it by hand."""
        return self.is_in(*PILOTED)

    def is_in(self, *modes: Px4Mode) -> Bools:
        """(T,): whether it is in one of these modes."""
        return np.isin(self.mode, modes)

    def between(self, begin_s: float, end_s: float) -> "VehicleTruth":
        """That part of it."""
        part = slice(
            int(np.searchsorted(self.time_s, begin_s)), int(np.searchsorted(self.time_s, end_s))
        )
        return VehicleTruth(
            self.time_s[part], self.position_m[part], self.velocity_m_s[part], self.mode[part],
            self.armed[part], self.landed[part], self.setpoint_at_s[part], self.is_velocity[part],
            self.velocity_error_m_s[part], self.commands[part],
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class FlightTruth:
    """One flight of a fault. `hit` are the robots that it was done to.

    `fault_s` is when it began, `calm_s` when the operator began to bring all home. `marks` tell of
    further times by their names. `pads_m` (N, 2) is where they really stood at first. `late_s` is
    how far the machine that flew it was behind real time; 0 on a simulated clock. `unix_s` is Unix
    time when the vehicles' clock was 0.
    """

    vehicles: tuple[VehicleTruth, ...]
    hit: tuple[int, ...]
    fault_s: float
    calm_s: float
    marks: Mapping[str, float]
    orders: tuple[GivenOrder, ...]
    fence: Fence
    pads_m: F64
    drone_m: float
    late_s: float = 0.0
    unix_s: float = 0.0

    @property
    def others(self) -> tuple[int, ...]:
        """The robots that it was not done to."""
        return tuple(i for i in range(len(self.vehicles)) if i not in self.hit)

    def ordered(self, kind: str, robot: int) -> list[GivenOrder]:
        """All orders of that kind to the robot."""
        return [each for each in self.orders if each.kind == kind and robot in each.robots]


def tracks_of(flight: FlightTruth) -> dict[int, TrueTrack]:
    """Where each robot's vehicle was, in Unix time, for `lpac report`."""
    return {
        robot: TrueTrack(v.time_s + flight.unix_s, v.position_m, v.airborne)
        for robot, v in enumerate(flight.vehicles)
    }


def vehicle_truth(entries: Sequence[Truth], to_mission: LocalTransform) -> VehicleTruth:
    """From what a vehicle noted, which is in the world's frame: north, east, down."""
    north_east_down_m = np.array([entry.position_m for entry in entries]).reshape(-1, 3)
    velocity_m_s = np.array([entry.velocity_m_s for entry in entries]).reshape(-1, 3)
    position_m = north_east_down_m @ to_mission.rotation.T + to_mission.local_origin_m
    # The world's ground is at down = 0, whatever height the mission frame's origin has.
    position_m[:, 2] = -north_east_down_m[:, 2]

    def of(value: Callable[[Truth], object], kind: type[Any]) -> npt.NDArray[Any]:
        return np.array([value(entry) for entry in entries], kind)

    return VehicleTruth(
        time_s=of(lambda entry: entry.time_s, np.float64),
        position_m=position_m,
        velocity_m_s=velocity_m_s @ to_mission.rotation.T,
        mode=of(lambda entry: entry.mode, np.int64),
        armed=of(lambda entry: entry.armed, np.bool_),
        landed=of(lambda entry: entry.landed, np.bool_),
        setpoint_at_s=of(lambda entry: entry.setpoint_at_s, np.float64),
        is_velocity=of(lambda entry: entry.follows == "velocity", np.bool_),
        velocity_error_m_s=of(lambda entry: entry.velocity_error_m_s, np.float64),
        commands=of(lambda entry: entry.commands, np.int64),
    )
