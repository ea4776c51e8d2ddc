"""Network namespaces in which robots' programs run, and their processes."""

import contextlib
import json
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Condition, Thread
from typing import NamedTuple, Self

from lpac.sim.programs import python_program

# Longer than a robot's program waits for its child.
_ENDS_WITHIN_S = 30.0
_LOOK_AGAIN_S = 0.2


class NetworkPlace(NamedTuple):
    """A robot's place in the network; `namespace` None is this machine's own network."""

    address: str
    namespace: str | None = None

    def enter(self, command: Sequence[str]) -> list[str]:
        """Command line that runs `command` there."""
        if self.namespace is None:
            return list(command)
        return ["ip", "netns", "exec", self.namespace, *command]


LOOPBACK = NetworkPlace("127.0.0.1")


def place_in(namespace: str) -> NetworkPlace:
    """The namespace's first address. Raises ValueError, OSError."""
    if os.geteuid() != 0:
        raise ValueError("--namespaces: network namespaces need root: use sudo")
    if not Path("/run/netns", namespace).exists():
        raise ValueError(
            f"--namespaces: there is no network namespace {namespace}: `ip netns` lists them"
        )
    command = ["ip", "-json", "-netns", namespace, "-4", "address", "show", "scope", "global"]
    shown = subprocess.run(command, check=False, capture_output=True, text=True)
    for interface in json.loads(shown.stdout or "[]"):
        for address in interface.get("addr_info", ()):
            return NetworkPlace(address["local"], namespace)
    raise ValueError(
        f"--namespaces: {namespace} has no IPv4 address except on its loopback: `ip -n {namespace} "
        "address` shows all"
    )


class Notifier:
    """Condition notified of each output line and exit of several programs."""

    def __init__(self) -> None:
        self._changed = Condition()

    def notify(self) -> None:
        """Wake up `wait`."""
        with self._changed:
            self._changed.notify_all()

    def wait(self, until: Callable[[], bool], at_most_s: float) -> bool:
        """Wait for a condition; returns False after the timeout."""
        ends_s = time.monotonic() + at_most_s
        with self._changed:
            while not until():
                left_s = ends_s - time.monotonic()
                if left_s <= 0.0:
                    return False
                self._changed.wait(min(left_s, _LOOK_AGAIN_S))
        return True


class Program:
    """A module of this package as a process at a place; a context manager that ends it.

    The process also ends with this one, since its standard input closes.
    """

    def __init__(
        self, place: NetworkPlace, notifier: Notifier, on_line: Callable[[str], None], *command: str
    ) -> None:
        """`command` is a module and its arguments; a thread passes output to `on_line`."""
        self._command = command
        self._notifier = notifier
        self._on_line = on_line
        self._problem: str | None = None
        self._leaving = False
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the program runs
        self._process = subprocess.Popen(
            place.enter(python_program(*command)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            bufsize=1,
            # Only this process handles Ctrl-C.
            start_new_session=True,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )
        self._reader = Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.leave()
        assert self._process.stdout is not None
        try:
            self._process.wait(_ENDS_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join(_ENDS_WITHIN_S)
        self._process.stdout.close()
        self._errors.close()

    def leave(self) -> None:
        """Ask the process to end. With several programs, ask all before waiting for any."""
        self._leaving = True
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()

    def send(self, *words: object) -> None:
        """Write one line. Raises OSError if the process has ended."""
        self.check()
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(" ".join(map(str, words)) + "\n")
        except BrokenPipeError:
            self._reader.join(_ENDS_WITHIN_S)
            self.check()
            raise

    def check(self) -> None:
        """Raise OSError with the cause if the process has failed or ended."""
        if self._problem is not None:
            raise OSError(f"{self._command[0]}: {self._problem}")

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            word, _, rest = line.strip().partition(" ")
            if word == "failed":
                self._problem = self._problem or rest
            else:
                self._on_line(line)
            self._notifier.notify()
        if not self._leaving and self._problem is None:
            self._errors.seek(0)
            last = self._errors.read().decode(errors="replace").strip().splitlines()[-1:]
            self._problem = " ".join(["the program ended", *last])
        self._notifier.notify()
