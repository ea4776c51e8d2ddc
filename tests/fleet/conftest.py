"""Robot computers that all tests of the fleet share."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from sim.host_base import NoHostsError
from sim.hosts import RobotHosts
from tests.conftest import SHIPPED


@pytest.fixture(scope="package")
def hosts(amd64_image: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RobotHosts]:
    """r1, r2 and r3 with a slot each, r4 without; as the test before left them."""
    with ExitStack() as stack:
        try:
            running = stack.enter_context(
                RobotHosts(
                    4,
                    tmp_path_factory.mktemp("hosts"),
                    image=amd64_image,
                    bundle=SHIPPED,
                    spares=1,
                )
            )
        except NoHostsError as reason:
            pytest.skip(str(reason))
        yield running


@pytest.fixture
def fresh_hosts(hosts: RobotHosts) -> RobotHosts:
    """The same with new disks, just booted: half a second each."""
    for host in hosts:
        host.reset()
    return hosts
