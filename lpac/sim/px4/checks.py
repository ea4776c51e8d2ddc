"""PX4's health and arming checks of the vehicle, as it reports them.

Each problem belongs to a component and prevents arming in some modes. A report has all problems at
one time; the bits of SYS_STATUS, the armable modes, and PX4's events and texts follow from it.
"""

import math
import struct
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import IntEnum

from lpac.sim.px4.modes import Px4Mode


class Component(IntEnum):
    """PX4's components, by the number of their bit."""

    BAROMETER = 1
    GPS = 3
    REMOTE_CONTROL = 7
    LOGGING = 10
    BATTERY = 11
    COMMUNICATION_LINKS = 12
    ATTITUDE_ESTIMATE = 16
    LOCAL_POSITION_ESTIMATE = 17
    SYSTEM = 20
    GLOBAL_POSITION_ESTIMATE = 24
    COMPASS = 27
    ACCELEROMETER = 28
    GYROSCOPE = 29


class Level(IntEnum):
    """Severity of an event or a text: MAV_SEVERITY, and a level for programs alone."""

    EMERGENCY = 0
    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    INFO = 6
    PROTOCOL = 8


@dataclass(frozen=True, slots=True)
class Px4Event:
    """An EVENT of the vehicle, with a STATUSTEXT where PX4 has one.

    `number` is the event's id in PX4.
    """

    number: int
    level: Level
    arguments: bytes = b""
    text: str = ""
    text_level: Level = Level.CRITICAL


@dataclass(frozen=True, slots=True)
class ArmingProblem:
    """One check that fails; masks have a bit per `Px4Mode`.

    `blocks_arming` has the modes in which arming is refused, `blocks_entry` those that
    cannot be entered, `reported_modes` those that the event reports.
    """

    number: int
    component: Component
    level: Level
    blocks_arming: int = 0
    blocks_entry: int = 0
    reported_modes: int = 0xFFFFFFFF
    arguments: bytes = b""
    text: str = ""
    text_level: Level = Level.CRITICAL
    is_health: bool = False

    def event(self) -> Px4Event:
        """As PX4 reports it."""
        arguments = struct.pack("<IB", self.reported_modes, self.component) + self.arguments
        return Px4Event(self.number, self.level, arguments, self.text, self.text_level)


_ALL = 0x807FFFFF
_BY_HAND, _MISSION, _OFFBOARD = 0x8547, 0x8, 0x4000
_LOCAL, _GLOBAL, _ATTITUDE, _HOME = 0x7E007C, 0x38, 0x7ED17E, 0x20
_NOT_FOR_TAKEOFF = 0x3C3020

_ERROR, _INFO, _CRITICAL = Level.ERROR, Level.INFO, Level.CRITICAL


def _mode_problem(number: int, component: Component, level: Level, modes: int) -> ArmingProblem:
    return ArmingProblem(number, component, level, modes, modes, modes)


def _no_data(number: int, component: Component, text: str) -> ArmingProblem:
    return ArmingProblem(
        number, component, _ERROR, _ALL, arguments=b"\0", text=f"Preflight Fail: {text}",
        is_health=True,
    )  # fmt: skip


# No mission is ever uploaded to this vehicle.
NO_MISSION = _mode_problem(377561, Component.SYSTEM, _INFO, _MISSION)
NO_ATTITUDE = _mode_problem(10450063, Component.ATTITUDE_ESTIMATE, _CRITICAL, _ATTITUDE)
NO_LOCAL_POSITION = _mode_problem(13835193, Component.LOCAL_POSITION_ESTIMATE, _ERROR, _LOCAL)
NO_GLOBAL_POSITION = _mode_problem(10011251, Component.GLOBAL_POSITION_ESTIMATE, _ERROR, _GLOBAL)
NO_OFFBOARD_SIGNAL = _mode_problem(3087815, Component.SYSTEM, _ERROR, _OFFBOARD)
NO_HOME = _mode_problem(79408, Component.SYSTEM, _INFO, _HOME)
# With COM_RC_IN_MODE 4 (no manual control at all), and otherwise.
MANUAL_CONTROL_DISABLED = _mode_problem(453929, Component.REMOTE_CONTROL, _ERROR, _BY_HAND)
NO_MANUAL_CONTROL = replace(MANUAL_CONTROL_DISABLED, level=Level.WARNING, reported_modes=0xFFFFFFFF)
MODE_PREVENTS_ARMING = ArmingProblem(
    1871713, Component.SYSTEM, _INFO, _NOT_FOR_TAKEOFF, reported_modes=_NOT_FOR_TAKEOFF
)
GPS_FIX_TOO_LOW = ArmingProblem(
    12369553, Component.GPS, Level.WARNING, reported_modes=_LOCAL | _GLOBAL,
    text="Preflight: GPS fix too low", text_level=Level.WARNING,
)  # fmt: skip
FENCE_BREACHED = ArmingProblem(143019, Component.SYSTEM, _ERROR, _ALL)
NO_GROUND_STATION = ArmingProblem(6801787, Component.COMMUNICATION_LINKS, _INFO)
GROUND_STATION_REQUIRED = replace(
    NO_GROUND_STATION,
    level=_ERROR,
    blocks_arming=_ALL,
    text="Preflight Fail: No connection to the GCS",
    text_level=Level.WARNING,
)
BATTERY_LOW = ArmingProblem(5049764, Component.BATTERY, _CRITICAL, text="Low battery\t")
BATTERY_CRITICAL = ArmingProblem(
    2627595, Component.BATTERY, _CRITICAL, _ALL, text="Critical battery\t"
)
BATTERY_EMERGENCY = ArmingProblem(
    11344647, Component.BATTERY, Level.EMERGENCY, _ALL, text="Emergency battery level\t"
)
BATTERY_SILENT = ArmingProblem(
    13344346, Component.BATTERY, _ERROR, _ALL, text="Preflight Fail: Battery unhealthy",
    is_health=True,
)  # fmt: skip
NO_BAROMETER = _no_data(3189229, Component.BAROMETER, "No valid data from Baro 0")
NO_COMPASS = _no_data(6410608, Component.COMPASS, "No valid data from Compass 0")

