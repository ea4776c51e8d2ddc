"""What a fleet with keys makes of whoever is on its radio without one, or with a robot's."""

import random
import secrets
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from edge.identity.guard import Unguarded
from edge.identity.members import Role
from edge.messages.codec import encode
from edge.messages.codes import ReasonCode
from edge.messages.mission import FlightState, Order, RobotStatus, SafetyAction
from edge.messages.topics import MESSAGE, ORDER, STATE, STATUS, TOPICS, Topic
from lpac.analysis.snapshot import FleetSnapshot
from lpac.ground.alarms import AlarmCode, alarms
from lpac.ground.station.protocol import (
    ProblemCode,
    Resume,
    RobotCommand,
    SafetyCommand,
    Start,
    Takeoff,
)
from lpac.sim.description import ERRORS
from lpac.sim.drill.bounds import POSITION_ERROR_M
from lpac.sim.fleet.members import SimulatedMembers
from lpac.sim.fleet.simulated import EPOCH_S
from tests.flown import FlownRobot
from tests.sim.ground.field import Field, a_field
from tests.sim.ground.stolen_key import Lie, harms, held_up, ready_fleet

_S = FlightState
# On the radio, as a ground and as a robot.
ENEMY, TWIN = -50, 0
# An hour later than all programs start: what a thief says is newer.
STOLEN_START = int(1e3 * (EPOCH_S + 3600.0))

Seal = Callable[[Topic, bytes], bytes]


def status_of(robot: FlownRobot) -> RobotStatus:
    assert robot.program.status is not None
    return robot.program.status


def attack(field: Field, seal: Seal) -> None:
    """All robots are killed and landed in the operator's name; robot 0 is said to be another's."""
    ground, robot = (field.fleet.radio.link(station, {}) for station in (ENEMY, TWIN))
    state = field.stations["alice"].published_state()
    assert state is not None
    for each in field.robots:
        status = status_of(each)
        order = Order(
            secrets.token_hex(4), each.robot_id, status.boot_nonce, "kill",
            status.uptime_s + 5.0, "alice",
        )  # fmt: skip
        ground.publish(ORDER, seal(ORDER, encode(order)))
    lands = replace(state, sequence=state.sequence + 1, safety_action="land")
    ground.publish(STATE, seal(STATE, encode(lands)))
    told: RobotStatus = replace(
        status_of(field.robots[0]), sequence=10**6, operator="mallory", obeyed_sequence=2**48
    )
    robot.publish(STATUS, seal(STATUS, encode(told)))
    for link in (ground, robot):
        link.close()
    field.run(3.0)


def test_without_keys_anybody_kills_the_fleet() -> None:
    field = a_field(2, "flying")
    attack(field, Unguarded(STOLEN_START).seal)
    assert not any(status_of(robot).armed for robot in field.robots)


@pytest.mark.parametrize("with_the_key_of", ["nobody", "robot 1", "an observer"])
def test_with_keys_nobody_else_commands_it(with_the_key_of: str) -> None:
    field = a_field(2, "flying", secure=True)
    members = field.fleet.members
    assert members is not None
    if with_the_key_of == "nobody":
        seal: Seal = Unguarded(STOLEN_START).seal
    else:
        role, name, robot_id = (
            (Role.ROBOT, "r1", 1) if with_the_key_of == "robot 1" else (Role.OBSERVER, "eve", None)
        )
        seal = members.guard(role, name, robot_id, STOLEN_START, lambda: 0.0).seal
    attack(field, seal)
    assert field.states() == {_S.MISSION}
    assert {status_of(robot).operator for robot in field.robots} == {"alice"}
    assert field.stations["alice"].commands
    assert field.do(SafetyCommand("hold")).done
    assert field.states() == {_S.HOLD}


