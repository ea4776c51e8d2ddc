"""Records the flights that `tests/unit/flight/test_recorded_flights.py` replays.

    python -m tests.record_flights [NAME...]

Each is one robot's, cut to what matters: a normal flight, and what docs/faults.md lists as failing,
flown on the simulated clock. To record a flight anew is to accept that it is now decided otherwise;
`lpac replay tests/unit/flight/recorded` shows before, what is.
"""

import contextlib
import math
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from edge.drivers.flight_log import ROBOT_TOPICS, FlightLog
from edge.drivers.log_reader import read, read_metadata
from edge.flight.record import TickReader, TickWriter
from edge.messages.mission import FlightState
from lpac.ground.procedure import Until
from lpac.ground.station.protocol import (
    Enable,
    Request,
    Resume,
    RobotCommand,
    SafetyCommand,
    SetOrigin,
    Start,
    Takeoff,
)
from lpac.sim.air import GROUND
from lpac.sim.fleet.layout import ORIGIN, Settings
from lpac.sim.fleet.robots import SimulatedRobot
from lpac.sim.fleet.simulated import SimulatedFleet
from lpac.sim.px4.modes import MavResult, Px4Mode
from lpac.sim.px4.vector import vector
from lpac.sim.px4.vehicle import Px4Vehicle, SimulatedSensor
from lpac.sim.scenario import Scenario
from tests.conftest import ROOT, SHIPPED
from tests.flown import PRECISE, QUICK

RECORDED = ROOT / "tests" / "unit" / "flight" / "recorded"

_S = FlightState
_BEFORE_S = 1.0
# What they think matters little here, and takes the most time.
_RATES = {"perception_hz": 2.0, "policy_hz": 2.0}


class _Flight:
    """Two robots; what is done to them, of which robot 0's ticks are recorded from `began_s` on."""

    def __init__(self, folder: Path, settings: Settings) -> None:
        scenario = Scenario(robots=2, seed=3, errors=False, budget=PRECISE)
        self.fleet = SimulatedFleet(
            scenario, folder, SHIPPED, settings={"rates": _RATES, **settings}, logs=True
        )
        for each in self.fleet.vehicles:
            each.vehicle.parameters |= QUICK
            each.vehicle.rc_connected = True
        self.began_s = 0.0

    @property
    def robot(self) -> SimulatedRobot:
        return self.fleet.robots[0]

    @property
    def vehicle(self) -> Px4Vehicle:
        return self.fleet.vehicles[0].vehicle

    @property
    def state(self) -> FlightState | None:
        """What it says of itself, heard or not."""
        return None if self.robot.status is None else self.robot.status.state

    def run(self, duration_s: float) -> None:
        self.fleet.schedule.run_until(self.fleet.schedule.monotonic_s() + duration_s)

    def until(self, *states: FlightState, more_s: float = 1.0, at_most_s: float = 60.0) -> None:
        """Let time pass until robot 0 is in one of these states, and a little more."""
        end_s = self.fleet.schedule.monotonic_s() + at_most_s
        while self.state not in states:
            if self.fleet.schedule.monotonic_s() > end_s:
                raise RuntimeError(f"is {self.robot.status and self.robot.status.reason}")
            self.run(0.1)
        self.run(more_s)

    def do(self, request: Request) -> None:
        report = self.fleet.ground.command(request)
        if not report.done:
            raise RuntimeError(f"{request}: {report}")

    def begin(self) -> None:
        """What comes now is recorded."""
        self.began_s = self.fleet.schedule.monotonic_s() - _BEFORE_S

    def ready(self) -> None:
        """On the ground, and every check passes."""
        ground = self.fleet.ground
        wait = ground.carry_out
        wait(_until(lambda: all(r.fresh for r in ground.snapshot.robots), 30.0))
        self.do(SetOrigin(ORIGIN))
        self.do(Enable())
        wait(_until(lambda: all(r.status and r.status.ready for r in ground.snapshot.robots), 60.0))

    def fly(self) -> None:
        """In the mission, and recorded."""
        self.ready()
        self.do(Takeoff())
        self.do(Start())
        self.run(4.0)
        self.begin()

    def beside(self, offset_m: tuple[float, float]) -> Px4Vehicle:
        """Robot 1's vehicle, put so far from robot 0 in the plane, as both estimate it."""
        other = self.fleet.vehicles[1].vehicle
        place_m = self.vehicle.estimated_position_m + np.array([*offset_m, 0.0])
        x_m, y_m, _ = other.position_m + place_m - other.estimated_position_m
        other.position_m = np.array([x_m, y_m, other.position_m[2]])
        return other

    def cut(self, apart: bool) -> None:
        """The ground hears no robot, and none hears it; or all of that again."""
        groups = (frozenset({GROUND}), frozenset({0, 1})) if apart else ()
        self.fleet.radio.air = replace(self.fleet.radio.air, partition=groups)


