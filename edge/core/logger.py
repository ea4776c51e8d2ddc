"""The structlog logger of all programs; each program chooses its output.

The default sends warnings and errors to standard error as text; robots then call
`edge.drivers.logs.log_to`. Pass an exception as `exc_info`.
"""

import sys
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager
from typing import Any, Literal

# structlog imports rich, if installed, for coloured tracebacks: 4 MB of memory in each robot.
_HIDDEN = {"rich"} - sys.modules.keys()
sys.modules.update(dict.fromkeys(_HIDDEN))  # type: ignore[arg-type]
import structlog  # noqa: E402

for _name in _HIDDEN:
    del sys.modules[_name]

log: structlog.typing.FilteringBoundLogger = structlog.get_logger()


def show(least: Literal["warning", "error"]) -> None:
    """Send lines of at least this level to standard error as text; drop all others."""
    structlog.configure(
        [_as_text],
        structlog.make_filtering_bound_logger(least),
        logger_factory=lambda *_: structlog.PrintLogger(sys.stderr),
    )


@contextmanager
def errors_only() -> Iterator[None]:
    """Drop all lines except errors within this context."""
    before = structlog.get_config()["wrapper_class"]
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger("error"))
    try:
        yield
    finally:
        structlog.configure(wrapper_class=before)


def _as_text(_logger: object, _level: str, entry: MutableMapping[str, Any]) -> str:
    event, raised = entry.pop("event"), entry.pop("exc_info", None)
    text = f"{event} ({raised!r})" if raised else str(event)
    details = "".join(f" {key}={value}" for key, value in entry.items())
    return f"{text}:{details}" if details else text


show("warning")
