"""A fleet of real robot nodes under a real ground, on one simulated clock."""

import dataclasses
import itertools
import math
import re
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from edge.core import F64
from edge.core.part import PartError
from edge.drivers.log_reader import read
from edge.flight.failsafe import required
from edge.identity.guard import Unguarded
from edge.messages.codes import CheckCode, ReasonCode
from edge.messages.mission import FlightState
from edge.policy.bundle import load_bundle
from edge.policy.lpac.policy import LpacPolicy
from edge.robot.readiness import Checks
from lpac.analysis.examination import Examined, Wanted, examine
from lpac.analysis.flight import FlightRecord
from lpac.analysis.flight_replay import FlightReplay
from lpac.analysis.policy_replay import replay
from lpac.analysis.snapshot import FleetSnapshot, RobotSnapshot
from lpac.ground.procedure import Procedure, Until
from lpac.ground.script import ScriptListener, ScriptRun, load_script
from lpac.ground.site import Sites
from lpac.ground.station.protocol import (
    Enable,
    RobotCommand,
    SafetyCommand,
    SetOrigin,
    Start,
    Takeoff,
)
from lpac.sim.air import GROUND
from lpac.sim.fleet.clocked import fly_simulated
from lpac.sim.fleet.flight import FleetMoment
from lpac.sim.fleet.layout import ORIGIN, Settings
from lpac.sim.fleet.recorded import RecordingError
from lpac.sim.fleet.scripted import ScriptedFlight
from lpac.sim.fleet.simulated import SimulatedFleet, SimulatedGround
from lpac.sim.flight_summary import summary
from lpac.sim.points import SAMPLE_S
from lpac.sim.px4.modes import Px4Mode
from lpac.sim.px4.wire import MavlinkWire
from lpac.sim.px4.world import FencePolygon
from lpac.sim.scenario import Scenario
from tests.conftest import ROOT, SHIPPED
from tests.flown import PRECISE

DRONE_M = 0.5
# Of fleets to which something happens that has little to do with their policy.
SELDOM: Settings = {"rates": {"perception_hz": 2.0, "policy_hz": 2.0}}
STEP_S = 0.05


def a_fleet(folder: Path, seed: int = 3, robots: int = 3) -> SimulatedFleet:
    """As fleets are simulated."""
    return SimulatedFleet(Scenario(robots=robots, seed=seed), folder, SHIPPED)


def low_flight(robots: int, seed: int, duration_s: float) -> Scenario:
    """Robots that know where they are fly low, and are soon up and down."""
    return Scenario(robots=robots, seed=seed, duration_s=duration_s, errors=False, budget=PRECISE)


def a_low_fleet(folder: Path) -> SimulatedFleet:
    return SimulatedFleet(
        low_flight(2, 3, 60.0), folder, SHIPPED, settings=SELDOM, vehicle_step_s=STEP_S
    )


def all_are_ready(snapshot: FleetSnapshot) -> bool:
    return all(robot.status is not None and robot.status.ready for robot in snapshot.robots)


def to_ready(ground: SimulatedGround) -> Procedure[None]:
    """From the start to all robots ready to take off."""
    yield Until(lambda snapshot: all(robot.fresh for robot in snapshot.robots), 30.0)
    for request in (SetOrigin(ORIGIN), Enable()):
        report = yield request
        assert report.done, (request, report)
    ready = yield Until(all_are_ready, 60.0)
    assert ready, ground.snapshot


def to_mission(ground: SimulatedGround) -> Procedure[None]:
    """From the start to all robots in their mission."""
    yield from to_ready(ground)
    for request in (Takeoff(), Start()):
        report = yield request
        assert report.done, (request, report)


@cache
def _in_mission(for_a_pilot: bool = False) -> SimulatedFleet:
    settings: Settings = {**SELDOM, "failsafe": {"rc": "pilot" if for_a_pilot else "none"}}
    with tempfile.TemporaryDirectory() as folder:
        scenario = Scenario(robots=2, seed=3)
        fleet = SimulatedFleet(
            scenario, Path(folder), SHIPPED, settings=settings, vehicle_step_s=STEP_S
        )
    for each in fleet.vehicles:
        each.vehicle.rc_connected = for_a_pilot
    fleet.ground.carry_out(to_mission(fleet.ground))
    return fleet


def in_mission() -> SimulatedFleet:
    """Two robots that fly their mission."""
    return _in_mission().copy()


@cache
def _on_their_way(for_a_pilot: bool) -> SimulatedFleet:
    fleet = _in_mission(for_a_pilot).copy()
    fleet.ground.carry_out(_pass(8.0))
    return fleet


