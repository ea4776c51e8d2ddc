"""Judges whether to trust the position: one judgement for preflight, flight and status.

Vehicle state -> causes of distrust (`PositionCause`) -> `PositionQuality`, with hysteresis: a
single glitch must not land a drone, and a bad position must not be flown. No clock is used.

Errors that one receiver cannot notice, such as a drifting bias, are part of the margins: see
docs/faults.md.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, NamedTuple

from msgspec import Meta, Struct
from msgspec.structs import replace

from edge.core.schema import Bounded, Positive
from edge.core.vehicle import Gps, VehicleState

_FIX_3D = 3
# Requested at 5 and 20 Hz. An autopilot may continue to send its estimate without measurements, so
# silence is only one way to lose a position.
_GPS_SILENT_S = 1.5
_POSITION_OLD_S = 0.6
# An estimate from a vehicle's sensors never repeats exactly.
_FROZEN_S = 1.0
# A receiver's measurements have noise even at rest: three repeats are no coincidence.
_STUCK_REPEATS = 3
# A receiver's velocity error is about 0.3 m/s, an estimate's up to 0.9 m/s.
_MAX_VELOCITY_OFFSET_M_S = 2.0
# If they differ and the fix's places slip by this much, the receiver's velocity is the wrong one:
# PX4's estimator would adopt it within a second.
_SLIP_BESIDE_VELOCITY_M = 1.0
# Requested at 5 Hz, sent once a second by default; older ones say nothing about the present.
_ESTIMATOR_HEARD_S = 2.5
# Duration of a jump: longer than any sensible `doubtful_after_s`.
_JUMP_S = 1.0
# After a longer pause of the judge, all durations start again.
_NOT_LOOKED_S = 0.5
# A shorter good time does not interrupt a bad one.
_CLEAR_S = 0.5
# Time of consistency after which a receiver that contradicted itself is believed again.
_BELIEVED_AFTER_S = 1.0
# An accuracy worse than allowed by this factor counts as no position.
_HOPELESS = 2.0


class PositionQuality(StrEnum):
    """GOOD: fly by it. DOUBTFUL: stay in place. LOST: land."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    LOST = "lost"


class PositionCause(StrEnum):
    """Causes of distrust in a position, the most severe first.

    Unknown causes from newer programs are UNKNOWN.
    """

    UNKNOWN = "unknown"
    OLD = "old"
    FROZEN = "frozen"
    GPS_SILENT = "gps_silent"
    NO_FIX = "no_fix"
    GPS_STUCK = "gps_stuck"
    NOT_ESTIMATED = "not_estimated"
    INACCURATE = "inaccurate"
    DISAGREES = "disagrees"
    VELOCITY_DISAGREES = "velocity_disagrees"
    SLIPS = "slips"
    GLITCH = "glitch"
    JUMPED = "jumped"
    FEW_SATELLITES = "few_satellites"

    @classmethod
    def _missing_(cls, value: object) -> "PositionCause | None":
        return cls.UNKNOWN if isinstance(value, str) else None


_GRAVITY = {cause: rank for rank, cause in enumerate(PositionCause)}
_CONTRADICTIONS = (PositionCause.GPS_STUCK, PositionCause.SLIPS)
_WORDS = {
    PositionCause.UNKNOWN: "it is not known",
    PositionCause.OLD: "no new position arrives",
    PositionCause.FROZEN: "it never changes, unlike a real estimate",
    PositionCause.GPS_SILENT: "nothing new comes from the GPS receiver",
    PositionCause.NO_FIX: "GPS has no fix",
    PositionCause.GPS_STUCK: "the GPS receiver repeats the same fix",
    PositionCause.NOT_ESTIMATED: "the autopilot's estimator does not consider it valid",
    PositionCause.INACCURATE: "GPS is accurate to {value:.1f} m only",
    PositionCause.DISAGREES: "the GPS fix is {value:.1f} m away from the estimate",
    PositionCause.VELOCITY_DISAGREES: "the GPS velocity is {value:.1f} m/s off the estimate",
    PositionCause.SLIPS: "the GPS place moved by {value:.1f} m, contrary to its velocity",
    PositionCause.GLITCH: "the autopilot's estimator rejects the GPS",
    PositionCause.JUMPED: "it jumped",
    PositionCause.FEW_SATELLITES: "GPS sees {value:.0f} satellites only",
}


