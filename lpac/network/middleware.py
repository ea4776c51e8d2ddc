"""What robots speak with: one small interface, and an adapter for each middleware."""

import importlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from types import MappingProxyType
from typing import Protocol

# No middleware at all: what the others are compared with.
NOTHING = "nothing"


class Peer(Protocol):
    """Sends to all other robots. It is closed when the robot's program ends."""

    def publish(self, data: bytes) -> None:
        """It may be lost, and nothing raises."""


class OpenPeer(Protocol):
    """The function `open_peer` of an adapter's module."""

    def __call__(
        self, index: int, endpoints: Sequence[str], receive: Callable[[bytes], None]
    ) -> AbstractContextManager[Peer]:
        """Open robot `index`'s, of those at `endpoints`, each `<IPv4 address>:<port>`.

        `receive` is called with all that others say, from any thread, and only stores. Raises
        OSError if a port is taken.
        """


@dataclass(frozen=True, slots=True)
class Middleware:
    """`title` is for people, `package` what pip calls it, `adapter` the module."""

    title: str
    package: str
    adapter: str

    def open_peer(self) -> OpenPeer:
        """Raises ModuleNotFoundError if it is not installed."""
        opened: OpenPeer = importlib.import_module(self.adapter).open_peer
        return opened

    def version(self) -> str | None:
        """None if it is not installed."""
        try:
            return version(self.package)
        except PackageNotFoundError:
            return None


MIDDLEWARES: Mapping[str, Middleware] = MappingProxyType(
    {
        "zenoh": Middleware("zenoh", "eclipse-zenoh", "lpac.network.over_zenoh"),
        "cyclonedds": Middleware("Cyclone DDS", "cyclonedds", "lpac.network.over_cyclone"),
    }
)