def states(fleet: SimulatedFleet) -> set[FlightState]:
    return {
        robot.status.state for robot in fleet.ground.snapshot.robots if robot.status is not None
    }


def all_are_down(fleet: SimulatedFleet) -> bool:
    return all(each.vehicle.landed and not each.vehicle.armed for each in fleet.vehicles)


def watch_separation(fleet: SimulatedFleet) -> list[float]:
    """The least true distance of two robots in the air, m, as time passes."""
    least_m: list[float] = []

    def look() -> None:
        airborne = [not each.vehicle.landed for each in fleet.vehicles]
        places_m: F64 = fleet.true_positions_m()[airborne]
        for i, place_m in enumerate(places_m):
            least_m.extend(np.linalg.norm(places_m[i + 1 :] - place_m, axis=1).tolist())

    fleet.schedule.every(0.1, look)
    return least_m


@pytest.mark.slow
def test_a_fleet_flies_its_mission_and_lands_on_its_pads(tmp_path: Path) -> None:
    fleet = a_fleet(tmp_path)
    apart_m = watch_separation(fleet)
    ground = fleet.ground
    ground.carry_out(to_mission(ground))
    assert states(fleet) == {FlightState.MISSION}
    before_m = fleet.true_positions_m()
    ground.carry_out(_pass(10.0))
    assert np.linalg.norm(fleet.true_positions_m() - before_m, axis=1).max() > 2.0
    assert ground.command(SafetyCommand("return", wait=True)).done
    ground.carry_out(_pass(0.5))  # The snapshot comes after the answer.
    assert states(fleet) == {FlightState.LANDED}
    for each, landing_m in zip(fleet.vehicles, fleet.layout.pads_m, strict=True):
        assert each.vehicle.landed and not each.vehicle.armed
        # Where it takes its pad to be: off by the receiver's error at most, there and back.
        place_m = fleet.layout.to_mission.local_to_mission(each.vehicle.position_m)
        assert np.linalg.norm(place_m[:2] - landing_m) < 6.0
    assert min(apart_m) > DRONE_M


def test_a_copy_flies_on_as_the_first_does_and_apart_from_it() -> None:
    fleet = in_mission()
    copies = [fleet.copy() for _ in range(3)]
    copies[0].vehicles[0].vehicle.wind_m_s = (3.0, 0.0, 0.0)
    copies[1].radio.air = dataclasses.replace(copies[1].radio.air, silent=frozenset({0, 1}))
    flown = []
    for each in (*copies, fleet):
        each.ground.carry_out(_pass(4.0))
        assert each.ground.command(SafetyCommand("hold")).done is (each is not copies[1])
        flown.append((each.true_positions_m().tobytes(), [e.text for e in each.ground.events]))
    assert flown[2] == flown[3]
    assert flown[0] != flown[3] != flown[1]


def test_whose_loop_hangs_is_held_and_whose_program_ends_lands() -> None:
    fleet = in_mission()
    ground = fleet.ground
    fleet.robots[0].loops["control"].hang(3.0)
    fleet.robots[1].stop()
    ground.carry_out(_pass(2.0))
    assert [each.vehicle.mode for each in fleet.vehicles] == [Px4Mode.HOLD, Px4Mode.LAND]
    ground.carry_out(_pass(3.0))
    status = fleet.robots[0].status
    assert status is not None
    assert (status.state, status.reason.code) == (FlightState.HOLD, ReasonCode.CONTROL_SILENT)
    assert ground.carry_out(_until(lambda _: all_are_down(fleet), 90.0))


def of_vehicle(**fields: Any) -> Callable[[SimulatedFleet], None]:
    """These fields of the first robot's vehicle are so from now on."""

    def change(fleet: SimulatedFleet) -> None:
        for name, value in fields.items():
            setattr(fleet.vehicles[0].vehicle, name, value)

    return change


def loop_hangs(name: str) -> Callable[[SimulatedFleet], None]:
    return lambda fleet: fleet.robots[0].loops[name].hang(60.0)


def left_to_hold(fleet: SimulatedFleet) -> None:
    fleet.vehicles[0].vehicle.set_mode(Px4Mode.HOLD)


def flown_by_a_pilot(fleet: SimulatedFleet) -> None:
    fleet.vehicles[0].vehicle.pilot()


