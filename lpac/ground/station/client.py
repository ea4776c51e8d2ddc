"""Client of this machine's ground process, for commands, views and scripts."""

import asyncio
import os
import socket
import stat
import tempfile
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterable, Iterator
from contextlib import AbstractContextManager, aclosing, contextmanager
from pathlib import Path

from lpac.ground.station.protocol import (
    SUBSCRIBE,
    CommandProgress,
    CommandReport,
    Request,
    ServerMessage,
    server_message_from_line,
    to_line,
)

# Unless it hangs, the ground process sends something at least once a second.
_PATIENCE_S = 5.0
# Worlds are the longest lines.
MAX_LINE = 1 << 26
_MAX_PATH = 103  # macOS; Linux has a few more


class GroundError(OSError):
    """The ground process does not run, has ended or hangs. The message says what to do."""


def socket_path(fleet: str) -> Path:
    """Path of the ground process's socket, in a folder of this user alone.

    Raises GroundError if others can write to the folder, or the path is too long.
    """
    folder = os.environ.get("XDG_RUNTIME_DIR") or _own_folder()
    path = Path(folder, f"lpac-ground-{fleet}.sock")
    if len(os.fsencode(path)) > _MAX_PATH:
        raise GroundError(f"{path}: too long for a socket: set XDG_RUNTIME_DIR to a short path")
    return path


def command(
    fleet: str,
    request: Request,
    on_progress: Callable[[CommandProgress], None] = lambda _: None,
    meanwhile: Callable[[], None] = lambda: None,
) -> CommandReport:
    """Run a command and wait for its report; `meanwhile` is called once a second.

    Leaving early, as by Ctrl-C, abandons what is not ordered yet. Raises GroundError.
    """
    with _connected(fleet, to_line(request)) as answers:
        for answer in answers:
            meanwhile()
            if isinstance(answer, CommandReport):
                return answer
            if isinstance(answer, CommandProgress) and answer.text:
                on_progress(answer)
    raise AssertionError("answers end with a report or an error")


def subscribe(fleet: str) -> AbstractContextManager[Iterator[ServerMessage]]:
    """Messages of the ground process from now on. Raises GroundError, also when it ends."""
    return _connected(fleet, SUBSCRIBE)


async def send(fleet: str, request: Request) -> CommandReport:
    """`command` for asyncio, without progress."""
    async with aclosing(_answers(fleet, to_line(request))) as answers:
        async for answer in answers:
            if isinstance(answer, CommandReport):
                return answer
    raise AssertionError("answers end with a report or an error")


def listen(fleet: str) -> AsyncIterator[ServerMessage]:
    """`subscribe` for asyncio."""
    return _answers(fleet, SUBSCRIBE)


@contextmanager
def _connected(fleet: str, line: bytes) -> Iterator[Iterator[ServerMessage]]:
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(_PATIENCE_S)
        with _ground_errors(fleet):
            connection.connect(str(socket_path(fleet)))
        with connection.makefile("rb") as lines:
            yield _read(fleet, connection, line, lines)


def _read(
    fleet: str, connection: socket.socket, line: bytes, lines: Iterable[bytes]
) -> Iterator[ServerMessage]:
    with _ground_errors(fleet):
        connection.sendall(line)
        yield from map(server_message_from_line, lines)
    raise _ended(fleet)


async def _answers(fleet: str, line: bytes) -> AsyncGenerator[ServerMessage]:
    with _ground_errors(fleet):
        reader, writer = await asyncio.open_unix_connection(socket_path(fleet), limit=MAX_LINE)
        try:
            writer.write(line)
            async with asyncio.timeout(_PATIENCE_S):
                await writer.drain()
            while True:
                async with asyncio.timeout(_PATIENCE_S):
                    answer = await reader.readline()
                if not answer:
                    break
                yield server_message_from_line(answer)
        finally:
            writer.close()
    raise _ended(fleet)


@contextmanager
def _ground_errors(fleet: str) -> Iterator[None]:
    """Turn a socket's exceptions into GroundError."""
    try:
        yield
    except (FileNotFoundError, ConnectionRefusedError):
        text = f"no ground station runs for fleet {fleet} here: start `lpac ground`"
        raise GroundError(text) from None
    except (TimeoutError, BlockingIOError):  # Its backlog is full.
        raise no_answer(fleet) from None
    except ConnectionError:
        raise _ended(fleet) from None


def _own_folder() -> Path:
    folder = Path(tempfile.gettempdir(), f"lpac-{os.getuid()}")
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise GroundError(f"{folder}: others can write to it: remove it")
    return folder


def no_answer(fleet: str) -> GroundError:
    """Error of a ground process that hangs."""
    return GroundError(
        f"the ground station of fleet {fleet} does not answer: end it, and start `lpac ground` "
        "again"
    )


def _ended(fleet: str) -> GroundError:
    return GroundError(f"the ground station of fleet {fleet} has ended: start `lpac ground` again")
