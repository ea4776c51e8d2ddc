"""Whole robots on one clock, in one process: the real nodes on simulated vehicles.

Subclasses provide the links and advance the time: `fleet.simulated` on a simulated clock.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

from edge.core import F64
from edge.core.ports import SensorOver
from edge.core.vehicle import Action, Mode
from edge.drivers.flight_log import FlightLog
from edge.drivers.registry import load_verified_policy, open_sensor
from edge.identity.guard import Guard, Unguarded
from edge.messages.mission import RobotStatus
from edge.messages.topics import Link
from edge.policy.family import VerifiedPolicy, verified
from edge.policy.lpac.policy import LpacPolicy
from edge.robot.config import RobotConfig, load_config
from edge.robot.log import open_log
from edge.robot.node import Ports, RobotNode
from lpac.sim.air import Subscriptions
from lpac.sim.fleet.agents import DeferredAgent, PolicyWithAgents
from lpac.sim.fleet.layout import Layout, Settings
from lpac.sim.fleet.recorded import RecordedAgent, recorded_steps
from lpac.sim.px4.direct import DirectVehicle
from lpac.sim.scenario import Scenario
from lpac.sim.schedule import Schedule, Timer, WallClock

# Default step of the vehicles' physics.
VEHICLE_STEP_S = 0.02
# Period of preflight and status.
_CHORE_S = 0.25
_WATCH_S = 0.1


class OpenLink(Link, Protocol):
    """A link that is closed with its program."""

    def close(self) -> None:
        """Close the link."""
        ...


class SimulatedRobot:
    """A vehicle, and a robot's program, which may start and end.

    `status` is the program's last one, received or not; None before the first. `clock` is the
    robot computer's.
    """

    def __init__(
        self,
        config: RobotConfig,
        vehicle: DirectVehicle,
        policy: VerifiedPolicy,
        sensor_over: SensorOver,
        world: str,
        schedule: Schedule,
        rng: np.random.Generator,
        open_link: Callable[["SimulatedRobot", Subscriptions], OpenLink],
        new_guard: Callable[["SimulatedRobot", int], Guard],
        next_boot: Callable[[], int],
        logs: bool,
    ) -> None:
        """`world` is the text of the world file. `next_boot` numbers the starts of programs."""
        self.config = config
        self.vehicle = vehicle
        self.world = world
        self.clock = WallClock(schedule)
        self.node: RobotNode | None = None
        self.watchdog: SimulatedWatchdog | None = None
        self._disk = _Disk()
        self._last_status: RobotStatus | None = None
        self.loops: dict[str, Timer] = {}
        self._policy = policy
        self._sensor_over = sensor_over
        self._schedule = schedule
        self._rng = rng
        self._open_link = open_link
        self._new_guard = new_guard
        self._next_boot = next_boot
        self._link: OpenLink | None = None
        self._logs = logs
        self._log: FlightLog | None = None

    @property
    def status(self) -> RobotStatus | None:
        """The last status, also after the program has ended; None before the first."""
        return (self.node and self.node.status) or self._last_status

    def start(self) -> None:
        """Start or restart the program."""
        self.stop()
        schedule, boot = self._schedule, self._next_boot()
        if self._logs:
            self._log = open_log(self.config, self._policy.policy.bundle_id.hex(), boot)
        self._disk.log = self._log
        self.watchdog = SimulatedWatchdog(
            self.vehicle,
            schedule,
            self.config.flight.command_timeout_s,
            self.config.flight.hover_land_s,
        )
        self.node = node = RobotNode(
            self.config,
            Ports(
                clock=self.clock,
                vehicle=self.vehicle,
                vehicle_setup=self.vehicle,
                watchdog=self.watchdog,
                recorder=self._disk,
                sensor_over=self._sensor_over,
            ),
            self._policy,
            self.world,
            self._new_guard(self, boot),
            boot_nonce=boot,
        )
        self._link = self._open_link(self, node.subscriptions)
        node.attach(self._link)
        rates = self.config.rates
        steps: tuple[tuple[str, float, Callable[[], object]], ...] = (
            ("control", 1.0 / rates.control_hz, node.control_step),
            ("perception", 1.0 / rates.perception_hz, node.perception_step),
            ("policy", 1.0 / rates.policy_hz, node.policy_step),
            ("preflight", _CHORE_S, node.preflight_step),
            ("status", _CHORE_S, partial(node.status_step, {})),
        )
        self.loops = {
            # Random phases, since real programs do not start at the same time.
            name: schedule.every(period_s, step, period_s * self._rng.random())
            for name, period_s, step in steps
        }
        if self._log is not None:
            self.loops["log"] = schedule.every(_CHORE_S, self._log.flush)

    def hang(self, duration_s: float) -> None:
        """Stop all loops of the program for this long."""
        for loop in self.loops.values():
            loop.hang(duration_s)

    def fill_disk(self) -> None:
        """Fill the disk: the log reports it, as `FlightLog` does."""
        self._disk.full = True

    def end(self) -> None:
        """End the program as by SIGTERM: it leaves the vehicle as on_stop says."""
        assert self.node is not None and self.watchdog is not None
        action = self.node.leave(Action(self.config.on_stop))
        if action is not None:
            self.watchdog.feed(flying=False)
            self.vehicle.command(action)
        self.stop()

    def stop(self) -> None:
        """End the program, as by a loss of power."""
        self._last_status = self.status
        for loop in self.loops.values():
            loop.stop()
        if self.watchdog is not None:
            self.watchdog.program_ended()
        if self._link is not None:
            self._link.close()
        if self._log is not None:
            self._log.close()
        self.loops, self._link, self._log, self.node = {}, None, None, None
        self._disk.log = None


class SimulatedRobots:
    """The robots of a scenario, on `schedule`; their programs are not started yet.

    `robots[i]` is robot i; `all_programs` includes second programs of robots.
    """

    def __init__(
        self,
        scenario: Scenario,
        folder: Path,
        bundle: Path,
        *,
        fleet: str,
        ports: Sequence[int],
        epoch_s: float,
        boots: int = 0,
        settings: Settings | None = None,
        spares: int = 0,
        vehicle_step_s: float = VEHICLE_STEP_S,
        logs: bool = False,
        recorded: Path | None = None,
    ) -> None:
        """Write fleet.toml, the world and each robot's robot.toml to `folder`, and read them.

        `ports` are the robots' zenoh ports; the wall clock starts at `epoch_s`, and starts of
        programs are numbered from `boots`. See `Layout.write` for `settings` and `spares`. With
        `logs` the robots write logs in `folder`. `recorded` is such a folder of an earlier flight,
        whose policy outputs are replayed. Raises the same as `Layout`, and RecordingError.
        """
        for table in ("autopilot", "link"):
            if table in (settings or {}):
                raise ValueError(f"settings: {table}: is set by the simulation: leave it out")
        self.layout = layout = Layout(scenario, bundle)
        self.folder = folder
        self.fleet_toml = folder / "fleet.toml"
        self.schedule = Schedule(epoch_s)
        self._boots = boots
        self._vehicle_step_s = vehicle_step_s
        self._logs = logs
        self._recorded = recorded
        self._sensors = ExitStack()
        self._rng = np.random.default_rng([scenario.seed, 2])
        layout.write(
            folder,
            fleet,
            {
                f"r{robot}": {
                    "zenoh_port": port,
                    "system_id": robot + 1,
                    "mavlink_url": f"udpin://127.0.0.1:{14551 + robot}",
                }
                for robot, port in enumerate(ports)
            },
            settings=settings,
            spares=spares,
        )
        self._policy = load_verified_policy(layout.bundle_path)
        self.vehicles = tuple(
            DirectVehicle(vehicle, robot + 1, self.schedule)
            for robot, vehicle in enumerate(layout.vehicles)
        )
        world = (folder / "world.env").read_text()
        self.robots = tuple(
            self._robot(load_config(folder / "robots" / str(i) / "robot.toml"), vehicle, world)
            for i, vehicle in enumerate(self.vehicles)
        )
        self.all_programs = list(self.robots)
        self._let_fly(self.vehicles)

    def second_program(self, robot_id: int, vehicle: DirectVehicle) -> SimulatedRobot:
        """Another computer with the same robot id, and a vehicle of its own."""
        first = self.robots[robot_id]
        second = self._robot(first.config, vehicle, first.world)
        self.all_programs.append(second)
        self._let_fly([vehicle])
        return second

    def true_positions_m(self) -> F64:
        """True positions of the vehicles: the mission frame, (N, 3), m."""
        to_mission = self.layout.to_mission
        return np.array(
            [to_mission.local_to_mission(each.vehicle.position_m) for each in self.vehicles]
        )

    def close(self) -> None:
        """End the robots' programs, and close the sensors."""
        for robot in self.robots:
            robot.stop()
        self._sensors.close()

    def _let_fly(self, vehicles: Sequence[DirectVehicle]) -> None:
        step_s = self._vehicle_step_s
        self.schedule.every(step_s, partial(_step, vehicles, step_s), step_s)

    def _robot(self, config: RobotConfig, vehicle: DirectVehicle, world: str) -> SimulatedRobot:
        sensor = open_sensor(config.sensor.type, config.sensor.options, self.layout.bundle.manifest)
        return SimulatedRobot(
            config,
            vehicle,
            self._policy_of(config.robot_id),
            self._sensors.enter_context(sensor),
            world,
            self.schedule,
            self._rng,
            self._open_link,
            self._new_guard,
            self._next_boot,
            self._logs,
        )

    def _policy_of(self, robot_id: int) -> VerifiedPolicy:
        policy = self._policy.policy
        if self._recorded is not None:
            steps = recorded_steps(self._recorded, robot_id, policy)
            recorded = partial(RecordedAgent, steps, self.schedule.unix_s)
            return verified(PolicyWithAgents(policy, recorded))
        if self._logs or not isinstance(policy, LpacPolicy):
            return self._policy
        deferred = partial(DeferredAgent, policy)
        return VerifiedPolicy(PolicyWithAgents(policy, deferred), self._policy.problem)

    def _open_link(self, robot: SimulatedRobot, subscriptions: Subscriptions) -> OpenLink:
        raise NotImplementedError

    def _new_guard(self, robot: SimulatedRobot, start: int) -> Guard:
        """Guard of one start of the program."""
        return Unguarded(int(1e3 * robot.clock.unix_s()) + start)

    def _next_boot(self) -> int:
        self._boots += 1
        return self._boots


