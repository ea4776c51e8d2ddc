"""Adapter for zenoh: the robots' own link, in a mesh, without keys."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Self

from edge.drivers.zenoh_link import ZenohLink
from edge.messages.topics import MESSAGE
from lpac.middleware.kinds import Peer


class _ZenohPeer:
    def __init__(self, link: ZenohLink) -> None:
        self._link = link

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._link.close()

    def publish(self, data: bytes) -> None:
        self._link.publish(MESSAGE, data)


def open_peer(
    index: int, endpoints: Sequence[str], receive: Callable[[bytes], None]
) -> AbstractContextManager[Peer]:
    """See `OpenPeer`. Like the robots of fleet.toml, a robot connects to all before it."""
    return _ZenohPeer(
        ZenohLink(
            fleet="bench",
            robot_id=index,
            listen=[f"tcp/{endpoints[index]}"],
            connect=[f"tcp/{endpoint}" for endpoint in endpoints[:index]],
            subscriptions={MESSAGE: lambda _, data: receive(data)},
        )
    )
