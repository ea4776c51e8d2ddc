"""Readiness to fly: prepare the vehicle, and gather the inputs of preflight's checks.

Call it from one thread, not the control loop's: a vehicle that does not answer may block the caller
for many seconds.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from edge.core.fence import Fence
from edge.core.logger import log
from edge.core.ports import Odometry, Vehicle, VehicleSetup
from edge.core.position import PositionJudgement
from edge.core.vehicle import GPS_CONTROL
from edge.flight.failsafe import PARAMETERS, Requirement, explain, required
from edge.flight.failsafe import check as check_parameters
from edge.flight.preflight import PreflightInputs, failed_checks
from edge.flight.state import Px4Change, Robot
from edge.messages.beacon import Neighbour, ReceivedBeacon
from edge.messages.codes import CheckCode, FailedCheck
from edge.messages.mission import Origin
from edge.robot.config import RobotConfig

# Others may change parameters and fence at any time.
_READ_PERIOD_S = 1.5
_RETRY_S = 3.0
# A change in flight that lasts longer counts as not restored.
_RESTORED_WITHIN_S = 3.5

_MAX_ANSWER_AGE_S = 2.0


class Assignment(NamedTuple):
    """A robot's assignment from the ground: mission origin, fence and place, and world."""

    origin: Origin | None
    robot: Robot
    world_id: str


class Checks(NamedTuple):
    """Failed checks at one time, for one assignment."""

    failed: tuple[FailedCheck, ...]
    at_s: float
    assignment: Assignment


