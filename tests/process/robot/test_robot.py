"""The robot's program as a process: `lpac robot run`, a simulated vehicle, and a ground."""

import dataclasses
import json
import os
import signal
import socket
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from edge.core.fence import Fence
from edge.drivers.log_reader import read as read_log
from edge.drivers.zenoh_link import ZenohLink
from edge.flight.failsafe import PARAMETERS
from edge.identity.guard import Sender, Unguarded
from edge.messages.codes import CheckCode, ReasonCode, RefusalCode, texts
from edge.messages.mission import (
    FlightState,
    OrderKind,
    Place,
    RobotStatus,
    explored_from_bytes,
    world_id,
)
from edge.messages.topics import EXPLORED
from edge.policy.bundle import Bundle, make_bundle, write_bundle
from lpac.analysis.worlds import format_world, random_features
from lpac.ground.station.protocol import (
    NextTrial,
    Resume,
    RobotCommand,
    SafetyCommand,
    SetPlaces,
    SetWorld,
    Start,
    TakeCommand,
)
from lpac.sim.px4.modes import Px4Mode
from tests.raw_ground import RawGround
from tests.robot_rig import (
    NAME,
    ORIGIN,
    Changes,
    Program,
    Rig,
    horizontal_speed_m_s,
    lpac_robot,
    new_vehicle,
    program,
    rig,
)
from tests.said import codes, why
from tests.unit.policy.test_bundle import scaled, with_files

pytestmark = pytest.mark.real_time

PARAM_REQUEST_READ = 20  # MAVLink's message id
# Nothing here takes so long unless it is broken.
PATIENCE_S = 120.0
# An exit code of 0 says that the program ended by itself: after 2.9 s its own timer would kill it.


def test_a_day_of_one_robot(tmp_path: Path) -> None:
    """It flies, lands, flies again, is ended in flight, started in flight, and taken back."""
    vehicle = new_vehicle()
    with rig(tmp_path, vehicle) as made:
        with program(made) as first:
            made.take_off()
            second = lpac_robot("run", "--config", made.config_path)
            assert second.returncode == 1
            (line,) = second.stderr.splitlines()
            assert line == (
                f"lpac: robot 3 of fleet {made.config.fleet} is in use by process "
                f"{first.process.pid} on this machine: stop that first"
            )
            fly_a_mission(made, "a")
            # The ground's link and the one that hears the robot here may be behind one another.
            made.do(SafetyCommand("land", wait=True))
            made.wait_for_state(FlightState.LANDED)
            assert not vehicle.armed

            made.take_off()
            fly_a_mission(made, "b")
            assert first.end(signal.SIGTERM) == 0
        assert made.vehicle_is(lambda v: v.mode is Px4Mode.HOLD and horizontal_speed_m_s(v) < 0.2)
        assert vehicle.armed

        with program(made) as again:
            made.wait(lambda status: status.state is FlightState.PILOT and status.uptime_s > 3.0)
            assert vehicle.mode is Px4Mode.HOLD
            assert ReasonCode.ARMED_BEFORE in codes(made.status.alarms)
            made.do(RobotCommand("rejoin", (NAME,)))
            made.wait_for_state(FlightState.HOLD)
            assert made.vehicle_is(lambda v: v.mode is Px4Mode.OFFBOARD)
            made.do(SafetyCommand("land"))
            made.wait_for_state(FlightState.LANDED)
            assert again.end(signal.SIGINT) == 0
    look_into_the_logs(tmp_path / "logs")
    assert "Traceback" not in first.log.read_text()


def fly_a_mission(made: Rig, trial: str) -> None:
    made.do(NextTrial(trial))
    made.do(Start())
    made.wait(lambda status: status.trial == trial and status.state is FlightState.MISSION)
    goes_on_until(made, lambda: made.vehicle_is(lambda v: horizontal_speed_m_s(v) > 0.3, 5.0))
    assert all(loop.failures == 0 for loop in made.status.loops.values())
    assert made.status.message_counts["accepted"] == 0
    made.do(SafetyCommand("hold"))
    made.wait_for_state(FlightState.HOLD)
    made.do(Resume())
    made.wait_for_state(FlightState.MISSION)


def goes_on_until(made: Rig, reached: Callable[[], bool]) -> None:
    """It flies its mission, started again where a machine that held it up let it hold."""
    until_s = time.monotonic() + 120.0
    while not reached():
        assert time.monotonic() < until_s, made.status
        if made.status.state is FlightState.HOLD:
            made.do(Start())
        time.sleep(0.1)


