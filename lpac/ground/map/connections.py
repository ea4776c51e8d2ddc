"""Connections of the live map, limited in total and per address; idle ones are closed.

Without limits, anyone on the network could use up all file descriptors.
"""

import asyncio
import contextlib
import socket
import ssl
from collections import Counter
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

from aiohttp import web
from aiohttp.web_protocol import RequestHandler

# A browser opens six for a page's files, and keeps one.
MOST_OF_ADDRESS = 32
MOST = 256
# Timeout of the TLS handshake, and then of the first request's head.
HEAD_S = 5.0
# Timeout between two requests.
_KEPT_S = 15.0


@dataclass(slots=True)
class _Place:
    """State of a connection from its acceptance, before any TLS."""

    asked: bool = False
    ended: asyncio.Event = field(default_factory=asyncio.Event)


class Connection(RequestHandler):
    """Connection that is closed unless it sends a request in time."""

    __slots__ = ("_head", "_place")

    def __init__(self, server: web.Server, place: _Place) -> None:
        loop = asyncio.get_running_loop()
        super().__init__(server, loop=loop, keepalive_timeout=_KEPT_S)
        self._place = place
        self._head: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Start the timeout; over TLS, after the handshake."""
        super().connection_made(transport)
        assert isinstance(transport, asyncio.Transport)
        self._head = asyncio.get_running_loop().call_later(HEAD_S, transport.abort)

    def asked(self) -> None:
        """Note that the head of a request has been received."""
        self._place.asked = True
        if self._head is not None:
            self._head.cancel()

    def connection_lost(self, exc: BaseException | None) -> None:
        """Release the connection's place."""
        self.asked()
        self._place.ended.set()
        super().connection_lost(exc)


@contextlib.asynccontextmanager
async def accepting(
    server: web.Server, host: str, port: int, tls: ssl.SSLContext | None
) -> AsyncIterator[tuple[str, int]]:
    """Accept connections within this context; gives the address and port.

    Raises OSError if it cannot listen there.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, port), family=family, backlog=128) as listening:
        listening.setblocking(False)
        accepts = asyncio.create_task(_accept(listening, server, tls))
        try:
            own, own_port, *_ = listening.getsockname()
            yield own, own_port
        finally:
            accepts.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await accepts


async def _accept(listening: socket.socket, server: web.Server, tls: ssl.SSLContext | None) -> None:
    loop = asyncio.get_running_loop()
    of_address: Counter[str] = Counter()
    open_now: dict[asyncio.Task[None], _Place] = {}
    try:
        while True:
            try:
                accepted, (address, *_) = await loop.sock_accept(listening)
            except OSError:  # The client has gone, or no descriptors are left.
                await asyncio.sleep(0.1)
                continue
            if len(open_now) >= MOST and of_address[address] < MOST_OF_ADDRESS:
                # Close the oldest connection without a request.
                idle = (task for task, place in open_now.items() if not place.asked)
                if (oldest := next(idle, None)) is not None:
                    oldest.cancel()
                    await asyncio.wait([oldest])
            if len(open_now) >= MOST or of_address[address] >= MOST_OF_ADDRESS:
                accepted.close()
                # Let other tasks run during a flood.
                await asyncio.sleep(0)
                continue
            of_address[address] += 1
            place = _Place()
            task = asyncio.create_task(_serve(accepted, server, tls, place))
            open_now[task] = place

            def end(task: asyncio.Task[None], address: str = address) -> None:
                del open_now[task]
                of_address[address] -= 1
                if not of_address[address]:
                    del of_address[address]

            task.add_done_callback(end)
    finally:
        for task in tuple(open_now):
            task.cancel()


async def _serve(
    accepted: socket.socket, server: web.Server, tls: ssl.SSLContext | None, place: _Place
) -> None:
    try:
        transport, _ = await asyncio.get_running_loop().connect_accepted_socket(
            lambda: Connection(server, place),
            accepted,
            ssl=tls,
            ssl_handshake_timeout=None if tls is None else HEAD_S,
        )
    except OSError:  # No TLS, or not in time.
        accepted.close()
        return
    try:
        await place.ended.wait()
    finally:
        transport.abort()
