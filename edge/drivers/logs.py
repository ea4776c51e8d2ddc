"""Log lines: JSON on standard error, for the journal, and into the flight log."""

import json
import os
import time
import traceback
from contextlib import suppress
from datetime import UTC, datetime

from edge.core import log
from edge.core.ports import Recorder


def log_to(recorder: Recorder) -> None:
    """From now on every log line of this process goes to both. To be called once, at the start."""

    def write(line: log.Line) -> None:
        now_s, details = time.time(), dict(line.details)
        if line.raised is not None:
            details["exception"] = "".join(traceback.format_exception(line.raised)).rstrip()
        text = " ".join([line.event, *(f"{key}={value}" for key, value in details.items())])
        recorder.record("/log", now_s, {"level": line.level, "message": text, "name": "robot"})
        at = datetime.fromtimestamp(now_s, UTC).isoformat().replace("+00:00", "Z")
        entry = {**details, "event": line.event, "level": line.level, "timestamp": at}
        # For as long as somebody reads it: a loop must not end because nobody does any more.
        with suppress(OSError):
            os.write(2, (json.dumps(entry, default=str) + "\n").encode())

    log.listen(write)
