"""One robot's control ticks in simulated time: no thread, no socket, a simulated vehicle."""

import dataclasses
import math
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs
from pymavlink.dialects.v20 import common as mavlink

from edge.core import F32
from edge.core.fence import Fence
from edge.core.position import PositionQuality
from edge.core.vehicle import (
    Action,
    ActionResult,
    EstimatorStatus,
    GlobalOrigin,
    Gps,
    Mode,
    Setpoint,
    Vector,
    VehicleState,
    Velocity,
)
from edge.core.wire import FLOAT_PAYLOADS
from edge.core.world import rasterize
from edge.drivers.px4.telemetry import Px4Telemetry
from edge.drivers.world_sensor import WorldSensor
from edge.flight.state import FlightInputs
from edge.identity.guard import Sender
from edge.identity.members import Role
from edge.messages.beacon import Beacon, Neighbour
from edge.messages.codec import encode
from edge.messages.codes import CheckCode, FailedCheck, Reason, ReasonCode, RefusalCode
from edge.messages.mission import (
    ON_GROUND,
    Echo,
    FlightState,
    GroundState,
    Order,
    OrderKind,
    OrderResult,
    Origin,
    Place,
)
from edge.policy.lpac.policy import LpacPolicy
from edge.robot.config import load_config
from edge.robot.control import FlightControl, GroundWorld
from edge.robot.inbox import Inbox
from edge.robot.navigation import Navigation
from edge.robot.neighbours import NeighbourTable
from edge.robot.pac import Pac
from edge.robot.readiness import Checks
from lpac.analysis.worlds import random_features
from lpac.sim.px4.link import Px4Link
from lpac.sim.px4.modes import MavResult, Px4Mode
from lpac.sim.px4.vehicle import Px4Setpoint, Px4Vehicle
from tests.robot_rig import ORIGIN, new_vehicle, write_config
from tests.said import checks, codes, why
from tests.unit.flight.test_preflight import NEIGHBOUR

ANYBODY = Sender(Role.OPERATOR, "")

FENCE = Fence(((0.0, 0.0), (30.0, 0.0), (30.0, 30.0), (0.0, 30.0)), 1.5, 2.0, 28.0)
PLACE = Place(slot=1, landing_point_m=(14.0, 12.0))
ELSEWHERE = dataclasses.replace(ORIGIN, heading_deg=120.0)
MODES = {
    Px4Mode.OFFBOARD: Mode.OFFBOARD,
    Px4Mode.HOLD: Mode.HOLD,
    Px4Mode.LAND: Mode.LAND,
    Px4Mode.POSCTL: Mode.POSITION,
    Px4Mode.TAKEOFF: Mode.TAKEOFF,
}
NOT_SET = (math.nan,) * 3
WORLD = rasterize(random_features(np.random.default_rng(0), 10, 512), 512)


class DirectAutopilot:
    """An `Autopilot` port that calls the simulated vehicle."""

    def __init__(self, vehicle: Px4Vehicle) -> None:
        self.vehicle = vehicle
        self.commands: list[Action] = []
        self.result: ActionResult | None = None
        self.failsafe = False

    def state(self) -> VehicleState:
        vehicle = self.vehicle
        return VehicleState(
            connected=True,
            system_id=7,
            position_local_m=vector(vehicle.local_position_m),
            velocity_local_m_s=vector(vehicle.velocity_m_s),
            position_at_s=vehicle.time_s,
            position_changed_at_s=vehicle.time_s,
            heading_rad=vehicle.heading_rad,
            origin=GlobalOrigin(*vehicle.global_origin),
            gps=Gps(0 if vehicle.gps_lost else 3, 14, 0.8, at_s=vehicle.time_s),
            estimator=EstimatorStatus(vehicle.position_valid, False, vehicle.time_s),
            height_above_home_m=float(-vehicle.position_m[2]),
            mode=MODES[vehicle.mode],
            armed=vehicle.armed,
            in_air=not vehicle.landed,
            failsafe=self.failsafe,
            heartbeat_at_s=vehicle.time_s,
            battery=vehicle.battery_remaining,
            result=self.result,
        )

    def send(self, setpoint: Setpoint) -> Setpoint | None:
        commanded = setpoint[0]
        is_velocity = isinstance(setpoint, Velocity)
        self.vehicle.offboard(
            Px4Setpoint(
                NOT_SET if is_velocity else commanded, commanded if is_velocity else NOT_SET
            )
        )
        return setpoint

    def command(self, action: Action) -> None:
        self.commands.append(action)
        match action:
            case Action.ARM:
                result = self.vehicle.arm()
            case Action.DISARM | Action.KILL:
                result = self.vehicle.disarm(force=action is Action.KILL)
            case _:
                result = self.vehicle.set_mode(Px4Mode[action.name])
        self.result = ActionResult(action, result is MavResult.ACCEPTED, "", self.vehicle.time_s)


