"""Options that several commands have, and what they mean."""

import getpass
import socket
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

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
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Ray = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Fly on a Ray cluster, such as auto or HOST:6379."),
]
DEFAULT_FLEET = Path("fleet.toml")
DEFAULT_BUNDLE = SHIPPED_BUNDLE
# The name of a lock has some hundred bytes.
_LOCK_BYTES = 80


def open_fleet(path: Path, robots: str | None) -> tuple["FleetConfig", list["RobotHost"]]:
    """The fleet, and the robots that a command addresses. Raises ConfigError."""
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
        raise ValueError("--ray needs Ray: `pip install 'lpac-edge[ray]'`") from None
    return over_ray(ray)


def folder_lock(what: str, folder: Path) -> "ProcessLock":
    """To be held by who works in the folder."""
    from edge.drivers.process_lock import ProcessLock

    last_part = bytes(folder.resolve())[-_LOCK_BYTES:].decode(errors="ignore")
    return ProcessLock(f"{what} in {last_part}")


def user_at_host() -> str:
    """What this operator is called if nothing says otherwise. Raises ValueError."""
    try:
        return f"{getpass.getuser()}@{socket.gethostname()}"
    except (KeyError, OSError):
        raise ValueError("this user has no name: give the station one with --name") from None
