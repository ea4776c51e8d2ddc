"""Faults in the air, each with what docs/safety.md says of it, judged by the vehicles' own logs.

One fleet takes off once and flies its mission, and each test takes a robot of its own. Those that
come down are the lowest first, so that nobody lands through another's height.

With --vehicle px4 --px4 DIR the vehicles are real PX4s of that build, three at a time, and new ones
once fewer than two still fly.
"""

import json
import math
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Literal, Self

import numpy as np
import pytest
import zenoh

from edge.core import wire
from edge.core.position import PositionCause
from edge.core.wire import Rejection
from edge.messages.beacon import BEACON_BYTES
from edge.messages.codec import encode
from edge.messages.codes import CheckCode, ReasonCode, RefusalCode
from edge.messages.mission import ORDER_LIFETIME_S, FlightState, Order, RobotStatus
from edge.policy.lpac.policy import LpacPolicy
from lpac.ground.station.protocol import Enable, ResultCode, SetOrigin
from lpac.sim.description import ERRORS
from lpac.sim.fleet.ground import GroundProgram
from lpac.sim.fleet.layout import ORIGIN, WORLD, FleetScenario
from lpac.sim.fleet.listener import Statuses
from lpac.sim.fleet.processes import Fleet
from lpac.sim.px4.modes import Px4Mode
from lpac.sim.px4.vehicle import Px4Vehicle
from lpac.sim.sitl.build import Px4Build
from lpac.sim.sitl.ground_station import RealVehicle, RealVehicles
from tests.conftest import SHIPPED
from tests.process.sim.fault_rig import FaultRig, FaultyRobot, flies_on, speed_m_s
from tests.said import codes

pytestmark = pytest.mark.real_time

KILLED, NO_GPS, EMPTY, LOW, MANY_FAULTS, FAULTY, STOPPED = range(7)
# Another vehicle, whose program says that it is robot STOPPED.
TWIN = 7

# As many as two cores carry.
PX4S = 3

PX4_FENCE_M = 5.0

_S = FlightState


@pytest.fixture(scope="module")
def grounded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FaultRig]:
    """All programs run, two of them with one robot id, and nobody has taken off."""
    fleet = Fleet(FleetScenario(robots=8), tmp_path_factory.mktemp("faults"), SHIPPED)
    assert fleet.simulated is not None
    for vehicle in fleet.simulated.vehicles:
        vehicle.parameters |= {"MPC_LAND_SPEED": 1.5, "COM_DISARM_LAND": 0.5}
    programs = list(fleet.robots)
    for faulty in (FAULTY, TWIN):
        programs[faulty] = FaultyRobot(faulty, programs[faulty].folder)
    fleet.robots = tuple(programs)
    change_config(fleet, TWIN, f"robot_id = {TWIN}", f"robot_id = {STOPPED}")
    change_config(fleet, STOPPED, 'rc = "none"', 'rc = "pilot"')
    with fleet, GroundProgram(fleet.fleet_toml, fleet.name) as ground:
        rig = FaultRig(fleet, ground, range(TWIN), fleet.simulated)
        rig.change(STOPPED, rc_connected=True)
        rig.assemble()
        yield rig


@pytest.fixture(scope="module")
def simulated_rig(request: pytest.FixtureRequest) -> FaultRig:
    """All but the twin fly their mission."""
    grounded: FaultRig = request.getfixturevalue("grounded")
    twin = grounded.fleet.robots[TWIN]
    twin.send_signal(signal.SIGTERM)
    assert twin.wait(60.0) == 0
    grounded.make_ready()
    grounded.take_off()
    grounded.start()
    return grounded


