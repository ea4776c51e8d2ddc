"""Reads logs of robots and grounds onto one common clock.

A robot's status is in its own log, and in the ground's if it was received. Common times combine the
robot's uptime, which never jumps, with the ground's reception times, so robots with wrong clocks
line up. Without a ground's log, the robots' own clocks are used.
"""

import bisect
import itertools
import json
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np

from edge.core import F64
from edge.core.changes import plain
from edge.core.counted import counted
from edge.core.fence import Fence
from edge.core.schema import explain
from edge.drivers.flight_log import FlightMetadata
from edge.drivers.log_reader import FlightLogError, LogGap, read, read_metadata
from edge.messages.codes import Reason, Refusal
from edge.messages.mission import FlightState, LoopStatus, Origin, RobotStatus
from lpac.analysis.field_truth import (
    AUTOPILOT_LOGS,
    TRUTH_TABLE,
    Measured,
    ToMission,
    read_places,
    track_of,
)
from lpac.analysis.snapshot import FleetSetup, GroundEvent
from lpac.analysis.truth import TRUTH, TrueTrack, load_truth

# Quantile of the transmission delays that estimates the least one.
_EARLY = 0.1
_LATENESS = ("lateness_p50_ms", "lateness_p99_ms", "lateness_max_ms")

Progress = Callable[[str, float], None]
Program = tuple[int, int]  # robot id, boot nonce

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class LoggedStatus:
    """Part of a status that reports need; `time_s` is Unix time of the common clock.

    Loops with unknown lateness are left out; an unknown landing point is NaN.
    """

    time_s: float
    boot_nonce: int
    state: FlightState
    reason: Reason
    trial: str
    armed: bool | None
    position_m: tuple[float, float, float] | None
    alarms: tuple[Reason, ...]
    loops: Mapping[str, LoopStatus]
    message_counts: Mapping[str, int]
    fence: Fence | None
    battery: float | None
    landing_point_m: tuple[float, float]
    bundle_id: str
    world_id: str


@dataclass(frozen=True, slots=True, eq=False)
class Received:
    """Messages received by one robot, in order: (M,) each.

    `time_s` is on the common clock. `age_s` is the greatest possible age by the fleet's clock, NaN
    if it was not known. If a message could not be decoded, `sequence` is -1. `accepted` is 1 where
    the message was used.
    """

    time_s: F64
    sender: F64
    sequence: F64
    age_s: F64
    accepted: F64


class LoopRates(NamedTuple):
    """Rates of perception, and of the policy and its messages."""

    perception_hz: float
    policy_hz: float


class Ordered(NamedTuple):
    """A robot's answer to an order."""

    time_s: float
    robot_id: int
    kind: str
    operator: str
    trial: str
    refusal: Refusal | None


