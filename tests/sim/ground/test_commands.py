"""What commands do when somebody else wants something meanwhile, or their client leaves."""

from dataclasses import replace

import pytest

from edge.messages.mission import FlightState, Place, world_id
from lpac.ground.station.protocol import (
    Enable,
    NextTrial,
    Problem,
    ProblemCode,
    Request,
    ResultCode,
    Resume,
    RobotCommand,
    RobotResult,
    SafetyCommand,
    SetFence,
    SetOrigin,
    SetPlaces,
    SetWorld,
    Start,
    TakeCommand,
    Takeoff,
)
from lpac.sim.fleet.layout import ORIGIN
from lpac.sim.px4.modes import Px4Mode
from tests.said import not_done, problem
from tests.sim.ground.field import Field, Stage, a_field
from tests.sim.ground.test_station import OTHER_WORLD

_S = FlightState
TAKEOFF = Takeoff(interval_s=0.0)


def two_stations(n: int = 2, stage: Stage = "ready") -> Field:
    """Alice commands the robots, bob observes."""
    field = a_field(n, stage)
    field.join("bob")
    field.run(1.0)
    return field


@pytest.mark.parametrize("request_", [TAKEOFF, Start()])
def test_who_is_no_member_sets_nobody_in_motion(
    monkeypatch: pytest.MonkeyPatch, request_: Request
) -> None:
    field = a_field(1, "ready")
    guard = field.fleet.grounds["alice"].node._guard
    monkeypatch.setattr(type(guard), "is_member", lambda *_: False)
    report = field.do(request_)
    assert problem(report) is ProblemCode.MAY_NOT
    assert report.problem is not None
    assert report.problem.text.startswith("the key of alice is not in the list of members: ")


# A hold keeps robots on the ground, too


@pytest.mark.parametrize("by", ["alice", "bob"])
def test_a_hold_on_the_ground_is_not_withdrawn_by_takeoff(by: str) -> None:
    field = two_stations()
    field.done(SafetyCommand("hold"), by)
    field.run(1.0)
    who = "" if by == "alice" else " by bob"
    text = f"hold is commanded{who}: `lpac mission resume` withdraws it"
    assert field.do(TAKEOFF).problem == Problem(ProblemCode.UNDER_SAFETY_ACTION, text)
    field.run(5.0)
    assert field.states() == {_S.PREFLIGHT}
    field.done(Resume())
    field.done(TAKEOFF)
    assert field.states() == {_S.HOLD}


def test_who_takes_the_command_says_whose_hold_it_is() -> None:
    field = two_stations(1)
    field.done(SafetyCommand("hold"))
    field.done(TakeCommand(), "bob")
    state = field.stations["bob"].state
    assert state is not None and (state.safety_action, state.safety_action_by) == ("hold", "alice")


def test_a_hold_of_one_robot_is_not_withdrawn_with_the_landing_of_others() -> None:
    field = two_stations(3)
    field.done(SafetyCommand("hold", robots=("r1",)), "bob")
    field.run(1.0)
    assert not_done(field.do(TAKEOFF)) == {"r1": ResultCode.UNDER_SAFETY_ACTION}
    field.done(SafetyCommand("land", robots=("r0", "r2"), wait=True))
    field.done(Takeoff(robots=("r0",)))
    state = field.stations["alice"].state
    assert state is not None
    assert state.robot_safety_actions == {"1": "hold", "2": "land"}
    # Asked of all, it is as if all were to be set in motion.
    field.done(SafetyCommand("land", robots=("r0",), wait=True))
    assert problem(field.do(TAKEOFF)) is ProblemCode.UNDER_SAFETY_ACTION


def test_who_is_not_heard_may_be_in_the_air() -> None:
    field = a_field(2, "hovering")
    field.done(SafetyCommand("land", wait=True))
    field.robots[1].silent = True
    field.run(12.0)
    assert problem(field.do(TAKEOFF)) is ProblemCode.UNDER_SAFETY_ACTION
    # Who is heard may be asked for by name; the other is to land, still.
    field.done(Takeoff(interval_s=0.0, robots=("r0",)))
    state = field.stations["alice"].state
    assert state is not None
    assert state.safety_action_for(1) == "land"


