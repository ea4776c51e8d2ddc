"""A whole fleet on this machine: vehicles, one `lpac robot run` process each, and an operator."""

import math
import os
import signal
import subprocess
import time
from collections import deque
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np

from edge.core import F64
from edge.core.frames import LocalTransform
from edge.core.world import Feature, format_world, random_features
from edge.flight.margins import places_apart
from edge.messages.mission import Origin
from edge.policy.bundle import BundleError, load_bundle
from edge.robot.config import Rates
from lpac.fleet.settings import Places
from lpac.fleet.writer import write_fleet, write_robot
from lpac.sim.description import ERRORS, fence_around, robot_table
from lpac.sim.experiment import FIELD_SCALE
from lpac.sim.fleet.vehicles import SimulatedVehicles, Vehicles
from lpac.sim.operator import Operator, Say
from lpac.sim.ports import free_ports
from lpac.sim.programs import python_program
from lpac.sim.px4.errors import Errors
from lpac.sim.px4.vehicle import Px4Vehicle
from lpac.sim.px4.world import WorldOrigin
from lpac.sim.sitl.build import Px4Build

MAX_ROBOTS = 20
STOP_WITHIN_S = 3.0
# Once a machine fell so far behind real time within a while, what robots say of themselves follows
# from that; and then a flight is over.
DOUBTFUL_S = 1.5
OVERLOADED_S = 5.0
_WHILE_S = 20.0

# The field is the policy's world; its y axis does not point north, so that mistakes show.
WORLD = WorldOrigin()
ORIGIN = Origin(WORLD.latitude_deg, WORLD.longitude_deg, heading_deg=30.0)

# Pads, which are landing points too.
APART_M = places_apart(ERRORS.position_m, ERRORS.position_m).least_m
# As far inside the field as there is room: what a robot takes its place to be walks.
_PADS_INSIDE_FIELD_M = (2.0, 1.0, 0.0)
# How often pads are drawn anew, and pushed apart, before there is no room for them.
_PAD_DRAWS = 30
_PAD_PUSHES = 300
# What rounding and the last push may leave.
_PAD_SLACK = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetScenario:
    """A flight of a fleet; everything random in it but the timing follows from `seed`.

    The world is that of a `lpac.sim.experiment.Scenario` with the same seed. Without `errors` the
    simulated vehicles' estimates are off by noise alone, and the air stands still.

    Raises ValueError that names what is impossible.
    """

    robots: int = 10
    seed: int = 0
    duration_s: float = 60.0
    features: tuple[Feature, ...] | None = None
    random_feature_count: int = 10
    errors: bool = True

    def __post_init__(self) -> None:
        if not 1 <= self.robots <= MAX_ROBOTS:
            raise ValueError(f"robots = {self.robots}: must be from 1 to {MAX_ROBOTS}")
        if self.seed < 0:
            raise ValueError(f"seed = {self.seed}: must be at least 0")
        if not 0.0 < self.duration_s < math.inf:
            raise ValueError(f"duration = {self.duration_s}: must be positive and finite")
        if self.random_feature_count < 0:
            raise ValueError(f"features = {self.random_feature_count}: must be at least 0")


class SimulatedFleetError(ValueError):
    """A robot's program has ended; the text says which, and its last words."""


class Backlog(NamedTuple):
    """How far a machine is behind real time, s.

    `vehicles_s` is what the vehicles fell behind, `robots_s` the time of the control ticks that a
    robot has left out, the median of all robots.
    """

    vehicles_s: float
    robots_s: float


class OverloadError(RuntimeError):
    """This machine does not keep up; the text says how far it is behind, and what to do.

    `carried` is how many robots it was found to carry, None if nobody looked.
    """

    def __init__(self, lateness: Backlog, robots: int, carried: int | None = None) -> None:
        fewer = robots // 2 if carried is None else max(1, min(robots - 1, carried))
        advice = f"fly fewer: -n {fewer}" if robots > 1 else "end what else runs on it"
        super().__init__(
            f"this machine does not keep up with {robots} robots: within {_WHILE_S:g} s the "
            f"vehicles fell {lateness.vehicles_s:.1f} s behind real time, the robots left out "
            f"{lateness.robots_s:.1f} s of control; {advice}"
        )


