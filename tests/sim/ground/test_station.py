"""What a station and its commands decide: stations and robots on a radio that loses messages.

Time is counted, nothing waits: a minute in the field takes a moment.
"""

import itertools
import random
from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.messages.codes import CheckCode, FailedCheck, RefusalCode
from edge.messages.mission import ORDER_LIFETIME_S, FlightState, Place, world_id
from lpac.analysis.snapshot import FleetSetup, FleetSlot, GroundEvent
from lpac.ground.station.commands import Commands, CommandTask
from lpac.ground.station.protocol import (
    CommandReport,
    Enable,
    NextTrial,
    ProblemCode,
    Request,
    ResultCode,
    Resume,
    RobotCommand,
    SafetyCommand,
    SetFence,
    SetOrigin,
    SetPlaces,
    SetWorld,
    Start,
    TakeCommand,
    Takeoff,
)
from lpac.ground.station.station import NameTakenError, Station, next_trial
from tests.pretend import BASE_HEIGHT_M, FENCE, ORIGIN, SLOT_SPACING_M, PretendedRobot
from tests.said import not_done, problem

_S = FlightState
STEP_S = 0.05
WORLD = "CircularBND 256 256 40 8\n"
OTHER_WORLD = "CircularBND 100 100 20 5\n"


def setup(operator: str, n: int, spares: int = 0) -> FleetSetup:
    return FleetSetup(
        fleet="test",
        operator=operator,
        robots={f"r{i}": i for i in range(n + spares)},
        slots=tuple(FleetSlot(Place(i, pad_m(i)), pad_m(i), f"r{i}") for i in range(n)),
        fence=FENCE,
        world=WORLD,
        world_id="configured",
        bundle_id="b",
        world_size=512,
        sensor_size=64,
        communication_range=128.0,
        env_scale=16.0,
        truncation=2.0,
        norm=1.0,
        base_height_m=BASE_HEIGHT_M,
        slot_spacing_m=SLOT_SPACING_M,
    )


def pad_m(i: int) -> tuple[float, float]:
    return 2.0 + 3.0 * i, 2.0


class Field:
    """Stations and robots. `loss` of all messages are lost, and all between those `cut` off."""

    def __init__(self, n: int = 3, *, spares: int = 0, loss: float = 0.0, seed: int = 0) -> None:
        self.now_s = 0.0
        self.loss = loss
        self.cut: set[frozenset[str]] = set()
        self.stations: dict[str, Station] = {}
        self.commands: dict[str, Commands] = {}
        self.events: list[GroundEvent] = []
        self.robots = [self.new_robot(i, n) for i in range(n + spares)]
        self.programs = list(self.robots)
        self._n, self._spares = n, spares
        self._random = random.Random(seed)
        self._ticks = 0

    def new_robot(self, i: int, n: int) -> PretendedRobot:
        return PretendedRobot(
            robot_id=i, slot=i, pad_m=pad_m(i), landing_point_m=pad_m(i), fleet_size=n,
            bundle_id="b", world_id="configured", now_s=self.now_s,
        )  # fmt: skip

    def join(self, name: str) -> Station:
        """Start a station, or start it again."""
        station = Station(setup(name, self._n, self._spares), self.now_s, 1e9 + self.now_s)
        self.stations[name], self.commands[name] = station, Commands(station)
        return station

    def restart(self, name: str, away_s: float = 0.5) -> Station:
        """As on the same laptop, where the last process' memory is."""
        former = self.stations[name]
        self.leave(name)
        self.run(away_s)
        station = self.join(name)
        if former.commands and former.state is not None:
            station.remember(former.state)
        return station

    def leave(self, name: str) -> None:
        del self.stations[name], self.commands[name]

    def step(self) -> None:
        self.now_s += STEP_S
        self._ticks += 1
        for station in self.stations.values():
            station.set_time(self.now_s, 1e9 + self.now_s)
        for i, robot in enumerate(self.programs):
            robot.step(self.now_s, STEP_S)
            if (self._ticks + i) % 5 == 0 and not robot.silent:
                status = robot.status(self.now_s)
                status = replace(status, unix_time_s=1e9 + self.now_s)
                for name, station in self.stations.items():
                    if self._arrives(name, f"r{robot.robot_id}"):
                        station.hear_status(status)
                        self.commands[name].step()
        for i, (name, station) in enumerate(tuple(self.stations.items())):
            if (self._ticks + i) % 4 == 0:
                station.tick()
                self.commands[name].step()
                self._publish(name, station)
            if name == next(iter(self.stations)):
                self.events += station.new_events()

    def _publish(self, name: str, station: Station) -> None:
        state, world = station.published_state(), station.published_world()
        for other in [s for n, s in self.stations.items() if n != name]:
            if state is not None and self._arrives(name, other.operator):
                other.hear_state(state)
            if world is not None and self._arrives(name, other.operator):
                other.hear_world(world)
        for robot in self.programs:
            here = f"r{robot.robot_id}"
            if state is not None and self._arrives(name, here):
                robot.hear_state(state)
            for order in station.published_orders():
                if self._arrives(name, here):
                    robot.hear_order(order)
            if world is not None and self._arrives(name, here):
                robot.hear_world(world)

    def _arrives(self, a: str, b: str) -> bool:
        return frozenset((a, b)) not in self.cut and self._random.random() >= self.loss

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s / STEP_S)):
            self.step()

    def until(self, condition: Callable[[], object], timeout_s: float = 60.0) -> None:
        for _ in range(round(timeout_s / STEP_S)):
            if condition():
                return
            self.step()
        raise AssertionError([(r.state, r.reason) for r in self.robots])

    def begin(self, request: Request, by: str = "alice") -> CommandTask:
        return self.commands[by].begin(request)

    def do(self, request: Request, by: str = "alice") -> CommandReport:
        running = self.begin(request, by)
        self.until(lambda: running.report, 300.0)
        assert running.report is not None
        return running.report

    def done(self, request: Request, by: str = "alice") -> CommandReport:
        report = self.do(request, by)
        assert report.done, report
        return report

    def states(self) -> set[FlightState]:
        return {robot.state for robot in self.robots}

    def make_ready(self, by: str = "alice") -> None:
        self.done(SetOrigin(ORIGIN), by)
        self.done(Enable(), by)

    def take_off(self, by: str = "alice") -> None:
        self.make_ready(by)
        self.done(Takeoff(interval_s=0.0), by)

    def land(self) -> None:
        """What flies is on its way down; the stations know it when it is."""
        self.until(lambda: self.states() == {_S.LANDED})
        self.run(0.5)

    def fly(self, by: str = "alice") -> None:
        self.take_off(by)
        self.done(Start(), by)