def test_who_is_revoked_is_heard_no_more() -> None:
    field = a_field(2, "flying", secure=True)
    fleet = field.fleet
    assert fleet.members is not None
    assert status_of(field.robots[0]).neighbour_ages_s.keys() == {"1"}
    fleet.members.revoke(Role.ROBOT, "r1")
    field.run(3.0)
    assert status_of(field.robots[0]).neighbour_ages_s.keys() == set()
    assert status_of(field.robots[1]).neighbour_ages_s.keys() == {"0"}


def test_a_ground_that_is_no_member_any_more_starts_nothing() -> None:
    field = a_field(1, "ready", secure=True)
    assert field.fleet.members is not None
    field.fleet.members.revoke(Role.OPERATOR, "alice")
    field.run(1.0)
    for request in (Takeoff(), Start()):
        problem = field.do(request).problem
        assert problem is not None and problem.code is ProblemCode.MAY_NOT
        assert problem.text.startswith("the key of alice is not in the list")


def test_two_programs_with_one_key_are_an_alarm() -> None:
    """Of a key that was copied; the one that started first is heard no more."""
    field = a_field(2, "ready", secure=True)
    field.second_program(1)
    field.until(lambda: AlarmCode.DUPLICATE_ID in alarms_of(field, "r1"), 15.0)
    assert AlarmCode.DUPLICATE_ID not in alarms_of(field, "r0")


@pytest.mark.parametrize("ahead_s", [20 * 3600.0, 1e11], ids=["within a day", "beyond"])
def test_no_packet_of_a_thief_mutes_a_robot_for_good(ahead_s: float) -> None:
    """The greatest number that its key can sign; robots say so themselves, and the ground."""
    field = a_field(2, "ready", secure=True)
    assert field.fleet.members is not None
    start = min(int(1e3 * (field.fleet.schedule.unix_s() + ahead_s)), 2**48 - 1)
    thief = field.fleet.members.guard(Role.ROBOT, "r1", 1, start, lambda: 0.0)
    thief._sequences.update({"robot/1/message": 2**32 - 2, "robot/1/status": 2**32 - 2})
    link, hears = field.fleet.radio.link(1, {}), field.robots[0]
    for topic in (MESSAGE, STATUS):
        link.publish(topic, thief.seal(topic, b"stolen"))
    link.close()
    told = ReasonCode.SAID_TWICE
    field.until(lambda: told in {alarm.code for alarm in status_of(hears).alarms}, 15.0)
    field.until(lambda: AlarmCode.DUPLICATE_ID in alarms_of(field, "r1"), 5.0)
    if ahead_s < 1e6:
        assert not status_of(hears).neighbour_ages_s
        field.fleet.robots[1].start()
    field.until(lambda: status_of(hears).neighbour_ages_s.keys() == {"1"}, 15.0)
    field.until(lambda: told not in {alarm.code for alarm in status_of(hears).alarms}, 10.0)


def alarms_of(field: Field, robot: str, before: FleetSnapshot | None = None) -> set[AlarmCode]:
    """What alice's views show of a robot."""
    alice = field.stations["alice"]
    told = alarms(alice.setup, alice.snapshot(), before)
    return {alarm.code for alarm in told if alarm.robot == robot}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sequences_ahead"),
    [("alice", 5), ("alice", 2**48), ("mallory", 10**5), ("mallory", 2**48)],
)
def test_a_robot_that_lies_of_whom_it_obeys_takes_no_command_away(
    name: str, sequences_ahead: int
) -> None:
    field = a_field(3, "flying", secure=True)
    members, alice = field.fleet.members, field.stations["alice"]
    assert members is not None and alice.state is not None
    liar = field.robots[2]
    link = field.fleet.radio.link(liar.robot_id, {})
    seal = members.guard(Role.ROBOT, "r2", 2, STOLEN_START, lambda: 0.0).seal
    sequence = min(alice.state.sequence + sequences_ahead, 2**48)
    for i in range(40):
        status = status_of(liar)
        told = replace(
            status, sequence=10**6 + i, operator=name, obeyed_sequence=sequence, ground_age_s=0.0,
            boot_nonce=status.boot_nonce + 1,
        )  # fmt: skip
        link.publish(STATUS, seal(STATUS, encode(told)))
        field.run(0.1)
        if i == 19:
            before = alice.snapshot()
    assert AlarmCode.NOT_OBEYED in alarms_of(field, "r2", before)
    honest = field.robots[:2]
    assert alice.commands and alice.state.sequence < 2**47
    assert {robot.state for robot in honest} == {_S.MISSION}
    # Nor from a ground that starts just now, and knows nothing; nor a hold that others ask for.
    bob = field.join("bob")
    field.run(1.0)
    field.begin(SafetyCommand("hold"), "bob")
    field.until(lambda: {robot.state for robot in honest} == {_S.HOLD}, 3.0)
    assert bob.election.commander == "alice" and alice.commands
    # What sets robots in motion waits for those who do not obey, for a while.
    field.begin(Resume())
    field.until(lambda: {robot.state for robot in honest} == {_S.MISSION}, 10.0)
    field.begin(SafetyCommand("land"), "bob")
    field.until(lambda: {robot.state for robot in honest} == {_S.LAND}, 3.0)