class ListeningAutopilot(DirectAutopilot):
    """One that knows of the vehicle what it says by MAVLink."""

    def __init__(self, vehicle: Px4Vehicle) -> None:
        super().__init__(vehicle)
        self._link, self._telemetry = Px4Link(vehicle, system_id=7), Px4Telemetry()
        self._parser: Any = mavlink.MAVLink(None)

    def state(self) -> VehicleState:
        now_s = self.vehicle.time_s
        for datagram in self._link.due():
            for message in self._parser.parse_buffer(datagram) or ():
                if message.get_type() in self._telemetry.messages:
                    self._telemetry.receive(message.get_type(), message.to_dict(), now_s)
        return structs.replace(self._telemetry.state(now_s), system_id=7, result=self.result)


class Flown:
    """A robot whose ground, policy and vehicle a test steps through time."""

    def __init__(
        self,
        folder: Path,
        policy: LpacPolicy,
        autopilot: type[DirectAutopilot] = DirectAutopilot,
        vehicle: Px4Vehicle | None = None,
    ) -> None:
        path = write_config(folder, url="udpin://127.0.0.1:1", endpoint="tcp/127.0.0.1:1")
        config = load_config(path)
        self.vehicle = new_vehicle(COM_OBL_RC_ACT=4) if vehicle is None else vehicle
        self.autopilot = autopilot(self.vehicle)
        self.records: list[tuple[str, Mapping[str, Any]]] = []
        self.navigation = Navigation(self.autopilot, lambda: self.now_s, config.position)
        self.inbox = Inbox(config.robot_id, config.flight.ground_timeout_s)
        self.pac = Pac(
            robot_id=config.robot_id, policy=policy, sensor=WorldSensor(WORLD, 64),
            odometry=self.navigation, parameters=config.pac(FLOAT_PAYLOADS),
        )  # fmt: skip
        self.control = FlightControl(
            robot=config.robot(boot_nonce=11),
            world_id="configured",
            vehicle=self.autopilot,
            navigation=self.navigation,
            pac=self.pac,
            inbox=self.inbox,
            recorder=self,
            energy=config.energy,
            unix_clock_s=lambda: self.now_s,
            started_s=self.now_s,
        )
        self.ground = GroundState(sequence=1, operator="test", origin=ORIGIN, enabled=True)
        self.failed_checks: tuple[FailedCheck, ...] = ()
        self.sent = False
        self.images: F32 | None = None
        self._ticks = self._orders = 0

    @property
    def now_s(self) -> float:
        return self.vehicle.time_s

    @property
    def recording(self) -> bool:
        return True

    @property
    def state(self) -> FlightState:
        return self.control.flight.state

    def record(self, topic: str, _: float, message: Mapping[str, object]) -> None:
        self.records.append((topic, message))

    def say(self, **changes: Any) -> None:
        self.ground = dataclasses.replace(self.ground, sequence=self.ground.sequence + 1, **changes)

    def tick(self) -> None:
        """One tenth of a second of everything."""
        self.inbox.receive_ground(encode(self.ground), ANYBODY, self.now_s)
        self.look()
        if self._ticks % 2 == 0:
            perceived = self.pac.perceive(self.now_s)
            self.images = None if perceived is None else perceived.inputs["images"]
        if self._ticks % 4 == 0:
            self.pac.infer(self.now_s)
        self._ticks += 1
        self.sent = self.control.tick(self.now_s)
        for _ in range(2):
            self.vehicle.step(0.05)

    def look(self) -> None:
        """Preflight's part."""
        self.control.checks = Checks(self.failed_checks, self.now_s, self.control.assignment)

    def until(self, *states: FlightState) -> None:
        for _ in range(400):
            if self.state in states:
                return
            self.tick()
        raise AssertionError(self.control.flight)

    def order(self, kind: OrderKind, trial: str = "") -> OrderResult:
        self._orders += 1
        order = Order(
            order_id=str(self._orders), robot_id=3, boot_nonce=11, kind=kind,
            expires_at_uptime_s=self.now_s + 9.0, operator="test", trial=trial,
        )  # fmt: skip
        self.inbox.receive_order(encode(order), ANYBODY, self.now_s)
        self.tick()
        return self.control.flight.answers[-1]

    def take_off(self) -> None:
        self.until(FlightState.PREFLIGHT)
        assert self.order("takeoff").accepted
        self.until(FlightState.HOLD)

    def take_off_by_hand(self, height_m: float) -> None:
        """Somebody flies it, and leaves it to PX4 to hold."""
        self.vehicle.parameters["MIS_TAKEOFF_ALT"] = height_m
        self.vehicle.step(0.02)
        assert self.vehicle.arm() is MavResult.ACCEPTED
        assert self.vehicle.set_mode(Px4Mode.TAKEOFF) is MavResult.ACCEPTED
        for _ in range(150):
            self.tick()
        self.vehicle.set_mode(Px4Mode.HOLD)
        self.tick()

    def explore(self, trial: str) -> None:
        assert self.order("start", trial).accepted
        for _ in range(60):
            self.tick()
        assert self.state is FlightState.MISSION

    def explored(self) -> int:
        """How much of its surroundings the robot knows, in pixels of its local map."""
        assert self.images is not None
        return int((self.images[0, 0] > 0.0).sum())

    def peers(self, *beacons: Beacon, age_s: float = 0.1) -> None:
        """What other robots said of themselves."""
        self.pac.table = NeighbourTable(3)
        for beacon in beacons:
            self.pac.table.receive(beacon, (1, 1), None, self.now_s - age_s, None)

    def inputs(self) -> FlightInputs:
        """Inputs of the last tick."""
        topic, message = self.records[-1]
        assert topic == "flight"
        inputs: FlightInputs = message["given"].inputs
        return inputs

    def silent(self) -> tuple[Neighbour, ...]:
        """Neighbours that the last tick treated as silent."""
        return self.inputs().fell_silent

    def lands_beside_m(self) -> tuple[float, float] | None:
        """Where the last tick was to land, if not at its landing point."""
        return self.inputs().lands_beside_m

    def odometry(self) -> Vector:
        odometry = self.navigation.odometry()
        assert odometry is not None
        return odometry.position_m


