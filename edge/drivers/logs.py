"""Log output of a robot: JSON lines on standard error, for the journal, and the flight log."""

import os
import time
from collections.abc import MutableMapping
from contextlib import suppress
from typing import Any

import structlog

from edge.core.ports import Recorder


def log_to(recorder: Recorder) -> None:
    """Send all further log lines of this process to both. Call it once, at the start."""

    def record(
        _logger: object, level: str, entry: MutableMapping[str, Any]
    ) -> MutableMapping[str, Any]:
        details = (f"{key}={value}" for key, value in entry.items() if key != "event")
        text = " ".join([entry["event"], *details])
        recorder.record("/log", time.time(), {"level": level, "message": text, "name": "robot"})
        return entry

    structlog.configure(
        [
            structlog.processors.format_exc_info,
            record,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper("iso"),
            structlog.processors.JSONRenderer(default=str),
        ],
        structlog.make_filtering_bound_logger("info"),
        logger_factory=lambda *_: _Journal(),
    )


class _Journal:
    """Logger on standard error that never raises: a closed pipe must not end a loop."""

    def info(self, line: str) -> None:
        with suppress(OSError):
            os.write(2, (line + "\n").encode())

    warning = error = info