FENCE = Fence(((0.0, 0.0), (30.0, 0.0), (30.0, 30.0), (0.0, 30.0)), 1.5, 2.0, 28.0)
PLACE = Place(slot=1, landing_point_m=(14.0, 12.0))
WORLD = format_world(random_features(np.random.default_rng(1), 10, 512))
# One look of the sensor, 64 of the world's 512 cells wide, on a raster of 64 x 64.
ONE_LOOK = 64


def test_what_the_ground_sets_is_taken_up_on_the_ground_and_kept_in_flight(tmp_path: Path) -> None:
    vehicle = new_vehicle(GF_MAX_VER_DIST=25)
    explored = [0]
    with (
        rig(tmp_path, vehicle) as made, program(made), listening(made, explored),
        RawGround(made.config.fleet, made.config.link.listen, made.listener) as eve,
    ):  # fmt: skip
        made.enable()
        tells_where_it_stands(made)
        obeys_only_who_commands(made, eve)
        refuses_what_does_not_fit(made, eve)

        # Of eve's state the fence is right.
        made.do(TakeCommand())
        made.do(SetPlaces({NAME: PLACE}))
        made.do(SetWorld(WORLD, "w.env"))
        made.wait(lambda status: status.world_id == world_id(WORLD) and status.ready)
        assert made.status.fence == FENCE
        assert (made.status.slot_height_m, made.status.landing_point_m) == (9.5, (14.0, 12.0))
        assert made.status.not_taken == ()
        # It was below the new ceiling.
        assert made.vehicle_is(lambda v: v.parameters["GF_MAX_VER_DIST"] == 0)
        made.take_off()
        assert made.vehicle_is(lambda v: abs(-v.position_m[2] - 9.5) < 1.0)
        keeps_what_it_has_in_flight(made, eve)
        made.do(TakeCommand())

        made.do(NextTrial("a"))
        made.do(Start())
        goes_on_until(made, lambda: explored[-1] > 1.3 * ONE_LOOK)
        assert refused(made, "disarm") is RefusalCode.IN_THE_AIR
        made.do(RobotCommand("pilot", (NAME,)))
        assert made.vehicle_is(lambda v: v.mode is Px4Mode.HOLD)
        pilot = FlightState.PILOT, ReasonCode.GIVEN_TO_PILOT
        made.wait(lambda status: (status.state, status.reason.code) == pilot)
        made.do(RobotCommand("rejoin", (NAME,)))
        made.wait_for_state(FlightState.HOLD)
        made.do(SafetyCommand("land"))
        made.wait_for_state(FlightState.LANDED)
        assert explored[-1] > 1.3 * ONE_LOOK
        made.do(NextTrial("b"))
        made.wait(lambda status: status.trial == "")
        wait_until(lambda: explored[-1] <= 1.3 * ONE_LOOK)

        # Without a word of the ground's, the configured fence and place count again.
        configured = made.config.fence, 5.0
        says(
            made, eve, lambda status: (status.fence, status.slot_height_m) == configured,
            fence=None, places={}, world_id=None,
        )  # fmt: skip
        made.do(TakeCommand())
        assert made.status.world_id == world_id(WORLD)
        assert refused(made, "disarm") is RefusalCode.NOT_ARMED
        with made.server.stepped:
            vehicle.arm(force=True)
        made.wait_for_state(FlightState.PILOT)
        made.do(RobotCommand("disarm", (NAME,)))
        assert made.vehicle_is(lambda v: not v.armed)
    told = [m["message"] for path in (tmp_path / "logs").glob("*.mcap")
            for _, _, m in read_log(path, "/log")]  # fmt: skip
    assert any("adopted from the ground" in text and world_id(WORLD) in text for text in told)


def tells_where_it_stands(made: Rig) -> None:
    status = made.wait(
        lambda status: (
            status.ready
            and status.policy_velocity_m_s is not None
            and status.feature_age_s is not None
        )
    )
    assert (status.fence, status.not_taken, status.in_air) == (made.config.fence, (), False)
    assert status.global_deg is not None
    assert status.position_m is not None
    place_m = ORIGIN.frame().relative_to(*status.global_deg).local_origin_m
    assert place_m[:2] == pytest.approx(status.position_m[:2], abs=1.5)
    assert status.hdop is not None
    assert status.neighbour_messages == {}
    assert status.ground_age_s is not None and status.ground_age_s < 3.0