def _until(condition: Callable[[], bool], at_most_s: float) -> Any:
    came = yield Until(lambda _: condition(), at_most_s)
    assert came


# What is flown


def _normal(f: _Flight) -> None:
    f.ready()
    f.begin()
    f.do(Takeoff())
    f.do(Start())
    f.run(12.0)
    f.do(SafetyCommand("return", wait=True))
    f.run(3.0)


def _ordered(f: _Flight) -> None:
    """All that an operator may say in the air."""
    f.fly()
    f.do(SafetyCommand("hold"))
    f.run(1.5)
    f.do(Resume())
    f.run(1.5)
    f.do(RobotCommand("pilot", ("r0",)))
    f.run(1.5)
    f.do(RobotCommand("rejoin", ("r0",)))
    f.run(1.5)
    f.do(SafetyCommand("land"))
    f.run(1.5)
    f.do(SafetyCommand("hold"))
    f.run(1.5)
    f.do(SafetyCommand("land"))
    f.run(1.5)
    f.do(SafetyCommand("return"))
    f.run(1.5)
    f.do(SafetyCommand("land", wait=True))
    f.run(1.0)


def _killed(f: _Flight) -> None:
    f.fly()
    f.do(RobotCommand("kill", ("r0",)))
    f.run(3.0)


def _program_hangs(f: _Flight) -> None:
    f.fly()
    f.robot.loops["control"].hang(3.0)
    f.run(7.0)


def _nobody_answers(f: _Flight) -> None:
    f.fly()
    f.robot.loops["control"].hang(1.0)
    f.run(9.0)
    f.until(_S.LAND)


def _program_restarts(f: _Flight) -> None:
    f.fly()
    # The watchdog holds the vehicle meanwhile.
    f.robot.loops["control"].hang(10.0)
    f.run(1.0)
    f.robot.start()
    f.begin()
    f.run(6.0)
    f.do(RobotCommand("rejoin", ("r0",)))
    f.run(3.0)


def _policy_hangs(f: _Flight) -> None:
    f.fly()
    f.robot.loops["policy"].hang(30.0)
    f.run(5.0)


def _position_lost(f: _Flight) -> None:
    f.fly()
    f.vehicle.gps_lost = True
    f.until(_S.LAND)
    f.run(2.0)


def _position_in_doubt(f: _Flight) -> None:
    f.fly()
    f.vehicle.gps_accuracy_override_m = 7.0
    f.run(2.0)
    f.vehicle.gps_accuracy_override_m = None
    f.run(5.0)


def _position_frozen(f: _Flight) -> None:
    f.fly()
    f.vehicle.estimate_frozen = True
    f.until(_S.LAND)


def _origin_jumps(f: _Flight) -> None:
    f.fly()
    f.vehicle.jump_estimator_origin(30.0, -20.0, 5.0)
    f.run(5.0)
    f.do(SafetyCommand("hold"))
    f.vehicle.jump_estimator_origin(-30.0, 20.0, 0.0)
    f.run(5.0)


def _battery_low(f: _Flight) -> None:
    f.fly()
    f.vehicle.battery_remaining = 0.24
    f.until(_S.LAND)