@dataclass(frozen=True, slots=True)
class PositionLimits(Bounded):
    """Requirements of the position in flight, and times until they act.

    `max_accuracy_m` bounds the receiver's own figure; `max_offset_m` bounds the distance of its fix
    from the estimate, and the difference in 10 s between its movement and its own velocity. A
    position becomes doubtful after `doubtful_after_s` with causes of distrust, never interrupted
    for 0.5 s; lost after `lost_after_s` without position, or `doubtful_lost_after_s` in doubt; and
    good again after `good_after_s` without cause.

    Raises ValueError if a number is out of range.
    """

    min_satellites: Annotated[int, Meta(ge=4)] = 6
    max_accuracy_m: Positive = 5.0
    max_offset_m: Positive = 5.0
    doubtful_after_s: Annotated[float, Meta(gt=0.0, lt=_JUMP_S)] = 0.4
    lost_after_s: Positive = 2.0
    doubtful_lost_after_s: Positive = 60.0
    good_after_s: Positive = 3.0

    def check_rules(self) -> None:
        if not self.doubtful_after_s < self.lost_after_s < self.doubtful_lost_after_s:
            raise ValueError(
                f"lost_after_s = {self.lost_after_s}, doubtful_lost_after_s = "
                f"{self.doubtful_lost_after_s}: must be doubtful_after_s < lost_after_s < "
                "doubtful_lost_after_s"
            )


class PositionJudgement(Struct, frozen=True):
    """Trust in the position, since `since_s`; `cause` is the present or last cause of distrust.

    `value` is the measured value of a cause with a number. `contradicted_at_s` is when the receiver
    last contradicted itself: an estimator that uses it is led astray within seconds, and is better
    off without it. Distrust began at `bad_since_s`, never interrupted for 0.5 s; the position is
    missing since `none_since_s`, and without causes of distrust since `good_since_s`; None if not
    so now.
    """

    quality: PositionQuality = PositionQuality.LOST
    cause: PositionCause | None = PositionCause.UNKNOWN
    value: float = math.nan
    since_s: float = -math.inf
    bad_since_s: float | None = None
    none_since_s: float | None = None
    good_since_s: float | None = None
    contradicted_at_s: float = -math.inf
    looked_from_s: float = math.inf
    looked_at_s: float = -math.inf

    @property
    def text(self) -> str:
        """Text for people why the position is not good; "" if it is."""
        return "" if self.cause is None else _WORDS[self.cause].format(value=self.value)

    @property
    def distrusts_gps(self) -> bool:
        """Whether the receiver contradicts itself, or did a moment ago."""
        return self.looked_at_s - self.contradicted_at_s < _BELIEVED_AFTER_S


class _Finding(NamedTuple):
    """A present cause of distrust; with `is_none`, the position counts as missing."""

    cause: PositionCause
    is_none: bool
    since_s: float
    value: float = math.nan


def judge(
    before: PositionJudgement, vehicle: VehicleState, limits: PositionLimits, now_s: float
) -> PositionJudgement:
    """Judge the position now. Call it a few times a second."""
    looked_from_s = before.looked_from_s
    if not now_s - before.looked_at_s <= _NOT_LOOKED_S:
        # The time in between is unknown: start all durations again.
        looked_from_s = now_s
        before = replace(before, bad_since_s=None, none_since_s=None, good_since_s=None)
    found = _findings(vehicle, limits, now_s)
    findings = tuple(sorted(found, key=lambda finding: _GRAVITY[finding.cause]))
    without = tuple(finding for finding in findings if finding.is_none)
    none_since_s = _since(before.none_since_s, without, looked_from_s)
    good_since_s = None
    if not findings:
        good_since_s = now_s if before.good_since_s is None else before.good_since_s
    bad_since_s = before.bad_since_s
    if before.good_since_s is not None and now_s - before.good_since_s >= _CLEAR_S:
        bad_since_s = None
    if findings:
        bad_since_s = _since(bad_since_s, findings, looked_from_s)
    contradicts = any(finding.cause in _CONTRADICTIONS for finding in findings)
    quality = before.quality
    doubtful_s = now_s - before.since_s if quality is PositionQuality.DOUBTFUL else 0.0
    if (
        none_since_s is not None and now_s - none_since_s >= limits.lost_after_s
    ) or doubtful_s >= limits.doubtful_lost_after_s:
        quality = PositionQuality.LOST
    elif findings and bad_since_s is not None and now_s - bad_since_s >= limits.doubtful_after_s:
        quality = PositionQuality.DOUBTFUL if quality is PositionQuality.GOOD else quality
    elif good_since_s is not None and now_s - good_since_s >= limits.good_after_s:
        quality = PositionQuality.GOOD
    if findings:
        cause, value = findings[0].cause, findings[0].value
    elif quality is PositionQuality.GOOD:
        cause, value = None, math.nan
    else:
        cause, value = before.cause, before.value
    return PositionJudgement(
        quality=quality,
        cause=cause,
        value=value,
        since_s=before.since_s if quality is before.quality else now_s,
        bad_since_s=bad_since_s,
        none_since_s=none_since_s,
        good_since_s=good_since_s,
        contradicted_at_s=now_s if contradicts else before.contradicted_at_s,
        looked_from_s=looked_from_s,
        looked_at_s=now_s,
    )


