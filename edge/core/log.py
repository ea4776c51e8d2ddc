"""What the parts of a program say of themselves, for people: a sentence, and its details by name.

Where that goes is the program's matter: it says so once, with `listen`. Until then warnings and
errors go to standard error. The standard library's logging is not used, since a line here has its
details by name; packages that have the same cost a robot 5 MB.
"""

import sys
from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple

Level = Literal["info", "warning", "error"]


class Line(NamedTuple):
    """One thing that was said; `raised` is the exception that it is about, if it is about one."""

    level: Level
    event: str
    details: Mapping[str, object]
    raised: BaseException | None = None


Listener = Callable[[Line], None]


def show_problems(line: Line) -> None:
    """Warnings and errors to standard error."""
    if line.level != "info":
        said = f" ({line.raised!r})" if line.raised else ""
        details = "".join(f" {key}={value}" for key, value in line.details.items())
        print(f"{line.event}{said}:{details}" if details else line.event + said, file=sys.stderr)


def show_errors(line: Line) -> None:
    """Errors alone to standard error."""
    if line.level == "error":
        show_problems(line)


_listener: Listener = show_problems


def listen(listener: Listener) -> Listener:
    """From now on all lines of this process go there. Returns where they went before."""
    global _listener
    before, _listener = _listener, listener
    return before


def info(event: str, **details: object) -> None:
    """Say what happened. From any thread."""
    _listener(Line("info", event, details))


def warning(event: str, **details: object) -> None:
    """Say what should not be. From any thread."""
    _listener(Line("warning", event, details))


def error(event: str, raised: BaseException | None = None, **details: object) -> None:
    """Say what went wrong. From any thread."""
    _listener(Line("error", event, details, raised))
