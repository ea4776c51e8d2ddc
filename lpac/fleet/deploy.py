"""Deploy a release to a robot: send, check, verify, benchmark and switch, or change nothing."""

import json
from collections.abc import Iterable, Sequence, Set
from typing import Any, NamedTuple

from lpac.fleet.hold import Held, Report, earlier_than, hold
from lpac.fleet.members import send_members
from lpac.fleet.program import require_disarmed
from lpac.fleet.release import Release
from lpac.fleet.session import Done, FleetError, RemoteError, Session, rsync
from lpac.fleet.settings import FleetConfig, RobotHost

_MARGIN_MB = 100.0
# The policy's verification on a slow CPU.
_VERIFY_S = 150.0
# Runs lpac in the release's file system as the unit would, before any switch: as user nobody, or
# as root with a folder mounted read-only at /var/lib.
_INSIDE = """set -e; cd "$1/root"; state=$2; shift 2; mount --bind .. release
user=--userspec=65534:65534
if [ "$state" ]; then
    user=--userspec=0:0; mount --bind "$state" var/lib; mount -o remount,bind,ro var/lib
fi
mount -t proc proc proc; mount --rbind /sys sys; mount --rbind /dev dev
mount -t tmpfs tmpfs tmp; exec nice -n 5 chroot "$user" . /usr/bin/lpac "$@"
"""


class Deployed(NamedTuple):
    """A robot's new release, the bytes sent, and the policy's measured tick times, ms."""

    release: str
    summary: str
    sent_bytes: int
    perceive_p99_ms: float | None
    infer_p99_ms: float | None


async def lpac_inside(session: Session, release: str, *command: str, state: str = "") -> Done:
    """Run `lpac` from the release in that folder on the robot, mounted at /release as in the unit.

    Runs as nobody; with `state`, as root with that folder mounted read-only at /var/lib.
    """
    inside = ("unshare", "--mount", "sh", "-c", _INSIDE, "sh", release, state)
    return await session.run(*inside, *command, timeout_s=_VERIFY_S)


async def deploy(
    config: FleetConfig, robot: RobotHost, release: Release, report: Report
) -> Deployed:
    """Send `release` to the robot and run it.

    Raises FleetError with the cause; the robot then keeps its former release.
    """
    async with hold(config, robot, report) as held:
        before, session = held.found, held.session
        if before["machine"] != release.image.machine:
            raise RemoteError(
                f"it is {before['machine']}, and the image is for {release.image.machine}: "
                f"make image ARCH={'arm64' if before['machine'] == 'aarch64' else 'amd64'}"
            )
        await require_disarmed(session, robot, "deploying")
        spare = config.slot_of(robot.name) is None
        runs = spare or before["service"]["fresh"]
        if before["current"] == release.id and before["pending"] is None and runs:
            report("check", None)
            if await _is_whole(session, f"{config.directory}/current/"):
                await send_members(session, config)
                return Deployed(release.id, held.recovered or "unchanged", 0, None, None)
        incoming = f"{config.directory}/incoming/{release.id}"
        kept = await _make_room(session, config, release, before, incoming)
        await send_members(session, config)
        like = [f"--link-dest={config.directory}/releases/{name}" for name in kept]
        sent_bytes = await _send(config, robot, release, held, incoming, like, report)
        steps = await _prove(session, release, incoming, report)
        report("switch", None)
        await require_disarmed(session, robot, "switching")
        await _switch(session, config, robot, release, before, kept, incoming)
        summary = "spare, not started" if spare else "runs"
        perceive_ms, infer_ms = steps["perceive"]["p99_ms"], steps["infer"]["p99_ms"]
        return Deployed(release.id, summary, sent_bytes, perceive_ms, infer_ms)


async def _is_whole(session: Session, folder: str) -> bool:
    try:
        await session.call("check", folder=folder)
    except RemoteError:
        return False
    return True


async def _make_room(
    session: Session, config: FleetConfig, release: Release, found: dict[str, Any], incoming: str
) -> set[str]:
    """Prepare `incoming`, keeping what an interrupted transfer left, and return the kept releases.

    Raises RemoteError if the disk has no room.
    """
    number, current = found["number"], f"{config.directory}/current/manifest.json"
    if number is None and (await session.run("test", "-e", current)).code == 0:
        raise RemoteError("its current release cannot be read, so none is removed: try again")
    await session.check_output("mkdir", "-p", incoming, f"{config.directory}/releases")
    others = ("-mindepth", "1", "-maxdepth", "1", "!", "-name", release.id, "-exec", "rm", "-rf")
    await session.check_output("find", f"{config.directory}/incoming", *others, "{}", "+")
    # A newer one may be left from a failed switch or a rollback.
    names = found["releases"]
    newer = next((name for name in names if name != number), None)
    kept = {number, earlier_than(number, names) or newer} - {None}
    await _keep(session, config, names, kept)
    received = await session.check_output("du", "-sb", incoming)
    free = await session.check_output("df", "-B1", "--output=avail", incoming)
    needed_mb = _MARGIN_MB
    if not any(names[name]["image"] == release.image.id for name in kept):
        needed_mb += max(0.0, release.size_bytes - float(received.split()[0])) / 1e6
    free_mb = float(free.split()[-1]) / 1e6
    if free_mb < needed_mb:
        raise RemoteError(
            f"the disk has {free_mb:.0f} MB free, and the release needs {needed_mb:.0f} MB: remove "
            "old logs, but not the newest (`lpac fleet pull`, then `lpac fleet exec`)"
        )
    return kept


