"""Battery endurance, and time needed for the way home; no clock is used.

A percentage alone is not enough: packs age, and the robot in the highest slot waits longest to
land. The consumption is measured in flight, so a weak pack shows after a minute.
"""

import math
from bisect import bisect_left, insort
from collections import deque
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta

from edge.core.schema import Bounded

# The voltage drops when the motors start, and with it PX4's estimate of the charge.
_SETTLED_S = 15.0
# Shares are whole percents.
_SAMPLE_S = 5.0
_SAMPLES = 36
_LEAST_MEASURED_S = 60.0
# A measurement may show a pack to be worse than configured, but at most this much better.
_AT_LEAST_DRAIN = 0.5
# The median rejects a single wrong message.
_MEDIAN_S = 5.0
# The way home is flown below maximum speed: corners, neighbours and wind.
_SPEED_SHARE = 0.7
# PX4's MPC_LAND_SPEED is 0.7 m/s; and time to detect the ground and stop the motors.
_LANDING_M_S, _TOUCHDOWN_S = 0.5, 5.0
_UpToAnHour = Annotated[float, Meta(ge=0.0, le=3600.0)]


@dataclass(frozen=True, slots=True)
class EnergyParameters(Bounded):
    """Endurance of a pack; times in s.

    `endurance_s` is the flight time of a full pack until it is empty, until one is measured.
    `cells` in series, 0 if unknown, disables `low_cell_v`, V per cell under load. `queue_s` is the
    time that a robot in each lower slot may delay this one's landing. `reserve_s` must be left
    after landing.

    Raises ValueError that names the impossible value.
    """

    endurance_s: Annotated[float, Meta(ge=60.0, le=36_000.0)] = 900.0
    cells: Annotated[int, Meta(ge=0, le=14)] = 0
    low_cell_v: Annotated[float, Meta(ge=2.0, le=4.2)] = 3.4
    queue_s: _UpToAnHour = 10.0
    reserve_s: _UpToAnHour = 60.0


class Energy(NamedTuple):
    """Available and required flight time.

    `lasts_s` is the time until the battery is critical, by this flight's consumption. `home_s` is
    the time from here to landing, including the queue before and the reserve after; None if
    unknown. `cell_v` is the present voltage of a cell, None if unknown; `low_cell_v` is its limit.
    """

    lasts_s: float
    home_s: float | None
    cell_v: float | None
    low_cell_v: float

    def shortage(self) -> str | None:
        """Reason why the robot must go home; None if it need not."""
        if self.home_s is not None and self.lasts_s < self.home_s:
            # Rounded, so that the text stays the same for a while.
            lasts_s, needs_s = math.floor(self.lasts_s / 10) * 10, math.ceil(self.home_s / 10) * 10
            return f"battery lasts {lasts_s} s more, home and landing take {needs_s} s"
        if self.cell_v is not None and self.cell_v < self.low_cell_v:
            return f"battery low under load: {self.cell_v:.2f} V per cell"
        return None


class Consumption:
    """Estimates the battery's endurance, flight by flight. Not thread-safe."""

    def __init__(self, parameters: EnergyParameters) -> None:
        self._parameters = parameters
        self._armed_at_s: float | None = None
        self._share, self._voltage_v = _Recent(), _Recent()
        self._samples: deque[tuple[float, float]] = deque(maxlen=_SAMPLES)
        self._endurance_s = parameters.endurance_s

    @property
    def endurance_s(self) -> float:
        """Endurance of a full pack: measured in this or the last flight, else as configured."""
        return self._endurance_s

    def add(
        self, now_s: float, armed: bool | None, share: float | None, voltage_v: float | None
    ) -> None:
        """Add the autopilot's remaining share and voltage of the battery."""
        self._share.add(now_s, share)
        if self._parameters.cells:
            self._voltage_v.add(now_s, voltage_v)
        if not armed:
            self._armed_at_s = None
            self._samples.clear()
            return
        self._armed_at_s = now_s if self._armed_at_s is None else self._armed_at_s
        due_s = self._samples[-1][0] + _SAMPLE_S if self._samples else -math.inf
        if now_s - self._armed_at_s < _SETTLED_S or now_s < due_s:
            return
        smooth = self._share.median()
        if smooth is None:
            return
        self._samples.append((now_s, smooth))
        if now_s - self._samples[0][0] >= _LEAST_MEASURED_S:
            least = _AT_LEAST_DRAIN / self._parameters.endurance_s
            self._endurance_s = 1.0 / max(_drain(self._samples), least)

    def energy(self, until_share: float, home_s: float | None) -> Energy | None:
        """Estimate with the critical share `until_share`; None without readings."""
        share, voltage_v = self._share.median(), self._voltage_v.median()
        if share is None:
            return None
        return Energy(
            lasts_s=max(share - until_share, 0.0) * self._endurance_s,
            home_s=home_s,
            cell_v=None if voltage_v is None else voltage_v / self._parameters.cells,
            low_cell_v=self._parameters.low_cell_v,
        )


class _Recent:
    """Readings of one value in the last few seconds, and their median."""

    def __init__(self) -> None:
        self._readings: deque[tuple[float, float | None]] = deque()
        # The finite values, ascending.
        self._ordered: list[float] = []

    def add(self, now_s: float, value: float | None) -> None:
        if value is not None and math.isfinite(value):
            insort(self._ordered, value)
        self._readings.append((now_s, value))
        while now_s - self._readings[0][0] > _MEDIAN_S:
            _, old = self._readings.popleft()
            if old is not None and math.isfinite(old):
                del self._ordered[bisect_left(self._ordered, old)]

    def median(self) -> float | None:
        ordered = self._ordered
        # If the newest reading is missing, the battery is unknown.
        if not ordered or self._readings[-1][1] is None:
            return None
        middle, is_odd = divmod(len(ordered), 2)
        return ordered[middle] if is_odd else (ordered[middle - 1] + ordered[middle]) / 2.0


def _drain(samples: deque[tuple[float, float]]) -> float:
    """Share per s: the median slope between all pairs, which is robust against jumps."""
    times_s, shares = np.array(samples).T
    i, j = np.triu_indices(len(times_s), 1)
    # np.median would import a module in flight.
    slopes = np.sort((shares[i] - shares[j]) / (times_s[j] - times_s[i]))
    return float(0.5 * (slopes[(len(slopes) - 1) // 2] + slopes[len(slopes) // 2]))


def home_s(
    parameters: EnergyParameters,
    *,
    away_m: float,
    height_m: float,
    slot: int,
    slot_height_m: float,
    max_speed_m_s: float,
    max_climb_m_s: float,
) -> float:
    """Time from `away_m` and `height_m` to standing on the landing point, plus the reserve."""
    to_slot_s = abs(slot_height_m - height_m) / max_climb_m_s
    flight_s = away_m / (_SPEED_SHARE * max_speed_m_s)
    landing_s = slot_height_m / _LANDING_M_S + _TOUCHDOWN_S
    queue_s = slot * parameters.queue_s
    return to_slot_s + flight_s + queue_s + landing_s + parameters.reserve_s
