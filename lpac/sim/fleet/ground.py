"""`lpac ground` as a program beside the simulator, just as an operator runs it."""

import signal
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

from lpac.ground.station.client import GroundError, command, socket_path
from lpac.ground.station.protocol import CommandReport, Request
from lpac.ground.station.subscriber import GroundSubscriber
from lpac.sim.programs import python_program

_START_WITHIN_S = 60.0
_END_WITHIN_S = 10.0
_TRY_AGAIN_S = 0.05


class GroundProgram:
    """One `lpac ground`; a context, in which it runs. `told` is what it tells its clients.

    `pid` is its process. What it prints is in ground.log beside the fleet's file.
    """

    told: GroundSubscriber
    pid: int

    def __init__(self, fleet_toml: Path, fleet: str, name: str = "sim") -> None:
        """`fleet` is the fleet's name in its file, `name` the station's."""
        self.fleet = fleet
        self._fleet_toml = fleet_toml
        self._name = name
        self._log = fleet_toml.with_name("ground.log")
        self._process: subprocess.Popen[bytes] | None = None
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Comes back once it tells of the fleet. Raises GroundError if it does not start."""
        with ExitStack() as stack:
            with self._log.open("ab") as output:
                self._process = subprocess.Popen(
                    python_program("lpac.cli.main", "ground",
                                   "--fleet", str(self._fleet_toml), "--name", self._name),
                    stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                    # Ctrl-C is for the launcher alone, which lands the vehicles first.
                    process_group=0,
                )  # fmt: skip
            self.pid = self._process.pid
            stack.callback(self._end)
            self.told = self._connected()
            stack.push(self.told)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stack.__exit__(kind, error, traceback)

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self._process is not None and self._process.poll() is None

    def command(self, request: Request) -> CommandReport:
        """Have a command done, and wait for what came of it. Raises GroundError."""
        return command(self.fleet, request)

    def kill(self) -> None:
        """It ends like a computer whose battery is empty."""
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def _connected(self) -> GroundSubscriber:
        until_s = time.monotonic() + _START_WITHIN_S
        while True:
            try:
                return GroundSubscriber(self.fleet).__enter__()
            except GroundError:
                # It is not open yet, and nothing tells when it is.
                if not self.running or time.monotonic() > until_s:
                    text = f"`lpac ground` does not start: {self._last_words()}"
                    raise GroundError(text) from None
                time.sleep(_TRY_AGAIN_S)

    def _last_words(self) -> str:
        lines = self._log.read_text(errors="replace").splitlines()
        return next((line for line in reversed(lines) if line.strip()), "it printed nothing")

    def _end(self) -> None:
        assert self._process is not None
        if self.running:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(_END_WITHIN_S)
            except subprocess.TimeoutExpired:
                self.kill()
        # Nobody flies this fleet again: what a ground leaves for the next one is not needed.
        path = socket_path(self.fleet)
        for left in (path, path.with_suffix(".state"), path.with_suffix(".world")):
            left.unlink(missing_ok=True)
