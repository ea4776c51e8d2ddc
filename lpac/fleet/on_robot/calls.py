"""The robot's end of a session: calls come in as JSON lines, progress and results go out.

A call that has begun is carried out though the laptop has gone: what it does to the robot is then
whole. A session ends when its input ends, or is silent: then locks that it held are free again.
"""

import json
import os
import select
import signal
import subprocess
import sys
import traceback
from typing import Any, Callable, Dict, List

# The laptop says something every few seconds.
SILENCE_S = 12.0

Call = Callable[..., Dict[str, Any]]
_CALLS = {}  # type: Dict[str, Call]


class Refused(Exception):
    """A request that cannot or must not be carried out; one line says why, and what to do."""


def call(function: Call) -> Call:
    """Let the laptop call this function, with arguments and a result that JSON can hold."""
    _CALLS[function.__name__] = function
    return function


def say(text: str) -> None:
    """Tell whoever waits for the present call how far it is."""
    _send({"progress": text})


def run(command: List[str], timeout_s: float = 10.0) -> "subprocess.CompletedProcess[str]":
    """Run a program of the robot and wait for it; its output comes back whatever its exit code.

    Raises Refused if the program is not there, or does not end in time.
    """
    try:
        return subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            timeout=timeout_s,
            check=False,
        )
    except FileNotFoundError:
        raise Refused("the program %s is missing on the robot" % command[0]) from None
    except subprocess.TimeoutExpired:
        raise Refused("%s did not end within %g s" % (" ".join(command[:3]), timeout_s)) from None


def reason(done: "subprocess.CompletedProcess[str]") -> str:
    """The last line with which a program complained, else its exit code."""
    lines = [line for line in done.stderr.split("\n") if line.strip()]
    return lines[-1].strip() if lines else "exit code %d" % done.returncode


def must(command: List[str], timeout_s: float = 60.0) -> str:
    """Output of a program of the robot. Raises Refused unless it returns 0."""
    done = run(command, timeout_s)
    if done.returncode != 0:
        raise Refused("%s: %s" % (" ".join(command), reason(done)))
    return done.stdout


def write_whole(path: str, data: bytes, mode: int = 0o644) -> None:
    """Write a file that, whenever the power goes, is the old one or the new one.

    Also in a folder of somebody else's, who may have put a link there for root to follow.
    """
    part = path + ".part"
    if os.path.lexists(part):
        os.unlink(part)
    with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)


def serve() -> None:
    """Answer calls from standard input until it ends or is silent."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    buffer = b""
    while select.select([0], [], [], SILENCE_S)[0]:
        data = os.read(0, 1 << 16)
        if not data:
            return
        *lines, buffer = (buffer + data).split(b"\n")
        for line in lines:
            if line:
                _answer(json.loads(line.decode()))


def _answer(request: Dict[str, Any]) -> None:
    function = _CALLS[request["call"]]
    try:
        _send({"result": function(**request["arguments"])})
    except Refused as error:
        _send({"error": " ".join(str(error).split())})
    except OSError as error:
        where = "%s: " % error.filename if error.filename else ""
        _send({"error": where + (error.strerror or str(error))})
    except Exception as error:
        # A mistake of ours: the one who reads it needs the place.
        place = traceback.extract_tb(sys.exc_info()[2])[-1]
        _send({"error": "%s: %s (%s:%s)" % (type(error).__name__, error, place[0], place[1])})


def _send(message: Dict[str, Any]) -> None:
    data = (json.dumps(message) + "\n").encode()
    try:
        while data:
            data = data[os.write(1, data) :]
    except OSError:
        pass  # Nobody is there any more; the call goes on.
