"""Fetching what robots recorded of a trial: resumable, and checked against their checksums."""

import asyncio
import contextlib
import hashlib
import itertools
from pathlib import Path
from typing import NamedTuple

from lpac.fleet.hold import Report, visit
from lpac.fleet.session import RemoteError, Session, UnreachableError, rsync
from lpac.fleet.settings import FleetConfig, RobotHost

SUMS = "SHA256SUMS"


class Pulled(NamedTuple):
    """Files that were fetched to `folder`, how much of them travelled, and a word about it."""

    folder: str
    files: int
    size_bytes: int
    sent_bytes: int
    summary: str


async def pull(
    config: FleetConfig, robot: RobotHost, trial: str | None, out: Path, report: Report
) -> Pulled:
    """Fetch flight logs, PX4's logs and parameters, journal, configuration and versions.

    To `out`/TRIAL/ROBOT; without a trial, whatever is newer than what is there, to `out`/all/ROBOT.
    `SHA256SUMS` there is what the robot said, and `sha256sum -c` understands it. Files of earlier
    pulls are never lost: robots number their logs from 1 again once those are removed. Raises
    FleetError, also if the robot has nothing of the trial.
    """
    folder = out.resolve() / ("all" if trial is None else trial.replace("/", "_")) / robot.name
    async with visit(config, robot, report) as (session, found):
        collected = await session.call(
            "collect", directory=config.directory, mavlink_port=robot.mavlink_port, trial=trial,
            since_s=0.0 if trial is not None else _newest_s(folder),
        )  # fmt: skip
        if collected["folder"] is None:
            return _nothing(config, robot, trial, folder, collected)
        folder.mkdir(parents=True, exist_ok=True)
        sums: dict[str, str] = collected["files"]
        try:
            report("compare", None)
            kept = await _keep_others(session, collected["folder"], folder, sums)
            sent_bytes = await rsync(
                config, robot, [f":{collected['folder']}/"], f"{folder}/",
                options=["--copy-links", "--partial"], sudo=found["sudo"],
                on_share=lambda share: report("fetch", share),
            )  # fmt: skip
        finally:
            # A robot out of reach removes it later by itself; the transfer's problem is to be told.
            with contextlib.suppress(UnreachableError):
                await session.call("fetched", folder=collected["folder"])
    report("check", None)
    await asyncio.to_thread(_check, folder, sums)
    _write_sums(folder, _read_sums(folder) | sums)
    size_bytes = sum((folder / name).stat().st_size for name in sums)
    summary = "whole" if sent_bytes else "was here already"
    if kept is not None:
        summary += f"; files of the same names that were here are in {kept}"
    return Pulled(str(folder), len(sums), size_bytes, sent_bytes, summary)


async def _keep_others(
    session: Session, remote: str, folder: Path, sums: dict[str, str]
) -> str | None:
    """Move what the transfer would overwrite, but for files that it continues or mends.

    Returns the folder in `folder` that has them now, None if there are none.
    """
    known = _read_sums(folder)
    here = {
        name: folder / name
        for name, digest in sums.items()
        if known.get(name) != digest and (folder / name).is_file()
    }
    if not here:
        return None
    beginnings = await session.call(
        "beginnings",
        folder=remote,
        sizes={name: path.stat().st_size for name, path in here.items()},
    )
    others = [
        name
        for name, path in here.items()
        if await asyncio.to_thread(_sha256, path) != beginnings[name]
    ]
    if not others:
        return None
    kept = next(
        name for n in itertools.count(1) if not (folder / (name := f"earlier-{n}")).exists()
    )
    for name in others:
        target = folder / kept / name
        target.parent.mkdir(parents=True, exist_ok=True)
        (folder / name).rename(target)
        if name in known:
            known[f"{kept}/{name}"] = known.pop(name)
    _write_sums(folder, known)
    return kept


def _nothing(
    config: FleetConfig,
    robot: RobotHost,
    trial: str | None,
    folder: Path,
    collected: dict[str, object],
) -> Pulled:
    """Raises RemoteError unless that is as it should be."""
    if trial is None:
        return Pulled(str(folder), 0, 0, 0, "nothing new")
    if not collected["has_logs"] and config.slot_of(robot.name) is None:
        return Pulled(str(folder), 0, 0, 0, "a spare that never flew")
    trials = collected["trials"]
    assert isinstance(trials, list)
    flown = f"it has {', '.join(map(repr, trials[-5:]))}" if trials else "it has none at all"
    raise RemoteError(f"it has nothing of trial {trial!r}; {flown}")


def _newest_s(folder: Path) -> float:
    """When the newest of the logs that came whole was written to, Unix time; 0 without any.

    Those of a pull that broke off do not count.
    """
    logs = [folder / name for name in _read_sums(folder) if name.endswith((".mcap", ".ulg"))]
    return max((log.stat().st_mtime for log in logs if log.exists()), default=0.0)


def _check(folder: Path, sums: dict[str, str]) -> None:
    """Raises RemoteError if a file here is not what the robot has."""
    for name, wanted in sums.items():
        if _sha256(folder / name) != wanted:
            raise RemoteError(f"{name} did not come whole: pull again")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read_sums(folder: Path) -> dict[str, str]:
    """File -> sha256 of what came in earlier pulls."""
    path = folder / SUMS
    if not path.exists():
        return {}
    lines = (line.partition("  ") for line in path.read_text().splitlines())
    return {name: digest for digest, _, name in lines}


def _write_sums(folder: Path, sums: dict[str, str]) -> None:
    text = "".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items()))
    (folder / SUMS).write_text(text)
