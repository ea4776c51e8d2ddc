"""Where robots' programs run, and how they are started there."""

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

# Longer than a robot's program waits for its own.
_ENDS_WITHIN_S = 30.0
_LOOK_AGAIN_S = 0.2


class NetworkPlace(NamedTuple):
    """A robot's place in the network; `namespace` None is this machine's own."""

    address: str
    namespace: str | None = None

    def enter(self, command: Sequence[str]) -> list[str]:
        """The command line that runs a command there."""
        if self.namespace is None:
            return list(command)
        return ["ip", "netns", "exec", self.namespace, *command]


LOOPBACK = NetworkPlace("127.0.0.1")


def place_in(namespace: str) -> NetworkPlace:
    """At the namespace's first address. Raises ValueError, OSError."""
    if os.geteuid() != 0:
        raise ValueError("--namespaces: only root runs programs in network namespaces: use sudo")
    if not Path("/run/netns", namespace).exists():
        raise ValueError(
            f"--namespaces: no network namespace is called {namespace}: `ip netns` lists them"
        )
    asked = ["ip", "-json", "-netns", namespace, "-4", "address", "show", "scope", "global"]
    told = subprocess.run(asked, check=False, capture_output=True, text=True)
    for interface in json.loads(told.stdout or "[]"):
        for address in interface.get("addr_info", ()):
            return NetworkPlace(address["local"], namespace)
    raise ValueError(
        f"--namespaces: {namespace} has no IPv4 address but its loopback's: `ip -n {namespace} "
        "address` shows all"
    )


class News:
    """Condition to wait on for lines of several programs."""

    def __init__(self) -> None:
        self._changed = Condition()

    def tell(self) -> None:
        """Something was said, or a program has ended."""
        with self._changed:
            self._changed.notify_all()

    def wait(self, until: Callable[[], bool], at_most_s: float) -> bool:
        """Whether it came true within that time."""
        ends_s = time.monotonic() + at_most_s
        with self._changed:
            while not until():
                left_s = ends_s - time.monotonic()
                if left_s <= 0.0:
                    return False
                self._changed.wait(min(left_s, _LOOK_AGAIN_S))
        return True


class Program:
    """A module of this package that runs as a process at a place. A context, which ends it.

    It ends with this process, too, however that ends: its standard input does.
    """

    def __init__(
        self, place: NetworkPlace, news: News, hear: Callable[[str], None], *command: str
    ) -> None:
        """`command` is the module and its arguments; `hear` gets its lines, from a thread."""
        self._command = command
        self._news = news
        self._hear = hear
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
            # Ctrl-C is this process's own matter.
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
        """Tell it to end; who has several tells all of them before waiting for each."""
        self._leaving = True
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()

    def tell(self, *words: object) -> None:
        """One line. Raises OSError if it has ended."""
        self.check()
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(" ".join(map(str, words)) + "\n")
        except BrokenPipeError:
            self._reader.join(_ENDS_WITHIN_S)
            self.check()
            raise

    def check(self) -> None:
        """Raises OSError if it has failed or ended; the text says why."""
        if self._problem is not None:
            raise OSError(f"{self._command[0]}: {self._problem}")

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            word, _, rest = line.strip().partition(" ")
            if word == "failed":
                self._problem = self._problem or rest
            else:
                self._hear(line)
            self._news.tell()
        if not self._leaving and self._problem is None:
            self._errors.seek(0)
            last = self._errors.read().decode(errors="replace").strip().splitlines()[-1:]
            self._problem = " ".join(["it ended", *last])
        self._news.tell()