def a_field(n: int = 3, **options: float) -> Field:
    field = Field(n, **options)  # type: ignore[arg-type]
    field.join("alice")
    field.run(1.0)
    return field


# One station


def test_nothing_is_said_before_the_first_command() -> None:
    field = a_field()
    field.run(10.0)
    assert field.stations["alice"].published_state() is None
    assert all(robot.ground is None for robot in field.robots)


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_commands_arrive_although_messages_are_lost(loss: float) -> None:
    for seed in range(5):
        field = a_field(4, loss=loss, seed=seed)
        field.fly()
        assert field.states() == {_S.MISSION}
        field.done(SafetyCommand("hold"))
        field.done(Resume())
        field.done(SafetyCommand("return", wait=True))
        field.done(SetWorld(OTHER_WORLD, "w.env"))


def test_the_highest_takes_off_first_and_in_intervals() -> None:
    field = a_field(4)
    field.make_ready()
    began_s: dict[int, float] = {}
    running = field.begin(Takeoff(interval_s=3.0))
    while running.report is None:
        field.step()
        for robot in field.robots:
            if robot.state is _S.ARMING:
                began_s.setdefault(robot.robot_id, field.now_s)
    assert running.report.done
    assert list(began_s) == [3, 2, 1, 0]
    apart_s = [b - a for a, b in itertools.pairwise(began_s.values())]
    assert all(2.7 < passed_s < 3.6 for passed_s in apart_s), apart_s


def test_a_failure_keeps_the_others_on_the_ground_if_asked() -> None:
    field = a_field(4)
    field.make_ready()
    field.robots[2].refuses = "GPS: 4 satellites"
    field.run(1.0)
    report = field.do(Takeoff(interval_s=0.0, abort_on_failure=True))
    assert not_done(report) == {
        "r2": ResultCode.NOT_READY,
        "r1": ResultCode.NOT_ORDERED,
        "r0": ResultCode.NOT_ORDERED,
    }
    assert field.robots[3].state is _S.HOLD
    report = field.do(Takeoff(interval_s=0.0))
    assert not_done(report) == {"r2": ResultCode.NOT_READY}
    assert report.results[3].done


def test_a_climb_that_is_held_up_is_no_takeoff() -> None:
    field = a_field()
    field.make_ready()
    held_up = field.robots[1]
    running = field.begin(Takeoff(interval_s=0.0))
    field.until(lambda: held_up.state is _S.TAKEOFF, 10.0)
    held_up.enter(_S.HOLD, "control was silent for 0.7 s")
    field.until(lambda: running.report, 30.0)
    assert running.report is not None
    assert not_done(running.report) == {"r1": ResultCode.TOO_LOW}
    assert not_done(field.do(Takeoff())) == {"r1": ResultCode.TOO_LOW}
    field.done(SafetyCommand("land", wait=True))
    field.done(Takeoff(interval_s=0.0))


def test_who_is_in_the_air_keeps_what_it_has() -> None:
    field = a_field()
    field.take_off()
    for request in (SetOrigin(ORIGIN), SetFence(None), SetWorld(OTHER_WORLD, "w"),
                    SetPlaces({"r1": Place(5, (9.0, 9.0))})):  # fmt: skip
        before = field.stations["alice"].state
        report = field.do(request)
        assert problem(report) is ProblemCode.ARMED
        assert field.stations["alice"].state == before
    field.done(Start())
    assert problem(field.do(NextTrial())) is ProblemCode.ON_MISSION


