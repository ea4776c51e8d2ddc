"""The state machine flies a scripted vehicle, tick by tick, with guidance in the loop.

Every test with a `world` is a scenario: it runs once as it is, and again with telemetry that is up
to a second late on top of coming once a second.
"""

import functools
import math
import random
import re
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import replace
from inspect import signature

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import structs

from edge.core.fence import Fence
from edge.core.ports import Odometry
from edge.core.position import PositionJudgement, PositionLimits, PositionQuality, judge
from edge.core.vehicle import (
    PILOTED,
    Action,
    ActionResult,
    AutopilotReason,
    GlobalOrigin,
    Gps,
    Mode,
    VehicleState,
)
from edge.flight.energy import Energy
from edge.flight.guidance import (
    Guidance,
    MissionPosition,
    MissionSetpoint,
    MissionVelocity,
    guide,
)
from edge.flight.orders import ORDERS, refusal
from edge.flight.safety import Closest, MotionLimits
from edge.flight.state import (
    FlightInputs,
    FlightMemory,
    FlightParameters,
    Px4Change,
    RemoteControlLost,
    Robot,
    Tick,
    flown_s,
)
from edge.flight.step import Decision, enter, step
from edge.flight.transitions import TRANSITIONS, Transition
from edge.messages.codes import (
    CheckCode,
    FailedCheck,
    Reason,
    ReasonCode,
    Refusal,
    RefusalCode,
)
from edge.messages.mission import (
    FlightState,
    GroundState,
    Order,
    OrderKind,
    OrderResult,
    Origin,
    SafetyAction,
)
from edge.robot.navigation import MAX_POSITION_AGE_S
from tests.conftest import ROOT
from tests.said import why

TICK_S = 0.1
PERIOD_S = 1.0
ZERO_M = 7.3  # The estimator's zero is not the pad.
NOT_OURS = (
    FlightState.INIT,
    FlightState.IDLE,
    FlightState.PREFLIGHT,
    FlightState.LANDED,
    FlightState.PILOT,
    FlightState.FAULT,
)
ON_GROUND = NOT_OURS[:4]
AIRBORNE = (
    FlightState.TAKEOFF,
    FlightState.HOLD,
    FlightState.MISSION,
    FlightState.RETURN,
    FlightState.LAND,
)
SAFETY_PAGE = ROOT / "docs" / "safety.md"
FAULTS_PAGE = ROOT / "docs" / "faults.md"

FENCE = Fence(((0.0, 0.0), (32.0, 0.0), (32.0, 32.0), (0.0, 32.0)), 2.0, 1.0, 30.0)
ROBOT = Robot(
    robot_id=3,
    boot_nonce=77,
    parameters=FlightParameters(slot=1, landing_point_m=(10.0, 12.0)),
    fence=FENCE,
    limits=MotionLimits(2.0, 1.5, 1.5, 1.3),
)
SLOT_M = ROBOT.parameters.slot_height_m


def codes(decision: Decision) -> list[ReasonCode]:
    """Its alarms."""
    return [alarm.code for alarm in decision.alarms]


class World:
    """One robot's decisions, a crude PX4, and a ground; `heartbeats` come `latency_s` late.

    `repeats` is how often its receiver has told the same fix.
    """

    repeats = 0
    other_release = ""

    def __init__(
        self, phase_s: float = 0.35, latency_s: float = 0.1, *, flown_again: bool = False
    ) -> None:
        self.flown_again = flown_again
        self.robot = ROBOT
        self.now_s = 100.0
        self.latency_s = latency_s
        self.next_beat_s = self.now_s + phase_s
        # The vehicle, as it really is.
        self.mode = self.intended = Mode.HOLD
        self.armed = False
        self.position_m = np.array([16.0, 14.0, 0.0])
        self.velocity_m_s = np.zeros(3)
        self.sticks_m_s = np.zeros(3)
        # What PX4's own failsafe does now, until another mode is asked for.
        self.failsafe: Mode | None = None
        self.landed_at_s: float | None = self.now_s
        self.setpoint: MissionSetpoint | None = None
        self.setpoint_at_s = -math.inf
        self.commands: list[Action] = []
        self.refuses: dict[Action, str] = {}
        self.heavy = self.stuck = self.never_lands = False
        # Its motors do not lift it, so that it sinks so fast; and PX4 always says "in the air".
        self.sinks_m_s = 0.0
        self.watchdog = True
        # What is heard of it.
        self.telemetry, self.word_at_s, self.heard_from_s = True, 0.0, 0.0
        self.silent_from_s = math.inf
        self.fell = False
        self.lands_beside_m: tuple[float, float] | None = None
        self.position_known = True
        self.accuracy_m = 0.9
        self.battery: float | None = 0.9
        self.remote_control: bool | None = True
        self.energy: Energy | None = None
        self.px4_change: Px4Change | None = None
        self.beats: list[tuple[float, Mode, bool, bool, bool]] = []
        self.heard = VehicleState(origin=GlobalOrigin(47.0, 8.0, 0.0), height_above_home_m=0)
        # The rest of the inputs.
        self.ground: GroundState | None = None
        self.ground_on = True
        self.ground_at_s = -math.inf
        self.policy_m_s: np.ndarray | None = np.array([1.0, 0.0])
        self.policy_problem = ""
        self.closest: Closest | None = None
        self.busy: tuple[int, ...] = ()
        self.failed_checks: tuple[FailedCheck, ...] | None = ()
        self.not_taken: tuple[FailedCheck, ...] = ()
        self.safety_request: SafetyAction = "none"
        self.order: Order | None = None
        self.orders = 0
        # The program, and what it did.
        self.restart()
        self.taken: list[Transition] = []
        self.reasons: list[str] = []
        self.said: Refusal | None = None
        self.taken_s: list[float] = []
        self.actions: list[tuple[float, Action]] = []
        self.takeoffs = 0

    def restart(self) -> None:
        """The robot's program starts anew, and has heard nothing yet."""
        self.flight, self.guidance, self.position = FlightMemory(), Guidance(), PositionJudgement()
        self.heard, self.beats = structs.replace(self.heard, mode=None, armed=None, in_air=None), []
        self.started_s = self.now_s

    # Time

    def tick(self) -> Decision:
        self._pass(TICK_S)
        return self._decide(self._hear())

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK_S)):
            self.tick()

    def until(self, state: FlightState, within_s: float) -> None:
        for _ in range(round(within_s / TICK_S)):
            self.tick()
            if self.flight.state is state:
                return
        raise AssertionError(f"{self.flight.state}, not {state}: {self.flight.reason.text}")

    def stop(self, seconds: float) -> None:
        """The process is stopped and continued: its first ticks know nothing new."""
        before = self._hear()
        ground_on, self.ground_on = self.ground_on, False
        for _ in range(round(seconds / TICK_S)):
            self._pass(TICK_S)
            if self.watchdog and self.mode is Mode.OFFBOARD and self._silence_s > 0.5:
                self.mode = self.intended = Mode.HOLD
        connected = self.now_s - self.word_at_s < 2.5
        self._decide(structs.replace(before, connected=connected))
        self._pass(TICK_S)
        self._decide(structs.replace(before, connected=connected))
        self.ground_on = ground_on

    # The ground

    def enable(self, safety_action: SafetyAction = "none") -> None:
        self.ground = GroundState(
            1, "op", Origin(47.0, 8.0, 0.0), enabled=True, safety_action=safety_action
        )

    def new_order(self, kind: OrderKind, trial: str = "") -> Order:
        self.orders += 1
        expires_s = self.now_s - self.started_s + 9.0
        return Order(f"o{self.orders}", ROBOT.robot_id, 77, kind, expires_s, "op", trial)

    def give(self, order: Order) -> OrderResult:
        self.order = order
        self.tick()
        self.order = None
        return next(a for a in reversed(self.flight.answers) if a.order_id == order.order_id)

    def obey(self, kind: OrderKind, trial: str = "") -> None:
        answer = self.give(self.new_order(kind, trial))
        assert answer.accepted, answer.refusal

    def reads(self, said: Reason | Refusal | None, words: str) -> None:
        """The operator reads words that begin so; of scenarios flown again only deeds count."""
        assert said is not None
        assert self.flown_again or said.text.startswith(words)

    def refuse(self, kind: OrderKind) -> RefusalCode:
        """The robot refuses it: why."""
        refusal = self.give(self.new_order(kind)).refusal
        assert refusal is not None
        self.said = refusal
        return refusal.code

    # A flight's beginning

    def ready(self) -> None:
        self.enable()
        self.until(FlightState.PREFLIGHT, 6.0)

    def hover(self) -> None:
        self.ready()
        self.obey("takeoff")
        self.until(FlightState.HOLD, 25.0)
        self.run(3.0)

    def fly(self) -> None:
        self.hover()
        self.obey("start", "first")
        assert self.flight.state is FlightState.MISSION
        self.run(1.0)

    def end_failsafe(self) -> None:
        """What made PX4's own failsafe act is over: the vehicle's mode is again what was asked."""
        self.failsafe, self.mode = None, self.intended

    def pilot(self, *sticks_m_s: float) -> None:
        self.failsafe = None
        self.mode = self.intended = Mode.POSITION
        self.sticks_m_s = np.array(sticks_m_s or (0.0, 0.0, 0.0))

    def state(self) -> FlightState:
        return self.flight.state

    @property
    def why(self) -> tuple[FlightState, ReasonCode]:
        return self.flight.state, self.flight.reason.code

    @property
    def height_m(self) -> float:
        return float(self.position_m[2])

    @property
    def speed_m_s(self) -> float:
        return float(np.linalg.norm(self.velocity_m_s))

    # The vehicle

    @property
    def _silence_s(self) -> float:
        return self.now_s - self.setpoint_at_s

    def _pass(self, dt_s: float) -> None:
        self.now_s += dt_s
        for action in self.commands:
            text = self._carry_out(action)
            result = ActionResult(action, not text, text, self.now_s)
            self.heard = structs.replace(self.heard, result=result)
        self.commands = []
        if self.armed and self.intended is Mode.OFFBOARD:
            # PX4's failsafe, which ends when setpoints come again.
            self.mode = Mode.OFFBOARD if self._silence_s <= 1.0 else Mode.LAND
        if self.armed and self.failsafe is not None:
            self.mode = self.failsafe
        self._move(dt_s)
        if self.now_s >= self.next_beat_s:
            in_air = self.armed and (self.height_m > 0.1 or self.never_lands)
            failsafe = self.armed and self.failsafe is not None
            beat = (self.next_beat_s, self.mode, self.armed, in_air, failsafe)
            self.next_beat_s += PERIOD_S
            if self.telemetry:
                self.beats.append(beat)
        if self.ground_on and self.ground is not None:
            self.ground_at_s = self.now_s

    def _carry_out(self, action: Action) -> str:
        if action in self.refuses:
            return self.refuses[action]
        if action in (Action.OFFBOARD, Action.HOLD, Action.LAND):
            self.failsafe = None
        if action is Action.OFFBOARD:
            if self._silence_s > 0.5:
                return "no setpoints"
            self.mode = self.intended = Mode.OFFBOARD
        elif action is Action.ARM:
            self.armed = not self.stuck
        elif action is Action.HOLD:
            self.mode = self.intended = Mode.HOLD
        elif action is Action.LAND:
            self.mode = self.intended = Mode.LAND
        elif action is Action.DISARM:
            if self.height_m > 0.0:
                return "not landed"
            self.armed = False
        elif action is Action.KILL:
            self.armed, self.position_m[2] = False, 0.0
        return ""

    def _move(self, dt_s: float) -> None:
        wanted_m_s = np.zeros(3)
        if self.armed and self.mode is Mode.LAND:
            wanted_m_s[2] = -0.7
        elif self.armed and self.mode is Mode.POSITION:
            wanted_m_s = self.sticks_m_s
        elif self.armed and self.mode is Mode.OFFBOARD and self.setpoint is not None:
            if isinstance(self.setpoint, MissionPosition):
                wanted_m_s = 0.95 * (np.array(self.setpoint.position_m) - self.position_m)
            else:
                wanted_m_s = np.array(self.setpoint.velocity_m_s)
        self.velocity_m_s = self.velocity_m_s + 0.4 * (wanted_m_s - self.velocity_m_s)
        if self.heavy:
            self.velocity_m_s[2] = min(self.velocity_m_s[2], 0.0)
        if self.sinks_m_s:
            self.velocity_m_s[2] = -self.sinks_m_s
        self.position_m = self.position_m + self.velocity_m_s * dt_s
        if self.height_m > 0.0:
            self.landed_at_s = None
            return
        self.position_m[2] = 0.0
        self.velocity_m_s = np.zeros(3)
        self.landed_at_s = self.now_s if self.landed_at_s is None else self.landed_at_s
        down_s = self.now_s - self.landed_at_s
        if self.mode is Mode.LAND and down_s > 2.0 and Action.DISARM not in self.refuses:
            self.armed = False

    def _thrust(self) -> float:
        if not self.armed or (self.height_m == 0.0 and self.mode is Mode.LAND):
            return 0.0
        return 1.0 if self.sinks_m_s or self.height_m == 0.0 else 0.5

    # The robot

    def _hear(self) -> VehicleState:
        while self.beats and self.beats[0][0] + self.latency_s <= self.now_s:
            at_s, mode, armed, in_air, failsafe = self.beats.pop(0)
            self.heard = structs.replace(
                self.heard,
                mode=mode,
                armed=armed,
                in_air=in_air,
                failsafe=failsafe,
                heartbeat_at_s=at_s,
            )
        if self.telemetry:
            if self.now_s - self.word_at_s > 2.5:
                self.heard_from_s = self.now_s
            self.word_at_s = self.now_s
        known = self.heard.heartbeat_at_s >= max(self.heard_from_s, self.now_s - 10.0)
        return structs.replace(
            self.heard,
            connected=known and self.now_s - self.word_at_s < 2.5,
            fell=self.fell,
            battery=self.battery,
            thrust=self._thrust(),
            position_local_m=(0.0, 0.0, 0.0),
            position_at_s=min(self.now_s, self.silent_from_s),
            position_changed_at_s=min(self.now_s, self.silent_from_s),
            gps=Gps(
                3 if self.position_known else 0,
                12,
                0.8,
                self.accuracy_m,
                at_s=min(self.now_s, self.silent_from_s),
                repeats=self.repeats,
            ),
            height_above_home_m=self.height_m,
            remote_control=self.remote_control,
        )

    def inputs(self, vehicle: VehicleState) -> FlightInputs:
        """What the robot knows now, if that is the vehicle's state."""
        self.position = judge(self.position, vehicle, PositionLimits(), self.now_s)
        odometry = None
        fresh = self.now_s - vehicle.position_at_s <= MAX_POSITION_AGE_S
        if fresh and self.position.quality is not PositionQuality.LOST:
            x_m, y_m, height_m = self.position_m.tolist()
            vx, vy, vz = self.velocity_m_s.tolist()
            odometry = Odometry((x_m, y_m, height_m + ZERO_M), (vx, vy, vz))
        return FlightInputs(
            now_s=self.now_s,
            vehicle=vehicle,
            position=self.position,
            odometry=odometry,
            policy_velocity_m_s=self.policy_m_s,
            policy_problem=self.policy_problem,
            neighbours=(),
            closest=self.closest,
            busy_neighbours=self.busy,
            ground=self.ground,
            ground_age_s=self.now_s - self.ground_at_s,
            safety_request=self.safety_request,
            other_release=self.other_release,
            failed_checks=self.failed_checks,
            not_taken=self.not_taken,
            order=self.order,
            uptime_s=self.now_s - self.started_s,
            energy=self.energy,
            lands_beside_m=self.lands_beside_m,
            px4_change=self.px4_change,
        )

    def _decide(self, vehicle: VehicleState) -> Decision:
        inputs, before = self.inputs(vehicle), self.flight
        decision = step(self.robot, before, inputs)
        self.flight = decision.flight
        setpoint, self.guidance = guide(self.robot, self.flight, inputs, self.guidance, TICK_S)
        self._check(before, vehicle, decision, setpoint)
        self.commands += decision.actions
        self.actions += [(self.now_s, action) for action in decision.actions]
        if decision.taken is not None:
            self.taken.append(decision.taken)
            self.reasons.append(decision.flight.reason.text)
            self.taken_s.append(self.now_s)
            # No two rows may lead back and forth.
            assert len(self.taken_s) < 6 or self.now_s - self.taken_s[-6] > 0.7
        if setpoint is not None:
            self.setpoint, self.setpoint_at_s = setpoint, self.now_s
        return decision

    def _check(
        self,
        before: FlightMemory,
        vehicle: VehicleState,
        decision: Decision,
        setpoint: MissionSetpoint | None,
    ) -> None:
        """What holds in every tick of every flight."""
        state = decision.flight.state
        allowed = set(Action)
        if state in NOT_OURS:
            assert setpoint is None
            allowed = {Action.DISARM} if before.state is FlightState.ARMING else set()
            if decision.flight.killed:
                allowed.add(Action.KILL)
            if state in ON_GROUND and vehicle.armed is False:
                allowed.add(Action.HOLD)
            if state is FlightState.PILOT and self.order is not None:
                given: dict[OrderKind, Action] = {"pilot": Action.HOLD, "disarm": Action.DISARM}
                allowed |= {action for kind, action in given.items() if kind == self.order.kind}
        assert set(decision.actions) <= allowed
        if vehicle.mode in PILOTED and before.reached and before.state in AIRBORNE:
            assert setpoint is None, "a pilot flies it"
        if setpoint is not None:
            assert all(math.isfinite(value) for value in setpoint[0])
        if state is FlightState.ARMING and before.state is not FlightState.ARMING:
            assert before.state is FlightState.PREFLIGHT
            assert self.order is not None
            assert self.order.kind == "takeoff"
            self.takeoffs += 1
        if Action.ARM in decision.actions:
            assert state is FlightState.ARMING
        arms = sum(action is Action.ARM for _, action in self.actions)
        assert arms + (Action.ARM in decision.actions) <= self.takeoffs

    def asked(self, action: Action) -> int:
        return sum(asked is action for _, asked in self.actions)


