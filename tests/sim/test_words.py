"""What decides reads codes: where every text is "x", nothing is decided otherwise."""

import dataclasses
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from msgspec import structs

from edge.flight.preflight import failed_checks
from edge.messages import codes
from edge.messages.codes import CheckCode, FailedCheck, Reason, ReasonCode
from edge.messages.mission import OrderKind, Origin
from lpac.fleet.doctor import judge
from lpac.fleet.settings import parse_fleet
from lpac.ground.alarms import alarms
from lpac.ground.station import commands
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
    Takeoff,
)
from lpac.ground.station.station import Station
from lpac.sim.fleet.layout import ORIGIN
from tests.conftest import ROOT
from tests.sim.ground.field import Field, a_field
from tests.sim.ground.test_station import OTHER_WORLD
from tests.unit.fleet.test_doctor import well
from tests.unit.flight.test_flight import World
from tests.unit.flight.test_preflight import INPUTS, LIMITS, POSITIONS, READY, VEHICLE, VEHICLES
from tests.unit.ground.snapshots import FENCE, robot, setup, snapshot, status


@pytest.fixture
def wordless(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Called, it makes every text "x" that a robot or the ground says from then on."""

    def begin() -> None:
        def forget(said: object) -> None:
            object.__setattr__(said, "text", "x")

        def result(name: str, code: ResultCode, _: str, *refusal: Any) -> RobotResult:
            return RobotResult(name, code, "x", *refusal)

        def problem(code: ProblemCode, _: str) -> Problem:
            return Problem(code, "x")

        notify = Station.notify

        def notify_nothing(
            station: Station, kind: Any, name: str, _: str, *more: Any, **known: Any
        ) -> None:
            notify(station, kind, name, "x", *more, **known)

        monkeypatch.setattr(codes, "_shorten", forget)
        monkeypatch.setattr(commands, "RobotResult", result)
        monkeypatch.setattr(commands, "Problem", problem)
        monkeypatch.setattr(Station, "notify", notify_nothing)

    return begin


Wordless = Callable[[], None]
OTHER_FENCE, OTHER_ORIGIN = replace(FENCE, ceiling_m=30.0), Origin(47.0, 8.0, 0.0)


def flown() -> list[tuple[object, ...]]:
    """What a robot decided and said, in codes, while much went wrong."""
    told: list[tuple[object, ...]] = []
    kinds: tuple[OrderKind, ...] = ("rejoin", "start", "takeoff", "disarm", "reset")

    def look(world: World, seconds: float) -> None:
        for _ in range(round(seconds / 0.1)):
            decision = world.tick()
            alarmed = {alarm.code for alarm in decision.alarms}
            told.append((*world.why, decision.actions, frozenset(alarmed)))
        for kind in kinds:
            refusal = world.give(world.new_order(kind)).refusal
            told.append((kind, refusal and refusal.code))

    for change in (
        {"position_known": False}, {"battery": 0.24}, {"battery": 0.1}, {"ground_on": False},
        {"policy_m_s": None}, {"telemetry": False}, {"busy": (4,)}, {"safety_request": "hold"},
        {"not_taken": (FailedCheck(CheckCode.KEEPS_FENCE, "in flight: keeps its fence"),)},
        {"failed_checks": (FailedCheck(CheckCode.GPS_NO_FIX, "no fix"),)},
    ):  # fmt: skip
        world = World()
        world.fly()
        for name, value in change.items():
            setattr(world, name, value)
        look(world, 8.0)
        world.stop(3.0)
        look(world, 20.0)
    return told


def test_a_robot_flies_the_same(wordless: Wordless) -> None:
    spoken = flown()
    wordless()
    assert Reason(ReasonCode.PILOT, "a pilot flies it").text == "x"
    assert flown() == spoken
    assert len({state for state, *_ in spoken}) > 8


def failed() -> list[FailedCheck]:
    """Everything that preflight knows."""
    changes = [change for change, _, _ in INPUTS + POSITIONS]
    changes += [{"vehicle": structs.replace(VEHICLE, **change)} for change, _, _ in VEHICLES]
    return [check for c in changes for check in failed_checks(replace(READY, **c), LIMITS)]


def diagnosed(checks: list[FailedCheck]) -> list[tuple[str, str, str]]:
    """What doctor makes of a robot whose program says that."""
    path = ROOT / "docs" / "fleet.toml"
    config = parse_fleet(path, path.read_text().replace("# insecure = false", "insecure = true"))
    fleet = {name: well(config, name) for name in ("r1", "r2", "r3")}
    told = [dataclasses.asdict(check) for check in checks]
    fleet["r1"].facts["service"]["status"]["failed_checks"] = told
    return [(c.name, c.verdict, c.fix) for c in judge(config, config.robots["r1"], fleet)]


def test_doctor_judges_the_same(wordless: Wordless) -> None:
    spoken = [diagnosed([check]) for check in failed()]
    everything = diagnosed(failed())
    before = {check.text for check in failed()}
    wordless()
    assert {check.text for check in failed()} == {"x"} != before
    assert [diagnosed([check]) for check in failed()] == spoken
    assert diagnosed(failed()) == everything
    verdicts = {verdict for found in spoken for _, verdict, _ in found}
    assert verdicts == {"ok", "warning", "FAILED"}


def alarmed() -> list[list[tuple[str, ...]]]:
    """The ground's alarms for robots that say all kinds of things, but for the words."""
    said: list[dict[str, Any]] = [
        {"not_taken": (FailedCheck(code, f"{code} fence origin world"),), **differs}
        for code in CheckCode
        for differs in ({"fence": OTHER_FENCE}, {"origin": OTHER_ORIGIN}, {"world_id": "w"})
    ]
    said += [{"alarms": (Reason(code, f"{code}: battery"),), "battery": 0.2} for code in ReasonCode]
    return [
        [alarm[:3] for alarm in alarms(setup(1), snapshot(robot(status(0, **each))))]
        for each in said
    ]


def test_the_ground_alarms_the_same(wordless: Wordless) -> None:
    spoken = alarmed()
    wordless()
    assert alarmed() == spoken


def commanded() -> list[object]:
    """A day on the ground, in codes: what came of each command, and what was told."""
    field = a_field(2)
    # Whatever words the robots had before, they have said it anew.
    field.run(1.0)
    began = len(field.events)
    requests: tuple[Request, ...] = (
        Takeoff(), Start(), Enable(), SetFence(None), Takeoff(interval_s=0.0),
        SetWorld(OTHER_WORLD, "w"), SetPlaces({}), Start(), Start(), SafetyCommand("hold"),
        Start(), Resume(), NextTrial(), RobotCommand("pilot", ("r1",)),
        RobotCommand("rejoin", ("r1",)), RobotCommand("kill", ("r1",)), Resume(),
        SafetyCommand("return", wait=True), SafetyCommand("land", wait=True), NextTrial(),
        SetWorld(OTHER_WORLD, "w"), SetFence(OTHER_FENCE),
    )  # fmt: skip
    told: list[object] = []
    ask(field, told, Takeoff())
    ask(field, told, SetOrigin(ORIGIN))
    ask(field, told, Enable())
    charge = field.robots[0].vehicle.battery_remaining
    field.robots[0].tire()
    field.run(6.0)
    for request in requests:
        ask(field, told, request)
        field.robots[0].vehicle.battery_remaining = charge
    unusable = FailedCheck(CheckCode.WORLD_UNUSABLE, "the ground's world cannot be used")
    station = field.stations["alice"]
    last = field.robots[0].said
    for i, not_taken in enumerate(((), (unusable,))):
        lacking = replace(last, world_id="old", not_taken=not_taken, sequence=last.sequence + 1 + i)
        station.receive_status(lacking)
        told.append(station.published_world())
    assert told[-2:] == [OTHER_WORLD, None]
    events = [(e.kind, e.robot, e.operator, e.trial) for e in field.events[began:]]
    return [*told, *events, [robot.state for robot in field.robots]]


def ask(field: Field, told: list[object], request: Request) -> None:
    report = field.do(request)
    results = [(result.robot, result.code, result.refusal) for result in report.results]
    told.append((type(request), report.problem and report.problem.code, results))


@pytest.mark.slow
def test_the_ground_commands_the_same(wordless: Wordless) -> None:
    spoken = commanded()
    wordless()
    assert commanded() == spoken
