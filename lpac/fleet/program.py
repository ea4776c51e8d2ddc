"""Start and stop the robot's unit; land a vehicle whose program is gone."""

import time
from base64 import b64encode
from typing import Any

from edge.drivers.px4.raw_mavlink import land_command
from lpac.fleet.agent import UNIT
from lpac.fleet.hold import Report
from lpac.fleet.session import RemoteError, Session
from lpac.fleet.settings import FleetConfig, RobotHost

# PX4 modes that a pilot flies by the sticks.
_PILOTED = ("manual", "stabilized", "altitude", "position")
# PX4 reports its mode at 1 Hz.
_LANDS_S = 8.0
_COMPONENT = 198  # MAVLink component id, distinct from the program's and its watchdog's


async def start(session: Session, config: FleetConfig) -> None:
    """Start the unit, now and at every boot, and wait until the program is healthy.

    Raises RemoteError if it does not become healthy or the release is damaged.
    """
    await require_whole(session, config)
    await _start(session)


async def restart(
    session: Session, config: FleetConfig, robot: RobotHost, *, in_flight: bool
) -> None:
    """`stop`, then `start`."""
    # The slow check comes first: a vehicle may be in the air between stop and start.
    await require_whole(session, config)
    await stop(session, robot, in_flight=in_flight, disable=False)
    await _start(session)


async def require_whole(session: Session, config: FleetConfig) -> None:
    """Raises RemoteError if the current release is missing, damaged, or a spare's."""
    current = f"{config.directory}/current/"
    if (await session.run("test", "-e", f"{current}robot.toml")).code != 0:
        raise RemoteError("there is no release for a slot on this robot: deploy first")
    await session.call("check", folder=current)


async def _start(session: Session) -> None:
    await session.run("systemctl", "reset-failed", UNIT)
    await session.check_output("systemctl", "enable", UNIT)
    # `health` reports a program that cannot start, with the reason.
    await session.run("systemctl", "start", UNIT, timeout_s=90.0)
    await session.call("health")


async def stop(session: Session, robot: RobotHost, *, in_flight: bool, disable: bool) -> None:
    """Stop the unit; with `disable`, also at boot. A vehicle in flight follows `on_stop`.

    Refused while the vehicle is armed, unless `in_flight`.
    """
    if not in_flight:
        await require_disarmed(session, robot, "stopping")
    if (await session.call("service"))["installed"]:
        await session.check_output("systemctl", "stop", UNIT)
        if disable:
            await session.check_output("systemctl", "disable", UNIT)


async def require_disarmed(session: Session, robot: RobotHost, doing: str) -> None:
    """Raises RemoteError if the vehicle is known to be armed."""
    await session.call("require_disarmed", mavlink_port=robot.mavlink_port, doing=doing)


async def receive_heartbeat(session: Session, robot: RobotHost) -> dict[str, Any] | None:
    """Wait up to 2.5 s for PX4's heartbeat; return it with its `sender`, or None."""
    received = await session.call("receive_heartbeat", port=robot.mavlink_port)
    beat: dict[str, Any] | None = received["heartbeat"]
    return beat


async def land(session: Session, robot: RobotHost, report: Report) -> dict[str, Any]:
    """Command PX4 to land where it is; return its last heartbeat.

    Raises RemoteError if the robot's program runs, a pilot flies, or PX4 does not land.
    """
    if (await session.call("service"))["fresh"]:
        raise RemoteError(
            "its program runs: use `lpac mission land`, in pilot after `lpac mission rejoin`"
        )
    report("await PX4", None)
    beat = await receive_heartbeat(session, robot)
    if beat is None:
        raise RemoteError(f"no heartbeat of PX4 at UDP port {robot.mavlink_port}")
    if beat["system_id"] != robot.system_id:
        raise RemoteError(
            f"PX4 is system {beat['system_id']}, not {robot.system_id}: correct fleet.toml"
        )
    if not beat["armed"]:
        raise RemoteError("it is disarmed: there is nothing to land")
    if beat["mode"] in _PILOTED:
        raise RemoteError(f"a pilot flies it ({beat['mode']}): the pilot must land it")
    report("land", None)
    until_s, sequence = time.monotonic() + _LANDS_S, 0
    while beat["armed"] and beat["mode"] != "land":
        if time.monotonic() > until_s:
            raise RemoteError(f"it does not land and is in {beat['mode']}: a pilot must take over")
        sequence += 1
        command = land_command(sequence, robot.system_id, _COMPONENT)
        await session.call(
            "send", port=robot.mavlink_port, to=beat["sender"], content=b64encode(command).decode()
        )
        beat = await receive_heartbeat(session, robot) or beat
    return beat
