"""A spare takes a failed robot's slot: its pad, height and landing point."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from edge.core.schema import ConfigError
from lpac.fleet.deploy import Deployed, deploy
from lpac.fleet.hold import Report, check_identity, hold, overview
from lpac.fleet.members import join
from lpac.fleet.program import stop
from lpac.fleet.release import load_common, make_release
from lpac.fleet.session import RemoteError, UnreachableError, connect
from lpac.fleet.settings import FleetConfig, RobotHost, load_fleet, select
from lpac.fleet.writer import assign


class Swapped(NamedTuple):
    """Result of a swap: the slot's index in the file, and what runs on the spare.

    `changed`: the slot was the failed robot's until now. `not_stopped` is why the failed robot
    could not be stopped, None if it was. `callers` are the robots whose configuration makes them
    connect to the spare; the spare connects to all others.
    """

    slot: int
    changed: bool
    deployed: Deployed
    not_stopped: str | None
    callers: tuple[str, ...]


async def swap(
    path: Path, failed: str, spare: str, report: Report, operator: Callable[[], str]
) -> Swapped:
    """Give the slot of `failed` to `spare`. A repeat finishes an interrupted swap.

    First the spare must answer and become a member, then the failed robot is stopped, then the
    slot changes hands. `operator` is as for `enroll`. Raises ConfigError; FleetError if the failed
    robot is armed or the release cannot be deployed; ValueError or OSError for a bad release.
    """
    config = load_fleet(path)
    index = _slot(config, failed, spare)
    changed = config.slots[index].robot == failed
    common = load_common(config)
    report(f"check {spare}", None)
    async with hold(config, config.robots[spare], report) as held:
        report(f"key of {spare}", None)
        await join(held.session, config, config.robots[spare], operator)
    report(f"stop {failed}", None)
    not_stopped = await _stop(config, config.robots[failed])
    report(path.name, None)
    assign(path, index, spare)
    config = load_fleet(path)
    robot = config.robots[spare]
    with tempfile.TemporaryDirectory(prefix="lpac-swap-") as folder:
        release = make_release(config, robot, common, Path(folder))
        deployed = await deploy(config, robot, release, report)
    return Swapped(index, changed, deployed, not_stopped, _callers(config, robot))


def _slot(config: FleetConfig, failed: str, spare: str) -> int:
    """Index of the slot that changes hands, or did in an earlier try. Raises ConfigError."""
    select(config, f"{failed},{spare}")
    slots = {slot.robot: index for index, slot in enumerate(config.slots)}
    if failed in slots and spare in slots:
        raise ConfigError(f"{config.path}: {spare} is not a spare: it has slots[{slots[spare]}]")
    if failed not in slots and spare not in slots:
        raise ConfigError(f"{config.path}: {failed} has no slot for {spare} to take")
    return slots[failed if failed in slots else spare]


def _callers(config: FleetConfig, robot: RobotHost) -> tuple[str, ...]:
    """Flying robots that connect to this one: of each pair, the one with the larger id does."""
    flying = (config.robots[slot.robot] for slot in config.slots if slot.robot is not None)
    return tuple(other.name for other in flying if other.robot_id > robot.robot_id)


async def _stop(config: FleetConfig, robot: RobotHost) -> str | None:
    """Stop the robot's program, now and at boot. Return why it could not be reached, or None.

    Raises RemoteError if it is armed.
    """
    try:
        async with connect(config, robot) as session:
            found = await overview(session, config)
            try:
                check_identity(found["identity"], config, robot)
            except RemoteError as error:
                return str(error)
            # Without the lock, which a broken robot may not give.
            await stop(session, robot, in_flight=False, disable=True)
    except UnreachableError as error:
        return str(error)
    return None
