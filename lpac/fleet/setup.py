"""Set-up of a robot's computer and vehicle, as enrolling does it; each step may be repeated."""

import asyncio
import json
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, Self

from edge.core.schema import ConfigError
from lpac.fleet.deploy import lpac_inside
from lpac.fleet.hold import identity_of, other_identity
from lpac.fleet.probes import VISION_HUB, containers, unit, without_comments
from lpac.fleet.program import hear_heartbeat, require_disarmed, require_whole, start, stop
from lpac.fleet.session import RemoteError, Session
from lpac.fleet.settings import FleetConfig, RobotHost

# Bridges PX4 to DDS: through it a predecessor's program commands the vehicle.
_DDS_AGENT = "voxl-microdds-agent"
# What else of ModalAI's may send setpoints.
_BRIDGES = ("voxl-mpa-to-ros", "voxl-mpa-to-ros2")
_HUB_UNIT = "voxl-vision-hub"
_PX4 = "voxl-px4"
# PX4 writes changed parameters to its file up to two seconds later.
_PARAMETERS_SAVED_S = 3.0
# Until PX4, its MAVLink server and voxl-vision-hub are there again.
_PX4_STARTS_S = 40.0


class EnrolStep(NamedTuple):
    """One step of enrolling: what came of it, and what there is to say about it."""

    name: str
    outcome: Literal["done", "was so already", "skipped", "left to do"]
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, name: str, changed: bool, notes: Sequence[str] = ()) -> Self:
        """One that was done, or was so already."""
        return cls(name, "done" if changed else "was so already", tuple(notes))


async def set_identity(
    session: Session, config: FleetConfig, robot: RobotHost, found: dict[str, Any] | None
) -> EnrolStep:
    """Write who this robot is; `found` is what is there."""
    wanted = identity_of(config, robot)
    if found != wanted:
        await session.write({"/etc/lpac/robot.json": json.dumps(wanted).encode() + b"\n"})
    former = other_identity(found, config, robot)
    return EnrolStep.of("robot id", found != wanted, [f"it was {former}"] if former else [])


async def set_vision_hub(session: Session, robot: RobotHost) -> EnrolStep:
    """Let voxl-vision-hub forward MAVLink to this host, and send no setpoints of its own."""
    name = "vision-hub"
    there = await session.run("cat", VISION_HUB)
    if there.code != 0:
        note = "not a VOXL2: see that PX4's MAVLink comes to this computer"
        return EnrolStep(name, "skipped", (note,))
    try:
        values = json.loads(without_comments(there.out))
    except ValueError as error:
        raise RemoteError(
            f"{VISION_HUB} is no JSON ({error}): mend it, or remove it and reinstall"
        ) from None
    if not isinstance(values, dict):
        raise RemoteError(f"{VISION_HUB} is no JSON object: mend it, or remove it and reinstall")
    wanted: dict[str, Any] = {"en_localhost_mavlink_udp": True, "offboard_mode": "off"}
    if "localhost_udp_port_number" in values:
        wanted["localhost_udp_port_number"] = robot.mavlink_port
    changes = [
        f"{key} from {json.dumps(values.get(key))} to {json.dumps(value)}"
        for key, value in wanted.items()
        if values.get(key) != value
    ]
    if not changes:
        return EnrolStep.of(name, False)
    await require_disarmed(session, robot, "changing voxl-vision-hub")
    kept = f"{VISION_HUB}.before-lpac"
    await session.must("sh", "-c", f"[ -e {kept} ] || cp -p {VISION_HUB} {kept}")
    await session.write({VISION_HUB: f"{json.dumps(values | wanted, indent=4)}\n".encode()})
    if (await unit(session, _HUB_UNIT))["active"]:
        await session.must("systemctl", "restart", _HUB_UNIT)
    else:
        changes.append(f"{_HUB_UNIT} does not run: see `systemctl status {_HUB_UNIT}`")
    return EnrolStep.of(name, True, changes)


async def retire(
    session: Session, robot: RobotHost, predecessors: Sequence[str], say: Callable[[str], None]
) -> EnrolStep:
    """Stop containers and units that must not command the vehicle any more, also at boot.

    Nothing is deleted. What else runs and may send setpoints is told.
    """
    known = await containers(session)
    by_name = {container["name"]: container for container in known or []}
    notes: list[str] = []

    async def stop_it(kind: str, name: str, *commands: tuple[str, ...]) -> None:
        await require_disarmed(session, robot, f"stopping {name}")
        say(f"stops {name}")
        for command in commands:
            await session.must(*command)
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
        return EnrolStep.of("predecessors", stopped, notes)
    silent = (
        "docker does not answer, so its containers may command the vehicle: look at "
        "`systemctl status docker` on the robot, then enroll again"
    )
    return EnrolStep("predecessors", "left to do", (*notes, silent))


async def set_up_px4(
    session: Session, config: FleetConfig, robot: RobotHost, say: Callable[[str], None]
) -> EnrolStep:
    """Set the vehicle's system id and failsafe parameters by the current release's own program.

    The robot's program stands still meanwhile. PX4 is restarted where that is needed and systemd
    runs it. Raises ConfigError, or RemoteError.
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
        say("stops the program")
        await stop(session, robot, in_flight=False, disable=False)
    try:
        say("sets PX4's parameters")
        current = f"{config.directory}/current"
        done = await lpac_inside(session, current, "robot", "setup", "--json", *map(str, options))
        try:
            told = json.loads(done.out)
        except ValueError:
            raise RemoteError(done.reason.replace("lpac: ", "", 1)) from None
        notes, needs_reboot = [*told["changes"]], told["needs_reboot"]
        restarts = needs_reboot and (await unit(session, _PX4))["active"]
        if restarts:
            say("restarts PX4")
            await asyncio.sleep(_PARAMETERS_SAVED_S)
            await require_disarmed(session, robot, "restarting PX4")
            await session.must("systemctl", "restart", _PX4)
            system_id = await _await_px4(session, robot)
            notes.append(f"PX4 was restarted, and answers as system {system_id}")
            needs_reboot = system_id != robot.system_id
    finally:
        if program_runs:
            await start(session, config)
    if needs_reboot:
        notes.append("some of it counts after a restart only: switch the vehicle off and on")
    notes += told["problems"]
    if told["problems"] or needs_reboot:
        return EnrolStep("PX4", "left to do", tuple(notes))
    return EnrolStep.of("PX4", bool(told["changes"]) or restarts, notes)


def _value(
    config: FleetConfig, robot: RobotHost, table: str, key: str, default: object = None
) -> object:
    """Value that robot.toml would have there."""
    value = config.values_of(robot).get(table, {}).get(key, default)
    if value is None:
        raise ConfigError(f"{config.path}: robot.{table}.{key} is missing")
    return value


async def _await_px4(session: Session, robot: RobotHost) -> int | None:
    """As which system PX4 answers after its restart; None if it is silent."""
    heard: int | None = None
    until_s = time.monotonic() + _PX4_STARTS_S
    while time.monotonic() < until_s and heard != robot.system_id:
        beat = await hear_heartbeat(session, robot)
        heard = beat["system_id"] if beat else heard
    return heard