def killed(fleet: SimulatedFleet) -> None:
    fleet.ground.node.begin(RobotCommand("kill", ("r0",)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "state", "reason"),
    [
        (of_vehicle(gps_lost=True), FlightState.LAND, ReasonCode.POSITION_LOST),
        (of_vehicle(battery_remaining=0.145), FlightState.LAND, ReasonCode.BATTERY_CRITICAL),
        (of_vehicle(battery_remaining=0.24), FlightState.RETURN, ReasonCode.BATTERY_LOW),
        (loop_hangs("policy"), FlightState.HOLD, ReasonCode.POLICY_STALE),
        (loop_hangs("perception"), FlightState.HOLD, ReasonCode.POLICY_STALE),
        (left_to_hold, FlightState.PILOT, ReasonCode.LEFT_OFFBOARD),
        (flown_by_a_pilot, FlightState.PILOT, ReasonCode.PILOT),
        (killed, FlightState.FAULT, ReasonCode.KILLED),
    ],
)
def test_a_robot_says_what_befell_it_and_the_other_flies_on(
    fault: Callable[[SimulatedFleet], None], state: FlightState, reason: ReasonCode
) -> None:
    fleet = _on_their_way(for_a_pilot=fault is flown_by_a_pilot).copy()
    fault(fleet)

    def reports_it(snapshot: FleetSnapshot) -> bool:
        return snapshot.robots[0].status is not None and snapshot.robots[0].status.state is state

    assert fleet.ground.carry_out(_until(reports_it, 10.0))
    status, other = (robot.status for robot in fleet.ground.snapshot.robots)
    assert status is not None and other is not None
    assert status.reason.code is reason and status.reason in status.alarms
    assert other.state is FlightState.MISSION
    # Nor does it fly on when it is ordered to.
    assert not fleet.ground.command(Start(("r0",))).done
    again = fleet.ground.snapshot.robots[0].status
    assert again is not None and again.state is not FlightState.MISSION


def test_a_receiver_that_repeats_itself_is_ignored_until_the_robot_has_landed() -> None:
    fleet = _on_their_way(for_a_pilot=False).copy()
    vehicle = fleet.vehicles[0].vehicle
    vehicle.receiver.stuck = True
    at_m, began_s = vehicle.position_m, vehicle.time_s

    def lands(snapshot: FleetSnapshot) -> bool:
        return snapshot.robots[0].status is not None and (
            snapshot.robots[0].status.state is FlightState.LAND
        )

    def is_down(_: FleetSnapshot) -> bool:
        return not vehicle.armed

    assert fleet.ground.carry_out(_until(lambda _: not vehicle.parameters["EKF2_GPS_CTRL"], 1.5))
    assert fleet.ground.carry_out(_until(lands, 4.0))
    assert vehicle.time_s - began_s <= 3.5
    status = fleet.ground.snapshot.robots[0].status
    assert status is not None and status.reason.code is ReasonCode.POSITION_LOST
    assert "repeats" in status.reason.text
    # It was changed by the robot itself, and no alarm reports it.
    assert ReasonCode.PX4_CHANGED not in {reason.code for reason in status.alarms}
    assert math.dist(vehicle.position_m[:2], at_m[:2]) < 5.0
    assert fleet.ground.carry_out(_until(is_down, 60.0))
    fleet.ground.carry_out(_pass(2.0))
    assert vehicle.parameters["EKF2_GPS_CTRL"] == 7


def gf_action_is(value: int) -> Callable[[SimulatedFleet], None]:
    def do(fleet: SimulatedFleet) -> None:
        fleet.vehicles[0].vehicle.parameters["GF_ACTION"] = value

    return do


def fence_is_cleared(fleet: SimulatedFleet) -> None:
    fleet.vehicles[0].vehicle.fence = ()


def fence_is_another(fleet: SimulatedFleet) -> None:
    vehicle = fleet.vehicles[0].vehicle
    (polygon,) = vehicle.fence
    vehicle.fence = (FencePolygon(True, polygon.vertices_deg[::-1]),)


def as_preflight_found_it(fleet: SimulatedFleet) -> bool:
    changed, other = (each.vehicle for each in fleet.vehicles)
    fences = [[polygon.vertices_deg for polygon in each.fence] for each in (changed, other)]
    return fences[0] == fences[1] and changed.parameters["GF_ACTION"] == 2


BY_SOMEBODY_ELSE = pytest.mark.parametrize(
    ("changed", "code"),
    [
        (gf_action_is(0), CheckCode.FAILSAFE_WRONG),
        (fence_is_cleared, CheckCode.FENCE_NOT_UPLOADED),
        (fence_is_another, CheckCode.FENCE_NOT_UPLOADED),
    ],
)


