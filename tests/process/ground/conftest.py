"""A ground station as a real process, with a socket of its own."""

import itertools
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Protocol

import pytest

from lpac.analysis.snapshot import FleetSetup, FleetSnapshot
from lpac.ground.station import client
from lpac.ground.station.protocol import (
    CommandProgress,
    CommandReport,
    Request,
    ServerMessage,
    server_message_from_line,
    to_line,
)
from tests.conftest import ROOT

# Nothing here takes so long unless it is broken.
PATIENCE_S = 120.0


@pytest.fixture(autouse=True)
def from_a_terminal() -> Iterator[None]:
    """Processes end when their terminal does, also if these tests have none to lose (nohup)."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def all_heard(snapshot: FleetSnapshot) -> bool:
    return all(robot.fresh for robot in snapshot.robots)


def wait_for_snapshot(
    fleet: str,
    condition: Callable[[FleetSnapshot], object] = all_heard,
    assert_runs: Callable[[], None] = lambda: None,
) -> FleetSnapshot:
    """The first picture that is so, of the ground process that this environment has.

    It may still have to start.
    """
    until_s = time.monotonic() + PATIENCE_S
    last: FleetSnapshot | None = None
    while time.monotonic() < until_s:
        assert_runs()
        try:
            with client.subscribe(fleet) as told:
                for last in (t for t in told if isinstance(t, FleetSnapshot)):
                    if condition(last):
                        return last
                    if time.monotonic() > until_s:
                        break
        except client.GroundError:
            time.sleep(0.02)
    raise AssertionError(last)


class GroundStation:
    """`lpac ground` in a process; commands and pictures by way of its socket."""

    def __init__(self, fleet_toml: Path, runtime: Path, name: str, log: Path) -> None:
        self.runtime = runtime
        self.name = name
        self.log = log
        arguments = ["ground", "--fleet", str(fleet_toml), "--name", name]
        self._command = [sys.executable, "-m", "lpac.cli.main", *arguments]
        match = re.search(r'^fleet = "(.*)"', fleet_toml.read_text(), re.MULTILINE)
        assert match is not None
        self.fleet = match[1]
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it, and wait until it listens."""
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                self._command, env=_environment(self.runtime),
                stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            )  # fmt: skip
        self.wait_for(lambda _: True)

    def end(self, number: signal.Signals = signal.SIGTERM) -> int:
        """Send the signal; the exit code."""
        assert self.process is not None
        self.process.send_signal(number)
        return self.process.wait(PATIENCE_S)

    @property
    def socket_path(self) -> Path:
        return self.runtime / f"lpac-ground-{self.fleet}.sock"

    def twin(self) -> subprocess.CompletedProcess[str]:
        """Another one of the same user, until it ends."""
        return subprocess.run(
            self._command, env=_environment(self.runtime),
            capture_output=True, text=True, timeout=PATIENCE_S, check=False,
        )  # fmt: skip

    def kill(self) -> None:
        """As by a power loss."""
        assert self.process is not None
        self.process.kill()
        self.process.wait()

    def command(self, request: Request) -> CommandReport:
        with self._here():
            return client.command(self.fleet, request)

    def begin(self, request: Request) -> "Pending":
        """A command that runs beside the test; its first progress tells that it was taken."""
        return Pending(self, request)

    def wait_for(self, condition: Callable[[FleetSnapshot], object]) -> FleetSnapshot:
        """The first picture that is so. Waits for a socket, too."""
        with self._here():
            return wait_for_snapshot(self.fleet, condition, self._assert_runs)

    def _assert_runs(self) -> None:
        assert self.process is not None
        assert self.process.poll() is None, self.log.read_text()

    def told(self) -> list[ServerMessage]:
        """What a new subscriber is told first, up to a picture."""
        with self._here(), client.subscribe(self.fleet) as told:
            return [*itertools.takewhile(lambda t: not isinstance(t, FleetSnapshot), told)]

    def setup(self) -> FleetSetup:
        """The fleet as it is now."""
        return next(told for told in self.told() if isinstance(told, FleetSetup))

    def subscribed(self) -> Iterator[ServerMessage]:
        """All that a subscriber is told."""
        with ExitStack() as stack:
            with self._here():
                told = stack.enter_context(client.subscribe(self.fleet))
            yield from told

    @contextmanager
    def _here(self) -> Iterator[None]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("XDG_RUNTIME_DIR", str(self.runtime))
            yield


def _environment(runtime: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "XDG_RUNTIME_DIR": str(runtime)}


class Pending:
    """A command that runs beside the test."""

    def __init__(self, station: GroundStation, request: Request) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(PATIENCE_S)
        self._socket.connect(str(station.socket_path))
        self._socket.sendall(to_line(request))
        self._lines = self._socket.makefile("rb")

    def progress(self, of: str) -> CommandProgress:
        """The next of one robot."""
        for told in self._told():
            if isinstance(told, CommandProgress) and told.robot == of:
                return told
        raise AssertionError("it has ended")

    def report(self) -> CommandReport:
        """What came of it."""
        report = next(told for told in self._told() if isinstance(told, CommandReport))
        self.leave()
        return report

    def leave(self) -> None:
        """As by Ctrl-C."""
        self._lines.close()
        self._socket.close()

    def _told(self) -> Iterator[ServerMessage]:
        return map(server_message_from_line, self._lines)


class NewStation(Protocol):
    """Starts a station: whoever has another name has another socket, as on another laptop."""

    def __call__(self, fleet_toml: Path, name: str = ..., laptop: str = ...) -> GroundStation: ...


@pytest.fixture
def new_station(tmp_path: Path) -> Iterator[NewStation]:
    """They are killed in the end, if they still run."""
    # A socket's path must be short.
    with tempfile.TemporaryDirectory(prefix="lpac-") as folder, ExitStack() as stack:

        def start(fleet_toml: Path, name: str = "alice", laptop: str = "") -> GroundStation:
            runtime = Path(folder, laptop or name)
            runtime.mkdir(exist_ok=True)
            station = GroundStation(fleet_toml, runtime, name, tmp_path / f"{runtime.name}.log")
            stack.callback(station.kill)
            station.start()
            return station

        yield start
