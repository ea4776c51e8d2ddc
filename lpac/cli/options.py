"""Options shared by several commands."""

import getpass
import socket
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli import apps
from lpac.shipped import SHIPPED_BUNDLE

if TYPE_CHECKING:
    from edge.drivers.process_lock import ProcessLock
    from lpac.fleet.settings import FleetConfig, RobotHost
    from lpac.sim.cores import Pool

Fleet = Annotated[
    Path, typer.Option("--fleet", envvar="LPAC_FLEET", help="The fleet's description, TOML.")
]
Robots = Annotated[
    str | None, typer.Option("--robots", help="Only these robots, such as r1,r3; else all.")
]
Px4 = Annotated[
    Path | None,
    typer.Option(help="px4: PX4's build folder, made by `make px4_sitl`."),
]
Sensor = Annotated[
    str, typer.Option(help="Whole robots: the type of their sensor.", metavar="TYPE")
]
Ray = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Fly on a Ray cluster, such as auto or HOST:6379."),
]
AsJson = apps.AsJson
DEFAULT_FLEET = Path("fleet.toml")
DEFAULT_BUNDLE = SHIPPED_BUNDLE
DEFAULT_SENSOR = "world"
DEFAULT_ROBOTS = 10
# The name of a lock is limited to about 100 bytes.
_LOCK_BYTES = 80


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetOptions:
    """Options of a command for robots of a fleet."""

    fleet: Fleet = DEFAULT_FLEET
    robots: Robots = None
    as_json: AsJson = False


class VehicleKind(StrEnum):
    """Kinds of vehicles."""

    POINT = "point"
    SIMULATED = "simulated"
    MAVLINK = "mavlink"
    PX4 = "px4"


IN_REAL_TIME = (VehicleKind.MAVLINK, VehicleKind.PX4)


def check_px4(vehicle: VehicleKind, px4: Path | None) -> None:
    """Raise ValueError if --vehicle px4 and --px4 are not given together."""
    if vehicle is VehicleKind.PX4 and px4 is None:
        raise ValueError("--vehicle px4 needs --px4 with PX4's build folder")
    if vehicle is not VehicleKind.PX4 and px4 is not None:
        raise ValueError(f"--px4 does nothing with --vehicle {vehicle.value}")


def open_fleet(path: Path, robots: str | None) -> tuple["FleetConfig", list["RobotHost"]]:
    """Load the fleet, and select a command's robots. Raises ConfigError."""
    from lpac.fleet.settings import load_fleet, select

    config = load_fleet(path)
    return config, select(config, robots)


def pool(ray: str | None) -> "Pool":
    """All cores of this machine, or of a Ray cluster. Raises ValueError, ConnectionError."""
    if ray is None:
        from lpac.sim.cores import over_cores

        return over_cores
    try:
        from lpac.sim.cluster import over_ray
    except ModuleNotFoundError:
        from lpac.extras import install_command

        raise ValueError(f"--ray needs Ray: `{install_command('ray')}`") from None
    return over_ray(ray)


def require_here(vehicle: VehicleKind, ray: str | None) -> None:
    """Raise ValueError for flights in real time on a cluster."""
    if vehicle in IN_REAL_TIME and ray is not None:
        raise ValueError(f"--ray does nothing with --vehicle {vehicle.value}: it flies here")


def folder_lock(what: str, folder: Path) -> "ProcessLock":
    """Lock against a second process in the folder."""
    from edge.drivers.process_lock import ProcessLock

    last_part = bytes(folder.resolve())[-_LOCK_BYTES:].decode(errors="ignore")
    return ProcessLock(f"{what} in {last_part}")


def existing(path: Path | None) -> Path | None:
    """Option callback: raise OSError for a missing file before slow imports."""
    if path is not None:
        path.stat()
    return path


def user_at_host() -> str:
    """Default name of this operator. Raises ValueError."""
    try:
        return f"{getpass.getuser()}@{socket.gethostname()}"
    except (KeyError, OSError):
        raise ValueError("this user has no name: give the station one with --name") from None
