"""The list of members on its way to a robot: only a newer one, and whole."""

import asyncio
from dataclasses import replace
from pathlib import Path

import pytest

from edge.drivers.identity_folder import GROUP_KEYS, MEMBERS
from edge.identity.members import Role
from lpac.fleet import members
from lpac.fleet.authority import create_authority, new_member
from lpac.fleet.members import bring_members
from lpac.fleet.session import RemoteError
from lpac.fleet.settings import load_fleet
from tests.conftest import ROOT
from tests.local_session import LocalSession


def test_a_robot_is_brought_a_newer_list_and_no_older_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    robot = tmp_path / "robot"
    robot.mkdir()
    monkeypatch.setattr(members, "_IDENTITY", str(robot))
    monkeypatch.setattr(members, "_OWN", "ls")
    authority = create_authority(tmp_path / "keys", "demo")
    config = replace(load_fleet(ROOT / "docs" / "fleet.toml"), keys=authority.folder)

    def brought() -> str | None:
        return asyncio.run(bring_members(LocalSession(), config))

    with pytest.raises(RemoteError, match="has no key of the fleet: run `lpac fleet enroll`"):
        brought()
    new_member(authority, robot, Role.ROBOT, "r1", 1)
    assert brought() is None
    earlier = authority.members
    new_member(authority, tmp_path / "ann", Role.OPERATOR, "ann")
    authority.renew_group_key()
    assert brought() == f"it was given the list of members {earlier.number + 1}"
    for name in (MEMBERS, GROUP_KEYS):
        assert (robot / name).read_bytes() == (authority.folder / name).read_bytes()
    assert brought() is None
    for other in (earlier, replace(earlier, number=earlier.number + 1)):
        (authority.folder / MEMBERS).write_text(other.text)
        with pytest.raises(RemoteError, match="is not newer: bring `members` from the computer"):
            brought()
    # One that its program would not take up either is replaced.
    (robot / MEMBERS).write_text("torn")
    assert brought() is not None
    # A laptop that was given no list has none to bring.
    (authority.folder / MEMBERS).unlink()
    assert brought() is None
