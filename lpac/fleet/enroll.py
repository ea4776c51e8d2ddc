"""Making a computer a robot of the fleet: each step is done, or was so already.

The first step logs in as a person does, since only that person can: OpenSSH itself asks for the
password, and whether the host key is the right one.
"""

import re
import socket
import subprocess
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from edge.core.address import require_host
from edge.core.schema import ConfigError
from lpac.fleet.cards import CardGiven, give_card
from lpac.fleet.deploy import deploy
from lpac.fleet.hold import lock
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
from lpac.fleet.writer import add_robot

# As ssh-copy-id does it; the key comes on standard input.
_INSTALL_KEYS = """exec sh -c '
cd && umask 077 && mkdir -p .ssh && touch .ssh/authorized_keys || exit 1
file=.ssh/authorized_keys
[ -z "$(tail -c 1 $file)" ] || echo >> $file
while read -r key; do grep -qxF "$key" $file || echo "$key" >> $file; done
'"""
_LOGIN_S = 30.0


class EnrolStep(NamedTuple):
    """One step of enrolling: what came of it, and what there is to say about it."""

    name: str
    outcome: Literal["done", "was so already", "skipped", "left to do"]
    notes: tuple[str, ...] = ()


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
        found = (await session.call("overview", directory=config.directory))["identity"]
        await lock(session, config, robot)
        wanted = {"fleet": config.fleet, "robot": name, "robot_id": robot.robot_id}
        if found not in (None, wanted) and not rename:
            # The same word as the robot's, but before the file is changed.
            await session.call("set_identity", **wanted, rename=False)
        was_there = name in config.robots
        if not was_there:
            add_robot(
                path, name, robot.host, robot.robot_id, user=robot.user, port=port,
                address=robot.address if robot.address != robot.host else None,
            )  # fmt: skip
            config = load_fleet(path)
            robot = config.robots[name]
        on_step(EnrolStep(path.name, *_done(not was_there)))
        identity = await session.call("set_identity", **wanted, rename=rename)
        was = (f"it was {identity['former']}",) if identity["former"] else ()
        on_step(EnrolStep("robot id", *_done(identity["changed"], was)))
        on_step(_card_step(config, await give_card(session, config, robot, operator)))
        on_step(_vision_hub_step(
            await session.call("set_vision_hub", mavlink_port=robot.mavlink_port)
        ))  # fmt: skip
        on_step(_predecessors_step(
            await session.call(
                "retire", predecessors=list(config.predecessors), mavlink_port=robot.mavlink_port
            )
        ))  # fmt: skip
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
            report = await session.call(
                "set_up_px4", directory=config.directory, url=robot.mavlink_url,
                mavlink_port=robot.mavlink_port, system_id=robot.system_id,
                rc=_value(config, robot, "failsafe", "rc"),
                ceiling_m=_value(config, robot, "fence", "ceiling_m"),
                command_timeout_s=_value(config, robot, "flight", "command_timeout_s", 0.5),
            )  # fmt: skip
        except RemoteError as error:
            on_step(EnrolStep("PX4", "left to do", (f"{error}; then enroll again",)))
            return
        on_step(_px4_step(report))


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
        if (await session.call("overview", directory=config.directory))["current"] is not None:
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


def _card_step(config: FleetConfig, given: CardGiven) -> EnrolStep:
    if given.outcome is None:
        why = "insecure = true: whoever is on the network can fly it" if config.insecure else ""
        return EnrolStep("card", "skipped", (why,) if why else ())
    notes: tuple[str, ...] = ()
    if given.new_authority is not None:
        notes = (
            f"made the fleet's keys: {given.new_authority}",
            "keep a copy of that folder where nobody else can read it: whoever has it can fly the "
            "fleet, and without it no robot joins",
        )
    return EnrolStep("card", given.outcome, notes)


def _vision_hub_step(result: Mapping[str, Any]) -> EnrolStep:
    if not result["there"]:
        note = "not a VOXL2: see that PX4's MAVLink comes to this computer"
        return EnrolStep("vision-hub", "skipped", (note,))
    notes = tuple(result["changed"])
    if notes and not result["restarted"]:
        notes = (*notes, "voxl-vision-hub does not run: see `systemctl status voxl-vision-hub`")
    return EnrolStep("vision-hub", *_done(bool(result["changed"]), notes))


def _predecessors_step(result: Mapping[str, Any]) -> EnrolStep:
    notes = (*(f"stopped {what}" for what in result["stopped"]), *result["suspects"])
    if not result["saw_containers"]:
        note = (
            "docker does not answer, so its containers may command the vehicle: look at "
            "`systemctl status docker` on the robot, then enroll again"
        )
        return EnrolStep("predecessors", "left to do", (*notes, note))
    return EnrolStep("predecessors", *_done(bool(result["stopped"]), notes))


def _px4_step(report: Mapping[str, Any]) -> EnrolStep:
    notes = tuple(report["changes"])
    if report["restarted"]:
        notes = (*notes, f"PX4 was restarted, and answers as system {report['system_id']}")
    if report["needs_reboot"]:
        notes = (*notes, "some of it counts after a restart only: switch the vehicle off and on")
    notes = (*notes, *report["problems"])
    if report["problems"] or report["needs_reboot"]:
        return EnrolStep("PX4", "left to do", notes)
    return EnrolStep("PX4", *_done(bool(report["changes"]) or report["restarted"], notes))


def _done(
    changed: bool, notes: tuple[str, ...] = ()
) -> tuple[Literal["done", "was so already"], tuple[str, ...]]:
    return "done" if changed else "was so already", notes


def _value(
    config: FleetConfig, robot: RobotHost, table: str, key: str, default: object = None
) -> object:
    """Value that robot.toml would have there."""
    value = config.values_of(robot).get(table, {}).get(key, default)
    if value is None:
        raise ConfigError(f"{config.path}: robot.{table}.{key} is missing")
    return value
