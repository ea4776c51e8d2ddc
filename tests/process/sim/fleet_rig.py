"""A fleet of programs under a ground, for tests that command it and wait for its statuses."""

import time
from collections.abc import Callable

from edge.core.vehicle import PILOTED
from edge.messages.codes import ReasonCode, texts
from edge.messages.mission import ON_GROUND, FlightState, RobotStatus
from lpac.ground.station.commands import is_too_low
from lpac.ground.station.protocol import (
    CommandReport,
    Enable,
    Request,
    ResultCode,
    RobotCommand,
    SafetyCommand,
    SetOrigin,
    Start,
    Takeoff,
)
from lpac.sim.fleet.ground import GroundProgram
from lpac.sim.fleet.layout import ORIGIN
from lpac.sim.fleet.listener import Statuses
from lpac.sim.fleet.processes import Fleet
from lpac.sim.px4.vehicle import Px4Vehicle
from tests.robot_rig import HELD_UP, NOT_YET

_S = FlightState

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
    """Whether the robot flies its mission, or left it for one of the reasons in `_BY_ITSELF`."""
    return status.state is _S.MISSION or status.reason.code in _BY_ITSELF


class FleetRig:
    """A running fleet of simulated vehicles, under a ground that commands it."""

    def __init__(self, fleet: Fleet, ground: GroundProgram) -> None:
        assert fleet.simulated is not None
        self.fleet = fleet
        self.ground = ground
        self.listener = fleet.listener
        self.simulated = fleet.simulated

    @property
    def names(self) -> tuple[str, ...]:
        """The robots' names in commands."""
        return tuple(robot.name for robot in self.fleet.robots)

    def command(self, request: Request) -> CommandReport:
        """Send a command that the ground accepts; some robots may refuse it."""
        report = self.ground.command(request)
        assert report.problem is None, report
        return report

    def done(self, request: Request) -> CommandReport:
        """Repeat a command until all robots have done it; refusals must be temporary."""
        until_s = time.monotonic() + 60.0
        while not (report := self.command(request)).done:
            for result in report.results:
                for_a_moment = result.refusal in HELD_UP or result.code in NOT_YET
                assert result.code is ResultCode.DONE or for_a_moment, report
            assert time.monotonic() < until_s, report
        return report

    def assemble(self) -> None:
        """Wait until the ground receives all robots."""
        self._wait_for_all("assemble", lambda status: True, self.fleet.require_running, 240.0)
        connected = self.ground.subscriber.wait_for(
            lambda snapshot: all(r.fresh for r in snapshot.robots), 60.0
        )
        assert connected, self.ground.subscriber.snapshot

    def make_ready(self) -> None:
        """Set the origin, and wait until all robots pass their checks."""
        self.command(SetOrigin(ORIGIN))
        self._wait_for_all(
            "make ready",
            lambda status: status.state is _S.PREFLIGHT and status.ready,
            lambda: self.command(Enable()),
            240.0,
        )

    def take_off(self) -> None:
        """Take off until all hold at their heights; robots that stay too low land and try again."""

        def order() -> None:
            statuses = {self.names[r]: s for r, s in self.listener.statuses().items()}
            low = [n for n, s in statuses.items() if s.state is _S.HOLD and is_too_low(s)]
            if low:
                self.command(SafetyCommand("land", tuple(low), wait=True))
            waiting = [n for n, s in statuses.items() if s.state in ON_GROUND]
            if waiting:
                self.command(Takeoff(tuple(waiting)))

        self._wait_for_all(
            "take off",
            lambda status: status.state is _S.HOLD and not is_too_low(status),
            order,
            300.0,
        )

    def start(self) -> None:
        """Start the mission; robots that left offboard without a pilot rejoin first."""

        def order() -> None:
            left = [
                self.names[robot]
                for robot, status in self.listener.statuses().items()
                if status.state is _S.PILOT and status.mode not in PILOTED
            ]
            if left:
                self.command(RobotCommand("rejoin", tuple(left)))
            self.command(Start(self.names))

        self._wait_for_all("start", lambda status: status.state is _S.MISSION, order, 80.0)

    def _wait_for_all(
        self,
        name: str,
        holds: Callable[[RobotStatus], bool],
        order: Callable[[], object],
        at_most_s: float,
    ) -> None:
        """Call `order` until the condition holds for all robots."""

        def all_are(statuses: Statuses) -> bool:
            return len(statuses) == len(self.names) and all(map(holds, statuses.values()))

        until_s = time.monotonic() + at_most_s
        while not self.listener.wait_for(all_are, 0.2):
            assert time.monotonic() < until_s, (
                name,
                self.summary(),
                self.ground.subscriber.snapshot.ground,
            )
            order()

    def summary(self) -> dict[int, tuple[str, str, str | None, str]]:
        """Last statuses, for the message of a failed assertion."""
        statuses = sorted(self.listener.statuses().items())
        return {r: (s.state, s.reason.text, s.mode, texts(s.failed_checks)) for r, s in statuses}

    def status(self, robot: int) -> RobotStatus:
        """The robot's newest status."""
        return self.listener.history(robot)[-1].status

    def wait_status(self, robot: int, holds: Callable[[RobotStatus], object]) -> RobotStatus:
        """Wait for the first status that meets the condition, and return it."""
        found: list[RobotStatus] = []

        def is_found(statuses: Statuses) -> bool:
            if robot in statuses and holds(statuses[robot]):
                found.append(statuses[robot])
            return bool(found)

        assert self.listener.wait_for(is_found, 60.0), self.summary()
        return found[0]

    def wait_state(self, robot: int, state: FlightState) -> RobotStatus:
        """Wait until the robot is in this state; returns its status."""
        return self.wait_status(robot, lambda status: status.state is state)

    def vehicle(self, robot: int) -> Px4Vehicle:
        """The robot's vehicle."""
        return self.simulated.vehicles[robot]

    def wait_vehicle(self, robot: int, holds: Callable[[Px4Vehicle], bool]) -> None:
        """Wait until the vehicle meets the condition."""
        vehicle = self.vehicle(robot)
        with self.simulated.stepped:
            found = self.simulated.stepped.wait_for(lambda: holds(vehicle), 120.0)
        assert found, (robot, self.summary(), vehicle.truth[-1])
