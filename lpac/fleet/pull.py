"""Fetch logs from the robots; resumable, and checked against the robots' checksums."""

import asyncio
import contextlib
import hashlib
import itertools
import json
import math
import shlex
import time
from pathlib import Path
from typing import NamedTuple

from lpac.fleet.agent import LAND_UNIT, UNIT
from lpac.fleet.deploy import lpac_inside
from lpac.fleet.hold import Report, visit
from lpac.fleet.program import require_disarmed
from lpac.fleet.session import RemoteError, Session, UnreachableError, rsync
from lpac.fleet.settings import FleetConfig, RobotHost

SUMS = "SHA256SUMS"

_STATE = "/var/lib/private/lpac"
_PLACE = "/var/tmp/lpac-pull-"
# The journal also covers the time just before and after a trial.
_MARGIN_S = 30.0
# Below the session's own timeout for a call.
_STAGE_S = 380.0
# Prints modification time and path of flight logs and PX4 logs. Folders that an interrupted pull
# left are removed after an hour.
_LIST = f"""find {_PLACE}* -maxdepth 0 -mmin +60 -exec rm -rf {{}} +
find {_STATE}/logs -type f -name '*.mcap' -printf '%T@ %p\\n'
find /data/px4/log -type f -path '*/sess*/*.ulg' -printf '%T@ %p\\n'"""
# Files are linked, not copied on the robot; but a file that may still grow is copied, so that its
# checksum matches what is sent. Existing symlinks are skipped: they may point anywhere.
_STAGE = f"""set -e; umask 077; d=$(mktemp -d {_PLACE}XXXXXX); trap 'rm -rf "$d"' EXIT
put() {{
    [ -f "$2" ] && [ ! -L "$2" ] || return 0
    mkdir -p "$(dirname "$d/$1")"
    if [ "$(find "$2" -type f -mmin -1)" ]; then cp -p "$2" "$d/$1"
    else ln -s "$(realpath "$2")" "$d/$1"; fi
}}
"""

Interval = tuple[float, float]


class Pulled(NamedTuple):
    """Files fetched to `folder`, and a summary; `sent_bytes` is what was transferred of them."""

    folder: str
    files: int
    size_bytes: int
    sent_bytes: int
    summary: str


async def pull(
    config: FleetConfig, robot: RobotHost, trial: str | None, out: Path, report: Report
) -> Pulled:
    """Fetch flight logs, PX4's logs and parameters, journal, configuration and versions.

    They go to `out`/TRIAL/ROBOT; without a trial, everything new goes to `out`/all/ROBOT. The
    robot's checksums are in `SHA256SUMS`, for `sha256sum -c`. Files of earlier pulls are never
    overwritten by others of the same name: a robot whose logs were removed numbers them from 1
    again. Raises FleetError, also if the robot has nothing of the trial.
    """
    folder = out.resolve() / ("all" if trial is None else trial.replace("/", "_")) / robot.name
    async with visit(config, robot, report) as (session, found):
        await require_disarmed(session, robot, "pulling")
        listed = await session.run("sh", "-c", _LIST)
        entries = [line.split(" ", 1) for line in listed.out.splitlines()]
        times = {path: float(time_s) for time_s, path in entries}
        if trial is None:
            interval, logs = (_newest_s(folder), math.inf), [path for path in times if _log(path)]
            logs = [path for path in logs if times[path] >= interval[0]]
        else:
            report("read flight logs", None)
            logs, flown = await _of_trial(session, config, trial, times)
            if trial not in flown:
                return _nothing(config, robot, trial, folder, times, list(flown))
            interval = flown[trial]
        ulogs = _ulogs(times, interval)
        if trial is None and not (logs or ulogs):
            return Pulled(str(folder), 0, 0, 0, "nothing new")
        folder.mkdir(parents=True, exist_ok=True)
        report("checksums", None)
        remote, sums = await _stage(session, config, trial, interval, logs, ulogs)
        try:
            report("compare", None)
            kept = await _keep_others(session, remote, folder, sums)
            sent_bytes = await rsync(
                config, robot, [f":{remote}/"], f"{folder}/",
                options=["--copy-links", "--partial"], sudo=found["sudo"],
                on_share=lambda share: report("fetch", share),
            )  # fmt: skip
        finally:
            # The next pull removes it from a robot that is out of reach now.
            with contextlib.suppress(UnreachableError):
                await session.run("rm", "-rf", remote)
    report("check", None)
    await asyncio.to_thread(_check, folder, sums)
    _write_sums(folder, _read_sums(folder) | sums)
    size_bytes = sum((folder / name).stat().st_size for name in sums)
    summary = "complete" if sent_bytes else "was here already"
    if kept is not None:
        summary += f"; older files of the same names are in {kept}"
    return Pulled(str(folder), len(sums), size_bytes, sent_bytes, summary)


def _log(path: str) -> bool:
    return path.endswith(".mcap")


