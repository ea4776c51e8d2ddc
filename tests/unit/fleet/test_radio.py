"""What robots' radios tell, between two looks at them."""

from pathlib import Path
from typing import Any

import pytest

from lpac.fleet.radio import in_the_wifi, reading
from lpac.radio.checked import WifiReading


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