@pytest.mark.slow
def test_a_stolen_robots_lies_move_nobody_beyond_the_limits(tmp_path: Path) -> None:
    lies = (Lie.BESIDE_ONE, Lie.BESIDE_EACH, Lie.PAYLOAD, Lie.BOTH)
    ready = ready_fleet(2, 1, tmp_path)
    hovering = ready.copy()
    assert hovering.ground.command(Takeoff(interval_s=0.0)).done
    for lie, harm in harms(hovering.copy(), (Lie.NOTHING, *lies), 1, 12.0).items():
        # It was heard.
        assert (harm.pushed_m > 1.0) == (lie is not Lie.NOTHING), lie
        assert harm.down == 0 and harm.separation_m > 1.5, lie
        # The fence applies to what a robot takes for its place; wind pushes it over.
        assert harm.estimated_fence_m > -ERRORS.wind_m, lie
        assert harm.fence_m > -POSITION_ERROR_M and harm.speed_m_s < 2.0, lie
    kept = held_up(ready, hovering, 1)
    assert kept.from_mission == 2 and kept.from_mission_after == 0


@pytest.mark.slow
def test_a_man_in_the_middle_makes_nobody_do_what_was_not_asked(
    request: pytest.FixtureRequest,
) -> None:
    """He drops, holds back, repeats and reorders what he likes, while the operator commands."""
    for seed in range(max(10, request.config.getoption("--tries") // 10)):
        with_a_man_in_the_middle(a_field(2, "flying", secure=True, seed=seed), random.Random(seed))


def with_a_man_in_the_middle(field: Field, rng: random.Random) -> None:
    clear = field.air
    running = field.begin(Start())
    for _ in range(6):
        field.air = replace(
            clear,
            loss=rng.choice((0.0, 0.5, 0.9)),
            delay_s=rng.choice((0.01, 1.0, 5.0)),
            duplication=rng.choice((0.0, 0.9)),
        )
        if running.report is not None:
            running = field.begin(rng.choice((SafetyCommand("hold"), Resume(), Start())))
        field.run(rng.uniform(0.5, 4.0))
        # Shorter than what robots wait for a silent ground before they land.
        field.air = clear
        field.run(1.0)
    # Nobody landed, or was armed or disarmed: neither was asked, nor did the ground fall silent.
    field.until(lambda: running.report, 120.0)
    for robot in field.robots:
        assert all(entry.armed and not entry.landed for entry in robot.vehicle.truth)
    assert field.states() <= {_S.MISSION, _S.HOLD}
    # What he has held back comes to nothing once it is out of date.
    field.done(SafetyCommand("hold"))
    field.run(15.0)
    assert field.states() == {_S.HOLD}
    field.done(Resume())
    field.done(Start())
    field.run(8.0)
    assert field.states() == {_S.MISSION}


class Enemy:
    """Whoever has heard this fleet's messages, has robot 1's key, and another fleet's."""

    def __init__(self, field: Field, rng: random.Random) -> None:
        members = field.fleet.members
        assert members is not None
        others = SimulatedMembers("other")
        self._rng = rng
        self._field = field
        self._seals: list[Seal] = [
            lambda _, data: data,
            Unguarded(STOLEN_START).seal,
            members.guard(Role.ROBOT, "r1", 1, STOLEN_START, lambda: 0.0).seal,
            members.guard(Role.OBSERVER, "eve", None, STOLEN_START, lambda: 0.0).seal,
            others.guard(Role.OPERATOR, "alice", None, STOLEN_START, lambda: 0.0).seal,
        ]
        self.recorded: list[tuple[Topic, bytes]] = []
        for station in (-60, 7):
            field.fleet.radio.link(station, {t: partial(self._record, t) for t in TOPICS})
        field.run(0.7)

    def _record(self, topic: Topic, _: str, data: bytes) -> None:
        self.recorded.append((topic, data))

    def says(self) -> None:
        """One message, as whoever it likes to be."""
        topic, data = self._made_up()
        station = ENEMY if topic.sender == "ground" else self._rng.choice((0, 1, 9))
        link = self._field.fleet.radio.link(station, {})
        link.publish(topic, data)
        link.close()

    def _made_up(self) -> tuple[Topic, bytes]:
        rng, seal = self._rng, self._rng.choice(self._seals)
        kind = rng.randrange(6)
        if kind == 0:  # Said again.
            return rng.choice(self.recorded)
        if kind == 1:  # Said again, and changed.
            topic, data = rng.choice(self.recorded)
            changed = bytearray(data)
            for _ in range(rng.randrange(1, 9)):
                changed[rng.randrange(len(changed))] = rng.randrange(256)
            return topic, bytes(changed[: rng.choice((len(changed), rng.randrange(len(changed))))])
        topic = rng.choice(TOPICS)
        if kind == 2:
            return topic, seal(topic, rng.randbytes(rng.randrange(topic.limit_bytes)))
        if kind == 3:
            return topic, seal(topic, rng.choice((b"[" * 4000, b"", b'{"sequence":' + b"9" * 4300)))
        if kind == 4:
            state = self._field.stations["alice"].published_state()
            assert state is not None
            sequence = rng.choice((state.sequence, state.sequence + 1, 2**48))
            actions: tuple[SafetyAction, ...] = ("none", "hold", "return", "land")
            said = replace(
                state, sequence=sequence, operator=rng.choice(("alice", "zoe")),
                safety_action=rng.choice(actions), enabled=rng.random() < 0.5,
            )  # fmt: skip
            return STATE, seal(STATE, encode(said))
        status = replace(
            status_of(self._field.robots[rng.randrange(2)]),
            sequence=rng.choice((1, 10**6, 2**48)), boot_nonce=rng.randrange(2**48),
            operator=rng.choice(("", "alice", "zoe")), obeyed_sequence=rng.choice((-1, 2**48)),
            uptime_s=rng.choice((0.0, 1e9)), state=rng.choice(tuple(_S)),
        )  # fmt: skip
        return STATUS, seal(STATUS, encode(status))


@pytest.mark.slow
def test_hold_land_and_kill_act_whatever_single_message_came_before(
    request: pytest.FixtureRequest,
) -> None:
    for seed in range(request.config.getoption("--tries")):
        hold_land_and_kill_act(a_field(2, "flying", secure=True, seed=seed), random.Random(seed))


def hold_land_and_kill_act(field: Field, rng: random.Random) -> None:
    enemy, (first, second) = Enemy(field, rng), field.robots
    enemy.says()
    field.run(0.3)
    field.begin(SafetyCommand("hold"))
    field.until(lambda: first.state is _S.HOLD, 1.0)
    enemy.says()
    field.begin(SafetyCommand("land", ("r1",)))
    field.until(lambda: second.state is _S.LAND, 1.0)
    enemy.says()
    field.begin(RobotCommand("kill", ("r0",)))
    field.until(lambda: not first.vehicle.armed, 1.0)
