"""Enroll a computer as a robot of the fleet, in steps that may be repeated.

The first step lets OpenSSH itself ask for the password and about the host key.
"""

import re
import socket
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from edge.core.address import require_host
from edge.core.schema import ConfigError
from lpac.fleet.deploy import deploy
from lpac.fleet.hold import lock, other_identity, overview
from lpac.fleet.members import Joined, join
from lpac.fleet.release import load_common, make_release
from lpac.fleet.session import (
    FleetError,
    OnProgress,
    RemoteError,
    UnreachableError,
    connect,
    explain,
    ssh_command,
)
from lpac.fleet.settings import FleetConfig, RobotHost, is_host_address, load_fleet
from lpac.fleet.setup import (
    EnrollStep,
    set_identity,
    set_up_px4,
    set_vision_hub,
    stop_predecessors,
)
from lpac.fleet.writer import add_robot

# As ssh-copy-id does; the keys come on stdin.
_INSTALL_KEYS = """exec sh -c '
cd && umask 077 && mkdir -p .ssh && touch .ssh/authorized_keys || exit 1
file=.ssh/authorized_keys
[ -z "$(tail -c 1 $file)" ] || echo >> $file
while read -r key; do grep -qxF "$key" $file || echo "$key" >> $file; done
'"""
_LOGIN_S = 30.0
_VOXL2_URL = "udpin://127.0.0.1:14551"

OnStep = Callable[[EnrollStep], None]


async def enroll(
    path: Path,
    name: str,
    host: str | None,
    *,
    user: str | None,
    port: int | None,
    address: str | None,
    robot_id: int | None,
    rename: bool,
    operator: Callable[[], str],
    on_step: OnStep,
    on_progress: OnProgress,
) -> None:
    """Enroll the computer at `host` in the fleet of the file; a new robot becomes a spare.

    For a robot that is in the file, everything follows from the file. For a new one, `user`
    defaults to root, `address` to what its host name resolves to here, and `robot_id` to the number
    in its name.

    `on_step` gets the result of every step, `on_progress` what is being done. `rename` allows a
    robot that is enrolled under another name. The first robot creates the fleet's authority, with
    `operator()` as this computer's name. Raises ConfigError, AuthorityError or FleetError at the
    first step that fails.
    """
    config = load_fleet(path)
    robot = _robot(config, name, host, user, port, address, robot_id)
    on_step(_key(config, robot))
    async with connect(config, robot, on_progress) as session:
        found = (await overview(session, config))["identity"]
        await lock(session, config, robot)
        former = other_identity(found, config, robot)
        if former is not None and not rename:
            raise RemoteError(f"it is enrolled as {former}: to make it {name}, add --yes")
        is_new = name not in config.robots
        if is_new:
            add_robot(
                path, name, robot.host, robot.robot_id, user=robot.user, port=port,
                address=robot.address if robot.address != robot.host else None,
            )  # fmt: skip
            config = load_fleet(path)
            robot = config.robots[name]
        on_step(EnrollStep.of(path.name, is_new))
        on_step(await set_identity(session, config, robot, found))
        on_step(_member_step(config, await join(session, config, robot, operator)))
        on_step(await set_vision_hub(session, robot))
        on_step(await stop_predecessors(session, robot, config.predecessors, on_progress))
    step = await _release(config, robot, on_progress)
    on_step(step)
    if step.outcome == "left to do":
        on_step(
            EnrollStep("PX4", "left to do", ("needs the release: enroll again after deploying",))
        )
        return
    async with connect(config, robot, on_progress) as session:
        await lock(session, config, robot)
        try:
            on_step(await set_up_px4(session, config, robot, on_progress))
        except RemoteError as error:
            on_step(EnrollStep("PX4", "left to do", (f"{error}; then enroll again",)))


def _robot(
    config: FleetConfig,
    name: str,
    host: str | None,
    user: str | None,
    port: int | None,
    address: str | None,
    robot_id: int | None,
) -> RobotHost:
    """The file's robot of that name, or a new one. Raises ConfigError or UnreachableError."""
    known = config.robots.get(name)
    if known is not None:
        given = {"host": host, "user": user, "port": port, "address": address, "robot_id": robot_id}
        for key, value in given.items():
            has = getattr(known, key)
            if value not in (None, has):
                present = f"{key} = {has!r}" if has is not None else f"no {key}"
                raise ConfigError(
                    f"{config.path}: robots.{name}: has {present}: change it there, or leave "
                    f"{value!r} out"
                )
        return known
    if host is None:
        raise ConfigError(f"{config.path}: robots.{name}: does not exist yet: give its address")
    # Before it gets on a command line.
    require_host("HOST", host)
    if not (address is None or is_host_address(address)):
        raise ConfigError(f"--address {address!r}: must be a computer's own IPv4 address")
    if robot_id is None:
        number = re.search(r"\d+", name)
        if number is None:
            raise ConfigError(f"{config.path}: robots.{name}: has no number: give --robot-id")
        robot_id = int(number[0])
    # The file is checked when the robot is added.
    url = config.shared.get("autopilot", {}).get("url", _VOXL2_URL)
    robot = RobotHost(
        name=name, host=host, user=user or "root", port=port, address=address or host,
        robot_id=robot_id, zenoh_port=0, system_id=robot_id, mavlink_url=url, cpus=(), overrides={},
    )  # fmt: skip
    if address is not None:
        return robot
    (named,) = _ssh_options(config, robot)["hostname"]
    try:
        return replace(robot, address=socket.gethostbyname(named))
    except OSError:
        raise UnreachableError(
            f"{named}: has no IPv4 address here: give the one that the other robots reach with "
            "--address"
        ) from None


