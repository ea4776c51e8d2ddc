"""The type "px4" of robot.toml's [autopilot]."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from edge.core.ports import OpenVehicle, VehicleSetting
from edge.core.schema import no_options
from edge.drivers.process_lock import ProcessLock
from edge.drivers.px4.autopilot import MavsdkAutopilot
from edge.drivers.px4.watchdog import WatchdogProcess


def vehicle_lock(port: int) -> ProcessLock:
    """Keeps other programs of this machine from the vehicle whose datagrams come in there."""
    return ProcessLock(f"the autopilot's port {port}")


@contextmanager
def px4_vehicle(setting: VehicleSetting) -> Iterator[OpenVehicle]:
    """PX4 over MAVSDK. It has no options. Raises ConfigError, OSError."""
    no_options("autopilot", setting.options)
    port = int(setting.url.rpartition(":")[2])
    with (
        vehicle_lock(port),
        MavsdkAutopilot(setting.url, system_id=setting.system_id) as autopilot,
    ):
        yield OpenVehicle(autopilot, autopilot, partial(WatchdogProcess, port, setting.system_id))
