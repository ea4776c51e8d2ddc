"""The simulated points' radio: `--transport`, `--wifi`, and the model's assumptions."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer


def _airtime() -> Any:
    from lpac.radio import airtime

    return airtime


if TYPE_CHECKING:
    from lpac.radio import airtime
    from lpac.radio.calibration import Calibration, Source
else:
    # Only commands with these options import this module.
    airtime = _airtime()

Transport = airtime.Transport

WifiFile = Annotated[
    Path | None,
    typer.Option(
        "--wifi",
        metavar="FILE",
        help="With --transport: what the model assumes of the Wi-Fi. A .toml file with any of "
        "data_rate_mbit_s, multicast_rate_mbit_s, frame_loss, queue_s, ground_wired; or a .jsonl "
        "file of records of a field's radio (`lpac fleet radio --record`).",
    ),
]


def calibration(wifi: Path | None, *, transport: bool) -> "Calibration":
    """Read the file, if any. Raises ConfigError, OSError, ValueError."""
    from lpac.radio.calibration import read_wifi

    if wifi is not None and not transport:
        raise ValueError("--wifi does nothing without --transport")
    return read_wifi(wifi)


def wifi_lines(found: "Calibration") -> list[str]:
    """Each value of the channel as TOML, with its origin."""
    return [
        f"{name} = {_toml(getattr(found.wifi, name))}  # {_text(source)}"
        for name, source in found.sources.items()
    ]


def _toml(value: float | bool) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value:.4g}"


def _text(source: "Source") -> str:
    from edge.core.counted import counted

    origin = {
        "assumed": "assumed",
        "file": "from the file",
        "rates": "from the radios' rates",
        "busy": "from how busy the channel was",
        "delivered": "from what multicast delivered",
    }[source.kind.value]
    return f"{origin}, {counted(source.records, 'record')}" if source.records else origin
