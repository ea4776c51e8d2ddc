"""The shell's part of what is asked of robots, with the tools of this machine."""

import asyncio
import os
import time
from pathlib import Path

import pytest

from lpac.fleet import probes, up
from tests.local_session import LocalSession


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
    start = tmp_path / "start"
    start.write_text(f"{now_ms + int(days * 86_400_000)}\n")
    monkeypatch.setattr(up, "_START", str(start))
    before = start.read_text()
    assert asyncio.run(up.renumber_starts(LocalSession())) is ahead
    if ahead:
        assert 0 <= int(start.read_text()) - now_ms < 60_000
    else:
        assert start.read_text() == before


def test_a_tool_that_hangs_holds_nothing_up() -> None:
    commands = {"before": "echo a; echo b >&2", "hung": "echo c; sleep 60", "after": 'echo "d\'"'}
    found = asyncio.run(LocalSession().look(commands, each_s=0.5))
    assert found == {"before": "a", "hung": "c", "after": "d'"}
