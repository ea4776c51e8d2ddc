"""Steps of enrolling that set up the robot's computer and vehicle. Each may be repeated."""

import asyncio
import json
import time
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, Self

from edge.core.schema import ConfigError
from lpac.fleet.deploy import lpac_inside
from lpac.fleet.hold import identity_of, other_identity
from lpac.fleet.probes import VISION_HUB, containers, unit, without_comments
from lpac.fleet.program import receive_heartbeat, require_disarmed, require_whole, start, stop
from lpac.fleet.session import OnProgress, RemoteError, Session
from lpac.fleet.settings import FleetConfig, RobotHost

# Bridge from PX4 to DDS, by which a predecessor's program commands the vehicle.
_DDS_AGENT = "voxl-microdds-agent"
# Other ModalAI units that may send setpoints.
_BRIDGES = ("voxl-mpa-to-ros", "voxl-mpa-to-ros2")
_HUB_UNIT = "voxl-vision-hub"
_PX4 = "voxl-px4"
# PX4 saves changed parameters within 2 s.
_PARAMETERS_SAVED_S = 3.0
# Start of PX4, its MAVLink server and voxl-vision-hub.
_PX4_STARTS_S = 40.0


class EnrollStep(NamedTuple):
    """Result of a step of enrolling."""

    name: str
    outcome: Literal["done", "was so already", "skipped", "left to do"]
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, name: str, changed: bool, notes: Sequence[str] = ()) -> Self:
        """Step whose outcome is "done" or "was so already"."""
        return cls(name, "done" if changed else "was so already", tuple(notes))


async def set_identity(
    session: Session, config: FleetConfig, robot: RobotHost, found: dict[str, Any] | None
) -> EnrollStep:
    """Write the robot's identity; `found` is the present one."""
    wanted = identity_of(config, robot)
    if found != wanted:
        await session.write({"/etc/lpac/robot.json": json.dumps(wanted).encode() + b"\n"})
    former = other_identity(found, config, robot)
    return EnrollStep.of("robot id", found != wanted, [f"it was {former}"] if former else [])


async def set_vision_hub(session: Session, robot: RobotHost) -> EnrollStep:
    """Configure voxl-vision-hub to forward MAVLink to this host and to send no setpoints."""
    name = "vision-hub"
    there = await session.run("cat", VISION_HUB)
    if there.code != 0:
        note = "not a VOXL2: make sure that PX4's MAVLink reaches this computer"
        return EnrollStep(name, "skipped", (note,))
    try:
        values = json.loads(without_comments(there.out))
    except ValueError as error:
        raise RemoteError(
            f"{VISION_HUB} is not JSON ({error}): repair it, or remove it and reinstall"
        ) from None
    if not isinstance(values, dict):
        raise RemoteError(
            f"{VISION_HUB} is not a JSON object: repair it, or remove it and reinstall"
        )
    wanted: dict[str, Any] = {"en_localhost_mavlink_udp": True, "offboard_mode": "off"}
    if "localhost_udp_port_number" in values:
        wanted["localhost_udp_port_number"] = robot.mavlink_port
    changes = [
        f"{key} from {json.dumps(values.get(key))} to {json.dumps(value)}"
        for key, value in wanted.items()
        if values.get(key) != value
    ]
    if not changes:
        return EnrollStep.of(name, False)
    await require_disarmed(session, robot, "changing voxl-vision-hub")
    kept = f"{VISION_HUB}.before-lpac"
    await session.check_output("sh", "-c", f"[ -e {kept} ] || cp -p {VISION_HUB} {kept}")
    await session.write({VISION_HUB: f"{json.dumps(values | wanted, indent=4)}\n".encode()})
    if (await unit(session, _HUB_UNIT))["active"]:
        await session.check_output("systemctl", "restart", _HUB_UNIT)
    else:
        changes.append(f"{_HUB_UNIT} does not run: see `systemctl status {_HUB_UNIT}`")
    return EnrollStep.of(name, True, changes)


