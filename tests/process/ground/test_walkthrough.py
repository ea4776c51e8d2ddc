"""The walk through ground control in docs/ground.md, line by line as it stands there."""

import json
import os
import pty
import re
import subprocess
import sys
import termios
import threading
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

import pytest

from tests.conftest import ROOT

pytestmark = pytest.mark.real_time

# The page has as many as the machine carries; more than three would only take longer here.
ROBOTS = int(os.environ.get("LPAC_WALK_ROBOTS", "3"))
ACTIVATE = ". .venv/bin/activate"
SETTING = re.compile(r"\. \.venv/bin/activate && export (\w+)=([^\s`]+)")
PATIENCE_S = 120.0
# What a terminal shows beside its text.
CONTROL = re.compile(r"\x1b(\[[0-?]*[ -/]*[@-~]|\][^\x07]*\x07|[@-Z\\-_])")


class Terminal:
    """A command line in a terminal of its own, until Ctrl-C; `key` ends it where that does not."""

    def __init__(
        self, line: str, folder: Path, environment: Mapping[str, str], key: bytes = b"\x03"
    ) -> None:
        self.line = line
        self.text = ""
        self._key = key
        self._grown = threading.Condition()
        self._open = True
        self._controller, terminal = pty.openpty()
        termios.tcsetwinsize(terminal, (30, 100))
        self.process = subprocess.Popen(
            ["setsid", "--ctty", "sh", "-c", f"exec {line}"],
            cwd=folder, env={**environment, "TERM": "xterm-256color"},
            stdin=terminal, stdout=terminal, stderr=terminal,
        )  # fmt: skip
        os.close(terminal)
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def wait_for(self, text: str) -> None:
        """Until it has shown this text."""
        with self._grown:
            found = self._grown.wait_for(lambda: text in self.text or not self._open, PATIENCE_S)
        assert found and text in self.text, (self.line, text, self.text[-2000:])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            os.write(self._controller, self._key)
            code = self.process.wait(PATIENCE_S)
        finally:
            if self.process.poll() is None:
                self.process.kill()
                self.process.wait()
            self._reader.join()
            os.close(self._controller)
        if error is None:
            assert code == 0, (self.line, code, self.text[-2000:])
            assert "Traceback" not in self.text, (self.line, self.text[-2000:])

    def _read(self) -> None:
        while True:
            try:
                data = os.read(self._controller, 1 << 16)
            except OSError:  # the last program that had the terminal has ended
                data = b""
            with self._grown:
                self.text += CONTROL.sub("", data.decode(errors="replace"))
                self._open = bool(data)
                self._grown.notify_all()
            if not data:
                return


def test_the_page_can_be_followed_line_by_line(tmp_path: Path) -> None:
    walk((ROOT / "docs" / "ground.md").read_text(), tmp_path)


def walk(page: str, folder: Path) -> None:
    """Type everything in the section that is to be tried, as it stands there."""
    (section,) = re.findall(
        r"^## Try it on this machine\n(.*?)(?=^## )", page + "\n## ", re.S | re.M
    )
    simulator, stations, flight = re.findall(r"^```sh\n(.*?)^```$", section, re.S | re.M)
    activate, simulate = simulator.splitlines()
    assert activate == ACTIVATE
    setting = SETTING.search(section)
    assert setting is not None
    first, *commands = flight.splitlines()
    assert SETTING.fullmatch(first)
    plain = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    environment = plain | {setting[1]: setting[2]}
    with ExitStack() as terminals:
        assert "-n" not in simulate.split() and simulate.endswith(" --no-script")
        simulate += f" -n {ROBOTS}"
        simulation = terminals.enter_context(Terminal(simulate, folder, plain))
        simulation.wait_for(f"export {setting[1]}={setting[2]}")
        shown = {
            "lpac ground": [f"r{robot}: idle: " for robot in range(ROBOTS)],
            "lpac record": ["connected to the ground station"],
            "lpac watch": [f"r{ROBOTS - 1} "],
            "lpac map --operate": ["http://127.0.0.1:"],
        }
        for line in stations.splitlines():
            command = line.partition("#")[0].strip()
            key = b"q" if command == "lpac watch" else b"\x03"
            terminal = terminals.enter_context(Terminal(line, folder, environment, key))
            for text in shown.pop(command):
                terminal.wait_for(text)
        assert not shown
        said = [type_line(line, folder, environment) for line in commands]
    assert "see out/sim/report/" in said[-1]
    look_at_the_report(folder / "out" / "sim" / "report")


def type_line(line: str, folder: Path, environment: Mapping[str, str]) -> str:
    done = subprocess.run(
        line, shell=True, cwd=folder, env=environment, stdin=subprocess.DEVNULL,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, (line, done.stdout, done.stderr)
    assert "Traceback" not in done.stderr
    if line.startswith("lpac mission ") and "--robots" not in line and " r2" not in line:
        for robot in range(ROBOTS):
            assert f"r{robot} " in done.stdout, (line, done.stdout)
    return done.stdout


def look_at_the_report(folder: Path) -> None:
    trials = json.loads((folder / "report.json").read_text())["trials"]
    assert [trial["trial"] for trial in trials] == ["t1", "t2"]
    for trial in trials:
        assert len(trial["robots"]) == ROBOTS and trial["cost"]["normalized"] > 0.0, trial
    assert (folder / "report.html").stat().st_size > 0 and list(folder.glob("*.png"))