def _battery_low_in_hold(f: _Flight) -> None:
    f.ready()
    f.do(Takeoff())
    f.begin()
    f.vehicle.battery_remaining = 0.24
    f.until(_S.LAND)


def _battery_critical(f: _Flight) -> None:
    f.fly()
    f.vehicle.battery_remaining = 0.14
    f.until(_S.LAND)
    f.run(4.0)


def _px4_changed(f: _Flight) -> None:
    """Somebody else changes the autopilot, and can be set back; and then goes on to do so."""
    f.fly()
    f.vehicle.parameters["GF_ACTION"] = 0
    f.vehicle.fence = ()
    f.run(6.0)
    vars(f.fleet.vehicles[0])["set_parameter"] = _refuses_to_be_set
    f.vehicle.parameters["GF_ACTION"] = 0
    f.until(_S.LAND)


def _ground_lost(f: _Flight) -> None:
    f.fly()
    f.cut(True)
    f.until(_S.LAND)
    f.run(1.0)


def _ground_lost_for_a_while(f: _Flight) -> None:
    f.fly()
    f.do(SafetyCommand("return"))
    f.cut(True)
    f.run(5.0)
    f.cut(False)
    f.run(3.0)


def _ground_lost_below_another(f: _Flight) -> None:
    f.fly()
    f.cut(True)
    f.until(_S.HOLD)
    f.begin()
    f.beside((0.8, 0.4))
    f.until(_S.LAND)


def _pilot_takes_over(f: _Flight) -> None:
    f.fly()
    f.vehicle.pilot(Px4Mode.POSCTL, (1.0, 0.0, 0.0))
    f.run(4.0)
    f.vehicle.set_mode(Px4Mode.HOLD)
    f.run(2.0)


def _somebody_lands_it(f: _Flight) -> None:
    f.fly()
    f.vehicle.set_mode(Px4Mode.LAND)
    f.run(4.0)
    f.vehicle.set_mode(Px4Mode.HOLD)
    f.run(2.0)


def _somebody_holds_it(f: _Flight) -> None:
    f.fly()
    f.vehicle.set_mode(Px4Mode.HOLD)
    f.run(3.0)


def _remote_control_lost(f: _Flight) -> None:
    f.fly()
    f.vehicle.rc_connected = False
    f.run(6.0)


def _near_neighbour(f: _Flight) -> None:
    """A pilot takes robot 1 down to the height of robot 0, in whose way it then stands."""
    f.fly()
    other = f.fleet.vehicles[1].vehicle
    other.pilot(Px4Mode.POSCTL, (0.0, 0.0, 1.0))
    while other.position_m[2] < f.vehicle.position_m[2] - 0.3:
        f.run(0.1)
    other.move_sticks(())
    f.begin()
    for away_m in (3.5, 0.9):
        f.beside((away_m, 0.0))
        f.run(3.0)


def _comes_down_above(f: _Flight) -> None:
    """Somebody's ground station lands robot 1 through the height of robot 0, near by."""
    f.fly()
    other = f.beside((3.0, 1.0))
    f.begin()
    other.set_mode(Px4Mode.LAND)
    f.run(10.0)


def _falls_silent(f: _Flight) -> None:
    """Robot 1 is heard no more where robot 0 flies, and where it lands."""
    f.fly()
    f.beside((2.0, 1.0))
    f.run(1.0)
    f.begin()
    f.fleet.radio.air = replace(
        f.fleet.radio.air, partition=(frozenset({GROUND, 0}), frozenset({1}))
    )
    f.run(8.0)
    f.do(SafetyCommand("return", robots=("r0",)))
    f.until(_S.LAND)


def _landing_point_taken(f: _Flight) -> None:
    """Robot 1 has come down where robot 0 lands."""
    f.fly()
    f.do(SafetyCommand("land", robots=("r1",)))
    other = f.fleet.vehicles[1].vehicle
    while other.armed:
        f.run(0.5)
    layout = f.fleet.layout
    there_m = layout.to_world_m(np.array(f.robot.config.flight.landing_point_m))
    error_m = f.vehicle.estimated_position_m - f.vehicle.position_m
    place_m = np.array([*there_m, 0.0]) - error_m
    other.gps_bias_m = f.vehicle.gps_bias_m
    other.position_m = np.array([*place_m[:2], other.position_m[2]])
    f.run(5.0)
    f.begin()
    f.do(SafetyCommand("return", robots=("r0",)))
    f.until(_S.LAND)


