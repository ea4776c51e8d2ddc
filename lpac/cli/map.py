"""`lpac map`: the live map, a page for the browser of the laptop."""

from typing import Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import DEFAULT_FLEET, Fleet

app = new_app()


@app.command("map")
def live_map(
    fleet: Fleet = DEFAULT_FLEET,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any that is free.")] = 8300,
    host: Annotated[
        str, typer.Option(help="Where to serve; beyond this machine it asks for a token.")
    ] = "127.0.0.1",
    operate: Annotated[
        bool, typer.Option("--operate", help="Also command the fleet from the page.")
    ] = False,
    token: Annotated[
        str | None, typer.Option(help="The token; if not given, one is made where needed.")
    ] = None,
    over_tls: Annotated[
        bool, typer.Option("--tls", help="Serve over TLS, from the laptop with the authority.")
    ] = False,
    open_page: Annotated[bool, typer.Option("--open", help="Open it in the browser.")] = False,
) -> None:
    """Show the fleet on a live map, in a browser; needs `lpac ground`, and no internet.

    It only observes, unless --operate is given; then it asks for a token, which is part of the
    address. Without --tls anybody who listens on the network can read the token; with it, each
    browser has to import the authority once.
    """
    import asyncio
    import datetime
    import re
    import secrets
    import ssl
    import webbrowser

    from edge.core.address import is_loopback, require_host
    from lpac.fleet.settings import load_fleet
    from lpac.ground.map.access import Access, reached_at
    from lpac.ground.map.server import serve
    from lpac.ground.station.client import subscribe

    require_host("--host", host)
    config = load_fleet(fleet)
    if token is not None and re.fullmatch(r"[A-Za-z0-9_-]+", token) is None:
        raise ValueError("--token: must be letters, digits, '-' and '_'")
    if host == "::":
        # asyncio would serve IPv6 alone, of which a field's network has no address to open.
        host = "0.0.0.0"
    local = is_loopback(host)
    if token is None and (operate or not local):
        token = secrets.token_urlsafe(16)
    context = None
    if over_tls:
        from lpac.fleet.cards import open_authority
        from lpac.fleet.web_certificate import web_certificate

        addresses = ["127.0.0.1" if a == "localhost" else a for a in reached_at(host)]
        files = web_certificate(
            open_authority(config), addresses, datetime.datetime.now(datetime.UTC)
        )
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        context.load_cert_chain(files.certificate, files.key)
        typer.echo(f"browsers import {files.authority}")

    def ready(addresses: list[str]) -> None:
        for address in addresses:
            typer.echo(f"map of {config.fleet}: {address}")
        typer.echo("commands the fleet" if operate else "only observes; --operate commands")
        typer.echo("Ctrl-C ends it, and nothing else")
        try:
            with subscribe(config.fleet):
                pass
        except OSError as error:
            typer.echo(f"{error}; until then the map shows nothing")
        if open_page:
            webbrowser.open(addresses[0])

    asyncio.run(
        serve(
            config.fleet, host=host, port=port, operate=operate, tls=context, ready=ready,
            access=Access(local, token, "https" if over_tls else "http"),
        )
    )  # fmt: skip
