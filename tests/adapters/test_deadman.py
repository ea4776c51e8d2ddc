"""The watchdog: a vehicle whose program hangs holds, and one whose program died lands."""

import math
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest
from pymavlink.dialects.v20 import common as mavlink

from edge.adapters.deadman import Deadman, DeadmanError, _hold_command
from sim.px4.link import Px4Link
from sim.px4.modes import Mode
from sim.px4.server import Instance, Px4Server
from sim.px4.vehicle import Px4Vehicle
from tests.conftest import ROOT
from tests.sim.test_px4 import free_port

PROGRAM = """
import ctypes, logging, sys, time
import structlog
from edge.adapters.deadman import Deadman
from edge.adapters.mavsdk_autopilot import MavsdkAutopilot
from edge.core.vehicle import Action, Mode, Velocity

structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
port, system_id, way = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]

def fly(velocity, until, action=None):
    while not until(autopilot.state()):
        if action is not None:
            autopilot.command(action)  # until it is so: a busy machine may have missed the answer
        autopilot.send(Velocity(velocity))
        deadman.feed(flying=True)
        time.sleep(0.1)

with (
    MavsdkAutopilot(f"udpin://127.0.0.1:{port}", system_id=system_id) as autopilot,
    Deadman(port, system_id, 0.5) as deadman,
):
    while not autopilot.state().armable:
        time.sleep(0.05)
    fly((0.0, 0.0, -2.0), lambda s: s.armed, Action.ARM)
    fly((0.0, 0.0, -2.0), lambda s: s.mode is Mode.OFFBOARD, Action.OFFBOARD)
    fly((0.0, 0.0, -2.0), lambda s: s.height_above_home_m > 1.5)
    fly((1.0, 0.0, 0.0), lambda s: s.velocity_local_m_s[0] > 0.9)
    print("flying", flush=True)
    if way == "interpreter":
        ctypes.PyDLL(None).sleep(600)  # holds the GIL
    if way == "loop":
        time.sleep(600)
    fly((1.0, 0.0, 0.0), lambda _: False)
"""


@contextmanager
def program(port: int, system_id: int, way: str) -> Iterator[subprocess.Popen[str]]:
    arguments = [sys.executable, "-c", PROGRAM, str(port), str(system_id), way]
    with subprocess.Popen(arguments, cwd=ROOT, stdout=subprocess.PIPE, text=True) as running:
        try:
            yield running
        finally:
            running.kill()


def test_a_program_that_hangs_lets_the_vehicle_hold_and_one_that_dies_lets_it_land() -> None:
    ways = {"process": Mode.HOLD, "interpreter": Mode.HOLD, "loop": Mode.HOLD, "killed": Mode.LAND}
    ports = [free_port() for _ in ways]
    vehicles = []
    for seed, _ in enumerate(ways, 1):
        vehicle = Px4Vehicle(seed=seed, ready_after_s=0.0)
        vehicle.parameters |= {"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 4}
        vehicles.append(vehicle)
    instances = [
        Instance(Px4Link(vehicle, system_id=number), 0, port)
        for number, (vehicle, port) in enumerate(zip(vehicles, ports, strict=True), 1)
    ]
    with Px4Server(instances) as server, ExitStack() as stack:
        programs = [
            stack.enter_context(program(port, number, way))
            for number, (port, way) in enumerate(zip(ports, ways, strict=True), 1)
        ]
        for each in programs:
            assert each.stdout is not None
            assert each.stdout.readline() == "flying\n"
        programs[0].send_signal(signal.SIGSTOP)
        programs[3].kill()
        with server.stepped:
            stopped_s = vehicles[0].time_s
        assert server.wait_for(lambda: vehicles[0].time_s > stopped_s + 5.0, 60.0)
    for (way, mode), vehicle in zip(ways.items(), vehicles, strict=True):
        silent_s = vehicle._setpoint_at_s
        later = next(truth for truth in vehicle.truth if truth.time_s > silent_s + 4.0)
        assert later.mode is mode, way
        # Horizontally at rest 1.5 s after the last command, and then at rest altogether or landing.
        after = [truth for truth in vehicle.truth if truth.time_s > silent_s + 1.5]
        assert len(after) > 50
        for truth in after:
            axes = 2 if way == "killed" else 3
            assert math.hypot(*truth.velocity_m_s[:axes]) < 0.2, (way, truth)


@pytest.fixture
def sockets() -> Iterator[tuple[socket.socket, socket.socket]]:
    """The program's socket, and the autopilot's, which has sent it something."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot,
    ):
        own.bind(("127.0.0.1", 0))
        autopilot.bind(("127.0.0.1", 0))
        autopilot.settimeout(60.0)
        autopilot.sendto(b"heartbeat", own.getsockname())
        yield own, autopilot


def test_silence_after_flying_is_answered_once_with_hold(
    sockets: tuple[socket.socket, socket.socket],
) -> None:
    own, autopilot = sockets
    with Deadman(own.getsockname()[1], system_id=7, timeout_s=0.3) as deadman:
        assert deadman.alive()
        deadman.feed(flying=True)
        frames = [autopilot.recv(300) for _ in range(3)]
        assert own.recv(300) == b"heartbeat"  # still there for the program to read
        autopilot.settimeout(0.7)
        with pytest.raises(TimeoutError):
            autopilot.recv(300)
    assert not deadman.alive()
    messages = [mavlink.MAVLink(None).parse_char(frame) for frame in frames]
    for message in messages:
        assert message.get_type() == "COMMAND_LONG"
        assert (message.target_system, message.target_component) == (7, 1)
        assert message.command == mavlink.MAV_CMD_DO_SET_MODE
        assert (message.param1, message.param2, message.param3) == (1.0, 4.0, 3.0)


def test_a_robot_that_does_not_fly_may_be_silent(
    sockets: tuple[socket.socket, socket.socket],
) -> None:
    own, autopilot = sockets
    autopilot.settimeout(1.0)
    with Deadman(own.getsockname()[1], system_id=7, timeout_s=0.3) as deadman:
        assert deadman._process is not None
        # It hears both together, however slow this machine is.
        deadman._process.send_signal(signal.SIGSTOP)
        deadman.feed(flying=True)
        deadman.feed(flying=False)
        deadman._process.send_signal(signal.SIGCONT)
        with pytest.raises(TimeoutError):
            autopilot.recv(300)


def test_feeding_a_watchdog_that_was_killed_does_not_raise(
    sockets: tuple[socket.socket, socket.socket],
) -> None:
    own, _ = sockets
    with Deadman(own.getsockname()[1], system_id=7, timeout_s=0.3) as deadman:
        assert deadman._process is not None
        deadman._process.kill()
        deadman._process.wait()
        deadman.feed(flying=True)
        assert not deadman.alive()


def test_a_port_that_is_not_open_is_named() -> None:
    with (
        pytest.raises(DeadmanError, match=r"^no UDP socket on port 9 to guard"),
        Deadman(9, system_id=7, timeout_s=0.5),
    ):
        pass


@pytest.mark.parametrize("system_id", [1, 7, 255])
def test_frames_are_mavlink(system_id: int) -> None:
    frame = _hold_command(sequence=3, system_id=system_id)
    (message,) = mavlink.MAVLink(None).parse_buffer(frame)
    assert message.get_msgbuf() == frame
    assert message.get_srcSystem() == message.target_system == system_id
