"""The watchdog: a vehicle whose program hangs holds, and lands if nobody takes it; one whose
program died lands at once."""

import math
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from edge.drivers.px4 import unattended
from edge.drivers.px4.raw_mavlink import Heartbeat, heartbeat, hold_command, land_command
from edge.drivers.px4.watchdog import WatchdogError, WatchdogProcess
from lpac.sim.ports import free_ports
from lpac.sim.px4.link import Px4Link
from lpac.sim.px4.modes import Px4Mode
from lpac.sim.px4.server import Instance, Px4Server
from lpac.sim.px4.vehicle import Px4Vehicle
from tests.conftest import ROOT

PROGRAM = """
import ctypes, sys, time
from edge.core.logger import show
from edge.drivers.px4.watchdog import WatchdogProcess
from edge.drivers.px4.autopilot import MavsdkAutopilot
from edge.core.vehicle import Action, Mode, Velocity

show("error")
port, system_id, way = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]

def fly(velocity, until, action=None):
    while not until(autopilot.state()):
        if action is not None:
            autopilot.command(action)  # until it is so: a busy machine may have missed the answer
        autopilot.send(Velocity(velocity))
        watchdog.feed(flying=True)
        time.sleep(0.1)

with (
    MavsdkAutopilot(f"udpin://127.0.0.1:{port}", system_id=system_id) as autopilot,
    WatchdogProcess(port, system_id, 0.5, float(sys.argv[4])) as watchdog,
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


HOVER_LAND_S = 8.0


@contextmanager
def program(
    port: int, system_id: int, way: str, hover_land_s: float
) -> Iterator[subprocess.Popen[str]]:
    """Flies, and then hangs in this way; it has said so on its output."""
    arguments = [sys.executable, "-c", PROGRAM, str(port), str(system_id), way, str(hover_land_s)]
    with subprocess.Popen(arguments, cwd=ROOT, stdout=subprocess.PIPE, text=True) as running:
        try:
            yield running
        finally:
            running.kill()


@pytest.mark.alone
def test_a_program_that_hangs_or_dies_leaves_nobody_flying_or_hovering() -> None:
    hangs = ("process", "interpreter", "loop")
    ways = (*hangs, "killed", "stopped, then killed", "continued", "taken", "taken and left")
    ports = free_ports(len(ways))
    vehicles = {}
    for seed, way in enumerate(ways, 1):
        vehicles[way] = Px4Vehicle(seed=seed, ready_after_s=0.0)
        vehicles[way].parameters |= {"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 4}
    instances = [
        Instance(Px4Link(vehicle, system_id=number), 0, port)
        for number, (vehicle, port) in enumerate(zip(vehicles.values(), ports, strict=True), 1)
    ]
    killed, continued, taken, left = (vehicles[way] for way in ways[3:] if way != ways[4])
    hang = [vehicle for vehicle in vehicles.values() if vehicle is not killed]
    landed = [vehicles[way] for way in (*hangs, "stopped, then killed")]
    with Px4Server(instances) as server, ExitStack() as stack:
        programs = {
            way: stack.enter_context(program(port, number, way, HOVER_LAND_S))
            for number, (port, way) in enumerate(zip(ports, ways, strict=True), 1)
        }
        for each in programs.values():
            assert each.stdout is not None
            assert each.stdout.readline() == "flying\n"
        for way in ("process", *ways[4:]):
            programs[way].send_signal(signal.SIGSTOP)
        programs["killed"].kill()
        assert server.wait_for(lambda: all(v.mode is Px4Mode.HOLD for v in hang), 60.0)
        with server.stepped:
            began_s = taken.time_s
        # The watchdog says it three times.
        assert server.wait_for(lambda: taken.time_s > began_s + 1.0, 60.0)
        programs["stopped, then killed"].kill()
        programs["continued"].send_signal(signal.SIGCONT)
        with server.stepped:
            taken.pilot()
            left.pilot()
        # Long enough to be told.
        assert server.wait_for(lambda: taken.time_s > began_s + 7.0, 60.0)
        with server.stepped:
            left.set_mode(Px4Mode.HOLD)
        assert server.wait_for(lambda: all(v.landed and not v.armed for v in landed), 120.0)
    assert (continued.mode, left.mode, taken.mode) == (Px4Mode.HOLD, Px4Mode.HOLD, Px4Mode.POSCTL)
    for way, mode in {**dict.fromkeys(hangs, Px4Mode.HOLD), "killed": Px4Mode.LAND}.items():
        vehicle = vehicles[way]
        silent_s = vehicle._setpoint_at_s
        later = next(truth for truth in vehicle.truth if truth.time_s > silent_s + 4.0)
        assert later.mode is mode, way
        # Horizontally at rest 1.5 s after the last command, and then at rest altogether or landing.
        after = [t for t in vehicle.truth if silent_s + 1.5 < t.time_s < silent_s + HOVER_LAND_S]
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
    with WatchdogProcess(
        own.getsockname()[1], system_id=7, timeout_s=0.3, hover_land_s=60.0
    ) as watchdog:
        assert watchdog.alive()
        watchdog.feed(flying=True)
        frames = [autopilot.recv(300) for _ in range(3)]
        assert own.recv(300) == b"heartbeat"  # still there for the program to read
        autopilot.settimeout(0.7)
        with pytest.raises(TimeoutError):
            autopilot.recv(300)
    assert not watchdog.alive()
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
    with WatchdogProcess(
        own.getsockname()[1], system_id=7, timeout_s=0.3, hover_land_s=60.0
    ) as watchdog:
        assert watchdog._process is not None
        # It hears both together, however slow this machine is.
        watchdog._process.send_signal(signal.SIGSTOP)
        watchdog.feed(flying=True)
        watchdog.feed(flying=False)
        watchdog._process.send_signal(signal.SIGCONT)
        with pytest.raises(TimeoutError):
            autopilot.recv(300)


def test_feeding_a_watchdog_that_was_killed_does_not_raise(
    sockets: tuple[socket.socket, socket.socket],
) -> None:
    own, _ = sockets
    with WatchdogProcess(
        own.getsockname()[1], system_id=7, timeout_s=0.3, hover_land_s=60.0
    ) as watchdog:
        assert watchdog._process is not None
        watchdog._process.kill()
        watchdog._process.wait()
        watchdog.feed(flying=True)
        assert not watchdog.alive()


def test_a_port_that_is_not_open_is_named() -> None:
    with (
        pytest.raises(WatchdogError, match=r"^no UDP socket on port 9: check"),
        WatchdogProcess(9, system_id=7, timeout_s=0.5, hover_land_s=60.0),
    ):
        pass


@pytest.mark.parametrize("system_id", [1, 7, 255])
def test_frames_are_mavlink(system_id: int) -> None:
    for command, frame in (
        (mavlink.MAV_CMD_DO_SET_MODE, hold_command(3, system_id, 197)),
        (mavlink.MAV_CMD_NAV_LAND, land_command(259, system_id, 197)),
    ):
        (message,) = mavlink.MAVLink(None).parse_buffer(frame)
        assert message.get_msgbuf() == frame
        assert (message.command, message.get_seq()) == (command, 3)
        assert message.get_srcSystem() == message.target_system == system_id


def beat(system_id: int, custom_mode: int, armed: bool = True, component: int = 1) -> bytes:
    """A heartbeat of PX4, as a frame."""
    sender = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=component)
    base_mode = 0x1D | (0x80 if armed else 0)
    frame: bytes = sender.heartbeat_encode(2, 12, base_mode, custom_mode, 4).pack(sender)
    return frame


HOLD, LAND, OFFBOARD, POSITION = 0x3040000, 0x6040000, 0x60000, 0x30000


def test_the_autopilots_heartbeat_is_found_in_a_datagram() -> None:
    assert heartbeat(beat(7, HOLD, component=191) + beat(7, HOLD)) == Heartbeat(7, 12, True, "hold")
    # Trailing zeros are not sent.
    sender = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    assert heartbeat(sender.heartbeat_encode(0, 0, 0, 0, 0, 0).pack(sender)) == Heartbeat(
        7, 0, False, "other"
    )


@given(st.binary(max_size=300))
def test_no_datagram_breaks_it(data: bytes) -> None:
    for start in (b"", b"\xfd", b"\xfe"):
        heartbeat(start + data)


@pytest.mark.parametrize(
    ("told", "lands"),
    [
        ((OFFBOARD, HOLD), True),
        ((HOLD,), True),
        # PX4 ends it by itself.
        ((OFFBOARD,), False),
        ((LAND,), False),
        # It does not go through with it.
        ((LAND, HOLD), True),
        ((HOLD, LAND, HOLD), True),
        ((HOLD, LAND, POSITION, HOLD), False),
        ((HOLD, POSITION, HOLD), False),
        ((HOLD, OFFBOARD, HOLD), False),
        ((), False),
    ],
)
def test_only_a_vehicle_that_hovers_and_that_nobody_took_is_landed(
    told: tuple[int, ...],
    lands: bool,
    sockets: tuple[socket.socket, socket.socket],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    own, autopilot = sockets
    monkeypatch.setattr(unattended, "_FRESH_S", 0.3)
    monkeypatch.setattr(unattended, "_GAP_S", 0.3)
    address = own.getsockname()
    for custom_mode in told:
        # Of another vehicle on the same link nothing counts.
        autopilot.sendto(beat(8, POSITION), address)
        autopilot.sendto(beat(7, custom_mode), address)
    unattended.land_unattended(own, 7, 0.0)
    autopilot.settimeout(0.01)
    try:
        message = mavlink.MAVLink(None).parse_char(autopilot.recv(300))
    except TimeoutError:
        assert not lands
    else:
        assert lands
        assert message.command == mavlink.MAV_CMD_NAV_LAND
        assert message.target_system == 7


def test_a_program_that_hangs_and_takes_all_that_the_vehicle_says_is_killed(
    sockets: tuple[socket.socket, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    own, _ = sockets
    monkeypatch.setattr(unattended, "_STARVED_S", 0.3)
    reader, writer = os.pipe()
    with (
        os.fdopen(reader),
        subprocess.Popen(["sleep", "600"], pass_fds=(writer,)) as program,
    ):
        os.close(writer)
        # Its end shows at the pipe, which it alone has, before the vehicle is given up.
        assert not unattended.land_unattended(own, 7, 0.0, reader, program.pid)
        assert program.wait() == -signal.SIGKILL