# By the names of the scenarios that were flown as tests.
_flown: dict[str, World] = {}


@pytest.fixture
def world(request: pytest.FixtureRequest) -> World:
    _flown[request.function.__name__] = world = World()
    return world


# A whole flight


def test_takes_off_flies_returns_lands_and_flies_again(world: World) -> None:
    world.ready()
    for trial in ("first", "second"):
        world.obey("takeoff")
        world.until(FlightState.TAKEOFF, 8.0)
        world.until(FlightState.HOLD, 15.0)
        world.run(3.0)
        assert world.height_m == pytest.approx(SLOT_M, abs=0.3)
        world.order = world.new_order("start", trial)
        assert world.tick().new_trial
        world.order = None
        east_m = float(world.position_m[0])
        world.run(3.0)
        assert world.position_m[0] > east_m + 2.0
        world.enable(safety_action="return")
        world.until(FlightState.LAND, 30.0)
        assert world.position_m[:2] == pytest.approx(ROBOT.parameters.landing_point_m, abs=0.6)
        world.until(FlightState.LANDED, 20.0)
        assert not world.armed
        world.run(5.0)
        assert world.state() is FlightState.LANDED
        world.enable()
        world.until(FlightState.PREFLIGHT, 1.0)
    assert world.asked(Action.ARM) == 2


def test_the_same_trial_goes_on_after_a_hold(world: World) -> None:
    world.fly()
    world.enable(safety_action="hold")
    world.run(2.0)
    assert world.state() is FlightState.HOLD
    world.enable()
    world.run(3.0)
    assert world.state() is FlightState.HOLD  # Withdrawing it sets nothing in motion.
    world.order = world.new_order("start", "first")
    decision = world.tick()
    assert decision.flight.state is FlightState.MISSION
    assert not decision.new_trial


# Nothing that repeats arms


def test_repeated_ground_states_never_arm(world: World) -> None:
    for safety_action in ("none", "hold", "return", "land", "none"):
        world.enable(safety_action=safety_action)
        world.run(5.0)
    assert world.state() is FlightState.PREFLIGHT
    assert world.actions == []


def test_a_battery_swap_in_somebodys_hands_does_not_arm(world: World) -> None:
    world.ready()
    takeoff = world.new_order("takeoff")
    world.restart()
    world.heard = VehicleState(origin=GlobalOrigin(47.0, 8.0, 0.0))
    world.until(FlightState.PREFLIGHT, 8.0)
    answer = world.give(replace(takeoff, boot_nonce=76))
    assert why(answer) is RefusalCode.OTHER_START
    world.reads(answer.refusal, "meant for another start of this robot's program")
    world.run(10.0)
    assert world.actions == []


def test_a_watchdog_restart_forgets_a_takeoff_that_it_was_told(world: World) -> None:
    world.ready()
    world.obey("takeoff")
    world.run(0.2)
    world.restart()
    world.run(20.0)
    assert world.state() is FlightState.PREFLIGHT
    assert world.asked(Action.ARM) == 0


def test_a_late_gps_fix_does_not_arm(world: World) -> None:
    world.position_known = False
    world.enable()
    world.run(20.0)
    assert world.state() is FlightState.INIT
    assert world.refuse("takeoff") is RefusalCode.WRONG_STATE
    world.position_known = True
    world.until(FlightState.PREFLIGHT, 8.0)
    world.run(10.0)
    assert world.actions == []


def test_a_repeated_takeoff_order_arms_once(world: World) -> None:
    world.ready()
    order = world.new_order("takeoff")
    for _ in range(60):
        world.order = order
        world.tick()
    world.until(FlightState.HOLD, 20.0)
    assert world.asked(Action.ARM) == 1


def test_a_takeoff_order_counts_no_more_after_others_were_answered(world: World) -> None:
    world.ready()
    takeoff = world.new_order("takeoff")
    assert world.give(takeoff).accepted
    world.enable(safety_action="hold")
    world.until(FlightState.IDLE, 1.0)
    world.enable()
    world.until(FlightState.PREFLIGHT, 3.0)
    for _ in range(10):
        world.refuse("rejoin")
    answer = world.give(takeoff)
    assert why(answer) is RefusalCode.OLDER
    world.reads(answer.refusal, "older than an order that was obeyed")
    world.run(10.0)
    assert world.asked(Action.ARM) == 0


# Orders