def test_what_is_asked_of_some_robots_is_asked_of_them_alone() -> None:
    field = a_field()
    field.fly()
    field.done(SafetyCommand("hold", robots=("r1",)))
    assert [robot.state for robot in field.robots] == [_S.MISSION, _S.HOLD, _S.MISSION]
    assert not_done(field.do(Start())) == {"r1": ResultCode.UNDER_SAFETY_ACTION}
    field.done(SafetyCommand("land", robots=("r0",), wait=True))
    assert [robot.state for robot in field.robots] == [_S.LANDED, _S.HOLD, _S.MISSION]
    # The fleet's safety action is everybody's again.
    field.done(SafetyCommand("hold"))
    field.done(Resume())
    assert [robot.state for robot in field.robots][1:] == [_S.MISSION, _S.MISSION]
    field.done(Takeoff(robots=("r0",)))
    assert field.robots[0].state is _S.HOLD


def test_resume_starts_only_who_flew_this_trial() -> None:
    field = a_field()
    field.take_off()
    field.done(Start(robots=("r0",)))
    field.done(SafetyCommand("hold"))
    field.done(Resume())
    assert [robot.state for robot in field.robots] == [_S.MISSION, _S.HOLD, _S.HOLD]
    # Also who was on its way home.
    field.done(Start())
    for robot in field.robots:
        robot.position_m = (30.0, 30.0, robot.slot_height_m)
    field.run(0.5)
    field.done(SafetyCommand("return"))
    assert field.states() == {_S.RETURN}
    field.done(Resume())
    assert field.states() == {_S.MISSION}


def test_what_brought_robots_down_does_not_keep_them_there() -> None:
    field = a_field()
    for safety_action in ("land", "return", "hold"):
        field.take_off()
        field.done(SafetyCommand(safety_action))
        if safety_action == "hold":
            # Those that hold in the air are not sent off by somebody who forgot that.
            assert problem(field.do(Takeoff())) is ProblemCode.UNDER_SAFETY_ACTION
            field.done(SafetyCommand("land"))
        field.land()


def test_who_returns_waits_for_those_below() -> None:
    field = a_field(4)
    field.fly()
    for robot, far_m in zip(field.robots, (28.0, 4.0, 20.0, 6.0), strict=True):
        x_m, y_m = robot.landing_point_m
        robot.position_m = (x_m, y_m + far_m, robot.slot_height_m)
    field.begin(SafetyCommand("return"))
    landing: list[int] = []
    while field.states() != {_S.LANDED}:
        field.step()
        for robot in field.robots:
            if robot.state is _S.LAND and robot.robot_id not in landing:
                landing.append(robot.robot_id)
                flying = [r.slot for r in field.robots if r.state in (_S.RETURN, _S.MISSION)]
                over = [r.slot for r in field.robots if r._away_m(r.landing_point_m) < 1.5]
                assert all(slot > robot.slot or slot in over for slot in flying)
        assert field.now_s < 300.0
    assert landing[0] == 0


def a_return(field: Field, slow: int) -> None:
    """All return, and robot `slow` is so slow that the others wait for it over their places."""
    field.fly()
    field.run(5.0)
    field.robots[slow].speed_m_s = 0.1
    field.begin(SafetyCommand("return"))
    above = field.robots[slow + 1 :]
    field.until(lambda: all(robot.state is _S.HOLD for robot in above))


@pytest.mark.parametrize("by", ["alice", "bob"])
def test_whom_somebody_holds_in_a_return_stays(by: str) -> None:
    field = a_field()
    field.join("bob")
    a_return(field, slow=1)
    over = field.robots[0]
    field.until(lambda: over.state is _S.LAND or over._away_m(over.landing_point_m) < 1.4)
    # Also where it could be taken for one that waits.
    field.done(SafetyCommand("hold", robots=("r0",)), by)
    states = set()
    for _ in range(100):
        field.step()
        states.add(over.state)
    assert states == {_S.HOLD}
    # Who waits goes on when its way is free, and not before.
    assert [robot.state for robot in field.robots[1:]] == [_S.RETURN, _S.HOLD]
    field.done(SafetyCommand("hold", robots=("r1",)), by)
    field.until(lambda: field.robots[2].state is _S.LANDED)
    field.run(5.0)
    assert [robot.state for robot in field.robots[:2]] == [_S.HOLD, _S.HOLD]
    field.done(SafetyCommand("return", robots=("r0",), wait=True))
    assert field.robots[1].state is _S.HOLD
    field.done(SafetyCommand("land", robots=("r1",), wait=True))