async def _send(
    config: FleetConfig,
    robot: RobotHost,
    release: Release,
    held: Held,
    incoming: str,
    like: Sequence[str],
    report: Report,
) -> int:
    """Send the release to `incoming`; return the bytes of content sent.

    `like` are rsync's --link-dest options: files that the kept releases have are hard-linked.
    """
    try:
        return await rsync(
            config, robot, [f"{release.folder}/", str(release.image.folder)], f":{incoming}/",
            # Folders only: the manifest has the files' modes.
            options=["--delete", "--partial", "--chmod=Du=rwx,Dgo=rx", *like],
            sudo=held.found["sudo"], on_share=lambda share: report("send", share),
        )  # fmt: skip
    except FleetError as error:
        if "disk is full" in str(error):
            await held.session.check_output("rm", "-rf", incoming)
        raise


async def _prove(
    session: Session, release: Release, incoming: str, report: Report
) -> dict[str, Any]:
    """Check every file, verify the policy's golden outputs, and benchmark it on this CPU.

    Raises RemoteError if a file differs, an output is wrong, or the policy is too slow.
    """
    report("check", None)
    manifest = await session.check_output("sha256sum", f"{incoming}/manifest.json")
    if not manifest.startswith(release.id):
        raise RemoteError("the manifest was damaged in transfer: deploy again")
    await session.call("check", folder=incoming)
    bundle = ("/release/bundle", "--json")
    commands = (("verify", *bundle), ("benchmark", *bundle, "--seconds", "1"))
    for command in commands:
        report(command[0], None)
        done = await lpac_inside(session, incoming, "bundle", *command)
        if done.code != 0 and command[0] == "benchmark":
            # Another process may have disturbed the first run.
            done = await lpac_inside(session, incoming, "bundle", *command)
        if done.code != 0:
            raise RemoteError(f"bundle {command[0]} on the robot: {done.reason}")
    steps: dict[str, Any] = json.loads(done.out)["steps"]
    return steps


async def _switch(
    session: Session,
    config: FleetConfig,
    robot: RobotHost,
    release: Release,
    before: dict[str, Any],
    kept: Set[str],
    incoming: str,
) -> None:
    """Run the received release; of those in `kept`, keep only the one before it."""
    releases = before["releases"]
    number = max([release.number, *(int(name) + 1 for name in releases if name.isdigit())])
    place = f"{config.directory}/releases"
    await session.check_output("sync", "--file-system", place, timeout_s=120.0)
    await session.check_output("mv", "--no-target-directory", incoming, f"{place}/{number}")
    await session.call("switch", directory=config.directory, release=str(number),
                       mavlink_port=robot.mavlink_port)  # fmt: skip
    same = before["current"] == release.id
    former = earlier_than(before["number"], releases) if same else before["number"]
    await _keep(session, config, kept, {former})


async def _keep(
    session: Session, config: FleetConfig, names: Iterable[str], kept: Set[str | None]
) -> None:
    """Remove all releases of `names` but those in `kept`."""
    gone = [name for name in names if name not in kept]
    if gone:
        # Moved first, so that a half-removed folder is not taken for a release.
        incoming, place = f"{config.directory}/incoming", f"{config.directory}/releases"
        await session.check_output("mv", "-t", incoming, *(f"{place}/{name}" for name in gone))
        await session.check_output("rm", "-rf", *(f"{incoming}/{name}" for name in gone))


async def rollback(config: FleetConfig, robot: RobotHost, report: Report) -> str:
    """Run the release before the current one; return its id. Raises FleetError."""
    async with hold(config, robot, report) as (session, found, _):
        await require_disarmed(session, robot, "rolling back")
        name = earlier_than(found["number"], found["releases"])
        if name is None or found["earlier"] is None:
            raise RemoteError("there is no earlier release to go back to")
        report("check", None)
        await session.call("check", folder=f"{config.directory}/releases/{name}")
        await session.call("switch", directory=config.directory, release=name,
                           mavlink_port=robot.mavlink_port)  # fmt: skip
        return str(found["earlier"])