def _offboard_refused(f: _Flight) -> None:
    f.fly()
    _refuse(f.vehicle, Px4Mode.OFFBOARD)
    f.robot.loops["control"].hang(1.0)
    f.until(_S.PILOT)


def _arming_refused(f: _Flight) -> None:
    f.ready()
    f.begin()
    f.vehicle.arm = _refused  # type: ignore[method-assign]
    f.fleet.ground.command(Takeoff(robots=("r0",)))
    f.run(3.0)


def _ground_ends_arming(f: _Flight) -> None:
    f.ready()
    f.begin()
    f.fleet.ground.node.begin(Takeoff(robots=("r0",)))
    f.until(_S.ARMING, more_s=0.1)
    f.do(SafetyCommand("hold"))
    f.run(4.0)


def _ground_holds_takeoff(f: _Flight) -> None:
    f.ready()
    f.begin()
    f.fleet.ground.node.begin(Takeoff(robots=("r0",)))
    f.until(_S.TAKEOFF, more_s=0.0)
    f.fleet.ground.node.begin(SafetyCommand("hold"))
    f.run(4.0)


def _ground_ends_takeoff(f: _Flight) -> None:
    f.ready()
    f.fleet.ground.node.begin(Takeoff(robots=("r0",)))
    f.until(_S.TAKEOFF)
    f.begin()
    f.run(1.0)
    f.do(SafetyCommand("land", wait=True))
    f.run(3.0)


def _orders_refused(f: _Flight) -> None:
    """Beyond the fence nothing starts, and in the air nothing disarms."""
    f.ready()
    f.do(Takeoff())
    f.begin()
    for request in (
        RobotCommand("disarm", ("r0",)),
        RobotCommand("rejoin", ("r0",)),
        Start(robots=("r0",)),
    ):
        if isinstance(request, Start):
            f.vehicle.position_m = f.vehicle.position_m + _to_the_line_m(f) + 1.5 * _outwards(f)
            f.run(1.0)
        f.fleet.ground.command(request)


def _does_not_climb(f: _Flight) -> None:
    f.ready()
    f.vehicle.parameters["MPC_Z_VEL_MAX_UP"] = 0.0
    f.fleet.ground.node.begin(Takeoff(robots=("r0",)))
    f.until(_S.TAKEOFF)
    f.begin()
    f.until(_S.LANDED, _S.PREFLIGHT)


def _sinks(f: _Flight) -> None:
    f.fly()
    f.vehicle.motor_loss = 0.53
    f.until(_S.LANDED, _S.PREFLIGHT)


def _stands_on_the_ground(f: _Flight) -> None:
    """Its motors push against the ground, so that PX4 takes it to be in the air."""
    f.fly()
    f.vehicle.motor_loss = 0.9
    f.until(_S.LANDED, _S.PREFLIGHT)


def _armed_by_others(f: _Flight) -> None:
    f.ready()
    f.begin()
    f.vehicle.arm(force=True)
    f.run(3.0)
    f.do(RobotCommand("disarm", ("r0",)))
    f.run(2.0)


def _wind_over_the_fence(f: _Flight) -> None:
    f.fly()
    # Towards the nearest line, and over it.
    f.vehicle.position_m = f.vehicle.position_m + _to_the_line_m(f)
    f.run(1.0)
    f.vehicle.wind_m_s = vector(3.0 * _outwards(f))
    f.run(8.0)


def _px4_fence(f: _Flight) -> None:
    f.fly()
    f.vehicle.position_m = f.vehicle.position_m + _to_the_line_m(f) + 8.0 * _outwards(f)
    f.run(6.0)


def _px4_lands(f: _Flight) -> None:
    f.fly()
    f.vehicle.battery_remaining = 0.05
    f.do(SafetyCommand("hold"))
    f.run(8.0)