@pytest.mark.parametrize("by", ["alice", "bob"])
def test_who_waits_in_a_return_may_be_held(by: str) -> None:
    field = a_field()
    field.join("bob")
    a_return(field, slow=0)
    field.done(SafetyCommand("hold", robots=("r0", "r2")), by)
    field.until(lambda: field.robots[1].state is _S.LANDED)
    field.done(TakeCommand(), "bob")
    field.run(20.0)
    assert [robot.state for robot in field.robots] == [_S.HOLD, _S.LANDED, _S.HOLD]
    field.robots[0].speed_m_s = 1.0
    field.done(SafetyCommand("return", wait=True), "bob")


def test_a_return_goes_on_with_another_commander() -> None:
    field = a_field()
    field.join("bob")
    a_return(field, slow=0)
    field.done(TakeCommand(), "bob")
    field.run(2.0)
    assert [robot.state for robot in field.robots] == [_S.RETURN, _S.HOLD, _S.HOLD]
    field.leave("alice")
    field.robots[0].speed_m_s = 1.0
    field.land()


def test_places_and_spares() -> None:
    field = a_field(3, spares=1)
    station = field.stations["alice"]
    field.done(SetOrigin(ORIGIN))
    assert station.flying == ("r0", "r1", "r2")
    report = field.do(SetPlaces({"r0": Place(0, (3.0, 3.0)), "r3": Place(0, (6.0, 3.0))}))
    assert problem(report) is ProblemCode.SLOT_SHARED
    places = {"r0": Place(0, pad_m(0)), "r2": Place(1, pad_m(1)), "r3": Place(2, pad_m(2))}
    field.done(SetPlaces(places))
    assert station.flying == ("r0", "r2", "r3")
    assert [robot.slot for robot in field.robots] == [0, 1, 1, 2]
    field.take_off()
    assert [robot.state is _S.HOLD for robot in field.robots] == [True, False, True, True]
    # Who comes after finds the robots where they are.
    field.leave("alice")
    again = field.join("alice")
    field.run(2.0)
    assert again.flying == ("r0", "r2", "r3")
    assert again.state is not None
    assert again.state.places == {"2": places["r2"], "3": places["r3"]}


def test_a_world_comes_with_its_text() -> None:
    field = a_field()
    field.robots[1].deaf = True
    report = field.do(SetWorld(OTHER_WORLD, "w.env"))
    assert not_done(report) == {"r1": ResultCode.NOT_OBEYING}
    assert field.stations["alice"].published_world() == OTHER_WORLD
    field.robots[1].deaf = False
    field.run(2.0)
    assert field.stations["alice"].published_world() is None


def test_a_world_that_another_station_sends_is_known() -> None:
    field = a_field()
    bob = field.join("bob")
    field.done(SetWorld(OTHER_WORLD, "w.env"))
    assert bob.setup.world == OTHER_WORLD
    assert bob.setup.world_id == field.stations["alice"].setup.world_id
    bob.hear_world("Uniform 3 1 0 0 9 0 9 9\n")
    field.done(SetWorld(WORLD, "w.env"))
    assert bob.setup.world == WORLD


def test_a_world_that_is_not_known_is_not_shown_as_another() -> None:
    field = a_field()
    field.done(SetWorld(OTHER_WORLD, "w.env"))
    # It comes when the robots have that world, and nobody sends it any more.
    bob = field.join("bob")
    assert (bob.setup.world, bob.setup.world_id) == (WORLD, "configured")
    field.run(0.5)
    assert (bob.setup.world, bob.setup.world_id) == ("", world_id(OTHER_WORLD))
    # Nor does a commander send a world that it does not have.
    field.done(TakeCommand(), "bob")
    field.robots[1].world_id = "configured"
    field.run(0.5)
    assert bob.published_world() is None


def test_nobody_said_a_world_and_the_robots_have_another_than_configured() -> None:
    field = a_field()
    for robot in field.robots:
        robot.world_id = "older"
    field.run(0.5)
    alice = field.stations["alice"]
    assert (alice.setup.world, alice.setup.world_id) == ("", "older")
    field.robots[0].world_id = "configured"
    field.make_ready()
    assert alice.setup.world_id == "older", "what most have"
    field.done(SetWorld(OTHER_WORLD, "w.env"))
    assert alice.setup.world == OTHER_WORLD


def test_a_world_that_cannot_be_used_is_not_sent_for_ever() -> None:
    field = a_field(1)
    station = field.stations["alice"]
    field.robots[0].deaf = True
    station.set_world(OTHER_WORLD)
    status = field.robots[0].status(field.now_s)
    for code, text in (
        (CheckCode.WORLD_NOT_ARRIVED, OTHER_WORLD),
        (CheckCode.WORLD_UNUSABLE, None),
    ):
        field.run(STEP_S)
        status = replace(status, not_taken=(FailedCheck(code, "x"),))
        station.hear_status(replace(status, sequence=field.robots[0].sequence + 1))
        field.robots[0].silent = True
        assert station.published_world() == text
        field.robots[0].sequence += 1


