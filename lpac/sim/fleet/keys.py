"""Keys for a fleet of programs on this machine, made on the fly."""

import shutil
from pathlib import Path

from edge.identity.card import Role
from lpac.fleet.authority import create_authority, new_member

OPERATOR = "sim"


def write_keys(folder: Path, fleet: str, robots: int) -> Path:
    """A new authority with its operator in `folder`/keys, and each robot's beside its robot.toml.

    Returns the folder of an observer that the simulator itself listens as. Raises OSError.
    """
    keys, listener = folder / "keys", folder / "listener"
    shutil.rmtree(keys, ignore_errors=True)  # an earlier flight's
    authority = create_authority(keys, fleet)
    new_member(authority, keys, Role.OPERATOR, OPERATOR)
    new_member(authority, listener, Role.OBSERVER, "listener")
    for robot in range(robots):
        identity = folder / "robots" / str(robot) / "identity"
        new_member(authority, identity, Role.ROBOT, f"r{robot}", robot)
    return listener