def _autopilot_silent(f: _Flight, duration_s: float) -> None:
    f.fly()
    _silence(f, duration_s)
    f.run(4.0)


def _autopilot_silent_on_the_ground(f: _Flight) -> None:
    f.ready()
    f.begin()
    _silence(f, 4.0)
    f.run(6.0)


def _autopilot_silent_while_arming(f: _Flight) -> None:
    f.ready()
    f.begin()
    f.fleet.ground.node.begin(Takeoff(robots=("r0",)))
    f.until(_S.ARMING, more_s=0.0)
    _silence(f, 4.0)


def _position_silent(f: _Flight) -> None:
    """Of what the vehicle says, positions alone are lost."""
    f.fly()
    vehicle = f.fleet.vehicles[0]
    said = vehicle._received
    vars(vehicle)["_received"] = lambda now_s: [
        each for each in said(now_s) if each[0] != "LOCAL_POSITION_NED"
    ]
    f.run(3.0)
    del vars(vehicle)["_received"]
    f.run(1.0)


def _disarmed_in_air(f: _Flight) -> None:
    f.fly()
    f.vehicle.disarm(force=True)
    f.run(4.0)


def _battery_not_told(f: _Flight) -> None:
    f.fly()
    f.vehicle.dead_sensors.add(SimulatedSensor.BATTERY)
    f.run(6.0)


def _not_enabled(f: _Flight) -> None:
    f.ready()
    f.begin()
    f.do(Enable(False))
    f.run(3.0)


def _refuses_to_be_set(name: str, value: float) -> None:
    raise OSError(f"parameter {name} = {value}: denied")


def _silence(f: _Flight, duration_s: float) -> None:
    """Whatever the vehicle says is lost."""
    vars(f.fleet.vehicles[0])["_received"] = lambda _: ()
    f.run(duration_s)
    del vars(f.fleet.vehicles[0])["_received"]


def _refused(*_: object, **__: object) -> MavResult:
    return MavResult.TEMPORARILY_REJECTED


def _refuse(vehicle: Px4Vehicle, refused: Px4Mode) -> None:
    set_mode = vehicle.set_mode

    def choose(mode: Px4Mode) -> MavResult:
        return MavResult.TEMPORARILY_REJECTED if mode is refused else set_mode(mode)

    vehicle.set_mode = choose  # type: ignore[method-assign]


def _outwards(f: _Flight) -> Any:
    """(3,), world frame: to the west of the mission."""
    layout = f.fleet.layout
    (x_m, y_m), (east_x_m, east_y_m) = map(layout.to_world_m, (np.zeros(2), np.array([1.0, 0.0])))
    return np.array([x_m - east_x_m, y_m - east_y_m, 0.0])


def _to_the_line_m(f: _Flight) -> Any:
    place_m = f.fleet.layout.to_mission.local_to_mission(f.vehicle.estimated_position_m)
    left_m = -min(x_m for x_m, _ in f.robot.config.fence.vertices_m) + place_m[0]
    return left_m * _outwards(f)


