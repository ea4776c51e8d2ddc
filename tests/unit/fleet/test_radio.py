"""What robots' radios tell, between two looks at them."""

from typing import Any

import pytest

from lpac.fleet.radio import reading
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
