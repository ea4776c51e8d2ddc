"""What robots' radios tell, between two looks at them, and what all of them take of the air."""

import json
import re
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from edge.messages.mission import RadioCounts
from lpac.analysis.snapshot import FleetSnapshot
from lpac.cli.main import app
from lpac.fleet.radio import in_the_wifi, reading
from lpac.radio.checked import WifiReading
from tests.unit.cli.test_fleet import write_fleet
from tests.unit.ground import snapshots


def interface(**changes: Any) -> dict[str, Any]:
    return {
        "name": "wlan0", "connected": True, "signal_dbm": -52.0, "rate_mbit_s": 433.3,
        "frequency_mhz": 5180.0, "active_ms": 1000.0, "busy_ms": 200.0,
    } | changes  # fmt: skip


def test_how_busy_the_channel_was_meanwhile() -> None:
    later = interface(active_ms=21_000.0, busy_ms=5200.0, signal_dbm=-60.0)
    assert reading([interface()], [later]) == WifiReading(433.3, -60.0, 0.25)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ({"busy_ms": None}, {}),
        ({}, {"active_ms": None, "busy_ms": None}),
        # A driver that began anew.
        ({"active_ms": 54_995.0, "busy_ms": 432.0}, {"active_ms": 32_592.0, "busy_ms": 254.0}),
        ({}, {}),
        ({"frequency_mhz": 2412.0}, {"active_ms": 9000.0, "busy_ms": 900.0}),
        ({"name": "wlan1"}, {"active_ms": 9000.0, "busy_ms": 900.0}),
    ],
)
def test_a_driver_that_does_not_count_is_not_guessed_for(
    before: dict[str, Any], after: dict[str, Any]
) -> None:
    told = reading([interface(**before)], [interface(**after)])
    assert told == WifiReading(433.3, -52.0, None)


def test_the_interface_that_has_a_network_tells() -> None:
    idle = interface(name="wlan1", connected=False, signal_dbm=None)
    assert reading([], [idle, interface()]) == WifiReading(433.3, -52.0, None)
    assert reading([], [idle]) == reading([], []) == WifiReading()


# As Linux tells them: destination, gateway and mask are little-endian.
ROUTES = """\
Iface\tDestination\tGateway\tFlags\tRefCnt\tUse\tMetric\tMask\tMTU\tWindow\tIRTT
eth0\t00000000\t0101A8C0\t0003\t0\t0\t100\t00000000\t0\t0\t0
wlan0\t0008A8C0\t00000000\t0001\t0\t0\t600\t00FFFFFF\t0\t0\t0
"""


@pytest.mark.parametrize(
    ("address", "wireless"), [("192.168.8.10", True), ("192.168.1.7", False), ("10.0.0.1", False)]
)
def test_a_laptop_knows_whether_it_is_in_the_wifi(
    tmp_path: Path, address: str, *, wireless: bool
) -> None:
    assert not in_the_wifi(address, tmp_path)
    for name in ("proc/net", "sys/class/net/eth0", "sys/class/net/wlan0/phy80211"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "proc/net/route").write_text(ROUTES)
    assert in_the_wifi(address, tmp_path) == wireless


class _Ground:
    """Hears three robots that say 2.5 messages a second, on a clock that does not wait."""

    now_s = 0.0

    def wait_for(self, until: Callable[[FleetSnapshot], bool], timeout_s: float) -> None:
        self.now_s += timeout_s
        sent = round(2.5 * self.now_s)
        said = RadioCounts(sent, 1800 * sent, {str(n): (sent, 0, sent) for n in (1, 2, 3)})
        changes = {"uptime_s": self.now_s, "radio_counts": said, "armed": False}
        robots = [snapshots.robot(snapshots.status(n, **changes)) for n in (1, 2, 3)]
        until(snapshots.snapshot(*robots))


def test_who_is_not_asked_about_takes_airtime_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, ground = write_fleet(tmp_path, 22, flying=3), _Ground()
    # Robots without computers, as those of `lpac sim`.
    path.write_text(re.sub(r'"(127.0.0.(\d))"', r'"r\2.invalid"\naddress = "\1"', path.read_text()))
    monkeypatch.setattr(
        "lpac.ground.station.subscriber.GroundSubscriber", lambda _: nullcontext(ground)
    )
    clock = SimpleNamespace(monotonic=lambda: ground.now_s)
    monkeypatch.setattr(sys.modules["lpac.cli.fleet.radio"], "time", clock)

    def asked(*options: object) -> dict[str, Any]:
        words = ["fleet", "radio", "--fleet", path, "--json", *options]
        result = CliRunner().invoke(app, [str(word) for word in words])
        assert result.exception is None, result.exception
        found: dict[str, Any] = json.loads(result.stdout)
        return found

    two = asked("--robots", "r1,r3")
    assert {(p["sender"], p["receiver"]) for p in two["pairs"]} == {("r1", "r3"), ("r3", "r1")}
    room = two["room"]["carries"] - 3
    assert two["sentence"] == (
        f"carries 3 robots, of which r1, r3 were judged, with room for {room}"
    )
    assert asked()["sentence"] == f"carries 3 robots with room for {room}"
