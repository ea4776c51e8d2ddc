"""The shell's part of what is asked of robots, with the tools of this machine."""

import asyncio
import os
import time
from pathlib import Path

import pytest

from lpac.fleet import agent, members, probes, pull, up
from lpac.fleet.authority import create_authority
from lpac.fleet.settings import load_fleet
from tests.conftest import ROOT
from tests.local_session import LocalSession
from tests.needs import needs


def test_this_machine_can_be_looked_at(tmp_path: Path) -> None:
    """The shell's part of the probes, with the tools that are here."""
    found = asyncio.run(
        probes.facts(LocalSession(), str(tmp_path / "not" / "there"), ["never_was"])
    )
    assert found["kernel"] == os.uname().release
    assert found["python"].split(".")[0] == "3"
    assert found["memory"]["total_bytes"] > found["memory"]["available_bytes"] > 0.0
    assert all(0 <= disk["free_bytes"] <= disk["total_bytes"] for disk in found["disks"])
    assert int(found["cpus"]) >= 1 and found["load"] >= 0.0
    assert found["units"] == {"never_was": {"there": False, "active": False, "enabled": False}}


@pytest.mark.parametrize(("days", "ahead"), [(0.9, False), (1.1, True)])
def test_starts_that_were_numbered_by_a_clock_far_ahead_are_numbered_anew(
    days: float, ahead: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    now_ms = int(1e3 * time.time())
    start, others = tmp_path / "start", tmp_path / "others"
    others.write_text(f"{now_ms + int(days * 86_400_000)}\n")
    start.symlink_to(others)
    monkeypatch.setattr(up, "_START", str(start))
    before = start.read_text()
    assert asyncio.run(up.renumber_starts(LocalSession())) is ahead
    if ahead:
        assert 0 <= int(start.read_text()) - now_ms < 60_000
    else:
        assert start.read_text() == before
    # The program's user may have put a link there for root to follow.
    assert others.read_text() == before


def test_only_files_are_fetched_and_not_what_links_lead_to(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    state, secret = tmp_path / "state", tmp_path / "secret"
    (state / "logs").mkdir(parents=True)
    secret.write_text("root's")
    (state / "logs" / "1.mcap").write_text("flown")
    (state / "logs" / "2.mcap").symlink_to(secret)
    (state / "logs" / "3.mcap").mkdir()
    listing = pull._LIST.replace(pull._STATE, str(state)).replace(pull._PLACE, f"{tmp_path}/place-")
    session = LocalSession()
    listed = asyncio.run(session.run("sh", "-c", listing)).out
    assert [line.split()[1] for line in listed.splitlines()] == [f"{state}/logs/1.mcap"]
    stage = pull._STAGE.replace(pull._PLACE, f"{tmp_path}/place-")
    puts = "".join(f"put {n}.mcap {state}/logs/{n}.mcap\n" for n in (1, 2, 3, 4))
    assert asyncio.run(session.check_output("sh", "-c", f'{stage}{puts}ls "$d"')) == "1.mcap\n"


def test_a_tool_that_hangs_holds_nothing_up() -> None:
    commands = {"before": "echo a; echo b >&2", "hung": "echo c; sleep 60", "after": 'echo "d\'"'}
    found = asyncio.run(LocalSession().capture(commands, each_s=0.5))
    assert found == {"before": "a", "hung": "c", "after": "d'"}


@needs("openssl")
def test_a_robots_key_is_made_on_it_and_replaced_with_what_belongs_to_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder, others = tmp_path / "lpac" / "identity", tmp_path / "others"
    monkeypatch.setattr(members, "_IDENTITY", str(folder))
    monkeypatch.setattr(agent, "_lock", [0])
    monkeypatch.setattr(agent, "armed", lambda _: False)
    robot = load_fleet(ROOT / "docs" / "fleet.toml").robots["r1"]
    authority = create_authority(tmp_path / "keys", "demo")
    session = LocalSession()

    def public_key(*, fresh: bool) -> bytes:
        return asyncio.run(members._public_key(session, fresh=fresh))

    first = public_key(fresh=False)
    key = (folder / "key.pem").read_bytes()
    assert (folder / "key.pem").stat().st_mode & 0o777 == 0o600
    assert first == public_key(fresh=False)
    assert public_key(fresh=True) != first and (folder / "key.pem").read_bytes() == key
    # The program's user may have put a link there for root to follow.
    others.write_text("theirs")
    (folder / "certificate.pem.part").symlink_to(others)
    asyncio.run(members._admit(session, authority, robot, fresh=True))
    (member,) = authority.members.members
    assert public_key(fresh=False) == member.public_key != first
    files = {"certificate.pem", "authority.pem", "group-keys", "members"}
    assert others.read_text() == "theirs" and not (folder / "certificate.pem").is_symlink()
    assert {path.name for path in folder.iterdir()} == {"key.pem", *files}
    assert {path.stat().st_mode & 0o777 for path in folder.iterdir()} == {0o600}
    digests = asyncio.run(members._digests(session))
    assert digests["certificate.pem"] == members._sha256((folder / "certificate.pem").read_bytes())
