"""SSH session with one robot, and plain explanations of ssh's and rsync's errors.

OpenSSH's own configuration, agent, keys and known_hosts apply. Host keys are always checked, and
nothing prompts.
"""

import asyncio
import contextlib
import json
import re
import shlex
from base64 import b64encode
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from edge.drivers.px4 import raw_mavlink
from lpac.fleet import agent
from lpac.fleet.settings import FleetConfig, RobotHost

OnProgress = Callable[[str], None]

_KEEP_ALIVE_S = 3.0
# The longest call is the policy's verification on a slow CPU.
_CALL_S = 400.0
# Separates the outputs of `capture`.
_SEPARATOR = "\x1e"
# Loads the agent's modules from stdin and serves. The only command that the login shell sees.
_BOOTSTRAP = """
import json, os, sys, types
data = b""
while len(data) < {size}:
    part = os.read(0, {size} - len(data))
    if not part: sys.exit(1)
    data += part
for name, source in json.loads(data.decode()):
    module = sys.modules[name] = types.ModuleType(name)
    exec(compile(source, name, "exec"), module.__dict__)
sys.modules["lpac.fleet.agent"].serve()
"""
# Patterns in the output of ssh and rsync, and their explanations.
_ADVICE = (
    (r"REMOTE HOST IDENTIFICATION HAS CHANGED",
     "its host key has changed: another computer answers, or it was reinstalled; "
     "only in that case run `ssh-keygen -R HOST`, and log in once with ssh"),
    # In batch mode ssh prints only this for an unknown host key.
    (r"No .* host key is known|Host key verification failed",
     "its host key is not known here: log in once with ssh to accept it"),
    (r"Permission denied", "it refuses the login: run `lpac fleet enroll`, or check your key"),
    (r"Could not resolve", "its host name is not known"),
    (r"Connection refused", "nothing listens on its ssh port"),
    # Before the next pattern: rsync reports a closed connection too when the disk is full.
    (r"No space left", "its disk is full"),
    (r"No route to host|timed out|Network is unreachable|not responding|Connection closed|"
     r"Connection reset|Broken pipe|connection unexpectedly closed|timeout in data send/receive",
     "it does not answer: it is off, or out of reach"),
    # The closing quote is env's.
    (r"python3\W?: ((command )?not found|No such)", "python3 is missing on the robot"),
    (r"rsync: (command )?not found", "rsync is missing on the robot"),
    (r"a password is required|sudo: ", "its user may not use sudo without a password"),
)  # fmt: skip


class FleetError(OSError):
    """Failure on one robot. The message is one line: the cause, then what to do."""


class UnreachableError(FleetError):
    """The robot cannot be reached, or the session has broken off."""


class RemoteError(FleetError):
    """The robot refused or failed the request."""


def ssh_command(config: FleetConfig, robot: RobotHost) -> list[str]:
    """OpenSSH's command line up to the robot's host."""
    return ["ssh", "-o", "BatchMode=yes", "-o", "LogLevel=ERROR", "-T",
            "-o", f"ConnectTimeout={config.ssh.connect_timeout_s:.0f}",
            "-o", "ServerAliveInterval=3", "-o", "ServerAliveCountMax=3",
            *ssh_options(config, robot), "-l", robot.user, robot.host]  # fmt: skip


def ssh_options(config: FleetConfig, robot: RobotHost) -> list[str]:
    """Options of ssh for the file and the port of fleet.toml."""
    file = ["-F", config.ssh.config] if config.ssh.config else []
    return [*file, *(["-p", str(robot.port)] if robot.port is not None else [])]


def as_root(command: str) -> str:
    """Command line for the login shell that runs `command` as root."""
    text = f'if [ "$(id -u)" = 0 ]; then exec {command}; else exec sudo -n {command}; fi'
    return f"exec sh -c {shlex.quote(text)}"


