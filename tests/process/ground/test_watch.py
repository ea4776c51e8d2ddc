"""`lpac watch`, as an operator uses it."""

import asyncio
import fcntl
import itertools
import json
import os
import pty
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from textual.pilot import Pilot
from typer.testing import CliRunner

from edge.messages.mission import FlightState
from lpac.analysis.snapshot import FleetSetup, FleetSnapshot, GroundEvent, RobotSnapshot
from lpac.cli.main import app
from lpac.ground.station.client import command, socket_path
from lpac.ground.station.protocol import (
    Enable,
    SetOrigin,
    Start,
    Takeoff,
    to_line,
)
from lpac.ground.terminal.app import Lines, Watch
from tests.conftest import ROOT
from tests.live import ORIGIN, FlownFleet
from tests.process.ground.conftest import PATIENCE_S, wait_for_snapshot
from tests.said import reason, reasons
from tests.unit.ground.snapshots import on_ground, robot, setup, snapshot, status

_S = FlightState


class Seen:
    """What stands on the screen."""

    def __init__(self, app: Watch, pilot: Pilot[str]) -> None:
        self.app, self.pilot = app, pilot

    def lines(self, name: str) -> list[str]:
        """What a part of the screen shows."""
        part = self.app.query_one(f"#{name}", Lines)
        if not part.display:
            return []
        return [part.render_line(y).text for y in range(part.size.height)]

    def text(self, name: str) -> str:
        return "\n".join(line.rstrip() for line in self.lines(name))

    def table_states(self) -> list[str]:
        """The states in the table, robot by robot."""
        rows = (line[1:].split() for line in self.lines("body"))
        return [row[1] for row in rows if row]

    async def until(self, condition: Callable[[], object]) -> None:
        """Each picture may bring it."""
        until_s = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < until_s, "\n".join(
                self.text(part.id or "") for part in self.app.query(Lines)
            )
            await self.pilot.pause(0.05)

    async def press(self, *keys: str) -> None:
        await self.pilot.press(*keys)


@asynccontextmanager
async def watching(fleet: str, size: tuple[int, int] = (80, 24)) -> AsyncIterator[Seen]:
    app = Watch(fleet)
    async with app.run_test(size=size) as pilot:
        yield Seen(app, pilot)


@pytest.fixture(autouse=True)
def _own_sockets(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("run")))


def lpac(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "lpac.cli.main", *map(str, arguments)]


def environment(**changes: str) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), **changes}


