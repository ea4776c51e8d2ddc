"""A command on a robot, by its shell; its output comes line by line while it runs."""

import asyncio
from collections.abc import Callable
from contextlib import suppress

from lpac.fleet.session import UnreachableError, explain, ssh_command
from lpac.fleet.settings import FleetConfig, RobotHost

# Of a line of output.
_MOST_BYTES = 1 << 22
# What ssh itself ends with if there is no conversation with the robot.
_SSH_FAILED = 255

OnLine = Callable[[str], None]


async def execute(
    config: FleetConfig,
    robot: RobotHost,
    command: str,
    on_output: OnLine,
    on_error: OnLine,
) -> int:
    """Run `command` in the login shell; its exit code. Each line of stdout and stderr is handed on.

    Raises UnreachableError, ValueError for a line that is endless, and what `on_output` raises.
    """
    process = await asyncio.create_subprocess_exec(
        *ssh_command(config, robot), command,
        stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE, limit=_MOST_BYTES, process_group=0,
    )  # fmt: skip
    assert process.stdout is not None and process.stderr is not None
    complaints: list[str] = []

    def on_complaint(line: str) -> None:
        complaints.append(line)
        on_error(line)

    try:
        async with asyncio.TaskGroup() as group:
            group.create_task(_read(process.stdout, on_output))
            group.create_task(_read(process.stderr, on_complaint))
        exit_code = await process.wait()
    except ExceptionGroup as errors:
        # Not except*, which raises a group again before Python 3.11.4.
        if isinstance(errors.exceptions[0], ValueError):
            raise errors.exceptions[0] from None
        raise
    finally:
        with suppress(ProcessLookupError):
            process.kill()
        await process.wait()
    if exit_code == _SSH_FAILED:
        raise UnreachableError(explain("\n".join(complaints), robot.host))
    return exit_code


async def _read(stream: asyncio.StreamReader, on_line: OnLine) -> None:
    while True:
        try:
            line = await stream.readline()
        except ValueError:
            raise ValueError(f"a line of its output is longer than {_MOST_BYTES} bytes") from None
        if not line:
            return
        on_line(line.decode(errors="replace").rstrip("\r\n"))
