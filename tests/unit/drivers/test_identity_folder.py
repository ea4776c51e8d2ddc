"""Keys, certificates and the list of members as they lie on the disk."""

import errno
import stat
from pathlib import Path

import pytest

from edge.core.schema import ConfigError
from edge.drivers import identity_folder
from edge.drivers.identity_folder import GROUP_KEYS, MEMBERS, Identity, load_identity
from edge.identity.guard import SignedGuard
from edge.identity.members import Members, Role
from lpac.fleet.authority import (
    Authority,
    AuthorityError,
    create_authority,
    new_member,
    write_file,
)
from lpac.sim.fleet.keys import give_list


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return create_authority(tmp_path / "keys", "demo")


def test_a_member_is_who_the_authority_says(authority: Authority, tmp_path: Path) -> None:
    folder = tmp_path / "r3"
    member = new_member(authority, folder, Role.ROBOT, "r3", 3)
    identity = load_identity(folder, fleet="demo", unix_s=2e9, robot_id=3)
    assert identity.membership.own == member
    assert identity.membership.members == authority.members
    # A clock that was lost does not make it an earlier start than the last one.
    assert identity.membership.start == 2_000_000_000_000
    assert load_identity(folder, fleet="demo", unix_s=5.0).membership.start == 2_000_000_000_001
    assert load_identity(folder, fleet="demo", unix_s=3e9).membership.start == 3_000_000_000_000
    with pytest.raises(ConfigError, match="belongs to robot r3, not robot 4"):
        load_identity(folder, fleet="demo", unix_s=2e9, robot_id=4)
    # One that left starts as the robot that it is, as it may be in the air; nobody else does.
    authority.revoke("r3")
    give_list(authority, folder)
    identity = load_identity(folder, fleet="demo", unix_s=2e9, robot_id=3)
    assert not identity.guard(lambda: 0.0).is_member()
    with pytest.raises(ConfigError, match="its key is not in the list of members"):
        load_identity(folder, fleet="demo", unix_s=2e9)


def brought_a_new_list(authority: Authority, tmp_path: Path) -> tuple[Identity, SignedGuard]:
    """A robot's running program, in whose folder a newer list was just put."""
    folder = tmp_path / "r3"
    new_member(authority, folder, Role.ROBOT, "r3", 3)
    identity = load_identity(folder, fleet="demo", unix_s=2e9)
    guard = identity.guard(lambda: 0.0)
    new_member(authority, tmp_path / "ann", Role.OPERATOR, "ann")
    give_list(authority, folder)
    return identity, guard


def test_a_running_program_takes_up_the_list_that_it_is_brought(
    authority: Authority, tmp_path: Path
) -> None:
    identity, guard = brought_a_new_list(authority, tmp_path)
    identity.update(guard)
    assert guard.members == authority.members


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (b"", "does not begin with"),
        (b"fleet demo 9 2 " + 64 * b"a" + b"\n", "has 0 of 2 members"),
        (b"fleet demo 1 0 %b\n", "list 1 is not newer than 2"),
        (b"fleet demo 9 0 " + 64 * b"a" + b"\n", "is another fleet's"),
        (b"fleet other 9 0 %b\n", "is another fleet's"),
        (None, "No such file"),
    ],
    ids=["empty", "torn", "older", "another authority's", "another fleet's", "missing"],
)
def test_a_list_that_cannot_be_used_changes_nothing_and_is_told_once(
    authority: Authority,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    text: bytes | None,
    why: str,
) -> None:
    folder = tmp_path / "r3"
    new_member(authority, folder, Role.ROBOT, "r3", 3)
    identity = load_identity(folder, fleet="demo", unix_s=2e9)
    guard, good = identity.guard(lambda: 0.0), (folder / MEMBERS).read_bytes()
    identity.update(guard)
    if text is None:
        (folder / MEMBERS).unlink()
    else:
        (folder / MEMBERS).write_bytes(text.replace(b"%b", good.split()[4]))
    capsys.readouterr()
    for _ in range(3):
        identity.update(guard)
    assert guard.members == authority.members
    told = capsys.readouterr()
    assert (told.out + told.err).count("identity not updated") == 1
    assert why in told.out + told.err
    # And is followed again, once it is whole.
    new_member(authority, tmp_path / "ann", Role.OPERATOR, "ann")
    give_list(authority, folder)
    identity.update(guard)
    assert guard.members == authority.members


