"""Alarms for the operator, from the ground's snapshots. Pure."""

import math
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from enum import StrEnum
from typing import Literal, NamedTuple

from edge.core.arrivals import Arrivals
from edge.core.counted import counted
from edge.flight.preflight import PreflightLimits
from edge.messages.codes import CheckCode, ReasonCode, texts
from edge.messages.mission import AIRBORNE, FlightState, RobotStatus
from lpac.analysis.commonest import commonest
from lpac.analysis.snapshot import COMMANDER_SILENT_S, FleetSetup, FleetSnapshot, RobotSnapshot
from lpac.radio.pairs import LATE_S, Blame, Link, blame

Severity = Literal["critical", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("critical", "warning", "note")

# Age of the earlier snapshot.
_HISTORY_S = 2.0

_S, _C, _R = FlightState, CheckCode, ReasonCode
# Codes for the ground's fence, world or origin that a robot does not adopt.
FENCE_NOT_TAKEN = (_C.KEEPS_FENCE, _C.FENCE_OR_PLACE_UNFIT, _C.FENCE_OUT_OF_REACH)
_WORLD_NOT_TAKEN = (_C.KEEPS_WORLD, _C.WORLD_NOT_ARRIVED, _C.WORLD_UNUSABLE)
_ORIGIN_NOT_TAKEN = (_C.KEEPS_ORIGIN, _C.ORIGIN_OUT_OF_REACH)
_BATTERY_REASONS = (_R.BATTERY_CRITICAL, _R.BATTERY_LOW, _R.BATTERY_NOT_KNOWN)
# States in which a robot uses the others' messages.
_USES_OTHERS = (_S.HOLD, _S.MISSION, _S.RETURN)
# The defaults: a robot's own configuration may differ.
LIMITS = PreflightLimits()
# Above the share at which a robot returns on its own, so that the operator can still decide.
BATTERY_LOW = 0.3
# Time for a robot to receive a state and report it.
_OBEYED_WITHIN_S = 1.0
FEATURE_AGE_S = 1.0
LATE_MS = 50.0
# Half the rate at which robots send.
_MIN_RATE_HZ = 1.25
# Share of messages younger than 0.8 s with which the field's policy still flies nearly as well,
# judged from at least ten messages.
_MIN_IN_TIME, _MIN_SENT = 0.7, 10
# Of the wall clock, which stamps the robot's logs.
_CLOCK_WITHIN_S = 1.0
# Characters shown of an id.
ID = 8
_NAMES = 4


class AlarmCode(StrEnum):
    """Subject of an alarm: the fleet, or from `SILENT` on one robot."""

    NOBODY_COMMANDS = "nobody_commands"
    COMMANDER_SILENT = "commander_silent"
    HELD_BY_OTHERS = "held_by_others"
    NAME_SHARED = "name_shared"
    MEMBERS_DIFFER = "members_differ"
    INSECURE = "insecure"
    WORLD_NOT_HERE = "world_not_here"
    NOT_HEARD_YET = "not_heard_yet"
    SILENT = "silent"
    DUPLICATE_ID = "duplicate_id"
    OWN = "own"
    NOT_OBEYED = "not_obeyed"
    BATTERY = "battery"
    OTHER_RELEASE = "other_release"
    OTHER_BUNDLE = "other_bundle"
    OTHER_WORLD = "other_world"
    OTHER_ORIGIN = "other_origin"
    OTHER_FENCE = "other_fence"
    NOT_TAKEN = "not_taken"
    GPS = "gps"
    FEATURES = "features"
    NEIGHBOURS = "neighbours"
    LOOPS = "loops"
    CLOCK = "clock"
    NOT_READY = "not_ready"


class Alarm(NamedTuple):
    """`critical`: act now; `warning`: look into it; `note`: good to know.

    `robot` is a name, "" for the fleet. `AlarmCode.OWN` marks an alarm that the robot reports.
    """

    severity: Severity
    robot: str
    code: AlarmCode
    text: str


def alarms(
    setup: FleetSetup, snapshot: FleetSnapshot, before: FleetSnapshot | None = None
) -> tuple[Alarm, ...]:
    """Alarms of a snapshot, the gravest first, at most one per robot and code.

    `before` is from `SnapshotHistory`; alarms that compare two snapshots (the ground's state is not
    obeyed, loops miss ticks) need it.
    """
    fleet = _Fleet(setup, snapshot, before)
    found = [Alarm(severity, "", code, text) for severity, code, text in _fleet_alarms(fleet)]
    found += [
        Alarm(alarm[0], seen.name, code, alarm[1])
        for code, check in _CHECKS.items()
        for seen in fleet.seen
        if (code in _ALSO_IF_SILENT or seen.robot.fresh)
        and (alarm := check(fleet, seen)) is not None
    ]
    return tuple(sorted(found, key=lambda alarm: SEVERITIES.index(alarm.severity)))


class SnapshotHistory:
    """Snapshots of the last 2 s."""

    def __init__(self) -> None:
        self._snapshots: deque[tuple[float, FleetSnapshot]] = deque()

    def add(self, snapshot: FleetSnapshot, now_s: float) -> FleetSnapshot | None:
        """Add a snapshot; return the one 2 s or slightly more before it, or None."""
        self._snapshots.append((now_s, snapshot))
        while len(self._snapshots) > 1 and now_s - self._snapshots[1][0] >= _HISTORY_S:
            self._snapshots.popleft()
        at_s, before = self._snapshots[0]
        return before if now_s - at_s >= _HISTORY_S else None


def is_flying(status: RobotStatus) -> bool:
    """Whether the robot is in the air or about to be, by its status."""
    handed_over = status.state is _S.PILOT and status.armed is True
    return status.state in AIRBORNE or status.in_air is True or handed_over


_Found = tuple[Severity, str] | None


class _Seen(NamedTuple):
    """A robot that was heard at some time; `before` is its status in the earlier snapshot."""

    robot: RobotSnapshot
    status: RobotStatus
    before: RobotStatus | None

    @property
    def name(self) -> str:
        return self.robot.name


class _Fleet:
    """A snapshot, and what is derived from it as a whole. `fresh` are robots that are heard now."""

    def __init__(
        self, setup: FleetSetup, snapshot: FleetSnapshot, before: FleetSnapshot | None
    ) -> None:
        self.setup = setup
        self.snapshot = snapshot
        self.ground = snapshot.state
        self.ground_before = None if before is None else before.ground
        statuses = {} if before is None else {r.name: r.status for r in before.robots}
        self.seen = [
            _Seen(robot, robot.status, statuses.get(robot.name))
            for robot in snapshot.robots
            if robot.status is not None
        ]
        self.fresh = [seen for seen in self.seen if seen.robot.fresh]
        present_world = commonest(s.status.world_id for s in self.fresh)
        self.world = self.ground.world_id or present_world or setup.world_id
        self.origin = self.ground.origin or commonest(s.status.origin for s in self.fresh)
        self.fence = self.ground.fence or setup.fence
        self.blame = blame(self._links())

    def _links(self) -> dict[Link, bool]:
        """(sender, receiver) -> whether the link is good, of all pairs that fly within range."""
        flying = [seen for seen in self.fresh if seen.status.state in _USES_OTHERS]
        return {
            (sender.name, receiver.name): _is_good(
                receiver.robot, receiver.status, sender.robot.robot_id
            )
            for receiver in flying
            for sender in flying
            if sender is not receiver and self._in_range(receiver.status, sender.status)
        }

    def _in_range(self, a: RobotStatus, b: RobotStatus) -> bool:
        if a.position_m is None or b.position_m is None:
            return False
        range_m = self.setup.communication_range / self.setup.env_scale
        return math.dist(a.position_m[:2], b.position_m[:2]) <= range_m


def _is_good(robot: RobotSnapshot, status: RobotStatus, sender: int) -> bool:
    """Whether the robot gets enough of the sender's messages before they are 0.8 s old."""
    key = str(sender)
    if key not in status.neighbour_ages_s:
        return False
    if robot.rates_hz.get(key, math.inf) < _MIN_RATE_HZ:
        return False
    arrivals = Arrivals.of_counts(robot.arrivals.get(key, ()))
    in_time = arrivals.arrived - arrivals.older_than(LATE_S)
    return arrivals.sent < _MIN_SENT or in_time >= _MIN_IN_TIME * arrivals.sent


def _fleet_alarms(fleet: _Fleet) -> Iterator[tuple[Severity, AlarmCode, str]]:
    ground = fleet.ground
    flying = sum(is_flying(seen.status) for seen in fleet.seen)
    silent = fleet.snapshot.commander_age_s > COMMANDER_SILENT_S
    if flying and not fleet.snapshot.commander:
        verb = "flies" if flying == 1 else "fly"
        text = f"nobody commands the fleet while {counted(flying, 'robot')} {verb}: hold or land"
        yield "critical", AlarmCode.NOBODY_COMMANDS, text
    if fleet.snapshot.commander and silent:
        text = f"the commander {fleet.snapshot.commander} is not heard: hold takes command"
        yield ("critical" if flying else "warning"), AlarmCode.COMMANDER_SILENT, text
    if fleet.setup.insecure:
        text = "insecure: anyone on the network can fly this fleet"
        yield "warning", AlarmCode.INSECURE, text
    if fleet.snapshot.shares_name:
        text = f"another ground station uses the name {fleet.setup.operator}: both may command"
        yield "critical", AlarmCode.NAME_SHARED, text
    if fleet.snapshot.members_problem:
        yield "warning", AlarmCode.MEMBERS_DIFFER, fleet.snapshot.members_problem
    if ground.safety_action_by not in ("", ground.operator):
        held = [n for n, i in fleet.setup.robots.items() if ground.safety_action_for(i) == "hold"]
        text = f"{ground.safety_action_by} commands {counted(len(held), 'robot')} to hold"
        yield "warning", AlarmCode.HELD_BY_OTHERS, text
    if not fleet.snapshot.commander and not flying:
        yield "note", AlarmCode.NOBODY_COMMANDS, "nobody commands the fleet yet"
    if not fleet.setup.world:
        text = f"this station lacks the robots' world {fleet.setup.world_id[:ID]}: no density, no "
        yield "warning", AlarmCode.WORLD_NOT_HERE, f"{text}cost; `lpac mission world FILE`"
    if fleet.seen:
        slots = {site.robot for site in fleet.setup.slots}
        unheard = [r.name for r in fleet.snapshot.robots if r.status is None and r.name in slots]
        if unheard:
            yield "note", AlarmCode.NOT_HEARD_YET, f"not heard yet: {' '.join(unheard)}"
    else:
        yield "note", AlarmCode.NOT_HEARD_YET, "no robot is heard yet"


def _silent(fleet: _Fleet, seen: _Seen) -> _Found:
    if seen.robot.fresh:
        return None
    if is_flying(seen.status):
        return "critical", f"no longer heard, last in the air in {seen.status.state}"
    return "warning", f"no longer heard, last in {seen.status.state}"


def _duplicate(fleet: _Fleet, seen: _Seen) -> _Found:
    if not seen.robot.duplicate:
        return None
    return "critical", "two programs have this robot's id: end one, or revoke its key"


def _release(fleet: _Fleet, seen: _Seen) -> _Found:
    release = seen.robot.other_release
    if not release:
        return None
    text = f"flies another release ({release}) than this ground station: deploy one to all"
    return "critical" if is_flying(seen.status) else "warning", text


def _own(fleet: _Fleet, seen: _Seen) -> _Found:
    status = seen.status
    if not status.alarms:
        return None
    # A pilot with a working remote control can handle it.
    has_pilot = status.state is _S.PILOT and status.remote_control is not False
    grave = is_flying(status) and not has_pilot
    return ("critical" if grave else "warning"), texts(status.alarms)


def _not_obeyed(fleet: _Fleet, seen: _Seen) -> _Found:
    """Robot that has had time to obey the ground's earlier state but has not."""
    before, status = fleet.ground_before, seen.status
    if before is None or fleet.snapshot.ground is None:
        return None
    if seen.robot.age_s is None or seen.robot.age_s > _HISTORY_S - _OBEYED_WITHIN_S:
        return None
    severity: Severity = "critical" if is_flying(status) else "warning"
    if status.obeyed_sequence < before.sequence:
        return severity, "does not obey the ground's state"
    if status.operator not in ("", before.operator, fleet.ground.operator):
        return severity, f"obeys {status.operator}, not {fleet.ground.operator}"
    # An observer's hold or another station would be received here by the second snapshot.
    known, obeyed = fleet.ground.sequence, status.obeyed_sequence
    if seen.before is not None and min(obeyed, seen.before.obeyed_sequence) > known:
        return severity, f"obeys sequence {obeyed}, but the ground is at {known}"
    return None


def _battery(fleet: _Fleet, seen: _Seen) -> _Found:
    battery = seen.status.battery
    reported = any(alarm.code in _BATTERY_REASONS for alarm in seen.status.alarms)
    if reported or battery is None or battery > BATTERY_LOW:
        return None
    if not is_flying(seen.status):
        return "note", f"battery low: {battery:.0%}"
    if battery <= fleet.setup.battery_critical:
        return "critical", f"battery critical: {battery:.0%}"
    return "warning", f"battery low: {battery:.0%}"


def _bundle(fleet: _Fleet, seen: _Seen) -> _Found:
    theirs, ours = seen.status.bundle_id, fleet.setup.bundle_id
    if theirs == ours:
        return None
    return "warning", f"bundle {theirs[:ID] or 'none'}, not the fleet's {ours[:ID]}"


def _world(fleet: _Fleet, seen: _Seen) -> _Found:
    theirs, ours = seen.status.world_id, fleet.world
    if theirs == ours or _reports(seen, _WORLD_NOT_TAKEN):
        return None
    return "warning", f"world {theirs[:ID] or 'none'}, not the fleet's {ours[:ID]}"


def _origin(fleet: _Fleet, seen: _Seen) -> _Found:
    if seen.status.origin in (None, fleet.origin) or _reports(seen, _ORIGIN_NOT_TAKEN):
        return None
    return "warning", "its origin is not the fleet's"


def _fence(fleet: _Fleet, seen: _Seen) -> _Found:
    if seen.status.fence in (None, fleet.fence) or _reports(seen, FENCE_NOT_TAKEN):
        return None
    return "warning", "its fence is not the fleet's"


def _reports(seen: _Seen, codes: Collection[CheckCode]) -> bool:
    """Whether the robot itself reports why it has another one than the fleet."""
    return any(each.code in codes for each in seen.status.not_taken)


def _not_taken(fleet: _Fleet, seen: _Seen) -> _Found:
    return ("warning", texts(seen.status.not_taken)) if seen.status.not_taken else None


def _gps(fleet: _Fleet, seen: _Seen) -> _Found:
    """GPS in the air; on the ground the robot's own checks report it."""
    satellites, hdop = seen.status.satellites, seen.status.hdop
    if not is_flying(seen.status):
        return None
    if satellites is not None and satellites < LIMITS.min_satellites:
        return "warning", f"GPS sees {counted(satellites, 'satellite')}"
    if hdop is not None and not hdop <= LIMITS.max_hdop:
        return "warning", f"GPS precision (HDOP) is {hdop:.1f}"
    return None


def _features(fleet: _Fleet, seen: _Seen) -> _Found:
    if seen.status.state not in (_S.HOLD, _S.MISSION):
        return None
    age_s = seen.status.feature_age_s
    if age_s is None:
        return _graver_in_mission(seen), "has no features for its policy"
    if age_s > FEATURE_AGE_S:
        return _graver_in_mission(seen), f"features are {age_s:.1f} s old"
    return None


def _neighbours(fleet: _Fleet, seen: _Seen) -> _Found:
    """Poor links within range. A robot that explains all of its poor links is blamed alone."""
    found: Blame = fleet.blame
    poor = [sender for sender, receiver in found.links if receiver == seen.name]
    # Beyond four names the same text for all robots, which views can group.
    senders = " ".join(poor) if len(poor) <= _NAMES else f"more than {_NAMES} robots in range"
    faults = {
        "receives no robot in range well": seen.name in found.receivers,
        "no robot in range receives it well": seen.name in found.senders,
        f"receives badly from {senders}": bool(poor),
    }
    text = "; ".join(text for text, holds in faults.items() if holds)
    return (_graver_in_mission(seen), text) if text else None


def _loops(fleet: _Fleet, seen: _Seen) -> _Found:
    severity: Severity = "warning" if is_flying(seen.status) else "note"
    for name, loop in seen.status.loops.items():
        last = None if seen.before is None else seen.before.loops.get(name)
        if last is not None and loop.failures > last.failures:
            return severity, f"its {name} loop fails"
        if last is not None and loop.overruns > last.overruns:
            return severity, f"its {name} loop misses ticks"
        if loop.lateness_p99_ms > LATE_MS:
            return severity, f"its {name} loop is late by {loop.lateness_p99_ms:.0f} ms"
    return None


def _clock(fleet: _Fleet, seen: _Seen) -> _Found:
    offset_s = seen.robot.clock_offset_s
    if offset_s is None or abs(offset_s) <= _CLOCK_WITHIN_S:
        return None
    return "warning", f"its clock is {abs(offset_s):.0f} s {'ahead' if offset_s > 0 else 'behind'}"


def _not_ready(fleet: _Fleet, seen: _Seen) -> _Found:
    status = seen.status
    waits = status.state in (_S.INIT, _S.IDLE, _S.PREFLIGHT) and not status.ready
    if not waits or not fleet.ground.enabled_for(seen.robot.robot_id) or not status.failed_checks:
        return None
    more = len(status.failed_checks) - 1
    return "note", f"not ready: {status.failed_checks[0].text}{f' (+ {more})' if more else ''}"


def _graver_in_mission(seen: _Seen) -> Severity:
    return "warning" if seen.status.state is _S.MISSION else "note"


# In order of gravity within one severity.
_CHECKS: Mapping[AlarmCode, Callable[[_Fleet, _Seen], _Found]] = {
    AlarmCode.SILENT: _silent,
    AlarmCode.DUPLICATE_ID: _duplicate,
    AlarmCode.OWN: _own,
    AlarmCode.NOT_OBEYED: _not_obeyed,
    AlarmCode.BATTERY: _battery,
    AlarmCode.OTHER_RELEASE: _release,
    AlarmCode.OTHER_BUNDLE: _bundle,
    AlarmCode.OTHER_WORLD: _world,
    AlarmCode.OTHER_ORIGIN: _origin,
    AlarmCode.OTHER_FENCE: _fence,
    AlarmCode.NOT_TAKEN: _not_taken,
    AlarmCode.GPS: _gps,
    AlarmCode.FEATURES: _features,
    AlarmCode.NEIGHBOURS: _neighbours,
    AlarmCode.LOOPS: _loops,
    AlarmCode.CLOCK: _clock,
    AlarmCode.NOT_READY: _not_ready,
}
# The other checks would report old statuses.
_ALSO_IF_SILENT = (AlarmCode.SILENT, AlarmCode.DUPLICATE_ID)
