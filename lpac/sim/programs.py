"""Programs of this project that the simulator starts beside itself."""

import signal
import subprocess
import sys
from pathlib import Path


def python_program(module: str, *arguments: str) -> list[str]:
    """The command line that runs a module as a program, in this Python.

    Whatever lies in the working directory, a folder `edge` of the user's own too, it is this
    project that runs: -P keeps that directory out of the modules' path.
    """
    return [sys.executable, "-P", "-m", module, *arguments]


class LpacProgram:
    """A command of `lpac`, in a process of its own; what it prints goes to the end of `log`."""

    def __init__(self, log: Path, *arguments: str) -> None:
        self.log = log
        self._arguments = arguments
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it, also again after it has ended."""
        with self.log.open("ab") as output:
            self._process = subprocess.Popen(
                python_program("lpac.cli.main", *self._arguments),
                stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                # Ctrl-C is for the launcher alone, which lands the vehicles first.
                process_group=0,
            )  # fmt: skip

    @property
    def running(self) -> bool:
        """Whether it was started, and has not ended."""
        return self._process is not None and self._process.poll() is None

    @property
    def pid(self) -> int:
        """Raises RuntimeError if the program was never started."""
        if self._process is None:
            raise RuntimeError(f"{' '.join(self._arguments)} was not started")
        return self._process.pid

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal; nothing happens if the program has ended."""
        if self._process is not None:
            self._process.send_signal(number)

    def wait(self, timeout_s: float | None = None) -> int | None:
        """The exit code once the program has ended, None if it has not within the time."""
        assert self._process is not None
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def terminate(self) -> None:
        """Tell it to end, also if it stands still."""
        self.send_signal(signal.SIGTERM)
        self.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        """End it at once."""
        self.send_signal(signal.SIGKILL)
        self.wait()

    def last_words(self) -> str:
        """The last line that it printed."""
        lines = self.log.read_text(errors="replace").split("\n") if self.log.exists() else []
        return next((line for line in reversed(lines) if line.strip()), "it printed nothing")

    def ending(self) -> str:
        """How the program has ended, in words; with the last line that it printed, if by itself."""
        code = self.wait(0.0)
        if code is not None and code < 0:
            return f"by {signal.Signals(-code).name}"
        return f"exit code {code}: {self.last_words()}"
