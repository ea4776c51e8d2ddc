"""A conversation with one robot over OpenSSH, and what it says when there can be none.

OpenSSH's own configuration, agent, keys and known_hosts decide; nothing here switches the check of
host keys off, and nothing asks: a fleet answers at once or not at all.
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

Say = Callable[[str], None]

_PING_S = 3.0
# Of one call: the longest is the policy's verification on a slow CPU.
_CALL_S = 400.0
# Between the parts of what `look` has printed.
_BETWEEN = "\x1e"
# Reads the modules' sources, makes them modules, and serves. The login shell sees but this.
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
# What ssh and rsync say of a robot, and what that means for a person.
_ADVICE = (
    (r"REMOTE HOST IDENTIFICATION HAS CHANGED",
     "its host key is not the known one: another computer answers, or it was set up anew; "
     "only in that case run `ssh-keygen -R HOST`, and log in once with ssh"),
    # Where it may not ask, ssh says but this of a key that it has never seen.
    (r"No .* host key is known|Host key verification failed",
     "its host key is not known here: log in once with ssh to accept it"),
    (r"Permission denied", "it refuses the login: run `lpac fleet enroll`, or look at your key"),
    (r"Could not resolve", "its host name is not known"),
    (r"Connection refused", "nothing listens on its ssh port"),
    # rsync then says that the connection is closed, too.
    (r"No space left", "its disk is full"),
    (r"No route to host|timed out|Network is unreachable|not responding|Connection closed|"
     r"Connection reset|Broken pipe|connection unexpectedly closed|timeout in data send/receive",
     "it does not answer: it is off, or out of reach"),
    # env quotes the name.
    (r"python3\W?: ((command )?not found|No such)", "python3 is missing on the robot"),
    (r"rsync: (command )?not found", "rsync is missing on the robot"),
    (r"a password is required|sudo: ", "its user may not use sudo without a password"),
)  # fmt: skip


class FleetError(OSError):
    """Something with one robot cannot be done; one line says why, and what to do."""


class UnreachableError(FleetError):
    """There is no conversation with the robot, or it has broken off."""


class RemoteError(FleetError):
    """The robot refuses, or cannot do, what was asked."""


def ssh_command(config: FleetConfig, robot: RobotHost) -> list[str]:
    """OpenSSH's command line as far as the robot's host."""
    command = ["ssh", "-o", "BatchMode=yes", "-o", "LogLevel=ERROR", "-T",
               "-o", f"ConnectTimeout={config.ssh.connect_timeout_s:.0f}",
               "-o", "ServerAliveInterval=3", "-o", "ServerAliveCountMax=3"]  # fmt: skip
    if config.ssh.config:
        command += ["-F", config.ssh.config]
    if robot.port is not None:
        command += ["-p", str(robot.port)]
    return [*command, "-l", robot.user, robot.host]


def as_root(command: str) -> str:
    """Command line for the login shell that runs `command` as root, who owns releases and units."""
    text = f'if [ "$(id -u)" = 0 ]; then exec {command}; else exec sudo -n {command}; fi'
    return f"exec sh -c {shlex.quote(text)}"


def explain(text: str, host: str) -> str:
    """Explain ssh's or rsync's last words in one line."""
    for pattern, advice in _ADVICE:
        if re.search(pattern, text):
            return advice.replace("HOST", host)
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    # Of a connection that has gone silent ssh does not say more.
    return lines[-1] if lines else "it does not answer any more: it is off, or out of reach"


class Done(NamedTuple):
    """A program's exit code, and what it wrote."""

    code: int
    out: str
    err: str

    @property
    def reason(self) -> str:
        """The last line with which it complained, else its exit code."""
        lines = [line.strip() for line in self.err.splitlines() if line.strip()]
        return lines[-1] if lines else f"exit code {self.code}"


