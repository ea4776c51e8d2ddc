"""What runs on the robot, as far as it needs no robot: releases in a folder, heartbeats."""

import ast
import hashlib
import json
import math
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from edge.drivers.px4 import raw_mavlink
from lpac.fleet.enroll import _predecessors_step
from lpac.fleet.on_robot import enrolment, landing, probes, releases, service
from lpac.fleet.on_robot.calls import Refused
from lpac.fleet.release import _entry
from lpac.sim.ports import free_ports
from lpac.sim.px4.link import Px4Link
from lpac.sim.px4.modes import Px4Mode
from lpac.sim.px4.server import Instance, Px4Server
from lpac.sim.px4.vehicle import Px4Vehicle
from tests.conftest import ROOT


@pytest.mark.parametrize(
    "path",
    [*sorted((ROOT / "lpac" / "fleet" / "on_robot").glob("*.py")), Path(raw_mavlink.__file__)],
    ids=lambda path: path.name,
)
def test_the_robots_python_3_6_can_read_it(path: Path) -> None:
    ast.parse(path.read_text(), feature_version=(3, 6))


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


needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs root: it listens to a network")


@pytest.fixture
def datagrams() -> Iterator[tuple[int, socket.socket]]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        port = udp.getsockname()[1]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        yield port, sender


@needs_root
@pytest.mark.parametrize("armed", [False, True])
@pytest.mark.parametrize("version", [1, 2])
def test_an_autopilots_heartbeat_tells_whether_it_is_armed(
    datagrams: tuple[int, socket.socket], *, armed: bool, version: int
) -> None:
    port, sender = datagrams
    mavlink = common.MAVLink(None, srcSystem=11, srcComponent=1)
    camera = common.MAVLink(None, srcSystem=11, srcComponent=100)
    messages = (
        camera.heartbeat_encode(30, 8, 128, 0, 4).pack(camera, force_mavlink1=version == 1)
        + mavlink.attitude_encode(1, 0, 0, 0, 0, 0, 0).pack(mavlink, force_mavlink1=version == 1)
        + mavlink.heartbeat_encode(2, 12, 128 if armed else 0, 0x3040000, 0).pack(
            mavlink, force_mavlink1=version == 1
        )
    )
    stop = threading.Event()

    def send() -> None:
        while not stop.wait(0.05):
            sender.sendto(b"no MAVLink", ("127.0.0.1", port))
            sender.sendto(messages, ("127.0.0.1", port))

    thread = threading.Thread(target=send)
    thread.start()
    try:
        heard = service.hear_heartbeat(port)
    finally:
        stop.set()
        thread.join()
    assert heard == {
        "system_id": 11,
        "autopilot": 12,
        "armed": armed,
        "mode": "hold",
        "sender": ("127.0.0.1", sender.getsockname()[1]),
    }


@given(st.binary(max_size=300))
def test_no_datagram_breaks_the_listener(data: bytes) -> None:
    service._datagram(data, 14551)
    service._datagram(b"\x45" + data, 14551)


@needs_root
def test_no_heartbeat_is_silence(datagrams: tuple[int, socket.socket]) -> None:
    assert service.hear_heartbeat(datagrams[0], wait_s=0.2) is None


@needs_root
def test_a_vehicle_whose_program_is_gone_is_landed(monkeypatch: pytest.MonkeyPatch) -> None:
    said = {"fresh": True}
    monkeypatch.setattr(service, "service", lambda: said)
    vehicle = Px4Vehicle(seed=1, ready_after_s=0.0)
    (port,) = free_ports(1)

    def refused(why: str, system_id: int = 7) -> None:
        with pytest.raises(Refused, match=why):
            landing.land(port, system_id)

    def takes_off() -> bool:
        if not vehicle.armed and vehicle.armable:
            vehicle.arm()
            vehicle.take_off(math.nan)
        return bool(vehicle.position_m[2] < -1.0)

    refused(
        "^its program runs: `lpac mission land` lands it, in pilot after `lpac mission rejoin`$"
    )
    said["fresh"] = False
    with Px4Server([Instance(Px4Link(vehicle, system_id=7), 0, port)]) as server:
        refused("^PX4 is system 7, not 8", system_id=8)
        refused("^it is disarmed: nothing is to land$")
        assert server.wait_for(takes_off, 60.0)
        with server.stepped:
            vehicle.pilot()
        assert server.wait_for(lambda: vehicle.mode is Px4Mode.POSCTL, 60.0)
        # PX4 tells it within a second.
        heard = {}
        while heard.get("mode") != "position":
            heard = service.hear_heartbeat(port) or {}
        refused(r"^a pilot flies it \(position\): he lands it$")
        with server.stepped:
            vehicle.set_mode(Px4Mode.HOLD)
        while heard.get("mode") != "hold":
            heard = service.hear_heartbeat(port) or {}
        assert landing.land(port, 7) == {"mode": "land", "armed": True}
        assert vehicle.mode is Px4Mode.LAND
        assert server.wait_for(lambda: vehicle.landed and not vehicle.armed, 60.0)


@needs_root
def test_where_nothing_is_heard_nothing_is_landed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service, "service", lambda: {"fresh": False})
    (port,) = free_ports(1)
    with pytest.raises(Refused, match=f"^nothing is heard of PX4 at UDP port {port}$"):
        landing.land(port, 7)


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