def _since(
    before_s: float | None, findings: tuple[_Finding, ...], looked_from_s: float
) -> float | None:
    if not findings:
        return None
    first_s = max(min(finding.since_s for finding in findings), looked_from_s)
    return first_s if before_s is None else min(before_s, first_s)


def _findings(vehicle: VehicleState, limits: PositionLimits, now_s: float) -> Iterator[_Finding]:
    """Yield all present causes of distrust."""
    if vehicle.position_local_m is None or vehicle.origin is None:
        yield _Finding(PositionCause.UNKNOWN, True, now_s)
    elif now_s - vehicle.position_at_s > _POSITION_OLD_S:
        # The vehicle's state is unknown since the last message, so count from there.
        yield _Finding(PositionCause.OLD, True, vehicle.position_at_s)
    elif now_s - vehicle.position_changed_at_s > _FROZEN_S:
        yield _Finding(PositionCause.FROZEN, True, vehicle.position_changed_at_s + _FROZEN_S)
    yield from _findings_of_receiver(vehicle.gps, limits, now_s)
    estimator = vehicle.estimator
    if estimator is not None and now_s - estimator.at_s <= _ESTIMATOR_HEARD_S:
        if not estimator.horizontal:
            yield _Finding(PositionCause.NOT_ESTIMATED, True, now_s)
        if estimator.glitch:
            yield _Finding(PositionCause.GLITCH, False, now_s)
    if now_s - vehicle.jumped_at_s <= _JUMP_S:
        yield _Finding(PositionCause.JUMPED, False, vehicle.jumped_at_s)


def _findings_of_receiver(
    gps: Gps | None, limits: PositionLimits, now_s: float
) -> Iterator[_Finding]:
    if gps is None or now_s - gps.at_s > _GPS_SILENT_S:
        # Counted from when it is noticed: a pause of the receiver must not land a drone at once.
        yield _Finding(
            PositionCause.GPS_SILENT, True, now_s if gps is None else gps.at_s + _GPS_SILENT_S
        )
    elif gps.fix < _FIX_3D:
        yield _Finding(PositionCause.NO_FIX, True, now_s)
    if gps is None or gps.fix < _FIX_3D:
        return
    if gps.repeats >= _STUCK_REPEATS:
        yield _Finding(PositionCause.GPS_STUCK, True, now_s)
    accuracy_m = gps.accuracy_m
    if accuracy_m is not None and not accuracy_m <= limits.max_accuracy_m:
        hopeless = not accuracy_m <= _HOPELESS * limits.max_accuracy_m
        yield _Finding(PositionCause.INACCURATE, hopeless, now_s, accuracy_m)
    off_m_s, slip_limit_m = gps.velocity_offset_m_s, limits.max_offset_m
    if off_m_s is not None and not off_m_s <= _MAX_VELOCITY_OFFSET_M_S:
        slip_limit_m = min(slip_limit_m, _SLIP_BESIDE_VELOCITY_M)
    for cause, value, limit in (
        (PositionCause.DISAGREES, gps.offset_m, limits.max_offset_m),
        (PositionCause.VELOCITY_DISAGREES, off_m_s, _MAX_VELOCITY_OFFSET_M_S),
        (PositionCause.SLIPS, gps.slip_m, slip_limit_m),
    ):
        if value is not None and not value <= limit:
            yield _Finding(cause, True, now_s, value)
    if gps.satellites < limits.min_satellites:
        yield _Finding(PositionCause.FEW_SATELLITES, False, now_s, gps.satellites)
