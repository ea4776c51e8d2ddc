"""systemd as the robot sees it: a socket that datagrams go to, or nobody."""

import json
import os
import secrets
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from edge.drivers.systemd import ServiceManager, status_text
from edge.messages.codes import CheckCode, FailedCheck
from edge.messages.mission import FlightState, LoopStatus, RobotStatus
from tests.said import reason, reasons


@contextmanager
def service_manager() -> Iterator[ServiceManager]:
    manager = ServiceManager()
    try:
        yield manager
    finally:
        manager.close()


@pytest.mark.parametrize("abstract", [False, True])
def test_assignments_arrive_and_no_child_inherits_the_socket(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, abstract: bool
) -> None:
    name = f"@lpac test {secrets.token_hex(4)}" if abstract else str(tmp_path / "notify")
    for variable, value in {
        "NOTIFY_SOCKET": name,
        "WATCHDOG_PID": "1",
        "WATCHDOG_USEC": "9",
    }.items():
        monkeypatch.setenv(variable, value)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd, service_manager() as manager:
        systemd.bind(name.replace("@", "\0"))
        manager.notify()
        manager.notify("STATUS=well", "WATCHDOG=1")
        assert systemd.recv(4096) == b"STATUS=well\nWATCHDOG=1"
        assert not {"NOTIFY_SOCKET", "WATCHDOG_PID", "WATCHDOG_USEC"} & os.environ.keys()


def test_nobody_who_listens_or_reads_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with service_manager() as alone:
        alone.notify("READY=1")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    with service_manager() as manager:
        manager.notify("READY=1")
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
            systemd.bind(str(tmp_path / "notify"))
            # It hangs: its queue fills up, and nobody waits for it.
            for _ in range(10_000):
                manager.notify("WATCHDOG=1")
        manager.notify("STOPPING=1")


def test_a_status_is_one_line_of_ascii_however_long_its_texts_are() -> None:
    loops = dict.fromkeys(
        ("control", "perception", "policy"), LoopStatus(10**9, 0, 10**9, 0.0, 0.0, 0.0)
    )
    worst = '"\\é\n\0' * 100
    check = FailedCheck(max(CheckCode, key=len), worst, settles_by_itself=False)
    status = RobotStatus(
        robot_id=65535, boot_nonce=2**48 - 1, sequence=1, uptime_s=1.0, unix_time_s=1.0,
        state=FlightState.PREFLIGHT, reason=reason(worst), ready=False, failed_checks=(check,) * 50,
        alarms=reasons(worst), obeyed_sequence=1, operator=worst, orders=(), bundle_id="b" * 64,
        world_id="w" * 12, trial=worst, origin=None, system_id=255, slot_height_m=4.0,
        landing_point_m=(0.0, 0.0), position_m=None, velocity_m_s=None, heading_rad=None,
        mode="offboard", armed=False, battery=1 / 3, satellites=12, message_counts={},
        neighbour_ages_s={}, loops=loops,
    )  # fmt: skip
    text = status_text(
        status,
        monotonic_s=1e9 / 3,
        autopilot=True,
        ages_s={"control": 1 / 3, "perception": None, "policy": 1e6 / 3},
        peers=10,
        insecure=True,
    )
    assert text.isascii() and text.isprintable() and len(text) < 3000
    assert text.startswith("STATUS={")
    told = json.loads(text.removeprefix("STATUS="))
    assert told["state"] == "preflight" and told["armed"] is False and told["battery"] == 0.333
    assert told["loops"]["control"] == {"ticks": 10**9, "failures": 10**9, "age_s": 0.333}
    assert told["loops"]["perception"]["age_s"] is None
    assert [each["code"] for each in told["failed_checks"]] == [check.code] * 8
    assert told["failed_checks_more"] == 42
