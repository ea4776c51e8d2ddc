"""Log lines: JSON on standard error, for the journal, and into the flight log."""

import logging
import os
import time
from collections.abc import MutableMapping
from contextlib import suppress
from typing import Any, TextIO, cast

import structlog

from edge.core.ports import Recorder


class _StandardError:
    """For as long as somebody reads it: a loop must not end because nobody does any more."""

    def write(self, text: str) -> None:
        with suppress(OSError):
            os.write(2, text.encode())

    def flush(self) -> None:
        """Nothing is kept back."""


def configure_logging(recorder: Recorder) -> None:
    """From now on every log line of this process goes to both. To be called once, at the start."""

    def record(_: object, level: str, line: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
        details = {key: value for key, value in line.items() if key != "event"}
        text = " ".join([str(line.get("event")), *(f"{k}={v}" for k, v in details.items())])
        recorder.record("/log", time.time(), {"level": level, "message": text, "name": "robot"})
        return line

    structlog.configure(
        processors=[
            structlog.processors.format_exc_info,
            record,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.JSONRenderer(default=str),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(logging.INFO),
        logger_factory=structlog.WriteLoggerFactory(cast(TextIO, _StandardError())),
        cache_logger_on_first_use=False,
    )
