"""`lpac mission` as processes, with a ground process and robots that fly in this process.

What it says and does is in tests/sim/cli.
"""

import contextlib
import os
import pty
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from edge.messages.mission import FlightState
from tests.command import error_line, lpac
from tests.conftest import ROOT
from tests.live import FlownFleet, until
from tests.process.ground.conftest import wait_for_snapshot
from tests.sim.cli.test_mission import write_script

_S = FlightState


@contextlib.contextmanager
def ground(fleet: FlownFleet) -> Iterator[None]:
    process = subprocess.Popen(
        [sys.executable, "-m", "lpac.cli.main", "ground", "--name", "alice"],
        cwd=ROOT, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        wait_for_snapshot(fleet.name)
        yield
    finally:
        # The second Ctrl-C ends it also while robots fly.
        process.terminate()
        process.wait()


@contextlib.contextmanager
def running(*arguments: str | Path) -> Iterator["subprocess.Popen[str]"]:
    with subprocess.Popen(
        [sys.executable, "-m", "lpac.cli.main", "mission", *map(str, arguments)],
        cwd=ROOT, text=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        try:
            yield process
        finally:
            process.kill()


def on_terminal(answer: str, *arguments: str) -> str:
    """What a command prints on a terminal at which somebody types."""
    ours, theirs = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "lpac.cli.main", "mission", *arguments],
        cwd=ROOT, stdin=theirs, stdout=theirs, stderr=theirs,
    ) as process:  # fmt: skip
        os.close(theirs)
        os.write(ours, answer.encode())
        printed = b""
        with contextlib.suppress(OSError):  # its end
            while chunk := os.read(ours, 4096):
                printed += chunk
        process.wait()
    os.close(ours)
    return printed.decode()


def test_ctrl_c_ends_a_script_and_no_return_and_kill_asks(
    tmp_path: Path, short_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with FlownFleet(tmp_path, 3, spares=1) as fleet:
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(short_path))
        monkeypatch.setenv("LPAC_FLEET", str(fleet.fleet_toml))

        def states() -> list[FlightState]:
            return [robot.state for robot in fleet.flown[:3]]

        for command in ("takeoff", "rehearse"):
            why = error_line(lpac("mission", command))
            assert f"fleet {fleet.name} here: start `lpac ground`" in why
        script = write_script(tmp_path, 600.0, **{"at_s = 1.5": "at_s = 599.5"})
        with ground(fleet):
            with running("run", script, "--yes") as process:
                until(lambda: states() == [_S.MISSION, _S.MISSION, _S.PILOT])
                process.send_signal(signal.SIGINT)
                _, err = process.communicate(timeout=60.0)
            assert process.returncode == 130
            assert states()[:2] == [_S.HOLD, _S.HOLD]
            assert "interrupted; " in err
            assert "Traceback" not in err

            assert "KILL r1? What flies falls." in on_terminal("n\n", "kill", "r1")
            assert states()[1] is _S.HOLD
            on_terminal("y\n", "kill", "r1")
            assert states()[1] is _S.FAULT
            assert states()[0] is _S.HOLD

            with running("return", "--robots", "r0", "--wait") as process:
                assert process.stderr is not None
                assert "r" in process.stderr.readline()
                process.send_signal(signal.SIGINT)
                _, err = process.communicate(timeout=60.0)
            assert process.returncode == 130
            last = err.splitlines()[-1]
            assert last == "lpac: return: interrupted: robots that were ordered to return do so"
            until(lambda: states()[0] is _S.LANDED)