class Readiness:
    """The preflight checks of one robot, and the watch over its vehicle's settings in flight.

    `explanations` describe PX4's failsafes; `changes` are the parameters that were set;
    `px4_change` is as in `FlightInputs`.
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
        # At least as long as flight tolerates.
        self._max_answer_age_s = max(_MAX_ANSWER_AGE_S, config.policy.max_input_age_s)
        self._requirements: tuple[Requirement, ...] = ()
        # The ceiling that they were made for; their other inputs are configured.
        self._ceiling_m: float | None = None
        self._parameter_problems: tuple[str, ...] | None = None
        # The last values without a problem.
        self._right: dict[str, int | float | None] = {}
        self._read_due_s = self._fence_due_s = -math.inf
        self._uploaded: tuple[Origin, Fence] | None = None
        # Reads that must still find the fence after somebody changed it.
        self._fence_doubts = 0
        # Changes in this flight.
        self.px4_change: Px4Change | None = None
        self._changed: tuple[str, ...] = ()
        self._changed_since_s = math.inf
        self.explanations: tuple[str, ...] = ()
        self.changes: tuple[str, ...] = ()

    def prepare(self, now_s: float, assignment: Assignment, *, steers: bool = False) -> None:
        """Read the vehicle's parameters and fence; on the ground, set them as configured.

        The fence is uploaded once the mission's origin is known. In flight, changes by others are
        restored if this program `steers`.
        """
        origin, fence = assignment.origin, assignment.robot.fence
        failsafe, flight = self._config.failsafe, self._config.flight
        if fence.ceiling_m != self._ceiling_m:
            self._ceiling_m = fence.ceiling_m
            self._requirements = required(failsafe.rc, fence.ceiling_m, flight.command_timeout_s)
            self._forget()
        vehicle = self._vehicle.state()
        if not vehicle.connected:
            self._read_due_s = -math.inf
            # A vehicle that was armed may still fly, with the same settings.
            if not vehicle.armed:
                self._forget()
                self._uploaded, self._fence_doubts = None, 0
            return
        # Set nothing while the vehicle that answers is uncertain.
        if vehicle.armed is None or vehicle.other_system_ids:
            return
        if vehicle.armed:
            if now_s >= self._read_due_s:
                self._watch(now_s, steers=steers)
            return
        self.px4_change, self._changed, self._changed_since_s = None, (), math.inf
        if now_s >= self._read_due_s:
            self._read_due_s = now_s + (_READ_PERIOD_S if self._read() else _RETRY_S)
            self._check_fence(now_s)
        if origin is None or self._uploaded == (origin, fence):
            return
        if now_s >= self._fence_due_s:
            self._fence_due_s = now_s + _RETRY_S
            self._upload_fence(origin, fence)
            # Wait before the next read, so that it finds a repeated change by others.
            self._read_due_s = max(self._read_due_s, now_s + _READ_PERIOD_S)

    def _forget(self) -> None:
        self._parameter_problems, self._right = None, {}
        self._read_due_s = -math.inf

    def checks(
        self,
        now_s: float,
        *,
        assignment: Assignment,
        position: PositionJudgement,
        odometry: Odometry | None,
        peers: Sequence[ReceivedBeacon],
        unreadable_robots: Sequence[int],
        ground_release: str,
        missing_robots: Sequence[int],
        fell_silent: Sequence[Neighbour],
        duplicate: bool,
        watchdog_alive: bool,
        is_member: bool,
        members_differ: str,
        ground_age_s: float,
        time_uncertainty_s: float | None,
        answer_age_s: float | None,
        answer_problem: str,
    ) -> Checks:
        """Run all checks. `ground_age_s` is infinite before the first ground state."""
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
            fence_changed=self._fence_doubts > 0,
            origin=origin,
            position=position,
            position_m=None if odometry is None else odometry.position_m,
            slot_height_m=robot.parameters.slot_height_m,
            landing_point_m=robot.parameters.landing_point_m,
            min_separation_m=robot.parameters.min_separation_m,
            errors=robot.errors,
            neighbours=peers,
            unreadable_robots=unreadable_robots,
            ground_release=ground_release,
            missing_robots=missing_robots,
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
            text = "watchdog has ended: restart this robot's program"
            failed = (*failed, FailedCheck(CheckCode.WATCHDOG_ENDED, text))
        if not is_member:
            text = "its key is not in the fleet's list of members: enroll this robot again"
            failed = (*failed, FailedCheck(CheckCode.NOT_A_MEMBER, text))
        if members_differ:
            failed = (*failed, FailedCheck(CheckCode.MEMBERS_DIFFER, members_differ))
        return Checks(failed, now_s, assignment)

    def _read(self) -> bool:
        """Read the parameters, and set the wrong ones; returns whether all were right."""
        # Report a change by others before setting it, and until the next read finds it restored.
        sets = self._config.failsafe.parameters == "set" and self._parameter_problems != ()
        try:
            values = self._setup.read_parameters(PARAMETERS)
            if sets and self._set_wrong(values) and not self._right:
                values = self._setup.read_parameters(PARAMETERS)
        except OSError as error:
            log.warning("PX4 parameters not read or set", error=str(error))
            self._parameter_problems = None
            return False
        problems = check_parameters(self._requirements, values)
        if not problems:
            self._right = {each.name: values[each.name] for each in self._requirements}
        changed = "; ".join(_differences(self._right, values))
        suffix = f" (changed by somebody else: {changed})" if problems and changed else ""
        self._parameter_problems = tuple(problem + suffix for problem in problems)
        timeout_s = self._config.flight.command_timeout_s
        hang = f"if this program hangs, its watchdog lets PX4 hold, {timeout_s:g} s later"
        self.explanations = (hang, *explain(values))
        return not problems

    def _set_wrong(self, values: dict[str, int | float | None]) -> bool:
        """Set each wrong parameter that can be set; returns whether there was any."""
        wrong = [
            (requirement, requirement.value_to_set)
            for requirement in self._requirements
            if values.get(requirement.name) is not None
            and requirement.problem(values[requirement.name]) is not None
            and requirement.value_to_set is not None
        ]
        for requirement, value in wrong:
            self._set(requirement.name, values[requirement.name], value, requirement.why)
        return bool(wrong)

    def _set(self, name: str, before: float | None, value: float, why: str) -> None:
        self._setup.set_parameter(name, value)
        change = f"{name} from {before:g} to {value:g}"
        self.changes = (*self.changes, change)
        log.warning("PX4 parameter set", change=change, why=why)

    def _check_fence(self, now_s: float) -> None:
        """Report a fence that others changed, until two reads after a new upload find it.

        One read is not enough: it may show the moment after the upload.
        """
        if self._uploaded is None:
            return
        try:
            if self._setup.has_fence():
                self._fence_doubts = max(self._fence_doubts - 1, 0)
                return
        except OSError as error:
            log.warning("fence not read", error=str(error))
        else:
            self._fence_doubts = 2
            log.warning("fence was changed by somebody else")
        self._uploaded, self._fence_due_s = None, now_s + _RETRY_S

    def _upload_fence(self, origin: Origin, fence: Fence) -> None:
        # Without an answer the vehicle may have the new fence, the former, or none.
        self._uploaded = None
        try:
            self._send_fence(origin, fence)
        except OSError as error:
            log.warning("fence upload failed", error=str(error))
            return
        self._uploaded = origin, fence

    def _send_fence(self, origin: Origin, fence: Fence) -> None:
        frame = origin.frame()
        grown_m = fence.grown_m(self._config.failsafe.fence_margin_m)
        self._setup.upload_fence([frame.to_global_deg(*vertex) for vertex in grown_m])

    def _watch(self, now_s: float, *, steers: bool) -> None:
        """Report settings that changed since preflight, and restore them if allowed."""
        self._read_due_s = now_s + _READ_PERIOD_S
        # Armed by others, or before this program's start: preflight has not passed.
        if self._parameter_problems or not self._right or self._uploaded is None:
            return
        try:
            read = self._setup.read_parameters(PARAMETERS)
            has_fence = self._setup.has_fence()
        except OSError as error:
            log.warning("not known whether PX4 was changed", error=str(error))
            return
        # A parameter without an answer counts as unchanged.
        values = {n: was if read[n] is None else read[n] for n, was in self._right.items()}
        # The control loop sets it in flight; if others do, the position is soon lost.
        values[GPS_CONTROL] = self._right.get(GPS_CONTROL)
        wrong: tuple[str, ...] = ()
        if check_parameters(self._requirements, values):
            wrong = _differences(self._right, values)
        else:
            self._right = values
        may_set = not wrong or self._config.failsafe.parameters == "set"
        if not has_fence:
            wrong = (*wrong, "its fence")
        if not wrong:
            self._changed_since_s = math.inf
            if self._changed:
                what = ", ".join(self._changed)
                text = f"somebody changed the autopilot in flight, and it was restored: {what}"
                self.px4_change = Px4Change(text, False)
            return
        self._changed = tuple(dict.fromkeys((*self._changed, *wrong)))
        self._changed_since_s = min(self._changed_since_s, now_s)
        stays = not may_set or now_s - self._changed_since_s > _RESTORED_WITHIN_S
        self._read_due_s = now_s + (_READ_PERIOD_S if stays else 0.0)
        how = "not restored" if stays else "being restored"
        text = f"somebody changed the autopilot in flight, {how}: {', '.join(wrong)}"
        change = Px4Change(text, stays)
        if change != self.px4_change:
            log.warning("PX4 was changed in flight", what=wrong, stays=stays)
        self.px4_change = change
        if steers:
            self._restore(values if may_set else self._right, has_fence=has_fence)

    def _restore(self, values: dict[str, int | float | None], *, has_fence: bool) -> None:
        try:
            for name, right in self._right.items():
                if right is not None and values[name] != right:
                    self._set(name, values[name], right, "changed in flight")
            if not has_fence and self._uploaded is not None:
                self._send_fence(*self._uploaded)
        except OSError as error:
            log.warning("PX4 not restored", error=str(error))


def _differences(
    before: Mapping[str, float | None], after: Mapping[str, float | None]
) -> tuple[str, ...]:
    return tuple(
        f"{name} from {was:g} to {now:g}"
        for name, was in before.items()
        if was is not None and (now := after.get(name)) is not None and now != was
    )
