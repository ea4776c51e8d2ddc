"""The laptop's side of tests that deploy."""

import asyncio
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, TypeVar

from lpac.fleet.deploy import Deployed, deploy, rollback
from lpac.fleet.hold import Report, overview
from lpac.fleet.release import Common, Release, load_common, make_release
from lpac.fleet.session import Session, connect
from lpac.fleet.settings import FleetConfig, RobotHost, load_fleet
from tests.host.fleet.field import unwatched
from tests.host.hosts import FrailHosts

T = TypeVar("T")


class Laptop:
    """An operator's files: fleet.toml as it is now, and the releases made from it."""

    def __init__(self, hosts: FrailHosts, folder: Path) -> None:
        self.hosts = hosts
        self.config: FleetConfig = load_fleet(hosts.fleet_toml)
        self.common: Common = load_common(self.config)
        self._folder = folder

    def robot(self, index: int) -> RobotHost:
        return self.config.robots[self.hosts[index].name]

    def release(self, index: int, common: Common | None = None) -> Release:
        folder = self._folder / f"release-{len(list(self._folder.iterdir()))}"
        folder.mkdir()
        return make_release(self.config, self.robot(index), common or self.common, folder)

    def deploy(
        self, index: int, release: Release | None = None, report: Report = unwatched
    ) -> Deployed:
        release = release or self.release(index)
        return asyncio.run(deploy(self.config, self.robot(index), release, report))

    def ask(self, index: int, question: Callable[[Session, RobotHost], Awaitable[T]]) -> T:
        """Answer to a question in a session."""

        async def one() -> T:
            robot = self.robot(index)
            async with connect(self.config, robot) as session:
                return await question(session, robot)

        return asyncio.run(one())

    def overview(self, index: int) -> dict[str, Any]:
        """Overview of the robot; a busy machine may hold up for a moment what its program says."""
        until_s = time.monotonic() + 60.0
        while True:
            found = self.ask(index, lambda session, _: overview(session, self.config))
            service = found["service"]
            if service["fresh"] or service["active"] != "active" or time.monotonic() > until_s:
                return found

    def changed(self) -> Common:
        """The same with another world file: a release that differs in one file, and versions."""
        world = self.common.world + b"CircularBND 100 100 20 %.9f\n" % time.monotonic()
        return self.common._replace(world=world)

    def roll_back(self, index: int) -> str:
        return asyncio.run(rollback(self.config, self.robot(index), unwatched))


def boot_nonce(overview: dict[str, Any]) -> int:
    assert overview["service"]["fresh"], overview
    nonce: int = overview["service"]["status"]["boot_nonce"]
    return nonce