async def _of_trial(
    session: Session, config: FleetConfig, trial: str, times: dict[str, float]
) -> tuple[list[str], dict[str, Interval]]:
    """The trial's flight logs, and the interval of each trial, the newest last.

    The logs are read on the robot by its own release. Raises RemoteError.
    """
    paths = [path for path in times if _log(path)]
    if not paths:
        return [], {}
    command = ("log", "trials", "/var/lib/logs", "--json")
    done = await lpac_inside(session, f"{config.directory}/current", *command, state=_STATE)
    if done.code != 0:
        raise RemoteError(f"its flight logs cannot be read: {done.reason}")
    found: dict[str, dict[str, Interval]] = json.loads(done.out)
    flown: dict[str, list[float]] = {}
    for of_log in found.values():
        for name, interval in of_log.items():
            flown.setdefault(name, []).extend(interval)
    flown.pop("", None)
    names = sorted(flown, key=lambda name: max(flown[name]))
    logs = [path for path in paths if trial in found.get(path.rpartition("/")[2], {})]
    return logs, {name: (min(flown[name]), max(flown[name])) for name in names}


def _ulogs(times: dict[str, float], interval: Interval) -> list[str]:
    """PX4 logs that may overlap the interval; each begins after the one before it ends."""
    found, began_s = [], 0.0
    for path in sorted((p for p in times if not _log(p)), key=lambda p: (times[p], p)):
        if times[path] >= interval[0] and began_s <= interval[1]:
            found.append(path)
        began_s = times[path]
    return found


async def _stage(
    session: Session,
    config: FleetConfig,
    trial: str | None,
    interval: Interval,
    logs: list[str],
    ulogs: list[str],
) -> tuple[str, dict[str, str]]:
    """Link the files in one folder on the robot; return it, and the sha256 of each file."""
    files = {f"logs/{path.rpartition('/')[2]}": path for path in logs}
    files |= {"/".join(["px4", *path.split("/")[-2:]]): path for path in ulogs}
    files["px4/parameters"] = "/data/px4/param/parameters"
    for name in ("robot.toml", "versions.json"):
        files[name] = f"{config.directory}/current/{name}"
    journal = ["journalctl", "-u", UNIT, "-u", LAND_UNIT, "-o", "json", "--no-pager", "--quiet",
               "--since", f"@{max(0, int(interval[0] - _MARGIN_S))}"]  # fmt: skip
    if interval[1] < math.inf:
        journal += ["--until", f"@{int(interval[1] + _MARGIN_S)}"]
    name = "journal.jsonl" if trial is not None else f"journal-{int(time.time())}.jsonl"
    script = [
        _STAGE,
        *(shlex.join(["put", *file]) for file in files.items()),
        f'{shlex.join(journal)} > "$d/{name}"',
        'cd "$d"; pwd; find -L . -type f -exec sha256sum {} +; trap - EXIT',
    ]
    shown = await session.check_output("sh", "-c", "\n".join(script), timeout_s=_STAGE_S)
    remote, *sums = shown.splitlines()
    return remote, {
        path.removeprefix("./"): digest for digest, path in (s.split("  ") for s in sums)
    }


async def _keep_others(
    session: Session, remote: str, folder: Path, sums: dict[str, str]
) -> str | None:
    """Move away files that the transfer would overwrite, unless it continues or repairs them.

    Returns the subfolder that has them now, or None.
    """
    known = _read_sums(folder)
    here = {
        name: folder / name
        for name, digest in sums.items()
        if known.get(name) != digest and (folder / name).is_file()
    }
    if not here:
        return None
    commands = {
        name: f"head -c {path.stat().st_size} {shlex.quote(f'{remote}/{name}')} | sha256sum"
        for name, path in here.items()
    }
    beginnings = await session.capture(commands, each_s=_STAGE_S / len(commands))
    others = [
        name
        for name, path in here.items()
        if not beginnings[name].startswith(await asyncio.to_thread(_sha256, path))
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
    trial: str,
    folder: Path,
    times: dict[str, float],
    trials: list[str],
) -> Pulled:
    """Result for a spare that never flew. Raises RemoteError for any other robot."""
    if not any(map(_log, times)) and config.slot_of(robot.name) is None:
        return Pulled(str(folder), 0, 0, 0, "a spare that never flew")
    flown = f"it has {', '.join(map(repr, trials[-5:]))}" if trials else "it has none of any trial"
    raise RemoteError(f"it has no logs of trial {trial!r}; {flown}")


def _newest_s(folder: Path) -> float:
    """Modification time of the newest log that was fetched completely, Unix time; 0 if none."""
    logs = [folder / name for name in _read_sums(folder) if name.endswith((".mcap", ".ulg"))]
    return max((log.stat().st_mtime for log in logs if log.exists()), default=0.0)


def _check(folder: Path, sums: dict[str, str]) -> None:
    """Raises RemoteError if a fetched file differs from the robot's."""
    for name, wanted in sums.items():
        if _sha256(folder / name) != wanted:
            raise RemoteError(f"{name} was damaged in transfer: pull again")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read_sums(folder: Path) -> dict[str, str]:
    """sha256 by file name, from earlier pulls."""
    path = folder / SUMS
    if not path.exists():
        return {}
    lines = (line.partition("  ") for line in path.read_text().splitlines())
    return {name: digest for digest, _, name in lines}


def _write_sums(folder: Path, sums: dict[str, str]) -> None:
    text = "".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items()))
    (folder / SUMS).write_text(text)