def peer(robot_id: int, state: FlightState, position_m: Vector = (100.0, 0.0, 9.0)) -> Beacon:
    return dataclasses.replace(
        NEIGHBOUR,
        robot_id=robot_id,
        state=state,
        armed=state not in ON_GROUND,
        position_m=position_m,
        frame_id=ORIGIN.frame().frame_id,
    )


def vector(values: Any) -> Vector:
    x, y, z = values.tolist()
    return x, y, z


@pytest.fixture
def flown(tmp_path: Path, shipped_policy: LpacPolicy) -> Flown:
    return Flown(tmp_path, shipped_policy)


def test_it_flies_what_it_is_told_and_lands(flown: Flown) -> None:
    flown.until(FlightState.PREFLIGHT)
    assert not flown.sent
    flown.take_off()
    assert flown.sent
    assert abs(-flown.vehicle.position_m[2] - 5.0) < 0.8
    flown.explore("a")
    assert np.linalg.norm(flown.vehicle.velocity_m_s[:2]) > 0.2
    flown.say(safety_action="hold")
    flown.until(FlightState.HOLD)
    flown.say(safety_action="return")
    flown.until(FlightState.LANDED)
    assert not flown.sent
    assert not flown.vehicle.armed
    assert flown.autopilot.commands.count(Action.ARM) == 1
    flown.say(safety_action="none")
    flown.take_off()
    topics = [topic for topic, _ in flown.records]
    assert topics.count("control") == round(flown.now_s / 0.1)
    assert topics.count("ground") == flown.ground.sequence
    answers = [message["answer"] for topic, message in flown.records if topic == "order"]
    assert answers == [OrderResult(str(number)) for number in (1, 2, 3)]


def test_what_the_watchdog_did_in_a_tick_that_took_long_is_not_taken_for_a_pilots(
    flown: Flown,
) -> None:
    flown.take_off()
    flown.explore("a")
    now_s = flown.now_s
    # Late, but the watchdog has not acted.
    flown.control.note_silence(now_s - 0.4, now_s)
    flown.tick()
    assert (flown.state, flown.vehicle.mode) == (FlightState.MISSION, Px4Mode.OFFBOARD)
    flown.vehicle.set_mode(Px4Mode.HOLD)
    flown.control.note_silence(now_s - 0.5, now_s)
    flown.tick()
    assert flown.state is FlightState.HOLD
    assert flown.control.flight.reason == Reason(
        ReasonCode.CONTROL_SILENT, "control was silent for 0.6 s"
    )
    for _ in range(50):
        flown.tick()
    assert flown.state is FlightState.HOLD and flown.vehicle.mode is Px4Mode.OFFBOARD


@pytest.mark.parametrize("state", [FlightState.HOLD, FlightState.MISSION, FlightState.RETURN])
@pytest.mark.parametrize("jump_m", [(0.0, 0.0, 6.0), (0.0, 0.0, -10.0), (5.0, 0.0, -1.3)])
def test_it_stays_at_its_height_when_the_estimate_of_it_jumps(
    tmp_path: Path, shipped_policy: LpacPolicy, state: FlightState, jump_m: Vector
) -> None:
    """North, east, down: without a new origin. The vehicle itself has not moved."""
    flown = Flown(tmp_path, shipped_policy, ListeningAutopilot)
    flown.take_off()
    if state is not FlightState.HOLD:
        flown.explore("a")
    if state is FlightState.RETURN:
        flown.say(safety_action="return")
        flown.until(state)
    before_m = -flown.vehicle.position_m[2]
    flown.vehicle.gps_bias_m = jump_m
    qualities = []
    for _ in range(100 if state is not FlightState.RETURN else 30):
        flown.tick()
        assert flown.state is state
        assert abs(-flown.vehicle.position_m[2] - before_m) < 1.0
        qualities.append(flown.navigation.position.quality)
    assert set(qualities) == {PositionQuality.GOOD, PositionQuality.DOUBTFUL}
    assert abs(flown.odometry()[2] - 5.0) < 0.8
    doubted = [r["height_m"] for t, r in flown.records[-30:] if t == "control"]
    assert max(doubted) - min(doubted) < 1.0
    if state is FlightState.HOLD:
        flown.say(safety_action="land")
        flown.until(FlightState.LANDED)