def test_a_spare_that_is_switched_off_keeps_nobody_on_the_ground() -> None:
    field = a_field(2, spares=1)
    field.robots[2].silent = True
    field.join("alice")
    field.run(1.0)
    field.done(SetOrigin(ORIGIN))
    field.done(Enable())
    field.done(TAKEOFF)
    field.done(SafetyCommand("land", wait=True))
    field.done(TAKEOFF)
    state = field.stations["alice"].state
    assert state is not None
    assert (state.safety_action, state.robot_safety_actions) == ("none", {})


# Done is what was asked for


def test_a_return_that_ends_elsewhere_is_not_done() -> None:
    field = a_field(3, "flying")
    field.until(lambda: min(robot.away_m for robot in field.robots) > 3.0)
    lands = field.robots[1]
    lands.crawl()
    task = field.begin(SafetyCommand("return", wait=True))
    field.run(2.0)
    lands.vehicle.battery_remaining = 0.01
    field.until(lambda: task.report, 120.0)
    assert task.report is not None
    assert not_done(task.report) == {"r1": ResultCode.LANDED_ELSEWHERE}
    text = next(result.text for result in task.report.results if result.robot == "r1")
    assert "m from its landing point" in text
    assert "battery critical" in text


def test_a_killed_robot_has_not_landed_on_command() -> None:
    field = a_field(2, "flying")
    field.join("bob")
    field.run(2.0)
    task = field.begin(SafetyCommand("land", wait=True))
    field.until(lambda: field.states() == {_S.LAND})
    field.run(1.0)
    kill = field.begin(RobotCommand("kill", ("r0",)), "bob")
    field.robots[0].silent = True
    field.until(lambda: field.robots[0].said.armed is False)
    field.robots[0].silent = False
    field.until(lambda: task.report and kill.report)
    assert task.report is not None
    assert not_done(task.report) == {"r0": ResultCode.WRONG_STATE}


def test_who_stood_on_the_ground_before_has_nothing_to_do() -> None:
    field = a_field(2, "ready")
    report = field.done(SafetyCommand("return", wait=True))
    assert {result.text for result in report.results} == {"on the ground"}


# A mission that was not started is not resumed


def test_a_reset_robot_has_not_begun_the_trial() -> None:
    field = a_field(2, "ready")
    field.done(NextTrial("second"))
    field.done(TAKEOFF)
    field.done(SafetyCommand("hold"))
    report = field.done(Resume())
    texts = {result.text for result in report.results}
    assert texts == {"holds: not in this trial yet; `lpac mission start`"}
    field.run(5.0)
    assert field.states() == {_S.HOLD}


# What is the fleet's is not changed while one of it flies


@pytest.mark.parametrize(
    "request_",
    [
        SetOrigin(replace(ORIGIN, heading_deg=90.0), robots=("r0",)),
        SetFence(None, robots=("r0",)),
        SetWorld(OTHER_WORLD, "w", robots=("r0",)),
        SetPlaces({"r0": Place(1, (3.0, 3.0))}),
    ],
)
def test_who_is_not_addressed_keeps_what_it_has(request_: Request) -> None:
    field = a_field(2, "ready")
    field.done(Takeoff(robots=("r1",)))
    before = field.stations["alice"].state
    text = "r1 is armed: land and disarm first"
    assert field.do(request_).problem == Problem(ProblemCode.ARMED, text)
    assert field.stations["alice"].state == before


def test_a_killed_robot_is_not_in_the_others_way() -> None:
    field = a_field(3, "hovering")
    field.done(RobotCommand("kill", ("r0",)))
    field.done(SafetyCommand("land", robots=("r1", "r2"), wait=True))
    field.done(SetWorld(OTHER_WORLD, "w", robots=("r1", "r2")))


def test_the_fleets_world_is_made_known_at_any_time() -> None:
    field = two_stations()
    configured = field.stations["alice"].setup.world
    field.done(SetWorld(OTHER_WORLD, "w"))
    field.leave("bob")
    field.done(TAKEOFF)
    bob = field.join("bob")
    field.run(1.5)
    assert not bob.setup.world
    before = field.stations["alice"].state
    assert problem(field.do(SetWorld(configured, "w"), "bob")) is ProblemCode.OTHER_COMMANDS
    field.done(SetWorld(OTHER_WORLD, "w"), "bob")
    assert bob.setup.world == OTHER_WORLD
    assert field.stations["alice"].state == before


# Whoever takes over has the fleet


def test_who_takes_over_has_gathered_its_robots_first() -> None:
    field = two_stations()
    # It knows who commands before it has heard every robot.
    field.join("carol")
    field.done(TakeCommand(), "carol")


