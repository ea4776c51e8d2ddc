"""`lpac ground` as a real process, over real zenoh, with robots that fly in this process."""

import asyncio
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from edge.messages.codes import RefusalCode
from edge.messages.mission import FlightState, world_id
from lpac.analysis.snapshot import Explored, FleetSnapshot, GroundEvent
from lpac.ground.station import client
from lpac.ground.station.config import load_ground
from lpac.ground.station.protocol import (
    CommandReport,
    Enable,
    ProblemCode,
    ResultCode,
    RobotCommand,
    SafetyCommand,
    SetOrigin,
    SetWorld,
    Start,
    Takeoff,
)
from tests.live import ORIGIN, FlownFleet
from tests.process.ground.conftest import PATIENCE_S, GroundStation, NewStation, all_heard
from tests.said import not_done, problem

_S = FlightState


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[FlownFleet]:
    """Three robots r0, r1, r2, and r3, a spare."""
    with FlownFleet(tmp_path, 3, spares=1) as running:
        yield running


@pytest.fixture(scope="module")
def on_ground(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FlownFleet]:
    """The same, for tests that fly none of them."""
    with FlownFleet(tmp_path_factory.mktemp("on_ground"), 3, spares=1) as running:
        yield running


def everywhere(snapshot: FleetSnapshot, state: FlightState, count: int = 3) -> bool:
    return all(r.status and r.status.state is state for r in snapshot.robots[:count])


def obeying(snapshot: FleetSnapshot, operator: str) -> bool:
    return all(r.status and r.status.operator == operator for r in snapshot.robots[:3])


def done(report: CommandReport) -> CommandReport:
    assert report.done, report.problem or [r for r in report.results if not r.done]
    return report


def make_ready(station: GroundStation) -> None:
    station.wait_for(all_heard)
    done(station.command(SetOrigin(ORIGIN)))
    # On a busy machine robots hear the ground too late for a while, and are not ready.
    station.command(Enable())
    station.wait_for(lambda p: all(r.status and r.status.ready for r in p.robots[:3]))


def fly(station: GroundStation) -> None:
    make_ready(station)
    done(station.command(Takeoff(interval_s=0.0)))
    report = station.command(Start())
    # Of many, some may not have heard yet that the last ones are up.
    while refused := tuple(
        result.robot for result in report.results if result.refusal is RefusalCode.OTHERS_TAKE_OFF
    ):
        report = station.command(Start(refused))
    done(report)


def test_a_station_that_was_killed_goes_on_where_it_was(
    fleet: FlownFleet, new_station: NewStation
) -> None:
    text = "CircularBND 100 100 20 5\n"
    station = new_station(fleet.fleet_toml)
    make_ready(station)
    # It climbs for as long as the test has a use for it.
    fleet.flown[2].climb_slowly()
    done(station.command(SetWorld(text, "w.env")))
    takeoff = station.begin(Takeoff(interval_s=60.0))
    takeoff.progress("r2")
    station.wait_for(lambda p: p.robots[2].status and p.robots[2].status.state is _S.TAKEOFF)
    station.kill()
    takeoff.leave()
    fleet.flown[2].hurry()
    station.start()
    snapshot = station.wait_for(lambda p: p.ground is not None)
    assert snapshot.ground is not None
    assert snapshot.ground.origin == ORIGIN
    assert snapshot.ground.enabled
    # Nothing half done: what had taken off comes to hold, and nothing else takes off.
    states = [_S.PREFLIGHT, _S.PREFLIGHT, _S.HOLD]
    station.wait_for(lambda p: [r.status and r.status.state for r in p.robots[:3]] == states)
    assert station.setup().world == text
    done(station.command(Takeoff(interval_s=0.0)))
    done(station.command(Start()))
    # What robots do not say is not forgotten either.
    done(station.command(SafetyCommand("hold")))
    station.kill()
    station.start()
    snapshot = station.wait_for(lambda p: p.ground is not None)
    assert snapshot.ground is not None
    assert snapshot.ground.safety_action == "hold"
    assert problem(station.command(Start())) is ProblemCode.UNDER_SAFETY_ACTION
    # A memory that is broken is none.
    station.kill()
    station.socket_path.with_suffix(".state").write_text("{")
    station.start()
    station.wait_for(lambda p: p.ground is not None)