@dataclass(slots=True)
class Logs:
    """Contents of all logs. `names`, `statuses` and `received` are by robot id.

    `clocks_known` are the programs with a ground's log; the clocks of others are unknown.
    `programs_logged` are those with a log of their own. `setups` are in the order of their Unix
    times, s. `truths` are vehicles' true tracks by robot id, one mapping per simulation. `notes`
    are for the reader.
    """

    names: dict[int, str] = field(default_factory=dict)
    statuses: dict[int, list[LoggedStatus]] = field(default_factory=dict)
    received: dict[int, Received] = field(default_factory=dict)
    clocks_known: set[Program] = field(default_factory=set)
    programs_logged: set[Program] = field(default_factory=set)
    metadata: list[FlightMetadata] = field(default_factory=list)
    setups: list[tuple[float, FleetSetup]] = field(default_factory=list)
    events: list[GroundEvent] = field(default_factory=list)
    orders: list[Ordered] = field(default_factory=list)
    truths: list[Mapping[int, TrueTrack]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def name(self, robot_id: int) -> str:
        """The robot's name, for people."""
        return self.names.get(robot_id, str(robot_id))


def read_logs(folders: Sequence[Path], progress: Progress = lambda *_: None) -> Logs:
    """Read all logs of robots and grounds below `folders`, and the vehicles' true positions.

    Raises ValueError if there are no logs, or a folder does not exist.
    """
    paths: list[Path] = []
    for folder in folders:
        if not folder.is_dir():
            raise ValueError(f"{folder}: is not a folder")
        for name in ("robot-*.mcap", "ground-*.mcap"):
            paths += sorted(path for path in folder.rglob(name) if path.is_file())
    if not paths:
        where = ", ".join(map(str, folders))
        raise ValueError(
            f"{where}: holds no logs (robot-*.mcap, ground-*.mcap): `lpac fleet pull` fetches them"
        )
    truths = [path for folder in folders for path in sorted(folder.rglob(TRUTH))]
    if not truths:  # a simulator's truth is better than any instrument
        for folder, name in itertools.product(folders, (TRUTH_TABLE, AUTOPILOT_LOGS)):
            truths += sorted(folder.rglob(name))
    return read_files([*paths, *truths], progress)


def simulated_name(robot_id: int) -> str:
    """A robot's name in `lpac sim`."""
    return f"r{robot_id}"


def read_files(paths: Sequence[Path], progress: Progress = lambda *_: None) -> Logs:
    """Read these logs of robots and grounds, and files with true positions."""
    reader = _LogReader()
    paths = list(dict.fromkeys(path.resolve() for path in paths))
    for index, path in enumerate(paths):
        progress(f"reading {path.name}", index / len(paths))
        reader.read(path)
    return reader.logs()


def logs_of(statuses: Iterable[RobotStatus]) -> Logs:
    """Make logs from statuses alone."""
    reader = _LogReader()
    for status in statuses:
        reader.take_status(status)
    return reader.logs()


class _LogReader:
    """Collects files, then puts them on one clock."""

    def __init__(self) -> None:
        self._logs = Logs()
        # program -> sequence -> status, by uptime; the ground's copies are identical
        self._statuses: dict[Program, dict[int, LoggedStatus]] = defaultdict(dict)
        # program -> time of its start by its own clock, from each status
        self._own_starts_s: dict[Program, list[float]] = defaultdict(list)
        # The last fence, as logged and as converted.
        self._fence: tuple[object, Fence | None] = None, None
        # program -> reception time at the ground minus uptime
        self._ground_starts_s: dict[Program, list[float]] = defaultdict(list)
        # program -> rows of `Received`, by the robot's clock
        self._received: dict[Program, list[tuple[float, int, int, float, bool]]] = defaultdict(list)
        self._orders: list[tuple[Program, Ordered]] = []  # by the robot's clock
        self._events: set[GroundEvent] = set()
        # Unix time -> origin reported by robots from then on
        self._origins: dict[float, Origin] = {}
        self._origin: Mapping[str, Any] | None = None  # the last one, as logged
        self._places: list[tuple[Path, Measured]] = []

    def take_status(self, status: RobotStatus) -> None:
        """Add a robot's status, as if from its log."""
        self._take_status((status.robot_id, status.boot_nonce), plain(status))

    def read(self, path: Path) -> None:
        """Add a file; notes describe the parts that are skipped."""
        notes = self._logs.notes
        if path.name == TRUTH or not path.match("*.mcap"):
            try:
                if path.name == TRUTH:
                    self._logs.truths.append(load_truth(path))
                else:
                    self._places.append((path, read_places(path)))
            except ValueError as error:
                notes.append(f"{error}: skipped")
            return
        # topic -> reason for each skipped message
        skipped: dict[str, list[str]] = defaultdict(list)
        begun = False
        try:
            if path.name.startswith("ground-"):
                take, topics = self._take_from_ground, ("setup", "status", "event")
            else:
                take = partial(self._take_from_robot, self._begin_robot(path))
                topics = ("status", "received", "order")
            gaps: list[LogGap] = []
            for topic, time_s, message in read(path, *topics, on_gap=gaps.append):
                begun = True
                try:
                    take(topic, time_s, message)
                except KeyError as error:
                    skipped[topic].append(f"{error} is missing")
                except (AttributeError, OverflowError, TypeError, ValueError) as error:
                    skipped[topic].append(str(error))
            notes += map(str, gaps)
            if not begun and not gaps:
                notes.append(f"{path}: is empty")
        except FlightLogError as error:
            notes.append(f"{error}: skipped")
        except ValueError as error:  # a message that is not JSON
            notes.append(f"{path}: {error}: the rest is skipped")
        notes += [
            f"{path}: {why[0]}: {counted(len(why), 'message')} of topic {topic} skipped"
            for topic, why in skipped.items()
        ]

    def _begin_robot(self, path: Path) -> Program:
        metadata = read_metadata(path)
        program = (metadata.robot_id, metadata.boot_nonce)
        self._logs.metadata.append(metadata)
        self._logs.programs_logged.add(program)
        if path.parent.name == "logs":
            # `lpac fleet pull` names folders by the robots' names, simulators by their ids.
            folder = path.parts[-3]
            name = simulated_name(int(folder)) if folder.isdecimal() else folder
            self._logs.names.setdefault(metadata.robot_id, name)
        return program

    def _take_from_robot(
        self, program: Program, topic: str, time_s: float, message: Mapping[str, Any]
    ) -> None:
        if topic == "status":
            self._take_status(program, message)
        elif topic == "received":
            age_s, sequence = message["age_s"], message["sequence"]
            self._received[program].append(
                (
                    time_s,
                    int(message["sender"]),
                    -1 if sequence is None else int(sequence),
                    math.nan if age_s is None else float(age_s),
                    message["rejection"] is None,
                )
            )
        else:
            refusal = message["answer"]["refusal"]
            kind, operator, trial = (str(message[key]) for key in ("kind", "operator", "trial"))
            order = Ordered(
                time_s, program[0], kind, operator, trial,
                refusal and _convert(Refusal, refusal, "refusal"),
            )  # fmt: skip
            self._orders.append((program, order))

    def _take_from_ground(self, topic: str, time_s: float, message: Mapping[str, Any]) -> None:
        if topic == "setup":
            self._logs.setups.append((time_s, _convert(FleetSetup, message, "setup")))
        elif topic == "event":
            self._events.add(_convert(GroundEvent, message, "event"))
        else:
            program = (int(message["robot_id"]), int(message["boot_nonce"]))
            name = str(message["name"])
            heard_s = _time_s(message, "heard_at_unix_s") - _time_s(message, "uptime_s")
            self._take_status(program, message)
            self._logs.names[program[0]] = name
            self._ground_starts_s[program].append(heard_s)

    def _take_status(self, program: Program, status: Mapping[str, Any]) -> None:
        sequence = int(status["sequence"])
        if program in self._statuses and sequence in self._statuses[program]:
            return
        unix_s = _time_s(status, "unix_time_s")
        own_start_s = unix_s - _time_s(status, "uptime_s")
        self._statuses[program][sequence] = self._logged_status(status)
        self._own_starts_s[program].append(own_start_s)
        if status.get("origin") not in (None, self._origin):
            self._origin = status["origin"]
            self._origins[unix_s] = _convert(Origin, self._origin, "origin")

    def _logged_status(self, status: Mapping[str, Any]) -> LoggedStatus:
        position_m, fence = [*map(float, status["position_m"] or ())], status.get("fence")
        logged = _convert(
            LoggedStatus,
            {
                **status,
                "time_s": _time_s(status, "uptime_s"),
                "position_m": position_m if position_m and math.isfinite(sum(position_m)) else None,
                "landing_point_m": [*map(float, status["landing_point_m"])],
                "loops": {
                    name: loop
                    for name, loop in status["loops"].items()
                    if None not in [_finite(loop[key]) for key in _LATENESS]
                },
                "fence": None,
                "battery": _finite(status["battery"]),
            },
            "status",
        )
        # Convert once: there are very many statuses, nearly all with the same fence.
        if fence != self._fence[0]:
            self._fence = fence, None if fence is None else _convert(Fence, fence, "fence")
        return replace(logged, fence=self._fence[1])

    def logs(self) -> Logs:
        logs = self._logs
        # program -> its start on the common clock, and the lead of its own clock
        starts_s: dict[Program, float] = {}
        ahead_s: dict[Program, float] = {}
        for program, statuses in self._statuses.items():
            starts_s[program] = own_s = float(np.median(self._own_starts_s[program]))
            if program in self._ground_starts_s:
                starts_s[program] = float(np.quantile(self._ground_starts_s[program], _EARLY))
                logs.clocks_known.add(program)
            ahead_s[program] = own_s - starts_s[program]
            logs.statuses.setdefault(program[0], []).extend(
                replace(s, time_s=starts_s[program] + s.time_s) for s in statuses.values()
            )
        for robot_statuses in logs.statuses.values():
            robot_statuses.sort(key=lambda status: status.time_s)
        self._sort_received(ahead_s)
        orders = (
            order._replace(time_s=order.time_s - ahead_s.get(program, 0.0))
            for program, order in self._orders
        )
        logs.orders = sorted(orders, key=lambda order: order.time_s)
        logs.events = sorted(self._events, key=lambda event: event.unix_time_s)
        logs.setups.sort(key=lambda setup: setup[0])
        for _, setup in logs.setups:
            logs.names.update({robot_id: name for name, robot_id in setup.robots.items()})
        if self._places:
            self._take_places()
        return logs

    def _take_places(self) -> None:
        """Add true tracks of robots whose folders contain measurements."""
        robots = {self._logs.name(robot_id): robot_id for robot_id in self._logs.statuses}
        # Simulators name folders by the robots' ids.
        folders = {str(robot_id): robot_id for robot_id in self._logs.statuses} | robots
        measured: dict[int, list[Measured]] = {robot_id: [] for robot_id in robots.values()}
        unfixed: dict[str, None] = {}
        for path, places in self._places:
            of = next((folder.name for folder in path.parents if folder.name in folders), None)
            if of is None:
                why = f"is not in the folder of a robot ({', '.join(robots)})"
                self._logs.notes.append(f"{path}: {why}: skipped")
            elif not len(places.unix_s):
                unfixed[of] = None
            elif places.is_global and not self._origins:
                self._logs.notes.append(f"{path}: no robot's log has the mission's origin: skipped")
            else:
                measured[folders[of]].append(places)
        if unfixed and any(measured.values()):
            self._logs.notes.append(
                f"no RTK fix in the PX4 log of {', '.join(unfixed)}: true positions are incomplete"
            )
        if any(measured.values()):
            to_mission = self._to_mission()
            self._logs.truths.append(
                {robot_id: track_of(files, to_mission) for robot_id, files in measured.items()}
            )

    def _to_mission(self) -> ToMission:
        times_s = sorted(self._origins)
        frames = [self._origins[time_s].frame() for time_s in times_s]

        def to_mission(
            latitude_deg: float, longitude_deg: float, unix_s: float
        ) -> tuple[float, float]:
            frame = frames[max(0, bisect.bisect_right(times_s, unix_s) - 1)]
            x_m, y_m, _ = frame.relative_to(latitude_deg, longitude_deg).local_origin_m.tolist()
            return x_m, y_m

        return to_mission

    def _sort_received(self, ahead_s: Mapping[Program, float]) -> None:
        columns: dict[int, list[tuple[float, ...]]] = defaultdict(list)
        for program, messages in self._received.items():
            own_s = ahead_s.get(program, 0.0)
            columns[program[0]] += [(at_s - own_s, *rest) for at_s, *rest in messages]
        for robot_id, rows in columns.items():
            ordered = np.array(sorted(rows), np.float64).T
            self._logs.received[robot_id] = Received(*ordered)


def configured(metadata: FlightMetadata, part: str) -> Mapping[str, Any]:
    """A part of the robot's configuration; empty if it cannot be read."""
    try:
        found = json.loads(metadata.configuration)[part]
    except (ValueError, KeyError, TypeError):
        return {}
    return found if isinstance(found, dict) else {}


def _convert(cls: type[T], value: object, where: str) -> T:
    """Like `from_mapping`, but ignores unknown keys, which other versions may write."""
    try:
        return msgspec.convert(value, cls)
    except msgspec.ValidationError as error:
        raise ValueError(explain(error, cls, value, where)) from None


def _finite(value: Any) -> float | None:
    number = math.nan if value is None else float(value)
    return number if math.isfinite(number) else None


def _time_s(message: Mapping[str, Any], key: str) -> float:
    value = _finite(message[key])
    if value is None:
        raise ValueError(f"{key} = {message[key]}")
    return value