def test_the_grounds_word_is_as_old_as_it_is_by_the_clock_of_whoever_says_it(flown: Flown) -> None:
    flown.until(FlightState.PREFLIGHT)

    def age_s(base: int, ahead_s: float, late_s: float = 0.0, boot_nonce: int = 11) -> float:
        """Age of the ground's state, received `late_s` ago from a clock `ahead_s` ahead."""
        said_s = flown.now_s - late_s
        echo = Echo(boot_nonce, uptime_s=said_s, held_s=0.0)
        flown.say(time_base=base, time_s=said_s + ahead_s, echoes={"3": echo})
        flown.tick()
        return flown.control.ground_age_s(flown.now_s)

    # Another start of this program is not answered for this one.
    assert age_s(1, 1000.0, boot_nonce=12) < 0.3 and flown.pac.clock.at(flown.now_s) is None
    assert age_s(1, 1000.0) < 0.3 and flown.pac.clock.at(flown.now_s) is not None
    # What was overtaken on its way is not the newest.
    assert age_s(1, 1000.0, late_s=2.0) < 0.3
    # Another ground's clock begins anew.
    assert [age_s(2, 5.0) for _ in range(20)][-1] < 0.3
    for _ in range(20):
        flown.tick()
    assert flown.control.ground_age_s(flown.now_s) > 1.5


def test_only_another_mission_makes_it_forget_what_it_saw(flown: Flown) -> None:
    flown.take_off()
    flown.explore("a")
    explored = flown.explored()
    for trial, forgets in (("a", False), ("b", True)):
        flown.say(safety_action="hold")
        flown.until(FlightState.HOLD)
        flown.say(safety_action="none")
        flown.tick()
        assert flown.order("start", trial).accepted
        flown.tick()
        flown.tick()
        assert (flown.explored() < 0.9 * explored) is forgets
        assert flown.control.flight.trial == trial
        assert flown.pac._trial == zlib.crc32(trial.encode())


def test_another_origin_counts_on_the_ground_alone(flown: Flown) -> None:
    def place() -> Origin | None:
        assert flown.navigation.frame is not None
        origin = flown.control.assignment.origin
        assert origin is not None
        assert flown.navigation.frame.frame_id == origin.frame().frame_id
        assert flown.pac.frame_id == flown.navigation.frame.frame_id
        return origin

    flown.take_off()
    flown.say(origin=ELSEWHERE)
    flown.tick()
    assert place() == ORIGIN
    flown.say(safety_action="land")
    flown.until(FlightState.LANDED)
    flown.tick()
    assert place() == ELSEWHERE


def test_what_was_known_by_one_origin_is_forgotten_with_another(flown: Flown) -> None:
    def known() -> tuple[list[int], list[int], bool]:
        """Ids of silent robots and of neighbours, and whether the landing point is taken."""
        inputs = flown.inputs()
        silent, kept_away = (
            [each.robot_id for each in some] for some in (inputs.fell_silent, inputs.neighbours)
        )
        return silent, kept_away, inputs.lands_beside_m is not None

    flown.until(FlightState.PREFLIGHT)
    x_m, y_m = flown.control.assignment.robot.parameters.landing_point_m
    others = (
        peer(5, FlightState.LANDED, (x_m + 1.0, y_m, 0.0)),
        peer(6, FlightState.MISSION, (60.0, 0.0, 9.0)),
        peer(7, FlightState.HOLD, (90.0, 0.0, 9.0)),
    )
    # Where somebody is by another one tells nothing.
    flown.peers(*(dataclasses.replace(each, frame_id=0) for each in others))
    flown.tick()
    assert known() == ([], [], False)
    flown.peers(*others)
    flown.tick()
    flown.control.revoked = frozenset({7})
    flown.peers()
    flown.tick()
    assert known() == ([6], [7], True)
    flown.say(fence=dataclasses.replace(flown.control.assignment.robot.fence, ceiling_m=29.0))
    flown.tick()
    assert known() == ([6], [7], True)
    one_look = flown.pac.explored().sum()
    flown.say(origin=dataclasses.replace(ORIGIN, latitude_deg=ORIGIN.latitude_deg - 5e-5))
    flown.tick()
    assert known() == ([], [], False)
    flown.tick()
    flown.tick()
    assert flown.pac.explored().sum() <= one_look


def test_a_program_that_starts_in_flight_takes_the_origin_it_hears(flown: Flown) -> None:
    flown.vehicle.arm(force=True)
    flown.until(FlightState.PILOT)
    # It needs to know where it is first.
    for _ in range(100):
        flown.tick()
    assert flown.control.assignment.origin == ORIGIN
    assert not flown.sent
    assert flown.autopilot.commands == []