_PILOTED = {"failsafe": {"rc": "pilot"}}
FLIGHTS: Mapping[str, tuple[Callable[[_Flight], None], Settings]] = {
    "normal": (_normal, {}),
    "ordered": (_ordered, {}),
    "killed": (_killed, {}),
    "not_enabled": (_not_enabled, {}),
    "program_hangs": (_program_hangs, {}),
    "nobody_answers": (_nobody_answers, {"flight": {"hover_land_s": 8.0}}),
    "program_restarts": (_program_restarts, {}),
    "policy_hangs": (_policy_hangs, {}),
    "position_lost": (_position_lost, {}),
    "position_in_doubt": (_position_in_doubt, {}),
    "position_frozen": (_position_frozen, {}),
    "origin_jumps": (_origin_jumps, {}),
    "battery_low": (_battery_low, {}),
    "battery_low_in_hold": (_battery_low_in_hold, {}),
    "battery_critical": (_battery_critical, {}),
    "battery_not_told": (_battery_not_told, {}),
    "px4_changed": (_px4_changed, {}),
    "ground_lost": (_ground_lost, {}),
    "ground_lost_for_a_while": (_ground_lost_for_a_while, {}),
    "ground_lost_below_another": (_ground_lost_below_another, {}),
    "pilot_takes_over": (_pilot_takes_over, _PILOTED),
    "somebody_lands_it": (_somebody_lands_it, {}),
    "somebody_holds_it": (_somebody_holds_it, {}),
    "remote_control_lost": (_remote_control_lost, _PILOTED),
    "remote_control_lost_holds": (
        _remote_control_lost, {"failsafe": {"rc": "pilot", "rc_lost": "hold"}},
    ),
    "remote_control_lost_lands": (
        _remote_control_lost, {"failsafe": {"rc": "pilot", "rc_lost": "land"}},
    ),
    "near_neighbour": (_near_neighbour, _PILOTED),
    "comes_down_above": (_comes_down_above, {}),
    "falls_silent": (_falls_silent, {}),
    "landing_point_taken": (_landing_point_taken, {}),
    "offboard_refused": (_offboard_refused, {}),
    "arming_refused": (_arming_refused, {}),
    "ground_ends_arming": (_ground_ends_arming, {}),
    "ground_holds_takeoff": (_ground_holds_takeoff, {}),
    "ground_ends_takeoff": (_ground_ends_takeoff, {}),
    "orders_refused": (_orders_refused, {}),
    "does_not_climb": (_does_not_climb, {}),
    "sinks": (_sinks, {}),
    "stands_on_the_ground": (_stands_on_the_ground, {}),
    "armed_by_others": (_armed_by_others, {}),
    "wind_over_the_fence": (_wind_over_the_fence, {}),
    "px4_fence": (_px4_fence, {}),
    "px4_lands": (_px4_lands, {}),
    "position_silent": (_position_silent, {}),
    "disarmed_in_air": (_disarmed_in_air, {}),
    "autopilot_silent": (partial(_autopilot_silent, duration_s=5.0), {}),
    "autopilot_silent_until_down": (partial(_autopilot_silent, duration_s=12.0), {}),
    "autopilot_silent_while_arming": (_autopilot_silent_while_arming, {}),
    "autopilot_silent_on_the_ground": (_autopilot_silent_on_the_ground, {}),
}  # fmt: skip


def record(name: str, folder: Path = RECORDED) -> Path:
    """Fly it, and write what robot 0 was given and made."""
    flown, settings = FLIGHTS[name]
    with tempfile.TemporaryDirectory() as scratch:
        flight = _Flight(Path(scratch), settings)
        flown(flight)
        flight.fleet.close()
        began_unix_s = flight.fleet.schedule.epoch_s + flight.began_s
        log = max(Path(flight.robot.config.log.folder).glob("robot-0-*.mcap"))
        metadata = replace(read_metadata(log), bundle_path="", configuration="")
        ticks, reader, writer = [], TickReader(), TickWriter()
        for _, unix_time_s, message in read(log, "flight"):
            tick = reader.tick(message)
            if tick is not None and unix_time_s >= began_unix_s:
                ticks.append((unix_time_s, writer.message(tick)))
        # One chunk: it is smaller.
        with contextlib.closing(
            FlightLog(
                Path(scratch) / "cut",
                metadata,
                {"flight": ROBOT_TOPICS["flight"]},
                max_queued_messages=len(ticks) + 1,
                sync_period_s=math.inf,
            )
        ) as cut:
            for unix_time_s, message in ticks:
                cut.record("flight", unix_time_s, message)
        (written,) = (Path(scratch) / "cut").glob("*.mcap")
        path = folder / f"{name}.mcap"
        path.write_bytes(written.read_bytes())
    return path


def _main(names: list[str]) -> None:
    for name in names or FLIGHTS:
        path = record(name)
        print(f"{path.relative_to(ROOT)}: {path.stat().st_size:,} bytes")


if __name__ == "__main__":
    _main(sys.argv[1:])
