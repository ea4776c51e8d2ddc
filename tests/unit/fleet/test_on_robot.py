"""What runs on the robot, as far as it needs no robot and no root."""

import ast
import hashlib
import json
import stat
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from edge.drivers.px4 import raw_mavlink
from lpac.fleet.enroll import _predecessors_step
from lpac.fleet.on_robot import collection, enrolment, probes, releases, service, signatures
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
    monkeypatch.setattr(service, "hear_heartbeat", lambda _: heartbeat)
    for active in ("active", "reloading", "deactivating"):
        state = {"active": active, "status": status}
        monkeypatch.setattr(service, "service", lambda state=state: state)
        assert service.armed(14551) is armed
    # What a program said that has ended is no word of now.
    monkeypatch.setattr(service, "service", lambda: {"active": "failed", "status": status})
    assert service.armed(14551) is bool(heard)


PORT = 14551
NEEDS_LOCK: tuple[Callable[[str], object], ...] = (
    lambda folder: releases.prepare(folder, "r", 0, "i", PORT),
    lambda folder: releases.switch(folder, "r", PORT),
    lambda folder: releases.rollback(folder, PORT),
    lambda folder: enrolment.set_card({}, False, PORT),
    lambda folder: enrolment.set_group_keys("", PORT),
    lambda folder: enrolment.set_up_px4(folder, "", PORT, 1, "", 9.0, 0.5),
)
GROUNDED: tuple[Callable[[str], object], ...] = (
    *NEEDS_LOCK,
    lambda folder: enrolment.set_vision_hub(PORT),
    lambda folder: enrolment.retire(["old"], PORT),
    lambda folder: service.stop(PORT, in_flight=False, disable=False),
    lambda folder: service.restart(folder, PORT, in_flight=False),
    lambda folder: probes.set_clock(0.0, PORT),
    lambda folder: collection.collect(folder, PORT, None, 0.0),
)


