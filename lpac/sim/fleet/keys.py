"""Keys for a simulated fleet of programs."""

import shutil
from pathlib import Path

from edge.drivers.identity_folder import MEMBERS
from edge.identity.members import Role
from lpac.fleet.authority import Authority, create_authority, new_member, write_file

OPERATOR = "sim"


def write_keys(folder: Path, fleet: str, robots: int) -> Path:
    """Make an authority and its operator in `folder`/keys, and each robot's keys in its folder.

    Returns the folder of the observer as which the simulator subscribes. Raises OSError.
    """
    keys, listener = folder / "keys", folder / "listener"
    shutil.rmtree(keys, ignore_errors=True)  # an earlier flight's
    authority = create_authority(keys, fleet)
    new_member(authority, keys, Role.OPERATOR, OPERATOR)
    new_member(authority, listener, Role.OBSERVER, "listener")
    identities = [folder / "robots" / str(robot) / "identity" for robot in range(robots)]
    for robot, identity in enumerate(identities):
        new_member(authority, identity, Role.ROBOT, f"r{robot}", robot)
    give_list(authority, listener, *identities)
    return listener


def give_list(authority: Authority, *identities: Path) -> None:
    """Write the current member list to the members' folders, as `lpac fleet up` does by SSH."""
    for identity in identities:
        write_file(identity / MEMBERS, authority.members.text.encode(), 0o600)
