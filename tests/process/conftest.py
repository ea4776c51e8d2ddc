"""What tests with real processes share."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture
def short_path() -> Iterator[Path]:
    """A new folder of a short path, for sockets: with their name they have 107 bytes."""
    with tempfile.TemporaryDirectory(prefix="lpac-") as folder:
        yield Path(folder)