def test_trials_are_numbered() -> None:
    names = [""]
    for _ in range(3):
        names.append(next_trial(names[-1]))
    assert names == ["", "t1", "t2", "t3"]
    assert (next_trial("windy"), next_trial("windy9")) == ("windy2", "windy10")
    field = a_field()
    field.fly()
    field.done(SafetyCommand("land", wait=True))
    assert problem(field.do(NextTrial("second"))) is None
    field.done(Takeoff(interval_s=0.0))
    field.done(Start())
    assert {robot.trial for robot in field.robots} == {"second"}
    assert {event.trial for event in field.events} == {"", "t1", "second"}


def test_disable_holds_what_flies() -> None:
    field = a_field()
    field.fly()
    field.done(Enable(on=False))
    assert field.states() == {_S.HOLD}
    field.done(SafetyCommand("land", wait=True))
    assert problem(field.do(Takeoff())) is ProblemCode.NOT_ENABLED
    field.done(Enable(robots=("r1",)))
    assert not_done(field.do(Takeoff(robots=("r1",)))) == {}


def test_disarm_of_who_is_not_armed() -> None:
    field = a_field()
    report = field.done(RobotCommand("disarm", ("r0", "r2")))
    assert [result.robot for result in report.results] == ["r0", "r2"]


def test_a_safety_command_ends_what_sets_in_motion() -> None:
    for request in (SafetyCommand("hold"), SafetyCommand("land"), SafetyCommand("hold",
    robots=("r0",)), RobotCommand("kill", ("r0",)),
                    Enable(on=False)):  # fmt: skip
        field = a_field()
        field.make_ready()
        takeoff = field.begin(Takeoff(interval_s=30.0))
        field.run(1.0)
        assert field.robots[2].state is _S.TAKEOFF
        field.do(request)
        assert takeoff.report is not None
        assert set(not_done(takeoff.report).values()) == {ResultCode.ABANDONED}
        field.run(40.0)
        assert field.robots[1].state in (_S.PREFLIGHT, _S.IDLE)


# Robots' programs


def test_orders_are_for_one_start_of_a_program() -> None:
    field = a_field()
    field.make_ready()
    field.robots[1].deaf = True
    takeoff = field.begin(Takeoff(interval_s=0.0, robots=("r1",)))
    field.run(1.0)
    field.robots[1].restart()
    field.robots[1].deaf = False
    field.until(lambda: takeoff.report, 20.0)
    assert takeoff.report is not None
    (result,) = takeoff.report.results
    assert (result.code, result.refusal) == (ResultCode.REFUSED, RefusalCode.STARTED_AGAIN)
    field.run(15.0)
    assert field.robots[1].state is _S.PREFLIGHT
    assert [e.text for e in field.events if e.kind == "presence" and e.robot == "r1"] == [
        "heard", "its program has started again",
    ]  # fmt: skip


def test_an_order_that_is_not_answered_expires() -> None:
    field = a_field()
    field.make_ready()
    field.robots[1].deaf = True
    assert not_done(field.do(Takeoff(interval_s=0.0))) == {"r1": ResultCode.REFUSED}
    field.robots[0].silent = True
    field.run(12.0)
    report = field.do(RobotCommand("disarm", ("r0", "r2")))
    assert not_done(report)["r0"] == ResultCode.NOT_HEARD


def test_a_robot_that_is_silent_for_a_moment_is_waited_for() -> None:
    field = a_field()
    field.make_ready()
    field.robots[0].silent = field.robots[0].deaf = True
    field.run(3.0)
    takeoff = field.begin(Takeoff(interval_s=0.0))
    field.run(4.0)
    field.robots[0].silent = field.robots[0].deaf = False
    field.until(lambda: takeoff.report, 30.0)
    assert takeoff.report is not None
    assert takeoff.report.done


def test_a_silent_robot_is_killed_too() -> None:
    field = a_field()
    field.take_off()
    field.robots[0].silent = True
    field.run(8.0)
    kill = field.begin(RobotCommand("kill", ("r0",)))
    field.run(1.0)
    assert field.robots[0].state is _S.FAULT
    field.robots[0].silent = False
    field.run(1.0)
    assert kill.report is not None
    assert kill.report.done
    never = Field(1)
    never.robots[0].silent = True
    never.join("alice")
    assert not_done(never.do(RobotCommand("kill", ("r0",)))) == {"r0": ResultCode.NOT_HEARD}


def test_of_two_orders_the_later_expires_later() -> None:
    field = a_field()
    field.make_ready()
    station, robot = field.stations["alice"], field.robots[0]
    robot.silent = robot.deaf = True
    last_s = 0.0
    for pause_s in (0.0, 0.0, 0.1, 1.0, 5.0):
        field.run(pause_s)
        station.order("reset", "r0")
        expiry_s = station.published_orders()[-1].expires_at_uptime_s
        uptime_s = field.now_s - robot.began_s
        assert last_s < expiry_s <= uptime_s + ORDER_LIFETIME_S
        last_s = expiry_s


