"""The adapter with the real MAVSDK, against simulated vehicles over UDP."""

import math
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import numpy as np
import pytest
from geographiclib.geodesic import Geodesic
from pymavlink.dialects.v20 import common as mavlink

from edge.core.vehicle import Action, Mode, Position, Setpoint, Vector, VehicleState, Velocity
from edge.drivers.px4.autopilot import AutopilotError, MavsdkAutopilot
from edge.drivers.px4.dialogue import _COMMANDS
from lpac.sim.ports import free_ports
from lpac.sim.px4.link import Px4Link
from lpac.sim.px4.modes import MavResult, Px4Mode
from lpac.sim.px4.server import Instance, Px4Server
from lpac.sim.px4.vehicle import Px4Setpoint, Px4Vehicle
from lpac.sim.px4.wire import MavlinkWire
from lpac.sim.px4.world import FencePolygon
from tests.conftest import ROOT
from tests.said import lines_said

CLIMB = Velocity((0.0, 0.0, -2.0))
STAY = Velocity((0.0, 0.0, 0.0))
NORTH = Velocity((1.0, 0.0, 0.0))


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """No command is given up because this machine is slow."""
    patient = {action: command._replace(wait_s=60.0) for action, command in _COMMANDS.items()}
    monkeypatch.setattr("edge.drivers.px4.dialogue._COMMANDS", patient)
    monkeypatch.setattr("edge.drivers.px4.dialogue._STALE_COMMAND_S", 60.0)


def new_vehicle(seed: int = 1, **parameters: float) -> Px4Vehicle:
    """Ready, and quick to take off and land."""
    vehicle = Px4Vehicle(seed=seed, ready_after_s=0.0)
    vehicle.parameters |= {
        "COM_SPOOLUP_TIME": 0.0,
        "MPC_TKO_RAMP_T": 0.0,
        "MPC_LAND_SPEED": 1.5,
        **parameters,
    }
    return vehicle


def record_setpoints(vehicle: Px4Vehicle) -> list[tuple[float, Px4Setpoint]]:
    """Grows by each setpoint that reaches the vehicle, and its time there, s."""
    heard: list[tuple[float, Px4Setpoint]] = []
    follow = vehicle.offboard

    def offboard(setpoint: Px4Setpoint) -> None:
        heard.append((vehicle.time_s, setpoint))
        follow(setpoint)

    vehicle.offboard = offboard  # type: ignore[method-assign]
    return heard


@contextmanager
def served(*links: Px4Link, port: int) -> Iterator[Px4Server]:
    with Px4Server([Instance(link, 0, port) for link in links]) as server:
        yield server


@contextmanager
def connected(vehicle: Px4Vehicle) -> Iterator[tuple[MavsdkAutopilot, Px4Server]]:
    (port,) = free_ports(1)
    link = Px4Link(vehicle, system_id=7)
    # MAVSDK waits for two of them, which PX4 sends once a second.
    link._set_interval(mavlink.MAVLINK_MSG_ID_HEARTBEAT, 0.1)
    with (
        MavsdkAutopilot(f"udpin://127.0.0.1:{port}", system_id=7) as autopilot,
        served(link, port=port) as server,
    ):
        wait(
            autopilot,
            lambda s: s.connected and s.origin and s.position_local_m and s.in_air is not None,
        )
        yield autopilot, server


def wait(
    autopilot: MavsdkAutopilot,
    condition: Callable[[VehicleState], object],
    setpoint: Setpoint | None = None,
    timeout_s: float = 60.0,
) -> VehicleState:
    """Until the state is so; meanwhile a setpoint is streamed at 20 Hz."""
    deadline_s = time.monotonic() + timeout_s
    while not condition(state := autopilot.state()):
        assert time.monotonic() < deadline_s, state
        if setpoint is not None:
            autopilot.send(setpoint)
        time.sleep(0.05)
    return state


def carry_out(
    autopilot: MavsdkAutopilot, action: Action, setpoint: Setpoint | None = None
) -> str | None:
    """The refusal of a command, "" if it was accepted."""
    began_s = time.monotonic()
    autopilot.command(action)
    result = wait(autopilot, lambda s: s.result and s.result.at_s > began_s, setpoint).result
    assert result is not None
    assert result.action is action
    assert result.accepted is (result.text == "")
    return result.text


