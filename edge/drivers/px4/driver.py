"""Vehicle of type "px4"."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from edge.core.ports import OpenVehicle, VehicleSetting
from edge.core.schema import no_options
from edge.drivers.process_lock import ProcessLock
from edge.drivers.px4.autopilot import MavsdkAutopilot
from edge.drivers.px4.watchdog import WatchdogProcess


def vehicle_lock(port: int) -> ProcessLock:
    """Lock that keeps this machine's other programs from the vehicle on that UDP port."""
    return ProcessLock(f"the autopilot's port {port}")


@contextmanager
def px4_vehicle(setting: VehicleSetting) -> Iterator[OpenVehicle]:
    """Open the vehicle of `type = "px4"` in [autopilot]; it has no options.

    Raises ConfigError or OSError.
    """
    no_options("autopilot", setting.options)
    port = int(setting.url.rpartition(":")[2])
    with vehicle_lock(port), MavsdkAutopilot(setting.url, system_id=setting.system_id) as autopilot:
        yield OpenVehicle(autopilot, autopilot, partial(WatchdogProcess, port, setting.system_id))