def test_all_programs_of_one_robot_are_killed() -> None:
    field = a_field()
    field.take_off()
    second = field.new_robot(1, 3)
    field.programs.append(second)
    field.run(1.0)
    field.done(RobotCommand("kill", ("r1",)))
    field.run(1.0)
    assert (field.robots[1].state, second.state) == (_S.FAULT, _S.FAULT)
    field.run(12.0)
    assert not field.stations["alice"].published_orders()


def test_two_programs_of_one_robot_settle_nothing() -> None:
    field = a_field()
    field.make_ready()
    second = field.new_robot(1, 3)
    field.programs.append(second)
    field.run(1.0)
    snapshots = field.stations["alice"].snapshot().robots
    assert [snapshot.duplicate for snapshot in snapshots] == [False, True, False]
    # Who was there first is shown.
    assert snapshots[1].status is not None
    assert snapshots[1].status.boot_nonce == field.robots[1].boot_nonce
    report = field.do(Takeoff(interval_s=0.0))
    assert not_done(report) == {"r1": ResultCode.DUPLICATE_ID}
    field.programs.remove(field.robots[1])
    field.run(5.0)
    assert not field.stations["alice"].snapshot().robots[1].duplicate


def test_what_a_snapshot_tells() -> None:
    field = a_field()
    field.run(5.0)
    robot = field.stations["alice"].snapshot().robots[0]
    assert robot.fresh
    assert robot.clock_offset_s == pytest.approx(0.0, abs=1e-3)
    assert robot.rates_hz["1"] == pytest.approx(2.5, abs=0.5)
    field.robots[0].silent = True
    field.run(3.0)
    robot = field.stations["alice"].snapshot().robots[0]
    assert not robot.fresh
    assert robot.age_s == pytest.approx(3.0, abs=0.3)
    field.robots[0].silent = False
    field.run(0.5)
    texts = [e.text for e in field.events if e.kind == "presence" and e.robot == "r0"]
    assert texts == ["heard", "silent for 2 s", "heard"]


# A station that was started again, or later


def test_a_station_started_again_takes_up_what_robots_do() -> None:
    field = a_field()
    field.done(SetWorld(OTHER_WORLD, "w.env"))
    field.done(SetFence(replace(FENCE, ceiling_m=50.0)))
    field.fly()
    before = field.stations["alice"].state
    assert before is not None
    field.leave("alice")
    field.run(0.5)
    field.join("alice")
    field.run(1.2)
    after = field.stations["alice"].state
    assert after is not None
    assert after == replace(before, sequence=after.sequence, unix_time_s=after.unix_time_s)
    field.run(30.0)
    assert field.states() == {_S.MISSION}
    field.done(SafetyCommand("land", wait=True))


def test_a_station_started_again_remembers_what_robots_do_not_say() -> None:
    field = a_field()
    field.make_ready()
    field.done(SetPlaces({"r2": Place(7, (20.0, 20.0))}))
    field.done(Takeoff(interval_s=0.0))
    field.done(Start(robots=("r0", "r1")))
    field.done(SafetyCommand("hold"))
    before = field.stations["alice"].state
    # Of whom it hears one alone.
    field.cut = {frozenset(("alice", f"r{i}")) for i in (1, 2)}
    after = field.restart("alice")
    field.run(1.2)
    assert before is not None
    assert after.state == replace(before, sequence=before.sequence + 1)
    field.cut.clear()
    field.run(2.0)
    assert problem(field.do(Start())) is ProblemCode.UNDER_SAFETY_ACTION
    # What somebody else said since is what counts.
    field.join("bob")
    field.run(1.0)
    field.done(TakeCommand(), "bob")
    field.done(Resume(), "bob")
    bob = field.stations["bob"].state
    field.leave("bob")
    after = field.restart("alice")
    after.remember(before)
    field.run(5.0)
    assert after.commands
    assert after.state is not None
    assert bob is not None
    assert (after.state.safety_action, after.state.sequence) == ("none", bob.sequence + 1)


def test_a_return_goes_on_after_a_restart() -> None:
    field = a_field()
    a_return(field, slow=0)
    # Whom the others wait for is heard last.
    field.cut = {frozenset(("alice", "r0"))}
    field.restart("alice")
    field.run(2.0)
    field.cut.clear()
    field.run(5.0)
    assert [robot.state for robot in field.robots] == [_S.RETURN, _S.HOLD, _S.HOLD]
    field.robots[0].speed_m_s = 1.0
    field.land()


def test_robots_in_the_air_stay_enabled_although_one_on_the_ground_is_heard_first() -> None:
    field = a_field()
    field.done(SetOrigin(ORIGIN))
    field.done(Enable(robots=("r1", "r2")))
    field.done(Takeoff(robots=("r1", "r2"), interval_s=0.0))
    field.done(Start(robots=("r1", "r2")))
    field.leave("alice")
    field.cut = {frozenset(("alice", f"r{i}")) for i in (1, 2)}
    field.join("alice")
    field.run(1.2)
    field.cut.clear()
    field.run(3.0)
    assert [robot.state for robot in field.robots] == [_S.IDLE, _S.MISSION, _S.MISSION]


