"""The ground process: a station, the radio, and the socket of its clients.

All of it runs in one asyncio loop; zenoh's threads only hand over what came.
"""

import asyncio
import base64
import math
import socket
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from edge.core.perception import EXPLORED_CELLS
from edge.drivers.zenoh_link import ZenohLink
from edge.messages.codec import MessageError, decode, encode
from edge.messages.mission import GroundState, RobotStatus
from edge.messages.topics import EXPLORED, ORDER, STATE, STATUS, WORLD
from lpac.analysis.snapshot import Explored, GroundEvent
from lpac.ground.station.client import MAX_LINE, GroundError, socket_path
from lpac.ground.station.commands import DEFECT, Commands
from lpac.ground.station.config import GroundConfig
from lpac.ground.station.protocol import (
    SNAPSHOT_PERIOD_S,
    SUBSCRIBE,
    CommandProgress,
    CommandReport,
    Problem,
    ProblemCode,
    ServerMessage,
    request_from_line,
    to_line,
)
from lpac.ground.station.station import NameTakenError, Station, is_down

_WORLD_PERIOD_S = 0.5
# A client takes it from this that its ground does not hang.
_WORD_PERIOD_S = 1.0
# A client that does not read misses pictures, and in the end is left alone.
_LATE_BYTES = 1 << 20
_LOST_BYTES = 1 << 25


class _Client:
    """One that has subscribed."""

    def __init__(self, writer: asyncio.StreamWriter) -> None:
        self.writer = writer

    def send(self, line: bytes, *, may_be_missed: bool = False) -> None:
        waiting = self.writer.transport.get_write_buffer_size()
        if waiting > _LOST_BYTES:
            self.writer.transport.abort()
        elif not (may_be_missed and waiting > _LATE_BYTES):
            self.writer.write(line)