@pytest.mark.parametrize(
    "request_", [NextTrial(), RobotCommand("disarm", ("r0",)), SafetyCommand("hold"), Enable()]
)
def test_who_took_over_is_not_robbed_of_the_command(request_: Request) -> None:
    field = two_stations()
    # It obeys somebody who is gone, and hears nobody: alice waits for it.
    field.join("carol")
    field.cut(("alice", "bob", "r1"), ("carol", "r0"))
    field.run(4.0)
    field.do(TakeCommand(), "carol")
    robot = field.robots[0]
    assert [each.said.operator for each in field.robots] == ["carol", "alice"]
    field.leave("carol")
    robot.deaf = True
    field.run(1.2)
    field.mend()
    field.run(1.0)
    assert field.stations["alice"].commands
    waiting = field.begin(request_)
    field.run(1.0)
    assert waiting.report is None
    taken = field.begin(TakeCommand(), "bob")
    field.run(1.0)
    assert waiting.report is not None
    assert not_done(waiting.report)["r0"] is ResultCode.ABANDONED
    robot.deaf = False
    field.until(lambda: taken.report)
    field.run(6.0)
    assert [station.commands for station in field.stations.values()] == [False, True]


def test_kill_goes_on_whoever_takes_over() -> None:
    field = two_stations(stage="hovering")
    field.robots[0].deaf = True
    kill = field.begin(RobotCommand("kill", ("r0",)))
    field.run(1.0)
    field.begin(TakeCommand(), "bob")
    field.run(1.0)
    field.robots[0].deaf = False
    field.until(lambda: kill.report)
    assert kill.report is not None
    assert kill.report.done


def test_anothers_hold_ends_only_what_sets_in_motion() -> None:
    field = two_stations()
    field.robots[0].deaf = True
    again = field.begin(NextTrial())
    field.done(SafetyCommand("hold", robots=("r1",)), "bob")
    field.run(1.0)
    assert again.report is None
    field.robots[0].deaf = False
    field.until(lambda: again.report)
    assert again.report is not None
    assert again.report.done


def test_who_hears_the_ground_after_seconds_obeys_it_still() -> None:
    field = two_stations(stage="flying")
    field.robots[0].silent = field.robots[0].deaf = True
    field.run(0.5)
    hold = field.begin(SafetyCommand("hold"))
    field.run(2.5)
    assert hold.report is None
    field.robots[0].silent = field.robots[0].deaf = False
    field.until(lambda: hold.report, 5.0)
    assert hold.report is not None
    assert hold.report.done


# A client that leaves


def half_resumed() -> Field:
    """Robots that return are asked to resume, and hold by now."""
    field = two_stations(stage="flying")
    field.until(lambda: min(robot.away_m for robot in field.robots) > 2.0)
    field.done(SafetyCommand("return"))
    return field


def test_who_was_on_its_way_home_goes_on_if_resume_is_abandoned() -> None:
    field = half_resumed()
    resume = field.begin(Resume())
    field.until(lambda: _S.HOLD in field.states())
    resume.abandon("its client left", withdraw=False)
    field.land()


@pytest.mark.parametrize("by", ["alice", "bob"])
def test_who_is_told_to_hold_goes_nowhere_if_resume_is_abandoned(by: str) -> None:
    field = half_resumed()
    resume = field.begin(Resume())
    field.run(0.1)
    field.done(SafetyCommand("hold"), by)
    field.run(1.0)
    assert resume.report is not None
    assert set(not_done(resume.report)) == {"r0", "r1"}
    field.run(5.0)
    assert field.states() == {_S.HOLD}


# A status from before the command


def test_who_was_with_its_pilot_until_now_lands_with_the_others() -> None:
    field = a_field(2, "hovering")
    field.done(RobotCommand("pilot", ("r1",)))
    # It is taken back, and does not come to say so before all are to land.
    field.robots[1].program.loops["status"].hang(1.5)
    field.begin(RobotCommand("rejoin", ("r1",)))
    field.run(1.0)
    heard = field.stations["alice"].status("r1")
    assert heard is not None and heard.state is _S.PILOT
    field.done(SafetyCommand("land", wait=True))
    assert field.states() == {_S.LANDED}


# Who cannot do it is said so at once, and does not count as done


