"""Records of a field's radio: JSON lines, one for each ordered pair and measurement."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from edge.core.schema import (
    AtLeastOne,
    Bounded,
    ConfigError,
    Finite,
    NonNegative,
    Positive,
    Share,
    from_mapping,
)
from lpac.radio.airtime import Transport

_Name = Annotated[str, Meta(min_length=1, description="a name")]


@dataclass(frozen=True, slots=True, kw_only=True)
class RadioRecord(Bounded):
    """Link from `sender` to `receiver` while `robots` robots sent; None where unknown.

    `sender_heading_deg` is the true heading of the sender's nose, clockwise from north, and
    `receiver_height_m` is above its own takeoff point. The sender sends `sent` sealed messages of
    `message_bytes` at `message_hz`, of which `received` arrived; ages are their travel times.
    `rate_mbit_s` and `signal_dbm` are of the receiver's Wi-Fi; `busy_share` is the share of time in
    which any station sent. `loaded`: a bulk stream was sent meanwhile. `ground_wired`: the ground
    was not on the Wi-Fi.

    Raises ValueError that names an impossible value.
    """

    sender: _Name
    receiver: _Name
    transport: Transport
    robots: AtLeastOne
    message_bytes: Positive
    message_hz: Positive
    sent: AtLeastOne
    received: int
    loaded: bool
    ground_wired: bool
    age_p50_s: NonNegative | None = None
    age_p99_s: NonNegative | None = None
    distance_m: NonNegative | None = None
    sender_heading_deg: Finite | None = None
    receiver_height_m: Finite | None = None
    rate_mbit_s: Positive | None = None
    signal_dbm: Finite | None = None
    busy_share: Share | None = None

    @property
    def is_of_radio(self) -> bool:
        """Whether a radio reported a value; robots of `lpac sim` have no radio."""
        return any(v is not None for v in (self.rate_mbit_s, self.signal_dbm, self.busy_share))

    def check_rules(self) -> None:
        if self.sender == self.receiver:
            raise ValueError(f"receiver = {self.receiver!r}: must not be the sender")
        if not 0 <= self.received <= self.sent:
            raise ValueError(f"received = {self.received}: must be from 0 to {self.sent}, as sent")


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