def test_a_fence_that_one_robot_does_not_take_stays_the_others() -> None:
    field = a_field(2)
    field.make_ready()
    site = replace(FENCE, ceiling_m=50.0)
    field.done(SetFence(site))
    field.leave("alice")
    field.robots[0].silent = field.robots[0].deaf = True
    again = field.join("alice")
    robot = field.robots[0]
    for _ in range(30):
        field.step()
        again.hear_status(replace(robot.status(field.now_s), fence=FENCE))
    assert again.commands
    assert field.robots[1].fence == site


def test_places_that_are_none_end_nothing() -> None:
    field = a_field(2)
    field.make_ready()
    field.leave("alice")
    robot = field.robots[0]
    robot.silent = True
    for height_m in (-1e6, 1e5, 1e6):
        again = field.join("alice")
        for _ in range(30):
            field.step()
            again.hear_status(replace(robot.status(field.now_s), slot_height_m=height_m))
        assert again.commands
        assert again.state is not None
        assert not again.state.places
        field.leave("alice")


def test_robots_that_are_heard_late_are_taken_up_too() -> None:
    field = a_field()
    field.fly()
    field.leave("alice")
    for robot in field.robots:
        robot.silent = True
    field.join("alice")
    field.run(1.5)
    for robot in field.robots:
        robot.silent = False
    field.run(20.0)
    assert field.stations["alice"].commands
    assert field.states() == {_S.MISSION}


def test_another_station_takes_up_what_was_left_alone() -> None:
    field = a_field()
    field.fly()
    field.leave("alice")
    field.run(1.5)
    field.join("bob")
    field.run(1.2)
    assert field.stations["bob"].commands
    field.run(20.0)
    assert field.states() == {_S.MISSION}


def test_a_station_does_not_take_over_from_one_that_only_robots_hear() -> None:
    field = a_field()
    field.cut.add(frozenset(("alice", "bob")))
    field.fly()
    bob = field.join("bob")
    field.run(10.0)
    assert (bob.commands, bob.commander) == (False, "alice")
    assert problem(field.do(Start(), "bob")) is ProblemCode.OTHER_COMMANDS
    assert {robot.ground.operator for robot in field.robots if robot.ground} == {"alice"}
    # It may hold, still.
    field.done(SafetyCommand("hold"), "bob")
    field.run(10.0)
    assert field.states() == {_S.HOLD}


# Several stations


def test_stations_that_do_not_hear_each_other() -> None:
    field = a_field()
    field.fly()
    field.cut.add(frozenset(("alice", "bob")))
    bob = field.join("bob")
    field.run(2.0)
    field.done(TakeCommand(), "bob")
    for trial in ("t7", "t8", "t9"):
        bob.change(trial=trial)
    field.run(0.5)
    # It may hold at once, also before it knows.
    alice = field.stations["alice"]
    assert alice.commands
    field.done(SafetyCommand("hold"))
    assert field.states() == {_S.HOLD}
    field.run(2.0)
    assert field.states() == {_S.HOLD}
    assert (bob.commands, bob.commander) == (False, "alice")
    assert problem(field.do(Start(), "bob")) is ProblemCode.OTHER_COMMANDS
    # Who is told so by robots alone does not say that it commands.
    field.done(TakeCommand(), "bob")
    takeoff = field.begin(Takeoff())
    field.run(2.0)
    assert takeoff.report is not None
    assert (alice.commands, alice.commander) == (False, "bob")
    assert {robot.ground.operator for robot in field.robots if robot.ground} == {"bob"}
    field.done(SafetyCommand("hold"))


def test_an_observer_holds_and_nothing_else() -> None:
    field = a_field()
    field.fly()
    bob = field.join("bob")
    field.run(2.0)
    assert (bob.commands, bob.commander) == (False, "alice")
    for request in (SafetyCommand("land"), SafetyCommand("return"), Start(), Resume(), Takeoff(),
    Enable(on=False),
                    SetOrigin(ORIGIN), NextTrial(), RobotCommand("disarm", ("r0",))):  # fmt: skip
        assert problem(field.do(request, "bob")) is ProblemCode.OTHER_COMMANDS
    field.done(SafetyCommand("hold", robots=("r1",)), "bob")
    assert [robot.state for robot in field.robots] == [_S.MISSION, _S.HOLD, _S.MISSION]
    field.done(SafetyCommand("hold"), "bob")
    assert field.states() == {_S.HOLD}
    alice = field.stations["alice"]
    assert alice.commands
    assert alice.state is not None
    assert alice.state.safety_action_by == "bob"
    # It is the commander's to withdraw, for good.
    field.done(Resume())
    field.run(5.0)
    assert field.states() == {_S.MISSION}
    field.done(RobotCommand("kill", ("r0",)), "bob")
    assert field.robots[0].state is _S.FAULT