def test_orders_are_refused_with_the_reason(world: World) -> None:
    world.enable()
    world.failed_checks = None
    world.until(FlightState.PREFLIGHT, 6.0)
    assert world.refuse("takeoff") is RefusalCode.CHECKS_RUNNING
    world.reads(world.said, "not ready: the checks are still running")
    world.failed_checks = (
        FailedCheck(CheckCode.BATTERY_LOW, "battery 40 %"),
        FailedCheck(CheckCode.GPS_NO_FIX, "GPS: 2-D fix"),
    )
    assert world.refuse("takeoff") is RefusalCode.NOT_READY
    world.reads(world.said, "not ready: battery 40 %; GPS: 2-D fix")
    world.failed_checks = ()
    assert world.refuse("start") is RefusalCode.WRONG_STATE
    world.reads(world.said, "start is accepted in hold only; the robot is in preflight")
    order = world.new_order("takeoff")
    late = replace(order, expires_at_uptime_s=world.now_s - world.started_s)
    answer = world.give(late)
    assert why(answer) is RefusalCode.EXPIRED
    world.reads(answer.refusal, "expired")
    for expires_s in (1e9, math.nan, math.inf):
        far = replace(world.new_order("takeoff"), expires_at_uptime_s=expires_s)
        answer = world.give(far)
        assert why(answer) is RefusalCode.VALID_TOO_LONG
        world.reads(answer.refusal, "would be valid for ")
    answer = world.give(replace(world.new_order("takeoff"), boot_nonce=1))
    assert why(answer) is RefusalCode.OTHER_START
    answer = world.give(replace(world.new_order("takeoff"), kind="dock"))
    assert why(answer) is RefusalCode.NOT_UNDERSTOOD
    world.reads(answer.refusal, "this program does not understand dock")
    assert world.state() is FlightState.PREFLIGHT
    world.other_release = "01020304"
    assert world.refuse("takeoff") is RefusalCode.OTHER_RELEASE
    world.reads(world.said, "the ground flies another release (01020304) than this robot")
    world.other_release = ""
    world.enable(safety_action="hold")
    assert world.refuse("takeoff") is RefusalCode.GROUND_COMMANDS
    world.reads(world.said, "the ground commands hold")
    answers = world.flight.answers
    world.order = replace(world.new_order("takeoff"), robot_id=4)
    world.tick()
    assert world.flight.answers == answers
    assert world.actions == []


def test_start_is_refused_until_the_robot_and_the_others_are_in_place(world: World) -> None:
    world.hover()
    world.busy = (4, 7)
    assert world.refuse("start") is RefusalCode.OTHERS_TAKE_OFF
    world.reads(world.said, "robots still taking off: 4, 7")
    world.busy = ()
    world.policy_m_s = None
    assert world.refuse("start") is RefusalCode.POLICY_STALE
    world.reads(world.said, "the policy has no fresh answer")
    world.policy_problem = "sensor: it shows nothing"
    assert world.refuse("start") is RefusalCode.POLICY_STALE
    world.reads(world.said, "the policy has no fresh answer: sensor: it shows nothing")
    world.policy_m_s, world.policy_problem = np.zeros(2), ""
    world.closest = Closest(4, 1.2)
    assert world.refuse("start") is RefusalCode.TOO_CLOSE
    world.closest = None
    world.failed_checks = (
        FailedCheck(CheckCode.NOT_DISARMED, "vehicle is armed"),
        FailedCheck(CheckCode.NOT_A_MEMBER, "its key is not listed"),
    )
    assert world.refuse("start") is RefusalCode.NOT_READY
    world.reads(world.said, "its key is not listed")
    world.failed_checks = world.failed_checks[:1]
    world.position_m[0] = 33.0
    assert world.refuse("start") is RefusalCode.OUTSIDE_FENCE
    world.reads(world.said, "outside the fence")
    world.position_m[0], world.position_m[2] = 16.0, SLOT_M - 2.0
    assert world.refuse("start") is RefusalCode.NOT_AT_HEIGHT
    world.reads(world.said, f"at {world.height_m:.1f} m; its height is 9.5 m")
    world.position_m[2] = SLOT_M
    world.battery = 0.2
    assert world.refuse("start") is RefusalCode.OVERRULED
    assert world.state() is FlightState.RETURN


def test_only_the_commander_orders_but_anybody_kills(world: World) -> None:
    world.ready()
    kinds: tuple[OrderKind, ...] = ("takeoff", "start", "pilot", "rejoin", "reset", "disarm")
    for kind in kinds:
        answer = world.give(replace(world.new_order(kind), operator="eve"))
        assert why(answer) is RefusalCode.OTHER_COMMANDER
        world.reads(answer.refusal, "op commands, not eve")
    assert world.actions == []
    world.obey("reset")
    obeyed_s = world.flight.obeyed_expiry_s
    kill = replace(world.new_order("kill"), operator="eve", expires_at_uptime_s=obeyed_s - 5.0)
    assert world.give(kill).accepted
    # Nor does that make older orders count again.
    assert world.flight.obeyed_expiry_s == obeyed_s


def test_without_a_ground_only_kill_is_taken(world: World) -> None:
    world.run(3.0)
    assert world.refuse("reset") is RefusalCode.GROUND_NOT_HEARD
    world.hover()
    world.ground_on = False
    world.run(3.5)
    kinds: tuple[OrderKind, ...] = ("start", "pilot", "reset")
    for kind in kinds:
        assert world.refuse(kind) is RefusalCode.GROUND_NOT_HEARD
    world.obey("kill")


def test_one_robot_alone_is_enabled(world: World) -> None:
    world.enable()
    assert world.ground is not None
    world.ground = replace(world.ground, robot_enabled={"3": False})
    world.run(8.0)
    assert world.state() is FlightState.IDLE
    world.ground = replace(world.ground, enabled=False, robot_enabled={"3": True})
    world.until(FlightState.PREFLIGHT, 6.0)
    world.obey("takeoff")
    world.until(FlightState.HOLD, 25.0)
    world.run(3.0)
    world.obey("start")
    world.ground = replace(world.ground, enabled=True, robot_enabled={"3": False})
    world.tick()
    assert world.state() is FlightState.HOLD


def test_what_the_ground_says_and_the_robot_does_not_fly_by_keeps_it_from_starting(
    world: World,
) -> None:
    world.hover()
    world.not_taken = (
        FailedCheck(CheckCode.KEEPS_FENCE, "in flight: keeps its fence"),
        FailedCheck(CheckCode.KEEPS_WORLD, "in flight: keeps its world"),
    )
    assert world.refuse("start") is RefusalCode.NOT_TAKEN_UP
    world.reads(world.said, "in flight: keeps its fence; in flight: keeps its world")
    world.not_taken = ()
    world.obey("start")


def test_the_next_trial_is_reset_on_the_ground_or_in_hold_and_then_started(world: World) -> None:
    world.fly()
    assert world.refuse("reset") is RefusalCode.WRONG_STATE
    world.enable(safety_action="hold")
    world.run(2.0)
    for trial in ("second", "second", "third"):
        world.order = world.new_order("reset", trial)
        decision = world.tick()
        assert decision.new_trial
        assert decision.flight.state is FlightState.HOLD
        # Of which it has flown nothing yet.
        assert decision.flight.trial == ""
        assert decision.flight.answers[-1].accepted
    world.enable()
    world.run(1.0)
    world.order = world.new_order("start", "third")
    decision = world.tick()
    assert decision.flight.state is FlightState.MISSION
    assert decision.flight.trial == "third"


def test_an_order_is_refused_where_what_it_needs_is_not_known_or_lost() -> None:
    world = World()
    world.robot = replace(ROBOT, on_remote_control_lost="land")
    world.hover()
    lost: dict[str, object] = {"remote_control_at_s": world.now_s - 2.0}
    cases: tuple[tuple[OrderKind, dict[str, object], dict[str, object], RefusalCode], ...] = (
        ("disarm", {"in_air": None}, {}, RefusalCode.ARMED_NOT_KNOWN),
        ("disarm", {"in_air": False, "armed": None}, {}, RefusalCode.ARMED_NOT_KNOWN),
        ("start", {"armed": None}, {}, RefusalCode.NOT_IN_THE_AIR),
        ("start", {"remote_control": False}, lost, RefusalCode.REMOTE_CONTROL_LOST),
        ("start", {}, {"datum_m": None}, RefusalCode.PLACE_NOT_KNOWN),
        ("start", {}, {"reached": False}, RefusalCode.NOT_IN_OFFBOARD),
    )
    for kind, heard, memory, code in cases:
        flight = structs.replace(world.flight, **memory)
        vehicle = structs.replace(world._hear(), **heard)
        t = Tick(world.robot, flight, world.inputs(vehicle))
        refused = refusal(t, world.new_order(kind))
        assert refused is not None and refused.code is code, (kind, heard, memory)


def test_a_reset_is_taken_though_the_state_changes_in_the_same_tick(world: World) -> None:
    world.hover()
    world.enable(safety_action="land")
    world.order = world.new_order("reset", "second")
    decision = world.tick()
    assert decision.flight.state is FlightState.LAND
    assert decision.new_trial
    assert decision.flight.answers[-1].accepted


def test_disarm_stops_the_motors_on_the_ground_only(world: World) -> None:
    world.ready()
    assert world.refuse("disarm") is RefusalCode.NOT_ARMED
    # Before it is heard to be armed.
    world.obey("takeoff")
    while not world.flight.armed_asked:
        world.tick()
    world.obey("disarm")
    world.until(FlightState.LANDED, 2.5)
    world.run(3.0)
    assert not world.armed
    world.ready()
    world.heavy = True
    world.obey("takeoff")
    world.until(FlightState.TAKEOFF, 6.0)
    world.run(2.5)
    world.obey("disarm")
    assert world.why == (FlightState.PILOT, ReasonCode.DISARM_ORDERED)
    world.until(FlightState.LANDED, 2.5)
    assert not world.armed
    assert world.height_m == 0.0
    world.heavy = False
    world.hover()
    assert world.refuse("disarm") is RefusalCode.IN_THE_AIR
    world.enable(safety_action="land")
    assert world.refuse("disarm") is RefusalCode.IN_THE_AIR
    world.until(FlightState.LANDED, 20.0)


# Arming


def test_takeoff_waits_for_the_vehicle_and_stops_where_it_is_refused(world: World) -> None:
    for action in (Action.OFFBOARD, Action.ARM):
        world.ready()
        world.refuses = {action: "not today"}
        world.obey("takeoff")
        world.until(FlightState.IDLE, 7.0)
        assert world.flight.reason.code is ReasonCode.ARMING_FAILED
        assert world.actions[-1][1] is Action.DISARM
        world.run(1.5)
        assert world.state() is FlightState.IDLE
        assert world.flight.alarming
    world.refuses = {}
    world.ready()
    world.telemetry = False
    world.until(FlightState.INIT, 6.0)


def test_arming_is_called_off(world: World) -> None:
    world.ready()
    for safety_action in ("hold", "return", "land"):
        world.obey("takeoff")
        world.run(0.4)
        world.enable(safety_action=safety_action)
        world.tick()
        assert world.state() is FlightState.IDLE
        world.ready()
    world.ground_on = False
    world.run(2.5)
    world.obey("takeoff")
    world.until(FlightState.IDLE, 1.0)
    assert world.actions[-1][1] is Action.DISARM
    world.ground_on = True
    world.ready()
    world.obey("takeoff")
    world.stop(1.0)
    assert world.state() is FlightState.IDLE
    world.run(15.0)
    assert not world.armed


def test_a_vehicle_that_does_not_arm_is_left_alone(world: World) -> None:
    world.ready()
    world.stuck = True
    world.obey("takeoff")
    world.until(FlightState.IDLE, 7.0)
    assert world.flight.reason.code is ReasonCode.ARMING_FAILED
    world.run(3.0)
    assert not world.armed


def test_the_link_is_lost_while_arming(world: World) -> None:
    world.ready()
    world.telemetry = False
    world.beats = []
    world.refuses = {Action.OFFBOARD: ""}
    world.obey("takeoff")
    world.until(FlightState.INIT, 4.0)
    assert world.actions[-1][1] is Action.DISARM


