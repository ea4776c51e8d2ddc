"""What runs on the robot, as far as it needs no robot and no root."""

import ast
import hashlib
import json
import stat
import subprocess
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from edge.drivers.px4 import raw_mavlink
from lpac.fleet.enroll import _predecessors_step
from lpac.fleet.on_robot import enrolment, probes, releases, service, signatures
from lpac.fleet.on_robot.calls import Refused, write_whole
from lpac.fleet.release import _entry
from tests.conftest import ROOT


@pytest.mark.parametrize(
    "path",
    [*sorted((ROOT / "lpac" / "fleet" / "on_robot").glob("*.py")), Path(raw_mavlink.__file__)],
    ids=lambda path: path.name,
)
def test_the_robots_python_3_6_can_read_it(path: Path) -> None:
    ast.parse(path.read_text(), feature_version=(3, 6))


def test_a_file_is_written_past_a_link_that_somebody_put_there(tmp_path: Path) -> None:
    others, path = tmp_path / "others", tmp_path / "key.pem"
    others.write_text("theirs")
    (tmp_path / "key.pem.part").symlink_to(others)
    write_whole(str(path), b"ours", 0o600)
    assert (path.read_text(), others.read_text()) == ("ours", "theirs")
    assert not path.is_symlink() and stat.S_IMODE(path.stat().st_mode) == 0o600


def make(folder: Path, files: dict[str, str]) -> str:
    """A folder with a manifest; the release's id."""
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (folder / "link").symlink_to("somewhere")
    entries = {
        str(path.relative_to(folder)): _entry(path, path.lstat())
        for path in folder.rglob("*")
        if path.is_symlink() or path.is_file()
    }
    data = json.dumps({"files": entries}).encode()
    (folder / "manifest.json").write_bytes(data)
    return hashlib.sha256(data).hexdigest()[:16]


def test_a_release_is_taken_in_only_if_every_file_is_what_the_manifest_says(
    tmp_path: Path,
) -> None:
    release = make(tmp_path, {"root/usr/bin/lpac": "run", "robot.toml": "a = 1"})
    releases._check(str(tmp_path), release)

    def refused(match: str) -> None:
        with pytest.raises(Refused, match=match):
            releases._check(str(tmp_path), release)

    (tmp_path / "robot.toml").write_text("a = 2")
    refused("robot.toml has not come whole")
    (tmp_path / "robot.toml").write_text("a = 1")
    (tmp_path / "robot.toml").chmod(0o777)
    refused("robot.toml has not come whole")
    (tmp_path / "robot.toml").unlink()
    refused("robot.toml has not come")
    (tmp_path / "robot.toml").write_text("a = 1")
    (tmp_path / "robot.toml").chmod(0o644)
    (tmp_path / "more").write_text("")
    refused("more has not come whole")
    (tmp_path / "more").unlink()
    (tmp_path / "link").unlink()
    (tmp_path / "link").symlink_to("elsewhere")
    refused("link has not come whole")
    (tmp_path / "manifest.json").write_text("{}")
    refused("the manifest that came is not the release's")


@given(
    count=st.integers(1, 7),
    current=st.integers(0, 6),
    last_good=st.integers(0, 6),
    new=st.integers(0, 6),
)
def test_pruning_never_removes_what_runs_nor_what_a_rollback_needs(
    tmp_path_factory: pytest.TempPathFactory, count: int, current: int, last_good: int, new: int
) -> None:
    folder = tmp_path_factory.mktemp("robot")
    for i in range(count):
        (folder / "releases" / f"r{i}" / "root").mkdir(parents=True)
    kept = {f"r{i % count}" for i in (current, last_good, new)}
    releases._link(str(folder), "current", f"r{current % count}")
    releases._link(str(folder), "last-good", f"r{last_good % count}")
    releases._prune(str(folder), {f"r{new % count}"})
    left = {path.name for path in (folder / "releases").iterdir()}
    assert kept <= left
    assert len(left) == min(count, max(3, len(kept)))


@given(st.binary(max_size=300))
@example(bytes(8))
def test_no_datagram_breaks_the_listener(data: bytes) -> None:
    service._datagram(data, 14551)
    service._datagram(b"\x45" + data, 14551)


@pytest.mark.parametrize(
    ("status", "heard", "armed"),
    [
        ({"armed": True, "autopilot": True}, False, True),
        ({"armed": False, "autopilot": True}, True, False),
        # The program's last word from before it lost the vehicle.
        ({"armed": True, "autopilot": False}, False, False),
        ({"armed": True, "autopilot": False}, None, True),
        ({"armed": False, "autopilot": False}, True, True),
        ({"armed": None, "autopilot": False}, True, True),
        (None, True, True),
    ],
)
def test_the_programs_word_counts_while_it_has_the_vehicle(
    status: dict[str, bool | None] | None,
    heard: bool | None,
    armed: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    heartbeat = None if heard is None else {"armed": heard}
    monkeypatch.setattr(service, "service", lambda: {"active": "active", "status": status})
    monkeypatch.setattr(service, "hear_heartbeat", lambda _: heartbeat)
    assert service.armed(14551) is armed


def test_a_container_engine_that_is_silent_keeps_nobody_from_being_enrolled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    idle = {"there": False, "active": False, "enabled": False}
    monkeypatch.setattr(probes, "known_containers", lambda: None)
    monkeypatch.setattr(enrolment, "_unit", lambda _: idle)
    step = _predecessors_step(enrolment.retire(["old_stack"], 14551))
    assert step.outcome == "left to do"
    assert "docker does not answer" in step.notes[0]


@given(data=st.binary(max_size=50), size_bytes=st.integers(0, 60))
def test_the_checksum_of_a_beginning(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, size_bytes: int
) -> None:
    path = tmp_path_factory.mktemp("file") / "log"
    path.write_bytes(data)
    wanted = hashlib.sha256(data[:size_bytes]).hexdigest()
    assert releases.sha256(str(path), size_bytes) == wanted
    assert releases.sha256(str(path)) == hashlib.sha256(data).hexdigest()


@pytest.mark.parametrize(("failures", "is_proven"), [(0, True), (1, True), (2, False)])
def test_a_benchmark_that_something_else_disturbed_is_run_again(
    failures: int, is_proven: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = [failures]

    def run_inside(_: str, command: list[str]) -> subprocess.CompletedProcess[str]:
        fails = "benchmark" in command and left[0] > 0
        left[0] -= fails
        return subprocess.CompletedProcess(command, int(fails), "{}", "lpac: too slow")

    monkeypatch.setattr(releases, "require_lock", lambda: None)
    monkeypatch.setattr(signatures, "require_signed", lambda *_, **__: None)
    monkeypatch.setattr(releases, "run_inside", run_inside)
    if is_proven:
        assert set(releases.prove("", "a")) == {"verify", "benchmark"}
    else:
        with pytest.raises(Refused, match="too slow"):
            releases.prove("", "a")
