"""The vehicles of a simulated fleet: their MAVLink addresses and true tracks."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
import numpy.typing as npt

from lpac.analysis.truth import TrueTrack
from lpac.sim.ports import free_ports
from lpac.sim.px4.link import Px4Link
from lpac.sim.px4.server import Instance, Px4Server
from lpac.sim.px4.vehicle import Px4Vehicle, Truth


class AutopilotAddress(NamedTuple):
    """MAVSDK address of a vehicle, and its MAVLink system id."""

    url: str
    system_id: int


class VehicleError(ValueError):
    """A vehicle cannot start, or has ended; the text says which and why."""


class Vehicles(Protocol):
    """A context in which the vehicles run."""

    autopilots: tuple[AutopilotAddress, ...]

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def require_running(self) -> None:
        """Raise VehicleError if a vehicle has ended."""

    def tracks(self) -> tuple[TrueTrack, ...]:
        """Each vehicle's track until now.

        Times are `time.monotonic()`, positions north, east, down from the world's origin, m.
        """

    def forget(self) -> None:
        """Drop the history of each vehicle."""

    def lost_s(self) -> float:
        """Time by which the vehicles are behind real time, s."""


def track_of(entries: Sequence[Truth]) -> TrueTrack:
    """Track of a simulated vehicle, on its own clock and in the world's frame."""
    columns = dict(zip(Truth._fields, zip(*entries, strict=True), strict=False))

    def of(name: str, kind: type[Any], *shape: int) -> npt.NDArray[Any]:
        return np.array(columns.get(name, ()), kind).reshape(-1, *shape)

    return TrueTrack(
        time_s=of("time_s", np.float64),
        position_m=of("position_m", np.float64, 3),
        airborne=~of("landed", np.bool_),
        velocity_m_s=of("velocity_m_s", np.float64, 3),
        mode=of("mode", np.int64),
        armed=of("armed", np.bool_),
        setpoint_at_s=of("setpoint_at_s", np.float64),
        is_velocity=np.array([each == "velocity" for each in columns.get("follows", ())], np.bool_),
        velocity_error_m_s=of("velocity_error_m_s", np.float64),
        commands=of("commands", np.int64),
    )


class SimulatedVehicles:
    """`lpac.sim.px4` vehicles, simulated by a thread of this process.

    Hold `stepped` while changing `vehicles`, or `links`, their connections to robots' computers.
    """

    def __init__(self, vehicles: Sequence[Px4Vehicle]) -> None:
        self.vehicles = tuple(vehicles)
        ports = free_ports(len(self.vehicles))
        self.links = tuple(Px4Link(v, system_id=i + 1) for i, v in enumerate(self.vehicles))
        self._server = Px4Server(
            [Instance(link, 0, port) for link, port in zip(self.links, ports, strict=True)]
        )
        self.autopilots = tuple(
            AutopilotAddress(f"udpin://127.0.0.1:{port}", i + 1) for i, port in enumerate(ports)
        )
        self.stepped = self._server.stepped
        self._began_s = math.nan

    def __enter__(self) -> Self:
        self._server.__enter__()
        with self.stepped:
            self.stepped.wait_for(lambda: self._server.started_s > 0.0)
            self._began_s = self._server.started_s
        return self

    def __exit__(self, *_: object) -> None:
        self._server.__exit__()

    def require_running(self) -> None:
        """Do nothing: the vehicles run as long as this process."""

    def tracks(self) -> tuple[TrueTrack, ...]:
        """Each vehicle's track until now, all at the same times."""
        with self.stepped:
            truths = [tuple(vehicle.truth) for vehicle in self.vehicles]
        started_s = self._server.started_s
        return tuple(track_of(truth).shifted(started_s) for truth in truths)

    def forget(self) -> None:
        """Drop the history of each vehicle."""
        with self.stepped:
            for vehicle in self.vehicles:
                del vehicle.truth[:-1]

    def lost_s(self) -> float:
        """Time that the vehicles skipped while this process was held up, s."""
        return self._server.started_s - self._began_s
