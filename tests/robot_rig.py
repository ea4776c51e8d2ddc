"""One robot's program as a real process, its vehicle, and the ground that commands it."""

import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from edge.messages.codes import Refusal, RefusalCode
from edge.messages.mission import FlightState, OrderKind, Origin, RobotStatus
from edge.robot.config import RobotConfig, load_config
from lpac.analysis.worlds import format_world, random_features
from lpac.fleet.writer import write_fleet
from lpac.ground.station.client import GroundError
from lpac.ground.station.client import command as ground_command
from lpac.ground.station.protocol import (
    CommandReport,
    Enable,
    Request,
    ResultCode,
    Resume,
    SafetyCommand,
    SetOrigin,
    TakeCommand,
    Takeoff,
)
from lpac.sim.fleet.ground import GroundProgram
from lpac.sim.fleet.listener import FleetListener
from lpac.sim.ports import free_ports
from lpac.sim.px4.link import Px4Link
from lpac.sim.px4.server import Instance, Px4Server
from lpac.sim.px4.vehicle import Px4Vehicle
from lpac.sim.px4.world import WorldOrigin
from tests.conftest import ROOT, SHIPPED
from tests.raw_ground import RawGround

SYSTEM_ID = 7
ROBOT_ID, NAME = 3, "r3"
OPERATOR = "test"
# The mission's y axis does not point north, and the vehicle does not stand on its origin.
ORIGIN = Origin(WorldOrigin().latitude_deg, WorldOrigin().longitude_deg, heading_deg=30.0)
PAD_M = (12.0, 10.0)
# Where nobody sits.
FREE_PAD_M = (24.0, 24.0)
# Why a robot refuses for a moment: this machine held it up, a command is still on its way, or its
# program has just begun and not listened for long enough.
HELD_UP = (
    RefusalCode.CONTROL_SILENT,
    RefusalCode.CHECKS_RUNNING,
    RefusalCode.NOT_READY,
    RefusalCode.POSITION_NOT_GOOD,
    RefusalCode.PLACE_NOT_KNOWN,
    RefusalCode.GROUND_COMMANDS,
    RefusalCode.GROUND_NOT_HEARD,
    RefusalCode.NOT_IN_OFFBOARD,
    RefusalCode.NOT_ANSWERED,
    RefusalCode.EXPIRED,
)

# What a command fails for a moment for: the robot was out of reach.
NOT_YET = (ResultCode.NOT_HEARD, ResultCode.NOT_OBEYING)
MOST_TAKEOFFS = 10

Changes = dict[str, dict[str, Any]]


def new_vehicle(**parameters: float) -> Px4Vehicle:
    """Ready at once, quick to take off, with failsafe parameters that no robot may fly with."""
    transform = ORIGIN.frame().relative_to(ORIGIN.latitude_deg, ORIGIN.longitude_deg)
    north_m, east_m, _ = transform.mission_to_local(np.array([*PAD_M, 0.0])).tolist()
    vehicle = Px4Vehicle(seed=1, start_m=(north_m, east_m), ready_after_s=0.0)
    vehicle.gps_bias_m = (0.0, 0.0, 0.0)
    vehicle.parameters |= {"COM_SPOOLUP_TIME": 0.0, "MPC_TKO_RAMP_T": 0.0, **parameters}
    vehicle.parameters |= {"MPC_LAND_SPEED": 1.5, "COM_DISARM_LAND": 0.5}
    return vehicle


def write_config(folder: Path, *, url: str, endpoint: str, changes: Changes | None = None) -> Path:
    """robot.toml in `folder`, and its world; `changes` are further keys of its tables."""
    world = random_features(np.random.default_rng(0), 10, 512)
    (folder / "world.env").write_text(format_world(world))
    tables: Changes = {
        "policy": {"bundle": str(SHIPPED), "world": "world.env"},
        "autopilot": {"url": url, "system_id": SYSTEM_ID},
        "link": {"listen": [endpoint]},
        "flight": {"slot": 0, "base_height_m": 5.0, "landing_point_m": list(PAD_M)},
        "fence": {
            "vertices_m": [[-2.0, -2.0], [34.0, -2.0], [34.0, 34.0], [-2.0, 34.0]],
            "buffer_m": 1.5, "floor_m": 2.0, "ceiling_m": 20.0,
        },
        "limits": {
            "max_speed_m_s": 1.25, "max_climb_m_s": 2.0, "max_acceleration_m_s2": 2.0, "lag_s": 1.3,
        },
        "failsafe": {"rc": "none", "parameters": "set"},
    }  # fmt: skip
    top = {"fleet": f"test-{endpoint.rpartition(':')[2]}", "robot_id": ROBOT_ID}
    for name, keys in (changes or {}).items():
        if name == "":
            top |= keys
        else:
            tables[name] = tables.get(name, {}) | keys
    path = folder / "robot.toml"
    path.write_text(tomlkit.dumps(top | tables))
    return path