def _key(config: FleetConfig, robot: RobotHost) -> EnrollStep:
    """Install this operator's ssh keys, asking for the password if need be."""
    problem = _login_problem(config, robot)
    if problem is None:
        return EnrollStep("key", "was so already")
    keys = _public_keys(config, robot)
    if not keys:
        raise FleetError("you have no ssh key to install: make one with ssh-keygen")
    command = [
        "BatchMode=no" if part == "BatchMode=yes" else part for part in ssh_command(config, robot)
    ]
    done = subprocess.run([*command, _INSTALL_KEYS], input=keys.encode(), check=False)
    if done.returncode != 0:
        raise UnreachableError(f"{robot.host} did not let you in: see above")
    problem = _login_problem(config, robot)
    if problem is not None:
        raise UnreachableError(
            f"your key is installed, but {problem}; a key with a passphrase needs ssh-add"
        )
    return EnrollStep("key", "done")


def _login_problem(config: FleetConfig, robot: RobotHost) -> str | None:
    """Why a login without prompts fails; None if it succeeds.

    Raises UnreachableError if an interactive login would fail too.
    """
    try:
        done = subprocess.run(
            [*ssh_command(config, robot), "true"], stdin=subprocess.DEVNULL, capture_output=True,
            text=True, timeout=_LOGIN_S + config.ssh.connect_timeout_s, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise UnreachableError(f"{robot.host}: it does not answer") from None
    if done.returncode == 0:
        return None
    problem = explain(done.stderr, robot.host)
    may_prompt = "Permission denied" in done.stderr or (
        "Host key verification failed" in done.stderr
        and "IDENTIFICATION HAS CHANGED" not in done.stderr
    )
    if not may_prompt:
        raise UnreachableError(f"{robot.host}: {problem}")
    return problem


def _public_keys(config: FleetConfig, robot: RobotHost) -> str:
    """Lines for authorized_keys: the agent's keys, and those that ssh would use for this host."""
    lines = []
    options = _ssh_options(config, robot)
    if options.get("identitiesonly") != ["yes"]:
        agent = subprocess.run(["ssh-add", "-L"], capture_output=True, text=True, check=False)
        if agent.returncode == 0:
            lines += agent.stdout.splitlines()
    for file in options.get("identityfile", []):
        public = Path(file + ".pub").expanduser()
        if public.exists():
            lines += public.read_text().splitlines()
    return "".join(f"{line}\n" for line in dict.fromkeys(lines) if line.strip())


def _ssh_options(config: FleetConfig, robot: RobotHost) -> dict[str, list[str]]:
    *command, host = ssh_command(config, robot)
    done = subprocess.run([*command, "-G", host], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise FleetError(explain(done.stderr, robot.host))
    options: dict[str, list[str]] = {}
    for line in done.stdout.splitlines():
        key, _, value = line.partition(" ")
        options.setdefault(key, []).append(value)
    return options


async def _release(config: FleetConfig, robot: RobotHost, on_progress: OnProgress) -> EnrollStep:
    """Deploy a spare's release, which starts nothing, unless the robot has a release."""
    async with connect(config, robot, on_progress) as session:
        if (await overview(session, config))["current"] is not None:
            return EnrollStep("release", "was so already")
    try:
        common = load_common(config)
    except (ValueError, OSError) as error:
        return EnrollStep("release", "left to do", (str(error),))
    config = replace(config, slots=())
    with tempfile.TemporaryDirectory(prefix="lpac-enroll-") as folder:
        release = make_release(config, robot, common, Path(folder))

        def report(step: str, share: float | None) -> None:
            on_progress(step if share is None else f"{step} {100.0 * share:.0f} %")

        await deploy(config, robot, release, report)
    return EnrollStep("release", "done", ("as a spare: nothing was started",))


def _member_step(config: FleetConfig, joined: Joined) -> EnrollStep:
    if joined.outcome is None:
        why = "insecure = true: anyone on the network can fly it" if config.insecure else ""
        return EnrollStep("member", "skipped", (why,) if why else ())
    notes: tuple[str, ...] = ()
    if joined.new_authority is not None:
        notes = (
            f"made the fleet's keys: {joined.new_authority}",
            "keep a copy of that folder where nobody else can read it: anyone who has it can fly "
            "the fleet, and without it no robot can join",
        )
    return EnrollStep("member", joined.outcome, notes)
