"""A trial's files on a robot, put together for the laptop to fetch, with checksums.

Large files are only linked to, so that nothing of them is copied on the robot; but those that may
still grow are, so that what travels is what the checksums are of.
"""

import contextlib
import glob
import json
import os
import shutil
import subprocess
import tempfile
import time
from typing import Any, Dict, Iterator, List, Optional, Tuple

from lpac.fleet.on_robot import releases, service
from lpac.fleet.on_robot.calls import Refused, call, reason, say

_STATE = "/var/lib/private/lpac"
_LOGS = _STATE + "/logs"
_ULOGS = "/data/px4/log/sess*/*.ulg"
_PARAMETERS = "/data/px4/param/parameters"
_PLACE = "/var/tmp/lpac-pull-"

# A file that was written to so lately may grow.
_GROWS_S = 60.0
# What the journal holds from before and after a trial.
_MARGIN_S = 30.0
# A laptop that has gone fetches nothing any more.
_FORGOTTEN_S = 3600.0

Interval = Tuple[float, float]


@call
def collect(
    directory: str, mavlink_port: int, trial: Optional[str], since_s: float
) -> Dict[str, Any]:
    """Put together what there is of the trial, or without one what was written since then.

    Returns the `folder` to fetch, following its links, with the sha256 of each of its `files`; no
    folder if there is nothing. `trials` are those that are in the flight logs, the newest last,
    where a trial was asked for; `has_logs` tells whether there are any flight logs.
    """
    service.refuse_in_flight(mavlink_port, "pulling")
    _forget()
    paths = sorted(glob.glob(_LOGS + "/*.mcap"))
    answer = {
        "folder": None,
        "files": {},
        "trials": [],
        "has_logs": bool(paths),
    }  # type: Dict[str, Any]
    if trial is None:
        interval = (since_s, float("inf"))
        paths = [path for path in paths if os.stat(path).st_mtime >= since_s]
    else:
        say("reads the flight logs")
        found = _trials(directory) if paths else {}
        times = {}  # type: Dict[str, List[float]]
        for name in found:
            for flown, (first_s, last_s) in found[name].items():
                times.setdefault(flown, []).extend((first_s, last_s))
        times.pop("", None)
        answer["trials"] = sorted(times, key=lambda flown: max(times[flown]))
        if trial not in times:
            return answer
        interval = (min(times[trial]), max(times[trial]))
        paths = [path for path in paths if trial in found.get(os.path.basename(path), {})]
    files = {"logs/" + os.path.basename(path): path for path in paths}
    for path in _ulogs(interval):
        session, name = path.split("/")[-2:]
        files["px4/%s/%s" % (session, name)] = path
    if trial is None and not files:
        return answer
    release = os.path.join(directory, "current")
    files["px4/parameters"] = _PARAMETERS
    for name in ("robot.toml", "versions.json"):
        files[name] = os.path.join(release, name)
    folder = tempfile.mkdtemp(prefix=os.path.basename(_PLACE), dir=os.path.dirname(_PLACE))
    try:
        _stage(folder, {name: path for name, path in files.items() if os.path.exists(path)})
        say("reads the journal")
        journal = "journal.jsonl" if trial is not None else "journal-%d.jsonl" % time.time()
        _journal(os.path.join(folder, journal), interval)
        say("checksums")
        answer["files"] = {
            os.path.relpath(path, folder): releases.sha256(path) for path in sorted(_files(folder))
        }
    except BaseException:
        shutil.rmtree(folder)
        raise
    answer["folder"] = folder
    return answer


@call
def beginnings(folder: str, sizes: Dict[str, int]) -> Dict[str, Any]:
    """The sha256 of the first so many bytes of files that were put together."""
    return {name: releases.sha256(os.path.join(folder, name), size) for name, size in sizes.items()}


@call
def fetched(folder: str) -> Dict[str, Any]:
    """Remove what was put together."""
    if not folder.startswith(_PLACE):
        raise ValueError(folder)
    shutil.rmtree(folder, ignore_errors=True)
    return {}


def _trials(directory: str) -> Dict[str, Dict[str, Interval]]:
    """Which trials each flight log holds, and when: the release reads its own logs."""
    current = releases.linked(directory, "current")
    if current is None:
        raise Refused("no release is on the robot that could read its flight logs: deploy first")
    release = os.path.join(directory, "releases", current)
    command = ["/usr/bin/lpac", "log", "trials", "/var/lib/logs", "--json"]
    done = releases.run_inside(release, command, state=_STATE)
    if done.returncode != 0:
        raise Refused("its flight logs cannot be read: %s" % reason(done))
    return dict(json.loads(done.stdout))


def _ulogs(interval: Interval) -> List[str]:
    """PX4's logs that may overlap the interval: each was begun after the one before it ended."""
    ends = sorted((os.stat(path).st_mtime, path) for path in glob.glob(_ULOGS))
    found = []
    began_s = 0.0
    for ended_s, path in ends:
        if ended_s >= interval[0] and began_s <= interval[1]:
            found.append(path)
        began_s = ended_s
    return found


def _stage(folder: str, files: Dict[str, str]) -> None:
    for name, path in files.items():
        target = os.path.join(folder, name)
        os.makedirs(os.path.dirname(target), exist_ok=True)
        if os.stat(path).st_mtime > time.time() - _GROWS_S:
            shutil.copy2(path, target)
        else:
            os.symlink(os.path.realpath(path), target)


def _journal(path: str, interval: Interval) -> None:
    """The units' journal of that time, one JSON object a line."""
    command = ["journalctl", "-u", service.UNIT, "-u", service.LAND_UNIT, "-o", "json",
               "--no-pager", "--quiet",
               "--since", "@%d" % max(0, interval[0] - _MARGIN_S)]  # fmt: skip
    if interval[1] < float("inf"):
        command += ["--until", "@%d" % (interval[1] + _MARGIN_S)]
    with open(path, "wb") as file:
        if subprocess.call(command, stdin=subprocess.DEVNULL, stdout=file) != 0:
            raise Refused("its journal cannot be read")


def _files(folder: str) -> Iterator[str]:
    for parent, _, names in os.walk(folder):
        for name in names:
            yield os.path.join(parent, name)


def _forget() -> None:
    """Remove what a laptop left that has gone."""
    for folder in glob.glob(_PLACE + "*"):
        with contextlib.suppress(OSError):
            if os.stat(folder).st_mtime < time.time() - _FORGOTTEN_S:
                shutil.rmtree(folder)