def take_off(autopilot: MavsdkAutopilot, height_m: float = 1.5) -> None:
    wait(autopilot, lambda s: s.armable)
    for _ in range(3):
        assert autopilot.send(CLIMB) == CLIMB
    assert carry_out(autopilot, Action.ARM, CLIMB) == ""
    assert carry_out(autopilot, Action.OFFBOARD, CLIMB) == ""
    wait(autopilot, lambda s: (s.height_above_home_m or 0.0) > height_m, CLIMB)


def horizontal_m(a_deg: tuple[float, float], b_deg: tuple[float, float]) -> float:
    return float(Geodesic.WGS84.Inverse(*a_deg, *b_deg)["s12"])


def known(vector: Vector | None) -> Vector:
    assert vector is not None
    return vector


def implied_place(state: VehicleState) -> tuple[float, float]:
    """Where origin and position together say that the vehicle is: latitude, longitude, deg."""
    assert state.origin is not None
    north_m, east_m, _ = known(state.position_local_m)
    azimuth_deg = math.degrees(math.atan2(east_m, north_m))
    place = Geodesic.WGS84.Direct(*state.origin[:2], azimuth_deg, math.hypot(north_m, east_m))
    return place["lat2"], place["lon2"]


def implied_altitude_m(state: VehicleState) -> float:
    """How high they say that it is, above sea level."""
    assert state.origin is not None
    return state.origin.altitude_m - known(state.position_local_m)[2]


@contextmanager
def second_path(autopilot: MavsdkAutopilot, server: Px4Server) -> Iterator[None]:
    """Sends a vehicle's datagrams a second time, and passes on what is answered to it."""
    (link,) = (instance.link for instance in server._instances)
    port = int(autopilot._url.rpartition(":")[2])
    due, over = link.due, threading.Event()
    late: list[tuple[float, bytes]] = []

    def due_twice() -> list[bytes]:
        datagrams = due()
        late.extend((time.monotonic() + 0.1, datagram) for datagram in datagrams)
        return datagrams

    def forward() -> None:
        while not over.is_set():
            with server.stepped:
                server.stepped.wait(0.1)
                while late and late[0][0] <= time.monotonic():
                    udp.sendto(late.pop(0)[1], ("127.0.0.1", port))
                with suppress(BlockingIOError):
                    link.receive(udp.recv(2048))

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.setblocking(False)
        link.due = due_twice  # type: ignore[method-assign]
        thread = threading.Thread(target=forward)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()


# Telemetry


def test_the_whole_state_is_known() -> None:
    vehicle = Px4Vehicle(seed=4, ready_after_s=0.0, heading_rad=5.0)
    vehicle.battery_remaining = 0.62
    with connected(vehicle) as (autopilot, server):
        state = wait(autopilot, lambda s: s.armable and s.gps and s.heading_rad is not None)
        with server.stepped:
            place, local_m = vehicle.global_position[:2], vehicle.local_position_m
        assert state.system_id == 7
        assert state.other_system_ids == ()
        assert state.position_local_m == pytest.approx(local_m, abs=0.3)
        assert state.velocity_local_m_s == (0.0, 0.0, 0.0)
        assert horizontal_m(implied_place(state), place) < 0.3
        assert state.heading_rad == pytest.approx(5.0, abs=1e-3)
        assert state.height_above_home_m == pytest.approx(0.0, abs=0.5)
        assert (state.mode, state.armed, state.in_air) == (Mode.HOLD, False, False)
        assert state.battery == pytest.approx(0.62, abs=0.01)
        assert state.gps is not None
        assert (state.gps.fix, state.gps.satellites, state.gps.hdop) == (3, 10, 0.7)
        assert state.problems == ()
        vehicle.gps_lost = True
        state = wait(autopilot, lambda s: s.gps and s.gps.fix < 3)
        assert state.connected


def test_position_and_origin_belong_together_when_the_origin_jumps() -> None:
    vehicle = new_vehicle()
    with connected(vehicle) as (autopilot, server):
        take_off(autopilot)
        origin = autopilot.state().origin
        assert origin is not None
        with server.stepped:
            vehicle.jump_estimator_origin(7.0, -3.0, 6.0)

        def has_followed(state: VehicleState) -> bool:
            assert horizontal_m(implied_place(state), vehicle.global_position[:2]) < 1.0
            assert abs(implied_altitude_m(state) - vehicle.global_position[2]) < 1.0
            assert state.origin is not None
            followed = horizontal_m(state.origin[:2], origin[:2]) > 7.0
            return followed and state.origin.altitude_m < origin.altitude_m - 5.0

        deadline_s = time.monotonic() + 60.0
        while not has_followed(autopilot.state()):
            assert time.monotonic() < deadline_s
        assert autopilot.state().jumped_at_s == -math.inf
        assert autopilot.state().height_jumped_m == 0.0


