"""`lpac ground` beside the simulator, and who only listens to robots."""

from pathlib import Path

import pytest

from edge.drivers.zenoh_link import ZenohLink
from edge.identity.guard import Unguarded
from edge.messages.topics import STATUS
from lpac.ground.station.client import GroundError, socket_path
from lpac.ground.station.protocol import Enable, ProblemCode, ResultCode, SetOrigin
from lpac.sim.fleet.ground import GroundProgram
from lpac.sim.fleet.layout import ORIGIN
from lpac.sim.fleet.listener import FleetListener
from lpac.sim.fleet.processes import Fleet
from lpac.sim.ports import free_ports
from lpac.sim.scenario import Scenario
from tests.conftest import SHIPPED
from tests.said import not_done, problem


def test_it_is_a_ground_as_any_other_until_it_ends(tmp_path: Path) -> None:
    fleet = Fleet(Scenario(robots=2), tmp_path, SHIPPED)
    left = socket_path(fleet.name).parent
    with GroundProgram(fleet.fleet_toml, fleet.name) as ground:
        assert [robot.name for robot in ground.subscriber.snapshot.robots] == ["r0", "r1"]
        assert ground.subscriber.setup.operator == "sim" and ground.running
        assert problem(ground.command(Enable())) is ProblemCode.NO_ORIGIN
        assert not_done(ground.command(SetOrigin(ORIGIN))) == dict.fromkeys(
            ("r0", "r1"), ResultCode.NOT_HEARD
        )
        assert list(left.glob(f"lpac-ground-{fleet.name}.*"))
        ground.kill()
        assert not ground.running
        with pytest.raises(GroundError):
            ground.command(Enable())
    assert not list(left.glob(f"lpac-ground-{fleet.name}.*"))


def test_one_that_does_not_start_says_why(tmp_path: Path) -> None:
    with pytest.raises(GroundError, match=r"does not start: lpac: .*fleet\.toml: "):
        GroundProgram(tmp_path / "fleet.toml", "nowhere").__enter__()


def test_a_status_that_is_none_is_said_and_left_out() -> None:
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    said: list[str] = []
    with (
        ZenohLink(fleet="test", robot_id=3, listen=(endpoint,)) as robot,
        FleetListener(fleet="test", connect=(endpoint,), report=said.append) as heard,
    ):

        def is_said(_: object) -> bool:
            robot.publish(STATUS, Unguarded(1).seal(STATUS, b'{"robot_id": "three"}'))
            return bool(said)

        assert heard.wait_for(is_said, 60.0)
        assert heard.statuses() == {} and heard.history(3) == ()
    assert said[0].startswith("a status is malformed: ")