@BY_SOMEBODY_ELSE
def test_a_vehicle_that_others_change_on_the_ground_is_not_ready_until_it_is_set_back(
    changed: Callable[[SimulatedFleet], None], code: CheckCode, tmp_path: Path
) -> None:
    fleet = a_low_fleet(tmp_path)
    fleet.ground.carry_out(to_ready(fleet.ground))
    changed(fleet)

    def reports_why(snapshot: FleetSnapshot) -> bool:
        status = snapshot.robots[0].status
        checks = () if status is None else status.failed_checks
        return any(check.code is code and "somebody else" in check.text for check in checks)

    assert fleet.ground.carry_out(_until(reports_why, 3.0))
    assert not all_are_ready(fleet.ground.snapshot)
    assert fleet.ground.carry_out(_until(all_are_ready, 10.0))
    assert as_preflight_found_it(fleet)


@pytest.mark.slow
@BY_SOMEBODY_ELSE
def test_a_vehicle_that_others_change_in_flight_is_set_back(
    changed: Callable[[SimulatedFleet], None], code: CheckCode
) -> None:
    fleet = in_mission()
    changed(fleet)
    assert fleet.ground.carry_out(_until(reports_the_change, 5.0))
    fleet.ground.carry_out(_pass(3.0))
    assert as_preflight_found_it(fleet)
    # It still says so: somebody did it.
    assert reports_the_change(fleet.ground.snapshot)
    assert states(fleet) == {FlightState.MISSION}
    assert fleet.ground.command(SafetyCommand("land", wait=True)).done
    fleet.ground.carry_out(_pass(3.0))
    assert not reports_the_change(fleet.ground.snapshot)


def refused(name: str, value: float) -> None:
    raise OSError(f"parameter {name} = {value}: denied")


def not_uploaded(vertices_deg: object) -> None:
    raise OSError("fence upload: denied")


@pytest.mark.parametrize(
    ("changed", "cannot"),
    [
        (gf_action_is(0), {"set_parameter": refused}),
        (fence_is_cleared, {"upload_fence": not_uploaded}),
    ],
)
def test_a_vehicle_that_cannot_be_set_back_comes_home(
    changed: Callable[[SimulatedFleet], None], cannot: dict[str, Any]
) -> None:
    fleet = in_mission()
    vars(fleet.vehicles[0]).update(cannot)
    changed(fleet)
    assert fleet.ground.carry_out(_until(reports_the_change, 5.0))
    assert fleet.ground.carry_out(_until(returns_for_it, 6.0))
    other = fleet.ground.snapshot.robots[1].status
    assert other is not None and other.state is FlightState.MISSION


def test_who_may_not_set_parameters_comes_home_at_once(tmp_path: Path) -> None:
    settings: Settings = {**SELDOM, "failsafe": {"parameters": "refuse"}}
    fleet = SimulatedFleet(
        low_flight(2, 3, 60.0), tmp_path, SHIPPED, settings=settings, vehicle_step_s=STEP_S
    )
    for each in fleet.vehicles:
        for requirement in required("none", ceiling_m=30.0):
            if requirement.value_to_set is not None:
                each.vehicle.parameters[requirement.name] = requirement.value_to_set
    fleet.ground.carry_out(to_mission(fleet.ground))
    # Away from its landing point.
    fleet.ground.carry_out(_pass(5.0))
    gf_action_is(0)(fleet)
    assert fleet.ground.carry_out(_until(returns_for_it, 5.0))
    assert fleet.vehicles[0].vehicle.parameters["GF_ACTION"] == 0


def test_who_flies_by_hand_may_change_what_he_likes() -> None:
    fleet = _in_mission(for_a_pilot=True).copy()
    flown_by_a_pilot(fleet)
    fleet.ground.carry_out(_pass(3.0))
    gf_action_is(0)(fleet)
    assert fleet.ground.carry_out(_until(reports_the_change, 5.0))
    fleet.ground.carry_out(_pass(10.0))
    assert fleet.vehicles[0].vehicle.parameters["GF_ACTION"] == 0


def test_what_was_found_right_is_still_watched_after_the_autopilot_was_silent() -> None:
    fleet = in_mission()
    fleet.vehicles[0].vehicle.wire = MavlinkWire(loss=1.0)
    fleet.ground.carry_out(_pass(4.0))
    fleet.vehicles[0].vehicle.wire = MavlinkWire()
    fleet.ground.carry_out(_pass(1.0))
    gf_action_is(0)(fleet)
    assert fleet.vehicles[0].vehicle.armed
    assert fleet.ground.carry_out(_until(reports_the_change, 5.0))


def reports_the_change(snapshot: FleetSnapshot) -> bool:
    status = snapshot.robots[0].status
    alarms = () if status is None else status.alarms
    return any(alarm.code is ReasonCode.PX4_CHANGED for alarm in alarms)


