"""Where vehicles really were: simulated ones tell it, and a PX4 in software in its log.

A simulator leaves it as truth.npz beside its robots' logs, for `lpac report`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Self
from zipfile import BadZipFile, ZipFile

import numpy as np
import numpy.typing as npt

from edge.core import F64, Bools

TRUTH = "truth.npz"
_COLUMNS = ("time_s", "position_m", "airborne")


def _nothing() -> npt.NDArray[np.int64]:
    return np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class TrueTrack:
    """Where one vehicle was: `time_s` (T,), ascending, `position_m` (T, 3), `airborne` (T,).

    In the clock and the frame of whoever has it. In a flight's record, and in a file, that is the
    mission frame, with heights above the ground.

    The others are empty where nothing tells: `velocity_m_s` (T, 3), `mode` (T,), PX4's number of
    it, `armed` (T,), `setpoint_at_s` (T,), when the last setpoint had come, `is_velocity` (T,),
    whether that moved it in the plane, as in a mission, `velocity_error_m_s` (T,), how wrong its
    estimate of the horizontal velocity was, and `commands` (T,), how many had been sent to it.
    """

    time_s: F64
    position_m: F64
    airborne: Bools
    velocity_m_s: F64 = field(default_factory=lambda: np.zeros((0, 3)))
    mode: npt.NDArray[np.int64] = field(default_factory=_nothing)
    armed: Bools = field(default_factory=lambda: np.zeros(0, np.bool_))
    setpoint_at_s: F64 = field(default_factory=lambda: np.zeros(0))
    is_velocity: Bools = field(default_factory=lambda: np.zeros(0, np.bool_))
    velocity_error_m_s: F64 = field(default_factory=lambda: np.zeros(0))
    commands: npt.NDArray[np.int64] = field(default_factory=_nothing)

    def positions_at(self, times_s: F64) -> F64:
        """(len(times_s), 3): NaN before the first and after the last that is known."""
        if not len(self.time_s):
            return np.full((len(times_s), 3), np.nan)
        known = (times_s >= self.time_s[0]) & (times_s <= self.time_s[-1])
        places_m = [np.interp(times_s, self.time_s, self.position_m[:, axis]) for axis in range(3)]
        return np.where(known[:, None], np.stack(places_m, axis=1), np.nan)

    def places_at(self, times_s: F64) -> F64:
        """The same, and NaN where it was not in the air."""
        if not len(self.time_s):
            return np.full((len(times_s), 3), np.nan)
        after = np.searchsorted(self.time_s, times_s).clip(max=len(self.time_s) - 1)
        return np.where(self.airborne[after, None], self.positions_at(times_s), np.nan)

    def is_in(self, *modes: int) -> Bools:
        """(T,): whether it was in one of these modes of PX4."""
        return np.isin(self.mode, modes)

    def between(self, begin_s: float, end_s: float) -> Self:
        """That part of it, without the end."""
        part = slice(*np.searchsorted(self.time_s, (begin_s, end_s)).tolist())
        return replace(self, **{each.name: getattr(self, each.name)[part] for each in fields(self)})

    def shifted(self, by_s: float) -> Self:
        """The same on a clock that is `by_s` ahead."""
        return replace(self, time_s=self.time_s + by_s, setpoint_at_s=self.setpoint_at_s + by_s)


def write_truth(tracks: Mapping[int, TrueTrack], path: Path) -> None:
    """By robot id, in Unix time and the mission frame. Raises OSError."""
    arrays = {
        f"{robot_id}.{name}": getattr(track, name)
        for robot_id, track in tracks.items()
        for name in _COLUMNS
    }
    np.savez(path, **arrays)


def load_truth(path: Path) -> dict[int, TrueTrack]:
    """Read a file of `write_truth`. Raises ValueError that says what is wrong, OSError."""
    try:
        with ZipFile(path) as file:
            # As it is written: nothing unpacks to more.
            if sum(member.file_size for member in file.infolist()) > path.stat().st_size:
                raise ValueError("is compressed")
        with np.load(path, allow_pickle=False) as arrays:
            robots = sorted({int(name.partition(".")[0]) for name in arrays.files})
            return {robot: _track(*(arrays[f"{robot}.{c}"] for c in _COLUMNS)) for robot in robots}
    # Whoever reads it may not know who made it: such is raised, too, of what cannot be.
    except (ValueError, LookupError, EOFError, MemoryError, RuntimeError, BadZipFile) as error:
        raise ValueError(f"{path}: is no record of vehicles: {error}") from None


def _track(time_s: F64, position_m: F64, airborne: npt.NDArray[np.bool_]) -> TrueTrack:
    count = len(time_s)
    if (
        (time_s.shape, position_m.shape, airborne.shape) != ((count,), (count, 3), (count,))
        or [column.dtype.kind for column in (time_s, position_m, airborne)] != ["f", "f", "b"]
        or not (np.diff(time_s) >= 0.0).all()
    ):
        raise ValueError("its arrays are others")
    return TrueTrack(time_s, position_m, airborne)
