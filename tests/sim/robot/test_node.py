"""What a robot's node tells of its program, its computer and its radio, at its own steps."""

import math
from collections import Counter
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import pytest

from edge.identity.envelope import OVERHEAD_BYTES
from edge.identity.guard import Unguarded
from edge.messages.codes import CheckCode, Reason, ReasonCode
from edge.messages.topics import MESSAGE, STATE, Topic
from edge.robot.pac import message_bytes
from lpac.sim.fleet.robots import SimulatedRobot
from tests.said import codes, lines_said
from tests.sim.ground.field import a_field

COMPUTER = Reason(ReasonCode.DESCRIPTORS_SHORT, "900 of 1024 descriptors are in use")


def node_is(**fields: Any) -> Callable[[SimulatedRobot], None]:
    return lambda robot: vars(robot.node).update(fields)


def hears_nonsense(robot: SimulatedRobot) -> None:
    assert robot.node is not None
    robot.node.subscriptions[STATE]("ground/0/state", Unguarded(1).seal(STATE, b"?"))


def watchdog_dies(robot: SimulatedRobot) -> None:
    assert robot.watchdog is not None
    robot.watchdog.die()


@pytest.mark.parametrize(
    ("befalls", "alarm", "check"),
    [
        (node_is(identity_problem="no room"), ReasonCode.IDENTITY_NOT_WRITTEN, None),
        (node_is(host_alarms=(COMPUTER,)), ReasonCode.DESCRIPTORS_SHORT, None),
        (hears_nonsense, ReasonCode.GROUND_NOT_UNDERSTOOD, None),
        (SimulatedRobot.fill_disk, ReasonCode.LOG_NOT_WRITTEN, None),
        (watchdog_dies, ReasonCode.WATCHDOG_ENDED, CheckCode.WATCHDOG_ENDED),
    ],
)
def test_what_befalls_program_or_computer_is_an_alarm(
    befalls: Callable[[SimulatedRobot], None], alarm: ReasonCode, check: CheckCode | None
) -> None:
    robot = a_field(1, "ready").robots[0]
    node = robot.program.node
    assert node is not None and robot.said.ready and not robot.said.alarms
    befalls(robot.program)
    node.control_step()
    node.preflight_step()
    said = node.status_step({})
    assert codes(said.alarms) == [alarm]
    assert codes(said.failed_checks) == ([] if check is None else [check])
    assert said.ready is (check is None)


def test_a_sensor_that_shows_nothing_is_said_once_and_keeps_the_robot_down() -> None:
    field = a_field(1, "ready")
    node = field.robots[0].program.node
    assert node is not None
    node._pac.sensor = SimpleNamespace(view=lambda _: None)
    with lines_said() as lines:
        field.run(5.0)
    (line,) = (line for line in lines if "result not used" in line["event"])
    assert line["why"] == "sensor: it shows nothing"
    (check,) = field.robots[0].said.failed_checks
    assert check.code is CheckCode.NO_FRESH_ANSWER and line["why"] in check.text


def test_what_it_publishes_and_logs_in_ten_seconds_of_flight() -> None:
    field = a_field(2, "flying")
    robot = field.robots[0]
    node, other = (each.program.node for each in field.robots)
    assert node is not None and other is not None
    published, last = Counter[str](), dict[str, bytes]()
    logged: dict[str, Mapping[str, Any]] = {}
    publish = node._publish

    def count(topic: Topic, data: bytes) -> None:
        published[topic.name] += 1
        last[topic.name] = data
        publish(topic, data)

    def record(topic: str, unix_time_s: float, message: Mapping[str, Any]) -> None:
        logged[topic] = message

    node._publish = count  # type: ignore[method-assign]
    robot.program._disk.record = record  # type: ignore[method-assign]
    field.run(10.0)
    assert published == {"message": 20, "status": 20, "explored": 10}
    said = robot.said
    assert said.heading_rad is not None and said.origin is not None
    # Right of the mission's heading is x.
    right_rad = said.heading_rad - math.radians(said.origin.heading_deg)
    yaw_rad = logged["/pose"]["yaw_rad"]
    assert (math.cos(yaw_rad), math.sin(yaw_rad)) == pytest.approx(
        (math.sin(right_rad), math.cos(right_rad))
    )
    assert 0.0 < logged["received"]["age_s"] < 0.1
    assert said.remote_control is None, "there is none to lose"
    # Its neighbour hears the same.
    (beacon,) = (heard.beacon for heard in other._pac.table.beacons(field.now_s, 1.0))
    assert (beacon.state, beacon.armed, beacon.system_id) == (said.state, True, said.system_id)
    assert beacon.gps_accuracy_m == pytest.approx(said.gps_accuracy_m, abs=0.01)
    assert beacon.flown_s == pytest.approx(said.flown_s, abs=1.0)
    # Whose it is its key tells; what is no beacon is a stranger's.
    for robot_id, data in ((5, last["message"]), (6, b"?")):
        sealed = node._guard.seal(MESSAGE, data)
        other.subscriptions[MESSAGE](f"robot/{robot_id}/message", sealed)
    assert [h.beacon.robot_id for h in other._pac.table.beacons(field.now_s, 1.0)] == [0, 5]
    assert other._inbox.unreadable_robots(field.now_s) == (6,)
    # What is new is said at once, and once.
    published.clear()
    node.identity_problem = "no room"
    node.status_step({})
    node.status_step({})
    assert published == {"status": 1}
    # Neighbours hear where it is from a robot whose policy hangs.
    robot.program.loops["policy"].hang(60.0)
    field.run(1.0)
    published.clear()
    field.run(10.0)
    assert published["message"] == 10


def test_on_the_ground_it_says_as_much_as_in_flight() -> None:
    """The radio is then tested on the ground with the load of a flight."""
    node = a_field(1, "ready").robots[0].program.node
    assert node is not None
    sizes: list[int] = []
    node._publish = lambda topic, data: sizes.append(len(data))  # type: ignore[method-assign]
    node.policy_step()
    least_bytes, _ = message_bytes(node._pac._policy, node._pac._parameters.payload)
    assert sizes[0] + OVERHEAD_BYTES >= least_bytes