def returns_for_it(snapshot: FleetSnapshot) -> bool:
    status = snapshot.robots[0].status
    return status is not None and (status.state, status.reason.code) == (
        FlightState.RETURN, ReasonCode.PX4_CHANGED,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wires", "code", "text"),
    [
        (
            (MavlinkWire(loss=0.2), MavlinkWire(loss=0.2)),
            ReasonCode.LINK_LOSES,
            r"(15|20|25)% of the autopilot's messages",
        ),
        (
            (MavlinkWire(twice=1.0), MavlinkWire(twice=1.0, late_s=(1.9, 2.1))),
            ReasonCode.LINK_TWICE,
            "MAVLink arrives twice",
        ),
    ],
)
def test_a_bad_link_to_the_autopilot_is_told(
    wires: tuple[MavlinkWire, MavlinkWire], code: ReasonCode, text: str
) -> None:
    """In flight, where the mission goes on, and before takeoff, where the robot is ready."""
    fleet = in_mission()
    for each, wire in zip(fleet.vehicles, wires, strict=True):
        each.vehicle.wire = wire
    # A little longer than what is counted together.
    fleet.ground.carry_out(_pass(12.0))
    for robot in fleet.ground.snapshot.robots:
        assert robot.status is not None and robot.status.state is FlightState.MISSION
        (alarm,) = (alarm for alarm in robot.status.alarms if alarm.code is code)
        assert re.match(text, alarm.text)
    fleet.ground.command(SafetyCommand("land", wait=True))
    fleet.ground.carry_out(_pass(12.0))
    for robot in fleet.ground.snapshot.robots:
        assert robot.status is not None and code in [alarm.code for alarm in robot.status.alarms]
        assert CheckCode.OTHER_VEHICLES not in [check.code for check in robot.status.failed_checks]


def test_programs_start_late_and_start_again(tmp_path: Path) -> None:
    scenario = Scenario(robots=2, seed=3)
    fleet = SimulatedFleet(
        scenario, tmp_path, SHIPPED, absent=1, settings=SELDOM, vehicle_step_s=STEP_S
    )
    ground = fleet.ground
    assert not ground.carry_out(_until_all(lambda robot: robot.fresh, 10.0))
    fleet.robots[1].start()
    ground.carry_out(to_mission(ground))
    # As by a loss of power, in flight: whoever comes back only looks.
    fleet.robots[0].start()
    ground.carry_out(_pass(5.0))
    texts = [e.text for e in ground.events if e.kind == "presence" and e.robot == "r0"]
    assert texts[-1] == "its program has restarted"
    assert fleet.robots[0].status is not None
    assert fleet.robots[0].status.state is FlightState.PILOT
    # A ground of the same computer knows what the one before said.
    assert ground.command(SafetyCommand("hold", robots=("r1",))).done
    again = fleet.join("operator")
    assert not ground.runs and not again.node.station.commands
    assert again.carry_out(_until_all(lambda robot: robot.fresh, 10.0))
    again.carry_out(_pass(3.0))
    assert again.node.station.commands and again.node.station.state is not None
    assert again.node.station.state.robot_safety_actions == {"1": "hold"}
    # Another one observes, also of the same name, on another computer.
    other = fleet.join("other")
    twin = SimulatedGround(again.setup, fleet.schedule, fleet.radio, -9, Unguarded(1))
    again.carry_out(_pass(5.0))
    assert (other.node.station.commands, other.node.station.election.commander) == (
        False,
        "operator",
    )
    assert again.node.station.commands and not twin.node.station.commands


def _until(condition: Callable[[FleetSnapshot], bool], at_most_s: float) -> Procedure[bool]:
    came: bool = yield Until(condition, at_most_s)
    return came


def _until_all(condition: Callable[[RobotSnapshot], bool], at_most_s: float) -> Procedure[bool]:
    came: bool = yield Until(lambda snapshot: all(map(condition, snapshot.robots)), at_most_s)
    return came


def test_robots_that_lose_the_ground_hold_and_land() -> None:
    fleet = in_mission()
    ground = fleet.ground
    robots = frozenset(range(len(fleet.robots)))
    cut = (frozenset({GROUND}), robots)
    fleet.radio.air = dataclasses.replace(fleet.radio.air, partition=cut)
    ground.carry_out(_pass(5.0))
    # The ground hears nothing of it: the vehicles tell.
    assert all(np.linalg.norm(each.vehicle.velocity_m_s) < 0.5 for each in fleet.vehicles)
    assert not any(each.vehicle.landed for each in fleet.vehicles)
    assert ground.carry_out(_until(lambda _: all_are_down(fleet), 60.0))
    ground.carry_out(_pass(3.0))  # A robot knows a little later than its vehicle.
    fleet.radio.air = dataclasses.replace(fleet.radio.air, partition=())
    ground.carry_out(_pass(3.0))
    # Heard again, and still enabled.
    assert states(fleet) == {FlightState.PREFLIGHT}
    assert not any(each.vehicle.armed for each in fleet.vehicles)


