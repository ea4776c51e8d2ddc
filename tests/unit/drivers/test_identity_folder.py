"""Keys, cards and certificates as they lie on the disk."""

import stat
from pathlib import Path

import pytest

from edge.core.schema import ConfigError
from edge.drivers.identity_folder import GROUP_KEYS, load_identity
from edge.identity.card import Revocations, Role, verified
from lpac.fleet.authority import (
    Authority,
    AuthorityError,
    create_authority,
    new_member,
    write_file,
)


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return create_authority(tmp_path / "keys", "demo")


def test_a_member_is_who_the_authority_says(authority: Authority, tmp_path: Path) -> None:
    folder = tmp_path / "r3"
    issued = new_member(authority, folder, Role.ROBOT, "r3", 3)
    identity = load_identity(folder, fleet="demo", unix_s=2e9)
    assert (identity.card.role, identity.card.robot_id) == (Role.ROBOT, 3)
    assert identity.card.public_key == issued.public_key
    assert identity.membership.authority == authority.public_key
    # A clock that was lost does not make it an earlier start than the last one.
    assert identity.membership.start == 2_000_000_000_000
    assert load_identity(folder, fleet="demo", unix_s=5.0).membership.start == 2_000_000_000_001
    assert load_identity(folder, fleet="demo", unix_s=3e9).membership.start == 3_000_000_000_000
    # What was heard in flight is known the next time.
    guard = identity.guard(lambda: 0.0)
    authority.revoke("r3")
    assert guard.hear_revocations(authority.revocations)
    identity.keep(guard)
    assert load_identity(folder, fleet="demo", unix_s=3e9).revocations == authority.revocations
    # And what comes onto the disk meanwhile, in flight.
    authority.revoke("r3")
    (folder / "revoked").write_bytes(authority.revocations)
    identity.keep(guard)
    assert guard.revocations == authority.revocations


def test_a_start_that_was_numbered_anew_stays_so_while_the_program_runs(
    authority: Authority, tmp_path: Path
) -> None:
    """Its clock was far ahead when it started; `lpac fleet up` set both right."""
    folder = tmp_path / "r3"
    new_member(authority, folder, Role.ROBOT, "r3", 3)
    identity = load_identity(folder, fleet="demo", unix_s=3e9)
    (folder / "start").write_text("2000000000000\n")
    identity.keep(identity.guard(lambda: 0.0))
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
        identity.keep(guard)
    obstacle.rmdir()
    for text in ("2000000000000\n", "1000\n"):
        identity.keep(guard)
        assert start.read_text() == text
        start.write_text("1000\n")


def test_robots_share_a_key_that_is_renewed_when_one_is_a_member_no_more(
    authority: Authority, tmp_path: Path
) -> None:
    def keys(robot_id: int) -> tuple[bytes, ...]:
        folder = tmp_path / f"r{robot_id}"
        write_file(folder / GROUP_KEYS, authority.group_keys(), 0o600)
        return load_identity(folder, fleet="demo", unix_s=2e9).group_keys

    for robot_id in (1, 2):
        new_member(authority, tmp_path / f"r{robot_id}", Role.ROBOT, f"r{robot_id}", robot_id)
    # The ground is not in the group.
    new_member(authority, tmp_path / "ann", Role.OPERATOR, "ann")
    assert not (tmp_path / "ann" / GROUP_KEYS).exists()
    (first,) = keys(1)
    assert keys(2) == (first,) and len(first) == 32
    assert not authority.renew_group_key()
    authority.revoke("r2")
    # Not before all robots are given it.
    assert keys(1) == (first,)
    assert authority.renew_group_key() and not authority.renew_group_key()
    second, former = keys(1)
    assert former == first != second
    authority.revoke("r2")
    assert authority.renew_group_key()
    assert keys(1)[1:] == (second,)


