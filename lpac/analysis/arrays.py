"""Reads flight logs as numpy arrays: one column per value of each topic.

These are one program's messages, unchanged. A flight's record
(`lpac.analysis.examination.examine`) combines several logs on one clock. The topics are listed in
`edge.drivers.flight_log`.
"""

import re
import warnings
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from edge.core import F64
from edge.drivers.log_reader import FlightLogError, LogGap, read

_NOT_FINITE = frozenset({"NaN", "Infinity", "-Infinity"})


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """T messages of one topic; `columns["position_m"]` is the column of that name.

    `time_s` (T,) is Unix time, s, by the writer's clock. Names of nested values have dots:
    "origin.heading_deg". A column is (T, ...). Numbers, and lists and arrays of numbers of one
    shape, are numeric: float with NaN if some messages do not have them. Texts are strings.
    Everything else, and texts that some messages do not have, are objects, with None where missing.
    A value that no message has is NaN.
    """

    time_s: F64
    values: Mapping[str, npt.NDArray[Any]]

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        """Raises KeyError that lists the columns."""
        try:
            return self.values[name]
        except KeyError:
            raise KeyError(f"{name!r}: the columns are {', '.join(self.values)}") from None


def log_arrays(path: Path | str, *topics: str) -> dict[str, dict[str, Columns]]:
    """Read a log, or all logs below a folder: log's name -> topic -> columns.

    A log's name is that of its files without their number, such as "robot-3"; files are joined in
    order. With `topics` only these are read, which is faster, and each log has all of them.

    Raises ValueError if there are no logs, FlightLogError (a ValueError) for an invalid file,
    OSError. In a folder, invalid files are skipped with a warning. Gaps in damaged logs also give a
    warning.
    """
    path = Path(path)
    paths = sorted(path.rglob("*.mcap")) if path.is_dir() else [path]
    if not paths:
        raise ValueError(f"{path}: holds no logs (*.mcap)")
    found: dict[str, dict[str, _Messages]] = {}
    gaps: list[LogGap] = []
    for file in paths:
        numbered = re.fullmatch(r"(.+)-\d+", file.stem)
        log = found.setdefault(
            numbered[1] if numbered else file.stem, {topic: _Messages() for topic in topics}
        )
        try:
            for topic, time_s, message in read(file, *topics, on_gap=gaps.append):
                log.setdefault(topic, _Messages()).add(time_s, message)
        except FlightLogError as error:
            if not path.is_dir():
                raise
            warnings.warn(f"{error}: skipped", stacklevel=2)
    for gap in gaps:
        warnings.warn(str(gap), stacklevel=2)
    return {
        name: {topic: messages.columns() for topic, messages in log.items()}
        for name, log in found.items()
    }


class _Messages:
    """Collects the messages of one topic."""

    def __init__(self) -> None:
        self._time_s: list[float] = []
        # Column -> index of message -> value.
        self._rows: dict[str, dict[int, object]] = defaultdict(dict)

    def add(self, time_s: float, message: Mapping[str, object]) -> None:
        for name, value in _flat(message):
            self._rows[name][len(self._time_s)] = value
        self._time_s.append(time_s)

    def columns(self) -> Columns:
        count = len(self._time_s)
        values = {
            name: _column([rows.get(k) for k in range(count)]) for name, rows in self._rows.items()
        }
        # A value that is a mapping in some messages, and None in others, has the mapping's columns.
        whole = {
            name
            for name, rows in self._rows.items()
            if all(value is None for value in rows.values())
        }
        whole &= {name[:k] for name in values for k, sign in enumerate(name) if sign == "."}
        return Columns(
            np.array(self._time_s), {name: v for name, v in values.items() if name not in whole}
        )


def _flat(message: Mapping[str, object], before: str = "") -> Iterator[tuple[str, object]]:
    for key, value in message.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{before}{key}.")
        else:
            yield before + key, value


def _column(values: list[object]) -> npt.NDArray[Any]:
    known = [value for value in values if value is not None]
    missing = len(known) < len(values)
    texts = not missing and all(isinstance(value, str) for value in known)
    if texts and not set(known) <= _NOT_FINITE:
        return np.array(known, np.str_)
    arrays = [_numbers(value) for value in known]
    numeric = [array for array in arrays if array is not None]
    shapes = {array.shape for array in numeric}
    if len(numeric) == len(known) and len(shapes) <= 1:
        shape = next(iter(shapes), ())
        dtype = np.result_type(*(array.dtype for array in numeric)) if numeric else np.dtype(float)
        if missing and dtype.kind != "f":
            dtype = np.dtype(float)
        column = np.full((len(values), *shape), np.nan if missing else 0, dtype)
        column[[value is not None for value in values]] = numeric
        return column
    objects = np.empty(len(values), object)
    for k, value in enumerate(values):
        objects[k] = value
    return objects


def _numbers(value: object) -> npt.NDArray[Any] | None:
    """Convert to an array; None if the value is not numeric."""
    if isinstance(value, np.ndarray | bool | int | float):
        return np.asarray(value)
    if isinstance(value, str) and value in _NOT_FINITE:
        return np.asarray(float(value))
    if not isinstance(value, list) or not value:
        return None
    parts = [np.asarray(np.nan) if part is None else _numbers(part) for part in value]
    arrays = [part for part in parts if part is not None]
    if len(arrays) < len(parts) or len({array.shape for array in arrays}) > 1:
        return None
    return np.array(arrays)