def _step(vehicles: Sequence[DirectVehicle], dt_s: float) -> None:
    for vehicle in vehicles:
        vehicle.step(dt_s)


class SimulatedWatchdog:
    """Counterpart of `edge.drivers.px4.watchdog`, which outlives a hanging program."""

    def __init__(
        self, vehicle: DirectVehicle, schedule: Schedule, timeout_s: float, hover_land_s: float
    ) -> None:
        self._vehicle = vehicle
        self._schedule = schedule
        self._timeout_s = timeout_s
        self._hover_land_s = hover_land_s
        self._flying = False
        self._fed_s = schedule.monotonic_s()
        self._held: Literal["no", "holds", "left"] = "no"
        self._looks = schedule.every(_WATCH_S, self._look, _WATCH_S)
        self._alive = True

    def program_ended(self) -> None:
        """Go on only if it holds the vehicle; otherwise PX4 reacts to the program's end."""
        if self._held != "holds":
            self.die()

    def die(self) -> None:
        """End, as by kill -9."""
        self._alive = False
        self._looks.stop()

    def feed(self, *, flying: bool) -> None:
        """Report that the control loop runs."""
        self._flying, self._fed_s, self._held = flying, self._schedule.monotonic_s(), "no"

    def alive(self) -> bool:
        """Whether it still runs."""
        return self._alive

    def _look(self) -> None:
        """Hold a vehicle without control, and land it after a while if it still holds."""
        silent_s = self._schedule.monotonic_s() - self._fed_s
        if self._flying and self._held == "no" and silent_s >= self._timeout_s:
            self._held = "holds"
            self._vehicle.command(Action.HOLD)
        elif self._held == "holds" and silent_s >= self._hover_land_s:
            self._held = "left"
            if self._vehicle.state().mode is Mode.HOLD:
                self._vehicle.command(Action.LAND)


class _Disk:
    """Recorder that writes to the current log, if any, until the disk is full."""

    def __init__(self) -> None:
        self.log: FlightLog | None = None
        self.full = False

    @property
    def recording(self) -> bool:
        """Whether records can be written."""
        return not self.full and (self.log is None or self.log.recording)

    def record(self, topic: str, unix_time_s: float, message: Mapping[str, object]) -> None:
        """Write to the log, if there is one and the disk is not full."""
        if self.log is not None and not self.full:
            self.log.record(topic, unix_time_s, message)
