"""`lpac foxglove live`: WebSocket server for Foxglove, a client of the ground process.

Foxglove clients can only subscribe. Each has its own queue, so that a slow one delays no other.
"""

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Mapping

from foxglove import Context, StatusLevel, start_server
from foxglove.websocket import WebSocketServer

from lpac.analysis.snapshot import FleetSetup, FleetSnapshot
from lpac.ground.foxglove.channels import Channels
from lpac.ground.foxglove.view import FoxgloveView
from lpac.ground.record import Recording
from lpac.ground.station.client import listen

_RETRY_S = 1.0
_NO_GROUND = "ground"


@contextlib.asynccontextmanager
async def serving(fleet: str, *, host: str, port: int) -> AsyncIterator[int]:
    """Serve a fleet to Foxglove within this context; gives the port.

    Port 0 takes a free one. Raises OSError if it cannot listen there.
    """
    context = Context()
    channels = Channels(context)
    try:
        server = start_server(
            name=f"lpac {fleet}", host=host, port=port, capabilities=[], context=context
        )
    except RuntimeError as error:
        reason = str(error).removeprefix("FoxgloveError: ")
        raise OSError(f"--host {host} --port {port}: cannot serve there: {reason}") from None
    following = asyncio.create_task(_follow(fleet, channels, server))
    try:
        yield server.port
    finally:
        following.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await following
        server.stop()


async def _follow(fleet: str, channels: Channels, server: WebSocketServer) -> None:
    """Follow the ground process forever, reconnecting when it has ended."""
    view = FoxgloveView()

    def show(topic: str, unix_time_s: float, message: Mapping[str, object]) -> None:
        for shown in view.take(topic, unix_time_s, message):
            channels.publish(shown)

    with contextlib.closing(Recording(show)) as recording:
        while True:
            try:
                async for message in listen(fleet):
                    recording.take(message, time.time())
                    if isinstance(message, FleetSetup):
                        server.remove_status([_NO_GROUND])
                    elif isinstance(message, FleetSnapshot):
                        for shown in view.tick(message.unix_time_s):
                            channels.publish(shown)
            except (OSError, ValueError) as error:
                server.publish_status(str(error), StatusLevel.Warning, _NO_GROUND)
            await asyncio.sleep(_RETRY_S)
