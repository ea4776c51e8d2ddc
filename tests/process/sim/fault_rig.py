"""A fleet in its mission, to which faults are done; and a robot program that can be made to fail.

As a program, `python -m tests.process.sim.fault_rig FOLDER` is `lpac robot run` with FOLDER's
robot.toml. For as long as FOLDER holds a file `fail-policy` its policy raises, with `fail-sensor`
its sensor sees nothing. It also runs beside another program of the same robot id, as on another
machine.
"""

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, Literal
from unittest.mock import patch

import numpy as np

import edge.drivers.world_sensor
import edge.robot.node
import edge.robot.process
from edge.core import F32, F64
from edge.core.vehicle import PILOTED
from edge.drivers.world_sensor import WorldSensor
from edge.messages.codes import ReasonCode, RefusalCode, texts
from edge.messages.mission import (
    ON_GROUND,
    FlightState,
    OrderKind,
    RobotStatus,
    is_too_low,
)
from edge.robot.pac import Pac, PolicyTick
from lpac.cli.robot import run
from lpac.ground.station.protocol import (
    CommandReport,
    Enable,
    Request,
    ResultCode,
    Resume,
    RobotCommand,
    RobotResult,
    SafetyCommand,
    SetOrigin,
    Start,
    Takeoff,
)
from lpac.sim.fleet.ground import GroundProgram
from lpac.sim.fleet.layout import ORIGIN
from lpac.sim.fleet.listener import Heard, Statuses
from lpac.sim.fleet.processes import Fleet, RobotProcess
from lpac.sim.fleet.vehicles import SimulatedVehicles
from lpac.sim.px4.errors import GREATEST_WIND_M_S
from lpac.sim.px4.vehicle import Px4Vehicle, Truth
from lpac.sim.sitl.ground_station import RealVehicle, RealVehicles
from tests.conftest import ROOT
from tests.raw_ground import RawGround
from tests.robot_rig import HELD_UP, NOT_YET
from tests.said import why

_S = FlightState

PILOT_M_S = 3.0
# More than a vehicle flies against, and how fast it comes up.
STORM_M_S, STORM_M_S2 = 16.0, 4.0
# A robot that this machine kept waiting, or that passes another which lands, rightly leaves the
# mission too.
_BY_ITSELF = (
    ReasonCode.CONTROL_SILENT,
    ReasonCode.POLICY_STALE,
    ReasonCode.LEFT_OFFBOARD,
    ReasonCode.TOO_CLOSE,
    ReasonCode.TAKEN_BACK,
)


def flies_on(status: RobotStatus) -> bool:
    """Whether it flies its mission, or left it for what it rightly leaves it for."""
    return status.state is _S.MISSION or status.reason.code in _BY_ITSELF


class FaultyRobot(RobotProcess):
    """A robot program that fails when a test says so."""

    def start(self) -> None:
        """Start the program."""
        with (self.folder / "robot.log").open("wb") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.process.sim.fault_rig", str(self.folder)],
                cwd=ROOT,
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                process_group=0,
            )

    def fail(self, part: Literal["policy", "sensor"]) -> None:
        """From now on that part fails."""
        (self.folder / f"fail-{part}").touch()

    def mend(self) -> None:
        """Nothing fails any more."""
        for path in self.folder.glob("fail-*"):
            path.unlink()


