"""Making a computer a robot of the fleet: each step is done, or was so already.

The first step logs in as a person does, since only that person can: OpenSSH itself asks for the
password, and whether the host key is the right one.
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
    RemoteError,
    UnreachableError,
    connect,
    explain,
    ssh_command,
)
from lpac.fleet.settings import FleetConfig, RobotHost, is_of_computer, load_fleet
from lpac.fleet.setup import (
    EnrolStep,
    retire,
    set_identity,
    set_up_px4,
    set_vision_hub,
)
from lpac.fleet.writer import add_robot

# As ssh-copy-id does it; the key comes on standard input.
_INSTALL_KEYS = """exec sh -c '
cd && umask 077 && mkdir -p .ssh && touch .ssh/authorized_keys || exit 1
file=.ssh/authorized_keys
[ -z "$(tail -c 1 $file)" ] || echo >> $file
while read -r key; do grep -qxF "$key" $file || echo "$key" >> $file; done
'"""
_LOGIN_S = 30.0


_VOXL2_URL = "udpin://127.0.0.1:14551"

OnStep = Callable[[EnrolStep], None]
Say = Callable[[str], None]


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
    say: Say,
) -> None:
    """Enroll the computer at `host` in the fleet of the file; a robot that is new is a spare.

    Of a robot that the file has, all about it follows from the file. A new robot without a `user`
    is root's, without an `address` has the one that its host name has here, and without a
    `robot_id` has the number in its name.

    `on_step` hears of every step, `say` what is being done. `rename` lets a robot that is enrolled
    as another one become this one. The first robot makes the fleet's authority, with `operator` as
    this computer's name. Raises ConfigError, AuthorityError or FleetError at the first step that
    fails.
    """
    config = load_fleet(path)
    robot = _robot(config, name, host, user, port, address, robot_id)
    on_step(_key(config, robot))
    async with connect(config, robot, say) as session:
        found = (await overview(session, config))["identity"]
        await lock(session, config, robot)
        former = other_identity(found, config, robot)
        if former is not None and not rename:
            raise RemoteError(f"it is enrolled as {former}: if it is to be {name}, add --yes")
        was_there = name in config.robots
        if not was_there:
            add_robot(
                path, name, robot.host, robot.robot_id, user=robot.user, port=port,
                address=robot.address if robot.address != robot.host else None,
            )  # fmt: skip
            config = load_fleet(path)
            robot = config.robots[name]
        on_step(EnrolStep.of(path.name, not was_there))
        on_step(await set_identity(session, config, robot, found))
        on_step(_member_step(config, await join(session, config, robot, operator)))
        on_step(await set_vision_hub(session, robot))
        on_step(await retire(session, robot, config.predecessors, say))
    step = await _release(config, robot, say)
    on_step(step)
    if step.outcome == "left to do":
        on_step(
            EnrolStep("PX4", "left to do", ("the release sets it up: enroll again after that",))
        )
        return
    async with connect(config, robot, say) as session:
        await lock(session, config, robot)
        try:
            on_step(await set_up_px4(session, config, robot, say))
        except RemoteError as error:
            on_step(EnrolStep("PX4", "left to do", (f"{error}; then enroll again",)))


def _robot(
    config: FleetConfig,
    name: str,
    host: str | None,
    user: str | None,
    port: int | None,
    address: str | None,
    robot_id: int | None,
) -> RobotHost:
    """The robot of the file, or one that it does not have yet."""
    known = config.robots.get(name)
    if known is not None:
        given = {"host": host, "user": user, "port": port, "address": address, "robot_id": robot_id}
        for key, value in given.items():
            has = getattr(known, key)
            if value not in (None, has):
                stands = f"{key} = {has!r}" if has is not None else f"no {key}"
                raise ConfigError(
                    f"{config.path}: robots.{name}: has {stands}: change it there, or leave "
                    f"{value!r} out"
                )
        return known
    if host is None:
        raise ConfigError(f"{config.path}: robots.{name}: is not there: give its address")
    # Before anything is sent there.
    require_host("HOST", host)
    if not (address is None or is_of_computer(address)):
        raise ConfigError(f"--address {address!r}: must be a computer's own IPv4 address")
    if robot_id is None:
        number = re.search(r"\d+", name)
        if number is None:
            raise ConfigError(f"{config.path}: robots.{name}: no number in it: give --robot-id")
        robot_id = int(number[0])
    # A file without it is refused when the robot is added.
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
            f"{named}: has no IPv4 address here: give the one that the other robots know with "
            "--address"
        ) from None