class Usage(NamedTuple):
    """What a process took so far: processor time, s, and its greatest resident memory, MB."""

    cpu_s: float
    peak_memory_mb: float


class RobotProcess:
    """One `lpac robot run`; `folder` holds robot.toml, what it prints (robot.log), its flight log.

    `name` is what people call the robot; `running` tells whether it has not ended yet.
    """

    def __init__(self, robot_id: int, folder: Path) -> None:
        self.robot_id = robot_id
        self.name = f"r{robot_id}"
        self.folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        self._first_start_unix_s = math.inf

    def start(self) -> None:
        """Start the program, also again after it has ended."""
        first = self._process is None
        if first:
            self._first_start_unix_s = time.time()
        with (self.folder / "robot.log").open("wb" if first else "ab") as output:
            self._process = subprocess.Popen(
                python_program("lpac.cli.main", "robot", "run",
                               "--config", str(self.folder / "robot.toml")),
                stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                # Ctrl-C is for the launcher alone, which lands the vehicles first.
                process_group=0,
            )  # fmt: skip

    @property
    def running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    @property
    def pid(self) -> int:
        """Raises RuntimeError if the program was never started."""
        if self._process is None:
            raise RuntimeError(f"robot {self.robot_id} was not started")
        return self._process.pid

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal; nothing happens if the program has ended."""
        if self._process is not None:
            self._process.send_signal(number)

    def wait(self, timeout_s: float) -> int | None:
        """The exit code once the program has ended, None if it has not within the time."""
        assert self._process is not None
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def usage(self) -> Usage:
        """Nothing if the program has ended."""
        return process_usage(self.pid) if self.running else Usage(0.0, 0.0)

    def logs(self) -> list[Path]:
        """The flight logs of these starts, the oldest first; the folder may have older ones."""
        return sorted(
            path
            for path in (self.folder / "logs").rglob("*.mcap")
            if path.stat().st_mtime >= self._first_start_unix_s
        )

    def ending(self) -> str:
        """How the program has ended, in words; with the last line that it printed, if by itself."""
        code = self.wait(0.0)
        if code is not None and code < 0:
            return f"by {signal.Signals(-code).name}"
        log = self.folder / "robot.log"
        lines = log.read_text(errors="replace").split("\n") if log.exists() else []
        last = next((line for line in reversed(lines) if line.strip()), "it printed nothing")
        return f"exit code {code}: {last}"


def process_usage(pid: int) -> Usage:
    """What a process of this machine took so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    ticks = int(fields[11]) + int(fields[12])
    status = Path(f"/proc/{pid}/status").read_text()
    peak_kb = next(
        (int(w[1]) for w in map(str.split, status.split("\n")) if w[:1] == ["VmHWM:"]), 0
    )
    return Usage(ticks / os.sysconf("SC_CLK_TCK"), peak_kb * 1024 / 1e6)


