"""A fleet of processes: vehicles, one `lpac robot run` for each, and a status subscriber."""

import math
import os
import signal
import time
from collections import deque
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from edge.core.counted import counted
from edge.robot.config import Rates
from lpac.sim.fleet.keys import write_keys
from lpac.sim.fleet.layout import WORLD, Layout, Settings
from lpac.sim.fleet.listener import FleetListener, Report
from lpac.sim.fleet.vehicles import SimulatedVehicles, Vehicles
from lpac.sim.ports import free_ports
from lpac.sim.programs import LpacProgram
from lpac.sim.scenario import Scenario
from lpac.sim.sitl.build import Px4Build

STOP_WITHIN_S = 3.0
# Lateness, s, within `_WHILE_S`, beyond which the robots' reports follow from the overload, and
# beyond which the flight ends.
DOUBTFUL_S = 1.5
OVERLOADED_S = 5.0
_WHILE_S = 20.0
_LOOK_AGAIN_S = 0.05


class SimulatedFleetError(ValueError):
    """A robot's program has ended; the text says which, and how."""


class Backlog(NamedTuple):
    """Lateness of a machine behind real time, s.

    `vehicles_s` is the vehicles' lateness, `robots_s` the time of the control ticks that the median
    robot has skipped.
    """

    vehicles_s: float
    robots_s: float


class OverloadError(RuntimeError):
    """This machine does not keep up; the text says how far it is behind, and what to do.

    `carried` is how many robots it can run; None if not measured.
    """

    def __init__(self, lateness: Backlog, robots: int, carried: int | None = None) -> None:
        fewer = robots // 2 if carried is None else max(1, min(robots - 1, carried))
        advice = f"fly fewer: -n {fewer}" if robots > 1 else "end other programs on it"
        super().__init__(
            f"this machine does not keep up with {counted(robots, 'robot')}: within {_WHILE_S:g} s "
            f"the vehicles fell {lateness.vehicles_s:.1f} s behind real time, the robots left out "
            f"{lateness.robots_s:.1f} s of control; {advice}"
        )


class Usage(NamedTuple):
    """Resources that a process has used: CPU time, s, and peak resident memory, MB."""

    cpu_s: float
    peak_memory_mb: float


class RobotProcess(LpacProgram):
    """One `lpac robot run`; `folder` holds robot.toml, robot.log (its output) and flight logs.

    `name` is the robot's name in commands.
    """

    def __init__(self, robot_id: int, folder: Path) -> None:
        super().__init__(
            folder / "robot.log", "robot", "run", "--config", str(folder / "robot.toml")
        )
        self.robot_id = robot_id
        self.name = f"r{robot_id}"
        self.folder = folder
        self._first_start_unix_s = math.inf

    def start(self) -> None:
        """Start the program, or restart it after it has ended."""
        if not math.isfinite(self._first_start_unix_s):
            self._first_start_unix_s = time.time()
            self.log.unlink(missing_ok=True)
        super().start()

    def kill_watchdog(self) -> None:
        """Kill the watchdog, the program's only child (kill -9)."""
        for children in Path(f"/proc/{self.pid}/task").glob("*/children"):
            for child in children.read_text().split():
                os.kill(int(child), signal.SIGKILL)

    def usage(self) -> Usage:
        """Resources used since the start; zero if the program has ended."""
        return process_usage(self.pid) if self.running else Usage(0.0, 0.0)

    def logs(self) -> list[Path]:
        """Flight logs since the first start, oldest first, without older ones in the folder."""
        return sorted(
            path
            for path in (self.folder / "logs").rglob("*.mcap")
            if path.stat().st_mtime >= self._first_start_unix_s
        )


