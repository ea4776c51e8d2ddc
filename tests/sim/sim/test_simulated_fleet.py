"""A fleet of real robot nodes under a real ground, on one simulated clock."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from edge.core import F64
from edge.messages.mission import FlightState
from lpac.ground.procedure import Procedure, Until
from lpac.ground.script import ScriptListener, ScriptRun, load_script
from lpac.ground.site import Sites
from lpac.ground.station.protocol import Enable, SafetyCommand, SetOrigin, Start, Takeoff
from lpac.sim.fleet.clocked import fly_simulated
from lpac.sim.fleet.flight import FleetFlight, normalized
from lpac.sim.fleet.layout import ORIGIN, FleetScenario
from lpac.sim.fleet.simulated import SimulatedFleet, SimulatedGround
from lpac.sim.radio import GROUND
from tests.conftest import SHIPPED

ROBOTS = 3
DRONE_M = 0.5


def a_fleet(folder: Path, seed: int = 3, robots: int = ROBOTS) -> SimulatedFleet:
    return SimulatedFleet(FleetScenario(robots=robots, seed=seed), folder, SHIPPED)


def to_mission(ground: SimulatedGround) -> Procedure[None]:
    """From the start to all robots in their mission."""
    yield Until(lambda told: all(robot.fresh for robot in told.robots), 30.0)
    for request in (SetOrigin(ORIGIN), Enable(), Takeoff(), Start()):
        if isinstance(request, Takeoff):
            ready = yield Until(
                lambda told: all(robot.status and robot.status.ready for robot in told.robots), 60.0
            )
            assert ready, ground.snapshot
        report = yield request
        assert report.done, (request, report)


def states(fleet: SimulatedFleet) -> set[FlightState]:
    return {
        robot.status.state for robot in fleet.ground.snapshot.robots if robot.status is not None
    }


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
    assert states(fleet) == {FlightState.LANDED}
    for each, landing_m in zip(fleet.vehicles, fleet.layout.pads_m, strict=True):
        assert each.vehicle.landed and not each.vehicle.armed
        # Where it takes its pad to be: off by the receiver's error at most, there and back.
        place_m = fleet.layout.to_mission.local_to_mission(each.vehicle.position_m)
        assert np.linalg.norm(place_m[:2] - landing_m) < 6.0
    assert min(apart_m) > DRONE_M


def test_a_flight_is_the_same_each_time(tmp_path: Path) -> None:
    def flown(folder: Path, seed: int) -> tuple[bytes, list[str]]:
        fleet = a_fleet(folder, seed, robots=2)
        fleet.ground.carry_out(to_mission(fleet.ground))
        fleet.ground.carry_out(_pass(3.0))
        return fleet.true_positions_m().tobytes(), [each.text for each in fleet.ground.events]

    first = flown(tmp_path / "first", 3)
    assert flown(tmp_path / "again", 3) == first
    assert flown(tmp_path / "other", 4) != first


def test_robots_that_lose_the_ground_hold_and_land(tmp_path: Path) -> None:
    fleet = a_fleet(tmp_path)
    ground = fleet.ground
    ground.carry_out(to_mission(ground))
    robots = frozenset(range(ROBOTS))
    cut = (frozenset({GROUND}), robots)
    fleet.radio.air = dataclasses.replace(fleet.radio.air, partition=cut)
    ground.carry_out(_pass(5.0))
    # The ground hears nothing of it: the vehicles tell.
    assert all(np.linalg.norm(each.vehicle.velocity_m_s) < 0.5 for each in fleet.vehicles)
    assert not any(each.vehicle.landed for each in fleet.vehicles)
    ground.carry_out(_pass(60.0))
    assert all(each.vehicle.landed and not each.vehicle.armed for each in fleet.vehicles)
    fleet.radio.air = dataclasses.replace(fleet.radio.air, partition=())
    ground.carry_out(_pass(3.0))
    # Heard again, and still enabled.
    assert states(fleet) == {FlightState.PREFLIGHT}
    assert not any(each.vehicle.armed for each in fleet.vehicles)


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_a_script_is_flown_on_the_simulated_clock(tmp_path: Path, loss: float) -> None:
    fleet = a_fleet(tmp_path)
    fleet.radio.air = dataclasses.replace(fleet.radio.air, loss=loss)
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
    assert all(each.vehicle.landed and not each.vehicle.armed for each in fleet.vehicles)
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

    def may(self, question: str) -> bool:
        return True


def test_a_flight_tells_of_itself_and_is_the_same_twice(tmp_path: Path) -> None:
    def flown(name: str) -> FleetFlight:
        scenario = FleetScenario(robots=3, seed=5, duration_s=10.0)
        return fly_simulated(scenario, tmp_path / name, SHIPPED)

    flight, again = flown("first"), flown("again")
    assert flight.all_landed and flight.problem is None
    assert [change.state for change in flight.robots[0].changes][-4:] == [
        FlightState.MISSION, FlightState.RETURN, FlightState.LAND, FlightState.LANDED,
    ]  # fmt: skip
    assert min(robot.mission_share for robot in flight.robots) > 0.9
    assert flight.true_fence_margin_m() > 0.0
    assert flight.separation is not None and flight.separation.distance_m > DRONE_M
    assert flight.summary() == again.summary()
    assert normalized(flight.cost)[-1] < 1.0
