"""The start of a day in the field: robots that answer, clocks set, programs that run."""

import asyncio
import math
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from edge.core.wire import PayloadType
from edge.drivers.registry import load_policy
from edge.flight.energy import trials
from edge.identity.group import frames
from edge.policy.bundle import load_bundle
from edge.robot.pac import message_bytes
from lpac.fleet.doctor import (
    GOOD_CLOCK_OFFSET_S,
    Diagnosis,
    DoctorCheck,
    Examination,
    diagnose,
    measure_clock,
)
from lpac.fleet.hold import Report, lock, visit
from lpac.fleet.members import bring_members
from lpac.fleet.operations import Outcome
from lpac.fleet.program import require_disarmed, start
from lpac.fleet.session import RemoteError, Session, UnreachableError
from lpac.fleet.settings import FleetConfig, RobotHost

_ASK_AGAIN_S = 1.0
# As `edge.drivers.identity_folder` writes it, and `edge.identity.guard` refuses it.
_START, _MOST_AHEAD_MS = "/var/lib/private/lpac/identity/start", 24 * 3600 * 1000
# Of what goes to a group by Wi-Fi, where the receiver is neither near nor far.
_LOST = 0.05


class Arrival(NamedTuple):
    """Steps done on a robot to bring it up, and problems, in words."""

    done: tuple[str, ...]
    problems: tuple[str, ...]


class GoDecision(NamedTuple):
    """Whether a robot may fly, as far as that shows on the ground; and what speaks against it."""

    robot: str
    go: bool
    reasons: tuple[str, ...]


class Pack(NamedTuple):
    """A robot's battery: its share, and how many trials it is good for; None if not known.

    `endurance_s` is what a full one lasts, as measured in the last flight, or else as configured.
    """

    robot: str
    share: float | None
    endurance_s: float | None
    trials: int | None


class GroupCost(NamedTuple):
    """Cost of a robot's message in a multicast group: datagrams, all of which must come.

    `datagrams` are from so many, with a map that is almost nothing, to so many, with one that does
    not compress; `lost` is the share of messages, each of it, that are lost if one datagram of
    twenty is. More than `MOST_FRAGMENTS` are not sent.
    """

    payload: PayloadType
    datagrams: tuple[int, int]
    lost: tuple[float, float]


def group_costs(config: FleetConfig) -> list[GroupCost]:
    """For each payload that robots of the fleet speak in; none unless they speak in a group.

    Raises BundleError, ConfigError or OSError for a policy that cannot be loaded.
    """
    if config.radio.transport != "multicast":
        return []
    policy = load_policy(load_bundle(config.bundle))
    judged = policy.manifest.payload_types
    flying = [slot.robot for slot in config.slots if slot.robot is not None]
    spoken = [config.robot_config(name).policy.payload_of(judged) for name in flying]
    costs = []
    for payload in dict.fromkeys(spoken):
        least, most = map(frames, message_bytes(policy, payload))
        lost = 1.0 - (1.0 - _LOST) ** least, 1.0 - (1.0 - _LOST) ** most
        costs.append(GroupCost(payload, (least, most), lost))
    return costs


async def bring_up(
    config: FleetConfig,
    robot: RobotHost,
    until_s: float,
    report: Report,
    unix_time_s: Callable[[], float] = time.time,
) -> Arrival:
    """Wait for the robot, set its clock, finish an interrupted switch, start its program.

    It is waited for until `until_s` of the monotonic clock. A program that was stopped on purpose
    is not started. Raises FleetError if it does not come, or another robot answers.
    """
    while True:
        try:
            async with visit(config, robot, report) as (session, _):
                return await _bring_up(config, robot, session, unix_time_s)
        except UnreachableError as error:
            # A robot that is starting refuses connections, and breaks them off.
            if time.monotonic() + _ASK_AGAIN_S > until_s:
                raise
            report(f"waits: {error}", None)
            await asyncio.sleep(_ASK_AGAIN_S)