class GroundProcess:
    """`run` it; `tell` hears each event."""

    def __init__(self, config: GroundConfig, tell: Callable[[GroundEvent], None]) -> None:
        setup = config.setup
        self._config = config
        self._tell = tell
        self._station = Station(setup, time.monotonic(), time.time())
        self._commands = Commands(self._station)
        self._clients: set[_Client] = set()
        self._explored: dict[str, bytes] = {}
        self._names = {f"robot/{robot}": name for name, robot in setup.robots.items()}
        self._told_setup = setup
        self._world_at_s = 0.0
        self._complained: set[str] = set()
        self._socket_path = socket_path(setup.fleet)
        # What the robots were told last outlives this process.
        self._world_path = self._socket_path.with_suffix(".world")
        self._state_path = self._socket_path.with_suffix(".state")
        self._kept: GroundState | None = None
        self._stepped = asyncio.Event()
        self._failed: asyncio.Future[None] | None = None
        self._link: ZenohLink | None = None
        self._published: tuple[int | None, int] = None, 0

    async def run(self, on_listening: Callable[[], None]) -> None:
        """Until it is cancelled; `on_listening` is called once clients can connect.

        Raises GroundError, LinkError or NameTakenError, in one line.
        """
        fleet = self._config.setup.fleet
        loop = asyncio.get_running_loop()
        self._failed = loop.create_future()
        self._recall()

        def received(key: str, data: bytes) -> None:
            with suppress(RuntimeError):  # The loop has ended.
                loop.call_soon_threadsafe(self._guarded, key, data)

        _refuse_second(self._socket_path, fleet)
        with ZenohLink(
            fleet=fleet,
            connect=self._config.connect,
            subscriptions={
                STATUS: received,
                EXPLORED: received,
                STATE: received,
                WORLD: received,
            },
        ) as self._link:
            server = await asyncio.start_unix_server(self._serve, self._socket_path, limit=MAX_LINE)
            self._socket_path.chmod(0o600)
            on_listening()
            ticking = asyncio.create_task(self._tick_on())
            try:
                await asyncio.wait((ticking, self._failed), return_when=asyncio.FIRST_COMPLETED)
                for ended in (ticking, self._failed):
                    if ended.done():
                        ended.result()
            finally:
                ticking.cancel()
                server.close()
                for client in self._clients:
                    client.writer.transport.abort()
                self._socket_path.unlink(missing_ok=True)

    def needed(self) -> bool:
        """Whether robots fly that this station commands, or did a few seconds ago."""
        statuses = map(self._station.lately, self._config.setup.robots)
        return self._station.commands and not all(map(is_down, filter(None, statuses)))

    # What comes

    def _guarded(self, key: str, data: bytes) -> None:
        assert self._failed is not None
        try:
            self._receive(key, data)
        except NameTakenError as error:
            if not self._failed.done():
                self._failed.set_exception(error)
        except Exception as error:
            self._survive(key, error)

    def _receive(self, key: str, data: bytes) -> None:
        self._station.set_time(time.monotonic(), time.time())
        source, _, topic = key.rpartition("/")
        name = self._names.get(source)
        if topic == "explored":
            sane = len(data) == EXPLORED_CELLS**2 // 8
            if name is not None and sane and self._explored.get(name) != data:
                self._explored[name] = data
                self._send(_explored(name, data))
            return
        try:
            if topic == "state":
                self._station.hear_state(decode(GroundState, data))
            elif topic == "world":
                self._station.hear_world(data.decode(errors="replace"))
            else:
                self._station.hear_status(decode(RobotStatus, data))
        except MessageError as error:
            # Another version of the program, say.
            self._complain(key, name or "", f"{topic} is not understood: {error}")
            return
        if name is None and topic == "status":
            self._complain(key, "", f"{source.replace('/', ' ')} is heard, and not in fleet.toml")
        self._step()

    def _survive(self, what: str, error: Exception) -> None:
        """Robots that fly need this process more than they need what it could not do."""
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(where.filename).name}, line {where.lineno}"
        text = f"a defect of lpac ground ({what}): {error!r} in {place}"
        self._complain(f"defect {what}", "", text)

    def _complain(self, key: str, robot: str, text: str) -> None:
        """Once for each key is enough."""
        if key not in self._complained:
            self._complained.add(key)
            self._station.tell("presence", robot, text)

    # What goes

    async def _tick_on(self) -> None:
        next_s = time.monotonic()
        while True:
            now_s = time.monotonic()
            self._station.set_time(now_s, time.time())
            try:
                self._station.tick()
                self._step()
            except NameTakenError:
                raise
            except Exception as error:
                self._survive("tick", error)
            try:
                self._publish(now_s)
                if self._clients:
                    snapshot = to_line(self._station.snapshot(self._commands.texts))
                    for client in tuple(self._clients):
                        client.send(snapshot, may_be_missed=True)
            except Exception as error:
                self._survive("publish", error)
            next_s = max(next_s + SNAPSHOT_PERIOD_S, now_s)
            await asyncio.sleep(next_s - time.monotonic())

    def _publish(self, now_s: float) -> None:
        link = self._link
        assert link is not None
        self._keep()
        state = self._station.published_state()
        orders = self._station.published_orders()
        self._published = (None if state is None else state.sequence, len(orders))
        if state is not None:
            link.publish(STATE, encode(state))
        for order in orders:
            link.publish(ORDER, encode(order))
        world = self._station.published_world()
        if world is not None and now_s - self._world_at_s >= _WORLD_PERIOD_S:
            self._world_at_s = now_s
            link.publish(WORLD, world.encode())

    def _step(self) -> None:
        """Let commands go on, and tell what is new."""
        self._commands.step()
        self._stepped.set()
        self._stepped.clear()
        setup = self._station.setup
        if setup != self._told_setup:
            if setup.world not in ("", self._told_setup.world):
                with suppress(OSError, ValueError):  # Only the next one misses it.
                    self._world_path.write_text(setup.world, "utf-8")
            self._told_setup = setup
            self._send(setup)
        for event in self._station.new_events():
            self._tell(event)
            self._send(event)
        state, orders = self._station.published_state(), self._station.published_orders()
        if self._published != (None if state is None else state.sequence, len(orders)):
            # What is new does not wait for its turn.
            self._publish(time.monotonic())

    def _send(self, told: ServerMessage) -> None:
        if self._clients:
            line = to_line(told)
            for client in tuple(self._clients):
                client.send(line)

    def _keep(self) -> None:
        """Before robots hear of it."""
        state = self._station.state
        if state is None or state == self._kept or not self._station.commands:
            return
        self._kept = state
        new = self._state_path.with_suffix(".state-new")
        with suppress(OSError):  # Only the next one misses it.
            new.write_bytes(encode(state))
            new.replace(self._state_path)

    def _recall(self) -> None:
        with suppress(OSError, UnicodeDecodeError):
            self._station.remember_world(self._world_path.read_text("utf-8-sig"))
        with suppress(OSError, MessageError):
            self._station.remember(decode(GroundState, self._state_path.read_bytes()))

    # Clients

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            line = await reader.readline()
            if line == SUBSCRIBE:
                await self._serve_subscriber(reader, writer)
            elif line:
                await self._serve_command(line, reader, writer)
        except (ConnectionError, ValueError):  # It left, or its line is too long.
            pass
        except asyncio.CancelledError:  # This process ends; asyncio would only complain.
            pass
        finally:
            writer.close()

    async def _serve_subscriber(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        client = _Client(writer)
        station = self._station
        explored = (_explored(name, cells) for name, cells in self._explored.items())
        snapshot = station.snapshot(self._commands.texts)
        known: tuple[ServerMessage, ...] = station.setup, *explored, *station.last_events, snapshot
        for told in known:
            client.send(to_line(told))
        self._clients.add(client)
        try:
            while await reader.read(1 << 16):
                pass
        finally:
            self._clients.discard(client)

    async def _serve_command(
        self, line: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        try:
            request = request_from_line(line)
        except MessageError as error:
            writer.write(
                to_line(CommandReport(problem=Problem(ProblemCode.NOT_UNDERSTOOD, str(error))))
            )
            return
        self._station.set_time(time.monotonic(), time.time())
        try:
            running = self._commands.begin(request)
            self._step()
        except Exception as error:
            self._survive("command", error)
            writer.write(to_line(CommandReport(problem=DEFECT)))
            return
        left = asyncio.create_task(reader.read(1))
        said_s = -math.inf
        try:
            while True:
                news, now_s = running.news(), time.monotonic()
                if not news and now_s - said_s >= _WORD_PERIOD_S:
                    news = [CommandProgress("", "")]
                for progress in news:
                    said_s = now_s
                    writer.write(to_line(progress))
                if running.report is not None:
                    writer.write(to_line(running.report))
                    await writer.drain()
                    return
                stepped = asyncio.create_task(self._stepped.wait())
                await asyncio.wait((left, stepped), return_when=asyncio.FIRST_COMPLETED)
                stepped.cancel()
                if left.done():
                    running.abandon("its client left", withdraw=False)
                    self._step()
                    return
        finally:
            left.cancel()


def _explored(name: str, cells: bytes) -> Explored:
    return Explored(name, base64.b64encode(cells).decode())


def _refuse_second(path: Path, fleet: str) -> None:
    """Raises GroundError if one runs already; what a dead one left is removed."""
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(str(path))
        except FileNotFoundError:
            return
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
            return
    raise GroundError(f"`lpac ground` already runs for fleet {fleet} here")
