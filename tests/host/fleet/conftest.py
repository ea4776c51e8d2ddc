"""Robot computers that all tests of the fleet share."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.host.fleet.field import booted
from tests.host.hosts import FrailHosts


@pytest.fixture(scope="package")
def hosts(amd64_image: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[FrailHosts]:
    """r1, r2 and r3 with a slot each, r4 without; as the test before left them."""
    with booted(amd64_image, tmp_path_factory.mktemp("hosts"), 4) as running:
        yield running
