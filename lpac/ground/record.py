"""The ground's log: what the ground process tells, as MCAP files `ground-<number>.mcap`.

They are flight logs (see `edge.drivers.flight_log`) with these topics, in this machine's clock:

| topic | holds |
| --- | --- |
| `setup` | `FleetSetup`, with the world file's text; again once a minute |
| `state` | `GroundState`, whenever it changes |
| `status` | `RobotStatus`, and the robot's `name`, `heard_at_unix_s`, `clock_offset_s` |
| `event` | `GroundEvent`: commands, results, who gave them; robots' new states |
| `cost` | `Cost` |
| `explored` | `Explored`, whenever it changes |
"""

import asyncio
import contextlib
import dataclasses
import os
import signal
import time
from collections import Counter, deque
from collections.abc import Callable, Coroutine, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from edge.core import F64
from edge.core.counted import counted
from edge.core.file_errors import in_words
from edge.drivers.flight_log import FlightLog, topic
from edge.messages.mission import FlightState, GroundState, RobotStatus
from lpac.analysis.coverage import Coverage, LastPositions, in_air
from lpac.analysis.mission_tracker import MissionTracker
from lpac.analysis.snapshot import Explored, FleetSetup, FleetSnapshot, GroundEvent
from lpac.ground.station.client import GroundError, listen
from lpac.ground.station.protocol import ServerMessage

COST_PERIOD_S = 0.5
_SETUP_PERIOD_S = 60.0
_SHOW_PERIOD_S = 5.0
_RETRY_S = 0.5
_LOOK_AGAIN_S = 0.5
_MAX_TOTAL_BYTES = 2**34


@dataclass(frozen=True, slots=True)
class Cost:
    """Cost of the robots' positions now: the paper's J, model units.

    `robots` are those that count, by name (see `lpac.analysis.coverage.LastPositions`);
    `flying_mission` whether one of them flies its mission, which begins anew as
    `lpac.analysis.mission_tracker` says. `initial` is J when the first of this trial did;
    `normalized` is J over that; `bound` is what Lloyd's algorithm comes to, which
    knows the world, with so many robots: no bound, though logs call it so. These are None before.
    """

    trial: str
    robots: tuple[str, ...]
    flying_mission: bool
    cost: float
    initial: float | None
    normalized: float | None
    bound: float | None


TOPICS = {
    "setup": topic("FleetSetup", FleetSetup),
    "state": topic("GroundState", GroundState),
    "status": topic(
        "HeardStatus", RobotStatus, name=str, heard_at_unix_s=float, clock_offset_s=float
    ),
    "event": topic("GroundEvent", GroundEvent),
    "cost": topic("Cost", Cost),
    "explored": topic("Explored", Explored),
}


@dataclass(frozen=True, slots=True)
class GroundMetadata:
    """Metadata of the ground that wrote the log."""

    fleet: str
    version: str
    log_name: str = "ground"