def test_a_vehicle_that_appears_late_goes_and_comes_back() -> None:
    (port,) = free_ports(1)
    link = Px4Link(new_vehicle(), system_id=7)
    with MavsdkAutopilot(f"udpin://127.0.0.1:{port}") as autopilot:
        assert autopilot.state() == VehicleState()
        assert autopilot.send(STAY) is None
        assert carry_out(autopilot, Action.LAND) == "no vehicle"
        with pytest.raises(AutopilotError, match="no vehicle"):
            autopilot.read_parameters(["COM_OF_LOSS_T"])
        with served(link, port=port):
            wait(autopilot, lambda s: s.connected and s.origin and s.position_local_m)
        gone = wait(autopilot, lambda s: not s.connected)
        assert gone.system_id == 7
        assert carry_out(autopilot, Action.ARM) == "no vehicle"
        restarted = Px4Link(new_vehicle(2), system_id=7)
        with served(restarted, port=port) as server:
            wait(autopilot, lambda s: s.connected and s.origin and s.position_local_m)
            assert carry_out(autopilot, Action.ARM) == ""
            assert server.wait_for(lambda: restarted.vehicle.armed, 60.0)


def test_it_speaks_to_its_own_vehicle_alone() -> None:
    (port,) = free_ports(1)
    own, other = new_vehicle(1), new_vehicle(2)
    links = Px4Link(other, system_id=3), Px4Link(own, system_id=5)
    with (
        MavsdkAutopilot(f"udpin://127.0.0.1:{port}", system_id=5) as autopilot,
        served(*links, port=port),
    ):
        state = wait(autopilot, lambda s: s.connected and s.armable and s.other_system_ids)
        assert (state.system_id, state.other_system_ids) == (5, (3,))
        assert carry_out(autopilot, Action.ARM) == ""
        wait(autopilot, lambda s: s.armed)
        assert not other.armed


@pytest.mark.parametrize(("uids", "boot_s"), [((1, 2), 0.0), ((1, 1), 0.5)])
def test_two_vehicles_with_one_system_id_are_noticed(uids: tuple[int, int], boot_s: float) -> None:
    (port,) = free_ports(1)
    first, second = new_vehicle(1), new_vehicle(2)
    while first.time_s < boot_s:
        first.step(0.02)
    links = [
        Px4Link(vehicle, system_id=7, hardware_uid=uid)
        for vehicle, uid in zip((first, second), uids, strict=True)
    ]
    with (
        MavsdkAutopilot(f"udpin://127.0.0.1:{port}") as autopilot,
        served(*links, port=port),
    ):
        assert wait(autopilot, lambda s: s.other_system_ids).other_system_ids == (7,)


def test_a_clock_that_differs_from_now_on_is_no_backlog() -> None:
    vehicle = new_vehicle()
    with connected(vehicle) as (autopilot, server):
        with server.stepped:
            time.sleep(1.5)
        wait(autopilot, lambda s: time.monotonic() - s.position_at_s < 0.2)