class Session:
    """Calls to the functions of `lpac.fleet.agent` on one robot. For one task at a time."""

    def __init__(self, robot: RobotHost, process: asyncio.subprocess.Process, say: Say) -> None:
        assert process.stdin is not None and process.stdout is not None
        self.robot = robot
        self._process = process
        self._write, self._read = process.stdin, process.stdout
        self._say = say
        # Kept while the session lives: what ssh complains about.
        self._complaints = asyncio.create_task(self._last_words())
        self._pings = asyncio.create_task(self._ping())

    async def call(self, function: str, **arguments: object) -> dict[str, Any]:
        """Its result. Raises RemoteError or UnreachableError."""
        request = {"call": function, "arguments": arguments}
        try:
            self._write.write(json.dumps(request).encode() + b"\n")
            async with asyncio.timeout(_CALL_S):
                await self._write.drain()
                while line := await self._read.readline():
                    match json.loads(line):
                        case {"progress": str(text)}:
                            self._say(text)
                        case {"error": str(text)}:
                            raise RemoteError(text)
                        case {"result": dict(result)}:
                            return result
                        case _:
                            raise ValueError
        except TimeoutError:
            raise UnreachableError(f"it has not answered within {_CALL_S:g} s") from None
        except ConnectionError:
            pass  # The complaints tell why.
        except ValueError:
            raise RemoteError(
                f"its login shell prints {line[:60]!r}: let ~/.bashrc be silent for ssh"
            ) from None
        raise UnreachableError(explain(await self._all_complaints(), self.robot.host))

    async def run(self, *command: str, timeout_s: float = 60.0) -> Done:
        """Run a program as root, whatever its exit code. Raises as `call`."""
        return Done(**await self.call("run", command=command, timeout_s=timeout_s))

    async def must(self, *command: str, timeout_s: float = 60.0) -> str:
        """Output of a program. Raises RemoteError unless it returns 0; else as `call`."""
        done = await self.run(*command, timeout_s=timeout_s)
        if done.code != 0:
            # A script is nothing to read in one line.
            what = "" if command[0] == "sh" else f"{shlex.join(command)}: "
            raise RemoteError(what + done.reason)
        return done.out

    async def look(self, commands: Mapping[str, str], *, each_s: float = 5.0) -> dict[str, str]:
        """Output of shell commands, by name, without complaints; in one call.

        One that does not end in `each_s` has printed what it had by then.
        """
        lines = [
            f"timeout {each_s:g} sh -c {shlex.quote(command)} 2>/dev/null; printf '\\036'"
            for command in commands.values()
        ]
        script = "\n".join(["export LC_ALL=C", *lines])
        shown = await self.run("sh", "-c", script, timeout_s=each_s * len(lines) + 5.0)
        return dict(zip(commands, map(str.strip, shown.out.split(_BETWEEN)), strict=False))

    async def write(self, files: Mapping[str, bytes], mode: int = 0o644) -> None:
        """Write files, each whole or not at all; by path. Raises as `call`."""
        contents = {path: b64encode(data).decode() for path, data in files.items()}
        await self.call("write", files=contents, mode=mode)

    async def close(self) -> None:
        """End the conversation; locks that it held are free then."""
        self._pings.cancel()
        self._write.close()
        try:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(2.0):
                    await self._process.wait()
        finally:  # also if Ctrl-C comes again
            if self._process.returncode is None:
                self._process.kill()
                await self._process.wait()
            # Before Python 3.11.4 a broken pipe that nobody has asked about is printed.
            with contextlib.suppress(OSError):
                await asyncio.wait_for(self._write.wait_closed(), 2.0)
        await self._all_complaints()

    async def _ping(self) -> None:
        """A robot that hears nothing for long takes the laptop for gone."""
        with contextlib.suppress(ConnectionError):
            while True:
                await asyncio.sleep(_PING_S)
                self._write.write(b"\n")
                await self._write.drain()

    async def _all_complaints(self) -> str:
        # A helper that ssh's configuration starts may hold the pipe open after ssh has ended.
        with contextlib.suppress(TimeoutError):
            return await asyncio.wait_for(self._complaints, 2.0)
        return ""

    async def _last_words(self) -> str:
        assert self._process.stderr is not None
        return (await self._process.stderr.read()).decode(errors="replace")


@contextlib.asynccontextmanager
async def connect(
    config: FleetConfig, robot: RobotHost, say: Say = lambda _: None
) -> AsyncIterator[Session]:
    """A session; `say` hears how far calls are. Raises UnreachableError."""
    modules = (raw_mavlink, agent)
    sources = [(m.__name__, Path(str(m.__file__)).read_text("utf-8")) for m in modules]
    payload = json.dumps(sources).encode()
    # Python 3.6 would take the robot's texts for ASCII.
    python = f"env LC_ALL=C.UTF-8 python3 -u -c {shlex.quote(_BOOTSTRAP.format(size=len(payload)))}"
    process = await asyncio.create_subprocess_exec(
        *ssh_command(config, robot), as_root(python),
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE, limit=1 << 24,
        # Ctrl-C is for the laptop's program, which ends the sessions in order.
        process_group=0,
    )  # fmt: skip
    session = Session(robot, process, say)
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
    """Copy by rsync, contents compared by checksum; how many bytes of content travelled.

    `sources` and `target` are rsync's; the robot's side begins with ":". `on_share` hears the share
    that is done. Raises FleetError.
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
    complaints = asyncio.create_task(process.stderr.read())
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
    words = (await complaints).decode(errors="replace")
    if process.returncode != 0:
        raise UnreachableError(explain(words, robot.host))
    literal = re.search(r"Literal data: (\d+)", text)
    return int(literal[1]) if literal else 0