@pytest.mark.slow
def test_a_script_is_flown_on_the_simulated_clock_although_messages_are_lost(
    tmp_path: Path,
) -> None:
    fleet = a_low_fleet(tmp_path)
    fleet.radio.air = dataclasses.replace(fleet.radio.air, loss=0.3)
    path = tmp_path / "script.toml"
    path.write_text(
        f"""
        trials = 2
        before = [{{ do = "origin", latitude_deg = {ORIGIN.latitude_deg},
                     longitude_deg = {ORIGIN.longitude_deg}, heading_deg = {ORIGIN.heading_deg} }}]
        steps = [{{ do = "preflight" }}, {{ do = "takeoff" }},
                 {{ do = "mission", duration_s = 5 }}, {{ do = "return" }}]
        """.replace("\n                     ", " ").replace("\n                 ", " ")
    )
    sites = Sites(tmp_path / "fleet.toml")
    listener = _Listener()
    run = ScriptRun(load_script(path, sites), sites, fleet.ground, listener)
    fleet.ground.carry_out(run.fly())
    assert all_are_down(fleet)
    assert sum("mission" in name for name in listener.steps) == 2


def _pass(seconds: float) -> Procedure[None]:
    yield Until(lambda _: False, seconds)


class _Listener(ScriptListener):
    def __init__(self) -> None:
        self.steps: list[str] = []

    def step(self, name: str, at_most_s: float | None) -> None:
        self.steps.append(name)

    def line(self, text: str) -> None:
        pass

    def confirm(self, question: str) -> bool:
        return True


@pytest.mark.slow
def test_a_flight_tells_of_itself_and_is_the_same_twice(tmp_path: Path) -> None:
    def flown(name: str) -> FlightRecord:
        return fly_simulated(scenario, tmp_path / name, SHIPPED)

    scenario = Scenario(robots=2, seed=4, duration_s=10.0)
    flight, again = flown("first"), flown("again")
    for track, same in zip(flight.vehicles, again.vehicles, strict=True):
        np.testing.assert_array_equal(track.position_m, same.position_m)
    pads_m, others_m = (
        a_fleet(tmp_path / str(seed), seed, robots=2).true_positions_m() for seed in (5, 6)
    )
    assert (pads_m != others_m).any()
    assert flight.all_landed and flight.script.problem is None
    assert [change.state for change in flight.script.programs[0].changes][-4:] == [
        FlightState.MISSION, FlightState.RETURN, FlightState.LAND, FlightState.LANDED,
    ]  # fmt: skip
    assert min(map(flight.mission_share, flight.robots)) > 0.9
    assert flight.true_fence_margin_m > 0.0
    least = flight.true_separation
    assert least is not None and least.distance_m > DRONE_M
    figures = summary(scenario, flight)
    assert figures == summary(scenario, again)
    assert [each["command"] for each in figures["commands"]] == [
        "origin", "again", "enable", "takeoff", "start", "return",
    ]  # fmt: skip
    for each in figures["commands"]:
        assert each["problem"] is None
        assert each["results"] == dict.fromkeys(("r0", "r1"), "done")
    assert flight.normalized[-1] < 1.0


