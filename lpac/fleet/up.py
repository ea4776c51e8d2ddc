"""`lpac fleet up`: wait for the robots, set their clocks, start their programs, and decide."""

import asyncio
import math
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from edge.core.wire import PayloadType
from edge.drivers.registry import load_policy
from edge.flight.energy import EnergyParameters, home_s
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
from lpac.fleet.members import send_members
from lpac.fleet.operations import Outcome
from lpac.fleet.program import require_disarmed, start
from lpac.fleet.session import RemoteError, Session, UnreachableError
from lpac.fleet.settings import FleetConfig, RobotHost

_RETRY_S = 1.0
# The file of `edge.drivers.identity_folder`, and the limit of `edge.identity.guard`.
_START, _MAX_AHEAD_MS = "/var/lib/private/lpac/identity/start", 24 * 3600 * 1000
# Share of multicast frames lost on Wi-Fi at a medium distance.
_LOST = 0.05


class UpResult(NamedTuple):
    """Steps done to bring a robot up, and problems, in words."""

    done: tuple[str, ...]
    problems: tuple[str, ...]


class BatteryReport(NamedTuple):
    """A robot's battery: its charge (0 to 1) and the trials that it lasts for; None if unknown.

    `endurance_s` is that of a full battery, as measured in the last flight or else as configured.
    """

    robot: str
    share: float | None
    endurance_s: float | None
    trials: int | None


class GroupCost(NamedTuple):
    """Datagrams per message in a multicast group, all of which must be received.

    `datagrams` is the number for an empty map and for one that does not compress; `lost` the shares
    of such messages that are lost if 5 % of datagrams are. More than `MOST_FRAGMENTS` are not sent.
    """

    payload: PayloadType
    datagrams: tuple[int, int]
    lost: tuple[float, float]


def group_costs(config: FleetConfig) -> list[GroupCost]:
    """Cost of each payload type that the fleet's robots use; [] without multicast.

    Raises BundleError, ConfigError or OSError for a policy that cannot be loaded.
    """
    if config.radio.transport != "multicast":
        return []
    policy = load_policy(load_bundle(config.bundle))
    evaluated = policy.manifest.payload_types
    flying = [slot.robot for slot in config.slots if slot.robot is not None]
    payloads = [config.robot_config(name).policy.payload_of(evaluated) for name in flying]
    costs = []
    for payload in dict.fromkeys(payloads):
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
) -> UpResult:
    """Wait for the robot, set its clock, finish an interrupted switch, start its program.

    `until_s` is the deadline on the monotonic clock. A program that was stopped on purpose is not
    started. Raises FleetError if the robot does not answer in time or another one does.
    """
    while True:
        try:
            async with visit(config, robot, report) as (session, _):
                return await _bring_up(config, robot, session, unix_time_s)
        except UnreachableError as error:
            # A booting robot refuses connections and breaks them off.
            if time.monotonic() + _RETRY_S > until_s:
                raise
            report(f"wait: {error}", None)
            await asyncio.sleep(_RETRY_S)


async def _bring_up(
    config: FleetConfig,
    robot: RobotHost,
    session: Session,
    unix_time_s: Callable[[], float],
) -> UpResult:
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
            done.append(f"clock set by {-clock.offset_s:+.2f} s")
            is_right = True
    except RemoteError as error:
        problems.append(str(error))
    if is_right and await renumber_starts(session):
        problems.append(
            "its program was started while its clock was more than a day ahead, so its messages "
            f"are ignored: `lpac fleet restart --robots {robot.name}`"
        )
    try:
        sent = await send_members(session, config)
        done += [sent] if sent is not None else []
    except RemoteError as error:
        problems.append(str(error))
    if not locked:
        return UpResult(tuple(done), tuple(problems))
    try:
        service = await session.call("service")
        idle = service["enabled"] and service["active"] != "active"
        if idle and config.slot_of(robot.name) is not None:
            await start(session, config)
            done.append("program started")
    except RemoteError as error:
        problems.append(str(error))
    return UpResult(tuple(done), tuple(problems))


async def set_clock(session: Session, robot: RobotHost, offset_s: float) -> None:
    """Step the wall clock back by `offset_s`, and set the battery-backed clock if there is one.

    Refused while the vehicle is armed. The program may run meanwhile, since it uses monotonic time;
    only the flight log's times jump. Raises RemoteError.
    """
    await require_disarmed(session, robot, "setting the clock")
    set_it = f"import time as t; t.clock_settime(0, t.clock_gettime(0) - {offset_s!r})"
    if (await session.run("python3", "-c", set_it)).code != 0:
        raise RemoteError("its clock cannot be set: its system does not allow it (a container?)")
    await session.run("sh", "-c", "ls /dev/rtc* && hwclock -w")