@contextmanager
def ground(fleet: FlownFleet) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(
        lpac("ground", "--fleet", fleet.fleet_toml, "--name", "alice"),
        env=environment(), stdout=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        wait_for_snapshot(fleet.name)
        yield process
    finally:
        process.kill()
        process.wait()
        # It had no time to.
        socket_path(fleet.name).unlink(missing_ok=True)


def fly(fleet: FlownFleet) -> None:
    for request in (SetOrigin(ORIGIN), Enable(), Takeoff(interval_s=0.1), Start()):
        report = command(fleet.name, request)
        assert report.done, report


def states(fleet: FlownFleet) -> set[FlightState]:
    return {flown.state for flown in fleet.flown}


def test_an_operator_watches_holds_and_lands(tmp_path: Path) -> None:
    async def use(fleet: FlownFleet) -> None:
        async with watching(fleet.name) as seen:
            await seen.until(lambda: seen.table_states() == ["mission"] * 3)
            await seen.until(lambda: "alice commands" in seen.text("header"))
            await seen.press("c", "y")
            await seen.until(lambda: "take command: r0 r1 r2: obeys alice" in seen.text("message"))
            # One key, also while something is asked, and in every view.
            await seen.press("?", "l")
            await seen.until(lambda: "Land the WHOLE FLEET" in seen.text("message"))
            await seen.press("h")
            await seen.until(lambda: states(fleet) == {_S.HOLD})
            await seen.until(lambda: "hold the fleet: r0 r1 r2: hold" in seen.text("message"))
            await seen.press("escape")
            await seen.until(lambda: seen.table_states() == ["hold"] * 3)
            await seen.until(lambda: "HOLD by alice" in seen.text("header"))
            # One robot alone, in its own view. Which is where depends on the alarms at the time.
            await seen.press("enter")
            for key in itertools.cycle("kkjj"):
                if seen.text("heading").startswith("r1 "):
                    break
                await seen.press(key)
            r1 = "r1 (id 1)  hold: ground commands hold"
            await seen.until(lambda: seen.text("heading").startswith(r1))
            await seen.press("L")
            await seen.until(lambda: "Land r1 where it is?" in seen.text("message"))
            await seen.press("y")
            await seen.until(lambda: fleet.flown[1].state is _S.LANDED)
            await seen.until(lambda: "land r1: r1: " in seen.text("message"))
            assert fleet.flown[0].state is _S.HOLD
            # Anything but y is no; caps lock does not make a key of the fleet a robot's.
            await seen.press("escape", "L", "x")
            await seen.until(lambda: "nothing done" in seen.text("message"))
            await seen.press("l", "y")
            await seen.until(lambda: states(fleet) == {_S.LANDED})
            await seen.press("q")

    with FlownFleet(tmp_path, 3) as fleet, ground(fleet):
        fly(fleet)
        asyncio.run(use(fleet))


def test_a_ground_process_that_ends_and_comes_back(tmp_path: Path) -> None:
    async def use(fleet: FlownFleet) -> None:
        async with watching(fleet.name) as seen:
            await seen.until(lambda: "NO GROUND STATION" in seen.text("banner"))
            assert "start `lpac ground`" in seen.text("banner")
            with ground(fleet) as process:
                await seen.until(lambda: seen.table_states() == ["idle"] * 2)
                assert not seen.text("banner")
                process.send_signal(signal.SIGSTOP)
                await seen.until(lambda: "sends nothing" in seen.text("banner"))
                process.send_signal(signal.SIGCONT)
                await seen.until(lambda: not seen.text("banner"))
            await seen.until(lambda: "NO GROUND STATION" in seen.text("banner"))
            assert "hold after 3 s, land where they are after 13 s" in seen.text("banner")
            assert seen.table_states() == ["idle"] * 2
            await seen.press("h")
            await seen.until(lambda: "hold the fleet NOT SENT" in seen.text("message"))
            with ground(fleet):
                await seen.until(lambda: not seen.text("banner"))

    with FlownFleet(tmp_path, 2) as fleet:
        asyncio.run(use(fleet))


@asynccontextmanager
async def told(
    fleet: FleetSetup, seen: Callable[[], FleetSnapshot], events: Sequence[GroundEvent] = ()
) -> AsyncIterator[None]:
    """A ground process that tells events, and then whatever picture it is given."""

    async def serve(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(to_line(fleet))
        writer.writelines(to_line(event) for event in events)
        try:
            while not ended.is_set():
                writer.write(to_line(seen()))
                await writer.drain()
                await asyncio.sleep(0.05)
        except ConnectionError:
            pass
        finally:
            writer.close()
            left.set()

    ended, left = asyncio.Event(), asyncio.Event()
    async with await asyncio.start_unix_server(serve, socket_path(fleet.fleet)):
        yield
        ended.set()
        await left.wait()


def test_the_missions_clock() -> None:
    async def use() -> None:
        seen_last = snapshot(robot(status(0)), robot(status(1)), mission_s=60.0)
        async with told(setup(2), lambda: seen_last), watching("field") as seen:
            await seen.until(lambda: "mission 01:00" in seen.text("header"))

    asyncio.run(use())


@pytest.mark.parametrize("size", [(40, 12), (40, 8)])
def test_what_is_asked_is_seen_in_a_small_terminal(size: tuple[int, int]) -> None:
    ill = snapshot(*(robot(status(i, alarms=reasons(f"{i} is lost"))) for i in range(9)))

    async def use() -> None:
        async with told(setup(9), lambda: ill), watching("field", size) as seen:
            await seen.until(lambda: "0 is lost" in seen.text("alarms"))
            await seen.press("l")
            await seen.until(lambda: "Land the WHOLE FLEET" in seen.text("message"))
            assert "h HOLD" in seen.text("keys")
            bottom = seen.app.query_one("#bottom").region
            assert (bottom.y, bottom.height) == (size[1] - 2, 2)
            # Nothing scrolls but the table.
            assert seen.app.screen.scrollbars_enabled == (False, False)

    asyncio.run(use())


def test_thirty_robots_at_80_columns_and_24_lines() -> None:
    def heard(robot_id: int, **changes: Any) -> RobotSnapshot:
        return robot(status(robot_id, neighbour_ages_s=everybody, **changes))

    everybody = {str(i): 0.2 for i in range(30)}
    odd = [
        replace(heard(0), status=None, age_s=None),
        heard(1, position_m=None, velocity_m_s=None, battery=None, satellites=None, mode=None),
        heard(2, battery=1.0, position_m=(-12.3, -123.4, -0.04)),
        robot(on_ground(3), age_s=4000.0),
        heard(4, reason=reason("世界 " * 40), mode="stabilized"),
    ]
    flying = [heard(i, position_m=(i, i, 4.0)) for i in range(5, 29)]
    late = heard(29, alarms=reasons("position lost"))

    async def use() -> None:
        snapshots = [snapshot(*odd, *flying, late)]
        async with told(setup(30), lambda: snapshots[0]), watching("field") as seen:
            await seen.until(lambda: "position lost" in seen.text("alarms"))
            for part in seen.app.query(Lines):
                assert all(len(line) <= 80 for line in seen.lines(part.id or ""))
            shown = seen.lines("body")
            assert shown[0].startswith("! r29 ")
            # The reason begins where it does in every other line.
            assert all(line[43] == " " != line[42] for line in shown), shown
            await seen.press("end")
            await seen.until(lambda: "r28 " in seen.text("body"))
            why, more = seen.lines("selected")
            assert why.startswith(" r28  mission started")
            assert more.startswith(" fence margin 6.0 m   bundle 79929121   world c64e4b1b ")
            assert seen.text("body").count("\n") == 10
            await seen.press("enter")
            r28 = "r28 (id 28)  mission: mission started"
            await seen.until(lambda: seen.text("heading").startswith(r28))
            # Who was selected stays so, wherever his row goes.
            snapshots[0] = snapshot(*odd, *flying[:-1], heard(28, battery=0.1), late)
            await seen.press("escape")
            await seen.until(lambda: "battery critical: 10%" in seen.text("alarms"))
            await seen.press("home", "enter")
            await seen.until(lambda: seen.text("heading").startswith("r28 (id 28)"))
            await seen.press("a")
            await seen.until(lambda: "position lost" in seen.text("body"))

    asyncio.run(use())


# The command


def test_without_a_ground_process_it_is_one_line(tmp_path: Path) -> None:
    fleet = FlownFleet(tmp_path, 1, name="nobody")  # which does not run
    done = subprocess.run(
        lpac("watch", "--once", "--fleet", fleet.fleet_toml), env=environment(),
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    text = "lpac: no ground station runs for fleet nobody here: start `lpac ground`\n"
    assert (done.returncode, done.stdout, done.stderr) == (1, "", text)


def test_the_command_on_a_terminal_and_without(tmp_path: Path) -> None:
    with FlownFleet(tmp_path, 2) as fleet, ground(fleet):
        at = ("--fleet", fleet.fleet_toml)

        def printed(*arguments: object, **changes: str) -> str:
            return subprocess.run(
                lpac("watch", *at, *arguments), env=environment(**changes),
                stdin=subprocess.DEVNULL, capture_output=True, text=True, check=True,
            ).stdout  # fmt: skip

        def mistake(*arguments: object) -> str:
            called = CliRunner().invoke(app, ["watch", *map(str, (*at, *arguments))])
            assert called.exit_code == 1
            return str(called.exception)

        # There is no terminal here.
        lines = printed(COLUMNS="80").splitlines()
        assert lines[0].startswith(f"{fleet.name}  nobody commands (this is alice)")
        assert [line.split()[0] for line in lines[-2:]] == ["r0", "r1"]
        assert all(len(line) <= 80 for line in lines)
        assert [r["name"] for r in json.loads(printed("--json"))["robots"]] == ["r0", "r1"]
        svg = tmp_path / "watch.svg"
        printed("--screenshot", svg, "--size", "100x30")
        assert "commands" in svg.read_text()
        nowhere = tmp_path / "nowhere/watch.svg"
        assert mistake("--screenshot", nowhere).endswith(f"No such file or directory: '{nowhere}'")
        text = "--size 80: must be columns x lines, such as 100x30"
        assert mistake("--screenshot", svg, "--size", "80") == text
        with terminal(lpac("watch", *at), 80, 24) as (process, screen):
            read_until(screen, "nobody")
            os.write(screen, b"q")
            read_until(screen, "\x1b[?1049l")
            assert process.wait(PATIENCE_S) == 0


@contextmanager
def terminal(
    command_line: list[str], across: int, down: int
) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """A program in a terminal of that size; and what it writes there."""
    screen, inside = pty.openpty()
    fcntl.ioctl(inside, termios.TIOCSWINSZ, struct.pack("HHHH", down, across, 0, 0))
    without_size = {k: v for k, v in environment().items() if k not in ("COLUMNS", "LINES")}
    process = subprocess.Popen(
        command_line, env={**without_size, "TERM": "xterm-256color"}, start_new_session=True,
        stdin=inside, stdout=inside, stderr=inside,
    )  # fmt: skip
    os.close(inside)
    try:
        yield process, screen
    finally:
        process.kill()
        process.wait()
        os.close(screen)


def read_until(screen: int, wanted: str) -> None:
    read = ""
    until_s = time.monotonic() + PATIENCE_S
    while wanted not in read:
        ready, _, _ = select.select([screen], [], [], max(0.0, until_s - time.monotonic()))
        assert ready, read
        read += os.read(screen, 1 << 16).decode(errors="replace")
