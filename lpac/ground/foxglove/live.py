"""`lpac foxglove live`: a WebSocket that Foxglove connects to; a client of the ground process.

Clients can subscribe, and nothing else: whoever is connected, the fleet hears nothing of it. Each
has a queue of its own, so that a slow one misses messages, and no other does.
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
    """Serve a fleet to Foxglove as long as this context lasts; gives the port.

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
    """Listen to the ground, and again when it comes back; for ever."""
    view = FoxgloveView()

    def show(topic: str, unix_time_s: float, message: Mapping[str, object]) -> None:
        for shown in view.take(topic, unix_time_s, message):
            channels.publish(shown)

    with contextlib.closing(Recording(show)) as recording:
        while True:
            try:
                async for told in listen(fleet):
                    recording.take(told, time.time())
                    if isinstance(told, FleetSetup):
                        server.remove_status([_NO_GROUND])
                    elif isinstance(told, FleetSnapshot):
                        for shown in view.tick(told.unix_time_s):
                            channels.publish(shown)
            except (OSError, ValueError) as error:
                server.publish_status(str(error), StatusLevel.Warning, _NO_GROUND)
            await asyncio.sleep(_RETRY_S)