def test_an_observers_hold_ends_a_takeoff() -> None:
    field = a_field()
    field.make_ready()
    field.join("bob")
    field.run(2.0)
    takeoff = field.begin(Takeoff(interval_s=30.0))
    field.until(lambda: field.robots[2].state is _S.HOLD)
    field.done(SafetyCommand("hold"), "bob")
    field.run(1.0)
    assert takeoff.report is not None
    assert set(not_done(takeoff.report).values()) == {ResultCode.ABANDONED}


def test_taking_over() -> None:
    field = a_field()
    field.fly()
    field.join("bob")
    field.run(2.0)
    takeoff = field.begin(SafetyCommand("return", wait=True))
    field.run(0.5)
    field.done(TakeCommand(), "bob")
    field.run(0.5)
    assert takeoff.report is not None
    assert takeoff.report.results[0].code is ResultCode.ABANDONED
    assert [s.commands for s in field.stations.values()] == [False, True]
    # What the other wanted goes on.
    field.land()
    field.done(Takeoff(interval_s=0.0), "bob")
    field.done(TakeCommand())
    assert [s.commands for s in field.stations.values()] == [True, False]


def test_a_hold_when_the_commander_is_gone_commands() -> None:
    field = a_field()
    field.fly()
    field.join("bob")
    field.run(2.0)
    field.leave("alice")
    field.run(0.3)
    field.done(SafetyCommand("hold"), "bob")
    field.run(3.0)
    assert field.stations["bob"].commands
    field.done(Resume(), "bob")
    field.run(10.0)
    assert field.states() == {_S.MISSION}


def test_a_name_is_one_stations() -> None:
    field = a_field()
    field.make_ready()
    twin = Station(setup("alice", 3), field.now_s, 1e9)
    state = field.stations["alice"].published_state()
    assert state is not None
    with pytest.raises(NameTakenError, match="--name"):
        twin.hear_state(state)
    # A state of its own former life that says less is no other's.
    field.stations["alice"].hear_state(replace(state, sequence=state.sequence - 1))
    with pytest.raises(NameTakenError):
        field.stations["alice"].hear_state(replace(state, sequence=state.sequence + 1))


def test_a_second_station_of_a_name_ends_and_not_the_first() -> None:
    field = a_field()
    field.fly()
    # Each hears the robots, and not the other.
    twin = Station(setup("alice", 3), field.now_s, 1e9)

    def listen() -> None:
        while field.now_s < 60.0:
            field.step()
            twin.set_time(field.now_s, 1e9)
            for robot in field.robots:
                twin.hear_status(robot.status(field.now_s))
            twin.tick()

    with pytest.raises(NameTakenError, match="--name"):
        listen()
    assert not twin.commands
    assert twin.published_state() is None
    field.run(5.0)
    assert field.stations["alice"].commands
    assert field.states() == {_S.MISSION}


REQUESTS = st.sampled_from([
    SafetyCommand("hold"), SafetyCommand("hold", robots=("r0",)), SafetyCommand("land"),
    SafetyCommand("return"), TakeCommand(), Start(),
    Takeoff(interval_s=0.0), Resume(), Enable(), NextTrial(), RobotCommand("pilot", ("r1",)),
    RobotCommand("rejoin", ("r1",)), SetWorld(OTHER_WORLD, "w"),
])  # fmt: skip
NAMES = ("alice", "bob", "carol")


@settings(max_examples=30, deadline=None)
@given(
    steps=st.lists(
        st.tuples(st.sampled_from(NAMES), REQUESTS, st.floats(0.0, 3.0)), min_size=1, max_size=12
    ),
    restarts=st.sets(st.integers(0, 11), max_size=2),
    loss=st.sampled_from([0.0, 0.3]),
    seed=st.integers(0, 1000),
)
def test_stations_agree_whatever_they_are_told(
    steps: list[tuple[str, Request, float]], restarts: set[int], loss: float, seed: int
) -> None:
    field = Field(3, loss=loss, seed=seed)
    field.join("alice")
    field.fly()
    for name in NAMES[1:]:
        field.join(name)
    field.run(2.0)
    for i, (name, request, pause_s) in enumerate(steps):
        if i in restarts:
            field.restart(name, pause_s)
        field.begin(request, name)
        field.run(pause_s)
    # In the end one commands, all know who, and the robots obey it.
    field.run(5.0)
    assert sum(station.commands for station in field.stations.values()) == 1
    (commander,) = {station.commander for station in field.stations.values()}
    assert {robot.ground.operator for robot in field.robots if robot.ground} == {commander}
    # Whoever holds then, all hold.
    field.do(SafetyCommand("hold"), NAMES[seed % 3])
    field.run(3.0)
    flying = {s for s in field.states() if s in (_S.MISSION, _S.RETURN, _S.TAKEOFF)}
    assert not flying
    assert field.stations[commander].commands
