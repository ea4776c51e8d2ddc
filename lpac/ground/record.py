"""The ground's log: messages of the ground process, as MCAP files `ground-<number>.mcap`.

They are flight logs (see `edge.drivers.flight_log`) with these topics, stamped by this machine:

| topic | content |
| --- | --- |
| `setup` | `FleetSetup`, with the world file's text; again once a minute |
| `state` | `GroundState`, whenever it changes |
| `status` | `RobotStatus`, and the robot's `name`, `heard_at_unix_s`, `clock_offset_s` |
| `event` | `GroundEvent`: commands with their operators, results; robots' new states |
| `cost` | `Cost` |
| `explored` | `Explored`, whenever it changes |
"""

import asyncio
import contextlib
import dataclasses
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from edge.core.counted import counted
from edge.core.file_errors import in_words
from edge.drivers.flight_log import FlightLog, topic
from edge.messages.mission import GroundState, RobotStatus
from lpac.analysis.coverage import in_air
from lpac.analysis.snapshot import Explored, FleetSetup, FleetSnapshot, GroundEvent
from lpac.ground.cost import Cost, MissionCosts, positions_of
from lpac.ground.station.client import GroundError, listen
from lpac.ground.station.protocol import ServerMessage

COST_PERIOD_S = 0.5
_SETUP_PERIOD_S = 60.0
_SHOW_PERIOD_S = 5.0
_RETRY_S = 0.5
_HANG_UP_RETRY_S = 0.5
_MAX_TOTAL_BYTES = 2**34


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
    """Metadata of a ground's log."""

    fleet: str
    version: str
    log_name: str = "ground"


class Recording:
    """Records the ground's messages by topic, each once.

    `cost` is the newest cost, `flying` whether a robot was in the air in the last snapshot.
    """

    def __init__(self, record: Callable[[str, float, Mapping[str, object]], None]) -> None:
        """`record` gets the topic, the Unix time, s, and the message."""
        self._record = record
        self._costs = MissionCosts()
        self._setup: FleetSetup | None = None
        self._setup_at_s = 0.0
        self._state: GroundState | None = None
        # Boot nonce and sequence of each robot's newest status.
        self._statuses: dict[str, tuple[int, int]] = {}
        # The ground repeats its last 200 to a new client.
        self._events: deque[GroundEvent] = deque(maxlen=400)
        self._explored: dict[str, str] = {}
        self._cost_at_s = 0.0
        self.cost: Cost | None = None
        self.flying = False

    def take(self, message: ServerMessage, unix_now_s: float) -> None:
        """Record what is new in a message."""
        match message:
            case FleetSetup():
                self._take_setup(message, unix_now_s)
            case FleetSnapshot():
                self._take_snapshot(message)
            case GroundEvent() if message not in self._events:
                self._events.append(message)
                self._record("event", message.unix_time_s, dataclasses.asdict(message))
            case Explored(robot, cells) if self._explored.get(robot) != cells:
                self._explored[robot] = cells
                self._record("explored", unix_now_s, dataclasses.asdict(message))

    def close(self) -> None:
        """Abandon pending computations."""
        self._costs.close()

    def _take_setup(self, setup: FleetSetup, unix_now_s: float) -> None:
        self._costs.take_setup(setup)
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
        places_m, coverage = self._costs.follow(snapshot), self._costs.coverage
        if abs(now_s - self._cost_at_s) >= COST_PERIOD_S and coverage is not None:
            self._cost_at_s, self.cost = now_s, None
            if places_m:
                cost = coverage.cost(positions_of(places_m))
                self.cost = self._costs.cost(snapshot, places_m, cost)
                self._record("cost", now_s, dataclasses.asdict(self.cost))


def record(
    fleet: str,
    directory: Path,
    notify: Callable[[str], None],
    show: Callable[[str], None] = lambda _: None,
) -> None:
    """Record the messages of the fleet's ground process until SIGINT or SIGTERM.

    Waits for the ground process, and again when it ends. When the terminal closes (SIGHUP) it ends
    as `lpac ground` does: once no robot that is heard is in the air. `notify` gets messages for the
    user, `show` a summary every few seconds. Raises OSError if the log cannot be written.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"{directory}: cannot be created: {in_words(error)}") from None
    if not os.access(directory, os.W_OK | os.X_OK):
        raise OSError(f"{directory}: is not writable")
    metadata = GroundMetadata(fleet, version("lpac-edge"))
    log = FlightLog(directory, metadata, TOPICS, max_total_bytes=_MAX_TOTAL_BYTES)
    recording = Recording(log.record)
    with contextlib.closing(recording), contextlib.closing(log):
        if not log.recording:
            raise OSError(f"{directory}: is not writable: is the disk full?")
        notify(f"recording to {directory}; Ctrl-C ends it")
        following = _follow(fleet, log, recording, notify, show)
        asyncio.run(_until_stopped(following, recording))
    notify(f"recorded to {directory}")


async def _until_stopped(following: Coroutine[None, None, None], recording: Recording) -> None:
    loop = asyncio.get_running_loop()
    task = asyncio.create_task(following)

    def hang_up() -> None:
        if recording.flying:
            loop.call_later(_HANG_UP_RETRY_S, hang_up)
        else:
            task.cancel()

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, task.cancel)
    # With nohup, SIGHUP is ignored.
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        loop.add_signal_handler(signal.SIGHUP, hang_up)
    with contextlib.suppress(asyncio.CancelledError):
        await task


async def _follow(
    fleet: str,
    log: FlightLog,
    recording: Recording,
    notify: Callable[[str], None],
    show: Callable[[str], None],
) -> None:
    connected: bool | None = None
    shown_at_s = trial = None
    while True:
        try:
            async for message in listen(fleet):
                if not connected:
                    connected = True
                    notify(f"connected to the ground station of fleet {fleet}")
                recording.take(message, time.time())
                if not isinstance(message, FleetSnapshot):
                    continue
                log.flush()
                cost = recording.cost
                if cost is not None and cost.flying_mission and cost.trial != trial:
                    trial = cost.trial
                    robots = counted(len(cost.robots), "robot")
                    notify(f"trial {trial or '(no name)'} begins with {robots}")
                now_s = time.monotonic()
                if shown_at_s is None or now_s - shown_at_s >= _SHOW_PERIOD_S:
                    shown_at_s = now_s
                    show(_summary(message, cost))
        except (GroundError, ValueError) as error:
            if connected is not False:
                connected = False
                notify(f"{error}; waiting for it")
            recording.flying = False  # unknown
            log.flush()
            await asyncio.sleep(_RETRY_S)


def _summary(snapshot: FleetSnapshot, cost: Cost | None) -> str:
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