@pytest.mark.parametrize("loss", [0.1, 0.3])
def test_a_link_that_loses_messages(loss: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is there, its parameters are read, and it flies."""
    monkeypatch.undo()
    vehicle = new_vehicle()
    vehicle.wire = MavlinkWire(loss=loss)
    with connected(vehicle) as (autopilot, _):
        lost = wait(autopilot, lambda s: s.link_lost).link_lost
        assert loss - 0.1 < lost < loss + 0.1
        names = ["COM_OBL_RC_ACT", "COM_OF_LOSS_T", "NAV_DLL_ACT", "EKF2_HGT_REF"]
        assert None not in autopilot.read_parameters(names).values()
        wait(autopilot, lambda s: s.armable)
        # Each may be lost, or its answer, and neither is sent twice on one order.
        began_s = time.monotonic()
        while not autopilot.state().armed or autopilot.state().mode is not Mode.OFFBOARD:
            autopilot.send(CLIMB)
            armed = autopilot.state().armed
            autopilot.command(Action.OFFBOARD if armed else Action.ARM)
            assert time.monotonic() < began_s + 60.0
            time.sleep(0.05)
        state = wait(autopilot, lambda s: (s.height_above_home_m or 0.0) > 1.5, CLIMB)
        assert (state.connected, state.other_system_ids) == (True, ())


def test_messages_that_come_twice_and_late() -> None:
    vehicle = new_vehicle()
    vehicle.wire = MavlinkWire(twice=1.0, late_s=(1.9, 2.1))
    with connected(vehicle) as (autopilot, _):
        take_off(autopilot)
        wait(autopilot, lambda s: s.mode is Mode.OFFBOARD and s.link_twice, CLIMB)
        until_s = time.monotonic() + 3.0

        def is_as_before(state: VehicleState) -> bool:
            assert (state.mode, state.armed) == (Mode.OFFBOARD, True)
            assert state.jumped_at_s == -math.inf
            assert state.other_system_ids == () and state.link_lost == 0.0
            return time.monotonic() > until_s

        wait(autopilot, is_as_before, STAY)


def test_of_two_paths_one_is_answered() -> None:
    """All that the vehicle says comes by another port, too, 0.1 s later."""
    vehicle = new_vehicle()
    armings: list[float] = []
    arm = vehicle.arm

    def counted(*, force: bool = False) -> MavResult:
        armings.append(vehicle.time_s)
        return arm(force=force)

    vehicle.arm = counted  # type: ignore[method-assign]
    with connected(vehicle) as (autopilot, server), second_path(autopilot, server):
        wait(autopilot, lambda s: s.link_twice and s.armable)
        assert autopilot.state().other_system_ids == ()
        assert carry_out(autopilot, Action.ARM) == ""
        assert len(armings) == 1


# Setpoints


def test_it_flies_velocities_and_positions() -> None:
    vehicle = new_vehicle()
    with connected(vehicle) as (autopilot, _):
        take_off(autopilot)
        flies = (Mode.OFFBOARD, True, True)
        wait(autopilot, lambda s: (s.mode, s.armed, s.in_air) == flies, NORTH)
        state = wait(autopilot, lambda s: known(s.velocity_local_m_s)[0] > 0.5, NORTH)
        north_m, east_m, down_m = known(state.position_local_m)
        goal = Position((north_m, east_m + 2.0, down_m - 1.0))
        goal_m = goal.position_local_m
        wait(autopilot, lambda s: math.dist(known(s.position_local_m), goal_m) < 0.5, goal)


def test_each_setpoint_is_sent_once_and_only_if_it_is_finite() -> None:
    vehicle = new_vehicle()
    heard = record_setpoints(vehicle)
    with connected(vehicle) as (autopilot, server):
        for value in (math.nan, math.inf, -math.inf, 1e30):
            for vector in ((value, 0.0, 0.0), (0.0, value, 0.0), (0.0, 0.0, value)):
                assert autopilot.send(Velocity(vector)) is None
                assert autopilot.send(Position(vector)) is None
        position = Position((4.0, -5.0, -6.5))
        assert autopilot.send(NORTH) == NORTH
        assert autopilot.send(position) == position
        assert server.wait_for(lambda: len(heard) >= 2, 60.0)
        heard_s = vehicle.time_s
        assert server.wait_for(lambda: vehicle.time_s > heard_s + 0.5, 60.0)
    (_, velocity), (_, place) = heard
    assert velocity.velocity_m_s == (1.0, 0.0, 0.0)
    assert place.position_m == (4.0, -5.0, -6.5)
    for unused in (velocity.position_m, place.velocity_m_s, velocity.yaw_rad, place.yaw_rad):
        assert np.isnan(unused).all()


# Commands


def test_arming_is_refused_where_px4s_checks_fail() -> None:
    vehicle = new_vehicle()
    vehicle.battery_remaining = 0.06
    with connected(vehicle) as (autopilot, _):
        state = wait(autopilot, lambda s: s.armable is False and s.problems)
        assert [problem.text for problem in state.problems] == ["battery critical"]
        refusal = carry_out(autopilot, Action.ARM) or ""
        assert refusal.startswith("not now: ") and refusal.endswith("battery critical")
        vehicle.battery_remaining = 1.0
        assert wait(autopilot, lambda s: s.armable).problems == ()
        assert carry_out(autopilot, Action.ARM) == ""


def test_hold_land_and_disarm() -> None:
    vehicle = new_vehicle(COM_DISARM_LAND=0.0)
    with connected(vehicle) as (autopilot, _):
        take_off(autopilot)
        assert carry_out(autopilot, Action.HOLD) == ""
        wait(autopilot, lambda s: s.mode is Mode.HOLD)
        assert carry_out(autopilot, Action.DISARM) == "not now: it has not landed"
        assert carry_out(autopilot, Action.LAND) == ""
        wait(autopilot, lambda s: s.mode is Mode.LAND)
        wait(autopilot, lambda s: s.in_air is False)
        assert carry_out(autopilot, Action.DISARM) == ""
        wait(autopilot, lambda s: s.armed is False)
        assert vehicle.landed


def results_of(commands: list[Action], vehicle: Px4Vehicle) -> list[tuple[str, str]]:
    """What became of commands that were given while the vehicle did not answer."""
    first, *others = commands
    with lines_said() as lines, connected(vehicle) as (autopilot, server):
        wait(autopilot, lambda s: s.armable)
        with server.stepped:
            autopilot.command(first)
            wait(autopilot, lambda _: autopilot._dialogue.running is first)
            for action in others:
                autopilot.command(action)
        wait(autopilot, lambda s: s.result and s.result.action is commands[-1])
    commands_said = [line for line in lines if line["event"] == "command"]
    return [(str(said["action"]), str(said["refusal"])) for said in commands_said]


@pytest.mark.parametrize("last", [Action.LAND, Action.HOLD])
def test_what_waits_behind_a_landing_is_not_sent(last: Action) -> None:
    vehicle = new_vehicle()
    results = results_of([Action.DISARM, Action.ARM, Action.OFFBOARD, last], vehicle)
    assert results == [
        ("arm", "superseded"),
        ("offboard", "superseded"),
        ("disarm", ""),
        (last.value, ""),
    ]
    assert not any(truth.armed for truth in vehicle.truth)


def test_an_unanswered_command_does_not_hold_up_a_kill() -> None:
    vehicle = new_vehicle()
    results = results_of([Action.LAND, Action.DISARM, Action.KILL], vehicle)
    assert results == [("disarm", "superseded"), ("land", "superseded"), ("kill", "")]


def test_a_command_that_waits_is_not_queued_twice() -> None:
    results = results_of([Action.DISARM, Action.ARM, Action.ARM], new_vehicle())
    assert results == [("disarm", ""), ("arm", "")]


def test_a_start_that_waited_too_long_is_not_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    vehicle = new_vehicle()
    with lines_said() as lines, connected(vehicle) as (autopilot, server), server.stepped:
        autopilot.command(Action.DISARM)
        autopilot.command(Action.ARM)
        wait(autopilot, lambda s: s.result and s.result.action is Action.ARM)
    assert [line["refusal"] for line in lines if line["event"] == "command"] == [
        "no answer",
        "requested too long ago",
    ]
    assert not any(truth.armed for truth in vehicle.truth)


def test_an_unanswered_arm_is_sent_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    vehicle = new_vehicle()
    with connected(vehicle) as (autopilot, server):
        armings: list[float] = []
        arm = vehicle.arm

        def counted(*, force: bool = False) -> MavResult:
            armings.append(vehicle.time_s)
            return arm(force=force)

        vehicle.arm = counted  # type: ignore[method-assign]
        with server.stepped:
            assert carry_out(autopilot, Action.ARM) == "no answer"
        wait(autopilot, lambda s: s.armed)
        assert len(armings) == 1


def test_a_kill_drops_the_vehicle() -> None:
    vehicle = new_vehicle()
    with connected(vehicle) as (autopilot, _):
        take_off(autopilot)
        assert carry_out(autopilot, Action.KILL, CLIMB) == ""
        assert not vehicle.armed
        wait(autopilot, lambda s: s.in_air is False and s.armed is False)


# Before flight


def test_parameters() -> None:
    vehicle = new_vehicle()
    with connected(vehicle) as (autopilot, _):
        autopilot.set_parameter("COM_OBL_RC_ACT", -4)
        autopilot.set_parameter("COM_OF_LOSS_T", 1)
        autopilot.set_parameter("MPC_XY_P", 0.75)
        names = ["COM_OBL_RC_ACT", "NO_SUCH", "COM_OF_LOSS_T", "MPC_XY_P", "EKF2_HGT_REF"]
        assert autopilot.read_parameters(names) == {
            "COM_OBL_RC_ACT": -4,
            "NO_SUCH": None,
            "COM_OF_LOSS_T": 1.0,
            "MPC_XY_P": 0.75,
            "EKF2_HGT_REF": 1,
        }
        with pytest.raises(AutopilotError, match="NO_SUCH"):
            autopilot.set_parameter("NO_SUCH", 1)
        with pytest.raises(AutopilotError, match=r"COM_OBL_RC_ACT = 1\.5: must be a whole number"):
            autopilot.set_parameter("COM_OBL_RC_ACT", 1.5)


def test_parameters_are_asked_for_one_by_one_only_once_one_of_them_changed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    vehicle, asked = new_vehicle(), list[str]()
    answer = Px4Link._on_param_request_read

    def on_param_request_read(self: Px4Link, message: Any) -> None:
        asked.append(message.param_id)
        answer(self, message)

    monkeypatch.setattr(Px4Link, "_on_param_request_read", on_param_request_read)
    names = ["COM_OBL_RC_ACT", "COM_OF_LOSS_T", "NO_SUCH"]
    # What does not exist is waited for in each of these calls.
    monkeypatch.setattr("edge.drivers.px4.autopilot._ABSENT_AFTER_CALLS", 2)
    with connected(vehicle) as (autopilot, server):
        before = {"COM_OBL_RC_ACT": 0, "COM_OF_LOSS_T": 1.0, "NO_SUCH": None}
        for _ in range(3):
            assert autopilot.read_parameters(names) == before
        asked.clear()
        assert autopilot.read_parameters(names) == before
        assert asked == ["_HASH_CHECK"]
        with server.stepped:
            vehicle.parameters["COM_OBL_RC_ACT"] = 4
        assert autopilot.read_parameters(names) == before | {"COM_OBL_RC_ACT": 4}


FENCE_DEG = [(39.95, -75.17), (39.96, -75.17), (39.96, -75.16), (39.95, -75.16)]


@pytest.mark.parametrize("px4", ["v1.17", "v1.14"])
def test_a_fence_that_others_change_or_clear_is_no_longer_there(
    px4: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if px4 == "v1.14":
        monkeypatch.setattr(Px4Link, "_fence_id", lambda _: 0)
    vehicle = new_vehicle()
    with connected(vehicle) as (autopilot, server):
        assert not autopilot.has_fence()
        others = (FencePolygon(True, tuple(FENCE_DEG[:3])),), ()
        for fence in others:
            autopilot.upload_fence(FENCE_DEG)
            assert autopilot.has_fence()
            told_s = vehicle.time_s + 2.0
            assert server.wait_for(lambda until_s=told_s: vehicle.time_s > until_s, 60.0)  # type: ignore[misc]
            assert autopilot.has_fence()
            with server.stepped:
                vehicle.fence = fence
            deadline_s = time.monotonic() + 60.0
            while autopilot.has_fence():
                assert time.monotonic() < deadline_s
                time.sleep(0.05)


def test_fence() -> None:
    vehicle = new_vehicle()
    with connected(vehicle) as (autopilot, _):
        vertices_deg = FENCE_DEG
        autopilot.upload_fence(vertices_deg)
        (polygon,) = vehicle.fence
        assert polygon.inclusion
        assert np.array(polygon.vertices_deg) == pytest.approx(np.array(vertices_deg), abs=1e-6)
        with pytest.raises(AutopilotError, match="fence"):
            autopilot.upload_fence(vertices_deg[:2])


def test_an_impossible_url_is_named() -> None:
    with pytest.raises(AutopilotError, match="nonsense"), MavsdkAutopilot("nonsense://1"):
        pass


# When the program fails


PILOT_PROGRAM = """
import ctypes, sys, time
from edge.core.logger import show
from edge.drivers.px4.autopilot import MavsdkAutopilot
from edge.core.vehicle import Action, Mode, Velocity

show("error")

def fly(velocity, until, action=None):
    while not until(autopilot.state()):
        if action is not None:
            autopilot.command(action)  # until it is so: a busy machine may have missed the answer
        autopilot.send(Velocity(velocity))
        time.sleep(0.1)

with MavsdkAutopilot(f"udpin://127.0.0.1:{sys.argv[1]}") as autopilot:
    while not autopilot.state().armable:
        time.sleep(0.05)
    fly((0.0, 0.0, -2.0), lambda s: s.armed, Action.ARM)
    fly((0.0, 0.0, -2.0), lambda s: s.mode is Mode.OFFBOARD, Action.OFFBOARD)
    fly((0.0, 0.0, -2.0), lambda s: s.height_above_home_m > 1.5)
    fly((1.0, 0.0, 0.0), lambda s: s.velocity_local_m_s[0] > 0.9)
    print("flying", flush=True)
    if sys.argv[2] == "interpreter":
        ctypes.PyDLL(None).sleep(600)  # holds the GIL
    fly((1.0, 0.0, 0.0), lambda _: False)
"""


@contextmanager
def program(port: int, way: str) -> Iterator[subprocess.Popen[str]]:
    arguments = [sys.executable, "-c", PILOT_PROGRAM, str(port), way]
    with subprocess.Popen(arguments, cwd=ROOT, stdout=subprocess.PIPE, text=True) as running:
        try:
            yield running
        finally:
            running.kill()


def test_a_program_that_stands_still_stops_the_vehicle() -> None:
    """Its process stopped, its interpreter held up, itself killed: each flies a vehicle."""
    ways = ("process", "interpreter", "killed")
    ports = free_ports(len(ways))
    vehicles = [
        new_vehicle(seed, COM_OF_LOSS_T=0.5, COM_OBL_RC_ACT=4, COM_FAIL_ACT_T=1.0)
        for seed in (1, 2, 3)
    ]
    heard = [record_setpoints(vehicle) for vehicle in vehicles]
    instances = [
        Instance(Px4Link(vehicle, system_id=7), 0, port)
        for vehicle, port in zip(vehicles, ports, strict=True)
    ]
    with Px4Server(instances) as server, ExitStack() as stack:
        programs = [stack.enter_context(program(*each)) for each in zip(ports, ways, strict=True)]
        for each in programs:
            assert each.stdout is not None
            assert each.stdout.readline() == "flying\n"
        programs[0].send_signal(signal.SIGSTOP)
        programs[2].kill()
        have_waited = server.wait_for(
            lambda: all(v.time_s > h[-1][0] + 2.0 for v, h in zip(vehicles, heard, strict=True)),
            60.0,
        )
        assert have_waited
    for vehicle, setpoints in zip(vehicles, heard, strict=True):
        last_s, last = setpoints[-1]
        assert last.velocity_m_s[0] == 1.0
        at_last = next(truth for truth in vehicle.truth if truth.time_s >= last_s)
        assert at_last.velocity_m_s[0] > 0.8
        # Later it has landed, and is disarmed.
        assert next(t for t in vehicle.truth if t.time_s > last_s + 1.9).mode is Px4Mode.LAND
        after = [truth for truth in vehicle.truth if truth.time_s > last_s + 1.3]
        assert after
        assert all(math.hypot(*truth.velocity_m_s[:2]) < 0.2 for truth in after)


@pytest.mark.parametrize("with_vehicle", [True, False])
def test_the_interpreter_exits_without_a_close(with_vehicle: bool) -> None:
    code = """
import sys, time
from edge.drivers.px4.autopilot import MavsdkAutopilot
with MavsdkAutopilot(f"udpin://127.0.0.1:{sys.argv[1]}") as autopilot:
    while sys.argv[2] == "True" and not autopilot.state().connected:
        time.sleep(0.02)
    raise SystemExit(3)
"""
    (port,) = free_ports(1)
    with served(Px4Link(new_vehicle(), system_id=7), port=port):
        arguments = [sys.executable, "-c", code, str(port), str(with_vehicle)]
        assert subprocess.run(arguments, cwd=ROOT, timeout=120.0, check=False).returncode == 3


def test_closing_is_final_and_can_be_repeated() -> None:
    with connected(new_vehicle()) as (autopilot, _):
        autopilot.command(Action.LAND)
        autopilot.close()
        autopilot.close()
        autopilot.command(Action.ARM)
        assert autopilot.send(STAY) is None
        assert autopilot.state().system_id == 7