class Recording:
    """Sorts what the ground tells into topics, each thing once.

    `cost` is the newest. `flying` is whether a robot was in the air in the last picture.
    """

    def __init__(self, record: Callable[[str, float, Mapping[str, object]], None]) -> None:
        """`record` gets topic, Unix time in s, and message."""
        self._record = record
        self._pool = ThreadPoolExecutor(1)
        # Of the mission that began last, by world, trial and number of robots.
        self._bounds: dict[tuple[str, str, int], Future[float]] = {}
        self._setup: FleetSetup | None = None
        self._setup_at_s = 0.0
        self._coverage: Coverage | None = None
        self._state: GroundState | None = None
        # Of each robot: boot nonce and sequence of the newest status.
        self._statuses: dict[str, tuple[int, int]] = {}
        # The ground repeats its last 200 to a new client.
        self._events: deque[GroundEvent] = deque(maxlen=400)
        self._explored: dict[str, str] = {}
        self._cost_at_s = 0.0
        self._last_positions = LastPositions()
        self._mission_tracker = MissionTracker()
        # J at the start of each trial's last mission.
        self._initial: dict[str, float] = {}
        self.cost: Cost | None = None
        self.flying = False

    def take(self, told: ServerMessage, unix_now_s: float) -> None:
        """Record what is new in it."""
        match told:
            case FleetSetup():
                self._take_setup(told, unix_now_s)
            case FleetSnapshot():
                self._take_snapshot(told)
            case GroundEvent() if told not in self._events:
                self._events.append(told)
                self._record("event", told.unix_time_s, dataclasses.asdict(told))
            case Explored(robot, cells) if self._explored.get(robot) != cells:
                self._explored[robot] = cells
                self._record("explored", unix_now_s, dataclasses.asdict(told))

    def close(self) -> None:
        """Leave what is being computed."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _take_setup(self, setup: FleetSetup, unix_now_s: float) -> None:
        if self._setup is None or self._setup.world != setup.world:
            self._coverage = None
            # Nothing else depends on a world that cannot be read, or is not known.
            with contextlib.suppress(ValueError):
                self._coverage = Coverage.of(setup) if setup.world else None
        self._setup, self._setup_at_s = setup, unix_now_s
        self._record("setup", unix_now_s, dataclasses.asdict(setup))

    def _take_snapshot(self, snapshot: FleetSnapshot) -> None:
        now_s = snapshot.unix_time_s
        self.flying = any(r.fresh and r.status and in_air(r.status) for r in snapshot.robots)
        if self._setup is not None and abs(now_s - self._setup_at_s) >= _SETUP_PERIOD_S:
            self._take_setup(self._setup, now_s)
        state = snapshot.ground and dataclasses.replace(snapshot.ground, unix_time_s=None)
        if state is not None and state != self._state:
            self._state = state
            self._record("state", now_s, dataclasses.asdict(snapshot.ground))  # type: ignore[arg-type]
        for robot in snapshot.robots:
            status = robot.status
            if status is None or robot.age_s is None:
                continue
            if self._mission_tracker.begins(robot.robot_id, status, now_s - robot.age_s):
                self._initial.pop(status.trial, None)
                self._bounds.clear()
            at = (status.boot_nonce, status.sequence)
            if self._statuses.get(robot.name) == at:
                continue
            self._statuses[robot.name] = at
            heard_at_s = now_s - robot.age_s
            heard = {
                **dataclasses.asdict(status), "name": robot.name, "heard_at_unix_s": heard_at_s,
                "clock_offset_s": robot.clock_offset_s,
            }  # fmt: skip
            self._record("status", heard_at_s, heard)
        places_m = self._last_positions.counted(snapshot)
        if abs(now_s - self._cost_at_s) >= COST_PERIOD_S and self._coverage is not None:
            self._take_cost(snapshot, places_m, self._coverage)

    def _take_cost(
        self,
        snapshot: FleetSnapshot,
        places_m: Mapping[str, tuple[float, float]],
        coverage: Coverage,
    ) -> None:
        self._cost_at_s = snapshot.unix_time_s
        if not places_m:
            self.cost = None
            return
        positions_m = np.array(list(places_m.values()))
        cost = coverage.cost(positions_m)
        statuses = [
            r.status for r in snapshot.robots if r.name in places_m and r.status is not None
        ]
        flying = [status for status in statuses if status.state is FlightState.MISSION]
        # As the robots say: a ground that has just started does not know it yet.
        ((trial, _),) = Counter(s.trial for s in flying or statuses).most_common(1)
        if flying:
            self._initial.setdefault(trial, cost)
        initial = self._initial.get(trial)
        self.cost = Cost(
            trial, tuple(places_m), bool(flying), cost, initial,
            normalized=cost / initial if initial else None,
            bound=None if initial is None else self._bound(coverage, trial, positions_m),
        )  # fmt: skip
        self._record("cost", snapshot.unix_time_s, dataclasses.asdict(self.cost))

    def _bound(self, coverage: Coverage, trial: str, positions_m: F64) -> float | None:
        """Computed beside all else, once per world, trial and number; None until it is known."""
        assert self._setup is not None
        key = (self._setup.world_id, trial, len(positions_m))
        if key not in self._bounds:
            self._bounds[key] = self._pool.submit(coverage.lloyd, positions_m)
        return self._bounds[key].result() if self._bounds[key].done() else None


def record(
    fleet: str,
    directory: Path,
    say: Callable[[str], None],
    show: Callable[[str], None] = lambda _: None,
) -> None:
    """Record what the ground process of `fleet` tells, until SIGINT or SIGTERM.

    It waits for the ground process, also for the next when one ends. When its terminal is closed
    (SIGHUP) it ends as `lpac ground` does: once nobody that is heard is in the air. `say` gets what
    a person is to know; `show` where things stand, every few seconds. Raises OSError if nothing
    can be written.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"{directory}: cannot be made: {in_words(error)}") from None
    if not os.access(directory, os.W_OK | os.X_OK):
        raise OSError(f"{directory}: nothing can be written there")
    metadata = GroundMetadata(fleet, version("lpac-edge"))
    log = FlightLog(directory, metadata, TOPICS, max_total_bytes=_MAX_TOTAL_BYTES)
    recording = Recording(log.record)
    with contextlib.closing(recording), contextlib.closing(log):
        if not log.recording:
            raise OSError(f"{directory}: nothing can be written there; is the disk full?")
        say(f"recording to {directory}; Ctrl-C ends it")
        following = _follow(fleet, log, recording, say, show)
        asyncio.run(_until_stopped(following, recording))
    say(f"recorded to {directory}")


