"""What a field said of its radio: JSON lines, one for each ordered pair and measurement."""

import json
import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from edge.core.schema import ConfigError, from_mapping
from lpac.radio.airtime import Transport


@dataclass(frozen=True, slots=True, kw_only=True)
class RadioRecord:
    """What `receiver` heard of `sender` while `robots` of them spoke; None: it is not known.

    `sender_heading_deg` is the true heading of the sender's nose, clockwise from north, and
    `receiver_height_m` above its own takeoff point. Of `sent` messages of `message_bytes`, sealed,
    said `message_hz` times a second to each that is to hear them, `received` arrived; ages are how
    long those travelled. `rate_mbit_s` and `signal_dbm` are of the receiver's Wi-Fi, `busy_share`
    is the share of the channel's time that somebody sent in, by anybody. `loaded`: a bulk stream
    was sent meanwhile, on purpose. `ground_wired`: ground and router were not in the Wi-Fi.

    Raises ValueError that names an impossible value.
    """

    sender: str
    receiver: str
    transport: Transport
    robots: int
    message_bytes: float
    message_hz: float
    sent: int
    received: int
    loaded: bool
    ground_wired: bool
    age_p50_s: float | None = None
    age_p99_s: float | None = None
    distance_m: float | None = None
    sender_heading_deg: float | None = None
    receiver_height_m: float | None = None
    rate_mbit_s: float | None = None
    signal_dbm: float | None = None
    busy_share: float | None = None

    @property
    def is_of_radio(self) -> bool:
        """Whether a radio told anything; robots of `lpac sim` have none."""
        return any(v is not None for v in (self.rate_mbit_s, self.signal_dbm, self.busy_share))

    def __post_init__(self) -> None:
        for name in ("sender", "receiver"):
            if not getattr(self, name):
                raise ValueError(f"{name} = '': must be a name")
        if self.sender == self.receiver:
            raise ValueError(f"receiver = {self.receiver!r}: must not be the sender")
        for name in ("robots", "sent"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} = {getattr(self, name)}: must be at least 1")
        if not 0 <= self.received <= self.sent:
            raise ValueError(f"received = {self.received}: must be from 0 to {self.sent}, as sent")
        for names, is_allowed, allowed in _NUMBERS:
            for name in names:
                value = getattr(self, name)
                if value is not None and not is_allowed(value):
                    raise ValueError(f"{name} = {value}: must be {allowed}")


# Which may be what, and in words.
_NUMBERS: tuple[tuple[tuple[str, ...], Callable[[float], bool], str], ...] = (
    (
        ("message_bytes", "message_hz", "rate_mbit_s"),
        lambda value: 0.0 < value < math.inf,
        "above 0 and finite",
    ),
    (
        ("age_p50_s", "age_p99_s", "distance_m"),
        lambda value: 0.0 <= value < math.inf,
        "at least 0 and finite",
    ),
    (("sender_heading_deg", "receiver_height_m", "signal_dbm"), math.isfinite, "finite"),
    (("busy_share",), lambda value: 0.0 <= value <= 1.0, "from 0 to 1"),
)


def write_records(path: Path, records: Iterable[RadioRecord]) -> None:
    """Make or replace the file. Raises OSError."""
    with path.open("w", encoding="utf-8") as file:
        for record in records:
            file.write(json.dumps(asdict(record)) + "\n")


def read_records(path: Path) -> list[RadioRecord]:
    """All records; empty lines are skipped. A key may be missing where None is allowed.

    Raises OSError; ConfigError that names file, line, key and what is allowed.
    """
    records = []
    for number, line in enumerate(path.read_bytes().split(b"\n"), 1):
        if line.strip():
            where = f"{path}: line {number}"
            try:
                mapping = json.loads(line.decode())
            except (ValueError, RecursionError):
                raise ConfigError(f"{where}: is not JSON") from None
            records.append(from_mapping(RadioRecord, mapping, where))
    return records