def test_a_refusal_is_not_the_reason_of_who_left_hold_since() -> None:
    field = a_field(1, "hovering")
    field.robots[0].program.loops["policy"].hang(60.0)
    field.run(3.0)
    start = field.begin(Start())
    field.until(lambda: field.robots[0].said.orders)
    field.run(1.0)
    assert start.report is None  # It is asked again for a while.
    field.robots[0].vehicle.set_mode(Px4Mode.HOLD)
    field.until(lambda: start.report)
    assert start.report is not None
    (result,) = start.report.results
    assert (result.code, result.refusal) == (ResultCode.WRONG_STATE, None)
    assert "pilot" in result.text


def test_who_is_killed_fails_and_does_not_hold_up_the_others() -> None:
    field = two_stations(3)
    field.done(RobotCommand("kill", ("r1",)))
    report = field.do(Enable())
    assert not_done(report) == {"r1": ResultCode.WRONG_STATE}
    why = "fault: killed by the operator; inspect it, then `lpac fleet restart`"
    assert report.results[1].text == why
    assert field.done(SafetyCommand("land", wait=True))
    field.done(Resume())
    abort = replace(TAKEOFF, abort_on_failure=True)
    assert not_done(field.do(abort)) == {
        "r1": ResultCode.WRONG_STATE, "r0": ResultCode.NOT_ORDERED, "r2": ResultCode.NOT_ORDERED,
    }  # fmt: skip
    assert field.robots[0].state is field.robots[2].state is _S.PREFLIGHT


def test_who_is_not_ready_is_not_done_with_enable() -> None:
    field = a_field()
    field.robots[2].tire()
    field.done(SetOrigin(ORIGIN))
    assert not_done(field.do(Enable())) == {"r2": ResultCode.NOT_READY}


def test_who_is_not_enabled_is_not_waited_for() -> None:
    field = a_field()
    field.done(SetOrigin(ORIGIN))
    field.done(Enable(robots=("r0",)))
    refused = ResultCode.NOT_ENABLED
    assert not_done(field.do(TAKEOFF)) == {"r1": refused, "r2": refused}


def test_two_holds_at_once_are_both_done() -> None:
    field = a_field(2, "flying")
    field.robots[1].silent = True
    first = field.begin(SafetyCommand("hold"))
    field.run(1.0)
    field.robots[1].silent = False
    assert field.do(SafetyCommand("hold")).done
    assert first.report is not None
    assert first.report.done


def test_the_next_trial_begins_only_when_nobody_flies_this_one() -> None:
    field = a_field(3, "flying")
    field.done(SafetyCommand("hold", robots=("r0",)))
    text = "r1, r2 fly the mission: hold or land first"
    told = field.do(NextTrial(robots=("r0",))).problem
    assert told == Problem(ProblemCode.ON_MISSION, text)


def test_a_command_with_a_defect_takes_nothing_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    field = a_field(2, "flying")
    hold = field.begin(SafetyCommand("hold", wait=True))
    monkeypatch.setattr(hold, "_steps", (1 / 0 for _ in range(1)))
    with pytest.raises(ZeroDivisionError):
        field.commands["alice"].step()
    assert hold.report is not None
    assert problem(hold.report) is ProblemCode.DEFECT
    field.done(SafetyCommand("land", wait=True))


def test_what_is_done_when() -> None:
    assert problem(a_field(1).do(TAKEOFF)) is ProblemCode.NO_ORIGIN
    field = a_field(3, "ready", spares=1)
    report = field.done(TAKEOFF)
    assert report.results[0] == RobotResult("r0", ResultCode.DONE, "at its height, 5 m")
    field.done(Start())
    # A spare does not fly by default, but has the state.
    assert field.robots[3].state is _S.PREFLIGHT
    assert problem(field.do(SetWorld(OTHER_WORLD, "w.env"))) is ProblemCode.ARMED
    field.done(RobotCommand("pilot", ("r1",)))
    assert field.each_state()[:3] == [_S.MISSION, _S.PILOT, _S.MISSION]
    field.done(RobotCommand("rejoin", ("r1",)))
    assert field.each_state()[1] is _S.HOLD


def test_who_joins_late_has_the_state() -> None:
    field = a_field(3)
    late = field.robots[2].program
    late.stop()
    field.run(5.0)
    assert not_done(field.do(SetOrigin(ORIGIN))) == {"r2": ResultCode.NOT_HEARD}
    assert not_done(field.do(SetWorld(OTHER_WORLD, "w.env"))) == {"r2": ResultCode.NOT_HEARD}
    late.start()
    field.until(lambda: late.status and late.status.origin == ORIGIN)
    field.until(lambda: field.robots[2].said.world_id == world_id(OTHER_WORLD))