def flies_by(flown: Flown) -> tuple[Fence, Place, str]:
    _, robot, world_id = flown.control.assignment
    return robot.fence, robot.place, world_id


def test_fence_and_place_are_taken_up_together_on_the_ground_and_given_back(flown: Flown) -> None:
    flown.until(FlightState.PREFLIGHT)
    configured = flies_by(flown)
    flown.say(fence=FENCE, places={"3": PLACE, "4": Place(7, (1.0, 1.0))})
    # The checks were made for another fence.
    assert why(flown.order("takeoff")) is RefusalCode.CHECKS_RUNNING
    assert flies_by(flown) == (FENCE, PLACE, "configured")
    flown.take_off()
    assert abs(-flown.vehicle.position_m[2] - 9.5) < 0.8
    flown.say(fence=None, places={}, origin=ELSEWHERE, world_id="other")
    flown.tick()
    assert flies_by(flown) == (FENCE, PLACE, "configured")
    kept = (
        FailedCheck(CheckCode.KEEPS_ORIGIN, "in flight: keeps its mission origin"),
        FailedCheck(CheckCode.KEEPS_FENCE, "in flight: keeps its fence"),
        FailedCheck(CheckCode.KEEPS_PLACE, "in flight: keeps its place"),
        FailedCheck(CheckCode.KEEPS_WORLD, "in flight: keeps its world"),
    )
    assert flown.control.not_taken == kept
    assert why(flown.order("start", "a")) is RefusalCode.NOT_TAKEN_UP
    flown.say(safety_action="land", world_id=None)
    flown.until(FlightState.LANDED)
    flown.tick()
    assert flies_by(flown) == configured
    assert not flown.control.not_taken
    # Killed, it may have fallen anywhere.
    flown.say(safety_action="none")
    flown.until(FlightState.PREFLIGHT)
    assert flown.order("takeoff").accepted and flown.order("kill").accepted
    flown.say(fence=FENCE)
    flown.tick()
    text = "not known to be on the ground: keeps its fence"
    assert flown.control.not_taken == (FailedCheck(CheckCode.KEEPS_FENCE, text),)
    assert flies_by(flown) == configured


def test_a_place_outside_the_fence_leaves_both_as_they_were_and_keeps_it_down(flown: Flown) -> None:
    flown.until(FlightState.PREFLIGHT)
    before = flies_by(flown)
    for place, problem in (
        (Place(1, (29.0, 12.0)), "landing_point_m = [29.0, 12.0]: must be inside the fence, at"),
        (Place(30, (14.0, 12.0)), "slot = 30 flies at 140 m: must be from floor_m = 2 to"),
    ):
        flown.say(fence=FENCE, places={"3": place})
        assert why(flown.order("takeoff")) is RefusalCode.NOT_READY
        (unfit,) = flown.control.not_taken
        assert unfit.code is CheckCode.FENCE_OR_PLACE_UNFIT
        assert unfit.text.startswith(f"the ground's fence or place does not fit: {problem}")
        assert flies_by(flown) == before
    flown.say(fence=FENCE, places={"3": PLACE})
    flown.tick()
    assert flies_by(flown) == (FENCE, PLACE, "configured")


FAR = 300.0
FAR_FENCE = Fence(((0.0, 0.0), (FAR, 0.0), (FAR, FAR), (0.0, FAR)), 1.5, 2.0, 28.0)
FAR_ORIGIN = Origin(ORIGIN.latitude_deg + 0.003, ORIGIN.longitude_deg, 0.0)  # to the north


def test_what_is_out_of_its_reach_is_not_taken_up(flown: Flown) -> None:
    flown.until(FlightState.PREFLIGHT)
    before, origin = flies_by(flown), flown.control.assignment.origin
    high = dataclasses.replace(FENCE, ceiling_m=1e9)
    for said, code in (
        ({"origin": FAR_ORIGIN}, CheckCode.ORIGIN_OUT_OF_REACH),
        ({"fence": FAR_FENCE}, CheckCode.FENCE_OUT_OF_REACH),
        ({"fence": high, "places": {"3": PLACE}}, CheckCode.FENCE_OR_PLACE_UNFIT),
    ):
        flown.say(**{"origin": ORIGIN, "fence": None, "places": {}, **said})
        assert why(flown.order("takeoff")) is RefusalCode.NOT_READY
        assert codes(flown.control.not_taken) == [code]
        assert (flies_by(flown), flown.control.assignment.origin) == (before, origin)
    flown.say(origin=ORIGIN, fence=FENCE, places={"3": PLACE})
    flown.tick()
    assert flies_by(flown) == (FENCE, PLACE, "configured") and not flown.control.not_taken