async def stop_predecessors(
    session: Session, robot: RobotHost, predecessors: Sequence[str], on_progress: OnProgress
) -> EnrollStep:
    """Stop containers and units that used to command the vehicle, now and at boot.

    Nothing is deleted. Other programs that may send setpoints are noted.
    """
    known = await containers(session)
    by_name = {container["name"]: container for container in known or []}
    notes: list[str] = []

    async def stop_it(kind: str, name: str, *commands: tuple[str, ...]) -> None:
        await require_disarmed(session, robot, f"stopping {name}")
        on_progress(f"stop {name}")
        for command in commands:
            await session.check_output(*command)
        notes.append(f"stopped {kind} {name}")

    for name in (*predecessors, _DDS_AGENT):
        container, known_unit = by_name.get(name), await unit(session, name)
        if container and (container["running"] or container["restarts"] != "no"):
            update = ("docker", "update", "--restart=no", name)
            await stop_it("container", name, update, ("docker", "stop", name))
        if known_unit["active"] or known_unit["enabled"]:
            await stop_it("unit", name, ("systemctl", "disable", "--now", name))
    stopped = bool(notes)
    notes += [
        f"container {name} ({its['image']}) runs in this host's network: if it commands the "
        "vehicle, add it to predecessors"
        for name, its in by_name.items()
        if its["running"] and its["host_network"] and name not in predecessors
    ]
    notes += [
        f"unit {name} runs: if it sends setpoints, add it to predecessors"
        for name in _BRIDGES
        if name not in predecessors and (await unit(session, name))["active"]
    ]
    if known is not None:
        return EnrollStep.of("predecessors", stopped, notes)
    problem = (
        "docker does not answer, so its containers may command the vehicle: check "
        "`systemctl status docker` on the robot, then enroll again"
    )
    return EnrollStep("predecessors", "left to do", (*notes, problem))


async def set_up_px4(
    session: Session, config: FleetConfig, robot: RobotHost, on_progress: OnProgress
) -> EnrollStep:
    """Set the vehicle's system id and failsafe parameters with the current release's `lpac`.

    The robot's program is stopped meanwhile. PX4 is restarted if need be and if systemd runs it.
    Raises ConfigError or RemoteError.
    """
    ceiling = _value(config, robot, "fence", "ceiling_m")
    timeout = _value(config, robot, "flight", "command_timeout_s", 0.5)
    options = ("--url", robot.mavlink_url, "--system-id", robot.system_id, "--rc",
               _value(config, robot, "failsafe", "rc"), "--ceiling", ceiling,
               "--command-timeout", timeout)  # fmt: skip
    await require_disarmed(session, robot, "setting up PX4")
    state = (await session.call("service"))["active"]
    program_runs = state in ("active", "activating", "reloading")
    if program_runs:
        await require_whole(session, config)
        on_progress("stop the program")
        await stop(session, robot, in_flight=False, disable=False)
    try:
        on_progress("set PX4's parameters")
        current = f"{config.directory}/current"
        done = await lpac_inside(session, current, "robot", "setup", "--json", *map(str, options))
        try:
            result = json.loads(done.out)
        except ValueError:
            raise RemoteError(done.reason.replace("lpac: ", "", 1)) from None
        notes, needs_reboot = [*result["changes"]], result["needs_reboot"]
        restarts = needs_reboot and (await unit(session, _PX4))["active"]
        if restarts:
            on_progress("restart PX4")
            await asyncio.sleep(_PARAMETERS_SAVED_S)
            await require_disarmed(session, robot, "restarting PX4")
            await session.check_output("systemctl", "restart", _PX4)
            system_id = await _await_px4(session, robot)
            notes.append(f"PX4 was restarted and answers as system {system_id}")
            needs_reboot = system_id != robot.system_id
    finally:
        if program_runs:
            await start(session, config)
    if needs_reboot:
        notes.append("some parameters need a restart of PX4: switch the vehicle off and on")
    notes += result["problems"]
    if result["problems"] or needs_reboot:
        return EnrollStep("PX4", "left to do", tuple(notes))
    return EnrollStep.of("PX4", bool(result["changes"]) or restarts, notes)


def _value(
    config: FleetConfig, robot: RobotHost, table: str, key: str, default: object = None
) -> object:
    """The robot's value of `table.key` in robot.toml. Raises ConfigError if it has none."""
    value = config.values_of(robot).get(table, {}).get(key, default)
    if value is None:
        raise ConfigError(f"{config.path}: robot.{table}.{key} is missing")
    return value


async def _await_px4(session: Session, robot: RobotHost) -> int | None:
    """Wait for PX4's restart; return the system id that it answers with, or None."""
    system_id: int | None = None
    until_s = time.monotonic() + _PX4_STARTS_S
    while time.monotonic() < until_s and system_id != robot.system_id:
        beat = await receive_heartbeat(session, robot)
        system_id = beat["system_id"] if beat else system_id
    return system_id
