"""A robot's computer listens to its autopilot, and lands a vehicle whose program is gone."""

import asyncio
import math
import socket
import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
from pymavlink.dialects.v20 import common

from lpac.fleet import agent
from lpac.fleet.program import land
from lpac.fleet.session import RemoteError
from lpac.fleet.settings import load_fleet
from lpac.sim.ports import free_ports
from lpac.sim.px4.link import Px4Link
from lpac.sim.px4.modes import Px4Mode
from lpac.sim.px4.server import Instance, Px4Server
from lpac.sim.px4.vehicle import Px4Vehicle
from tests.conftest import ROOT
from tests.local_session import LocalSession
from tests.needs import needs

needs_root = needs(root=True)
ROBOT = load_fleet(ROOT / "docs" / "fleet.toml").robots["r1"]


def land_it(port: int, system_id: int) -> dict[str, Any]:
    robot = replace(ROBOT, mavlink_url=f"udpin://127.0.0.1:{port}", system_id=system_id)
    return asyncio.run(land(LocalSession(), robot, lambda *_: None))


@pytest.fixture
def datagrams() -> Iterator[tuple[int, socket.socket]]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        port = udp.getsockname()[1]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        yield port, sender


@needs_root
@pytest.mark.parametrize("armed", [False, True])
@pytest.mark.parametrize("version", [1, 2])
def test_an_autopilots_heartbeat_tells_whether_it_is_armed(
    datagrams: tuple[int, socket.socket], *, armed: bool, version: int
) -> None:
    port, sender = datagrams
    mavlink = common.MAVLink(None, srcSystem=11, srcComponent=1)
    camera = common.MAVLink(None, srcSystem=11, srcComponent=100)
    messages = (
        camera.heartbeat_encode(30, 8, 128, 0, 4).pack(camera, force_mavlink1=version == 1)
        + mavlink.attitude_encode(1, 0, 0, 0, 0, 0, 0).pack(mavlink, force_mavlink1=version == 1)
        + mavlink.heartbeat_encode(2, 12, 128 if armed else 0, 0x3040000, 0).pack(
            mavlink, force_mavlink1=version == 1
        )
    )
    stop = threading.Event()

    def send() -> None:
        while not stop.wait(0.05):
            sender.sendto(b"no MAVLink", ("127.0.0.1", port))
            sender.sendto(messages, ("127.0.0.1", port))

    thread = threading.Thread(target=send)
    thread.start()
    try:
        heard = agent.receive_heartbeat(port)["heartbeat"]
    finally:
        stop.set()
        thread.join()
    assert heard == {
        "system_id": 11,
        "autopilot": 12,
        "armed": armed,
        "mode": "hold",
        "sender": ("127.0.0.1", sender.getsockname()[1]),
    }


@needs_root
def test_no_heartbeat_is_silence(datagrams: tuple[int, socket.socket]) -> None:
    assert agent.receive_heartbeat(datagrams[0], wait_s=0.2) == {"heartbeat": None}


@needs_root
def test_a_vehicle_whose_program_is_gone_is_landed(monkeypatch: pytest.MonkeyPatch) -> None:
    said = {"fresh": True}
    monkeypatch.setitem(agent._CALLS, "service", lambda: said)
    vehicle = Px4Vehicle(seed=1, ready_after_s=0.0)
    (port,) = free_ports(1)

    def refused(why: str, system_id: int = 7) -> None:
        with pytest.raises(RemoteError, match=why):
            land_it(port, system_id)

    def takes_off() -> bool:
        if not vehicle.armed and vehicle.armable:
            vehicle.arm()
            vehicle.take_off(math.nan)
        return bool(vehicle.position_m[2] < -1.0)

    refused("^its program runs: use `lpac mission land`, in pilot after `lpac mission rejoin`$")
    said["fresh"] = False
    with Px4Server([Instance(Px4Link(vehicle, system_id=7), 0, port)]) as server:
        refused("^PX4 is system 7, not 8", system_id=8)
        refused("^it is disarmed: there is nothing to land$")
        assert server.wait_for(takes_off, 60.0)
        with server.stepped:
            vehicle.pilot()
        assert server.wait_for(lambda: vehicle.mode is Px4Mode.POSCTL, 60.0)
        # PX4 tells it within a second.
        heard: dict[str, object] = {}
        while heard.get("mode") != "position":
            heard = agent.receive_heartbeat(port)["heartbeat"] or {}
        refused(r"^a pilot flies it \(position\): the pilot must land it$")
        with server.stepped:
            vehicle.set_mode(Px4Mode.HOLD)
        while heard.get("mode") != "hold":
            heard = agent.receive_heartbeat(port)["heartbeat"] or {}
        landed = land_it(port, 7)
        assert (landed["mode"], landed["armed"]) == ("land", True)
        assert vehicle.mode is Px4Mode.LAND
        assert server.wait_for(lambda: vehicle.landed and not vehicle.armed, 60.0)


@needs_root
def test_where_nothing_is_heard_nothing_is_landed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(agent._CALLS, "service", lambda: {"fresh": False})
    (port,) = free_ports(1)
    with pytest.raises(RemoteError, match=f"^no heartbeat of PX4 at UDP port {port}$"):
        land_it(port, 7)
