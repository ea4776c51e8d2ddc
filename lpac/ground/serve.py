"""Run a view's server until it is stopped."""

import asyncio
import signal
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from typing import TypeVar

T = TypeVar("T")


async def serve(server: AbstractAsyncContextManager[T], ready: Callable[[T], None]) -> None:
    """Serve until SIGINT or SIGTERM. `ready` gets the server's value. Raises what it raises."""
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    async with server as where:
        ready(where)
        await ended.wait()