def test_a_program_that_starts_in_flight_takes_up_nothing_out_of_its_reach(
    tmp_path: Path, shipped_policy: LpacPolicy
) -> None:
    flown = Flown(tmp_path, shipped_policy)
    flown.take_off()
    again = Flown(tmp_path, shipped_policy, vehicle=flown.vehicle)
    again.say(origin=ORIGIN, fence=FAR_FENCE)
    for _ in range(50):
        again.tick()
        assert again.control.assignment.robot.fence != FAR_FENCE
    assert again.state is FlightState.PILOT
    assert codes(again.control.not_taken) == [CheckCode.FENCE_OUT_OF_REACH]
    assert again.control.assignment.origin == ORIGIN


def test_a_world_is_waited_for_and_then_seen_instead_of_the_old_one(flown: Flown) -> None:
    flown.until(FlightState.PREFLIGHT)
    flown.say(world_id="flat")
    text = "world flat of the ground has not arrived: wait"
    waiting = FailedCheck(CheckCode.WORLD_NOT_ARRIVED, text, settles_by_itself=True)
    assert why(flown.order("takeoff")) is RefusalCode.NOT_READY
    assert flown.control.not_taken == (waiting,)
    assert flown.control.wanted_world_id == "flat"
    assert flown.explored() > 0
    flown.control.world = GroundWorld("stale", WorldSensor(np.ones((512, 512), np.float32), 64), "")
    flown.tick()
    assert flies_by(flown)[2] == "configured"
    flown.control.world = GroundWorld("flat", None, "world flat: record 1 (X): unknown kind")
    flown.tick()
    text = "the ground's world cannot be used: world flat: record 1 (X): unknown kind"
    problem = FailedCheck(CheckCode.WORLD_UNUSABLE, text)
    assert flown.control.failed_checks(flown.now_s) == (problem,)
    assert flown.control.wanted_world_id is None
    flown.control.world = GroundWorld("flat", WorldSensor(np.zeros((512, 512), np.float32), 64), "")
    flown.tick()
    assert flies_by(flown)[2] == "flat"
    # Its checks, and what it sees, are of the new one.
    flown.tick()
    assert flown.control.failed_checks(flown.now_s) == ()
    assert flown.explored() == 0
    flown.take_off()


def test_a_program_that_starts_in_flight_flies_on_by_what_the_ground_says(flown: Flown) -> None:
    """What it was configured for is not what its predecessor took off with."""
    flown.say(fence=FENCE, places={"3": PLACE}, world_id="flat")
    flown.take_off_by_hand(9.5)
    assert flies_by(flown) == (FENCE, PLACE, "configured")
    flown.control.world = GroundWorld("flat", WorldSensor(np.zeros((512, 512), np.float32), 64), "")
    flown.tick()
    assert flies_by(flown) == (FENCE, PLACE, "flat")
    assert flown.order("rejoin").accepted
    flown.say(fence=None)
    flown.tick()
    assert flies_by(flown) == (FENCE, PLACE, "flat")
    assert codes(flown.control.not_taken) == [CheckCode.KEEPS_FENCE]


def test_a_reset_forgets_what_was_seen_and_moves_nothing(flown: Flown) -> None:
    flown.take_off()
    flown.explore("a")
    explored = int(flown.pac.explored().sum())
    flown.say(safety_action="hold")
    flown.until(FlightState.HOLD)
    assert flown.order("reset", "b").accepted
    flown.tick()
    assert int(flown.pac.explored().sum()) < explored
    assert (flown.state, flown.control.flight.trial) == (FlightState.HOLD, "")


