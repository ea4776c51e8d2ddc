"""What a pilot does with a real PX4, on the link where PX4 listens to a ground station."""

import math
import socket
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from lpac.sim.px4.modes import CUSTOM_MODES, Px4Mode
from lpac.sim.px4.world import WorldOrigin
from lpac.sim.sitl.build import GROUND_PORT
from lpac.sim.sitl.ground_station import RealVehicle

# Far from those that flights use.
INSTANCE = 73
SYSTEM = INSTANCE + 1


class Px4EndOfTheLink:
    """Send the messages of a PX4 to a ground station, and receive its messages."""

    def __init__(self, udp: socket.socket) -> None:
        self.udp = udp
        self.mav: Any = mavlink.MAVLink(None, srcSystem=SYSTEM, srcComponent=1)
        self.mav.robust_parsing = True
        self.peer: Any = None

    def received(self) -> list[Any]:
        """All messages since the last call."""
        messages: list[Any] = []
        while True:
            try:
                data, self.peer = self.udp.recvfrom(2048)
            except BlockingIOError:
                return messages
            messages += self.mav.parse_buffer(data) or ()

    def send(self, message: Any) -> None:
        self.udp.sendto(message.pack(self.mav), self.peer)

    def is_in(self, mode: Px4Mode) -> None:
        main, sub = CUSTOM_MODES[mode]
        self.send(
            mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4,
                mavlink.MAV_MODE_FLAG_SAFETY_ARMED, main << 16 | sub << 24, 4, 3,
            )
        )  # fmt: skip

    def is_heading(self, heading_rad: float) -> None:
        half = heading_rad / 2.0
        latitude, longitude, altitude_m = WorldOrigin().to_global(np.zeros(3))
        self.send(
            mavlink.MAVLink_hil_state_quaternion_message(
                0, [math.cos(half), 0.0, 0.0, math.sin(half)], 0.0, 0.0, 0.0,
                round(latitude * 1e7), round(longitude * 1e7), round(altitude_m * 1e3),
                0, 0, 0, 0, 0, 0, 0, 0,
            )
        )  # fmt: skip


@pytest.fixture
def link() -> Iterator[tuple[RealVehicle, Px4EndOfTheLink]]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", GROUND_PORT + INSTANCE))
        udp.setblocking(False)
        vehicle = RealVehicle(INSTANCE, WorldOrigin())
        yield vehicle, Px4EndOfTheLink(udp)
        vehicle.close()


def only(messages: list[Any], kind: str) -> list[Any]:
    return [message for message in messages if message.get_type() == kind]


def channels(sticks: Any) -> tuple[int, ...]:
    """Roll, pitch, throttle, yaw."""
    return sticks.chan1_raw, sticks.chan2_raw, sticks.chan3_raw, sticks.chan4_raw


def test_sticks_are_sent_first_and_the_mode_is_commanded_until_it_is_set(
    link: tuple[RealVehicle, Px4EndOfTheLink], monkeypatch: pytest.MonkeyPatch
) -> None:
    vehicle, px4 = link
    now_s = 100.0
    monkeypatch.setattr("lpac.sim.sitl.ground_station.time.monotonic", lambda: now_s)
    vehicle.exchange()
    assert not only(px4.received(), "RC_CHANNELS_OVERRIDE"), "no remote control is on"
    px4.is_in(Px4Mode.OFFBOARD)
    # North is to the left of a nose that points east.
    px4.is_heading(math.pi / 2.0)
    vehicle.exchange()
    assert (vehicle.mode, vehicle.armed) == (Px4Mode.OFFBOARD, True)
    vehicle.pilot(Px4Mode.POSCTL, (2.0, 1.0, -1.5))
    asked = 0
    for _ in range(10):
        now_s += 0.1
        vehicle.exchange()
        messages = px4.received()
        (sticks,) = only(messages, "RC_CHANNELS_OVERRIDE")
        assert sticks.target_system == SYSTEM
        shares = (np.array(channels(sticks)) - 1500.0) / 500.0
        # PX4 v1.17's own curve, src/lib/sticks/Sticks.hpp.
        assert 0.4 * shares + 0.6 * shares**3 == pytest.approx([-0.5, 0.25, 0.5, 0.0], abs=3e-3)
        modes = only(messages, "COMMAND_LONG")
        asked += sum(m.command == mavlink.MAV_CMD_DO_SET_MODE for m in modes)
    assert asked >= 3
    px4.is_in(Px4Mode.POSCTL)
    vehicle.exchange()
    assert vehicle.mode is Px4Mode.POSCTL
    px4.received()
    vehicle.move_sticks(())
    now_s += 1.0
    vehicle.exchange()
    messages = px4.received()
    (sticks,) = only(messages, "RC_CHANNELS_OVERRIDE")
    assert channels(sticks) == (1500,) * 4
    commands = [m.command for m in only(messages, "COMMAND_LONG")]
    assert mavlink.MAV_CMD_DO_SET_MODE not in commands
    # Lost, it says nothing more.
    vehicle.rc_connected = False
    now_s += 1.0
    vehicle.exchange()
    assert not only(px4.received(), "RC_CHANNELS_OVERRIDE")


def test_parameters_are_sent_again_until_they_are_confirmed(
    link: tuple[RealVehicle, Px4EndOfTheLink], monkeypatch: pytest.MonkeyPatch
) -> None:
    vehicle, px4 = link
    now_s = 100.0
    monkeypatch.setattr("lpac.sim.sitl.ground_station.time.monotonic", lambda: now_s)
    vehicle.set_parameter("SIM_GPS_USED", 0)
    vehicle.set_parameter("SIM_GPS_USED", 10)
    vehicle.set_parameter("MPC_VEL_MANUAL", 4.1)
    vehicle.exchange()
    sent = {each.param_id: each for each in only(px4.received(), "PARAM_SET")}
    assert sent.keys() == {"SIM_GPS_USED", "MPC_VEL_MANUAL"}
    for number, kept in enumerate(sent.values()):
        # Of one it says what it had before, which is no confirmation.
        value = kept.param_value if kept.param_id == "SIM_GPS_USED" else 10.0
        name = kept.param_id.encode()
        px4.send(mavlink.MAVLink_param_value_message(name, value, kept.param_type, 2, number))
    vehicle.exchange()
    assert vehicle.unconfirmed == ("MPC_VEL_MANUAL",)
    now_s += 1.0
    vehicle.exchange()
    (again,) = only(px4.received(), "PARAM_SET")
    px4.send(mavlink.MAVLink_param_value_message(b"MPC_VEL_MANUAL", again.param_value, 9, 2, 1))
    vehicle.exchange()
    assert len(vehicle.unconfirmed) == 0
    now_s += 1.0
    vehicle.exchange()
    assert only(px4.received(), "PARAM_SET") == []
