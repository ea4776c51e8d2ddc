"""Robot computers that all tests of the fleet share."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from lpac.sim.hosts.base import NoHostsError
from lpac.sim.hosts.hosts import SimulatedHosts
from tests.conftest import SHIPPED
from tests.host.fleet.field import lpac_fleet, name_robot


@pytest.fixture(scope="package")
def hosts(amd64_image: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimulatedHosts]:
    """r1, r2 and r3 with a slot each, r4 without; as the test before left them."""
    with ExitStack() as stack:
        try:
            running = stack.enter_context(
                SimulatedHosts(
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


@pytest.fixture(scope="package")
def deployed(hosts: SimulatedHosts) -> SimulatedHosts:
    """With new disks r1 and r3, which fly, and r4, a spare; they have the release. Not r2."""
    for host in (hosts[0], *hosts[2:]):
        host.reset()
        name_robot(hosts, host)
    done = lpac_fleet(hosts.fleet_toml, "deploy", "--robots", "r1,r3,r4")
    assert done.returncode == 0, done.stderr
    return hosts
