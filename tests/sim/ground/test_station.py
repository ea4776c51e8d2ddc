"""What a ground and its commands decide: real grounds, and robots that fly, on one radio.

Time is counted, nothing waits: a minute in the field takes a second.
"""

import itertools
from dataclasses import replace
from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.identity.guard import Sender, Unguarded
from edge.identity.members import Role
from edge.messages.codes import CheckCode, FailedCheck, ReasonCode, RefusalCode
from edge.messages.mission import ORDER_LIFETIME_S, FlightState, GroundState, Place, world_id
from lpac.ground.alarms import AlarmCode, alarms
from lpac.ground.station.protocol import (
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
from lpac.ground.station.states import next_trial
from lpac.ground.station.station import Station
from lpac.sim.fleet.layout import ORIGIN
from lpac.sim.fleet.simulated import SimulatedGround
from tests.said import not_done, problem
from tests.sim.ground.field import Field, a_field
from tests.unit.ground.snapshots import on_ground, setup, status

ANYBODY = Sender(Role.OPERATOR, "")

_S = FlightState
OTHER_WORLD = "CircularBND 100 100 20 5\n"


def pad_m(field: Field, i: int) -> tuple[float, ...]:
    return field.fleet.ground.node.station.setup.slots[i].place.landing_point_m


# One station


def test_the_missions_clock_of_a_name_that_is_flown_again() -> None:
    station = Station(setup(2), 0.0, 700.0)
    state = GroundState(4, "bob", trial="t1")
    flown = (
        (800.0, _S.HOLD, None), (820.0, _S.MISSION, 0.0), (850.0, _S.HOLD, 30.0),
        (900.0, _S.LANDED, None), (935.0, _S.HOLD, None), (940.0, _S.MISSION, 0.0),
        (1000.0, _S.MISSION, 60.0),
    )  # fmt: skip
    sequence, before = itertools.count(), _S.IDLE
    for unix_s, phase, mission_s in flown:
        # Statuses come twice a second.
        for at_s, said in ((unix_s - 0.5, before), (unix_s, phase)):
            station.set_time(at_s - 700.0, at_s)
            station.election.receive_state(state, ANYBODY)
            armed = said not in (_S.IDLE, _S.LANDED)
            for robot_id in (0, 1):
                changes = {"sequence": next(sequence), "state": said, "armed": armed}
                station.receive_status(status(robot_id, **changes))
        assert station.snapshot().mission_s == mission_s
        before = phase
    # A station that begins to listen meanwhile does not know when it began.
    late = Station(setup(2), 0.0, 1000.0)
    late.election.receive_state(state, ANYBODY)
    late.receive_status(status(0))
    assert late.snapshot().mission_s is None


def test_nothing_is_said_before_the_first_command() -> None:
    field = a_field(2)
    field.run(10.0)
    assert field.stations["alice"].published_state() is None
    assert {robot.said.obeyed_sequence for robot in field.robots} == {-1}


def test_commands_arrive_although_messages_are_lost() -> None:
    """And come twice, and overtake each other."""
    field = a_field(3, seed=1)
    field.air = replace(field.air, loss=0.3, duplication=0.2, delay_s=0.1)
    field.done(SetOrigin(ORIGIN))
    field.done(Enable())
    field.done(Takeoff(interval_s=0.0))
    field.done(Start())
    assert field.states() == {_S.MISSION}
    field.done(SafetyCommand("hold"))
    field.done(Resume())
    field.done(SafetyCommand("return", wait=True))
    field.done(SetWorld(OTHER_WORLD, "w.env"))


def test_the_highest_takes_off_first_and_in_intervals() -> None:
    field = a_field(4, "ready")
    began_s: dict[int, float] = {}
    running = field.begin(Takeoff(interval_s=3.0))
    while running.report is None:
        field.step()
        for robot in field.robots:
            if robot.state is _S.ARMING:
                began_s.setdefault(robot.robot_id, field.now_s)
    assert running.report.done
    assert list(began_s) == [3, 2, 1, 0]
    assert [p.robot for p in running.new_progress() if p.text == "taking off"] == [
        "r3",
        "r2",
        "r1",
        "r0",
    ]
    apart_s = [b - a for a, b in itertools.pairwise(began_s.values())]
    assert all(2.7 < passed_s < 3.6 for passed_s in apart_s), apart_s


def test_a_failure_keeps_the_others_on_the_ground_if_asked() -> None:
    field = a_field(4, "ready")
    field.robots[2].tire()
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
    field = a_field(2, "ready")
    held_up = field.robots[1]
    held_up.vehicle.parameters["MPC_Z_VEL_MAX_UP"] = 0.5
    running = field.begin(Takeoff(interval_s=0.0))
    field.until(lambda: held_up.state is _S.TAKEOFF, 10.0)
    # It hangs; what it had climbed to by then is where it holds.
    field.run(3.0)
    held_up.program.loops["control"].hang(0.8)
    field.until(lambda: held_up.state is _S.HOLD)
    assert held_up.said.reason.code is ReasonCode.CONTROL_SILENT
    field.until(lambda: running.report, 30.0)
    assert running.report is not None
    assert not_done(running.report) == {"r1": ResultCode.TOO_LOW}
    assert not_done(field.do(Takeoff())) == {"r1": ResultCode.TOO_LOW}
    field.done(SafetyCommand("land", wait=True))
    field.done(Takeoff(interval_s=0.0))


def test_who_is_in_the_air_keeps_what_it_has() -> None:
    field = a_field(2, "hovering")
    for request in (SetOrigin(ORIGIN), SetFence(None), SetWorld(OTHER_WORLD, "w"),
                    SetPlaces({"r1": Place(5, (9.0, 9.0))})):  # fmt: skip
        before = field.stations["alice"].state
        report = field.do(request)
        assert problem(report) is ProblemCode.ARMED
        assert field.stations["alice"].state == before
    field.done(Start())
    assert problem(field.do(NextTrial())) is ProblemCode.ON_MISSION


def test_what_is_asked_of_some_robots_is_asked_of_them_alone() -> None:
    field = a_field(3, "flying")
    field.done(SafetyCommand("hold", robots=("r1",)))
    assert field.each_state() == [_S.MISSION, _S.HOLD, _S.MISSION]
    assert not_done(field.do(Start())) == {"r1": ResultCode.UNDER_SAFETY_ACTION}
    field.done(SafetyCommand("land", robots=("r0",), wait=True))
    assert field.each_state() == [_S.LANDED, _S.HOLD, _S.MISSION]
    # The fleet's safety action is everybody's again.
    field.done(SafetyCommand("hold"))
    field.done(Resume())
    assert field.each_state()[1:] == [_S.MISSION, _S.MISSION]
    field.done(Takeoff(robots=("r0",)))
    assert field.robots[0].state is _S.HOLD


def test_resume_starts_only_who_flew_this_trial() -> None:
    field = a_field(3, "hovering")
    field.done(Start(robots=("r0",)))
    field.done(SafetyCommand("hold"))
    field.done(Resume())
    assert field.each_state() == [_S.MISSION, _S.HOLD, _S.HOLD]
    # Also who was on its way home.
    field.done(Start())
    field.until(lambda: min(robot.away_m for robot in field.robots) > 2.0)
    field.done(SafetyCommand("return"))
    assert field.states() == {_S.RETURN}
    field.done(Resume())
    assert field.states() == {_S.MISSION}


def test_what_brought_robots_down_does_not_keep_them_there() -> None:
    field = a_field(2, "ready")
    for safety_action in ("land", "return", "hold"):
        field.done(Takeoff(interval_s=0.0))
        field.done(SafetyCommand(safety_action))
        if safety_action == "hold":
            # Those that hold in the air are not sent off by somebody who forgot that.
            assert problem(field.do(Takeoff())) is ProblemCode.UNDER_SAFETY_ACTION
            field.done(SafetyCommand("land"))
        field.land()


def test_who_returns_waits_for_those_below() -> None:
    field = a_field(4, "flying")
    field.until(lambda: min(robot.away_m for robot in field.robots) > 2.0)
    # The lowest comes home last.
    field.robots[0].crawl()
    field.begin(SafetyCommand("return"))
    landing: list[int] = []
    waited = set()
    while len(landing) < 4:
        field.step()
        waited |= {robot.robot_id for robot in field.robots if robot.state is _S.HOLD}
        if len(waited) == 3:
            field.robots[0].hurry()
        for robot in field.robots:
            if robot.state is _S.LAND and robot.robot_id not in landing:
                landing.append(robot.robot_id)
                flying = [r for r in field.robots if r.state in (_S.RETURN, _S.MISSION)]
                # Who is above, or over its own landing point, is in nobody's way.
                assert all(r.robot_id > robot.robot_id or r.away_m < 1.5 for r in flying)
        assert field.now_s < 300.0
    assert waited == {1, 2, 3}
    field.land()


def a_return(field: Field, slow: int) -> None:
    """All return, and robot `slow` is so slow that the others wait for it over their places."""
    field.until(lambda: min(robot.away_m for robot in field.robots) > 2.0)
    field.robots[slow].crawl()
    field.done(SafetyCommand("return"))
    above = field.robots[slow + 1 :]
    field.until(lambda: all(robot.state is _S.HOLD for robot in above))


@cache
def _observed_return(slow: int) -> Field:
    field = a_field(3, "flying")
    field.join("bob")
    a_return(field, slow)
    return field


def an_observed_return(slow: int) -> Field:
    """The same, and bob observes it."""
    return Field(_observed_return(slow).fleet.copy())


@pytest.mark.slow
@pytest.mark.parametrize("by", ["alice", "bob"])
def test_whom_somebody_holds_in_a_return_stays(by: str) -> None:
    field = an_observed_return(slow=1)
    over = field.robots[0]
    field.until(lambda: over.state is _S.LAND or over.away_m < 1.4)
    # Also where it could be taken for one that waits.
    field.done(SafetyCommand("hold", robots=("r0",)), by)
    states = set()
    for _ in range(100):
        field.step()
        states.add(over.state)
    assert states == {_S.HOLD}
    # Who waits goes on when its way is free, and not before.
    assert field.each_state()[1:] == [_S.RETURN, _S.HOLD]
    field.done(SafetyCommand("hold", robots=("r1",)), by)
    field.until(lambda: field.robots[2].state is _S.LANDED)
    field.run(5.0)
    assert field.each_state()[:2] == [_S.HOLD, _S.HOLD]
    field.done(SafetyCommand("return", robots=("r0",), wait=True))
    assert field.robots[1].state is _S.HOLD
    field.done(SafetyCommand("land", robots=("r1",), wait=True))


@pytest.mark.slow
@pytest.mark.parametrize("by", ["alice", "bob"])
def test_who_waits_in_a_return_may_be_held(by: str) -> None:
    field = an_observed_return(slow=0)
    field.done(SafetyCommand("hold", robots=("r0", "r2")), by)
    field.until(lambda: field.robots[1].state is _S.LANDED)
    field.done(TakeCommand(), "bob")
    field.run(8.0)
    assert field.each_state() == [_S.HOLD, _S.LANDED, _S.HOLD]
    field.robots[0].hurry()
    field.done(SafetyCommand("return", wait=True), "bob")


def test_a_return_goes_on_with_another_commander() -> None:
    field = an_observed_return(slow=0)
    field.done(TakeCommand(), "bob")
    field.run(2.0)
    assert field.each_state() == [_S.RETURN, _S.HOLD, _S.HOLD]
    field.leave("alice")
    field.robots[0].hurry()
    field.land()


def test_places_and_spares() -> None:
    field = a_field(3, spares=1)
    station = field.stations["alice"]
    field.done(SetOrigin(ORIGIN))
    assert station.flying == ("r0", "r1", "r2")
    report = field.do(SetPlaces({"r0": Place(0, (3.0, 3.0)), "r3": Place(0, (6.0, 3.0))}))
    assert problem(report) is ProblemCode.SLOT_SHARED
    # The spare flies in place of r1, and all stay where they stand.
    given = {"r0": (0, 0), "r2": (1, 2), "r3": (2, 3)}
    places = {name: Place(slot, pad_m(field, pad)) for name, (slot, pad) in given.items()}
    field.done(SetPlaces(places))
    assert station.flying == ("r0", "r2", "r3")
    heights_m = [robot.said.slot_height_m for robot in field.robots]
    assert heights_m[1] == heights_m[2] and heights_m[0] < heights_m[2] < heights_m[3]
    field.robots[1].program.stop()
    field.run(4.0)
    field.done(Enable())
    field.done(Takeoff(interval_s=0.0))
    assert field.each_state() == [_S.HOLD, _S.IDLE, _S.HOLD, _S.HOLD]
    # Who comes after finds the robots where they are.
    field.leave("alice")
    again = field.join("alice")
    field.run(2.0)
    assert again.flying == ("r0", "r2", "r3")
    assert again.state is not None
    assert again.state.places == {"2": places["r2"], "3": places["r3"]}


def test_a_world_comes_with_its_text() -> None:
    field = a_field(2)
    field.robots[1].deaf = True
    report = field.do(SetWorld(OTHER_WORLD, "w.env"))
    assert not_done(report) == {"r1": ResultCode.NOT_OBEYING}
    assert field.stations["alice"].published_world() == OTHER_WORLD
    field.robots[1].deaf = False
    field.run(2.0)
    assert field.stations["alice"].published_world() is None


def test_a_world_that_another_station_sends_is_known() -> None:
    field = a_field(2)
    configured = field.stations["alice"].setup.world
    bob = field.join("bob")
    field.run(0.5)
    field.done(SetWorld(OTHER_WORLD, "w.env"))
    assert bob.setup.world == OTHER_WORLD
    assert bob.setup.world_id == field.stations["alice"].setup.world_id
    bob.receive_world("Uniform 3 1 0 0 9 0 9 9\n")
    field.done(SetWorld(configured, "w.env"))
    assert bob.setup.world == configured


def test_a_world_that_is_not_known_is_not_shown_as_another() -> None:
    field = a_field(2)
    known = field.stations["alice"].setup
    field.done(SetWorld(OTHER_WORLD, "w.env"))
    # It comes when the robots have that world, and nobody sends it any more.
    bob = field.join("bob")
    assert (bob.setup.world, bob.setup.world_id) == (known.world, known.world_id)
    field.run(1.0)
    assert (bob.setup.world, bob.setup.world_id) == ("", world_id(OTHER_WORLD))
    # Nor does a commander send a world that it does not have.
    field.done(TakeCommand(), "bob")
    field.robots[1].program.start()
    field.until(lambda: field.robots[1].said.world_id == known.world_id)
    field.run(1.0)
    assert bob.published_world() is None


def test_nobody_said_a_world_and_the_robots_have_another_than_configured() -> None:
    field = a_field()
    alice = field.stations["alice"]
    configured = alice.setup.world_id
    for robot in field.robots[1:]:
        robot.program.world = OTHER_WORLD
        robot.program.start()
    older = world_id(OTHER_WORLD)
    field.until(lambda: alice.setup.world_id == older, 10.0)
    assert alice.setup.world == ""
    field.until(lambda: field.states() == {_S.IDLE})
    field.done(SetOrigin(ORIGIN))
    # What most have; and each knows of the others, so that nobody is ready.
    report = field.do(Enable())
    assert set(not_done(report).values()) == {ResultCode.NOT_READY}
    assert alice.setup.world_id == older != configured
    field.done(SetWorld(OTHER_WORLD, "w.env"))
    assert alice.setup.world == OTHER_WORLD
    field.until(lambda: all(robot.said.ready for robot in field.robots))


def test_a_world_that_cannot_be_used_is_not_sent_for_ever() -> None:
    station = Station(setup(1), 0.0, 1e9)
    station.set_world(OTHER_WORLD)
    for sequence, (code, text) in enumerate(
        ((CheckCode.WORLD_NOT_ARRIVED, OTHER_WORLD), (CheckCode.WORLD_UNUSABLE, None)), 10
    ):
        waits = FailedCheck(code, "x")
        station.receive_status(on_ground(0, not_taken=(waits,), sequence=sequence))
        assert station.published_world() == text


def test_trials_are_numbered() -> None:
    names = [""]
    for _ in range(3):
        names.append(next_trial(names[-1]))
    assert names == ["", "t1", "t2", "t3"]
    assert (next_trial("windy"), next_trial("windy9")) == ("windy2", "windy10")
    field = a_field(2, "flying")
    field.done(SafetyCommand("land", wait=True))
    assert problem(field.do(NextTrial("second"))) is None
    field.done(Takeoff(interval_s=0.0))
    field.done(Start())
    assert {robot.said.trial for robot in field.robots} == {"second"}
    assert {event.trial for event in field.events} == {"", "t1", "second"}


def test_disable_holds_what_flies() -> None:
    field = a_field(2, "flying")
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


@pytest.mark.parametrize(
    "request_",
    [
        SafetyCommand("hold"), SafetyCommand("land"), SafetyCommand("hold", robots=("r0",)),
        RobotCommand("kill", ("r0",)), Enable(on=False),
    ],
)  # fmt: skip
def test_a_safety_command_ends_what_sets_in_motion(request_: Request) -> None:
    field = a_field(2, "ready")
    takeoff = field.begin(Takeoff(interval_s=10.0))
    field.until(lambda: field.robots[1].state is _S.TAKEOFF, 5.0)
    field.do(request_)
    assert takeoff.report is not None
    assert set(not_done(takeoff.report).values()) == {ResultCode.ABANDONED}
    field.run(12.0)
    killed = isinstance(request_, RobotCommand)
    assert field.robots[0].state in ((_S.FAULT,) if killed else (_S.PREFLIGHT, _S.IDLE))


# Robots' programs


def test_orders_are_for_one_start_of_a_program() -> None:
    field = a_field(2, "ready")
    field.robots[1].deaf = True
    takeoff = field.begin(Takeoff(interval_s=0.0, robots=("r1",)))
    field.run(1.0)
    field.robots[1].program.start()
    field.robots[1].deaf = False
    field.until(lambda: takeoff.report, 20.0)
    assert takeoff.report is not None
    (result,) = takeoff.report.results
    assert (result.code, result.refusal) == (ResultCode.REFUSED, RefusalCode.STARTED_AGAIN)
    field.run(15.0)
    assert field.robots[1].state is _S.PREFLIGHT
    assert not field.robots[1].vehicle.armed
    assert [e.text for e in field.events if e.kind == "presence" and e.robot == "r1"] == [
        "heard", "its program has restarted",
    ]  # fmt: skip


def test_an_order_that_is_not_answered_expires() -> None:
    field = a_field(3, "ready")
    field.robots[1].deaf = True
    assert not_done(field.do(Takeoff(interval_s=0.0))) == {"r1": ResultCode.REFUSED}
    field.robots[0].silent = True
    field.run(12.0)
    report = field.do(RobotCommand("disarm", ("r0", "r2")))
    assert not_done(report)["r0"] == ResultCode.NOT_HEARD


def test_a_robot_that_is_silent_for_a_moment_is_waited_for() -> None:
    field = a_field(2, "ready")
    field.robots[0].silent = field.robots[0].deaf = True
    field.run(3.0)
    takeoff = field.begin(Takeoff(interval_s=0.0))
    field.run(4.0)
    field.robots[0].silent = field.robots[0].deaf = False
    field.until(lambda: takeoff.report, 30.0)
    assert takeoff.report is not None
    assert takeoff.report.done


def test_a_silent_robot_is_killed_too() -> None:
    field = a_field(2, "hovering")
    field.robots[0].silent = True
    field.run(8.0)
    kill = field.begin(RobotCommand("kill", ("r0",)))
    field.run(1.0)
    assert field.robots[0].state is _S.FAULT
    field.robots[0].silent = False
    field.run(1.0)
    assert kill.report is not None
    assert kill.report.done
    never = a_field(1)
    never.robots[0].silent = True
    never.join("alice")
    assert not_done(never.do(RobotCommand("kill", ("r0",)))) == {"r0": ResultCode.NOT_HEARD}


def test_of_two_orders_the_later_expires_later() -> None:
    station = Station(setup(1), 0.0, 1e9)
    heard = on_ground(0, uptime_s=30.0)
    station.receive_status(heard)
    now_s = last_s = 0.0
    for pause_s in (0.0, 0.0, 0.1, 1.0, 5.0):
        now_s += pause_s
        station.set_time(now_s, 1e9 + now_s)
        station.order("reset", "r0")
        expiry_s = station.orders.pending[-1].expires_at_uptime_s
        assert last_s < expiry_s <= heard.uptime_s + now_s + ORDER_LIFETIME_S
        last_s = expiry_s


def test_all_programs_of_one_robot_are_killed() -> None:
    field = a_field(2, "hovering")
    second = field.second_program(1)
    field.run(2.0)
    field.done(RobotCommand("kill", ("r1",)))
    field.run(1.0)
    assert (field.robots[1].state, second.state) == (_S.FAULT, _S.FAULT)
    assert not field.robots[1].vehicle.armed
    field.run(12.0)
    assert not field.stations["alice"].orders.pending


def test_two_programs_of_one_robot_settle_nothing() -> None:
    field = a_field(3, "ready", seed=6)
    field.air = replace(field.air, loss=0.1)
    field.second_program(1)
    field.run(10.0)
    snapshots = field.stations["alice"].snapshot().robots
    assert [snapshot.duplicate for snapshot in snapshots] == [False, True, False]
    # Who was there first is shown.
    assert snapshots[1].status is not None
    assert snapshots[1].status.boot_nonce == field.robots[1].said.boot_nonce
    report = field.do(Takeoff(interval_s=0.0))
    assert not_done(report)["r1"] is ResultCode.DUPLICATE_ID
    # Nor does a lost status make it another start of one program.
    told = [e.text for e in field.events if e.kind == "presence" and e.robot == "r1"]
    assert told == ["heard", "two programs have this robot's id"]
    field.robots[1].program.stop()
    field.run(5.0)
    assert not field.stations["alice"].snapshot().robots[1].duplicate


def test_what_a_snapshot_tells() -> None:
    field = a_field(2, "ready")
    field.run(2.0)
    robot = field.stations["alice"].snapshot().robots[0]
    assert robot.fresh
    assert robot.clock_offset_s == pytest.approx(0.0, abs=0.02)
    assert robot.rates_hz["1"] == pytest.approx(2.0, abs=0.5)
    field.robots[0].silent = True
    field.run(3.0)
    robot = field.stations["alice"].snapshot().robots[0]
    assert not robot.fresh
    assert robot.age_s == pytest.approx(3.0, abs=0.6)
    field.robots[0].silent = False
    field.run(1.0)
    texts = [e.text for e in field.events if e.kind == "presence" and e.robot == "r0"]
    assert texts == ["heard", "silent for 2 s", "heard"]


# A station that was started again, or later


def test_a_station_started_again_takes_up_what_robots_do() -> None:
    field = a_field(2)
    field.done(SetWorld(OTHER_WORLD, "w.env"))
    field.done(SetFence(replace(field.stations["alice"].setup.fence, ceiling_m=50.0)))
    field.done(SetOrigin(ORIGIN))
    field.done(Enable())
    field.done(Takeoff(interval_s=0.0))
    field.done(Start())
    before = field.stations["alice"].state
    assert before is not None
    field.leave("alice")
    field.run(0.5)
    field.join("alice")
    field.run(2.0)
    after = field.stations["alice"].state
    assert after is not None
    assert after == replace(before, sequence=after.sequence, unix_time_s=after.unix_time_s)
    field.run(8.0)
    assert field.states() == {_S.MISSION}
    field.done(SafetyCommand("land", wait=True))


def test_a_station_started_again_remembers_what_robots_do_not_say() -> None:
    field = a_field(3, "ready")
    field.done(SetPlaces({"r2": Place(3, pad_m(field, 2))}))
    field.done(Enable())
    field.done(Takeoff(interval_s=0.0))
    field.done(Start(robots=("r0", "r1")))
    field.done(SafetyCommand("hold"))
    before = field.stations["alice"].state
    # Of whom it hears one alone.
    field.cut(("alice",), ("r1", "r2"))
    after = field.restart("alice")
    field.run(2.0)
    assert before is not None
    assert after.state == replace(before, sequence=before.sequence + 1)
    field.mend()
    field.run(2.0)
    assert problem(field.do(Start())) is ProblemCode.UNDER_SAFETY_ACTION
    # What somebody else said since is what counts.
    field.join("bob")
    field.run(1.0)
    field.done(TakeCommand(), "bob")
    field.done(Resume(), "bob")
    bob = field.stations["bob"].state
    field.leave("bob")
    after = field.restart("alice", 1.5)
    after.election.restore(before)
    field.run(5.0)
    assert after.commands
    assert after.state is not None
    assert bob is not None
    assert (after.state.safety_action, after.state.sequence) == ("none", bob.sequence + 1)


def test_a_return_goes_on_after_a_restart() -> None:
    field = a_field(3, "flying")
    a_return(field, slow=0)
    # Whom the others wait for is heard last.
    field.cut(("alice",), ("r0",))
    field.restart("alice")
    field.run(2.0)
    field.mend()
    field.run(5.0)
    assert field.each_state() == [_S.RETURN, _S.HOLD, _S.HOLD]
    field.robots[0].hurry()
    field.land()


def test_robots_in_the_air_stay_enabled_although_one_on_the_ground_is_heard_first() -> None:
    field = a_field()
    field.done(SetOrigin(ORIGIN))
    field.done(Enable(robots=("r1", "r2")))
    field.done(Takeoff(robots=("r1", "r2"), interval_s=0.0))
    field.done(Start(robots=("r1", "r2")))
    field.leave("alice")
    field.cut(("alice",), ("r1", "r2"))
    field.join("alice")
    field.run(1.2)
    field.mend()
    field.run(3.0)
    assert field.each_state() == [_S.IDLE, _S.MISSION, _S.MISSION]


def test_a_fence_that_one_robot_does_not_take_stays_the_others() -> None:
    field = a_field(2, "ready")
    configured = field.stations["alice"].setup.fence
    site = replace(configured, ceiling_m=50.0)
    field.done(SetFence(site))
    field.leave("alice")
    # One has started again, and hears nobody.
    field.robots[0].deaf = True
    field.robots[0].program.start()
    again = field.join("alice")
    field.run(4.0)
    assert again.commands
    assert [robot.said.fence for robot in field.robots] == [configured, site]


@pytest.mark.parametrize("height_m", [-1e6, 1e5, 1e6])
def test_places_that_are_none_end_nothing(height_m: float) -> None:
    station = Station(setup(2), 0.0, 1e9)
    for step in range(40):
        station.set_time(0.05 * step, 1e9)
        told = on_ground(0, slot_height_m=height_m, ground_age_s=9.0, sequence=10 + step)
        station.receive_status(told)
        station.tick()
    assert station.commands
    assert station.state is not None
    assert not station.state.places


def test_robots_that_are_heard_late_are_taken_up_too() -> None:
    field = a_field(2, "flying")
    field.leave("alice")
    for robot in field.robots:
        robot.silent = True
    field.join("alice")
    field.run(1.5)
    for robot in field.robots:
        robot.silent = False
    field.run(8.0)
    assert field.stations["alice"].commands
    assert field.states() == {_S.MISSION}


def test_a_station_that_starts_again_goes_on_once_most_robots_are_heard() -> None:
    field = a_field(3, "flying")
    again = field.restart("alice", away_s=0.1)
    field.run(0.6)
    assert again.commands
    field.run(5.0)
    assert field.states() == {_S.MISSION}


def test_one_robot_that_is_cut_off_hastens_no_station() -> None:
    field = a_field(3, "flying")
    field.cut(("r0",), ("alice", "r1", "r2"))
    field.run(1.5)
    carol = field.join("carol")
    field.cut(("r0", "carol"), ("alice", "r1", "r2"))
    field.run(0.6)
    assert carol.election.commander == "alice" and not carol.commands


def test_one_robot_that_obeys_a_former_commander_hastens_it_neither() -> None:
    field = a_field(3, "flying")
    field.join("bob")
    field.run(1.0)
    field.done(SafetyCommand("hold"), by="bob")
    field.cut(("r0",), ("alice", "bob", "r1", "r2"))
    field.done(Resume(("r1", "r2")), by="alice")
    field.leave("bob")
    again = field.restart("bob", away_s=0.1)
    field.cut(("r0", "bob"), ("alice", "r1", "r2"))
    field.run(0.6)
    assert not again.commands


def test_another_station_takes_up_what_was_left_alone() -> None:
    field = a_field(2, "flying")
    field.leave("alice")
    field.run(1.5)
    field.join("bob")
    field.run(1.5)
    assert field.stations["bob"].commands
    field.run(8.0)
    assert field.states() == {_S.MISSION}


def test_a_station_does_not_take_over_from_one_that_only_robots_hear() -> None:
    field = a_field(2, "flying")
    bob = field.join("bob")
    field.cut(("alice",), ("bob",))
    field.run(10.0)
    assert (bob.commands, bob.election.commander) == (False, "alice")
    assert problem(field.do(Start(), "bob")) is ProblemCode.OTHER_COMMANDS
    assert field.operators() == {"alice"}
    # It may hold, still.
    field.done(SafetyCommand("hold"), "bob")
    field.run(10.0)
    assert field.states() == {_S.HOLD}


# Several stations


def test_stations_that_do_not_hear_each_other() -> None:
    field = a_field(2, "flying")
    bob = field.join("bob")
    field.cut(("alice",), ("bob",))
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
    assert (bob.commands, bob.election.commander) == (False, "alice")
    assert problem(field.do(Start(), "bob")) is ProblemCode.OTHER_COMMANDS
    # Who is told so by robots alone does not say that it commands.
    field.done(TakeCommand(), "bob")
    takeoff = field.begin(Takeoff())
    field.run(2.0)
    assert takeoff.report is not None
    assert (alice.commands, alice.election.commander) == (False, "bob")
    assert field.operators() == {"bob"}
    field.done(SafetyCommand("hold"))


def test_who_does_not_command_holds_and_nothing_else() -> None:
    field = a_field(3, "flying")
    bob = field.join("bob")
    field.run(2.0)
    assert (bob.commands, bob.election.commander) == (False, "alice")
    for request in (SafetyCommand("return"), Start(), Resume(), Takeoff(), Enable(on=False),
                    SetOrigin(ORIGIN), NextTrial(), RobotCommand("disarm", ("r0",))):  # fmt: skip
        assert problem(field.do(request, "bob")) is ProblemCode.OTHER_COMMANDS
    field.done(SafetyCommand("hold", robots=("r1",)), "bob")
    assert field.each_state() == [_S.MISSION, _S.HOLD, _S.MISSION]
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
    # Whoever lands robots commands from then on.
    field.done(SafetyCommand("land", robots=("r1",)), "bob")
    assert field.each_state() == [_S.FAULT, _S.LAND, _S.MISSION]
    assert (alice.commands, alice.election.commander) == (False, "bob")


def test_an_observer_may_ask_for_hold_alone() -> None:
    field = a_field(2, "flying", secure=True)
    eve = field.join("eve", Role.OBSERVER)
    field.run(2.0)
    for request in (SafetyCommand("land"), TakeCommand(), Start(), Resume(),
                    RobotCommand("kill", ("r0",))):  # fmt: skip
        assert problem(field.do(request, "eve")) is ProblemCode.MAY_NOT
    field.done(SafetyCommand("hold"), "eve")
    assert field.states() == {_S.HOLD} and field.stations["alice"].commands
    field.done(Resume())
    # When nobody commands any more, robots do by themselves what is safe.
    field.leave("alice")
    field.until(lambda: field.states() == {_S.LANDED}, 120.0)
    assert not eve.commands and eve.election.commander == "alice"


def test_an_observers_hold_ends_a_takeoff() -> None:
    field = a_field(3, "ready")
    field.join("bob")
    field.run(2.0)
    takeoff = field.begin(Takeoff(interval_s=30.0))
    field.until(lambda: field.robots[2].state is _S.HOLD)
    field.done(SafetyCommand("hold"), "bob")
    field.run(1.0)
    assert takeoff.report is not None
    assert set(not_done(takeoff.report).values()) == {ResultCode.ABANDONED}


def test_taking_over() -> None:
    field = a_field(2, "flying")
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
    field = a_field(2, "flying")
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


def test_two_stations_of_a_name_are_an_alarm_and_end_nobody() -> None:
    field = a_field(1, "ready")
    alice = field.stations["alice"]
    twin = Station(alice.setup, field.now_s, 1e9)
    state = alice.published_state()
    assert state is not None
    twin.election.receive_state(state, ANYBODY)
    assert twin.election.shares_name and not twin.commands
    # A state of its own former life that says less is no other's.
    alice.election.receive_state(replace(state, sequence=state.sequence - 1), ANYBODY)
    assert alice.commands and not alice.election.shares_name
    alice.election.receive_state(replace(state, sequence=state.sequence + 1), ANYBODY)
    assert alice.election.shares_name and not alice.commands
    (alarm, *_) = alarms(alice.setup, alice.snapshot())
    assert (alarm.severity, alarm.code) == ("critical", AlarmCode.NAME_SHARED)
    # Its operator decides.
    alice.election.take_command()
    assert alice.commands and alice.state is not None
    assert alice.state.sequence == state.sequence + 2


@pytest.mark.parametrize("robots", [1, 3])
def test_a_second_station_of_a_name_leaves_the_fleet_to_the_first(robots: int) -> None:
    field = a_field(robots, "flying")
    fleet = field.fleet
    twin = SimulatedGround(
        field.stations["alice"].setup, fleet.schedule, fleet.radio, -7, Unguarded(1)
    )
    # Each hears the robots, and not the other.
    field.air = replace(field.air, partition=(frozenset({-1}), frozenset({-7})))
    field.until(lambda: twin.node.station.election.shares_name, 10.0)
    assert not twin.node.station.commands
    assert twin.node.station.published_state() is None
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


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(
    steps=st.lists(
        st.tuples(st.sampled_from(NAMES), REQUESTS, st.floats(0.0, 3.0)), min_size=1, max_size=12
    ),
    restarts=st.sets(st.integers(0, 11), max_size=2),
    deaf=st.dictionaries(st.integers(0, 11), st.integers(-3, 1), max_size=2),
    loss=st.sampled_from([0.0, 0.3]),
    delay_s=st.sampled_from([0.01, 0.2]),
    seed=st.integers(1, 1000),
)
def test_stations_agree_whatever_they_are_told(
    steps: list[tuple[str, Request, float]],
    restarts: set[int],
    deaf: dict[int, int],
    loss: float,
    delay_s: float,
    seed: int,
) -> None:
    """Robots and grounds are deaf for a while, messages are lost, come twice, and overtake."""
    field = a_field(2, "flying", seed=seed)
    field.air = replace(field.air, loss=loss, duplication=loss, delay_s=delay_s)
    for name in NAMES[1:]:
        field.join(name)
    field.run(2.0)
    for i, (name, request, pause_s) in enumerate(steps):
        if i in restarts:
            field.restart(name, pause_s)
        field.air = replace(field.air, deaf=frozenset({deaf[i]} if i in deaf else ()))
        field.begin(request, name)
        field.run(pause_s)
    field.air = replace(field.air, deaf=frozenset())
    # In the end one commands, all know who, and the robots obey it.
    field.run(5.0)
    assert sum(station.commands for station in field.stations.values()) == 1
    (commander,) = {station.election.commander for station in field.stations.values()}
    assert field.operators() == {commander}
    # Whoever holds then, all hold.
    field.do(SafetyCommand("hold"), NAMES[seed % 3])
    field.run(3.0)
    flying = {s for s in field.states() if s in (_S.MISSION, _S.RETURN, _S.TAKEOFF)}
    assert not flying
    assert field.stations[commander].commands
