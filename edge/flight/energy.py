"""How long the battery lasts, and how long the way home takes; nothing here has a clock.

A percentage alone does not tell: packs age, and the one whose slot is highest waits longest. The
consumption of this flight is measured, so that a weak pack shows after a minute.
"""

import math
from bisect import bisect_left, insort
from collections import deque
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta

from edge.core.schema import Bounded

# The voltage falls when the motors start, and PX4's estimate of the charge with it.
_SETTLED_S = 15.0
# A share comes in whole percents.
_SAMPLE_S = 5.0
_SAMPLES = 36
_LEAST_MEASURED_S = 60.0
# What is measured may say that a pack is worse than configured, but not that it lasts for ever.
_AT_LEAST_DRAIN = 0.5
# One message that is wrong is not believed.
_MEDIAN_S = 5.0
# Home is flown at less than full speed: there are corners, neighbours and wind.
_SPEED_SHARE = 0.7
# PX4's MPC_LAND_SPEED is 0.7 m/s; and what it takes to find the ground and stop the motors.
_LANDING_M_S, _TOUCHDOWN_S = 0.5, 5.0
_UpToAnHour = Annotated[float, Meta(ge=0.0, le=3600.0)]


@dataclass(frozen=True, slots=True)
class EnergyParameters(Bounded):
    """Endurance of a pack; times in s.

    `endurance_s` is a flight with a full pack until it is empty, for as long as none was measured.
    `cells` in series, 0 if not known: then `low_cell_v`, V per cell under load, is not looked at.
    `queue_s`: for each lower slot, how long that robot may keep this one from landing. `reserve_s`
    is left when it has landed.

    Raises ValueError that names what is impossible.
    """

    endurance_s: Annotated[float, Meta(ge=60.0, le=36_000.0)] = 900.0
    cells: Annotated[int, Meta(ge=0, le=14)] = 0
    low_cell_v: Annotated[float, Meta(ge=2.0, le=4.2)] = 3.4
    queue_s: _UpToAnHour = 10.0
    reserve_s: _UpToAnHour = 60.0


class Energy(NamedTuple):
    """Flight time that is left, and that is needed.

    `lasts_s` is how long the robot flies until its battery is critical, by this flight's drain.
    `home_s` is what it takes from here until the vehicle has landed, with the wait before and the
    reserve after; None where that is not known. `cell_v` is a cell's voltage now, None if not
    known; `low_cell_v` the limit.
    """

    lasts_s: float
    home_s: float | None
    cell_v: float | None
    low_cell_v: float

    def shortage(self) -> str | None:
        """Why the robot must go home, in words; None if it need not."""
        if self.home_s is not None and self.lasts_s < self.home_s:
            # In steps, so that the same is told in the same words.
            lasts_s, needs_s = math.floor(self.lasts_s / 10) * 10, math.ceil(self.home_s / 10) * 10
            return f"battery lasts {lasts_s} s more, home and landing take {needs_s} s"
        if self.cell_v is not None and self.cell_v < self.low_cell_v:
            return f"battery low under load: {self.cell_v:.2f} V per cell"
        return None


class Consumption:
    """Estimator of the battery's endurance, flight by flight. For one thread."""

    def __init__(self, parameters: EnergyParameters) -> None:
        self._parameters = parameters
        self._armed_at_s: float | None = None
        self._share, self._voltage_v = _Recent(), _Recent()
        self._samples: deque[tuple[float, float]] = deque(maxlen=_SAMPLES)
        self._endurance_s = parameters.endurance_s

    @property
    def endurance_s(self) -> float:
        """How long a full pack lasts: by this flight's drain, else the last one's, else as said."""
        return self._endurance_s

    def hear(
        self, now_s: float, armed: bool | None, share: float | None, voltage_v: float | None
    ) -> None:
        """Take the autopilot's reading of the battery: its remaining share, and its voltage."""
        self._share.hear(now_s, share)
        if self._parameters.cells:
            self._voltage_v.hear(now_s, voltage_v)
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
        """The estimate: `until_share` is when the battery is critical. None if nothing is heard."""
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
        self._heard: deque[tuple[float, float | None]] = deque()
        # The finite ones, in ascending order.
        self._ordered: list[float] = []

    def hear(self, now_s: float, value: float | None) -> None:
        if value is not None and math.isfinite(value):
            insort(self._ordered, value)
        self._heard.append((now_s, value))
        while now_s - self._heard[0][0] > _MEDIAN_S:
            _, old = self._heard.popleft()
            if old is not None and math.isfinite(old):
                del self._ordered[bisect_left(self._ordered, old)]

    def median(self) -> float | None:
        ordered = self._ordered
        # A battery that is silent now is not known, whatever it said before.
        if not ordered or self._heard[-1][1] is None:
            return None
        middle, is_odd = divmod(len(ordered), 2)
        return ordered[middle] if is_odd else (ordered[middle - 1] + ordered[middle]) / 2.0


def _drain(samples: deque[tuple[float, float]]) -> float:
    """Share per s: the median of the slopes between all pairs, which a jump hardly moves."""
    times_s, shares = np.array(samples).T
    i, j = np.triu_indices(len(times_s), 1)
    # np.median would import a part of numpy, in flight.
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
    """From `away_m` and `height_m` until the robot stands on its landing point, and the reserve."""
    to_slot_s = abs(slot_height_m - height_m) / max_climb_m_s
    flight_s = away_m / (_SPEED_SHARE * max_speed_m_s)
    landing_s = slot_height_m / _LANDING_M_S + _TOUCHDOWN_S
    queue_s = slot * parameters.queue_s
    return to_slot_s + flight_s + queue_s + landing_s + parameters.reserve_s


def trials(
    parameters: EnergyParameters,
    *,
    share: float,
    min_battery: float,
    battery_low: float,
    battery_critical: float,
    endurance_s: float,
    trial_s: float,
    away_m: float,
    slot: int,
    slot_height_m: float,
    max_speed_m_s: float,
    max_climb_m_s: float,
) -> int:
    """How many trials a pack is good for: none counts in which the robot would return by itself.

    Each is a climb to the slot, a wait there for the others, `trial_s` of mission, and the way home
    from `away_m`, the queue and the landing. Then the next takes off, with `min_battery` at least.
    """
    down_s = home_s(
        parameters,
        away_m=away_m,
        height_m=slot_height_m,
        slot=slot,
        slot_height_m=slot_height_m,
        max_speed_m_s=max_speed_m_s,
        max_climb_m_s=max_climb_m_s,
    )
    returns_at = max(battery_low, battery_critical + down_s / endurance_s)
    mission_s = 2.0 * slot_height_m / max_climb_m_s + trial_s
    # What may be used before the last one begins.
    until = max(min_battery, returns_at + mission_s / endurance_s)
    each_s = mission_s + down_s - parameters.reserve_s
    return max(math.floor((share - until) * endurance_s / each_s) + 1, 0)