# The key


def _key(config: FleetConfig, robot: RobotHost) -> EnrolStep:
    """Let this operator's keys in, with a person's login if need be."""
    problem = _login_problem(config, robot)
    if problem is None:
        return EnrolStep("key", "was so already")
    keys = _public_keys(config, robot)
    if not keys:
        raise FleetError("there is no key of yours to install: make one with ssh-keygen")
    command = [
        "BatchMode=no" if part == "BatchMode=yes" else part for part in ssh_command(config, robot)
    ]
    done = subprocess.run([*command, _INSTALL_KEYS], input=keys.encode(), check=False)
    if done.returncode != 0:
        raise UnreachableError(f"{robot.host} did not let you in: see above")
    problem = _login_problem(config, robot)
    if problem is not None:
        raise UnreachableError(
            f"your key is installed, and still: {problem}; a key with a passphrase needs ssh-add"
        )
    return EnrolStep("key", "done")


def _login_problem(config: FleetConfig, robot: RobotHost) -> str | None:
    """Why a login without a question is not possible where a person's may be; None if it is.

    Raises UnreachableError where a person's is not either.
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
    a_person_may = "Permission denied" in done.stderr or (
        "Host key verification failed" in done.stderr
        and "IDENTIFICATION HAS CHANGED" not in done.stderr
    )
    if not a_person_may:
        raise UnreachableError(f"{robot.host}: {problem}")
    return problem


def _public_keys(config: FleetConfig, robot: RobotHost) -> str:
    """Content of authorized_keys: the agent's keys, and those that ssh would use here."""
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
    """Read OpenSSH's configuration of this host."""
    *command, host = ssh_command(config, robot)
    done = subprocess.run([*command, "-G", host], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise FleetError(explain(done.stderr, robot.host))
    options: dict[str, list[str]] = {}
    for line in done.stdout.splitlines():
        key, _, value = line.partition(" ")
        options.setdefault(key, []).append(value)
    return options


# The other steps


async def _release(config: FleetConfig, robot: RobotHost, say: Say) -> EnrolStep:
    """A release without a slot's configuration, unless there is any: nothing is started by it."""
    async with connect(config, robot, say) as session:
        if (await overview(session, config))["current"] is not None:
            return EnrolStep("release", "was so already")
    try:
        common = load_common(config)
    except (ValueError, OSError) as error:
        return EnrolStep("release", "left to do", (str(error),))
    config = replace(config, slots=())
    with tempfile.TemporaryDirectory(prefix="lpac-enroll-") as folder:
        release = make_release(config, robot, common, Path(folder))

        def report(step: str, share: float | None) -> None:
            say(step if share is None else f"{step} {100.0 * share:.0f} %")

        await deploy(config, robot, release, report)
    return EnrolStep("release", "done", ("as a spare's: nothing was started",))


def _member_step(config: FleetConfig, joined: Joined) -> EnrolStep:
    if joined.outcome is None:
        why = "insecure = true: whoever is on the network can fly it" if config.insecure else ""
        return EnrolStep("member", "skipped", (why,) if why else ())
    notes: tuple[str, ...] = ()
    if joined.new_authority is not None:
        notes = (
            f"made the fleet's keys: {joined.new_authority}",
            "keep a copy of that folder where nobody else can read it: whoever has it can fly the "
            "fleet, and without it no robot joins",
        )
    return EnrolStep("member", joined.outcome, notes)