class Px4Rigs:
    """Fleets of real PX4s, one after the other; a context, in which the newest flies."""

    def __init__(self, build: Path, folder: Path) -> None:
        self._build, self._folder = build, folder
        self._stack = ExitStack()
        self._rig: FaultRig | None = None
        self._fleets = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def flying(self) -> FaultRig:
        """A fleet in its mission, of which one robot may be lost and another goes on."""
        if self._rig is None or len(self._rig.flying) < 2:
            self._stack.close()
            self._rig = None
            self._fleets += 1
            self._rig = self._start(self._folder / str(self._fleets))
        return self._rig

    def _start(self, folder: Path) -> FaultRig:
        fleet = Fleet(
            FleetScenario(robots=PX4S, seed=self._fleets), folder, SHIPPED, px4_build=self._build
        )
        fleet.robots = tuple(FaultyRobot(r.robot_id, r.folder) for r in fleet.robots)
        assert isinstance(fleet.vehicles, Px4Build)
        vehicles = RealVehicles(fleet.vehicles, WORLD)
        self._stack.enter_context(fleet)
        self._stack.enter_context(vehicles)
        ground = self._stack.enter_context(GroundProgram(fleet.fleet_toml, fleet.name))
        rig = FaultRig(fleet, ground, range(PX4S), vehicles)
        rig.assemble()
        rig.make_ready()
        rig.take_off()
        rig.start()
        return rig


@pytest.fixture(scope="module")
def px4_rigs(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Px4Rigs]:
    with Px4Rigs(request.config.getoption("--px4"), tmp_path_factory.mktemp("px4")) as rigs:
        yield rigs


@pytest.fixture
def rig(request: pytest.FixtureRequest) -> FaultRig:
    """A fleet in its mission."""
    if request.config.getoption("--vehicle") == "px4":
        rigs: Px4Rigs = request.getfixturevalue("px4_rigs")
        return rigs.flying()
    simulated: FaultRig = request.getfixturevalue("simulated_rig")
    return simulated


def change_config(fleet: Fleet, robot: int, before: str, after: str) -> None:
    path = fleet.robots[robot].folder / "robot.toml"
    text = path.read_text()
    assert text.count(before) == 1
    path.write_text(text.replace(before, after))