async def _bring_up(
    config: FleetConfig,
    robot: RobotHost,
    session: Session,
    unix_time_s: Callable[[], float],
) -> Arrival:
    done: list[str] = []
    problems: list[str] = []
    locked = is_right = False
    try:
        recovered = await lock(session, config, robot)
        locked = True
        done += [recovered] if recovered is not None else []
    except RemoteError as error:
        problems.append(str(error))
    try:
        clock = await measure_clock(session, unix_time_s)
        is_right = abs(clock.offset_s) <= GOOD_CLOCK_OFFSET_S + clock.uncertainty_s
        if not is_right:
            await set_clock(session, robot, clock.offset_s)
            done.append(f"its clock was set by {-clock.offset_s:+.2f} s")
            is_right = True
    except RemoteError as error:
        problems.append(str(error))
    if is_right and await renumber_starts(session):
        problems.append(
            "its program started by a clock more than a day ahead, and is not listened to: "
            f"`lpac fleet restart --robots {robot.name}`"
        )
    try:
        brought = await bring_members(session, config)
        done += [brought] if brought is not None else []
    except RemoteError as error:
        problems.append(str(error))
    if not locked:
        return Arrival(tuple(done), tuple(problems))
    try:
        service = await session.call("service")
        idle = service["enabled"] and service["active"] != "active"
        if idle and config.slot_of(robot.name) is not None:
            await start(session, config)
            done.append("its program was started")
    except RemoteError as error:
        problems.append(str(error))
    return Arrival(tuple(done), tuple(problems))


async def set_clock(session: Session, robot: RobotHost, offset_s: float) -> None:
    """Take `offset_s` off the wall clock at once, and set the battery-backed clock if there is one.

    Refused while the vehicle is armed. On the ground the program may run meanwhile: it counts
    monotonic time. Only the flight log's times jump as the clock does. Raises RemoteError.
    """
    await require_disarmed(session, robot, "setting the clock")
    set_it = f"import time as t; t.clock_settime(0, t.clock_gettime(0) - {offset_s!r})"
    if (await session.run("python3", "-c", set_it)).code != 0:
        raise RemoteError(
            "its clock cannot be set: the system does not let root do that (a container?)"
        )
    await session.run("sh", "-c", "ls /dev/rtc* && hwclock -w")


async def renumber_starts(session: Session) -> bool:
    """Number the program's starts by the clock again if the last was more than a day ahead of it.

    Nobody listens to such a start. The clock must be right. Whether it was ahead.
    """
    said = await session.look({"start": f"cat {_START}", "now": "date +%s%3N"})
    if not said["start"].isdigit() or int(said["start"]) <= int(said["now"]) + _MOST_AHEAD_MS:
        return False
    await session.write({_START: f"{said['now']}\n".encode()}, 0o600)
    return True


def board(
    config: FleetConfig,
    arrivals: Sequence[Outcome[Arrival]],
    examinations: Sequence[Outcome[Examination]],
) -> list[Diagnosis]:
    """All robots' checks: the doctor's, and what kept them from coming up."""
    examined = {diagnosis.robot: diagnosis for diagnosis in diagnose(config, examinations)}
    diagnoses = []
    for outcome in arrivals:
        name = outcome.robot.name
        if outcome.value is None:
            checks = (DoctorCheck("up", "FAILED", outcome.problem or ""),)
            diagnoses.append(Diagnosis(name, checks))
            continue
        problems = "; ".join(outcome.value.problems)
        done = "; ".join(outcome.value.done) or "nothing was to be done"
        came = DoctorCheck("up", "FAILED", problems) if problems else DoctorCheck("up", "ok", done)
        diagnoses.append(Diagnosis(name, (came, *examined[name].checks)))
    return diagnoses


def packs(
    config: FleetConfig, examinations: Sequence[Outcome[Examination]], trial_s: float
) -> list[Pack]:
    """Endurance of the batteries in the slots' robots, as their programs know them."""
    found = []
    for outcome in examinations:
        robot, examination = outcome.robot, outcome.value
        if examination is None or config.slot_of(robot.name) is None:
            continue
        service = examination.facts["service"]
        said = (service["status"] or {}) if service["fresh"] else {}
        share, endurance_s = said.get("battery"), said.get("endurance_s")
        count = None
        if share is not None and endurance_s is not None:
            flown = config.robot_config(robot.name)
            flight, limits = flown.flight, flown.limits
            count = trials(
                flown.energy,
                share=share,
                min_battery=flown.preflight.min_battery,
                battery_low=flight.battery_low,
                battery_critical=flight.battery_critical,
                endurance_s=endurance_s,
                trial_s=trial_s,
                # A mission may end anywhere.
                away_m=max(math.dist(v, flight.landing_point_m) for v in flown.fence.vertices_m),
                slot=flight.slot,
                slot_height_m=flight.slot_height_m,
                max_speed_m_s=limits.max_speed_m_s,
                max_climb_m_s=limits.max_climb_m_s,
            )
        found.append(Pack(robot.name, share, endurance_s, count))
    return found


def decide(diagnosis: Diagnosis) -> GoDecision:
    """Go or no-go: no-go for whatever failed."""
    failed = diagnosis.failed()
    return GoDecision(
        diagnosis.robot, not failed, tuple(f"{check.name}: {check.found}" for check in failed)
    )
