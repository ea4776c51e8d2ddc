"""Log lines: JSON on standard error, for the journal, and into the flight log."""

import logging
import sys
import time
from collections.abc import MutableMapping
from typing import Any

import structlog

from edge.core.ports import Recorder


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
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
        cache_logger_on_first_use=False,
    )
