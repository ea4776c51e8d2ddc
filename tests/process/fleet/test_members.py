"""The list of members on its way to a robot: only a newer one, and whole."""

import asyncio
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from edge.drivers.identity_folder import GROUP_KEYS, MEMBERS, load_identity
from edge.identity.members import Role
from lpac.fleet import agent, members
from lpac.fleet.authority import create_authority, new_member
from lpac.fleet.members import send_members
from lpac.fleet.session import RemoteError, UnreachableError
from lpac.fleet.settings import load_fleet
from tests.conftest import ROOT
from tests.local_session import LocalSession
from tests.needs import needs

R1 = load_fleet(ROOT / "docs" / "fleet.toml").robots["r1"]


@needs("openssl")
def test_a_key_is_on_the_list_only_once_its_robot_has_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    robot = tmp_path / "lpac" / "identity"
    config = replace(load_fleet(ROOT / "docs" / "fleet.toml"), keys=tmp_path / "keys")
    monkeypatch.setattr(members, "_IDENTITY", str(robot))
    monkeypatch.setattr(agent, "_lock", [0])
    in_flight, kept = [True], members._write
    monkeypatch.setattr(agent, "armed", lambda _: in_flight[0])

    def join() -> str | None:
        return asyncio.run(members.join(LocalSession(), config, R1, lambda: "ann")).outcome

    def renew() -> None:
        authority = members.open_authority(config)
        asyncio.run(members._admit(LocalSession(), authority, R1, fresh=True))

    def keys() -> list[bytes]:
        known = members.open_authority(config).members.members
        return [member.public_key for member in known if member.robot_id is not None]

    def own_key() -> bytes:
        return asyncio.run(members._public_key(LocalSession(), fresh=False))

    with pytest.raises(RemoteError, match="the vehicle is armed: a new key is refused"):
        join()
    assert not robot.exists() and not keys()
    in_flight[0] = False
    assert (join(), join()) == ("done", "was so already")
    in_flight[0] = True
    # A member that flies is given the list, and keeps its key.
    assert join() == "was so already"
    before = {path: path.read_bytes() for path in robot.iterdir()}
    with pytest.raises(RemoteError, match="the vehicle is armed: a new key is refused"):
        renew()
    assert {path: path.read_bytes() for path in robot.iterdir()} == before
    in_flight[0] = False

    async def breaks_off(session: LocalSession, files: Mapping[str, bytes]) -> None:
        await kept(session, files)
        raise UnreachableError("it does not answer")

    (first,) = keys()
    monkeypatch.setattr(members, "_write", breaks_off)
    with pytest.raises(UnreachableError):
        renew()
    assert keys() == [first] == [own_key()]
    monkeypatch.setattr(members, "_write", kept)
    renew()
    assert keys() == [own_key()] != [first]
    identity = load_identity(robot, fleet=config.fleet, unix_s=2e9, robot_id=R1.robot_id)
    assert identity.membership.own.public_key == own_key()
    assert {path.name for path in robot.iterdir()} == {path.name for path in before} | {
        "start",
        "room",
    }


def test_a_robot_is_brought_a_newer_list_and_no_older_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    robot = tmp_path / "robot"
    robot.mkdir()
    monkeypatch.setattr(members, "_IDENTITY", str(robot))
    authority = create_authority(tmp_path / "keys", "demo")
    config = replace(load_fleet(ROOT / "docs" / "fleet.toml"), keys=authority.folder)

    def brought() -> str | None:
        return asyncio.run(send_members(LocalSession(), config))

    with pytest.raises(RemoteError, match="has no key of this fleet: run `lpac fleet enroll`"):
        brought()
    new_member(authority, robot, Role.ROBOT, "r1", 1)
    assert brought() is None
    earlier = authority.members
    new_member(authority, tmp_path / "ann", Role.OPERATOR, "ann")
    authority.renew_group_key()
    assert brought() == f"list of members {earlier.number + 1} sent"
    for name in (MEMBERS, GROUP_KEYS):
        assert (robot / name).read_bytes() == (authority.folder / name).read_bytes()
    assert brought() is None
    for other in (earlier, replace(earlier, number=earlier.number + 1)):
        (authority.folder / MEMBERS).write_text(other.text)
        with pytest.raises(RemoteError, match="copy `members` here from the computer"):
            brought()
    # One that its program would not take up either is replaced.
    (robot / MEMBERS).write_text("torn")
    assert brought() is not None
    # A laptop that was given no list has none to bring.
    (authority.folder / MEMBERS).unlink()
    assert brought() is None
