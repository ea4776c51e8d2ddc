"""Faults in the air, each with what docs/safety.md says of it, judged by the vehicles' own logs.

One fleet takes off once and flies its mission; each test takes a robot of its own. The lowest fly
to their end first, so that nobody lands through another's height.
"""

import json
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh

from edge.core.mission import FlightState
from edge.core.wire import Rejection
from sim.fleet import ORIGIN, Fleet, FleetScenario
from tests.conftest import SHIPPED
from tests.sim.fault_rig import FaultRig, FaultyRobot, speed_m_s

KILLED, NO_GPS, EMPTY, LOW, MANY_FAULTS, FAULTY, STOPPED = range(7)
# Its vehicle is another, its robot id that of STOPPED.
TWIN = 7

AT_REST_M_S = 0.2

_S = FlightState


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FaultRig]:
    """The fleet in its mission; before that, that two programs of one robot id cannot take off."""
    folder = tmp_path_factory.mktemp("faults")
    fleet = Fleet(FleetScenario(robots=8, seed=0), folder, SHIPPED)
    programs = list(fleet.robots)
    for faulty in (FAULTY, TWIN):
        programs[faulty] = FaultyRobot(faulty, programs[faulty].folder)
    fleet.robots = tuple(programs)
    change_config(fleet, TWIN, f"robot_id = {TWIN}", f"robot_id = {STOPPED}")
    change_config(fleet, STOPPED, 'rc = "none"', 'rc = "pilot"')
    with fleet:
        rig = FaultRig(fleet, range(7))
        rig.script("assemble")
        neither_of_two_with_one_id_takes_off(rig)
        for step in ("preflight", "takeoff", "start"):
            rig.script(step)
        yield rig


def change_config(fleet: Fleet, robot: int, before: str, after: str) -> None:
    path = fleet.robots[robot].folder / "robot.toml"
    text = path.read_text()
    assert text.count(before) == 1
    path.write_text(text.replace(before, after))


def neither_of_two_with_one_id_takes_off(rig: FaultRig) -> None:
    operator, twin = rig.operator, rig.fleet.robots[TWIN]
    operator.enable(ORIGIN)
    text = f"another program says that it is robot {STOPPED}"

    def both_say_so(_: object) -> bool:
        told = {heard.status.boot_nonce: heard.status for heard in operator.history(STOPPED)}
        return len(told) == 2 and all(
            status.state is _S.PREFLIGHT
            and any(check.startswith(text) for check in status.failed_checks)
            and text in status.alarms
            for status in told.values()
        )

    assert operator.wait_for(both_say_so, 60.0), rig.told()

    def both_refuse(_: object) -> bool:
        # Each of them also answers orders that are meant for the other.
        assert not rig.order("takeoff", STOPPED).accepted
        refused = {
            heard.status.boot_nonce
            for heard in operator.history(STOPPED)
            for answer in heard.status.orders
            if text in answer.reason
        }
        return len(refused) == 2

    assert operator.wait_for(both_refuse, 60.0), rig.told()
    twin.send_signal(signal.SIGTERM)
    assert twin.wait(10.0) == 0
    assert not any(entry.armed for v in (STOPPED, TWIN) for entry in rig.truth(v, 0.0))


def test_a_stopped_program_and_its_return(rig: FaultRig) -> None:
    robot, process = STOPPED, rig.fleet.robots[STOPPED]
    rig.wait_moving(robot)
    with rig.others_go_on(robot):
        process.send_signal(signal.SIGSTOP)
        began_s = rig.now_s(robot)
        rig.wait_time(robot, began_s + 4.0)
        silent_s = rig.last_setpoint_s(robot)
        assert silent_s < began_s + 0.5
        # Who is not heard is forgotten.
        assert all(
            str(robot) not in rig.status(other).neighbour_ages_s for other in rig.flying
        ), rig.told()
        process.send_signal(signal.SIGCONT)
        rig.wait_time(robot, began_s + 6.0)
        status = rig.wait_state(robot, _S.HOLD)
        assert "control was silent" in status.alarms[0]
        rig.wait_vehicle(robot, lambda v: v.mode.name == "OFFBOARD")
        rig.wait_time(robot, began_s + 12.0)
        assert rig.status(robot).state is _S.HOLD
        assert rig.max_speed_m_s(robot, silent_s + 1.5) < AT_REST_M_S
        assert rig.operator.wait_for(
            lambda s: all(str(robot) in s[other].neighbour_ages_s for other in rig.flying), 10.0
        )


def test_a_killed_program(rig: FaultRig) -> None:
    robot, process = KILLED, rig.fleet.robots[KILLED]
    rig.wait_moving(robot)
    with rig.others_go_on(robot, lost=True):
        process.send_signal(signal.SIGKILL)
        assert process.wait(10.0) == -signal.SIGKILL
        began_s = rig.now_s(robot)
        rig.wait_time(robot, began_s + 3.0)
        silent_s = rig.last_setpoint_s(robot)
        assert all(str(robot) not in rig.status(other).neighbour_ages_s for other in rig.flying)
        rig.wait_down(robot)
    assert rig.max_speed_m_s(robot, silent_s + 2.0, axes=2) < AT_REST_M_S
