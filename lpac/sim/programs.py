"""Programs of this project that the simulator starts as processes."""

import signal
import subprocess
import sys
from pathlib import Path


def python_program(module: str, *arguments: str) -> list[str]:
    """The command line that runs a module as a program, in this Python.

    -P keeps the working directory out of the module path: a user's own folder `edge` must not
    replace this project's.
    """
    return [sys.executable, "-P", "-m", module, *arguments]


class LpacProgram:
    """A command of `lpac` as a process; its output is appended to `log`."""

    def __init__(self, log: Path, *arguments: str) -> None:
        self.log = log
        self._arguments = arguments
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the program, or restart it after it has ended."""
        with self.log.open("ab") as output:
            self._process = subprocess.Popen(
                python_program("lpac.cli.main", *self._arguments),
                stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                # Ctrl-C goes to the launcher alone, which lands the vehicles first.
                process_group=0,
            )  # fmt: skip

    @property
    def running(self) -> bool:
        """Whether it has started and not ended."""
        return self._process is not None and self._process.poll() is None

    @property
    def pid(self) -> int:
        """Process id. Raises RuntimeError if the program was never started."""
        if self._process is None:
            raise RuntimeError(f"{' '.join(self._arguments)} was not started")
        return self._process.pid

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal; nothing happens if the program has ended."""
        if self._process is not None:
            self._process.send_signal(number)

    def wait(self, timeout_s: float | None = None) -> int | None:
        """The exit code once the program has ended; None on timeout."""
        assert self._process is not None
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def terminate(self) -> None:
        """Send SIGTERM, and SIGCONT in case the program is stopped."""
        self.send_signal(signal.SIGTERM)
        self.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        """Kill the program, and wait for its end."""
        self.send_signal(signal.SIGKILL)
        self.wait()

    def last_output(self) -> str:
        """The last non-blank line of its output."""
        lines = self.log.read_text(errors="replace").split("\n") if self.log.exists() else []
        return next((line for line in reversed(lines) if line.strip()), "it printed nothing")

    def ending(self) -> str:
        """Signal that ended the program, or its exit code and last line of output."""
        code = self.wait(0.0)
        if code is not None and code < 0:
            return f"by {signal.Signals(-code).name}"
        return f"exit code {code}: {self.last_output()}"