@pytest.mark.parametrize("call", GROUNDED)
def test_a_robot_in_flight_is_left_as_it_is(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, call: Callable[[str], object]
) -> None:
    hub, running = tmp_path / "hub.conf", {"active": True, "enabled": True}
    hub.write_text("{}")
    monkeypatch.setattr(service, "armed", lambda _: True)
    monkeypatch.setattr(releases, "_lock", [0])
    monkeypatch.setattr(probes, "VISION_HUB", str(hub))
    monkeypatch.setattr(probes, "known_containers", lambda: [])
    monkeypatch.setattr(enrolment, "_unit", lambda _: running)
    monkeypatch.setattr(enrolment, "_MEMBERSHIP", str(tmp_path / "identity"))
    with pytest.raises(Refused, match="the vehicle is armed"):
        call(str(tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["hub.conf"] and hub.read_text() == "{}"


@pytest.mark.parametrize(
    "call",
    [
        *NEEDS_LOCK,
        lambda folder: releases.discard(folder, "r"),
        lambda folder: releases.accept(folder, "r"),
        lambda folder: releases.sign(folder, "r", None),
        lambda folder: releases.prove(folder, "r"),
        probes.vehicle_check,
    ],
)
def test_who_does_not_hold_the_robot_changes_nothing(
    tmp_path: Path, call: Callable[[str], object]
) -> None:
    with pytest.raises(RuntimeError, match="lock was not called"):
        call(str(tmp_path))


def test_a_signature_counts_if_it_is_as_new_as_any_before(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("AUTHORITY", "_NEWEST", "_NEXT"):
        monkeypatch.setattr(signatures, name, str(tmp_path / "etc" / name))
    newest, release = tmp_path / "etc" / "_NEWEST", tmp_path / "release"
    release.mkdir()
    signatures.sign(str(release), None)  # Of a robot that knows no authority.
    signatures.trust_authority(b"ours")
    with pytest.raises(Refused, match="is not signed"):
        signatures.sign(str(release), None)
    for number in (7, 7, 6, 8):
        monkeypatch.setattr(signatures, "_number", lambda *_, number=number: number)
        signatures.require_signed(str(release), forward=False)
        if number == 6:
            older = "older than one that the robot has had"
            with pytest.raises(Refused, match=older):
                signatures.sign(str(release), "6")
            with pytest.raises(Refused, match=older):
                signatures.require_signed(str(release), forward=True)
            assert (release / "signature.pem").read_text() == "7"
            continue
        signatures.sign(str(release), str(number))
        assert newest.read_text() == f"{number}\n"
    signatures.trust_authority(b"ours")
    assert newest.read_text() == "8\n"
    signatures.trust_authority(b"another")
    assert newest.read_text() == "0\n"


@pytest.mark.parametrize(
    ("at", "problem", "known_s"),
    [
        (lambda s: {}, None, 2.0),
        (lambda s: {"failures": int(s > 1.0)}, "its control loop fails", 40.25),
        (lambda s: {"ticks": 5}, "its control loop does not tick", 40.25),
        (lambda s: {"link": False}, "the radio link is not open", 40.25),
        (lambda s: {"fresh": False}, "the program says nothing", 40.25),
        (lambda s: {"active": "failed"}, "the unit is failed", 0.0),
        # One restart is no fault, if it is well then; again and again it is.
        (lambda s: {"nonce": int(s >= 1.0), "restarts": int(s >= 1.0)}, None, 3.0),
        (lambda s: {"nonce": int(s), "restarts": int(s)}, "its control loop does not tick", 2.0),
    ],
)
def test_a_program_is_well_once_its_loops_have_ticked_for_a_while(
    monkeypatch: pytest.MonkeyPatch,
    at: Callable[[float], dict[str, Any]],
    problem: str | None,
    known_s: float,
) -> None:
    clock_s = [0.0]

    def state() -> dict[str, Any]:
        usual = {"failures": 0, "ticks": clock_s[0], "link": True, "fresh": True,
                 "active": "active", "nonce": 0, "restarts": 0}  # fmt: skip
        now = usual | at(clock_s[0])
        loop = {"failures": now["failures"], "ticks": now["ticks"]}
        status = {"link": now["link"], "boot_nonce": now["nonce"], "loops": {"control": loop}}
        return {key: now[key] for key in ("active", "fresh", "restarts")} | {
            "result": "", "status": status
        }  # fmt: skip

    def sleep(duration_s: float) -> None:
        clock_s[0] += duration_s

    monkeypatch.setattr(service, "service", state)
    monkeypatch.setattr(service, "_reason", lambda: "see the logs")
    monkeypatch.setattr("time.monotonic", lambda: clock_s[0])
    monkeypatch.setattr("time.sleep", sleep)
    found = service.unhealthy()
    assert found is None if problem is None else str(found).startswith(problem)
    assert clock_s[0] == known_s


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


def test_a_signature_is_the_authoritys_and_of_this_very_release(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Verify with a stubbed OpenSSL, which is called without a check of time."""
    (tmp_path / "manifest.json").write_bytes(b"{}")
    (tmp_path / "signature.pem").write_text("a certificate")
    digest = hashlib.sha256(b"{}").hexdigest()

    def number(subject: str = digest, code: int = 0) -> int:
        def run(command: list[str]) -> subprocess.CompletedProcess[str]:
            assert {"verify", "-no_check_time", signatures.AUTHORITY} <= set(command)
            return subprocess.CompletedProcess(command, code, "", "error 20: unable to verify")

        monkeypatch.setattr(signatures, "run", run)
        said = f"serial=1A\nsubject=CN={subject},O=LPAC fleet demo\n"
        monkeypatch.setattr(signatures, "must", lambda _: said)
        return signatures._number(str(tmp_path), str(tmp_path / "signature.pem"))

    assert number() == 0x1A
    for refused, match in (
        ({"code": 2}, "not the fleet's authority's: error 20"),
        ({"subject": 64 * "0"}, "is another release's"),
        ({"subject": "robot-1"}, "a certificate for something else"),
    ):
        with pytest.raises(Refused, match=match):
            number(**refused)


@pytest.mark.parametrize(
    ("active", "age_s", "fresh"),
    [
        ("active", 0.5, True),
        ("active", 3.0, False),
        ("active", -2.0, False),
        ("active", None, False),
        ("failed", 0.5, False),
    ],
)
def test_a_programs_word_is_fresh_while_it_runs(
    monkeypatch: pytest.MonkeyPatch, active: str, age_s: float | None, fresh: bool
) -> None:
    told = "" if age_s is None else json.dumps({"monotonic_s": 100.0 - age_s})
    shown = f"ActiveState={active}\nStatusText={told}\nNRestarts=2\nUnitFileState=enabled\n"
    monkeypatch.setattr(service, "must", lambda _: shown)
    monkeypatch.setattr("time.monotonic", lambda: 100.0)
    state = service.service()
    assert (state["fresh"], state["active"]) == (fresh, active)
    assert (state["restarts"], state["enabled"]) == (2, True)


def test_a_datagram_is_for_the_port_that_it_is_sent_to() -> None:
    header = bytes([0x45, *bytes(8), 17, *bytes(2), 127, 0, 0, 1, *bytes(4)])
    packet = header + (14580).to_bytes(2) + (14551).to_bytes(2) + bytes(4) + b"beat"
    assert service._datagram(packet, 14551) == b"beat"
    assert service._datagram(packet, 14580) == b""
    assert service._datagram(packet.replace(b"\x11", b"\x06", 1), 14551) == b""
    assert service._sender(packet) == ("127.0.0.1", 14580)
