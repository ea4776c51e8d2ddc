"""Options that several commands have, and what they mean."""

import getpass
import socket
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.shipped import shipped

if TYPE_CHECKING:
    from lpac.fleet.settings import FleetConfig, RobotHost

Fleet = Annotated[
    Path, typer.Option("--fleet", envvar="LPAC_FLEET", help="The fleet's description, TOML.")
]
Robots = Annotated[
    str | None, typer.Option("--robots", help="Only these robots, such as r1,r3; else all.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
DEFAULT_FLEET = Path("fleet.toml")
DEFAULT_BUNDLE = shipped("policies/lpac_l2_k3_n10_512")


def open_fleet(path: Path, robots: str | None) -> tuple["FleetConfig", list["RobotHost"]]:
    """The fleet, and the robots that a command addresses. Raises ConfigError."""
    from lpac.fleet.settings import load_fleet, select

    config = load_fleet(path)
    return config, select(config, robots)


def user_at_host() -> str:
    """What this operator is called if nothing says otherwise. Raises ValueError."""
    try:
        return f"{getpass.getuser()}@{socket.gethostname()}"
    except (KeyError, OSError):
        raise ValueError("this user has no name: give the station one with --name") from None
