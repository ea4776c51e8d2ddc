"""What robots and ground recorded, brought together on one clock.

A robot says each status once; its own log has it, and the ground's too if it was heard. Times are
made from the robot's uptime, which does not jump, and from when the ground heard it: so robots
whose clocks were wrong line up. Without a ground's log their own clocks must do.
"""

import json
import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from edge.adapters.flight_log import FlightLogError, FlightMetadata, read, read_metadata
from edge.core import F64
from edge.core.mission import FlightState, LoopStatus
from edge.core.safety import Fence
from edge.core.schema import ConfigError, from_mapping
from ground.protocol import Event, Setup

# Of the times from saying to hearing, the share that may be shorter than the one that is believed.
_EARLY = 0.1

Progress = Callable[[str, float], None]
Program = tuple[int, int]  # robot id, boot nonce


@dataclass(frozen=True, slots=True)
class Said:
    """What the report needs of a status; `time_s` is Unix time of the common clock."""

    time_s: float
    boot_nonce: int
    state: FlightState
    trial: str
    armed: bool | None
    position_m: tuple[float, float, float] | None
    alarms: tuple[str, ...]
    loops: Mapping[str, LoopStatus]
    fence: Fence | None
    battery: float | None
    landing_point_m: tuple[float, float]
    world_id: str


@dataclass(frozen=True, slots=True, eq=False)
class Received:
    """The messages that one robot got, in order: (M,) each.

    `time_s` is on the common clock, and `age_s` corrected by it. `sequence` is -1, and `age_s` NaN,
    where the message could not be read; `accepted` where it was used.
    """

    time_s: F64
    sender: F64
    sequence: F64
    age_s: F64
    accepted: F64


class Ordered(NamedTuple):
    """An order that a robot answered."""

    time_s: float
    robot_id: int
    kind: str
    operator: str
    trial: str
    accepted: bool
    reason: str


@dataclass(slots=True)
class Logs:
    """All that was found. `names` are the robots' by id, `statuses` and `received` by robot id.

    `clocks_known` are the programs that a ground heard; of the others' clocks nothing is known.
    `programs_logged` are those whose own logs were found. `notes` are for the reader.
    """

    names: dict[int, str] = field(default_factory=dict)
    statuses: dict[int, list[Said]] = field(default_factory=dict)
    received: dict[int, Received] = field(default_factory=dict)
    clocks_known: set[Program] = field(default_factory=set)
    programs_logged: set[Program] = field(default_factory=set)
    metadata: list[FlightMetadata] = field(default_factory=list)
    setups: list[Setup] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    orders: list[Ordered] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def name(self, robot_id: int) -> str:
        """What people call the robot."""
        return self.names.get(robot_id, str(robot_id))


def read_logs(folders: Sequence[Path], progress: Progress) -> Logs:
    """Read all robots' and grounds' logs below `folders`.

    Raises ValueError if there are none, or a folder is not there.
    """
    paths: list[Path] = []
    for folder in folders:
        if not folder.is_dir():
            raise ValueError(f"{folder}: is not a folder")
        paths += sorted(folder.rglob("robot-*.mcap")) + sorted(folder.rglob("ground-*.mcap"))
    if not paths:
        where = ", ".join(map(str, folders))
        raise ValueError(
            f"{where}: holds no logs (robot-*.mcap, ground-*.mcap): `lpac fleet pull` fetches them"
        )
    reader = _Reader()
    paths = list(dict.fromkeys(path.resolve() for path in paths))
    for index, path in enumerate(paths):
        progress(f"reading {path.name}", index / len(paths))
        if path.name.startswith("ground-"):
            reader.read_ground(path)
        else:
            reader.read_robot(path)
    return reader.logs()