def test_a_vehicle_that_was_armed_as_the_link_was_lost_is_not_said_to_be_somebodys(
    world: World,
) -> None:
    world.ready()
    world.obey("takeoff")
    while not world.flight.armed_asked:
        world.tick()
    world.refuses = {Action.DISARM: "did not hear"}
    world.telemetry, world.beats = False, []
    world.until(FlightState.INIT, 4.0)
    world.telemetry = True
    world.until(FlightState.PILOT, 4.0)
    assert world.why == (FlightState.PILOT, ReasonCode.ARMED_BEFORE)
    world.armed = False
    world.until(FlightState.LANDED, 2.5)
    world.ready()
    world.armed, world.mode, world.intended = True, Mode.POSITION, Mode.POSITION
    world.until(FlightState.PILOT, 2.5)
    assert world.why == (FlightState.PILOT, ReasonCode.ARMED_BY_OTHERS)


def test_whoever_arms_by_hand_after_a_flight_that_is_over_is_not_this_program(
    world: World,
) -> None:
    world.fly()
    world.telemetry = False
    world.until(FlightState.FAULT, 6.0)
    world.enable()
    assert world.ground is not None
    world.ground = replace(world.ground, enabled=False)
    # Meanwhile it came down.
    world.armed, world.mode, world.intended = False, Mode.HOLD, Mode.HOLD
    world.position_m[2], world.landed_at_s = 0.0, world.now_s
    world.telemetry = True
    world.until(FlightState.IDLE, 6.0)
    world.run(290.0)
    world.armed, world.mode, world.intended = True, Mode.POSITION, Mode.POSITION
    world.until(FlightState.PILOT, 2.5)
    assert world.why == (FlightState.PILOT, ReasonCode.ARMED_BY_OTHERS)


def test_how_long_a_vehicle_has_been_in_the_air(world: World) -> None:
    def flown() -> float | None:
        return flown_s(world.flight, world.heard, world.now_s)

    world.ready()
    assert flown() is None
    world.hover()
    armed_s = next(at_s for at_s, action in world.actions if action is Action.ARM)
    world.run(60.0)
    assert flown() == pytest.approx(world.now_s - armed_s, abs=PERIOD_S + 0.5)
    # What is not heard any more goes on.
    world.telemetry = False
    world.until(FlightState.FAULT, 6.0)
    assert flown() == pytest.approx(world.now_s - armed_s, abs=PERIOD_S + 0.5)
    world.telemetry = True
    world.until(FlightState.PILOT, 4.0)
    world.restart()
    world.until(FlightState.PILOT, 4.0)
    assert flown() is None and world.heard.armed
    world.armed = False
    world.until(FlightState.LANDED, 2.5)
    assert flown() is None


def test_somebody_else_arms_meanwhile(world: World) -> None:
    world.ready()
    world.obey("takeoff")
    world.armed, world.mode = True, Mode.POSITION
    world.intended = Mode.POSITION
    world.until(FlightState.PILOT, 3.0)
    assert world.asked(Action.ARM) == 0


def test_a_pilot_takes_it_while_arming(world: World) -> None:
    world.ready()
    world.obey("takeoff")
    while not world.flight.reached:
        world.tick()
    world.pilot()
    world.refuses = {Action.ARM: "wrong mode"}
    world.until(FlightState.IDLE, 4.0)
    world.run(3.0)
    assert not world.armed
    assert world.mode is Mode.POSITION


# Takeoff


def test_a_takeoff_that_does_not_climb_ends_after_15_s(world: World) -> None:
    world.ready()
    world.heavy = True
    world.obey("takeoff")
    world.until(FlightState.TAKEOFF, 6.0)
    began_s = world.now_s
    world.until(FlightState.LAND, 16.0)
    assert world.now_s - began_s == pytest.approx(15.0, abs=0.3)
    assert world.flight.reason in world._decide(world._hear()).alarms
    world.until(FlightState.LANDED, 8.0)
    assert not world.armed


def test_a_takeoff_on_hold_stays_where_it_is_in_the_air_or_on_the_ground(world: World) -> None:
    world.ready()
    world.obey("takeoff")
    while world.height_m < 3.0:
        world.tick()
    world.run(2.5 - world.latency_s if world.latency_s < 0.5 else 0.0)
    world.enable(safety_action="hold")
    world.tick()
    assert world.state() is FlightState.HOLD
    world.enable(safety_action="land")
    world.until(FlightState.LANDED, 20.0)
    world.ready()
    world.heavy = True
    world.obey("takeoff")
    world.until(FlightState.TAKEOFF, 6.0)
    world.enable(safety_action="hold")
    world.until(FlightState.LAND, 3.0)
    assert world.flight.reason.code is ReasonCode.ON_GROUND
    # Nothing that the ground repeats lifts it off again.
    world.heavy = False
    world.enable(safety_action="return")
    world.until(FlightState.LANDED, 10.0)
    assert world.height_m == 0.0


def test_land_and_return_end_a_takeoff(world: World) -> None:
    safety_actions: tuple[SafetyAction, ...] = ("land", "return")
    for safety_action in safety_actions:
        world.ready()
        world.obey("takeoff")
        world.until(FlightState.TAKEOFF, 6.0)
        world.run(1.0)
        world.enable(safety_action=safety_action)
        world.tick()
        assert world.state() is FlightState.LAND
        world.until(FlightState.LANDED, 15.0)


# Safety commands of the ground


def test_the_latest_of_hold_land_and_return_counts(world: World) -> None:
    world.fly()
    steps: tuple[tuple[SafetyAction, FlightState], ...] = (
        ("hold", FlightState.HOLD),
        ("land", FlightState.LAND),
        ("hold", FlightState.HOLD),
        ("return", FlightState.RETURN),
        ("hold", FlightState.HOLD),
        ("land", FlightState.LAND),
        ("return", FlightState.RETURN),
        ("land", FlightState.LAND),
    )
    for safety_action, state in steps:
        world.enable(safety_action=safety_action)
        world.tick()
        assert world.state() is state
        world.run(0.9)
        assert world.state() is state
    world.until(FlightState.LANDED, 20.0)


def test_changing_ones_mind_quickly_ends_in_what_was_said_last(world: World) -> None:
    world.fly()
    said: tuple[tuple[SafetyAction, float], ...] = (
        ("land", 0.4),
        ("hold", 0.8),
        ("land", 0.2),
        ("hold", 0.6),
    )
    for safety_action, seconds in said:
        world.enable(safety_action=safety_action)
        world.run(seconds)
    world.run(5.0)
    assert world.state() is FlightState.HOLD
    assert world.mode is Mode.OFFBOARD
    world.enable(safety_action="land")
    world.run(0.2)
    assert world.state() is FlightState.LAND
    world.until(FlightState.LANDED, 20.0)


def test_one_robot_alone_is_called_and_disabling_holds(world: World) -> None:
    world.fly()
    assert world.ground is not None
    world.ground = replace(world.ground, robot_safety_actions={"3": "hold"})
    world.tick()
    assert world.state() is FlightState.HOLD
    world.enable()
    world.obey("start", "first")
    world.ground = replace(world.ground, enabled=False)
    world.tick()
    assert world.state() is FlightState.HOLD


def test_after_touchdown_hold_and_return_do_not_lift_it(world: World) -> None:
    safety_actions: tuple[SafetyAction, ...] = ("hold", "return")
    for safety_action in safety_actions:
        world.hover()
        world.enable(safety_action="land")
        while world.height_m > 0.0:
            world.tick()
        world.run(0.2)
        world.enable(safety_action=safety_action)
        world.until(FlightState.LANDED, 12.0)
        assert world.height_m < 0.5
        world.enable()
        world.until(FlightState.PREFLIGHT, 1.0)


# Faults in flight


def test_a_robot_that_was_knocked_down_in_its_mission_lands(world: World) -> None:
    world.fly()
    world.heavy = True
    while world.height_m > 0.0:
        world.position_m[2] = max(world.position_m[2] - 0.5, 0.0)
        world.tick()
    world.until(FlightState.LAND, 3.0)
    assert world.flight.alarming


def test_a_robot_that_sinks_holds_apart_and_lands(world: World) -> None:
    world.fly()
    world.sinks_m_s = 0.8
    sank_at_s = world.now_s
    world.until(FlightState.HOLD, 6.0)
    # 1.5 m take 1.9 s.
    assert world.now_s - sank_at_s == pytest.approx(1.9 + 2.0, abs=0.3)
    assert world.why == (FlightState.HOLD, ReasonCode.OFF_HEIGHT)
    # Nothing leads it elsewhere meanwhile.
    world.enable(safety_action="return")
    world.battery = 0.2
    decision = world.tick()
    assert codes(decision)[0] is ReasonCode.OFF_HEIGHT
    assert world.refuse("start") in (RefusalCode.GROUND_COMMANDS, RefusalCode.NOT_AT_HEIGHT)
    held_at_s = world.now_s
    world.until(FlightState.LAND, 3.5)
    assert world.why == (FlightState.LAND, ReasonCode.OFF_HEIGHT)
    assert world.now_s - held_at_s < 3.2
    world.until(FlightState.LANDED, 15.0)


def test_a_robot_that_sinks_as_it_returns_holds_or_takes_off_lands(world: World) -> None:
    def sinks() -> None:
        world.sinks_m_s = 0.8
        world.until(FlightState.LAND, 8.0)
        assert world.why == (FlightState.LAND, ReasonCode.OFF_HEIGHT)
        world.until(FlightState.LANDED, 20.0)
        world.sinks_m_s = 0.0

    world.fly()
    world.enable(safety_action="return")
    world.until(FlightState.RETURN, 1.0)
    sinks()
    world.hover()
    sinks()
    world.ready()
    world.obey("takeoff")
    while world.height_m < 8.0:
        world.tick()
    sinks()


def test_a_robot_that_is_given_time_to_climb_to_its_height_returns(world: World) -> None:
    """From where a hold stopped its takeoff."""
    world.ready()
    world.obey("takeoff")
    while world.height_m < 2.0:
        world.tick()
    world.run(2.5 - world.latency_s)
    world.enable(safety_action="hold")
    world.until(FlightState.HOLD, 1.0)
    world.run(5.0)
    world.enable(safety_action="return")
    world.until(FlightState.LANDED, 60.0)
    assert ReasonCode.OFF_HEIGHT not in {row.code for row in world.taken}


def test_what_stands_on_the_ground_is_landed_whatever_the_autopilot_says(world: World) -> None:
    """It pushes upwards, PX4 says that it is in the air, and would not disarm it."""
    world.fly()
    world.sinks_m_s = 4.0
    world.never_lands = True
    world.refuses = {Action.DISARM: "denied"}
    while world.height_m > 0.0:
        world.tick()
    world.until(FlightState.LAND, 2.8)
    assert world.why == (FlightState.LAND, ReasonCode.ON_GROUND)
    # Its motors lift again, and PX4 lands: they idle.
    world.sinks_m_s = 0.0
    while world.flight.landed_since_s is None:
        world.tick()
    for action, at_s in ((Action.DISARM, world.flight.since_s - 1.0), (Action.LAND, world.now_s)):
        world.heard = structs.replace(
            world.heard, result=ActionResult(action, False, "denied", at_s)
        )
        assert ReasonCode.DISARM_REFUSED not in codes(world.tick())
    world.run(8.0)
    assert world.height_m == 0.0 and world.armed
    assert ReasonCode.DISARM_REFUSED in codes(world.tick())
    assert world.asked(Action.DISARM) > 1
    world.refuses = {}
    world.until(FlightState.LANDED, 4.0)