def test_another_station_knows_the_world_that_one_sends(
    on_ground: FlownFleet, new_station: NewStation
) -> None:
    text = "CircularBND 100 100 20 5\n"
    alice = new_station(on_ground.fleet_toml)
    alice.wait_for(all_heard)
    bob = new_station(on_ground.fleet_toml, "bob")
    # It is sent only until all robots have it: by then bob hears alice.
    done(alice.command(SetOrigin(ORIGIN)))
    bob.wait_for(lambda p: p.ground)
    done(alice.command(SetWorld(text, "w.env")))
    bob.wait_for(lambda _: bob.setup().world == text)
    carol = new_station(on_ground.fleet_toml, "carol")
    carol.wait_for(lambda _: not carol.setup().world)
    assert carol.setup().world_id == world_id(text)
    # On the same laptop it stays known.
    bob.kill()
    bob.start()
    bob.wait_for(lambda p: p.ground)
    assert bob.setup().world == text


def test_a_ground_that_hangs(
    fleet: FlownFleet, new_station: NewStation, monkeypatch: pytest.MonkeyPatch
) -> None:
    station = new_station(fleet.fleet_toml)
    make_ready(station)
    subscribed = station.subscribed()
    next(subscribed)
    # It is silent for longer than that, and yet a long command goes on.
    fleet.flown[2].climb_slowly()
    takeoff = station.begin(Takeoff(interval_s=60.0))
    assert [takeoff.progress("").text for _ in range(2)] == ["", ""]
    assert station.process is not None
    station.process.send_signal(signal.SIGSTOP)
    monkeypatch.setattr(client, "_PATIENCE_S", 0.5)
    with pytest.raises(client.GroundError, match="does not answer: end it, and start"):
        station.command(SafetyCommand("hold"))
    with pytest.raises(client.GroundError, match="does not answer"):
        station.told()
    with pytest.raises(client.GroundError, match="does not answer"):
        list(subscribed)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(station.runtime))
    with pytest.raises(client.GroundError, match="does not answer"):
        asyncio.run(client.send(station.fleet, SafetyCommand("hold")))
    monkeypatch.undo()
    station.process.send_signal(signal.SIGCONT)
    fleet.flown[2].hurry()
    # What it was told meanwhile it does.
    station.wait_for(lambda p: p.ground and p.ground.safety_action == "hold")
    takeoff.leave()


def test_robots_land_when_their_files_say(on_ground: FlownFleet) -> None:
    text = on_ground.fleet_toml.read_text()
    flight = "battery_critical = 0.2\nground_timeout_s = 4.0\nground_lost_land_s = 30.0\n"
    changed = on_ground.fleet_toml.with_name("changed.toml")
    changed.write_text(text.replace("[robot.flight]\n", f"[robot.flight]\n{flight}"))
    setup = load_ground(changed, "alice").setup
    assert setup.battery_critical == 0.2
    assert (setup.ground_timeout_s, setup.ground_lost_land_s) == (4.0, 30.0)


def test_two_stations_of_one_name(on_ground: FlownFleet, new_station: NewStation) -> None:
    station = new_station(on_ground.fleet_toml)
    make_ready(station)
    other = new_station(on_ground.fleet_toml, "alice", "other laptop")
    snapshot = other.wait_for(lambda p: p.shares_name)
    assert snapshot.commander == "alice" and not station.wait_for(all_heard).shares_name
    other.kill()
    # Of one user there is no second one.
    second = station.twin()
    assert second.returncode == 1
    assert second.stderr == (f"lpac: `lpac ground` already runs for fleet {on_ground.name} here\n")
    assert station.wait_for(lambda p: obeying(p, "alice")).commander == "alice"


def test_another_fleet_is_not_reached(on_ground: FlownFleet, new_station: NewStation) -> None:
    text = on_ground.fleet_toml.read_text()
    other = on_ground.fleet_toml.with_name("other.toml")
    other.write_text(text.replace(on_ground.name, f"{on_ground.name}x"))
    station = new_station(other, "mallory")
    before = [robot.said.obeyed_sequence for robot in on_ground.flown]
    report = station.command(SetOrigin(ORIGIN))
    assert not_done(report) == dict.fromkeys(("r0", "r1", "r2"), ResultCode.NOT_HEARD)
    assert not_done(station.command(RobotCommand("kill", ("r0",)))) == {"r0": ResultCode.NOT_HEARD}
    assert [robot.said.obeyed_sequence for robot in on_ground.flown] == before


