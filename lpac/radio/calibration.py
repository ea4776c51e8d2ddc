"""Calibration of the radio model by a field's own records.

`read_wifi` takes a TOML file of `Wifi` values, or a file of a field's `RadioRecord`s, from which
`calibrated` takes what they can say:

- `data_rate_mbit_s` from the radios' rates: the one at which the same bytes take as long as at all
  of them, their harmonic mean. Where no radio told its rate, the one at which the model of a mesh
  keeps the channel as busy as it was.
- `multicast_rate_mbit_s`, if the data rate is known so: the one at which the model of multicast
  keeps the channel as busy as it was.
- `frame_loss` from multicast: the one at which the model delivers as much as arrived. In a mesh
  what is lost is repeated, so that nobody sees it.

The rest stays assumed: what a full queue is worth would take a channel that somebody fills, whose
traffic is in no record. For the same reason records beside a bulk stream are left out. Each record
is held against the model with its own `ground_wired`. Channels more than half busy are left to the
radios' rates alone, since what waits is sent together then, and the model is at its worst. It knows
no distances: what is found is a mean over the pairs and places that were recorded, and a channel
that other networks keep busy looks slow.
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
# Between these a value is looked for.
_RATES_MBIT_S, _LOSSES = (0.1, 1e5), (0.0, 0.99)
# Each value depends a little on the others.
_ROUNDS = 3


class SourceKind(StrEnum):
    """Origin of a value of `Wifi`."""

    ASSUMED = "assumed"
    FILE = "file"
    RATES = "rates"
    BUSY = "busy"
    DELIVERED = "delivered"


class Source(NamedTuple):
    """Of one value; `records` counts those that it comes from, if any."""

    kind: SourceKind
    records: int = 0


@dataclass(frozen=True, slots=True)
class Calibration:
    """A channel, and by the name of each of its values where that comes from."""

    wifi: Wifi
    sources: Mapping[str, Source]


def read_wifi(path: Path | None) -> Calibration:
    """Of a .toml or a .jsonl file; without a path, all of it is assumed.

    Raises OSError; ConfigError that names file, key, value and what is allowed, also for records
    that say nothing of what is assumed, and for those of no radio.
    """
    if path is None:
        return _calibration(Wifi(), {})
    if path.suffix == ".jsonl":
        records = read_records(path)
        if records and not any(record.is_of_radio for record in records):
            raise ConfigError(
                f"{path}: these records are not of a radio: none told of signal, rate or how busy "
                "the channel was, as with robots of `lpac sim`"
            )
        found = calibrated(records)
        if all(source.kind is SourceKind.ASSUMED for source in found.sources.values()):
            raise ConfigError(f"{path}: no record says anything of what the model assumes")
        return found
    if path.suffix != ".toml":
        raise ConfigError(
            f"{path}: must be a .toml file of the model's values, or a .jsonl file of records"
        )
    mapping = read_toml(path)
    wifi = from_mapping(Wifi, mapping, str(path))
    return _calibration(wifi, dict.fromkeys(mapping, Source(SourceKind.FILE)))


def calibrated(records: Sequence[RadioRecord], assumed: Wifi | None = None) -> Calibration:
    """Calibrate by records, from what is `assumed`: if not given, what `Wifi` has."""
    wifi, sources = assumed or Wifi(), dict[str, Source]()
    # What a bulk stream takes of the channel, and does to messages, is not in the model.
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
    told = [
        each
        for each in records
        if each.transport == transport and each.busy_share is not None and _is_quiet(each)
    ]
    busy = _means(told, lambda record: record.busy_share or 0.0)

    def too_busy(rate_mbit_s: float) -> float:
        changed = _with(wifi, name, rate_mbit_s)
        return math.fsum(
            count * (airtime(transport, replace(changed, ground_wired=wired), traffic).busy - share)
            for (transport, wired, traffic), (share, count) in busy.items()
        )

    rate_mbit_s = _where_zero(too_busy, *_RATES_MBIT_S) if told else None
    return None if rate_mbit_s is None else _Found(rate_mbit_s, Source(SourceKind.BUSY, len(told)))


def _frame_loss(records: Sequence[RadioRecord], wifi: Wifi) -> _Found | None:
    heard = [each for each in records if each.transport == "multicast" and _is_quiet(each)]
    if not heard:
        return None
    delivered = _means(heard, lambda record: record.received / record.sent)

    def too_much(frame_loss: float) -> float:
        changed = _with(wifi, "frame_loss", frame_loss)
        total = 0.0
        for (transport, wired, traffic), (share, count) in delivered.items():
            quality = link_quality(transport, replace(changed, ground_wired=wired), traffic)
            total += count * (1.0 - quality.loss - share)
        return total

    # More arrived than the model's collisions let through, or next to nothing.
    least, most = _LOSSES
    loss = least if too_much(least) <= 0.0 else _where_zero(too_much, least, most)
    return _Found(most if loss is None else loss, Source(SourceKind.DELIVERED, len(heard)))


_FINDERS: tuple[tuple[str, Callable[[Sequence[RadioRecord], Wifi], _Found | None]], ...] = (
    ("data_rate_mbit_s", _data_rate),
    ("multicast_rate_mbit_s", _multicast_rate),
    ("frame_loss", _frame_loss),
)


def _is_quiet(record: RadioRecord) -> bool:
    return record.busy_share is None or record.busy_share <= _MOST_BUSY


# What the model tells records apart by: the bool is `ground_wired`.
_Alike = tuple[Transport, bool, Traffic]


def _means(
    records: Iterable[RadioRecord], value: Callable[[RadioRecord], float]
) -> dict[_Alike, tuple[float, int]]:
    """Of records that the model cannot tell apart: the mean, and how many they are."""
    alike: defaultdict[_Alike, list[float]] = defaultdict(list)
    for each in records:
        traffic = Traffic(
            robots=each.robots, message_bytes=each.message_bytes, message_hz=each.message_hz
        )
        alike[each.transport, each.ground_wired, traffic].append(value(each))
    return {key: (fmean(values), len(values)) for key, values in alike.items()}


def _where_zero(falling: Callable[[float], float], low: float, high: float) -> float | None:
    """None if it is not above 0 at `low` and below at `high`."""
    if not falling(low) > 0.0 > falling(high):
        return None
    return float(scipy.optimize.brentq(falling, low, high, xtol=1e-9))