def test_a_list_that_could_not_be_read_once_is_read_again(
    authority: Authority, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    identity, guard = brought_a_new_list(authority, tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(identity_folder, "read_members", _too_many_open_files)
        identity.update(guard)
    assert guard.members != authority.members
    identity.update(guard)
    assert guard.members == authority.members


def _too_many_open_files(_: Path) -> Members:
    raise OSError(errno.EMFILE, "Too many open files")


def test_a_start_that_was_numbered_anew_stays_so_while_the_program_runs(
    authority: Authority, tmp_path: Path
) -> None:
    """Its clock was far ahead when it started; `lpac fleet up` set both right."""
    folder = tmp_path / "r3"
    new_member(authority, folder, Role.ROBOT, "r3", 3)
    identity = load_identity(folder, fleet="demo", unix_s=3e9)
    (folder / "start").write_text("2000000000000\n")
    identity.update(identity.guard(lambda: 0.0))
    again = load_identity(folder, fleet="demo", unix_s=2.000000001e9)
    assert again.membership.start == 2_000_000_001_000


def test_a_start_that_could_not_be_written_is_written_later_once(
    authority: Authority, tmp_path: Path
) -> None:
    folder, start = tmp_path / "r3", tmp_path / "r3" / "start"
    new_member(authority, folder, Role.ROBOT, "r3", 3)
    obstacle = folder / "start-new"
    obstacle.mkdir()
    identity = load_identity(folder, fleet="demo", unix_s=2e9)
    guard = identity.guard(lambda: 0.0)
    with pytest.raises(OSError, match="start"):
        identity.update(guard)
    obstacle.rmdir()
    for text in ("2000000000000\n", "1000\n"):
        identity.update(guard)
        assert start.read_text() == text
        start.write_text("1000\n")


def test_robots_share_a_key_of_the_group_that_changes_when_one_leaves(
    authority: Authority, tmp_path: Path
) -> None:
    def given() -> tuple[bytes, ...]:
        write_file(
            tmp_path / "r1" / GROUP_KEYS, (authority.folder / GROUP_KEYS).read_bytes(), 0o600
        )
        give_list(authority, tmp_path / "r1")
        keys = load_identity(tmp_path / "r1", fleet="demo", unix_s=2e9).group_keys
        assert keys is not None and keys.sending == keys.receiving[0]
        return keys.receiving

    for robot_id in (1, 2):
        new_member(authority, tmp_path / f"r{robot_id}", Role.ROBOT, f"r{robot_id}", robot_id)
    # The ground is not in the group.
    new_member(authority, tmp_path / "ann", Role.OPERATOR, "ann")
    assert not (tmp_path / "ann" / GROUP_KEYS).exists()
    authority.revoke("ann")
    (first,) = given()
    assert len(first) == 32
    assert (tmp_path / "r2" / GROUP_KEYS).read_bytes() == (
        tmp_path / "r1" / GROUP_KEYS
    ).read_bytes()
    authority.revoke("r2")
    second, former = given()
    assert former == first != second
    # Also if another computer takes its place; but a new robot changes nothing.
    new_member(authority, tmp_path / "r3", Role.ROBOT, "r3", 3)
    assert given() == (second, first)
    new_member(authority, tmp_path / "r3", Role.ROBOT, "r3", 3)
    assert given()[1:] == (second,)


def test_in_flight_the_groups_key_that_is_spoken_stays(
    authority: Authority, tmp_path: Path
) -> None:
    """Others in the air may have been given none; all who have one are heard meanwhile."""
    folder = tmp_path / "r1"
    for robot_id in (1, 2, 3):
        new_member(authority, tmp_path / f"r{robot_id}", Role.ROBOT, f"r{robot_id}", robot_id)
    identity = load_identity(folder, fleet="demo", unix_s=2e9)
    guard = identity.guard(lambda: 0.0)
    assert identity.group_keys is not None
    first = identity.group_keys.sending
    for leaves in ("r2", "r3"):
        authority.revoke(leaves)
        write_file(folder / GROUP_KEYS, (authority.folder / GROUP_KEYS).read_bytes(), 0o600)
        give_list(authority, folder)
        identity.update(guard, in_flight=True)
        assert identity.group_keys.sending == first == identity.group_keys.receiving[-1]
    assert len(identity.group_keys.receiving) == 3
    identity.update(guard)
    assert len(identity.group_keys.receiving) == 2 and first not in identity.group_keys.receiving
    assert identity.group_keys.sending == identity.group_keys.receiving[0]


def test_secrets_are_for_nobody_else(authority: Authority, tmp_path: Path) -> None:
    new_member(authority, authority.folder, Role.OPERATOR, "ann")
    secrets = ("authority.key", "group-keys", "key.pem")
    for name in secrets:
        assert stat.S_IMODE((authority.folder / name).stat().st_mode) == 0o600
    (authority.folder / "key.pem").chmod(0o644)
    with pytest.raises(ConfigError, match=r"key\.pem is readable by others: chmod 600"):
        load_identity(authority.folder, fleet="demo", unix_s=2e9)
    (authority.folder / "authority.key").chmod(0o640)
    with pytest.raises(AuthorityError, match="chmod 600"):
        Authority(authority.folder, "demo")


@pytest.mark.parametrize(
    ("name", "data", "problem"),
    [
        ("members", None, r"members is missing: enroll it first"),
        ("members", b"[" * 100_000, r"members: does not begin with"),
        ("group-keys", b"xy", "hexadecimal"),
        ("key.pem", None, r"key\.pem is missing"),
        (
            "key.pem",
            b"-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----",
            "not an Ed25519",
        ),
    ],
)
def test_what_cannot_be_used_is_one_line(
    authority: Authority, name: str, data: bytes | None, problem: str
) -> None:
    folder = authority.folder
    new_member(authority, folder, Role.OPERATOR, "ann")
    if data is None:
        (folder / name).unlink()
    else:
        (folder / name).write_bytes(data)
    with pytest.raises(ConfigError, match=problem) as raised:
        load_identity(folder, fleet="demo", unix_s=2e9)
    assert "\n" not in str(raised.value)


def test_another_fleets_identity_is_refused(authority: Authority, tmp_path: Path) -> None:
    new_member(authority, authority.folder, Role.OPERATOR, "ann")
    with pytest.raises(ConfigError, match="belongs to fleet 'demo', not 'field'"):
        load_identity(authority.folder, fleet="field", unix_s=2e9)
    # A key that the list does not have.
    new_member(authority, tmp_path / "bob", Role.OPERATOR, "bob")
    authority.revoke("bob")
    (authority.folder / "key.pem").write_bytes((tmp_path / "bob" / "key.pem").read_bytes())
    with pytest.raises(ConfigError, match="its key is not in the list of members"):
        load_identity(authority.folder, fleet="demo", unix_s=2e9)


def test_a_member_that_gets_a_new_key_loses_the_old_one(
    authority: Authority, tmp_path: Path
) -> None:
    def known() -> list[tuple[str, bytes]]:
        return [(m.name, m.public_key) for m in authority.members.members]

    new_member(authority, tmp_path / "old", Role.ROBOT, "r3", 3)
    r4 = new_member(authority, tmp_path / "r4", Role.ROBOT, "r4", 4)
    number = authority.members.number
    new = new_member(authority, tmp_path / "new", Role.ROBOT, "spare", 3)
    assert known() == [("r4", r4.public_key), ("spare", new.public_key)]
    # What is so already changes nothing; a computer that becomes another robot is that one alone.
    authority.issue(Role.ROBOT, "spare", new.public_key, 3)
    assert authority.members.number == number + 1
    authority.issue(Role.ROBOT, "r4", new.public_key, 4)
    assert known() == [("r4", new.public_key)] and authority.members.number == number + 2
    authority.revoke("r4")
    assert known() == []


def test_a_revocation_that_breaks_off_is_repeated(
    authority: Authority, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    new_member(authority, tmp_path / "r3", Role.ROBOT, "r3", 3)
    before = (authority.folder / GROUP_KEYS).read_text()
    written: list[Path] = []

    def breaks_off(path: Path, data: bytes, mode: int) -> None:
        if written:
            raise OSError("the disk is full")
        written.append(path)
        write_file(path, data, mode)

    with monkeypatch.context() as patch:
        patch.setattr("lpac.fleet.authority.write_file", breaks_off)
        with pytest.raises(OSError, match="the disk is full"):
            authority.revoke("r3")
    authority.revoke("r3")
    assert not authority.members.members
    assert before not in (authority.folder / GROUP_KEYS).read_text()


def test_an_authority_says_what_it_cannot_do(authority: Authority, tmp_path: Path) -> None:
    with pytest.raises(AuthorityError, match="has an authority already"):
        create_authority(authority.folder, "demo")
    with pytest.raises(AuthorityError, match="has no authority of fleet demo"):
        Authority(tmp_path / "nowhere", "demo")
    with pytest.raises(AuthorityError, match="is of fleet demo, not of field"):
        Authority(authority.folder, "field")
    with pytest.raises(AuthorityError, match="must be from 0 to 255"):
        new_member(authority, tmp_path / "r", Role.ROBOT, "r256", 256)
    with pytest.raises(AuthorityError, match="bob: not a member of fleet demo; members: none"):
        authority.revoke("bob")


def test_a_name_in_another_role_is_another_member(authority: Authority, tmp_path: Path) -> None:
    for name, role in (("a", Role.OPERATOR), ("b", Role.OBSERVER)):
        new_member(authority, tmp_path / name, role, "bob")
    assert [m.role for m in authority.named("bob")] == [Role.OPERATOR, Role.OBSERVER]
    with pytest.raises(ValueError, match="must be 1 to 128 letters, none of them a space"):
        new_member(authority, tmp_path / "c", Role.OPERATOR, "two words")