def obeys_only_who_commands(made: Rig, eve: RawGround) -> None:
    assert why(eve.order("takeoff", made.status, "eve")) is RefusalCode.OTHER_COMMANDER


def says(
    made: Rig,
    eve: RawGround,
    condition: Callable[[RobotStatus], bool],
    world: str = "",
    **changes: Any,
) -> None:
    """Somebody else takes the command, and wants something else, until it shows."""
    told = made.ground.subscriber.snapshot.ground
    assert told is not None
    sequence = max(told.sequence, made.status.obeyed_sequence) + 10
    state = dataclasses.replace(told, sequence=sequence, operator="eve", **changes)
    eve.state_until(state, lambda statuses: 3 in statuses and condition(statuses[3]), world)


def refuses_what_does_not_fit(made: Rig, eve: RawGround) -> None:
    """It stays on the ground, as it was."""
    before = made.status
    outside = Place(slot=1, landing_point_m=(50.0, 12.0))
    unfit = [CheckCode.FENCE_OR_PLACE_UNFIT, CheckCode.WORLD_UNUSABLE]
    nonsense = "Nonsense 1 2"
    says(
        made, eve, lambda status: codes(status.not_taken) == unfit, nonsense,
        fence=FENCE, places={"3": outside}, world_id=world_id(nonsense),
    )  # fmt: skip
    # What is wrong with them is the fence's, and the world's, own text.
    told = texts(made.status.not_taken)
    assert "landing_point_m = [50.0, 12.0]" in told and "record 1 (Nonsense)" in told
    assert refused(made, "takeoff") is RefusalCode.NOT_READY
    assert (made.status.fence, made.status.world_id) == (before.fence, before.world_id)


def refused(made: Rig, kind: OrderKind) -> RefusalCode | None:
    refusal = made.refusal(kind)
    return None if refusal is None else refusal.code


def keeps_what_it_has_in_flight(made: Rig, eve: RawGround) -> None:
    """Whatever somebody wants who takes the command; a ground of ours would not."""
    # No world is any world.
    kept = [CheckCode.KEEPS_FENCE, CheckCode.KEEPS_PLACE]
    says(
        made, eve, lambda status: codes(status.not_taken) == kept,
        fence=None, places={}, world_id=None,
    )  # fmt: skip
    assert made.status.fence == FENCE
    assert refused(made, "start") is RefusalCode.NOT_TAKEN_UP
    says(
        made, eve, lambda status: status.not_taken == (),
        fence=FENCE, places={"3": PLACE}, world_id=world_id(WORLD),
    )  # fmt: skip


@contextmanager
def listening(made: Rig, explored: list[int]) -> Iterator[None]:
    """Meanwhile it is kept how many cells the robot says it has seen."""

    def count(_: str, data: bytes, __: Sender) -> None:
        explored.append(int(explored_from_bytes(data).sum()))

    with ZenohLink(
        fleet=made.config.fleet, listen=("tcp/127.0.0.1:0",), connect=made.config.link.listen,
        subscriptions=Unguarded(0).subscriptions({EXPLORED: count}),
    ):  # fmt: skip
        yield


def look_into_the_logs(folder: Path) -> None:
    """Everything that happened is in there, of all starts."""
    topics: Counter[str] = Counter()
    states: list[str] = []
    for path in sorted(folder.glob("*.mcap")):
        for topic, _, message in read_log(path):
            topics[topic] += 1
            if topic == "control":
                states.append(message["state"])
    assert {"perception", "policy", "control", "status", "vehicle", "order", "ground"} <= set(
        topics
    )
    assert {"/pose", "/log"} <= set(topics)
    seen = [
        state for state, before in zip(states, [None, *states], strict=False) if state != before
    ]
    assert seen[:6] == ["init", "idle", "preflight", "arming", "takeoff", "hold"]
    assert seen[-5:] == ["init", "pilot", "hold", "land", "landed"]


def test_it_can_be_ended_at_any_time_of_its_start(tmp_path: Path) -> None:
    with rig(tmp_path, new_vehicle()) as made:
        for moment in ("handles signals", "robot runs", "flight state"):
            assert any(ends_by_itself(made, moment) for _ in range(5)), moment