class _Reader:
    """Collects files, and then puts them on one clock."""

    def __init__(self) -> None:
        self._logs = Logs()
        # program -> sequence -> status, in uptime; the robots' own are the same.
        self._statuses: dict[Program, dict[int, Said]] = defaultdict(dict)
        # program -> what its clock said when it had begun, by each status
        self._own_starts_s: dict[Program, list[float]] = defaultdict(list)
        self._fences: dict[str, Fence] = {}
        # program -> when the ground heard it, less its uptime
        self._heard: dict[Program, list[float]] = defaultdict(list)
        # program -> (robot's clock, message)
        self._received: dict[Program, list[tuple[float, dict[str, Any]]]] = defaultdict(list)
        self._orders: list[tuple[Program, float, dict[str, Any]]] = []
        self._events: set[Event] = set()

    def read_robot(self, path: Path) -> None:
        try:
            metadata = read_metadata(path)
        except FlightLogError as error:
            self._logs.notes.append(f"{error}: left out")
            return
        logs = self._logs
        program = (metadata.robot_id, metadata.boot_nonce)
        logs.metadata.append(metadata)
        logs.programs_logged.add(program)
        if path.parent.name == "logs" and not path.parts[-3].isdigit():
            # As `lpac fleet pull` calls the robots' folders.
            logs.names.setdefault(metadata.robot_id, path.parts[-3])
        for topic, time_s, message in read(path, "status", "received", "order"):
            if topic == "status":
                self._take_status(path, program, message)
            elif topic == "received":
                self._received[program].append((time_s, message))
            else:
                self._orders.append((program, time_s, message))

    def read_ground(self, path: Path) -> None:
        try:
            begun = self._read_ground(path)
        except FlightLogError as error:
            self._logs.notes.append(f"{error}: left out")
            return
        if not begun:
            self._logs.notes.append(f"{path}: holds nothing")

    def _read_ground(self, path: Path) -> bool:
        begun = False
        for topic, _, message in read(path, "setup", "status", "event"):
            begun = True
            if topic == "status":
                program = (message["robot_id"], message["boot_nonce"])
                self._logs.names[message["robot_id"]] = message["name"]
                self._heard[program].append(message["heard_at_unix_s"] - message["uptime_s"])
                self._take_status(path, program, message)
                continue
            try:
                if topic == "setup":
                    self._logs.setups.append(from_mapping(Setup, message, str(path)))
                else:
                    self._events.add(from_mapping(Event, message, str(path)))
            except ConfigError as error:
                self._logs.notes.append(f"{error}: left out")
        return begun

    def _take_status(self, path: Path, program: Program, status: Mapping[str, Any]) -> None:
        statuses = self._statuses[program]
        if status["sequence"] not in statuses:
            statuses[status["sequence"]] = self._said(path, status)
            self._own_starts_s[program].append(status["unix_time_s"] - status["uptime_s"])

    def _said(self, path: Path, status: Mapping[str, Any]) -> Said:
        position = status["position_m"]
        known = position is not None and all(math.isfinite(float(value)) for value in position)
        fence = status.get("fence")
        if fence is not None:
            # They are all the same, and there are very many.
            text = json.dumps(fence)
            if text not in self._fences:
                self._fences[text] = from_mapping(Fence, fence, f"{path}: fence")
            fence = self._fences[text]
        x_m, y_m = status["landing_point_m"]
        return Said(
            time_s=status["uptime_s"],
            boot_nonce=status["boot_nonce"],
            state=FlightState(status["state"]),
            trial=status["trial"],
            armed=status["armed"],
            position_m=tuple(position) if known else None,
            alarms=tuple(status["alarms"]),
            loops={
                name: from_mapping(LoopStatus, loop, f"{path}: {name}")
                for name, loop in status["loops"].items()
            },
            fence=fence,
            battery=status["battery"],
            landing_point_m=(x_m, y_m),
            world_id=status["world_id"],
        )

    def logs(self) -> Logs:
        logs = self._logs
        # By program: what turns its uptime into the common clock, and how far ahead its own is.
        starts_s: dict[Program, float] = {}
        ahead_s: dict[Program, float] = {}
        for program, statuses in self._statuses.items():
            starts_s[program] = own_s = float(np.median(self._own_starts_s[program]))
            if program in self._heard:
                starts_s[program] = float(np.quantile(self._heard[program], _EARLY))
                logs.clocks_known.add(program)
            ahead_s[program] = own_s - starts_s[program]
            logs.statuses.setdefault(program[0], []).extend(
                replace(said, time_s=starts_s[program] + said.time_s) for said in statuses.values()
            )
        for robot_statuses in logs.statuses.values():
            robot_statuses.sort(key=lambda said: said.time_s)
        self._sort_received(starts_s, ahead_s)
        logs.orders = sorted(
            Ordered(
                at_s - ahead_s.get(program, 0.0), program[0], message["kind"], message["operator"],
                message["trial"], message["answer"]["accepted"], message["answer"]["reason"],
            )
            for program, at_s, message in self._orders
        )  # fmt: skip
        logs.events = sorted(self._events, key=lambda event: event.unix_time_s)
        for setup in logs.setups:
            logs.names.update({robot_id: name for name, robot_id in setup.robots.items()})
        return logs

    def _sort_received(
        self, starts_s: Mapping[Program, float], ahead_s: Mapping[Program, float]
    ) -> None:
        # A message names its sender, not the start of its program: the one that ran then sent it.
        began: dict[int, list[tuple[float, float]]] = defaultdict(list)
        for program, start_s in sorted(starts_s.items(), key=lambda item: item[1]):
            began[program[0]].append((start_s, ahead_s[program]))
        columns: dict[int, list[tuple[float, ...]]] = defaultdict(list)
        for program, messages in self._received.items():
            own_s = ahead_s.get(program, 0.0)
            for at_s, message in messages:
                time_s, age_s, sender = at_s - own_s, math.nan, message["sender"]
                if message["age_s"] is not None:
                    senders = [a for start_s, a in began[sender] if start_s <= time_s]
                    age_s = float(message["age_s"]) - own_s + (senders[-1] if senders else 0.0)
                sequence = -1 if message["sequence"] is None else message["sequence"]
                columns[program[0]].append(
                    (time_s, sender, sequence, age_s, message["rejection"] is None)
                )
        for robot_id, rows in columns.items():
            ordered = np.array(sorted(rows), np.float64).T
            self._logs.received[robot_id] = Received(*ordered)


def configured_fence(metadata: FlightMetadata) -> Fence | None:
    """The fence of the robot's configuration; None if that cannot be read."""
    try:
        return from_mapping(Fence, json.loads(metadata.configuration)["fence"], "fence")
    except (ValueError, KeyError, TypeError):
        return None
