"""What the tests of the fleet share: the `lpac fleet` command, and what is done to robots."""

import asyncio
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from lpac.fleet.hold import hold
from lpac.fleet.members import join
from lpac.fleet.release import Image, load_image
from lpac.fleet.settings import FleetConfig, RobotHost, load_fleet
from lpac.sim.fleet.keys import OPERATOR
from lpac.sim.hosts.base import NoHostsError
from tests.conftest import ROOT, SHIPPED
from tests.host.hosts import FrailHost, FrailHosts

SILENT = "it does not answer: it is off, or out of reach"


def _typed(fleet: Path, command: str, options: tuple[object, ...]) -> list[str]:
    words = (command, "--fleet", fleet, *options)
    return [sys.executable, "-m", "lpac.cli.main", "fleet", *map(str, words)]


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200"}


def lpac_fleet(
    fleet: Path, command: str, *options: object, environment: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """`lpac fleet COMMAND --fleet FLEET ...` until it ends, where nobody can be asked."""
    return subprocess.run(
        _typed(fleet, command, options), env={**_environment(), **(environment or {})},
        stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=300.0, check=False,
        start_new_session=True,
    )  # fmt: skip


@contextmanager
def running_lpac_fleet(
    fleet: Path, command: str, *options: object
) -> Iterator[subprocess.Popen[str]]:
    """The same while it runs; it is killed at the end."""
    with subprocess.Popen(
        _typed(fleet, command, options), env=_environment(),
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def booted(image: Path, folder: Path, count: int) -> Iterator[FrailHosts]:
    """Robot computers, the last one without a slot. Skips where this machine can have none."""
    with ExitStack() as stack:
        try:
            hosts = stack.enter_context(
                FrailHosts(count, folder, image=image, bundle=SHIPPED, spares=1)
            )
        except NoHostsError as reason:
            pytest.skip(str(reason))
        yield hosts


def unwatched(_: str, __: float | None) -> None:
    """A report that nobody reads."""


def name_robot(hosts: FrailHosts, host: FrailHost) -> None:
    """Give the host its identity and its key, as `enroll` does."""
    identity = {"fleet": hosts.fleet, "robot": host.name, "robot_id": host.robot_id}
    host.run(f"mkdir -p /etc/lpac; echo '{json.dumps(identity)}' > /etc/lpac/robot.json")
    config = load_fleet(hosts.fleet_toml)
    asyncio.run(_join(config, config.robots[host.name]))


def give_image(host: FrailHost, image: Image, image_id: str | None = None) -> None:
    """Let it have the files of the image, of 170 MB, from an earlier release: none travels.

    With an `image_id` of another image: only the files are the same.
    """
    earlier = host.root / "opt/lpac/releases/1"
    if not earlier.parent.exists():
        shutil.copytree(image.folder, earlier / "root", symlinks=True)
        (earlier / "versions.json").write_text(json.dumps({"image": image_id or image.id}))
        (earlier / "manifest.json").write_text("{}")


def deploy_to(
    hosts: FrailHosts, *names: str, image_id: str | None = None
) -> dict[str, dict[str, Any]]:
    """Give the robots their identity, if they are new, and the release; what `deploy` says of each.

    Only the policy and the configuration travel. See `give_image` for `image_id`.
    """
    image = load_image(load_fleet(hosts.fleet_toml).image)
    for host in hosts:
        if host.name in names and not (host.root / "opt/lpac").exists():
            name_robot(hosts, host)
            give_image(host, image, image_id)
    done = lpac_fleet(hosts.fleet_toml, "deploy", "--json", "--robots", ",".join(names))
    assert done.returncode == 0, done.stderr
    robots: dict[str, dict[str, Any]] = json.loads(done.stdout)["robots"]
    assert all(robot["sent_bytes"] < 5_000_000 for robot in robots.values()), robots
    return robots


async def _join(config: FleetConfig, robot: RobotHost) -> None:
    async with hold(config, robot) as held:
        await join(held.session, config, robot, lambda: OPERATOR)


@contextmanager
def armed(host: FrailHost) -> Iterator[None]:
    """Its vehicle is armed meanwhile, and does not disarm by itself."""
    with host.stepped:
        host.vehicle.parameters["COM_DISARM_PRFLT"] = 0.0
        host.vehicle.arm(force=True)
    try:
        yield
    finally:
        with host.stepped:
            host.vehicle.disarm(force=True)


def await_said(host: FrailHost, text: str) -> None:
    """Until the robot's program says so of itself."""
    host.run(
        f"until systemctl show -p StatusText lpac-robot | grep -q '{text}'; do sleep 0.1; done"
    )