def write_fleet_of(config_path: Path, config: RobotConfig) -> Path:
    """fleet.toml beside robot.toml: the same robot, as its ground needs to know it."""
    tables = tomlkit.parse(config_path.read_text()).unwrap()
    port = int(config.link.listen[0].rpartition(":")[2])
    robot = {name: keys for name, keys in tables.items() if isinstance(keys, dict)}
    autopilot = robot.pop("autopilot")
    for elsewhere in ("link", "log"):
        robot.pop(elsewhere, None)
    for keys in (("policy", "bundle"), ("policy", "world"), ("flight", "slot"),
                 ("flight", "landing_point_m")):  # fmt: skip
        robot[keys[0]].pop(keys[1], None)
    path = config_path.with_name("fleet.toml")
    slots = [
        {"height": height, "pad_m": list(pad_m), "landing_point_m": list(pad_m)}
        for height, pad_m in enumerate((PAD_M, FREE_PAD_M))
    ]
    slots[0]["robot"] = NAME
    host = {
        "host": "r3.invalid", "address": "127.0.0.1", "robot_id": ROBOT_ID, "zenoh_port": port,
        "system_id": autopilot["system_id"], "mavlink_url": autopilot["url"],
    }  # fmt: skip
    write_fleet(
        path,
        "One robot of a test.",
        {
            "fleet": config.fleet, "image": "none", "bundle": config.policy.bundle,
            "world": config.policy.world, "robot": robot, "robots": {NAME: host}, "slots": slots,
        },
    )  # fmt: skip
    return path