def test_disarm_is_taken_from_what_stands_whatever_the_autopilot_says(world: World) -> None:
    world.fly()
    assert world.refuse("disarm") is RefusalCode.IN_THE_AIR
    world.never_lands = True
    world.sinks_m_s = 4.0
    world.until(FlightState.LAND, 8.0)
    world.refuses = {Action.DISARM: "denied"}
    world.obey("disarm")
    assert world.why == (FlightState.PILOT, ReasonCode.DISARM_ORDERED)
    # He who has it knows, and may fly it.
    assert ReasonCode.DISARM_REFUSED not in codes(world.tick())


def test_hold_outside_the_fence_comes_back_inside(world: World) -> None:
    world.fly()
    world.position_m[:2] = (33.0, 16.0)
    world.enable(safety_action="hold")
    world.until(FlightState.HOLD, 1.0)
    assert ReasonCode.OUTSIDE_FENCE in codes(world._decide(world._hear()))
    world.run(20.0)
    assert world.position_m[:2] == pytest.approx((31.0, 16.0), abs=0.2)


def test_a_receiver_that_repeats_itself_is_ignored_as_long_as_it_does(world: World) -> None:
    world.fly()
    world.repeats = 3
    world.run(0.3)
    ignored = world.asked(Action.IGNORE_GPS)
    assert ignored
    world.heard = structs.replace(world.heard, ignores_gps=True)
    world.run(0.5)
    world.stop(1.0)
    world.run(0.5)
    # PX4 says that it is so; nor is the receiver given back where the control loop was silent.
    assert (world.asked(Action.IGNORE_GPS), world.asked(Action.USE_GPS)) == (ignored, 0)
    world.repeats = 0
    world.run(5.0)
    assert world.asked(Action.USE_GPS)


def test_a_vehicle_that_flies_without_a_receiver_on_purpose_is_left_so(world: World) -> None:
    world.heard = structs.replace(world.heard, ignores_gps=True)
    world.fly()
    world.run(3.0)
    assert not world.asked(Action.USE_GPS) and not world.asked(Action.IGNORE_GPS)


def test_ground_lost_holds_and_lands_ten_seconds_later(world: World) -> None:
    world.fly()
    world.ground_on = False
    lost_s = world.now_s
    world.until(FlightState.HOLD, 4.0)
    assert world.now_s - lost_s == pytest.approx(3.0, abs=0.2)
    assert ReasonCode.GROUND_LOST in codes(world._decide(world._hear()))
    # Others may be in its way home, and it hears of nobody's.
    world.battery = 0.2
    world.run(2.0)
    assert world.state() is FlightState.HOLD
    world.until(FlightState.LAND, 9.0)
    assert world.now_s - lost_s == pytest.approx(13.0, abs=0.2)
    world.ground_on = True
    world.enable(safety_action="hold")
    world.until(FlightState.LANDED, 20.0)


def test_the_ground_comes_back_and_the_robot_waits(world: World) -> None:
    world.fly()
    world.enable(safety_action="return")
    world.run(0.5)
    world.ground_on = False
    world.until(FlightState.HOLD, 4.0)
    world.run(3.0)
    assert world.state() is FlightState.HOLD
    world.ground_on = True
    world.enable()
    world.run(5.0)
    assert world.state() is FlightState.HOLD


def test_battery_low_returns_and_critical_lands(world: World) -> None:
    world.fly()
    world.battery = 0.24
    decision = world.tick()
    assert world.state() is FlightState.RETURN
    assert codes(decision) == [ReasonCode.BATTERY_LOW]
    world.reads(decision.alarms[0], "battery low: 24%")
    world.enable(safety_action="hold")
    world.run(1.0)
    assert world.state() is FlightState.HOLD
    world.enable()
    world.run(0.2)
    assert world.state() is FlightState.RETURN
    world.battery = 0.1
    world.tick()
    assert world.state() is FlightState.LAND
    world.enable(safety_action="hold")
    world.until(FlightState.LANDED, 20.0)


CHANGED = "somebody changed the autopilot in flight, not restored: GF_ACTION from 2 to 0"


def test_an_autopilot_that_others_change_is_an_alarm(world: World) -> None:
    world.fly()
    world.px4_change = Px4Change("somebody changed the autopilot in flight", stays=False)
    assert codes(world.tick()) == [ReasonCode.PX4_CHANGED]
    world.run(5.0)
    assert world.state() is FlightState.MISSION


def test_an_autopilot_that_others_change_for_good_brings_it_home(world: World) -> None:
    world.fly()
    world.px4_change = Px4Change(CHANGED, stays=True)
    assert codes(world.tick()) == [ReasonCode.PX4_CHANGED]
    assert world.why == (FlightState.RETURN, ReasonCode.PX4_CHANGED)
    world.enable(safety_action="hold")
    world.run(1.0)
    assert world.state() is FlightState.HOLD
    world.enable()
    world.run(0.2)
    assert world.why == (FlightState.RETURN, ReasonCode.PX4_CHANGED)
    world.until(FlightState.LANDED, 40.0)


def test_a_takeoff_from_an_autopilot_that_others_change_ends_at_home(world: World) -> None:
    world.ready()
    world.obey("takeoff")
    world.until(FlightState.TAKEOFF, 10.0)
    world.px4_change = Px4Change(CHANGED, stays=True)
    world.until(FlightState.RETURN, 25.0)
    world.until(FlightState.LANDED, 40.0)


def test_a_lost_position_stops_and_then_lands(world: World) -> None:
    world.fly()
    world.position_known = False
    world.run(0.6)
    (doubtful,) = world.tick().alarms
    assert doubtful.code is ReasonCode.POSITION_DOUBTFUL
    world.reads(doubtful, "position doubtful: ")
    world.run(1.0)
    assert world.state() is FlightState.MISSION
    assert world.speed_m_s < 0.1
    world.run(0.5)
    assert world.state() is FlightState.LAND
    (lost,) = world.tick().alarms
    assert lost.code is ReasonCode.POSITION_LOST
    world.reads(lost, "position lost: ")
    world.position_known = True
    world.until(FlightState.LANDED, 30.0)


@pytest.mark.parametrize("beat_s_ago", [0.2, 0.9])
def test_an_autopilot_that_falls_silent_is_stopped_landed_and_given_up(beat_s_ago: float) -> None:
    """When docs/faults.md says, from its last message."""
    after = "0.7 s and 2 s after its last position; FAULT 2.5 s after its last message of any kind"
    assert f"| {after}, or 10 s after its last heartbeat" in FAULTS_PAGE.read_text()
    world = World()
    world.fly()
    while not beat_s_ago <= world.now_s - world.heard.heartbeat_at_s < beat_s_ago + TICK_S:
        world.tick()
    world.silent_from_s, world.telemetry, world.beats = world.now_s, False, []
    stopped_s, actions, sent_s = math.inf, len(world.actions), 0.0
    while world.state() is not FlightState.FAULT:
        world.tick()
        silent_s = world.now_s - world.silent_from_s
        sent = world.setpoint
        if isinstance(sent, MissionVelocity) and math.hypot(*sent.velocity_m_s[:2]) == 0.0:
            assert abs(sent.velocity_m_s[2]) <= 0.5
            stopped_s = min(stopped_s, silent_s)
        if world.setpoint_at_s == world.now_s:
            sent_s = silent_s
    assert 0.6 <= stopped_s <= 0.7 + 1e-6
    assert [action for _, action in world.actions[actions:]] == [Action.LAND]
    fault_s = world.now_s - world.silent_from_s
    assert 2.5 <= fault_s <= 2.6 + 1e-6
    asked_s = [at_s - world.silent_from_s for at_s, _ in world.actions[actions:]]
    assert all(2.0 <= at_s <= 2.1 + 1e-6 for at_s in asked_s)
    world.run(3.0)
    assert sent_s <= 2.0 and world.setpoint_at_s - world.silent_from_s == sent_s
    assert len(world.actions) == actions + 1


def test_a_glitch_stops_and_the_mission_goes_on(world: World) -> None:
    world.fly()
    world.position_known = False
    world.run(1.5)
    world.position_known = True
    world.run(2.9)
    assert world.state() is FlightState.MISSION and world.speed_m_s < 0.1
    world.run(2.0)
    assert world.state() is FlightState.MISSION and world.speed_m_s > 0.5
    assert world.tick().alarms == ()


@pytest.mark.parametrize("state", [FlightState.HOLD, FlightState.TAKEOFF, FlightState.RETURN])
def test_a_position_in_doubt_is_stood_still_by(world: World, state: FlightState) -> None:
    if state is FlightState.TAKEOFF:
        world.ready()
        world.obey("takeoff")
        world.until(FlightState.TAKEOFF, 5.0)
        world.run(3.0)
    else:
        world.fly()
        world.enable(safety_action="hold" if state is FlightState.HOLD else "return")
        world.run(3.0)
    assert world.state() is state
    world.accuracy_m = 7.0
    world.run(3.0)
    assert world.state() is state
    assert world.speed_m_s < 0.1
    assert ReasonCode.POSITION_DOUBTFUL in codes(world.tick())
    # The numbers may be another place's now: it is not flown to.
    place_m = world.position_m.copy()
    world.position_m[0] += 5.0
    world.run(1.0)
    world.accuracy_m = 0.9
    world.run(5.0)
    if state is FlightState.HOLD:
        assert math.dist(world.position_m[:2], (place_m[0] + 5.0, place_m[1])) < 0.5
    if state is FlightState.TAKEOFF:
        world.until(FlightState.HOLD, 20.0)


def test_a_position_that_stays_in_doubt_lands(world: World) -> None:
    world.fly()
    world.accuracy_m = 7.0
    world.run(59.0)
    assert world.state() is FlightState.MISSION
    world.until(FlightState.LAND, 3.0)
    world.until(FlightState.LANDED, 20.0)


def test_what_px4_warns_of_in_flight_is_an_alarm(world: World) -> None:
    warning = AutopilotReason(
        "commander_failsafe_enter", (0, 7, 4), "failsafe, battery critical: PX4 lands"
    )
    world.heard = structs.replace(world.heard, warnings=(warning,))
    world.enable()
    world.run(1.0)
    assert world.tick().alarms == ()
    world.fly()
    (alarm,) = world.tick().alarms
    assert alarm.code is ReasonCode.PX4
    world.reads(alarm, f"PX4: {warning.text}")


def test_a_battery_that_just_lasts_for_the_way_home_returns(world: World) -> None:
    plenty = Energy(lasts_s=200.0, home_s=150.0, cell_v=3.7, low_cell_v=3.4)
    for short in (plenty._replace(lasts_s=149.0), plenty._replace(cell_v=3.31)):
        world.energy = plenty
        world.fly()
        world.energy = short
        decision = world.tick()
        assert world.state() is FlightState.RETURN
        assert codes(decision) == [ReasonCode.BATTERY_LOW]
        world.enable(safety_action="hold")
        world.run(1.0)
        assert world.refuse("start") is RefusalCode.GROUND_COMMANDS
        world.enable()
        world.run(0.2)
        assert world.state() is FlightState.RETURN
        world.until(FlightState.LANDED, 40.0)
        world.energy = plenty._replace(home_s=None)


