"""MAVSDK's output as lines of the robot's log, with nothing printed past it."""

import mavsdk.plugins.param.param
import pytest
from mavsdk.logging import LogLevel

from edge.drivers.px4.autopilot import _on_mavsdk_log, _redirect_log
from tests.said import lines_said


def test_warnings_and_prints_are_lines_of_the_log(capfd: pytest.CaptureFixture[str]) -> None:
    _redirect_log()
    with lines_said() as lines:
        assert _on_mavsdk_log(LogLevel.DEBUG, "sent a message", None, 0)
        for number in range(100):
            assert _on_mavsdk_log(LogLevel.WARN, f"timeout of {number}", None, 0)
        vars(mavsdk.plugins.param.param)["print"]("Error in callback:", ValueError("odd"))
    assert [line["times"] for line in lines] == [1, 2, 4, 8, 16, 32, 64, 1]
    assert {line["event"] for line in lines} == {"MAVSDK"}
    assert lines[-1]["says"] == "Error in callback: odd"
    assert capfd.readouterr() == ("", "")
