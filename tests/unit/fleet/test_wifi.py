"""What robots' radios tell, between two looks at them, and what all of them take of the air."""

import json
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from edge.messages.mission import RadioCounts
from lpac.analysis.snapshot import FleetSnapshot
from lpac.cli.main import app
from lpac.fleet.wifi import in_the_wifi, reading
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
    """Hears robots that say 2.5 messages a second, on a clock that does not wait."""

    def __init__(self, *robots: int) -> None:
        self._robots = robots
        self.now_s = 0.0

    def wait_for(self, until: Callable[[FleetSnapshot], bool], timeout_s: float) -> None:
        self.now_s += timeout_s
        sent = round(2.5 * self.now_s)
        said = RadioCounts(sent, 1800 * sent, {str(n): (sent, 0, sent) for n in (1, 2, 3)})
        changes = {"uptime_s": self.now_s, "radio_counts": said, "armed": False}
        robots = [snapshots.robot(snapshots.status(n, **changes)) for n in self._robots]
        until(snapshots.snapshot(*robots))


Ask = Callable[..., Result]


@pytest.fixture
def ask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Ask:
    """`lpac fleet radio` of robots r1, r2, r3 without computers, as those of `lpac sim`.

    It is told who is heard, [radio], and options.
    """
    path = write_fleet(tmp_path, 22, flying=3)
    text = re.sub(r'"(127.0.0.(\d))"', r'"r\2.invalid"\naddress = "\1"', path.read_text())

    def asked(heard: Sequence[int], radio: str, *options: object) -> Result:
        ground = _Ground(*heard)
        path.write_text(f"{text}\n[radio]\n{radio}\n")
        monkeypatch.setattr(
            "lpac.ground.station.subscriber.GroundSubscriber", lambda _: nullcontext(ground)
        )
        clock = SimpleNamespace(monotonic=lambda: ground.now_s)
        monkeypatch.setattr(sys.modules["lpac.cli.fleet.radio"], "time", clock)
        words = ["fleet", "radio", "--fleet", path, *options]
        return CliRunner().invoke(app, [str(word) for word in words])

    return asked


def test_who_is_not_asked_about_takes_airtime_all_the_same(ask: Ask) -> None:
    def asked(*options: object) -> dict[str, Any]:
        result = ask((1, 2, 3), "", "--json", *options)
        assert result.exception is None, result.exception
        found: dict[str, Any] = json.loads(result.stdout)
        return found

    two = asked("--robots", "r1,r3")
    assert {(p["sender"], p["receiver"]) for p in two["pairs"]} == {("r1", "r3"), ("r3", "r1")}
    room = two["room"]["carries"] - 3
    by_model = f"by the model there is room for {room} more"
    assert two["sentence"] == f"carries 3 robots, of which r1, r3 were judged; {by_model}"
    assert asked()["sentence"] == f"carries 3 robots; {by_model}"


@pytest.mark.parametrize(
    ("radio", "rates"),
    [
        ("", "mesh at 220 Mbit/s (assumed);"),
        (
            'transport = "multicast"',
            "multicast at 220 Mbit/s, and 6 Mbit/s to all (both assumed);",
        ),
    ],
)
def test_what_is_assumed_and_comes_from_the_model_is_called_so(
    ask: Ask, radio: str, rates: str
) -> None:
    result = ask((1, 2, 3), radio)
    assert result.exception is None, result.exception
    assert "carries 3 robots; by the model there is room for " in result.stdout
    assert f"room by the model of docs/network.md: {rates}" in result.stdout


def test_who_is_not_heard_has_no_figures_and_there_is_no_room_to_tell_of(ask: Ask) -> None:
    result = ask((1, 3), "")
    assert "radio: r2 is not heard here: `lpac fleet status` shows" in str(result.exception)
    assert "room" not in result.stdout
    rows = [line.split() for line in result.stdout.splitlines() if re.match(r"r\d [ \d.-]+$", line)]
    # Of each of three tables; nobody hears itself.
    assert rows == [
        ["r1", "-", "100"], ["r2", "-", "-"], ["r3", "100", "-"],
        ["r1", "-", "0.02"], ["r2", "-", "-"], ["r3", "0.02", "-"],
        ["r1", "-", "0"], ["r2", "-", "-"], ["r3", "0", "-"],
    ]  # fmt: skip