def test_a_neighbour_too_close_holds_and_alarms(world: World) -> None:
    world.fly()
    world.closest = Closest(9, 1.4)
    decision = world.tick()
    assert world.state() is FlightState.HOLD
    assert codes(decision) == [ReasonCode.TOO_CLOSE]
    world.reads(decision.alarms[0], "only 1.4 m to robot 9")
    # On its way home it brakes, but does not flicker between two states.
    world.enable(safety_action="return")
    world.run(1.0)
    assert world.state() is FlightState.RETURN


def test_a_lost_remote_control_is_an_alarm_and_what_is_configured(world: World) -> None:
    reactions: tuple[tuple[RemoteControlLost | None, FlightState], ...] = (
        (None, FlightState.MISSION),
        ("alarm", FlightState.MISSION),
        ("hold", FlightState.HOLD),
        ("land", FlightState.LAND),
    )
    for reaction, state in reactions:
        world.robot = replace(ROBOT, on_remote_control_lost=reaction)
        world.fly()
        world.remote_control = False
        world.run(0.8)
        world.remote_control = True  # That was no loss.
        world.run(0.8)
        assert world.state() is FlightState.MISSION
        world.remote_control = False
        world.run(1.5)
        assert world.state() is state
        lost = ReasonCode.REMOTE_CONTROL_LOST in codes(world.tick())
        assert lost is (reaction is not None)
        if reaction == "hold":
            assert world.refuse("start") is RefusalCode.REMOTE_CONTROL_LOST
        # On its way home it goes on.
        world.enable(safety_action="none" if reaction == "land" else "return")
        world.until(FlightState.LANDED, 40.0)
        world.remote_control = True


def test_a_remote_control_of_which_nothing_is_told_any_more_is_lost(world: World) -> None:
    world.robot = replace(ROBOT, on_remote_control_lost="land")
    world.fly()
    world.remote_control = None
    world.run(0.8)
    assert world.state() is FlightState.MISSION
    world.run(0.5)
    assert world.why == (FlightState.LAND, ReasonCode.REMOTE_CONTROL_LOST)


def test_what_was_not_told_while_the_program_stood_still_is_not_lost(world: World) -> None:
    world.robot = replace(ROBOT, on_remote_control_lost="land")
    world.fly()
    world.remote_control = world.battery = None
    world.stop(3.0)
    assert ReasonCode.BATTERY_NOT_KNOWN not in codes(world.tick())
    world.remote_control, world.battery = True, 0.9
    world.run(4.0)
    assert world.state() is FlightState.HOLD
    assert ReasonCode.REMOTE_CONTROL_LOST not in codes(world.tick())


def test_who_lands_where_it_is_does_not_land_beside_its_landing_point(world: World) -> None:
    world.fly()
    world.lands_beside_m = (2.0, 1.0)
    assert codes(world.tick()) == [ReasonCode.LANDS_BESIDE]
    world.enable(safety_action="return")
    world.until(FlightState.RETURN, 2.0)
    assert ReasonCode.LANDS_BESIDE in codes(world.tick())
    world.battery = 0.05
    world.until(FlightState.LAND, 2.0)
    assert ReasonCode.LANDS_BESIDE not in codes(world.tick())
    world.pilot()
    world.until(FlightState.PILOT, 4.0)
    assert ReasonCode.LANDS_BESIDE not in codes(world.tick())


@pytest.mark.parametrize(
    ("heard", "code", "text"),
    [
        ({"link_lost": 0.2}, ReasonCode.LINK_LOSES, "20% of the autopilot's messages are lost"),
        ({"link_twice": True}, ReasonCode.LINK_TWICE, "MAVLink arrives twice"),
    ],
)
def test_a_bad_link_to_the_autopilot_is_an_alarm_at_all_times(
    world: World, heard: dict[str, float], code: ReasonCode, text: str
) -> None:
    world.ready()
    world.heard = structs.replace(world.heard, **heard)
    (alarm,) = world.tick().alarms
    assert alarm.code is code and alarm.text.startswith(text)
    world.fly()
    assert world.tick().alarms == (alarm,)
    assert world.state() is FlightState.MISSION


def test_a_battery_that_is_not_known_in_flight_is_an_alarm(world: World) -> None:
    world.fly()
    assert world.tick().alarms == ()
    world.battery = None
    assert codes(world.tick()) == [ReasonCode.BATTERY_NOT_KNOWN]
    assert world.state() is FlightState.MISSION


def test_a_stale_policy_holds(world: World) -> None:
    world.fly()
    world.policy_m_s = None
    world.tick()
    assert world.state() is FlightState.HOLD
    assert world.flight.alarming
    world.policy_m_s = np.ones(2)
    world.run(2.0)
    assert world.state() is FlightState.HOLD


def test_the_autopilot_that_lands_is_left_to_land(world: World) -> None:
    for failsafe in (None, Mode.LAND):
        world.fly()
        rows, asked = len(world.taken), world.asked(Action.OFFBOARD)
        world.mode = world.intended = Mode.LAND
        world.failsafe = failsafe
        world.until(FlightState.LAND, 2.5)
        assert len(world.taken) == rows + 1
        world.enable(safety_action="hold")
        world.until(FlightState.LANDED, 20.0)
        assert world.asked(Action.OFFBOARD) == asked
        world.failsafe = None


def test_a_landing_that_cannot_be_held_goes_on(world: World) -> None:
    cases: tuple[tuple[Mode | None, float], ...] = ((None, 6.5), (Mode.LAND, 3.0))
    for failsafe, within_s in cases:
        world.hover()
        world.enable(safety_action="land")
        world.run(3.0)
        world.refuses = {Action.OFFBOARD: "not now"}
        world.enable(safety_action="hold")
        world.until(FlightState.HOLD, 0.2)
        world.failsafe = failsafe
        world.until(FlightState.LAND, within_s)
        assert world.why == (FlightState.LAND, ReasonCode.AUTOPILOT_LANDS)
        world.until(FlightState.LANDED, 20.0)
        world.refuses, world.failsafe = {}, None


def test_a_vehicle_that_leaves_offboard_is_not_fought_for(world: World) -> None:
    world.fly()
    world.mode = world.intended = Mode.RETURN
    world.until(FlightState.PILOT, 2.5)
    world.run(10.0)
    assert world.state() is FlightState.PILOT
    assert world.mode is Mode.RETURN
    # Once it is down PX4 would not arm in that mode.
    world.position_m[2], world.armed = 0.0, False
    world.until(FlightState.LANDED, 2.5)
    world.run(3.0)
    assert world.asked(Action.HOLD) == 1


def test_the_autopilot_falls_silent_and_answers_again(world: World) -> None:
    world.fly()
    world.telemetry = False
    world.until(FlightState.FAULT, 6.0)
    world.run(3.0)
    world.telemetry = True
    world.until(FlightState.PILOT, 4.0)
    assert world.why == (FlightState.PILOT, ReasonCode.ARMED_BEFORE)
    world.run(3.0)
    world.telemetry = False
    world.until(FlightState.FAULT, 6.0)
    world.armed = False
    world.telemetry = True
    # Without a position it may be an autopilot that was switched on anew.
    world.silent_from_s = world.now_s
    world.run(5.0)
    assert world.state() is FlightState.FAULT
    world.silent_from_s = math.inf
    world.until(FlightState.IDLE, 5.0)


def test_a_vehicle_that_was_disarmed_in_the_air_has_not_landed(world: World) -> None:
    world.fly()
    world.armed, world.fell = False, True
    world.until(FlightState.FAULT, 2.5)
    assert world.why == (FlightState.FAULT, ReasonCode.DISARMED_IN_AIR)
    world.run(5.0)
    assert world.state() is FlightState.FAULT
    assert world.flight.alarming


def test_an_autopilot_that_answers_again_after_it_started_anew_in_the_air(world: World) -> None:
    world.fly()
    world.telemetry = False
    world.until(FlightState.FAULT, 6.0)
    world.armed, world.fell, world.telemetry = False, True, True
    world.run(5.0)
    assert world.why == (FlightState.FAULT, ReasonCode.DISARMED_IN_AIR)


def test_without_positions_the_policy_is_not_to_blame(world: World) -> None:
    world.fly()
    world.silent_from_s = world.now_s
    world.run(0.9)
    assert world.state() is FlightState.MISSION
    world.policy_m_s = None
    world.tick()
    assert world.why == (FlightState.HOLD, ReasonCode.AUTOPILOT_SILENT)


def test_offboard_refused_leaves_it_to_the_pilot(world: World) -> None:
    world.fly()
    world.pilot()
    world.until(FlightState.PILOT, 2.5)
    world.refuses = {Action.OFFBOARD: "sticks"}
    world.obey("rejoin")
    world.run(3.5)
    assert world.state() is FlightState.HOLD
    world.until(FlightState.PILOT, 2.0)
    assert world.why == (FlightState.PILOT, ReasonCode.PILOT)
    world.mode = world.intended = Mode.HOLD
    world.run(3.0)
    world.obey("rejoin")
    world.until(FlightState.PILOT, 6.0)
    assert world.flight.reason.code is ReasonCode.OFFBOARD_REFUSED


# The autopilot's own failsafe


def test_a_landing_that_the_autopilots_failsafe_interrupts_goes_on(world: World) -> None:
    # As PX4 v1.17 does with a critical battery: 5.5 s of hold, then it lands.
    world.hover()
    world.enable(safety_action="land")
    world.run(4.0)
    asked = len(world.actions)
    world.failsafe = Mode.HOLD
    world.run(5.5)
    assert ReasonCode.FAILSAFE in codes(world.tick())
    assert world.state() is FlightState.LAND
    world.enable(safety_action="hold")
    world.run(0.5)
    assert world.state() is FlightState.LAND
    world.failsafe = Mode.LAND
    world.until(FlightState.LANDED, 20.0)
    assert len(world.actions) == asked


def test_a_landing_is_resumed_when_the_autopilots_failsafe_ends_without_one(world: World) -> None:
    world.hover()
    world.enable(safety_action="land")
    world.run(4.0)
    world.intended = world.failsafe = Mode.HOLD
    world.run(4.0)
    asked, height_m = world.asked(Action.LAND), world.height_m
    world.end_failsafe()
    world.run(3.0)
    assert world.asked(Action.LAND) == asked + 1
    assert world.height_m < height_m
    world.until(FlightState.LANDED, 20.0)


def test_a_pilot_wins_over_the_autopilots_failsafe(world: World) -> None:
    safety_actions: tuple[SafetyAction, ...] = ("hold", "land")
    for safety_action in safety_actions:
        world.hover()
        world.enable(safety_action=safety_action)
        world.run(3.0)
        world.failsafe = Mode.HOLD
        world.run(3.0)
        world.pilot()
        world.until(FlightState.PILOT, 2.5)
        # PX4 still warns of why it acted.
        warned = world._decide(structs.replace(world._hear(), failsafe=True))
        assert ReasonCode.FAILSAFE not in codes(warned)
        world.run(4.0)
        assert world.mode is Mode.POSITION
        world.pilot(0.0, 0.0, -1.0)
        while world.height_m > 0.0:
            world.tick()
        world.armed = False
        world.until(FlightState.LANDED, 2.5)


def test_the_autopilots_failsafe_in_a_mission_holds_and_then_lands(world: World) -> None:
    world.fly()
    asked = len(world.actions)
    world.failsafe = Mode.HOLD
    world.until(FlightState.HOLD, 2.5)
    assert world.flight.alarming
    world.run(3.0)
    # The ground comes after it.
    world.enable(safety_action="return")
    world.run(3.0)
    assert world.state() is FlightState.HOLD
    assert world.refuse("start") is RefusalCode.GROUND_COMMANDS
    world.enable()
    assert world.refuse("start") is RefusalCode.FAILSAFE
    world.failsafe = Mode.LAND
    world.until(FlightState.LAND, 2.5)
    world.until(FlightState.LANDED, 20.0)
    assert len(world.actions) == asked