def explain(text: str, host: str) -> str:
    """Explain the error output of ssh or rsync in one line."""
    for pattern, advice in _ADVICE:
        if re.search(pattern, text):
            return advice.replace("HOST", host)
    # ssh prints nothing when a connection falls silent.
    return _last_line(text) or "it no longer answers: it is off, or out of reach"


def _last_line(text: str) -> str:
    return next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "")


class Done(NamedTuple):
    """Exit code, stdout and stderr of a program."""

    code: int
    out: str
    err: str

    @property
    def reason(self) -> str:
        """Last line of stderr, else the exit code."""
        return _last_line(self.err) or f"exit code {self.code}"


class Session:
    """Calls to the functions of `lpac.fleet.agent` on one robot. For one task at a time."""

    def __init__(
        self, robot: RobotHost, process: asyncio.subprocess.Process, on_progress: OnProgress
    ) -> None:
        assert process.stdin is not None and process.stdout is not None
        self.robot = robot
        self._process = process
        self._write, self._read = process.stdin, process.stdout
        self._on_progress = on_progress
        self._stderr = asyncio.create_task(self._read_stderr())
        self._keep_alive = asyncio.create_task(self._send_keep_alive())

    async def call(self, function: str, **arguments: object) -> dict[str, Any]:
        """Call a function of the agent and return its result.

        Raises RemoteError or UnreachableError.
        """
        request = {"call": function, "arguments": arguments}
        try:
            self._write.write(json.dumps(request).encode() + b"\n")
            async with asyncio.timeout(_CALL_S):
                await self._write.drain()
                while line := await self._read.readline():
                    match json.loads(line):
                        case {"progress": str(text)}:
                            self._on_progress(text)
                        case {"error": str(text)}:
                            raise RemoteError(text)
                        case {"result": dict(result)}:
                            return result
                        case _:
                            raise ValueError
        except TimeoutError:
            raise UnreachableError(f"it did not answer within {_CALL_S:g} s") from None
        except ConnectionError:
            pass  # ssh's stderr has the cause.
        except ValueError:
            raise RemoteError(
                f"its login shell prints {line[:60]!r}: make ~/.bashrc print nothing for ssh"
            ) from None
        raise UnreachableError(explain(await self._all_stderr(), self.robot.host))

    async def run(self, *command: str, timeout_s: float = 60.0) -> Done:
        """Run a program as root; any exit code is accepted. Raises as `call`."""
        return Done(**await self.call("run", command=command, timeout_s=timeout_s))

    async def check_output(self, *command: str, timeout_s: float = 60.0) -> str:
        """Output of a program run as root. Raises RemoteError if its exit code is not 0."""
        done = await self.run(*command, timeout_s=timeout_s)
        if done.code != 0:
            # A script is too long for a message.
            what = "" if command[0] == "sh" else f"{shlex.join(command)}: "
            raise RemoteError(what + done.reason)
        return done.out

    async def capture(self, commands: Mapping[str, str], *, each_s: float = 5.0) -> dict[str, str]:
        """Run shell commands in one call; return the stdout of each, by name.

        A command that runs longer than `each_s` is stopped; its output up to then is kept.
        """
        lines = [
            f"timeout {each_s:g} sh -c {shlex.quote(command)} 2>/dev/null; printf '\\036'"
            for command in commands.values()
        ]
        script = "\n".join(["export LC_ALL=C", *lines])
        shown = await self.run("sh", "-c", script, timeout_s=each_s * len(lines) + 5.0)
        return dict(zip(commands, map(str.strip, shown.out.split(_SEPARATOR)), strict=False))

    async def write(self, files: Mapping[str, bytes], mode: int = 0o644) -> None:
        """Write files, by path, each atomically. Raises as `call`."""
        contents = {path: b64encode(data).decode() for path, data in files.items()}
        await self.call("write", files=contents, mode=mode)

    async def close(self) -> None:
        """End the session, which releases its lock."""
        self._keep_alive.cancel()
        self._write.close()
        try:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(2.0):
                    await self._process.wait()
        finally:  # Also on a second Ctrl-C.
            if self._process.returncode is None:
                self._process.kill()
                await self._process.wait()
            # Python before 3.11.4 prints an unretrieved broken pipe.
            with contextlib.suppress(OSError):
                await asyncio.wait_for(self._write.wait_closed(), 2.0)
        await self._all_stderr()

    async def _send_keep_alive(self) -> None:
        with contextlib.suppress(ConnectionError):
            while True:
                await asyncio.sleep(_KEEP_ALIVE_S)
                self._write.write(b"\n")
                await self._write.drain()

    async def _all_stderr(self) -> str:
        # A helper process from ssh's configuration may keep the pipe open after ssh has ended.
        with contextlib.suppress(TimeoutError):
            return await asyncio.wait_for(self._stderr, 2.0)
        return ""

    async def _read_stderr(self) -> str:
        assert self._process.stderr is not None
        return (await self._process.stderr.read()).decode(errors="replace")


