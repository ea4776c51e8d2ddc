"""The router by which a fleet in multicast reaches its ground: it outlives `lpac ground`."""

import time
from collections.abc import Callable
from pathlib import Path

from edge.core.schema import ConfigError
from edge.drivers.door import allow_most_descriptors
from edge.drivers.stop import Stop
from edge.drivers.zenoh_link import ZenohRouter
from lpac.fleet.settings import load_fleet
from lpac.ground.station.config import load_own_identity


def serve_router(path: Path, stop: Stop, on_listening: Callable[[str], None]) -> None:
    """Pass on what members say until `stop` is set; `on_listening` is told the endpoint.

    `path` is the fleet's description. Raises ConfigError, LinkError or OSError, in one line.
    """
    config = load_fleet(path)
    if config.router is None:
        raise ConfigError(
            f"{path}: radio: transport = 'mesh' has no router: set transport = \"multicast\" and "
            'router = "ADDRESS:PORT", and deploy'
        )
    identity = load_own_identity(config, None)
    tls = None if identity is None else identity.tls
    members = None if identity is None else identity.guard(time.monotonic)
    if members is not None:
        members.hear_time(time.time())
    allow_most_descriptors()
    with ZenohRouter(fleet=config.fleet, listen=(config.router,), tls=tls, members=members):
        on_listening(config.router)
        stop.wait()