def test_checks_count_for_their_origin_and_not_for_long(
    flown: Flown, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown.failed_checks = checks("GPS is not heard")
    flown.until(FlightState.PREFLIGHT)
    assert why(flown.order("takeoff")) is RefusalCode.NOT_READY
    flown.failed_checks = ()
    flown.tick()
    with monkeypatch.context() as slow:
        slow.setattr(flown, "look", lambda: None)
        # Preflight is slow: what it found was for the origin before.
        flown.say(origin=ELSEWHERE)
        assert why(flown.order("takeoff")) is RefusalCode.CHECKS_RUNNING
        # Nor does it count when that is undone: the vehicle may have the other fence by now.
        flown.say(origin=ORIGIN)
        assert why(flown.order("takeoff")) is RefusalCode.CHECKS_RUNNING
    flown.tick()
    assert flown.control.failed_checks(flown.now_s) == ()
    monkeypatch.setattr(flown, "look", lambda: None)
    for _ in range(51):
        flown.tick()
    assert why(flown.order("takeoff")) is RefusalCode.CHECKS_RUNNING
    assert Action.ARM not in flown.autopilot.commands


def test_it_does_not_start_while_others_take_off(flown: Flown) -> None:
    flown.take_off()
    for state in (FlightState.ARMING, FlightState.TAKEOFF):
        flown.peers(peer(5, state), peer(6, FlightState.HOLD))
        assert why(flown.order("start", "a")) is RefusalCode.OTHERS_TAKE_OFF
    flown.peers(peer(5, FlightState.HOLD))
    assert flown.order("start", "a").accepted


def test_a_robot_whose_policy_is_silent_is_kept_away_from_by_its_beacon(flown: Flown) -> None:
    flown.take_off()
    x_m, y_m, height_m = flown.odometry()
    near = peer(5, FlightState.HOLD, (x_m + 1.0, y_m, height_m))
    flown.peers(near, age_s=1.4)
    assert why(flown.order("start", "a")) is RefusalCode.TOO_CLOSE
    # What it said a while ago tells nothing.
    flown.peers(near, age_s=1.6)
    assert flown.order("start", "a").accepted
    # Nor does another program that says it is this robot.
    flown.peers(dataclasses.replace(near, robot_id=3))
    flown.tick()
    assert flown.inputs().neighbours == ()


@pytest.mark.parametrize(
    ("state", "above_its_height_m", "goes"),
    [
        (FlightState.HOLD, 0.0, False),
        (FlightState.PILOT, 0.0, True),
        # It sinks, and hangs there.
        (FlightState.MISSION, -1.4, False),
        (FlightState.MISSION, -1.6, True),
        # It is on its way to its height.
        (FlightState.TAKEOFF, -1.6, False),
    ],
)
def test_who_is_flown_by_a_pilot_or_off_its_height_is_kept_away_from_further(
    flown: Flown, state: FlightState, above_its_height_m: float, goes: bool
) -> None:
    flown.take_off()
    flown.explore("a")
    x_m, y_m, height_m = flown.odometry()
    other = dataclasses.replace(
        peer(5, state, (x_m, y_m + 3.0, height_m)), slot_height_m=height_m - above_its_height_m
    )
    for _ in range(50):
        flown.peers(other)
        flown.tick()
    assert (math.dist(flown.odometry()[:2], (x_m, y_m + 3.0)) > 4.5) == goes


def test_a_revoked_robot_is_kept_away_from_where_it_was_last(flown: Flown) -> None:
    flown.take_off()
    x_m, y_m, height_m = flown.odometry()
    around = ((1.2, 0.0), (-1.2, 0.0), (0.0, 1.2), (0.0, -1.2))
    flown.peers(
        *(
            peer(5 + i, FlightState.HOLD, (x_m + dx_m, y_m + dy_m, height_m))
            for i, (dx_m, dy_m) in enumerate(around)
        )
    )
    assert why(flown.order("start", "a")) is RefusalCode.TOO_CLOSE
    flown.control.revoked = frozenset({5, 6, 7, 8, 9})
    flown.peers()
    # It may have been a lie: the mission begins, and nothing flies there.
    flown.explore("a")
    assert math.dist(flown.odometry()[:2], (x_m, y_m)) < 0.3
    for _ in range(900):
        flown.tick()
    assert math.dist(flown.odometry()[:2], (x_m, y_m)) < 0.6
    # They are members again, and are silent for so long that they must be down.
    flown.control.revoked = frozenset()
    for _ in range(60):
        flown.tick()
    assert math.dist(flown.odometry()[:2], (x_m, y_m)) > 1.0


def test_who_fell_silent_in_flight_may_come_down_where_it_was(flown: Flown) -> None:
    flown.take_off()
    flown.explore("a")
    x_m, y_m, _ = flown.odometry()
    flown.peers(peer(5, FlightState.MISSION, (x_m, y_m + 1.0, 14.0)))
    flown.tick()
    flown.peers()

    for _ in range(200):
        flown.tick()
    assert math.dist(flown.odometry()[:2], (x_m, y_m + 1.0)) > 7.0
    # It is heard again, and is down.
    flown.peers(peer(5, FlightState.LANDED, (x_m, y_m + 1.0, 0.0)))
    flown.tick()
    flown.peers()
    flown.tick()
    assert flown.silent() == ()


def test_it_lands_beside_where_who_fell_silent_may_have_come_down(flown: Flown) -> None:
    flown.take_off()
    x_m, y_m = flown.control.assignment.robot.parameters.landing_point_m
    flown.peers(peer(5, FlightState.MISSION, (x_m + 1.0, y_m, 14.0)))
    flown.tick()
    flown.peers()
    # A radio may lose a few beacons.
    for _ in range(28):
        flown.tick()
        assert flown.lands_beside_m() is None
    # Long after it must be down.
    for _ in range(1172):
        flown.tick()
    assert flown.silent() == ()
    flown.say(safety_action="return")
    flown.until(FlightState.LAND)
    assert ReasonCode.LANDS_BESIDE in codes(flown.control.alarms)
    assert math.dist(flown.odometry()[:2], (x_m + 1.0, y_m)) > 7.0


def test_it_does_not_climb_past_one_that_fell_silent_above_it(flown: Flown) -> None:
    flown.until(FlightState.PREFLIGHT)
    x_m, y_m, _ = flown.odometry()
    flown.peers(peer(5, FlightState.HOLD, (x_m, y_m + 1.0, 4.5)))
    flown.tick()
    flown.peers()
    assert flown.order("takeoff").accepted
    flown.until(FlightState.LAND)
    heights_m = [
        message["height_m"] or 0.0 for topic, message in flown.records if topic == "control"
    ]
    assert 2.0 < max(heights_m) < 3.5


def test_who_flies_lower_has_the_first_choice_of_a_place_beside(flown: Flown) -> None:
    flown.take_off()
    x_m, y_m = flown.control.assignment.robot.parameters.landing_point_m
    stands = peer(5, FlightState.LANDED, (x_m + 1.0, y_m, 0.0))
    flown.peers(stands)
    flown.tick()
    first_m = flown.lands_beside_m()
    assert first_m is not None
    # Robots of lower and of greater heights return to just there.
    for slot_height_m, gives_way in ((4.9, True), (9.5, False)):
        flown.control._lands_beside_m = None
        other = peer(6, FlightState.RETURN, (*first_m, slot_height_m))
        other = dataclasses.replace(other, slot_height_m=slot_height_m, landing_point_m=(90.0, 0.0))
        flown.peers(stands, other)
        flown.tick()
        place_m = flown.lands_beside_m()
        assert place_m is not None
        assert (math.dist(place_m, first_m) >= 6.0) == gives_way


@pytest.mark.slow
@pytest.mark.parametrize(
    ("state", "height_m", "at_most_m"),
    [
        (FlightState.MISSION, 9.0, 9.0),
        (FlightState.LAND, 9.0, 9.0),
        (FlightState.TAKEOFF, 2.0, NEIGHBOUR.slot_height_m),
        (FlightState.PREFLIGHT, 0.0, None),
    ],
)
def test_who_flies_and_tells_no_place_is_taken_to_be_where_it_last_was(
    flown: Flown, state: FlightState, height_m: float, at_most_m: float | None
) -> None:
    told = peer(5, state, (50.0, 0.0, height_m))
    no_place = dataclasses.replace(told, position_m=None)
    restarted = dataclasses.replace(told, frame_id=0)
    flown.until(FlightState.PREFLIGHT)
    flown.peers(told)
    flown.tick()
    assert flown.silent() == ()
    expected = [] if at_most_m is None else [(50.0, 0.0, at_most_m)]
    for beacons in ((no_place,), (restarted,), ()):
        flown.peers(*beacons)
        flown.tick()
        assert [robot.position_m for robot in flown.silent()] == expected
    # At the latest it comes down after a minute, at half a metre a second.
    for wait_s, still in ((65.0 + 2.0 * (at_most_m or 0.0), expected), (3.0, [])):
        for _ in range(round(10.0 * wait_s)):
            flown.tick()
        assert [robot.position_m for robot in flown.silent()] == still


def test_it_knows_how_long_its_battery_lasts_and_the_way_home(flown: Flown) -> None:
    flown.say(fence=FENCE, places={"3": PLACE})
    flown.take_off()
    energy, robot = flown.control.energy, flown.control.assignment.robot
    assert energy is not None and energy.home_s is not None
    left = flown.vehicle.battery_remaining - robot.parameters.battery_critical
    assert energy.lasts_s == pytest.approx(900.0 * left, rel=0.02)
    flight_s = math.dist(flown.odometry()[:2], PLACE.landing_point_m) / robot.limits.max_speed_m_s
    # At 0.7 of its speed, after one lower robot, from 9.5 m down; and the reserve.
    assert energy.home_s == pytest.approx(flight_s / 0.7 + 10.0 + 24.0 + 60.0, abs=0.7)


@pytest.mark.parametrize("on_stop", [Action.HOLD, Action.LAND])
def test_what_it_leaves_behind(flown: Flown, on_stop: Action) -> None:
    leave = flown.control.leave
    assert leave(on_stop) is None
    flown.until(FlightState.PREFLIGHT)
    assert leave(on_stop) is None
    assert flown.order("takeoff").accepted
    assert flown.state is FlightState.ARMING
    assert leave(on_stop) is Action.DISARM
    flown.until(FlightState.TAKEOFF)
    assert leave(on_stop) is on_stop
    flown.until(FlightState.HOLD)
    assert leave(on_stop) is on_stop
    flown.explore("a")
    assert leave(on_stop) is on_stop
    # The watchdog was first.
    flown.vehicle.set_mode(Px4Mode.HOLD)
    flown.vehicle.step(0.02)
    assert leave(on_stop) is on_stop
    # PX4's own failsafe was: neither this program nor its watchdog takes it from that.
    flown.autopilot.failsafe = True
    assert leave(on_stop) is None
    flown.tick()
    assert not flown.sent
    flown.autopilot.failsafe = False
    # PX4 lands by itself, or a pilot came, and no tick has seen it yet.
    flown.vehicle.set_mode(Px4Mode.LAND)
    flown.vehicle.step(0.02)
    assert leave(on_stop) is None
    flown.vehicle.pilot()
    flown.vehicle.step(0.02)
    assert leave(on_stop) is None
    flown.until(FlightState.PILOT)
    assert leave(on_stop) is None