def test_secrets_are_for_nobody_else(authority: Authority, tmp_path: Path) -> None:
    new_member(authority, authority.folder, Role.OPERATOR, "ann")
    secrets = ("authority.key", "members.json", "key.pem")
    for name in secrets:
        assert stat.S_IMODE((authority.folder / name).stat().st_mode) == 0o600
    (authority.folder / "key.pem").chmod(0o644)
    with pytest.raises(ConfigError, match=r"key\.pem is readable for others: chmod 600"):
        load_identity(authority.folder, fleet="demo", unix_s=2e9)
    (authority.folder / "authority.key").chmod(0o640)
    with pytest.raises(AuthorityError, match="chmod 600"):
        Authority(authority.folder, "demo")


@pytest.mark.parametrize(
    ("name", "data", "problem"),
    [
        ("identity.json", None, r"identity\.json is missing: enroll it first"),
        ("identity.json", b"[" * 100_000, r"identity\.json: "),
        ("identity.json", b'{"fleet":"demo","authority":"xy","card":""}', "hexadecimal"),
        ("key.pem", None, r"key\.pem is missing"),
        ("key.pem", b"-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----", "no Ed25519"),
        ("revoked", b"nonsense", "Revocations: this fleet's authority has not signed it"),
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
    with pytest.raises(ConfigError, match="is of fleet 'demo', not of 'field'"):
        load_identity(authority.folder, fleet="field", unix_s=2e9)
    # The card of one key beside the key of another.
    new_member(authority, tmp_path / "bob", Role.OPERATOR, "bob")
    (authority.folder / "key.pem").write_bytes((tmp_path / "bob" / "key.pem").read_bytes())
    with pytest.raises(ConfigError, match="the card of ann is for another key"):
        load_identity(authority.folder, fleet="demo", unix_s=2e9)


def test_a_member_that_gets_a_new_key_loses_the_old_one(
    authority: Authority, tmp_path: Path
) -> None:
    old = new_member(authority, tmp_path / "old", Role.ROBOT, "r3", 3)
    new_member(authority, tmp_path / "r4", Role.ROBOT, "r4", 4)
    new = new_member(authority, tmp_path / "new", Role.ROBOT, "spare", 3)
    assert new.serial > old.serial
    revocations = verified(Revocations, authority.revocations, authority.public_key)
    assert revocations.fingerprints == (old.fingerprint,)
    assert [(m.name, m.revoked) for m in authority.members()] == [
        ("r3", True), ("r4", False), ("spare", False),
    ]  # fmt: skip
    authority.revoke("r4")
    later = verified(Revocations, authority.revocations, authority.public_key)
    assert later.count > revocations.count and len(later.fingerprints) == 2


def test_an_authority_says_what_it_cannot_do(authority: Authority, tmp_path: Path) -> None:
    with pytest.raises(AuthorityError, match="has an authority already"):
        create_authority(authority.folder, "demo")
    with pytest.raises(AuthorityError, match="has no authority of fleet demo"):
        Authority(tmp_path / "nowhere", "demo")
    with pytest.raises(AuthorityError, match="is of fleet demo, not of field"):
        Authority(authority.folder, "field")
    with pytest.raises(AuthorityError, match="must be from 0 to 255"):
        new_member(authority, tmp_path / "r", Role.ROBOT, "r256", 256)
    with pytest.raises(AuthorityError, match="bob: is no member of fleet demo; known: nobody"):
        authority.revoke("bob")


def test_an_authority_revokes_as_many_as_a_list_holds(
    authority: Authority, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("lpac.fleet.authority.MOST_REVOKED", 1)
    for name in ("ann", "bob"):
        new_member(authority, tmp_path / name, Role.OPERATOR, name)
    # Another's name, in another role, is another member.
    new_member(authority, tmp_path / "watcher", Role.OBSERVER, "bob")
    authority.revoke("ann")
    with pytest.raises(AuthorityError, match="3 keys are revoked, and a list holds 1"):
        authority.revoke("bob")
    assert [member.revoked for member in authority.members()] == [True, False, False]