class Fleet:
    """Vehicles, robots and an operator: a context, in which all of them run.

    `robots[i]` is robot i's process, `operator` speaks to all. `simulated` are the vehicles
    themselves, for whoever wants to do something to them; None where they are real PX4.
    `pads_m` (N, 2) is where they really stand, `landing_points_m` (N, 2) where they return to, both
    in the mission frame. `endpoints` are the robots' zenoh addresses, `name` the fleet's. `carried`
    is how many robots this machine was found to carry; who finds it out says so.
    `fleet_toml` describes the fleet to `lpac ground`, as if its robots were in the field.
    """

    def __init__(
        self,
        scenario: FleetScenario,
        folder: Path,
        bundle_path: Path,
        *,
        px4_build: Path | None = None,
        say: Say = lambda _: None,
    ) -> None:
        """Prepare the fleet in `folder`: fleet.toml, world, a folder per robot. Starts nothing.

        With `px4_build` the vehicles are real PX4s of that build folder.

        Raises ValueError if that one is no build, or there is no room for so many robots;
        BundleError for a bundle that cannot be loaded, or has no perception.
        """
        self.bundle = load_bundle(bundle_path)
        perception, training = self.bundle.manifest.perception, self.bundle.manifest.training
        if perception is None:
            raise BundleError(f"{bundle_path}: the bundle has no perception: it cannot fly")
        self.scenario = scenario
        self._bundle_path = bundle_path.resolve()
        self.folder = folder.resolve()
        self.fleet_toml = self.folder / "fleet.toml"
        self.field_m = perception.world_size / FIELD_SCALE.env_scale
        self.max_speed_m_s = training.max_speed * FIELD_SCALE.velocity_scale
        self.to_mission: LocalTransform = ORIGIN.frame().relative_to(
            WORLD.latitude_deg, WORLD.longitude_deg
        )
        self.fence = fence_around(self.field_m, scenario.robots)
        self.features = scenario.features
        if self.features is None:
            self.features = random_features(
                # The first of the children that sim.experiment draws from.
                np.random.default_rng(np.random.SeedSequence(scenario.seed).spawn(1)[0]),
                scenario.random_feature_count,
                perception.world_size,
            )
        self.vehicles: Vehicles
        self.simulated: SimulatedVehicles | None = None
        if px4_build is None:
            self.pads_m, self.landing_points_m, drawn = self._draw_vehicles()
            self.vehicles = self.simulated = SimulatedVehicles(drawn)
        else:
            self.pads_m = self.landing_points_m = self._draw_pads(np.zeros((scenario.robots, 2)))
            self.vehicles = Px4Build(
                px4_build, [self._to_world_m(pad_m) for pad_m in self.pads_m], WORLD,
                self.folder / "px4",
            )  # fmt: skip
        ports = free_ports(scenario.robots)
        self.endpoints = tuple(f"tcp/127.0.0.1:{port}" for port in ports)
        self.name = f"sim-{ports[0]}"
        self.robots = tuple(
            RobotProcess(robot, self.folder / "robots" / str(robot))
            for robot in range(scenario.robots)
        )
        self.carried: int | None = None
        self._say = say
        self.operator = Operator(
            fleet=self.name, connect=self.endpoints, say=self.say_unless_behind
        )
        self._late_before = Backlog(0.0, 0.0)
        self._latenesses = deque([(-math.inf, self._late_before)])
        self._stack = ExitStack()
        self._write_files()

    def __enter__(self) -> Self:
        """Start everything. Raises OSError or LinkError if a port is taken."""
        with ExitStack() as stack:
            stack.enter_context(self.vehicles)
            stack.enter_context(self.operator)
            stack.callback(self._stop_robots)
            for robot in self.robots:
                robot.start()
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stack.__exit__(kind, error, traceback)

    def require_running(self) -> None:
        """Raises FleetError if the program of a robot has ended."""
        for robot in self.robots:
            if not robot.running:
                raise SimulatedFleetError(
                    f"the program of robot {robot.robot_id} has ended, {robot.ending()}"
                )

    def begin(self) -> None:
        """All programs run: from now on this machine has to keep up."""
        self._late_before = self._lateness()
        self._latenesses = deque([(time.monotonic(), Backlog(0.0, 0.0))])

    def lateness(self) -> "Backlog":
        """How far this machine fell behind since `begin`."""
        now, before = self._lateness(), self._late_before
        return Backlog(now.vehicles_s - before.vehicles_s, now.robots_s - before.robots_s)

    def require_keeping_up(self) -> None:
        """Raises OverloadError if this machine is too far behind."""
        recent = self._recent_lateness()
        if max(recent) > OVERLOADED_S:
            raise OverloadError(recent, self.scenario.robots, self.carried)

    def _lateness(self) -> "Backlog":
        control_s = 1.0 / Rates().control_hz
        left_out_s = [
            control_s * status.loops["control"].overruns
            for status in self.operator.statuses().values()
            if "control" in status.loops
        ]
        return Backlog(self.vehicles.lost_s(), float(np.median(left_out_s or [0.0])))

    def say_unless_behind(self, text: str) -> None:
        """Say what robots do; nothing once it follows from a machine that is behind."""
        if max(self._recent_lateness()) < DOUBTFUL_S:
            self._say(text)

    def _recent_lateness(self) -> "Backlog":
        """How far this machine fell behind lately."""
        now_s, now = time.monotonic(), self.lateness()
        self._latenesses.append((now_s, now))
        while self._latenesses[0][0] < now_s - _WHILE_S:
            self._latenesses.popleft()
        before = self._latenesses[0][1]
        return Backlog(now.vehicles_s - before.vehicles_s, now.robots_s - before.robots_s)

    def forget(self) -> None:
        """Keep nothing of the past, which only grows, and which a flight's figures alone need."""
        self.operator.forget()
        self.vehicles.forget()

    def true_positions_m(self) -> F64:
        """Where simulated vehicles really are: the mission frame, (N, 3)."""
        assert self.simulated is not None
        with self.simulated.stepped:
            world_m = [vehicle.position_m for vehicle in self.simulated.vehicles]
        return np.array([self.to_mission.local_to_mission(place_m) for place_m in world_m])

    def _stop_robots(self) -> None:
        running = [robot for robot in self.robots if robot.running]
        for robot in running:
            robot.send_signal(signal.SIGTERM)
            robot.send_signal(signal.SIGCONT)
        until_s = time.monotonic() + STOP_WITHIN_S
        for robot in running:
            if robot.wait(max(0.0, until_s - time.monotonic())) is None:
                self._say(f"robot {robot.robot_id} did not end within {STOP_WITHIN_S:g} s: killed")
                robot.send_signal(signal.SIGKILL)
                robot.wait(STOP_WITHIN_S)

    # Where everything stands

    def _draw_vehicles(self) -> tuple[F64, F64, list[Px4Vehicle]]:
        """Pads, landing points, vehicles. A robot lands where it takes its own pad to be."""
        robots = self.scenario.robots
        seeds = np.random.SeedSequence([self.scenario.seed, robots]).generate_state(robots).tolist()
        # Both places of a vehicle and its pad: a vehicle's bias is drawn before it has a place.
        biases_m = np.zeros((robots, 2))
        if self.scenario.errors:
            biases_m = np.array([self._horizontal(Px4Vehicle(seed=s).gps_bias_m) for s in seeds])
        pads_m = self._draw_pads(biases_m)
        headings_rad = np.random.default_rng(seeds).uniform(0.0, math.tau, robots).tolist()
        vehicles = []
        for seed, pad_m, heading_rad in zip(seeds, pads_m, headings_rad, strict=True):
            north_m, east_m = self._to_world_m(pad_m)
            vehicle = Px4Vehicle(
                seed=seed, start_m=(north_m, east_m), heading_rad=heading_rad, origin=WORLD,
                errors=Errors(seed, self.scenario.seed) if self.scenario.errors else None,
            )  # fmt: skip
            if not self.scenario.errors:
                vehicle.gps_bias_m = np.zeros(3)
            vehicles.append(vehicle)
        return pads_m, pads_m + biases_m, vehicles

    def _draw_pads(self, biases_m: F64) -> F64:
        """Pads (N, 2) apart from each other, both in truth and as the robots see them."""
        rng = np.random.default_rng([self.scenario.seed, 1])
        robots, field_m = len(biases_m), self.field_m
        for inside_m in _PADS_INSIDE_FIELD_M:
            pads_m = _pads_apart(biases_m, inside_m, field_m - inside_m, rng)
            if pads_m is not None:
                return pads_m
        fit = next(
            fewer
            for fewer in range(robots - 1, 0, -1)
            if _pads_apart(biases_m[:fewer], 0.0, field_m, rng) is not None
        )
        raise ValueError(
            f"robots = {robots}: {fit} fit on {field_m:g} x {field_m:g} m, with pads {APART_M:g} m "
            "apart, which is twice the position error"
        )

    def _horizontal(self, vector_m: F64) -> F64:
        """A vector (3,) of the world, along the mission axes: (2,)."""
        turned: F64 = self.to_mission.velocity_to_mission(vector_m)[:2]
        return turned

    def _to_world_m(self, place_m: F64) -> tuple[float, float]:
        """North and east, m, of a place (2,) of the mission frame."""
        north_m, east_m, _ = self.to_mission.mission_to_local(np.array([*place_m, 0.0])).tolist()
        return north_m, east_m

    # What the robots and the ground read

    def _write_files(self) -> None:
        assert self.features is not None
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "world.env").write_text(format_world(self.features))
        config = write_fleet(
            self.fleet_toml,
            "Made by `lpac sim`: the robots are programs of this machine, without image or SSH.",
            self._description(),
        )
        places = Places(str(self._bundle_path), "../../world.env", "logs", "127.0.0.1")
        for robot in self.robots:
            write_robot(robot.folder / "robot.toml", config, robot.name, places)

    def _description(self) -> dict[str, object]:
        """fleet.toml. No computer has such a host name, so that nobody deploys to this machine."""
        return {
            "fleet": self.name,
            "image": "none",
            "bundle": str(self._bundle_path),
            "world": "world.env",
            "robot": robot_table(self.fence, self.max_speed_m_s),
            "robots": {
                robot.name: {
                    "host": f"{robot.name}.invalid",
                    "address": "127.0.0.1",
                    "zenoh_port": int(endpoint.rpartition(":")[2]),
                    "robot_id": robot.robot_id,
                    "system_id": autopilot.system_id,
                    "mavlink_url": autopilot.url,
                }
                for robot, endpoint, autopilot in zip(
                    self.robots, self.endpoints, self.vehicles.autopilots, strict=True
                )
            },
            "slots": [
                {
                    "robot": robot.name,
                    "height": robot.robot_id,
                    "pad_m": self._pad_seen_m(robot.robot_id),
                    "landing_point_m": self._pad_seen_m(robot.robot_id),
                }
                for robot in self.robots
            ],
        }

    def _pad_seen_m(self, robot: int) -> list[float]:
        """Where a robot takes its pad to be: mission frame, m."""
        return [round(c, 3) for c in self.landing_points_m[robot].tolist()]