def ends_by_itself(made: Rig, moment: str) -> bool:
    """Whether it ends before its own timer ends it: on a busy machine loading takes longer."""
    with program(made) as starting:
        wait_until(partial(reached, starting, moment))
        for number in (signal.SIGTERM, signal.SIGINT):
            starting.process.send_signal(number)
        code = starting.process.wait(PATIENCE_S)
    starting.log.unlink()
    assert code in (0, -signal.SIGALRM)
    return code == 0


def reached(starting: Program, moment: str) -> bool:
    if moment != "handles signals":
        return f'"event": "{moment}"' in starting.log.read_text()
    status = Path(f"/proc/{starting.process.pid}/status").read_text()
    (caught,) = (line.split()[1] for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(caught, 16) >> (signal.SIGTERM - 1) & 1)


def wait_until(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


def test_a_vehicle_that_does_not_answer_holds_up_neither_status_nor_end(tmp_path: Path) -> None:
    with rig(tmp_path, new_vehicle()) as made:
        receive, asked = made.link.receive, Counter[int]()

        def deaf_while_it_is_read(datagram: bytes) -> None:
            asked[datagram[7]] += 1
            # Each parameter is asked for twice.
            if asked[PARAM_REQUEST_READ] <= len(PARAMETERS) + 5:
                receive(datagram)

        made.link.receive = deaf_while_it_is_read  # type: ignore[method-assign]
        with program(made) as running:
            made.enable()
            wait_until(lambda: asked[PARAM_REQUEST_READ] > len(PARAMETERS) + 5)
            made.wait(lambda status: codes(status.failed_checks) == [CheckCode.CHECKS_RUNNING])
            assert running.end(signal.SIGTERM) == 0


HANGING = """
import pathlib, sys, time
from edge.robot.control import FlightControl
tick = FlightControl.tick
def hang(self, now_s):
    while pathlib.Path(sys.argv[-1]).with_name("hang").exists():
        time.sleep(0.1)
    return tick(self, now_s)
FlightControl.tick = hang
import lpac.cli.main
lpac.cli.main.main()
"""


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """Where a robot's program that is started now tells its news."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(PATIENCE_S)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield listening


def news(systemd: socket.socket, condition: Callable[[list[str]], object]) -> list[str]:
    """The first assignments that are so."""
    while not condition(assignments := systemd.recv(4096).decode().split("\n")):
        pass
    return assignments


def described(status: str) -> dict[str, Any]:
    """What the program says of itself in a status line."""
    said: dict[str, Any] = json.loads(status.removeprefix("STATUS="))
    return said


def test_a_control_loop_that_hangs_in_flight_lets_the_vehicle_hold_and_the_program_end(
    tmp_path: Path, systemd: socket.socket
) -> None:
    vehicle = new_vehicle()
    with rig(tmp_path, vehicle) as made:
        command = [sys.executable, "-c", HANGING, "robot", "run", "--config", str(made.config_path)]
        with program(made, command) as hanging:
            status, *others = news(systemd, lambda told: "READY=1" in told)
            assert others == ["READY=1", "WATCHDOG=1"]
            assert described(status)["robot_id"] == 3 and described(status)["link"]
            assert all(loop["ticks"] > 0 for loop in described(status)["loops"].values())

            made.take_off()
            fly_a_mission(made, "a")
            (tmp_path / "hang").touch()
            assert made.vehicle_is(lambda v: v.mode is Px4Mode.HOLD)
            # A busy machine may have held up the loop for a moment on the ground.
            status, *others = news(
                systemd, lambda told: "WATCHDOG=1" not in told and described(told[0])["armed"]
            )
            assert others == ["READY=1"]
            assert hanging.end(signal.SIGTERM) == 0
            news(systemd, lambda told: told == ["STOPPING=1"])
        assert vehicle.armed
        assert vehicle.mode is Px4Mode.HOLD


def test_a_hung_program_that_systemd_restarts_in_flight_leaves_the_vehicle_in_hold_and_lands_it(
    tmp_path: Path,
) -> None:
    vehicle = new_vehicle()
    with rig(tmp_path, vehicle, changes={"flight": {"hover_land_s": 12.0}}) as made:
        with program(made) as hanging:
            made.take_off()
            hanging.process.send_signal(signal.SIGSTOP)
            assert made.vehicle_is(lambda v: v.mode is Px4Mode.HOLD)
            # As systemd does it.
            for number in (signal.SIGABRT, signal.SIGCONT):
                hanging.process.send_signal(number)
            assert hanging.process.wait(PATIENCE_S) == -signal.SIGABRT
        former = made.status.boot_nonce
        with program(made):
            made.wait(
                lambda status: (
                    status.boot_nonce != former
                    and status.state is FlightState.PILOT
                    and status.uptime_s > 2.0
                )
            )
            assert vehicle.armed
            assert vehicle.mode is Px4Mode.HOLD
            assert horizontal_speed_m_s(vehicle) < 0.2
            # Nobody answers.
            made.wait(lambda status: status.reason.code is ReasonCode.NOBODY_ANSWERED)
            assert made.vehicle_is(lambda v: v.landed and not v.armed)


def test_ended_in_flight_it_lands_if_configured_to(tmp_path: Path) -> None:
    vehicle = new_vehicle()
    with rig(tmp_path, vehicle, changes={"": {"on_stop": "land"}}) as made:
        with program(made) as flying:
            made.take_off()
            assert flying.end(signal.SIGTERM) == 0
        assert vehicle.mode is Px4Mode.LAND
        ended_s = vehicle.time_s
        assert made.vehicle_is(lambda v: not v.armed)
        # The watchdog has not interrupted it.
        assert Px4Mode.HOLD not in {truth.mode for truth in vehicle.truth if truth.time_s > ended_s}


def test_a_robot_with_an_altered_policy_says_so_and_does_not_arm(
    tmp_path: Path, shipped_bundle: Bundle
) -> None:
    graph = scaled(shipped_bundle.files["action.onnx"], first_weight(shipped_bundle), slice(None))
    files = with_files(shipped_bundle, action__onnx=graph)
    write_bundle(make_bundle(shipped_bundle.manifest, files), tmp_path / "altered")
    vehicle = new_vehicle()
    changes = {"policy": {"bundle": "altered"}}
    with rig(tmp_path, vehicle, changes=changes) as made, program(made):
        made.enable()
        made.wait_for_state(FlightState.PREFLIGHT)
        # All else is well by then.
        problem = "action.onnx, swarm did not reproduce the bundle's golden"
        unverified = [CheckCode.BUNDLE_NOT_VERIFIED]
        made.wait(lambda status: codes(status.failed_checks) == unverified)
        assert problem in texts(made.status.failed_checks)
        assert refused(made, "takeoff") is RefusalCode.NOT_READY
        assert not made.status.ready
    assert not any(truth.armed for truth in vehicle.truth)


def first_weight(bundle: Bundle) -> str:
    return str(onnx.load_from_string(bundle.files["action.onnx"]).graph.initializer[0].name)


def test_without_a_vehicle_and_a_log_it_runs_and_says_what_is_missing(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    changes: Changes = {"autopilot": {"system_id": 9}, "log": {"folder": "file"}}
    with rig(tmp_path, new_vehicle(), changes=changes) as made, program(made) as running:
        made.enable()
        status = made.wait(
            lambda status: (
                status.uptime_s > 3.0
                and CheckCode.OTHER_AUTOPILOT in codes(status.failed_checks)
                and ReasonCode.LOG_NOT_WRITTEN in codes(status.alarms)
            )
        )
        assert status.state is FlightState.INIT
        assert running.end(signal.SIGTERM) == 0


def test_it_flies_on_when_nobody_reads_what_it_prints(tmp_path: Path) -> None:
    with rig(tmp_path, new_vehicle()) as made:
        reader, writer = os.pipe()
        with program(made, output=writer) as running:
            os.close(writer)
            os.close(reader)
            made.take_off()
            assert all(loop.failures == 0 for loop in made.status.loops.values())
            assert running.end(signal.SIGTERM) == 0


def test_two_programs_that_say_they_are_one_robot_see_each_other(tmp_path: Path) -> None:
    """Not on one machine, which refuses the second: here it calls its fleet's link by itself."""
    with rig(tmp_path, new_vehicle()) as made, program(made):
        made.enable()
        made.wait(lambda status: status.ready)
        with ZenohLink(
            fleet=made.config.fleet, robot_id=3, listen=("tcp/127.0.0.1:0",),
            connect=made.config.link.listen,
        ):  # fmt: skip
            alarm = ReasonCode.DUPLICATE_ID
            made.wait(lambda status: alarm in codes(status.alarms) and not status.ready)
        made.wait(lambda status: status.ready and not status.alarms)