async def renumber_starts(session: Session) -> bool:
    """Reset the number of the program's last start if it is more than a day ahead of the clock.

    Others ignore messages of such a start. The clock must be right. Returns whether it was ahead.
    """
    output = await session.capture({"start": f"cat {_START}", "now": "date +%s%3N"})
    start, now = output["start"], output["now"]
    if not start.isdigit() or int(start) <= int(now) + _MAX_AHEAD_MS:
        return False
    await session.write({_START: f"{now}\n".encode()}, 0o600)
    return True


def combine_checks(
    config: FleetConfig,
    results: Sequence[Outcome[UpResult]],
    examinations: Sequence[Outcome[Examination]],
) -> list[Diagnosis]:
    """Each robot's checks: `up`, then the doctor's."""
    examined = {diagnosis.robot: diagnosis for diagnosis in diagnose(config, examinations)}
    diagnoses = []
    for outcome in results:
        name = outcome.robot.name
        if outcome.value is None:
            checks = (DoctorCheck("up", "FAILED", outcome.problem or ""),)
            diagnoses.append(Diagnosis(name, checks))
            continue
        problems = "; ".join(outcome.value.problems)
        done = "; ".join(outcome.value.done) or "nothing to do"
        check = DoctorCheck("up", "FAILED", problems) if problems else DoctorCheck("up", "ok", done)
        diagnoses.append(Diagnosis(name, (check, *examined[name].checks)))
    return diagnoses


def batteries_of(
    config: FleetConfig, examinations: Sequence[Outcome[Examination]], trial_s: float
) -> list[BatteryReport]:
    """Batteries of the robots with a slot, as their programs report them."""
    found = []
    for outcome in examinations:
        robot, examination = outcome.robot, outcome.value
        if examination is None or config.slot_of(robot.name) is None:
            continue
        service = examination.facts["service"]
        status = (service["status"] or {}) if service["fresh"] else {}
        share, endurance_s = status.get("battery"), status.get("endurance_s")
        count = None
        if share is not None and endurance_s is not None:
            configured = config.robot_config(robot.name)
            flight, limits = configured.flight, configured.limits
            vertices_m = configured.fence.vertices_m
            count = trials(
                configured.energy,
                share=share,
                min_battery=configured.preflight.min_battery,
                battery_low=flight.battery_low,
                battery_critical=flight.battery_critical,
                endurance_s=endurance_s,
                trial_s=trial_s,
                # A mission may end anywhere.
                away_m=max(math.dist(vertex, flight.landing_point_m) for vertex in vertices_m),
                slot=flight.slot,
                slot_height_m=flight.slot_height_m,
                max_speed_m_s=limits.max_speed_m_s,
                max_climb_m_s=limits.max_climb_m_s,
            )
        found.append(BatteryReport(robot.name, share, endurance_s, count))
    return found


def trials(
    parameters: EnergyParameters,
    *,
    share: float,
    min_battery: float,
    battery_low: float,
    battery_critical: float,
    endurance_s: float,
    trial_s: float,
    away_m: float,
    slot: int,
    slot_height_m: float,
    max_speed_m_s: float,
    max_climb_m_s: float,
) -> int:
    """Number of trials that a pack allows, without any in which the robot would return early.

    Each trial is a climb to the slot, a wait for the others, `trial_s` of mission, and the way home
    from `away_m` with queue and landing. The next takeoff needs at least `min_battery`.
    """
    down_s = home_s(
        parameters,
        away_m=away_m,
        height_m=slot_height_m,
        slot=slot,
        slot_height_m=slot_height_m,
        max_speed_m_s=max_speed_m_s,
        max_climb_m_s=max_climb_m_s,
    )
    returns_at = max(battery_low, battery_critical + down_s / endurance_s)
    mission_s = 2.0 * slot_height_m / max_climb_m_s + trial_s
    # Share that may be used before the last trial begins.
    until = max(min_battery, returns_at + mission_s / endurance_s)
    each_s = mission_s + down_s - parameters.reserve_s
    return max(math.floor((share - until) * endurance_s / each_s) + 1, 0)