def _pads_apart(biases_m: F64, low_m: float, high_m: float, rng: np.random.Generator) -> F64 | None:
    """Places (N, 2) within a square, `APART_M` from each other, and so with the biases added.

    Drawn in the cells of a grid, then pushed apart; None if they find no room.
    """
    robots = len(biases_m)
    side = math.ceil(math.sqrt(robots))
    lowest_m, highest_m = np.maximum(low_m, low_m - biases_m), np.minimum(high_m, high_m - biases_m)
    truth_and_seen_m = np.stack([np.zeros_like(biases_m), biases_m])
    wanted_m = APART_M * (1.0 + _PAD_SLACK)
    for _ in range(_PAD_DRAWS):
        cells = np.stack(np.divmod(rng.permutation(side * side)[:robots], side), axis=1)
        jittered = cells + rng.uniform(0.0, 1.0, (robots, 2))
        places_m = low_m + jittered * ((high_m - low_m) / side)
        for _ in range(_PAD_PUSHES):
            places_m = np.clip(places_m, lowest_m, highest_m)
            all_m = truth_and_seen_m + places_m
            offsets_m = all_m[:, :, None] - all_m[:, None]
            distances_m = np.linalg.norm(offsets_m, axis=3)
            distances_m[:, range(robots), range(robots)] = math.inf
            if distances_m.min() >= APART_M * (1.0 + _PAD_SLACK / 2.0):
                return places_m
            shares = np.maximum(wanted_m - distances_m, 0.0) / np.maximum(distances_m, 1e-9)
            # Less than half of what is missing for either of two: crowds come to rest so.
            places_m = places_m + 0.35 * (offsets_m * shares[..., None]).sum(axis=(0, 2))
    return None
