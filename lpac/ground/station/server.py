"""The ground process: a station, the radio, and the socket of its clients.

All of it runs in one asyncio loop; zenoh's threads only hand over what came.
"""

import asyncio
import math
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from edge.core.file_errors import in_words
from edge.core.logger import log
from edge.drivers.clock import SystemClock
from edge.drivers.zenoh_link import ZenohLink
from edge.identity.guard import Unguarded
from edge.messages.codec import MessageError, decode, encode
from edge.messages.mission import GroundState
from edge.messages.topics import ReceiveCallback
from lpac.analysis.snapshot import FleetSetup, GroundEvent
from lpac.ground.station.client import MAX_LINE, GroundError, socket_path
from lpac.ground.station.commands import DEFECT
from lpac.ground.station.config import GroundConfig
from lpac.ground.station.node import GroundNode
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
from lpac.ground.station.station import is_down

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
        self._config = config
        self._tell = tell
        clock, identity = SystemClock(), config.identity
        guard = None if identity is None else identity.guard(clock.monotonic_s)
        self._take_up = (
            None if identity is None or guard is None
            else partial(identity.update, guard)
        )  # fmt: skip
        self._node = GroundNode(
            config.setup, clock, self, guard or Unguarded(int(1e3 * clock.unix_s()))
        )
        self._members = guard
        self._clients: set[_Client] = set()
        self._world = config.setup.world
        self._socket_path = socket_path(config.setup.fleet)
        # What the robots were told last outlives this process.
        self._world_path = self._socket_path.with_suffix(".world")
        self._state_path = self._socket_path.with_suffix(".state")
        self._stepped = asyncio.Event()
        self._cannot_write = False

    async def run(self, on_listening: Callable[[], None]) -> None:
        """Until it is cancelled; `on_listening` is called once clients can connect.

        Raises GroundError or LinkError, in one line.
        """
        fleet, identity = self._config.setup.fleet, self._config.identity
        loop = asyncio.get_running_loop()
        self._recall()

        def received(hear: ReceiveCallback, key: str, data: bytes) -> None:
            with suppress(RuntimeError):  # The loop has ended.
                loop.call_soon_threadsafe(hear, key, data)

        _refuse_second(self._socket_path, fleet)
        with ZenohLink(
            fleet=fleet,
            connect=self._config.connect,
            subscriptions={
                topic: partial(received, hear) for topic, hear in self._node.subscriptions.items()
            },
            tls=None if identity is None else identity.tls,
            members=self._members,
        ) as link:
            self._node.attach(link)
            server = await asyncio.start_unix_server(self._serve, self._socket_path, limit=MAX_LINE)
            self._socket_path.chmod(0o600)
            on_listening()
            ticking = asyncio.create_task(self._tick_on())
            try:
                await ticking
            finally:
                ticking.cancel()
                server.close()
                for client in self._clients:
                    client.writer.transport.abort()
                self._socket_path.unlink(missing_ok=True)

    def needed(self) -> bool:
        """Whether robots fly that this station commands, or did a few seconds ago."""
        station = self._node.station
        statuses = map(station.lately, self._config.setup.robots)
        return station.commands and not all(map(is_down, filter(None, statuses)))

    async def _tick_on(self) -> None:
        next_s = time.monotonic()
        while True:
            if self._take_up is not None:
                with self._writing():
                    self._take_up()
            self._node.tick()
            with self._node.surviving("snapshot"):
                if self._clients:
                    snapshot = to_line(self._node.snapshot)
                    for client in tuple(self._clients):
                        client.send(snapshot, may_be_missed=True)
            now_s = time.monotonic()
            next_s = max(next_s + SNAPSHOT_PERIOD_S, now_s)
            await asyncio.sleep(next_s - now_s)

    # What the node tells

    def told(self, message: ServerMessage) -> None:
        """To all clients, and the last world to the disk."""
        if isinstance(message, GroundEvent):
            self._tell(message)
        if isinstance(message, FleetSetup) and message.world not in ("", self._world):
            self._world = message.world
            with self._writing(), suppress(ValueError):
                self._world_path.write_text(message.world, "utf-8")
        if self._clients:
            line = to_line(message)
            for client in tuple(self._clients):
                client.send(line)

    def stepped(self) -> None:
        """Wake the clients that wait for a command."""
        self._stepped.set()
        self._stepped.clear()

    def commanded(self, state: GroundState) -> None:
        """To the disk."""
        new = self._state_path.with_suffix(".state-new")
        with self._writing():
            new.write_bytes(encode(state))
            new.replace(self._state_path)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Warn once if state that the next start needs cannot be written."""
        try:
            yield
        except OSError as error:
            if not self._cannot_write:
                self._cannot_write = True
                why = f"{error.filename or self._state_path.parent}: {in_words(error)}"
                log.warning("what the next start has to know is not written", why=why)

    def _recall(self) -> None:
        station = self._node.station
        with suppress(OSError, UnicodeDecodeError):
            station.worlds.remember(self._world_path.read_text("utf-8-sig"))
        with suppress(OSError, MessageError):
            station.election.remember(decode(GroundState, self._state_path.read_bytes()))

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
        node = self._node
        known: tuple[ServerMessage, ...] = (
            node.station.setup, *node.explored, *node.station.last_events, node.snapshot,
        )  # fmt: skip
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
        running = self._node.begin(request)
        if running is None:
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
                    self._node.abandon(running, "its client left")
                    return
        finally:
            left.cancel()


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