@contextlib.asynccontextmanager
async def connect(
    config: FleetConfig, robot: RobotHost, on_progress: OnProgress = lambda _: None
) -> AsyncIterator[Session]:
    """Open a session; `on_progress` gets the steps of each call. Raises UnreachableError."""
    modules = (raw_mavlink, agent)
    sources = [(m.__name__, Path(str(m.__file__)).read_text("utf-8")) for m in modules]
    payload = json.dumps(sources).encode()
    # Python 3.6 would read and write ASCII otherwise.
    python = f"env LC_ALL=C.UTF-8 python3 -u -c {shlex.quote(_BOOTSTRAP.format(size=len(payload)))}"
    process = await asyncio.create_subprocess_exec(
        *ssh_command(config, robot), as_root(python),
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE, limit=1 << 24,
        # So that Ctrl-C does not kill ssh: this program closes the sessions.
        process_group=0,
    )  # fmt: skip
    session = Session(robot, process, on_progress)
    try:
        assert process.stdin is not None
        process.stdin.write(payload)
        yield session
    finally:
        await session.close()


async def rsync(
    config: FleetConfig,
    robot: RobotHost,
    sources: Sequence[str],
    target: str,
    *,
    options: Sequence[str] = (),
    sudo: bool = False,
    on_share: Callable[[float], None] = lambda _: None,
) -> int:
    """Copy by rsync, comparing checksums; return how many bytes of content were transferred.

    `sources` and `target` are as for rsync; paths on the robot begin with ":". `on_share` gets the
    share done, 0 to 1. Raises FleetError.
    """
    shell = shlex.join(ssh_command(config, robot)[:-1])
    host = f"[{robot.host}]" if ":" in robot.host else robot.host
    paths = [host + path if path.startswith(":") else path for path in (*sources, target)]
    command = ["rsync", "-rlpt", "--checksum", "--timeout=10",
               "--no-inc-recursive", "--info=progress2,stats2",
               "--no-human-readable", "-e", shell, *options]  # fmt: skip
    if sudo:
        command += ["--rsync-path", "sudo -n rsync"]
    process = await asyncio.create_subprocess_exec(
        *command, "--", *paths,
        stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE, process_group=0,
    )  # fmt: skip
    assert process.stdout is not None and process.stderr is not None
    stderr = asyncio.create_task(process.stderr.read())
    text, percent = "", 0
    try:
        while data := await process.stdout.read(4096):
            text = (text + data.decode(errors="replace"))[-8192:]
            shares = re.findall(r"(\d+)%", text.rpartition("\r")[2])
            if shares and int(shares[-1]) > percent:
                percent = int(shares[-1])
                on_share(percent / 100.0)
        await process.wait()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    errors = (await stderr).decode(errors="replace")
    if process.returncode != 0:
        raise UnreachableError(explain(errors, robot.host))
    literal = re.search(r"Literal data: (\d+)", text)
    return int(literal[1]) if literal else 0
