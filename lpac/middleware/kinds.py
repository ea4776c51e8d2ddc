"""The measured middlewares: one small interface, with an adapter for each."""

import importlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from types import MappingProxyType
from typing import Protocol

from lpac.extras import install_command

# Reference without any middleware.
NOTHING = "nothing"


class Peer(Protocol):
    """Sends to all other robots, until the robot's program ends."""

    def publish(self, data: bytes) -> None:
        """Send a message, which may be lost. Never raises."""


class OpenPeer(Protocol):
    """Signature of `open_peer` in an adapter's module."""

    def __call__(
        self, index: int, endpoints: Sequence[str], receive: Callable[[bytes], None]
    ) -> AbstractContextManager[Peer]:
        """Open robot `index`'s peer; `endpoints` are all robots', each `<IPv4 address>:<port>`.

        `receive` is called from any thread with each received message, and must only store it.
        Raises OSError if a port is in use.
        """


@dataclass(frozen=True, slots=True)
class Middleware:
    """`title` is for people, `adapter` the module, and `install` a shell command.

    `version` gives the installed version, or None. An optional middleware is only measured where it
    is installed.
    """

    title: str
    adapter: str
    install: str
    version: Callable[[], str | None]
    is_optional: bool = False

    def open_peer(self) -> OpenPeer:
        """Import the adapter. Raises ModuleNotFoundError if it is not installed."""
        opened: OpenPeer = importlib.import_module(self.adapter).open_peer
        return opened


def _of_package(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _of_fast_dds() -> str | None:
    installed: str | None = importlib.import_module("lpac.middleware.over_fastdds").version()
    return installed


_BENCH = install_command("bench")
MIDDLEWARES: Mapping[str, Middleware] = MappingProxyType(
    {
        "zenoh": Middleware(
            "zenoh", "lpac.middleware.over_zenoh", _BENCH, partial(_of_package, "eclipse-zenoh")
        ),
        "cyclonedds": Middleware(
            "Cyclone DDS",
            "lpac.middleware.over_cyclone",
            _BENCH,
            partial(_of_package, "cyclonedds"),
        ),
        "fastdds": Middleware(
            "Fast DDS",
            "lpac.middleware.over_fastdds",
            "sudo apt install g++ libfastrtps-dev",
            _of_fast_dds,
            is_optional=True,
        ),
    }
)
