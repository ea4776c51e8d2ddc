"""What keeps the robot from flying: gathers what preflight's checks ask for.

One thread only, and not the control loop's: a vehicle that falls silent while it is asked something
holds up the caller for many seconds.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from edge.core.fence import Fence
from edge.core.logger import log
from edge.core.mailbox import Neighbour
from edge.core.ports import Odometry, Vehicle, VehicleSetup
from edge.core.position import PositionJudgement
from edge.flight.failsafe import PARAMETERS, Requirement, explain, required
from edge.flight.failsafe import check as check_parameters
from edge.flight.preflight import PreflightInputs, failed_checks
from edge.flight.state import Robot
from edge.identity.guard import CardProblem
from edge.messages.beacon import HeardBeacon
from edge.messages.codes import CheckCode, FailedCheck
from edge.messages.mission import Origin
from edge.robot.config import RobotConfig

# Parameters may be changed by others meanwhile.
_READ_AGAIN_S = 5.0
_TRY_AGAIN_S = 3.0

_MAX_ANSWER_AGE_S = 2.0


class Assignment(NamedTuple):
    """What a robot flies by, as the ground sets it: where, its fence and place, and its world."""

    origin: Origin | None
    robot: Robot
    world_id: str


class Checks(NamedTuple):
    """What preflight found at one time, for one assignment: one line for each failed check."""

    failed: tuple[FailedCheck, ...]
    at_s: float
    assignment: Assignment


class Readiness:
    """The checks of one robot before flight.

    `explanations` say what PX4 would do when something fails; `changes` are the parameters that
    were set.
    """

    def __init__(
        self,
        config: RobotConfig,
        vehicle: Vehicle,
        setup: VehicleSetup,
        *,
        bundle_id: str,
        bundle_problem: str | None,
    ) -> None:
        self._config = config
        self._vehicle = vehicle
        self._setup = setup
        self._bundle_id = bundle_id
        self._bundle_problem = bundle_problem
        # What is later than many periods of the policy is late in flight, too.
        self._max_answer_age_s = max(_MAX_ANSWER_AGE_S, config.policy.max_input_age_s)
        self._requirements: tuple[Requirement, ...] = ()
        # What they were made for; all else that they follow from is configured.
        self._ceiling_m: float | None = None
        self._parameter_problems: tuple[str, ...] | None = None
        self._parameters_due_s = self._fence_due_s = -math.inf
        self._uploaded: tuple[Origin, Fence] | None = None
        self.explanations: tuple[str, ...] = ()
        self.changes: tuple[str, ...] = ()

    def prepare(self, now_s: float, assignment: Assignment) -> None:
        """Read, and set if the configuration says so, what the vehicle must be; only on the ground.

        The fence goes to the vehicle when the mission's origin is known.
        """
        origin, fence = assignment.origin, assignment.robot.fence
        failsafe, flight = self._config.failsafe, self._config.flight
        if fence.ceiling_m != self._ceiling_m:
            self._ceiling_m = fence.ceiling_m
            self._requirements = required(failsafe.rc, fence.ceiling_m, flight.command_timeout_s)
            self._parameter_problems = None
            self._parameters_due_s = -math.inf
        vehicle = self._vehicle.state()
        if not vehicle.connected:
            self._parameters_due_s, self._uploaded = -math.inf, None
            return
        # Nothing is set while it is not sure which vehicle answers.
        if vehicle.armed is not False or vehicle.other_system_ids:
            return
        if now_s >= self._parameters_due_s:
            self._parameters_due_s = now_s + (_READ_AGAIN_S if self._read() else _TRY_AGAIN_S)
        if origin is None or self._uploaded == (origin, fence):
            return
        if now_s >= self._fence_due_s:
            self._fence_due_s = now_s + _TRY_AGAIN_S
            self._upload_fence(origin, fence)

    def checks(
        self,
        now_s: float,
        *,
        assignment: Assignment,
        position: PositionJudgement,
        odometry: Odometry | None,
        peers: Sequence[HeardBeacon],
        not_understood: Sequence[str],
        unheard: Sequence[int],
        fell_silent: Sequence[Neighbour],
        duplicate: bool,
        watchdog_alive: bool,
        card_problem: CardProblem | None,
        ground_age_s: float,
        time_uncertainty_s: float | None,
        answer_age_s: float | None,
        answer_problem: str,
    ) -> Checks:
        """All checks, now. `ground_age_s` is infinite if the ground was never heard."""
        config = self._config
        origin, robot, world_id = assignment
        inputs = PreflightInputs(
            now_s=now_s,
            robot_id=config.robot_id,
            duplicate_id=duplicate,
            bundle_problem=self._bundle_problem,
            bundle_id=self._bundle_id,
            world_id=world_id,
            system_id=config.autopilot.system_id,
            vehicle=self._vehicle.state(),
            failsafe_problems=self._parameter_problems,
            fence=robot.fence,
            reach=robot.reach,
            fence_uploaded=origin is not None and self._uploaded == (origin, robot.fence),
            origin=origin,
            position=position,
            position_m=None if odometry is None else odometry.position_m,
            slot_height_m=robot.parameters.slot_height_m,
            landing_point_m=robot.parameters.landing_point_m,
            min_separation_m=robot.parameters.min_separation_m,
            errors=robot.errors,
            neighbours=peers,
            not_understood=not_understood,
            unheard=unheard,
            fell_silent=fell_silent,
            separation=robot.separation,
            rc=config.failsafe.rc,
            ground_age_s=ground_age_s if math.isfinite(ground_age_s) else None,
            time_uncertainty_s=time_uncertainty_s,
            has_answer=answer_age_s is not None and answer_age_s <= self._max_answer_age_s,
            answer_problem=answer_problem,
        )
        failed = failed_checks(inputs, config.preflight)
        if not watchdog_alive:
            text = "watchdog has ended: start this robot's program again"
            failed = (*failed, FailedCheck(CheckCode.WATCHDOG_ENDED, text))
        if card_problem is not None:
            text = f"its card in the fleet is {card_problem.value}: enroll this robot again"
            failed = (*failed, FailedCheck(CheckCode.CARD_NOT_GOOD, text))
        return Checks(failed, now_s, assignment)

    def _read(self) -> bool:
        """Whether everything is as it must be."""
        try:
            values = self._setup.read_parameters(PARAMETERS)
            if self._config.failsafe.parameters == "set" and self._set_wrong(values):
                values = self._setup.read_parameters(PARAMETERS)
        except OSError as error:
            log.warning("PX4 parameters not read or set", error=str(error))
            self._parameter_problems = None
            return False
        self._parameter_problems = check_parameters(self._requirements, values)
        timeout_s = self._config.flight.command_timeout_s
        hang = f"if this program hangs, its watchdog lets PX4 hold, {timeout_s:g} s later"
        self.explanations = (hang, *explain(values))
        return not self._parameter_problems

    def _set_wrong(self, values: dict[str, int | float | None]) -> bool:
        """Set what is wrong and can be set; whether there was any."""
        wrong = [
            (requirement, requirement.value_to_set)
            for requirement in self._requirements
            if values.get(requirement.name) is not None
            and requirement.problem(values[requirement.name]) is not None
            and requirement.value_to_set is not None
        ]
        for requirement, value in wrong:
            self._setup.set_parameter(requirement.name, value)
            change = f"{requirement.name} from {values[requirement.name]:g} to {value:g}"
            self.changes = (*self.changes, change)
            log.warning("PX4 parameter set", change=change, why=requirement.why)
        return bool(wrong)

    def _upload_fence(self, origin: Origin, fence: Fence) -> None:
        frame = origin.frame()
        grown_m = fence.grown_m(self._config.failsafe.fence_margin_m)
        # Without an answer the vehicle may have this one, the one before, or none.
        self._uploaded = None
        try:
            self._setup.upload_fence([frame.to_global_deg(*vertex) for vertex in grown_m])
        except OSError as error:
            log.warning("fence upload failed", error=str(error))
            return
        self._uploaded = origin, fence