_ARMING_SUMMARY, _HEALTH_SUMMARY = 11047904, 1914663


@dataclass(frozen=True, slots=True)
class HealthReport:
    """All problems at one time, and the components present."""

    problems: tuple[ArmingProblem, ...] = ()
    present: frozenset[Component] = frozenset()

    @property
    def unhealthy(self) -> frozenset[Component]:
        """The components that have a problem, or a warning."""
        return frozenset(p.component for p in self.problems if p.level <= Level.WARNING)

    def can_arm(self, mode: Px4Mode) -> bool:
        """Whether the vehicle may be armed in this mode."""
        return not _union(p.blocks_arming for p in self.problems) >> mode & 1

    def can_run(self, mode: Px4Mode) -> bool:
        """Whether the vehicle may fly in this mode."""
        return not _union(p.blocks_entry for p in self.problems) >> mode & 1

    def events(self) -> list[Px4Event]:
        """The report as PX4 sends it: a summary, each problem, and a summary of the sensors."""
        arming = struct.pack(
            "<BIIII",
            0,
            self._bits(is_health=False, warnings=False),
            self._bits(is_health=False, warnings=True),
            _ALL & ~_union(p.blocks_arming for p in self.problems),
            _ALL & ~_union(p.blocks_entry for p in self.problems),
        )
        health = struct.pack(
            "<BIII",
            0,
            _union(1 << component for component in self.present),
            self._bits(is_health=True, warnings=False),
            self._bits(is_health=True, warnings=True),
        )
        return [
            Px4Event(_ARMING_SUMMARY, Level.PROTOCOL, arming),
            *(problem.event() for problem in self.problems),
            Px4Event(_HEALTH_SUMMARY, Level.PROTOCOL, health),
        ]

    def _bits(self, *, is_health: bool, warnings: bool) -> int:
        return _union(
            1 << p.component
            for p in self.problems
            if p.is_health is is_health
            and (p.level is Level.WARNING if warnings else p.level <= Level.ERROR)
        )


def _union(masks: Iterable[int]) -> int:
    union = 0
    for mask in masks:
        union |= mask
    return union


class HealthReporter:
    """Timing of PX4's reports: changes at most every two seconds, and at once on request.

    SYS_STATUS shows the `published` report, None in the first seconds. `newest` is of
    `checked_at_s`.
    """

    _INTERVAL_S, _FIRST_S = 2.0, 2.1

    def __init__(self) -> None:
        self.published: HealthReport | None = None
        self.checked_at_s = -math.inf
        self.newest = HealthReport()
        self._reported = HealthReport()
        self._reported_at_s = self._FIRST_S - self._INTERVAL_S

    def update(
        self, report: HealthReport, now_s: float, *, on_request: bool = False
    ) -> list[Px4Event]:
        """Update the checks; returns the events that PX4 sends about them."""
        self.newest, self.checked_at_s = report, now_s
        is_due = report != self._reported and now_s >= self._reported_at_s + self._INTERVAL_S
        if not (is_due or on_request):
            return []
        self.published = report
        return self._report(now_s)

    def before_failsafe(self, now_s: float) -> list[Px4Event]:
        """Report pending changes at once, before a failsafe acts on them.

        PX4 does so by events alone: SYS_STATUS shows them with the next report.
        """
        return self._report(now_s) if self.newest != self._reported else []

    def _report(self, now_s: float) -> list[Px4Event]:
        self._reported, self._reported_at_s = self.newest, now_s
        return self.newest.events()
