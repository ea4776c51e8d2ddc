"""Log lines: who hears them, and what of them is in the journal and in the flight log."""

import json
from collections.abc import Mapping
from datetime import datetime

import pytest

from edge.core.logger import log, show
from edge.drivers.logs import log_to
from edge.messages.mission import FlightState
from tests.said import lines_said


class Recorder:
    recording = True

    def __init__(self) -> None:
        self.messages: list[tuple[str, Mapping[str, object]]] = []

    def record(self, topic: str, unix_time_s: float, message: Mapping[str, object]) -> None:
        self.messages.append((topic, message))


def test_a_robots_lines_are_json_in_the_journal_and_words_in_the_flight_log(
    capfd: pytest.CaptureFixture[str],
) -> None:
    recorder = Recorder()
    with lines_said():
        log_to(recorder)
        log.info("flight state", state=FlightState.HOLD, ticks=3)
        try:
            raise ValueError("odd")
        except ValueError as error:
            log.error("loop step failed", exc_info=error, loop="policy")
    first, second = map(json.loads, capfd.readouterr().err.splitlines())
    assert datetime.fromisoformat(first.pop("timestamp")).tzinfo is not None
    assert first == {"event": "flight state", "level": "info", "state": "hold", "ticks": 3}
    assert (second["event"], second["level"], second["loop"]) == (
        "loop step failed", "error", "policy",
    )  # fmt: skip
    assert second["exception"].startswith("Traceback") and "ValueError: odd" in second["exception"]
    (topic, message), (_, failed) = recorder.messages
    assert topic == "/log"
    assert message == {
        "level": "info", "message": "flight state state=hold ticks=3", "name": "robot",
    }  # fmt: skip
    assert "ValueError: odd" in str(failed["message"])


def test_without_a_listener_problems_go_to_standard_error(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with lines_said():
        for least in ("warning", "error"):
            show(least)
            log.info("all is well", robot=3)
            log.warning("it is slow", late_s=2)
            log.error("it broke", exc_info=OSError(5, "no disk"))
    warning, *errors = capfd.readouterr().err.splitlines()
    assert warning == "it is slow: late_s=2"
    assert errors == ["it broke (OSError(5, 'no disk'))"] * 2