def test_what_cannot_be_done_and_lines_that_are_no_commands(
    on_ground: FlownFleet, new_station: NewStation
) -> None:
    with pytest.raises(client.GroundError, match="no ground station runs for fleet"):
        client.command(on_ground.name, Start())
    station = new_station(on_ground.fleet_toml)
    assert problem(station.command(Start(robots=("r7",)))) is ProblemCode.UNKNOWN_ROBOT
    assert problem(station.command(RobotCommand("kill", ()))) is ProblemCode.NO_ROBOT
    for line in (
        b"", b"\n", b"{}\n", b"[" * 100_000 + b"\n", b'{"takeoff": {"interval_s": "x"}}\n',
        b"\xff\xfe\n", b'{"snapshot": {}}\n', b"subscribe", b"x" * 1000,
    ):  # fmt: skip
        with socket.socket(socket.AF_UNIX) as connection:
            connection.connect(str(station.socket_path))
            connection.sendall(line)
            connection.shutdown(socket.SHUT_WR)
            with connection.makefile("rb") as answers:
                answers.readline()
    make_ready(station)


def test_who_leaves_abandons_what_is_not_ordered(
    fleet: FlownFleet, new_station: NewStation
) -> None:
    station = new_station(fleet.fleet_toml)
    make_ready(station)
    takeoff = station.begin(Takeoff(interval_s=60.0))
    takeoff.progress("r2")
    takeoff.leave()
    station.wait_for(lambda p: not p.running and fleet.flown[2].state is _S.HOLD)
    assert [robot.state for robot in fleet.flown[:2]] == [_S.PREFLIGHT] * 2
    # A hold ends a takeoff, too, and then land is just as quick.
    takeoff = station.begin(Takeoff(interval_s=60.0))
    takeoff.progress("r1")
    done(station.command(SafetyCommand("hold")))
    assert not_done(takeoff.report())["r0"] is ResultCode.ABANDONED
    done(station.command(SafetyCommand("land", wait=True)))


def test_the_end_of_a_station(fleet: FlownFleet, new_station: NewStation) -> None:
    station = new_station(fleet.fleet_toml)
    assert station.end(signal.SIGINT) == 0
    station.start()
    fly(station)
    assert station.process is not None
    station.process.send_signal(signal.SIGINT)
    station.wait_for(lambda _: "hold after 3 s" in station.log.read_text())
    assert station.end(signal.SIGINT) == 0
    assert not station.socket_path.exists()
    station.start()
    station.wait_for(lambda p: p.ground and all_heard(p))
    assert station.process is not None
    # Its terminal is closed, which is no reason to leave robots in the air alone.
    station.process.send_signal(signal.SIGHUP)
    # They are in the air for as long as it has something to say.
    for robot in fleet.flown:
        robot.sink_slowly()
    done(station.command(SafetyCommand("land")))
    for robot in fleet.flown:
        robot.hurry()
    assert station.process.wait(PATIENCE_S) == 0
    assert {robot.state for robot in fleet.flown[:3]} == {_S.LANDED}
    station.start()
    assert station.end(signal.SIGTERM) == 0
    station.start()
    # What is left of a station that was killed is in nobody's way.
    station.kill()
    assert station.socket_path.exists()
    station.start()
    subscribed = station.subscribed()
    next(subscribed)
    station.kill()
    with pytest.raises(client.GroundError, match="has ended"):
        list(subscribed)


@pytest.mark.alone
def test_many_robots(tmp_path: Path, new_station: NewStation) -> None:
    with FlownFleet(tmp_path, 20) as fleet:
        station = new_station(fleet.fleet_toml)
        station.wait_for(lambda p: all(robot.fresh for robot in p.robots))
        # It never reads.
        with socket.socket(socket.AF_UNIX) as late:
            late.connect(str(station.socket_path))
            late.sendall(b"subscribe\n")
            fly(station)
            done(station.command(SafetyCommand("hold")))
        # Maps have no hurry on the radio.
        station.wait_for(
            lambda _: (
                {t.robot for t in station.told() if isinstance(t, Explored)}
                == set(station.setup().robots)
            )
        )
        assert any(isinstance(t, GroundEvent) and t.kind == "result" for t in station.told())
