"""Membership commands of `lpac fleet`, as an operator types them."""

import json
import stat
from pathlib import Path
from typing import Any

import pytest

from edge.drivers.identity_folder import load_identity
from edge.identity.members import Role
from tests.command import called, error_line
from tests.conftest import ROOT


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    """The example, with its keys beside it."""
    path = tmp_path / "fleet.toml"
    text = (ROOT / "docs" / "fleet.toml").read_text()
    path.write_text(text.replace('# keys = ""', 'keys = "keys"'))
    return path


def members(fleet: Path) -> list[dict[str, Any]]:
    told = called("fleet", "members", "--fleet", fleet, "--json")
    assert told.returncode == 0, told.stderr
    known: list[dict[str, Any]] = json.loads(told.stdout)["members"]
    return known


def test_an_authority_its_operators_and_who_is_revoked(fleet: Path, tmp_path: Path) -> None:
    assert "make one with `lpac fleet init`" in error_line(
        called("fleet", "members", "--fleet", fleet)
    )
    made = called("fleet", "init", "--fleet", fleet, "--name", "ann")
    assert made.returncode == 0 and "keep a copy of that folder" in made.stdout
    assert stat.S_IMODE((tmp_path / "keys").stat().st_mode) == 0o700
    assert "has an authority already" in error_line(called("fleet", "init", "--fleet", fleet))

    for name, options, role in (
        ("bob", (), Role.OPERATOR),
        ("eve", ("--observer",), Role.OBSERVER),
    ):
        out = tmp_path / name
        made = called("fleet", "operator", name, "--fleet", fleet, "--out", out, *options)
        assert made.returncode == 0 and f"{name} is an {role} of fleet demo" in made.stdout
        own = load_identity(out, fleet="demo", unix_s=2e9).membership.own
        assert (own.name, own.role) == (name, role)
        assert not (out / "authority.key").exists()
    again = called("fleet", "operator", "bob", "--fleet", fleet, "--out", tmp_path / "bob")
    assert "exists: give a new folder" in error_line(again)
    assert [m["name"] for m in members(fleet)] == ["ann", "bob", "eve"]

    assert "members: ann, bob, eve" in error_line(called("fleet", "revoke", "r9", "--fleet", fleet))
    # Without a ground nobody knows what it does now.
    assert "add --in-flight" in error_line(called("fleet", "revoke", "bob", "--fleet", fleet))
    assert len(members(fleet)) == 3
    done = called("fleet", "revoke", "bob", "--fleet", fleet, "--in-flight")
    assert done.returncode == 0 and "bob is no longer a member" in done.stdout
    assert [m["name"] for m in members(fleet)] == ["ann", "eve"]
    table = called("fleet", "members", "--fleet", fleet).stdout
    assert "bob" not in table and "observer" in table and "list 5" in table


def test_an_insecure_fleet_has_no_keys(fleet: Path) -> None:
    text = fleet.read_text().replace('keys = "keys"', "insecure = true")
    fleet.write_text(text)
    assert "has no keys: insecure = true" in error_line(called("fleet", "init", "--fleet", fleet))
    fleet.write_text(f'keys = "keys"\n{text}')
    assert "insecure = true: excludes keys" in error_line(called("fleet", "init", "--fleet", fleet))


def test_one_robots_options_are_not_for_all(fleet: Path) -> None:
    line = error_line(called("fleet", "enroll", "--fleet", fleet, "--user", "voxl"))
    assert line == "lpac: --user is for one robot: give its name too"
