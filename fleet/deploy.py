"""A release's way to a robot: travel, be checked whole, prove itself, switch; or change nothing."""

import getpass
import socket
from collections.abc import Callable
from typing import NamedTuple

from fleet.config import FleetConfig, RobotHost
from fleet.release import Release
from fleet.session import FleetError, RemoteError, Session, connect, rsync

# The step, and the share of it that is done where that is known.
Report = Callable[[str, float | None], None]

# Of folders; files keep theirs, which the manifest has.
_MODES = "--chmod=Du=rwx,Dgo=rx"


class Deployed(NamedTuple):
    """What a robot has now, and what it took: bytes of content, and its policy's ticks, ms."""

    release: str
    summary: str
    sent_bytes: int
    perceive_p99_ms: float | None
    infer_p99_ms: float | None


def operator() -> str:
    """Who changes robots from here, for whoever else tries to."""
    return f"{getpass.getuser()}@{socket.gethostname()}"


def check_identity(
    identity: dict[str, object] | None, config: FleetConfig, robot: RobotHost
) -> None:
    """Raises RemoteError if another robot answers at this one's address."""
    if identity is None:
        raise RemoteError(
            f"it is not enrolled: run `lpac fleet enroll {robot.name} {robot.host}` once"
        )
    wanted = {"fleet": config.fleet, "robot": robot.name, "robot_id": robot.robot_id}
    if {key: identity.get(key) for key in wanted} != wanted:
        raise RemoteError(
            f"at {robot.host} answers {identity.get('robot')} of fleet {identity.get('fleet')} "
            f"(id {identity.get('robot_id')}): mend the host in {config.path.name}, or enroll it"
        )


async def deploy(
    config: FleetConfig, robot: RobotHost, release: Release, report: Report
) -> Deployed:
    """Bring `release` to the robot and run it there, or leave what runs untouched.

    Raises FleetError that says what went wrong; the robot then has what it had before.
    """
    report("connect", None)
    async with connect(config, robot, lambda step: report(step, None)) as session:
        before = await session.call("overview", directory=config.directory)
        check_identity(before["identity"], config, robot)
        if before["machine"] != release.image.machine:
            raise RemoteError(
                f"it is {before['machine']}, and the image is for {release.image.machine}: "
                f"make image ARCH={'arm64' if before['machine'] == 'aarch64' else 'amd64'}"
            )
        await session.call("lock", directory=config.directory, who=operator())
        before = await session.call("overview", directory=config.directory)
        spare = config.slot_of(robot.name) is None
        runs = spare or before["service"]["fresh"]
        if before["current"] == release.id and before["pending"] is None and runs:
            return Deployed(release.id, "unchanged", 0, None, None)
        place = await session.call(
            "prepare", directory=config.directory, release=release.id, image=release.image.id,
            size_bytes=release.size_bytes, mavlink_port=robot.mavlink_port,
        )  # fmt: skip
        sent_bytes = 0
        if not place["complete"]:
            sent_bytes = await _transfer(
                config, robot, release, session, place["incoming"], place["like"],
                sudo=before["sudo"], report=report,
            )  # fmt: skip
            report("check", None)
            await session.call("accept", directory=config.directory, release=release.id)
        proof = await session.call("prove", directory=config.directory, release=release.id)
        report("switch", None)
        after = await session.call(
            "switch", directory=config.directory, release=release.id,
            mavlink_port=robot.mavlink_port,
        )  # fmt: skip
        steps = proof["benchmark"]["steps"]
        return Deployed(
            after["current"],
            "spare, not started" if spare else "runs",
            sent_bytes,
            steps["perceive"]["p99_ms"],
            steps["infer"]["p99_ms"],
        )


async def _transfer(
    config: FleetConfig,
    robot: RobotHost,
    release: Release,
    session: Session,
    incoming: str,
    like: list[str],
    *,
    sudo: bool,
    report: Report,
) -> int:
    options = ["--delete", "--partial", _MODES]
    try:
        sent = await rsync(
            config, robot, [f"{release.image.folder}/"], f":{incoming}/root/",
            options=[*options, *(f"--link-dest={folder}/root" for folder in like)],
            sudo=sudo, on_share=lambda share: report("image", share),
        )  # fmt: skip
        sent += await rsync(
            config, robot, [f"{release.folder}/"], f":{incoming}/",
            options=[*options, "--exclude=/root", *(f"--link-dest={folder}" for folder in like)],
            sudo=sudo, on_share=lambda share: report("policy", share),
        )  # fmt: skip
    except FleetError as error:
        if "disk is full" in str(error):
            await session.call("discard", directory=config.directory, release=release.id)
        raise
    return sent


async def rollback(config: FleetConfig, robot: RobotHost, report: Report) -> str:
    """Run the last good release again; its id. Raises FleetError."""
    report("connect", None)
    async with connect(config, robot, lambda step: report(step, None)) as session:
        found = await session.call("overview", directory=config.directory)
        check_identity(found["identity"], config, robot)
        await session.call("lock", directory=config.directory, who=operator())
        after = await session.call(
            "rollback", directory=config.directory, mavlink_port=robot.mavlink_port
        )
        return str(after["current"])
