"""A fleet on one simulated clock: real nodes of robots and ground stations, simulated vehicles.

The flight follows from the scenario's seed, under any load of the machine. The policy's outputs are
onnxruntime's, which differ in the last bits between types of CPU: `fleet.recorded` replays those of
an earlier flight.
"""

import copy
import copyreg
import itertools
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any, Self, TypeVar

from edge.identity.guard import Guard, Unguarded
from edge.identity.members import Role
from edge.messages.mission import GroundState
from lpac.analysis.snapshot import FleetSetup, FleetSnapshot, GroundEvent
from lpac.ground.procedure import NoSnapshotError, Procedure, Until, carry_out
from lpac.ground.station.config import load_ground
from lpac.ground.station.node import GroundNode
from lpac.ground.station.protocol import (
    SNAPSHOT_PERIOD_S,
    CommandReport,
    Request,
    ServerMessage,
)
from lpac.sim.air import GROUND, Radio, RadioLink, Subscriptions
from lpac.sim.fleet.layout import Settings
from lpac.sim.fleet.members import SimulatedMembers
from lpac.sim.fleet.robots import VEHICLE_STEP_S, SimulatedRobot, SimulatedRobots
from lpac.sim.scenario import Scenario
from lpac.sim.schedule import Schedule, WallClock

# Later than any date that a robot considers a wrong clock.
EPOCH_S = 1_800_000_000.0
_FIRST_PORT = 7447
_PATIENCE_S = 60.0

T = TypeVar("T")


class SimulatedFleet(SimulatedRobots):
    """Running robots, vehicles, radio and a first ground station, which advances the time.

    `radio.air` has the radio faults. `grounds` are all ground stations that ever joined, by name.
    """

    def __init__(
        self,
        scenario: Scenario,
        folder: Path,
        bundle: Path,
        *,
        operator: str = "operator",
        absent: int = 0,
        settings: Settings | None = None,
        spares: int = 0,
        vehicle_step_s: float = VEHICLE_STEP_S,
        logs: bool = False,
        recorded: Path | None = None,
        epoch_s: float = EPOCH_S,
    ) -> None:
        """Start all programs but those of the last `absent` robots.

        See `SimulatedRobots` for the other parameters. Raises the same as `Layout`.
        """
        self.members = SimulatedMembers("simulated") if scenario.secure else None
        self._last_start: dict[str, int] = {}
        super().__init__(
            scenario,
            folder,
            bundle,
            fleet="simulated",
            ports=range(_FIRST_PORT, _FIRST_PORT + scenario.robots),
            epoch_s=epoch_s,
            # Log readers must not confuse programs of flights at different times.
            boots=int(epoch_s - EPOCH_S),
            settings=settings,
            spares=spares,
            vehicle_step_s=vehicle_step_s,
            logs=logs,
            recorded=recorded,
        )
        self.radio = Radio(self.schedule, self.true_positions_m, self._rng)
        for robot in self.robots[: scenario.robots - absent]:
            robot.start()
        self._setup = load_ground(self.fleet_toml, operator).setup
        self.grounds: dict[str, SimulatedGround] = {}
        self.ground = self.join(operator)

    def join(
        self, operator: str, role: Role = Role.OPERATOR, *, remembers: bool = True
    ) -> "SimulatedGround":
        """Start a ground station; one of that name that runs first ends, as by a loss of power.

        With `remembers` it restarts on the same computer, with the state left on its disk.
        """
        former = self.grounds.get(operator)
        if former is None:
            station = GROUND - len(self.grounds)
        else:
            former.leave()
            station = former.station_id
        setup = replace(self._setup, operator=operator)
        guard = self._guard(role, operator, None, self._next_boot())
        ground = SimulatedGround(setup, self.schedule, self.radio, station, guard)
        if former is not None and remembers:
            ground.recall(former)
        self.grounds[operator] = ground
        return ground

    def copy(self) -> Self:
        """Independent copy of the current state, so that many flights can share their start.

        Callbacks on the schedule must be methods or partials of them: a plain function would act
        on the first fleet. Raises TypeError while a command runs, and for a fleet that logs.
        """
        shared = (self._policy, self._policy.policy, self.layout.bundle, self._sensors)
        with _copyable():
            return copy.deepcopy(self, {id(each): each for each in shared})

    def _open_link(self, robot: SimulatedRobot, subscriptions: Subscriptions) -> RadioLink:
        return self.radio.link(robot.config.robot_id, subscriptions)

    def _new_guard(self, robot: SimulatedRobot, start: int) -> Guard:
        robot_id = robot.config.robot_id
        return self._guard(Role.ROBOT, f"r{robot_id}", robot_id, start)

    def _guard(self, role: Role, name: str, robot_id: int | None, start: int) -> Guard:
        start += int(1e3 * self.schedule.unix_s())
        if self.members is None:
            return Unguarded(start)
        # As `edge.drivers.identity_folder` numbers the starts of a real program.
        start = max(start, self._last_start.get(name, 0) + 1)
        self._last_start[name] = start
        return self.members.guard(role, name, robot_id, start, self.schedule.monotonic_s)