class FaultRig:
    """A running fleet, and what tests do to it and ask of it; `flying` are the robots not lost yet.

    Times are a vehicle's own, s. What the vehicle really did is `truth`. `at_rest_m_s` is what a
    vehicle that holds its place does not exceed, `log_lag_s` how late its log tells of setpoints,
    `drift_m` how far it comes down from where it was without GPS, in still air, and `drift_m_s` how
    fast it goes there; without control of its place, it is carried by a wind of `wind_m_s`.
    """

    def __init__(
        self,
        fleet: Fleet,
        ground: GroundProgram,
        robots: Sequence[int],
        vehicles: SimulatedVehicles | RealVehicles,
    ) -> None:
        self.fleet = fleet
        self.ground = ground
        self.listener = fleet.heard
        self.simulated = vehicles
        self.flying = set(robots)
        # PX4's own estimate wanders, and the vehicle after it: by up to 0.63 m/s in 13 minutes of
        # PX4's own hold and landings. Simulated ones have gusts.
        self.at_rest_m_s = 0.7 if isinstance(vehicles, RealVehicles) else 0.35
        # A real PX4 was seen 7.5 m away after it had landed without GPS.
        self.drift_m = 10.0 if isinstance(vehicles, RealVehicles) else 6.0
        # How fast a real one's dead reckoning drifts is no promise (1.2 m/s was seen); how far is.
        self.drift_m_s = math.inf if isinstance(vehicles, RealVehicles) else 1.2
        self.wind_m_s = 0.0 if isinstance(vehicles, RealVehicles) else GREATEST_WIND_M_S
        self.log_lag_s = 1.5 if isinstance(vehicles, RealVehicles) else 0.1

    def robot(self, role: int) -> int:
        """Who takes a test's part: of real PX4s there are few, so the lowest that still flies."""
        return min(self.flying) if isinstance(self.simulated, RealVehicles) else role

    # The operator's part

    def name(self, robot: int) -> str:
        """What its operator calls it."""
        return self.fleet.robots[robot].name

    @property
    def names(self) -> tuple[str, ...]:
        """Of those that fly."""
        return tuple(map(self.name, sorted(self.flying)))

    def command(self, request: Request) -> CommandReport:
        """Command something that is possible as such; not every robot may do it."""
        report = self.ground.command(request)
        assert report.problem is None, report
        return report

    def done(self, request: Request) -> CommandReport:
        """Command it until it is done of all, but for what lasts a moment."""
        until_s = time.monotonic() + 60.0
        while not (report := self.command(request)).done:
            for result in report.results:
                for_a_moment = result.refusal in HELD_UP or result.code in NOT_YET
                assert result.code is ResultCode.DONE or for_a_moment, report
            assert time.monotonic() < until_s, report
        return report

    def assemble(self) -> None:
        """Wait until the ground hears all that are to fly."""
        self._wait_for_all("assemble", lambda told: True, self.fleet.require_running, 240.0)
        heard = self.ground.told.wait_for(
            lambda told: all(r.fresh for r in told.robots if r.name in self.names), 60.0
        )
        assert heard, self.ground.told.snapshot

    def make_ready(self) -> None:
        """Origin, and their checks, until all are passed."""
        self.command(SetOrigin(ORIGIN))
        self._wait_for_all(
            "make ready",
            lambda told: told.state is _S.PREFLIGHT and told.ready,
            lambda: self.command(Enable()),
            240.0,
        )

    def take_off(self) -> None:
        """All come to hold at their heights; who was held up on its way lands, and tries again."""

        def order() -> None:
            statuses = {self.name(r): s for r, s in self.listener.statuses().items()}
            low = [n for n, s in statuses.items() if s.state is _S.HOLD and is_too_low(s)]
            if low:
                self.command(SafetyCommand("land", tuple(low), wait=True))
            waiting = [n for n, s in statuses.items() if s.state in ON_GROUND and n in self.names]
            if waiting:
                self.command(Takeoff(tuple(waiting)))

        self._wait_for_all(
            "take off", lambda told: told.state is _S.HOLD and not is_too_low(told), order, 300.0
        )

    def start(self) -> None:
        """All fly their mission; who left offboard without a pilot is taken back before."""

        def order() -> None:
            left = [
                self.name(robot)
                for robot, status in self.listener.statuses().items()
                if robot in self.flying and status.state is _S.PILOT and status.mode not in PILOTED
            ]
            if left:
                self.command(RobotCommand("rejoin", tuple(left)))
            self.command(Start(self.names))

        self._wait_for_all("start", lambda told: told.state is _S.MISSION, order, 80.0)

    def _wait_for_all(
        self,
        name: str,
        holds: Callable[[RobotStatus], bool],
        order: Callable[[], object],
        at_most_s: float,
    ) -> None:
        """Order it again and again until it holds of all that fly."""

        def all_are(statuses: Statuses) -> bool:
            return self.flying <= statuses.keys() and all(holds(statuses[r]) for r in self.flying)

        until_s = time.monotonic() + at_most_s
        while not self.listener.wait_for(all_are, 0.2):
            assert time.monotonic() < until_s, (name, self.told(), self.ground.told.snapshot.ground)
            order()

    def order(self, kind: Literal["takeoff", "start", "rejoin", "kill"], robot: int) -> RobotResult:
        """What comes of a command to one robot; given again if it fails for what lasts a moment."""
        until_s = time.monotonic() + 60.0
        names = (self.name(robot),)
        request: Request
        if kind == "takeoff":
            request = Takeoff(names)
        elif kind == "start":
            request = Start(names)
        else:
            request = RobotCommand(kind, names)
        while True:
            (result,) = self.command(request).results
            lasts = result.refusal not in HELD_UP and result.code not in NOT_YET
            if lasts or time.monotonic() > until_s:
                return result

    def refusal(self, kind: OrderKind, robot: int) -> RefusalCode | None:
        """Why the robot itself refuses what the ground would not order it now; None: it obeys."""
        with RawGround(self.fleet.name, self.fleet.endpoints, self.listener) as raw:
            return why(raw.order(kind, self.status(robot)))

    def hold(self, robot: int) -> None:
        """The ground wants it to hold."""
        assert self.command(SafetyCommand("hold", (self.name(robot),))).done

    def resume(self, robot: int) -> None:
        """The ground does not want it any more."""
        self.command(Resume((self.name(robot),)))

    def told(self) -> dict[int, tuple[str, str, str | None, str]]:
        """What the robots say of themselves, for whoever reads a failure."""
        statuses = sorted(self.listener.statuses().items())
        return {r: (s.state, s.reason.text, s.mode, texts(s.failed_checks)) for r, s in statuses}

    def status(self, robot: int) -> RobotStatus:
        """Its newest status."""
        return self.listener.history(robot)[-1].status

    def wait_status(self, robot: int, holds: Callable[[RobotStatus], object]) -> RobotStatus:
        """Wait for a status of which something holds; returns that one."""
        found: list[RobotStatus] = []

        def is_found(statuses: Statuses) -> bool:
            if robot in statuses and holds(statuses[robot]):
                found.append(statuses[robot])
            return bool(found)

        assert self.listener.wait_for(is_found, 60.0), self.told()
        return found[0]

    def wait_state(self, robot: int, state: FlightState) -> RobotStatus:
        """Wait until the robot says that it is in this state; returns what it says."""
        return self.wait_status(robot, lambda status: status.state is state)

    def is_heard(self, robot: int) -> bool:
        """Whether all others that fly have fresh messages of the robot, soon."""
        return self._others_say(lambda status: str(robot) in status.neighbour_ages_s)

    def is_forgotten(self, robot: int) -> bool:
        """Whether no other that flies has a fresh message of the robot, soon."""
        return self._others_say(lambda status: str(robot) not in status.neighbour_ages_s)

    def _others_say(self, holds: Callable[[RobotStatus], bool]) -> bool:
        return self.listener.wait_for(
            lambda statuses: (
                self.flying <= statuses.keys() and all(holds(statuses[r]) for r in self.flying)
            ),
            60.0,
        )

    @contextmanager
    def others_go_on(self, robot: int, *, lost: bool = False) -> Iterator[None]:
        """Meanwhile the others fly their mission; afterwards all do, but a robot that is `lost`."""
        self.start()
        began_s = time.monotonic()
        self.flying.remove(robot)
        others = tuple(self.flying)
        yield
        self.start()
        for other in others:
            for _, status in self.heard(other, began_s):
                assert flies_on(status), (other, status.state, status.reason)
        if not lost:
            self.flying.add(robot)
            self.start()

    def heard(self, robot: int, since_s: float) -> list[Heard]:
        """What a robot said since then (`time.monotonic()`)."""
        return [heard for heard in self.listener.history(robot) if heard.at_s >= since_s]

    # The vehicles' part

    def vehicle(self, robot: int) -> Px4Vehicle | RealVehicle:
        """The robot's vehicle."""
        return self.simulated.vehicles[robot]

    def simulated_vehicle(self, robot: int) -> Px4Vehicle:
        """The same, where it can be asked for all that is in it."""
        vehicle = self.vehicle(robot)
        assert isinstance(vehicle, Px4Vehicle)
        return vehicle

    def lose_gps(self, robot: int) -> float:
        """Its receiver sees nothing from now on; returns the vehicle's time."""
        with self.simulated.stepped:
            vehicle = self.vehicle(robot)
            if isinstance(vehicle, RealVehicle):
                vehicle.lose_gps()
            else:
                vehicle.gps_lost = True
            return vehicle.time_s

    def drain(self, robot: int, remaining: float) -> float:
        """Its battery falls to this share; returns the vehicle's time."""
        with self.simulated.stepped:
            vehicle = self.vehicle(robot)
            if isinstance(vehicle, RealVehicle):
                vehicle.drain(remaining)
            else:
                vehicle.battery_remaining = remaining
            return vehicle.time_s

    def now_s(self, robot: int) -> float:
        """The vehicle's time."""
        with self.simulated.stepped:
            return self.vehicle(robot).time_s

    def change(self, robot: int, **fields: Any) -> float:
        """Set fields of the vehicle; returns its time."""
        with self.simulated.stepped:
            for name, value in fields.items():
                setattr(self.vehicle(robot), name, value)
            return self.vehicle(robot).time_s

    def wait_vehicle(self, robot: int, holds: Callable[[Any], bool]) -> None:
        """Wait until something holds of the vehicle."""
        assert self._vehicle_is(robot, holds, 120.0), (
            robot, self.told(), self.vehicle(robot).truth[-1],
        )  # fmt: skip

    def _vehicle_is(self, robot: int, holds: Callable[[Any], bool], timeout_s: float) -> bool:
        vehicle = self.vehicle(robot)
        with self.simulated.stepped:
            return self.simulated.stepped.wait_for(lambda: holds(vehicle), timeout_s)

    def wait_time(self, robot: int, until_s: float) -> None:
        """Wait for a time of the vehicle."""
        self.wait_vehicle(robot, lambda vehicle: vehicle.time_s >= until_s)

    def wait_moving(self, robot: int) -> None:
        """Wait until the vehicle flies its mission fast enough for a stop to be one."""
        until_s = time.monotonic() + 120.0
        while not self._vehicle_is(robot, lambda v: speed_m_s(v.velocity_m_s, 2) > 0.3, 5.0):
            assert time.monotonic() < until_s, self.told()
            # It may have come to hold by itself.
            self.start()

    def wait_landed(self, robot: int) -> None:
        """Wait until the vehicle stands on the ground, disarmed, and its robot says so."""
        self.wait_vehicle(robot, lambda vehicle: vehicle.landed and not vehicle.armed)
        # LANDED lasts no longer than a tick if the ground lets the robot fly again.
        self.wait_status(robot, lambda status: status.state in (_S.LANDED, _S.PREFLIGHT))

    def last_setpoint_s(self, robot: int) -> float:
        """When the last setpoint reached the vehicle."""
        with self.simulated.stepped:
            vehicle = self.vehicle(robot)
            if isinstance(vehicle, RealVehicle):
                return vehicle.last_setpoint_s()
            return vehicle._setpoint_at_s

    def walked_m(self, robot: int, since_s: float) -> float:
        """How far a real PX4's estimate has moved from the truth since then, horizontally.

        A simulated vehicle's moves little, and counts as if it did not.
        """
        with self.simulated.stepped:
            vehicle = self.vehicle(robot)
            if not isinstance(vehicle, RealVehicle):
                return 0.0
            count = sum(entry.time_s > since_s for entry in vehicle.truth)
            return math.dist(vehicle.errors_m[-count][:2], vehicle.errors_m[-1][:2])

    def silence_before_landing_s(self, robot: int, landing_s: float) -> float:
        """How long the vehicle had no setpoints when it began to land, at `landing_s`."""
        with self.simulated.stepped:
            vehicle = self.vehicle(robot)
            if isinstance(vehicle, RealVehicle):
                # What is heard of it comes some milliseconds late, and its clock may be slow.
                return vehicle.silence_before_landing_s()
            return landing_s - vehicle._setpoint_at_s

    def truth(self, robot: int, since_s: float) -> list[Truth]:
        """What was really so since then; it is never nothing."""
        with self.simulated.stepped:
            truth = [entry for entry in self.vehicle(robot).truth if entry.time_s > since_s]
        assert truth
        return truth

    def max_speed_m_s(self, robot: int, since_s: float, axes: int = 3) -> float:
        """The greatest true speed since then; with 2 axes the horizontal one."""
        return max(speed_m_s(entry.velocity_m_s, axes) for entry in self.truth(robot, since_s))

    def jump_origin(
        self, robot: int, north_m: float, east_m: float, down_m: float
    ) -> tuple[float, F64]:
        """Its estimator starts over from another origin; its time then, and where it really was."""
        with self.simulated.stepped:
            vehicle = self.vehicle(robot)
            vehicle.jump_estimator_origin(north_m, east_m, down_m)
            return vehicle.time_s, vehicle.position_m.copy()

    def true_position_m(self, robot: int) -> F64:
        """Where the vehicle really is: the mission frame, (3,)."""
        with self.simulated.stepped:
            return self._to_mission_m(self.vehicle(robot).position_m)

    def estimate_m(self, robot: int) -> F64:
        """Where the vehicle takes itself to be: the mission frame, (3,)."""
        with self.simulated.stepped:
            return self._to_mission_m(self.vehicle(robot).estimated_position_m)

    def _to_mission_m(self, place_m: F64) -> F64:
        return self.fleet.layout.to_mission.local_to_mission(place_m)

    def inside_m(self, robot: int) -> float:
        """How far inside the fence the vehicle takes itself to be."""
        x_m, y_m, _ = self.estimate_m(robot)
        return self.fleet.layout.fence.distance_m(x_m, y_m)

    def outwards(self, robot: int) -> F64:
        """(3,), mission frame, of length 1: towards the nearest side of the fence."""
        x_m, y_m, _ = self.estimate_m(robot)
        low_m, high_m = np.array(self.fleet.layout.fence.vertices_m)[[0, 2]]
        away_m = np.array([x_m - low_m[0], high_m[0] - x_m, y_m - low_m[1], high_m[1] - y_m])
        sides = np.array([(-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 1.0, 0.0)])
        outwards: F64 = sides[away_m.argmin()]
        return outwards

    def fly_by_hand(self, robot: int, place_m: F64) -> None:
        """A pilot flies it to where its estimate is `place_m` (3,), mission frame, and stops."""
        goal_m = self.fleet.layout.to_mission.mission_to_local(place_m)

        def is_there(vehicle: Px4Vehicle) -> bool:
            offset_m = goal_m - vehicle.estimated_position_m
            away_m = speed_m_s(offset_m, 3)
            vehicle.move_sticks((offset_m * min(1.0, PILOT_M_S / max(away_m, 1e-9))).tolist())
            return away_m < 0.2

        with self.simulated.stepped:
            self.simulated_vehicle(robot).pilot()
        self.wait_vehicle(robot, is_there)
        with self.simulated.stepped:
            self.simulated_vehicle(robot).move_sticks(())

    def push_over_the_fence(self, robot: int) -> None:
        """A storm carries it over the line; then the wind blows on as it is used to."""
        outwards = self.fleet.layout.to_mission.velocity_to_local(self.outwards(robot))
        began_s = self.now_s(robot)

        def is_over_the_line(vehicle: Px4Vehicle) -> bool:
            storm_m_s = min(STORM_M_S, STORM_M_S2 * (vehicle.time_s - began_s))
            vehicle.wind_m_s = vehicle.wind_m_s + outwards * storm_m_s - vehicle.air_m_s
            x_m, y_m, _ = self._to_mission_m(vehicle.estimated_position_m)
            return self.fleet.layout.fence.distance_m(x_m, y_m) < -0.3

        self.wait_vehicle(robot, is_over_the_line)
        with self.simulated.stepped:
            vehicle = self.simulated_vehicle(robot)
            vehicle.wind_m_s = vehicle.wind_m_s + vehicle.compensated_wind_m_s - vehicle.air_m_s


def speed_m_s(velocity_m_s: Sequence[float] | F64, axes: int) -> float:
    """Of the first axes of a velocity."""
    return math.hypot(*velocity_m_s[:axes])


def _run(folder: Path) -> None:
    class FailingPac(Pac):
        def infer(self, now_s: float) -> PolicyTick | None:
            if (folder / "fail-policy").exists():
                raise RuntimeError("the policy was made to fail")
            return super().infer(now_s)

    class FailingSensor(WorldSensor):
        def view(self, position: F64) -> F32:
            nothing = np.zeros((0, 0), np.float32)
            return nothing if (folder / "fail-sensor").exists() else super().view(position)

    with (
        patch.object(edge.robot.node, "Pac", FailingPac),
        patch.object(edge.drivers.world_sensor, "WorldSensor", FailingSensor),
        patch.object(edge.robot.process, "_robot_lock", lambda _: nullcontext()),
    ):
        run(folder / "robot.toml")


if __name__ == "__main__":
    _run(Path(sys.argv[1]))
