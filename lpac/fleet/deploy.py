"""A release's way to a robot: travel, be checked whole, prove itself, switch; or change nothing."""

from pathlib import Path
from typing import NamedTuple

from lpac.fleet.cards import open_authority
from lpac.fleet.hold import Held, Report, hold
from lpac.fleet.release import Release
from lpac.fleet.session import FleetError, RemoteError, rsync
from lpac.fleet.settings import FleetConfig, RobotHost

# Of folders; files keep theirs, which the manifest has.
_MODES = "--chmod=Du=rwx,Dgo=rx"


class Deployed(NamedTuple):
    """A robot's new release, and its cost: bytes of content, and its policy's ticks, ms."""

    release: str
    summary: str
    sent_bytes: int
    perceive_p99_ms: float | None
    infer_p99_ms: float | None


async def deploy(
    config: FleetConfig, robot: RobotHost, release: Release, report: Report
) -> Deployed:
    """Bring `release` to the robot and run it there, or leave what runs untouched.

    Raises FleetError that says what went wrong; the robot then has what it had before.
    AuthorityError: the fleet has keys, and its authority is not on this computer.
    """
    authority = None if config.keys is None else open_authority(config)
    async with hold(config, robot, report) as held:
        before, session = held.found, held.session
        if before["machine"] != release.image.machine:
            raise RemoteError(
                f"it is {before['machine']}, and the image is for {release.image.machine}: "
                f"make image ARCH={'arm64' if before['machine'] == 'aarch64' else 'amd64'}"
            )
        spare = config.slot_of(robot.name) is None
        runs = spare or before["service"]["fresh"]
        if before["current"] == release.id and before["pending"] is None and runs:
            return Deployed(release.id, held.recovered or "unchanged", 0, None, None)
        sent_bytes = await _bring(config, robot, release, held, report)
        signature = authority and authority.sign_release(release.manifest_sha256)
        await session.call(
            "sign", directory=config.directory, release=release.id, signature=signature
        )
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


async def _bring(
    config: FleetConfig, robot: RobotHost, release: Release, held: Held, report: Report
) -> int:
    """Have the release whole on the robot; how many bytes of content travelled."""
    session = held.session
    place = await session.call(
        "prepare", directory=config.directory, release=release.id, image=release.image.id,
        size_bytes=release.size_bytes, mavlink_port=robot.mavlink_port,
    )  # fmt: skip
    if place["complete"]:
        return 0
    target, like = f":{place['incoming']}", place["like"]

    async def send(step: str, folder: Path, below: str, *options: str) -> int:
        try:
            return await rsync(
                config, robot, [f"{folder}/"], f"{target}{below}/",
                options=["--delete", "--partial", _MODES, *options,
                         *(f"--link-dest={folder}{below}" for folder in like)],
                sudo=held.found["sudo"], on_share=lambda share: report(step, share),
            )  # fmt: skip
        except FleetError as error:
            if "disk is full" in str(error):
                await session.call("discard", directory=config.directory, release=release.id)
            raise

    async def accept() -> None:
        report("check", None)
        await session.call("accept", directory=config.directory, release=release.id)

    sent_bytes = await send("policy", release.folder, "", "--exclude=/root")
    if place["has_image"]:
        try:
            await accept()
            return sent_bytes
        except RemoteError:
            pass  # The image that was there is damaged.
    sent_bytes += await send("image", release.image.folder, "/root")
    await accept()
    return sent_bytes


async def rollback(config: FleetConfig, robot: RobotHost, report: Report) -> str:
    """Run the last good release again; its id. Raises FleetError."""
    async with hold(config, robot, report) as held:
        after = await held.session.call(
            "rollback", directory=config.directory, mavlink_port=robot.mavlink_port
        )
        return str(after["current"])