def test_after_the_autopilots_failsafe_the_robot_holds_or_returns_home(world: World) -> None:
    world.fly()
    world.failsafe = Mode.HOLD
    world.run(4.0)
    world.position_m[0] += 2.0  # Where it stands then counts.
    world.run(1.5)
    at_m = world.position_m.copy()
    world.end_failsafe()
    world.run(5.0)
    assert world.state() is FlightState.HOLD
    assert world.mode is Mode.OFFBOARD
    assert world.position_m == pytest.approx(at_m, abs=0.3)
    world.enable(safety_action="return")
    world.run(1.5)
    world.failsafe = Mode.HOLD
    world.until(FlightState.HOLD, 2.5)
    world.end_failsafe()
    world.until(FlightState.RETURN, 2.5)
    world.until(FlightState.LANDED, 40.0)


# Nobody is left hovering


def test_a_vehicle_that_the_autopilots_failsafe_holds_for_a_minute_is_landed(world: World) -> None:
    world.hover()
    world.failsafe = Mode.HOLD
    world.run(55.0)
    assert world.state() is FlightState.HOLD
    world.until(FlightState.LAND, 8.0)
    world.until(FlightState.LANDED, 20.0)


def test_a_landing_that_the_autopilots_failsafe_holds_for_a_minute_is_asked_for_again(
    world: World,
) -> None:
    world.hover()
    world.enable(safety_action="land")
    world.run(10.0)
    world.failsafe = Mode.HOLD
    world.run(54.0)
    assert world.mode is Mode.HOLD
    world.until(FlightState.LANDED, 30.0)


def test_after_a_lapse_that_nobody_answers_it_lands(world: World) -> None:
    world.fly()
    world.stop(3.0)
    began_s = world.now_s
    world.run(30.0)
    world.stop(1.0)  # Another one is no answer, nor is what somebody else is told.
    world.order = replace(world.new_order("reset"), robot_id=4)
    world.tick()
    world.order = None
    assert world.flight.alarming
    (alone,) = (a for a in world.tick().alarms if a.code is ReasonCode.HOVERS_ALONE)
    world.reads(alone, "hovers unattended: lands 60 s after it began, unless ordered or held")
    world.until(FlightState.LAND, 35.0)
    assert world.now_s - began_s == pytest.approx(60.0, abs=1.0)
    assert world.flight.reason.code is ReasonCode.NOBODY_ANSWERED
    world.until(FlightState.LANDED, 20.0)


def test_after_a_lapse_that_somebody_answers_it_stays(world: World) -> None:
    def hold() -> None:
        world.enable(safety_action="hold")
        world.run(0.5)
        world.enable()

    for answer in (hold, lambda: world.obey("reset"), lambda: world.refuse("rejoin")):
        world.fly()
        world.stop(3.0)
        world.run(30.0)
        answer()
        world.run(65.0)
        assert world.state() is FlightState.HOLD
        world.enable(safety_action="land")
        world.until(FlightState.LANDED, 20.0)


def test_a_hold_for_which_somebody_gave_a_reason_lasts(world: World) -> None:
    world.hover()
    world.run(65.0)
    assert world.state() is FlightState.HOLD
    world.obey("start", "first")
    world.run(1.0)
    world.obey("pilot")
    world.run(65.0)
    assert (world.state(), world.mode) == (FlightState.PILOT, Mode.HOLD)


def test_a_program_that_finds_its_vehicle_in_hold_lands_it_if_nobody_answers(world: World) -> None:
    world.fly()
    world.mode = world.intended = Mode.HOLD  # The watchdog's.
    world.restart()
    world.until(FlightState.PILOT, 2.5)
    began_s, actions = world.now_s, list(world.actions)
    world.run(58.0)
    assert world.actions == actions
    world.until(FlightState.LAND, 3.0)
    assert world.now_s - began_s == pytest.approx(60.0, abs=0.3)
    world.until(FlightState.LANDED, 20.0)


def test_a_vehicle_in_hold_that_somebody_has_is_left_to_him(world: World) -> None:
    def fly_a_little() -> None:
        world.pilot()
        world.run(2.5)
        world.mode = world.intended = Mode.HOLD

    def hold() -> None:
        world.enable(safety_action="hold")
        world.run(0.5)

    for answer in (fly_a_little, hold, lambda: world.refuse("takeoff")):
        world.fly()
        world.mode = world.intended = Mode.HOLD
        world.restart()
        world.until(FlightState.PILOT, 2.5)
        world.run(30.0)
        answer()
        world.run(65.0)
        assert (world.state(), world.mode) == (FlightState.PILOT, Mode.HOLD)
        world.mode = world.intended = Mode.LAND
        world.until(FlightState.LANDED, 20.0)


def test_a_vehicle_that_was_armed_in_hold_on_the_ground_is_not_landed(world: World) -> None:
    world.armed, world.mode, world.intended = True, Mode.HOLD, Mode.HOLD
    world.until(FlightState.PILOT, 2.5)
    world.run(65.0)
    assert world.state() is FlightState.PILOT
    assert world.actions == []


def test_offboard_that_is_refused_after_a_lapse_leaves_nobody_hovering(world: World) -> None:
    world.fly()
    world.refuses = {Action.OFFBOARD: "not now"}
    world.stop(3.0)
    world.until(FlightState.PILOT, 9.0)
    world.until(FlightState.LAND, 61.0)
    world.until(FlightState.LANDED, 20.0)


# A lapse of the control loop


def test_after_a_lapse_nothing_moves_until_the_operator_resumes(world: World) -> None:
    world.fly()
    assert world.speed_m_s > 0.5
    world.stop(20.0)
    assert world.state() is FlightState.HOLD
    assert world.flight.alarming
    world.run(1.0)
    world.position_m[0] += 0.4  # Where it stands then counts.
    at_m = world.position_m.copy()
    sent_s = world.setpoint_at_s
    world.run(0.7)
    assert world.setpoint_at_s == sent_s  # Stale telemetry is worked off first.
    for _ in range(100):
        world.tick()
        assert world.state() is FlightState.HOLD
        assert world.speed_m_s < 0.2
    assert world.position_m == pytest.approx(at_m, abs=0.1)
    assert world.mode is Mode.OFFBOARD
    world.obey("start", "first")
    world.run(3.0)
    assert world.speed_m_s > 0.5


def test_just_after_a_lapse_no_order_is_taken(world: World) -> None:
    world.fly()
    world.stop(0.8)
    assert world.refuse("start") is RefusalCode.CONTROL_SILENT


def test_after_a_lapse_without_a_watchdog_the_autopilots_landing_goes_on(world: World) -> None:
    world.fly()
    world.watchdog = False
    world.stop(4.0)
    world.until(FlightState.LAND, 4.0)
    world.until(FlightState.LANDED, 20.0)


def test_after_a_lapse_that_only_the_program_saw_the_vehicle_holds() -> None:
    world = World()
    world.fly()
    world.watchdog = False
    world.stop(0.6)
    world.next_beat_s, world.latency_s = world.now_s + 0.05, 0.0
    world.run(10.0)
    assert world.asked(Action.HOLD) == 1
    assert world.state() is FlightState.HOLD
    assert world.height_m == pytest.approx(SLOT_M, abs=0.3)


def test_a_pilot_who_took_it_during_a_lapse_keeps_it(world: World) -> None:
    world.fly()
    world.pilot(0.0, 0.5, 0.0)
    world.stop(3.0)
    world.until(FlightState.PILOT, 2.5)
    world.run(5.0)
    assert world.mode is Mode.POSITION


# A pilot


def test_the_operator_gives_it_to_a_pilot_and_takes_it_back(world: World) -> None:
    def start() -> None:
        world.obey("start", "first")
        world.run(1.0)

    def hold() -> None:
        world.enable(safety_action="hold")
        world.run(1.0)

    def fly_home() -> None:
        world.enable(safety_action="return")
        world.run(1.0)

    safety_actions: tuple[SafetyAction, ...] = ("land", "return", "hold", "none")
    world.hover()
    for begin, state in (
        (hold, FlightState.HOLD), (start, FlightState.MISSION), (fly_home, FlightState.RETURN),
    ):  # fmt: skip
        begin()
        assert world.state() is state
        world.obey("pilot")
        assert world.why == (FlightState.PILOT, ReasonCode.GIVEN_TO_PILOT)
        assert ReasonCode.GIVEN_TO_PILOT in codes(world.tick())
        # Again is no mistake; and nothing that the ground repeats takes it back.
        world.obey("pilot")
        for safety_action in safety_actions:
            world.enable(safety_action=safety_action)
            world.run(1.5)
            assert world.state() is FlightState.PILOT
            assert world.mode == Mode.HOLD
        assert world.speed_m_s < 0.1
        world.obey("rejoin")
        world.run(3.0)
        assert world.state() is FlightState.HOLD
        assert world.mode is Mode.OFFBOARD
    world.enable(safety_action="land")
    world.run(1.0)
    assert world.refuse("pilot") is RefusalCode.WRONG_STATE


def test_a_pilot_takes_it_away_and_the_operator_takes_it_back(world: World) -> None:
    world.fly()
    world.pilot(1.0, 0.0, 0.0)
    world.until(FlightState.PILOT, 2.5)
    while world.position_m[0] < 33.0:
        world.tick()
    assert world.refuse("rejoin") is RefusalCode.OUTSIDE_FENCE
    world.pilot(-1.0, 0.0, -0.3)
    while world.position_m[0] > 25.0:
        world.tick()
    assert world.refuse("rejoin") is RefusalCode.NOT_AT_HEIGHT
    world.position_m[2] = SLOT_M
    world.pilot()
    world.obey("rejoin")
    while not world.flight.reached:
        world.tick()
    world.pilot()  # He takes it again at once.
    world.until(FlightState.PILOT, 2.5)
    assert world.why == (FlightState.PILOT, ReasonCode.PILOT)
    world.obey("rejoin")
    world.run(5.0)
    assert world.state() is FlightState.HOLD
    assert world.mode is Mode.OFFBOARD
    world.obey("start", "first")
    world.run(1.0)
    assert world.state() is FlightState.MISSION


def test_a_pilot_keeps_a_vehicle_that_was_told_to_land_or_to_stop_landing(world: World) -> None:
    for safety_action in ("land", "hold"):
        world.hover()
        world.enable(safety_action="land")
        world.run(0.1 if safety_action == "land" else 3.0)
        world.enable(safety_action=safety_action)
        world.run(0.9)
        world.pilot()
        world.until(FlightState.PILOT, 2.5)
        world.run(4.0)
        assert world.mode is Mode.POSITION
        world.pilot(0.0, 0.0, -1.0)
        while world.height_m > 0.0:
            world.tick()
        world.armed = False
        world.until(FlightState.LANDED, 2.5)
        world.enable()
        world.until(FlightState.PREFLIGHT, 1.0)


def test_a_landing_that_somebody_else_ends_is_his(world: World) -> None:
    world.hover()
    world.enable(safety_action="land")
    world.run(3.0)
    world.mode = world.intended = Mode.HOLD
    world.until(FlightState.PILOT, 2.5)


