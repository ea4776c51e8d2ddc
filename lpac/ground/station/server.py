"""The ground process: a station, the radio, and the clients' socket.

Everything runs in one asyncio loop; zenoh's threads only pass messages to it.
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

# Empty progress tells a client that the ground process does not hang.
_KEEP_ALIVE_S = 1.0
# A client that does not read misses snapshots, and is disconnected in the end.
_SKIP_BYTES = 1 << 20
_DISCONNECT_BYTES = 1 << 25


class _Client:
    def __init__(self, writer: asyncio.StreamWriter) -> None:
        self.writer = writer

    def send(self, line: bytes, *, may_be_missed: bool = False) -> None:
        waiting = self.writer.transport.get_write_buffer_size()
        if waiting > _DISCONNECT_BYTES:
            self.writer.transport.abort()
        elif not (may_be_missed and waiting > _SKIP_BYTES):
            self.writer.write(line)


class GroundProcess:
    """The ground process; `on_event` gets each event."""

    def __init__(self, config: GroundConfig, on_event: Callable[[GroundEvent], None]) -> None:
        self._config = config
        self._on_event = on_event
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
        # Restored by the next ground process.
        self._world_path = self._socket_path.with_suffix(".world")
        self._state_path = self._socket_path.with_suffix(".state")
        self._stepped = asyncio.Event()
        self._cannot_write = False

    async def run(self, on_listening: Callable[[], None]) -> None:
        """Run until cancelled; `on_listening` is called once clients can connect.

        Raises GroundError or LinkError, in one line.
        """
        fleet, identity = self._config.setup.fleet, self._config.identity
        loop = asyncio.get_running_loop()
        self._restore()

        def received(receive: ReceiveCallback, key: str, data: bytes) -> None:
            with suppress(RuntimeError):  # The loop has ended.
                loop.call_soon_threadsafe(receive, key, data)

        _refuse_second(self._socket_path, fleet)
        with ZenohLink(
            fleet=fleet,
            connect=self._config.connect,
            subscriptions={
                topic: partial(received, receive)
                for topic, receive in self._node.subscriptions.items()
            },
            tls=None if identity is None else identity.tls,
            members=self._members,
        ) as link:
            self._node.attach(link)
            server = await asyncio.start_unix_server(self._serve, self._socket_path, limit=MAX_LINE)
            self._socket_path.chmod(0o600)
            on_listening()
            ticking = asyncio.create_task(self._tick_forever())
            try:
                await ticking
            finally:
                ticking.cancel()
                server.close()
                for client in self._clients:
                    client.writer.transport.abort()
                self._socket_path.unlink(missing_ok=True)

    def is_needed(self) -> bool:
        """Whether this station commands robots that fly, or did a few seconds ago."""
        station = self._node.station
        statuses = map(station.recent_status, self._config.setup.robots)
        return station.commands and not all(map(is_down, filter(None, statuses)))

    async def _tick_forever(self) -> None:
        next_s = time.monotonic()
        while True:
            if self._take_up is not None:
                with self._writing():
                    self._take_up()
            self._node.tick()
            with self._node.reporting_defects("snapshot"):
                if self._clients:
                    snapshot = to_line(self._node.snapshot)
                    for client in tuple(self._clients):
                        client.send(snapshot, may_be_missed=True)
            now_s = time.monotonic()
            next_s = max(next_s + SNAPSHOT_PERIOD_S, now_s)
            await asyncio.sleep(next_s - now_s)

    def published(self, message: ServerMessage) -> None:
        """Send the message to all clients, and save the last world."""
        if isinstance(message, GroundEvent):
            self._on_event(message)
        if isinstance(message, FleetSetup) and message.world not in ("", self._world):
            self._world = message.world
            with self._writing(), suppress(ValueError):
                self._world_path.write_text(message.world, "utf-8")
        if self._clients:
            line = to_line(message)
            for client in tuple(self._clients):
                client.send(line)

    def progressed(self) -> None:
        """Wake the clients that wait for a command."""
        self._stepped.set()
        self._stepped.clear()

    def state_changed(self, state: GroundState) -> None:
        """Save the state."""
        new = self._state_path.with_suffix(".state-new")
        with self._writing():
            new.write_bytes(encode(state))
            new.replace(self._state_path)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Warn once if the files that the next start restores cannot be written."""
        try:
            yield
        except OSError as error:
            if not self._cannot_write:
                self._cannot_write = True
                why = f"{error.filename or self._state_path.parent}: {in_words(error)}"
                log.warning("state for the next start cannot be written", why=why)

    def _restore(self) -> None:
        station = self._node.station
        with suppress(OSError, UnicodeDecodeError):
            station.worlds.add(self._world_path.read_text("utf-8-sig"))
        with suppress(OSError, MessageError):
            station.election.restore(decode(GroundState, self._state_path.read_bytes()))

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            line = await reader.readline()
            if line == SUBSCRIBE:
                await self._serve_subscriber(reader, writer)
            elif line:
                await self._serve_command(line, reader, writer)
        except (ConnectionError, ValueError):  # It left, or its line is too long.
            pass
        except asyncio.CancelledError:  # At the end of the process, asyncio would log it.
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
        for message in known:
            client.send(to_line(message))
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
        sent_s = -math.inf
        try:
            while True:
                messages, now_s = running.new_progress(), time.monotonic()
                if not messages and now_s - sent_s >= _KEEP_ALIVE_S:
                    messages = [CommandProgress("", "")]
                for progress in messages:
                    sent_s = now_s
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
    """Raises GroundError if one runs already; removes the socket of a dead one."""
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(str(path))
        except FileNotFoundError:
            return
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
            return
    raise GroundError(f"`lpac ground` already runs for fleet {fleet} here")