def process_usage(pid: int) -> Usage:
    """Resources that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    ticks = int(fields[11]) + int(fields[12])
    status = Path(f"/proc/{pid}/status").read_text()
    peak_kb = next(
        (int(w[1]) for w in map(str.split, status.split("\n")) if w[:1] == ["VmHWM:"]), 0
    )
    return Usage(ticks / os.sysconf("SC_CLK_TCK"), peak_kb * 1024 / 1e6)


class Fleet:
    """Vehicles and robots, without a ground station: a context, in which all of them run.

    `robots[i]` is robot i's process, `listener` receives their statuses. `simulated` gives access
    to simulated vehicles; None for real PX4s. `endpoints` are the robots' zenoh addresses, `name`
    is the fleet's. `carried`, set by the caller, is how many robots this machine can run.
    `fleet_toml` describes the fleet to `lpac ground`, as if its robots were in the field.
    """

    def __init__(
        self,
        scenario: Scenario,
        folder: Path,
        bundle_path: Path,
        *,
        px4_build: Path | None = None,
        settings: Settings | None = None,
        report: Report = lambda _: None,
    ) -> None:
        """Prepare the fleet in `folder`: fleet.toml, world, a folder per robot. Starts nothing.

        With `px4_build` the vehicles are real PX4s of that build folder. `settings` are further
        keys of robot.toml's tables, for all robots.

        Raises ValueError if `px4_build` is no build, or there is too little room for the robots;
        BundleError for a bundle that cannot be loaded, or has no perception.
        """
        self.layout = Layout(scenario, bundle_path, without_vehicles=px4_build is not None)
        self.folder = folder.resolve()
        self.fleet_toml = self.folder / "fleet.toml"
        self.vehicles: Vehicles
        self.simulated: SimulatedVehicles | None = None
        if px4_build is None:
            self.vehicles = self.simulated = SimulatedVehicles(self.layout.vehicles)
        else:
            starts_m = [self.layout.to_world_m(pad_m) for pad_m in self.layout.pads_m]
            self.vehicles = Px4Build(px4_build, starts_m, WORLD, self.folder / "px4")
        *ports, group_port = free_ports(scenario.robots + 1)
        scheme = "tls" if scenario.secure else "tcp"
        self.endpoints = tuple(f"{scheme}/127.0.0.1:{port}" for port in ports)
        radio = {}
        if scenario.transport == "multicast":
            # A group of its own, so that it does not receive another fleet's datagrams.
            radio = {"transport": "multicast", "group": f"239.255.76.80:{group_port}"}
        self.name = f"sim-{ports[0]}"
        self.robots = tuple(
            RobotProcess(robot, self.folder / "robots" / str(robot))
            for robot in range(scenario.robots)
        )
        self.carried: int | None = None
        self._report = report
        keys = write_keys(self.folder, self.name, scenario.robots) if scenario.secure else None
        self.listener = FleetListener(
            fleet=self.name,
            connect=self.endpoints,
            identity=keys,
            report=self.report_unless_behind,
        )
        self._late_before = Backlog(0.0, 0.0)
        self._latenesses = deque([(-math.inf, self._late_before)])
        self._stack = ExitStack()
        self.layout.write(
            self.folder,
            self.name,
            {
                robot.name: {
                    "zenoh_port": port,
                    "system_id": autopilot.system_id,
                    "mavlink_url": autopilot.url,
                }
                for robot, port, autopilot in zip(
                    self.robots, ports, self.vehicles.autopilots, strict=True
                )
            },
            settings=settings,
            keys=True,
            radio=radio,
        )

    def __enter__(self) -> Self:
        """Start everything. Raises OSError or LinkError if a port is taken."""
        with ExitStack() as stack:
            stack.enter_context(self.vehicles)
            stack.enter_context(self.listener)
            stack.callback(self._stop_robots)
            for robot in self.robots:
                robot.start()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def require_running(self) -> None:
        """Raise SimulatedFleetError if the program of a robot has ended."""
        for robot in self.robots:
            if not robot.running:
                raise SimulatedFleetError(
                    f"the program of {robot.name} has ended, {robot.ending()}"
                )

    def begin(self) -> None:
        """Start to measure lateness, once all programs run."""
        self._late_before = self._lateness()
        self._latenesses = deque([(time.monotonic(), Backlog(0.0, 0.0))])

    def lateness(self) -> "Backlog":
        """Lateness since `begin`."""
        now, before = self._lateness(), self._late_before
        return Backlog(now.vehicles_s - before.vehicles_s, now.robots_s - before.robots_s)

    def require_keeping_up(self) -> None:
        """Raise OverloadError if this machine is too far behind."""
        recent = self._recent_lateness()
        if max(recent) > OVERLOADED_S:
            raise OverloadError(recent, self.layout.scenario.robots, self.carried)

    def _lateness(self) -> "Backlog":
        control_s = 1.0 / Rates().control_hz
        left_out_s = [
            control_s * status.loops["control"].overruns
            for status in self.listener.statuses().values()
            if "control" in status.loops
        ]
        return Backlog(self.vehicles.lost_s(), float(np.median(left_out_s or [0.0])))

    def report_unless_behind(self, text: str) -> None:
        """Report what robots do, unless it may follow from an overloaded machine."""
        if max(self._recent_lateness()) < DOUBTFUL_S:
            self._report(text)

    def _recent_lateness(self) -> "Backlog":
        """Lateness within the last `_WHILE_S`."""
        now_s, now = time.monotonic(), self.lateness()
        self._latenesses.append((now_s, now))
        while self._latenesses[0][0] < now_s - _WHILE_S:
            self._latenesses.popleft()
        before = self._latenesses[0][1]
        return Backlog(now.vehicles_s - before.vehicles_s, now.robots_s - before.robots_s)

    def forget(self) -> None:
        """Drop the history, which only the figures of a flight need."""
        self.listener.forget()
        self.vehicles.forget()

    def _stop_robots(self) -> None:
        running = [robot for robot in self.robots if robot.running]
        for robot in running:
            robot.terminate()
        until_s = time.monotonic() + STOP_WITHIN_S
        for robot in running:
            if robot.wait(max(0.0, until_s - time.monotonic())) is None:
                self._report(f"{robot.name} did not end within {STOP_WITHIN_S:g} s: killed")
                robot.kill()
