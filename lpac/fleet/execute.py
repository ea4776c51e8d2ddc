"""Shell command on a robot, with its output line by line as it comes."""

import asyncio
from collections.abc import Callable
from contextlib import suppress

from lpac.fleet.session import UnreachableError, explain, ssh_command
from lpac.fleet.settings import FleetConfig, RobotHost

_MAX_LINE_BYTES = 1 << 22
# ssh's own exit code for a failed connection.
_SSH_FAILED = 255

OnLine = Callable[[str], None]


async def execute(
    config: FleetConfig,
    robot: RobotHost,
    command: str,
    on_output: OnLine,
    on_error: OnLine,
) -> int:
    """Run `command` in the login shell, pass on each line of output, and return the exit code.

    Raises UnreachableError, ValueError for a line of more than 4 MB, and what `on_output` raises.
    """
    process = await asyncio.create_subprocess_exec(
        *ssh_command(config, robot), command,
        stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE, limit=_MAX_LINE_BYTES, process_group=0,
    )  # fmt: skip
    assert process.stdout is not None and process.stderr is not None
    stderr: list[str] = []

    def on_stderr(line: str) -> None:
        stderr.append(line)
        on_error(line)

    try:
        async with asyncio.TaskGroup() as group:
            group.create_task(_read(process.stdout, on_output))
            group.create_task(_read(process.stderr, on_stderr))
        exit_code = await process.wait()
    except ExceptionGroup as errors:
        # except* re-raises a group before Python 3.11.4.
        if isinstance(errors.exceptions[0], ValueError):
            raise errors.exceptions[0] from None
        raise
    finally:
        with suppress(ProcessLookupError):
            process.kill()
        await process.wait()
    if exit_code == _SSH_FAILED:
        raise UnreachableError(explain("\n".join(stderr), robot.host))
    return exit_code


async def _read(stream: asyncio.StreamReader, on_line: OnLine) -> None:
    while True:
        try:
            line = await stream.readline()
        except ValueError:
            raise ValueError(f"an output line exceeds {_MAX_LINE_BYTES} bytes") from None
        if not line:
            return
        on_line(line.decode(errors="replace").rstrip("\r\n"))
