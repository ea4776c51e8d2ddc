"""The robot's program under systemd, started and stopped; a vehicle without one, landed."""

import time
from base64 import b64encode
from typing import Any

from edge.drivers.px4.raw_mavlink import land_command
from lpac.fleet.agent import UNIT
from lpac.fleet.hold import Report
from lpac.fleet.session import RemoteError, Session
from lpac.fleet.settings import FleetConfig, RobotHost

# Where PX4's sticks fly the vehicle.
_PILOTED = ("manual", "stabilized", "altitude", "position")
# PX4 tells its mode once a second.
_LANDS_S = 8.0
_COMPONENT = 198  # beside the robot's program and its watchdog


async def start(session: Session, config: FleetConfig) -> None:
    """Start the unit now and at every boot, and wait until the program is well.

    Raises RemoteError if it is not, or if a file of the release is not what it was when it came.
    """
    await require_whole(session, config)
    await _start(session)


async def restart(
    session: Session, config: FleetConfig, robot: RobotHost, *, in_flight: bool
) -> None:
    """Stop the unit and start it again; as `stop` and `start`."""
    # First what takes time: a vehicle may wait in the air.
    await require_whole(session, config)
    await stop(session, robot, in_flight=in_flight, disable=False)
    await _start(session)


async def require_whole(session: Session, config: FleetConfig) -> None:
    """Raises RemoteError if a file of the current release is not what it was when it came."""
    current = f"{config.directory}/current/"
    if (await session.run("test", "-e", f"{current}robot.toml")).code != 0:
        raise RemoteError("there is no release for a slot on this robot: deploy first")
    await session.call("check", folder=current)


async def _start(session: Session) -> None:
    await session.run("systemctl", "reset-failed", UNIT)
    await session.must("systemctl", "enable", UNIT)
    # A program that cannot start shows in its health, with the reason.
    await session.run("systemctl", "start", UNIT, timeout_s=90.0)
    await session.call("health")


async def stop(session: Session, robot: RobotHost, *, in_flight: bool, disable: bool) -> None:
    """Stop the unit; a vehicle in flight holds or lands then, as its `on_stop` says.

    Refused while the vehicle is armed unless `in_flight` insists. With `disable` it does not start
    at the next boot either.
    """
    if not in_flight:
        await require_disarmed(session, robot, "stopping")
    if (await session.call("service"))["installed"]:
        await session.must("systemctl", "stop", UNIT)
        if disable:
            await session.must("systemctl", "disable", UNIT)


async def require_disarmed(session: Session, robot: RobotHost, doing: str) -> None:
    """Raises RemoteError if the vehicle is armed, as far as anybody on the robot can tell."""
    await session.call("require_disarmed", mavlink_port=robot.mavlink_port, doing=doing)


async def hear_heartbeat(session: Session, robot: RobotHost) -> dict[str, Any] | None:
    """PX4's heartbeat within 2.5 s, and its `sender`; None if none comes."""
    heard = await session.call("hear_heartbeat", port=robot.mavlink_port)
    beat: dict[str, Any] | None = heard["heartbeat"]
    return beat


async def land(session: Session, robot: RobotHost, report: Report) -> dict[str, Any]:
    """Let PX4 land where it is; the last heartbeat that was heard of it.

    Refused while the program runs, and while a pilot flies: neither is to be fought with.
    """
    if (await session.call("service"))["fresh"]:
        raise RemoteError(
            "its program runs: `lpac mission land` lands it, in pilot after `lpac mission rejoin`"
        )
    report("listens to PX4", None)
    beat = await hear_heartbeat(session, robot)
    if beat is None:
        raise RemoteError(f"nothing is heard of PX4 at UDP port {robot.mavlink_port}")
    if beat["system_id"] != robot.system_id:
        raise RemoteError(
            f"PX4 is system {beat['system_id']}, not {robot.system_id}: mend the fleet file"
        )
    if not beat["armed"]:
        raise RemoteError("it is disarmed: nothing is to land")
    if beat["mode"] in _PILOTED:
        raise RemoteError(f"a pilot flies it ({beat['mode']}): he lands it")
    report("lands it", None)
    until_s, sequence = time.monotonic() + _LANDS_S, 0
    while beat["armed"] and beat["mode"] != "land":
        if time.monotonic() > until_s:
            raise RemoteError(f"it does not land, and is in {beat['mode']}: a pilot must take it")
        sequence += 1
        command = land_command(sequence, robot.system_id, _COMPONENT)
        await session.call(
            "send", port=robot.mavlink_port, to=beat["sender"], content=b64encode(command).decode()
        )
        beat = await hear_heartbeat(session, robot) or beat
    return beat