def test_who_flies_is_checked_once_a_second_and_who_has_landed_more_often(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = a_fleet(tmp_path, robots=1)
    ground, node = fleet.ground, fleet.robots[0].node
    assert node is not None
    readiness = node.readiness
    checked_at_s: list[float] = []
    check = readiness.checks

    def counted(now_s: float, *arguments: Any, **facts: Any) -> Checks:
        checked_at_s.append(now_s)
        return check(now_s, *arguments, **facts)

    monkeypatch.setattr(readiness, "checks", counted)
    ground.carry_out(to_mission(ground))
    checked_at_s.clear()
    ground.carry_out(_pass(10.0))
    assert 9 <= len(checked_at_s) <= 11
    assert ground.command(SafetyCommand("land", wait=True)).done
    checked_at_s.clear()
    ground.carry_out(_pass(10.0))
    assert 39 <= len(checked_at_s) <= 41


def test_a_takeoff_that_fails_brings_all_down_and_is_tried_again(tmp_path: Path) -> None:
    fleet = a_low_fleet(tmp_path)
    [_, low] = [each.vehicle for each in fleet.vehicles]
    lost = False

    def lose_gps_once() -> None:
        nonlocal lost
        climbing = low.armed and low.position_m[2] < -1.0
        if climbing and not lost:
            lost = low.gps_lost = True
        elif low.landed and not low.armed:
            low.gps_lost = False

    fleet.schedule.every(0.1, lose_gps_once)
    lines: list[str] = []
    flight = ScriptedFlight(fleet.ground, tmp_path / "fleet.toml", 2.0, report=lines.append)
    assert fleet.ground.carry_out(flight.fly()) is None
    assert lost and any(text.startswith("all take off again: ") for text in lines)
    takeoffs = [done.report.done for done in flight.commands if isinstance(done.request, Takeoff)]
    assert takeoffs == [False, True]
    assert all_are_down(fleet)


def test_a_flight_that_cannot_go_on_says_why_and_all_land(tmp_path: Path) -> None:
    fleet = a_low_fleet(tmp_path)
    flight = ScriptedFlight(fleet.ground, tmp_path / "fleet.toml", 10.0)

    def leave_offboard() -> None:
        if "mission" in flight.began_s:
            fleet.vehicles[0].vehicle.set_mode(Px4Mode.HOLD)

    fleet.schedule.every(0.1, leave_offboard)
    problem = fleet.ground.carry_out(flight.fly())
    # Nobody flies that one any more but its pilot.
    assert problem is not None and "r0: pilot" in problem
    assert [each.vehicle.landed for each in fleet.vehicles] == [False, True]


def test_a_vehicle_that_leaves_offboard_once_is_taken_back_and_flies_on(tmp_path: Path) -> None:
    fleet = a_low_fleet(tmp_path)
    flight = ScriptedFlight(fleet.ground, tmp_path / "fleet.toml", 10.0)
    seen: list[FlightState] = []

    def leave_offboard_once() -> None:
        status = fleet.ground.snapshot.robots[0].status
        if "mission" in flight.began_s and FlightState.PILOT not in seen:
            fleet.vehicles[0].vehicle.set_mode(Px4Mode.HOLD)
        if status is not None and seen[-1:] != [status.state]:
            seen.append(status.state)

    fleet.schedule.every(0.1, leave_offboard_once)
    assert fleet.ground.carry_out(flight.fly()) is None
    mission = [FlightState.MISSION, FlightState.PILOT, FlightState.HOLD, FlightState.MISSION]
    began = seen.index(FlightState.MISSION)
    assert seen[began : began + 4] == mission and seen[began + 4] is FlightState.RETURN


def test_nobody_takes_off_who_is_not_ready(tmp_path: Path) -> None:
    fleet = a_low_fleet(tmp_path)
    fleet.vehicles[1].vehicle.battery_remaining = 0.1
    flight = ScriptedFlight(fleet.ground, tmp_path / "fleet.toml", 10.0)
    problem = fleet.ground.carry_out(flight.fly())
    assert problem is not None and problem.startswith("preflight (steps[0]): not ready after 60 s")
    assert "takeoff" not in flight.began_s and "land" not in flight.began_s
    assert not any(entry.armed for each in fleet.vehicles for entry in each.vehicle.truth)


LOGGED = low_flight(2, 1, 3.0)
# Its robots share maps.
SHARING = ROOT / "policies" / "field" / "field"


def test_whoever_watches_a_fleet_may_end_its_mission(tmp_path: Path) -> None:
    seen: list[FleetMoment] = []

    def watch(moment: FleetMoment) -> None:
        seen.append(moment)
        if moment.step == "mission" and len(moment.statuses) == 2:
            moment.stop()

    flight = fly_simulated(low_flight(2, 1, 60.0), tmp_path, SHIPPED, watch=watch)
    assert flight.script.problem is None and flight.all_landed
    assert 0.0 < flight.duration_s < 3.0
    times_s = [moment.time_s for moment in seen]
    assert np.allclose(np.diff(times_s), SAMPLE_S) and times_s[-1] <= flight.script.began_s["end"]
    assert [step for step, _ in itertools.groupby(moment.step for moment in seen)] == [
        "assemble", "origin", "reset maps", "preflight", "takeoff", "start", "mission", "return",
    ]  # fmt: skip


class Logged(NamedTuple):
    """A flight whose robots wrote logs, and the folder that they are in."""

    flight: FlightRecord
    folder: Path


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> Logged:
    folder = tmp_path_factory.mktemp("logged")
    return Logged(fly_simulated(LOGGED, folder, SHARING, logs=True), folder)


@pytest.mark.slow
def test_what_the_robots_logged_is_what_they_computed(logged: Logged) -> None:
    """Flight logs as the robots' programs write them."""
    policy = LpacPolicy(load_bundle(SHARING))
    neighbours = 0
    for robot, program in enumerate(logged.flight.script.programs):
        (log,) = program.logs
        assert log == f"robots/{robot}/logs/robot-{robot}-0001.mcap"
        messages = list(read(logged.folder / log))
        states = {message["state"] for topic, _, message in messages if topic == "status"}
        assert {FlightState.MISSION, FlightState.LANDED} <= states
        for compared in replay(policy, messages):
            assert compared.ticks > 0 and compared.differing == 0
        flight = FlightReplay()
        for topic, unix_time_s, message in messages:
            if topic == "flight":
                flight.run(unix_time_s, message)
                neighbours += len(message["given"].get("inputs", {}).get("neighbours", ()))
        ticks = sum(topic == "control" for topic, _, _ in messages)
        assert (flight.ticks, flight.passed_over, flight.differing) == (ticks, 0, 0)
    assert neighbours > 0


def test_the_report_says_the_same_as_the_flight(logged: Logged) -> None:
    """To the last digit: `lpac report` has the logs, the flight the statuses of the robots."""
    flight = logged.flight
    (reported,) = examine([logged.folder], Wanted(), lambda *_: None).records
    trial = Examined((reported,), ()).summary()["trials"][0]
    figures = summary(LOGGED, flight)
    for cost, truly in ((trial["cost"], "cost"), (trial["truth"]["cost"], "true_cost")):
        assert 0.0 < cost["final"] != cost["initial"]
        assert [cost[key] for key in ("initial", "final", "normalized")] == [
            figures[truly][key] for key in ("initial", "final", "final_normalized")
        ]
    assert trial["cost"]["curve"] == figures["cost_curve"]["normalized_cost"]
    for key in (
        "duration_s", "curve_time_s", "cost", "true_cost", "lloyd", "separation", "true_separation",
        "fence_margin_m", "true_fence_margin_m",
    ):  # fmt: skip
        np.testing.assert_equal(getattr(reported, key), getattr(flight, key), key)
    assert trial["fence_margin_m"] == figures["fence"]["margin_m"] is not None
    assert trial["truth"]["fence_margin_m"] == figures["fence"]["true_margin_m"] is not None
    assert trial["truth"]["separation"]["distance_m"] == figures["separation"]["distance_m"]
    for robot, flown in zip(reported.robots, flight.robots, strict=True):
        assert reported.mission_share(robot) == flight.mission_share(flown) > 0.5


@pytest.mark.slow
def test_flights_beside_each_other_are_told_apart(tmp_path: Path, logged: Logged) -> None:
    """Also of the same world; each is as long as it was."""
    longer = fly_simulated(low_flight(2, 1, 6.0), tmp_path, SHARING, logs=True)
    flown = [logged.flight, longer]
    both = examine([logged.folder, tmp_path], Wanted(), lambda *_: None)
    reported = sorted(both.records, key=_duration_s)
    assert [_duration_s(r) for r in reported] == [_duration_s(f) for f in flown]
    for record, flight in zip(reported, flown, strict=True):
        np.testing.assert_equal(record.normalized, flight.normalized)


def _duration_s(record: FlightRecord) -> float:
    return record.duration_s


@pytest.mark.slow
def test_recorded_steps_of_the_policy_are_the_same_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, logged: Logged
) -> None:
    """As on a CPU whose onnxruntime rounds otherwise."""
    velocity = LpacPolicy.velocity
    monkeypatch.setattr(LpacPolicy, "velocity", lambda *inputs: velocity(*inputs) * 1.01)
    other = fly_simulated(LOGGED, tmp_path / "other", SHARING)
    again = fly_simulated(LOGGED, tmp_path / "again", SHARING, recorded=logged.folder)
    for track, first in zip(again.vehicles, logged.flight.vehicles, strict=True):
        np.testing.assert_array_equal(track.position_m, first.position_m)
    assert not any(each.logs for each in (*other.script.programs, *again.script.programs))
    assert again.cost.tolist() == logged.flight.cost.tolist() != other.cost.tolist()


def test_records_of_another_flight_are_refused(tmp_path: Path, logged: Logged) -> None:
    def recorded(scenario: Scenario, folder: Path) -> None:
        fly_simulated(scenario, tmp_path / "flown", SHARING, recorded=folder)

    with pytest.raises(RecordingError, match="has no flight log of robot 2"):
        recorded(low_flight(3, 1, 3.0), logged.folder)
    with pytest.raises(PartError, match=r"robot \d: policy: the robot's log has no step at"):
        recorded(low_flight(2, 2, 3.0), logged.folder)
    two = tmp_path / "two"
    for number in (1, 2):
        flight = fly_simulated(low_flight(1, 1, 2.0), two, SHARING, logs=True)
        assert flight.script.programs[0].logs == (f"robots/0/logs/robot-0-000{number}.mcap",)
    with pytest.raises(RecordingError, match="holds logs of more than one flight"):
        recorded(low_flight(1, 1, 2.0), two)