@contextmanager
def rogue(fleet: Fleet) -> Iterator[zenoh.Session]:
    """A session on the robots' radio that keeps to no rule."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
    config.insert_json5("connect/endpoints", json.dumps(fleet.endpoints))
    with zenoh.open(config) as session:
        yield session


def is_down(vehicle: Px4Vehicle) -> bool:
    return vehicle.landed and not vehicle.armed


def nothing_is_sent(rig: FaultRig, robot: int) -> None:
    # What was under way arrives first, and a log is written.
    rig.wait_time(robot, rig.now_s(robot) + rig.log_lag_s)
    sent_s = rig.last_setpoint_s(robot)
    rig.wait_time(robot, rig.now_s(robot) + 2.0 + rig.log_lag_s)
    assert rig.last_setpoint_s(robot) == sent_s


def longest_without_setpoint_s(rig: FaultRig, robot: int, until_s: float) -> float:
    """How long no setpoint came, at most, from now on or until it lands.

    Of a real PX4 that is not known live.
    """
    longest_s = 0.0

    def is_over(vehicle: Px4Vehicle | RealVehicle) -> bool:
        nonlocal longest_s
        if isinstance(vehicle, Px4Vehicle):
            longest_s = max(longest_s, vehicle.time_s - vehicle._setpoint_at_s)
        return vehicle.time_s >= until_s or vehicle.mode is Px4Mode.LAND

    rig.wait_vehicle(robot, is_over)
    return longest_s


def comes_straight_down(
    rig: FaultRig, robot: int, since_s: float, carried_m: float | None = None
) -> float:
    """From when on PX4 landed it, after `since_s`; it did not climb, and ended near there.

    Near by its own estimate, which may walk from the truth as far as the error budget has it; or
    within `carried_m` in truth, where it has no estimate that is worth anything.
    """
    landing = [entry for entry in rig.truth(robot, since_s) if entry.mode is Px4Mode.LAND]
    began_s = landing[0].time_s
    truth = rig.truth(robot, began_s)
    if carried_m is None:
        walked_m = rig.walked_m(robot, began_s)
        assert walked_m < ERRORS.gps_m
        carried_m = 2.0 + walked_m
    assert math.dist(truth[0].position_m[:2], truth[-1].position_m[:2]) < carried_m
    # But for what it still had of a climb.
    assert all(truth[0].position_m[2] - entry.position_m[2] < 0.3 for entry in truth)
    return began_s


@pytest.mark.simulated_only("takes a vehicle more, and PX4 has no part in it")
def test_neither_of_two_programs_with_one_id_takes_off(grounded: FaultRig) -> None:
    listener = grounded.listener
    grounded.command(SetOrigin(ORIGIN))
    grounded.command(Enable())

    def two() -> tuple[RobotStatus, ...]:
        told = {heard.status.boot_nonce: heard.status for heard in listener.history(STOPPED)}
        return tuple(told.values())

    def both_say_so(_: Statuses) -> bool:
        told = two()
        return len(told) == 2 and all(
            status.state is _S.PREFLIGHT
            and ReasonCode.DUPLICATE_ID in codes(status.alarms)
            and CheckCode.DUPLICATE_ID in codes(status.failed_checks)
            for status in told
        )

    assert listener.wait_for(both_say_so, 120.0), grounded.told()
    with rogue(grounded.fleet) as session:

        def both_refuse(_: Statuses) -> bool:
            told = two()
            for status in told:
                # For each program of the two; the ground orders nothing then.
                order = Order(
                    order_id=f"for {status.boot_nonce}",
                    robot_id=STOPPED,
                    boot_nonce=status.boot_nonce,
                    kind="takeoff",
                    expires_at_uptime_s=status.uptime_s + ORDER_LIFETIME_S / 2.0,
                    operator=status.operator,
                )
                session.put(f"lpac/{grounded.fleet.name}/ground/order", encode(order))
            return all(
                any(
                    answer.order_id == f"for {status.boot_nonce}"
                    and answer.refusal is not None
                    and answer.refusal.code is RefusalCode.NOT_READY
                    for answer in status.orders
                )
                for status in told
            )

        assert listener.wait_for(both_refuse, 60.0), grounded.told()
    for robot in (STOPPED, TWIN):
        assert not any(entry.armed for entry in grounded.truth(robot, 0.0))


def test_a_program_is_stopped_and_continued(rig: FaultRig) -> None:
    robot = rig.robot(STOPPED)
    program = rig.fleet.robots[robot]
    rig.wait_moving(robot)
    with rig.others_go_on(robot):
        program.send_signal(signal.SIGSTOP)
        began_s = rig.now_s(robot)
        rig.wait_time(robot, began_s + 4.0)
        silent_s = rig.last_setpoint_s(robot)
        assert rig.is_forgotten(robot)
        program.send_signal(signal.SIGCONT)
        status = rig.wait_state(robot, _S.HOLD)
        assert status.reason == status.alarms[0]
        assert status.reason.code is ReasonCode.CONTROL_SILENT
        rig.wait_vehicle(robot, lambda vehicle: vehicle.mode is Px4Mode.OFFBOARD)
        # Nothing but the operator's order makes it fly on.
        rig.wait_time(robot, rig.now_s(robot) + 5.0)
        assert rig.status(robot).state is _S.HOLD, rig.told()
        assert rig.max_speed_m_s(robot, silent_s + 1.5) < rig.at_rest_m_s
        # Its messages have come back.
        assert rig.is_heard(robot)


def test_a_program_is_killed(rig: FaultRig) -> None:
    robot = rig.robot(KILLED)
    program = rig.fleet.robots[robot]
    rig.wait_moving(robot)
    with rig.others_go_on(robot, lost=True):
        began_s = rig.now_s(robot)
        program.send_signal(signal.SIGKILL)
        assert program.wait(60.0) == -signal.SIGKILL
        rig.wait_vehicle(robot, is_down)
        assert rig.is_forgotten(robot)
    landing_s = comes_straight_down(rig, robot, began_s)
    assert rig.silence_before_landing_s(robot, landing_s) < 1.2
    silent_s = rig.last_setpoint_s(robot)
    assert rig.max_speed_m_s(robot, silent_s + 2.0, axes=2) < rig.at_rest_m_s


@pytest.mark.parametrize(("part", "within_s"), [("policy", 1.0), ("sensor", 2.0)])
def test_the_policy_raises_and_the_sensor_sees_nothing(
    rig: FaultRig, part: Literal["policy", "sensor"], within_s: float
) -> None:
    robot = rig.robot(FAULTY)
    program = rig.fleet.robots[robot]
    assert isinstance(program, FaultyRobot)
    rig.wait_moving(robot)
    with rig.others_go_on(robot):
        program.fail(part)
        began_s = rig.now_s(robot)
        status = rig.wait_state(robot, _S.HOLD)
        assert status.reason == status.alarms[0]
        assert status.reason.code is ReasonCode.POLICY_STALE
        rig.wait_time(robot, began_s + within_s + 5.0)
        # It brakes, and flies back slowly to where it was told to stop.
        assert rig.max_speed_m_s(robot, began_s + within_s + 1.0) < rig.at_rest_m_s + 0.15
        assert rig.max_speed_m_s(robot, began_s + within_s + 3.0) < rig.at_rest_m_s
        assert rig.order("start", robot).refusal is RefusalCode.POLICY_STALE
        program.mend()


def test_a_neighbours_messages_come_corrupt_old_and_from_another_bundle(rig: FaultRig) -> None:
    robot, bundle = rig.robot(STOPPED), rig.fleet.layout.bundle
    with rig.others_go_on(robot), rogue(rig.fleet) as session:
        key = f"lpac/{rig.fleet.name}/robot/{robot}/message"
        with session.declare_subscriber(key) as subscriber:
            genuine = subscriber.recv().payload.to_bytes()
        message = wire.decode(
            genuine[BEACON_BYTES:],
            bundle_id=bytes.fromhex(bundle.id),
            frame_id=None,
            own_robot_id=-1,
            message_size=LpacPolicy(bundle).message_size,
        )
        assert not isinstance(message, Rejection)
        wrong = {
            Rejection.MAGIC: bytes(len(genuine)),
            Rejection.TRUNCATED: genuine[: BEACON_BYTES + 50],
            Rejection.CHECKSUM: genuine[:-1] + bytes([genuine[-1] ^ 1]),
            Rejection.OTHER_BUNDLE: genuine[:BEACON_BYTES]
            + wire.encode(message, bytes(32), "float16"),
            Rejection.OUTDATED: genuine,
        }
        before = {other: rig.status(other).message_counts for other in rig.flying}

        def all_are_counted(statuses: Statuses) -> bool:
            for data in wrong.values():
                session.put(key, data)
            return before.keys() <= statuses.keys() and all(
                statuses[other].message_counts[kind] > counts[kind] + 5
                for other, counts in before.items()
                for kind in wrong
            )

        assert rig.listener.wait_for(all_are_counted, 60.0), rig.told()
        assert rig.listener.wait_for(
            lambda statuses: (
                before.keys() <= statuses.keys()
                and all(
                    statuses[other].message_counts["accepted"] > counts["accepted"] + 5
                    for other, counts in before.items()
                )
            ),
            60.0,
        )
        assert rig.is_heard(robot)
        assert flies_on(rig.status(robot))


@pytest.mark.parametrize("state", [_S.MISSION, _S.HOLD])
def test_the_estimators_origin_jumps(rig: FaultRig, state: FlightState) -> None:
    robot = rig.robot(MANY_FAULTS)
    with rig.others_go_on(robot):
        if state is _S.HOLD:
            rig.hold(robot)
            rig.wait_state(robot, _S.HOLD)
            rig.wait_time(robot, rig.now_s(robot) + 2.5)
        north_m = 5.6
        # Until its next setpoint the vehicle follows the last one, which is another place now: a
        # jump in which the robot was held up tells nothing. Ten such in a row count all the same.
        for _ in range(10):
            began_s, began_m = rig.jump_origin(robot, north_m, -0.75 * north_m, north_m)
            if longest_without_setpoint_s(rig, robot, began_s + 3.0) < 0.2:
                break
            north_m = -north_m
        status = rig.status(robot)
        assert status.state is state or (state is _S.MISSION and flies_on(status))

        # The mission position follows, but for the age of a status; the vehicle does not dash.
        def is_where_it_says(status: RobotStatus) -> bool:
            position_m, truly_m = status.position_m, rig.estimate_m(robot)
            return position_m is not None and math.dist(position_m[:2], truly_m[:2]) < 1.5

        rig.wait_status(robot, is_where_it_says)
        fastest_m_s = 0.5 if state is _S.HOLD else rig.fleet.layout.max_speed_m_s
        assert rig.max_speed_m_s(robot, began_s, axes=2) < fastest_m_s + 0.5
        moved_m = math.dist(rig.truth(robot, began_s)[-1].position_m[:2], began_m[:2])
        assert moved_m < (1.0 if state is _S.HOLD else 3.0 * rig.fleet.layout.max_speed_m_s)
        # Others fly above and below.
        assert all(
            abs(entry.position_m[2] - began_m[2]) < 1.5 for entry in rig.truth(robot, began_s)
        )
        if state is _S.HOLD:
            rig.resume(robot)


def test_a_vehicle_leaves_offboard(rig: FaultRig) -> None:
    robot = rig.robot(MANY_FAULTS)
    with rig.others_go_on(robot):
        with rig.simulated.stepped:
            rig.vehicle(robot).set_mode(Px4Mode.HOLD)
        status = rig.wait_state(robot, _S.PILOT)
        assert status.reason == status.alarms[0]
        assert status.reason.code is ReasonCode.LEFT_OFFBOARD
        nothing_is_sent(rig, robot)
        assert rig.vehicle(robot).mode is Px4Mode.HOLD
        assert rig.order("start", robot).code is ResultCode.WRONG_STATE
        assert rig.refusal("start", robot) is RefusalCode.WRONG_STATE
        assert rig.order("rejoin", robot).done
        rig.wait_vehicle(robot, lambda vehicle: vehicle.mode is Px4Mode.OFFBOARD)


@pytest.mark.simulated_only("PX4's simulator has no remote control that can be taken away")
def test_a_remote_control_is_lost_and_comes_back(rig: FaultRig) -> None:
    robot = STOPPED
    with rig.others_go_on(robot):
        lost = ReasonCode.REMOTE_CONTROL_LOST
        rig.change(robot, rc_connected=False)
        status = rig.wait_status(robot, lambda status: lost in codes(status.alarms))
        assert status.remote_control is False
        assert rig.vehicle(robot).mode is Px4Mode.OFFBOARD
        rig.change(robot, rc_connected=True)
        rig.wait_status(robot, lambda status: lost not in codes(status.alarms))


@pytest.mark.simulated_only("PX4's own vehicle model has no wind that can be set in flight")
def test_wind_carries_a_robot_over_the_fence(rig: FaultRig) -> None:
    robot, fence = rig.robot(MANY_FAULTS), rig.fleet.layout.fence
    with rig.others_go_on(robot):
        heard_s = time.monotonic()
        rig.push_over_the_fence(robot)
        least_m = 0.0

        def is_back(_: Px4Vehicle) -> bool:
            nonlocal least_m
            inside_m = rig.inside_m(robot)
            least_m = min(least_m, inside_m)
            return inside_m > fence.buffer_m / 2.0

        rig.wait_vehicle(robot, is_back)
        assert -PX4_FENCE_M < least_m < 0.0
        for _, status in rig.heard(robot, heard_s):
            assert flies_on(status), (status.state, status.reason)


@pytest.mark.simulated_only(
    "nobody flies a real PX4 by sticks here; a ground station's HOLD is flown"
)
def test_a_pilot_takes_a_robot_out_of_the_area_and_brings_it_back(rig: FaultRig) -> None:
    robot = STOPPED
    with rig.others_go_on(robot):
        place_m = rig.estimate_m(robot)
        outside_m = place_m + (rig.inside_m(robot) + 2.0) * rig.outwards(robot)
        rig.fly_by_hand(robot, outside_m)
        status = rig.wait_state(robot, _S.PILOT)
        assert status.reason == status.alarms[0]
        assert (status.reason.code, status.mode) == (ReasonCode.PILOT, "position")
        nothing_is_sent(rig, robot)
        # Messages and perception go on.
        assert rig.is_heard(robot)
        ticks = status.loops["perception"].ticks
        rig.wait_status(robot, lambda status: status.loops["perception"].ticks > ticks)
        assert rig.order("rejoin", robot).refusal is RefusalCode.OUTSIDE_FENCE
        rig.fly_by_hand(robot, place_m + np.array([0.0, 0.0, 3.0]))
        assert rig.order("rejoin", robot).refusal is RefusalCode.NOT_AT_HEIGHT
        rig.fly_by_hand(robot, place_m)
        rig.wait_vehicle(robot, lambda v: math.hypot(*v.velocity_m_s) < rig.at_rest_m_s)
        assert rig.status(robot).state is _S.PILOT
        began_s = rig.now_s(robot)
        assert rig.order("rejoin", robot).done
        rig.wait_vehicle(robot, lambda vehicle: vehicle.mode is Px4Mode.OFFBOARD)
        # Nothing but the operator's order makes it fly on.
        rig.wait_time(robot, rig.now_s(robot) + 3.0)
        assert rig.status(robot).state is _S.HOLD
        assert rig.max_speed_m_s(robot, began_s) < 2.0 * rig.at_rest_m_s


def test_gps_is_lost(rig: FaultRig) -> None:
    robot = rig.robot(NO_GPS)
    rig.wait_moving(robot)
    with rig.others_go_on(robot, lost=True):
        heard_s, began_s = time.monotonic(), rig.lose_gps(robot)
        held_up_s = longest_without_setpoint_s(rig, robot, began_s + 5.0)
        rig.wait_landed(robot)
        landing = [h.status for h in rig.heard(robot, heard_s) if h.status.state is _S.LAND]
        assert {status.reason.code for status in landing} == {ReasonCode.POSITION_LOST}
        assert landing[0].position_cause is PositionCause.NO_FIX
        # Its estimate drifts by metres on the way; and once PX4 gives it up, the wind carries it.
        descent_s = [e.time_s for e in rig.truth(robot, began_s) if e.mode is Px4Mode.DESCEND]
        carried_m = rig.wind_m_s * (max(descent_s) - min(descent_s)) if descent_s else 0.0
        landing_s = comes_straight_down(rig, robot, began_s, rig.drift_m + carried_m)
        # 2.4 s, and the messages on the way; besides what this machine kept the robot waiting.
        assert landing_s - began_s < 3.3 + max(held_up_s - 0.2, 0.0)
        before = [entry for entry in rig.truth(robot, began_s) if entry.time_s <= landing_s]
        assert math.dist(before[0].position_m[:2], before[-1].position_m[:2]) < 3.5
        # By then it stands, but for the last of its braking.
        standing = [entry for entry in before if entry.time_s > landing_s - 0.3]
        speeds_m_s = [speed_m_s(entry.velocity_m_s, 2) for entry in standing]
        assert max(speeds_m_s) < rig.at_rest_m_s + 0.15
        # From there it goes after an estimate that drifts, as long as PX4 goes by that.
        down_s = min([*descent_s, rig.truth(robot, began_s)[-1].time_s])
        for entry in rig.truth(robot, max(began_s + 3.0, landing_s)):
            assert speed_m_s(entry.velocity_m_s, 2) < rig.drift_m_s or entry.time_s >= down_s


def test_the_battery_is_critical(rig: FaultRig) -> None:
    robot = rig.robot(EMPTY)
    with rig.others_go_on(robot, lost=True):
        began_s = rig.drain(robot, 0.145)
        status = rig.wait_state(robot, _S.LAND)
        assert status.reason == status.alarms[0]
        assert status.reason.code is ReasonCode.BATTERY_CRITICAL
        rig.wait_landed(robot)
        comes_straight_down(rig, robot, began_s)


def test_the_battery_is_low(rig: FaultRig) -> None:
    robot = rig.robot(LOW)
    with rig.others_go_on(robot, lost=True):
        heard_s = time.monotonic()
        rig.drain(robot, 0.245)
        status = rig.wait_state(robot, _S.RETURN)
        # Below its percentage, or too little for the way home, whichever comes first.
        assert status.reason.code is status.alarms[0].code is ReasonCode.BATTERY_LOW
        rig.wait_landed(robot)
        told = [heard.status for heard in rig.heard(robot, heard_s)]
        # Whether it still says "mission" once is a matter of the instant.
        states = dict.fromkeys(status.state for status in told if not flies_on(status))
        assert [*states][:2] == [_S.RETURN, _S.LAND]
        landed_m = rig.true_position_m(robot)
        # What its receiver errs by has walked since the pad was measured.
        assert math.dist(landed_m[:2], rig.fleet.layout.pads_m[robot]) < 2.5


def test_a_robot_is_killed_by_the_operator(rig: FaultRig) -> None:
    robot = rig.robot(MANY_FAULTS)
    with rig.others_go_on(robot, lost=True):
        began_s = rig.now_s(robot)
        assert rig.order("kill", robot).done
        status = rig.wait_state(robot, _S.FAULT)
        assert status.reason == status.alarms[0]
        assert status.reason.code is ReasonCode.KILLED
        rig.wait_vehicle(robot, is_down)
        disarmed = next(entry for entry in rig.truth(robot, began_s) if not entry.armed)
        assert disarmed.position_m[2] < -0.5 * status.slot_height_m
        # It stays so.
        rig.wait_time(robot, rig.now_s(robot) + 2.0)
        assert rig.order("takeoff", robot).code is ResultCode.WRONG_STATE
        assert rig.refusal("takeoff", robot) is RefusalCode.WRONG_STATE


def test_the_ground_disappears(rig: FaultRig) -> None:
    rig.start()
    heard_s = time.monotonic()
    began_s = {robot: rig.now_s(robot) for robot in rig.flying}
    rig.ground.kill()
    lost = ReasonCode.GROUND_LOST
    for robot in rig.flying:
        rig.wait_status(robot, lambda s: s.state is _S.HOLD and lost in codes(s.alarms))
    for robot in rig.flying:
        rig.wait_landed(robot)
        told = [heard.status for heard in rig.heard(robot, heard_s)]
        assert [*dict.fromkeys(status.state for status in told)] == [
            _S.MISSION, _S.HOLD, _S.LAND, _S.LANDED
        ]  # fmt: skip
        comes_straight_down(rig, robot, began_s[robot])
        # 3 s and 10 s from the last word, and not sooner.
        for state, least_s, most_s in ((_S.HOLD, 3.0, 16.0), (_S.LAND, 13.0, math.inf)):
            # The first may have been made while the state changed.
            _, *silent_s = (
                status.ground_age_s or 0.0
                for status in told
                if status.state is state and status.reason.code is ReasonCode.GROUND_LOST
            )
            assert all(least_s < age_s < most_s for age_s in silent_s), (robot, silent_s)