async def _until_stopped(following: Coroutine[None, None, None], recording: Recording) -> None:
    loop = asyncio.get_running_loop()
    task = asyncio.create_task(following)

    def hang_up() -> None:
        if recording.flying:
            loop.call_later(_LOOK_AGAIN_S, hang_up)
        else:
            task.cancel()

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, task.cancel)
    # With nohup it goes on whatever becomes of the terminal.
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        loop.add_signal_handler(signal.SIGHUP, hang_up)
    with contextlib.suppress(asyncio.CancelledError):
        await task


async def _follow(
    fleet: str,
    log: FlightLog,
    recording: Recording,
    say: Callable[[str], None],
    show: Callable[[str], None],
) -> None:
    hears: bool | None = None
    shown_at_s = trial = None
    while True:
        try:
            async for told in listen(fleet):
                if not hears:
                    hears = True
                    say(f"hears the ground station of fleet {fleet}")
                recording.take(told, time.time())
                if not isinstance(told, FleetSnapshot):
                    continue
                log.flush()
                cost = recording.cost
                if cost is not None and cost.flying_mission and cost.trial != trial:
                    trial = cost.trial
                    robots = counted(len(cost.robots), "robot")
                    say(f"trial {trial or '(no name)'} begins with {robots}")
                now_s = time.monotonic()
                if shown_at_s is None or now_s - shown_at_s >= _SHOW_PERIOD_S:
                    shown_at_s = now_s
                    show(_line(told, cost))
        except (GroundError, ValueError) as error:
            if hears is not False:
                hears = False
                say(f"{error}; waiting for it")
            recording.flying = False  # as far as is known
            log.flush()
            await asyncio.sleep(_RETRY_S)


def _line(snapshot: FleetSnapshot, cost: Cost | None) -> str:
    """Where things stand."""
    heard = sum(robot.fresh for robot in snapshot.robots)
    words = [
        time.strftime("%H:%M:%S", time.localtime(snapshot.unix_time_s)),
        f"{heard} of {counted(len(snapshot.robots), 'robot')} heard",
    ]
    if cost is not None and cost.normalized is not None and cost.initial:
        words += [
            f"trial {cost.trial or '-'}",
            f"{len(cost.robots)} in the air",
            f"cost {cost.normalized:.2f} of the initial",
        ]
        if cost.bound is not None:
            words.append(f"Lloyd, knowing the whole world, {cost.bound / cost.initial:.2f}")
    return "  ".join(words)
