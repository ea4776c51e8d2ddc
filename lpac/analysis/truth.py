"""True tracks of vehicles, from simulators, instruments and logs of PX4.

Simulators write them to truth.npz beside the robots' logs, for `lpac report`.
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
    """One vehicle's true track: `time_s` (T,), ascending, `position_m` (T, 3), `airborne` (T,).

    Clock and frame are the owner's. In a flight's record and in files they are the mission frame,
    with heights above the ground.

    The other arrays are empty if unknown: `velocity_m_s` (T, 3), `mode` (T,), PX4's number, `armed`
    (T,), `setpoint_at_s` (T,), time of the last setpoint, `is_velocity` (T,), whether that was a
    horizontal velocity, as in a mission, `velocity_error_m_s` (T,), error of the vehicle's
    horizontal velocity estimate, and `commands` (T,), number of commands sent to it.
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
        """Positions (len(times_s), 3); NaN outside of the track's time."""
        if not len(self.time_s):
            return np.full((len(times_s), 3), np.nan)
        known = (times_s >= self.time_s[0]) & (times_s <= self.time_s[-1])
        places_m = [np.interp(times_s, self.time_s, self.position_m[:, axis]) for axis in range(3)]
        return np.where(known[:, None], np.stack(places_m, axis=1), np.nan)

    def places_at(self, times_s: F64) -> F64:
        """Like `positions_at`, with NaN on the ground."""
        if not len(self.time_s):
            return np.full((len(times_s), 3), np.nan)
        after = np.searchsorted(self.time_s, times_s).clip(max=len(self.time_s) - 1)
        return np.where(self.airborne[after, None], self.positions_at(times_s), np.nan)

    def is_in(self, *modes: int) -> Bools:
        """Mask (T,) of the times in one of these modes of PX4."""
        return np.isin(self.mode, modes)

    def between(self, begin_s: float, end_s: float) -> Self:
        """The part from `begin_s` to `end_s`, exclusive."""
        part = slice(*np.searchsorted(self.time_s, (begin_s, end_s)).tolist())
        return replace(self, **{each.name: getattr(self, each.name)[part] for each in fields(self)})

    def shifted(self, by_s: float) -> Self:
        """The same track on a clock that is `by_s` ahead."""
        return replace(self, time_s=self.time_s + by_s, setpoint_at_s=self.setpoint_at_s + by_s)


def write_truth(tracks: Mapping[int, TrueTrack], path: Path) -> None:
    """Write tracks by robot id, in Unix time and the mission frame. Raises OSError."""
    arrays = {
        f"{robot_id}.{name}": getattr(track, name)
        for robot_id, track in tracks.items()
        for name in _COLUMNS
    }
    np.savez(path, **arrays)


def load_truth(path: Path) -> dict[int, TrueTrack]:
    """Read a file of `write_truth`. Raises ValueError that names the fault, OSError."""
    try:
        with ZipFile(path) as file:
            # `write_truth` does not compress, so a larger content is refused before it is unpacked.
            if sum(member.file_size for member in file.infolist()) > path.stat().st_size:
                raise ValueError("is compressed")
        with np.load(path, allow_pickle=False) as arrays:
            robots = sorted({int(name.partition(".")[0]) for name in arrays.files})
            return {robot: _track(*(arrays[f"{robot}.{c}"] for c in _COLUMNS)) for robot in robots}
    # Files of unknown origin may raise any of these.
    except (ValueError, LookupError, EOFError, MemoryError, RuntimeError, BadZipFile) as error:
        raise ValueError(f"{path}: is not a file of true tracks: {error}") from None


def _track(time_s: F64, position_m: F64, airborne: npt.NDArray[np.bool_]) -> TrueTrack:
    count = len(time_s)
    if (
        (time_s.shape, position_m.shape, airborne.shape) != ((count,), (count, 3), (count,))
        or [column.dtype.kind for column in (time_s, position_m, airborne)] != ["f", "f", "b"]
        or not (np.diff(time_s) >= 0.0).all()
    ):
        raise ValueError("its arrays do not match")
    return TrueTrack(time_s, position_m, airborne)
