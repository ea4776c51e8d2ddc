"""Calibrates the radio model with records of the field.

`read_wifi` reads a TOML file of `Wifi` values, or a file of `RadioRecord`s, from which `calibrated`
estimates:

- `data_rate_mbit_s` from the radios' rates: their harmonic mean, at which the same bytes take the
  same time. Without rates, the value at which the model of a mesh is as busy as the channel.
- `multicast_rate_mbit_s`, if the data rate is known: the value at which the model of multicast is
  as busy as the channel.
- `frame_loss` from multicast: the value at which the model delivers as much as arrived. A mesh
  repeats lost frames and hides them.

Other values stay assumed: the capacity of a full queue would need a saturated channel, whose
traffic is not recorded. Records beside a bulk stream are ignored for this reason. Each record is
compared with the model with its own `ground_wired`. Of channels more than half busy only the
radios' rates are used: waiting messages are sent together then, and the model is at its worst. It
knows no distances: results are means over the recorded pairs and places, and a channel used by
other networks looks slow.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from pathlib import Path
from statistics import fmean, harmonic_mean
from types import MappingProxyType
from typing import Any, NamedTuple

import scipy  # its parts are loaded on first use

from edge.core.schema import ConfigError, from_mapping
from edge.core.toml import read_toml
from lpac.radio.airtime import Traffic, Transport, Wifi, airtime, link_quality
from lpac.radio.records import RadioRecord, read_records

_MOST_BUSY = 0.5
# Search intervals.
_RATES_MBIT_S, _LOSSES = (0.1, 1e5), (0.0, 0.99)
# Number of iterations: each value depends a little on the others.
_ROUNDS = 3


class SourceKind(StrEnum):
    """Origin of a value of `Wifi`."""

    ASSUMED = "assumed"
    FILE = "file"
    RATES = "rates"
    BUSY = "busy"
    DELIVERED = "delivered"


class Source(NamedTuple):
    """Origin of one value; `records` is the number of its records, if any."""

    kind: SourceKind
    records: int = 0


@dataclass(frozen=True, slots=True)
class Calibration:
    """A channel, and the origin of each value by name."""

    wifi: Wifi
    sources: Mapping[str, Source]


def read_wifi(path: Path | None) -> Calibration:
    """Read a .toml or .jsonl file; without a path, all values are assumed.

    Raises OSError; ConfigError that names file, key, value and what is allowed, also for records
    without information about assumed values, or without a radio.
    """
    if path is None:
        return _calibration(Wifi(), {})
    if path.suffix == ".jsonl":
        records = read_records(path)
        if records and not any(record.is_of_radio for record in records):
            raise ConfigError(
                f"{path}: no record has a radio's signal, rate or channel load, as with robots of "
                "`lpac sim`"
            )
        found = calibrated(records)
        if all(source.kind is SourceKind.ASSUMED for source in found.sources.values()):
            raise ConfigError(f"{path}: no record has information about the model's values")
        return found
    if path.suffix != ".toml":
        raise ConfigError(
            f"{path}: must be a .toml file of the model's values, or a .jsonl file of records"
        )
    mapping = read_toml(path)
    wifi = from_mapping(Wifi, mapping, str(path))
    return _calibration(wifi, dict.fromkeys(mapping, Source(SourceKind.FILE)))


def calibrated(records: Sequence[RadioRecord], assumed: Wifi | None = None) -> Calibration:
    """Calibrate with records, starting from `assumed`, by default the values of `Wifi`."""
    wifi, sources = assumed or Wifi(), dict[str, Source]()
    # The model does not include a bulk stream.
    records = [each for each in records if not each.loaded]
    for _ in range(_ROUNDS):
        for name, find in _FINDERS:
            found = find(records, wifi)
            if found is not None:
                wifi = _with(wifi, name, found.value)
                sources[name] = found.source
    return _calibration(wifi, sources)


def _calibration(wifi: Wifi, sources: Mapping[str, Source]) -> Calibration:
    assumed = {field.name: Source(SourceKind.ASSUMED) for field in fields(Wifi)}
    return Calibration(wifi, MappingProxyType({**assumed, **sources}))


def _with(wifi: Wifi, name: str, value: float) -> Wifi:
    changed: dict[str, Any] = {name: value}
    return replace(wifi, **changed)


class _Found(NamedTuple):
    value: float
    source: Source


def _data_rate(records: Sequence[RadioRecord], wifi: Wifi) -> _Found | None:
    rates = [each.rate_mbit_s for each in records if each.rate_mbit_s is not None]
    if rates:
        return _Found(harmonic_mean(rates), Source(SourceKind.RATES, len(rates)))
    return _by_busy("data_rate_mbit_s", records, "mesh", wifi)


def _multicast_rate(records: Sequence[RadioRecord], wifi: Wifi) -> _Found | None:
    if _data_rate(records, wifi) is None:
        return None
    return _by_busy("multicast_rate_mbit_s", records, "multicast", wifi)


def _by_busy(
    name: str, records: Sequence[RadioRecord], transport: Transport, wifi: Wifi
) -> _Found | None:
    known = [
        each
        for each in records
        if each.transport == transport and each.busy_share is not None and _is_quiet(each)
    ]
    busy = _means(known, lambda record: record.busy_share or 0.0)

    def too_busy(rate_mbit_s: float) -> float:
        changed = _with(wifi, name, rate_mbit_s)
        return math.fsum(
            count * (airtime(transport, replace(changed, ground_wired=wired), traffic).busy - share)
            for (transport, wired, traffic), (share, count) in busy.items()
        )

    rate_mbit_s = _where_zero(too_busy, *_RATES_MBIT_S) if known else None
    return None if rate_mbit_s is None else _Found(rate_mbit_s, Source(SourceKind.BUSY, len(known)))


def _frame_loss(records: Sequence[RadioRecord], wifi: Wifi) -> _Found | None:
    usable = [each for each in records if each.transport == "multicast" and _is_quiet(each)]
    if not usable:
        return None
    delivered = _means(usable, lambda record: record.received / record.sent)

    def too_much(frame_loss: float) -> float:
        changed = _with(wifi, "frame_loss", frame_loss)
        total = 0.0
        for (transport, wired, traffic), (share, count) in delivered.items():
            quality = link_quality(transport, replace(changed, ground_wired=wired), traffic)
            total += count * (1.0 - quality.loss - share)
        return total

    # At a bound: more arrived than the model's collisions allow, or almost nothing did.
    least, most = _LOSSES
    loss = least if too_much(least) <= 0.0 else _where_zero(too_much, least, most)
    return _Found(most if loss is None else loss, Source(SourceKind.DELIVERED, len(usable)))


_FINDERS: tuple[tuple[str, Callable[[Sequence[RadioRecord], Wifi], _Found | None]], ...] = (
    ("data_rate_mbit_s", _data_rate),
    ("multicast_rate_mbit_s", _multicast_rate),
    ("frame_loss", _frame_loss),
)


def _is_quiet(record: RadioRecord) -> bool:
    return record.busy_share is None or record.busy_share <= _MOST_BUSY


# Key of records that are equal to the model; the bool is `ground_wired`.
_Key = tuple[Transport, bool, Traffic]


def _means(
    records: Iterable[RadioRecord], value: Callable[[RadioRecord], float]
) -> dict[_Key, tuple[float, int]]:
    """Mean value and number of records for each key."""
    values_of: defaultdict[_Key, list[float]] = defaultdict(list)
    for each in records:
        traffic = Traffic(
            robots=each.robots, message_bytes=each.message_bytes, message_hz=each.message_hz
        )
        values_of[each.transport, each.ground_wired, traffic].append(value(each))
    return {key: (fmean(values), len(values)) for key, values in values_of.items()}


def _where_zero(falling: Callable[[float], float], low: float, high: float) -> float | None:
    """Root of a falling function; None if there is no change of sign."""
    if not falling(low) > 0.0 > falling(high):
        return None
    return float(scipy.optimize.brentq(falling, low, high, xtol=1e-9))
