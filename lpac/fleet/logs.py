"""Journal entries of the robot's units."""

import json
import shlex
from collections.abc import Callable
from datetime import datetime
from typing import NamedTuple

from lpac.fleet.execute import execute
from lpac.fleet.hold import json_object
from lpac.fleet.session import RemoteError, as_root
from lpac.fleet.settings import FleetConfig, RobotHost


class Entry(NamedTuple):
    """Journal entry, stamped by the robot's clock."""

    unix_time_s: float
    text: str


def journal_command(lines: int, *, follow: bool) -> list[str]:
    """Command that prints the units' last entries; with `follow`, also new ones."""
    return [
        "journalctl", "--quiet", "--no-pager", "--all", "--unit", "lpac-robot.service",
        "--unit", "lpac-land.service",
        "--lines", str(lines), "--output", "json", *(["--follow"] if follow else []),
    ]  # fmt: skip


async def read_journal(
    config: FleetConfig,
    robot: RobotHost,
    lines: int,
    on_entry: Callable[[Entry, str], None],
    *,
    follow: bool,
) -> None:
    """Pass each entry and the robot's name to `on_entry`. Raises RemoteError."""
    errors: list[str] = []
    command = as_root(shlex.join(journal_command(lines, follow=follow)))

    def on_output(line: str) -> None:
        on_entry(parse_entry(line), robot.name)

    if await execute(config, robot, command, on_output, errors.append) != 0:
        raise RemoteError(errors[-1] if errors else "journalctl failed")


def parse_entry(line: str) -> Entry:
    """Parse a line of journalctl's JSON. Raises ValueError."""
    try:
        fields = json.loads(line)
        text = fields.get("MESSAGE") or ""
        if isinstance(text, list):  # not UTF-8, or too long
            text = bytes(text).decode(errors="replace")
        return Entry(int(fields["__REALTIME_TIMESTAMP"]) / 1e6, str(text))
    except (KeyError, TypeError, AttributeError, ValueError):
        raise ValueError(f"journalctl printed {line[:80]!r}") from None


def readable(entry: Entry) -> str:
    """Local time and text; a structured line becomes `level event key=value`."""
    time_of_day = datetime.fromtimestamp(entry.unix_time_s).strftime("%H:%M:%S")
    return f"{time_of_day} {_readable_text(entry.text)}"


def _readable_text(text: str) -> str:
    event = json_object(text)
    if event is None or "event" not in event:
        return text
    event.pop("timestamp", None)
    words = [str(event.pop("level", "")), str(event.pop("event"))]
    exception = event.pop("exception", None)
    words += [f"{key}={_value(value)}" for key, value in event.items()]
    line = " ".join(word for word in words if word)
    return line if exception is None else f"{line}\n{exception}"


def _value(value: object) -> str:
    return value if isinstance(value, str) and " " not in value else json.dumps(value)