class Rig:
    """A vehicle that runs, a ground that is heard, and the robot's configuration.

    `listener` has the statuses of the robot, whoever commands it.
    """

    def __init__(self, config_path: Path, server: Px4Server, links: Sequence[Px4Link]) -> None:
        self.config_path = config_path
        self.config: RobotConfig = load_config(config_path)
        self.server = server
        self.link = links[0]
        self.vehicle = links[0].vehicle
        self.listener = FleetListener(fleet=self.config.fleet, connect=self.config.link.listen)
        self.stack = ExitStack()
        self._ground: GroundProgram | None = None

    @property
    def ground(self) -> GroundProgram:
        """Its `lpac ground`, which runs from now on."""
        if self._ground is None:
            fleet_toml = write_fleet_of(self.config_path, self.config)
            program = GroundProgram(fleet_toml, self.config.fleet, OPERATOR)
            self._ground = self.stack.enter_context(program)
        return self._ground

    @property
    def status(self) -> RobotStatus:
        """The robot's newest."""
        return self.listener.history(ROBOT_ID)[-1].status

    def wait(
        self, condition: Callable[[RobotStatus], object], timeout_s: float = 180.0
    ) -> RobotStatus:
        """Until the robot says so; what it says then."""
        found: list[RobotStatus] = []

        def is_so(statuses: Mapping[int, RobotStatus]) -> bool:
            found[:] = [statuses[ROBOT_ID]] if ROBOT_ID in statuses else []
            return bool(found and condition(found[0]))

        assert self.listener.wait_for(is_so, timeout_s), found
        return found[0]

    def wait_for_state(self, state: FlightState) -> None:
        self.wait(lambda status: status.state is state)

    def command(self, request: Request) -> CommandReport:
        """Command something that is possible as such; the robot may not do it."""
        report = self.ground.command(request)
        assert report.problem is None, report
        return report

    def do(self, request: Request) -> None:
        """Command it; it must be done, but for what lasts a moment."""
        until_s = time.monotonic() + 60.0
        while not (report := self.command(request)).done:
            (result,) = report.results
            for_a_moment = result.refusal in HELD_UP or result.code in NOT_YET
            assert for_a_moment and time.monotonic() < until_s, report
        if isinstance(request, TakeCommand):
            # The robot is heard here by a link of its own, which may be behind the ground's.
            self.wait(lambda status: status.operator == OPERATOR)

    def tell(self, request: Request) -> None:
        """Command it, and do not wait for what comes of it."""

        def command() -> None:
            with suppress(GroundError):  # The test is over.
                ground_command(self.config.fleet, request)

        fleet = self.ground.fleet
        assert fleet == self.config.fleet
        threading.Thread(target=command, daemon=True).start()

    def refusal(self, kind: OrderKind) -> Refusal | None:
        """Why the robot refuses an order, which its ground may not even give; None: it obeys."""
        # Who is silent just now cannot be ordered anything.
        status = self.wait(lambda _: True)
        with RawGround(self.config.fleet, self.config.link.listen, self.listener) as raw:
            return raw.order(kind, status).refusal

    def enable(self) -> None:
        """Origin, and its checks; whatever was commanded before is withdrawn."""
        self.command(SetOrigin(ORIGIN))
        told = self.ground.subscriber.snapshot.ground
        if told is not None and told.safety_action != "none":
            self.command(Resume())
        self.tell(Enable())

    def take_off(self) -> None:
        """Until it holds at its height; after a takeoff that this machine held up, once more."""
        for _ in range(MOST_TAKEOFFS):
            self.enable()
            self.wait(lambda status: status.ready)
            report = self.command(Takeoff())
            if report.done:
                return
            if self.status.state is FlightState.HOLD:
                self.do(SafetyCommand("land", wait=True))
        raise AssertionError(report)

    def vehicle_is(
        self, condition: Callable[[Px4Vehicle], object], timeout_s: float = 60.0
    ) -> bool:
        """Wait until the vehicle itself is so; whether it came to be."""
        return self.server.wait_for(lambda: bool(condition(self.vehicle)), timeout_s)


@contextmanager
def rig(
    folder: Path, vehicle: Px4Vehicle, *others: Px4Link, changes: Changes | None = None
) -> Iterator[Rig]:
    """A rig in `folder`; `others` speak on the same link as the vehicle."""
    links = (Px4Link(vehicle, system_id=SYSTEM_ID), *others)
    client_port, port = free_ports(2)
    endpoint = f"tcp/127.0.0.1:{port}"
    path = write_config(
        folder, url=f"udpin://127.0.0.1:{client_port}", endpoint=endpoint, changes=changes
    )
    with Px4Server([Instance(link, 0, client_port) for link in links]) as server:
        made = Rig(path, server, links)
        with made.listener, made.stack:
            yield made


class Program:
    """A robot's program, as a process; it prints to `log`, or to a descriptor."""

    def __init__(self, config_path: Path, arguments: Sequence[str], output: int | None) -> None:
        self.log = config_path.with_suffix(".log")
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                arguments, env=environment(),
                stdin=subprocess.DEVNULL, stdout=output or log, stderr=subprocess.STDOUT,
            )  # fmt: skip

    def end(self, number: signal.Signals) -> int:
        """Send the signal; the exit code."""
        self.process.send_signal(number)
        return self.process.wait(60.0)


@contextmanager
def program(
    made: Rig, arguments: Sequence[str] = (), output: int | None = None
) -> Iterator[Program]:
    """`lpac robot run`, or another command line; it is killed in the end if it still runs."""
    default = command("run", "--config", str(made.config_path))
    running = Program(made.config_path, arguments or default, output)
    try:
        yield running
    finally:
        running.process.kill()
        running.process.wait()


def lpac_robot(*arguments: object) -> subprocess.CompletedProcess[str]:
    """`lpac robot ...` until it ends."""
    return subprocess.run(
        command(*map(str, arguments)), env=environment(),
        capture_output=True, text=True, timeout=180.0, check=False,
    )  # fmt: skip


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "lpac.cli.main", "robot", *arguments]


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200"}


def horizontal_speed_m_s(vehicle: Px4Vehicle) -> float:
    return math.hypot(*vehicle.velocity_m_s[:2])