class SimulatedGround:
    """The real ground station on the simulated clock: a `Ground` that carries out procedures.

    `runs` until it leaves; `station_id` is its id on the radio, `clock` its computer's.
    """

    def __init__(
        self, setup: FleetSetup, schedule: Schedule, radio: Radio, station: int, guard: Guard
    ) -> None:
        self.events: list[GroundEvent] = []
        self.station_id = station
        self.runs = True
        self.clock = WallClock(schedule)
        self.node = GroundNode(setup, self.clock, self, guard)
        self._schedule = schedule
        self._snapshot = self.node.snapshot
        # State on its disk.
        self._commanded: GroundState | None = None
        self._world = ""
        self._link = radio.link(
            station,
            self.node.subscriptions,
        )
        self.node.attach(self._link)
        self._ticks = schedule.every(SNAPSHOT_PERIOD_S, self._tick)

    def leave(self) -> None:
        """End, as by a loss of power."""
        if self.runs:
            self.runs = False
            self._ticks.stop()
            self._link.close()
            self.node.detach()

    def suspend(self, duration_s: float) -> None:
        """Stop for this long, as a sleeping laptop, then handle all messages received."""
        self._link.suspended_until_s = self.now_s + duration_s
        self._ticks.hang(duration_s)

    def recall(self, former: "SimulatedGround") -> None:
        """Load the state that an earlier one left on its disk."""
        self._commanded, self._world = former._commanded, former._world
        if self._world:
            self.node.station.worlds.add(self._world)
        if self._commanded is not None:
            self.node.station.election.restore(self._commanded)

    @property
    def setup(self) -> FleetSetup:
        """The fleet's setup."""
        return self.node.station.setup

    @property
    def snapshot(self) -> FleetSnapshot:
        """The last snapshot of the fleet."""
        return self._snapshot

    @property
    def now_s(self) -> float:
        """Simulated time, s."""
        return self._schedule.monotonic_s()

    @property
    def unix_now_s(self) -> float:
        """Its computer's wall clock."""
        return self.clock.unix_s()

    def carry_out(self, procedure: Procedure[T]) -> T:
        """Advance the time until the procedure returns. Raises the procedure's errors."""
        return carry_out(procedure, self.command, self.wait)

    def command(self, request: Request) -> CommandReport:
        """Run a command to its report. Raises NoSnapshotError on timeout."""
        task = self.node.begin(request)
        end_s = self.now_s + _PATIENCE_S * len(self.setup.robots)
        while task is not None and task.report is None and self.now_s < end_s and self.runs:
            self._schedule.run_until(self.now_s + SNAPSHOT_PERIOD_S)
        if task is None or task.report is None:
            raise NoSnapshotError(f"{type(request).__name__} does not end")
        return task.report

    def wait(self, until: Until) -> bool:
        """Advance the time until the condition holds; False on timeout."""
        end_s = self.now_s + until.at_most_s
        while not until.condition(self._snapshot):
            if self.now_s >= end_s:
                return False
            self._schedule.run_until(min(end_s, self.now_s + SNAPSHOT_PERIOD_S))
        return True

    def published(self, message: ServerMessage) -> None:
        """Keep the events, and the last world on disk."""
        if isinstance(message, GroundEvent):
            self.events.append(message)
        if isinstance(message, FleetSetup) and message.world:
            self._world = message.world

    def progressed(self) -> None:
        """Do nothing: no thread waits for it."""

    def state_changed(self, state: GroundState) -> None:
        """Keep the election's state on disk."""
        self._commanded = state

    def _tick(self) -> None:
        self.node.tick()
        self._snapshot = self.node.snapshot


def _copy_count(count: Any) -> tuple[Any, tuple[int]]:
    """Reduce a count by its repr, the only way to read its position without advancing it."""
    return itertools.count, (int(repr(count)[len("count(") : -1]),)


# Objects that a copy recreates. Locks are free, since one thread runs all.
_COPIES: dict[type, Any] = {
    type(Lock()): lambda _: (Lock, ()),
    struct.Struct: lambda each: (struct.Struct, (each.format,)),
    itertools.count: _copy_count,
}


@contextmanager
def _copyable() -> Iterator[None]:
    before = {kind: copyreg.dispatch_table.get(kind) for kind in _COPIES}
    copyreg.dispatch_table.update(_COPIES)
    try:
        yield
    finally:
        for kind, reduce in before.items():
            if reduce is None:
                del copyreg.dispatch_table[kind]
            else:
                copyreg.dispatch_table[kind] = reduce