def test_a_program_that_starts_in_flight_only_observes_until_rejoin(world: World) -> None:
    world.fly()
    world.pilot()
    world.run(2.5)
    actions = list(world.actions)
    world.restart()
    world.until(FlightState.PILOT, 2.0)
    assert world.why == (FlightState.PILOT, ReasonCode.ARMED_BEFORE)
    for safety_action in ("none", "hold", "land", "return", "none"):
        world.enable(safety_action=safety_action)
        world.run(2.0)
    world.battery = 0.1
    world.run(2.0)
    world.battery = 0.9
    assert world.state() is FlightState.PILOT
    assert world.actions == actions
    world.obey("rejoin")
    world.until(FlightState.HOLD, 1.0)
    world.run(4.0)
    assert world.state() is FlightState.HOLD
    assert world.height_m == pytest.approx(SLOT_M, abs=0.3)


def test_a_vehicle_armed_by_hand_is_only_observed(world: World) -> None:
    world.ready()
    world.armed, world.mode, world.intended = True, Mode.POSITION, Mode.POSITION
    world.until(FlightState.PILOT, 2.5)
    assert world.refuse("rejoin") in (RefusalCode.PLACE_NOT_KNOWN, RefusalCode.NOT_IN_THE_AIR)
    world.armed = False
    world.until(FlightState.LANDED, 2.5)
    world.run(1.0)
    assert world.actions == []


def test_a_ground_that_goes_leaves_preflight(world: World) -> None:
    world.ready()
    world.ground_on = False
    world.until(FlightState.IDLE, 4.0)
    world.telemetry = False
    world.until(FlightState.INIT, 4.0)


# Kill


@pytest.mark.parametrize("state", list(FlightState))
def test_kill_is_taken_in_every_state(state: FlightState) -> None:
    world = World()
    world.hover()
    world.flight = structs.replace(world.flight, state=state, since_s=world.now_s, reached=True)
    world.obey("kill")
    assert world.state() is FlightState.FAULT
    assert world.actions[-1][1] is Action.KILL
    world.run(3.0)
    assert not world.armed


def test_a_killed_robot_stays_so_but_kills_nobody_who_arms_it_later(world: World) -> None:
    world.fly()
    world.refuses = {Action.KILL: "did not hear"}
    world.obey("kill")
    world.run(3.0)
    assert world.asked(Action.KILL) >= 3
    world.refuses = {}
    world.run(4.0)
    assert not world.armed
    kills = world.asked(Action.KILL)
    world.armed, world.mode, world.intended = True, Mode.POSITION, Mode.POSITION
    world.run(5.0)
    assert world.asked(Action.KILL) == kills
    assert world.state() is FlightState.FAULT


# The table


def scenarios() -> list[Callable[[World], None]]:
    return [
        test
        for name, test in sorted(globals().items())
        if name.startswith("test_") and list(signature(test).parameters) == ["world"]
    ]


def test_every_transition_is_taken_in_some_scenario() -> None:
    reasons = reasons_by_row()
    assert [row for row in TRANSITIONS if not reasons[row.when, row.target]] == []


@pytest.mark.slow
def test_late_telemetry_changes_no_outcome() -> None:
    draw = random.Random(0)
    for scenario in scenarios():
        scenario(World(draw.random(), draw.random(), flown_again=True))


def test_the_page_for_people_has_the_same_table() -> None:
    page = FAULTS_PAGE.read_text().splitlines()
    start = page.index("| From | To | When |") + 2
    rows = page[start : page.index("", start)]
    expected = table()
    for row, wanted in zip(rows, expected, strict=False):
        assert row == wanted, f"docs/faults.md: {MEND}"
    assert len(rows) == len(expected), f"docs/faults.md: {MEND}"


def test_the_page_for_people_says_where_each_order_is_taken() -> None:
    rows = re.findall(r"^\| (\w+) \| ([^|]*) \| [^|]* \|$", SAFETY_PAGE.read_text(), re.MULTILINE)
    said = {kind: cell for kind, cell in rows if kind in ORDERS}
    assert list(said) == list(ORDERS)
    for kind, rule in ORDERS.items():
        named = {state for state in FlightState if state.name in re.findall(r"\w+", said[kind])}
        any_but = said[kind].startswith("any state")
        assert set(rule.states) == (set(FlightState) - named if any_but else named), kind


def test_a_row_does_what_its_fields_say() -> None:
    """Whatever its condition is: nothing asks which row it was."""
    world = World()
    world.fly()
    t = Tick(
        ROBOT, structs.replace(world.flight, target_m=(1.0, 2.0, 3.0)), world.inputs(world.heard)
    )
    assert t.flight.reached
    row = Transition(
        (FlightState.MISSION,),
        FlightState.HOLD,
        ReasonCode.OTHER,
        "a test wants it",
        lambda _: "so",
    )
    plain = enter(row, "so", t)
    assert (plain.state, plain.reason) == (FlightState.HOLD, Reason(ReasonCode.OTHER, "so"))
    assert not plain.alarming
    assert (plain.reached, plain.target_m, plain.alone_since_s) == (True, None, None)
    assert not plain.killed
    full = replace(
        row, alarm=True, land_by="return", unattended="yes", drops_observations=True,
        keeps_target=True, rejoins=True, kills=True,
    )  # fmt: skip
    after = enter(full, "so", t)
    assert (after.alarming, after.land_by, after.killed) == (True, "return", True)
    assert (after.reached, after.target_m) == (False, (1.0, 2.0, 3.0))
    assert after.alone_since_s == after.rejoined_at_s == world.now_s
    vehicle = structs.replace(world.heard, mode=Mode.HOLD)
    in_hold = structs.replace(t, inputs=structs.replace(t.inputs, vehicle=vehicle))
    sometimes = replace(row, unattended="if in hold")
    assert enter(sometimes, "so", t).alone_since_s is None
    assert enter(sometimes, "so", in_hold).alone_since_s == world.now_s


MEND = "its table of transitions must be what test_flight.table() returns, row by row"


def table() -> list[str]:
    """The machine as rows of Markdown, in the order of `TRANSITIONS`.

    From, to, when, and an example of what the operator reads, from the scenarios, with numbers as
    "…"; none if `when` has these words, or the row above. The states of which all four appear
    together are "flying".
    """
    rows, above = [], ""
    reasons = reasons_by_row()
    for row in TRANSITIONS:
        everywhere = set(row.sources) == set(FlightState)
        sources = "any" if everywhere else ", ".join(state.name for state in row.sources)
        sources = sources.replace("TAKEOFF, HOLD, MISSION, RETURN", "flying")
        said = min(reasons[row.when, row.target])
        shown = "" if said in row.when or said == above else f": *{said}*"
        above = said
        rows.append(f"| {sources} | {row.target.name} | {row.when}{shown} |")
    return rows


@functools.cache
def reasons_by_row() -> Mapping[tuple[str, FlightState], set[str]]:
    """The reasons that the scenarios gave for each row, by when it applies and its target."""
    reasons: dict[tuple[str, FlightState], set[str]] = defaultdict(set)
    for scenario in scenarios():
        name = scenario.__name__
        if name not in _flown:
            scenario(_flown.setdefault(name, World(flown_again=True)))
        world = _flown[name]
        for row, reason in zip(world.taken, world.reasons, strict=True):
            reasons[row.when, row.target].add(re.sub(r"\d+(\.\d+)?", "…", reason))
    return reasons


# Whatever comes


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    begin=st.sampled_from([World.enable, World.ready, World.hover, World.fly]),
)
def test_whatever_comes_nothing_raises_or_arms_unasked(
    seed: int, begin: Callable[[World], None]
) -> None:
    """The checks are the world's own, in every tick."""
    draw = random.Random(seed)
    world = World(draw.random(), draw.random())
    begin(world)
    for _ in range(400):
        if draw.random() < 0.1:
            draw.choices(CHANGES, weights=(12, 1, 1, 6, 4, 3, 1, 1))[0](world, draw)
        world.tick()
        world.order = None


def _order(world: World, draw: random.Random) -> None:
    kinds: tuple[OrderKind, ...] = (
        "takeoff", "start", "rejoin", "pilot", "reset", "disarm", "kill",
    )  # fmt: skip
    kind = draw.choices(kinds, weights=(30, 20, 10, 5, 5, 5, 1))[0]
    order = world.new_order(kind, draw.choice(("", "a")))
    if draw.random() < 0.3:
        order = replace(order, order_id=f"o{draw.randrange(5)}")
    if draw.random() < 0.1:
        order = replace(order, boot_nonce=draw.randrange(100))
    if draw.random() < 0.1:
        order = replace(order, expires_at_uptime_s=draw.choice((math.nan, -1.0, 1e9)))
    world.order = order


def _mode(world: World, draw: random.Random) -> None:
    world.mode = world.intended = draw.choice(list(Mode))
    world.failsafe = draw.choice((None, None, Mode.HOLD, Mode.LAND, Mode.RETURN))


def _arm(world: World, draw: random.Random) -> None:
    world.armed = draw.random() < 0.5


def _ground(world: World, draw: random.Random) -> None:
    safety_actions: tuple[SafetyAction, ...] = ("none", "none", "none", "hold", "return", "land")
    world.enable(draw.choice(safety_actions))
    world.ground_on = draw.random() < 0.9


def _surroundings(world: World, draw: random.Random) -> None:
    world.remote_control = draw.random() < 0.8
    world.robot = replace(ROBOT, on_remote_control_lost=draw.choice(("alarm", "hold", "land")))
    world.policy_m_s = draw.choice((None, np.array([draw.uniform(-3, 3), draw.uniform(-3, 3)])))
    world.closest = draw.choice((None, None, Closest(4, draw.uniform(0.0, 3.0))))
    world.busy = draw.choice(((), (), (5,)))
    world.failed_checks = draw.choice(((), (), None, (FailedCheck(CheckCode.OTHER, "x"),)))
    world.battery = draw.choice((0.9, 0.9, 0.2, 0.1))
    world.px4_change = draw.choice((None, None, Px4Change("x", draw.random() < 0.5)))
    world.energy = draw.choice(
        (None, Energy(draw.uniform(0, 900), draw.uniform(0, 300), None, 3.4))
    )


def _vehicle(world: World, draw: random.Random) -> None:
    world.position_known = draw.random() < 0.8
    world.telemetry = draw.random() < 0.9
    world.refuses = draw.choice(({}, {}, {Action.OFFBOARD: "no"}, {Action.ARM: "no"}))


def _place(world: World, draw: random.Random) -> None:
    world.position_m = np.array([draw.uniform(-5, 40), draw.uniform(-5, 40), draw.uniform(0, 12)])


def _stop(world: World, draw: random.Random) -> None:
    world.watchdog = draw.random() < 0.5
    world.stop(draw.choice((0.6, 3.0, 15.0)))


CHANGES = (_order, _mode, _arm, _ground, _surroundings, _vehicle, _place, _stop)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"slot": -1}, "slot = -1"),
        ({"landing_point_m": (1.0,)}, "landing_point_m"),
        ({"landing_point_m": (1.0, math.nan)}, "landing_point_m"),
        ({"takeoff_timeout_s": 0.0}, "takeoff_timeout_s = 0.0"),
        ({"min_separation_m": 4.5}, "min_separation_m = 4.5"),
        ({"battery_critical": 0.3}, "battery_critical = 0.3"),
        ({"slot": 20}, "slot = 20"),
        ({"slot": 0, "base_height_m": 0.5}, "flies at 0.5 m: must be from floor_m = 1"),
        ({"landing_point_m": (1.0, 12.0)}, "buffer_m = 2"),
    ],
)
def test_parameters_that_cannot_be_flown_are_named(wrong: dict[str, object], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        replace(ROBOT, parameters=replace(ROBOT.parameters, **wrong))  # type: ignore[arg-type]
