"""A whole fleet on one simulated clock: the robots' real nodes, simulated vehicles, a real ground.

Everything follows from the scenario's seed, however loaded the machine is. The policy's numbers are
onnxruntime's, which differ in the last bits from one type of CPU to another.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from edge.core import F64
from edge.core.world import parse_world, rasterize
from edge.drivers.world_sensor import WorldSensor
from edge.messages.mission import GroundState
from edge.policy.bundle import Manifest
from edge.robot.config import load_config
from edge.robot.node import Ports, RobotNode, load_policy
from lpac.analysis.snapshot import FleetSetup, FleetSnapshot, GroundEvent
from lpac.ground.procedure import NothingComesError, Procedure, Until
from lpac.ground.station.config import load_ground
from lpac.ground.station.node import GroundNode
from lpac.ground.station.protocol import (
    SNAPSHOT_PERIOD_S,
    CommandReport,
    Request,
    ServerMessage,
)
from lpac.sim.fleet.layout import FleetScenario, Layout
from lpac.sim.px4.direct import DirectVehicle
from lpac.sim.radio import GROUND, Radio
from lpac.sim.schedule import Schedule

# Of a vehicle's physics; and of preflight and status.
_VEHICLE_STEP_S = 0.02
_CHORE_S = 0.25
# Long after any date that a robot takes for a wrong clock.
_EPOCH_S = 1_800_000_000.0
_FIRST_PORT = 7447
_PATIENCE_S = 60.0

T = TypeVar("T")


class SimulatedFleet:
    """Robots, vehicles, radio and ground, prepared; `ground` lets their time pass.

    `robots[i]` is robot i's node, `vehicles[i]` its vehicle, for whoever wants to do something to
    it; `radio.air` is what becomes of messages.
    """

    def __init__(self, scenario: FleetScenario, folder: Path, bundle: Path) -> None:
        """`folder` gets fleet.toml, the world and each robot's robot.toml, which are then read.

        Raises what `Layout` does.
        """
        self.layout = layout = Layout(scenario, bundle)
        self.schedule = schedule = Schedule(_EPOCH_S)
        layout.write(
            folder,
            "simulated",
            {
                f"r{robot}": {
                    "zenoh_port": _FIRST_PORT + robot,
                    "system_id": robot + 1,
                    "mavlink_url": f"udpin://127.0.0.1:{14551 + robot}",
                }
                for robot in range(scenario.robots)
            },
        )
        rng = np.random.default_rng([scenario.seed, 2])
        self.radio = Radio(schedule, self.true_positions_m, rng)
        self.vehicles = tuple(
            DirectVehicle(vehicle, robot + 1, schedule)
            for robot, vehicle in enumerate(layout.vehicles)
        )
        policy, world = load_policy(bundle), (folder / "world.env").read_text()
        robots = []
        for robot, vehicle in enumerate(self.vehicles):
            config = load_config(folder / "robots" / str(robot) / "robot.toml")
            node = RobotNode(
                config,
                Ports(
                    clock=schedule,
                    vehicle=vehicle,
                    vehicle_setup=vehicle,
                    watchdog=_Watchdog(),
                    recorder=_NoLog(),
                    sensor_over=partial(_sensor_over, layout.bundle.manifest),
                ),
                policy,
                world,
                boot_nonce=robot + 1,
                boot_epoch=int(_EPOCH_S * 1e3),
            )
            node.link = self.radio.link(robot, node.subscriptions)
            robots.append(node)
            schedule.every(_VEHICLE_STEP_S, partial(vehicle.step, _VEHICLE_STEP_S), _VEHICLE_STEP_S)
            rates = config.rates
            steps: tuple[tuple[float, Callable[[], object]], ...] = (
                (1.0 / rates.control_hz, node.control_step),
                (1.0 / rates.perception_hz, node.perception_step),
                (1.0 / rates.policy_hz, node.policy_step),
                (_CHORE_S, node.preflight_step),
                (_CHORE_S, partial(node.status_step, {})),
            )
            for period_s, step in steps:
                # Nobody starts ten programs at one time.
                schedule.every(period_s, step, period_s * rng.random())
        self.robots = tuple(robots)
        setup = load_ground(folder / "fleet.toml", "operator").setup
        self.ground = SimulatedGround(setup, schedule, self.radio)

    def true_positions_m(self) -> F64:
        """Where the vehicles really are: the mission frame, (N, 3), m."""
        to_mission = self.layout.to_mission
        return np.array(
            [to_mission.local_to_mission(each.vehicle.position_m) for each in self.vehicles]
        )


class SimulatedGround:
    """The real ground on the simulated clock: a `Ground` for procedures, which it carries out."""

    def __init__(self, setup: FleetSetup, schedule: Schedule, radio: Radio) -> None:
        self.events: list[GroundEvent] = []
        self.node = GroundNode(setup, schedule, self)
        self._schedule = schedule
        self._snapshot = self.node.snapshot
        self.node.link = radio.link(GROUND, self.node.subscriptions)
        schedule.every(SNAPSHOT_PERIOD_S, self._tick)

    @property
    def setup(self) -> FleetSetup:
        """What seldom changes."""
        return self.node.station.setup

    @property
    def snapshot(self) -> FleetSnapshot:
        """The fleet as it was told last."""
        return self._snapshot

    @property
    def now_s(self) -> float:
        """The simulated clock."""
        return self._schedule.monotonic_s()

    @property
    def unix_now_s(self) -> float:
        """The simulated wall clock."""
        return self._schedule.unix_s()

    def carry_out(self, procedure: Procedure[T]) -> T:
        """Let time pass until the procedure is through; what it comes to. Raises what it raises."""
        answer: CommandReport | bool | None = None
        while True:
            try:
                wanted = procedure.send(answer)
            except StopIteration as done:
                result: T = done.value
                return result
            answer = self._wait(wanted) if isinstance(wanted, Until) else self.command(wanted)

    def command(self, request: Request) -> CommandReport:
        """Have a command done. Raises NothingComesError if it does not end."""
        task = self.node.begin(request)
        end_s = self.now_s + _PATIENCE_S * len(self.setup.robots)
        while task is not None and task.report is None and self.now_s < end_s:
            self._schedule.run_until(self.now_s + SNAPSHOT_PERIOD_S)
        if task is None or task.report is None:
            raise NothingComesError(f"{type(request).__name__} does not end")
        return task.report

    def told(self, message: ServerMessage) -> None:
        """Keep the events."""
        if isinstance(message, GroundEvent):
            self.events.append(message)

    def stepped(self) -> None:
        """Nobody waits: time passes only while somebody looks."""

    def commanded(self, state: GroundState) -> None:
        """There is no disk to keep it on."""

    def _tick(self) -> None:
        self.node.tick()
        self._snapshot = self.node.snapshot

    def _wait(self, until: Until) -> bool:
        end_s = self.now_s + until.at_most_s
        while not until.condition(self._snapshot):
            if self.now_s >= end_s:
                return False
            self._schedule.run_until(min(end_s, self.now_s + SNAPSHOT_PERIOD_S))
        return True


class _Watchdog:
    """Nothing hangs on a simulated clock."""

    def feed(self, *, flying: bool) -> None:
        """Has nothing to watch."""

    def alive(self) -> bool:
        """Always."""
        return True


class _NoLog:
    """A recorder that keeps nothing."""

    recording = True

    def record(self, topic: str, unix_time_s: float, message: Mapping[str, object]) -> None:
        """Not kept."""


def _sensor_over(manifest: Manifest, text: str, source: str) -> WorldSensor:
    """A sensor over a world file's text."""
    perception, training = manifest.perception, manifest.training
    assert perception is not None  # Without it there is no layout.
    features = parse_world(text, source)
    importance = rasterize(
        features, perception.world_size, training.idf_truncation, training.idf_norm
    )
    return WorldSensor(importance, perception.sensor_size)
