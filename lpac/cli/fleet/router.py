"""`lpac fleet router`: connects a fleet in multicast with its ground stations."""

import signal

import typer

from lpac.cli.options import DEFAULT_FLEET, Fleet


def router(fleet: Fleet = DEFAULT_FLEET) -> None:
    """Pass on what robots and ground stations say, until Ctrl-C.

    For `transport = "multicast"` in [radio]: on the computer that has the address named there, on a
    wire to the access point. `lpac ground` may come and go meanwhile.
    """
    from edge.drivers.stop import Stop
    from lpac.ground.router import serve_router

    stop = Stop()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    serve_router(fleet, stop, lambda at: typer.echo(f"router at {at}: Ctrl-C ends it"))
